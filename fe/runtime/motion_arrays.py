"""The arrays that the loops of motion work on.

NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Any, NamedTuple

import numpy as np

from .arrays import FloatArray as FloatArray
from .arrays import IntArray as IntArray

Unnamed = tuple[Any, ...]
"""The fields of one of the records below."""

FIRST_PARTS = 400
"""Parts in which the way from a law's last position to the first one of a motion is followed."""


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

    def between(self, first: int, last: int) -> "Steps":
        """Return the steps between two boundaries, each of which is a sample."""
        steps, boundaries = slice(first, last), slice(first, last + 1)
        return self._replace(
            which=self.which[steps], push=self.push[steps], begin=self.begin[steps], end=self.end[steps],
            feed=self.feed[boundaries], time=self.time[boundaries], sample=np.arange(last - first + 1),
        )  # fmt: skip


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
    values : (J, 5 + E) ndarray
        Their parameters, and those of their elements.
    flexibility : (J,) ndarray
        R: position of each law's port by a unit force there that the modes do not hold; laws with the same
        row have the same, or zero, which leaves a law to the modes.
    relaxation : float
        beta of that flexibility [s].
    feed : (J,) ndarray
        What loads add to the ports' positions beyond the modes, at the end of the step that is taken.
    acts : (J, M) ndarray
        Row along which each law acts; that of its port, but for flows from one store into another.
    rate : float
        Stiffness drift r of the whole structure [1/s].
    """

    rows: FloatArray
    numbers: IntArray
    of_speed: IntArray
    values: FloatArray
    flexibility: FloatArray
    relaxation: float
    feed: FloatArray
    acts: FloatArray
    rate: float


class State(NamedTuple):
    """What moves: `q`, `v` (M,), the `memory` (J, 5 + E) of the laws, and their forces `current` (J,)."""

    q: FloatArray
    v: FloatArray
    memory: FloatArray
    current: FloatArray


class Acting(NamedTuple):
    """How the laws act on the modes, and what is kept of the begin of a step.

    Attributes
    ----------
    route : (J,) ndarray of int
        `STILL`, `SPEED`, `POSITION` or `FLEXIBLE` of `motion_kernel`.
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
    q, v : (M,) ndarray
        State at the begin.
    room : (2M,) ndarray
        For a new state.
    forces : (J,) ndarray
        Forces of the laws at the begin.
    speed, lost : (J,) ndarray
        Speed of the port of a law of speed at the begin, and what its first half kick took of it.
    freed : (J,) ndarray
        1 where friction let go in this step.
    """

    route: IntArray
    leader: IntArray
    springs: IntArray
    weight: FloatArray
    strength: FloatArray
    give: FloatArray
    pull: FloatArray
    answer: FloatArray
    q: FloatArray
    v: FloatArray
    room: FloatArray
    forces: FloatArray
    speed: FloatArray
    lost: FloatArray
    freed: FloatArray


class Samples(NamedTuple):
    """Results at the samples: `q`, `v` (N, M), `forces`, `lagged` (N, J), as in `stepwise.ModalMotion`."""

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
