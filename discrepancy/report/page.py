"""The page of an investigation: verdict, location of the gap, reasons, proof, and origin."""

from collections.abc import Mapping
from math import isfinite

from discrepancy.catalogue.entry import Effect
from discrepancy.judgement.closed_share import percent_with_interval
from discrepancy.judgement.curve_words import curve_in_words, curve_of, followed_variable
from discrepancy.judgement.hypotheses import effects_text, named_effects, probability_text
from discrepancy.judgement.remarks import KINDS_WITHOUT_GAP, gap_times_sentence
from discrepancy.location.locate import Location
from discrepancy.report import tables, verdict_tables
from discrepancy.report.decidability_text import group_lines
from discrepancy.report.figures import ReportInput
from discrepancy.report.sensor_table import sensor_table
from discrepancy.report.sizes import size_sentence
from discrepancy.report.text import (
    NAMING,
    WORDS,
    added_label,
    estimate_text,
    formula,
    number,
    parameter_text,
    unit_text,
)
from discrepancy.report.verdict_sentences import (
    ROLE_OF_PROBABILITY,
    error_sentence,
    group_members,
    headline,
    noise_levels,
    parameters_sentence,
    proof_scores,
    remainders_sentence,
    tested_trials,
)
from discrepancy.verdict import Gate, NamedEffect, ParameterEstimate, Verdict, VerdictKind
from discrepancy.workflow import Investigation
from reporting.pages.page import Block, Fold, Highlights, Notice, Page, PageFigure, Section
from reporting.words import capital, counted, listing, with_short_hashes

LONGEST_CARD = 60
"""Most characters of a card of the page; the sentence below it has all names."""
LEAST_SHOWN_SHARE = 0.05
"""Share of the residuals below which a disagreement is left to the file."""
MOST_SHOWN_DISAGREEMENTS = 8
"""Most disagreements of model and data that the page lists."""

OPENING = {
    VerdictKind.NOTHING_MISSING: "is missing",
    VerdictKind.NAMED: "is missing",
    VerdictKind.NAMED_IN_PART: "is missing; the remainder is larger than noise",
    VerdictKind.FAMILY: "is missing",
    VerdictKind.GROUP: "is missing: these data cannot tell which",
    VerdictKind.UNEXPLAINED: "fits what is missing",
    VerdictKind.DATA_ERROR: "are at fault",
    VerdictKind.BELOW_LIMIT: "is missing",
}
"""What the first card of the page says of its text."""

TEXT_WITHOUT_EFFECT = {
    VerdictKind.NOTHING_MISSING: "nothing",
    VerdictKind.DATA_ERROR: "the data",
    VerdictKind.BELOW_LIMIT: "nothing that could be detected",
}
"""The text of the first card for verdicts that name no effect."""


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
    sections = []
    if verdict.kind is not VerdictKind.DATA_ERROR:  # faulty data are not fitted
        looks = [figures.get(name) for name in ("history", "backbone", "spectrum", "load")]
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
        f"What the model “{origin.model}” lacks compared with these data: located, named, added, "
        "proved",
        sentence=verdict_card(verdict),
        picture=figures.get("missing_force"),
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
    """Return the blocks of the outcome: the verdict in numbers and, folded below, in sentences."""
    investigation = content.investigation
    verdict = investigation.verdict
    catalogue: dict[str, Effect] = {}
    if investigation.search is not None:
        catalogue = {effect.identifier: effect for effect in investigation.search.effects}
    sentences: list[Block] = [
        Notice(headline(verdict)),
        f"{sizes_sentence(content)} {error_sentence(investigation)}",
        _meaning(verdict),
        remainders_sentence(verdict),
    ]
    if verdict.kind is VerdictKind.UNEXPLAINED and verdict.resembles:
        names = [catalogue[name].name if name in catalogue else name for name in verdict.resembles]
        sentences.append(
            f"The nearest in the catalogue is {listing(names)}; this is a resemblance and not a "
            "name."
        )
    effects: dict[str, NamedEffect] = {}
    for effect in verdict.effects:
        effects.setdefault(effect.identifier, effect)
    for effect in effects.values():
        if effect.identifier in catalogue:
            sentences.append(_effect_paragraph(effect, catalogue[effect.identifier]))
    return [Highlights(_highlights(investigation)), Fold("How this was concluded", sentences)]


