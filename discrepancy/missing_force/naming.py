"""The search for what the missing force is: effects beside what is left of it, by their evidence.

A hypothesis is a set of effects with missing forces at ports beside it. Its effects act along the motion
that was, so that they and their derivatives by their unknowns are columns; a step of all unknowns, a new
motion, new columns: an iterated smoother whose fixed point is the most probable value, and whose evidence is
Laplace's.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect
from discrepancy.fits.candidate import PARAMETER_STEP, Candidate, Key, Point, Term
from discrepancy.fits.fitting import LARGEST_EFFECT
from discrepancy.fits.problem import Problem
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch

from .filtered import Process, Solution
from .hypotheses import Columns, log_prior, scaled, variants
from .process_search import MOST_STEPS, Processes
from .view import Column, Motion, View, combined

NOTHING, NO_VALUES = Candidate(), np.zeros(0)
WIDE = 3.0
"""Prior deviation of that size: so many times what would explain all of the gap."""
SIZES = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
TIMES = (0.5, 1.5)
"""Processes, over the most probable one without effect, beside which all effects are tried."""
LARGEST_RATIO = 1e100
"""Of an effect to a gap that is nought."""
MOST_PORTS = 4
"""Ports at which forces may be missing at once."""
BESIDE = 0.1
"""Size of a force beside the largest one, over its size alone, to begin with."""
WIDTHS = (10, 4, 4)
"""Effects that are followed after the screen: alone, beside one other, beside two."""
TIED = 1.0
"""Evidence [nat] by which values of an effect may differ to be begun with, too."""
BEAM = 3
"""Sets to which one more effect is added."""
ROUNDS = 8
LONGEST_STEP = 1.5
SETTLED = 0.05
"""Steps of the unknowns of an effect: how many, the longest, and that after which no other follows."""
LEAST_PART = 0.2
"""Least part of a step that is taken where steps turn back."""
ALONG = 0.5
"""Share of what is left of an unknown law that may be hidden along a named one: without it intervals beside a
weaker law hold 4 of 9 hidden values."""
SLOPE = 0.05
"""Standard normal step of the derivatives of an effect."""


@dataclass(frozen=True, eq=False)
class Explained:
    """A hypothesis.

    Attributes
    ----------
    candidate : Candidate
        Its effects; none: missing forces alone.
    effect : (E,) ndarray
        Their unknowns, standard normal before.
    processes : mapping of int to Process
        Missing forces beside them, by the numbers of their ports.
    log_evidence : float
        [nat], with the prior of the processes.
    view : View
        Trials and columns.
    solution : Solution
        Shared unknowns first, those of the effects last.
    local : sequence of (L,) ndarray
        Unknowns of the trials.
    motions : sequence of Motion
        By trial.
    """

    candidate: Candidate
    effect: FloatArray
    processes: Processes
    log_evidence: float
    view: View
    solution: Solution
    local: Sequence[FloatArray]
    motions: Sequence[Motion]

    @property
    def effect_covariance(self) -> FloatArray:
        """Of the effects' unknowns (E, E), beside the missing force as it is."""
        at = len(self.view.shared_precision)
        return self.solution.covariance[at:, at:]

    @cached_property
    def shared(self) -> FloatArray:
        """Shared unknowns (K,) at the values of the effects, which may not have settled."""
        at = len(self.view.shared_precision)
        mean, covariance = self.solution.mean, self.solution.covariance
        if not len(self.effect):
            return mean[:at]
        step = np.linalg.solve(covariance[at:, at:], self.effect - mean[at:])
        return np.asarray(mean[:at] + covariance[:at, at:] @ step)

    @cached_property
    def covariance(self) -> FloatArray:
        """Of all unknowns, shared ones first, wide enough for what is left to lie along the laws in part.

        The process is a force in time that has nothing to do with the motion. What is left of another law
        has: as much of it as is seen beside the columns may be hidden along them.
        """
        at, covariance = len(self.view.shared_precision), self.solution.covariance
        if not len(self.effect):
            return covariance
        wider = np.zeros((len(self.effect),) * 2)
        for port, process in self.processes.items():
            rows = []
            for number, trial in enumerate(self.view.trials):
                nothing = np.zeros(len(trial.fine_time))
                forces = [item[number].forces.get(port, nothing) for item in self.view.effects]
                rows.append(np.array([np.asarray(force)[:: trial.parts] for force in forces]))
            columns = np.concatenate(rows, axis=-1)  # the forces (E, T) at the samples of all trials
            acting = np.flatnonzero(columns.any(axis=1))
            if len(acting):
                size = (ALONG * process.size) ** 2
                gram = columns[acting] @ columns[acting].T / columns.shape[1]
                wider[np.ix_(acting, acting)] += size * np.linalg.inv(gram + size * np.eye(len(acting)))
        follow = np.linalg.lstsq(covariance[at:, at:], covariance[at:], rcond=None)[0].T
        return np.asarray(covariance + follow @ wider @ follow.T)


