"""The page of an investigation: verdict, location of the gap, reasons, proof, and origin.

Its text and order stand in `words.toml`; here are the functions that the text uses by name.
"""

from functools import partial
from math import isfinite, nan
from typing import Any

from discrepancy.campaign.units import UNITS
from discrepancy.judgement.closed_share import NOMINAL_UNIT
from discrepancy.judgement.conclusion import (
    calibrated_parameters,
    effects_text,
    named_effects,
    probability_text,
)
from discrepancy.judgement.remarks import KINDS_WITHOUT_GAP, gap_times_sentence
from discrepancy.report import text as words
from discrepancy.report.decidability_text import (
    confused_effects,
    detectability_texts,
    group_lines,
)
from discrepancy.report.figures import ReportInput
from discrepancy.report.text import WORDS
from discrepancy.self_calibration import Proportion, SelfCalibration, ordered_outcomes
from discrepancy.verdict import Gate, Hypothesis, Verdict, VerdictKind
from discrepancy.workflow import Investigation
from reporting.page import Page, ReportFigure
from reporting.templates import fill_template
from reporting.words import capital, listing, plus_minus

MOST_SHOWN_HYPOTHESES = 8
"""Most hypotheses in the table of evidence."""
NINETY = 1.6449
"""Normal quantile at 95 %: half of a 90 % interval in standard deviations."""


def evidence_rows(verdict: Verdict) -> list[tuple[Hypothesis, str]]:
    """Return the rows of the table of evidence: hypotheses with their roles.

    Those of the verdict come first, then the most probable others, at most `MOST_SHOWN_HYPOTHESES`
    in all. The hypothesis without effects is always included.
    """
    if verdict.group:
        members = [*verdict.group]
        role = "member of the group"
    else:
        members = [" + ".join(sorted(effect.identifier for effect in verdict.effects))]
        role = verdict.kind.value
    remaining_members = {member for member in members if member}
    chosen: list[tuple[Hypothesis, str]] = []
    remaining_hypotheses: list[tuple[Hypothesis, str]] = []
    for hypothesis in verdict.hypotheses:  # the most probable first
        identifiers = " + ".join(hypothesis.identifiers)
        if identifiers in remaining_members:
            remaining_members.remove(identifiers)
            chosen.append((hypothesis, role))
        else:
            remaining_hypotheses.append((hypothesis, ""))
    ranked = chosen + remaining_hypotheses
    without_effects = [row for row in ranked[MOST_SHOWN_HYPOTHESES:] if not row[0].effects]
    return ranked[:MOST_SHOWN_HYPOTHESES] + without_effects


def not_compared_rows(verdict: Verdict) -> list[tuple[str, str]]:
    """Return the rows of effects that were not fitted: each reason with the effects it concerns."""
    names_by_reason: dict[str, list[str]] = {}
    for omitted in verdict.not_fitted:
        gain = f" ({words.number(omitted.gain, 2)} nat)" if isfinite(omitted.gain) else ""
        reason = omitted.reason
        if reason.startswith("screened out"):
            reason = "screened out"
        name = omitted.identifier.replace("_", " ")
        names_by_reason.setdefault(reason, []).append(f"{name}{gain}")
    rows = []
    for reason, names in names_by_reason.items():
        rows.append((f"{reason[:1].upper()}{reason[1:]}", listing(names)))
    return rows


def parameter_rows(investigation: Investigation) -> list[tuple[str, ...]]:
    """Return the rows of the model's parameters: name, unit, and values with 90 % half-widths.

    Values are those of the calibration, of the fit of the model as it was, and of the fit with the
    effect. Without an effect the last is left out; without parameters there are no rows.
    """
    problem, search, fit = investigation.problem, investigation.search, investigation.fit
    if problem is None or search is None or fit is None:
        return []
    fits = [search.no_effect]
    if fit.candidate.terms:
        fits.append(fit)
    estimates_of_fits = [calibrated_parameters(problem, fitted) for fitted in fits]
    layout = problem.shared
    means = layout.centre.tolist()[: layout.parameter_count]
    deviations = layout.scale.tolist()[: layout.parameter_count]
    rows = []
    for index, (mean, deviation) in enumerate(zip(means, deviations, strict=True)):
        cells = [_with_half_width(mean, deviation)]
        for estimates in estimates_of_fits:
            cells.append(_with_half_width(estimates[index].mean, estimates[index].deviation))
        parameter = estimates_of_fits[0][index]
        name = parameter.name.replace("_", " ")
        rows.append((name, words.unit_text(parameter.unit), *cells))
    return rows


