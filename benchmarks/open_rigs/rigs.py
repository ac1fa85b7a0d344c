"""Rigs of five kinds by equations written out here, and their models as files of a user."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

FloatArray = NDArray[np.float64]
Force = Callable[[float, float, float], float]

SCALES = {
    "cart": (6.0, 0.5, 1.5),
    "damper": (60.0, 0.02, 0.12),
    "servo": (2.0, 0.5, 2.0),
    "support": (8.0, 0.04, 0.3),
}
"""Force, displacement and speed at which laws have their size."""
TURNS_OVER = 2e-4
"""Share of the largest speed within which friction turns over."""


@dataclass(frozen=True)
class Truth:
    """The truth of a rig: factors of its parameters, a hidden law, and a disturbance."""

    factors: Mapping[str, float] = field(default_factory=dict)
    law: str = ""
    size: float = 0.0
    shape: float = 0.3
    at: int = 0
    left: str = ""
    amount: float = 0.0
    pitch: float = 3.0


BEFORE = 1e-9
"""So long before its stamp a reading is taken [s]."""


@dataclass(frozen=True)
class Course:
    """The excitation of a trial over time with two derivatives, and a random force."""

    value: Callable[[float, int], float]
    push: Callable[[float], float]
    breaks: tuple[float, ...] = ()
    steps: tuple[float, ...] = ()

    @staticmethod
    def stepped(
        steps: tuple[float, ...], breaks: tuple[float, ...], push: Callable[[float], float]
    ) -> Course:
        """Return a course that holds each value until the next moment."""
        moments = np.array(breaks)
        return Course(
            lambda t, order: steps[int(np.searchsorted(moments, t, "right"))], push, breaks, steps
        )


@dataclass(frozen=True)
class Rig:
    """A rig: files as a user writes them, scales, and its equations.

    `drive`: quantity, unit and hold of what drives; `channels`: name, quantity, unit and noise;
    `parameters`: what each scales in the model, and how well it is known. `motion` returns the
    readings (n, C) of a trial.
    """

    model: str
    drive: str
    amplitude: float
    interval: float
    channels: tuple[tuple[str, str, str, float], ...]
    parameters: Mapping[str, tuple[str, float]]
    motion: Callable[[Truth, Course, FloatArray], FloatArray]


def law(
    truth: Truth, force: float, length: float, speed: float
) -> Callable[..., tuple[float, float]]:
    """Return force and slope of the hysteretic motion z of a law, by position, speed and z."""
    size, yields = truth.size * force, truth.shape * length

    def of(x: float, v: float, z: float) -> tuple[float, float]:
        if truth.law == "coulomb_friction":
            return size * np.tanh(v / (TURNS_OVER * speed)), 0.0
        if truth.law == "quadratic_damping":
            return size * v * abs(v) / speed**2, 0.0
        if truth.law == "cubic_stiffness":
            return size * (x / length) ** 3, 0.0
        if truth.law == "free_play":
            return -size * min(max(x / length, -truth.shape), truth.shape), 0.0
        if truth.law == "bouc_wen_hysteresis":
            slope = v * (1.0 - 0.5 * (1.0 + np.sign(v * z)) * abs(z / yields))
            return size * (z - x) / length, slope
        return 0.0, 0.0

    return of


def beside(truth: Truth, course: Course, force: float, length: float) -> Force:
    """Return what no hypothesis knows as a force against the motion, but for a loose body."""
    size = truth.amount * force
    if truth.left == "push":
        return lambda t, x, v: size * course.push(t)
    if truth.left == "law":
        return lambda t, x, v: size * ((x / length) ** 2 + np.sin(truth.pitch * x / length))
    return lambda t, x, v: 0.0


def solved(
    slope: Callable[[float, FloatArray], list[float]],
    begin: list[float],
    course: Course,
    stamps: FloatArray,
) -> FloatArray:
    """Return the states (n, S) at stamps, stretch by stretch between the steps of what drives."""
    states = np.zeros((len(stamps), len(begin)))
    ends = [*(t for t in course.breaks if 0.0 < t < stamps[-1]), float(stamps[-1])]
    now, state = float(stamps[0]), np.array(begin)
    for end in ends:
        inside = (stamps >= now) & (stamps <= end)
        asked = (
            np.append(stamps[inside], end)
            if not inside.any() or stamps[inside][-1] < end
            else stamps[inside]
        )
        found = solve_ivp(
            slope,
            (now, end),
            state,
            "LSODA",
            t_eval=asked,
            rtol=1e-8,
            atol=1e-11,
            max_step=(stamps[-1] - stamps[0]) / 50.0,
        )
        states[inside] = found.y.T[: inside.sum()]
        now = end
        state = found.y[:, -1]
    return states


def body(
    truth: Truth,
    course: Course,
    stamps: FloatArray,
    mass: float,
    scales: tuple[float, float, float],
    own: Callable[[float, float, float], float],
    *,
    shaken: Callable[[float], float] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return motion x, v (n, 2), and the forces of law and remainder against it (n, 2).

    The body, m x'' = own(t, x, v) - law - remainder - m a(t), carries a loose one of `amount` times
    its mass where that is what is left; x and v are relative to a support that is shaken with a(t).
    """
    force, length, speed = scales
    hidden, more = law(truth, force, length, speed), beside(truth, course, force, length)
    loose = truth.amount * mass if truth.left == "loose" else 0.0
    w = 2.0 * np.pi * truth.pitch

    def slope(t: float, y: FloatArray) -> list[float]:
        base = 0.0 if shaken is None else shaken(t)
        against, turns = hidden(y[0], y[1], y[2])
        pulled = w**2 * (y[0] - y[3]) + 0.04 * w * (y[1] - y[4])
        against += more(t, y[0], y[1]) + loose * pulled
        return [y[1], (own(t, y[0], y[1]) - against) / mass - base, turns, y[4], pulled - base]

    states = solved(slope, [0.0] * 5, course, stamps)
    pairs = [
        (hidden(y[0], y[1], y[2])[0], more(t, y[0], y[1]))
        for t, y in zip(stamps, states, strict=True)
    ]
    return states[:, :2], np.array(pairs)


