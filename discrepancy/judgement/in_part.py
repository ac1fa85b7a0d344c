"""Verdicts where no hypothesis leaves noise alone: named in part, a group with shares, or unexplained.

Every hypothesis, *nothing missing* included, carries its remainder (Kennedy and O'Hagan 2001); the evidence
then counts independent samples. A set of effects is named in part that is probable so and that explains most
of the gap on trials that it did not see, where no other set does as well.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.gates import ABSOLUTE_LEVEL, SHAPE_GAIN, absolute_gate, is_noise_colour, prior_tests
from discrepancy.fits.other_optima import free_shape
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.problem import Problem
from discrepancy.fits.remainder_inference import RemainderPrior, with_remainder
from discrepancy.location.residuals import ResidualSet
from discrepancy.search.honest_evidence import weigh_with_remainders
from discrepancy.search.hypotheses import Key, key_of
from discrepancy.search.starting_points import acts_within
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, NamedEffect, RemainderEstimate, Verdict, VerdictKind
from fe.runtime.patch import DecayingLine, Line

from .conclusion import Conclusion, family_words, named_effects
from .consistency_gate import consistency_gate
from .explained_share import Shares
from .proof import held_out_gate

LEAST_SHOWN = 0.1
"""Share of the gap from which a hypothesis is shown as the best one where none is named."""

Outcome = tuple[Verdict, Search, CandidateFit]


def judged_with_remainder(problem: Problem, found: Search, first: Verdict) -> Outcome:
    """Return the verdict where what the best hypothesis leaves is not the recorded noise.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    found : Search
        All candidates as fitted to recorded noise; compared with their remainders from here on.
    first : Verdict
        What they led to.

    Returns
    -------
    Verdict, Search, CandidateFit
        As `naming.name` returns them; the fit is that of the best hypothesis for an unexplained gap too.
    """
    weigh_with_remainders(found)
    weighed = _Weighed(problem, found)
    weighed.leave_out_stand_ins()
    best = found.best()
    probabilities = found.set_probabilities()
    told = Conclusion.of(problem, found, best, probabilities)
    gate, p_none = absolute_gate(problem, found.nothing), probabilities.get((), 0.0)
    if p_none > 1.0 - SEARCH.sure and gate.passed is not False and _is_coloured(found.nothing):
        if p_none >= SEARCH.unsure:
            return _nothing(told, found.nothing, gate), found, found.nothing
        return _too_small(told, p_none, gate), found, found.nothing
    if not best.candidate.terms:
        leading = weighed.leading()
        return _unexplained(told, weighed, leading, first), found, leading
    if best.point.remainder is None:  # what is left is noise: another gate is why it has no name
        return _unexplained(told, weighed, best, first), found, weighed.shown(best)
    probability = weighed.probability(best)
    plain = not best.candidate.is_family and weighed.freed(best) is None
    if plain and probability >= SEARCH.sure and _is_coloured(best):
        gates = (
            absolute_gate(problem, best), consistency_gate(problem, best),
            held_out_gate(weighed.residuals(replace_remainder(best))),
        )  # fmt: skip
        if all(gate.passed is not False for gate in gates):
            return _named(told, best, probability, gates), found, best
    best, probability, family = weighed.nameable(best)
    verdict = _in_part(told, weighed, best, probability, family, first)
    return verdict, found, weighed.shown(best) if verdict.kind is VerdictKind.UNEXPLAINED else best


def replace_remainder(found: CandidateFit) -> CandidateFit:
    """Return a fit whose predictions have the noise alone about them."""
    return replace(found, point=replace(found.point, remainder=None)) if found.point.remainder else found


@dataclass
class _Weighed:
    """Hypotheses with their remainders, and what each explains of the gap."""

    problem: Problem
    found: Search
    left_out: list[CandidateFit] = field(default_factory=list)
    _residuals: dict[Key, ResidualSet] = field(default_factory=dict)
    _shares: dict[Key, Shares] = field(default_factory=dict)

    def residuals(self, item: CandidateFit) -> ResidualSet:
        """Return fitted and held-out trials beside their predictions."""
        return residual_set(self.problem, item, sensitivities=False)

    def shares(self, item: CandidateFit) -> Shares:
        """Return what a hypothesis explains of the gap."""
        key = key_of(item.candidate)
        if key not in self._shares:
            if () not in self._residuals:
                self._residuals[()] = self.residuals(self.found.none)
            best = self.found.best()
            left = 1.0 / self.problem.precisions(best.sums)
            noise = np.where(self.problem.freedom > 0.0, 1.0, left)
            named: Mapping[str, float] = dict(zip(self.problem.channel_names, noise.tolist(), strict=True))
            self._shares[key] = Shares.of(self._residuals[()], self.residuals(item), named)
        return self._shares[key]

    def describes_better(self, best: CandidateFit) -> bool:
        """Whether a stand-in that is as long as a set of laws was left out, and is more probable by far."""
        return any(
            len(item.candidate.terms) == len(best.candidate.terms)
            and item.log_evidence > best.log_evidence + SEARCH.rival
            for item in self.left_out
        )

    def shown(self, best: CandidateFit) -> CandidateFit:
        """Return the best set if it closes a part of the gap, else the most probable one that does."""
        if best.candidate.terms and self.shares(best).value > LEAST_SHOWN:
            return best
        return self.leading()

    def leading(self) -> CandidateFit:
        """Return the most probable set that closes a part of the gap, else the fit without effect."""
        ranked = sorted(self.found.judged.values(), key=lambda item: -self.found.score(item))
        closing = (item for item in ranked if item.candidate.terms and self.shares(item).value > LEAST_SHOWN)
        return next(closing, self.found.none)

    def leave_out_stand_ins(self) -> None:
        """Take sets with a stand-in out of the comparison where a law explains as much, or it may not be.

        Clocks, gains, zeros, drifts and lines describe readings; they do not cause. They never stand before a
        law of the structure that explains the same share.
        """
        kept = dict(self.found.judged)
        laws = {key: item for key, item in kept.items() if key and not self._stands_in(item)}
        for key, item in self.found.judged.items():
            if not key or key in laws:
                continue
            share = self.shares(item).value
            beaten = any(
                len(law.candidate.terms) <= len(item.candidate.terms)
                and self.shares(law).value > share - SEARCH.rival_share
                for law in laws.values()
            )
            if not self._may_stand_in(item):
                del kept[key]
            elif beaten:
                del kept[key]
                self.left_out.append(item)
        self.found.judge(kept)

    def _stands_in(self, item: CandidateFit) -> bool:
        return any(not acts_within(term.effect, self.problem.setting) for term in item.candidate.terms)

    def is_mixed(self, item: CandidateFit) -> bool:
        """Whether a set holds a stand-in beside others."""
        return len(item.candidate.terms) > 1 and self._stands_in(item)

    def _may_stand_in(self, item: CandidateFit) -> bool:
        """Whether stand-ins are within their range, and lines have periods enough in the longest record."""
        longest = max(
            (float(np.ptp(data.trial.time)) for data in self.problem.trials if data.trial.is_dynamic),
            default=0.0,
        )
        parts = item.candidate.parts(item.point.effect)
        for term, part in zip(item.candidate.terms, parts, strict=True):
            if acts_within(term.effect, self.problem.setting):
                continue
            if np.abs(part).max(initial=0.0) > SEARCH.stand_in_range:
                return False
            patch = Candidate((term,)).patch(self.problem.setting, part)
            lines = [item.frequency for item in patch if isinstance(item, Line | DecayingLine)]
            if lines and min(lines) * longest < SEARCH.least_periods:
                return False
        return True

    def probability(self, item: CandidateFit) -> float:
        """Return the probability of a set with all that hold it."""
        names = set(_plain(item))
        found = self.found.all().values()
        scores = np.array([self.found.score(other) for other in found])
        holds = np.array([names <= set(_plain(other)) for other in found])
        weights = np.exp(scores - scores.max())
        return float(weights[holds].sum() / weights.sum())

    def nameable(self, best: CandidateFit) -> tuple[CandidateFit, float, str]:
        """Return the set that may be named, its probability, and its family where its shape is its own.

        The best set, or one within it that explains as much but for a little. Stand-ins beside laws take up
        what is left, whatever it is: they are no part of a name.
        """
        names = set(_plain(best))
        share = self.shares(best).value
        mixed = self.is_mixed(best)
        for item in sorted(self.found.judged.values(), key=lambda other: len(other.candidate.terms)):
            if not item.candidate.terms or not set(_plain(item)) < names:
                continue
            close = self.shares(item).value > share - 0.5 * SEARCH.rival_share
            if close or (mixed and not self._stands_in(item)):
                best = item
                break
        probability = self.probability(best)
        terms = best.candidate.terms
        if len(terms) == 1 and self.shares(best).value > SEARCH.least_share and terms[0].effect.shape:
            free = best if best.candidate.is_family else self.freed(best)
            if free is not None:
                family, _ = family_words(named_effects(self.problem, free))
                return free, probability, family
        return best, probability, ""

    def freed(self, best: CandidateFit) -> CandidateFit | None:
        """Return the family of a single law where a shape of its own gains enough."""
        if len(best.candidate.terms) != 1:
            return None
        free = free_shape(self.problem, best, 0)
        if free is None:
            return None
        free = with_remainder(self.problem, free, RemainderPrior.of(self.problem, self.found.none), rounds=3)
        if free is None or free.log_evidence - best.log_evidence <= SHAPE_GAIN:
            return None
        return free if self.shares(free).value >= self.shares(best).value - 0.02 else None

    def rivals(self, best: CandidateFit) -> list[CandidateFit]:
        """Return other sets of the same length that data or held-out trials do not tell from it."""
        own, found = self.shares(best), []
        for item in self.found.judged.values():
            same = len(item.candidate.terms) == len(best.candidate.terms)
            if not same or set(_plain(item)) == set(_plain(best)):
                continue
            share = self.shares(item)
            close = item.log_evidence > best.log_evidence - SEARCH.rival
            alike = share.value > own.value - SEARCH.rival_share and not own.told_from(share)
            if (close or alike) and share.value > SEARCH.least_share:
                found.append(item)
        return found


def _plain(item: CandidateFit) -> tuple[str, ...]:
    return tuple(term.effect.identifier for term in item.candidate.terms)


def _is_coloured(item: CandidateFit) -> bool:
    """Whether what a fit leaves is coloured as the noise itself may be."""
    return item.point.remainder is not None and is_noise_colour(item)


def _too_small(told: Conclusion, p_none: float, gate: Gate) -> Verdict:
    """Return the verdict that an effect may be there, too small to tell from coloured noise."""
    hints = sorted(name for name, p in told.inclusion.items() if p > 1.0 - SEARCH.sure)
    total = p_none + sum(told.inclusion[name] for name in hints)
    return told.verdict(
        VerdictKind.BELOW_LIMIT,
        "Something may be missing, but too small for these data to tell from noise that is coloured"
        + (f"; the nearest are {', '.join(hints[:4])}." if hints else "."),
        min(total, 1.0), group=tuple(hints), gates=(gate,),
        remainders=remainder_estimates(told.problem, told.found.nothing),
    )  # fmt: skip


def _nothing(told: Conclusion, best: CandidateFit, gate: Gate) -> Verdict:
    """Return the verdict that the noise is coloured, and nothing missing."""
    return told.verdict(
        VerdictKind.NOTHING_MISSING,
        "The model explains the data within their noise, which is coloured as its records admit.",
        told.found.set_probabilities()[()],
        gates=(gate,),
        remainders=remainder_estimates(told.problem, best),
    )


def _named(told: Conclusion, best: CandidateFit, probability: float, gates: tuple[Gate, ...]) -> Verdict:
    """Return the verdict that names a set beside noise that is coloured."""
    named = named_effects(told.problem, best)
    sentence = f"The model lacks {_words(named)} (probability {_certain(probability)})."
    return told.verdict(
        VerdictKind.NAMED, sentence, probability, effects=named, gates=gates,
        remainders=remainder_estimates(told.problem, best),
    )  # fmt: skip


def _in_part(
    told: Conclusion,
    weighed: _Weighed,
    best: CandidateFit,
    probability: float,
    family: str,
    first: Verdict,
) -> Verdict:
    """Return the verdict named in part, or a group with shares; unexplained where neither may be said."""
    problem = told.problem
    explained = weighed.shares(best).summary()
    tests = prior_tests(problem, best)
    beside = any(p * len(tests) < ABSOLUTE_LEVEL for _, p in tests)
    if explained.low < SEARCH.least_share or beside or weighed.is_mixed(best):
        return _unexplained(told, weighed, best, first)
    rivals = weighed.rivals(best)
    gates = (absolute_gate(problem, best),)
    more = {
        "explained": explained, "remainders": remainder_estimates(problem, best), "gates": gates,
    }  # fmt: skip
    left = (
        f"what is left is {explained.left:.2g} times the noise and unexplained"
        if explained.left > 0.0
        else "nothing is left beyond the noise"
    )
    if rivals and len(rivals) < SEARCH.largest_group:
        members = [best, *rivals]
        told_of = [
            f"{_words(named_effects(problem, item))} ({100.0 * weighed.shares(item).value:.0f} %)"
            for item in members
        ]
        sentence = (
            f"Either {', '.join(told_of[:-1])} or {told_of[-1]} closes this share of the gap on "
            f"{explained.trials} trials; these data cannot tell which, and {left}."
        )
        return told.verdict(
            VerdictKind.GROUP, sentence, sum(weighed.probability(item) for item in members),
            effects=tuple(effect for item in members for effect in named_effects(problem, item)),
            group=tuple(" + ".join(sorted(_plain(item))) for item in members), **more,
        )  # fmt: skip
    if rivals or probability < SEARCH.sure or weighed.describes_better(best):
        return _unexplained(told, weighed, best, first)
    named = named_effects(problem, best)
    what = f"An effect of the family {family}, with a shape of its own," if family else _words(named)
    sentence = (
        f"{what[0].upper()}{what[1:]} closes {_share_words(weighed.shares(best))} of the gap on "
        f"{explained.trials} trials (probability {_certain(probability)}); {left}."
    )
    return told.verdict(
        VerdictKind.NAMED_IN_PART, sentence, probability, effects=named, family=family, **more
    )


def _unexplained(told: Conclusion, weighed: _Weighed, leading: CandidateFit, first: Verdict) -> Verdict:
    """Return the verdict that there is a gap without a name, and how much the best hypothesis explains."""
    leading, sentence, explained = weighed.shown(leading), first.sentence, None
    failed = next((gate.reason for gate in first.gates if gate.passed is False), "")
    nearest = sorted(first.resembles) == sorted(_plain(leading))  # else it would name two as the nearest
    if first.kind is not VerdictKind.UNEXPLAINED or (failed and not nearest):
        sentence = f"There is a gap that no effect of the catalogue fits. {failed}".strip()
    if leading.candidate.terms:
        explained = weighed.shares(leading).summary()
        words = _words(named_effects(told.problem, leading))
        sentence += (
            f" The best hypothesis, {words}, closes {_share_words(weighed.shares(leading))} of the gap on "
            f"{explained.trials} trials."
        )
    return told.verdict(
        VerdictKind.UNEXPLAINED, sentence, first.probability, gates=first.gates,
        resembles=_plain(leading) or first.resembles, explained=explained,
        remainders=remainder_estimates(told.problem, leading),
    )  # fmt: skip


def remainder_estimates(problem: Problem, found: CandidateFit) -> tuple[RemainderEstimate, ...]:
    """Return the remainders of a fit for the verdict."""
    remainder = found.point.remainder
    if remainder is None:
        return ()
    rows = (
        (name, *remainder.of(channel))
        for channel, name in enumerate(problem.channel_names)
        if remainder.beyond_noise[channel] > 0.0
    )
    return tuple(
        RemainderEstimate(name, size, time, frequency / (2.0 * np.pi)) for name, size, time, frequency in rows
    )


def _words(named: tuple[NamedEffect, ...]) -> str:
    return " and ".join(f"{effect.name}{f' at {effect.place}' if effect.place else ''}" for effect in named)


def _certain(probability: float) -> str:
    return "> 0.999" if probability > 0.9995 else f"{probability:.3f}"  # never one


def _share_words(shares: Shares) -> str:
    found = shares.summary()
    return f"{100.0 * found.value:.0f} % ({100.0 * found.low:.0f} to {100.0 * found.high:.0f})"
