"""The ranking of hypotheses on the missing force, in two rounds if the records are long.

A screen finds the promising effects. Each is estimated roughly, and the best ones in full, together
with the motion. Then effects are added to the best hypothesis. Long records are thinned in the
first round, after which the leading hypotheses are estimated in all samples.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect
from discrepancy.catalogue.force_curve import (
    CORRELATION_LENGTHS,
    Variable,
    force_curve,
    variance_along_curve,
)
from discrepancy.fits.candidate import Candidate, CandidateKey, EffectTerm

from .estimate import Estimate
from .force_search import ForceSearch
from .screen import screen_effects

ROUGH_COUNTS = (10, 4, 4)
"""Numbers of screened effects that are estimated roughly: as single effects, and as the second and
third ones of a set."""
BEAM_WIDTHS = (4, 2, 2)
"""Numbers of these rough estimates that are then estimated in full."""
ESTIMATED_RANGE = 60.0
"""Difference to the best score above which a hypothesis is not estimated in full [nat]."""
RANGE_BESIDE_NO_FORCE = 6.0
"""The same difference to the hypothesis to which an effect is added, if that leaves no force [nat]:
the effect is then small, and its rough estimate nearly exact."""
LEAST_LOSS = 0.5
"""Evidence by which an estimate must be below its rough one to count as another optimum [nat]."""
MOST_SETTLING_ESTIMATES, LEAST_SETTLING_RISE = 4, 2.0
"""Largest number of times that the estimate of the best hypothesis is repeated, and the rise of its
evidence [nat] below which it is not repeated again."""
LEADING_RANGE = 12.0
"""Difference to the best score of the first round above which a hypothesis is dropped [nat]. In all
samples the difference is larger by about the factor of the thinning."""
MOST_LEADING = 3
"""Largest number of hypotheses with effects that are estimated in all samples."""

CURVE_DEVIATION = 2.0
"""Prior standard deviation of a force of free shape, over that of the missing force: at the ends of
the motion it is larger than on average."""

OnProgress = Callable[[str], None]
"""Called with a line for the progress display."""
OnEstimates = Callable[[list[Estimate]], None]
"""Called with all estimates so far, the most probable first, when there is a new one."""


def rank_by_missing_force(
    search: ForceSearch,
    effects: Sequence[Effect],
    on_progress: OnProgress = lambda message: None,
    on_estimates: OnEstimates = lambda estimates: None,
) -> list[Estimate]:
    """Return estimates of hypotheses on the missing force, the most probable first.

    If the records are long, all hypotheses are ranked in thinned records. Only the leading ones and
    the one without effects are then estimated in all samples, and returned.

    Parameters
    ----------
    on_progress : callable
        The function that receives a line for the progress display, such as the estimate that runs.
    on_estimates : callable
        The function that receives the estimates so far, so that an interrupted search keeps them.
    """
    thinned_search = search.thinned
    if thinned_search is None:
        return rank_hypotheses(search, effects, on_progress, on_estimates)
    ranked_estimates = rank_hypotheses(thinned_search, effects, on_progress, on_estimates)
    estimates = [search.estimate_without_effects]
    for leading_estimate in _leading_estimates(thinned_search, ranked_estimates, len(effects)):
        on_progress(f"estimating {leading_estimate.candidate.description} in all samples")
        estimate = search.estimate_in_all_samples(leading_estimate)
        if estimate is not None:
            estimates.append(estimate)
    return sorted(estimates, key=lambda estimate: -search.score(estimate, len(effects)))


def rank_hypotheses(
    search: ForceSearch,
    effects: Sequence[Effect],
    on_progress: OnProgress = lambda message: None,
    on_estimates: OnEstimates = lambda estimates: None,
    largest_set: int | None = None,
) -> list[Estimate]:
    """Return estimates of hypotheses, the most probable first.

    Effects are added to the best hypothesis one at a time, as long as its score rises. Each time,
    its estimate is repeated until it has settled, and its simpler forms are estimated, too. A force
    of free shape is estimated after the first effect, also if none is more probable than no effect.
    The ranking ends there if the force of free shape is more probable and leaves no force.

    Parameters
    ----------
    on_progress, on_estimates : callable
        See `rank_by_missing_force`.
    largest_set : int, optional
        The largest number of effects in a set; by default the length of `ROUGH_COUNTS`.
    """
    ranking = _Ranking(search, effects, on_progress, on_estimates)
    best_estimate = search.estimate_without_effects
    counts_by_length = list(zip(ROUGH_COUNTS, BEAM_WIDTHS, strict=True))
    for rough_count, beam_width in counts_by_length[:largest_set]:
        rough_estimates = ranking.rough_estimates(best_estimate, rough_count)
        ranking.estimate_in_full(best_estimate, rough_estimates, beam_width)
        ranking.settle_best()
        ranking.estimate_simpler_forms()
        is_first_effect = not best_estimate.candidate.terms
        is_improved = ranking.best is not best_estimate
        best_estimate = ranking.best
        curve = ranking.estimate_curve() if is_first_effect else None
        is_curve_enough = (
            curve is not None
            and curve.leaves_no_force
            and ranking.score(curve) > ranking.score(best_estimate)
        )
        if is_curve_enough or not is_improved:
            break
    return ranking.in_order()


class _ValuedCandidate(NamedTuple):
    """A set of effects, and the scaled parameters (E,) with which its estimate begins."""

    candidate: Candidate
    parameters: FloatArray


class _Ranking:
    """The estimates of a ranking, one for each set of effects."""

    def __init__(
        self,
        search: ForceSearch,
        effects: Sequence[Effect],
        on_progress: OnProgress,
        on_estimates: OnEstimates,
    ) -> None:
        self.search = search
        self.effects = effects
        self.on_progress = on_progress
        self.on_estimates = on_estimates
        without_effects = search.estimate_without_effects
        self.by_effects: dict[CandidateKey, Estimate] = {
            without_effects.candidate.key: without_effects
        }
        self.curve: Estimate | None = None
        self.estimated_in_full: set[CandidateKey] = {without_effects.candidate.key}
        self.hopeless_forms: set[CandidateKey] = set()

    def score(self, estimate: Estimate) -> float:
        """Return the log of evidence times prior of an estimate [nat]."""
        return self.search.score(estimate, len(self.effects))

    def in_order(self) -> list[Estimate]:
        """Return all estimates, the most probable first."""
        estimates = [*self.by_effects.values()]
        if self.curve is not None:
            estimates.append(self.curve)
        return sorted(estimates, key=lambda estimate: -self.score(estimate))

    @property
    def best(self) -> Estimate:
        """The most probable estimate of named laws and errors of sensors."""
        return max(self.by_effects.values(), key=self.score)

    def record(self, estimate: Estimate) -> None:
        """Store an estimate unless an earlier one of the same effects is more probable."""
        key = estimate.candidate.key
        earlier = self.by_effects.get(key)
        if earlier is None or estimate.log_evidence > earlier.log_evidence:
            self.by_effects[key] = estimate
            self.on_estimates(self.in_order())

    def rough_estimates(self, base: Estimate, rough_count: int) -> list[Estimate]:
        """Return rough estimates of a base with one more effect, the most probable first.

        The `rough_count` most promising effects of the screen are estimated, from the motion and
        the missing forces of the base. Sets that have an estimate already are left out.
        """
        base_in_words = f" beside {base.candidate.description}" if base.candidate.terms else ""
        self.on_progress(f"comparing all effects{base_in_words} with the missing force")
        screened_effects = screen_effects(self.search, base, self.effects)
        if base.leaves_no_force:
            # a further effect can only be small, and for small effects the screen is exact
            screened_effects = [effect for effect in screened_effects if effect.rise > 0.0]
        promising_effects = screened_effects[:rough_count]
        rough_estimates = []
        for index, screened_effect in enumerate(promising_effects):
            candidate = base.candidate.with_term(screened_effect.term)
            if candidate.key in self.by_effects:
                continue
            remaining_count = len(promising_effects) - index - 1
            description = candidate.description
            self.on_progress(f"estimating {description} roughly, {remaining_count} more")
            estimates_of_effect = []
            for start in screened_effect.starts:
                effect_values = np.concatenate((base.effect, start.effect))
                estimate = self.search.estimate_roughly(
                    base, candidate, effect_values, start.processes
                )
                if estimate is not None:
                    estimates_of_effect.append(estimate)
            if estimates_of_effect:
                best_estimate = max(estimates_of_effect, key=lambda estimate: estimate.log_evidence)
                linearisation = best_estimate.linearisation.without_cached_arrays()
                rough_estimates.append(replace(best_estimate, linearisation=linearisation))
        for estimate in rough_estimates:
            self.record(estimate)
        return sorted(rough_estimates, key=lambda estimate: -self.score(estimate))

    def estimate_in_full(
        self, base: Estimate, rough_estimates: Sequence[Estimate], beam_width: int
    ) -> None:
        """Estimate the best hypotheses in full, given their rough estimates, the best first.

        At most `beam_width` are estimated. They begin with the effects of the rough estimate, and
        with the motion and the missing forces of `base`.
        """
        for rough_estimate in rough_estimates[:beam_width]:
            if self.score(rough_estimate) < self.score(rough_estimates[0]) - ESTIMATED_RANGE:
                break
            # where nothing is left to explain, another effect cannot explain more
            reference = base if base.leaves_no_force else self.best
            score_range = RANGE_BESIDE_NO_FORCE if base.leaves_no_force else ESTIMATED_RANGE
            if (
                reference.leaves_no_force
                and self.score(rough_estimate) < self.score(reference) - score_range
            ):
                break
            candidate = rough_estimate.candidate
            self.on_progress(f"estimating {candidate.description} together with the motion")
            estimate = self.search.estimate_effects(base, candidate, rough_estimate.effect)
            if estimate is not None:
                self.record(estimate)
            # With the large missing force of the base, a law whose force hardly changes may be lost
            # to it: begin also with the smaller missing force of the rough estimate.
            least_evidence = rough_estimate.log_evidence - LEAST_LOSS
            if estimate is None or estimate.log_evidence < least_evidence:
                self.record(self.search.estimate_about_own_values(rough_estimate))
            self.estimated_in_full.add(candidate.key)

    def settle_best(self) -> None:
        """Repeat the estimate of the best hypothesis, as long as its evidence rises.

        Otherwise a further effect may seem to explain something only because its estimate began
        where this one ended.
        """
        for _ in range(MOST_SETTLING_ESTIMATES):
            best_estimate = self.best
            is_settled = best_estimate.converged or best_estimate.leaves_no_force
            if is_settled or not best_estimate.candidate.terms:
                return
            self.on_progress(f"estimating {best_estimate.candidate.description} again")
            repeated_estimate = self.search.estimate_about_own_values(best_estimate)
            self.record(repeated_estimate)
            if self.score(repeated_estimate) < self.score(best_estimate) + LEAST_SETTLING_RISE:
                return

    def estimate_simpler_forms(self) -> None:
        """Estimate the simpler forms of the best hypothesis, as long as one of them is better.

        A set may lead only because its estimate reached the right values of one effect, and the
        estimate of that effect alone did not. The same holds for a law of free shape and the named
        laws of its family, such as dry friction. Each simpler form is therefore estimated from the
        motion of the best hypothesis. A form that stays more than `ESTIMATED_RANGE` below the best
        one is not tried again.
        """
        best_estimate = self.best
        while best_estimate.candidate.terms:
            simpler_forms = [
                *self._named_laws_of_family(best_estimate.candidate),
                *_simpler_forms(best_estimate.candidate, best_estimate.effect),
            ]
            # if both lists have the same effects, those with the values of the best hypothesis stay
            form_by_effects = {form.candidate.key: form for form in simpler_forms}
            for key, form in form_by_effects.items():
                if key in self.hopeless_forms:
                    continue
                self.on_progress(
                    f"estimating {form.candidate.description} together with the motion"
                )
                estimate = self.search.polish_effects(best_estimate, *form)
                if estimate is not None:
                    self.record(estimate)
                form_estimate = self.by_effects.get(key)
                if (
                    form_estimate is None
                    or self.score(form_estimate) < self.score(best_estimate) - ESTIMATED_RANGE
                ):
                    self.hopeless_forms.add(key)
            if self.best is best_estimate:
                break
            best_estimate = self.best

    def estimate_curve(self) -> Estimate | None:
        """Estimate a force of free shape over the motion, unless a named law is enough.

        A named law is enough if it leaves no force, and no exponent of it had to be fitted. The
        curve acts at the port where most force is missing, and is a function of displacement or
        velocity, whichever explains more of that force; a flow at a port of a state is one of the
        state. Curves with ever sharper bends are tried, until one leaves no force or is less
        probable than the best named law. Of those that leave no force, or else of all, the most
        probable one is kept.
        """
        if self.best.leaves_no_force and not self.best.candidate.has_free_shape:
            return None
        base = self.search.estimate_without_effects
        port = max(base.processes, key=self.search.force_deviation)
        ported = self.search.ported
        port_name = ported.ports[port]
        force = np.concatenate([trial.missing_forces[port] for trial in base.trials])
        scale = ported.problem.setting.scales.ports.get(port_name)
        motion = _motion_of_port(base, port, is_state=scale is not None and scale.of_state)
        # at rest the velocity is zero
        variables = [name for name, values in motion.items() if np.any(values)]
        variable = max(variables, key=lambda name: variance_along_curve(name, motion[name], force))
        values = motion[variable]
        estimates = []
        for correlation_length in CORRELATION_LENGTHS:
            curve = force_curve(
                port_name,
                variable,
                (float(values.min()), float(values.max())),
                CURVE_DEVIATION * self.search.force_deviation(port),
                correlation_length,
            )
            candidate = Candidate((EffectTerm(curve, port_name, free_shape=True),))
            self.on_progress(f"estimating {candidate.description} together with the motion")
            estimate = self.search.estimate_effects(base, candidate, candidate.start_values())
            if estimate is not None:
                estimates.append(estimate)
                if estimate.leaves_no_force or self.score(estimate) < self.score(self.best):
                    break
        if not estimates:
            return None
        self.curve = max(estimates, key=lambda curve: (curve.leaves_no_force, curve.log_evidence))
        return self.curve

    def _named_laws_of_family(self, candidate: Candidate) -> list[_ValuedCandidate]:
        """Return sets with named laws of the same families instead of laws of free shape.

        They are those with a rough estimate but none in full, with the values of that estimate.
        """
        if not candidate.has_free_shape:
            return []
        forms = []
        for key, estimate in self.by_effects.items():
            other = estimate.candidate
            if (
                key not in self.estimated_in_full
                and not other.has_free_shape
                and _families_at_places(other) == _families_at_places(candidate)
            ):
                forms.append(_ValuedCandidate(other, estimate.effect))
        return forms


def _motion_of_port(base: Estimate, port: int, *, is_state: bool) -> dict[Variable, FloatArray]:
    """Return what a force at a port may follow, in all trials one after the other.

    It is the displacement and the velocity. At a port of a state it is the state, whose value
    stands in the place of a speed.
    """
    speeds = np.concatenate([trial.trajectory.speeds[:, port] for trial in base.trials])
    if is_state:
        return {"state": speeds}
    positions = np.concatenate([trial.trajectory.positions[:, port] for trial in base.trials])
    return {"displacement": positions, "velocity": speeds}


def _families_at_places(candidate: Candidate) -> list[tuple[str, str]]:
    """Return the families of a set of effects with their places, in order."""
    return sorted((term.effect.family, term.place) for term in candidate.terms)


def _simpler_forms(candidate: Candidate, parameters: FloatArray) -> list[_ValuedCandidate]:
    """Return the simpler forms of a set: without one effect, or with one law in canonical shape.

    They inherit the scaled parameters (E,) of the set. The only effect of a set is not left out.
    """
    forms = []
    term_indices = range(len(candidate.terms))
    if len(term_indices) > 1:
        for dropped_index in term_indices:
            remaining_indices = [
                term_index for term_index in term_indices if term_index != dropped_index
            ]
            smaller_set, values = candidate.subset_of_terms(remaining_indices, parameters)
            forms.append(_ValuedCandidate(smaller_set, values))
    for term_index, term in enumerate(candidate.terms):
        if not term.free_shape:
            continue
        canonical_term = replace(term, free_shape=False)
        terms = list(candidate.terms)
        terms[term_index] = canonical_term
        parameters_by_term = [values for _, values in candidate.split_by_term(parameters)]
        # the parameters of the shape follow those of the canonical law
        canonical_count = len(canonical_term.parameters)
        parameters_by_term[term_index] = parameters_by_term[term_index][:canonical_count]
        forms.append(_ValuedCandidate(Candidate(tuple(terms)), np.concatenate(parameters_by_term)))
    return forms


def _leading_estimates(
    search: ForceSearch, ranked_estimates: Sequence[Estimate], effect_count: int
) -> list[Estimate]:
    """Return the estimates with effects in thinned records that are repeated in all samples.

    They are the most probable ones, within `LEADING_RANGE` of the best score. If fewer than
    `MOST_LEADING` are, others of the families of the best one follow: the verdict compares a named
    law with that of free exponents, and the other way round.
    """
    with_effects = [estimate for estimate in ranked_estimates if estimate.candidate.terms]
    if not with_effects:
        return []
    best_estimate = with_effects[0]
    least_score = search.score(best_estimate, effect_count) - LEADING_RANGE
    leading_estimates = [
        estimate
        for estimate in with_effects[:MOST_LEADING]
        if search.score(estimate, effect_count) > least_score
    ]
    for estimate in with_effects:
        families = _families_at_places(estimate.candidate)
        if (
            families == _families_at_places(best_estimate.candidate)
            and estimate not in leading_estimates
            and len(leading_estimates) < MOST_LEADING
        ):
            leading_estimates.append(estimate)
    return leading_estimates
