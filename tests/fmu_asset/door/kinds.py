"""Assets of every kind behind the one door: what each is flown with, and what it must show."""

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from fe.runtime.state import TIP_FORCE
from fe.runtime.transient import ModalIntegrator
from fe.structure.design import parse_structure
from fmu_asset.companions.damage_growth import DamageGrowth
from fmu_asset.coupling.structure import Component, Setting, SystemStructure
from fmu_asset.door.binding import Binding, load_binding
from fmu_asset.slaves.effects import output_channels
from fmu_asset.structures.binding import structure_binding
from scenarios import binding_files
from tests.conftest import BEAM
from tests.fmu_asset.making import bound, changed, linear, parameters_of, system, watch
from tests.fmu_asset.ours import REGIONS, OurFmus

Floats = npt.NDArray[np.float64]
Inputs = Mapping[str, Mapping[str, Any]]
Shown = tuple[Any, Mapping[str, Any]]
"""Observations, a row for each step, and further outputs by name."""


@dataclass(frozen=True)
class Kind:
    """An asset, its course and its oracle.

    Attributes
    ----------
    file : str
        A name of `ours`, a model of `foreign_fmu` or a system of `systems`.
    binding : Binding
        What it is flown through.
    course : mapping
        Inputs by role and name: one for each step, or one for all.
    expected : callable, optional
        What the course must show, from the kind and `ours`; without it, only what holds of every asset is
        checked.
    rtol, largest : float
        How far from it: relative to each number, or to the largest observation. Both zero: to the bit.
    atol : float
        Absolute, of each number.
    state : {"serialised", "replay"}
        How its state is kept.
    start : mapping
        Inputs of the start.
    parameters : mapping
        Parameters by the binding's names.
    arrays : tuple of str
        Inputs that are whole arrays.
    """

    file: str
    binding: Binding
    course: Inputs
    expected: Callable[..., Shown] | None = None
    rtol: float = 0.0
    largest: float = 0.0
    atol: float = 0.0
    state: str = "replay"
    start: Inputs = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    arrays: tuple[str, ...] = ()

    @property
    def steps(self) -> int:
        """Number of steps of the course."""
        histories = [values for names in self.course.values() for values in names.values()]
        single = [len(values) for values in histories if np.ndim(values)]
        return max(single, default=8)

    def at(self, index: int) -> dict[str, dict[str, Any]]:
        """Return the inputs of one step, as `step` takes them."""
        return {
            role: {
                name: values[index] if np.ndim(values) > (name in self.arrays) else values
                for name, values in histories.items()
            }
            for role, histories in self.course.items()
        }


# ---------------------------------------------------------------------- structures

WING = load_binding(binding_files()["uav_wing"])
INPUTS = tomllib.loads(Path(__file__).with_name("inputs.toml").read_text("utf-8"))
"""Tables of what is refused."""
BINDINGS_FOLDER = Path(__file__).with_name("bindings")
BINDINGS = {path.stem: load_binding(path) for path in BINDINGS_FOLDER.glob("*.toml")}
"""Of others' FMUs and systems, by the name of the model."""
HOSTILE, SYSTEM_OF_THREE = BINDINGS["hostile2"], BINDINGS["three"]
QUASI_STATIC, TRANSIENT = 1.0, 2.0
MOVING = {"response": TRANSIENT, "initial_tip_displacement": 0.03, "damping_alpha": 1.0, "damping_beta": 1e-4}


def random_course(
    roles: Mapping[str, Mapping[str, tuple[float, float]]], steps: int = 24
) -> dict[str, dict[str, Floats]]:
    """Return inputs at random within limits: a new one at every step, of health at every third."""
    draw, held = np.random.default_rng(6), np.repeat(np.arange(0, steps, 3), 3)[:steps]
    return {
        role: {name: draw.uniform(*limits, steps)[held if role == "health" else slice(None)]
               for name, limits in limited.items()}
        for role, limited in roles.items()
    }  # fmt: skip