def verdict_card(verdict: Verdict) -> str:
    """Return the verdict in one line: what is missing, where, how large, and how sure that is.

    The size is the missing force at its port or, if there is no such force, the first parameter of
    a named effect with its 90 % interval. If no effect is named, the card says what the force
    depends on. If nothing is missing, it mentions the parameter, gain or zero that the fit moves
    farthest.
    """
    clauses = [f"{capital(missing_effects_text(verdict))} {OPENING[verdict.kind]}"]
    moved_unknowns = (*verdict.moved, *verdict.moved_within_prior)
    if verdict.kind in KINDS_WITHOUT_GAP and moved_unknowns:
        farthest = moved_unknowns[0]
        clauses.append(
            f"but with {farthest.name} moved by {abs(farthest.deviations):.1f} stated deviations, "
            "where an error of the model may hide"
        )
    curve = curve_of(verdict.effects)
    if curve is not None:
        unit = "N" if verdict.force is None else verdict.force.unit
        clauses.append(curve_in_words(curve, unit))
    parameters: list[ParameterEstimate] = []
    if verdict.kind in NAMING and curve is None:
        for effect in verdict.effects:
            parameters += effect.parameters
    if verdict.force is not None:
        force = verdict.force
        clauses.append(f"{number(force.rms)} {force.unit} (rms) at {force.port}")
        if verdict.kind is VerdictKind.UNEXPLAINED:
            clauses.append(force.dependence)
    elif parameters:
        value, interval = estimate_text(parameters[0])
        size = f"{parameter_text(parameters[0])} {value} {unit_text(parameters[0].unit)}".rstrip()
        clauses.append(f"{size} ({interval})")
    if isfinite(verdict.probability) and verdict.kind is not VerdictKind.UNEXPLAINED:
        role = "probability"
        if verdict.kind is VerdictKind.BELOW_LIMIT:
            role = ROLE_OF_PROBABILITY[verdict.kind]
        clauses.append(f"{role} {probability_text(verdict.probability)}")
    return f"{'; '.join(clauses)}."


def _highlights(investigation: Investigation) -> list[tuple[str, str]]:
    """Return the values that support the card of the page, each with its meaning."""
    verdict = investigation.verdict
    proof = investigation.proof
    force = verdict.force
    values = []
    if proof is not None and proof.closed is not None:
        taken_or_added = "taken away" if proof.closed.value >= 0.0 else "added"
        is_named = verdict.kind in (*NAMING, VerdictKind.FAMILY)
        reservation = "" if is_named else ", which is not named"
        meaning = (
            f"of the mean square error in {proof.closed.trials} trials is {taken_or_added} by "
            f"{added_label(investigation)}{reservation}"
        )
        values.append((percent_with_interval(proof.closed), meaning))
    if force is not None and force.ordered_by and not tested_trials(force):
        meaning = f"what the force follows, with {force.followed_percent} % of its variance"
        values.append((listing(force.ordered_by), meaning))
    if proof is not None and force is None:
        before, _, trials = proof_scores(proof)
        if isfinite(before.chi_square_per_sample):
            meaning = f"times the noise, rms on {trials} trials, before and after"
            values.append((" → ".join(noise_levels(proof)), meaning))
    gates = deciding_gates(verdict)
    if gates and proof is None and force is None:
        gate = gates[0]
        meaning = f"p of the {gate.name}; a fit has at least {number(gate.limit)}"
        values.append((number(gate.statistic), meaning))
    return values


def missing_effects_text(verdict: Verdict) -> str:
    """Return a few words on what the model lacks, for a card at the top of the page."""
    members = group_members(verdict)
    if members:
        names = listing(members, "or")
        return names if len(names) <= LONGEST_CARD else f"one of {len(members)} hypotheses"
    if verdict.kind in TEXT_WITHOUT_EFFECT:
        return TEXT_WITHOUT_EFFECT[verdict.kind]
    curve = curve_of(verdict.effects)
    if curve is not None:
        return f"a force that follows the {followed_variable(curve)}"
    phrases = []
    if verdict.kind in NAMING:
        # an effect whose shape was freed is named by its family
        effects = [effect for effect in verdict.effects if not (effect.shape and verdict.family)]
        phrases.append(effects_text(effects))
    if verdict.family:
        phrases.append(f"an effect of the family {verdict.family}")
    return listing(filter(None, phrases)) or "no name"


def sizes_sentence(content: ReportInput) -> str:
    """Return the sentence on the sizes of the named effects, in SI units or by their parameters."""
    investigation = content.investigation
    if content.intervals and investigation.problem is not None and investigation.fit is not None:
        effects = named_effects(investigation.problem, investigation.fit)
        sentence = size_sentence(investigation, effects, content.intervals)
        if sentence:
            return sentence
    verdict = investigation.verdict
    return parameters_sentence(verdict.effects if verdict.kind in NAMING else ())


def deciding_gates(verdict: Verdict) -> list[Gate]:
    """Return the gates that compared a p-value; those that did not pass come first."""
    compared = [
        gate
        for gate in verdict.gates
        if isfinite(gate.statistic) and gate.name not in ("shape", "held-out trials")
    ]
    return sorted(compared, key=lambda gate: not gate.has_failed)


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
            "What would decide most between the hypotheses that are still open, for its cost. "
            "Information is the mutual information of hypothesis and data, by simulation; ln 2 = "
            "0.69 nat decides between two equals.",
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
