"""The page: verdict first, then where the gap is, why this name, the proof, and what all rests on.

What it says, and in which order, stands in `words.toml`; here is what is said there by name.
"""

from functools import partial
from math import isfinite, nan
from typing import Any

from discrepancy.campaign.units import UNITS
from discrepancy.judgement.conclusion import calibrated_parameters, effects_text, named_effects
from discrepancy.judgement.remarks import NO_GAP, when_sentence
from discrepancy.report import text as words
from discrepancy.report.figures import ReportInput
from discrepancy.report.text import WORDS, group_lines, neighbours, seen_of
from discrepancy.self_calibration import SelfCalibration, Share, outcomes
from discrepancy.verdict import Gate, Hypothesis, Verdict, VerdictKind
from discrepancy.workflow import Investigation
from reporting.page import Page, ReportFigure
from reporting.templates import fill_template
from reporting.words import listing, plus_minus

SHOWN_HYPOTHESES = 8
NINETY = 1.6449
"""Normal quantile at 95 %: half of a 90 % interval in standard deviations."""


def evidence_rows(verdict: Verdict) -> list[tuple[Hypothesis, str]]:
    """Return the best hypotheses, each with its role: members of a group first and 'none' always."""
    named = " + ".join(sorted(item.identifier for item in verdict.effects))
    stands = dict.fromkeys(verdict.group or filter(None, [named]), True)  # each once, the most probable
    role = "member of the group" if verdict.group else verdict.kind.value
    ranked = [
        (item, role if stands.pop(" + ".join(item.identifiers), False) else "") for item in verdict.hypotheses
    ]
    ranked.sort(key=lambda row: not row[1])
    return ranked[:SHOWN_HYPOTHESES] + [row for row in ranked[SHOWN_HYPOTHESES:] if not row[0].effects]


def not_compared_rows(verdict: Verdict) -> list[tuple[str, str]]:
    """Return reasons, and what was not compared for each."""
    by_reason: dict[str, list[str]] = {}
    for item in verdict.not_fitted:
        gain = f" ({words.number(item.gain, 2)} nat)" if isfinite(item.gain) else ""
        reason = "screened out" if item.reason.startswith("screened out") else item.reason
        by_reason.setdefault(reason, []).append(item.identifier.replace("_", " ") + gain)
    return [(f"{reason[:1].upper()}{reason[1:]}", listing(names)) for reason, names in by_reason.items()]


def parameter_rows(investigation: Investigation) -> list[tuple[str, ...]]:
    """Return name, unit, and values with 90 % half-widths: calibration, model as it was, with the effect.

    Without an effect the last column is left out; without parameters there are no rows.
    """
    problem, search, fit = investigation.problem, investigation.search, investigation.fit
    if problem is None or search is None or fit is None:
        return []
    layout = problem.shared
    fits = [search.no_effect] + ([fit] if fit.candidate.terms else [])
    rows = []
    stated = [*zip(layout.centre.tolist(), layout.scale.tolist(), strict=True)][: layout.count]
    for prior, *found in zip(stated, *(calibrated_parameters(problem, one) for one in fits), strict=True):
        cells = [_beside(*prior), *(_beside(item.mean, item.deviation) for item in found)]
        rows.append((found[0].name.replace("_", " "), words.unit_text(found[0].unit), *cells))
    return rows


def _beside(value: float, deviation: float) -> str:
    return plus_minus(value, NINETY * deviation) if deviation > 0.0 else f"{value:.6g}, exact"


def score_rows(investigation: Investigation) -> tuple[list[str], list[list[str]]]:
    """Return what is scored in the proof, before and after, and the rows of its table."""
    proof, before = investigation.proof, investigation.before
    assert proof is not None
    scored = {
        "held out, before": proof.held_out_before, "held out, after": proof.held_out_after,
        "fitted, before": proof.fitted_before, "fitted, after": proof.fitted_after,
    }  # fmt: skip
    scores = {title: item for title, item in scored.items() if item is not None}
    shown = partial(fill_template, number=words.number, p_value_text=words.p_value_text)
    rows = [
        [title, *(shown(cell, score=item) for item in scores.values())]
        for title, cell in WORDS.content["scores"].items()
    ]
    channels = {} if before is None else before.channels
    for name in dict.fromkeys(name for item in scores.values() for name in item.rms):
        factor, unit = UNITS[channels[name].quantity].drawn if name in channels else (1.0, "")
        sizes = (words.number(factor * item.rms.get(name, nan)) for item in scores.values())
        rows.append([f"rms of {name}, {unit}", *sizes])
    return list(scores), rows