def wing_course(regions: tuple[str, ...] = ("z1", "z2")) -> Inputs:
    """Return a course whose forces are whole numbers, which are sent as any number."""
    course = random_course({
        "control": {"load_factor": (-1.0, 4.0)}, "health": dict.fromkeys(regions, (0.0, 0.8)),
        "load": {"tip_force": (-15.0, 15.0)},
    })  # fmt: skip
    return course | {"load": {"tip_force": np.round(course["load"]["tip_force"]).astype(int)}}


def rows_of(kind: Kind) -> list[dict[str, Any]]:
    """Return the inputs of each step, whatever their role."""
    return [
        {name: value for named in kind.at(index).values() for name, value in named.items()}
        for index in range(kind.steps)
    ]


def statics(kind: Kind, ours: OurFmus) -> Shown:
    """The static response to each row of inputs; accelerations are zero."""
    model = ours.model(kind.file)
    given = {name: value for name, value in kind.parameters.items() if name != "response"}
    found = [model.static_response({**row, **given}) for row in rows_of(kind)]
    bounds = {"strain_error_bound": [item.strain_error_bound for item in found]}
    if model.name != WING.name:
        return [[*item.strain, *item.displacement, 0.0] for item in found], bounds
    tips = {"tip_displacement": [item.displacement[0] for item in found]}
    return [item.strain for item in found], bounds | tips


def motion(kind: Kind, ours: OurFmus) -> Shown:
    """The modal integrator: a release, loads that jump, health that changes on the way."""
    model, given = ours.model(kind.file), kind.parameters
    damping = [given.get(f"damping_{name}", model.damping[k]) for k, name in enumerate(("alpha", "beta"))]
    now = ModalIntegrator(model, model.nominal, *damping)
    tip, at_start = given.get("initial_tip_displacement", 0.0), model.load_coefficients(model.nominal)
    state = now.released(tip, at_start, TIP_FORCE) if tip else now.at_rest(at_start)
    health, shown = dict.fromkeys(model.regions, 0.0), []
    for row in rows_of(kind):
        vector = model.vector(row)
        if health != (health := {name: row[name] for name in model.regions}):
            was, now = now, ModalIntegrator(model, vector, *damping)
            state = now.take_over(state, was)
        state = now.advance(state, kind.binding.step_size, model.load_coefficients(vector))
        shown.append(now.outputs(state))
    values = np.array(shown)
    if model.name != WING.name:
        return values, {}
    return values[:, :-1], {"tip_displacement": values[:, -1]}


def wing(file: str, response: float, **further: Any) -> Kind:
    """A wing at rest or in motion."""
    binding = load_binding(binding_files()["uav_wing_fmi3" if file == "fmi3" else "uav_wing"])
    regions, start = ("z1", "z2"), {}
    if file.endswith("regions"):
        regions, start = REGIONS, {"health": dict.fromkeys(REGIONS, 0.0)}
        binding = binding.with_regions(REGIONS)
    if response == QUASI_STATIC:
        still = {"response": QUASI_STATIC, "young_modulus_factor": 1.05}
        return Kind(file, binding, wing_course(regions), statics, start=start, parameters=still, **further)
    binding = changed(binding, header={"step_size": 0.005})
    return Kind(file, binding, wing_course(regions), motion, start=start, parameters=MOVING, **further)


def exchange(file: str, health: str, **header: object) -> Kind:
    """A wing whose modes our solver moves; they are those of one that moves them itself."""
    regions = {f"z{number}": {"variable": health.format(number), "unit": "1"} for number in (1, 2)}
    binding = changed(WING, header={"step_size": 0.005, "tolerance": 1e-9, **header}, health=regions)
    return Kind(file, binding, wing_course(), motion, largest=1e-6, parameters=MOVING)


BEAM_BINDING = structure_binding(parse_structure(tomllib.loads(BEAM)))
BEAM_COURSE = random_course({
    "control": {"load_factor": (-4.0, 6.0), "push": (-50.0, 50.0)},
    "health": {"z1": (0.0, 0.8), "z2": (0.0, 0.8)},
})  # fmt: skip


INTERVAL = 0.01
CHANNELS = output_channels(24)
OUTPUTS = [name for name, _ in CHANNELS]


