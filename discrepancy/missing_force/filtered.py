"""The Kalman filter of a trial with missing forces at ports: evidence, smoothed forces and states.

A missing force is a Gaussian process in time with a standard deviation and a correlation time:
Matern 3/2 with two states (Hartikainen and Sarkka 2010, IEEE Workshop on Machine Learning for
Signal Processing), or Matern 1/2 with one state if it may jump. The filter whitens the residuals
and the columns, which are the derivatives of the readings by unknowns; the unknowns follow from a
linear regression of the whitened residuals on the whitened columns.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from discrepancy.campaign.records import FloatArray
from reporting.arrays import LEAST_DIVISOR

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
        """Spectral density of the white noise that drives the last state [1/s].

        With it the stationary variance of every state is one.
        """
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
    force_deviations, speed_deviations : (P, N) ndarray
        The posterior standard deviations, at the samples, of the forces and of the speeds of their
        ports.
    """

    added_state: FloatArray
    forces: FloatArray
    force_deviations: FloatArray
    speed_deviations: FloatArray


@dataclass(frozen=True, eq=False)
class ForceFilter:
    """The Kalman filter of a trial with missing forces at ports.

    Attributes
    ----------
    trial : PortedTrial
        The trial as a linear system with ports.
    processes : sequence of (int, Process)
        The missing forces, each with the number of its port. Several may act at one port.
    """

    trial: PortedTrial
    processes: Sequence[tuple[int, Process]]

    @cached_property
    def state_units(self) -> FloatArray:
        """The typical size (n,) of each state of the structure; the filter divides the state by it.

        Let the missing force, which the model lacks, vary at the highest natural frequency omega
        with an amplitude of one standard deviation, and let it cause the acceleration a. The size
        of a speed is then a / omega, and the size of a position is a / omega^2.
        """
        system = self.trial.system
        state_count = len(system.generator)
        highest_frequency = max(
            float(np.max(np.abs(np.linalg.eigvals(system.generator)), initial=0.0)), 1e-9
        )
        # a row of `actions` holds the rates (n,) of the states that a unit force at a port causes
        accelerations = [
            np.abs(system.actions[port]).max(initial=0.0) * process.standard_deviation
            for port, process in self.processes
        ]
        largest_acceleration = max([*accelerations, LEAST_DIVISOR])
        units = np.full(state_count, largest_acceleration / highest_frequency)
        # The system does not say which states are positions. An even number of states is taken for
        # positions and then as many speeds, an odd number for speeds alone.
        has_positions = state_count % 2 == 0
        if has_positions:
            units[: state_count // 2] /= highest_frequency
        return units

    @cached_property
    def force_state_indices(self) -> list[int]:
        """The index of each missing force in the state.

        A force that may not jump has a second state, its scaled rate, which follows it.
        """
        state_counts = [len(process.generator) for _, process in self.processes]
        first_force_state = len(self.trial.system.generator)
        return [
            first_force_state + sum(state_counts[:number]) for number in range(len(state_counts))
        ]

    @cached_property
    def white_noise_scale(self) -> FloatArray:
        """The standard deviation (C,) of each channel's noise over the deviation of its white part.

        The filter counts readings in deviations of the white part, while `PortedTrial` counts them
        in deviations of the whole noise: this is the factor between both.
        """
        ratios = np.ones(len(self.trial.deviation))
        for noise in self.trial.coloured_noises:
            ratios[noise.channel] = 1.0 / np.sqrt(1.0 - noise.share)
        return ratios

    @cached_property
    def state_space(self) -> ForceStateSpace:
        """The state space with the states of the structure, missing forces, and coloured noises."""
        trial = self.trial
        force_state_count = sum(len(process.generator) for _, process in self.processes)
        first_noise_state = len(trial.system.generator) + force_state_count
        state_count = first_noise_state + len(trial.coloured_noises)
        state_space = ForceStateSpace(
            generator=np.zeros((state_count, state_count)),
            intensity=np.zeros((state_count, state_count)),
            output_rows=np.zeros((len(trial.deviation), state_count)),
            initial_covariance=np.zeros((state_count, state_count)),
        )
        self._fill_structure(state_space)
        for (port, process), index in zip(self.processes, self.force_state_indices, strict=True):
            self._fill_missing_force(state_space, port, process, index)
        self._fill_coloured_noises(state_space, first_noise_state)
        # readings in deviations of the white part of their noise
        return state_space._replace(
            output_rows=state_space.output_rows * self.white_noise_scale[:, None]
        )

    def _fill_structure(self, state_space: ForceStateSpace) -> None:
        """Fill the rates and outputs of the structure's own states, in units of these states."""
        system = self.trial.system
        structure = slice(0, len(system.generator))
        units = self.state_units
        state_space.generator[structure, structure] = system.generator * units / units[:, None]
        state_space.output_rows[:, structure] = (
            system.outputs * units / self.trial.deviation[:, None]
        )

    def _fill_missing_force(
        self, state_space: ForceStateSpace, port: int, process: Process, index: int
    ) -> None:
        """Fill the states of a missing force, which drives the structure.

        Parameters
        ----------
        state_space : ForceStateSpace
            The state space, whose structure is filled already.
        port : int
            The number of the port of the force.
        process : Process
            The statistics of the force.
        index : int
            The index of the force in the state.
        """
        trial = self.trial
        generator = state_space.generator
        covariance = state_space.initial_covariance
        structure = slice(0, len(trial.system.generator))
        force_states = slice(index, index + len(process.generator))
        generator[structure, index] = (
            -trial.system.actions[port] * process.standard_deviation / self.state_units
        )
        generator[force_states, force_states] = process.generator
        last_state = force_states.stop - 1
        state_space.intensity[last_state, last_state] = process.intensity
        # an acceleration shows the force directly
        state_space.output_rows[:, index] = (
            -trial.system.through[port] * process.standard_deviation / trial.deviation
        )
        covariance[force_states, force_states] = np.eye(len(process.generator))
        # a trial that begins at rest does so under the missing force f: A s + b f = 0
        if trial.begins_at_rest:
            state_at_rest = np.linalg.lstsq(
                generator[structure, structure], -generator[structure, index], rcond=1e-12
            )[0]
            covariance[structure, structure] += np.outer(state_at_rest, state_at_rest)
            covariance[structure, index] = state_at_rest
            covariance[index, structure] = state_at_rest

    def _fill_coloured_noises(self, state_space: ForceStateSpace, first_state: int) -> None:
        """Fill the correlated parts of noises: first-order processes of variance one.

        Parameters
        ----------
        state_space : ForceStateSpace
            The state space.
        first_state : int
            The index of the first of them in the state.
        """
        for index, noise in enumerate(self.trial.coloured_noises, first_state):
            state_space.generator[index, index] = -noise.decay_rate
            state_space.intensity[index, index] = 2.0 * noise.decay_rate
            state_space.initial_covariance[index, index] = 1.0
            state_space.output_rows[noise.channel, index] = np.sqrt(noise.share)

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
            Half the sum of the logarithms of the variances of the readings, each given those
            before it [nat]. It is infinite if a force is so large that rounding loses the readings.
        """
        record_filter = self.record_filter(columns)
        _, step_of_sample = self.trial.intervals
        begin = record_filter.initial_state(self.state_space.initial_covariance)
        end = np.array([len(step_of_sample)])
        at_end = record_filter.filter_before(step_of_sample, 0, begin, end)
        # the filter's readings are multiplied by `white_noise_scale`, and their deviations with
        # them
        log_scale = np.sum(np.log(self.white_noise_scale) * self.trial.used)
        return at_end.products[0], at_end.half_log_determinants[0] - log_scale

    def smooth(self, readings: FloatArray) -> SmoothedForces:
        """Return the smoothed missing forces, and the change of the state that they cause.

        Both are estimated from all readings of the trial, by a Kalman filter forwards in time and
        de Jong's smoother backwards in time.

        Parameters
        ----------
        readings : (N, C) array
            The residuals of N samples and C channels: readings minus the prediction without missing
            forces, divided by the standard deviations of the noise.
        """
        record_filter = self.record_filter(readings[None])
        _, step_of_sample = self.trial.intervals
        initial_state = record_filter.initial_state(self.state_space.initial_covariance)
        # The state after the readings of each sample k = 0 .. N - 1 is wanted. `filter_forward`
        # calls it the state before sample k + 1.
        next_samples = np.arange(1, len(readings) + 1)
        # forwards in time
        covariances, means, whitened_innovations, _, gains, variances = filter_forward(
            transitions=record_filter.transitions,
            noises=record_filter.noises,
            step_of_sample=step_of_sample,
            output_rows=record_filter.output_rows,
            is_used=record_filter.used,
            columns=record_filter.columns,
            first_sample=0,
            covariance=initial_state.covariance,
            mean=initial_state.mean,
            query_samples=next_samples,
        )
        # backwards in time
        corrections, informations = smoother_corrections(
            record_filter.transitions,
            step_of_sample,
            record_filter.output_rows,
            record_filter.used,
            whitened_innovations,
            gains,
            variances,
        )
        states = self._states_at_fine_stamps(means, covariances, corrections)
        # covariance of the state given all readings, see `smoother_corrections`
        posterior = covariances - covariances @ informations @ covariances
        # the rows are the deviations of all forces, then those of the speeds of their ports
        force_deviations, speed_deviations = np.split(
            self._force_and_speed_deviations(posterior), 2
        )
        # the filter's states are scaled: those of the structure come first, in `state_units`; a
        # force is in units of its standard deviation
        structure_states = states[:, : len(self.state_units)]
        force_states = states[:, self.force_state_indices]
        units_of_forces = np.array([process.standard_deviation for _, process in self.processes])
        return SmoothedForces(
            added_state=structure_states * self.state_units,
            forces=force_states.T * units_of_forces[:, None],
            force_deviations=force_deviations,
            speed_deviations=speed_deviations,
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
        # predict from each sample: the correction acts by the covariance of the sample, and by that
        # of the process noise since the sample
        state = means[:-1] + covariances[:-1] @ carried_back[-1]
        noise_since_sample = np.zeros_like(fine_transitions)
        fine_states = []
        for correction in carried_back[:0:-1]:
            fine_states.append(state + noise_since_sample[step_kind] @ correction)
            state = transitions @ state
            noise_since_sample = (
                fine_transitions @ noise_since_sample @ fine_transitions.mT + fine_noises
            )
        state_count = means.shape[1]
        return np.concatenate(
            (np.stack(fine_states, axis=1).reshape(-1, state_count), means[-1:, :, 0])
        )

    def _force_and_speed_deviations(self, covariances: FloatArray) -> FloatArray:
        """Return the standard deviations (2 P, N) of the P forces, then of their ports' speeds.

        Parameters
        ----------
        covariances : (N, n, n) ndarray
            The covariance of the scaled state at each sample, given all readings.
        """
        force_count = len(self.processes)
        # Forces and speeds are linear in the state, which is scaled: the structure's states come
        # first, in `state_units`; then each force, in units of its standard deviation.
        structure = slice(0, len(self.state_units))
        output_rows = np.zeros((2 * force_count, covariances.shape[-1]))
        for position, (port, process) in enumerate(self.processes):
            force_row, speed_row = output_rows[position], output_rows[force_count + position]
            force_row[self.force_state_indices[position]] = process.standard_deviation
            speed_row[structure] = self.trial.system.speeds[port] * self.state_units
        variances = np.sum((output_rows @ covariances) * output_rows, axis=-1)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)).T)


ROUNDING = 1e-12
"""Relative rounding error of the squared norm of a column. It is added to the diagonal of the
normal equations, so that equal columns do not make them singular."""
LEAST_PRECISION = 1e-10
"""Prior precision of an unknown with a flat prior, whose exact precision of zero is singular."""


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
        """Solve the linear model for some of its unknowns, with all other unknowns at zero.

        Parameters
        ----------
        unknowns : sequence of int
            The numbers of these unknowns.
        precision : (len(unknowns),) array
            The prior precision of each of these unknowns.
        """
        # the row and column of the residual come first, then those of the chosen unknowns
        rows = np.array([0, *(1 + unknown for unknown in unknowns)])
        products = self.products[np.ix_(rows, rows)]
        products_of_unknowns = products[1:, 1:]
        right_side = products[1:, 0]
        prior_precision = np.maximum(precision, LEAST_PRECISION)
        # columns may be of any scale and nearly equal: scale the normal equations to unit diagonal
        column_scale = 1.0 / np.sqrt(np.diag(products_of_unknowns) + prior_precision)
        scale_of_pair = np.outer(column_scale, column_scale)
        normal_matrix = (products_of_unknowns + np.diag(prior_precision)) * scale_of_pair
        identity = np.eye(len(prior_precision))
        cholesky, is_lower = cho_factor(normal_matrix + ROUNDING * identity)
        mean = column_scale * cho_solve((cholesky, is_lower), column_scale * right_side)
        covariance = scale_of_pair * cho_solve((cholesky, is_lower), identity)
        # Laplace's approximation of the evidence, which is exact for a linear model
        residual_weights = np.r_[1.0, -mean]
        misfit = float(
            residual_weights @ products @ residual_weights + mean @ (prior_precision * mean)
        )
        half_log_det_of_normal_matrix = np.sum(np.log(np.diag(cholesky) / column_scale))
        half_log_det_of_prior = 0.5 * np.sum(np.log(prior_precision))
        log_evidence = (
            -0.5 * misfit
            - self.half_log_determinant
            - float(half_log_det_of_normal_matrix - half_log_det_of_prior)
        )
        return Solution(log_evidence, mean, covariance)


def integrate_out_last(
    products: FloatArray, half_log_determinants: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return products and half log determinants with the last unknowns integrated out.

    Parameters
    ----------
    products : (..., W, W) array
        The inner products of the whitened residual (first) and the columns of the unknowns.
    half_log_determinants : (...) array
        Half the log determinants of the covariance of the readings [nat].
    precision : (L,) array
        The prior precisions of the last L unknowns.

    Returns
    -------
    products : (..., W - L, W - L) array
        The products with the last L columns projected out.
    half_log_determinants : (...) array
        Half the log determinants, with the contribution of these unknowns [nat].
    """
    if not len(precision):
        return products, half_log_determinants
    # The Gaussian integral over the last unknowns. Let A be their block of the products plus their
    # prior precisions P, and B their block with the kept columns. The products become the Schur
    # complement, less B^T A^-1 B, and the log determinant grows by ln det A - ln det P. A is at
    # least P, so that P is kept from being exactly singular.
    clipped_precision = np.maximum(precision, LEAST_PRECISION)
    kept_count = products.shape[-1] - len(clipped_precision)
    kept, last = slice(0, kept_count), slice(kept_count, None)
    root_of_a = np.linalg.cholesky(products[..., last, last] + np.diag(clipped_precision))
    whitened_b = np.asarray(np.linalg.solve(root_of_a, products[..., last, kept]))
    schur_complement = products[..., kept, kept] - whitened_b.mT @ whitened_b
    half_log_det_of_a = np.log(np.diagonal(root_of_a, axis1=-2, axis2=-1)).sum(-1)
    half_log_det_of_p = 0.5 * np.log(clipped_precision).sum()
    remaining_half_log_dets = half_log_determinants + half_log_det_of_a - half_log_det_of_p
    return schur_complement, remaining_half_log_dets


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
    sum_of_products: FloatArray | float = 0.0
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
            products, half_determinant_with_local = integrate_out_last(
                products_of_trial, half_log_determinant, trial_filter.trial.local_precision
            )
            sum_of_products = sum_of_products + products
            log_determinant += float(half_determinant_with_local)
    return Regression(np.asarray(sum_of_products), log_determinant)
