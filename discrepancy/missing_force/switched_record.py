"""A trial in which a force is on or off: the evidence of all stretches in which it may be on.

A path (N,) says for each sample whether the force of events is on; a stretch is a range of samples
in which it stays on, or off. The filter of the readings before a moment and the backward filter of
those after it are joined, so that the evidence of a stretch with any start and any end needs no
further pass over the record.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray

from .filtered import ForceFilter, ForceStateSpace, Process, integrate_out_last
from .kalman import RecordFilter, discretise, join_filters
from .view import LinearTrials

CHANGE_PRICE = 4.0
"""Log odds against a change of a path, besides the prior of its place [nat]."""
MOST_GRID_INTERVALS = 40
"""Largest number of places in a grid between which a stretch is looked for."""
MOST_FILTER_STEPS = 400_000
"""Largest number of steps of the filter for one such grid; a long record has fewer places."""
COMPARED_SAMPLES = 80
"""Number of places of a change that are compared at once."""
EVIDENCE_RANGE = 12.0
"""Log evidence below the largest [nat] from which on a place is taken as impossible."""

ForcePair = tuple[Process, Process]
"""The force of events, and the force that may be missing throughout."""


class TrialProducts(NamedTuple):
    """The information of a trial on the K shared unknowns, as the products of its whitened columns.

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
    linear_trials : LinearTrials
        The trials, and the columns of all unknowns and of the forces known to act.
    port : int
        The number of the port.
    stride : int
        The step between samples that are used; 1 uses all.

    Attributes
    ----------
    trials : list of PortedTrial
        The trials with the samples that are used.
    columns : list of (1 + K + L, N, C) ndarray
        The residual and the columns of all unknowns, by trial.
    """

    def __init__(self, linear_trials: LinearTrials, port: int, *, stride: int = 1) -> None:
        self.linear_trials = linear_trials
        self.port = port
        self.trials = [
            replace(trial, time=trial.time[::stride], used=trial.used[::stride])
            for trial in linear_trials.trials
        ]
        self.columns = [rows[:, ::stride] for rows in linear_trials.regression_rows]

    def log_evidence(self, by_trial: Sequence[TrialProducts]) -> FloatArray:
        """Return the log evidence (...) of all trials [nat], given the products of each."""
        products = sum(trial.products for trial in by_trial)
        half_log_determinants = sum(trial.half_log_determinants for trial in by_trial)
        products, half_log_determinants = integrate_out_last(
            np.asarray(products),
            np.asarray(half_log_determinants),
            self.linear_trials.shared_precision,
        )
        return np.asarray(-0.5 * products[..., 0, 0] - half_log_determinants)


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
        force_filter = ForceFilter(trial, [(trials.port, force) for force in forces])
        event = len(trial.system.generator)  # index of the event's force in the state
        lengths, step_of_sample = trial.intervals
        used = np.zeros(((len(trial.time) - 1) * substeps + 1, trial.used.shape[1]), dtype=bool)
        used[::substeps] = trial.used
        columns = np.zeros((*used.shape, len(trials.columns[trial_index])))
        columns[::substeps] = np.moveaxis(
            trials.columns[trial_index] * force_filter.white_noise_scale, 0, -1
        )
        # a step is of one of 4 J kinds: its force is off, begins, ends or is on (see
        # `switched_step_matrices`), and it has one of J lengths
        self.length_of_sample = np.concatenate(
            (step_of_sample[:1], np.repeat(step_of_sample[1:], substeps))
        )
        self.length_count = len(lengths)
        transitions, noises = switched_step_matrices(
            force_filter.state_space, event, lengths / substeps
        )
        self.record_filter = RecordFilter(
            transitions, noises, force_filter.state_space.output_rows, used, columns
        )
        off, on = initial_covariances(force_filter.state_space, event)
        self.states_off_and_on = [
            self.record_filter.initial_state(off),
            self.record_filter.initial_state(on),
        ]

    def step_kinds(self, on: BoolArray) -> IntArray:
        """Return the kind (N,) of the step that leads to each sample of a path (N,).

        It is the index in the matrices of `switched_step_matrices`.
        """
        was_on = np.r_[False, on[:-1]]
        return np.asarray((2 * was_on + on) * self.length_count + self.length_of_sample)

    def products(self, on: BoolArray) -> TrialProducts:
        """Return the information of the trial on the shared unknowns, given a path (N,)."""
        end = np.array([len(on)])
        begin = self.states_off_and_on[int(on[0])]
        *_, products, half_log_determinants = self.record_filter.filter_before(
            self.step_kinds(on), 0, begin, end
        )
        return TrialProducts(
            *integrate_out_last(products[0], half_log_determinants[0], self.local_precision)
        )

    def evidence_of_stretches(self, on: BoolArray, starts: IntArray, ends: IntArray) -> FloatArray:
        """Return the log evidence of all trials if the force is switched in one more stretch.

        Parameters
        ----------
        on : (N,) array of bool
            The path: whether the force is on at each sample.
        starts : (A,) array of int
            The first samples of the stretches in which the path is inverted.
        ends : (B,) array of int
            The samples that follow the last ones of the stretches.

        Returns
        -------
        (A, B) array
            The log evidence of each start with each end [nat]; -inf if the end is not after the
            start.
        """
        product_count = 1 + len(self.trials.linear_trials.shared_precision)
        products = np.zeros((len(starts), len(ends), product_count, product_count))
        # an infinite determinant is an evidence of -inf, which stays if an end is not after the
        # start
        half_log_determinants = np.full((len(starts), len(ends)), np.inf)
        kinds = self.step_kinds(on)
        states_at_starts = self.record_filter.filter_before(
            kinds, 0, self.states_off_and_on[int(on[0])], starts
        )
        after_ends = self.record_filter.information_after(kinds, ends)
        transitions, noises = self._steps_at_ends(on, ends)
        for k, start in enumerate(starts.tolist()):
            # a stretch from the first sample on: the force begins off instead of on, or on instead
            # of off
            if start == 0:
                state = self.states_off_and_on[int(not on[0])]
            else:
                covariance, mean, known_products, known_half = states_at_starts
                state = (covariance[k], mean[k], known_products[k], known_half[k])
            is_later = ends > start
            switched = on.copy()
            switched[start:] ^= True
            covariance, mean, *sums = self.record_filter.filter_before(
                self.step_kinds(switched), start, state, ends[is_later]
            )
            # the step into the sample `end`, from which on the path is not inverted any more
            transition = transitions[is_later]
            covariance = transition @ covariance @ transition.mT + noises[is_later]
            state_at_ends = (covariance, transition @ mean, *sums)
            products_of_trial = join_filters(
                state_at_ends, [array[is_later] for array in after_ends]
            )
            products[k, is_later], half_log_determinants[k, is_later] = integrate_out_last(
                *products_of_trial, self.local_precision
            )
        return self.trials.log_evidence(
            [TrialProducts(products, half_log_determinants), *self.products_of_others]
        )

    def _steps_at_ends(self, on: BoolArray, ends: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return transitions and noises (B, n, n) of the steps by which inverted stretches end.

        Parameters
        ----------
        on : (N,) array of bool
            The path before a stretch is inverted.
        ends : (B,) array of int
            The samples that follow the last ones of the stretches. No step follows the end of the
            record: its transition is the identity, without noise.
        """
        # the kind of step as in `step_kinds`: the path is inverted before the end, not at it
        is_last = ends == len(on)
        end_sample = np.where(is_last, 0, ends)
        was_on = ~on[ends - 1]
        kind = (2 * was_on + on[end_sample]) * self.length_count + self.length_of_sample[end_sample]
        identity = np.eye(len(self.record_filter.output_rows[0]))
        transitions = np.where(
            is_last[:, None, None], identity, self.record_filter.transitions[kind]
        )
        noises = np.where(is_last[:, None, None], 0.0, self.record_filter.noises[kind])
        return transitions, noises

    def invert_best_stretch(self, on: BoolArray) -> BoolArray | None:
        """Return the path with that one stretch inverted which makes it most probable.

        Inverting turns the force on where it was off, and off where it was on. The begin and the
        end of the stretch are taken from a grid over the record.

        Parameters
        ----------
        on : (N,) array of bool
            The path: whether the force is on at each sample.

        Returns
        -------
        (N,) array of bool or None
            The new path; None if no stretch raises the evidence by more than its changes cost.
        """
        sample_count = len(on)
        # each start needs one pass of the filter, of up to `sample_count` steps
        interval_count = min(
            max(MOST_FILTER_STEPS // sample_count, 12), MOST_GRID_INTERVALS, sample_count
        )
        edges = np.unique(
            np.r_[np.linspace(0, sample_count, interval_count + 1).round(), change_samples(on)]
        ).astype(np.int64)
        # The price of a path counts its changes. A stretch that begins or ends at an existing
        # change removes it (-1); elsewhere it adds one (+1); at the ends of the record there is no
        # change.
        prices = change_price(sample_count) * np.where(
            np.isin(edges, change_samples(on)), -1.0, 1.0
        )
        prices[[0, -1]] = 0.0
        # score [k, m]: the stretch from edge k to edge m + 1; -inf if it is empty
        scores = (
            self.evidence_of_stretches(on, edges[:-1], edges[1:])
            - prices[:-1, None]
            - prices[None, 1:]
        )
        first_edge, last_interval = np.unravel_index(np.argmax(scores), scores.shape)
        if scores[first_edge, last_interval] <= self.trials.log_evidence(
            [self.products(on), *self.products_of_others]
        ):
            return None
        switched = on.copy()
        switched[edges[first_edge] : edges[last_interval + 1]] ^= True
        return switched

    def place_changes(self, on: BoolArray) -> BoolArray:
        """Return a path (N,) whose changes are moved to their most probable places.

        They are moved one after the other. This is repeated, three times at most, since the best
        place of one change depends on the others.
        """
        for _ in range(3):
            previous = on.copy()
            for number, old in enumerate(change_samples(on)):
                places, log_evidence = self.evidence_of_change_samples(on, number)
                new = places[np.argmax(log_evidence)]
                on = on.copy()
                # between old and new place: an earlier change extends the state after it, a later
                # one extends the state before it
                on[min(old, new) : max(old, new)] = on[old] if new < old else on[old - 1]
            if np.array_equal(on, previous):
                break
        return on

    def evidence_of_change_samples(self, on: BoolArray, number: int) -> tuple[IntArray, FloatArray]:
        """Return places of a change of a path, and the log evidence of each.

        Places are refined from a coarse grid to all samples around the most probable ones.

        Parameters
        ----------
        on : (N,) array of bool
            The path: whether the force is on at each sample.
        number : int
            The index of the change among the changes of the path.

        Returns
        -------
        places : (B,) array of int
            Samples at which the change may lie, ascending.
        log_evidence : (B,) array
            The log evidence of all trials with the change there [nat].
        """
        previous_change, change, next_change = np.r_[0, change_samples(on), len(on)][
            number : number + 3
        ]
        # the path whose change is as early as the previous one; inverting it from there to a place
        # delays the change to that place
        earliest_path = on.copy()
        earliest_path[previous_change:next_change] = on[change]
        places = np.zeros(0, dtype=np.int64)
        log_evidence = np.zeros(0)
        first_place, last_place = previous_change + 1, next_change - 1
        while True:
            candidate_places = (
                np.linspace(first_place, last_place, COMPARED_SAMPLES).round().astype(np.int64)
            )
            new_places = np.setdiff1d(candidate_places, places)
            if not len(new_places):
                return places, log_evidence
            evidence_of_new = self.evidence_of_stretches(
                earliest_path, np.array([previous_change]), new_places
            )[0]
            places = np.r_[places, new_places]
            log_evidence = np.r_[log_evidence, evidence_of_new]
            order = np.argsort(places)
            places, log_evidence = places[order], log_evidence[order]
            probable = np.flatnonzero(log_evidence >= log_evidence.max() - EVIDENCE_RANGE)
            first_place = places[max(probable[0] - 1, 0)]
            last_place = places[min(probable[-1] + 1, len(places) - 1)]


def switched_step_matrices(
    system: ForceStateSpace, event: int, lengths: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return transitions and noises (4 J, n, n) of steps in which the force of events is switched.

    The first J have the force off; in the next J it begins at the end of the step; in the next J it
    acts during the step and ends there; in the last J it is on.

    Parameters
    ----------
    system : ForceStateSpace
        The state space with the force on.
    event : int
        The index of the force of events in the state.
    lengths : (J,) array
        The lengths of the steps [s].
    """
    on_transition, on_noise = discretise(system.generator, system.intensity, lengths)
    off_transition, off_noise = discretise(
        zero_state(system.generator, event), zero_state(system.intensity, event), lengths
    )
    transitions = np.stack((off_transition, off_transition, on_transition, on_transition))
    noises = np.stack((off_noise, off_noise, on_noise, on_noise))
    # After all steps but the last kind, the force does not continue the one before: it is zero, or
    # (second kind) begins with its stationary variance of one.
    transitions[:3, :, event] = 0.0
    noises[:3, :, event] = 0.0
    noises[:3, :, :, event] = 0.0
    noises[1, :, event, event] = 1.0
    shape = (-1, *system.generator.shape)
    return transitions.reshape(shape), noises.reshape(shape)


def initial_covariances(system: ForceStateSpace, event: int) -> tuple[FloatArray, FloatArray]:
    """Return the covariances (n, n) of the state at the first sample with the force off, and on.

    Parameters
    ----------
    system : ForceStateSpace
        The state space with the force on.
    event : int
        The index of the force of events in the state.
    """
    on = system.initial_covariance
    # a settled trial begins at rest under the force; without it that deflection is absent
    off = on.copy()
    off[:event, :event] -= np.outer(on[:event, event], on[:event, event])
    return zero_state(off, event), on


def zero_state(matrix: FloatArray, index: int) -> FloatArray:
    """Return a matrix with the row and the column of a state set to zero."""
    remaining = matrix.copy()
    remaining[index] = 0.0
    remaining[:, index] = 0.0
    return remaining


def change_samples(on: BoolArray) -> IntArray:
    """Return the samples at which a path (N,) changes: the first ones with the new value."""
    return np.flatnonzero(np.diff(on)) + 1


def change_price(sample_count: int) -> float:
    """Return the price of a change in a record of `sample_count` samples [nat].

    It is minus the log prior of a change: of its place among the samples, and that there is one.
    """
    return float(np.log(sample_count)) + CHANGE_PRICE


def price_of_changes(paths: Sequence[BoolArray]) -> float:
    """Return the price of all changes of paths [nat]."""
    return sum(len(change_samples(on)) * change_price(len(on)) for on in paths)
