"""From fitted candidates to a verdict: by the rules, and what overrules them."""

from collections.abc import Sequence
from dataclasses import replace

from discrepancy.catalogue.entry import Effect
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit, attempt
from discrepancy.fits.predictive import residual_set
from discrepancy.fits.problem import Problem
from discrepancy.search.hypotheses import Tell, acts_within, in_silence
from discrepancy.search.strategy import Search, search
from discrepancy.search_settings import SEARCH
from discrepancy.sentences import said
from discrepancy.verdict import Verdict, VerdictKind
from fe.runtime.patch import SENSORS, LoadGain, SensorGain

from .conclusion import LEAST_SIZE, Outcome, is_one_driven_channel, plain_names, small_terms
from .in_part import judged_in_part, without_sliver
from .proof import held_out_gate
from .rules import as_recorded

INSTRUMENTS = (LoadGain, *SENSORS)


def name(problem: Problem, effects: Sequence[Effect], tell: Tell = in_silence) -> Outcome:
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
    Outcome
        The verdict without next experiments and data faults, which others add; all candidates; the fit that
        stands for the verdict: of the named set, of the family, of the most probable member of a group or of
        what is too small to tell; else the one without effect.
    """
    found = search(problem, effects, tell)
    first = _named(problem, found)
    if found.force is None or first.verdict.kind is not VerdictKind.UNEXPLAINED:
        return first
    tell("nothing follows the missing force: comparing whole simulations")
    again = attempt(problem, Candidate(), found.none.point)  # time steps may be finer by now
    second = Search(problem, found.effects, again or found.none, tell=tell)
    second.run()
    other = _named(problem, second)
    second.force, second.forces = found.force, found.forces
    named = other.verdict.kind is VerdictKind.NAMED_IN_PART and any(_acts(problem, other.fit))
    # held-out trials alone give no name: most of the gap is to be closed where it was fitted
    count = float(problem.counts.sum())
    gap = second.none.chi_square - count
    closes = gap > 0.0 and other.fit.chi_square - count < (1.0 - SEARCH.least_share) * gap
    return other if named and closes else first


def _acts(problem: Problem, fit: CandidateFit) -> list[bool]:
    """Return which effects of a fit act on the structure, and are no errors of readings."""
    return [acts_within(term.effect, problem.setting) for term in fit.candidate.terms]


def _named(problem: Problem, found: Search) -> Outcome:
    """Return the verdict on a search, by its simulations or else by the missing force."""
    verdict, _, fit = as_recorded(problem, found)
    stands = verdict.kind in (VerdictKind.NAMED, VerdictKind.FAMILY)
    if stands or verdict.kind is VerdictKind.GROUP:
        gate = held_out_gate(residual_set(problem, fit, sensitivities=False))
        sentence = f"{verdict.sentence} {gate.reason}" if gate.passed is False else verdict.sentence
        verdict = replace(verdict, sentence=sentence, gates=(*verdict.gates, gate))
        stands = stands and gate.passed is not False
    if verdict.kind in (VerdictKind.NAMED, VerdictKind.GROUP):
        overruled = _nuisance(problem, found, verdict, fit) or _strained(problem, found, verdict)
        if overruled is not None:
            return Outcome(overruled, found, found.none)
    if stands and len(verdict.effects) > 1:
        alone = _without_readings(problem, found, verdict, fit)
        return without_sliver(problem, found, verdict, fit) if alone is None else alone
    failed = {gate.name for gate in verdict.gates if gate.passed is False}
    open_kinds = (VerdictKind.NAMED, VerdictKind.FAMILY, VerdictKind.UNEXPLAINED)
    open_group = verdict.kind is VerdictKind.GROUP and found.force is not None
    misfits = bool(failed & {"absolute fit", "held-out trials"})
    if open_group or (not stands and (misfits or verdict.kind in open_kinds)):
        return judged_in_part(problem, found, verdict)
    return Outcome(verdict, found, fit)


def _without_readings(problem: Problem, found: Search, verdict: Verdict, fit: CandidateFit) -> Outcome | None:
    """Return the verdict that names laws in part, without an error of readings that was named beside them.

    Where laws are nearly all of the missing force, such an error takes up what is left, whatever it is.
    """
    acts = _acts(problem, fit)
    if found.force is None or all(acts) or not any(acts):
        return None
    other = judged_in_part(problem, found, verdict)
    in_part, share = other.verdict.kind is VerdictKind.NAMED_IN_PART, other.verdict.explained
    return other if in_part and share is not None and share.value > SEARCH.nearly_all else None


def _nuisance(problem: Problem, found: Search, verdict: Verdict, fit: CandidateFit) -> Verdict | None:
    """Return the verdict where all that is named is below what counts as a cause; None where it is not."""
    fits = [fit]
    if verdict.kind is VerdictKind.GROUP:
        held = [(" + ".join(plain_names(i.candidate.identifiers)), i) for i in found.exact.values()]
        fits = [item for label, item in held if label in verdict.group]
    if not fits or any(None in small_terms(problem, item) for item in fits):
        return None
    sentence = said("verdict.nuisance", what=_either(verdict), least=100.0 * LEAST_SIZE)
    return replace(verdict, kind=VerdictKind.NOTHING_MISSING, sentence=sentence, effects=(), group=())


def _either(verdict: Verdict) -> str:
    return " or ".join(dict.fromkeys(effect.name for effect in verdict.effects))


def _strained(problem: Problem, found: Search, verdict: Verdict) -> Verdict | None:
    """Return the verdict where errors of instruments only keep calibrated parameters within their priors.

    With one channel under a recorded drive a gain does what all parameters of a linear model do together.
    Where the model as it is leaves no gap on held-out trials either, nothing but these priors speaks for it.
    """
    parts = [part for effect in verdict.effects for part in effect.patch]
    gains = any(isinstance(part, LoadGain | SensorGain) for part in parts)
    instruments = gains and all(isinstance(part, INSTRUMENTS) for part in parts)
    if not instruments or not is_one_driven_channel(problem) or not problem.campaign.held_out:
        return None
    if held_out_gate(residual_set(problem, found.none, sensitivities=False)).passed is not True:
        return None
    moved = zip(problem.model.parameters, found.none.point.shared, strict=False)
    far = [f"{item.name!r} {abs(u):.1f}" for item, u in moved if abs(u) > SEARCH.stand_in_range]
    told = f" ({', '.join(far)} stated deviations off)" if far else ""
    sentence = said("verdict.parameters_or_instruments", far=told, what=_either(verdict))
    resembles = tuple(dict.fromkeys(effect.identifier for effect in verdict.effects))
    return replace(
        verdict, kind=VerdictKind.UNEXPLAINED, sentence=sentence, resembles=resembles, effects=(), group=()
    )
