"""Sections on what it rests on: gates, proof, what the campaign can decide, data, provenance."""

from collections.abc import Callable, Sequence
from math import isfinite, isnan, nan

from discrepancy.campaign.units import UNITS
from discrepancy.files.document import Origin
from discrepancy.judgement.conclusion import calibrated_parameters
from discrepancy.report.check_tables import can_decide_table, group_lines
from discrepancy.report.content import ReportInput
from discrepancy.report.text import (
    NAMING,
    added_label,
    number,
    p_value_text,
    percent,
    probability_text,
    rounded,
    unit_text,
)
from discrepancy.self_calibration import Share, outcomes
from discrepancy.verdict import Gate, Proof, Scores, Verdict
from discrepancy.workflow import Investigation
from reporting.page import Page, Table, columns, numbers
from reporting.words import listing

NINETY = 1.6449
"""Normal quantile at 95 %: half of a 90 % interval in standard deviations."""


def add_gates(page: Page, investigation: Investigation) -> None:
    """Add the outcomes of the gates."""
    gates = investigation.verdict.gates
    if not gates:
        return
    passed = {None: "not applied", True: "yes", False: "no"}
    rows = [(gate.name, passed[gate.passed], *_compared(gate), gate.reason) for gate in gates]
    page.add_table(
        Table(columns("gate", "passed", "compared", "passes if", "reason"), rows),
        "A name must fit the noise record (absolute fit), freeing its shape must not gain more than two "
        "nats, and what it leaves must follow neither loads, runs nor its own channel (consistency).",
        title="Gates",
    )


def _compared(gate: Gate) -> tuple[str, str]:
    """Return what a gate compares, and with what: a p-value, or a gain in evidence."""
    if isnan(gate.statistic):
        return "\N{EN DASH}", "\N{EN DASH}"
    if gate.name == "held-out trials":
        return f"{number(gate.statistic)} deviations", f"at most {number(gate.limit)}"
    if gate.name == "shape":
        return f"gain {number(gate.statistic)} nat", f"at most {number(gate.limit)} nat"
    text = p_value_text(gate.statistic)
    return f"p {text}" if text.startswith("<") else f"p = {text}", f"p at least {number(gate.limit)}"


def add_inclusion(page: Page, investigation: Investigation) -> None:
    """Add the probabilities that effects take part."""
    inclusion = sorted(investigation.verdict.inclusion.items(), key=lambda row: -row[1])
    shown = [row for row in inclusion if row[1] >= 1e-3][:6]
    if len(shown) < 2:
        return
    page.add_paragraph(
        "Probability that an effect takes part: "
        + listing(f"{name.replace('_', ' ')} {probability_text(p)}" for name, p in shown)
        + "."
    )


def add_not_fitted(page: Page, verdict: Verdict) -> None:
    """Add what was not fitted, and why."""
    if not verdict.not_fitted:
        return
    rows = [(item.identifier, item.reason, number(item.gain, 2)) for item in verdict.not_fitted]
    page.add_table(
        Table(columns("effect", "why", numbers("promised at most", "nat")), rows),
        "What is not in this table was fitted and compared.",
        title="Not fitted",
    )


def parameter_rows(investigation: Investigation) -> list[tuple[str, ...]]:
    """Return name, unit, and values with 90 % half-widths: calibration, model as it was, with the effect.

    Without an effect the last column is left out; without parameters there are no rows.
    """
    problem, search, fit = investigation.problem, investigation.search, investigation.fit
    if problem is None or search is None or fit is None:
        return []
    layout = problem.shared
    fits = [search.none] + ([fit] if fit.candidate.terms else [])
    rows = []
    stated = zip(layout.parameter_mean.tolist(), layout.parameter_scale.tolist(), strict=True)
    for prior, *found in zip(stated, *(calibrated_parameters(problem, one) for one in fits), strict=True):
        cells = [_beside(*prior), *(_beside(item.mean, item.deviation) for item in found)]
        rows.append((found[0].name.replace("_", " "), unit_text(found[0].unit), *cells))
    return rows


