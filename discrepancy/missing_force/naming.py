"""The search for what the missing force is: effects as columns beside a process, by their evidence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from discrepancy.catalogue.entry import Effect
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.linearisation import Point
from discrepancy.fits.problem import Problem
from fe.runtime.patch import ModelPatch

from .columns import Columns, variants, with_prior
from .filtered import Process
from .regression import Solution
from .trial import seen_trial
from .view import SHARES, Column, Motion, View

FloatArray = NDArray[np.float64]

WIDE = 3.0
"""Prior deviation of an effect: so many times what would explain all of the gap."""
SIZES = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
TIMES = (0.5, 1.5)
"""Processes, over the most probable one without effect, beside which all effects are weighed."""
KEPT = 8
"""Effects that are followed along the motion that they give themselves."""
ROUNDS = 2


@dataclass(frozen=True, eq=False)
class Seen:
    """The missing force at a port.

    Attributes
    ----------
    view : View
        Port, trials, effects in it.
    process : Process
        Most probable.
    evidence : float
        [nat], with the prior of the process.
    solution : Solution
        Unknowns beside it.
    local : sequence of (L,) ndarray
        Unknowns of the trials.
    motions : sequence of Motion
        Motion and missing force, the effects' own included.
    """

    view: View
    process: Process
    evidence: float
    solution: Solution
    local: Sequence[FloatArray]
    motions: Sequence[Motion]

    @property
    def left(self) -> list[FloatArray]:
        """Missing force (F,) of each trial beside the effects."""
        count = len(self.view.shared_precision)
        found = []
        for number, motion in enumerate(self.motions):
            force = motion.force
            for mean, item in zip(self.solution.mean[count:], self.view.effects, strict=True):
                force = force - mean * item.parts[number].forces.get(self.view.port, 0.0)
            found.append(np.asarray(force))
        return found


def seen(view: View, about: Process, shares: Sequence[float] = SHARES) -> Seen:
    """Return the missing force at a view's port."""
    process, evidence = view.most_probable(about, shares)
    return Seen(view, process, evidence, *view.smoothed(process))


@dataclass(frozen=True, eq=False)
class Explained:
    """An effect beside what is left of the missing force."""

    term: Term
    values: FloatArray
    size: float
    deviation: float
    seen: Seen

    @property
    def evidence(self) -> float:
        """[nat]."""
        return self.seen.evidence


