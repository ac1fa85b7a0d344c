"""The Kalman filter of a trial with missing forces at ports: evidence, smoothed forces and states.

A missing force is a Gaussian process in time with standard deviation `size` and correlation time
`time`: Matern 3/2 with two states (Hartikainen and Sarkka 2010, IEEE Workshop on Machine Learning
for Signal Processing), or Matern 1/2 with one state. The filter whitens the residuals and the
columns, which are the derivatives of the readings by unknowns; the unknowns follow from a linear
regression of the whitened residuals on the whitened columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from discrepancy.campaign.records import FloatArray

from .backward import smoother_corrections
from .kalman import RecordFilter, discretise, filter_forward
from .trial import PortedTrial


@dataclass(frozen=True)
class Process:
    """The statistics of a missing force as a Gaussian process in time.

    Attributes
    ----------
    standard_deviation : float
        The standard deviation of the force [N, N m or the port's flow].
    correlation_time : float
        The correlation time [s].
    may_jump : bool
        Whether the force may jump (Matern 1/2). Otherwise it is differentiable (Matern 3/2).
    """

    standard_deviation: float
    correlation_time: float
    may_jump: bool = False

    @property
    def generator(self) -> FloatArray:
        """The rate matrix [1/s] of one or two states.

        The first state is the force over its standard deviation.
        """
        if self.may_jump:
            return np.array([[-1.0 / self.correlation_time]])
        rate = np.sqrt(3.0) / self.correlation_time
        return np.asarray(rate * np.array([[0.0, 1.0], [-1.0, -2.0]]))

    @property
    def intensity(self) -> float:
        """Spectral density of the white noise that drives the last state."""
        return (
            2.0 / self.correlation_time
            if self.may_jump
            else 4.0 * np.sqrt(3.0) / self.correlation_time
        )


class ForceStateSpace(NamedTuple):
    """The system of a trial, its missing forces and its coloured noises as n scaled states.

    Attributes
    ----------
    generator : (n, n) ndarray
        The rate matrix [1/s].
    intensity : (n, n) ndarray
        The spectral density of the white noise that drives the state [1/s].
    output_rows : (C, n) ndarray
        The readings for a unit of each state, divided by the deviation of the white part of their
        noise.
    initial_covariance : (n, n) ndarray
        The covariance of the state at the first sample.
    """

    generator: FloatArray
    intensity: FloatArray
    output_rows: FloatArray
    initial_covariance: FloatArray


class SmoothedForces(NamedTuple):
    """The added state and the missing forces of a trial given all of its readings.

    Shapes: F fine stamps, N samples, n states of the system, P missing forces.

    Attributes
    ----------
    added_state : (F, n) ndarray
        The state that the missing forces add to the response of the model.
    forces : (P, F) ndarray
        The missing forces [N, N m or the port's flow].
    deviations : (2 P, N) ndarray
        The posterior standard deviations at the samples: of the forces, then of the speeds of their
        ports.
    """

    added_state: FloatArray
    forces: FloatArray
    deviations: FloatArray


@dataclass(frozen=True, eq=False)
class ForceFilter:
    """The Kalman filter of a trial with missing forces at ports.

    Attributes
    ----------
    trial : PortedTrial
        The trial.
    processes : sequence of (int, Process)
        The missing forces, each with the number of its port. Several may act at one port.
    """

    trial: PortedTrial
    processes: Sequence[tuple[int, Process]]

    @cached_property
    def state_units(self) -> FloatArray:
        """The unit (n,) of each state of the system, by which the state is divided.

        A force of `size` at the highest natural frequency moves a speed by (force / frequency) and
        a position by that over the frequency, so that scaled states are about of size one.
        """
        system = self.trial.system
        state_count = len(system.generator)
        highest_frequency = max(
            float(np.max(np.abs(np.linalg.eigvals(system.generator)), initial=0.0)), 1e-9
        )
        largest_rates = [
            np.abs(system.actions[port]).max(initial=0.0) * process.standard_deviation
            for port, process in self.processes
        ]
        largest_rate = max(*largest_rates, 1e-300)
        units = np.full(state_count, largest_rate / highest_frequency)
        # with an even number of states, the first half are positions, the second half their speeds
        has_positions = state_count % 2 == 0
        if has_positions:
            units[: state_count // 2] /= highest_frequency
        return units

    @cached_property
    def force_state_indices(self) -> list[int]:
        """The index of each missing force in the whole state.

        A force that may not jump has a second state, which follows it.
        """
        state_counts = [len(process.generator) for _, process in self.processes]
        first_force_state = len(self.trial.system.generator)
        return [
            first_force_state + sum(state_counts[:number]) for number in range(len(state_counts))
        ]

    @cached_property
    def white_noise_scale(self) -> FloatArray:
        """The standard deviation (C,) of each channel's noise divided by that of its white part.

        The filter counts readings in deviations of the white part, while `PortedTrial` counts them
        in deviations of the whole noise: this is the factor between both.
        """
        ratios = np.ones(len(self.trial.deviation))
        for channel, coloured_share, _ in self.trial.coloured_noises:
            ratios[channel] = 1.0 / np.sqrt(1.0 - coloured_share)
        return ratios

    @cached_property
    def state_space(self) -> ForceStateSpace:
        """The state space: states of the system, missing forces, coloured noises, in this order."""
        trial = self.trial
        system_states = slice(0, len(trial.system.generator))
        first_noise_state = system_states.stop + sum(
            len(process.generator) for _, process in self.processes
        )
        state_count = first_noise_state + len(trial.coloured_noises)
        generator = np.zeros((state_count, state_count))
        intensity = np.zeros((state_count, state_count))
        start_covariance = np.zeros((state_count, state_count))
        output_rows = np.zeros((len(trial.deviation), state_count))
        # the system
        generator[system_states, system_states] = (
            trial.system.generator * self.state_units / self.state_units[:, None]
        )
        output_rows[:, system_states] = (
            trial.system.outputs * self.state_units / trial.deviation[:, None]
        )
        # the missing forces: they drive the system, and an acceleration shows them directly
        for (port, process), index in zip(self.processes, self.force_state_indices, strict=True):
            force_states = slice(index, index + len(process.generator))
            generator[system_states, index] = (
                -trial.system.actions[port] * process.standard_deviation / self.state_units
            )
            generator[force_states, force_states] = process.generator
            intensity[force_states.stop - 1, force_states.stop - 1] = process.intensity
            output_rows[:, index] = (
                -trial.system.through[port] * process.standard_deviation / trial.deviation
            )
            start_covariance[force_states, force_states] = np.eye(len(process.generator))
            # a settled trial begins at rest under the missing force f: A s + b f = 0
            if trial.begins_at_rest:
                at_rest = np.linalg.lstsq(
                    generator[system_states, system_states],
                    -generator[system_states, index],
                    rcond=1e-12,
                )[0]
                start_covariance[system_states, system_states] += np.outer(at_rest, at_rest)
                start_covariance[system_states, index] = at_rest
                start_covariance[index, system_states] = at_rest
        # the correlated parts of noises: first-order processes of variance one
        for index, (channel, coloured_share, rate) in enumerate(
            trial.coloured_noises, first_noise_state
        ):
            generator[index, index] = -rate
            intensity[index, index] = 2.0 * rate
            start_covariance[index, index] = 1.0
            output_rows[channel, index] = np.sqrt(coloured_share)
        output_rows *= self.white_noise_scale[:, None]
        return ForceStateSpace(generator, intensity, output_rows, start_covariance)

    @property
    def filter_key(self) -> tuple[bytes, ...]:
        """A key that is equal for trials with the same system, steps and used readings.

        Such trials have the same gains, and are filtered in one pass.
        """
        return tuple(
            array.tobytes() for array in (*self.state_space, *self.trial.intervals, self.trial.used)
        )

    def record_filter(self, columns: FloatArray) -> RecordFilter:
        """Return the filter's matrices by kind of step, with columns (K, N, C) to filter."""
        lengths, _ = self.trial.intervals
        transitions, noises = discretise(
            self.state_space.generator, self.state_space.intensity, lengths
        )
        scaled_columns = np.ascontiguousarray(
            np.moveaxis(columns, 0, -1) * self.white_noise_scale[:, None]
        )
        return RecordFilter(
            transitions, noises, self.state_space.output_rows, self.trial.used, scaled_columns
        )

    def whitened_products(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the products of whitened columns, and half the log determinant of the readings.

        Parameters
        ----------
        columns : (K, N, C) array
            The residual and the derivatives by unknowns, divided by the noise deviations.

        Returns
        -------
        products : (K, K) array
            The inner products of all pairs of whitened columns.
        half_log_determinant : float
            Half the sum of the logarithms of the variances of the readings, each given those before
            it [nat]. It is infinite if a force is so large that rounding loses the readings.
        """
        record_filter = self.record_filter(columns)
        _, step_of_sample = self.trial.intervals
        end = np.array([len(step_of_sample)])
        begin = record_filter.initial_state(self.state_space.initial_covariance)
        _, _, products, half_log_determinants = record_filter.filter_before(
            step_of_sample, 0, begin, end
        )
        # the filter's readings are multiplied by `white`, which multiplies their deviations too
        return products[0], half_log_determinants[0] - np.sum(
            np.log(self.white_noise_scale) * self.trial.used
        )

    def smooth(self, readings: FloatArray) -> SmoothedForces:
        """Return the added state and the missing forces given all readings.

        Parameters
        ----------
        readings : (N, C) array
            The residuals that the missing forces are to explain, divided by the noise deviations.
        """
        record_filter = self.record_filter(readings[None])
        _, step_of_sample = self.trial.intervals
        covariance, mean, *_ = record_filter.initial_state(self.state_space.initial_covariance)
        every_sample = np.arange(1, len(readings) + 1)
        record = (
            record_filter.transitions,
            record_filter.noises,
            step_of_sample,
            record_filter.output_rows,
            record_filter.used,
        )
        covariances, means, white, _, gains, variances = filter_forward(
            *record, record_filter.columns, 0, covariance, mean, every_sample
        )
        corrections, informations = smoother_corrections(
            record_filter.transitions,
            step_of_sample,
            record_filter.output_rows,
            record_filter.used,
            white,
            gains,
            variances,
        )
        states = self._states_at_fine_stamps(means, covariances, corrections)
        # de Jong's smoother: the covariance given all readings, see `smoother_corrections`
        posterior = covariances - covariances @ informations @ covariances
        sizes = np.array([process.standard_deviation for _, process in self.processes])
        return SmoothedForces(
            added_state=states[:, : len(self.state_units)] * self.state_units,
            forces=states[:, self.force_state_indices].T * sizes[:, None],
            deviations=self._deviations(posterior),
        )

    def _states_at_fine_stamps(
        self, means: FloatArray, covariances: FloatArray, corrections: FloatArray
    ) -> FloatArray:
        """Return the smoothed state (F, n) at all fine stamps, from the results at the samples.

        Parameters
        ----------
        means, covariances : (N, n, 1), (N, n, n) ndarray
            The filtered state: after the readings of each sample.
        corrections : (N, n) ndarray
            De Jong's vector r of each sample, by which later readings correct the state; see
            `smoother_corrections`.
        """
        substeps = self.trial.substeps
        lengths, step_of_sample = self.trial.intervals
        fine_transitions, fine_noises = discretise(
            self.state_space.generator, self.state_space.intensity, lengths / substeps
        )
        step_kind = step_of_sample[1:]
        transitions = fine_transitions[step_kind]
        # what later readings add, carried back from the next sample to each fine stamp before it
        carried_back = [corrections[1:, :, None]]
        for _ in range(substeps):
            carried_back.append(transitions.mT @ carried_back[-1])
        # the state, carried forward from each sample with what it may have gathered on the way
        state = means[:-1] + covariances[:-1] @ carried_back[-1]
        gathered_noise = np.zeros_like(fine_transitions)
        fine_states = []
        for correction in carried_back[:0:-1]:
            fine_states.append(state + gathered_noise[step_kind] @ correction)
            state = transitions @ state
            gathered_noise = fine_transitions @ gathered_noise @ fine_transitions.mT + fine_noises
        state_count = means.shape[1]
        return np.concatenate(
            (np.stack(fine_states, axis=1).reshape(-1, state_count), means[-1:, :, 0])
        )

    def _deviations(self, covariances: FloatArray) -> FloatArray:
        """Return the deviations (2 P, N) of the forces, then of the speeds of their ports.

        Parameters
        ----------
        covariances : (N, n, n) ndarray
            The covariance of the state at each sample, given all readings.
        """
        force_count = len(self.processes)
        output_rows = np.zeros((2 * force_count, covariances.shape[-1]))
        for number, (port, process) in enumerate(self.processes):
            output_rows[number, self.force_state_indices[number]] = process.standard_deviation
            output_rows[force_count + number, : len(self.state_units)] = (
                self.trial.system.speeds[port] * self.state_units
            )
        variances = np.sum((output_rows @ covariances) * output_rows, axis=-1)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)).T)


ROUNDING = 1e-12
"""Relative error of the squared norm of a column by rounding."""
LEAST_PRECISION = 1e-10
"""Prior precision that stands for an unknown of which nothing is known in advance."""


@dataclass(frozen=True, eq=False)
class Solution:
    """The K unknowns of a linear model given the readings.

    Attributes
    ----------
    log_evidence : float
        The log evidence [nat], up to a constant.
    mean : (K,) ndarray
        The posterior mean.
    covariance : (K, K) ndarray
        The posterior covariance.
    """

    log_evidence: float
    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Regression:
    """The normal equations of a linear model with K unknowns, summed over trials.

    Attributes
    ----------
    products : (1 + K, 1 + K) ndarray
        The inner products of the whitened residual (first) and of the whitened columns of the
        unknowns. Unknowns of single trials have been eliminated.
    half_log_determinant : float
        Half the log determinant of the covariance of the readings, with the contribution of the
        eliminated unknowns [nat].
    """

    products: FloatArray
    half_log_determinant: float

    def solve(self, unknowns: Sequence[int], precision: FloatArray) -> Solution:
        """Return evidence and values of some of the unknowns; the others are zero.

        Parameters
        ----------
        unknowns : sequence of int
            The K numbers of the unknowns.
        precision : (K,) array
            Their prior precisions.
        """
        rows = np.array([0, *(1 + k for k in unknowns)])
        products = self.products[np.ix_(rows, rows)]
        prior_precision = np.maximum(precision, LEAST_PRECISION)
        # columns may be of any scale and nearly equal: scale the normal equations to unit diagonal
        column_scale = 1.0 / np.sqrt(np.diag(products)[1:] + prior_precision)
        normal_matrix = (products[1:, 1:] + np.diag(prior_precision)) * np.outer(
            column_scale, column_scale
        )
        factor = cho_factor(normal_matrix + ROUNDING * np.eye(len(column_scale)))
        mean = column_scale * cho_solve(factor, column_scale * products[1:, 0])
        covariance = np.outer(column_scale, column_scale) * cho_solve(
            factor, np.eye(len(prior_precision))
        )
        # Laplace's approximation of the evidence, which is exact for a linear model
        residual_weights = np.r_[1.0, -mean]
        misfit = float(
            residual_weights @ products @ residual_weights + mean @ (prior_precision * mean)
        )
        evidence = -0.5 * misfit - self.half_log_determinant
        # half the log determinant of the unscaled normal equations
        log_determinant = np.sum(np.log(np.diag(factor[0]) / column_scale))
        evidence -= float(log_determinant - 0.5 * np.sum(np.log(prior_precision)))
        return Solution(evidence, mean, covariance)


def integrate_out_last(
    products: FloatArray, half_log_determinants: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return products and half log determinants with the last unknowns integrated out.

    Parameters
    ----------
    products : (..., W, W) array
        The inner products of the whitened residual and the columns of the unknowns.
    half_log_determinants : (...) array
        Half the log determinants of the covariance of the readings [nat].
    precision : (L,) array
        The prior precisions of the last L unknowns.

    Returns
    -------
    products : (..., W - L, W - L) array
        The products with the last L columns projected out (Schur complement).
    half_log_determinants : (...) array
        Half the log determinants, with the contribution of these unknowns [nat].
    """
    if not len(precision):
        return products, half_log_determinants
    prior_precision = np.maximum(precision, LEAST_PRECISION)
    kept_count = products.shape[-1] - len(prior_precision)
    # Schur complement of the last columns
    root = np.linalg.cholesky(products[..., kept_count:, kept_count:] + np.diag(prior_precision))
    projected = np.asarray(np.linalg.solve(root, products[..., kept_count:, :kept_count]))
    half_log_det_of_block = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(-1)
    remaining_half_log_dets = (
        half_log_determinants + half_log_det_of_block - 0.5 * np.log(prior_precision).sum()
    )
    return products[
        ..., :kept_count, :kept_count
    ] - projected.mT @ projected, remaining_half_log_dets


def sum_regressions(filters: Sequence[ForceFilter], rows: Sequence[FloatArray]) -> Regression:
    """Return the normal equations of all trials, without the unknowns of single trials.

    Parameters
    ----------
    filters : sequence of ForceFilter
        The filter of each trial.
    rows : sequence of (1 + K + L, N, C) array
        The residual of each trial, and its columns of the K common and the trial's own L unknowns.
    """
    groups: dict[tuple[bytes, ...], list[tuple[ForceFilter, FloatArray]]] = {}
    for trial_filter, columns in zip(filters, rows, strict=True):
        groups.setdefault(trial_filter.filter_key, []).append((trial_filter, columns))
    total: FloatArray | float = 0.0
    log_determinant = 0.0
    # trials of one group have the same gains: one pass of the filter whitens the columns of all
    for group in groups.values():
        first_filter, _ = group[0]
        products_of_group, half_log_determinant = first_filter.whitened_products(
            np.concatenate([columns for _, columns in group])
        )
        ends = np.cumsum([0, *(len(columns) for _, columns in group)]).tolist()
        for (trial_filter, _), (begin, end) in zip(group, pairwise(ends), strict=True):
            products_of_trial = products_of_group[begin:end, begin:end]
            products, half_with_local_unknowns = integrate_out_last(
                products_of_trial, half_log_determinant, trial_filter.trial.local_precision
            )
            total = total + products
            log_determinant += float(half_with_local_unknowns)
    return Regression(np.asarray(total), log_determinant)