def _beside(value: float, deviation: float) -> str:
    show = rounded(value, NINETY * deviation)
    return f"{show(value)} ± {show(NINETY * deviation)}" if deviation > 0.0 else f"{value:.6g}, exact"


def add_parameters(page: Page, investigation: Investigation) -> None:
    """Add the table, where the model has calibrated parameters."""
    rows = parameter_rows(investigation)
    if not rows:
        return
    values = map(numbers, ("calibration", "model as it was", "with the effect"))
    heads = columns("parameter", "unit", *values)
    added = added_label(investigation)
    page.add_table(
        Table(heads[: len(rows[0])], rows),
        "Values with the half-width of their 90 % intervals: as the calibration states them, and fitted to "
        f"these data {f'without and with {added}' if added else 'without any effect'}. Where the model as it "
        "was moves a parameter by several deviations, the parameter has taken up what the model lacks.",
        title="Calibrated parameters before and after",
    )


_SCORES: dict[str, Callable[[Scores], str]] = {
    "χ²/dof (1 is noise)": lambda s: number(s.chi_square_per_dof, 4),
    "its deviation if the model is right": lambda s: number(s.chi_square_deviation, 2),
    "mean log score, nat per sample (best −1.42)": lambda s: number(s.log_score, 4),
    "coverage of 50 % intervals, %": lambda s: f"{100.0 * s.coverage_50:.1f}",
    "coverage of 90 % intervals, %": lambda s: f"{100.0 * s.coverage_90:.1f}",
    "whiteness, p": lambda s: p_value_text(s.whiteness),
    "flat histogram of transforms, p": lambda s: p_value_text(s.pit_p_value),
    "samples": lambda s: str(s.sample_count),
}
"""Rows of the table before and after."""


def add_proof(page: Page, investigation: Investigation, proof: Proof) -> None:
    """Add scores before and after."""
    if investigation.verdict.kind not in NAMING:
        page.add_notice(
            f'The model "with the effect" has {added_label(investigation)} here, which is not named: '
            "the figures "
            "say how well it does, not that it is there."
        )
    page.add_paragraph(proof.remaining)
    before = investigation.before
    held = [] if before is None else [item.trial.name for item in before.trials if item.trial.held_out]
    scored = {
        "held out, before": proof.held_out_before, "held out, after": proof.held_out_after,
        "fitted, before": proof.fitted_before, "fitted, after": proof.fitted_after,
    }  # fmt: skip
    scores = {title: item for title, item in scored.items() if item is not None}
    rows = [(title, *(show(item) for item in scores.values())) for title, show in _SCORES.items()]
    channels = {} if before is None else before.channels
    for name in dict.fromkeys(name for item in scores.values() for name in item.rms):
        factor, unit = UNITS[channels[name].quantity].drawn if name in channels else (1.0, "")
        sizes = (number(factor * item.rms.get(name, nan)) for item in scores.values())
        rows.append((f"rms of {name}, {unit}", *sizes))
    gain = "Nothing is held out, so that nothing is proved." if proof.held_out_after is None else (
        f"Gain in log score on held-out trials {number(proof.log_score_gain, 4)} "
        f"± {number(proof.log_score_gain_error, 2)} nat per sample. "
    )  # fmt: skip
    closed = f"Gap closed: {percent(proof.gap_closed)} %." if isfinite(proof.gap_closed) else proof.gap_reason
    if investigation.verdict.explained is not None:
        closed = proof.gap_reason  # the share of the verdict is that of all channels in units of their noise
    trials = f" Held out: {', '.join(held)}; only their own releases and zeros were adapted." if held else ""
    table = Table(columns("score", *map(numbers, scores)), rows)
    page.add_table(table, f"{gain}{closed}{trials}", title="Before and after, at the same scale")