def cart(truth: Truth, course: Course, stamps: FloatArray) -> FloatArray:
    """Return the position of a cart under a recorded force."""
    mass, rubs = 1.5 * truth.factors.get("mass", 1.0), 0.8 * truth.factors.get("bearing", 1.0)
    found, _ = body(
        truth, course, stamps, mass, SCALES["cart"], lambda t, x, v: course.value(t, 0) - rubs * v
    )
    return found[:, :1]


def damper(truth: Truth, course: Course, stamps: FloatArray) -> FloatArray:
    """Return the force that a prescribed motion of a body takes; a loose mass moves freely."""
    factor = truth.factors.get
    m = 2.0 * factor("mass", 1.0)
    c = 400.0 * factor("oil", 1.0)
    k = 3000.0 * factor("spring", 1.0)
    hidden, more = law(truth, *SCALES["damper"]), beside(truth, course, *SCALES["damper"][:2])
    loose = truth.amount * m if truth.left == "loose" else 0.0
    w = 2.0 * np.pi * truth.pitch

    def pulled(t: float, y: FloatArray) -> float:
        x, v = course.value(t, 0), course.value(t, 1)
        return float(w**2 * (x - y[1]) + 0.04 * w * (v - y[2]))

    def slope(t: float, y: FloatArray) -> list[float]:
        return [hidden(course.value(t, 0), course.value(t, 1), y[0])[1], y[2], pulled(t, y)]

    begin = course.value(float(stamps[0]), 0)
    states = solved(slope, [0.0, begin, 0.0], course, stamps)
    readings = []
    for t, y in zip(stamps, states, strict=True):
        x, v, a = (course.value(t, order) for order in range(3))
        readings.append(
            m * a + c * v + k * x + hidden(x, v, y[0])[0] + more(t, x, v) + loose * pulled(t, y)
        )
    return np.array(readings)[:, None]


def servo(truth: Truth, course: Course, stamps: FloatArray) -> FloatArray:
    """Return angle and torque of a servo: proportional to error, derivative of the measurement."""
    factor = truth.factors.get
    inertia, rubs = 0.05 * factor("inertia", 1.0), 0.04 * factor("bearing", 1.0)
    gains = 6.0, 0.5

    def torque(t: float, x: float, v: float) -> float:
        return gains[0] * (course.value(t, 0) - x) - gains[1] * v

    found, _ = body(
        truth, course, stamps, inertia, SCALES["servo"], lambda t, x, v: torque(t, x, v) - rubs * v
    )
    # readings are taken just before a converter sets its next value
    torques = [torque(t - BEFORE, x, v) for t, (x, v) in zip(stamps, found, strict=True)]
    return np.column_stack((found[:, 0], torques))


def support(truth: Truth, course: Course, stamps: FloatArray, *, order: int) -> FloatArray:
    """Return the motion relative to a driven support, and the force in its spring and damper."""
    factor = truth.factors.get
    m = 2.0 * factor("mass", 1.0)
    c = 2.5 * factor("damper", 1.0)
    k = 180.0 * factor("spring", 1.0)

    def shaken(t: float) -> float:
        return course.value(t, order)

    found, forces = body(
        truth, course, stamps, m, SCALES["support"], lambda t, x, v: -c * v - k * x, shaken=shaken
    )
    x, v = found.T
    base = 0.8 * factor("mass", 1.0)
    between = forces[:, 0] + (
        forces[:, 1] if truth.left == "law" else 0.0
    )  # a push comes from outside
    return np.column_stack(
        (x, base * np.array([shaken(t) for t in stamps]) - c * v - k * x - between)
    )


