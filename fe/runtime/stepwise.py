"""Motion of a linear system with laws at its ports, at any time stamps: exact between them without laws.

Steps are those of `ModalSystem.exact_steps`; lengths that differ by less than `ALIKE` of the
usual one are one. NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from .arrays import PLACE, FloatArray, IntArray
from .modal_system import ModalSystem
from .motion import PLAIN, Kernel, Laws, port_flexibility
from .motion_arrays import ModalMotion, State, Steps

SLOWEST_PHASE, FASTEST_PHASE = 0.05, 0.4
"""Longest substep with laws: radians of the slowest and of the fastest mode that it may span."""
ALIKE = 1e-9
"""Lengths of steps that differ by less than this share of the usual one are taken as one."""
STEPS_AT_LEAST = 8
"""Substeps of an interval with laws where nothing in the structure has a pace of its own."""


@dataclass(frozen=True)
class Boundaries:
    """Stamps, and steps between them.

    Attributes
    ----------
    time : (K + 1,) ndarray
        Of the boundaries of the steps [s].
    sample : (N,) ndarray of int
        Boundary of each stamp.
    lengths : (K,) ndarray
        [s].
    """

    time: FloatArray
    sample: IntArray
    lengths: FloatArray

    @cached_property
    def alike(self) -> tuple[FloatArray, IntArray]:
        """Distinct lengths (S,) [s], and which (K,) each step has."""
        usual = float(np.median(self.lengths))
        if np.ptp(self.lengths) <= ALIKE * usual:
            return self.lengths[:1], np.zeros(len(self.lengths), dtype=np.int64)
        rounded = np.round(self.lengths / (ALIKE * usual))
        _, first, which = np.unique(rounded, return_index=True, return_inverse=True)
        return np.ascontiguousarray(self.lengths[first]), np.asarray(which, dtype=np.int64).ravel()


def substeps(
    system: ModalSystem,
    laws: Laws,
    time: FloatArray,
    refinement: int = 1,
    least: int = 1,
    edges: Sequence[float] = (),
) -> Boundaries:
    """Return the steps between stamps (N,) that the laws ask for, at least `least` in each interval.

    At `edges` something begins or ends, so that a step does.
    """
    inside = [moment for moment in edges if time[0] < moment < time[-1]]
    if inside:
        moments = np.union1d(time, inside)
        found = substeps(system, laws, moments, refinement, least)
        return replace(found, sample=found.sample[np.searchsorted(moments, time)])
    parts = np.ones(len(time) - 1)
    if not laws.linear:
        paces = system.paces
        parts *= STEPS_AT_LEAST
        if len(paces):
            rate = max(float(paces.min()) / SLOWEST_PHASE, float(paces.max()) / FASTEST_PHASE)
            parts = np.maximum(np.ceil(rate * np.diff(time) - 1e-9), 1.0)
    return _divided(time.tobytes(), (np.maximum(parts, least) * refinement).tobytes())


@lru_cache(maxsize=16)
def _divided(stamps: bytes, counts: bytes) -> Boundaries:
    """Return the steps by which each interval between stamps (N,) is divided into parts (N - 1,)."""
    time, parts = np.frombuffer(stamps), np.frombuffer(counts).astype(np.int64)
    sample = np.concatenate(([0], np.cumsum(parts))).astype(np.int64)
    lengths = np.repeat(np.diff(time) / parts, parts)
    interval = np.repeat(np.arange(len(parts)), parts)
    place = np.arange(1, len(interval) + 1) - sample[:-1][interval]
    moments = np.concatenate((time[:1], time[interval] + place * lengths))
    moments[sample] = time
    return Boundaries(moments, sample, lengths)


def steps_under(
    system: ModalSystem, boundaries: Boundaries, begin: FloatArray, end: FloatArray, feed: FloatArray
) -> Steps:
    """Return steps under modal forces (K, M) at both ends of each; `feed` is that of `Steps`."""
    lengths, which = boundaries.alike
    transition, *by = system.exact_steps(lengths)
    push = np.zeros((len(which), transition.shape[1]))
    for forces, part in zip((begin, end), by, strict=True):
        if forces.any():
            push += forces @ part[0].T if len(lengths) == 1 else np.einsum("knm,km->kn", part[which], forces)
    moments, sample = boundaries.time, boundaries.sample
    damping = np.ascontiguousarray(system.damping)
    return Steps(
        transition, lengths, which, push, begin, end, feed, moments, sample, system.stiffness, damping
    )


class Begin(NamedTuple):
    """Modal displacements and speeds (M + P,), and the laws' memory; None: loaded from zero at once."""

    q: FloatArray
    v: FloatArray
    memory: FloatArray | None = None


def advance(
    system: ModalSystem, laws: Laws, steps: Steps, begin: Begin, kernel: Kernel = PLAIN
) -> ModalMotion:
    """Return the motion at the samples of known steps, by plain loops or compiled ones.

    Where laws begin or end, a new section does: modes and the laws that go on keep their state, a law that
    begins has been loaded from zero to where its port is. A stamp at an edge belongs to what begins there.
    """
    known, modes, count, size = begin.memory is not None, len(begin.q), len(laws), len(steps.sample)
    memory = laws.memory() if begin.memory is None else begin.memory.copy()
    state, before = State(begin.q.astype(float), begin.v.astype(float), memory), np.ones(count, dtype=bool)
    none, forces = np.empty((2, size, modes)), np.empty((2, size, count))
    found = ModalMotion(none[0], none[1], forces[0], forces[1], memory)
    flexibility, actions = port_flexibility(system, laws), system.actions or system.ports
    given, time = tuple(map(np.ascontiguousarray, steps)), steps.time
    edges = [moment for moment in laws.edges if time[0] < moment < time[-1]]
    cuts = np.unique(np.concatenate(([0, len(time) - 1], np.searchsorted(time, edges)))).tolist()
    for first, last in pairwise(map(int, cuts)):
        moment = 0.5 * float(time[first] + time[first + 1])
        rows, acting = laws.rows(system.ports, modes, moment), laws.act_at(moment)
        for j in np.flatnonzero(acting & ~before):
            state.memory[j] = 0.0
            if laws.of_speed[j]:
                state.memory[j, PLACE] = rows[j] @ state.q
        acts, sample = laws.rows(actions, modes, moment), int(np.searchsorted(steps.sample, first))
        ports = laws.at(rows, acts, flexibility, float(system.relaxation), steps.transition)
        by, into = (given, first, last, sample, system.coupled, known), (tuple(state), tuple(found))
        kernel.integrate(*by, tuple(ports), *into)
        known, before = True, acting
    return found
