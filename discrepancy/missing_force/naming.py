"""The search for what the missing force is: effects beside what is left of it, by their evidence.

A hypothesis is a set of effects with missing forces at ports beside it. Its effects act along the motion
that was, so that they and their derivatives by their unknowns are columns; a step of all unknowns, a new
motion, new columns: an iterated smoother whose fixed point is the most probable value, and whose evidence is
Laplace's.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
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

from .explained import NOTHING, Explained, seen
from .filtered import Process
from .hypotheses import Columns, log_prior, scaled, variants
from .process_search import MOST_STEPS
from .view import Column, Motion, View, combined

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
SLOPE = 0.05
"""Standard normal step of the derivatives of an effect."""


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
        terms: list[Term] = []
        values_of_terms: list[FloatArray] = []
        columns: list[Column] = []
        for term in self._terms_beside(base, effects):
            for values in variants(term):
                column = self.columns.of(base.view, base.motions, Candidate((term,)), values)
                if column is not None and any(np.any(part.readings) for part in column):
                    terms.append(term)
                    values_of_terms.append(values)
                    columns.append(column)
        starts_of_terms: dict[Term, list[tuple[float, FloatArray]]] = {}
        for number, (log_evidence, factor) in self._weighed(base, columns, terms).items():
            term = terms[number]
            start = term.sized(values_of_terms[number], factor, -LARGEST_EFFECT, LARGEST_EFFECT)
            starts_of_terms.setdefault(term, []).append((log_evidence, start))
        rows = []
        for term, starts in starts_of_terms.items():
            best = max(log_evidence for log_evidence, _ in starts)
            as_good = [start for log_evidence, start in starts if log_evidence > best - TIED]
            rows.append((best, term, as_good))
        return sorted(rows, key=lambda row: -row[0])

    def _terms_beside(self, base: Explained, effects: Iterable[Effect]) -> Iterator[Term]:
        """Yield effects at places where a hypothesis does not have them, also with a free shape."""
        in_base = {(term.effect.identifier, term.place) for term in base.candidate.terms}
        for effect in effects:
            for place in effect.places(self.problem.setting):
                if (effect.identifier, place) in in_base:
                    continue
                yield Term(effect, place)
                if effect.shape:
                    yield Term(effect, place, True)

    def _weighed(
        self, base: Explained, columns: Sequence[Column], terms: Sequence[Term]
    ) -> dict[int, tuple[float, float]]:
        """Return for columns (by number) evidence and factor, beside processes around the base's."""
        if not columns:
            return {}
        with_columns = replace(
            base.view,
            motions=base.motions,
            effects=(*base.view.effects, *columns),
            precision=(*base.view.precision, *self._prior_precisions(base, columns)),
        )
        known_count = len(base.view.precisions)
        best: dict[int, tuple[float, float]] = {}
        for size, time in product(SIZES, TIMES):
            products = with_columns.products(scaled(base.processes, size, time))
            for number, term in enumerate(terms):
                chosen = [*range(known_count), known_count + number]
                solution = products.solve(chosen, with_columns.precisions[chosen])
                factor = float(solution.mean[-1])
                is_better = number not in best or best[number][0] < solution.evidence
                may_be = np.isfinite(solution.evidence) and (factor > 0.0 or term.may_turn)
                if is_better and may_be:
                    best[number] = (solution.evidence, factor)
        return best

    def _prior_precisions(self, base: Explained, columns: Sequence[Column]) -> list[float]:
        """Return prior precisions of factors of columns: `WIDE` times what would explain all of the gap."""
        gap_of_readings = self._gap(base, None)
        gap_of_forces = self._gap(base, base.motions)
        precisions = []
        for column in columns:
            forces = [np.ravel(force) for part in column for force in part.forces.values()]
            acting = forces or [part.readings.ravel() for part in column]
            gap = gap_of_forces if forces else gap_of_readings
            size = max(float(np.sqrt(np.mean(np.concatenate(acting) ** 2))), 1e-300)
            precisions.append(min(size / (WIDE * gap), LARGEST_RATIO) ** 2)
        return precisions

    @staticmethod
    def _gap(base: Explained, motions: Sequence[Motion] | None) -> float:
        """Return the root mean square of the missing force, or of the residuals."""
        if motions is None:
            values = [trial.residual.ravel() for trial in base.view.trials]
        else:
            values = [np.ravel(force) for motion in motions for force in motion.forces.values()]
        return max(float(np.sqrt(np.mean(np.concatenate(values) ** 2))), 1e-300)

    def followed(self, base: Explained, candidate: Candidate, effect: FloatArray) -> Explained | None:
        """Return a hypothesis at its most probable values, begun beside another; None: it cannot be.

        Steps of an iterated smoother: each takes the laws along the motion that the one before has found.
        """
        processes, motions = base.processes, base.motions
        settled = False
        damping = 1.0
        last_step = np.zeros(len(effect))
        best: Explained | None = None
        for turn in range(ROUNDS):
            view = self.linear(base.view, motions, candidate, effect)
            if view is None:
                break
            most_steps = MOST_STEPS if settled or turn == ROUNDS - 1 else 0
            median = self.about(processes)
            found = seen(view, median, processes, candidate, effect, near=turn > 0, most_steps=most_steps)
            step = found.solution.mean[len(view.shared_precision) :] - effect
            found = _less_what_is_out_of_reach(found, step)
            if settled:
                return replace(found, effect=effect + step)
            # along the motion of its base, which follows the readings, a hypothesis looks better than it is
            if best is None or turn == 1 or found.log_evidence > best.log_evidence:
                best = found
            turns_back = step @ last_step < -0.5 * (last_step @ last_step)
            damping = max(0.5 * damping, LEAST_PART) if turns_back else min(1.0, 1.5 * damping)
            move = damping * np.clip(step, -LONGEST_STEP, LONGEST_STEP)
            effect = np.clip(candidate.stepped(effect, move), -LARGEST_EFFECT, LARGEST_EFFECT)
            settled = turn > 0 and _is_last_step(step, last_step)
            processes, motions = found.processes, found.motions
            last_step = step
        return best

    def linear(
        self, view: View, motions: Sequence[Motion], candidate: Candidate, effect: FloatArray
    ) -> View | None:
        """Return the view of a hypothesis, linear about values of its unknowns and along motions."""
        if not candidate.terms:
            return replace(self.columns.along(view, motions, None), effects=(), precision=())
        at_values = self.columns.of(view, motions, candidate, effect)
        if at_values is None:
            return None
        slopes = []
        for k in range(len(effect)):
            step = np.zeros(len(effect))
            step[k] = SLOPE
            ahead = self.columns.of(view, motions, candidate, effect + step)
            back = self.columns.of(view, motions, candidate, effect - step)
            if ahead is None or back is None:
                return None
            slopes.append(combined((ahead, back), (0.5 / SLOPE, -0.5 / SLOPE)))
        # linear in the unknowns: what acts where they are zero, and a column for a unit of each
        at_zero = combined((at_values, *slopes), (1.0, *-effect))
        view = self.columns.along(view, motions, at_zero)
        return replace(view, effects=tuple(slopes), precision=(1.0,) * len(effect))


def _less_what_is_out_of_reach(found: Explained, step: FloatArray) -> Explained:
    """Return a hypothesis without the evidence of values that it has not reached: they are not its own."""
    far = np.where(np.abs(step) > SETTLED, step, 0.0)
    if not far.any():
        return found
    loss = 0.5 * float(far @ np.linalg.lstsq(found.effect_covariance, far, rcond=None)[0])
    return replace(found, log_evidence=found.log_evidence - loss)


def _is_last_step(step: FloatArray, last_step: FloatArray) -> bool:
    """Return whether no step need follow; small steps that hardly become smaller have far to go."""
    size = float(np.abs(step).max(initial=0.0))
    last_size = float(np.abs(last_step).max(initial=0.0))
    becomes_smaller = size < 0.5 * last_size
    return size < SETTLED * (1.0 if becomes_smaller else 0.1)