def _with_half_width(value: float, deviation: float) -> str:
    """Return a value with the half-width of its 90 % interval, or "exact" if its deviation is 0."""
    return plus_minus(value, NINETY * deviation) if deviation > 0.0 else f"{value:.6g}, exact"


def score_rows(investigation: Investigation) -> tuple[list[str], list[list[str]]]:
    """Return the table of scores without and with the effects.

    Returns
    -------
    titles : list of str
        Titles of the columns, such as "held out, before".
    rows : list of list of str
        Name of a score, or rms of a channel, and its values in these columns.
    """
    proof = investigation.proof
    assert proof is not None
    all_scores = {
        "held out, before": proof.held_out_before,
        "held out, after": proof.held_out_after,
        "fitted, before": proof.fitted_before,
        "fitted, after": proof.fitted_after,
    }
    scores = {title: score for title, score in all_scores.items() if score is not None}
    fill_cell = partial(fill_template, number=words.number, p_value_text=words.p_value_text)
    rows = []
    for title, template in WORDS.content["scores"].items():
        rows.append([title, *(fill_cell(template, score=score) for score in scores.values())])
    # rms of the residuals of each channel, in the unit in which it is drawn
    names = dict.fromkeys(name for score in scores.values() for name in score.rms)
    for name in names:
        factor, unit = UNITS[investigation.campaign.channels[name].quantity].drawn
        cells = [words.number(factor * score.rms.get(name, nan)) for score in scores.values()]
        shown_unit = "in its own unit" if unit == NOMINAL_UNIT else unit
        rows.append([f"rms residual of {name.replace('_', ' ')} ({shown_unit})", *cells])
    return list(scores), rows


def effect_rows(verdict: Verdict) -> list[dict[str, Any]]:
    """Return the rows of the table of effects: one row for each parameter of each effect.

    If the verdict is a group of hypotheses that look alike, its members follow one another, and the
    first row of each has its number as `member`. `item` is the parameter; None if an effect has
    none.
    """
    rows = []
    members = [*words.group_members(verdict).values()] or [verdict.effects]
    for number, effects in enumerate(members, start=1):
        label: int | str = number
        for effect in effects:
            for parameter in (*effect.parameters, *effect.shape) or (None,):
                rows.append({"member": label, "effect": effect, "item": parameter})
                label = ""
    return rows


LONGEST_CARD = 60
"""Most characters of a card of the page; the sentence below it has all names."""


def missing_effects_text(verdict: Verdict) -> str:
    """Return what the model lacks in a few words, for a card at the top of the page."""
    members = words.group_members(verdict)
    if members:
        names = listing(members, "or")
        return names if len(names) <= LONGEST_CARD else f"one of {len(members)} hypotheses"
    if verdict.kind in WORDS.content["without"]:
        return str(WORDS.content["without"][verdict.kind])
    phrases = []
    if verdict.kind in words.NAMING:
        # an effect whose shape was freed is named by its family
        effects = [effect for effect in verdict.effects if not (effect.shape and verdict.family)]
        phrases.append(effects_text(effects))
    if verdict.family:
        phrases.append(f"an effect of the family {verdict.family}")
    return listing(filter(None, phrases)) or "no name"


def verdict_card(verdict: Verdict) -> str:
    """Return the verdict in one line: what is missing, where, how large, and how sure that is.

    The size is the missing force at its port or, if there is no such force, the first parameter of
    a named effect with its 90 % interval.
    """
    opening = str(WORDS.content["opening"][verdict.kind])
    clauses = [f"{capital(missing_effects_text(verdict))} {opening}"]
    parameters = []
    if verdict.kind in words.NAMING:
        parameters = [item for effect in verdict.effects for item in effect.parameters]
    if verdict.force is not None:
        force = verdict.force
        clauses.append(f"{words.number(force.rms)} {force.unit} (rms) at {force.port}")
    elif parameters:
        value, interval = words.estimate_text(parameters[0])
        size = f"{words.parameter_text(parameters[0])} {value}"
        clauses.append(f"{size} {words.unit_text(parameters[0].unit)}".rstrip() + f" ({interval})")
    if isfinite(verdict.probability) and verdict.kind is not VerdictKind.UNEXPLAINED:
        clauses.append(f"probability {probability_text(verdict.probability)}")
    return f"{'; '.join(clauses)}."


