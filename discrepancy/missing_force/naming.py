"""The search for what the missing force is: effects beside what remains of it, by their evidence.

A hypothesis is a set of effects with missing forces at ports beside it. Its effects act along the
motion that was, so that they and their derivatives by their parameters are columns of a linear
model. A step of all parameters gives a new motion, and that new columns: an iterated smoother,
whose fixed point is the most probable value, with Laplace's evidence.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect
from discrepancy.fits.candidate import (
    Candidate,
    CandidateKey,
    EffectTerm,
    with_step,
)
from discrepancy.fits.fitting import LARGEST_EFFECT

from .at_ports import MissingForces
from .explained import ForceHypothesis, with_most_probable_forces
from .hypotheses import log_prior, scaled, trial_values
from .process_search import MOST_STEPS
from .view import EffectColumn, TrialMotion, View, combined

WIDE = 3.0
"""Prior deviation of the magnitude of an effect: so many times what would explain all of the
gap."""
SIZES = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
"""Sizes of the missing forces beside which effects are screened, over the most probable ones
without effect."""
TIMES = (0.5, 1.5)
"""Correlation times of these forces, over the same."""
LARGEST_RATIO = 1e100
"""Ratio of an effect to a gap of zero."""
WIDTHS = (10, 4, 4)
"""Effects that are followed after the screen: alone, beside one other, beside two."""
TIED = 1.0
"""Evidence by which values of an effect may be below the best ones to be followed, too [nat]."""
BEAM = 3
"""Sets to which one more effect is added."""
ROUNDS = 8
"""Largest number of steps of the parameters of an effect."""
LONGEST_STEP = 1.5
"""Longest step of these parameters."""
SETTLED = 0.05
"""Step after which no other follows."""
LEAST_PART = 0.2
"""Least part of a step that is taken where steps turn back."""
SLOPE = 0.05
"""Standard normal step of the derivatives of an effect."""


class ScreenedEffect(NamedTuple):
    """An effect that may stand beside a hypothesis.

    Attributes
    ----------
    log_evidence : float
        The largest evidence that it may have [nat].
    term : EffectTerm
        The effect at its place.
    starts : list of (E,) array
        The scaled parameters from which it is followed.
    """

    log_evidence: float
    term: EffectTerm
    starts: list[FloatArray]


class _WeighedColumn(NamedTuple):
    """The evidence of a column [nat], and the factor on it that is most probable."""

    log_evidence: float
    factor: float


class ForceSearch(MissingForces):
    """The search for effects that explain the missing forces of a problem."""

    # ---------------------------------------------------------------- what the force is

    def name(
        self,
        effects: Sequence[Effect],
        on_progress: Callable[[str], None] = lambda message: None,
    ) -> list[ForceHypothesis]:
        """Return hypotheses on the missing force, the most probable first, by a beam search.

        Each effect is tried alone, with its own shape and with a free one; then the best of these
        with one more effect, while that makes a more probable set.

        Parameters
        ----------
        effects : sequence of Effect
            The effects.
        on_progress : callable
            Takes a line that says what is compared, and how much is still to come.
        """
        count = len(effects)
        hypotheses: dict[CandidateKey, ForceHypothesis] = {(): self.whole}
        beam = [self.whole]
        for width in WIDTHS:
            best = self._ranked(hypotheses, count)[0]
            longer: dict[CandidateKey, ForceHypothesis] = {}
            for base in beam:
                self._follow_beside(base, effects, width, longer, on_progress)
            hypotheses |= longer
            ranked = self._ranked(longer, count)
            if not ranked or self.score(ranked[0], count) <= self.score(best, count):
                break
            beam = ranked[:BEAM]
        return self._ranked(hypotheses, count)

    def _follow_beside(
        self,
        base: ForceHypothesis,
        effects: Sequence[Effect],
        width: int,
        longer: dict[CandidateKey, ForceHypothesis],
        on_progress: Callable[[str], None],
    ) -> None:
        """Follow the most promising effects beside a base, and add them to the longer hypotheses.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis that an effect is added to.
        effects : sequence of Effect
            The effects.
        width : int
            The number of effects that are followed.
        longer : dict of CandidateKey to ForceHypothesis
            The hypotheses with one more effect, which is extended.
        on_progress : callable
            Takes a line that says what is compared.
        """
        beside = f" beside {base.candidate.description}" if base.candidate.terms else ""
        on_progress(f"comparing all effects{beside} with the missing force")
        promising = self.screened(base, effects)[:width]
        for number, screened_effect in enumerate(promising):
            candidate = base.candidate.with_term(screened_effect.term)
            if candidate.key in longer:
                continue
            remaining = len(promising) - number - 1
            description = candidate.description
            on_progress(f"following {description} along the missing force, {remaining} more")
            followed = []
            for start in screened_effect.starts:
                effect = np.concatenate((base.effect, start))
                hypothesis = self.followed(base, candidate, effect)
                if hypothesis is not None:
                    followed.append(hypothesis)
            if followed:
                best = max(followed, key=lambda hypothesis: hypothesis.log_evidence)
                longer[candidate.key] = best

    def score(self, hypothesis: ForceHypothesis, count: int) -> float:
        """Return ln (evidence times prior) of a hypothesis among `count` effects [nat]."""
        prior = log_prior(hypothesis.candidate, count, self.problem.setting)
        return hypothesis.log_evidence + prior

    def _ranked(
        self, hypotheses: Mapping[CandidateKey, ForceHypothesis], count: int
    ) -> list[ForceHypothesis]:
        """Return hypotheses among `count` effects, the most probable first."""
        return sorted(hypotheses.values(), key=lambda hypothesis: -self.score(hypothesis, count))

    # ---------------------------------------------------------------- screen of one more effect

    def screened(self, base: ForceHypothesis, effects: Iterable[Effect]) -> list[ScreenedEffect]:
        """Return effects that may stand beside a hypothesis, the most promising first.

        Each effect is tried at each of its places, and followed from all values that do as well
        within `TIED`: in proportion to its size a dead zone does the same whatever its stiffness,
        and ends elsewhere from each.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis that an effect is added to.
        effects : iterable of Effect
            The effects.
        """
        terms: list[EffectTerm] = []
        values_of_columns: list[FloatArray] = []
        columns: list[EffectColumn] = []
        for term in self._terms_beside(base, effects):
            for values in trial_values(term):
                candidate = Candidate((term,))
                column = self.columns.of(base.view, base.motions, candidate, values)
                if column is not None and any(np.any(part.readings) for part in column):
                    terms.append(term)
                    values_of_columns.append(values)
                    columns.append(column)
        starts_of_terms: dict[EffectTerm, list[tuple[float, FloatArray]]] = {}
        for number, (log_evidence, factor) in self._weighed(base, columns, terms).items():
            term = terms[number]
            values = values_of_columns[number]
            start = term.rescaled(values, factor, -LARGEST_EFFECT, LARGEST_EFFECT)
            starts_of_terms.setdefault(term, []).append((log_evidence, start))
        screened_effects = []
        for term, starts in starts_of_terms.items():
            best = max(log_evidence for log_evidence, _ in starts)
            tied = [start for log_evidence, start in starts if log_evidence > best - TIED]
            screened_effects.append(ScreenedEffect(best, term, tied))
        return sorted(screened_effects, key=lambda effect: -effect.log_evidence)

    def _terms_beside(
        self, base: ForceHypothesis, effects: Iterable[Effect]
    ) -> Iterator[EffectTerm]:
        """Yield effects at places where a hypothesis does not have them, also with a free shape."""
        in_base = {(term.effect.identifier, term.place) for term in base.candidate.terms}
        for effect in effects:
            for place in effect.places(self.problem.setting):
                if (effect.identifier, place) in in_base:
                    continue
                yield EffectTerm(effect, place)
                if effect.shape:
                    yield EffectTerm(effect, place, free_shape=True)

    def _weighed(
        self,
        base: ForceHypothesis,
        columns: Sequence[EffectColumn],
        terms: Sequence[EffectTerm],
    ) -> dict[int, _WeighedColumn]:
        """Return the best evidence and factor of each column, beside several missing forces.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis that an effect is added to.
        columns : sequence of EffectColumn
            The columns, each of an effect at one value of its parameters.
        terms : sequence of EffectTerm
            The effect of each column.

        Returns
        -------
        dict of int to _WeighedColumn
            The evidence and factor by the number of the column.
        """
        if not columns:
            return {}
        with_columns = replace(
            base.view,
            motions=base.motions,
            effects=(*base.view.effects, *columns),
            precision=(*base.view.precision, *self._prior_precisions(base, columns)),
        )
        known_count = len(base.view.precisions)
        best: dict[int, _WeighedColumn] = {}
        for size, time in product(SIZES, TIMES):
            products = with_columns.products(scaled(base.processes, size, time))
            for number, term in enumerate(terms):
                chosen = [*range(known_count), known_count + number]
                solution = products.solve(chosen, with_columns.precisions[chosen])
                factor = float(solution.mean[-1])
                is_better = number not in best or best[number].log_evidence < solution.evidence
                has_possible_sign = factor > 0.0 or term.may_be_negative
                if is_better and np.isfinite(solution.evidence) and has_possible_sign:
                    best[number] = _WeighedColumn(solution.evidence, factor)
        return best

    def _prior_precisions(
        self, base: ForceHypothesis, columns: Sequence[EffectColumn]
    ) -> list[float]:
        """Return the prior precisions of factors of columns.

        The prior deviation of a factor is `WIDE` times what would explain all of the gap.
        """
        gap_of_readings = _rms([trial.residual for trial in base.view.trials])
        gap_of_forces = _rms([force for motion in base.motions for force in motion.forces.values()])
        precisions = []
        for column in columns:
            forces = [force for part in column for force in part.forces.values()]
            if forces:
                size = _rms(forces)
                gap = gap_of_forces
            else:
                size = _rms([part.readings for part in column])
                gap = gap_of_readings
            precisions.append(min(size / (WIDE * gap), LARGEST_RATIO) ** 2)
        return precisions

    # ---------------------------------------------------------------- most probable values

    def followed(
        self, base: ForceHypothesis, candidate: Candidate, effect: FloatArray
    ) -> ForceHypothesis | None:
        """Return a hypothesis at its most probable values, by steps of an iterated smoother.

        Each step takes the laws along the motion that the last one has found.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis whose motion and missing forces the first step takes.
        candidate : Candidate
            The effects.
        effect : (E,) array
            The scaled effect parameters to begin with.

        Returns
        -------
        ForceHypothesis or None
            None if the effects cannot act along the motion.
        """
        processes = base.processes
        motions = base.motions
        is_settled = False
        damping = 1.0
        last_step = np.zeros(len(effect))
        best: ForceHypothesis | None = None
        for number in range(ROUNDS):
            view = self.linear(base.view, motions, candidate, effect)
            if view is None:
                break
            is_last = is_settled or number == ROUNDS - 1
            hypothesis = with_most_probable_forces(
                view,
                self.prior_processes(processes),
                processes,
                candidate,
                effect,
                near=number > 0,
                most_steps=MOST_STEPS if is_last else 0,
            )
            step = hypothesis.solution.mean[len(view.shared_precision) :] - effect
            hypothesis = _without_unreached_evidence(hypothesis, step)
            if is_settled:
                return replace(hypothesis, effect=effect + step)
            # the first motion is that of the base and follows the readings: there a hypothesis
            # looks better than it is
            is_better = best is None or hypothesis.log_evidence > best.log_evidence
            if is_better or number == 1:
                best = hypothesis
            turns_back = step @ last_step < -0.5 * (last_step @ last_step)
            damping = max(0.5 * damping, LEAST_PART) if turns_back else min(1.0, 1.5 * damping)
            move = damping * np.clip(step, -LONGEST_STEP, LONGEST_STEP)
            effect = np.clip(candidate.stepped(effect, move), -LARGEST_EFFECT, LARGEST_EFFECT)
            is_settled = number > 0 and _is_last_step(step, last_step)
            processes = hypothesis.processes
            motions = hypothesis.motions
            last_step = step
        return best

    def linear(
        self,
        view: View,
        motions: Sequence[TrialMotion],
        candidate: Candidate,
        effect: FloatArray,
    ) -> View | None:
        """Return the view of a hypothesis, linear about its values and along motions.

        Parameters
        ----------
        view : View
            The trials.
        motions : sequence of TrialMotion
            The motion of each trial along which the effects act.
        candidate : Candidate
            The effects.
        effect : (E,) array
            The scaled effect parameters.

        Returns
        -------
        View or None
            None if the effects cannot act along the motions.
        """
        if not candidate.terms:
            return replace(self.columns.along(view, motions, None), effects=(), precision=())
        at_values = self.columns.of(view, motions, candidate, effect)
        if at_values is None:
            return None
        slopes = []
        for k in range(len(effect)):
            above = self.columns.of(view, motions, candidate, with_step(effect, k, SLOPE))
            below = self.columns.of(view, motions, candidate, with_step(effect, k, -SLOPE))
            if above is None or below is None:
                return None
            slopes.append(combined((above, below), (0.5 / SLOPE, -0.5 / SLOPE)))
        # a column for each parameter, and one for what acts where all of them are zero
        at_zero = combined((at_values, *slopes), (1.0, *-effect))
        view = self.columns.along(view, motions, at_zero)
        return replace(view, effects=tuple(slopes), precision=(1.0,) * len(effect))


def _rms(series: Iterable[FloatArray]) -> float:
    """Return the root mean square of several arrays together, at least 1e-300."""
    values = np.concatenate([np.ravel(entries) for entries in series])
    return max(float(np.sqrt(np.mean(values**2))), 1e-300)


def _without_unreached_evidence(hypothesis: ForceHypothesis, step: FloatArray) -> ForceHypothesis:
    """Return a hypothesis without the evidence of values that its parameters have not reached.

    The solution is that of the linear model after a step (E,); its evidence is not that of the
    hypothesis where the step is long.
    """
    unreached = np.where(np.abs(step) > SETTLED, step, 0.0)
    if not unreached.any():
        return hypothesis
    weighted = np.linalg.lstsq(hypothesis.effect_covariance, unreached, rcond=None)[0]
    loss = 0.5 * float(unreached @ weighted)
    return replace(hypothesis, log_evidence=hypothesis.log_evidence - loss)


def _is_last_step(step: FloatArray, last_step: FloatArray) -> bool:
    """Return whether no step need follow; small steps that hardly become smaller have far to go."""
    size = float(np.abs(step).max(initial=0.0))
    last_size = float(np.abs(last_step).max(initial=0.0))
    becomes_smaller = size < 0.5 * last_size
    return size < SETTLED * (1.0 if becomes_smaller else 0.1)
