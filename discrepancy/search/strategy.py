"""The search for the set of effects that explains a campaign: screen, fit, add, drop."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from discrepancy.catalogue.entry import Effect
from discrepancy.errors import ModelError
from discrepancy.estimation.refinement import refined
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit, attempt, fit_free_shape
from discrepancy.fits.gates import SHAPE_GAIN, check_absolute_fit, time_step_error
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen, ScreenedChange
from discrepancy.missing_force.explained import ForceHypothesis
from discrepancy.missing_force.hypotheses import sees_forces
from discrepancy.missing_force.naming import ForceSearch
from discrepancy.search_settings import SEARCH

from .fitted_candidates import FittedCandidates
from .other_optima import canonical_relatives, points_at_other_sizes, sets_at_other_places
from .starts import (
    FitStart,
    OnProgress,
    acts_within,
    best_pairs,
    grid_starts,
    no_progress,
    start_beside,
    starting_changes,
    with_progress,
)


@dataclass
class Search(FittedCandidates):
    """A search for the effects that explain a campaign: screen, fit, add, drop.

    Attributes
    ----------
    screened_gains : dict of str to float
        The largest gain of each effect that a screen at the fit without effect found [nat].
    on_progress : callable
        Takes a line that says what is fitted, and how much is still to come.
    wide_problem : Problem or None
        The problem under the noise by which `wide_fits` were fitted: as wide as what the best
        hypothesis leaves.
    force_hypotheses : list of ForceHypothesis
        The sets of effects that were fitted to the missing force, the most probable first.
    """

    screened_gains: dict[str, float] = field(default_factory=dict)
    on_progress: OnProgress = no_progress
    wide_problem: Problem | None = None
    force_hypotheses: list[ForceHypothesis] = field(init=False, default_factory=list)

    @cached_property
    def force_search(self) -> ForceSearch | None:
        """The search for missing forces in the trials in motion.

        None where no force can be seen.
        """
        if not sees_forces(self.problem):
            return None
        self.on_progress("looking for the missing force")
        try:
            return ForceSearch(self.problem)
        except (ModelError, np.linalg.LinAlgError) as cause:
            self.on_progress(f"the missing force cannot be seen: {cause}")
            return None

    # ---------------------------------------------------------------- rough fits of one more effect

    def fit_roughly_beside(
        self, base: CandidateFit, effects: Iterable[Effect]
    ) -> list[CandidateFit]:
        """Fit each effect beside those of a base by few steps.

        Return the best fit of each, best first.

        Fits begin where a screen at the base leads. Far from the truth phases slip over a record
        and nothing is linear; there they begin on a grid too, beside the missing force.

        Parameters
        ----------
        base : CandidateFit
            The fit that effects are added to.
        effects : iterable of Effect
            The effects to add.
        """
        effects = tuple(effects)
        setting = self.problem.setting
        screened = effects
        if self._misfits(base):  # only what acts on readings leaves phases alone
            screened = tuple(effect for effect in effects if not acts_within(effect, setting))
        fits = self._fit_from_screen(base, screened)
        is_explained = any(check_absolute_fit(self.problem, fit).passed for fit in fits)
        if self._misfits(base) or (self._is_far(base) and not is_explained):
            unbiased_base = self._with_unbiased_nuisances(base)
            starts_by_effect = []
            for effect in effects:
                if acts_within(effect, setting):
                    starts_by_effect.append(grid_starts(self.problem, unbiased_base, effect))
            starts_by_effect = [starts for starts in starts_by_effect if starts]
            fits += self._fit_from_starts(starts_by_effect, unbiased_base, 0.0)
        best: dict[tuple[str, ...], CandidateFit] = {}
        for fit in sorted(fits, key=self.score):
            self.record(fit, exact=False)
            best[fit.candidate.identifiers] = fit
        return sorted(best.values(), key=lambda fit: -self.score(fit))

    def _misfits(self, base: CandidateFit) -> bool:
        """Return whether a fit leaves much."""
        return base.chi_square > SEARCH.far * float(self.problem.counts.sum())

    def _is_far(self, base: CandidateFit) -> bool:
        """Return whether a fit is far from the truth.

        It leaves much, or shared unknowns left their priors.
        """
        has_prior = self.problem.shared.precision > 0.0
        deviations = np.abs(base.point.shared[has_prior])
        return self._misfits(base) or bool(deviations.max(initial=0.0) > SEARCH.strained)

    def _fit_from_screen(self, base: CandidateFit, effects: Sequence[Effect]) -> list[CandidateFit]:
        """Fit effects from where a screen at a base leads, the most promising first."""
        has_effects = bool(base.candidate.terms)
        least_gain = SEARCH.worth_adding if has_effects else SEARCH.worth_fitting
        screen = Screen(self.problem, base)
        changes_by_effect = []
        for effect in with_progress(
            self.on_progress, effects, lambda effect: f"screening {effect.identifier}"
        ):
            changes = starting_changes(screen, effect)
            if not has_effects:
                gains = [change.gain for change in changes]
                self.screened_gains[effect.identifier] = max(gains, default=0.0)
            changes_by_effect.append([change for change in changes if change.gain >= least_gain])
        changes_by_effect.sort(
            key=lambda changes: -max((change.gain for change in changes), default=0.0)
        )
        starts_by_effect = []
        for changes in changes_by_effect:
            if changes:
                starts = [start_beside(base, change.term, change.best) for change in changes]
                starts_by_effect.append(starts)
        return self._fit_from_starts(starts_by_effect, base, least_gain if has_effects else 0.0)

    def _with_unbiased_nuisances(self, base: CandidateFit) -> CandidateFit:
        """Return a base with the nuisances that it has beside a free missing force.

        The nuisances of a wrong model are far off: a bad start. Beside a free force they are where
        they belong. With trials at rest, which show no force, they are at their prior means.
        """
        point = self.problem.start(base.candidate)
        force_search = self.force_search if self.is_all_in_motion else None
        if force_search is not None:
            hypothesis = force_search.whole
            if base.candidate.terms:
                followed = force_search.followed(hypothesis, base.candidate, base.effect)
                hypothesis = followed or hypothesis
            point = force_search.whole_point(hypothesis)
        return replace(base, point=replace(point, effect=base.effect), linearisations=())

    def _fit_from_starts(
        self, starts_by_effect: Sequence[Sequence[FitStart]], base: CandidateFit, least_gain: float
    ) -> list[CandidateFit]:
        """Fit each effect by few steps from its starts; return the best fit of each.

        Parameters
        ----------
        starts_by_effect : sequence of sequence of FitStart
            The starts of the fits of each effect.
        base : CandidateFit
            The fit that effects are added to; its derivatives begin the fits.
        least_gain : float
            The gain on the objective of the base below which a fit is given up [nat].
        """
        best_fits = []
        give_up = base.objective - least_gain
        for starts in with_progress(
            self.on_progress,
            starts_by_effect,
            lambda starts: f"fitting {starts[0].candidate.description}",
        ):
            fits: list[CandidateFit] = []
            for start in starts:
                rough = attempt(
                    self.problem,
                    start.candidate,
                    start.point,
                    known=base.linearisations or None,
                    iterations=SEARCH.rough_steps,
                    give_up=give_up,
                )
                if rough is not None:  # else it is more than the structure can carry
                    fits.append(rough)
                    give_up = min(give_up, rough.objective + SEARCH.out_of_reach)
            if fits:
                best_fits.append(max(fits, key=self.score))
        return best_fits

    # ---------------------------------------------------------------- exact fits

    def fit_best_exactly(self, rough: Sequence[CandidateFit], floor: float) -> list[CandidateFit]:
        """Fit the best of some rough fits to convergence; return these, the best first.

        Parameters
        ----------
        rough : sequence of CandidateFit
            The rough fits, the best first.
        floor : float
            The score below which none is fitted exactly.
        """
        if not rough:
            return []
        top = self.score(rough[0])
        # far from the truth, few steps rank only roughly
        margin = max(SEARCH.close, SEARCH.close_share * (top - floor))
        least = max(top - margin, floor)
        chosen = [fit for fit in rough[: SEARCH.exact_fits] if self.score(fit) > least]
        exact = []
        for fit in with_progress(
            self.on_progress, chosen, lambda fit: f"fitting {fit.candidate.description} to the end"
        ):
            exact.append(self.fit_exactly(fit))
        return sorted(exact, key=lambda fit: -self.score(fit))

    def refine_time_steps(self) -> None:
        """Halve the time steps while their error in the best candidate is large, and fit again.

        Verdicts rest on the best candidates only, so these alone are fitted again.
        """
        problem = self.problem
        while (
            problem.refinement < SEARCH.finest
            and time_step_error(problem, self.best()) > SEARCH.solver_share
        ):
            problem.refinement *= 2
            ranked = sorted(self.exact_fits.values(), key=lambda fit: -self.score(fit))
            for fit in ranked[: SEARCH.refitted]:
                if not fit.candidate.terms:
                    continue
                finer = attempt(problem, fit.candidate, fit.point)
                if finer is not None:  # else the coarser fit stands
                    self.exact_fits[fit.candidate.key] = finer

    # ---------------------------------------------------------------- the strategy

    def search_single_effects(self) -> None:
        """Search among single effects, with time steps that are fine enough for the best."""
        rough = self.fit_roughly_beside(self.no_effect, self.effects)
        self.fit_best_exactly(rough, self.score(self.no_effect) - SEARCH.hopeless)
        self.refine_time_steps()

    def search_sets(self) -> None:
        """Search beyond a single effect: a law of free shape, more effects, all pairs."""
        self.fit_families()
        self.refine_time_steps()
        # beside a law whose shape is free a further effect would imitate nearly anything
        if not self.best().candidate.is_family:
            self.add_effects()
        if not self.best().candidate.is_family and self.is_unexplained():
            self.fit_pairs()
        self.move_effects()
        self.drop_effects()
        self.refine_time_steps()

    def search_along_force(self, force_search: ForceSearch) -> None:
        """Fit the sets of effects that follow the missing force best.

        They replace what was fitted before.
        """
        self.exact_fits = {(): self.no_effect}
        self.rough_fits = {}
        named = force_search.name(self.effects, self.on_progress)
        self.force_hypotheses = refined(force_search, named, len(self.effects), self.on_progress)
        eligible = []
        for hypothesis in self.force_hypotheses:
            candidate = hypothesis.candidate
            # beside another law a free shape would imitate nearly anything
            is_family_in_set = candidate.is_family and len(candidate.terms) > 1
            if candidate.terms and not is_family_in_set:
                eligible.append(hypothesis)
        close = []
        for hypothesis in eligible:
            if self.score(hypothesis) > self.score(eligible[0]) - SEARCH.followed:
                close.append(hypothesis)
        for hypothesis in with_progress(
            self.on_progress,
            close[: SEARCH.far_fits],
            lambda hypothesis: f"fitting {hypothesis.candidate.description} to the end",
        ):
            start = force_search.whole_point(hypothesis)
            fit = attempt(self.problem, hypothesis.candidate, start)
            if fit is not None:
                self.record(fit, exact=True)
        self.restart_leading_single(force_search)
        self.move_effects()
        self.drop_effects()
        self.refine_time_steps()

    def restart_leading_single(self, force_search: ForceSearch) -> None:
        """Fit the leading single effect from other sizes, unless it explains the data.

        Dry friction that ends a motion has an optimum for every number of half swings. The missing
        force leads near the right one, but the parameters that follow it may be left in the next.
        With a free shape a law bends itself to a wrong optimum, so the laws of that family with
        canonical shape are tried.
        """
        if not self.is_unexplained() and not self.best().candidate.is_family:
            return
        singles = [fit for fit in self.exact_fits.values() if len(fit.candidate.terms) == 1]
        if not singles:
            return
        (leading,) = max(singles, key=self.score).candidate.terms
        for hypothesis in canonical_relatives(leading, self.force_hypotheses):
            candidate = hypothesis.candidate
            self.on_progress(f"fitting {candidate.description} from other sizes")
            start = force_search.whole_point(hypothesis)
            for point in points_at_other_sizes(self.problem, candidate, start):
                fit = attempt(self.problem, candidate, point)
                if fit is None:
                    continue
                self.record(fit, exact=True)
                if check_absolute_fit(self.problem, fit).passed:
                    return

    def add_effects(self) -> None:
        """Add one effect at a time to the best set while that makes a better one."""
        current = self.best()
        while 0 < len(current.candidate.terms) < SEARCH.largest_set:
            if len(current.candidate.terms) > 1 and self._is_far(current):
                break  # a third effect is looked for only where two nearly explain the data
            current_score = self.score(current)
            present = {term.effect.identifier for term in current.candidate.terms}
            others = [effect for effect in self.effects if effect.identifier not in present]
            rough = self.fit_roughly_beside(current, others)
            exact = self.fit_best_exactly(rough, current_score - SEARCH.hopeless_longer)
            if not exact or self.score(exact[0]) <= current_score:
                break
            current = exact[0]

    def move_effects(self) -> None:
        """Fit the best set with one effect at another place, while the set leaves more than noise.

        Rough fits keep one place of each set, and few steps may rank places wrongly.
        """
        best = self.best()
        while len(best.candidate.terms) > 1 and self.is_unexplained():
            give_up = best.objective + SEARCH.out_of_reach
            for candidate in sets_at_other_places(best.candidate, self.problem.setting):
                if candidate.key in self.exact_fits:
                    continue
                fit = attempt(self.problem, candidate, best.point, give_up=give_up)
                if fit is not None:
                    self.record(fit, exact=True)
            if self.best() is best:
                break
            best = self.best()

    def drop_effects(self) -> None:
        """Drop one effect at a time from the best set, while that makes a better one.

        An effect may have come first because the right one stood at another place, or was not
        followed to its place: beside the right one it may say nothing.
        """
        best = self.best()
        while len(best.candidate.terms) > 1:
            give_up = best.objective + SEARCH.out_of_reach
            numbers = range(len(best.candidate.terms))
            for dropped in numbers:
                remaining = [number for number in numbers if number != dropped]
                candidate, effect = best.candidate.subset(remaining, best.effect)
                start = replace(best.point, effect=effect)
                fit = attempt(self.problem, candidate, start, give_up=give_up)
                if fit is not None:
                    self.record(fit, exact=True)
            if self.best() is best:
                break
            best = self.best()

    def fit_families(self) -> None:
        """Fit the families (free shape) of single effects that come close; record those that fit.

        A law with a free shape is a simpler cause than two laws, so it is tried before pairs are.
        Where the best effect fits, families compete only if others fit as well: its own is for the
        shape test.
        """
        singles = self._singles_with_open_shape()
        best_families: dict[tuple[str, str], CandidateFit] = {}
        for single in singles:
            family = fit_free_shape(self.problem, single, 0)
            if family is None or family.log_evidence - single.log_evidence <= SHAPE_GAIN:
                continue
            (term,) = family.candidate.terms
            # a family is one verdict: keep the fit from the member that reaches it best
            key = (term.effect.family, term.place)
            is_best = key not in best_families or self.score(best_families[key]) < self.score(
                family
            )
            if is_best and check_absolute_fit(self.problem, family).passed is not False:
                best_families[key] = family
        for family in best_families.values():
            self.record(family, exact=True)

    def _singles_with_open_shape(self) -> list[CandidateFit]:
        """Return the single effects, the best first, beside which their families may compete."""
        singles = []
        for fit in self.exact_fits.values():
            if len(fit.candidate.terms) == 1 and not fit.candidate.is_family:
                singles.append(fit)
        singles = sorted(singles, key=self.score, reverse=True)[: SEARCH.exact_fits]
        fitting = []
        for fit in singles:
            if check_absolute_fit(self.problem, fit).passed is not False:
                fitting.append(fit)
        if not fitting or fitting[0] is not singles[0]:
            return singles
        least = self.score(singles[0]) - SEARCH.rivals
        competing = [fit for fit in fitting if self.score(fit) > least]
        model_fits = check_absolute_fit(self.problem, self.no_effect).passed is not False
        if len(competing) == 1 or model_fits:
            return []
        return competing

    def fit_pairs(self) -> None:
        """Fit the most promising of all pairs of effects, by a screen at the fit without effect."""
        screen = Screen(self.problem, self.no_effect)
        changes: list[ScreenedChange] = []
        for effect in self.effects:
            changes.extend(starting_changes(screen, effect))
        starts_by_pair = []
        for pair in best_pairs(changes, screen.sign)[: SEARCH.pairs_fitted]:
            candidate = Candidate((pair.first.term, pair.second.term))
            if candidate.key in self.exact_fits:
                continue
            values = np.concatenate((pair.first.best, pair.second.best))
            start = FitStart(candidate, replace(self.no_effect.point, effect=values))
            starts_by_pair.append([start])
        rough = self._fit_from_starts(starts_by_pair, self.no_effect, 0.0)
        for fit in rough:
            self.record(fit, exact=False)
        rough.sort(key=lambda fit: -self.score(fit))
        self.fit_best_exactly(rough, self.score(self.best()) - SEARCH.close)
