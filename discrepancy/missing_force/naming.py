"""The search for the effects that explain a missing force, compared by their evidence.

A hypothesis is a set of effects, together with a remaining missing force at ports. Its effects act
along the estimated motion, so that the effects and their derivatives by their parameters are
columns of a linear model. A step of all parameters gives a new motion, and the new motion new
columns. This is an iterated smoother; its fixed point is the most probable value, and its evidence
is Laplace's approximation.
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
from reporting.arrays import LEAST_DIVISOR

from .at_ports import MissingForces
from .explained import ForceHypothesis, fit_missing_forces
from .hypotheses import log_prior, scale_processes, values_to_try
from .linear_trials import EffectColumn, LinearTrials, TrialMotion, sum_of_columns
from .process_search import MOST_STEPS

FACTOR_DEVIATION = 3.0
"""Prior standard deviation of the factor on an effect in the screening, over the factor with
which the effect would be as large as the gap. It is wide, so that the screening prefers no size."""
SCREENED_DEVIATIONS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.003)
"""Standard deviations of the missing forces with which effects are screened, over the most
probable ones without effects: an effect leaves only a part of the force."""
SCREENED_TIMES = (0.5, 1.5)
"""Correlation times of these forces, over the most probable ones without effects."""
LARGEST_RATIO = 1e100
"""Ratio of an effect to the gap that stands for infinity, if the gap is zero."""
FOLLOWED_COUNTS = (10, 4, 4)
"""Numbers of effects that are fitted after the screening: as single effects, as second ones and as
third ones of a set."""
TIED_EVIDENCE = 1.0
"""Difference to the log evidence of the best values of an effect up to which fits begin at its
other values, too [nat]."""
BEAM_WIDTH = 3
"""Number of most probable sets to which one more effect is added."""
MOST_ITERATIONS = 8
"""Largest number of steps of the parameters of an effect."""
LONGEST_STEP = 1.5
"""Longest step of a parameter, in prior standard deviations."""
CONVERGED_STEP = 0.05
"""Step of a parameter below which the iteration ends, in prior standard deviations."""
LEAST_DAMPING = 0.2
"""Least fraction of a step that is taken. The fraction is reduced while successive steps have
opposite directions."""
HALF_DIFFERENCE = 0.05
"""Half the difference of a standard normal parameter in derivatives of an effect."""


class ScreenedEffect(NamedTuple):
    """An effect that may be added to a hypothesis, with the result of its screening.

    Attributes
    ----------
    log_evidence : float
        The largest log evidence of the screening, at the best of the tried values [nat].
    term : EffectTerm
        The effect at its place.
    starts : list of (E,) array
        The scaled parameters from which fits of the effect begin.
    """

    log_evidence: float
    term: EffectTerm
    starts: list[FloatArray]


class _TriedEffect(NamedTuple):
    """An effect at its place, the scaled values (E,) at which it is tried, and its column there."""

    term: EffectTerm
    values: FloatArray
    column: EffectColumn


class _WeighedColumn(NamedTuple):
    """The log evidence of a column [nat], and its most probable factor."""

    log_evidence: float
    factor: float


class _WeighedStart(NamedTuple):
    """The log evidence of an effect [nat], and the scaled parameters (E,) at which a fit begins."""

    log_evidence: float
    start: FloatArray


class ForceSearch(MissingForces):
    """The search for the effects that explain the missing forces of a problem."""

    # ---------------------------------------------------------------- ranking of hypotheses

    def rank_hypotheses(
        self,
        effects: Sequence[Effect],
        on_progress: Callable[[str], None] = lambda message: None,
        largest_set: int | None = None,
    ) -> list[ForceHypothesis]:
        """Return hypotheses on the missing force, the most probable first, by a beam search.

        Each effect is tried alone, with its own shape and with a free one. The best sets are then
        extended by one more effect, as long as that gives a more probable set.

        Parameters
        ----------
        effects : sequence of Effect
            The effects that may be missing in the model.
        on_progress : callable
            The function that receives a line for the progress display: the comparison that runs,
            and how many remain.
        largest_set : int, optional
            The largest number of effects in a set; by default that of `FOLLOWED_COUNTS`.
        """
        effect_count = len(effects)
        hypotheses: dict[CandidateKey, ForceHypothesis] = {(): self.hypothesis_of_all_ports}
        beam = [self.hypothesis_of_all_ports]
        for followed_count in FOLLOWED_COUNTS[:largest_set]:
            best_hypothesis = self._sort_by_score(hypotheses, effect_count)[0]
            extended_hypotheses: dict[CandidateKey, ForceHypothesis] = {}
            for base in beam:
                self._fit_promising_effects(
                    base, effects, followed_count, extended_hypotheses, on_progress
                )
            hypotheses |= extended_hypotheses
            ranked_hypotheses = self._sort_by_score(extended_hypotheses, effect_count)
            if not ranked_hypotheses or self.score(
                ranked_hypotheses[0], effect_count
            ) <= self.score(best_hypothesis, effect_count):
                break
            beam = ranked_hypotheses[:BEAM_WIDTH]
        return self._sort_by_score(hypotheses, effect_count)

    def extend_hypothesis(
        self,
        base: ForceHypothesis,
        effects: Sequence[Effect],
        followed_count: int,
        on_progress: Callable[[str], None] = lambda message: None,
    ) -> list[ForceHypothesis]:
        """Return a hypothesis with each promising effect added, the most probable first.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis to which an effect is added.
        effects : sequence of Effect
            The effects that may be missing in the model.
        followed_count : int
            The number of effects that are fitted.
        on_progress : callable
            The function that receives a line for the progress display, such as the comparison that
            runs.
        """
        extended_hypotheses: dict[CandidateKey, ForceHypothesis] = {}
        self._fit_promising_effects(base, effects, followed_count, extended_hypotheses, on_progress)
        return self._sort_by_score(extended_hypotheses, len(effects))

    def _fit_promising_effects(
        self,
        base: ForceHypothesis,
        effects: Sequence[Effect],
        followed_count: int,
        extended_hypotheses: dict[CandidateKey, ForceHypothesis],
        on_progress: Callable[[str], None],
    ) -> None:
        """Add each of the most promising effects to a hypothesis, fit the result, and store it.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis to which an effect is added.
        effects : sequence of Effect
            The effects that may be missing in the model.
        followed_count : int
            The number of effects that are fitted.
        extended_hypotheses : dict of CandidateKey to ForceHypothesis
            The hypotheses with one more effect, to which results are added.
        on_progress : callable
            The function that receives a line for the progress display, such as the comparison that
            runs.
        """
        base_in_words = f" beside {base.candidate.description}" if base.candidate.terms else ""
        on_progress(f"comparing all effects{base_in_words} with the missing force")
        promising_effects = self.screen_effects(base, effects)[:followed_count]
        for number, screened_effect in enumerate(promising_effects):
            candidate = base.candidate.with_term(screened_effect.term)
            if candidate.key in extended_hypotheses:
                continue
            remaining_count = len(promising_effects) - number - 1
            description = candidate.description
            on_progress(f"following {description} along the missing force, {remaining_count} more")
            fitted_hypotheses = []
            for start in screened_effect.starts:
                effect = np.concatenate((base.effect, start))
                hypothesis = self.fit_along_motion(base, candidate, effect)
                if hypothesis is not None:
                    fitted_hypotheses.append(hypothesis)
            if fitted_hypotheses:
                best_hypothesis = max(
                    fitted_hypotheses, key=lambda hypothesis: hypothesis.log_evidence
                )
                extended_hypotheses[candidate.key] = best_hypothesis

    def score(self, hypothesis: ForceHypothesis, effect_count: int) -> float:
        """Return the log of evidence times prior of a hypothesis [nat].

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The fitted hypothesis: its effects, and the motion and missing forces of each trial.
        effect_count : int
            The number of effects that are compared.
        """
        prior = log_prior(hypothesis.candidate, effect_count, self.problem.setting)
        return hypothesis.log_evidence + prior

    def _sort_by_score(
        self, hypotheses: Mapping[CandidateKey, ForceHypothesis], effect_count: int
    ) -> list[ForceHypothesis]:
        """Return hypotheses, the most probable first; `effect_count` effects are compared."""
        return sorted(
            hypotheses.values(), key=lambda hypothesis: -self.score(hypothesis, effect_count)
        )

    # ---------------------------------------------------------------- screen of one more effect

    def screen_effects(
        self, base: ForceHypothesis, effects: Iterable[Effect]
    ) -> list[ScreenedEffect]:
        """Return the effects that may be added to a hypothesis, the most promising first.

        Each effect is tried at each of its places, with several values of its parameters. All
        values whose evidence is within `TIED_EVIDENCE` of the best are starts of later fits. For
        example, dead zones of different stiffness act alike if only their amplitude is fitted, but
        fits that begin with them lead to different ends.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis to which an effect is added.
        effects : iterable of Effect
            The effects that may be missing in the model.
        """
        tried_effects = self._try_effects(base, effects)
        weighed_columns = self._weigh_columns(base, tried_effects)
        weighed_by_term: dict[EffectTerm, list[_WeighedStart]] = {}
        for index, (log_evidence, factor) in weighed_columns.items():
            tried_effect = tried_effects[index]
            start = tried_effect.term.multiply_magnitudes_within_range(tried_effect.values, factor)
            weighed_by_term.setdefault(tried_effect.term, []).append(
                _WeighedStart(log_evidence, start)
            )
        screened_effects = []
        for term, weighed_starts in weighed_by_term.items():
            best_evidence = max(weighed.log_evidence for weighed in weighed_starts)
            starts = [
                weighed.start
                for weighed in weighed_starts
                if weighed.log_evidence > best_evidence - TIED_EVIDENCE
            ]
            screened_effects.append(ScreenedEffect(best_evidence, term, starts))
        return sorted(screened_effects, key=lambda effect: -effect.log_evidence)

    def _try_effects(self, base: ForceHypothesis, effects: Iterable[Effect]) -> list[_TriedEffect]:
        """Return the columns of all effects that may be added, at several values of each.

        Columns that change no reading are left out.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis to which an effect is added, with the motion along which effects act.
        effects : iterable of Effect
            The effects that may be missing in the model.
        """
        tried_effects = []
        for term in self._terms_to_add(base, effects):
            for values in values_to_try(term):
                column = self.column_builder.column_of_candidate(
                    base.linear_trials, base.motions, Candidate((term,)), values
                )
                if column is not None and any(np.any(change.readings) for change in column):
                    tried_effects.append(_TriedEffect(term, values, column))
        return tried_effects

    def _terms_to_add(
        self, base: ForceHypothesis, effects: Iterable[Effect]
    ) -> Iterator[EffectTerm]:
        """Yield the effects at places where a hypothesis lacks them, also with a free shape.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis to which an effect may be added.
        effects : iterable of Effect
            The effects that may be missing in the model.
        """
        in_base = {(term.effect.identifier, term.place) for term in base.candidate.terms}
        for effect in effects:
            for place in effect.places(self.problem.setting):
                if (effect.identifier, place) in in_base:
                    continue
                yield EffectTerm(effect, place)
                if effect.shape:
                    yield EffectTerm(effect, place, free_shape=True)

    def _weigh_columns(
        self, base: ForceHypothesis, tried_effects: Sequence[_TriedEffect]
    ) -> dict[int, _WeighedColumn]:
        """Return the best evidence and factor of each column, added alone to a hypothesis.

        The best is taken over several deviations and times of the remaining missing forces.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis to which an effect is added.
        tried_effects : sequence of _TriedEffect
            The effects with their columns.

        Returns
        -------
        dict of int to _WeighedColumn
            The evidence and factor, by the index of the tried effect. One is left out if its factor
            always has a sign that the effect cannot have.
        """
        if not tried_effects:
            return {}
        columns = [tried_effect.column for tried_effect in tried_effects]
        with_columns = replace(
            base.linear_trials,
            motions=base.motions,
            effect_columns=(*base.linear_trials.effect_columns, *columns),
            effect_precision=(
                *base.linear_trials.effect_precision,
                *self._prior_precisions(base, columns),
            ),
        )
        base_count = len(base.linear_trials.prior_precision)
        best_columns: dict[int, _WeighedColumn] = {}
        for size_factor, time_factor in product(SCREENED_DEVIATIONS, SCREENED_TIMES):
            normal_equations = with_columns.regression(
                scale_processes(base.processes, size_factor, time_factor)
            )
            for index, tried_effect in enumerate(tried_effects):
                # the unknowns of the base are fitted again, with this column alone
                unknowns = [*range(base_count), base_count + index]
                solution = normal_equations.solve(unknowns, with_columns.prior_precision[unknowns])
                factor = float(solution.mean[-1])
                is_better = (
                    index not in best_columns
                    or best_columns[index].log_evidence < solution.log_evidence
                )
                has_possible_sign = factor > 0.0 or tried_effect.term.may_be_negative
                if is_better and np.isfinite(solution.log_evidence) and has_possible_sign:
                    best_columns[index] = _WeighedColumn(solution.log_evidence, factor)
        return best_columns

    def _prior_precisions(
        self, base: ForceHypothesis, columns: Sequence[EffectColumn]
    ) -> list[float]:
        """Return the prior precisions of the factors of columns.

        The prior standard deviation of a factor is `FACTOR_DEVIATION` times the factor with which
        the effect would be as large as the gap: of forces for an effect with a force, of readings
        for another one.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis with the gap.
        columns : sequence of EffectColumn
            The columns whose factors are unknown.
        """
        gap_of_readings = _rms([trial.residual for trial in base.linear_trials.trials])
        gap_of_forces = _rms([force for motion in base.motions for force in motion.forces.values()])
        precisions = []
        for column in columns:
            forces = [force for change in column for force in change.forces.values()]
            if forces:
                effect_rms = _rms(forces)
                gap_rms = gap_of_forces
            else:
                effect_rms = _rms([change.readings for change in column])
                gap_rms = gap_of_readings
            # precision = 1 / (FACTOR_DEVIATION * gap / effect)^2
            precisions.append(min(effect_rms / (FACTOR_DEVIATION * gap_rms), LARGEST_RATIO) ** 2)
        return precisions

    # ---------------------------------------------------------------- most probable values

    def fit_along_motion(
        self, base: ForceHypothesis, candidate: Candidate, effect: FloatArray
    ) -> ForceHypothesis | None:
        """Return a hypothesis at its most probable values, by steps of an iterated smoother.

        Each step evaluates the laws along the motion that was estimated by the previous one.

        Parameters
        ----------
        base : ForceHypothesis
            The hypothesis with the motion and the missing forces of the first step.
        candidate : Candidate
            The effects of the hypothesis, each at its place.
        effect : (E,) array
            The scaled effect parameters to begin with.

        Returns
        -------
        ForceHypothesis or None
            The hypothesis; None if the effects cannot act along the motion.
        """
        processes = base.processes
        motions = base.motions
        has_converged = False
        step_fraction = 1.0
        last_step = np.zeros(len(effect))
        best_hypothesis: ForceHypothesis | None = None
        for step_number in range(MOST_ITERATIONS):
            linear_trials = self.linearise_effects(base.linear_trials, motions, candidate, effect)
            if linear_trials is None:
                break
            # missing forces: the best point of a grid in the first step, unchanged in later ones,
            # and by Newton's method in the last one
            is_last = has_converged or step_number == MOST_ITERATIONS - 1
            hypothesis = fit_missing_forces(
                linear_trials,
                self.prior_processes(processes),
                processes,
                candidate,
                effect,
                skip_grid=step_number > 0,
                most_steps=MOST_STEPS if is_last else 0,
            )
            step = hypothesis.solution.mean[len(linear_trials.shared_precision) :] - effect
            hypothesis = _with_evidence_before_step(hypothesis, step)
            # the last iteration takes the step that remains
            if has_converged:
                return replace(hypothesis, effect=effect + step)
            # The motion of the first step is that of the base, which follows the readings without
            # the effects. So its evidence is too large: the second step replaces it in any case.
            is_better = (
                best_hypothesis is None or hypothesis.log_evidence > best_hypothesis.log_evidence
            )
            if is_better or step_number == 1:
                best_hypothesis = hypothesis
            # shorter steps if the direction reverses, longer ones again if not
            if step @ last_step < -0.5 * (last_step @ last_step):
                step_fraction = max(0.5 * step_fraction, LEAST_DAMPING)
            else:
                step_fraction = min(1.0, 1.5 * step_fraction)
            shortened_step = step_fraction * np.clip(step, -LONGEST_STEP, LONGEST_STEP)
            effect = candidate.within_range(candidate.add_step(effect, shortened_step))
            has_converged = step_number > 0 and _has_converged(step, last_step)
            processes = hypothesis.processes
            motions = hypothesis.motions
            last_step = step
        return best_hypothesis

    def linearise_effects(
        self,
        linear_trials: LinearTrials,
        motions: Sequence[TrialMotion],
        candidate: Candidate,
        effect: FloatArray,
    ) -> LinearTrials | None:
        """Return the trials, linear in the effect parameters of a hypothesis along motions.

        Parameters
        ----------
        linear_trials : LinearTrials
            The trials in motion as one linear model.
        motions : sequence of TrialMotion
            The motion of each trial along which the effects act.
        candidate : Candidate
            The effects of the hypothesis, each at its place.
        effect : (E,) array
            The scaled effect parameters about which the effects are linear.

        Returns
        -------
        LinearTrials or None
            The linear trials; None if the effects cannot act along the motions.
        """
        if not candidate.terms:
            return replace(
                self.column_builder.trials_along_motions(linear_trials, motions, None),
                effect_columns=(),
                effect_precision=(),
            )
        at_values = self.column_builder.column_of_candidate(
            linear_trials, motions, candidate, effect
        )
        if at_values is None:
            return None
        slopes = []
        for k in range(len(effect)):
            column_above = self.column_builder.column_of_candidate(
                linear_trials, motions, candidate, with_step(effect, k, HALF_DIFFERENCE)
            )
            column_below = self.column_builder.column_of_candidate(
                linear_trials, motions, candidate, with_step(effect, k, -HALF_DIFFERENCE)
            )
            if column_above is None or column_below is None:
                return None
            slopes.append(
                sum_of_columns(
                    (column_above, column_below), (0.5 / HALF_DIFFERENCE, -0.5 / HALF_DIFFERENCE)
                )
            )
        # a column for each parameter, and a constant one: the linear effects at zero parameters,
        # which are the effects at `effect` minus the sum of effect * slope
        at_zero = sum_of_columns((at_values, *slopes), (1.0, *-effect))
        linear_trials = self.column_builder.trials_along_motions(linear_trials, motions, at_zero)
        return replace(
            linear_trials, effect_columns=tuple(slopes), effect_precision=(1.0,) * len(effect)
        )


def _rms(series: Iterable[FloatArray]) -> float:
    """Return the root mean square of several arrays together, at least `LEAST_DIVISOR`."""
    values = np.concatenate([np.ravel(entries) for entries in series])
    return max(float(np.sqrt(np.mean(values**2))), LEAST_DIVISOR)


def _with_evidence_before_step(hypothesis: ForceHypothesis, step: FloatArray) -> ForceHypothesis:
    """Return a hypothesis with the log evidence at its own parameters, before a step.

    The evidence of the linear model is that at the end of a step of the parameters. Before the step
    the log density is lower by step^T covariance^-1 step / 2. Entries of the step below
    `CONVERGED_STEP` are taken as zero.

    Parameters
    ----------
    hypothesis : ForceHypothesis
        The fitted hypothesis: its effects, and the motion and missing forces of each trial.
    step : (E,) array
        The step from its effect parameters to the solution.
    """
    # entries of the step that the parameters have not taken yet
    remaining_step = np.where(np.abs(step) > CONVERGED_STEP, step, 0.0)
    if not remaining_step.any():
        return hypothesis
    weighted_step = np.linalg.lstsq(hypothesis.effect_covariance, remaining_step, rcond=None)[0]
    loss = 0.5 * float(remaining_step @ weighted_step)
    return replace(hypothesis, log_evidence=hypothesis.log_evidence - loss)


def _has_converged(step: FloatArray, last_step: FloatArray) -> bool:
    """Return whether a step of the effect parameters is so short that the iteration may end.

    The limit is `CONVERGED_STEP`. It is ten times lower if the step is longer than half of the
    previous one: convergence is then slow, and the sum of all further steps would be large.

    Parameters
    ----------
    step, last_step : (E,) array
        The present step, and the previous one.
    """
    largest_step = float(np.abs(step).max(initial=0.0))
    previous_largest_step = float(np.abs(last_step).max(initial=0.0))
    if largest_step < 0.5 * previous_largest_step:
        return largest_step < CONVERGED_STEP
    return largest_step < CONVERGED_STEP * 0.1
