"""A record in which a force is on or off: the evidence of every stretch in which it is.

What the readings before a moment tell and what those after it do are joined, so that the evidence
of a stretch with any begin and any end costs no pass of the filter of its own.
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
"""ln odds against a change, beside the choice of its place."""
STARTS = 40
"""Places between which a stretch is looked for first."""
MOST_STEPS = 400_000
"""Steps of the filter for one such look, of a long record."""
PLACES = 80
"""Places of a change that are weighed at once."""
RANGE = 12.0
"""Evidence below the largest [nat] at which a place is out of the question."""

Forces = tuple[Process, Process]
"""The force of events, and what may be missing throughout."""


class Products(NamedTuple):
    """What a trial tells of the shared unknowns.

    Attributes
    ----------
    products : (..., 1 + K, 1 + K) ndarray
        Products of the whitened residual (first) and the columns of the unknowns.
    half_log_determinants : (...) ndarray
        Half the logarithm of the determinant of the readings' covariance.
    """

    products: FloatArray
    half_log_determinants: FloatArray


class EventTrials:
    """The trials in which events at a port are looked for.

    Parameters
    ----------
    view : View
        Trials, unknowns, what is known to act.
    port : int
        Number of the port.
    every : int
        The step between readings that are looked at; 1 for all.

    Attributes
    ----------
    trials : list of SeenTrial
        Stamps of what is looked at, and which readings count.
    columns : list of (K, N, C) ndarray
        Residuals and columns of all unknowns, by trial.
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
        """Return ln evidence (...) of what trials tell together."""
        products = sum(trial.products for trial in by_trial)
        halves = sum(trial.half_log_determinants for trial in by_trial)
        products, halves = without(
            np.asarray(products), np.asarray(halves), self.view.shared_precision
        )
        return np.asarray(-0.5 * products[..., 0, 0] - halves)


