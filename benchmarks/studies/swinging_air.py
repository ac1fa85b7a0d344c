"""The temperature around a wing, packed as an FMU: a sine about the reference temperature."""

import math

from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real

UNITS = {"1": {}, "s": {"s": 1}, "K": {"K": 1}}
VARIABLES = {
    "swing": ("parameter", "K", 0.0, 60.0, 20.0, "amplitude of the swing"),
    "period": ("parameter", "s", 1.0, 1e6, 40.0, "period of the swing"),
    "temperature_difference": (
        "output",
        "K",
        None,
        None,
        None,
        "temperature minus the reference temperature temperature",
    ),
}


class SwingingAir(Fmi2Slave):  # type: ignore[misc]
    """Temperature less its reference at the end of each step."""

    author = "uav-twin"
    description = "Temperature around a wing"
    unit_table = UNITS
    variable_table = VARIABLES

    def __init__(self, **keywords: object) -> None:
        super().__init__(**keywords)
        self.swing = 20.0
        self.period = 40.0
        self.temperature_difference = 0.0
        for name in ("swing", "period"):
            self.register_variable(
                Real(name, causality=Fmi2Causality.parameter, variability=Fmi2Variability.tunable)
            )
        self.register_variable(Real("temperature_difference", causality=Fmi2Causality.output))

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Show the temperature at the end of the step."""
        phase = 2.0 * math.pi * (current_time + step_size) / self.period
        self.temperature_difference = self.swing * math.sin(phase)
        return True
