"""The tables of the report on a verdict: effects, experiments, gates and hypotheses."""

from collections.abc import Mapping
from math import isfinite, isnan, log
from typing import NamedTuple

from discrepancy.judgement.hypotheses import probability_text
from discrepancy.report.figures import ReportInput
from discrepancy.report.text import (
    NAMING,
    UNKNOWN,
    added_label,
    estimate_text,
    hypothesis_name,
    number,
    p_value_text,
    parameter_text,
    unit_text,
)
from discrepancy.report.verdict_sentences import group_members
from discrepancy.verdict import (
    Experiment,
    Gate,
    Hypothesis,
    NamedEffect,
    ParameterEstimate,
    Verdict,
    VerdictKind,
)
from reporting.pages.table import (
    PageColumn,
    RecordColumn,
    Table,
    number_cells,
    table_of_records,
    text_cells,
)
from reporting.words import listing
from reporting.words import number as cell_text

MOST_SHOWN_HYPOTHESES = 8
"""Most hypotheses in the table of evidence."""
MOST_SHOWN_INCLUSIONS = 6
"""Most effects whose probability to take part is told."""
LEAST_SHOWN_INCLUSION = 0.001
"""Probability to take part below which an effect is not told."""


class EffectRow(NamedTuple):
    """A row of the table of effects: one parameter of one effect.

    Attributes
    ----------
    member : str
        The number of the member of a group, in its first row; else empty.
    effect : NamedEffect
        The effect.
    parameter : ParameterEstimate or None
        The parameter; None if the effect has none.
    """

    member: str
    effect: NamedEffect
    parameter: ParameterEstimate | None

    @property
    def description(self) -> str:
        """The description of the parameter; empty without one."""
        return "" if self.parameter is None else parameter_text(self.parameter)

    @property
    def value(self) -> str:
        """The value of the parameter; empty without one."""
        return "" if self.parameter is None else estimate_text(self.parameter)[0]

    @property
    def interval(self) -> str:
        """The 90 % interval of the parameter; empty without one."""
        return "" if self.parameter is None else estimate_text(self.parameter)[1]

    @property
    def unit(self) -> str:
        """The unit of the parameter; empty without one."""
        return "" if self.parameter is None else unit_text(self.parameter.unit)


def effect_rows(verdict: Verdict) -> list[EffectRow]:
    """Return the rows of the table of effects: one row for each parameter of each effect.

    If the verdict is a group of hypotheses that look alike, its members follow one another.
    """
    rows = []
    members = [*group_members(verdict).values()] or [verdict.effects]
    for member_number, effects in enumerate(members, start=1):
        label = str(member_number)
        for effect in effects:
            for parameter in (*effect.parameters, *effect.shape) or (None,):
                rows.append(EffectRow(label, effect, parameter))
                label = ""
    return rows


CAPTION_OF_SIZES = {
    VerdictKind.NAMED: "Most probable values and 90 % intervals.",
    VerdictKind.NAMED_IN_PART: (
        "Most probable values and 90 % intervals, widened for the remainder."
    ),
    VerdictKind.FAMILY: "Most probable values and 90 % intervals; the shape was fitted.",
}
"""Whose values the table of parameters holds, by the kind of the verdict."""


def effects_table(content: ReportInput) -> Table:
    """Return the table of the effects that are added to the model, or could be added."""
    verdict = content.investigation.verdict
    is_named = verdict.kind in NAMING
    is_group = bool(group_members(verdict))
    columns: list[RecordColumn[EffectRow]] = [
        text_cells("effect", lambda row: row.effect.name),
        text_cells("place", lambda row: row.effect.place_in_words or UNKNOWN),
        text_cells("parameter", lambda row: row.description),
        number_cells("value", lambda row: row.value),
        number_cells("90 % interval", lambda row: row.interval),
        text_cells("unit", lambda row: row.unit),
    ]
    sentences = []
    if is_group:
        columns.insert(0, text_cells("member", lambda row: row.member))
        sentences.append("One of them is missing; these data cannot tell which.")
    sentences.append(
        CAPTION_OF_SIZES.get(
            verdict.kind,
            "Most probable values and 90 % intervals of each member, if it acts alone.",
        )
    )
    if content.intervals:
        whose = "" if is_named else f" of {added_label(content.investigation)}"
        sentences.append(f"patch.json holds the change{whose} in SI units. {content.fmu}")
    if is_group:
        title = "The members of the group"
    else:
        title = "What is added" if is_named else "Effects that could be added"
    caption = " ".join(sentences).rstrip()
    return table_of_records(columns, effect_rows(verdict), title, caption)


def printed_effects_table(verdict: Verdict) -> Table:
    """Return the parameters of the effects of a verdict, for the terminal."""
    columns: list[RecordColumn[EffectRow]] = [
        text_cells("effect", lambda row: row.effect.identifier),
        text_cells("place", lambda row: row.effect.place_in_words),
        text_cells("parameter", _parameter_name),
        text_cells("value", lambda row: row.value),
        text_cells("90 % interval", lambda row: row.interval),
        text_cells("unit", lambda row: row.unit),
    ]
    return table_of_records(columns, [row for row in effect_rows(verdict) if row.parameter])


def _parameter_name(row: EffectRow) -> str:
    """Return the name of the parameter of a row in words."""
    return "" if row.parameter is None else row.parameter.name.replace("_", " ")


