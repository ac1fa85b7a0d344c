"""Verdicts where no hypothesis leaves noise alone: named in part, a group with shares, or unexplained.

Every hypothesis, *nothing missing* included, carries its remainder (Kennedy and O'Hagan 2001); the evidence
then counts independent samples. A set of effects is named in part that is probable so and that explains most
of the gap on trials that it did not see, where no other set does as well.
"""

from dataclasses import replace

import numpy as np

from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.gates import ABSOLUTE_LEVEL, absolute_gate, prior_tests
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.hypotheses import key_of
from discrepancy.search.honest_evidence import weigh_with_remainders
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, NamedEffect, RemainderEstimate, Verdict, VerdictKind

from .conclusion import Conclusion, named_effects
from .consistency_gate import consistency_gate
from .explained_share import Shares
from .practical_size import UNSTATED_GAIN, is_one_driven_channel, small_terms
from .proof import held_out_gate
from .trial_by_trial import sizes_by_trial
from .weighed import Weighed, plain

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
    weighed = Weighed(problem, found)
    weighed.leave_out_stand_ins()
    weighed.join_relatives()
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
    if best.remainder is None:  # what is left is noise: another gate is why it has no name
        within, probability, family = weighed.nameable(best)
        if len(within.candidate.terms) == len(best.candidate.terms):
            return _unexplained(told, weighed, best, first), found, weighed.shown(best)
        verdict = _in_part(told, weighed, within, probability, family, first)
        named = verdict.kind is not VerdictKind.UNEXPLAINED
        return verdict, found, within if named else weighed.shown(best)
    probability = weighed.probability(best)
    plain = not best.candidate.is_family and weighed.freed(best) is None
    if plain and probability >= SEARCH.sure and _is_coloured(best) and weighed.slimmer(best) is best:
        gates = (
            absolute_gate(problem, best), consistency_gate(problem, best),
            held_out_gate(weighed.residuals(replace(best, remainder=None))),
        )  # fmt: skip
        if all(gate.passed is not False for gate in gates):
            return _named(told, best, probability, gates), found, best
    best, probability, family = weighed.nameable(best)
    verdict = _in_part(told, weighed, best, probability, family, first)
    return verdict, found, weighed.shown(best) if verdict.kind is VerdictKind.UNEXPLAINED else best


def without_sliver(problem: Problem, found: Search, first: Verdict, fit: CandidateFit) -> Outcome:
    """Return the verdict on a set that was named, one of whose effects may explain next to nothing.

    Where what is left is nearly noise, such an effect stands for what is left as well as a remainder does. It
    stays if the evidence of the whole set is above that of the set without it and a remainder by far.

    Parameters
    ----------
    problem, found, first
        As of `judged_with_remainder`.
    fit : CandidateFit
        Of the set that was named.
    """
    weighed = Weighed(problem, found)
    names, share = set(plain(fit)), weighed.shares(fit).value
    small = small_terms(problem, fit, unstated=UNSTATED_GAIN)
    alone = weighed.laws_of(fit) if is_one_driven_channel(problem) else plain(fit)
    kept = {name for name, size in zip(plain(fit), small, strict=True) if size is None and name in alone}
    singles = [item for item in found.exact.values() if item.candidate.terms and set(plain(item)) < names]
    closing = [item for item in singles if weighed.shares(item).value > share - SEARCH.sliver]
    if not closing and kept == names:
        return first, found, fit
    weigh_with_remainders(found)
    weighed = Weighed(problem, found)
    whole = found.judged.get(key_of(fit.candidate), fit)
    best = weighed.slimmer(whole, kept)
    if best is whole:
        found.judge({})
        return first, found, fit
    verdict = _in_part(Conclusion.of(problem, found, best, found.set_probabilities()), weighed, best,
                       weighed.probability(best), "", first)  # fmt: skip
    return verdict, found, weighed.shown(best) if verdict.kind is VerdictKind.UNEXPLAINED else best


def _is_coloured(item: CandidateFit) -> bool:
    """Whether what a fit leaves is coloured as the noise itself may be."""
    return item.remainder is not None and item.remainder.is_noise


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
    weighed: Weighed,
    best: CandidateFit,
    probability: float,
    family: str,
    first: Verdict,
) -> Verdict:
    """Return the verdict named in part, or a group with shares; unexplained where neither may be said."""
    problem = told.problem
    explained = weighed.shares(best).summary()
    why = _no_name(problem, weighed, best)
    if why:
        return _unexplained(told, weighed, best, first, why=why)
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
    members = [best, *rivals]
    if rivals and not any(weighed.laws_of(item) for item in members):
        alike = " and ".join(dict.fromkeys(_words(named_effects(problem, item)) for item in members))
        why = f"It is no name, as {alike} describe the readings alike: none has a pattern that is its own."
        return _unexplained(told, weighed, best, first, why=why)
    if rivals and len(rivals) < SEARCH.largest_group:
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
            group=tuple(" + ".join(sorted(plain(item))) for item in members), **more,
        )  # fmt: skip
    why = _no_winner(problem, weighed, best, len(rivals), probability)
    if why:
        return _unexplained(told, weighed, best, first, why=why)
    beside = _beside(problem, best)
    left += f", with {beside}" if beside else ""
    named = named_effects(problem, best)
    what = f"An effect of the family {family}, with a shape of its own," if family else _words(named)
    sentence = (
        f"{what[0].upper()}{what[1:]} closes {_share_words(weighed.shares(best))} of the gap on "
        f"{explained.trials} trials (probability {_certain(probability)}); {left}."
        f"{_exponents(problem, weighed, best)}"
    )
    return told.verdict(
        VerdictKind.NAMED_IN_PART, sentence, probability, effects=named, family=family, **more
    )


