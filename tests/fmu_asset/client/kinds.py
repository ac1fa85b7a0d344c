"""Assets of every kind, as `kinds.toml` names them, and the oracles of what they show."""

import math
import tomllib
from collections import ChainMap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.runtime.state import TIP_FORCE
from fe.runtime.transient import ModalIntegrator
from fe.structure.design import parse_structure
from fmu_asset.client.binding import Binding, load_binding, parse_binding
from fmu_asset.companions.damage_growth import DamageGrowthBehaviour
from fmu_asset.structures import structure_binding
from scenarios import binding_files
from tests.conftest import BEAM
from tests.fmu_asset.making import parameters_of, tables
from tests.fmu_asset.ours import OurFmus

Inputs = Mapping[str, Mapping[str, Any]]
Shown = tuple[Any, Mapping[str, Any]]
"""Observations, a row for each step, and further outputs by name."""
STEPS = 18


@dataclass(frozen=True)
class Kind:
    """An asset, its course and its oracle; see `kinds.toml`.

    Attributes
    ----------
    file : str
        A name of `ours`, a model of `foreign_fmu` or a system.
    binding : Binding
        What it is flown through.
    course : mapping
        Inputs by role and name: one for each step, or one for all.
    oracle : callable, optional
        What the course must show, from the kind and `ours`.
    rtol, largest, atol : float
        How far from it.
    state : {"serialised", "replay"}
        How its state is kept.
    start : mapping
        Inputs of the start.
    parameters : mapping
        Parameters by the binding's names.
    """

    file: str
    binding: Binding
    course: Inputs
    oracle: Callable[..., Shown] | None = None
    rtol: float = 0.0
    largest: float = 0.0
    atol: float = 0.0
    state: str = "serialised"
    start: Inputs = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def at(self, index: int) -> dict[str, dict[str, Any]]:
        """Return the inputs of one step, as `step` takes them."""
        return {
            role: {
                name: values[index] if np.ndim(values) else values
                for name, values in histories.items()
            }
            for role, histories in self.course.items()
        }

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Return the inputs of each step, whatever their role."""
        return [dict(ChainMap(*self.at(index).values())) for index in range(STEPS)]


HERE = Path(__file__).parent
INPUTS, FILE = tables(__file__, "inputs"), tables(__file__, "kinds")
"""Tables of what is refused, and of kinds."""
BINDINGS_FOLDER = HERE / "bindings"
_FILES = *BINDINGS_FOLDER.glob("*.toml"), *binding_files().values()
BINDINGS = {path.stem: load_binding(path) for path in _FILES}
"""By the name of the file."""
BINDINGS["beam"] = structure_binding(parse_structure(tomllib.loads(BEAM)))
HOSTILE, WING_BINDING, SPRING_BINDING = (
    BINDINGS[name] for name in ("hostile2", "uav_wing", "spring_mass")
)

# ---------------------------------------------------------------------- structures


def statics(kind: Kind, ours: OurFmus) -> Shown:
    """The static response to each row of inputs; accelerations are zero."""
    model = ours.model(kind.file)
    parameters = {name: value for name, value in kind.parameters.items() if name != "response"}
    responses = [model.static_response({**row, **parameters}) for row in kind.rows]
    strains = [response.strain for response in responses]
    strain_error_bounds = [response.strain_error_bound for response in responses]
    if kind.file == "beam":
        values = [[*response.strain, *response.displacement, 0.0] for response in responses]
        return values, {"strain_error_bound": strain_error_bounds}
    tip_displacements = [response.displacement[0] for response in responses]
    return strains, {
        "strain_error_bound": strain_error_bounds,
        "tip_displacement": tip_displacements,
    }


def motion(kind: Kind, ours: OurFmus) -> Shown:
    """The modal integrator: a release, loads that jump, health that changes on the way."""
    model = ours.model(kind.file)
    parameters = kind.parameters
    damping_alpha = parameters.get("damping_alpha", model.damping[0])
    damping_beta = parameters.get("damping_beta", model.damping[1])
    initial_inputs = model.vector(dict(ChainMap(*kind.start.values())))
    integrator = ModalIntegrator(model.structure_at(initial_inputs), damping_alpha, damping_beta)
    initial_loads = model.load_coefficients(initial_inputs)
    tip_displacement = parameters.get("initial_tip_displacement", 0.0)
    if tip_displacement:
        state = integrator.state_after_release(tip_displacement, initial_loads, TIP_FORCE)
    else:
        state = integrator.state_at_rest(initial_loads)
    health = dict.fromkeys(model.regions, 0.0) | kind.start.get("health", {})
    outputs = []
    for row in kind.rows:
        inputs = model.vector(row)
        health_of_row = {name: row[name] for name in model.regions}
        if health_of_row != health:
            health = health_of_row
            previous = integrator
            integrator = ModalIntegrator(model.structure_at(inputs), damping_alpha, damping_beta)
            state = integrator.take_over(state, previous)
        state = integrator.advance(state, kind.binding.step_size, model.load_coefficients(inputs))
        outputs.append(integrator.outputs(state))
    values = np.array(outputs)
    if kind.file == "beam":
        return values, {}
    return values[:, :-1], {"tip_displacement": values[:, -1]}


# ---------------------------------------------------------------------- others' FMUs


def after(kind: Kind, first: Any, move: Callable[[Any, dict[str, Any]], Any]) -> Any:
    """Return the states after each row of inputs."""
    return np.array([*accumulate(kind.rows, move, initial=first)][1:])


def calls(kind: Kind) -> FloatArray:
    """How often the FMU was asked for a step."""
    return kind.binding.binding.decimation * np.arange(1.0, STEPS + 1)


def spring(kind: Kind, _: OurFmus) -> Shown:
    def move(state: tuple[float, float], row: dict[str, Any]) -> tuple[float, float]:
        velocity, position = state
        for _ in range(0 if row["lock"] else 100):
            velocity += (row["push"] - row["spring"] * position) * 0.001
            position += velocity * 0.001
        return velocity, position

    return after(kind, (0.0, 0.0), move), {"steps": calls(kind)}


def lag(kind: Kind, _: OurFmus) -> Shown:
    """Out1' = (K In1 - Out1) / T, exact for inputs that are held; `hold` stops it."""
    gain = kind.parameters["gain"]
    decay = math.exp(-kind.binding.interval / kind.parameters["time"])

    def move(output: float, row: dict[str, Any]) -> float:
        if row["hold"]:
            return output
        steady = gain * row["speed"]
        return steady + (output - steady) * decay

    return after(kind, 0.0, move)[:, np.newaxis], {"count": calls(kind)}


