"""From fitted candidates to a verdict: named, a family, a group, unexplained, or nothing missing."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from discrepancy.catalogue.entry import Effect
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit, attempt
from discrepancy.fits.gates import SHAPE_GAIN, absolute_gate, shape_gate
from discrepancy.fits.other_optima import free_shape
from discrepancy.fits.posterior import with_draws
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.problem import Problem
from discrepancy.search.hypotheses import Tell, in_silence
from discrepancy.search.starting_points import acts_within
from discrepancy.search.strategy import Search, search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import Gate, NamedEffect, Verdict, VerdictKind
from fe.runtime.patch import INTERNAL_FORCES, SENSORS, LoadGain, SensorGain

from .conclusion import Conclusion, best_of, named_effects, plain_names
from .consistency_gate import consistency_gate
from .in_part import judged_in_part, without_sliver
from .practical_size import LEAST_SIZE, is_one_driven_channel, small_terms
from .proof import held_out_gate


def name(
    problem: Problem, effects: Sequence[Effect], tell: Tell = in_silence
) -> tuple[Verdict, Search, CandidateFit]:
    """Name what is missing.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    effects : sequence of Effect
        The catalogue.
    tell : callable
        Takes a few words on what is fitted, and how much is left.

    Returns
    -------
    Verdict
        Without next experiments and data faults, which others add.
    Search
        All candidates.
    CandidateFit
        The one that stands for the verdict: of the named set, of the family, of the most probable member of a
        group or of what is too small to tell; else the one without effect.
    """
    found = search(problem, effects, tell)
    first = _named(problem, found)
    if found.force is None or first[0].kind is not VerdictKind.UNEXPLAINED:
        return first
    tell("nothing follows the missing force: comparing whole simulations")
    again = attempt(problem, Candidate(), found.none.point)  # time steps may be finer by now
    second = Search(problem, found.effects, again or found.none, tell=tell)
    second.run()
    other = _named(problem, second)
    second.force, second.forces = found.force, found.forces
    causes = any(acts_within(term.effect, problem.setting) for term in other[2].candidate.terms)
    named = other[0].kind is VerdictKind.NAMED_IN_PART
    return other if named and causes and _closes_fitted(problem, other) else first


def _closes_fitted(problem: Problem, outcome: tuple[Verdict, Search, CandidateFit]) -> bool:
    """Whether a fit closes most of the gap where it was fitted: held-out trials alone give no name."""
    _, found, fit = outcome
    count = float(problem.counts.sum())
    gap = found.none.chi_square - count
    return gap > 0.0 and fit.chi_square - count < (1.0 - SEARCH.least_share) * gap


def _named(problem: Problem, found: Search) -> tuple[Verdict, Search, CandidateFit]:
    """Return the verdict on a search, by its simulations or else by the missing force."""
    verdict, _, fit = _as_recorded(problem, found)
    stands = verdict.kind in (VerdictKind.NAMED, VerdictKind.FAMILY)
    if stands or verdict.kind is VerdictKind.GROUP:
        gate = held_out_gate(residual_set(problem, fit, sensitivities=False))
        said = f" {gate.reason}" if gate.passed is False else ""
        verdict = replace(verdict, sentence=verdict.sentence + said, gates=(*verdict.gates, gate))
        stands = stands and gate.passed is not False
    may_name = verdict.kind in (VerdictKind.NAMED, VerdictKind.GROUP)
    if may_name and _all_small(problem, found, verdict, fit):
        return _nuisance(verdict), found, found.none
    if may_name and _stands_for_parameters(problem, found, verdict):
        return _strained(problem, found, verdict), found, found.none
    if stands and len(verdict.effects) > 1:
        alone = _without_readings(problem, found, verdict, fit)
        if alone is not None:
            return alone
        verdict, _, fit = without_sliver(problem, found, verdict, fit)
        return verdict, found, fit
    misfits = any(
        gate.name in ("absolute fit", "held-out trials") and gate.passed is False for gate in verdict.gates
    )
    open_kinds = (VerdictKind.NAMED, VerdictKind.FAMILY, VerdictKind.UNEXPLAINED)
    open_group = verdict.kind is VerdictKind.GROUP and found.force is not None
    if open_group or (not stands and (misfits or verdict.kind in open_kinds)):
        return judged_in_part(problem, found, verdict)
    return verdict, found, fit


def _without_readings(
    problem: Problem, found: Search, verdict: Verdict, fit: CandidateFit
) -> tuple[Verdict, Search, CandidateFit] | None:
    """Return the verdict that names laws in part, without an error of readings that was named beside them.

    Where laws are nearly all of the missing force, such an error takes up what is left, whatever it is.
    """
    acts = [acts_within(term.effect, problem.setting) for term in fit.candidate.terms]
    if found.force is None or all(acts) or not any(acts):
        return None
    other = judged_in_part(problem, found, verdict)
    in_part, share = other[0].kind is VerdictKind.NAMED_IN_PART, other[0].explained
    return other if in_part and share is not None and share.value > SEARCH.nearly_all else None


def _all_small(problem: Problem, found: Search, verdict: Verdict, fit: CandidateFit) -> bool:
    """Whether all that a verdict names is too small to be a cause."""
    if verdict.kind is VerdictKind.NAMED:
        return None not in small_terms(problem, fit)
    members = [item for item in found.exact.values() if " + ".join(_sorted(item)) in verdict.group]
    return bool(members) and all(None not in small_terms(problem, item) for item in members)


def _sorted(item: CandidateFit) -> list[str]:
    return list(plain_names(item.candidate.identifiers))


def _nuisance(verdict: Verdict) -> Verdict:
    """Return the verdict where all that is missing is below what counts as a cause."""
    what = " or ".join(dict.fromkeys(effect.name for effect in verdict.effects))
    return replace(
        verdict,
        kind=VerdictKind.NOTHING_MISSING,
        sentence=f"The model explains the data but for {what} below {100.0 * LEAST_SIZE:g} % of what it acts "
        "on, which is a nuisance of the instruments and no name.",
        effects=(), group=(),
    )  # fmt: skip


def _stands_for_parameters(problem: Problem, found: Search, verdict: Verdict) -> bool:
    """Whether a verdict of errors of instruments only keeps calibrated parameters within their priors.

    With one channel under a recorded drive a gain does what all parameters of a linear model do together.
    Where the model as it is leaves no gap on held-out trials either, nothing but these priors speaks for it.
    """
    if not is_one_driven_channel(problem) or not problem.campaign.held_out:
        return False
    gains = [any(isinstance(part, LoadGain | SensorGain) for part in item.patch) for item in verdict.effects]
    instruments = all(
        isinstance(part, (LoadGain, *SENSORS)) for item in verdict.effects for part in item.patch
    )
    as_it_is = held_out_gate(residual_set(problem, found.none, sensitivities=False))
    return any(gains) and instruments and as_it_is.passed is True


def _strained(problem: Problem, found: Search, verdict: Verdict) -> Verdict:
    """Return the verdict where errors of instruments and calibrated parameters cannot be told apart."""
    moved = zip(problem.model.parameters, found.none.point.shared, strict=False)
    far = [f"{item.name!r} {abs(u):.1f}" for item, u in moved if abs(u) > SEARCH.stand_in_range]
    told = f" ({', '.join(far)} stated deviations off)" if far else ""
    words = " or ".join(dict.fromkeys(effect.name for effect in verdict.effects))
    return replace(
        verdict, kind=VerdictKind.UNEXPLAINED,
        sentence="The model predicts held-out trials as it is, but with calibrated parameters beside their "
        f"priors{told}. An error of the instruments "
        f"({words}) would do as well: with one channel these data cannot tell them apart.",
        resembles=tuple(dict.fromkeys(effect.identifier for effect in verdict.effects)),
        effects=(), group=(),
    )  # fmt: skip


def _as_recorded(problem: Problem, found: Search) -> tuple[Verdict, Search, CandidateFit]:
    """Return the verdict if what a right model leaves is noise as the records say, and no more."""
    probabilities = _settled_probabilities(found)
    top, p_top = next(iter(probabilities.items()))
    best = best_of(found, top) if top else found.best()
    told = Conclusion.of(problem, found, best, probabilities)
    none_gate = absolute_gate(problem, found.none)
    if not top or (told.log_bayes_factor < SEARCH.bayes_factor and none_gate.passed is not False):
        if none_gate.passed is False:
            sentence = f"There is a gap that no effect of the catalogue explains. {none_gate.reason}"
            return told.unexplained(sentence, p_top, (none_gate,))
        if top and probabilities.get((), 0.0) < SEARCH.unsure:
            return _open(problem, found, probabilities, told.verdict, best)
        sentence = (
            "The model explains the data within their noise."
            if none_gate.passed
            else "No effect of the catalogue explains the data better than the model does. "
            f"{none_gate.reason}"
        )
        verdict = told.verdict(
            VerdictKind.NOTHING_MISSING, sentence, probabilities.get((), 0.0), gates=(none_gate,)
        )
        return verdict, found, found.none

    # sets that hold the best one and more agree with it; they only leave a further effect open
    p_top = min(
        sum(p for names, p in probabilities.items() if set(plain_names(top)) <= set(plain_names(names))), 1.0
    )
    if best.candidate.is_family:  # reached from several members or places, it is one family
        p_top = max(p_top, _family_probability(found, best.candidate.terms[0].effect.family))
    if p_top < SEARCH.sure or told.log_bayes_factor < SEARCH.bayes_factor:
        return _shared(problem, found, probabilities) or _open(
            problem, found, probabilities, told.verdict, best
        )
    return _judged(told, best, p_top)


def _shared(
    problem: Problem, found: Search, probabilities: dict[tuple[str, ...], float]
) -> tuple[Verdict, Search, CandidateFit] | None:
    """Return the verdict that names what all probable sets hold, if that fits alone: else a group is open.

    Which further effect it has beside it stays open, and a name does not depend on that.
    """
    members = _members(probabilities)
    common = set.intersection(*(set(plain_names(names)) for names in members))
    alone = next((names for names in members if set(names) == common), None)
    if not alone:
        return None
    best = best_of(found, alone)
    told = Conclusion.of(problem, found, best, probabilities)
    p_common = sum(p for names, p in probabilities.items() if common <= set(plain_names(names)))
    if p_common < SEARCH.sure or told.log_bayes_factor < SEARCH.bayes_factor:
        return None
    outcome = _judged(told, best, min(p_common, 1.0))
    return outcome if outcome[0].kind is VerdictKind.NAMED else None


def _judged(told: Conclusion, best: CandidateFit, p_top: float) -> tuple[Verdict, Search, CandidateFit]:
    """Return the verdict on the best set, probable enough for a name: by the gates."""
    problem, found = told.problem, told.found
    gate, consistent = absolute_gate(problem, best), consistency_gate(problem, best)
    if best.candidate.is_family:
        if _pass(gate, consistent):
            return told.family(best, p_top, (gate, consistent))
        reason = _failing(gate, consistent).reason
        return told.unexplained(
            f"There is a gap that no effect of the catalogue fits. {reason}", p_top, (gate, consistent)
        )
    shape, family = _shape(found, best)
    if _pass(gate, shape, consistent):
        best = with_draws(problem, best)
        named = named_effects(problem, best)
        more = {"effects": named, "gates": (gate, shape, consistent)}
        return (
            told.verdict(VerdictKind.NAMED, _named_sentence(named, p_top, gate), p_top, **more),
            found,
            best,
        )
    nearest = f"There is a gap that no effect of the catalogue fits; the nearest is {' with '.join(told.top)}"
    if family is not None and not shape.passed:
        if not _may_be_free(found, best):
            return told.unexplained(
                f"{nearest}, but one of them would need a shape of its own, and with so much freedom nearly "
                "anything fits.",
                p_top,
                (gate, shape, consistent),
            )
        gate, consistent = absolute_gate(problem, family), consistency_gate(problem, family)
        if _pass(gate, consistent):
            return told.family(family, p_top, (gate, shape, consistent))
    reason = _failing(gate, consistent).reason
    return told.unexplained(
        f"{nearest}, but {reason[0].lower()}{reason[1:]}", p_top, (gate, shape, consistent)
    )


def _pass(*gates: Gate) -> bool:
    return all(gate.passed is not False for gate in gates)


def _failing(absolute: Gate, consistent: Gate) -> Gate:
    """Return the gate that says why; the absolute one where it failed too."""
    return consistent if absolute.passed is not False and consistent.passed is False else absolute


def _settled_probabilities(found: Search) -> dict[tuple[str, ...], float]:
    """Return the probabilities of sets, those that matter fitted exactly: few steps give rough evidence."""
    probabilities = found.set_probabilities()
    for _ in range(SEARCH.largest_group):
        exact = {item.candidate.identifiers for item in found.exact.values()}
        rough = [names for names in _members(probabilities) if names not in exact]
        if not rough:
            break
        best_of(found, rough[0])
        probabilities = found.set_probabilities()
    return probabilities


def _members(probabilities: Mapping[tuple[str, ...], float]) -> list[tuple[str, ...]]:
    """Return the most probable sets that together reach the probability of a name."""
    members: list[tuple[str, ...]] = []
    total = 0.0
    for names, p in probabilities.items():
        members.append(names)
        total += p
        if total >= SEARCH.sure:
            break
    return members


def _family_probability(found: Search, family: str) -> float:
    """Return the probability of a family: of all single effects of it, named or of free shape."""
    kept = found.all().values()
    scores = np.array([found.score(item) for item in kept])
    members = np.array(
        [len(item.candidate.terms) == 1 and item.candidate.terms[0].effect.family == family for item in kept]
    )
    weights = np.exp(scores - scores.max())
    return float(weights[members].sum() / weights.sum())


def _open(
    problem: Problem,
    found: Search,
    probabilities: Mapping[tuple[str, ...], float],
    verdict: Callable[..., Verdict],
    best: CandidateFit,
) -> tuple[Verdict, Search, CandidateFit]:
    """Return the verdict where no set reaches the probability that a name needs, as `name` does."""
    members = _members(probabilities)
    total = sum(probabilities[names] for names in members)
    fits = [best_of(found, names) for names in members]
    if () in members:
        hints = sorted({name for names in members for name in plain_names(names)})
        return (
            verdict(
                VerdictKind.BELOW_LIMIT,
                "Something may be missing, but too small for these data to tell from noise"
                + (f"; the nearest are {', '.join(hints[:4])}." if hints else "."),
                total, group=tuple(hints), gates=(absolute_gate(problem, best),),
            ),
            found, best,
        )  # fmt: skip
    gates = [absolute_gate(problem, item) for item in fits]
    fitting: list[tuple[tuple[str, ...], CandidateFit, Gate]] = []
    together = 0.0
    for names, item, each in zip(members, fits, gates, strict=True):
        if each.passed is False:  # those that do not fit take their probability with them
            continue
        together += probabilities[names]
        if plain_names(names) not in [
            plain_names(other) for other, _, _ in fitting
        ]:  # else a law and its family
            fitting.append((names, with_draws(problem, item), each))
    if not fitting or len(fitting) > SEARCH.largest_group:
        return (
            verdict(
                VerdictKind.UNEXPLAINED,
                f"There is a gap that no effect of the catalogue fits. {gates[0].reason}"
                if not fitting
                else f"There is a gap, and {len(fitting)} explanations fit it alike.",
                total, gates=(gates[0],), resembles=plain_names(members[0]),
            ),
            found, found.none,
        )  # fmt: skip
    group = tuple(" + ".join(plain_names(names)) for names, _, _ in fitting)
    labels = [" + ".join(names) for names, _, _ in fitting]
    effects = tuple(effect for _, item, _ in fitting for effect in named_effects(problem, item))
    _, nearest, gate = fitting[0]
    sentence = (
        f"Either {', '.join(labels[:-1])} or {labels[-1]} is missing; these data cannot tell which."
        if len(group) > 1
        else f"There is a gap that {labels[0]} fits, but not with the probability that a name needs."
    )
    return (
        verdict(VerdictKind.GROUP, sentence, together, effects=effects, group=group, gates=(gate,)),
        found, nearest,
    )  # fmt: skip


def _may_be_free(found: Search, best: CandidateFit) -> bool:
    """Whether a set may be stated with one law of free shape.

    A free shape counts as one more effect, and beside a second law it would imitate nearly anything.
    """
    laws = 0
    for term, part in zip(best.candidate.terms, best.candidate.parts(best.point.effect), strict=True):
        alone = Candidate((term,)).patch(found.problem.setting, part)
        laws += len(alone.of(*INTERNAL_FORCES)) > 0
    return laws < 2 and len(best.candidate.terms) < SEARCH.largest_set


def _shape(found: Search, best: CandidateFit) -> tuple[Gate, CandidateFit | None]:
    """Free the shape of each effect of the best set in turn; return the outcome that matters most."""
    outcome, kept = shape_gate(best, None), None
    for number in range(len(best.candidate.terms)):
        family = free_shape(found.problem, best, number)
        if family is None:
            continue
        gate = shape_gate(best, family)
        if kept is None or gate.statistic > outcome.statistic:
            outcome, kept = gate, family
    return outcome, kept if kept is not None and outcome.statistic > SHAPE_GAIN else None


def _named_sentence(named: tuple[NamedEffect, ...], probability: float, gate: Gate) -> str:
    what = " and ".join(f"{effect.name}{f' at {effect.place}' if effect.place else ''}" for effect in named)
    certain = "> 0.999" if probability > 0.9995 else f"{probability:.3f}"  # never one
    limit = "" if gate.passed else f" {gate.reason}"
    return f"The model lacks {what} (probability {certain}).{limit}"
