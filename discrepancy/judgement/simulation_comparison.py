"""Comparison of hypotheses by simulations, under the recorded noise or a wider one.

The wider noise is as large as the residuals of the best hypothesis, see `search.wide_noise`.
"""

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import Candidate, CandidateKey, Point
from discrepancy.fits.fitting import CandidateFit, fit_free_shape, try_fit
from discrepancy.fits.gates import LEAST_SHAPE_GAIN
from discrepancy.location.residuals import FittedTrial
from discrepancy.missing_force.gap_share import OF_READINGS, GapShare
from discrepancy.missing_force.shares import LEAST_BLOCK_SAMPLES, MOST_BLOCKS
from discrepancy.search.starts import are_related
from discrepancy.search.strategy import Search
from discrepancy.search.wide_noise import (
    compare_under_wide_noise,
    refit_under_wide_noise,
    unrecorded_noise_levels,
)
from discrepancy.search_settings import SEARCH

from .comparison import Comparison, most_probable_sets
from .consistency_gate import check_consistency
from .proof import check_held_out


class _BlockSums(NamedTuple):
    """Sums over the samples of one block of a trial.

    Attributes
    ----------
    squares_without_effect, squares_with_effect : float
        The squared residuals over the noise variance, without effect and with a hypothesis.
    sample_count : float
        The number of used samples, which is the expected sum of squares of the noise alone.
    """

    squares_without_effect: float
    squares_with_effect: float
    sample_count: float