def watching(
    step_size: float = INTERVAL, load: Mapping[str, tuple[str, str]] | None = None, **header: object
) -> Binding:
    """Return a binding of a wing that observes all outputs."""
    return bound(
        step_size, {"all": (OUTPUTS, ["1"] * 24 + ["m"] * 2)}, header=header,
        control={"load_factor": ("load_factor", "1")},
        health={name: (f"health.{name}", "1") for name in ("z1", "z2")},
        load={"tip_force": ("tip_force", "N"), **(load or {})},
        parameter={"response": ("response", "1"), "release": ("initial_tip_displacement", "m")},
        record=["strain_error_bound", "frequency[{1..6}]", "damping_ratio[{1..6}]"],
    )  # fmt: skip


def on(*names: str) -> dict[str, float]:
    """Return the parameters that switch effects on."""
    return {f"effect.{name}.active": 1.0 for name in names}


WARM = {"temperature": ("temperature_difference", "K")}
SENDING = watching(
    0.05, WARM | {"drift": ("effect.gauge_zero_drift.active", "1"),
                  "time_constant": ("effect.coupling.time_constant[2]", "s")},
)  # fmt: skip


def playing(step_size: float = INTERVAL) -> Binding:
    """Return a binding that sends switches and a value of effects at every step."""
    sent = {name: (f"effect.{name}.active", "1") for name in ("root", "play")}
    return watching(step_size, WARM | sent | {"half_width": ("effect.play.half_width", "m")})


HYSTERESIS = ("slip", "bouc_wen", "friction", "local_loss")


def with_effects(file: str, binding: Binding, names: tuple[str, ...], switch: str, **given: float) -> Kind:
    """A wing with effects, of which one comes and goes; what they do is tested beside whole records."""
    course = wing_course()
    warm = np.linspace(0.0, 3.0, 24)
    load = {**course["load"], "temperature": warm, switch: np.arange(24) % 4 > 1}
    return Kind(file, binding, {**course, "load": load}, parameters=on(*names) | given, state="serialised")


# ---------------------------------------------------------------------- others' FMUs


def after(kind: Kind, first: Any, move: Callable[[Any, dict[str, Any]], Any]) -> Any:
    """Return the states after each row of inputs."""
    return np.array([*accumulate(rows_of(kind), move, initial=first)][1:])


def calls(kind: Kind) -> Floats:
    """How often the FMU was asked for a step."""
    return kind.binding.binding.decimation * np.arange(1.0, kind.steps + 1)


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
    gain, rest = kind.parameters["gain"], math.exp(-kind.binding.interval / kind.parameters["time"])

    def move(out: float, row: dict[str, Any]) -> float:
        steady = gain * row["speed"]
        return out if row["hold"] else steady + (out - steady) * rest

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

    def move(total: Floats, row: dict[str, Any]) -> Floats:
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
    moments = kind.binding.interval * np.arange(1, kind.steps + 1)
    found = [bounces(kind.parameters.get("restitution", 0.7), 9.81, moment) for moment in moments]
    return [[1e3 * height, speed] for height, speed, _ in found], {"bounces": [item[2] for item in found]}


def decay(kind: Kind, _: OurFmus) -> Shown:
    k = kind.parameters["k"]
    rest = math.exp(-k * kind.binding.interval)
    shown = after(kind, 1.0, lambda x, row: rest * x + (1.0 - rest) * (row["u"] + 273.15) / k)
    return shown[:, np.newaxis], {}


def swing(kind: Kind, _: OurFmus) -> Shown:
    """x'' = -9 (x - a): a becomes 1 at t = 1."""
    time = kind.binding.interval * np.arange(1, kind.steps + 1)
    x, v = 0.5 * np.cos(3.0 * np.minimum(time, 1.0)), -1.5 * np.sin(3.0 * np.minimum(time, 1.0))
    late = np.maximum(time - 1.0, 0.0)
    c, s, a = np.cos(3.0 * late), np.sin(3.0 * late), 1.0 * (time > 1.0)
    return np.array([a + (x - a) * c + v / 3.0 * s, v * c - 3.0 * (x - a) * s, a]).T, {}


LINE = np.array([0.5, 2.0, -1.0, -1.0, 3.0, 3.5, 0.0])


