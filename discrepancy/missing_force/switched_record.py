"""A trial in which a force is on or off: the evidence of every stretch in which it may be on.

A path (N,) says for each sample whether the force of events is on; a stretch is a range of samples
in which it stays on, or off. A filter runs forwards up to the start of a stretch, and from there to
all its possible ends, where it is joined with a backward filter. So one pass over the record gives
the evidence of all stretches with the same start.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from discrepancy.estimation.force_states import ForceStates, ForceStateSpace, Process
from discrepancy.estimation.linearisation import Linearisation
from discrepancy.estimation.regression import integrate_out_last
from discrepancy.trials_in_motion.steps import discretise

from .two_filters import FilterState, RecordFilter, StateInformation, join_filters

CHANGE_PRICE = 4.0
"""Log odds against a change of a path, in addition to the prior of its sample [nat]. With 4, the
prior odds of a change are 1 to exp(4) = 55."""
MOST_GRID_INTERVALS = 40
"""Largest number of intervals of the grid on which stretches begin and end."""
MOST_FILTER_STEPS = 400_000
"""Largest number of steps of the filter for one such grid; a long record has fewer intervals."""
COMPARED_SAMPLES = 80
"""Number of samples at which a change is tried at once."""
EVIDENCE_RANGE = 12.0
"""Difference to the largest log evidence above which a change at a sample is impossible [nat]."""

ForcePair = tuple[Process, Process]
"""The force of events, and the force that may be missing throughout."""


class TrialProducts(NamedTuple):
    """The information of a trial on the K shared unknowns: products of its whitened columns.

    Attributes
    ----------
    products : (..., 1 + K, 1 + K) ndarray
        The inner products of the whitened residual (first) and the columns of the unknowns.
    half_log_determinants : (...) ndarray
        Half the log determinant of the covariance of the readings [nat].
    """

    products: FloatArray
    half_log_determinants: FloatArray


class EventTrials:
    """The trials in which events at a port are looked for.

    Parameters
    ----------
    linearisation : Linearisation
        The trials with the columns of all unknowns, without laws.
    port : int
        The number of the port.
    stride : int
        The step between samples that are used; 1 uses all.

    Attributes
    ----------
    stride : int
        The step between the samples that are used.
    trials : list of PortedTrial
        The trials with the samples that are used.
    columns : list of (N, C, 1 + K + L) ndarray
        The residual and the columns of all unknowns, by trial.
    """

    def __init__(self, linearisation: Linearisation, port: int, *, stride: int = 1) -> None:
        self.linearisation = linearisation
        self.port = port
        self.stride = stride
        self.trials = [
            replace(
                linear_trial.trial,
                time=linear_trial.trial.time[::stride],
                used=linear_trial.trial.used[::stride],
            )
            for linear_trial in linearisation.in_motion
        ]
        # the columns of unknowns are minus the derivatives: change their sign
        self.columns = []
        for linear_trial in linearisation.in_motion:
            signs = np.r_[1.0, -np.ones(linear_trial.weight_count - 1)]
            self.columns.append(linear_trial.columns[::stride] * signs)

    def log_evidence(self, by_trial: Sequence[TrialProducts]) -> FloatArray:
        """Return the log evidence (...) of all trials [nat], given the products of each.

        It is -r^T r / 2 - (ln det C) / 2, with the whitened residual r and the covariance C of the
        readings, after the unknowns that the trials share have been integrated out.
        """
        sum_of_products = np.asarray(sum(trial.products for trial in by_trial))
        sum_of_determinants = np.asarray(sum(trial.half_log_determinants for trial in by_trial))
        products, half_log_determinants = integrate_out_last(
            sum_of_products, sum_of_determinants, self.linearisation.shared_precision
        )
        squared_residual = products[..., 0, 0]
        return np.asarray(-0.5 * squared_residual - half_log_determinants)


class SwitchedRecord:
    """A trial in which the force of events is on or off, with its filters.

    Parameters
    ----------
    trials : EventTrials
        The trials in which events are looked for.
    trial_index : int
        The index of this trial in them.
    forces : (Process, Process)
        The force of events, and the force that may be missing throughout.
    products_of_others : sequence of TrialProducts
        The products of the other trials, which also depend on the shared unknowns.
    substeps : int
        The number of steps into which each interval between samples is divided, so that a change
        can lie between samples.
    """

    def __init__(
        self,
        trials: EventTrials,
        trial_index: int,
        forces: ForcePair,
        products_of_others: Sequence[TrialProducts] = (),
        substeps: int = 1,
    ) -> None:
        self.trials = trials
        self.products_of_others = products_of_others
        trial = trials.trials[trial_index]
        self.local_precision = trial.local_precision
        force_states = ForceStates(trial, [(trials.port, force) for force in forces])
        state_space = force_states.state_space
        # the states of the missing forces follow those of the structure; that of events is first
        event_state = len(trial.system.generator)
        # between two samples there are `substeps` steps, at whose ends nothing is read
        lengths, step_of_sample = trial.intervals
        is_used = np.zeros(((len(trial.time) - 1) * substeps + 1, trial.used.shape[1]), dtype=bool)
        is_used[::substeps] = trial.used
        trial_columns = trials.columns[trial_index]
        columns = np.zeros((*is_used.shape, trial_columns.shape[-1]))
        columns[::substeps] = trial_columns * force_states.white_noise_scale[:, None]
        # a step is of one of 4 J kinds: its force is off, begins, ends or is on (see
        # `switched_step_matrices`), and it has one of J lengths
        self.length_of_sample = np.concatenate(
            (step_of_sample[:1], np.repeat(step_of_sample[1:], substeps))
        )
        self.length_count = len(lengths)
        transitions, noises = switched_step_matrices(state_space, event_state, lengths / substeps)
        self.record_filter = RecordFilter(
            transitions, noises, state_space.output_rows, is_used, columns
        )
        covariance_with_force_off, covariance_with_force_on = initial_covariances(
            state_space, event_state
        )
        self._state_with_force_off = self.record_filter.initial_state(covariance_with_force_off)
        self._state_with_force_on = self.record_filter.initial_state(covariance_with_force_on)

    def step_kinds(self, is_on: BoolArray) -> IntArray:
        """Return the kind (N,) of the step that leads to each sample of a path (N,).

        It is the index in the matrices of `switched_step_matrices`.
        """
        was_on = np.r_[False, is_on[:-1]]
        return self._step_kind(was_on, is_on, self.length_of_sample)

    def _step_kind(self, was_on: BoolArray, is_on: BoolArray, length: IntArray) -> IntArray:
        """Return the kinds of steps, given whether the force was on before and is on after them.

        The four cases are off, begins, ends and on, in this order, each with one kind for each
        length of a step.
        """
        return np.asarray((2 * was_on + is_on) * self.length_count + length)

    def products(self, is_on: BoolArray) -> TrialProducts:
        """Return the information of the trial on the shared unknowns, given a path (N,)."""
        end = np.array([len(is_on)])
        at_end = self.record_filter.filter_before(
            self.step_kinds(is_on), 0, self._initial_state(bool(is_on[0])), end
        )
        products, half_log_determinant = integrate_out_last(
            at_end.products[0], at_end.half_log_determinants[0], self.local_precision
        )
        return TrialProducts(products, half_log_determinant)

    def _initial_state(self, is_on: bool) -> FilterState:
        """Return the state of the filter before the first sample, with the force on or off."""
        return self._state_with_force_on if is_on else self._state_with_force_off

    def evidence_of_stretches(
        self, is_on: BoolArray, starts: IntArray, ends: IntArray
    ) -> FloatArray:
        """Return the log evidence of all trials if a path is inverted in one stretch.

        All stretches from one of A starts to one of B ends are tried.

        Parameters
        ----------
        is_on : (N,) array of bool
            The path: whether the force is on at each sample.
        starts : (A,) array of int
            The first samples of the stretches, ascending.
        ends : (B,) array of int
            The samples after the last one of the stretches, ascending.

        Returns
        -------
        (A, B) array
            The log evidence of each start with each end [nat]; -inf if the end is not after the
            start.
        """
        column_count = 1 + len(self.trials.linearisation.shared_precision)
        products = np.zeros((len(starts), len(ends), column_count, column_count))
        # an infinite determinant is an evidence of -inf, which stays if an end is not after the
        # start
        half_log_determinants = np.full((len(starts), len(ends)), np.inf)
        kinds = self.step_kinds(is_on)
        states_at_starts = self.record_filter.filter_before(
            kinds, 0, self._initial_state(bool(is_on[0])), starts
        )
        information_at_ends = self.record_filter.information_after(kinds, ends)
        transitions, noises = self._steps_at_ends(is_on, ends)
        for k, start in enumerate(starts.tolist()):
            if start == 0:  # the first sample is inverted, too
                state = self._initial_state(not is_on[0])
            else:
                state = FilterState(*(array[k] for array in states_at_starts))
            # filter the readings of the stretch, in which the path is inverted
            is_later = ends > start
            inverted_path = is_on.copy()
            inverted_path[start:] ^= True
            state_before_ends = self.record_filter.filter_before(
                self.step_kinds(inverted_path), start, state, ends[is_later]
            )
            # predict over the step that ends the stretch
            transition = transitions[is_later]
            covariance = transition @ state_before_ends.covariance @ transition.mT
            state_at_ends = state_before_ends._replace(
                covariance=covariance + noises[is_later], mean=transition @ state_before_ends.mean
            )
            # join with the readings after the stretch
            products_of_record, half_of_record = join_filters(
                state_at_ends, StateInformation(*(array[is_later] for array in information_at_ends))
            )
            products[k, is_later], half_log_determinants[k, is_later] = integrate_out_last(
                products_of_record, half_of_record, self.local_precision
            )
        return self.trials.log_evidence(
            [TrialProducts(products, half_log_determinants), *self.products_of_others]
        )

    def _steps_at_ends(self, is_on: BoolArray, ends: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return the matrices of the steps that end B stretches of the path, each tried inverted.

        The step leads from the last sample of a stretch, at which the path is inverted (on for off,
        off for on), to the next sample, at which it is not. A stretch up to the end of the record
        has no such step: its transition is the identity, without noise.

        Parameters
        ----------
        is_on : (N,) array of bool
            The path before an inversion: whether the force is on at each sample.
        ends : (B,) array of int
            The sample after the last one of each stretch; N at the end of the record.

        Returns
        -------
        transitions, noises : (B, n, n) array
            The transition matrix and noise covariance of each step, for the n filtered states.
        """
        is_last = ends == len(is_on)
        end_sample = np.where(is_last, 0, ends)  # any sample: the last ones are replaced below
        inverted_before_end = ~is_on[ends - 1]
        kind = self._step_kind(
            inverted_before_end, is_on[end_sample], self.length_of_sample[end_sample]
        )
        identity = np.eye(len(self.record_filter.output_rows[0]))
        transitions = np.where(
            is_last[:, None, None], identity, self.record_filter.transitions[kind]
        )
        noises = np.where(is_last[:, None, None], 0.0, self.record_filter.noises[kind])
        return transitions, noises

    def invert_best_stretch(self, is_on: BoolArray) -> BoolArray | None:
        """Return the path with the one stretch inverted that makes it most probable.

        An inversion turns the force on where it was off, and off where it was on. The stretch
        begins and ends at samples of a grid over the record, or at changes of the path.

        Parameters
        ----------
        is_on : (N,) array of bool
            The path: whether the force is on at each sample.

        Returns
        -------
        (N,) array of bool or None
            The new path; None if no stretch raises the evidence by more than its changes cost.
        """
        sample_count = len(is_on)
        # each start needs one pass of the filter, of up to `sample_count` steps; 12 intervals are
        # the least with which a stretch is found
        interval_count = min(
            max(MOST_FILTER_STEPS // sample_count, 12), MOST_GRID_INTERVALS, sample_count
        )
        edges = np.unique(
            np.r_[np.linspace(0, sample_count, interval_count + 1).round(), change_samples(is_on)]
        ).astype(np.int64)
        # The price of a path counts its changes. A stretch that begins or ends at an existing
        # change removes it (-1); elsewhere it adds one (+1); at the ends of the record there is no
        # change.
        prices = change_price(sample_count) * np.where(
            np.isin(edges, change_samples(is_on)), -1.0, 1.0
        )
        prices[[0, -1]] = 0.0
        # score [k, m]: the stretch from edge k to edge m + 1; -inf if it is empty
        scores = (
            self.evidence_of_stretches(is_on, edges[:-1], edges[1:])
            - prices[:-1, None]
            - prices[None, 1:]
        )
        first_edge, last_interval = np.unravel_index(np.argmax(scores), scores.shape)
        present_evidence = self.trials.log_evidence(
            [self.products(is_on), *self.products_of_others]
        )
        if scores[first_edge, last_interval] <= present_evidence:
            return None
        inverted_path = is_on.copy()
        inverted_path[edges[first_edge] : edges[last_interval + 1]] ^= True
        return inverted_path

    def place_changes(self, is_on: BoolArray) -> BoolArray:
        """Return a path (N,) whose changes are moved to their most probable samples.

        They are moved one after the other. This is repeated, three times at most, since the best
        sample of one change depends on the others.
        """
        for _ in range(3):
            is_on_before = is_on.copy()
            for change_index, old_sample in enumerate(change_samples(is_on)):
                samples, log_evidence = self.evidence_of_change_samples(is_on, change_index)
                new_sample = samples[np.argmax(log_evidence)]
                is_on = is_on.copy()
                # an earlier change extends the stretch after it; a later change, the one before it
                if new_sample < old_sample:
                    is_on[new_sample:old_sample] = is_on[old_sample]
                else:
                    is_on[old_sample:new_sample] = is_on[old_sample - 1]
            if np.array_equal(is_on, is_on_before):
                break
        return is_on

    def evidence_of_change_samples(
        self, is_on: BoolArray, change_index: int
    ) -> tuple[IntArray, FloatArray]:
        """Return samples to which a change of a path may be moved, and the log evidence of each.

        The samples lie between the neighbouring changes. A coarse grid of samples is refined around
        the most probable samples, until it contains every sample there.

        Parameters
        ----------
        is_on : (N,) array of bool
            The path: whether the force is on at each sample.
        change_index : int
            The index of the change among the changes of the path.

        Returns
        -------
        samples : (B,) array of int
            The samples at which the force may change, in ascending order.
        log_evidence : (B,) array
            The log evidence of all trials with the change at each of them [nat].
        """
        bounds = np.r_[0, change_samples(is_on), len(is_on)]
        previous_change, change, next_change = bounds[change_index : change_index + 3]
        # `earliest_path` has the change where the previous one is. If it is inverted from there up
        # to a sample, the change lies at that sample.
        earliest_path = is_on.copy()
        earliest_path[previous_change:next_change] = is_on[change]
        samples = np.zeros(0, dtype=np.int64)
        log_evidence = np.zeros(0)
        first_sample, last_sample = previous_change + 1, next_change - 1
        while True:
            grid = np.linspace(first_sample, last_sample, COMPARED_SAMPLES).round().astype(np.int64)
            new_samples = np.setdiff1d(grid, samples)
            if not len(new_samples):
                return samples, log_evidence
            (evidence_of_new,) = self.evidence_of_stretches(
                earliest_path, np.array([previous_change]), new_samples
            )
            samples = np.r_[samples, new_samples]
            log_evidence = np.r_[log_evidence, evidence_of_new]
            order = np.argsort(samples)
            samples, log_evidence = samples[order], log_evidence[order]
            # the next grid: one compared sample beyond the probable ones on either side
            probable = np.flatnonzero(log_evidence >= log_evidence.max() - EVIDENCE_RANGE)
            first_sample = samples[max(probable[0] - 1, 0)]
            last_sample = samples[min(probable[-1] + 1, len(samples) - 1)]


def switched_step_matrices(
    system: ForceStateSpace, event_state: int, lengths: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return transitions and noises (4 J, n, n) of steps in which the force of events is switched.

    In the first J steps the force is off, and in the last J it is on. In the second J it is off and
    begins at the end of the step. In the third J it is on and ends at the end of the step.

    Parameters
    ----------
    system : ForceStateSpace
        The state space with the force on.
    event_state : int
        The index of the force of events in the state.
    lengths : (J,) array
        The lengths of the steps [s].
    """
    on_transition, on_noise = discretise(system.generator, system.intensity, lengths)
    off_transition, off_noise = discretise(
        zero_state(system.generator, event_state),
        zero_state(system.intensity, event_state),
        lengths,
    )
    transitions = np.stack((off_transition, off_transition, on_transition, on_transition))
    noises = np.stack((off_noise, off_noise, on_noise, on_noise))
    # Only after the last kind of step does the force continue. After the others it is zero, or
    # begins with its stationary variance of one (second kind).
    transitions[:3, :, event_state] = 0.0
    noises[:3, :, event_state] = 0.0
    noises[:3, :, :, event_state] = 0.0
    noises[1, :, event_state, event_state] = 1.0
    shape = (-1, *system.generator.shape)
    return transitions.reshape(shape), noises.reshape(shape)


def initial_covariances(system: ForceStateSpace, event_state: int) -> tuple[FloatArray, FloatArray]:
    """Return the covariances (n, n) of the state at the first sample with the force off, and on.

    Parameters
    ----------
    system : ForceStateSpace
        The state space with the force on.
    event_state : int
        The index of the force of events in the state, after all states of the structure.
    """
    covariance_on = system.initial_covariance
    # In a trial that begins at rest, the force of events f deflects the states of the structure by
    # h f. As f has variance one, h is their covariance with f, and h h^T is what f adds to their
    # own covariance. With the force off, that is subtracted.
    covariance_off = covariance_on.copy()
    deflection = covariance_on[:event_state, event_state]
    covariance_off[:event_state, :event_state] -= np.outer(deflection, deflection)
    return zero_state(covariance_off, event_state), covariance_on


def zero_state(matrix: FloatArray, index: int) -> FloatArray:
    """Return a matrix (n, n) with the row and the column of one state set to zero."""
    zeroed_matrix = matrix.copy()
    zeroed_matrix[index] = 0.0
    zeroed_matrix[:, index] = 0.0
    return zeroed_matrix


def change_samples(is_on: BoolArray) -> IntArray:
    """Return the samples at which a path (N,) changes: each the first one with the new value."""
    return np.flatnonzero(np.diff(is_on)) + 1


def change_price(sample_count: int) -> float:
    """Return the price of a change in a record of `sample_count` samples [nat].

    It is minus the log prior of a change: that there is one, and that it lies at this sample.
    """
    return float(np.log(sample_count)) + CHANGE_PRICE


def price_of_changes(paths: Sequence[BoolArray]) -> float:
    """Return the price of all changes of paths [nat]."""
    return sum(len(change_samples(is_on)) * change_price(len(is_on)) for is_on in paths)