def room(kind: Kind, _: OurFmus) -> Shown:
    """Half of the heater's power over 100 W/K, above what it is outside."""

    def move(state: tuple[float, float], row: dict[str, Any]) -> tuple[float, float]:
        power = 500.0 * row["power"] * row["on"]
        steady = row["outside"] + power / 100.0
        warm = steady + (state[0] - steady) * math.exp(-60.0 * 100.0 / 5e4)
        return warm, (power - 100.0 * (warm - row["outside"])) / 5e4

    warm, rate = after(kind, (20.0, 0.0), move).T
    return np.array([warm, warm]).T, {"room.T": warm + 273.15, "der(room.T)": rate}


def fixed(kind: Kind, _: OurFmus) -> Shown:
    sums = np.cumsum(kind.course["control"]["u"])[:, np.newaxis]
    return 0.01 * kind.binding.binding.decimation * sums, {"calls": calls(kind)}


def array(kind: Kind, _: OurFmus) -> Shown:
    """The sum of gain A u + offset over the steps while active, in mm."""
    matrix = np.arange(1.0, 7.0).reshape(2, 3)
    for place, name in (((0, 0), "first"), ((1, 2), "corner")):
        matrix[place] = kind.parameters.get(name, matrix[place])
    matrix = kind.parameters.get("gain", 1.0) * np.reshape(kind.parameters.get("A", matrix), (2, 3))

    def move(total: FloatArray, row: dict[str, Any]) -> FloatArray:
        u = row["u"] if "u" in row else np.array([row["first"], 0.0, row["third"]])
        return total + row.get("active", 1.0) * (matrix @ u + row["offset"])

    return 1e-3 * after(kind, np.zeros(2), move), {"calls": calls(kind)}


def bounces(restitution: float, gravity: float, until: float) -> tuple[float, float, int]:
    """Return height, velocity and number of bounces of a ball let go at 1 m."""
    time, velocity = math.sqrt(2.0 / gravity), math.sqrt(2.0 * gravity)
    if until < time:
        return 1.0 - 0.5 * gravity * until**2, -gravity * until, 0
    for count in range(1, 1000):
        velocity *= restitution
        left, flight = until - time, 2.0 * velocity / gravity
        if left < flight:
            return velocity * left - 0.5 * gravity * left**2, velocity - gravity * left, count
        time += flight
    raise AssertionError(until)


def ball(kind: Kind, _: OurFmus) -> Shown:
    moments = kind.binding.interval * np.arange(1, STEPS + 1)
    found = [bounces(kind.parameters.get("restitution", 0.7), 9.81, moment) for moment in moments]
    return [[1e3 * height, speed] for height, speed, _ in found], {
        "bounces": [item[2] for item in found]
    }


