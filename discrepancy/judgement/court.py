"""Hypotheses before a court: which may be named, what speaks against the others.

Where no simulation leaves noise, hypotheses are compared by their readings, or along the missing force
(`ByForce`). Each has evidence, and is a share of what is missing, in trials that were fitted and in
those that were not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from scipy.special import logsumexp
from scipy.stats import chi2

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError, said
from discrepancy.fits.candidate import Candidate, Key, Point, Term
from discrepancy.fits.fitting import CandidateFit, attempt, free_shape
from discrepancy.fits.fitting import fit as fit_to
from discrepancy.fits.gates import ABSOLUTE_LEVEL, SHAPE_GAIN, absolute_gate
from discrepancy.fits.predictive import residual_set
from discrepancy.missing_force.explained import Explained
from discrepancy.missing_force.naming import ForceSearch
from discrepancy.missing_force.shares import OF_READINGS, SHORTEST, WINDOWS, ForceShares, Share, missing_force
from discrepancy.proof_record import ClosedShare
from discrepancy.search.honest_evidence import noise_levels, refitted
from discrepancy.search.starts import acts_within, are_related
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate

from .closed_share import closed_text
from .conclusion import Hypothetic
from .consistency_gate import consistency_gate
from .proof import held_out_gate, told_share

COUNTER = -0.1
"""Share below which trials in which a law has hardly any force speak against it all the same."""


class Court:
    """Hypotheses as whole simulations, each fitted under what the best of them leaves.

    Parameters
    ----------
    found : Search
        Whose hypotheses they are.

    Attributes
    ----------
    least_end : float
        Lower end of a share that a name needs.
    has_held_out : bool
        Whether there are trials that were not fitted.
    residuals : callable
        Fitted and held-out trials of a hypothesis beside their predictions, made once.
    share : callable
        What `share_of` returns, made once.
    simulated : callable
        What `fitted` returns, made once.
    standing : Hypothetic or None
        The hypothesis that the verdict is about, once there is one.
    """

    least_end = SEARCH.least_share

    def __init__(self, found: Search) -> None:
        self.problem, self.found = found.problem, found
        self.has_held_out = bool(self.problem.campaign.held_out)
        self.residuals = cache(partial(residual_set, self.problem, sensitivities=False))
        self.share = cache(self.share_of)
        self.simulated = cache(self.fitted)
        self.closed = cache(self.closed_by)
        self.standing: Hypothetic | None = None
        self._followed: dict[Key, Any] = {}
        self._free: dict[Key, CandidateFit] = {}

    # ---------------------------------------------------------------- how they are compared

    @property
    def nothing(self) -> Any:
        """The hypothesis without an effect."""
        return self.found.nothing

    def score(self, item: Any) -> float:
        """Return ln (evidence times prior) [nat]."""
        return self.found.score(item)

    def gap(self) -> str:
        """Return what is seen of what is missing, in one sentence; empty: nothing."""
        return ""

    @property
    def ranked(self) -> Sequence[Any]:
        """Hypotheses, the most probable first."""
        return sorted(self.found.all().values(), key=lambda item: -self.found.score(item))

    @cached_property
    def _noise(self) -> Mapping[str, float]:
        """Deviation of each channel's noise over that beside which residuals of the model as it is stand."""
        known, left = self.problem.freedom > 0.0, self.problem.precisions(self.found.none.sums)
        levels = np.where(known, 1.0, left * noise_levels(self.problem, self.found.best()))
        return dict(zip(self.problem.channel_names, np.sqrt(levels).tolist(), strict=True))

    def share_of(self, item: Any, *, held_out: bool) -> Share:
        """Return the share of the gap that a hypothesis closes; sizes are over the noise."""
        sets = [self.residuals(one) for one in (self.found.none, item)]
        pairs = zip(*([i for i in one.trials if i.trial.held_out is held_out] for one in sets), strict=True)
        rows, trials = [], 0
        for first, second in pairs:
            noise = first.noise_deviation * [self._noise[name] for name in first.trial.channels]
            count, trials = len(first.used), trials + 1
            blocks = min(WINDOWS, max(1, count // SHORTEST)) if first.trial.is_dynamic else 1
            squares = [np.where(one.used, one.residual / noise, 0.0) ** 2 for one in (first, second)]
            for part in np.array_split(np.arange(count), blocks):
                rows.append([float(one[part].sum()) for one in (*squares, first.used)])
        before, after, noise = np.array(rows).T
        left, whole = (float(np.sqrt(max(one.sum() / noise.sum() - 1.0, 0.0))) for one in (after, before))
        return Share(before, after, noise, held_out, trials, left, whole, OF_READINGS, tested=True)

    def followed(self, candidate: Candidate, effect: FloatArray) -> Any:
        """Return a further hypothesis, begun at values (E,) of its unknowns; None: it cannot be."""
        none = self.found.none
        found = self.found.exact.get(candidate.key)
        if found is None:
            found = attempt(self.problem, candidate, Point(none.point.shared, none.point.local, effect))
        return None if found is None else refitted(self.problem, self.found.wide or self.problem, found)

    def add_families(self) -> None:
        """Compare the best law, and those easily taken for it, with shapes of their own too."""
        best = self.found.best()
        if len(best.candidate.terms) != 1 or not self.acts(best.candidate.terms[0]):
            return
        (own,) = best.candidate.terms
        singles: dict[tuple[str, str], CandidateFit] = {}
        for item in (*self.found.rough.values(), *self.found.exact.values()):
            (term, *others) = item.candidate.terms or (None,)
            if term is None or others or term.free_shape or not term.effect.shape or not self.acts(term):
                continue
            if term == own or are_related(term.effect, own.effect):
                key = (term.effect.family, term.place)
                singles[key] = max(singles.get(key, item), item, key=self.found.score)
        joined = dict(self.found.judged)
        for item in singles.values():
            free = free_shape(self.problem, item, 0)
            free = None if free is None else refitted(self.problem, self.found.wide or self.problem, free)
            if free is not None:
                self._free[item.candidate.key] = free
                if free.log_evidence > best.log_evidence + SHAPE_GAIN:
                    joined[free.candidate.key] = free
        self.found.judged = joined

    def freed(self, item: Any) -> Any:
        """Return a single law with a shape of its own, where that was compared."""
        return item if item.candidate.is_family else self._free.get(item.candidate.key)

    def gate(self, item: Any) -> Gate:
        """Return how well the simulation of a hypothesis leaves noise alone."""
        return absolute_gate(self.problem, item)

    def passes_absolute_fit(self, item: Any) -> bool:
        """Whether the simulation of a hypothesis, fitted to the recorded noise, leaves noise alone."""
        key = item.candidate.key
        simulation = self.found.exact.get(key)
        if simulation is None:
            simulation = attempt(self.problem, item.candidate, self.begin(item))
        return simulation is not None and absolute_gate(self.problem, simulation).passed is not False

    def begin(self, item: Any) -> Point:
        """Return the point from which the simulation of a hypothesis is fitted."""
        point: Point = item.point
        return point

    def beside(self, item: Any) -> str:
        """Return what else speaks against a name: a gate that it fails where it leaves noise."""
        if item.remainder is not None:
            return ""
        gates: list[Gate] = [consistency_gate(self.problem, item), held_out_gate(self.residuals(item))]
        return next((gate.reason for gate in gates if gate.passed is False), "")

    def fitted(self, item: Any) -> CandidateFit:
        """Return the simulation that stands for a hypothesis: itself."""
        found: CandidateFit = item
        return found

    def left(self, item: Any, share: Share) -> str:
        """Return how much a hypothesis leaves, over how much there is without an effect."""
        return f"{share.left:.3g} of {share.whole:.3g} noise deviations (rms beyond the noise)"

    def closed_by(self, item: Any) -> tuple[ClosedShare | None, str]:
        """Return the share of the mean square error that a hypothesis takes away, and it in words.

        It is of simulations, without and with the hypothesis, whatever hypotheses are compared by.
        """
        before, after = self.residuals(self.found.none), self.residuals(self.simulated(item))
        closed, reason = told_share(before, after)
        if closed is None:
            return None, f"{reason[0].lower()}{reason[1:-1]}"
        return closed, closed_text(before, after, closed)

    def grew(self, item: Any) -> bool:
        """Whether the error is larger with a hypothesis than without it, or it cannot be simulated."""
        closed, _ = self.closed(item)
        return self.simulated(item) is self.found.none or (closed is not None and closed.grew)

    # ---------------------------------------------------------------- who may be named

    def told(self, item: Any) -> Share:
        """Return the share that counts: in trials not fitted, if there are any that can test it."""
        outside = self.share(item, held_out=True) if self.has_held_out else None
        return outside if outside is not None and outside.tested else self.share(item, held_out=False)

    def against(self, item: Any) -> str:
        """Return why a hypothesis is no name; empty where nothing speaks against it."""
        if not any(map(self.acts, item.candidate.terms)):
            return said("against.readings")
        if item.candidate.is_family and len(item.candidate.terms) > 1:
            return said("against.free_shape")
        inside = self.share(item, held_out=False)
        if _is_little(inside, self.least_end):
            return f"where it was fitted it leaves {self.left(item, inside)}"
        if self.has_held_out and not self._survives(item, self.least_end):
            outside = self.share(item, held_out=True)
            return f"in trials that were not fitted it leaves {self.left(item, outside)}"
        count = self.problem.shared.count
        proper = self.problem.shared.precision > 0.0
        for what, own in (("calibrated parameters", slice(count)), ("gains", slice(count, None))):
            u = item.shared[own][proper[own]]
            if u.size and chi2.sf(u @ u / SEARCH.widened**2, u.size) < ABSOLUTE_LEVEL:
                return said("against.beside_priors", what=what)
        return self.beside(item)

    def _survives(self, item: Any, least: float) -> bool:
        """Whether trials that were not fitted bear a hypothesis out, or have no force by which they could."""
        outside = self.share(item, held_out=True)
        return not _is_little(outside, least) if outside.tested else outside.value > COUNTER

    def acts(self, term: Term) -> bool:
        """Whether a term acts on the structure, and is no description of readings."""
        return acts_within(term.effect, self.problem.setting)

    @cached_property
    def contenders(self) -> list[Any]:
        """Hypotheses that data do not exclude and nothing speaks against, most probable first.

        Errors of the readings beside laws take up what is left, whatever it is: they are no part of a name.
        """
        found: dict[Key, tuple[Any, float]] = {}
        for item in (one for one in self.ranked if one.candidate.terms):
            acts = [number for number, term in enumerate(item.candidate.terms) if self.acts(term)]
            core = self._with(item, acts) if 0 < len(acts) < len(item.candidate.terms) else item
            if core is not None and core.candidate.key not in found and not self.against(core):
                found[core.candidate.key] = core, self.score(item)
        best = max((score for _, score in found.values()), default=0.0)
        return [item for item, score in found.values() if score > best - SEARCH.contenders]

    def _with(self, item: Any, kept: Sequence[int]) -> Any:
        """Return a hypothesis with some of its effects only."""
        candidate, values = item.candidate.some(kept, item.effect)
        key = candidate.key
        known = next((one for one in self.ranked if one.candidate.key == key), None)
        if known is not None:
            return known
        if key not in self._followed:
            self._followed[key] = self.followed(candidate, values)
        return self._followed[key]

    def slimmed(self, best: Any) -> Any:
        """Return the simplest hypothesis that is as much of the missing force."""
        own, count = families(best), len(best.candidate.terms)
        singles = [self._with(best, [number]) for number in range(count)] if count > 1 else []
        able = {item.candidate.key: item for item in (*self.ranked, *singles) if item is not None}
        inside, outside = self.share(best, held_out=False).value, self.told(best).value
        simpler = [
            item for item in able.values()
            if item.candidate.terms and _freedom(item) < _freedom(best) and families(item) <= own
            and self.share(item, held_out=False).value > inside - 3.0 * SEARCH.slim
            and self.told(item).value > outside - SEARCH.slim
            and not self.against(item)
        ]  # fmt: skip
        return min(simpler, key=lambda item: (_freedom(item), -self.score(item)), default=best)

    def probability(self, *items: Any) -> float:
        """Return the probability that one of some hypotheses holds, with all that hold its families."""
        kept = []
        for one in self.ranked:
            is_asked = any(one is item for item in items)
            if is_asked or not one.candidate.terms or not self._refuted(one):
                kept.append(one)
        scores = np.array([self.score(one) for one in kept])
        holds = np.array([any(families(item) <= families(one) for item in items) for one in kept])
        if not holds.any():
            return 0.0
        return float(np.exp(logsumexp(scores[holds]) - logsumexp(scores)))

    def _refuted(self, item: Any) -> bool:
        """Whether trials show that a hypothesis is not what is missing."""
        if self.share(item, held_out=False).interval[1] < SEARCH.least_share:
            return True
        return self.has_held_out and not self._survives(item, 0.0)

    def rivals(self, best: Any) -> list[Any]:
        """Return other names that neither evidence nor trials tell from the best one."""
        share, least = self.told(best), self.score(best) - SEARCH.force_rival
        others: dict[frozenset[tuple[str, str]], Any] = {}
        for item in self.contenders:
            same = item.candidate.is_family and families(item) == families(best)
            longer = len(item.candidate.terms) > len(best.candidate.terms)
            if not same and not longer and self.score(item) > least and not share.told_from(self.told(item)):
                others.setdefault(names(item), item)
        others.pop(names(best), None)
        return list(others.values())


def _is_little(share: Share, least: float) -> bool:
    low, high = share.interval
    return high < SEARCH.least_share or low < least


def families(item: Hypothetic) -> set[tuple[str, str]]:
    """Return families and places of the effects of a hypothesis."""
    return {(term.effect.family, term.place) for term in item.candidate.terms}


def names(item: Hypothetic) -> frozenset[tuple[str, str]]:
    """Return effects and places of a hypothesis."""
    return frozenset((term.effect.identifier, term.place) for term in item.candidate.terms)


def _freedom(item: Hypothetic) -> tuple[int, int]:
    return len(item.candidate.terms), sum(term.free_shape for term in item.candidate.terms)


class ByForce(Court):
    """Hypotheses along the missing force."""

    least_end = SEARCH.least_end

    def __init__(self, found: Search, force: ForceSearch) -> None:
        super().__init__(found)
        self.force, self._of_force = force, ForceShares(force)
        self.has_held_out = self._of_force.has_held_out

    @property
    def nothing(self) -> Explained:
        """Missing forces alone."""
        return self.force.whole

    @property
    def ranked(self) -> Sequence[Explained]:
        """Hypotheses, the most probable first."""
        return self.found.forces

    def share_of(self, item: Any, *, held_out: bool) -> Share:
        """Return the share that a hypothesis is of the missing force."""
        return self._of_force.of(item, held_out=held_out)

    def followed(self, candidate: Candidate, effect: FloatArray) -> Explained | None:
        """Return a further hypothesis, begun at values (E,) of its unknowns; None: it cannot be."""
        return self.force.followed(self.force.whole, candidate, effect)

    def freed(self, item: Any) -> Explained | None:
        """Return a single law with a shape of its own, where that was compared."""
        (term,) = item.candidate.terms
        key = Candidate((replace(term, free_shape=True),)).key
        return next((one for one in self.ranked if one.candidate.key == key), None)

    def begin(self, item: Any) -> Point:
        """Return the point at which the missing force has a hypothesis."""
        return self.force.whole_point(item)

    def beside(self, item: Any) -> str:
        """Return what else speaks against a name: nothing."""
        return ""

    def gate(self, item: Any) -> Gate:
        """Return how well the best simulation leaves noise alone."""
        return absolute_gate(self.problem, self.found.best())

    def fitted(self, item: Any) -> CandidateFit:
        """Return the simulation of a hypothesis at its values, with their covariance."""
        try:
            shown = fit_to(self.problem, item.candidate, self.force.whole_point(item), local_only=True)
        except (DiscrepancyError, np.linalg.LinAlgError):
            return self.found.none
        return replace(shown, covariance=item.covariance)

    def left(self, item: Any, share: Share) -> str:
        """Return how much of the missing force a hypothesis leaves, over how much there is without one."""
        return f"{share.left:.3g} of {share.whole:.3g} {self._unit(item)} (rms) of the missing force"

    def _unit(self, item: Any) -> str:
        """Return the unit of the force at the port of a hypothesis."""
        ports = self.force.ports
        places = [t.place for t in item.candidate.terms if t.place in ports]
        return self.problem.model.port_units(places[0] if places else ports[next(iter(item.processes))])[0]

    def gap(self) -> str:
        """Return size and port of the missing force, and the variable that orders it."""
        missing = missing_force(self.force, self.force.best())
        if missing is None:
            return ""
        told = missing.told
        order = said("verdict.not_ordered")
        if told.ordered_by:
            most = 100.0 * max(told.orders.values())
            order = said("verdict.ordered_by", names=" and ".join(told.ordered_by), share=most)
        return said("verdict.force", told=told, order=order)
