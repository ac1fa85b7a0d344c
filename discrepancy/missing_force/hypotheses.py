"""Sets of effects as hypotheses: their prior, values at which they are tried, and their columns.

A law is taken along a motion that is known: what it would have been, had the port moved so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from math import comb, log

import numpy as np
from scipy.special import erf

from discrepancy.campaign.records import FloatArray, TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, Point, Term
from discrepancy.fits.gates import SHAPE_GAIN
from discrepancy.fits.problem import Problem
from discrepancy.search_settings import SEARCH
from discrepancy.system.response import Response
from discrepancy.system.sensing import observe_response
from fe.compilation import compiled, law_functions
from fe.runtime.arrays import FIRST_ELEMENT, POSITION
from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws import LAWS, advance, force_and_slope
from fe.runtime.laws.interface import PARAMETERS, PortForce
from fe.runtime.laws.speed import steady_force
from fe.runtime.patch import SENSORS, LoggerClock, ModelPatch
from fe.runtime.sensors import clock_of

from .filtered import Process
from .process_search import Processes
from .trial import Part, SeenTrial, seen_trial
from .view import Column, Motion, View, combined

LEVELS = (-1.3, -0.4, 0.4, 1.3)
"""Standard normal values at which the numbers of an effect that are no magnitudes are tried."""
MOST_VARIANTS = 16
AWAY = 0.5
"""Standard normal value of a magnitude with which an effect is tried, its size being free."""


def sees_forces(problem: Problem) -> bool:
    """Whether missing forces can be seen: in trials in motion, of a model that tells how its ports move."""
    model = problem.model
    moving = any(data.trial.is_dynamic for data in problem.trials)
    return moving and model.shows_ports and bool(model.ports)


def log_prior(candidate: Candidate, count: int, setting: Setting) -> float:
    """Return ln of the prior probability of a candidate at its places, `count` effects being looked for.

    A free shape has to gain what the shape gate asks for.
    """
    terms = candidate.terms
    if not terms:
        return log(SEARCH.prior_none)
    places = sum(log(len(term.effect.places(setting))) for term in terms)
    free = sum(SHAPE_GAIN for term in terms if term.free_shape)
    share = (1.0 - SEARCH.prior_none) * SEARCH.set_shares[len(terms) - 1]
    return log(share / comb(max(count, len(terms)), len(terms))) - places - free


def variants(term: Term) -> list[FloatArray]:
    """Return standard normal values (E,) of a term's parameters at which it is tried."""
    free = [number for number, item in enumerate(term.parameters) if not item.magnitude]
    levels = [LEVELS if len(free) < 2 else LEVELS[::3]] * len(free)
    found = []
    for chosen in list(product(*levels))[:MOST_VARIANTS]:
        values = np.full(len(term.parameters), AWAY)  # the middle of a prior of both signs is no effect
        values[free] = chosen
        found.append(values)
    return found


def scaled(processes: Processes, size: float, time: float) -> Mapping[int, Process]:
    """Return processes of other sizes and times."""
    return {port: replace(one, size=one.size * size, time=one.time * time) for port, one in processes.items()}


WIDER = 10.0
"""By which a deviation of the speed is too small: that of the process does not know of steps."""
SLOW = 0.02
"""Share of the usual speed below which a body creeps before it slides, and no law of the speed holds."""


def along(
    number: int, of_speed: bool, law: FloatArray, x: FloatArray, v: FloatArray, memory: FloatArray,
    found: FloatArray,
) -> None:  # fmt: skip
    """Fill `found` (F,) with the force of a law at positions and speeds (F,) that follow one another."""
    for k in range(len(x)):
        if of_speed:
            found[k] = steady_force(law, x[k], v[k])
        else:
            advance(number, law, memory, x[k])
            memory[POSITION] = x[k]
            found[k] = force_and_slope(number, law, memory, x[k], 1.0)[0]


@cache
def _compiled_along() -> Callable[..., None]:
    return compiled(along, law_functions())


def law_course(
    law: PortForce,
    time: FloatArray,
    position: FloatArray,
    speed: FloatArray,
    doubt: float = 0.0,
    holding: FloatArray | float = 0.0,
) -> FloatArray:
    """Return the force (F,) of a law along a motion (F,) of its port; zero outside of its windows.

    Where a speed may be zero by its deviation `doubt`, a law of the speed that is a force at rest, too, is
    what holds the port, `holding` (F,), up to its own largest.
    """
    values, found = law.parameter_row, np.zeros(len(position))
    memory = np.zeros(FIRST_ELEMENT + max(1, len(values) - PARAMETERS))
    motion = (np.ascontiguousarray(position), np.ascontiguousarray(speed))
    _compiled_along()(LAWS.index(type(law)), type(law).depends_on_speed, values, *motion, memory, found)
    if type(law).depends_on_speed and doubt > 0.0:
        slow = max(WIDER * doubt, SLOW * float(np.sqrt(np.mean(speed**2))))
        moves = erf(np.abs(speed) / (np.sqrt(2.0) * slow))
        found = moves * found + (1.0 - moves) * np.clip(holding, -np.abs(found), np.abs(found))
    return found * law.acts_at(time)


