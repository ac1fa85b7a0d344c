"""The page of an investigation: verdict, location of the gap, reasons, proof, and origin."""

from collections.abc import Mapping
from math import isfinite

from discrepancy.application import has_applicable_effects
from discrepancy.catalogue.entry import Effect
from discrepancy.judgement.closed_share import (
    channels_by_error,
    error_change_text,
    percent_with_interval,
)
from discrepancy.judgement.curve_words import curve_of
from discrepancy.judgement.hypotheses import is_gain_error, named_effects
from discrepancy.judgement.remarks import (
    KINDS_OF_NOISE_ALONE,
    KINDS_WITH_NAME,
    KINDS_WITHOUT_GAP,
    gap_times_sentence,
)
from discrepancy.location.locate import Location
from discrepancy.report import tables, verdict_tables
from discrepancy.report.decidability_text import group_lines
from discrepancy.report.figures import ReportInput
from discrepancy.report.levels import levels_table
from discrepancy.report.sensor_table import sensor_table
from discrepancy.report.sizes import size_sentence
from discrepancy.report.text import (
    NAMING,
    WORDS,
    added_label,
    formula,
)
from discrepancy.report.verdict_sentences import (
    error_sentence,
    left_sentence,
    noise_levels,
    parameters_sentence,
    proof_scores,
    remainders_sentence,
)
from discrepancy.verdict import NamedEffect, Verdict, VerdictKind
from discrepancy.workflow import Investigation
from reporting.pages.page import Block, Fold, Highlights, Notice, Page, PageFigure, Section
from reporting.words import capital, counted, with_short_hashes

LOOKS = ("history", "load", "backbone", "spectrum")
"""Figures of readings and residuals; the first one opens the page if no force is missing."""
LEAST_SHOWN_SHARE = 0.05
"""Share of the residuals below which a disagreement is left to the file."""
MOST_SHOWN_DISAGREEMENTS = 8
"""Most disagreements of model and data that the page lists."""


def verdict_page(content: ReportInput, figures: Mapping[str, PageFigure]) -> Page:
    """Return the page of an investigation.

    Parameters
    ----------
    content : ReportInput
        The investigation and its origin.
    figures : mapping of str to PageFigure
        The figures by name; those that these data do not allow are missing.
    """
    origin = content.origin
    investigation = content.investigation
    verdict = investigation.verdict
    picture = next((name for name in ("missing_force", *LOOKS) if name in figures), "")
    sections = []
    if verdict.kind is not VerdictKind.DATA_ERROR:  # faulty data are not fitted
        looks = [figures.get(name) for name in LOOKS if name != picture]
        sections = [
            _next_experiment_section(verdict),
            _location_section(investigation, figures),
            Section("What it looks like", looks),
            _reasons_section(investigation),
            _proof_section(investigation, figures),
            _decidability_section(content, figures),
        ]
    provenance = Fold("Campaign, model, command and versions", [tables.origin_table(origin)])
    return Page(
        origin.campaign,
        f"What the model “{origin.model}” lacks",
        sentence=f"{verdict.sentence} {sizes_sentence(content)}".rstrip(),
        picture=figures.get(picture),
        outcome=_outcome(content),
        sections=[
            Section("Effects", [verdict_tables.effects_table(content)]),
            *sections,
            _data_section(investigation),
            Section("Where it comes from", [provenance]),
        ],
        footer=(
            f"Repeat it: {origin.short_command}",
            f"Data {origin.data_hash[:16]}, model {origin.model_hash[:16]}, seed "
            f"{origin.provenance.seed}.",
        ),
    )


def _outcome(content: ReportInput) -> list[Block]:
    """Return the blocks of the outcome: errors, the four questions, what is left, and why."""
    investigation = content.investigation
    verdict = investigation.verdict
    catalogue: dict[str, Effect] = {}
    if investigation.search is not None:
        catalogue = {effect.identifier: effect for effect in investigation.search.effects}
    explanations: list[Block] = [_meaning(verdict)]
    errors = _errors_before_and_after(investigation)
    effects: dict[str, NamedEffect] = {}
    for effect in verdict.effects:
        effects.setdefault(effect.identifier, effect)
    for effect in effects.values():
        if effect.identifier in catalogue:
            explanations.append(_effect_paragraph(effect, catalogue[effect.identifier]))
    # an error of the model may hide in what a fit without an effect moves
    hidden = verdict.reasons if verdict.kind in KINDS_WITHOUT_GAP else ""
    return [
        Notice(hidden),
        Highlights(errors),
        "" if errors else error_sentence(investigation),
        levels_table(investigation, next_step=_next_step(investigation)),
        left_over_sentence(verdict),
        "" if verdict.kind in KINDS_WITHOUT_GAP else verdict.reasons,
        Fold("What this verdict means", explanations),
    ]


