"""The arrays that the loops of motion work on.

NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Any, NamedTuple

from .arrays import FloatArray as FloatArray
from .arrays import IntArray as IntArray

Unnamed = tuple[Any, ...]
"""The fields of one of the records below."""

SPEED, STILL = -1, -2
"""In the place of a leader: of a law of speed that acts on the modes, and of one whose port does not move."""


class Steps(NamedTuple):
    """K steps, M modes, J laws; boundary k is the begin of step k.

    Attributes
    ----------
    transition : (S, 2M, 2M) ndarray
        Of (q, v), one for each distinct length.
    length : (S,) ndarray
        [s].
    which : (K,) ndarray of int
        Length of each step.
    push : (K, 2M) ndarray
        What the applied forces add to (q, v) in each step.
    begin, end : (K, M) ndarray
        Modal forces at the begin and at the end of each step.
    feed : (K + 1, J) ndarray
        What loads add to the positions of the laws' ports beyond the modes.
    time : (K + 1,) ndarray
        Of the boundaries [s].
    sample : (N,) ndarray of int
        Boundary of each sample, the first at 0.
    stiffness : (M,) ndarray
        Squared angular frequencies [1/s^2].
    damping : (M, M) ndarray
        D [1/s].
    """

    transition: FloatArray
    length: FloatArray
    which: IntArray
    push: FloatArray
    begin: FloatArray
    end: FloatArray
    feed: FloatArray
    time: FloatArray
    sample: IntArray
    stiffness: FloatArray
    damping: FloatArray


class Ports(NamedTuple):
    """Laws and the ports that they act on.

    Attributes
    ----------
    rows : (J, M) ndarray
        Row of the port of each law: what it sees.
    acts : (J, M) ndarray
        Row along which each law acts; that of its port, but for flows from one store into another.
    weight : (J,) ndarray
        rows . acts, what the law's port sees of its own push.
    leader : (J,) ndarray of int
        The first law that acts at the same position of a port, which the port's flexibility yields to; or
        `SPEED`, or `STILL`.
    answer : (S, J, 2M) ndarray
        State to a unit impulse after a step of each length.
    numbers : (J,) ndarray of int
        Laws.
    of_speed : (J,) ndarray of int
        1 for a law of speed.
    values : (J, 5 + E) ndarray
        Their parameters, and those of their elements.
    flexibility : (J,) ndarray
        R: position of each law's port by a unit force there that the modes do not hold.
    relaxation : float
        beta of that flexibility [s].
    rate : float
        Stiffness drift r of the whole structure [1/s].
    """

    rows: FloatArray
    acts: FloatArray
    weight: FloatArray
    leader: IntArray
    answer: FloatArray
    numbers: IntArray
    of_speed: IntArray
    values: FloatArray
    flexibility: FloatArray
    relaxation: float
    rate: float


class State(NamedTuple):
    """What moves: `q`, `v` (M,) and the `memory` (J, 5 + E) of the laws."""

    q: FloatArray
    v: FloatArray
    memory: FloatArray


class Kept(NamedTuple):
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


class ModalMotion(NamedTuple):
    """Motion at samples: `q`, `v` (N, M), `port_forces` (N, J) of the laws, their `memory` at the end.

    `lagged` (N, J) are the forces as what the modes leave out follows them.
    """

    q: FloatArray
    v: FloatArray
    port_forces: FloatArray
    lagged: FloatArray
    memory: FloatArray


def at_port(rows: FloatArray, j: int, q: FloatArray) -> float:
    """Return the motion of the port of law `j`."""
    x = 0.0
    for m in range(len(q)):
        x += rows[j, m] * q[m]
    return x


def add(target: FloatArray, along: FloatArray, size: float) -> None:
    """Add to modal coordinates or speeds what an impulse along a port gives them."""
    for m in range(len(target)):
        target[m] += along[m] * size