class SwitchedRecord:
    """A trial in which the force of events is on or off.

    Parameters
    ----------
    trials : EventTrials
        The trials in which events are looked for.
    number : int
        Number of this one.
    forces : (Process, Process)
        That of events, and what may be missing throughout.
    others : sequence of Products
        The products of the other trials, which inform on the shared unknowns.
    parts : int
        How many times smaller its steps are than those of the record.
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
        # the kind of each step is its length and one of four ways of the force
        self.length_of_sample = np.concatenate(
            (step_of_sample[:1], np.repeat(step_of_sample[1:], parts))
        )
        self.length_count = len(lengths)
        transitions, noises = switched_steps(filtered.system, event, lengths / parts)
        self.steps = FilterSteps(transitions, noises, filtered.system.output_rows, used, columns)
        off, on = begin_covariances(filtered.system, event)
        self.begun = [self.steps.begin(off), self.steps.begin(on)]

    def step_kinds(self, on: BoolArray) -> IntArray:
        """Return the kind of step (N,) that leads to each sample of a path."""
        was_on = np.r_[False, on[:-1]]
        return np.asarray((2 * was_on + on) * self.length_count + self.length_of_sample)

    def products(self, on: BoolArray) -> Products:
        """Return what the trial tells of the shared unknowns, of a path (N,)."""
        end = np.array([len(on)])
        begin = self.begun[int(on[0])]
        *_, products, halves = self.steps.before(self.step_kinds(on), 0, begin, end)
        return Products(*without(products[0], halves[0], self.local_precision))

    def evidence_by_ends(self, on: BoolArray, starts: IntArray, ends: IntArray) -> FloatArray:
        """Return ln evidence (A, B) with the force switched from each start to each end."""
        width = 1 + len(self.trials.view.shared_precision)
        products = np.zeros((len(starts), len(ends), width, width))
        halves = np.full((len(starts), len(ends)), np.inf)
        kinds = self.step_kinds(on)
        states_at_starts = self.steps.before(kinds, 0, self.begun[int(on[0])], starts)
        after_ends = self.steps.after(kinds, ends)
        transitions, noises = self._steps_back(on, ends)
        for k, start in enumerate(starts.tolist()):
            if start == 0:  # the record begins the other way
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
            # the step at the end of the stretch, behind which the path is as it was
            transition = transitions[is_later]
            covariance = transition @ covariance @ transition.mT + noises[is_later]
            arrived = (covariance, transition @ mean, *sums)
            whole = joined(arrived, [item[is_later] for item in after_ends])
            products[k, is_later], halves[k, is_later] = without(*whole, self.local_precision)
        return self.trials.evidence([Products(products, halves), *self.others])

    def _steps_back(self, on: BoolArray, ends: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return transitions and noises (B, n, n) of the steps at which a stretch ends.

        None at the last.
        """
        is_last = ends == len(on)
        sample = np.where(is_last, 0, ends)
        was_switched_on = ~on[ends - 1]
        kind = (2 * was_switched_on + on[sample]) * self.length_count + self.length_of_sample[
            sample
        ]
        nothing_moves = np.eye(len(self.steps.rows[0]))
        transitions = np.where(is_last[:, None, None], nothing_moves, self.steps.moves[kind])
        noises = np.where(is_last[:, None, None], 0.0, self.steps.noises[kind])
        return transitions, noises

    def with_best_stretch_switched(self, on: BoolArray) -> BoolArray | None:
        """Return a path with the stretch turned on or off that gains most; None where none pays."""
        count = len(on)
        size = min(max(MOST_STEPS // count, 12), STARTS, count)
        grid = np.unique(np.r_[np.linspace(0, count, size + 1).round(), changes(on)]).astype(
            np.int64
        )
        # an end where the path changes already takes that change away; ends of the record are free
        prices = change_price(count) * np.where(np.isin(grid, changes(on)), -1.0, 1.0)
        prices[[0, -1]] = 0.0
        gains = (
            self.evidence_by_ends(on, grid[:-1], grid[1:]) - prices[:-1, None] - prices[None, 1:]
        )
        start, end = np.unravel_index(np.argmax(gains), gains.shape)
        if gains[start, end] <= self.trials.evidence([self.products(on), *self.others]):
            return None
        switched = on.copy()
        switched[grid[start] : grid[end + 1]] ^= True
        return switched

    def with_changes_placed(self, on: BoolArray) -> BoolArray:
        """Return a path with its changes where they are most probable beside each other."""
        for _ in range(3):
            previous = on.copy()
            for number, old in enumerate(changes(on)):
                places, log_evidence = self.evidence_by_place(on, number)
                new = places[np.argmax(log_evidence)]
                on = on.copy()
                on[min(old, new) : max(old, new)] = on[old] if new < old else on[old - 1]
            if np.array_equal(on, previous):
                break
        return on

    def evidence_by_place(self, on: BoolArray, number: int) -> tuple[IntArray, FloatArray]:
        """Return places of a change, densest where it is probable, and ln evidence of each."""
        before, change, after = np.r_[0, changes(on), len(on)][number : number + 3]
        # from the change before on the path is as behind the change, which is put off to each place
        at_once = on.copy()
        at_once[before:after] = on[change]
        places = np.zeros(0, dtype=np.int64)
        log_evidence = np.zeros(0)
        first, last = before + 1, after - 1
        while True:
            grid = np.linspace(first, last, PLACES).round().astype(np.int64)
            new = np.setdiff1d(grid, places)
            if not len(new):
                return places, log_evidence
            of_new = self.evidence_by_ends(at_once, np.array([before]), new)[0]
            places = np.r_[places, new]
            log_evidence = np.r_[log_evidence, of_new]
            order = np.argsort(places)
            places, log_evidence = places[order], log_evidence[order]
            probable = np.flatnonzero(log_evidence >= log_evidence.max() - RANGE)
            first = places[max(probable[0] - 1, 0)]
            last = places[min(probable[-1] + 1, len(places) - 1)]


def switched_steps(
    system: ForceStateSpace, event: int, lengths: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return transitions and noises (4 J, n, n) of steps in which a force is switched.

    First all lengths with the force off, then beginning at the end of the step, then ending there,
    then on.
    """
    on_transition, on_noise = discretised(system.generator, system.intensity, lengths)
    off_transition, off_noise = discretised(
        without_state(system.generator, event), without_state(system.intensity, event), lengths
    )
    transitions = np.stack((off_transition, off_transition, on_transition, on_transition))
    noises = np.stack((off_noise, off_noise, on_noise, on_noise))
    # behind all steps but those with the force on throughout it is another force than before
    transitions[:3, :, event] = 0.0
    noises[:3, :, event] = 0.0
    noises[:3, :, :, event] = 0.0
    noises[1, :, event, event] = 1.0
    shape = (-1, *system.generator.shape)
    return transitions.reshape(shape), noises.reshape(shape)


def begin_covariances(system: ForceStateSpace, event: int) -> tuple[FloatArray, FloatArray]:
    """Return the start covariances (n, n) of the state with the event's force off, and on."""
    on = system.start_covariance
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
    """Return the samples from which on a force acts that did not, or does not any more."""
    return np.flatnonzero(np.diff(on)) + 1


def change_price(count: int) -> float:
    """Return what a change costs in a record of `count` samples [nat].

    Its place, and that it is there.
    """
    return float(np.log(count)) + CHANGE_PRICE


def price_of_changes(paths: Sequence[BoolArray]) -> float:
    """Return what all changes of paths cost [nat]."""
    return sum(len(changes(on)) * change_price(len(on)) for on in paths)