def follower(kind: Kind, _: OurFmus) -> Shown:
    """x' = u - x, x(0) = 0, u in straight lines; `seen` is u at the last call."""
    step = kind.binding.interval
    lost = 1.0 - math.exp(-step)
    shown = accumulate(
        pairwise(LINE), initial=0.0,
        func=lambda x, u: x + lost * (u[0] - x) + (u[1] - u[0]) / step * (step - lost),
    )  # fmt: skip
    values = np.array([*shown][1:])[:, np.newaxis]
    if kind.file == "follow1" or kind.binding.binding.interface == "model-exchange":
        return values, {}
    return values, {"seen": LINE[:-1] + (1.0 - 1.0 / kind.binding.binding.decimation) * np.diff(LINE)}


def following(file: str, *, quarters: bool = False, **header: object) -> Kind:
    divided = {"step_size": 0.0625, "decimation": 4} if quarters else {}
    binding = bound(
        0.25, {"x": ("x", "1")}, control={"u": ("u", "1")}, monitor={"seen": ("seen", "1")},
        header={"interpolation": "linear", **divided, **header},
    )  # fmt: skip
    return Kind(
        file, binding, {"control": {"u": LINE[1:]}}, follower, atol=1e-8 if header else 1e-13,
        state="replay" if header or file == "follow1" else "serialised", start={"control": {"u": LINE[0]}},
    )  # fmt: skip


EXCHANGED = {"interface": "model-exchange", "tolerance": 1e-11}


def integral(kind: Kind, _: OurFmus) -> Shown:
    return np.cumsum(kind.course["control"]["u"])[:, np.newaxis], {}


def damage(kind: Kind, ours: OurFmus) -> Shown:
    """The behaviour that is packed, in this process."""
    values = parameters_of(ours(kind.file))
    values |= {kind.binding.parameter[name].variable: value for name, value in kind.parameters.items()}
    behaviour = DamageGrowth()
    behaviour.start(values, 0.0, [1.0])
    loads = enumerate(kind.course["control"]["load_factor"])
    return [behaviour.advance(float(time), 1.0, [load]) for time, load in loads], {}


# ---------------------------------------------------------------------- systems

M1, M2, K1, K2, KC, C1, CC = 1.0, 1.5, 4.0, 3.0, 2.0, 0.1, 0.2
OSCILLATOR = np.array([1.0, 0.0, -0.5, 0.3])  # x1, v1, x2, v2 at the start
# The first mass is pushed by a force, the second one feels where the first one is and answers with the force.
A1, B1 = np.array([[0.0, 1.0], [-K1 / M1, -C1 / M1]]), np.array([[0.0, 0.0], [1.0 / M1, 1.0 / M1]])
A2 = np.array([[0.0, 1.0], [-(K2 + KC) / M2, -CC / M2]])
B2 = np.array([[0.0, 0.0], [KC / M2, CC / M2]])
C2, D2 = np.array([[KC, CC], [0.0, 0.0]]), np.array([[-KC, -CC], [0.0, 0.0]])


def held(matrix: Floats, inputs: Floats, step: float) -> tuple[Floats, Floats]:
    """Return what moves states and held inputs over a step."""
    block = np.zeros((4, 4))
    block[:2, :2], block[:2, 2:] = matrix, inputs
    whole = expm(block * step)
    return whole[:2, :2], whole[:2, 2:]


def recursion(kind: Kind, _: OurFmus) -> Shown:
    """Positions and force of two masses, the coupling written out by hand."""
    (p1, q1), (p2, q2) = (held(a, b, kind.binding.interval) for a, b in ((A1, B1), (A2, B2)))
    x, z = OSCILLATOR[:2], OSCILLATOR[2:]
    force, shown = (C2 @ z + D2 @ x)[0], []
    for push in kind.course["control"]["push"]:
        old, x = x, p1 @ x + q1 @ [force, push]
        seen = old if kind.file.endswith("jacobi") else x
        z = p2 @ z + q2 @ seen
        force = (C2 @ z + D2 @ seen)[0]
        shown.append([*x, force])
    return shown, {}