class SimulationComparison(Comparison[CandidateFit]):
    """A comparison of hypotheses by simulations that were fitted to the readings."""

    least_low_end = SEARCH.least_gap_share

    def __init__(self, search: Search) -> None:
        super().__init__(search)
        self._free_shape_fits: dict[CandidateKey, CandidateFit] = {}

    @property
    def no_effect(self) -> CandidateFit:
        """The model without an effect."""
        return self.search.compared_no_effect

    @property
    def log_evidence_of_nothing(self) -> float:
        """The log evidence of the model as it is [nat]."""
        return self.no_effect.log_evidence

    @property
    def ranked_hypotheses(self) -> Sequence[CandidateFit]:
        """All hypotheses, the most probable first."""
        return sorted(self.search.compared_fits().values(), key=lambda fit: -self.search.score(fit))

    @cached_property
    def _noise_scales(self) -> dict[str, float]:
        """The factor on the noise deviation of residual sets, by channel.

        It is 1 with a noise record. Without one, the noise of the residual sets is that of all
        residuals of the model without effect, and the factor reduces it to the level that is
        estimated from second differences.
        """
        problem = self.problem
        has_record = problem.record_freedom > 0.0
        precisions = problem.noise_precisions(self.search.no_effect.squares_by_channel)
        relative_variances = np.where(
            has_record, 1.0, precisions * unrecorded_noise_levels(problem, self.search.best())
        )
        return dict(zip(problem.channel_names, np.sqrt(relative_variances).tolist(), strict=True))

    def _compute_gap_share(self, hypothesis: CandidateFit, *, held_out: bool) -> GapShare:
        """Return the share of the gap between readings and simulation that a hypothesis explains.

        Squared residuals, in noise variances, are summed over blocks of the records for the
        bootstrap of the share. The result also has the rms of the gap beyond the noise, without
        effect and with the hypothesis, in noise deviations.
        """
        residuals_before = self.search.residuals(self.search.no_effect)
        residuals_after = self.search.residuals(hypothesis)
        trials_before = _trials_in_role(residuals_before.trials, held_out=held_out)
        trials_after = _trials_in_role(residuals_after.trials, held_out=held_out)
        blocks: list[_BlockSums] = []
        for trial_before, trial_after in zip(trials_before, trials_after, strict=True):
            blocks += self._block_sums(trial_before, trial_after)
        sums_before = np.array([block.squares_without_effect for block in blocks])
        sums_after = np.array([block.squares_with_effect for block in blocks])
        # noise has a variance of one in these units: its expected sum of squares is the count
        noise_sums = np.array([block.sample_count for block in blocks])
        return GapShare(
            squares_before=sums_before,
            squares_after=sums_after,
            noise_squares=noise_sums,
            held_out=held_out,
            trial_count=len(trials_before),
            remaining_rms=_rms_beyond_noise(sums_after, noise_sums),
            total_rms=_rms_beyond_noise(sums_before, noise_sums),
            kind=OF_READINGS,
            is_tested=True,  # the size of the law's force is not examined here
        )

    def _block_sums(self, trial_before: FittedTrial, trial_after: FittedTrial) -> list[_BlockSums]:
        """Return sums over blocks of a trial, given its residuals without effect and with effects.

        Both residuals are divided by the same noise deviation. A static trial is one block.
        """
        is_used = trial_before.used
        noise_scales = np.array([self._noise_scales[name] for name in trial_before.trial.channels])
        noise_deviation = trial_before.noise_deviation * noise_scales
        squares_before = np.where(is_used, trial_before.residual / noise_deviation, 0.0) ** 2
        squares_after = np.where(trial_after.used, trial_after.residual / noise_deviation, 0.0) ** 2
        sample_count = len(is_used)
        block_count = 1
        if trial_before.trial.is_dynamic:
            block_count = min(MOST_BLOCKS, max(1, sample_count // LEAST_BLOCK_SAMPLES))
        return [
            _BlockSums(
                float(squares_before[block].sum()),
                float(squares_after[block].sum()),
                float(is_used[block].sum()),
            )
            for block in np.array_split(np.arange(sample_count), block_count)
        ]

    def subsets(self, hypothesis: CandidateFit) -> list[CandidateFit]:
        """Return the converged fits that have some of the effects of a hypothesis."""
        return [fit for fit in super().subsets(hypothesis) if fit.candidate.key in self._exact_fits]

    @property
    def _exact_fits(self) -> dict[CandidateKey, CandidateFit]:
        """The fits that converged under the recorded noise."""
        return self.search.exact_fits

    def fit_candidate(self, candidate: Candidate, effect_values: FloatArray) -> CandidateFit | None:
        """Return the fit of a further candidate, from scaled effect parameters (E,).

        None if the candidate cannot be fitted.
        """
        no_effect = self.search.no_effect
        exact_fit = self._exact_fits.get(candidate.key)
        if exact_fit is None:
            start = Point(no_effect.point.shared, no_effect.point.local, effect_values)
            exact_fit = try_fit(self.problem, candidate, start)
        return None if exact_fit is None else self._fit_under_compared_noise(exact_fit)

    def _fit_under_compared_noise(self, exact_fit: CandidateFit) -> CandidateFit | None:
        """Return a hypothesis fitted under the compared noise; None if it cannot be fitted."""
        wide_problem = self.search.wide_problem or self.problem
        return refit_under_wide_noise(self.problem, wide_problem, exact_fit)

    def simulation_of_best_fit(self, hypothesis: CandidateFit) -> CandidateFit:
        """Return the hypothesis, fitted until it converges."""
        return self.search.fit_to_convergence(hypothesis)

    def fit_probable_sets(self) -> None:
        """Fit the most probable sets to convergence, as a fit by few steps is only approximate."""
        for _ in range(SEARCH.largest_group):
            converged_sets = {fit.candidate.identifiers for fit in self._exact_fits.values()}
            rough_sets = [
                identifiers
                for identifiers in most_probable_sets(self.set_probabilities())
                if identifiers not in converged_sets
            ]
            if not rough_sets:
                break
            self.search.fit_to_convergence(self.best_of_set(rough_sets[0]))

    def admit_remainder(self) -> None:
        """Compare the hypotheses under a noise as large as the residuals of the best one."""
        compare_under_wide_noise(self.search)
        self._subsets.clear()  # they were fitted under the recorded noise

    def admit_no_remainder(self) -> None:
        """Compare the hypotheses under the recorded noise again."""
        self.search.wide_problem = None
        self.search.wide_fits = {}

    def add_free_shape_families(self) -> None:
        """Add laws of free shape to the compared fits, if the best hypothesis is a single law.

        The best law and those that are easily mistaken for it are fitted with a free shape. A fit
        is added if its evidence is above that of the best law by more than `LEAST_SHAPE_GAIN`.
        """
        best_fit = self.search.best()
        if len(best_fit.candidate.terms) != 1 or not self.acts_on_structure(
            best_fit.candidate.terms[0]
        ):
            return
        compared = dict(self.search.wide_fits)
        for single_fit in self._single_laws_like(best_fit):
            free_shape_fit = fit_free_shape(self.problem, single_fit, 0)
            wide_free_shape_fit = (
                None if free_shape_fit is None else self._fit_under_compared_noise(free_shape_fit)
            )
            if wide_free_shape_fit is None:
                continue
            self._free_shape_fits[single_fit.candidate.key] = wide_free_shape_fit
            if wide_free_shape_fit.log_evidence > best_fit.log_evidence + LEAST_SHAPE_GAIN:
                compared[wide_free_shape_fit.candidate.key] = wide_free_shape_fit
        self.search.wide_fits = compared

    def _single_laws_like(self, best_fit: CandidateFit) -> list[CandidateFit]:
        """Return fits of single laws to repeat with a free shape: the best law and related ones.

        Related laws are those that are easily mistaken for the best one (`are_related`), at any
        place. Laws without a shape parameter, or whose shape is free already, are left out, be it
        the best law itself. Of several fits of a family at a place, the one with the highest score
        is returned.
        """
        (best_term,) = best_fit.candidate.terms
        single_fits: dict[tuple[str, str], CandidateFit] = {}
        fits = (*self.search.rough_fits.values(), *self.search.exact_fits.values())
        for other_fit in fits:
            if len(other_fit.candidate.terms) != 1:
                continue
            (term,) = other_fit.candidate.terms
            has_shape_to_free = bool(term.effect.shape) and not term.free_shape
            if not has_shape_to_free or not self.acts_on_structure(term):
                continue
            if term == best_term or are_related(term.effect, best_term.effect):
                key = (term.effect.family, term.place)
                single_fits[key] = max(
                    single_fits.get(key, other_fit), other_fit, key=self.search.score
                )
        return list(single_fits.values())

    def fit_with_free_shape(self, hypothesis: CandidateFit) -> CandidateFit | None:
        """Return the fit of a single law with its shape free; None if there is none."""
        if hypothesis.candidate.has_free_shape:
            return hypothesis
        return self._free_shape_fits.get(hypothesis.candidate.key)

    def failed_check_reason(self, hypothesis: CandidateFit) -> str:
        """Return the reason why a hypothesis fails the test of consistency or of held-out trials.

        It is empty if the hypothesis fails neither, or if its residuals are more than noise anyway.
        Held-out trials are not tested if it explains nearly all of the gap there: the verdict then
        states how much remains.
        """
        if hypothesis.residual_process is not None:
            return ""
        gates = [check_consistency(self.problem, hypothesis)]
        if not self._explains_nearly_all_held_out(hypothesis):
            gates.append(check_held_out(self.search.residuals(hypothesis)))
        return next((gate.reason for gate in gates if gate.has_failed), "")

    def _explains_nearly_all_held_out(self, hypothesis: CandidateFit) -> bool:
        """Return whether a hypothesis surely explains nearly all of the gap in held-out trials."""
        if not self.has_held_out:
            return False
        low_end, _ = self.gap_share(hypothesis, held_out=True).interval
        return low_end > SEARCH.nearly_complete_share

    def _compute_simulation(self, hypothesis: CandidateFit) -> CandidateFit:
        """Return the hypothesis, which is a simulation itself."""
        return hypothesis

    def unexplained_text(self, hypothesis: CandidateFit, share: GapShare) -> str:
        """Return in words how much of the gap a hypothesis does not explain."""
        return (
            f"{share.remaining_rms:.3g} of {share.total_rms:.3g} noise deviations "
            "(rms beyond the noise)"
        )


def _trials_in_role(trials: Iterable[FittedTrial], *, held_out: bool) -> list[FittedTrial]:
    """Return the trials that were held out, or those that were not."""
    return [fitted_trial for fitted_trial in trials if fitted_trial.trial.held_out is held_out]


def _rms_beyond_noise(sums: FloatArray, noise_sums: FloatArray) -> float:
    """Return the rms residual beyond the noise, in noise deviations.

    It is computed from the sums of squared residuals of blocks (B,), and from the part that the
    noise is expected to have in them (B,).
    """
    return float(np.sqrt(max(sums.sum() / noise_sums.sum() - 1.0, 0.0)))
