"""The arrays that the loops of motion work on.

NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Any, NamedTuple

from .arrays import FloatArray as FloatArray
from .arrays import IntArray as IntArray

Unnamed = tuple[Any, ...]
"""The fields of one of the records below."""

FIRST_PARTS = 400
"""Parts in which the way from a law's last position to the first one of a motion is followed."""

STILL, SPEED, POSITION, FLEXIBLE = 0, 1, 2, 3
"""How a law acts: not, its port being still; on the modes, by speed or position; on what they leave out."""


class Linear(NamedTuple):
    """The linear structure and its exact step (`fe.runtime.modal_system`).

    Attributes
    ----------
    transition, begin, end, constant : (2M, 2M), (2M,), (2M,), (2M,) ndarray
        Step of (q, v): from the state, from the force at its begin and at its end [1/N], from the constant.
    coupled : bool
        Whether `transition` couples modes.
    stiffness : (M,) ndarray
        Squared angular frequencies [1/s^2].
    damping : (M, M) ndarray
        D [1/s].
    shape, load : (M,) ndarray
        b and c.
    rate : float
        Stiffness drift r [1/s].
    """

    transition: FloatArray
    begin: FloatArray
    end: FloatArray
    constant: FloatArray
    coupled: bool
    stiffness: FloatArray
    damping: FloatArray
    shape: FloatArray
    load: FloatArray
    rate: float


class Ports(NamedTuple):
    """Laws and the ports that they act on.

    Attributes
    ----------
    rows : (J, M) ndarray
        Row of the port of each law: what it sees.
    numbers : (J,) ndarray of int
        Laws.
    of_speed : (J,) ndarray of int
        1 for a law of speed.
    values, elements : (J, 5), (J, E) ndarray
        Their parameters, and those of their elements.
    flexibility : (J,) ndarray
        R: position of each law's port by a unit force there that the modes do not hold; laws with the same
        row have the same, or zero, which leaves a law to the modes.
    relaxation : float
        beta of that flexibility [s].
    feed : (2, J) ndarray
        What the modes do not hold of the ports' positions by the force f = 1, and by the constant force.
    acts : (J, M) ndarray
        Row along which each law acts; that of its port, but for flows from one store into another.
    """

    rows: FloatArray
    numbers: IntArray
    of_speed: IntArray
    values: FloatArray
    elements: FloatArray
    flexibility: FloatArray
    relaxation: float
    feed: FloatArray
    acts: FloatArray


class State(NamedTuple):
    """What moves: `q`, `v` (M,), the `memory` (J, 5 + E) of the laws, and their forces `current` (J,)."""

    q: FloatArray
    v: FloatArray
    memory: FloatArray
    current: FloatArray


class Acting(NamedTuple):
    """How the laws act on the modes.

    Attributes
    ----------
    route : (J,) ndarray of int
        `STILL`, `SPEED`, `POSITION` or `FLEXIBLE`.
    leader : (J,) ndarray of int
        The first law at the same flexible port; -1 elsewhere.
    springs : (J,) ndarray of int
        Room for the leaders of the laws of position alone.
    weight : (J,) ndarray
        p . b, what the law's port sees of its own push.
    strength : (J,) ndarray
        Of a law of speed, for the port's speed.
    give : (J,) ndarray
        Position at the port after a step with a unit kick at its begin.
    pull : (J, M) ndarray
        Change of the modes for one unit of change at the port.
    answer : (J, 2M) ndarray
        State after a step to a unit kick at its begin.
    """

    route: IntArray
    leader: IntArray
    springs: IntArray
    weight: FloatArray
    strength: FloatArray
    give: FloatArray
    pull: FloatArray
    answer: FloatArray


class Before(NamedTuple):
    """What is kept of the begin of a step.

    Attributes
    ----------
    q, v : (M,) ndarray
        State.
    room : (2M,) ndarray
        For a new state.
    forces : (J,) ndarray
        Forces of the laws.
    speed, lost : (J,) ndarray
        Speed of the port of a law of speed, and what its first half kick took of it.
    freed : (J,) ndarray
        1 where friction let go in this step.
    """

    q: FloatArray
    v: FloatArray
    room: FloatArray
    forces: FloatArray
    speed: FloatArray
    lost: FloatArray
    freed: FloatArray


class Course(NamedTuple):
    """What is integrated over.

    Attributes
    ----------
    load : (N,) ndarray
        Force f at the samples [N].
    start, h : float
        Time of the first sample and length of a substep [s].
    substeps : int
        For each sample.
    known : bool
        Whether the memory is that of a state; otherwise each law is loaded from zero to its first position.
    """

    load: FloatArray
    start: float
    h: float
    substeps: int
    known: bool


class Samples(NamedTuple):
    """Results at the samples: `q`, `v` (N, M), `forces`, `lagged` (N, J), as in `motion.ModalMotion`."""

    q: FloatArray
    v: FloatArray
    forces: FloatArray
    lagged: FloatArray


def at_port(rows: FloatArray, j: int, q: FloatArray) -> float:
    """Return the motion of the port of law `j`."""
    x = 0.0
    for m in range(len(q)):
        x += rows[j, m] * q[m]
    return x


def add(target: FloatArray, along: FloatArray, size: float, duration: float) -> None:
    """Add to modal coordinates or speeds what a force or an impulse along a port gives them."""
    for m in range(len(target)):
        target[m] += along[m] * size * duration