class ForceSearch:
    """The missing forces of a problem, and effects that may be they.

    Parameters
    ----------
    problem : Problem
        With dynamic trials, of a model that has ports.

    Attributes
    ----------
    at : dict of str to Explained
        The missing force at each port: first along the model's own motion, for the initial states; then along
        the motion that was, with the parameters about where they are and the laws that the model has itself.
    """

    def __init__(self, problem: Problem) -> None:
        linear, self.laws = problem.model.apart()
        trials = tuple(data.trial for data in problem.trials)
        self.model = problem.model
        self.problem = problem.with_trials(trials, linear)
        self.numbers = [k for k, data in enumerate(problem.trials) if data.trial.is_dynamic]
        self.ports = tuple(linear.ports)
        self.at: dict[str, Explained] = {}
        self.point = self.problem.start(NOTHING)
        for turn in range(2):
            bare = self._view()
            for port, name in enumerate(self.ports):
                view = self.columns.along(bare, bare.smoothed(self.at[name].processes)[2]) if turn else bare
                first = self.about((port,))
                self.at[name] = seen(view, first, self.at[name].processes if turn else first)
            if not turn:
                self.point = self._point(self.best())

    # ---------------------------------------------------------------- where

    @cached_property
    def whole(self) -> Explained:
        """Missing forces at all ports at once, or at those that matter most if they are many."""
        best = self.best()
        ranked = sorted(self.at.values(), key=lambda item: -item.log_evidence)[:MOST_PORTS]
        if len(ranked) == 1:
            return best
        begin = dict(best.processes)
        for item in ranked[1:]:
            begin |= scaled(item.processes, BESIDE, 1.0)
        view = best.view
        for near in (False, True):
            found = seen(view, self.about(begin), begin, near=near)
            view = self.columns.along(view, found.motions)
            begin = dict(found.processes)
        return found

    def best(self) -> Explained:
        """Return the missing force of the largest evidence."""
        return max(self.at.values(), key=lambda item: item.log_evidence)

    def about(self, ports: Iterable[int]) -> dict[int, Process]:
        """Return missing forces at ports as they may be before any reading."""
        found = {}
        for port in ports:
            scale = self.problem.setting.scales.ports[self.ports[port]]
            pace = scale.angular_frequency or 1.0 / self.problem.setting.scales.duration
            found[port] = Process(0.05 * scale.stiffness * scale.displacement, 1.0 / pace)
        return found

    def own_laws(self, shared: FloatArray) -> ModelPatch:
        """Return the laws that the model has itself, at values (K,) of the shared unknowns."""
        model = self.model
        return model.own_laws(self.problem.shared.parameters(shared)) + model.patch.of(PortForce)

    def whole_size(self, port: int) -> float:
        """Return the deviation of the missing force at a port beside no effect [N or N m]."""
        beside = self.whole.processes.get(port)
        return self.about((port,))[port].size if beside is None else beside.size

    def _view(self) -> View:
        """Return the trials as they are seen about the point, where columns are from then on, too."""
        self.columns = Columns(self.problem, self.numbers, self.point, self.laws)
        return self.columns.bare()

    def rough(self, port: str) -> Explained:
        """Return the missing force at a port as one that may jump, linear about the motion that it gives."""
        found = self.at[port]
        for _ in range(2):
            self.point = self._point(found)
            view = self._view()
            for _ in range(2):
                view = self.columns.along(view, view.smoothed(found.processes)[2])
            begin = {at: replace(one, rough=True) for at, one in found.processes.items()}
            found = seen(view, self.about(begin), begin)
        return found

    def whole_point(self, found: Explained) -> Point:
        """Return the point of a hypothesis, from which a fit may begin."""
        point = self._point(found)
        return Point(found.shared.copy(), point.local, found.effect.copy())

    def _point(self, found: Explained) -> Point:
        local = [np.zeros(data.unknowns.size) for data in self.problem.trials]
        for number, values in zip(self.numbers, found.local, strict=True):
            local[number] = values
        low, high = self.problem.shared.ends  # nothing would follow from a step beyond them
        low, high = np.maximum(low + PARAMETER_STEP, -2.0), np.minimum(high - PARAMETER_STEP, 2.0)
        return Point(np.clip(found.shared, low, high), tuple(local), np.zeros(0))

    # ---------------------------------------------------------------- what

    def name(
        self, effects: Sequence[Effect], tell: Callable[[str], None] = lambda words: None
    ) -> list[Explained]:
        """Return hypotheses, the most probable first: sets of effects that were found one after another.

        Each effect alone, with its own shape and with a free one; the best of these with one more effect,
        while that makes a more probable set.
        """
        found: dict[Key, Explained] = {(): self.whole}
        beam = [self.whole]
        for width in WIDTHS:
            best = self._ranked(found, len(effects))[0]
            longer: dict[Key, Explained] = {}
            for base in beam:
                beside = f" beside {base.candidate.words}" if base.candidate.terms else ""
                tell(f"comparing all effects{beside} with the missing force")
                promising = self.screened(base, effects)[:width]
                for number, (_, term, starts) in enumerate(promising):
                    candidate = base.candidate.plus(term)
                    if candidate.key in longer:
                        continue
                    remaining = len(promising) - number - 1
                    tell(f"following {candidate.words} along the missing force, {remaining} more")
                    begun = (np.concatenate((base.effect, start)) for start in starts)
                    ends = [one for at in begun if (one := self.followed(base, candidate, at)) is not None]
                    if ends:
                        longer[candidate.key] = max(ends, key=lambda one: one.log_evidence)
            found |= longer
            ranked = self._ranked(longer, len(effects))
            if not ranked or self.score(ranked[0], len(effects)) <= self.score(best, len(effects)):
                break
            beam = ranked[:BEAM]
        return self._ranked(found, len(effects))

    def score(self, found: Explained, count: int) -> float:
        """Return ln (evidence times prior) of a hypothesis [nat], `count` effects being looked for."""
        return found.log_evidence + log_prior(found.candidate, count, self.problem.setting)

    def _ranked(self, found: Mapping[Key, Explained], count: int) -> list[Explained]:
        return sorted(found.values(), key=lambda item: -self.score(item, count))

    def screened(
        self, base: Explained, effects: Iterable[Effect]
    ) -> list[tuple[float, Term, list[FloatArray]]]:
        """Return effects with the evidence that they may have beside a hypothesis, and values to begin with.

        Best first, each at each of its places, from all values that do as well within `TIED`: in proportion
        to its size a dead zone does the same whatever its stiffness, and ends elsewhere from each.
        """
        tried: list[tuple[Term, FloatArray]] = []
        columns: list[Column] = []
        there = {(term.effect.identifier, term.place) for term in base.candidate.terms}
        for effect in effects:
            for place in effect.places(self.problem.setting):
                if (effect.identifier, place) in there:
                    continue
                for term in dict.fromkeys((Term(effect, place), Term(effect, place, bool(effect.shape)))):
                    for values in variants(term):
                        column = self.columns.of(base.view, base.motions, Candidate((term,)), values)
                        if column is not None and any(np.any(part.readings) for part in column):
                            tried.append((term, values))
                            columns.append(column)
        found: dict[Term, list[tuple[float, FloatArray]]] = {}
        for number, (value, size) in self._weighed(base, columns, [term for term, _ in tried]).items():
            term, values = tried[number]
            start = term.sized(values, size, -LARGEST_EFFECT, LARGEST_EFFECT)
            found.setdefault(term, []).append((value, start))
        rows = []
        for term, starts in found.items():
            top = max(value for value, _ in starts)
            rows.append((top, term, [start for value, start in starts if value > top - TIED]))
        return sorted(rows, key=lambda row: -row[0])

    def _weighed(
        self, base: Explained, columns: Sequence[Column], terms: Sequence[Term]
    ) -> dict[int, tuple[float, float]]:
        """Return for columns (by number) evidence and factor, beside processes around the base's."""
        if not columns:
            return {}
        gap = [self._gap(base, None), self._gap(base, base.motions)]
        precision = []
        for column in columns:
            forces = [np.ravel(force) for part in column for force in part.forces.values()]
            sizes = forces or [part.readings.ravel() for part in column]
            own = float(np.sqrt(np.mean(np.concatenate(sizes) ** 2)))
            precision.append(min(max(own, 1e-300) / (WIDE * gap[bool(forces)]), LARGEST_RATIO) ** 2)
        whole = replace(
            base.view, motions=base.motions, effects=(*base.view.effects, *columns),
            precision=(*base.view.precision, *precision),
        )  # fmt: skip
        count = len(base.view.precisions)
        found: dict[int, tuple[float, float]] = {}
        for size, time in product(SIZES, TIMES):
            products = whole.products(scaled(base.processes, size, time))
            for number, term in enumerate(terms):
                chosen = [*range(count), count + number]
                solution = products.solve(chosen, whole.precisions[chosen])
                factor = float(solution.mean[-1])
                better = number not in found or found[number][0] < solution.evidence
                if better and np.isfinite(solution.evidence) and (factor > 0.0 or term.may_turn):
                    found[number] = (solution.evidence, factor)
        return found

    @staticmethod
    def _gap(base: Explained, motions: Sequence[Motion] | None) -> float:
        """Return the root mean square of the missing force, or of the residuals."""
        if motions is None:
            values = [trial.residual.ravel() for trial in base.view.trials]
        else:
            values = [np.ravel(force) for motion in motions for force in motion.forces.values()]
        return max(float(np.sqrt(np.mean(np.concatenate(values) ** 2))), 1e-300)

    def followed(self, base: Explained, candidate: Candidate, effect: FloatArray) -> Explained | None:
        """Return a hypothesis at its most probable values, begun beside another; None: it cannot be."""
        processes, motions, share, settled = base.processes, base.motions, 1.0, False
        best: Explained | None = None
        before = np.zeros(len(effect))
        for turn in range(ROUNDS):
            view = self.linear(base.view, motions, candidate, effect)
            if view is None:
                break
            most = MOST_STEPS if settled or turn == ROUNDS - 1 else 0
            about = self.about(processes)
            found = seen(view, about, processes, candidate, effect, near=turn > 0, most=most)
            processes = found.processes
            step = found.solution.mean[len(view.shared_precision) :] - effect
            far = np.where(np.abs(step) > SETTLED, step, 0.0)
            if far.any():  # a value that it cannot reach is not its own
                loss = 0.5 * float(far @ np.linalg.lstsq(found.effect_covariance, far, rcond=None)[0])
                found = replace(found, log_evidence=found.log_evidence - loss)
            if settled:
                return replace(found, effect=effect + step)
            # along the motion of its base, which follows the readings, a hypothesis looks better than it is
            if best is None or turn == 1 or found.log_evidence > best.log_evidence:
                best = found
            turns_back = step @ before < -0.5 * (before @ before)
            share = max(0.5 * share, LEAST_PART) if turns_back else min(1.0, 1.5 * share)
            move = share * np.clip(step, -LONGEST_STEP, LONGEST_STEP)
            effect = np.clip(candidate.stepped(effect, move), -LARGEST_EFFECT, LARGEST_EFFECT)
            size, last = (float(np.abs(one).max(initial=0.0)) for one in (step, before))
            # small steps that hardly become smaller have far to go
            settled = turn > 0 and size < SETTLED * (1.0 if size < 0.5 * last else 0.1)
            motions, before = found.motions, step
        return best

    def linear(
        self, view: View, motions: Sequence[Motion], candidate: Candidate, effect: FloatArray
    ) -> View | None:
        """Return the view of a hypothesis, linear about values of its unknowns and along motions."""
        columns = self.columns
        at = columns.of(view, motions, candidate, effect) if candidate.terms else ()
        if at is None:
            return None
        slopes = []
        for k in range(len(effect)):
            step = np.zeros(len(effect))
            step[k] = SLOPE
            ends = [columns.of(view, motions, candidate, effect + sign * step) for sign in (1.0, -1.0)]
            if ends[0] is None or ends[1] is None:
                return None
            slopes.append(combined((ends[0], ends[1]), (0.5 / SLOPE, -0.5 / SLOPE)))
        known = combined((at, *slopes), (1.0, *-effect)) if at else None
        view = columns.along(view, motions, known)
        return replace(view, effects=tuple(slopes), precision=(1.0,) * len(effect))


def seen(
    view: View,
    about: Processes,
    begin: Processes,
    candidate: Candidate = NOTHING,
    effect: FloatArray = NO_VALUES,
    *,
    near: bool = False,
    most: int = MOST_STEPS,
) -> Explained:
    """Return a hypothesis beside the most probable missing forces, about some and begun at others."""
    processes, evidence = view.most_probable(about, begin, near=near, most_steps=most)
    return Explained(candidate, effect, processes, evidence, view, *view.smoothed(processes))
