"""Sections on what was found: verdict, next experiment, where the gap is."""

from collections.abc import Callable
from math import isfinite, isnan

from discrepancy.judgement.conclusion import named_effects
from discrepancy.judgement.when import when_sentence
from discrepancy.report.content import ReportInput
from discrepancy.report.sizes import definite_unit, size_sentence
from discrepancy.report.text import (
    NAMING,
    WORDS,
    added_label,
    catalogue_of,
    estimate_text,
    formula,
    headline,
    meaning,
    number,
    p_value_text,
    percent,
    probability_text,
    remainders_sentence,
    residual_sizes,
    rounded,
    shares_sentence,
    unit_text,
)
from discrepancy.verdict import Proof, Scores, VerdictKind
from discrepancy.workflow import Investigation
from reporting.page import Page, Table, columns, numbers
from reporting.words import counted, listing

LEAST_SHARE = 0.05
"""Findings in words that explain less of the excess variance are left to the file."""
SHOWN_FINDINGS = 8


def add_verdict(page: Page, content: ReportInput, picture: Callable[[], None] | None = None) -> None:
    """Add the verdict: its sentence and size, its `picture`, what is added, in what sizes."""
    investigation = content.investigation
    verdict = investigation.verdict
    page.add_notice(headline(verdict))
    if opening := " ".join(filter(None, (_sizes(content), closing_sentence(investigation)))):
        page.add_paragraph(opening)
    if picture is not None:
        picture()
    page.add_paragraph(meaning(verdict))
    if shares := shares_sentence(verdict):
        page.add_paragraph(f"{shares} {remainders_sentence(verdict)}".strip())
    _add_highlights(page, investigation)
    catalogue = catalogue_of(investigation)
    if verdict.kind is VerdictKind.UNEXPLAINED and verdict.resembles:
        names = [catalogue[name].name if name in catalogue else name for name in verdict.resembles]
        page.add_paragraph(
            f"The nearest in the catalogue is {listing(names)}; this is a resemblance, no name."
        )
    if not verdict.effects:
        return
    for effect in {item.identifier: item for item in verdict.effects}.values():
        entry = catalogue.get(effect.identifier)
        if entry is not None:
            page.add_paragraph(
                f"{effect.name[0].upper()}{effect.name[1:]}: {formula(entry.equation)}. Its signature: "
                f"{formula(entry.signature).rstrip('.')}. Source: {entry.reference.rstrip('.')}."
            )
    rows = []
    for effect in verdict.effects:
        for item in (*effect.parameters, *effect.shape):
            value, interval = estimate_text(item)
            rows.append(
                (
                    effect.name, effect.place or "\N{EN DASH}",
                    formula(item.description or item.name.replace("_", " ")),
                    value, interval, unit_text(item.unit),
                )
            )  # fmt: skip
    page.add_table(
        Table(
            columns("effect", "place", "parameter", *map(numbers, ("value", "90 % interval")), "unit"), rows
        ),
        WORDS["sizes"].get(verdict.kind, WORDS["sizes"]["other"]),
        title="What is added" if verdict.kind in NAMING else "What could be added",
    )
    _add_primitives(page, content)


def _sizes(content: ReportInput) -> str:
    """Return how large what is missing is, in SI units, or by its parameters where none has a unit."""
    found = content.investigation
    if content.intervals and found.problem is not None and found.fit is not None:
        effects = named_effects(found.problem, found.fit)
        if sentence := size_sentence(found, effects, content.intervals):
            return sentence
    if found.verdict.kind not in NAMING:
        return ""
    parts = []
    for effect in found.verdict.effects:
        for item in effect.parameters:
            value, interval = estimate_text(item)
            what = formula(item.description or item.name.replace("_", " "))
            parts.append(f"{what} {value} {unit_text(item.unit)}".rstrip() + f" ({interval})")
    return f"Its size: {'; '.join(parts)}; 90 % intervals in brackets." if parts else ""


def closing_sentence(investigation: Investigation) -> str:
    """Return how much of the gap is closed and what is left; empty where nothing was added or scored."""
    verdict, proof = investigation.verdict, investigation.proof
    added = "It" if verdict.kind in NAMING else "The best hypothesis, which is no name,"
    if (share := verdict.explained) is not None:
        interval = f"{100.0 * share.low:.0f} to {100.0 * share.high:.0f} %"
        closed = f"{100.0 * share.value:.0f} % of the gap on {share.trials} trials ({interval})"
        return f"{added} closes {closed} and leaves {number(share.left, 2)} noises."
    if proof is None or not added_label(investigation):
        return ""
    before, after, where = _scored(proof)
    if not (isfinite(before.chi_square_per_dof) and isfinite(after.chi_square_per_dof)):
        return ""
    course = f"{number(before.chi_square_per_dof)} before and {number(after.chi_square_per_dof)} after it"
    if proof.gap_closed > 0.0:
        closed = f"{percent(proof.gap_closed)} % of the gap on {where} trials"
        return f"{added} closes {closed}: χ²/dof is {course}, 1 for noise alone."
    return f"On {where} trials χ²/dof is {course}, 1 for noise alone."


def _scored(proof: Proof) -> tuple[Scores, Scores, str]:
    """Return the scores before and after, and on which trials: those held out, where there are any."""
    if proof.held_out_before is not None and proof.held_out_after is not None:
        return proof.held_out_before, proof.held_out_after, "held-out"
    return proof.fitted_before, proof.fitted_after, "fitted"