def stores(truth: Truth, course: Course, stamps: FloatArray) -> FloatArray:
    """Return the levels of two tanks, the upper of which runs into the lower one."""
    factor = truth.factors.get
    upper, lower = 0.02 * factor("upper outlet", 1.0), 0.025 * factor("lower outlet", 1.0)
    largest, flow = 1.0, 0.02
    more = beside(truth, course, flow, largest)
    small = truth.amount if truth.left == "loose" else 0.0

    def lost(h: float) -> float:
        if truth.law == "overflow":
            level = max(h - truth.shape, 0.0) / (largest - truth.shape)
            return float(truth.size * flow * level**1.5)
        return (
            truth.size * flow * float(np.sqrt(max(h, 0.0) / largest))
            if truth.law == "outflow"
            else 0.0
        )

    def slope(t: float, y: FloatArray) -> list[float]:
        over = upper * y[0] + (lost(y[0]) if truth.at == 0 else 0.0)
        out = lower * y[1] + (lost(y[1]) if truth.at == 1 else 0.0)
        soaks = 0.1 / truth.pitch * (y[1] - y[2])
        return [course.value(t, 0) - over, over - out - more(t, y[1], 0.0) - small * soaks, soaks]

    return solved(slope, [0.0] * 3, course, stamps)[:, :2]


def heated(truth: Truth, course: Course, stamps: FloatArray) -> FloatArray:
    """Return the temperature of a heated block over that of the room."""
    factor = truth.factors.get
    capacity, loss = 400.0 * factor("capacity", 1.0), 2.0 * factor("loss", 1.0)
    more = beside(truth, course, 80.0, 40.0)
    small = truth.amount if truth.left == "loose" else 0.0

    def slope(t: float, y: FloatArray) -> list[float]:
        hidden = truth.size * 80.0 * (max(y[0], 0.0) / 40.0) ** 1.25 if truth.law else 0.0
        soaks = 0.05 / truth.pitch * (y[0] - y[1])
        out = loss * y[0] + hidden + more(t, y[0], 0.0)
        return [(course.value(t, 0) - out) / capacity - small * soaks, soaks]

    return solved(slope, [0.0] * 2, course, stamps)[:, :1]


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
        (("x", "displacement", "m", 5e-4),),
        {"mass": ("mass", 0.03), "bearing": ("damping", 0.2)},
        cart,
    ),
    "damper": Rig(
        DAMPER,
        "displacement m smooth",
        0.006,
        0.025,
        (("force", "force", "N", 0.1),),
        {"mass": ("mass", 0.03), "oil": ("damping", 0.1), "spring": ("stiffness", 0.03)},
        damper,
    ),
    "servo": Rig(
        SERVO,
        "angle rad smooth",
        0.2,
        0.025,
        (("angle", "angle", "rad", 5e-4), ("torque", "torque", "N m", 5e-3)),
        {"inertia": ("mass", 0.03), "bearing": ("damping", 0.2)},
        servo,
    ),
    "support moved": Rig(
        SUPPORT + DRIVEN_BY["displacement"],
        "displacement m smooth",
        0.008,
        0.025,
        (("x", "displacement", "m", 1e-4), ("force", "force", "N", 0.02)),
        {"mass": ("mass", 0.03), "damper": ("damping", 0.2), "spring": ("stiffness", 0.03)},
        partial(support, order=2),
    ),
    "support shaken": Rig(
        SUPPORT + DRIVEN_BY["acceleration"],
        "acceleration m/s2 smooth",
        0.8,
        0.025,
        (("x", "displacement", "m", 1e-4), ("force", "force", "N", 0.02)),
        {"mass": ("mass", 0.03), "damper": ("damping", 0.2), "spring": ("stiffness", 0.03)},
        partial(support, order=0),
    ),
    "stores": Rig(
        STORES,
        "flow m3/s zero_order",
        0.016,
        5.0,
        (("upper", "level", "m", 5e-4), ("lower", "level", "m", 5e-4)),
        {"upper outlet": ("upper outlet", 0.05), "lower outlet": ("lower outlet", 0.05)},
        stores,
    ),
    "heated": Rig(
        HEATED,
        "heat W zero_order",
        80.0,
        5.0,
        (("block", "temperature", "K", 0.01),),
        {"capacity": ("capacity", 0.05), "loss": ("conductance", 0.1)},
        heated,
    ),
}
