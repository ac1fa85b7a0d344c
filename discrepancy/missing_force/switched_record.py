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

from .filtered import ForceFilter, ForceStateSpace, Process, without
from .kalman import FilterSteps, discretised, joined
from .view import View

CHANGE_PRICE = 4.0
"""Log odds against a change of a path, besides the prior of its place [nat]."""
STARTS = 40
"""Largest number of places in a grid between which a stretch is looked for."""
MOST_STEPS = 400_000
"""Largest number of steps of the filter for one such grid; a long record has fewer places."""
PLACES = 80
"""Number of places of a change that are compared at once."""
RANGE = 12.0
"""Log evidence below the largest [nat] from which on a place is taken as impossible."""

Forces = tuple[Process, Process]
"""The force of events, and the force that may be missing throughout."""


class Products(NamedTuple):
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
    view : View
        The trials, and the columns of all unknowns and of the forces known to act.
    port : int
        The number of the port.
    every : int
        The step between samples that are used; 1 uses all.

    Attributes
    ----------
    trials : list of SeenTrial
        The trials with the samples that are used.
    columns : list of (1 + K + L, N, C) ndarray
        The residual and the columns of all unknowns, by trial.
    """

    def __init__(self, view: View, port: int, *, every: int = 1) -> None:
        self.view = view
        self.port = port
        self.trials = [
            replace(trial, time=trial.time[::every], used=trial.used[::every])
            for trial in view.trials
        ]
        self.columns = [rows[:, ::every] for rows in view.rows]

    def evidence(self, by_trial: Sequence[Products]) -> FloatArray:
        """Return the log evidence (...) of all trials [nat], given the products of each."""
        products = sum(trial.products for trial in by_trial)
        halves = sum(trial.half_log_determinants for trial in by_trial)
        products, halves = without(
            np.asarray(products), np.asarray(halves), self.view.shared_precision
        )
        return np.asarray(-0.5 * products[..., 0, 0] - halves)


class SwitchedRecord:
    """A trial in which the force of events is on or off, with its filters.

    Parameters
    ----------
    trials : EventTrials
        The trials in which events are looked for.
    number : int
        The index of this trial in them.
    forces : (Process, Process)
        The force of events, and the force that may be missing throughout.
    others : sequence of Products
        The products of the other trials, which also depend on the shared unknowns.
    parts : int
        The number of steps into which each interval between samples is divided, so that a change
        can lie between samples.
    """

    def __init__(
        self,
        trials: EventTrials,
        number: int,
        forces: Forces,
        others: Sequence[Products] = (),
        parts: int = 1,
    ) -> None:
        self.trials = trials
        self.others = others
        trial = trials.trials[number]
        self.local_precision = trial.local_precision
        filtered = ForceFilter(trial, [(trials.port, force) for force in forces])
        event = len(trial.system.generator)  # index of the event's force in the state
        lengths, step_of_sample = trial.steps
        used = np.zeros(((len(trial.time) - 1) * parts + 1, trial.used.shape[1]), dtype=bool)
        used[::parts] = trial.used
        columns = np.zeros((*used.shape, len(trials.columns[number])))
        columns[::parts] = np.moveaxis(trials.columns[number] * filtered.white, 0, -1)
        # a step is of one of 4 J kinds: its force is off, begins, ends or is on (see
        # `switched_steps`), and it has one of J lengths
        self.length_of_sample = np.concatenate(
            (step_of_sample[:1], np.repeat(step_of_sample[1:], parts))
        )
        self.length_count = len(lengths)
        transitions, noises = switched_steps(filtered.system, event, lengths / parts)
        self.steps = FilterSteps(transitions, noises, filtered.system.output_rows, used, columns)
        off, on = begin_covariances(filtered.system, event)
        self.begun = [self.steps.begin(off), self.steps.begin(on)]

    def step_kinds(self, on: BoolArray) -> IntArray:
        """Return the kind (N,) of the step that leads to each sample of a path (N,).

        It is the index in the matrices of `switched_steps`.
        """
        was_on = np.r_[False, on[:-1]]
        return np.asarray((2 * was_on + on) * self.length_count + self.length_of_sample)

    def products(self, on: BoolArray) -> Products:
        """Return the information of the trial on the shared unknowns, given a path (N,)."""
        end = np.array([len(on)])
        begin = self.begun[int(on[0])]
        *_, products, half_log_determinants = self.steps.before(self.step_kinds(on), 0, begin, end)
        return Products(*without(products[0], half_log_determinants[0], self.local_precision))

    def evidence_by_ends(self, on: BoolArray, starts: IntArray, ends: IntArray) -> FloatArray:
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
        product_count = 1 + len(self.trials.view.shared_precision)
        products = np.zeros((len(starts), len(ends), product_count, product_count))
        # an infinite determinant is an evidence of -inf, which stays if an end is not after the
        # start
        half_log_determinants = np.full((len(starts), len(ends)), np.inf)
        kinds = self.step_kinds(on)
        states_at_starts = self.steps.before(kinds, 0, self.begun[int(on[0])], starts)
        after_ends = self.steps.after(kinds, ends)
        transitions, noises = self._steps_back(on, ends)
        for k, start in enumerate(starts.tolist()):
            # a stretch from the first sample on: the force begins off instead of on, or on instead
            # of off
            if start == 0:
                state = self.begun[int(not on[0])]
            else:
                covariance, mean, known_products, known_half = states_at_starts
                state = (covariance[k], mean[k], known_products[k], known_half[k])
            is_later = ends > start
            switched = on.copy()
            switched[start:] ^= True
            covariance, mean, *sums = self.steps.before(
                self.step_kinds(switched), start, state, ends[is_later]
            )
            # the step into the sample `end`, from which on the path is not inverted any more
            transition = transitions[is_later]
            covariance = transition @ covariance @ transition.mT + noises[is_later]
            state_at_ends = (covariance, transition @ mean, *sums)
            products_of_trial = joined(state_at_ends, [array[is_later] for array in after_ends])
            products[k, is_later], half_log_determinants[k, is_later] = without(
                *products_of_trial, self.local_precision
            )
        return self.trials.evidence([Products(products, half_log_determinants), *self.others])

    def _steps_back(self, on: BoolArray, ends: IntArray) -> tuple[FloatArray, FloatArray]:
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
        identity = np.eye(len(self.steps.rows[0]))
        transitions = np.where(is_last[:, None, None], identity, self.steps.moves[kind])
        noises = np.where(is_last[:, None, None], 0.0, self.steps.noises[kind])
        return transitions, noises

    def with_best_stretch_switched(self, on: BoolArray) -> BoolArray | None:
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
        interval_count = min(max(MOST_STEPS // sample_count, 12), STARTS, sample_count)
        edges = np.unique(
            np.r_[np.linspace(0, sample_count, interval_count + 1).round(), changes(on)]
        ).astype(np.int64)
        # The price of a path counts its changes. A stretch that begins or ends at an existing
        # change removes it (-1); elsewhere it adds one (+1); at the ends of the record there is no
        # change.
        prices = change_price(sample_count) * np.where(np.isin(edges, changes(on)), -1.0, 1.0)
        prices[[0, -1]] = 0.0
        # score [k, m]: the stretch from edge k to edge m + 1; -inf if it is empty
        scores = (
            self.evidence_by_ends(on, edges[:-1], edges[1:]) - prices[:-1, None] - prices[None, 1:]
        )
        first_edge, last_interval = np.unravel_index(np.argmax(scores), scores.shape)
        if scores[first_edge, last_interval] <= self.trials.evidence(
            [self.products(on), *self.others]
        ):
            return None
        switched = on.copy()
        switched[edges[first_edge] : edges[last_interval + 1]] ^= True
        return switched

    def with_changes_placed(self, on: BoolArray) -> BoolArray:
        """Return a path (N,) whose changes are moved to their most probable places.

        They are moved one after the other. This is repeated, three times at most, since the best
        place of one change depends on the others.
        """
        for _ in range(3):
            previous = on.copy()
            for number, old in enumerate(changes(on)):
                places, log_evidence = self.evidence_by_place(on, number)
                new = places[np.argmax(log_evidence)]
                on = on.copy()
                # between old and new place: an earlier change extends the state after it, a later
                # one extends the state before it
                on[min(old, new) : max(old, new)] = on[old] if new < old else on[old - 1]
            if np.array_equal(on, previous):
                break
        return on

    def evidence_by_place(self, on: BoolArray, number: int) -> tuple[IntArray, FloatArray]:
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
        previous_change, change, next_change = np.r_[0, changes(on), len(on)][number : number + 3]
        # the path whose change is as early as the previous one; inverting it from there to a place
        # delays the change to that place
        earliest_path = on.copy()
        earliest_path[previous_change:next_change] = on[change]
        places = np.zeros(0, dtype=np.int64)
        log_evidence = np.zeros(0)
        first_place, last_place = previous_change + 1, next_change - 1
        while True:
            candidate_places = np.linspace(first_place, last_place, PLACES).round().astype(np.int64)
            new_places = np.setdiff1d(candidate_places, places)
            if not len(new_places):
                return places, log_evidence
            evidence_of_new = self.evidence_by_ends(
                earliest_path, np.array([previous_change]), new_places
            )[0]
            places = np.r_[places, new_places]
            log_evidence = np.r_[log_evidence, evidence_of_new]
            order = np.argsort(places)
            places, log_evidence = places[order], log_evidence[order]
            probable = np.flatnonzero(log_evidence >= log_evidence.max() - RANGE)
            first_place = places[max(probable[0] - 1, 0)]
            last_place = places[min(probable[-1] + 1, len(places) - 1)]


def switched_steps(
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
    on_transition, on_noise = discretised(system.generator, system.intensity, lengths)
    off_transition, off_noise = discretised(
        without_state(system.generator, event), without_state(system.intensity, event), lengths
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


def begin_covariances(system: ForceStateSpace, event: int) -> tuple[FloatArray, FloatArray]:
    """Return the covariances (n, n) of the state at the first sample with the force off, and on.

    Parameters
    ----------
    system : ForceStateSpace
        The state space with the force on.
    event : int
        The index of the force of events in the state.
    """
    on = system.start_covariance
    # a settled trial begins at rest under the force; without it that deflection is absent
    off = on.copy()
    off[:event, :event] -= np.outer(on[:event, event], on[:event, event])
    return without_state(off, event), on


def without_state(matrix: FloatArray, index: int) -> FloatArray:
    """Return a matrix with the row and the column of a state set to zero."""
    remaining = matrix.copy()
    remaining[index] = 0.0
    remaining[:, index] = 0.0
    return remaining


def changes(on: BoolArray) -> IntArray:
    """Return the samples at which a path (N,) changes: the first ones with the new value."""
    return np.flatnonzero(np.diff(on)) + 1


def change_price(count: int) -> float:
    """Return the price of a change in a record of `count` samples [nat].

    It is minus the log prior of a change: of its place among the samples, and that there is one.
    """
    return float(np.log(count)) + CHANGE_PRICE


def price_of_changes(paths: Sequence[BoolArray]) -> float:
    """Return the price of all changes of paths [nat]."""
    return sum(len(changes(on)) * change_price(len(on)) for on in paths)
