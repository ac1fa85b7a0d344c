"""A hydraulic gear pump with a filter, in steady operation: a script that is packed as an FMU.

The pump lifts oil from a tank through a pressure filter to a load whose pressure is held. Its
clearances wear, and the filter clogs. Units here are SI; the interface has those of the trade.

- Flow and torque of a positive displacement pump with laminar slip, after Wilson: H. E. Merritt,
  Hydraulic Control Systems, Wiley 1967, chapter 4; D. McCloy, H. R. Martin, Control of Fluid Power,
  Ellis Horwood 1980: Q = D w - C_s D p / mu, T = D p (1 + C_f) + C_v D mu w.
- Slip is flow through plane gaps (plane Poiseuille flow), so it grows with the cube of the
clearance:
  F. M. White, Viscous Fluid Flow, McGraw-Hill 1991, chapter 3.
- The filter is a porous layer: Darcy's law, p_f = mu R Q / (1 - c) with the share c of its area
blocked.
- Viscosity falls exponentially with temperature (Merritt, chapter 2); the oil is ISO VG 46, 46
mm2/s at
  40 C within 10 % (ISO 3448), and 6.8 mm2/s at 100 C, as mineral oils with a viscosity index near
  100.
- The steady temperature of the tank follows from what is lost in pump and filter, and a cooler.
"""

import math
from typing import NamedTuple

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

DISPLACEMENT = 16.0e-6 / (2.0 * math.pi)  # D, m3/rad: 16 cm3 per revolution
# New, at 1500 1/min, 150 bar and 50 C: 95 % volumetric and 93 % mechanical efficiency, as gear
# pumps have.
SLIP = 1.52e-8  # C_s
VISCOUS_DRAG = 1.0e5  # C_v
FRICTION = 0.05  # C_f
FILTER_RESISTANCE = 9.0e9  # R, 1/m3: about 1 bar when clean, at 23 L/min and 50 C
DENSITY = 870.0  # kg/m3
KINEMATIC_VISCOSITY = 46.0e-6  # m2/s at 40 C
VISCOSITY_DECAY = math.log(46.0 / 6.8) / 60.0  # 1/K
AMBIENT = 40.0  # C, in the cabinet
COOLING = 250.0  # W/K
HOTTEST = 120.0  # C: beyond, the oil fails and so does this model
BISECTIONS = 60  # until the bracket is as narrow as the numbers allow

UNITS = {
    "1": {"displays": {"%": 100.0}},
    "1/min": {"s": -1, "factor": 1.0 / 60.0},
    "bar": {"kg": 1, "m": -1, "s": -2, "factor": 1.0e5},
    "L/min": {"m": 3, "s": -1, "factor": 1.0e-3 / 60.0},
    "N.m": {"kg": 1, "m": 2, "s": -2},
    "degC": {"K": 1, "offset": 273.15},
    "W": {"kg": 1, "m": 2, "s": -3},
}
"""Exponents of SI units, factor and offset to them, of each unit that the interface uses."""

VARIABLES = {
    "speed": ("input", "1/min", 500.0, 2500.0, 1500.0, "shaft speed"),
    "pressure": ("input", "bar", 10.0, 210.0, 150.0, "pressure at the load"),
    "wear": (
        "input",
        "1",
        0.0,
        1.0,
        0.0,
        "growth of the clearances, as a share of those of the new pump",
    ),
    "clogging": ("input", "1", 0.0, 0.95, 0.0, "share of the filter area that is blocked"),
    "viscosity_factor": ("parameter", "1", 0.8, 1.2, 1.0, "viscosity over that of the nominal oil"),
    "flow": ("output", "L/min", None, None, None, "flow to the load"),
    "torque": ("output", "N.m", None, None, None, "torque at the shaft"),
    "temperature": ("output", "degC", None, None, None, "temperature of the oil"),
    "filter_pressure": ("output", "bar", None, None, None, "pressure drop over the filter"),
    "loss": ("output", "W", None, None, None, "power that becomes heat"),
}
"""Causality, unit, range, start value and meaning of each variable."""


def viscosity(temperature: float, factor: float) -> float:
    """Return the dynamic viscosity [Pa s] at a temperature [C]."""
    decay = math.exp(-VISCOSITY_DECAY * (temperature - 40.0))
    return factor * DENSITY * KINEMATIC_VISCOSITY * decay