def decay(kind: Kind, _: OurFmus) -> Shown:
    k = kind.parameters["k"]
    rest = math.exp(-k * kind.binding.interval)
    shown = after(kind, 1.0, lambda x, row: rest * x + (1.0 - rest) * (row["u"] + 273.15) / k)
    return shown[:, np.newaxis], {}


def swing(kind: Kind, _: OurFmus) -> Shown:
    """x'' = -9 (x - a): a becomes 1 at t = 1."""
    time = kind.binding.interval * np.arange(1, STEPS + 1)
    x, v = 0.5 * np.cos(3.0 * np.minimum(time, 1.0)), -1.5 * np.sin(3.0 * np.minimum(time, 1.0))
    late = np.maximum(time - 1.0, 0.0)
    c, s, a = np.cos(3.0 * late), np.sin(3.0 * late), 1.0 * (time > 1.0)
    return np.array([a + (x - a) * c + v / 3.0 * s, v * c - 3.0 * (x - a) * s, a]).T, {}


def follower(kind: Kind, _: OurFmus) -> Shown:
    """x' = u - x, x(0) = 0, u in straight lines; `seen` is u at the last call."""
    step, line = (
        kind.binding.interval,
        np.array([kind.start["control"]["u"], *kind.course["control"]["u"]]),
    )
    lost = 1.0 - math.exp(-step)
    shown = accumulate(
        pairwise(line), initial=0.0,
        func=lambda x, u: x + lost * (u[0] - x) + (u[1] - u[0]) / step * (step - lost),
    )  # fmt: skip
    values = np.array([*shown][1:])[:, np.newaxis]
    if kind.file == "follow1" or kind.binding.binding.interface == "model-exchange":
        return values, {}
    return values, {
        "seen": line[:-1] + (1.0 - 1.0 / kind.binding.binding.decimation) * np.diff(line)
    }


def integral(kind: Kind, _: OurFmus) -> Shown:
    return np.cumsum(kind.course["control"]["u"])[:, np.newaxis], {}


def damage(kind: Kind, ours: OurFmus) -> Shown:
    """The behaviour that is packed, in this process."""
    values = parameters_of(ours(kind.file))
    values |= {
        kind.binding.parameter[name].variable: value for name, value in kind.parameters.items()
    }
    behaviour = DamageGrowthBehaviour()
    behaviour.start(values, 0.0, [1.0])
    loads = enumerate(kind.course["control"]["load_factor"])
    return [behaviour.advance(float(time), 1.0, [load]) for time, load in loads], {}


# ---------------------------------------------------------------------- the table


def merged(one: Any, other: Any) -> Any:
    """Return nested tables as one; where both say something, the other's."""
    if not (isinstance(one, dict) and isinstance(other, dict)):
        return other
    return one | {key: merged(one.get(key), value) for key, value in other.items()}


def drawn(course: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return inputs at random within limits: a new one at every step, of health at every third."""
    draw, held = np.random.default_rng(6), np.repeat(np.arange(0, STEPS, 3), 3)

    def history(role: str, limits: Any) -> Any:
        if not isinstance(limits, list):
            return limits
        low, high, *count = limits
        if isinstance(low, int):
            return draw.integers(low, high, STEPS, endpoint=True)
        values = draw.uniform(low, high, (STEPS, *count))
        return values[held] if role == "health" else values

    return {
        role: {name: history(role, limits) for name, limits in names.items()}
        for role, names in course.items()
    }


def kind_of(row: dict[str, Any]) -> Kind:
    """Return the kind of a row of the table."""
    record = BINDINGS[row.get("binding", row["file"])].model_dump(exclude_none=True, mode="json")
    further = {
        key: row[key]
        for key in ("rtol", "largest", "atol", "state", "start", "parameters")
        if key in row
    }
    return Kind(
        row["file"],
        parse_binding(merged(record, {"binding": row.get("header", {}), **row.get("tables", {})})),
        drawn(row.get("course", {})),
        globals().get(row.get("oracle")),
        **further,
    )


def kinds() -> dict[str, Kind]:
    """Return the kinds of the table."""
    found = {}
    for name, its in FILE["kind"].items():
        row = merged(FILE["flight"].get(its.get("flight"), {}), its)
        for ending, way in (("", row.get("still", {})), (" in motion", row.get("moving", False))):
            if way is not False:
                found[name + ending] = kind_of(merged(row, way))
    return found


KINDS = kinds()
