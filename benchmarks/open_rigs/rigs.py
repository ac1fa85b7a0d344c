"""Rigs of five kinds by equations written out here, and their models as files of a user."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

FloatArray = NDArray[np.float64]
Force = Callable[[float, float, float], float]

TURNS_OVER = 2e-4
"""Speed over the largest speed within which friction changes its sign."""


@dataclass(frozen=True)
class Truth:
    """The truth of a rig: its parameters, a hidden law, and a disturbance that no hypothesis knows.

    Attributes
    ----------
    factors : mapping of str to float
        True value of each parameter over its nominal value.
    law : str
        Effect whose law is hidden, or nothing.
    size, shape : float
        Size of the law at the scales of the rig, and its threshold over the length scale.
    store : int
        Which of two stores the law is at.
    disturbance : str
        "push" (a random force), "loose" (a mass on a spring of its own), "law" (a law outside the
        catalogue), or nothing.
    amount : float
        Size of the disturbance: of the force at the scales of the rig, or mass over carrying mass.
    pitch : float
        Natural frequency of the loose mass [Hz], or wave number of the law over the length scale.
    """

    factors: Mapping[str, float] = field(default_factory=dict)
    law: str = ""
    size: float = 0.0
    shape: float = 0.3
    store: int = 0
    disturbance: str = ""
    amount: float = 0.0
    pitch: float = 3.0

    def parameter(self, name: str, nominal: float) -> float:
        """Return the true value of a parameter with a nominal value."""
        return nominal * self.factors.get(name, 1.0)

    @property
    def loose_ratio(self) -> float:
        """The loose mass or store over the one that carries it; 0 without one."""
        return self.amount if self.disturbance == "loose" else 0.0


CONVERSION_LEAD = 1e-9
"""Time before its stamp at which a reading is taken [s]."""


@dataclass(frozen=True)
class Course:
    """The excitation of a trial.

    Attributes
    ----------
    value : callable
        (time, order) -> derivative of an order, 0 to 2, of the excitation.
    push : callable
        time -> random force of unit size.
    breaks : tuple of float
        Times at which a stepped excitation changes [s].
    steps : tuple of float
        Values of a stepped excitation, one more than `breaks`.
    """

    value: Callable[[float, int], float]
    push: Callable[[float], float]
    breaks: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()

    @staticmethod
    def stepped(
        steps: tuple[float, ...], breaks: tuple[float, ...], push: Callable[[float], float]
    ) -> Course:
        """Return an excitation that holds each value until the next break."""
        times = np.array(breaks)

        def value(t: float, _order: int) -> float:
            return steps[int(np.searchsorted(times, t, "right"))]

        return Course(value, push, breaks, steps)


class Scales(NamedTuple):
    """Force, displacement and speed at which a law has its size."""

    force: float
    length: float
    speed: float


class RigChannel(NamedTuple):
    """A channel as in a campaign file, with the standard deviation of its noise [unit]."""

    name: str
    quantity: str
    unit: str
    noise: float


class RigParameter(NamedTuple):
    """The terms that a parameter scales in the model, and its prior standard deviation."""

    terms: str
    deviation: float


@dataclass(frozen=True)
class Rig:
    """A rig: its model file, excitation, channels, parameters and equations.

    Attributes
    ----------
    model : str
        Tables of the model file.
    drive : str
        Quantity, unit and hold of the excitation.
    amplitude : float
        Size of the excitation [unit].
    interval : float
        Sampling interval [s].
    channels : tuple of RigChannel
        Measured channels.
    parameters : mapping of str to RigParameter
        Parameters by name.
    motion : callable
        (truth, course, times) -> readings (n, C) of a trial without errors.
    """

    model: str
    drive: str
    amplitude: float
    interval: float
    channels: tuple[RigChannel, ...]
    parameters: Mapping[str, RigParameter]
    motion: Callable[[Truth, Course, FloatArray], FloatArray]


SCALES = {
    "cart": Scales(6.0, 0.5, 1.5),
    "damper": Scales(60.0, 0.02, 0.12),
    "servo": Scales(2.0, 0.5, 2.0),
    "support": Scales(8.0, 0.04, 0.3),
}
"""Scales of the rigs with motion."""


def law_force(truth: Truth, scales: Scales, x: float, v: float, z: float) -> float:
    """Return the force of the hidden law against a motion x with velocity v.

    z is the hysteretic displacement of the Bouc-Wen law.
    """
    size = truth.size * scales.force
    if truth.law == "coulomb_friction":
        return float(size * np.tanh(v / (TURNS_OVER * scales.speed)))
    if truth.law == "quadratic_damping":
        return size * v * abs(v) / scales.speed**2
    if truth.law == "cubic_stiffness":
        return size * (x / scales.length) ** 3
    if truth.law == "free_play":
        return -size * min(max(x / scales.length, -truth.shape), truth.shape)
    if truth.law == "bouc_wen_hysteresis":
        return size * (z - x) / scales.length
    return 0.0


def hysteresis_rate(truth: Truth, scales: Scales, v: float, z: float) -> float:
    """Return dz/dt of the Bouc-Wen law; 0 for other laws."""
    if truth.law != "bouc_wen_hysteresis":
        return 0.0
    yield_displacement = truth.shape * scales.length
    return float(v * (1.0 - 0.5 * (1.0 + np.sign(v * z)) * abs(z / yield_displacement)))


def disturbance_force(truth: Truth, course: Course, force: float, length: float) -> Force:
    """Return the force (t, x, v) of a push or of an unknown law against the motion.

    `force` and `length` are the scales of the rig.
    """
    size = truth.amount * force
    if truth.disturbance == "push":
        return lambda t, x, v: size * course.push(t)
    if truth.disturbance == "law":
        return lambda t, x, v: size * ((x / length) ** 2 + np.sin(truth.pitch * x / length))
    return lambda t, x, v: 0.0


def solved(
    slope: Callable[[float, FloatArray], list[float]],
    begin: list[float],
    breaks: tuple[float, ...],
    stamps: FloatArray,
) -> FloatArray:
    """Integrate y' = slope(t, y) and return the states (n, S) at times (n,).

    The integration restarts at each break, where the slope jumps.

    Parameters
    ----------
    slope : callable
        (time, state) -> rates (S,).
    begin : list of float
        State (S,) at the first time.
    breaks : tuple of float
        Times at which the slope jumps [s].
    stamps : (n,) array
        Times [s].
    """
    states = np.zeros((len(stamps), len(begin)))
    ends = [*(t for t in breaks if 0.0 < t < stamps[-1]), float(stamps[-1])]
    now = float(stamps[0])
    state = np.array(begin)
    for end in ends:
        inside = (stamps >= now) & (stamps <= end)
        times = stamps[inside]
        if not len(times) or times[-1] < end:
            times = np.append(times, end)
        solution = solve_ivp(
            slope,
            (now, end),
            state,
            "LSODA",
            t_eval=times,
            rtol=1e-8,
            atol=1e-11,
            max_step=(stamps[-1] - stamps[0]) / 50.0,
        )
        states[inside] = solution.y.T[: inside.sum()]
        now = end
        state = solution.y[:, -1]
    return states


class BodyMotion(NamedTuple):
    """Motion of a body at n times, and the unknown forces against it.

    Attributes
    ----------
    x, v : (n,) array
        Displacement and velocity, relative to the support.
    law, disturbance : (n,) array
        Forces of the hidden law and of the disturbance.
    """

    x: FloatArray
    v: FloatArray
    law: FloatArray
    disturbance: FloatArray


def body(
    truth: Truth,
    course: Course,
    stamps: FloatArray,
    mass: float,
    scales: Scales,
    known_force: Callable[[float, float, float], float],
    *,
    shaken: Callable[[float], float] | None = None,
) -> BodyMotion:
    """Return the motion of a body under known forces, a hidden law and a disturbance.

    The body follows m x'' = known_force(t, x, v) - law - disturbance - m a(t), and may carry a
    loose mass on a spring and damper of its own. x and v are relative to the support.

    Parameters
    ----------
    truth : Truth
        Hidden law and disturbance.
    course : Course
        The excitation.
    stamps : (n,) array
        Times [s].
    mass : float
        Mass of the body.
    scales : Scales
        Scales of the rig.
    known_force : callable
        (t, x, v) -> force along the motion.
    shaken : callable, optional
        time -> acceleration a of the support; at rest without it.
    """
    disturbance = disturbance_force(truth, course, scales.force, scales.length)
    loose_mass = truth.loose_ratio * mass
    w = 2.0 * np.pi * truth.pitch

    def slope(t: float, state: FloatArray) -> list[float]:
        x, v, z, loose_x, loose_v = state
        support = 0.0 if shaken is None else shaken(t)
        loose_pull = w**2 * (x - loose_x) + 0.04 * w * (v - loose_v)
        against = law_force(truth, scales, x, v, z)
        against += disturbance(t, x, v) + loose_mass * loose_pull
        return [
            v,
            (known_force(t, x, v) - against) / mass - support,
            hysteresis_rate(truth, scales, v, z),
            loose_v,
            loose_pull - support,
        ]

    states = solved(slope, [0.0] * 5, course.breaks, stamps)
    law_forces = []
    disturbance_forces = []
    for t, state in zip(stamps, states, strict=True):
        x, v, z, _loose_x, _loose_v = state
        if truth.law == "coulomb_friction" and v == 0.0:
            # dry friction holds a body at rest with what pulls at it, up to its own size; the
            # smoothed law would have no force there
            size = truth.size * scales.force
            pull = mass * slope(t, state)[1]
            law_forces.append(float(np.clip(pull, -size, size)))
        else:
            law_forces.append(law_force(truth, scales, x, v, z))
        disturbance_forces.append(disturbance(t, x, v))
    x, v = states.T[:2]
    return BodyMotion(x, v, np.array(law_forces), np.array(disturbance_forces))


def cart(truth: Truth, course: Course, stamps: FloatArray) -> FloatArray:
    """Return the position (n, 1) of a cart under a recorded force."""
    mass = truth.parameter("mass", 1.5)
    bearing = truth.parameter("bearing", 0.8)

    def known_force(t: float, _x: float, v: float) -> float:
        return course.value(t, 0) - bearing * v

    return body(truth, course, stamps, mass, SCALES["cart"], known_force).x[:, None]


def damper(truth: Truth, course: Course, stamps: FloatArray) -> FloatArray:
    """Return the force (n, 1) of a prescribed motion of a body; a loose mass moves freely."""
    scales = SCALES["damper"]
    m = truth.parameter("mass", 2.0)
    c = truth.parameter("oil", 400.0)
    k = truth.parameter("spring", 3000.0)
    disturbance = disturbance_force(truth, course, scales.force, scales.length)
    loose_mass = truth.loose_ratio * m
    w = 2.0 * np.pi * truth.pitch

    def loose_pull(t: float, state: FloatArray) -> float:
        _z, loose_x, loose_v = state
        x = course.value(t, 0)
        v = course.value(t, 1)
        return float(w**2 * (x - loose_x) + 0.04 * w * (v - loose_v))

    def slope(t: float, state: FloatArray) -> list[float]:
        z, _loose_x, loose_v = state
        z_rate = hysteresis_rate(truth, scales, course.value(t, 1), z)
        return [z_rate, loose_v, loose_pull(t, state)]

    begin = course.value(float(stamps[0]), 0)
    states = solved(slope, [0.0, begin, 0.0], course.breaks, stamps)
    forces = []
    for t, state in zip(stamps, states, strict=True):
        x, v, a = (course.value(t, order) for order in range(3))
        forces.append(
            m * a
            + c * v
            + k * x
            + law_force(truth, scales, x, v, state[0])
            + disturbance(t, x, v)
            + loose_mass * loose_pull(t, state)
        )
    return np.array(forces)[:, None]


def servo(truth: Truth, course: Course, stamps: FloatArray) -> FloatArray:
    """Return angle and torque (n, 2) of a servo.

    Its controller acts on the error in proportion, and on the derivative of the measurement.
    """
    inertia = truth.parameter("inertia", 0.05)
    bearing = truth.parameter("bearing", 0.04)
    proportional = 6.0
    derivative = 0.5

    def torque(t: float, x: float, v: float) -> float:
        return proportional * (course.value(t, 0) - x) - derivative * v

    def known_torque(t: float, x: float, v: float) -> float:
        return torque(t, x, v) - bearing * v

    motion = body(truth, course, stamps, inertia, SCALES["servo"], known_torque)
    # Readings are taken just before a converter sets its next value
    torques = [
        torque(t - CONVERSION_LEAD, x, v)
        for t, x, v in zip(stamps, motion.x, motion.v, strict=True)
    ]
    return np.column_stack((motion.x, torques))


def support(truth: Truth, course: Course, stamps: FloatArray, *, order: int) -> FloatArray:
    """Return relative motion and support force (n, 2) of a body on a driven support.

    `order` is the derivative of the excitation that is the acceleration of the support.
    """
    m = truth.parameter("mass", 2.0)
    c = truth.parameter("damper", 2.5)
    k = truth.parameter("spring", 180.0)

    def shaken(t: float) -> float:
        return course.value(t, order)

    def known_force(_t: float, x: float, v: float) -> float:
        return -c * v - k * x

    motion = body(truth, course, stamps, m, SCALES["support"], known_force, shaken=shaken)
    support_mass = truth.parameter("mass", 0.8)
    acceleration = np.array([shaken(t) for t in stamps])
    # A push comes from outside: it is not a force between support and body
    internal = motion.law + (motion.disturbance if truth.disturbance == "law" else 0.0)
    force = support_mass * acceleration - c * motion.v - k * motion.x - internal
    return np.column_stack((motion.x, force))


def stores(truth: Truth, course: Course, stamps: FloatArray) -> FloatArray:
    """Return the levels (n, 2) of two tanks, the upper of which runs into the lower one."""
    upper_outlet = truth.parameter("upper outlet", 0.02)
    lower_outlet = truth.parameter("lower outlet", 0.025)
    largest_level = 1.0
    largest_flow = 0.02
    disturbance = disturbance_force(truth, course, largest_flow, largest_level)

    def hidden_flow(level: float) -> float:
        size = truth.size * largest_flow
        if truth.law == "overflow":
            head = max(level - truth.shape, 0.0) / (largest_level - truth.shape)
            return float(size * head**1.5)
        if truth.law == "outflow":
            return size * float(np.sqrt(max(level, 0.0) / largest_level))
        return 0.0

    def slope(t: float, state: FloatArray) -> list[float]:
        upper, lower, loose = state
        upper_flow = upper_outlet * upper + (hidden_flow(upper) if truth.store == 0 else 0.0)
        lower_flow = lower_outlet * lower + (hidden_flow(lower) if truth.store == 1 else 0.0)
        loose_flow = 0.1 / truth.pitch * (lower - loose)
        lower_rate = (
            upper_flow - lower_flow - disturbance(t, lower, 0.0) - truth.loose_ratio * loose_flow
        )
        return [course.value(t, 0) - upper_flow, lower_rate, loose_flow]

    return solved(slope, [0.0] * 3, course.breaks, stamps)[:, :2]


def heated(truth: Truth, course: Course, stamps: FloatArray) -> FloatArray:
    """Return the temperature (n, 1) of a heated block over that of the room."""
    capacity = truth.parameter("capacity", 400.0)
    loss = truth.parameter("loss", 2.0)
    disturbance = disturbance_force(truth, course, 80.0, 40.0)

    def slope(t: float, state: FloatArray) -> list[float]:
        block, loose = state
        hidden = truth.size * 80.0 * (max(block, 0.0) / 40.0) ** 1.25 if truth.law else 0.0
        loose_flow = 0.05 / truth.pitch * (block - loose)
        out = loss * block + hidden + disturbance(t, block, 0.0)
        rate = (course.value(t, 0) - out) / capacity - truth.loose_ratio * loose_flow
        return [rate, loose_flow]

    return solved(slope, [0.0] * 2, course.breaks, stamps)[:, :1]


def entry(heading: str, **keys: object) -> str:
    """Return a table of a TOML file."""
    return "\n".join(
        ["", f"[[{heading}]]", *(f"{key} = {json.dumps(value)}" for key, value in keys.items()), ""]
    )


def port(name: str, vector: object = 1.0, **more: object) -> str:
    """Return a place where something may act that is not known."""
    return entry("port", name=name, vector=vector, **more)


CART = "mass = 1.5\nfree = true\ndamping = { matrix = 0.8 }\n" + (
    entry("input", name="drive", vector=1.0, quantity="force")
    + entry("output", name="x", vector=1.0)
    + port("rail")
)
DAMPER = "mass = 2.0\nstiffness = 3000.0\ndamping = { matrix = 400.0 }\n" + (
    entry("input", name="drive", vector=1.0, quantity="displacement")
    + entry("output", name="force", reaction="drive", quantity="force")
    + port("piston")
)
SERVO = "mass = 0.05\nfree = true\ndamping = { matrix = 0.04 }\n" + (
    entry(
        "controller",
        name="loop",
        quantity="angle",
        vector=1.0,
        acts=1.0,
        reference="drive",
        proportional=6.0,
        derivative=0.5,
        derivative_of="measurement",
    )
    + entry("output", name="angle", vector=1.0, quantity="angle")
    + entry("output", name="torque", controller="loop", quantity="torque")
    + port("bearing")
)
SUPPORT = "mass = [0.8, 2.0]\nstiffness = [[180.0, -180.0], [-180.0, 180.0]]\nfree = true\n" + (
    "damping = { matrix = [[2.5, -2.5], [-2.5, 2.5]] }\n"
    + entry("output", name="x", vector=[-1.0, 1.0])
    + entry("output", name="force", reaction="drive", quantity="force")
    + port("mount", [-1.0, 1.0])
)
DRIVEN_BY = {
    quantity: entry("input", name="drive", vector=[1.0, 0.0], quantity=quantity)
    for quantity in ("displacement", "acceleration")
}
STORES = "capacity = [1.0, 1.0]\n" + (
    entry("conductance_part", name="upper outlet", matrix=[[0.02, 0.0], [-0.02, 0.0]])
    + entry("conductance_part", name="lower outlet", matrix=[[0.0, 0.0], [0.0, 0.025]])
    + entry("input", name="drive", vector=[1.0, 0.0], quantity="flow")
    + entry("output", name="upper", vector=[1.0, 0.0], quantity="level")
    + entry("output", name="lower", vector=[0.0, 1.0], quantity="level")
    + port("upper outlet", [1.0, 0.0], acts=[1.0, -1.0])
    + port("lower outlet", [0.0, 1.0])
)
HEATED = "capacity = 400.0\nconductance = 2.0\n" + (
    entry("input", name="drive", vector=1.0, quantity="heat")
    + entry("output", name="block", vector=1.0, quantity="temperature")
    + port("surface")
)
RIGS = {
    "cart": Rig(
        CART,
        "force N smooth",
        2.0,
        0.025,
        (RigChannel("x", "displacement", "m", 5e-4),),
        {"mass": RigParameter("mass", 0.03), "bearing": RigParameter("damping", 0.2)},
        cart,
    ),
    "damper": Rig(
        DAMPER,
        "displacement m smooth",
        0.006,
        0.025,
        (RigChannel("force", "force", "N", 0.1),),
        {
            "mass": RigParameter("mass", 0.03),
            "oil": RigParameter("damping", 0.1),
            "spring": RigParameter("stiffness", 0.03),
        },
        damper,
    ),
    "servo": Rig(
        SERVO,
        "angle rad smooth",
        0.2,
        0.025,
        (RigChannel("angle", "angle", "rad", 5e-4), RigChannel("torque", "torque", "N m", 5e-3)),
        {"inertia": RigParameter("mass", 0.03), "bearing": RigParameter("damping", 0.2)},
        servo,
    ),
    "support moved": Rig(
        SUPPORT + DRIVEN_BY["displacement"],
        "displacement m smooth",
        0.008,
        0.025,
        (RigChannel("x", "displacement", "m", 1e-4), RigChannel("force", "force", "N", 0.02)),
        {
            "mass": RigParameter("mass", 0.03),
            "damper": RigParameter("damping", 0.2),
            "spring": RigParameter("stiffness", 0.03),
        },
        partial(support, order=2),
    ),
    "support shaken": Rig(
        SUPPORT + DRIVEN_BY["acceleration"],
        "acceleration m/s2 smooth",
        0.8,
        0.025,
        (RigChannel("x", "displacement", "m", 1e-4), RigChannel("force", "force", "N", 0.02)),
        {
            "mass": RigParameter("mass", 0.03),
            "damper": RigParameter("damping", 0.2),
            "spring": RigParameter("stiffness", 0.03),
        },
        partial(support, order=0),
    ),
    "stores": Rig(
        STORES,
        "flow m3/s zero_order",
        0.016,
        5.0,
        (RigChannel("upper", "level", "m", 5e-4), RigChannel("lower", "level", "m", 5e-4)),
        {
            "upper outlet": RigParameter("upper outlet", 0.05),
            "lower outlet": RigParameter("lower outlet", 0.05),
        },
        stores,
    ),
    "heated": Rig(
        HEATED,
        "heat W zero_order",
        80.0,
        5.0,
        (RigChannel("block", "temperature", "K", 0.01),),
        {"capacity": RigParameter("capacity", 0.05), "loss": RigParameter("conductance", 0.1)},
        heated,
    ),
}