def _no_name(problem: Problem, weighed: Weighed, best: CandidateFit) -> str:
    """Return why the best set is no name whatever its rivals; empty where nothing speaks against one."""
    following = [item.sentence() for item in sizes_by_trial(problem, best) if item.follows]
    if following:
        return " ".join(following)
    if weighed.is_mixed(best):
        return "It is no name, as it takes an error of the readings beside a law."
    low = weighed.shares(best).summary().low
    if low < SEARCH.least_share:
        return f"It is no name, as it may close less than {100.0 * SEARCH.least_share:.0f} %."
    # the gap is what parameters and gains could not close by themselves: what is left of it moves them
    nearly_all = low > 1.0 - SEARCH.rival_share
    beside = _beside(problem, best, SEARCH.widened, own=nearly_all)
    return f"It is no name, as it needs {beside}: are these priors what you would bet on?" if beside else ""


def _no_winner(
    problem: Problem, weighed: Weighed, best: CandidateFit, rivals: int, probability: float
) -> str:
    """Return why the best set is no name beside its rivals; empty where nothing speaks against one."""
    if rivals:
        return f"{rivals} other sets explain as much: that tells nothing."
    if probability < SEARCH.sure:
        return f"It is no name, as its probability is {probability:.2g}: a name needs {SEARCH.sure:g}."
    describing = weighed.better_description(best)
    if describing is None:
        return ""
    words = _words(named_effects(problem, describing))
    return f"It is no name, as {words}, which describes readings and causes nothing, is more probable."


def _beside(problem: Problem, best: CandidateFit, widened: float = 1.0, *, own: bool = False) -> str:
    """Return which unknowns have left their priors, in words; `own`: of the effects alone."""
    tests = prior_tests(problem, best, widened, own=own)
    return " and ".join(name for name, p in tests if p * len(tests) < ABSOLUTE_LEVEL)


def _exponents(problem: Problem, weighed: Weighed, best: CandidateFit) -> str:
    """Return the sentence on the shape of a single law, its own or freed for it, with intervals."""
    free = best if best.candidate.is_family else weighed.free(best)
    if free is None:
        return ""
    (effect,) = named_effects(problem, free)
    spread = np.sqrt(np.diag(free.effect_covariance))[-len(effect.shape) :]
    told_of = [
        f"{item.description.split(' (')[0]} {item.value:.2g} ({item.low:.2g} to {item.high:.2g})"
        for item, deviation in zip(effect.shape, spread, strict=True)
        if deviation < SEARCH.told_by_data
    ]
    return f" With a shape of its own: {', '.join(told_of)}." if told_of else ""


def _unexplained(
    told: Conclusion, weighed: Weighed, leading: CandidateFit, first: Verdict, *, why: str = ""
) -> Verdict:
    """Return the verdict that there is a gap without a name, and how much the best hypothesis explains."""
    leading, sentence, explained = weighed.shown(leading), first.sentence, None
    failed = next((gate.reason for gate in first.gates if gate.passed is False), "")
    nearest = sorted(first.resembles) == sorted(plain(leading))  # else it would name two as the nearest
    if first.kind is not VerdictKind.UNEXPLAINED or (failed and not nearest):
        sentence = f"There is a gap that no effect of the catalogue fits. {failed}".strip()
    if leading.candidate.terms:
        explained = weighed.shares(leading).summary()
        words = _words(named_effects(told.problem, leading))
        sentence += (
            f" The best hypothesis, {words}, closes {_share_words(weighed.shares(leading))} of the gap on "
            f"{explained.trials} trials."
        )
    else:
        sentence += weighed.little()
    sentence += f" {why}" if why else ""
    return told.verdict(
        VerdictKind.UNEXPLAINED, sentence, first.probability, gates=first.gates,
        resembles=plain(leading) or first.resembles, explained=explained,
        remainders=remainder_estimates(told.problem, leading),
    )  # fmt: skip


def remainder_estimates(problem: Problem, found: CandidateFit) -> tuple[RemainderEstimate, ...]:
    """Return the remainders of a fit for the verdict."""
    remainder = found.remainder
    if remainder is None:
        return ()
    rows = (
        (name, remainder.size[channel], remainder.time[channel], remainder.frequency[channel])
        for channel, name in enumerate(problem.channel_names)
        if remainder.size[channel] > 0.0
    )
    return tuple(
        RemainderEstimate(name, float(size), float(time), float(frequency))
        for name, size, time, frequency in rows
    )


def _words(named: tuple[NamedEffect, ...]) -> str:
    return " and ".join(f"{effect.name}{f' at {effect.place}' if effect.place else ''}" for effect in named)


def _certain(probability: float) -> str:
    return "> 0.999" if probability > 0.9995 else f"{probability:.3f}"  # never one


def _share_words(shares: Shares) -> str:
    found = shares.summary()
    return f"{100.0 * found.value:.0f} % ({100.0 * found.low:.0f} to {100.0 * found.high:.0f})"
