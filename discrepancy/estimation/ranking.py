"""The ranking of hypotheses on the missing force, in two rounds if the records are long.

A screen finds the promising effects; each is estimated roughly, the best ones in full, together
with the motion. Then effects are added to the best hypothesis. Long records are thinned in the
first round, and the leading hypotheses are estimated in all samples.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import Effect
from discrepancy.catalogue.force_curve import (
    CORRELATION_LENGTHS,
    VARIABLES,
    force_curve,
    variance_along_curve,
)
from discrepancy.fits.candidate import Candidate, CandidateKey, EffectTerm

from .estimate import Estimate
from .force_search import ForceSearch
from .screen import screen_effects

FOLLOWED_COUNTS = (10, 4, 4)
"""Numbers of effects that are estimated after the screening: as single effects, as second ones and
as third ones of a set."""
BEAM_WIDTHS = (4, 2, 2)
"""Numbers of the rough estimates of each length that are estimated in full, the best first."""
ESTIMATED_RANGE = 60.0
"""Difference to the best score above which no hypothesis is estimated in full [nat]."""
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


def rank_by_missing_force(
    search: ForceSearch,
    effects: Sequence[Effect],
    on_progress: OnProgress = lambda message: None,
) -> list[Estimate]:
    """Return estimates of hypotheses on the missing force, the most probable first.

    Of long records, only the leading hypotheses and the one without effects are returned.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force in all samples.
    effects : sequence of Effect
        The effects that may be missing in the model.
    on_progress : callable
        The function that receives a line for the progress display, such as the estimate that runs.
    """
    thinned_search = search.thinned
    if thinned_search is None:
        return rank_hypotheses(search, effects, on_progress)
    ranked_estimates = rank_hypotheses(thinned_search, effects, on_progress)
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
    largest_set: int | None = None,
) -> list[Estimate]:
    """Return estimates of hypotheses, the most probable first.

    Effects are added to the best hypothesis one at a time, as long as its score rises. Each time,
    simpler forms of the best hypothesis are estimated, too.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    effects : sequence of Effect
        The effects that may be missing in the model.
    on_progress : callable
        The function that receives a line for the progress display, such as the estimate that runs.
    largest_set : int, optional
        The largest number of effects in a set; by default that of `FOLLOWED_COUNTS`.
    """
    ranking = _Ranking(search, effects, on_progress)
    best_estimate = search.estimate_without_effects
    for followed_count, beam_width in list(zip(FOLLOWED_COUNTS, BEAM_WIDTHS, strict=True))[
        :largest_set
    ]:
        rough_estimates = ranking.rough_estimates(best_estimate, followed_count)
        ranking.estimate_in_full(best_estimate, rough_estimates, beam_width)
        ranking.estimate_simpler_forms()
        if ranking.best is best_estimate:
            break
        is_first_effect = not best_estimate.candidate.terms
        best_estimate = ranking.best
        if is_first_effect:
            curve = ranking.estimate_curve()
            # effects are added to a named law, unless the curve leaves nothing to explain
            if (
                curve is not None
                and curve.leaves_no_force
                and ranking.score(curve) > ranking.score(best_estimate)
            ):
                break
    return ranking.in_order()


class _ValuedCandidate(NamedTuple):
    """A set of effects, and the scaled parameters (E,) with which its estimate begins."""

    candidate: Candidate
    parameters: FloatArray


class _Ranking:
    """The estimates of a ranking, one for each set of effects."""

    def __init__(
        self, search: ForceSearch, effects: Sequence[Effect], on_progress: OnProgress
    ) -> None:
        self.search = search
        self.effects = effects
        self.on_progress = on_progress
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

    def rough_estimates(self, base: Estimate, followed_count: int) -> list[Estimate]:
        """Return rough estimates of a base with one more effect, the most probable first.

        Parameters
        ----------
        base : Estimate
            The estimate to which an effect is added. Its motion and missing forces are those to
            begin with.
        followed_count : int
            The number of effects that are estimated, the most promising of the screen first.
        """
        base_in_words = f" beside {base.candidate.description}" if base.candidate.terms else ""
        self.on_progress(f"comparing all effects{base_in_words} with the missing force")
        screened_effects = screen_effects(self.search, base, self.effects)
        if base.leaves_no_force:
            # the screen is exact for effects that are small, as any further one is
            screened_effects = [effect for effect in screened_effects if effect.rise > 0.0]
        promising_effects = screened_effects[:followed_count]
        rough_estimates = []
        for number, screened_effect in enumerate(promising_effects):
            candidate = base.candidate.with_term(screened_effect.term)
            if candidate.key in self.by_effects:
                continue
            remaining_count = len(promising_effects) - number - 1
            description = candidate.description
            self.on_progress(f"estimating {description} roughly, {remaining_count} more")
            estimates_of_effect = []
            for start in screened_effect.starts:
                effect = np.concatenate((base.effect, start.effect))
                estimate = self.search.estimate_roughly(base, candidate, effect, start.processes)
                if estimate is not None:
                    estimates_of_effect.append(estimate)
            if estimates_of_effect:
                rough_estimates.append(
                    max(estimates_of_effect, key=lambda estimate: estimate.log_evidence)
                )
        for estimate in rough_estimates:
            self.record(estimate)
        return sorted(rough_estimates, key=lambda estimate: -self.score(estimate))

    def estimate_in_full(
        self, base: Estimate, rough_estimates: Sequence[Estimate], beam_width: int
    ) -> None:
        """Estimate the best of some hypotheses in full, each from its rough estimate.

        Parameters
        ----------
        base : Estimate
            The estimate whose motion and missing forces are those to begin with.
        rough_estimates : sequence of Estimate
            The rough estimates, the most probable first.
        beam_width : int
            The largest number of estimates in full.
        """
        for rough_estimate in rough_estimates[:beam_width]:
            if self.score(rough_estimate) < self.score(rough_estimates[0]) - ESTIMATED_RANGE:
                break
            # where nothing is left to explain, another effect cannot explain more
            best_estimate = self.best
            if (
                best_estimate.leaves_no_force
                and self.score(rough_estimate) < self.score(best_estimate) - ESTIMATED_RANGE
            ):
                break
            candidate = rough_estimate.candidate
            self.on_progress(f"estimating {candidate.description} together with the motion")
            estimate = self.search.estimate_effects(base, candidate, rough_estimate.effect)
            if estimate is not None:
                self.record(estimate)
            # A missing force that is large at first may take the place of a law whose force hardly
            # changes: the estimate also begins at the smaller one of the rough estimate.
            if self.by_effects[candidate.key] is rough_estimate:
                self.record(self.search.estimate_about_own_values(rough_estimate))
            self.estimated_in_full.add(candidate.key)

    def estimate_simpler_forms(self) -> None:
        """Estimate the simpler forms of the best hypothesis, as long as one of them is better.

        A set may lead only because its estimate reached the right values of one effect, and the
        estimate of that effect alone did not. The same holds for a law of free shape and the named
        laws of its family, such as dry friction. Each simpler form is therefore estimated from the
        motion of the best hypothesis.
        """
        best_estimate = self.best
        while best_estimate.candidate.terms:
            simpler_forms = [
                *self._named_laws_of_family(best_estimate.candidate),
                *_simpler_forms(best_estimate.candidate, best_estimate.effect),
            ]
            # the values of the best hypothesis are preferred where both have the same effects
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
        """Estimate a force of free shape over the motion where no named law is enough.

        A named law is enough if it leaves no force, and no exponent of it had to be fitted. The
        curve acts at the port that shows most of the missing force, and runs over what explains
        more of that force: displacement or velocity. A port of a state has neither.
        """
        if self.best.leaves_no_force and not self.best.candidate.has_free_shape:
            return None
        base = self.search.estimate_without_effects
        port = max(base.processes, key=self.search.force_deviation)
        ported = self.search.ported
        port_name = ported.ports[port]
        scale = ported.problem.setting.scales.ports.get(port_name)
        if scale is not None and scale.of_state:
            return None
        force = np.concatenate([trial.missing_forces[port] for trial in base.trials])
        values_of = {
            "displacement": np.concatenate(
                [trial.trajectory.positions[:, port] for trial in base.trials]
            ),
            "velocity": np.concatenate([trial.trajectory.speeds[:, port] for trial in base.trials]),
        }
        variable = max(
            VARIABLES, key=lambda name: variance_along_curve(name, values_of[name], force)
        )
        values = values_of[variable]
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
                # a sharper bend is tried only of a curve that leads and leaves a force
                if estimate.leaves_no_force or self.score(estimate) < self.score(self.best):
                    break
        if not estimates:
            return None
        self.curve = max(estimates, key=lambda curve: (curve.leaves_no_force, curve.log_evidence))
        return self.curve

    def _named_laws_of_family(self, candidate: Candidate) -> list[_ValuedCandidate]:
        """Return the sets in which named laws stand in place of the laws of free shape of a set.

        They are taken from the rough estimates, with the values that these have.
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