def next_experiments_table(verdict: Verdict) -> Table:
    """Return the table of the tests that would decide most for their cost."""
    columns: list[RecordColumn[Experiment]] = [
        text_cells("test", lambda experiment: experiment.description),
        text_cells("why", lambda experiment: experiment.reason),
        number_cells("information", lambda experiment: f"{bits(experiment):.2f}", "bit"),
        number_cells("cost", lambda experiment: f"{experiment.cost:g}", "trials"),
    ]
    return table_of_records(
        columns,
        verdict.next_experiments,
        title="Proposed tests, best first",
        caption="Cost is relative to one more trial of a kind that was done already.",
    )


def bits(experiment: Experiment) -> float:
    """Return the information of a proposed test in bits: 1 decides between two equals."""
    return experiment.information / log(2.0)


def gates_table(verdict: Verdict) -> Table:
    """Return the table of the gates that a name has to pass."""
    columns: list[RecordColumn[Gate]] = [
        text_cells("gate", lambda gate: gate.name),
        text_cells(
            "passed",
            lambda gate: "not applied" if gate.passed is None else cell_text(gate.passed),
        ),
        text_cells("compared", _compared_statistic),
        text_cells("passes if", _passing_limit),
        text_cells("reason", lambda gate: gate.reason),
    ]
    return table_of_records(
        columns,
        verdict.gates,
        title="Gates",
        caption=(
            "A name must fit the noise record (absolute fit), freeing its shape must not gain more "
            "than two nats, and its residuals must follow neither loads, runs nor its own channel "
            "(consistency)."
        ),
    )


def _compared_statistic(gate: Gate) -> str:
    """Return the statistic of a gate with its meaning, such as "p = 0.2"."""
    if isnan(gate.statistic):
        return UNKNOWN
    if gate.name == "held-out trials":
        return f"{number(gate.statistic)} deviations"
    if gate.name == "shape":
        return f"gain {number(gate.statistic)} nat"
    equals = "= " if gate.statistic >= 1e-6 else ""  # else the text of the p-value has a sign
    return f"p {equals}{p_value_text(gate.statistic)}"


def _passing_limit(gate: Gate) -> str:
    """Return the limit of a gate's statistic, such as "p at least 0.01"."""
    if isnan(gate.statistic):
        return UNKNOWN
    if gate.name == "held-out trials":
        return f"at most {number(gate.limit)}"
    if gate.name == "shape":
        return f"at most {number(gate.limit)} nat"
    return f"p at least {number(gate.limit)}"


def _rank_hypotheses(verdict: Verdict) -> list[tuple[Hypothesis, str]]:
    """Return the hypotheses that the table of evidence shows, with their roles.

    The hypotheses of the verdict come first. The most probable other hypotheses follow, so that at
    most `MOST_SHOWN_HYPOTHESES` are shown. The hypothesis without effects is always included.
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


def evidence_table(verdict: Verdict) -> Table:
    """Return the table of the best hypotheses with their probabilities and evidence.

    A hypothesis is a set of effects. The evidence is stated as a log Bayes factor against the
    hypothesis without effects, if that one was compared.
    """
    # each row is made of a hypothesis and its role in the verdict, such as "named"
    columns: list[RecordColumn[tuple[Hypothesis, str]]] = [
        text_cells("hypothesis", lambda row: hypothesis_name(row[0])),
        text_cells("role", lambda row: row[1]),
        number_cells("probability", lambda row: probability_text(row[0].probability)),
    ]
    without_effects = next(
        (hypothesis for hypothesis in verdict.hypotheses if not hypothesis.effects), None
    )
    if without_effects is not None:
        reference = without_effects.log_evidence
        columns.append(
            number_cells("ln B", lambda row: _signed(row[0].log_evidence - reference), unit="nat")
        )
    caption = (
        "The best hypotheses among those compared; ln B is the logarithm of the evidence over that "
        "of no effect (for the best place of the effect, before prior probabilities). In trials in "
        "motion, a force of unknown cause may be missing beside each hypothesis, and beside no "
        "effect."
    )
    return table_of_records(
        columns,
        _rank_hypotheses(verdict),
        title="Evidence",
        caption=f"{caption} {_inclusion_sentence(verdict.inclusion)}".rstrip(),
    )


def _signed(log_factor: float) -> str:
    """Return a difference of log evidence with its sign and one decimal."""
    return f"{log_factor:+,.1f}".replace("-", "\N{MINUS SIGN}")


def _inclusion_sentence(inclusion: Mapping[str, float]) -> str:
    """Return the probabilities that single effects take part; empty for fewer than two effects."""
    ranked = sorted(inclusion.items(), key=lambda item: item[1], reverse=True)
    shown = [item for item in ranked if item[1] >= LEAST_SHOWN_INCLUSION]
    phrases = []
    for name, probability in shown[:MOST_SHOWN_INCLUSIONS]:
        phrases.append(f"{name.replace('_', ' ')} {probability_text(probability)}")
    if len(phrases) < 2:
        return ""
    return f"Probability that an effect takes part: {listing(phrases)}."


def not_compared_table(verdict: Verdict) -> Table:
    """Return the table of effects that were not fitted: each reason with its effects."""
    names_by_reason: dict[str, list[str]] = {}
    for omitted in verdict.not_fitted:
        gain = f" ({number(omitted.gain, 2)} nat)" if isfinite(omitted.gain) else ""
        reason = omitted.reason
        if reason.startswith("screened out"):
            reason = "screened out"
        name = omitted.identifier.replace("_", " ")
        names_by_reason.setdefault(reason, []).append(f"{name}{gain}")
    rows = []
    for reason, names in names_by_reason.items():
        rows.append((f"{reason[:1].upper()}{reason[1:]}", listing(names)))
    return Table(
        [PageColumn("why"), PageColumn("effects")],
        rows,
        title="Not compared",
        caption=(
            "Effects that are not in this table were fitted and compared. Numbers in brackets are "
            "the largest gain that a screening predicted."
        ),
    )
