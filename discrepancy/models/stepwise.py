"""Motion of few modes at any time stamps, under several forces: exact between the stamps without laws.

Steps are those of `fe.runtime.modal_system.exact_step`; lengths that differ by less than `ALIKE` of the
usual one are one.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import FloatArray
from discrepancy.campaign.sampling import is_even
from discrepancy.models.compiled_motion import Steps, Structure, compiled_steps
from discrepancy.models.memory import Memory
from fe.runtime.modal_system import ModalSystem, exact_step
from fe.runtime.motion import FASTEST_PHASE, SLOWEST_PHASE, Laws, ModalMotion, port_flexibility
from fe.runtime.motion_arrays import Samples, State

IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

ALIKE = 1e-9
"""Lengths of steps that differ by less than this share of the usual one are taken as one."""
KEPT_STEPS = 16
STEPS_AT_LEAST = 8
"""Substeps of an interval with laws where nothing in the structure has a pace of its own."""
_kept, _divided = Memory(KEPT_STEPS), Memory(KEPT_STEPS)


@dataclass(frozen=True)
class CoupledModes(ModalSystem):
    """Coordinates q'' + D q' + S q = forces, S and D any matrices; the first-order ones have no stiffness.

    Attributes
    ----------
    stiffness_matrix : (M, M) ndarray, optional
        S [1/s^2]; the squared angular frequencies where it is left out.
    actions : mapping of str to (M,) ndarray
        Rows along which laws at ports act, where that is not how they see; empty: everywhere the same.
    """

    stiffness_matrix: FloatArray | None = None
    actions: Mapping[str, FloatArray] = field(default_factory=dict)

    @cached_property
    def coupled(self) -> bool:
        """Whether damping or stiffness couples the coordinates."""
        return self.stiffness_matrix is not None or bool(
            np.any(self.damping != np.diag(np.diag(self.damping)))
        )

    @cached_property
    def whole(self) -> FloatArray:
        """S, a matrix where no coordinate is coupled too."""
        return np.diag(self.stiffness) if self.stiffness_matrix is None else self.stiffness_matrix

    @cached_property
    def paces(self) -> FloatArray:
        """Frequencies, or magnitudes (2M,) of the eigenvalues [1/s] of the motion that are not zero."""
        count = len(self.angular_frequency)
        if self.stiffness_matrix is None and np.all(self.angular_frequency > 0.0):
            return self.angular_frequency
        matrix = np.block([[np.zeros((count, count)), np.eye(count)], [-self.whole, -self.damping]])
        found = np.abs(np.linalg.eigvals(matrix))
        return np.asarray(found[found > 1e-7 * np.max(found, initial=0.0)])


def exact_steps(system: CoupledModes, lengths: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what `exact_step` does: transitions (S, 2M, 2M), and the parts of the forces (S, 2M, M)."""
    matrix = system.whole if system.coupled else system.stiffness
    key = (matrix.tobytes(), system.damping.tobytes(), lengths.tobytes())
    return _kept.get(key, lambda: exact_step(matrix, system.damping, lengths))


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
    system: CoupledModes,
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
    parts = np.maximum(_substeps(system, laws, np.diff(time)), least) * refinement
    return _divided.get((time.tobytes(), parts.tobytes()), lambda: _boundaries(time, parts))


def _boundaries(time: FloatArray, parts: IntArray) -> Boundaries:
    """Return the steps by which each interval between stamps (N,) is divided into parts (N - 1,)."""
    sample = np.concatenate(([0], np.cumsum(parts))).astype(np.int64)
    lengths = np.repeat(np.diff(time) / parts, parts)
    interval = np.repeat(np.arange(len(parts)), parts)
    place = np.arange(1, len(interval) + 1) - sample[:-1][interval]
    moments = np.concatenate((time[:1], time[interval] + place * lengths))
    moments[sample] = time
    return Boundaries(moments, sample, lengths)


class Begin(NamedTuple):
    """Modal displacements and speeds (M + P,), and the laws' memory; None: loaded from zero at once."""

    q: FloatArray
    v: FloatArray
    memory: FloatArray | None = None