class ForceSearch:
    """The missing force of a problem, at every port, and effects that may be it.

    Parameters
    ----------
    problem : Problem
        With dynamic trials, of a model that has ports.
    """

    def __init__(self, problem: Problem) -> None:
        model = problem.model.inner
        self.laws: ModelPatch
        linear, self.laws = model.apart() if hasattr(model, "apart") else (model, ModelPatch())
        trials = tuple(data.trial for data in problem.trials)
        self.problem = Problem(problem.campaign, linear, problem.setting, trials, like=problem)
        self.numbers = [k for k, data in enumerate(problem.trials) if data.trial.is_dynamic]
        self.at: dict[str, Seen] = {}
        self.point = self.problem.start(Candidate())

    def locate(self, about: Point | None = None) -> dict[str, Seen]:
        """Return the missing force at each port.

        First along the model's own motion, for the initial states; then along the motion that was, with the
        parameters about where they are and the laws that the model has itself. `about`: where these are, if a
        fit tells it; what a law alone shows (the speed at which a body began to fall) it alone knows.
        """
        problem = self.problem
        if about is not None:
            self.point = Point(about.shared, about.local, np.zeros(0))
        for turn in range(2):
            trials = [seen_trial(problem, number, self.point) for number in self.numbers]
            columns = Columns(problem, self.numbers, self.point)
            for port, name in enumerate(problem.model.ports()):
                view = View(trials, port, problem.shared.precision)
                if not turn:
                    self.at[name] = seen(view, self._about(name), SHARES[:1])
                    continue
                before = self.at[name]
                found = view.smoothed(before.process)
                own = columns.of_patch(view, found[2], self.laws) if len(self.laws) else None
                view = replace(view, motions=found[2], certain=() if own is None else (own,))
                self.at[name] = seen(view, before.process)
            if not turn and about is None:
                self.point = self._point(self.best())
        return self.at

    def rough(self, port: str) -> Seen:
        """Return the missing force at a port as one that may jump, linear about the motion that it gives."""
        found = self.at[port]
        for _ in range(2):
            self.point = self._point(found)
            trials = [seen_trial(self.problem, number, self.point) for number in self.numbers]
            columns = Columns(self.problem, self.numbers, self.point)
            view = View(trials, found.view.port, self.problem.shared.precision)
            for _ in range(2):
                motions = view.smoothed(found.process)[2]
                own = columns.of_patch(view, motions, self.laws) if len(self.laws) else None
                view = replace(view, motions=motions, certain=() if own is None else (own,))
            found = seen(view, replace(found.process, rough=True))
        return found

    def best(self) -> Seen:
        """Return the view of the largest evidence."""
        return max(self.at.values(), key=lambda item: item.evidence)

    def _about(self, port: str) -> Process:
        scale = self.problem.setting.scales.ports[port]
        pace = scale.angular_frequency or 1.0 / self.problem.setting.scales.duration
        return Process(0.05 * scale.stiffness * scale.displacement, 1.0 / pace)

    def _point(self, found: Seen) -> Point:
        local = [np.zeros(data.unknowns.size) for data in self.problem.trials]
        for number, values in zip(self.numbers, found.local, strict=True):
            local[number] = values
        shared = found.solution.mean[: self.problem.shared.size]
        return Point(np.clip(shared, -2.0, 2.0), tuple(local), np.zeros(0))

    def name(self, effects: Sequence[Effect]) -> list[Explained]:
        """Return effects with what they leave, best first."""
        columns = Columns(self.problem, self.numbers, self.point)
        found: list[tuple[float, Seen, Term, FloatArray, Column]] = []
        base = self.best()
        ports = list(self.problem.model.ports())
        for port, at in self.at.items():
            candidates = []
            for effect in effects:
                for place in effect.places(self.problem.setting):
                    if (place in ports and place != port) or (place not in ports and at is not base):
                        continue
                    term = Term(effect, place)
                    for values in variants(term):
                        column = columns.of(at.view, at.motions, term, values)
                        if column is not None:
                            candidates.append((term, values, self._scaled(column, at)))
            for value, number in self._weighed(at, [item[2] for item in candidates]):
                term, values, column = candidates[number]
                found.append((value, at, term, values, column))
        best: dict[tuple[str, str], tuple[float, Seen, Term, FloatArray, Column]] = {}
        for item in sorted(found, key=lambda item: item[0]):
            best[item[2].label, item[2].place] = item
        ranked = sorted(best.values(), key=lambda item: -item[0])[:KEPT]
        return sorted(
            (self._followed(columns, *item[1:]) for item in ranked), key=lambda item: -item.evidence
        )

    @staticmethod
    def _scaled(column: Column, at: Seen) -> Column:
        """Return a column with its prior: what would be all of the gap, three times."""
        forces = [part.forces.get(at.view.port) for part in column.parts]
        if any(force is not None for force in forces):
            own = np.sqrt(np.mean(np.concatenate([f for f in forces if f is not None]) ** 2))
            gap = np.sqrt(np.mean(np.concatenate([m.force for m in at.motions]) ** 2))
        else:
            own = np.sqrt(np.mean(np.concatenate([p.readings.ravel() for p in column.parts]) ** 2))
            gap = np.sqrt(np.mean(np.concatenate([t.residual.ravel() for t in at.view.trials]) ** 2))
        return with_prior(column, WIDE * float(gap) / max(float(own), 1e-300))

    @staticmethod
    def _weighed(at: Seen, columns: Sequence[Column]) -> list[tuple[float, int]]:
        """Return evidence and number of each column, beside processes around the most probable one."""
        if not columns:
            return []
        view = replace(at.view, motions=at.motions)
        whole = replace(view, effects=(*view.effects, *columns))
        count = len(view.precision)
        best = np.full(len(columns), -np.inf)
        for size in SIZES:
            for time in TIMES:
                process = replace(at.process, size=at.process.size * size, time=at.process.time * time)
                products = whole.products(process)
                for number in range(len(columns)):
                    chosen = [*range(count), count + number]
                    solution = products.solve(chosen, whole.precision[chosen])
                    if solution.mean[-1] > 0.0 or columns[number].both_signs:
                        best[number] = max(best[number], solution.evidence)
        return [(float(value), number) for number, value in enumerate(best) if np.isfinite(value)]

    def _followed(
        self, columns: Columns, at: Seen, term: Term, values: FloatArray, column: Column
    ) -> Explained:
        motions = at.motions
        about = at.process
        for _ in range(ROUNDS):
            view = replace(at.view, motions=motions, effects=(*at.view.effects, column))
            found = seen(view, about)
            motions = found.motions
            again = columns.of(view, motions, term, values)
            if again is None:
                break
            column = replace(again, precision=column.precision)
        mean = float(found.solution.mean[-1])
        return Explained(term, values, mean, float(np.sqrt(found.solution.covariance[-1, -1])), found)
