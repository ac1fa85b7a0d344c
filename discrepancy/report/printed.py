"""What the commands print of a verdict, and of what a campaign can decide."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from math import isfinite

from discrepancy.campaign.records import Campaign
from discrepancy.catalogue.entry import Effect
from discrepancy.checks.fault import DataFault
from discrepancy.judgement.hypotheses import probability_text
from discrepancy.judgement.remarks import gap_times_sentence
from discrepancy.judgement.separability import Separability
from discrepancy.report import tables, verdict_tables
from discrepancy.report.decidability_text import campaign_needs, confused_effects, group_lines
from discrepancy.report.figures import ReportInput
from discrepancy.report.page import remarks_beside_faults, sizes_sentence
from discrepancy.report.sensor_table import printed_sensor_table
from discrepancy.report.text import number
from discrepancy.report.verdict_sentences import (
    error_sentence,
    force_sentence,
    headline,
    proof_scores,
    remainders_sentence,
)
from discrepancy.self_calibration import SelfCalibration
from discrepancy.system.interface import Model
from discrepancy.verdict import Verdict, VerdictKind
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
    yield from _sentences_on_gap(content)
    yield verdict_tables.printed_effects_table(verdict)
    yield printed_sensor_table(verdict.sensors, investigation.campaign.channels)
    yield from filter(None, _sentences_on_proof(investigation))
    for experiment in verdict.next_experiments[:MOST_PRINTED_EXPERIMENTS]:
        yield f"Next: {experiment.description} ({experiment.information:.2f} nat)"
    for fault in investigation.faults:
        yield f"Data: {fault.sentence}"
    for remark in remarks_beside_faults(investigation):
        yield f"Note: {remark}"
    if content.self_calibration is not None:
        yield _self_calibration_sentence(content.self_calibration)


def _sentences_on_gap(content: ReportInput) -> Iterator[str]:
    """Yield the sentences on what is missing, when it acts, and how probable it is."""
    verdict = content.investigation.verdict
    times = gap_times_sentence(verdict.windows)
    sentences = [
        headline(verdict),
        sizes_sentence(content) if content.intervals else "",
        "" if verdict.force is None else force_sentence(verdict.force),
        remainders_sentence(verdict),
        "" if times in verdict.sentence else times,
        _probability_sentence(verdict),
    ]
    yield from filter(None, sentences)


def _probability_sentence(verdict: Verdict) -> str:
    """Return the probability of a verdict and its Bayes factor; empty if it has none."""
    if not isfinite(verdict.probability) or verdict.kind is VerdictKind.UNEXPLAINED:
        return ""
    subject = "Probability"
    if verdict.kind is VerdictKind.BELOW_LIMIT:
        subject = "Probability that nothing is missing"
    sentence = f"{subject} {probability_text(verdict.probability)}"
    if verdict.kind is not VerdictKind.NOTHING_MISSING:
        sentence += f", ln Bayes factor against nothing missing {verdict.log_bayes_factor:.1f}"
    return f"{sentence}."


def _sentences_on_proof(investigation: Investigation) -> Iterator[str]:
    """Yield the sentences on the proof: the comparison of residuals without and with the effects.

    The first sentence states the fraction of the model's error that the effects explain. The second
    one states chi-square per sample without and with them, on the held-out trials if there are any,
    else on the fitted trials. Nothing is yielded without a proof.
    """
    proof = investigation.proof
    if proof is None:
        return
    yield error_sentence(investigation)
    before, after, trial_role = proof_scores(proof)
    if not isfinite(before.chi_square_per_sample):
        # chi-square is not known without a noise record, and this sentence says so
        yield proof.remaining
        return
    trial_remark = "none is held out"
    if trial_role == "held-out":
        trial_remark = ", ".join(trial.name for trial in investigation.campaign.held_out)
    yield (
        f"χ² per sample on {trial_role} trials ({trial_remark}): "
        f"{number(before.chi_square_per_sample)} before, "
        f"{number(after.chi_square_per_sample)} with the effect, 1 for noise alone."
    )


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