def advance(system: CoupledModes, laws: Laws, steps: Steps, begin: Begin) -> ModalMotion:
    """Return the motion at the samples of known steps.

    Where laws begin or end, a new section does: modes and the laws that go on keep their state, a law that
    begins has been loaded from zero to where its port is. A stamp at an edge belongs to what begins there.
    """
    (q, v, memory), modes, count = begin, len(begin.q), len(laws)
    sample = np.arange(len(steps.time)) if laws.spans else steps.sample
    out = Samples(*(np.empty((len(sample), width)) for width in (modes, modes, count, count)))
    kept = laws.memory() if memory is None else memory.copy()
    state = State(np.array(q, dtype=float), np.array(v, dtype=float), kept, np.zeros(count))
    rows = laws.rows(system.ports, modes)
    acts = laws.rows(system.actions, modes) if system.actions else rows
    flexibility = port_flexibility(system, laws)
    before = np.ones(count, dtype=bool)
    for first, last, acting in _sections(laws, steps.time):
        now = acting[:, None]
        ports = laws.at(rows * now, flexibility, system.relaxation, np.zeros((2, count)), acts * now)
        started = acting & ~before
        state.memory[started] = 0.0
        moving = started & (laws.of_speed == 1)
        state.memory[moving, 1] = rows[moving] @ state.q
        state.current[:] = 0.0
        own, part = steps, out
        if laws.spans:
            own = steps.between(first, last)
            part = Samples(*(item[first : last + 1] for item in out))
        structure = Structure(
            system.coupled, system.stiffness, np.ascontiguousarray(system.damping), laws.rate,
            memory is not None or first > 0,
        )  # fmt: skip
        given = (np.ascontiguousarray(item) for item in own)
        compiled_steps()(tuple(given), tuple(structure), tuple(ports), tuple(state), tuple(part))
        before = acting
    if laws.spans:
        out = Samples(*(item[steps.sample] for item in out))
    return ModalMotion(out.q, out.v, out.forces, kept, out.lagged)


def _sections(laws: Laws, time: FloatArray) -> Iterator[tuple[int, int, BoolArray]]:
    """Yield first and last boundary of the steps during which the same laws act, and which (J,) these are."""
    inside = [moment for moment in laws.edges if time[0] < moment < time[-1]]
    cuts = np.unique(np.concatenate(([0, len(time) - 1], np.searchsorted(time, inside)))).astype(int)
    for first, last in pairwise(cuts.tolist()):
        yield first, last, laws.act_at(0.5 * float(time[first] + time[first + 1]))


def _substeps(system: CoupledModes, laws: Laws, lengths: FloatArray) -> IntArray:
    """Return how many steps each interval (K,) is divided into, as `fe.runtime.motion.substeps_for` does."""
    if laws.linear:
        return np.ones(len(lengths), dtype=np.int64)
    paces = system.paces
    if not len(paces):
        return np.full(len(lengths), STEPS_AT_LEAST, dtype=np.int64)
    rate = max(float(paces.min()) / SLOWEST_PHASE, float(paces.max()) / FASTEST_PHASE)
    return np.maximum(np.ceil(rate * lengths - 1e-9), 1.0).astype(np.int64)


def free_motion(
    modal: ModalSystem, q: FloatArray, v: FloatArray, times: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return free motion (N, M), displacement and velocity, of uncoupled modes.

    Parameters
    ----------
    modal : ModalSystem
        The modes; only the diagonal of their damping acts.
    q, v : (M,) ndarray
        Displacement and velocity at time zero, mass-normalised.
    times : (N,) ndarray
        [s]; evenly spaced ones take a tenth of the time.
    """
    half = 0.5 * np.diag(modal.damping)
    w = modal.angular_frequency
    root = np.sqrt((half**2 - w**2).astype(complex))
    root = np.where(np.abs(root) < 1e-6 * w, 1e-6 * w, root)  # critical: beside it, by 1e-12 of w^2
    fast, slow = -half - root, -half + root
    first = (v - fast * q) / (2.0 * root)  # q = first e^(slow t) + second e^(fast t)
    if np.all(root.imag != 0.0):  # the two are conjugate
        wave = 2.0 * first * _waves(slow, times)
        return np.ascontiguousarray(wave.real), np.ascontiguousarray((slow * wave).real)
    one, two = first * _waves(slow, times), (q - first) * _waves(fast, times)
    return np.ascontiguousarray((one + two).real), np.ascontiguousarray((slow * one + fast * two).real)


def _waves(rates: NDArray[Any], times: FloatArray) -> NDArray[np.complex128]:
    """Return e^(rate t) (N, M); at evenly spaced times as products of few exponentials."""
    count, block = len(times), 32
    if count <= 2 * block or not is_even(times):
        return np.asarray(np.exp(np.outer(times, rates)))
    interval = (times[-1] - times[0]) / (count - 1)
    blocks = -(-count // block)
    coarse = np.exp(np.outer(times[0] + interval * block * np.arange(blocks), rates))
    fine = np.exp(np.outer(interval * np.arange(block), rates))
    return np.asarray((coarse[:, None, :] * fine).reshape(blocks * block, -1)[:count])
