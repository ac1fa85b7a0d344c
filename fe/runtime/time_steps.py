"""Time steps between any stamps, as short as laws need them, and their applied forces.

An exact step of the linear system is computed once for each length; lengths that differ by less
than `LENGTH_TOLERANCE` of the usual length count as one. NumPy and relative imports only: this file
is copied into the FMU.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from .arrays import FloatArray, IntArray
from .modal_system import ModalSystem
from .motion_arrays import StepArrays
from .port_laws import PortLaws

SLOWEST_PHASE, FASTEST_PHASE = 0.05, 0.4
"""Longest substep with laws: the phase of the slowest and of the fastest mode in it [rad]."""
LENGTH_TOLERANCE = 1e-9
"""Lengths of steps that differ by less than this fraction of the usual one count as one length."""
LEAST_SUBSTEPS = 8
"""Substeps of an interval with laws if the structure has no frequency of its own."""


class DistinctLengths(NamedTuple):
    """The S distinct lengths [s] of steps, and the number of its length for each of K steps."""

    length: FloatArray
    length_of_step: IntArray


@dataclass(frozen=True)
class Boundaries:
    """The boundaries of K time steps between N stamps.

    Attributes
    ----------
    time : (K + 1,) array
        Times of the boundaries [s].
    sample_boundary : (N,) array of int
        Boundary of each stamp.
    lengths : (K,) array
        Lengths of the steps [s].
    """

    time: FloatArray
    sample_boundary: IntArray
    lengths: FloatArray

    @cached_property
    def distinct_lengths(self) -> DistinctLengths:
        """The distinct lengths of the steps; an exact step is computed once for each."""
        usual = float(np.median(self.lengths))
        if np.ptp(self.lengths) <= LENGTH_TOLERANCE * usual:
            same_number = np.zeros(len(self.lengths), dtype=np.int64)
            return DistinctLengths(self.lengths[:1], same_number)
        rounded = np.round(self.lengths / (LENGTH_TOLERANCE * usual))
        _, first_of_length, number = np.unique(rounded, return_index=True, return_inverse=True)
        return DistinctLengths(
            length=np.ascontiguousarray(self.lengths[first_of_length]),
            length_of_step=np.asarray(number, dtype=np.int64).ravel(),
        )


def step_boundaries(
    system: ModalSystem,
    laws: PortLaws,
    time: FloatArray,
    refinement: int = 1,
    least: int = 1,
    switching_times: Sequence[float] | FloatArray = (),
) -> Boundaries:
    """Return time steps between stamps that are short enough for the laws.

    Parameters
    ----------
    system : ModalSystem
        The modes of the structure, without the forces of laws.
    time : (N,) array
        The time stamps [s].
    refinement : int
        Factor on the number of steps.
    least : int
        Least number of steps in each interval, before refinement.
    switching_times : sequence or array of float
        Times at which a load or a law begins or ends, so that a step has to end there [s].
    """
    moments = np.asarray(switching_times, dtype=np.float64)
    moments = moments[(moments > time[0]) & (moments < time[-1])]
    # most are stamps, as a sampled load has a corner at each of its samples
    between_stamps = moments[time[np.searchsorted(time, moments)] != moments]
    if len(between_stamps):
        all_times = np.union1d(time, between_stamps)
        boundaries = step_boundaries(system, laws, all_times, refinement, least)
        samples = boundaries.sample_boundary[np.searchsorted(all_times, time)]
        return replace(boundaries, sample_boundary=samples)
    # With laws, the slowest and the fastest mode set the length of a step. A number of steps that
    # exceeds a whole number by rounding alone is not rounded up.
    substeps = np.ones(len(time) - 1)
    if not laws.linear:
        substeps *= LEAST_SUBSTEPS
        rates = system.motion_rates
        if len(rates):
            steps_per_second = max(
                float(rates.min()) / SLOWEST_PHASE, float(rates.max()) / FASTEST_PHASE
            )
            substeps = np.maximum(np.ceil(steps_per_second * np.diff(time) - 1e-9), 1.0)
    counts = np.maximum(substeps, least) * refinement
    return _divided_intervals(time.tobytes(), counts.tobytes())


@lru_cache(maxsize=16)
def _divided_intervals(stamps: bytes, counts: bytes) -> Boundaries:
    """Return the steps that divide each interval between stamps (N,) into equal parts (N - 1,).

    The arrays of float64 are given by their bytes, so that the results can be cached.
    """
    time = np.frombuffer(stamps)
    parts = np.frombuffer(counts).astype(np.int64)
    sample_boundary = np.concatenate(([0], np.cumsum(parts))).astype(np.int64)
    # the interval of each step, and the number of the step in it, from one
    interval = np.repeat(np.arange(len(parts)), parts)
    steps_before_interval = sample_boundary[:-1][interval]
    number_in_interval = np.arange(1, len(interval) + 1) - steps_before_interval
    part_length = np.diff(time) / parts
    lengths = np.repeat(part_length, parts)
    # the ends of the steps; at a sample exactly the time of the sample
    end_times = time[interval] + number_in_interval * lengths
    boundary_times = np.concatenate((time[:1], end_times))
    boundary_times[sample_boundary] = time
    return Boundaries(boundary_times, sample_boundary, lengths)


def loaded_steps(
    system: ModalSystem,
    boundaries: Boundaries,
    begin_force: FloatArray,
    end_force: FloatArray,
    residual_position: FloatArray,
) -> StepArrays:
    """Return the time steps of a system under applied forces that are linear in time in each step.

    Parameters
    ----------
    system : ModalSystem
        The modes of the structure, without the forces of laws.
    boundaries : Boundaries
        Boundaries of the K steps.
    begin_force, end_force : (K, M) array
        Applied modal forces at both ends of each step.
    residual_position : (K + 1, J) array
        Displacements of the laws' ports under the loads in the modes that are left out, at each
        boundary.
    """
    length, length_of_step = boundaries.distinct_lengths
    exact = system.exact_steps(length)
    increment = np.zeros((len(length_of_step), exact.transition.shape[1]))
    for forces, response in ((begin_force, exact.begin), (end_force, exact.end)):
        if not forces.any():
            continue
        if len(length) == 1:
            increment += forces @ response[0].T
        else:
            increment += np.einsum("knm,km->kn", response[length_of_step], forces)
    return StepArrays(
        transition=exact.transition,
        length=length,
        length_of_step=length_of_step,
        increment=increment,
        begin_force=begin_force,
        end_force=end_force,
        residual_position=residual_position,
        time=boundaries.time,
        sample_boundary=boundaries.sample_boundary,
        stiffness=np.ascontiguousarray(system.full_stiffness),
        damping=np.ascontiguousarray(system.damping),
    )