def oscillator(
    state_fmu: Path, linear_fmu: Path, substeps: int = 1, *, pushed: bool = False
) -> SystemStructure:
    """Return two masses, the components in the wrong order: the right one follows from the dependencies."""
    first = linear("first", state_fmu, substeps, a=A1, b=B1, c=np.eye(2), initial=OSCILLATOR[:2])
    second = linear("second", linear_fmu, substeps, a=A2, b=B2, c=C2, d=D2, initial=OSCILLATOR[2:])
    ends = [("first.y1", "second.u1"), ("first.y2", "second.u2"), ("second.y1", "first.u1")]
    return system([second, first], [*ends, *([("push", "first.u2")] if pushed else [])])


def three(ours: OurFmus) -> SystemStructure:
    """Return damage growth, a wing in motion and its gauges."""
    damage = {"probability.z1": Setting(0.5), "probability.z2": Setting(0.4), "seed": Setting(7)}
    moving = {"response": Setting("transient"), "damping.alpha": Setting(1.0)}
    gauges = {"noise": Setting(150.0, "microstrain"), "dropout_probability": Setting(10.0, "%")}
    return system(
        [
            Component("damage", ours("damage_growth"), damage),
            Component("gauges", ours("strain_gauges"), gauges),
            Component("wing", ours("python"), moving),
        ],
        [
            ("load_factor", "wing.load_factor"),
            ("load_factor", "damage.load_factor"),
            ("damage.z1", "wing.health.z1"),
            ("damage.z2", "wing.health.z2"),
            ("wing.strain[{1..24}]", "gauges.strain[{1..24}]"),
        ],
    )


OSCILLATOR_ENDS = watch("first.y1", "first.y2", "second.y1", step_size=0.05, inputs=["push"])
PUSHED = {"control": {"push": np.sin(np.arange(24.0))}}
SERIALISED = {"state": "serialised"}
TURNS = np.arange(24)

