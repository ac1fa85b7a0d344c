"""What the commands print of a verdict, and of what a campaign can decide."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from math import isfinite

from discrepancy.campaign.records import Campaign
from discrepancy.catalogue.entry import Effect
from discrepancy.checks.fault import DataFault
from discrepancy.judgement.curve_words import curve_of
from discrepancy.judgement.hypotheses import is_gain_error
from discrepancy.judgement.moved_unknowns import MOVED_DEVIATIONS
from discrepancy.judgement.remarks import (
    KINDS_WITH_NAME,
    KINDS_WITHOUT_GAP,
    gap_times_sentence,
    has_gap_beginning_inside,
)
from discrepancy.judgement.separability import Separability
from discrepancy.report import tables, verdict_tables
from discrepancy.report.decidability_text import campaign_needs, confused_effects, group_lines
from discrepancy.report.figures import ReportInput
from discrepancy.report.levels import levels_table
from discrepancy.report.page import left_over_sentence, remarks_beside_faults, sizes_sentence
from discrepancy.report.sensor_table import printed_sensor_table
from discrepancy.report.verdict_sentences import error_sentence
from discrepancy.report.verdict_tables import bits
from discrepancy.self_calibration import SelfCalibration
from discrepancy.system.interface import Model
from discrepancy.verdict import Verdict
from discrepancy.workflow import Investigation
from reporting.pages.table import Table
from reporting.words import counted, listing

MOST_PRINTED_EXPERIMENTS = 3
"""Most proposed tests that are printed; the report has all."""


def verdict_lines(content: ReportInput) -> Iterator[str | Table]:
    """Yield the printed lines of an investigation, and the tables of effects and sensors.

    Parameters
    ----------
    content : ReportInput
        The investigation, with the intervals of its patch if it has one.
    """
    investigation = content.investigation
    verdict = investigation.verdict
    yield f"{verdict.sentence} {sizes_sentence(content)}".rstrip()
    yield levels_table(investigation)
    yield from filter(None, _sentences_on_errors(investigation))
    for number, experiment in enumerate(verdict.next_experiments[:MOST_PRINTED_EXPERIMENTS], 1):
        test = experiment.description.rstrip(".")
        yield f"Measure next, {number}: {test} ({bits(experiment):.2f} bit)"
    if verdict.reasons:
        yield verdict.reasons
    if not _tells_all_sizes(verdict):
        yield verdict_tables.printed_effects_table(verdict)
    if verdict.kind in (*KINDS_WITH_NAME, *KINDS_WITHOUT_GAP):
        sensors = verdict.sensors
        if verdict.kind in KINDS_WITH_NAME:
            sensors = tuple(item for item in sensors if abs(item.deviations) > MOVED_DEVIATIONS)
        yield printed_sensor_table(sensors, investigation.campaign.channels)
    for fault in investigation.faults:
        yield f"Data: {fault.sentence}"
    for remark in remarks_beside_faults(investigation):
        yield f"Note: {remark}"
    if content.self_calibration is not None:
        yield _self_calibration_sentence(content.self_calibration)


def _tells_all_sizes(verdict: Verdict) -> bool:
    """Return whether the first sentences have all sizes: of a curve, or of the gain of a sensor."""
    is_gain_alone = len(verdict.effects) == 1 and is_gain_error(verdict.effects[0])
    return verdict.kind in KINDS_WITH_NAME and (
        is_gain_alone or curve_of(verdict.effects) is not None
    )


def _sentences_on_errors(investigation: Investigation) -> Iterator[str]:
    """Yield the errors before and after, what is left, and when there is a gap."""
    verdict = investigation.verdict
    proof = investigation.proof
    yield error_sentence(investigation)
    if proof is not None and not isfinite(proof.fitted_before.chi_square_per_sample):
        yield proof.remaining  # it is not known what remains without a noise record
    yield left_over_sentence(verdict)
    times = gap_times_sentence(verdict.windows)
    if times not in verdict.reasons and has_gap_beginning_inside(verdict.windows):
        yield times


def _self_calibration_sentence(self_calibration: SelfCalibration) -> str:
    """Return how often the workflow named effects rightly in simulated campaigns."""
    right = self_calibration.share("right")
    wrong = self_calibration.share("wrong")
    false_names = self_calibration.share("wrong", null=True)
    return (
        f"Simulated campaigns: {right.count} of {right.total} hidden effects named, {wrong.count} "
        f"wrongly; {counted(false_names.count, 'false name')} where nothing was hidden "
        f"({false_names.total})."
    )


def check_lines(
    campaign: Campaign,
    model: Model,
    catalogue: Sequence[Effect],
    faults: Sequence[DataFault],
    separability: Separability | None,
) -> Iterator[str | Table]:
    """Yield the printed lines on a campaign: its faults, and the effects that it can decide on.

    Parameters
    ----------
    campaign : Campaign
        The campaign.
    model : Model
        The model beside which it is read.
    catalogue : sequence of Effect
        The catalogue.
    faults : sequence of DataFault
        Faults of the data.
    separability : Separability or None
        What the campaign can distinguish; None if a fault is fatal.
    """
    held_out = ", ".join(trial.name for trial in campaign.held_out) or "none"
    trials = counted(len(campaign.trials), "trial")
    channels = counted(len(campaign.channels), "channel")
    compared_with = "a model of the same name" if model.name == campaign.name else model.name
    yield f"Campaign {campaign.name}, compared with {compared_with}."
    yield f"{trials}, {channels}; held out: {held_out}."
    for fault in faults:
        yield f"{'Fault' if fault.fatal else 'Limit'}: {fault.sentence}"
    for remark in campaign.remarks:
        yield f"Note: {remark}"
    if separability is None:
        return
    table = tables.printed_sizes_table(separability)
    if table.rows:
        yield table
        yield from _meanings_of_parameters(separability)
    yield from _lines_on_untestable_effects(separability)
    for detectability in separability.detectability:
        identifier = detectability.effect.identifier
        others = confused_effects(separability, identifier)
        if others:
            yield f"Confused: {identifier} with {listing(others)}."
    yield from group_lines(separability, "to which is said above")
    yield from campaign_needs(separability, campaign, catalogue, model.kinds)


def _meanings_of_parameters(separability: Separability) -> Iterator[str]:
    """Yield what each parameter of the table means, with the effects that have it."""
    effects_by_meaning: dict[tuple[str, str], list[str]] = {}
    for row in separability.detectability:
        for parameter in row.effect.parameters:
            if not row.reason and parameter.name == row.parameter:
                meaning = parameter.name.replace("_", " "), parameter.description
                effects_by_meaning.setdefault(meaning, []).append(row.effect.identifier)
    yield "The parameters are sizes without a unit where none is given:"
    for (name, description), identifiers in effects_by_meaning.items():
        yield f"  {name} ({', '.join(identifiers)}): {description}"
    if any("(seen at" in row.place for row in separability.detectability):
        yield (
            "A mains line above half the sampling rate is seen at its alias, and only if the "
            "logger has no filter against it."
        )


def _lines_on_untestable_effects(separability: Separability) -> Iterator[str]:
    """Yield each reason why effects cannot be tested, with these effects."""
    untestable = [row for row in separability.detectability if row.reason]
    by_reason = sorted(untestable, key=lambda row: row.reason.lower())
    for _, rows in groupby(by_reason, key=lambda row: row.reason.lower()):
        members = list(rows)
        names = listing(row.effect.identifier for row in members)
        yield f"Not testable: {names}. {members[0].reason}"
