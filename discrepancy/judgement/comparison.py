"""Comparison of hypotheses where none leaves noise alone.

Which may be named, and what objects to others.

Where no simulation leaves noise alone, hypotheses are compared by their simulations under a wider
noise, or by the missing force that they follow. In both ways each hypothesis has evidence, and
explains a share of the gap, in the trials that were fitted and in those that were held out.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache, cached_property
from typing import Generic, TypeVar

import numpy as np
from scipy.special import logsumexp
from scipy.stats import chi2

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, CandidateKey, EffectTerm, Point
from discrepancy.fits.fitting import CandidateFit, attempt, fit, fit_free_shape
from discrepancy.fits.gates import ABSOLUTE_LEVEL, SHAPE_GAIN, check_absolute_fit
from discrepancy.fits.predictive import residual_set
from discrepancy.location.residuals import FittedTrial, ResidualSet
from discrepancy.missing_force.explained import ForceHypothesis
from discrepancy.missing_force.naming import ForceSearch
from discrepancy.missing_force.shares import (
    OF_READINGS,
    SHORTEST,
    WINDOWS,
    ForceShares,
    GapShare,
    missing_force,
)
from discrepancy.proof_record import ClosedShare
from discrepancy.search.starts import acts_within, are_related
from discrepancy.search.strategy import Search
from discrepancy.search.wide_noise import refit_under_wide_noise, unrecorded_noise_levels
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate

from .closed_share import closed_text
from .conclusion import ComparedHypothesis
from .consistency_gate import check_consistency
from .proof import check_held_out, closed_share_or_reason

LEAST_CONTRADICTING = -0.1
"""Share of the gap below which held-out trials in which a law has hardly any force contradict
it."""

H = TypeVar("H", bound=ComparedHypothesis)
EffectsAtPlaces = frozenset[tuple[str, str]]
"""Pairs of an effect, or a family of effects, and its place."""


class Comparison(ABC, Generic[H]):
    """Hypotheses of a search that are compared with each other.

    Parameters
    ----------
    search : Search
        The search whose hypotheses they are.

    Attributes
    ----------
    least_low_end : float
        The least lower end of the interval of the share that a name needs.
    has_held_out : bool
        Whether there are trials that were not fitted.
    standing : H or None
        The hypothesis that the verdict is about, once there is one.
    """

    least_low_end: float

    def __init__(self, search: Search) -> None:
        self.search = search
        self.problem = search.problem
        self.has_held_out = bool(self.problem.campaign.held_out)
        self.standing: H | None = None
        self._subsets: dict[CandidateKey, H | None] = {}
        # each is computed once for a hypothesis
        self.share = cache(self._gap_share)
        self.simulation = cache(self._simulation)
        self.closed_share = cache(self._closed_share)
        self.residuals = cache(self._residuals)

    # ---------------------------------------------------------------- how they are compared

    @property
    @abstractmethod
    def no_effect(self) -> H:
        """The hypothesis without an effect."""

    @property
    @abstractmethod
    def ranked(self) -> Sequence[H]:
        """All hypotheses, the most probable first."""

    @abstractmethod
    def gap_sentence(self) -> str:
        """Return a sentence on what is known of the gap; empty if nothing is."""

    @abstractmethod
    def _gap_share(self, hypothesis: H, *, held_out: bool) -> GapShare:
        """Return the share of the gap that a hypothesis explains, in fitted or held-out trials."""

    @abstractmethod
    def fit_followed(self, candidate: Candidate, effect: FloatArray) -> H | None:
        """Return a further hypothesis, begun at scaled effect parameters (E,).

        None if it cannot be fitted.
        """

    @abstractmethod
    def with_free_shape(self, hypothesis: H) -> H | None:
        """Return a hypothesis of one law with its shape free, if that was compared."""

    @abstractmethod
    def start_point(self, hypothesis: H) -> Point:
        """Return the point from which the simulation of a hypothesis is fitted."""

    @abstractmethod
    def check_fit(self, hypothesis: H) -> Gate:
        """Test whether the simulation that a hypothesis rests on leaves noise alone."""

    @abstractmethod
    def failed_check(self, hypothesis: H) -> str:
        """Return what a hypothesis that leaves noise alone fails nevertheless; empty if nothing."""

    @abstractmethod
    def _simulation(self, hypothesis: H) -> CandidateFit:
        """Return the simulation that stands for a hypothesis."""

    @abstractmethod
    def remaining_text(self, hypothesis: H, share: GapShare) -> str:
        """Return in words how much of the gap a hypothesis leaves, of how much there is."""

    def score(self, hypothesis: H) -> float:
        """Return ln (evidence times prior) of a hypothesis [nat]."""
        return hypothesis.log_evidence + self.search.log_prior(hypothesis.candidate)

    def passes_absolute_fit(self, hypothesis: H) -> bool:
        """Return whether the simulation of a hypothesis leaves no more than the recorded noise."""
        simulation = self.search.exact_fits.get(hypothesis.candidate.key)
        if simulation is None:
            start = self.start_point(hypothesis)
            simulation = attempt(self.problem, hypothesis.candidate, start)
        if simulation is None:
            return False
        return check_absolute_fit(self.problem, simulation).passed is not False

    def _residuals(self, simulation: CandidateFit) -> ResidualSet:
        """Return the fitted and held-out trials beside the predictions of a simulation."""
        return residual_set(self.problem, simulation, sensitivities=False)

    def _closed_share(self, hypothesis: H) -> tuple[ClosedShare | None, str]:
        """Return the share of the mean square error that a hypothesis removes, and it in words.

        It is that of simulations without and with the hypothesis, whatever hypotheses are compared
        by. Where no share can be given it is None with the reason.
        """
        before = self.residuals(self.search.no_effect)
        after = self.residuals(self.simulation(hypothesis))
        closed, reason = closed_share_or_reason(before, after)
        if closed is None:
            clause = f"{reason[0].lower()}{reason[1:-1]}"
            return None, clause
        return closed, closed_text(before, after, closed)

    def enlarges_error(self, hypothesis: H) -> bool:
        """Return whether a hypothesis makes the error larger, or cannot be simulated."""
        closed, _ = self.closed_share(hypothesis)
        if self.simulation(hypothesis) is self.search.no_effect:
            return True
        return closed is not None and closed.grew

    # ---------------------------------------------------------------- which may be named

    def decisive_share(self, hypothesis: H) -> GapShare:
        """Return the share of the gap that counts.

        In held-out trials if any can test the hypothesis.
        """
        if self.has_held_out:
            held_out_share = self.share(hypothesis, held_out=True)
            if held_out_share.tested:
                return held_out_share
        return self.share(hypothesis, held_out=False)

    def acts_on_structure(self, term: EffectTerm) -> bool:
        """Return whether a term acts on the structure, and does not only describe readings."""
        return acts_within(term.effect, self.problem.setting)

    def objection(self, hypothesis: H) -> str:
        """Return why a hypothesis cannot be a name; empty if nothing objects to it."""
        candidate = hypothesis.candidate
        if not any(self.acts_on_structure(term) for term in candidate.terms):
            return "it describes readings, causes nothing and leaves more than noise"
        if candidate.is_family and len(candidate.terms) > 1:
            return "beside another law a shape of its own imitates nearly anything"
        fitted_share = self.share(hypothesis, held_out=False)
        if _is_small(fitted_share, self.least_low_end):
            return f"where it was fitted it leaves {self.remaining_text(hypothesis, fitted_share)}"
        if self.has_held_out and not self._survives_held_out(hypothesis, self.least_low_end):
            held_out_share = self.share(hypothesis, held_out=True)
            remaining = self.remaining_text(hypothesis, held_out_share)
            return f"in trials that were not fitted it leaves {remaining}"
        strained = self._strained_unknowns(hypothesis)
        if strained:
            return f"it needs {strained} far beside their priors: are these what you would bet on?"
        return self.failed_check(hypothesis)

    def _strained_unknowns(self, hypothesis: H) -> str:
        """Return which kind of shared unknowns a hypothesis moves far from their priors.

        Empty if none.

        The priors count as wider than stated, since calibrated values take up what the hypothesis
        leaves.
        """
        shared = self.problem.shared
        has_prior = shared.precision > 0.0
        kinds = {
            "calibrated parameters": slice(shared.count),
            "gains": slice(shared.count, None),
        }
        for kind, numbers in kinds.items():
            u = hypothesis.shared[numbers][has_prior[numbers]]
            if u.size and chi2.sf(u @ u / SEARCH.widened**2, u.size) < ABSOLUTE_LEVEL:
                return kind
        return ""

    def _survives_held_out(self, hypothesis: H, least_low_end: float) -> bool:
        """Return whether held-out trials confirm a hypothesis, or cannot test it.

        Trials that cannot test it must not contradict it either.
        """
        share = self.share(hypothesis, held_out=True)
        if share.tested:
            return not _is_small(share, least_low_end)
        return share.value > LEAST_CONTRADICTING

    @cached_property
    def contenders(self) -> list[H]:
        """The hypotheses that may be named, as data do not exclude them, the most probable first.

        Errors of readings are no part of a name: beside a law they take up whatever it leaves.
        """
        contenders: dict[CandidateKey, tuple[H, float]] = {}
        for hypothesis in self.ranked:
            terms = hypothesis.candidate.terms
            laws = [number for number, term in enumerate(terms) if self.acts_on_structure(term)]
            core: H | None = hypothesis
            if 0 < len(laws) < len(terms):
                core = self._subset(hypothesis, laws)
            if not terms or core is None or core.candidate.key in contenders:
                continue
            if not self.objection(core):
                contenders[core.candidate.key] = (core, self.score(hypothesis))
        best_score = max((score for _, score in contenders.values()), default=0.0)
        least_score = best_score - SEARCH.contenders
        return [hypothesis for hypothesis, score in contenders.values() if score > least_score]

    def _subset(self, hypothesis: H, numbers: Sequence[int]) -> H | None:
        """Return the hypothesis of some of the terms of a hypothesis, given their indices."""
        candidate, effect = hypothesis.candidate.subset(numbers, hypothesis.effect)
        key = candidate.key
        for known in self.ranked:
            if known.candidate.key == key:
                return known
        if key not in self._subsets:
            self._subsets[key] = self.fit_followed(candidate, effect)
        return self._subsets[key]

    def simplest_equivalent(self, best: H) -> H:
        """Return the simplest hypothesis that explains as much of the gap as a given one."""
        count = len(best.candidate.terms)
        options: dict[CandidateKey, H] = {}
        for hypothesis in self.ranked:
            options[hypothesis.candidate.key] = hypothesis
        if count > 1:
            for number in range(count):
                single = self._subset(best, [number])
                if single is not None:
                    options[single.candidate.key] = single
        simpler = [option for option in options.values() if self._is_simpler(option, best)]
        return min(
            simpler,
            key=lambda hypothesis: (*_complexity(hypothesis), -self.score(hypothesis)),
            default=best,
        )

    def _is_simpler(self, option: H, best: H) -> bool:
        """Return whether a hypothesis is simpler than the best one and may replace it."""
        if not option.candidate.terms or _complexity(option) >= _complexity(best):
            return False
        if not families_at_places(option) <= families_at_places(best):
            return False
        fitted_share = self.share(option, held_out=False).value
        if fitted_share <= self.share(best, held_out=False).value - 3.0 * SEARCH.slim:
            return False
        if self.decisive_share(option).value <= self.decisive_share(best).value - SEARCH.slim:
            return False
        return not self.objection(option)

    def probability(self, *hypotheses: H) -> float:
        """Return the probability that one of some hypotheses holds.

        A hypothesis holds, too, where another one has all of its families at its places. Refuted
        hypotheses have no probability.
        """
        remaining = []
        for other in self.ranked:
            is_asked = any(other is hypothesis for hypothesis in hypotheses)
            if is_asked or not other.candidate.terms or not self._is_refuted(other):
                remaining.append(other)
        scores = np.array([self.score(other) for other in remaining])
        asked = [families_at_places(hypothesis) for hypothesis in hypotheses]
        includes_asked = []
        for other in remaining:
            families = families_at_places(other)
            includes_asked.append(any(asked_families <= families for asked_families in asked))
        holds = np.array(includes_asked)
        if not holds.any():
            return 0.0
        return float(np.exp(logsumexp(scores[holds]) - logsumexp(scores)))

    def _is_refuted(self, hypothesis: H) -> bool:
        """Return whether trials show that a hypothesis does not explain the gap."""
        _, high = self.share(hypothesis, held_out=False).interval
        if high < SEARCH.least_share:
            return True
        return self.has_held_out and not self._survives_held_out(hypothesis, 0.0)

    def competitors(self, best: H) -> list[H]:
        """Return other names that neither evidence nor trials separate from the best one."""
        best_share = self.decisive_share(best)
        least_score = self.score(best) - SEARCH.force_rival
        others: dict[EffectsAtPlaces, H] = {}
        for hypothesis in self.contenders:
            candidate = hypothesis.candidate
            is_same_family = families_at_places(hypothesis) == families_at_places(best)
            is_longer = len(candidate.terms) > len(best.candidate.terms)
            if (candidate.is_family and is_same_family) or is_longer:
                continue
            if self.score(hypothesis) <= least_score:
                continue
            if not best_share.is_larger_than(self.decisive_share(hypothesis)):
                others.setdefault(effects_at_places(hypothesis), hypothesis)
        others.pop(effects_at_places(best), None)
        return list(others.values())


def _is_small(share: GapShare, least_low_end: float) -> bool:
    """Return whether the interval of a share is too low for a name."""
    low, high = share.interval
    return high < SEARCH.least_share or low < least_low_end


def families_at_places(hypothesis: ComparedHypothesis) -> EffectsAtPlaces:
    """Return the families of a hypothesis with their places."""
    return frozenset((term.effect.family, term.place) for term in hypothesis.candidate.terms)


def effects_at_places(hypothesis: ComparedHypothesis) -> EffectsAtPlaces:
    """Return the effects of a hypothesis with their places."""
    return frozenset((term.effect.identifier, term.place) for term in hypothesis.candidate.terms)


def _complexity(hypothesis: ComparedHypothesis) -> tuple[int, int]:
    """Return the number of effects of a hypothesis, and of those whose shape is free."""
    terms = hypothesis.candidate.terms
    return len(terms), sum(term.free_shape for term in terms)


# ---------------------------------------------------------------- by simulations


class SimulationComparison(Comparison[CandidateFit]):
    """Hypotheses compared by simulations, fitted under the noise that the best of them leaves."""

    least_low_end = SEARCH.least_share

    def __init__(self, search: Search) -> None:
        super().__init__(search)
        self._free_shape_fits: dict[CandidateKey, CandidateFit] = {}

    @property
    def no_effect(self) -> CandidateFit:
        """The model without an effect, under the wider noise."""
        return self.search.compared_no_effect

    @property
    def ranked(self) -> Sequence[CandidateFit]:
        """All hypotheses, the most probable first."""
        return sorted(self.search.compared_fits().values(), key=lambda fit: -self.search.score(fit))

    def gap_sentence(self) -> str:
        """Return an empty sentence: simulations do not show what the gap is."""
        return ""

    @cached_property
    def _noise_scale(self) -> dict[str, float]:
        """The noise deviation by channel, relative to that of residual sets.

        Without a noise record that of residual sets is all that the model without effect leaves.
        """
        problem = self.problem
        has_record = problem.freedom > 0.0
        precisions = problem.precisions(self.search.no_effect.sums)
        levels = np.where(
            has_record, 1.0, precisions * unrecorded_noise_levels(problem, self.search.best())
        )
        return dict(zip(problem.channel_names, np.sqrt(levels).tolist(), strict=True))

    def _gap_share(self, hypothesis: CandidateFit, *, held_out: bool) -> GapShare:
        """Return the share of the gap between readings and simulation that is explained."""
        blocks = []
        trial_count = 0
        without_effect = self.residuals(self.search.no_effect).trials
        with_effect = self.residuals(hypothesis).trials
        for before, after in zip(
            _in_role(without_effect, held_out=held_out),
            _in_role(with_effect, held_out=held_out),
            strict=True,
        ):
            noise = before.noise_deviation * [
                self._noise_scale[name] for name in before.trial.channels
            ]
            squares_before = np.where(before.used, before.residual / noise, 0.0) ** 2
            squares_after = np.where(after.used, after.residual / noise, 0.0) ** 2
            sample_count = len(before.used)
            block_count = 1
            if before.trial.is_dynamic:
                block_count = min(WINDOWS, max(1, sample_count // SHORTEST))
            for block in np.array_split(np.arange(sample_count), block_count):
                sums = [
                    float(squares[block].sum())
                    for squares in (squares_before, squares_after, before.used)
                ]
                blocks.append(sums)
            trial_count += 1
        sums_before, sums_after, noise_sums = np.array(blocks).T
        return GapShare(
            before=sums_before,
            after=sums_after,
            noise=noise_sums,
            held_out=held_out,
            trial_count=trial_count,
            remaining_rms=_rms_beyond_noise(sums_after, noise_sums),
            total_rms=_rms_beyond_noise(sums_before, noise_sums),
            kind=OF_READINGS,
            tested=True,
        )

    def fit_followed(self, candidate: Candidate, effect: FloatArray) -> CandidateFit | None:
        """Return a further hypothesis, begun at scaled effect parameters (E,).

        None if it cannot be fitted.
        """
        no_effect = self.search.no_effect
        fitted = self.search.exact_fits.get(candidate.key)
        if fitted is None:
            start = Point(no_effect.point.shared, no_effect.point.local, effect)
            fitted = attempt(self.problem, candidate, start)
        return None if fitted is None else self._under_wide_noise(fitted)

    def _under_wide_noise(self, fitted: CandidateFit) -> CandidateFit | None:
        """Return a fit under the wider noise by which hypotheses are compared."""
        wide_problem = self.search.wide_problem or self.problem
        return refit_under_wide_noise(self.problem, wide_problem, fitted)

    def add_families(self) -> None:
        """Compare the best law, and those easily taken for it, with free shapes too.

        A free shape is compared only where the best hypothesis is a single law, and only if its
        evidence is clearly above that of the law.
        """
        best = self.search.best()
        if len(best.candidate.terms) != 1 or not self.acts_on_structure(best.candidate.terms[0]):
            return
        compared = dict(self.search.wide_fits)
        for single in self._related_single_laws(best):
            free = fit_free_shape(self.problem, single, 0)
            wide_free = None if free is None else self._under_wide_noise(free)
            if wide_free is None:
                continue
            self._free_shape_fits[single.candidate.key] = wide_free
            if wide_free.log_evidence > best.log_evidence + SHAPE_GAIN:
                compared[wide_free.candidate.key] = wide_free
        self.search.wide_fits = compared

    def _related_single_laws(self, best: CandidateFit) -> list[CandidateFit]:
        """Return the best fit of each family of laws that is easily taken for the best law."""
        (best_term,) = best.candidate.terms
        singles: dict[tuple[str, str], CandidateFit] = {}
        fits = (*self.search.rough_fits.values(), *self.search.exact_fits.values())
        for fitted in fits:
            if len(fitted.candidate.terms) != 1:
                continue
            (term,) = fitted.candidate.terms
            has_shape_to_free = bool(term.effect.shape) and not term.free_shape
            if not has_shape_to_free or not self.acts_on_structure(term):
                continue
            if term == best_term or are_related(term.effect, best_term.effect):
                key = (term.effect.family, term.place)
                singles[key] = max(singles.get(key, fitted), fitted, key=self.search.score)
        return list(singles.values())

    def with_free_shape(self, hypothesis: CandidateFit) -> CandidateFit | None:
        """Return a hypothesis of one law with its shape free, if that was compared."""
        if hypothesis.candidate.is_family:
            return hypothesis
        return self._free_shape_fits.get(hypothesis.candidate.key)

    def start_point(self, hypothesis: CandidateFit) -> Point:
        """Return the point of a hypothesis."""
        return hypothesis.point

    def check_fit(self, hypothesis: CandidateFit) -> Gate:
        """Test whether the simulation of a hypothesis leaves noise alone."""
        return check_absolute_fit(self.problem, hypothesis)

    def failed_check(self, hypothesis: CandidateFit) -> str:
        """Return the reason of a failed test of a hypothesis that leaves noise alone.

        Empty if none.
        """
        if hypothesis.residual_process is not None:
            return ""
        gates = (
            check_consistency(self.problem, hypothesis),
            check_held_out(self.residuals(hypothesis)),
        )
        return next((gate.reason for gate in gates if gate.passed is False), "")

    def _simulation(self, hypothesis: CandidateFit) -> CandidateFit:
        """Return the hypothesis, which is a simulation itself."""
        return hypothesis

    def remaining_text(self, hypothesis: CandidateFit, share: GapShare) -> str:
        """Return in words how much of the gap a hypothesis leaves, of how much there is."""
        return (
            f"{share.remaining_rms:.3g} of {share.total_rms:.3g} noise deviations "
            "(rms beyond the noise)"
        )


def _in_role(trials: Iterable[FittedTrial], *, held_out: bool) -> list[FittedTrial]:
    """Return the trials that were held out, or those that were not."""
    return [fitted for fitted in trials if fitted.trial.held_out is held_out]


def _rms_beyond_noise(sums: FloatArray, noise_sums: FloatArray) -> float:
    """Return the rms beyond the noise, in noise deviations, given sums of squares by block (B,)."""
    return float(np.sqrt(max(sums.sum() / noise_sums.sum() - 1.0, 0.0)))


# ---------------------------------------------------------------- by the missing force


class ForceComparison(Comparison[ForceHypothesis]):
    """Hypotheses compared by how they follow the missing force.

    Parameters
    ----------
    search : Search
        The search whose hypotheses they are.
    force_search : ForceSearch
        The search for the missing force.
    """

    least_low_end = SEARCH.least_end

    def __init__(self, search: Search, force_search: ForceSearch) -> None:
        super().__init__(search)
        self.force_search = force_search
        self._force_shares = ForceShares(force_search)
        self.has_held_out = self._force_shares.has_held_out

    @property
    def no_effect(self) -> ForceHypothesis:
        """The missing forces alone."""
        return self.force_search.whole

    @property
    def ranked(self) -> Sequence[ForceHypothesis]:
        """All hypotheses, the most probable first."""
        return self.search.force_hypotheses

    def _gap_share(self, hypothesis: ForceHypothesis, *, held_out: bool) -> GapShare:
        """Return the share of the missing force that a hypothesis explains."""
        return self._force_shares.share_of(hypothesis, held_out=held_out)

    def fit_followed(self, candidate: Candidate, effect: FloatArray) -> ForceHypothesis | None:
        """Return a further hypothesis, begun at scaled effect parameters (E,).

        None if it cannot be fitted.
        """
        return self.force_search.followed(self.force_search.whole, candidate, effect)

    def with_free_shape(self, hypothesis: ForceHypothesis) -> ForceHypothesis | None:
        """Return a hypothesis of one law with its shape free, if that was compared."""
        (term,) = hypothesis.candidate.terms
        key = Candidate((replace(term, free_shape=True),)).key
        return next((other for other in self.ranked if other.candidate.key == key), None)

    def start_point(self, hypothesis: ForceHypothesis) -> Point:
        """Return the point of a hypothesis along the missing force."""
        return self.force_search.whole_point(hypothesis)

    def failed_check(self, hypothesis: ForceHypothesis) -> str:
        """Return an empty reason: there are no further tests along the missing force."""
        return ""

    def check_fit(self, hypothesis: ForceHypothesis) -> Gate:
        """Test whether the best simulation leaves noise alone."""
        return check_absolute_fit(self.problem, self.search.best())

    def _simulation(self, hypothesis: ForceHypothesis) -> CandidateFit:
        """Return the simulation of a hypothesis at its values, with their covariance.

        It is the fit without effect if the hypothesis cannot be simulated.
        """
        start = self.start_point(hypothesis)
        try:
            simulation = fit(self.problem, hypothesis.candidate, start, local_only=True)
        except (DiscrepancyError, np.linalg.LinAlgError):
            return self.search.no_effect
        return replace(simulation, covariance=hypothesis.covariance)

    def remaining_text(self, hypothesis: ForceHypothesis, share: GapShare) -> str:
        """Return in words how much a hypothesis leaves of the missing force."""
        unit = self._force_unit(hypothesis)
        return (
            f"{share.remaining_rms:.3g} of {share.total_rms:.3g} {unit} (rms) of the missing force"
        )

    def _force_unit(self, hypothesis: ForceHypothesis) -> str:
        """Return the unit of the force at a hypothesis's port, or else of the missing force."""
        ports = self.force_search.ports
        law_ports = [term.place for term in hypothesis.candidate.terms if term.place in ports]
        port = law_ports[0] if law_ports else ports[next(iter(hypothesis.processes))]
        force_unit, *_ = self.problem.model.port_units(port)
        return force_unit

    def gap_sentence(self) -> str:
        """Return a sentence on the missing force: size, port, and the variables that order it."""
        missing = missing_force(self.force_search, self.force_search.best())
        if missing is None:
            return ""
        force = missing.at_port
        order = "ordered by none of displacement, velocity, amplitude and time"
        if force.ordered_by:
            variables = " and ".join(force.ordered_by)
            percent = 100.0 * max(force.orders.values())
            order = f"ordered by {variables} ({percent:.0f} % of its variance)"
        return (
            f"A force of {force.rms:.3g} {force.unit} (rms) is missing at {force.port!r}, {order}."
        )