KINDS: dict[str, Kind] = {
    "wing": wing("python", QUASI_STATIC, **SERIALISED),
    "wing in motion": wing("python", TRANSIENT, **SERIALISED),
    "compiled wing": wing("compiled", QUASI_STATIC, largest=1e-12, **SERIALISED),
    "compiled wing in motion": wing("compiled", TRANSIENT, largest=1e-12, **SERIALISED),
    "wing of FMI 3": wing("fmi3", QUASI_STATIC, largest=1e-12, **SERIALISED),
    "wing of FMI 3 in motion": wing("fmi3", TRANSIENT, largest=1e-12, **SERIALISED),
    "three regions": wing("regions", QUASI_STATIC, **SERIALISED),
    "three regions in motion": wing("regions", TRANSIENT, **SERIALISED),
    "three compiled regions": wing("compiled_regions", QUASI_STATIC, largest=1e-12, **SERIALISED),
    "three compiled regions in motion": wing("compiled_regions", TRANSIENT, largest=1e-12, **SERIALISED),
    "model exchange wing": exchange("exchange", "health.z{}"),
    "model exchange wing of FMI 3": exchange("exchange3", "health[{}]", fmi_version="3.0"),
    "effects of sensors": with_effects("sensing", SENDING, ("coupling", "hum"), "drift"),
    "effects of sensors in motion": with_effects(
        "sensing", SENDING, ("coupling", "hum"), "drift", response=TRANSIENT, release=0.01
    ),
    "hysteresis": with_effects("patched", playing(), HYSTERESIS, "root"),
    "hysteresis in motion": with_effects("patched", playing(), HYSTERESIS, "root", response=TRANSIENT),
    "beam": Kind(
        "beam", BEAM_BINDING, BEAM_COURSE, statics, largest=1e-12, parameters={"e": 1.06, "pump": 0.03},
        **SERIALISED,
    ),
    "beam in motion": Kind(
        "beam", changed(BEAM_BINDING, header={"step_size": 1e-3}), BEAM_COURSE, motion, largest=1e-12,
        parameters={"response": TRANSIENT}, **SERIALISED,
    ),
    "spring": Kind(
        "spring_mass", BINDINGS["spring_mass"],
        {"control": {"push": np.sin(TURNS)}, "health": {"spring": 2.0}, "load": {"lock": TURNS % 7 == 6}},
        spring, rtol=1e-12,
    ),
    "FMI 1": Kind(
        "lag1", BINDINGS["lag1"],
        {"control": {"speed": np.linspace(-2.0, 2.0, 24)}, "load": {"hold": TURNS % 7 == 6}},
        lag, rtol=1e-12, parameters={"gain": 3.0, "time": 0.4},
    ),
    "FMI 2 of a Modelica tool": Kind(
        "room2", BINDINGS["room2"],
        {"control": {"power": np.linspace(0.0, 3.0, 24)},
         "load": {"outside": np.linspace(-5.0, 9.0, 24), "on": TURNS % 5 != 4}},
        room, rtol=1e-12, parameters={"mode": 2.0},
    ),
    "a fixed step": Kind(
        "fixed2", BINDINGS["fixed2"],
        {"control": {"u": np.linspace(3.0, -1.0, 8)}}, fixed, rtol=1e-12, **SERIALISED,
    ),
    "elements of arrays": Kind(
        "array3", BINDINGS["array3"],
        {"control": {"first": np.cos(TURNS)},
         "load": {"offset": TURNS % 5 - 3, "active": TURNS % 4 != 3, "third": np.sin(TURNS)}},
        array, rtol=1e-12, parameters={"gain": 0.5, "corner": 10.0}, **SERIALISED,
    ),
    "whole arrays": Kind(
        "array3", BINDINGS["array3_whole"],
        {"load": {"u": np.random.default_rng(2).normal(size=(12, 3)), "offset": np.arange(12) - 5}},
        array, rtol=1e-12, parameters={"A": np.arange(6.0) ** 2}, arrays=("u",), **SERIALISED,
    ),
    "one array for all steps": Kind(
        "array3", BINDINGS["array3_whole"],
        {"load": {"u": np.array([1.0, -2.0, 3.0]), "offset": np.zeros(4)}}, array, rtol=1e-12,
        arrays=("u",), **SERIALISED,
    ),
    "model exchange of FMI 2 with state events": Kind(
        "ball2", BINDINGS["ball2"],
        {"control": {"gravity": np.full(30, 9.81)}}, ball, rtol=1e-5, atol=2e-3,
        parameters={"restitution": 0.8},
    ),
    "model exchange of FMI 1": Kind(
        "decay1", BINDINGS["decay1"],
        {"control": {"u": np.array([0.0, 0.0, 4.0, 4.0, -2.0, -2.0]) - 273.15}}, decay, atol=1e-7,
        start={"control": {"u": -273.15}}, parameters={"k": 2.0},
    ),
    "model exchange of FMI 3 with a time event": Kind(
        "swing3", BINDINGS["swing3"],
        {"load": {}, "control": {}}, swing, atol=1e-6, parameters={"w": 3.0},
    ),
    "lines of FMI 1": following("follow1"),
    "lines": following("follow2"),
    "lines in quarters": following("follow2", quarters=True),
    "lines in model exchange": following("follow2", **EXCHANGED),
    "lines in model exchange in quarters": following("follow2", quarters=True, **EXCHANGED),
    "an integrator": Kind("hostile2", HOSTILE, {"control": {"u": TURNS / 4.0}}, integral, **SERIALISED),
    "an integrator by replay": Kind(
        "hostile2", changed(HOSTILE, header={"state": "replay"}), {"control": {"u": TURNS / 4.0}}, integral
    ),
    "damage": Kind(
        "damage_growth", BINDINGS["damage_growth"], {"control": {"load_factor": 2.0 + TURNS % 2}}, damage,
        parameters={"p1": 0.4, "p2": 0.3, "seed": 11.0}, **SERIALISED,
    ),
    "a system": Kind("oscillator", OSCILLATOR_ENDS, PUSHED, recursion, rtol=1e-12, atol=1e-13, **SERIALISED),
    "a system by Jacobi": Kind(
        "oscillator jacobi", OSCILLATOR_ENDS, PUSHED, recursion, rtol=1e-12, atol=1e-13, **SERIALISED
    ),
    "a system with a wing": Kind(
        "three", SYSTEM_OF_THREE, {"control": {"load_factor": 2.0 + TURNS % 2}}, parameters={"seed": 5.0},
        **SERIALISED,
    ),
}  # fmt: skip
