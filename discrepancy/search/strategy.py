"""The search for the set of effects that explains a campaign.

Effects are screened at a fit (see `fits.screening`). The promising ones are fitted in a few steps,
and the best of these to convergence. Then effects are added to the best set, moved to other places,
and dropped. The *score* of a fit is ln (evidence times prior). A *family* is a law whose shape
parameters are fitted too. A fit is *far from the truth* if its residuals are much larger than the
noise, or if it moves a shared unknown far from its prior: predictions are then not linear between
this fit and the right one.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from discrepancy.catalogue.entry import Effect
from discrepancy.errors import ModelError
from discrepancy.estimation.estimate import Estimate
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.ported_problem import can_estimate_forces
from discrepancy.estimation.ranking import rank_by_missing_force
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit, try_fit
from discrepancy.fits.gates import check_absolute_fit, time_step_error
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen, ScreenedChange
from discrepancy.search_settings import SEARCH

from . import other_optima
from .fitted_candidates import FittedCandidates
from .free_shapes import fits_of_free_shape
from .starts import (
    FitStart,
    OnProgress,
    best_changes_by_effect,
    best_pairs,
    changes_structure,
    grid_starts,
    ignore_progress,
    moves_frequencies,
    report_each,
    start_with_added_effect,
)


@dataclass
class Search(FittedCandidates):
    """A search for the effects that explain a campaign: screen, fit, add, drop.

    Attributes
    ----------
    screened_gains : dict of str to float
        The largest decrease of the misfit by each effect, as expected by the screen at the fit
        without effect [nat].
    on_progress : callable
        The function that receives a line for the progress display: the fit that runs, and how many
        remain.
    wide_problem : Problem or None
        The problem under the wider noise of `wide_fits`, which is as large as the residuals of the
        best hypothesis.
    force_estimates : list of Estimate
        The sets of effects that were fitted to the missing force, the most probable first.
    """

    screened_gains: dict[str, float] = field(default_factory=dict)
    on_progress: OnProgress = ignore_progress
    wide_problem: Problem | None = None
    force_estimates: list[Estimate] = field(init=False, default_factory=list)

    @cached_property
    def force_search(self) -> ForceSearch | None:
        """The search for missing forces in the trials in motion; None if they show no force."""
        if not can_estimate_forces(self.problem):
            return None
        self.on_progress("looking for the missing force")
        try:
            return ForceSearch(self.problem)
        except (ModelError, np.linalg.LinAlgError) as cause:
            self.on_progress(f"the missing force cannot be estimated: {cause}")
            return None

    def estimate_of(self, candidate: Candidate) -> Estimate | None:
        """Return the estimate of a set of effects with the missing force; None without one."""
        for estimate in self.force_estimates:
            if estimate.candidate.key == candidate.key:
                return estimate
        return None

    # ---------------------------------------------------------------- rough fits of one more effect

    def fit_one_more_effect(
        self, base: CandidateFit, effects: Iterable[Effect]
    ) -> list[CandidateFit]:
        """Add each effect to a base, one at a time, and fit the sets in a few steps.

        The fits begin where a screen, which is linear, expects the best fit. If the base is far
        from the truth, its phases drift away from those of the readings, and a screen does not see
        that. Effects of the structure are then fitted from the best points of a grid. If the base
        is far only because it moves shared unknowns, they are fitted from the screen, too, and the
        grid is left out if one of these fits passes the test of absolute fit.

        Returns
        -------
        list of CandidateFit
            The best fit of each effect, in descending order of score.
        """
        effects = tuple(effects)
        structural_effects: list[Effect] = []
        reading_effects: list[Effect] = []
        for effect in effects:
            acts_on_structure = changes_structure(effect, self.problem.setting)
            (structural_effects if acts_on_structure else reading_effects).append(effect)
        has_large_residuals = self._has_large_residuals(base)
        # with large residuals a screen is used only for errors of readings, which shift no phases
        screened_effects = reading_effects if has_large_residuals else effects
        fits = self._fit_from_screen(base, screened_effects)
        # effects of the structure begin at a grid, too, where the screen is blind or found nothing
        some_fit_passes = any(
            check_absolute_fit(self.problem, fit).passed and not self._is_far_from_truth(fit)
            for fit in fits
        )
        is_far = self._is_far_from_truth(base)
        effects_on_grid: list[Effect] = []
        if has_large_residuals or (is_far and not some_fit_passes):
            effects_on_grid = structural_effects
        elif is_far and self.problem.model.nuisance_parameters:
            # an error of a sensor that passes by moving gains, too, is no reason to leave them out
            effects_on_grid = [
                effect
                for effect in structural_effects
                if moves_frequencies(effect, self.problem.setting)
            ]
        if effects_on_grid:
            unbiased_base = self._with_unbiased_nuisances(base)
            starts_by_effect = []
            for effect in effects_on_grid:
                starts = grid_starts(self.problem, unbiased_base, effect)
                if starts:
                    starts_by_effect.append(starts)
            fits += self._fit_from_starts(starts_by_effect, unbiased_base, least_gain=0.0)
        # keep the best fit of each set of effects
        best_by_effects: dict[tuple[str, ...], CandidateFit] = {}
        for fit in sorted(fits, key=self.score):
            self.record_fit(fit, exact=False)
            best_by_effects[fit.candidate.identifiers] = fit  # a later one has a higher score
        return sorted(best_by_effects.values(), key=self.score, reverse=True)

    def _has_large_residuals(self, base: CandidateFit) -> bool:
        """Return whether χ² per sample of a fit is above `SEARCH.far_chi_square`."""
        return base.chi_square > SEARCH.far_chi_square * float(self.problem.sample_counts.sum())

    def _is_far_from_truth(self, base: CandidateFit) -> bool:
        """Return whether a fit is far from the truth.

        Its residuals are then much larger than the noise, or a shared unknown is many deviations
        from its prior mean.
        """
        has_prior = self.problem.shared.precision > 0.0
        deviations = np.abs(base.point.shared[has_prior])
        return self._has_large_residuals(base) or bool(
            deviations.max(initial=0.0) > SEARCH.far_prior_deviations
        )

    def _fit_from_screen(self, base: CandidateFit, effects: Sequence[Effect]) -> list[CandidateFit]:
        """Fit each effect that a screen finds promising, and return the best fit of each.

        The screen predicts the gain of each effect, which is the decrease of the misfit to first
        order, at all places and on a grid of parameters. Effects with too small a gain are not
        fitted. The effect of the largest gain is fitted first.
        """
        has_effects = bool(base.candidate.terms)
        least_gain = SEARCH.least_gain_to_fit
        if has_effects:  # what the score asks of a further effect
            least_gain = SEARCH.least_gain_to_add + self._mesh_error_misfit
        starts_by_effect = []
        for changes in self._promising_changes(base, effects, least_gain):
            starts = [
                start_with_added_effect(base, change.term, change.best_values) for change in changes
            ]
            starts_by_effect.append(starts)
        return self._fit_from_starts(starts_by_effect, base, least_gain if has_effects else 0.0)

    def _promising_changes(
        self, base: CandidateFit, effects: Sequence[Effect], least_gain: float
    ) -> list[list[ScreenedChange]]:
        """Screen effects at a base, and return for each the changes that gain enough.

        Changes that gain less than `least_gain` [nat] are left out. An effect that has no other
        changes has no entry. The effect of the largest gain comes first. If the base has no effect,
        the largest gain of each effect is stored in `screened_gains`.
        """
        screen = Screen(self.problem, base)
        changes_by_effect = []
        for effect in report_each(
            self.on_progress, effects, lambda effect: f"screening {effect.identifier}"
        ):
            changes = best_changes_by_effect(screen, effect)
            if not base.candidate.terms:
                gains = [change.gain for change in changes]
                self.screened_gains[effect.identifier] = max(gains, default=0.0)
            promising_changes = [change for change in changes if change.gain >= least_gain]
            if promising_changes:
                changes_by_effect.append(promising_changes)
        return sorted(
            changes_by_effect, key=lambda changes: -max(change.gain for change in changes)
        )

    def _with_unbiased_nuisances(self, base: CandidateFit) -> CandidateFit:
        """Return the base with all nuisances at their prior means.

        The fitted nuisances of a wrong model compensate a part of its error, so fits should not
        begin with them. The objective stays that of the base. Where errors of a mesh are fitted,
        the returned base has the derivatives at the prior means.
        """
        point = replace(self.problem.prior_mean_point(base.candidate), effect=base.effect)
        if self.problem.model.nuisance_parameters:
            at_means = try_fit(self.problem, base.candidate, point, iterations=0)
            if at_means is not None:
                return replace(at_means, objective=base.objective)
        return replace(base, point=point, trial_derivatives=())

    def _fit_from_starts(
        self, starts_by_effect: Sequence[Sequence[FitStart]], base: CandidateFit, least_gain: float
    ) -> list[CandidateFit]:
        """Fit each effect in a few steps from several points, and return the best fit of each.

        A fit ends early if its objective, the negative log posterior, is not expected to come below
        a limit. The limit begins `least_gain` below the objective of the base. It falls to
        `SEARCH.largest_rough_deficit` above the best objective of all fits so far, since worse fits
        cannot become the best one.

        Parameters
        ----------
        starts_by_effect : sequence of sequence of FitStart
            For each effect, the points from which its fits start.
        base : CandidateFit
            The fit without the effect. Its derivatives with respect to nuisances are used for the
            first steps instead of new ones.
        least_gain : float
            The decrease of the objective, from that of the base, that makes a fit worthwhile [nat].

        Returns
        -------
        list of CandidateFit
            For each effect that could be fitted, its fit with the highest score.
        """
        best_fits = []
        objective_limit = base.objective - least_gain
        for starts in report_each(
            self.on_progress,
            starts_by_effect,
            lambda starts: f"fitting {starts[0].candidate.description}",
        ):
            fits: list[CandidateFit] = []
            for start in starts:
                rough_fit = try_fit(
                    self.problem,
                    start.candidate,
                    start.point,
                    nearby_derivatives=base.trial_derivatives or None,
                    iterations=SEARCH.rough_fit_iterations,
                    objective_limit=objective_limit,
                )
                if rough_fit is None:  # the effect is larger than the model allows
                    continue
                fits.append(rough_fit)
                # a fit whose objective is higher by more than this deficit cannot become the best
                objective_limit = min(
                    objective_limit, rough_fit.objective + SEARCH.largest_rough_deficit
                )
            if fits:
                best_fits.append(max(fits, key=self.score))
        return best_fits

    # ---------------------------------------------------------------- exact fits

    def fit_best_exactly(
        self, rough_fits: Sequence[CandidateFit], score_limit: float
    ) -> list[CandidateFit]:
        """Fit the best of some rough fits to convergence, and return them, the best first.

        Parameters
        ----------
        rough_fits : sequence of CandidateFit
            The rough fits, the best first.
        score_limit : float
            The score below which no candidate is fitted to convergence.
        """
        if not rough_fits:
            return []
        best_score = self.score(rough_fits[0])
        # far from the truth, the scores after few steps are only roughly in order
        margin = max(SEARCH.exact_fit_range, SEARCH.exact_fit_share * (best_score - score_limit))
        least_score = max(best_score - margin, score_limit)
        promising_fits = [
            fit for fit in rough_fits[: SEARCH.most_exact_fits] if self.score(fit) > least_score
        ]
        exact_fits = []
        for fit in report_each(
            self.on_progress,
            promising_fits,
            lambda fit: f"fitting {fit.candidate.description} until it converges",
        ):
            exact_fits.append(self.fit_to_convergence(fit))
        return sorted(exact_fits, key=lambda fit: -self.score(fit))

    def refine_time_steps(self) -> None:
        """Halve the time steps until their error in the best candidate is small against the noise.

        They are halved until `SEARCH.largest_step_reduction` at most. After each time the best
        `SEARCH.most_refitted` candidates are fitted again; no verdict depends on the others.
        """
        problem = self.problem
        while (
            problem.refinement < SEARCH.largest_step_reduction
            and time_step_error(problem, self.best()) > SEARCH.largest_step_error
        ):
            problem.refinement *= 2
            ranked_fits = sorted(self.exact_fits.values(), key=lambda fit: -self.score(fit))
            for fit in ranked_fits[: SEARCH.most_refitted]:
                if not fit.candidate.terms:
                    continue
                finer_fit = try_fit(problem, fit.candidate, fit.point)
                if finer_fit is not None:  # else the coarser fit stands
                    self.exact_fits[fit.candidate.key] = finer_fit

    # ---------------------------------------------------------------- the strategy

    def search_single_effects(self) -> None:
        """Fit all single effects, and refine the time steps for the best of them."""
        rough_fits = self.fit_one_more_effect(self.no_effect, self.effects)
        score_limit = self.score(self.no_effect) - SEARCH.largest_single_deficit
        self.fit_best_exactly(rough_fits, score_limit)
        self.refine_time_steps()

    def search_sets(self) -> None:
        """Fit laws of free shape, then sets of several effects, and improve the best set.

        Effects are added unless a law of free shape is the best fit. Further places of each effect
        and pairs are fitted only if the best set still leaves more than noise.
        """
        self.fit_free_shapes()
        self.refine_time_steps()
        # a law of free shape together with a further effect could fit nearly anything
        if not self.best().candidate.has_free_shape:
            terms = self.best().candidate.terms
            begins_with_several_places = len(terms) == 1 and terms[0].effect.at_several_places
            if not begins_with_several_places and self.is_unexplained():
                self.fit_effects_at_several_places()
            self.add_effects()
            if begins_with_several_places and self._leaves_much(self.best()):
                self.fit_effects_at_several_places()
        if not self.best().candidate.has_free_shape and self.is_unexplained():
            self.fit_pairs()
        self.move_effects()
        self.drop_effects()
        other_optima.refit_from_other_stretches(self, self.on_progress)
        other_optima.refit_masses_from_nearest_points(self, self.on_progress)
        self.refine_time_steps()

    def search_by_missing_force(self, force_search: ForceSearch) -> None:
        """Estimate sets of effects together with the missing force, and fit the best to readings.

        Sets that can imitate nearly anything are ranked, but not fitted.
        """
        force_search.begin_along_simulation(self.no_effect.point)
        self.force_estimates = rank_by_missing_force(
            force_search, self.effects, self.on_progress, on_estimates=self._keep_estimates
        )
        best_estimate = next(
            estimate
            for estimate in self.force_estimates
            if not estimate.candidate.can_imitate_nearly_anything
        )
        if best_estimate.candidate.terms:
            self.on_progress(f"fitting {best_estimate.candidate.description} until it converges")
            start = force_search.point(best_estimate)
            fit = try_fit(self.problem, best_estimate.candidate, start)
            if fit is not None:
                self.record_fit(fit, exact=True)
        self.refine_time_steps()

    def _keep_estimates(self, estimates: list[Estimate]) -> None:
        """Keep the estimates so far, which are what is known if the search is interrupted."""
        self.force_estimates = estimates

    def add_effects(self) -> None:
        """Add one effect at a time to the best set, as long as the score rises.

        A third effect is added only if two effects nearly explain the data.
        """
        current_fit = self.best()
        while 0 < len(current_fit.candidate.terms) < SEARCH.largest_set:
            if len(current_fit.candidate.terms) > 1 and self._is_far_from_truth(current_fit):
                break
            current_score = self.score(current_fit)
            present_identifiers = {term.effect.identifier for term in current_fit.candidate.terms}
            other_effects = [
                effect
                for effect in self.effects
                if effect.identifier not in present_identifiers or effect.at_several_places
            ]
            rough_fits = self.fit_one_more_effect(current_fit, other_effects)
            score_limit = current_score - SEARCH.largest_longer_set_deficit
            exact_fits = self.fit_best_exactly(rough_fits, score_limit)
            if not exact_fits or self.score(exact_fits[0]) <= current_score:
                break
            current_fit = exact_fits[0]

    def _leaves_much(self, fit: CandidateFit) -> bool:
        """Return whether a fit leaves more than noise, and more than a small part of the gap."""
        largest_remainder = SEARCH.small_remainder * self.no_effect.chi_square
        return self.is_unexplained() and fit.chi_square > largest_remainder

    def fit_effects_at_several_places(self) -> None:
        """Add further places to each effect that may act at several places at once.

        If such an effect acts at two places, it explains little at one place alone. Errors of
        sensors may then explain more, and `add_effects`, which begins with the best fit, would not
        reach it. So places are added to each such effect on its own, as long as the score rises.
        On a mesh the same holds for two different effects that change mass or stiffness, such as a
        mass and a yielding support: each of them that alone is more probable than no effect gets
        each other one added, until a set explains the data.
        """
        setting = self.problem.setting
        on_mesh = bool(self.problem.model.nuisance_parameters)
        several_places = [effect for effect in self.effects if effect.at_several_places]
        changes_of_mesh = [
            effect for effect in several_places if on_mesh and moves_frequencies(effect, setting)
        ]
        for effect in several_places:
            added_effects = changes_of_mesh if effect in changes_of_mesh else [effect]
            single_fits = [
                fit
                for fit in (*self.exact_fits.values(), *self.rough_fits.values())
                if [term.effect.identifier for term in fit.candidate.terms] == [effect.identifier]
            ]
            if not single_fits:
                continue
            current_fit = max(single_fits, key=self.score)
            if on_mesh and self.score(current_fit) < self.score(self.no_effect):
                continue
            while len(current_fit.candidate.terms) < SEARCH.largest_set:
                if on_mesh and not self.is_unexplained():
                    break
                current_score = self.score(current_fit)
                rough_fits = self.fit_one_more_effect(current_fit, added_effects)
                score_limit = current_score - SEARCH.largest_longer_set_deficit
                exact_fits = self.fit_best_exactly(rough_fits, score_limit)
                if not exact_fits or self.score(exact_fits[0]) <= current_score:
                    break
                current_fit = exact_fits[0]

    def move_effects(self) -> None:
        """Move one effect of the best set to another place, until the set explains the data.

        The place of an effect was chosen by fits of few steps, and may be wrong. The search also
        ends when no move raises the score.
        """
        best_fit = self.best()
        while len(best_fit.candidate.terms) > 1 and self.is_unexplained():
            objective_limit = best_fit.objective + SEARCH.largest_rough_deficit
            for candidate in other_optima.sets_at_other_places(
                best_fit.candidate, self.problem.setting
            ):
                if candidate.key in self.exact_fits:
                    continue
                fit = try_fit(
                    self.problem, candidate, best_fit.point, objective_limit=objective_limit
                )
                if fit is not None:
                    self.record_fit(fit, exact=True)
            if self.best() is best_fit:
                break
            best_fit = self.best()

    def drop_effects(self) -> None:
        """Drop one effect at a time from the best set, as long as the score rises.

        An effect may have become superfluous: it was added before the right one was found, or while
        the right one was at a wrong place.
        """
        best_fit = self.best()
        while len(best_fit.candidate.terms) > 1:
            objective_limit = best_fit.objective + SEARCH.largest_rough_deficit
            numbers = range(len(best_fit.candidate.terms))
            for dropped_number in numbers:
                remaining_numbers = [number for number in numbers if number != dropped_number]
                candidate, effect = best_fit.candidate.subset_of_terms(
                    remaining_numbers, best_fit.effect
                )
                start = replace(best_fit.point, effect=effect)
                fit = try_fit(self.problem, candidate, start, objective_limit=objective_limit)
                if fit is not None:
                    self.record_fit(fit, exact=True)
            if self.best() is best_fit:
                break
            best_fit = self.best()

    def fit_free_shapes(self) -> None:
        """Fit the best single effects with free shapes, see `fits_of_free_shape`.

        One law with a free shape is a simpler cause than two laws, so it is tried before pairs.
        """
        for free_fit in fits_of_free_shape(self):
            self.record_fit(free_fit, exact=True)

    def fit_pairs(self) -> None:
        """Fit the pairs of effects that should reduce the misfit most according to a screen.

        The screen is at the fit without effect. At most `SEARCH.most_fitted_pairs` pairs are
        fitted, unless they were fitted before.
        """
        screen = Screen(self.problem, self.no_effect)
        changes: list[ScreenedChange] = []
        for effect in self.effects:
            changes.extend(best_changes_by_effect(screen, effect))
        starts_by_pair = []
        for pair in best_pairs(changes, screen.inner_product_signs)[: SEARCH.most_fitted_pairs]:
            candidate = Candidate((pair.first.term, pair.second.term))
            if candidate.key in self.exact_fits:
                continue
            values = np.concatenate((pair.first.best_values, pair.second.best_values))
            start = FitStart(candidate, replace(self.no_effect.point, effect=values))
            starts_by_pair.append([start])
        # a pair that stays far above the best fit cannot become the best
        best_gain = self.no_effect.objective - self.best().objective
        least_gain = max(best_gain - SEARCH.largest_rough_deficit, 0.0)
        rough_fits = self._fit_from_starts(starts_by_pair, self.no_effect, least_gain)
        for fit in rough_fits:
            self.record_fit(fit, exact=False)
        rough_fits.sort(key=lambda fit: -self.score(fit))
        self.fit_best_exactly(rough_fits, self.score(self.best()) - SEARCH.exact_fit_range)