def sizes_sentence(content: ReportInput) -> str:
    """Return the sentence on the sizes of the named effects, in SI units or by their parameters."""
    investigation = content.investigation
    if content.intervals and investigation.problem is not None and investigation.fit is not None:
        effects = named_effects(investigation.problem, investigation.fit)
        sentence = words.size_sentence(investigation, effects, content.intervals)
        if sentence:
            return sentence
    verdict = investigation.verdict
    return WORDS.say("sizes", effects=verdict.effects if verdict.kind in words.NAMING else ())


def deciding_gates(verdict: Verdict) -> list[Gate]:
    """Return the gates that compared a p-value; those that did not pass come first."""
    compared = [
        gate
        for gate in verdict.gates
        if isfinite(gate.statistic) and gate.name not in ("shape", "held-out trials")
    ]
    return sorted(compared, key=lambda gate: not gate.has_failed)


def calibration_rows(self_calibration: SelfCalibration) -> list[tuple[str, str, Proportion]]:
    """Return the rows of the self-calibration: hidden or not, the outcome, and its fraction."""
    rows = []
    for title, null in (("an effect was hidden", False), ("nothing was hidden", True)):
        for outcome in ordered_outcomes(self_calibration, null=null):
            rows.append((title, outcome, self_calibration.share(outcome, null=null)))
    rows.append(
        ("named rightly", "90 % intervals that hold the true value", self_calibration.coverage())
    )
    return rows


FUNCTIONS = (
    evidence_rows,
    not_compared_rows,
    parameter_rows,
    score_rows,
    effect_rows,
    missing_effects_text,
    verdict_card,
    sizes_sentence,
    deciding_gates,
    calibration_rows,
    group_lines,
    confused_effects,
    detectability_texts,
    gap_times_sentence,
    words.hypothesis_name,
    words.headline,
    words.error_sentence,
    words.noise_levels,
    words.remainders_sentence,
    words.tested_trials,
    words.force_sentence,
)
"""Functions that the templates of the page and of the command call by name."""


def template_values(content: ReportInput) -> dict[str, Any]:
    """Return the names that the templates of the page and of the command use, with their values."""
    investigation = content.investigation
    verdict = investigation.verdict
    proof = investigation.proof
    effects = () if investigation.search is None else investigation.search.effects
    fault_sentences = {fault.sentence for fault in investigation.faults}
    without_effects = None
    for hypothesis in verdict.hypotheses:
        if not hypothesis.effects:
            without_effects = hypothesis
            break
    return {
        **{function.__name__: function for function in FUNCTIONS},
        "texts": WORDS.content,
        "content": content,
        "found": investigation,
        "origin": content.origin,
        "tried": content.self_calibration,
        "able": content.separability,
        "verdict": verdict,
        "proof": proof,
        "force": verdict.force,
        "location": investigation.location,
        "fitted": verdict.kind is not VerdictKind.DATA_ERROR,
        "named": verdict.kind in words.NAMING,
        "nothing": verdict.kind in KINDS_WITHOUT_GAP,
        "label": words.added_label(investigation),
        "members": words.group_members(verdict),
        "scored": None if proof is None else words.proof_scores(proof),
        "without": without_effects,
        "catalogue": {effect.identifier: effect for effect in effects},
        "remarks": [remark for remark in verdict.remarks if remark not in fault_sentences],
    }


def render_report(
    content: ReportInput, drawings: dict[str, bytes], figures: dict[str, ReportFigure]
) -> str:
    """Return the report as an HTML page.

    Parameters
    ----------
    content : ReportInput
        Content of the report.
    drawings : dict of str to bytes
        SVG of each figure, by name.
    figures : dict of str to ReportFigure
        The figures with their captions, as `report_figures` returned them.
    """
    origin = content.origin
    page = Page(
        origin.campaign,
        f"What the model “{origin.model}” lacks beside these data: located, named, added, proved",
        footer=(
            f"Repeat it: {origin.short_command}",
            f"Data {origin.data_hash[:16]}, model {origin.model_hash[:16]}, seed "
            f"{origin.provenance.seed}.",
        ),
    )
    WORDS.fill(page, drawings, figures=figures, **template_values(content))
    return page.render()