def _errors_before_and_after(investigation: Investigation) -> list[tuple[str, str]]:
    """Return the errors of the model before and after what was added, each with its meaning."""
    proof = investigation.proof
    if proof is None or proof.closed is None:
        return []  # the trials do not test what was added
    before, after, role = proof_scores(proof)
    values = []
    for name in channels_by_error(investigation.campaign.channels, before.rms)[:1]:
        error = error_change_text(investigation.campaign.channels, name, before.rms, after.rms)
        values.append((error, f"rms error of {name} in {role} trials, before and after"))
    if isfinite(before.chi_square_per_sample):
        meaning = f"times the noise: rms error in {role} trials, before and after"
        values.append((" → ".join(noise_levels(proof)), meaning))
    explained = "taken away" if proof.closed.value >= 0.0 else "added"
    meaning = f"of the mean square error in {role} trials is {explained}"
    if investigation.verdict.kind not in KINDS_WITH_NAME:
        is_group = investigation.verdict.kind is VerdictKind.GROUP
        clause = "the most probable of them" if is_group else "which is not named"
        meaning += f" by {added_label(investigation)}, {clause}"
    values.append((percent_with_interval(proof.closed), meaning))
    return values


def left_over_sentence(verdict: Verdict) -> str:
    """Return what the effects of a verdict leave: of the force, or of the readings.

    It is empty if they leave only noise.
    """
    if verdict.kind in KINDS_OF_NOISE_ALONE:
        return ""
    return left_sentence(verdict.force) or remainders_sentence(verdict)


def _next_step(investigation: Investigation) -> str:
    """Return what to do next: the test that would decide most, or to apply what is named."""
    verdict = investigation.verdict
    if verdict.next_experiments:
        return f"measure: {verdict.next_experiments[0].description.rstrip('.')}"
    if verdict.kind is VerdictKind.UNEXPLAINED:
        return "compare the shape in the picture with what you know of the rig"
    if has_applicable_effects(verdict, investigation.proof):
        return "add it to the model: uav-twin discrepancy apply"
    return ""


def sizes_sentence(content: ReportInput) -> str:
    """Return the sentence on the sizes of named effects, in SI units or by their parameters.

    It is empty without a name, as the sizes of a group are in its table.
    """
    investigation = content.investigation
    has_name = investigation.verdict.kind in KINDS_WITH_NAME
    if (
        has_name
        and content.intervals
        and investigation.problem is not None
        and investigation.fit is not None
    ):
        effects = named_effects(investigation.problem, investigation.fit)
        sentence = size_sentence(investigation, effects, content.intervals)
        if sentence:
            return sentence
    verdict = investigation.verdict
    if verdict.kind not in NAMING or curve_of(verdict.effects) is not None:
        return ""  # the sentence of the verdict describes a curve, and has the gain of a sensor
    return parameters_sentence(effect for effect in verdict.effects if not is_gain_error(effect))


def _meaning(verdict: Verdict) -> str:
    """Return the meaning of the kind of a verdict, which depends on the gate of absolute fit."""
    could_not_judge = any(
        gate.name == "absolute fit" and gate.passed is None for gate in verdict.gates
    )
    unjudged: dict[str, str] = WORDS.content["unjudged"]
    if could_not_judge and verdict.kind in unjudged:
        return unjudged[verdict.kind]
    return str(WORDS.content["meaning"][verdict.kind])


def _effect_paragraph(effect: NamedEffect, entry: Effect) -> str:
    """Return the equation, the signature and the source of an effect of the catalogue."""
    return (
        f"{capital(effect.name)}: {formula(entry.equation)}. "
        f"Its signature: {formula(entry.signature).rstrip('.')}. "
        f"Source: {entry.reference.rstrip('.')}."
    )


def _next_experiment_section(verdict: Verdict) -> Section:
    """Return the section on the tests that would decide most; it is empty without any."""
    if not verdict.next_experiments:
        return Section("Next experiment", [])
    return Section(
        "Next experiment",
        [
            "What would decide most between the explanations that are still open, for its cost. "
            "Information is the mutual information of explanation and data, by simulation: 1 bit "
            "decides between two that are equally probable.",
            gap_times_sentence(verdict.windows),
            verdict_tables.next_experiments_table(verdict),
        ],
    )


