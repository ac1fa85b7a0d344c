"""Verdicts where no simulation leaves noise alone: named in part, a group, unexplained.

A set of effects is named in part that is probable and is most of what is missing, in the trials that were
fitted and in those that were not, with what was calibrated within twice its prior deviations. Hypotheses are
compared along the missing force where one can be seen, else by whole simulations under what they leave.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import logsumexp

from discrepancy.errors import said
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.gates import absolute_gate
from discrepancy.fits.problem import Problem
from discrepancy.search.honest_evidence import weigh_with_remainders
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import RemainderEstimate, Verdict, VerdictKind
from reporting.words import capital, listing

from .closed_share import share_text, trials_text
from .conclusion import (
    UNSTATED_GAIN,
    Conclusion,
    Hypothetic,
    Outcome,
    below_limit,
    effects_text,
    is_one_driven_channel,
    is_small,
    named_effects,
    plain_names,
    probability_text,
)
from .consistency_gate import consistency_gate
from .court import ByForce, Court, families, names
from .proof import held_out_gate

LEAST_SHOWN = 0.1
"""Share of what is missing from which a hypothesis is shown as the best one where none is named."""


def judged_in_part(found: Search, first: Verdict) -> Outcome:
    """Return the verdict where what the best simulation leaves is not the recorded noise.

    Parameters
    ----------
    found : Search
        All candidates as fitted to recorded noise, and hypotheses along the missing force if it is seen.
    first : Verdict
        What the simulations led to.

    Returns
    -------
    Outcome
        As `naming.name` returns it; the fit is that of the best hypothesis for an unexplained gap too.
    """
    if found.force is not None and found.forces:
        return _verdict_of(ByForce(found, found.force), first)
    weigh_with_remainders(found)
    court = Court(found)
    coloured = _beside_coloured_noise(court)
    if coloured is not None:
        return coloured
    court.add_families()
    return _verdict_of(court, first)


def nearly_all_by_laws(found: Search, first: Verdict) -> Outcome | None:
    """Return the verdict that names laws in part that are nearly all of the missing force; None: none are.

    Parameters
    ----------
    found, first
        As of `judged_in_part`; hypotheses along the missing force are there.
    """
    assert found.force is not None
    court = ByForce(found, found.force)
    outcome = _verdict_of(court, first)
    if outcome.verdict.kind is not VerdictKind.NAMED_IN_PART or court.standing is None:
        return None
    return outcome if court.told(court.standing).value > SEARCH.nearly_all else None


def without_sliver(found: Search, first: Verdict, fit: CandidateFit) -> Outcome:
    """Return the verdict on a set that was named, one of whose effects may explain next to nothing.

    Where what is left is nearly noise, such an effect stands for what is left as well as wider noise does. It
    stays if the evidence of the whole set is above that of the set without it by far.

    Parameters
    ----------
    found, first
        As of `judged_in_part`.
    fit : CandidateFit
        Of the set that was named.
    """
    court, problem = Court(found), found.problem
    one_channel = is_one_driven_channel(problem)
    patches = fit.candidate.patches(problem.setting, fit.effect)
    kept = {
        (term.label, term.place) for term, patch in zip(fit.candidate.terms, patches, strict=True)
        if not is_small(problem, patch, unstated=UNSTATED_GAIN) and (court.acts(term) or not one_channel)
    }  # fmt: skip
    whole_key, share = set(fit.candidate.key), court.told(fit).value
    less = [item for key, item in found.exact.items() if key and set(key) < whole_key]
    if kept == whole_key and not any(court.told(item).value > share - SEARCH.sliver for item in less):
        return Outcome(first, found, fit)
    weigh_with_remainders(found)
    whole = found.judged.get(fit.candidate.key, fit)
    for item in sorted(found.judged.values(), key=lambda one: len(one.candidate.terms)):
        own = set(item.candidate.key)
        if not own or not own < whole_key or court.told(item).value < share - SEARCH.sliver:
            continue
        if own == kept or found.score(item) > found.score(whole) - SEARCH.sliver_gain:
            probability = court.probability(item)
            if court.against(item) or probability < SEARCH.sure:
                return _unexplained(court, first, item)
            return _in_part(court, item, probability)
    found.judged = {}
    return Outcome(first, found, fit)


def _beside_coloured_noise(court: Court) -> Outcome | None:
    """Return the verdict where all that is left is the colour of the noise, as its records have it."""
    problem, found = court.problem, court.found
    nothing, best = found.nothing, found.best()
    probabilities = found.set_probabilities()
    told = Conclusion.of(found, best, probabilities)
    gate, p_none = absolute_gate(problem, nothing), probabilities.get((), 0.0)
    if p_none > 1.0 - SEARCH.sure and gate.passed is not False and _is_coloured(nothing):
        more: dict[str, Any] = {"gates": (gate,), "remainders": remainder_estimates(problem, nothing)}
        if p_none >= SEARCH.unsure:
            sentence = said("verdict.coloured_noise")
            return told.outcome(VerdictKind.NOTHING_MISSING, sentence, p_none, nothing, **more)
        hints = sorted(name for name, p in told.inclusion.items() if p > 1.0 - SEARCH.sure)
        total = min(p_none + sum(told.inclusion[name] for name in hints), 1.0)
        sentence, more["group"] = below_limit(hints, " that is coloured"), tuple(hints)
        return told.outcome(VerdictKind.BELOW_LIMIT, sentence, total, nothing, **more)
    if not best.candidate.terms or best.candidate.is_family or not _is_coloured(best):
        return None
    probability = court.probability(best)
    held_out = held_out_gate(court.residuals(replace(best, remainder=None)))
    gates = (absolute_gate(problem, best), consistency_gate(problem, best), held_out)
    if probability < SEARCH.sure or any(gate.passed is False for gate in gates):
        return None
    return told.named(best, probability, gates, remainders=remainder_estimates(problem, best))


def _is_coloured(item: CandidateFit) -> bool:
    return item.remainder is not None and item.remainder.is_noise


def _verdict_of(court: Court, first: Verdict) -> Outcome:
    """Return the verdict of a court."""
    if not court.contenders:
        return _unexplained(court, first)
    best = court.slimmed(court.contenders[0])
    members = [best, *court.rivals(best)]
    if len(members) > SEARCH.largest_group:
        return _unexplained(court, first, best, said("against.rivals", rivals=len(members) - 1))
    if court.grew(best):
        return _unexplained(court, first, best)
    probability = court.probability(*members)
    if probability < SEARCH.sure:
        return _unexplained(court, first, best)
    log_bayes_factor = best.log_evidence - court.nothing.log_evidence
    if log_bayes_factor < SEARCH.bayes_factor:
        return _unexplained(court, first, best, _too_little_evidence(log_bayes_factor))
    if len(members) > 1:
        if all(map(court.passes_absolute_fit, members)):
            return _group(court, members, probability)
        others = listing([effects_text(named_effects(court.problem, item)) for item in members[1:]], "or")
        why = f"it leaves more than noise, and these data do not tell it from {others}"
        return _unexplained(court, first, best, why)
    return _in_part(court, best, probability)


def _too_little_evidence(log_bayes_factor: float) -> str:
    """Return why a hypothesis is no name that explains little more than a force without any law does."""
    return (
        "a missing force without any law explains the readings as well "
        f"(ln Bayes factor {log_bayes_factor:.3g}; a name needs {SEARCH.bayes_factor:g})"
    )


def _in_part(court: Court, best: Hypothetic, probability: float) -> Outcome:
    """Return the verdict that names a hypothesis in part."""
    effects, share = named_effects(court.problem, best), court.told(best)
    family = ", ".join(sorted({t.effect.family for t in best.candidate.terms if t.free_shape}))
    named = effects_text(effect for effect in effects if not effect.shape)
    what = listing(filter(None, (named, said("verdict.family_in_part", family=family) if family else "")))
    _, explains = court.closed(best)
    sentence = f"{capital(what)} is missing (probability {probability_text(probability)}): {explains}."
    if court.has_held_out and not share.held_out:
        sentence += " In the trials held out it has hardly any force."
    sentence += f" It leaves {court.left(best, share)}, which is unexplained."
    sentence += _shape(court, best) + _not_proved(court, best)
    more = {"effects": effects, "family": family, "gates": (court.gate(best),)}
    return _outcome(court, VerdictKind.NAMED_IN_PART, sentence, probability, best, [best], **more)


def _group(court: Court, members: Sequence[Hypothetic], probability: float) -> Outcome:
    """Return the verdict that one of several hypotheses is what is missing, what they share first."""
    effects = [named_effects(court.problem, item) for item in members]
    rows = zip(members, effects, strict=True)
    words = [f"{effects_text(own)}{_share_in_brackets(court, item)}" for item, own in rows]
    sentence = f"Either {listing(words, 'or')} is missing; these data cannot tell which."
    closed, reason = court.closed(members[0])
    if closed is None:
        sentence += f" {capital(reason)}."
    else:
        sentence += (
            f" In brackets the share of the mean square error that each explains in {trials_text(closed)}."
        )
    common = frozenset.intersection(*map(names, members))
    both = [effect for effect in effects[0] if (effect.identifier, effect.place) in common]
    if both:
        sentence = f"{capital(effects_text(both))} is missing. {sentence}"
    more = {
        "effects": tuple(effect for own in effects for effect in own),
        "group": tuple(" + ".join(sorted(plain_names(item.candidate.identifiers))) for item in members),
        "gates": (court.gate(members[0]),),
    }
    return _outcome(court, VerdictKind.GROUP, sentence, min(probability, 1.0), members[0], members, **more)


def _share_in_brackets(court: Court, item: Hypothetic) -> str:
    """Return the share of the mean square error that a member of a group takes away; empty: none is told."""
    closed, _ = court.closed(item)
    return "" if closed is None else f" ({share_text(closed)})"


def _unexplained(court: Court, first: Verdict, close: Hypothetic | None = None, why: str = "") -> Outcome:
    """Return the verdict that a force is missing which has no name: how large, and what orders it.

    `close`: what has a probability that is too small for a name, unless something else speaks against it.
    """
    failed = next((gate.reason for gate in first.gates if gate.passed is False), "")
    gap = f"{said('verdict.no_effect_fits', reason=failed).strip()} {court.gap()}".strip()
    effective = [item for item in court.ranked if item.candidate.terms]
    shown = close or max(effective, key=lambda item: court.told(item).value, default=None)
    if shown is None or court.told(shown).value < LEAST_SHOWN:
        shown, sentence = None, f"{gap} No effect of the catalogue follows it."
    elif court.grew(shown):
        sentence = f"{gap} {_worse(court, shown)}"
        shown = None
    else:
        why = why or court.against(shown)
        if close is not None and not why:
            why = said("against.probability", probability=court.probability(close), sure=SEARCH.sure)
        why = f"; it is no name, as {why}" if why else ""
        what, (_, explains) = effects_text(named_effects(court.problem, shown)), court.closed(shown)
        sentence = f"{gap} The best hypothesis is {what}: {explains}{why}."
    more = {
        "resembles": () if shown is None else plain_names(shown.candidate.identifiers), "gates": first.gates,
    }  # fmt: skip
    return _outcome(court, VerdictKind.UNEXPLAINED, sentence, first.probability, shown, [], **more)


def _worse(court: Court, item: Hypothetic) -> str:
    """Return the sentence on a hypothesis that makes the error larger, and is no name for that reason."""
    what = effects_text(named_effects(court.problem, item))
    if court.simulated(item) is court.found.none:
        return f"The nearest in the catalogue is {what}, but it cannot be simulated: nothing is named."
    _, words = court.closed(item)
    return (
        f"The nearest in the catalogue is {what}, but {words}: nothing is named, and nothing to be applied."
    )


def _outcome(
    court: Court, kind: VerdictKind, sentence: str, probability: float, stands: Hypothetic | None,
    first: Sequence[Hypothetic], **more: Any,
) -> Outcome:  # fmt: skip
    """Return a verdict with all hypotheses, some of them `first`, and the one that stands for it."""
    ranked = [*first, *(item for item in court.ranked if not any(item is one for one in first))]
    scores = np.array([court.score(item) for item in ranked])
    weights = np.exp(scores - logsumexp(scores)).tolist()
    rows = [*zip(ranked, weights, strict=True)]
    rows = rows[: len(first)] + sorted(rows[len(first) :], key=lambda row: -row[1])
    fit = court.found.none if stands is None else court.simulated(stands)
    court.standing = stands
    gain = (stands or ranked[0]).log_evidence - court.nothing.log_evidence
    more["remainders"] = remainder_estimates(court.problem, fit)
    return Conclusion(court.found, gain, rows).outcome(kind, sentence, probability, fit, **more)


def _shape(court: Court, best: Hypothetic) -> str:
    """Return the sentence on the free shape of one law, unless trials not fitted speak against it."""
    (term, *others) = best.candidate.terms
    free = None if others else court.freed(best)
    if free is None or court.told(free).value < court.told(best).value - SEARCH.slim:
        return ""
    spread = np.sqrt(np.diag(free.covariance))[len(free.shared) + len(term.effect.parameters) :]
    shown = [
        f"{item.description.split(' (')[0]} {item.value:.2g} ({item.low:.2g} to {item.high:.2g})"
        for item, deviation in zip(named_effects(court.problem, free)[0].shape, spread, strict=True)
        if deviation < SEARCH.told_by_data
    ]
    return said("verdict.with_a_shape", shape=", ".join(shown)) if shown else ""


def _not_proved(court: Court, best: Hypothetic) -> str:
    """Return the sentence on the next law that would stand beside a name, close but not probable enough."""
    own, least = families(best), court.score(best) - SEARCH.contenders
    longer = (item for item in court.ranked if families(item) > own)
    more = (item for item in longer if all(map(court.acts, item.candidate.terms)))
    close = next((item for item in more if court.score(item) > least), None)
    if close is None or court.told(close).value < court.told(best).value + SEARCH.sliver:
        return ""
    effects = named_effects(court.problem, close)
    added = effects_text(effect for effect in effects if (effect.family, effect.place) not in own)
    return said("verdict.not_proved", what=capital(added))


def remainder_estimates(problem: Problem, found: CandidateFit) -> tuple[RemainderEstimate, ...]:
    """Return the remainders of a fit for the verdict."""
    left = found.remainder
    if left is None:
        return ()
    rows = zip(problem.channel_names, left.size, left.time, left.frequency, strict=True)
    return tuple(RemainderEstimate(name, *map(float, of)) for name, *of in rows if of[0] > 0.0)