class Conditions(NamedTuple):
    """The conditions that a pump works under, in SI units.

    Attributes
    ----------
    speed : float
        The shaft speed [rad/s].
    pressure : float
        The pressure at the load [Pa].
    wear : float
        The growth of the clearances, as a fraction of those of the new pump.
    clogging : float
        The fraction of the filter area that is blocked.
    viscosity_factor : float
        The viscosity over that of the nominal oil.
    """

    speed: float
    pressure: float
    wear: float
    clogging: float
    viscosity_factor: float


class Operation(NamedTuple):
    """The operation of a pump, in SI units.

    Attributes
    ----------
    flow : float
        The flow to the load [m3/s].
    torque : float
        The torque at the shaft [N m].
    filter_pressure : float
        The pressure drop over the filter [Pa].
    loss : float
        The power that becomes heat [W].
    """

    flow: float
    torque: float
    filter_pressure: float
    loss: float


def operation(temperature: float, conditions: Conditions) -> Operation:
    """Return the operation of the pump at a temperature of the oil [C].

    The pump works against load and filter, and both slip and filter pressure are linear in the
    pressures, so that the flow is explicit.
    """
    speed, pressure = conditions.speed, conditions.pressure
    mu = viscosity(temperature, conditions.viscosity_factor)
    slip = SLIP * DISPLACEMENT * (1.0 + conditions.wear) ** 3 / mu
    resistance = mu * FILTER_RESISTANCE / (1.0 - conditions.clogging)
    flow = (DISPLACEMENT * speed - slip * pressure) / (1.0 + slip * resistance)
    filter_pressure = resistance * flow
    torque = DISPLACEMENT * (pressure + filter_pressure) * (1.0 + FRICTION)
    torque += VISCOUS_DRAG * DISPLACEMENT * mu * speed
    loss = torque * speed - pressure * flow
    return Operation(flow, torque, filter_pressure, loss)


def steady_temperature(conditions: Conditions) -> float:
    """Return the temperature [C] at which the cooler takes the lost power; NaN if there is none."""

    def surplus_heat(temperature: float) -> float:
        loss = operation(temperature, conditions).loss
        return loss - COOLING * (temperature - AMBIENT)

    low, high = AMBIENT, HOTTEST
    if not surplus_heat(low) > 0.0 > surplus_heat(high):
        return math.nan
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if surplus_heat(middle) > 0.0:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


class GearPump(Fmi2Slave):  # type: ignore[misc]
    """The pump. Each step is the steady operation under its inputs; the pump has no memory."""

    description = "Hydraulic gear pump with filter in steady operation; clearances wear and the filter clogs."
    variable_table = VARIABLES
    unit_table = UNITS

    def __init__(self, **kwargs: object) -> None:
        super().__init__(**kwargs)
        for name, (causality, _, _, _, start, text) in VARIABLES.items():
            setattr(self, name, 0.0 if start is None else start)
            is_parameter = causality == "parameter"
            variability = Fmi2Variability.fixed if is_parameter else Fmi2Variability.continuous
            variable = Real(
                name,
                causality=Fmi2Causality[causality],
                variability=variability,
                description=text,
            )
            self.register_variable(variable)

    def exit_initialization_mode(self) -> None:
        """Show the operation at the start already."""
        self._operate()

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Set the outputs of a step; return False (fmi2Discard) without a steady operation."""
        return self._operate()

    def _operate(self) -> bool:
        """Set the outputs; return whether there is a steady operation under the inputs."""
        conditions = Conditions(
            speed=self.speed * 2.0 * math.pi / 60.0,
            pressure=1.0e5 * self.pressure,
            wear=self.wear,
            clogging=self.clogging,
            viscosity_factor=self.viscosity_factor,
        )
        temperature = steady_temperature(conditions)
        if math.isnan(temperature):
            self.log(f"the cooler cannot hold the oil below {HOTTEST:g} C under these inputs")
            return False
        steady = operation(temperature, conditions)
        if steady.flow <= 0.0:
            self.log("the pump is worn so far that it delivers nothing against this pressure")
            return False
        self.flow = 6.0e4 * steady.flow
        self.torque = steady.torque
        self.temperature = temperature
        self.filter_pressure = 1.0e-5 * steady.filter_pressure
        self.loss = steady.loss
        return True