class Columns:
    """Makes columns of effects along the motion of a view.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    numbers : sequence of int
        Which trials of the problem the view's are.
    point : Point
        About which the view's trials are linear.
    own : ModelPatch
        Laws that the model has itself.
    """

    def __init__(self, problem: Problem, numbers: Sequence[int], point: Point, own: ModelPatch) -> None:
        self.problem, self.numbers, self.point, self.own = problem, numbers, point, own

    def bare(self) -> View:
        """Return the trials as they are seen about the point."""
        trials = [seen_trial(self.problem, number, self.point) for number in self.numbers]
        return View(trials, self.problem.shared.precision)

    def along(self, view: View, motions: Sequence[Motion], known: Column | None = None) -> View:
        """Return a view along motions, the model's own laws included, with what else is known."""
        own = self.of_patch(view, motions, self.own) if len(self.own) else None
        return replace(view, motions=motions, own=own, known=known)

    def of(
        self, view: View, motions: Sequence[Motion], candidate: Candidate, values: FloatArray
    ) -> Column | None:
        """Return what a candidate does at standard normal values (E,) of its unknowns; None: it cannot be."""
        found = []
        for term, part in candidate.parts(values):
            try:
                patch = term.patch(self.problem.setting, part)
            except DiscrepancyError:
                return None
            column = self.of_patch(view, motions, patch, term.effect.acts_on)
            if column is None:
                return None
            found.append(column)
        return combined(found, [1.0] * len(found))

    def of_patch(
        self,
        view: View,
        motions: Sequence[Motion],
        patch: ModelPatch,
        acts_on: frozenset[TrialKind] = frozenset(TrialKind),
    ) -> Column | None:
        """Return what a patch does, None where it cannot be."""
        try:
            parts = [
                self.part(trial, motion, number, patch.in_trial(trial.name), acts_on)
                for trial, motion, number in zip(view.trials, motions, self.numbers, strict=True)
            ]
        except (DiscrepancyError, InvalidPatchError):
            return None
        return parts if all(np.all(np.isfinite(part.readings)) for part in parts) else None

    def part(
        self, trial: SeenTrial, motion: Motion, number: int, patch: ModelPatch, acts_on: frozenset[TrialKind]
    ) -> Part:
        """Return what a patch does in a trial along a motion."""
        kind = self.problem.trials[number].trial.kind
        if kind not in acts_on or not len(patch):
            return Part(np.zeros_like(trial.residual))
        sensors = patch.of(*SENSORS)
        forces = patch.of(PortForce)
        if len(forces):
            return self._forced(trial, motion, forces)
        if len(sensors) < len(patch) or len(sensors.of(LoggerClock)):
            return Part(self._changed(number, patch, trial))
        return Part(self._shown(trial, motion, number, sensors))

    def _forced(self, trial: SeenTrial, motion: Motion, laws: ModelPatch) -> Part:
        """Return what forces at ports do."""
        added = np.zeros_like(motion.added)
        readings = np.zeros_like(trial.residual)
        forces: dict[int, FloatArray] = {}
        at_ports = self.problem.model.at_ports(laws)
        for law in (item for item in at_ports if isinstance(item, PortForce)):
            port = trial.system.ports.index(law.port)
            position, speed = motion.positions[:, port], motion.speeds[:, port]
            doubt, holding = motion.deviations.get(port, (0.0, 0.0))[1], motion.forces.get(port, 0.0)
            course = law_course(law, trial.fine_time, position, speed, doubt, holding)
            state = trial.pushed(port, course)
            added += state
            readings += trial.readings(state, {port: course})
            forces[port] = forces.get(port, 0.0) + course
        return Part(readings, added, forces)

    def _changed(self, number: int, patch: ModelPatch, trial: SeenTrial) -> FloatArray:
        """Return what a patch changes in the model's own response."""
        shared, local = self.point.shared, self.point.local[number]
        with_it, _ = self.problem.response(number, shared, local, patch)
        without, _ = self.problem.response(number, shared, local, ModelPatch())
        gains = 1.0 + self.problem.shared.gains(shared, self.problem.trials[number].trial.channels)
        return trial.over_noise((with_it - without) * gains)

    def _shown(self, trial: SeenTrial, motion: Motion, number: int, sensors: ModelPatch) -> FloatArray:
        """Return what sensors make of what is explained: a force of any size is shown by any gain."""
        problem, data = self.problem, self.problem.trials[number]
        shared, local = self.point.shared, self.point.local[number]
        values, rates = problem.response(number, shared, local, ModelPatch())
        gains = 1.0 + problem.shared.gains(shared, data.trial.channels)
        true = values + trial.readings(motion.explained, motion.laws) * trial.deviation / gains
        slope = None
        if rates is not None:
            pace = motion.explained @ trial.system.generator.T
            for port, force in motion.laws.items():
                pace = pace - np.outer(force, trial.system.actions[port])
            slope = rates + (pace @ trial.system.outputs.T)[:: trial.parts] / gains
        conditions = data.unknowns.conditions(data.trial, problem.shared.parameters(shared), local)
        with_it = observe_response(problem.campaign, data.trial, sensors, conditions, Response(true, slope))
        changed = with_it.values - true
        rate, zero = clock_of(sensors)
        if slope is not None:
            changed += slope * (rate * (trial.time - trial.time[0]) + zero)[:, None]
        return trial.over_noise(changed * gains)
