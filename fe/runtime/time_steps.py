"""Time steps between stamps, short enough for laws, and the forces applied in them.

An exact step of the linear system is computed once for each length; lengths that differ by less
than `LENGTH_TOLERANCE` of the median length count as one. NumPy and relative imports only: this
file is copied into the FMU.
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
"""Largest phase of the slowest and of the fastest mode within a substep with laws [rad]."""
LENGTH_TOLERANCE = 1e-9
"""Steps whose lengths differ by less than this fraction of the median count as equally long."""
LEAST_SUBSTEPS = 8
"""Substeps of an interval with laws if the structure has no frequency of its own."""


class DistinctLengths(NamedTuple):
    """The S distinct step lengths [s], and the index of the length of each of K steps."""

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
        median_length = float(np.median(self.lengths))
        if np.ptp(self.lengths) <= LENGTH_TOLERANCE * median_length:
            zeros = np.zeros(len(self.lengths), dtype=np.int64)
            return DistinctLengths(self.lengths[:1], zeros)
        rounded = np.round(self.lengths / (LENGTH_TOLERANCE * median_length))
        _, first_of_length, index = np.unique(rounded, return_index=True, return_inverse=True)
        return DistinctLengths(
            length=np.ascontiguousarray(self.lengths[first_of_length]),
            length_of_step=np.asarray(index, dtype=np.int64).ravel(),
        )


def step_boundaries(
    system: ModalSystem,
    laws: PortLaws,
    time: FloatArray,
    refinement: int = 1,
    least: int = 1,
    switching_times: Sequence[float] | FloatArray = (),
) -> Boundaries:
    """Divide the intervals between stamps into steps that are short enough for the laws.

    Parameters
    ----------
    time : (N,) array
        The time stamps [s].
    refinement : int
        Factor on the number of steps.
    least : int
        Least number of steps in each interval, before refinement.
    switching_times : sequence or array of float
        Times at which a load or a law begins or ends, where a step has to end, too [s].
    """
    inner_times = np.asarray(switching_times, dtype=np.float64)
    inner_times = inner_times[(inner_times > time[0]) & (inner_times < time[-1])]
    # times that are no stamps; most are, as a sampled load has a corner at each of its samples
    between_stamps = inner_times[time[np.searchsorted(time, inner_times)] != inner_times]
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
    """Divide each interval between stamps (N,) into equal steps, as many as `counts` (N - 1,).

    The arguments are the bytes of float64 arrays, since the cache needs arguments with a hash.
    """
    time = np.frombuffer(stamps)
    step_counts = np.frombuffer(counts).astype(np.int64)
    sample_boundary = np.concatenate(([0], np.cumsum(step_counts))).astype(np.int64)
    # the interval of each step, and the number of the step in it, from one
    interval = np.repeat(np.arange(len(step_counts)), step_counts)
    steps_before_interval = sample_boundary[:-1][interval]
    number_in_interval = np.arange(1, len(interval) + 1) - steps_before_interval
    step_length = np.diff(time) / step_counts
    lengths = np.repeat(step_length, step_counts)
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
    """Return time steps with applied forces that are linear in time in each step.

    Parameters
    ----------
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