def _add_primitives(page: Page, content: ReportInput) -> None:
    rows = []
    found = content.investigation
    if not content.intervals or found.problem is None or found.fit is None:
        return
    effects = named_effects(found.problem, found.fit)
    for effect, intervals in zip(effects, content.intervals, strict=True):
        for item in intervals:
            primitive = effect.patch.primitives[item.primitive]
            unit = definite_unit(item.unit, primitive, found.model, found.campaign) or unit_text(item.unit)
            if item.parameter in ("velocity_exponent", "displacement_exponent", "reference_velocity",
                                  "reference_displacement", "element_count"):  # fmt: skip
                continue
            if isnan(item.low) or item.low == item.high:
                interval, value = "fixed", f"{item.value:.4g}"
            else:
                form = rounded(item.value, 0.5 * (item.high - item.low))
                value, interval = form(item.value), f"{form(item.low)} to {form(item.high)}"
            rows.append((item.parameter.replace("_", " "), value, interval, unit))
    if not rows:
        return
    marked = "" if content.investigation.verdict.kind in NAMING else (
        f" It is that of {added_label(content.investigation)}, which is not named."
    )  # fmt: skip
    fmu = f" {content.fmu}" if content.fmu else ""
    page.add_table(
        Table(columns("number", *map(numbers, ("value", "90 % interval")), "unit"), rows),
        f"patch.json holds it in SI units, ready for the model and its FMU.{marked}{fmu}",
        title="The change of the model",
    )


def _add_highlights(page: Page, investigation: Investigation) -> None:
    """Add what the sentences above do not say."""
    verdict, proof = investigation.verdict, investigation.proof
    items: list[tuple[str, str]] = []
    said = "probability" in headline(verdict) or verdict.kind is VerdictKind.UNEXPLAINED
    if not isnan(verdict.probability) and not said:
        items.append((probability_text(verdict.probability), "probability of the verdict"))
    if isfinite(verdict.log_bayes_factor) and verdict.hypotheses and verdict.hypotheses[0].effects:
        items.append((f"{verdict.log_bayes_factor:,.1f} nat", "ln Bayes factor against nothing missing"))
    if proof is not None:
        first, second, where = _scored(proof)
        if verdict.explained is not None:  # at the scale of its share: χ²/dof counts uncertainty as expected
            before, after = residual_sizes(verdict.explained)
            items.append(
                (f"{before} → {after}", f"noise deviations, rms on {where} trials, before and after")
            )
        elif not closing_sentence(investigation):
            items.append(
                (
                    f"{number(first.chi_square_per_dof)} → {number(second.chi_square_per_dof)}",
                    f"χ²/dof on {where} trials, before and after",
                )
            )
    elif judged := [
        gate
        for gate in verdict.gates
        if gate.name not in ("shape", "held-out trials") and isfinite(gate.statistic)
    ]:
        # of gates whose statistic is a p-value, the one that decided
        gate = next((gate for gate in judged if gate.passed is False), judged[0])
        items.append(
            (number(gate.statistic), f"p of the {gate.name}; a fit has at least {number(gate.limit)}")
        )
    if items:
        page.add_highlights(items)


def add_next(page: Page, investigation: Investigation) -> None:
    """Add the proposed experiments."""
    page.add_paragraph(
        "What would decide most between the hypotheses that are still open, for its cost. Information is "
        "the mutual "
        "information of hypothesis and data, by simulation; ln 2 = 0.69 nat decides between two equals."
    )
    if sentence := when_sentence(investigation.verdict.windows):
        page.add_paragraph(sentence)
    rows = [
        (item.description, item.reason, f"{item.information:.2f}", f"{item.cost:g}")
        for item in investigation.verdict.next_experiments
    ]
    page.add_table(
        Table(columns("test", "why", numbers("information", "nat"), numbers("cost", "trials")), rows),
        "Cost is relative to one more trial of a kind that was done already.",
        title="Proposed tests, best first",
    )


def add_location(page: Page, investigation: Investigation) -> None:
    """Add where the model as it was disagrees."""
    location = investigation.location
    if location is None:
        page.add_paragraph("The residuals were not searched for patterns.")
        return
    if not location.disagrees:
        page.add_paragraph(
            "No global test finds a disagreement between the model as it was and the fitted trials."
        )
    else:
        significant = sum(cell.significant for cell in location.cells)
        page.add_paragraph(
            f"The model as it was disagrees with the fitted trials; {significant} of "
            f"{counted(len(location.cells), 'cell')} of the map (channel, trial, and bin of time, amplitude, "
            f"frequency or load) {'is a discovery' if significant == 1 else 'are discoveries'} at a false "
            "discovery rate of 5 %."
        )
    findings = [item for item in location.disagreements if item.share >= LEAST_SHARE][:SHOWN_FINDINGS]
    for item in findings:
        page.add_paragraph(f"• {item.sentence}")
    rows = [
        (test.name, number(test.statistic, 4), p_value_text(test.p_value), "yes" if test.rejected else "no")
        for test in location.tests
    ]
    page.add_table(
        Table(columns("test", numbers("statistic"), numbers("p"), "disagrees"), rows),
        "Residuals of the model as it was on fitted trials, each against what noise would leave after the "
        "fit; "
        "Holm's rule at 1 % over the tests.",
        title="Global tests",
    )