def add_separability(page: Page, content: ReportInput) -> None:
    """Add detectable sizes and confusion groups."""
    found = content.separability
    if found is None:
        return
    for line in group_lines(found):
        page.add_paragraph(line)
    untested = [(i.effect.name, i.reason) for i in found.detectability if i.reason]
    if untested:
        page.add_table(
            Table(columns("effect", "why not"), untested),
            "These can be neither named nor excluded by this campaign and model.",
            title="Effects that cannot be tested here",
        )
    page.add_table(
        can_decide_table(found),
        "From the model, the inputs and the noise alone. Detectable from: the size at which d² reaches "
        "25, with "
        "all nuisances adapted.",
        title="Detectable sizes",
    )


def _share(share: Share) -> str:
    return (
        f"{share.count} of {share.total}: {100.0 * share.value:.0f} % "
        f"({100.0 * share.low:.0f} to {100.0 * share.high:.0f} %)"
    )


def add_self_calibration(page: Page, content: ReportInput) -> None:
    """Add verdicts on simulated campaigns."""
    found = content.self_calibration
    if found is None:
        return
    rows = [
        (title, outcome, _share(found.share(outcome, null=null)))
        for title, null in (("an effect was hidden", False), ("nothing was hidden", True))
        for outcome in outcomes(found, null=null)
    ]
    rows.append(("named rightly", "90 % intervals that hold the true value", _share(found.coverage())))
    names = ", ".join(found.not_detectable)
    absent = f" Never detectable in draws of their priors, so not hidden: {names}." if names else ""
    page.add_table(
        Table(columns("campaigns", "outcome", "share, 90 % Wilson interval"), rows),
        "Simulated by the model that looks for the effect, with half its time step: this says what the "
        "campaign and "
        f"the workflow can do, not that the model is right.{absent} self_calibration.json has every case.",
        title="Verdicts on simulated campaigns of this geometry",
    )


def add_data(page: Page, investigation: Investigation) -> None:
    """Add faults, remarks and trials."""
    page.add_section("Data")
    for fault in investigation.faults:
        page.add_notice(fault.sentence)
    told = {fault.sentence for fault in investigation.faults}
    remarks = [text for text in investigation.verdict.remarks if text not in told]
    for text in remarks:
        page.add_paragraph(f"• {text}")
    if not told and not remarks:
        page.add_paragraph("No fault was found.")
    campaign = investigation.campaign
    rows = [
        (
            trial.name, trial.kind.value, trial.run or "\N{EN DASH}", str(len(trial.time)),
            _few(trial.channels), "held out" if trial.held_out else "fitted", str(int((~trial.used).sum())),
        )
        for trial in campaign.trials
    ]  # fmt: skip
    heads = columns("trial", "kind", "run", numbers("rows"), "channels", "role", numbers("left out"))
    page.add_table(
        Table(heads, rows),
        "Left out: single samples that were marked as outliers or empty.",
        title="Trials",
    )


def _few(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:6])} and {len(names) - 6} more"


def add_origin(page: Page, origin: Origin) -> None:
    """Add provenance."""
    page.add_section("Where it comes from")
    provenance = origin.provenance
    rows = [
        ("campaign", f"{origin.campaign}, SHA-256 {origin.data_hash}"),
        ("model", f"{origin.model}, SHA-256 {origin.model_hash}"),
        ("command", origin.short_command),
        ("seed", str(provenance.seed)),
        *((f"input {name}", f"SHA-256 {value}") for name, value in provenance.input_hashes.items()),
        ("software", ", ".join(f"{name} {version}" for name, version in provenance.versions.items())),
        ("sources", ", ".join(f"{name} {value[:12]}" for name, value in provenance.source_hashes.items())),
    ]
    page.add_table(
        Table(columns("item", "value"), rows),
        "verdict.json, patch.json and residuals.nc beside this page hold every figure.",
        title="Provenance",
    )