def _location_section(investigation: Investigation, figures: Mapping[str, PageFigure]) -> Section:
    """Return the section on where, when and in which channel model and data disagree."""
    location = investigation.location
    has_no_gap = investigation.verdict.kind in KINDS_WITHOUT_GAP
    blocks: list[Block] = [_location_sentence(location, has_no_gap=has_no_gap)]
    blocks += [figures.get(name) for name in ("residual_map", "residual_table", "time_line")]
    if location is not None:
        shown = [found for found in location.disagreements if found.share >= LEAST_SHOWN_SHARE]
        for disagreement in shown[:MOST_SHOWN_DISAGREEMENTS]:
            blocks.append(f"• {disagreement.sentence}")
        blocks.append(tables.global_tests_table(location))
    return Section("What the model leaves" if has_no_gap else "Where the gap is", blocks)


def _location_sentence(location: Location | None, *, has_no_gap: bool) -> str:
    """Say whether the residuals of the unchanged model exceed the noise, and in how many cells."""
    if location is None:
        return "The residuals were not searched for patterns."
    if location.disagrees:
        significant = sum(cell.significant for cell in location.cells)
        discoveries = "is a discovery" if significant == 1 else "are discoveries"
        return (
            f"The unchanged model disagrees with the fitted trials; {significant} of "
            f"{counted(len(location.cells), 'cell')} of the map (channel, trial, and bin of time, "
            f"amplitude, frequency or load) {discoveries} at a false discovery rate of 5 %."
        )
    if has_no_gap:
        return (
            "No global test finds a disagreement between the unchanged model and the fitted trials."
        )
    return (
        "The residuals of the unchanged model are not significant by themselves, or cannot be "
        "judged by their size: the gap appears only when effects are fitted, or in the missing "
        "force."
    )


def _reasons_section(investigation: Investigation) -> Section:
    """Return the section on gates, compared hypotheses, parameters, and fitted gains and zeros."""
    verdict = investigation.verdict
    return Section(
        "Why this verdict",
        [
            verdict_tables.gates_table(verdict),
            verdict_tables.evidence_table(verdict),
            verdict_tables.not_compared_table(verdict),
            tables.parameters_table(investigation),
            sensor_table(verdict.sensors, investigation.campaign.channels),
        ],
    )


def _proof_section(investigation: Investigation, figures: Mapping[str, PageFigure]) -> Section:
    """Return the section on the scores of held-out trials, without and with the effects."""
    title = "Proof on held-out trials"
    proof = investigation.proof
    if proof is None:
        return Section(title, [])
    reservation = None
    if investigation.verdict.kind not in NAMING:
        reservation = Notice(
            f'The model "with the effect" has {added_label(investigation)} here, which is not '
            "named: the figures say how well it does, not that it is there."
        )
    table = tables.proof_table(investigation, proof)
    return Section(title, [reservation, proof.remaining, figures.get("pit"), table])


def _decidability_section(content: ReportInput, figures: Mapping[str, PageFigure]) -> Section:
    """Return the section on which effects the campaign can detect and tell apart."""
    blocks: list[Block] = []
    if content.separability is not None:
        blocks += group_lines(content.separability)
        blocks.append(figures.get("separability"))
        blocks.append(tables.detectable_sizes_table(content.separability))
    if content.self_calibration is not None:
        blocks.append(figures.get("self_calibration"))
        blocks.append(tables.self_calibration_table(content.self_calibration))
    return Section("What this campaign can decide", blocks)


def remarks_beside_faults(investigation: Investigation) -> list[str]:
    """Return the remarks of the verdict that do not repeat a fault of the data."""
    fault_sentences = {fault.sentence for fault in investigation.faults}
    return [remark for remark in investigation.verdict.remarks if remark not in fault_sentences]


def _data_section(investigation: Investigation) -> Section:
    """Return the section on the faults of the data, the remarks, and the trials."""
    remarks = remarks_beside_faults(investigation)
    blocks: list[Block] = [Notice(fault.sentence) for fault in investigation.faults]
    blocks += [f"• {with_short_hashes(remark)}" for remark in remarks]
    if not blocks:
        blocks.append("No fault was found.")
    return Section("Data", [*blocks, tables.trials_table(investigation.campaign)])