def _families_at_places(candidate: Candidate) -> list[tuple[str, str]]:
    """Return the families of a set of effects with their places, in order."""
    return sorted((term.effect.family, term.place) for term in candidate.terms)


def _simpler_forms(candidate: Candidate, parameters: FloatArray) -> list[_ValuedCandidate]:
    """Return the simpler forms of a set: without one effect, or with one law in canonical shape.

    Parameters
    ----------
    candidate : Candidate
        The set of effects. The only effect of a set is never left out.
    parameters : (E,) array
        The scaled parameters of the set, which the forms inherit.
    """
    forms = []
    numbers = range(len(candidate.terms))
    if len(numbers) > 1:
        for left_out in numbers:
            kept = [number for number in numbers if number != left_out]
            forms.append(_ValuedCandidate(*candidate.subset_of_terms(kept, parameters)))
    for number, term in enumerate(candidate.terms):
        if not term.free_shape:
            continue
        canonical_term = replace(term, free_shape=False)
        terms = list(candidate.terms)
        terms[number] = canonical_term
        parameters_by_term = [of_term for _, of_term in candidate.split_by_term(parameters)]
        # the parameters of the shape follow those of the canonical law
        canonical_count = len(canonical_term.parameters)
        parameters_by_term[number] = parameters_by_term[number][:canonical_count]
        forms.append(_ValuedCandidate(Candidate(tuple(terms)), np.concatenate(parameters_by_term)))
    return forms


def _leading_estimates(
    search: ForceSearch, ranked_estimates: Sequence[Estimate], effect_count: int
) -> list[Estimate]:
    """Return the estimates with effects that are repeated in all samples, the best first.

    These are the most probable ones, and the law of the best one with the other kind of shape: the
    verdict compares a law of canonical shape with that of free shape.

    Parameters
    ----------
    search : ForceSearch
        The search in thinned records.
    ranked_estimates : sequence of Estimate
        Its estimates, the most probable first.
    effect_count : int
        The number of effects that were compared.
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
        has_same_effects = estimate.candidate.identifiers == best_estimate.candidate.identifiers
        if (
            has_same_effects
            and estimate not in leading_estimates
            and len(leading_estimates) < MOST_LEADING
        ):
            leading_estimates.append(estimate)
    return leading_estimates
