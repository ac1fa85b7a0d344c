"""Effects of the catalogue as columns: what a unit of one does along the motion that was."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import TrialKind
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.linearisation import Point
from discrepancy.fits.problem import Problem
from discrepancy.models.sensing import observe_response
from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import SENSORS, LoggerClock, ModelPatch

from .law_courses import law_course
from .trial import SeenTrial
from .view import Column, Motion, Part, View

FloatArray = NDArray[np.float64]

LEVELS = (-1.3, -0.4, 0.4, 1.3)
"""Standard normal values at which the numbers of an effect that are no magnitudes are tried."""
MOST_VARIANTS = 16
AWAY = 0.5
"""Standard normal value of a magnitude, in whose units its column is."""


def variants(term: Term) -> list[FloatArray]:
    """Return standard normal values (E,) of a term's parameters at which it is tried."""
    free = [number for number, item in enumerate(term.effect.parameters) if not item.magnitude]
    levels = [LEVELS if len(free) < 2 else LEVELS[::3]] * len(free)
    found = []
    for chosen in list(product(*levels))[:MOST_VARIANTS]:
        values = term.start()
        values[: len(term.effect.parameters)] = (
            AWAY  # the middle of a prior of both signs is no effect at all
        )
        values[free] = chosen
        found.append(values)
    return found


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
    """

    def __init__(self, problem: Problem, numbers: Sequence[int], point: Point) -> None:
        self.problem, self.numbers, self.point = problem, numbers, point

    def of(self, view: View, motions: Sequence[Motion], term: Term, values: FloatArray) -> Column | None:
        """Return the column of a term at values of its parameters, in units of what they say; None: nothing.

        Its prior precision is zero; it is for the caller to set.
        """
        try:
            patch = Candidate((term,)).patch(self.problem.setting, values)
        except DiscrepancyError:
            return None
        found = self.of_patch(view, motions, patch, term.effect.acts_on)
        magnitudes = [item.prior for item in term.effect.parameters if item.magnitude]
        both = any(prior.low < 0.0 for prior in magnitudes)
        return None if found is None else replace(found, both_signs=both)

    def of_patch(
        self,
        view: View,
        motions: Sequence[Motion],
        patch: ModelPatch,
        acts_on: frozenset[TrialKind] = frozenset(TrialKind),
    ) -> Column | None:
        """Return the column of a patch, None where it does nothing or cannot be."""
        try:
            parts = [
                self._part(view, trial, motion, number, patch.in_trial(trial.name), acts_on)
                for trial, motion, number in zip(view.trials, motions, self.numbers, strict=True)
            ]
        except (DiscrepancyError, InvalidPatchError):
            return None
        finite = all(np.all(np.isfinite(part.readings)) for part in parts)
        return Column(parts, 0.0) if finite and any(np.any(part.readings) for part in parts) else None

    def _part(
        self,
        view: View,
        trial: SeenTrial,
        motion: Motion,
        number: int,
        patch: ModelPatch,
        acts_on: frozenset[TrialKind],
    ) -> Part:
        kind = self.problem.trials[number].trial.kind
        if kind not in acts_on or not len(patch):
            return Part(np.zeros_like(trial.residual))
        sensors = patch.of(*SENSORS)
        forces = ModelPatch(tuple(item for item in patch if isinstance(item, PortForce)))
        if len(forces):
            return self._forced(trial, motion, forces)
        if len(sensors) < len(patch) or len(sensors.of(LoggerClock)):
            return Part(self._changed(number, patch, trial))
        return Part(self._shown(view, trial, motion, number, sensors))

    def _forced(self, trial: SeenTrial, motion: Motion, laws: ModelPatch) -> Part:
        """Return what forces at ports do."""
        names = trial.system.ports
        added = np.zeros_like(motion.added)
        readings = np.zeros_like(trial.residual)
        forces: dict[int, FloatArray] = {}
        time = trial.fine_time
        model = self.problem.model.inner
        for law in model.at_ports(laws) if hasattr(model, "at_ports") else laws:
            assert isinstance(law, PortForce)  # `_part` took these alone
            port = names.index(law.port)
            position, speed = trial.port_motion(port, motion.added)
            course = law_course(law, time, position, speed)
            state = trial.pushed(port, course)
            added += state
            readings += trial.readings(state, port, course)
            forces[port] = forces.get(port, 0.0) + course
        return Part(readings, added, forces)

    def _changed(self, number: int, patch: ModelPatch, trial: SeenTrial) -> FloatArray:
        """Return what a patch changes in the model's own response."""
        shared, local = self.point.shared, self.point.local[number]
        with_it, _ = self.problem.response(number, shared, local, patch)
        without, _ = self.problem.response(number, shared, local, ModelPatch())
        gains = 1.0 + self.problem.shared.gains(shared, self.problem.trials[number].trial.channels)
        return trial.over_noise((with_it - without) * gains)

    def _shown(
        self, view: View, trial: SeenTrial, motion: Motion, number: int, sensors: ModelPatch
    ) -> FloatArray:
        """Return what sensors make of the motion that was."""
        problem, data = self.problem, self.problem.trials[number]
        shared, local = self.point.shared, self.point.local[number]
        values, rates = problem.response(number, shared, local, ModelPatch())
        added = trial.readings(motion.added, view.port, motion.force) * trial.deviation
        true = values + added
        slope = np.gradient(true, trial.time, axis=0) if rates is not None else None
        conditions = data.unknowns.conditions(data.trial, problem.shared.parameters(shared), local)
        with_it = observe_response(problem.campaign, data.trial, sensors, conditions, true, slope)
        return trial.over_noise(with_it.values - true)


def with_prior(column: Column, deviation: float) -> Column:
    """Return a column whose unknown has a prior deviation."""
    return replace(column, precision=1.0 / deviation**2)