def effect_rows(verdict: Verdict) -> list[dict[str, Any]]:
    """Return effects with each of their parameters; by members of a group, where the verdict is one."""
    rows = []
    for number, effects in enumerate(words.members_of(verdict).values() or (verdict.effects,), start=1):
        own = [
            (effect, item) for effect in effects for item in (*effect.parameters, *effect.shape) or (None,)
        ]
        members = [number, *[""] * len(own)]
        rows += [{"member": m, "effect": e, "item": i} for m, (e, i) in zip(members, own, strict=False)]
    return rows


LONGEST_CARD = 60
"""Characters of a card of the page at most; the sentence below it has all names."""


def what_is_missing(verdict: Verdict) -> str:
    """Return what is missing in the few words of a card."""
    members = words.members_of(verdict)
    if members:
        names = listing(members, "or")
        return names if len(names) <= LONGEST_CARD else f"one of {len(members)} hypotheses"
    named = verdict.effects if verdict.kind in words.NAMING else ()
    kept = [item for item in named if not (item.shape and verdict.family)]
    found = [effects_text(kept), f"an effect of the family {verdict.family}" if verdict.family else ""]
    return WORDS.content["without"].get(verdict.kind) or listing(filter(None, found)) or "no name"


def sizes_sentence(content: ReportInput) -> str:
    """Return how large what is missing is, in SI units, or by its parameters where none has a unit."""
    found = content.investigation
    if content.intervals and found.problem is not None and found.fit is not None:
        effects = named_effects(found.problem, found.fit)
        if sentence := words.size_sentence(found, effects, content.intervals):
            return sentence
    return WORDS.say("sizes", effects=found.verdict.effects if found.verdict.kind in words.NAMING else ())


def deciding(verdict: Verdict) -> list[Gate]:
    """Return the gates that compare a p-value, first the one that decided."""
    compared = [gate for gate in verdict.gates if isfinite(gate.statistic)]
    judged = [gate for gate in compared if gate.name not in ("shape", "held-out trials")]
    return sorted(judged, key=lambda gate: gate.passed is not False)


def calibration_rows(tried: SelfCalibration) -> list[tuple[str, str, Share]]:
    """Return what was hidden in simulated campaigns, outcomes, and their shares."""
    rows = [
        (title, outcome, tried.share(outcome, null=null))
        for title, null in (("an effect was hidden", False), ("nothing was hidden", True))
        for outcome in outcomes(tried, null=null)
    ]
    return [*rows, ("named rightly", "90 % intervals that hold the true value", tried.coverage())]


FUNCTIONS = (
    evidence_rows, not_compared_rows, parameter_rows, score_rows, effect_rows, what_is_missing,
    sizes_sentence, deciding, calibration_rows, group_lines, neighbours, seen_of, when_sentence,
    words.hypothesis_name, words.headline, words.error_sentence, words.noise_levels,
    words.remainders_sentence, words.tested_trials, words.force_sentence,
)  # fmt: skip
"""What templates of the page and of the command call."""


def said_on_page(content: ReportInput) -> dict[str, Any]:
    """Return by name what templates of the page, and of the command, say of an investigation."""
    found = content.investigation
    verdict, proof, search = found.verdict, found.proof, found.search
    told = {fault.sentence for fault in found.faults}
    return {
        **{function.__name__: function for function in FUNCTIONS}, "texts": WORDS.content,
        "content": content, "found": found, "origin": content.origin, "tried": content.self_calibration,
        "able": content.separability, "verdict": verdict, "proof": proof, "force": verdict.force,
        "location": found.location, "fitted": verdict.kind is not VerdictKind.DATA_ERROR,
        "named": verdict.kind in words.NAMING, "nothing": verdict.kind in NO_GAP,
        "label": words.added_label(found), "members": words.members_of(verdict),
        "scored": None if proof is None else words.scored(proof),
        "without": next((item for item in verdict.hypotheses if not item.effects), None),
        "catalogue": {} if search is None else {item.identifier: item for item in search.effects},
        "remarks": [text for text in verdict.remarks if text not in told],
    }  # fmt: skip


def render_report(content: ReportInput, drawings: dict[str, bytes], figures: dict[str, ReportFigure]) -> str:
    """Return the page.

    Parameters
    ----------
    content : ReportInput
        What is shown.
    drawings : dict of str to bytes
        SVG of each of `figures`.
    figures : dict of str to ReportFigure
        What `report_figures` returned.
    """
    origin = content.origin
    page = Page(
        origin.campaign,
        f"What the model “{origin.model}” lacks beside these data: located, named, added, proved",
        footer=(
            f"Repeat it: {origin.short_command}",
            f"Data {origin.data_hash[:16]}, model {origin.model_hash[:16]}, seed {origin.provenance.seed}.",
        ),
    )
    WORDS.fill(page, drawings, figures=figures, **said_on_page(content))
    return page.render()
