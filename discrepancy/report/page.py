"""The page: verdict first, then where the gap is, why this name, the proof, and what all rests on."""

from collections.abc import Callable
from functools import partial
from math import isfinite, nan

from discrepancy.campaign.units import UNITS
from discrepancy.document import Origin
from discrepancy.judgement.conclusion import calibrated_parameters, probability_text
from discrepancy.judgement.when import NO_GAP
from discrepancy.report import findings
from discrepancy.report import text as words
from discrepancy.report.check_tables import group_lines, rows_of
from discrepancy.report.figures import ReportInput
from discrepancy.report.text import WORDS
from discrepancy.self_calibration import outcomes
from discrepancy.verdict import Proof, Scores, Verdict, VerdictKind
from discrepancy.workflow import Investigation
from reporting.page import Page, ReportFigure
from reporting.words import listing, plus_minus

SHOWN_HYPOTHESES = 8
NINETY = 1.6449
"""Normal quantile at 95 %: half of a 90 % interval in standard deviations."""


def add_evidence(page: Page, verdict: Verdict) -> None:
    """Add the best hypotheses, members of a group first and 'none' always, and what takes part in them."""
    named = " + ".join(sorted(item.identifier for item in verdict.effects))
    stands = dict.fromkeys(verdict.group or filter(None, [named]), True)  # each once, the most probable
    role = "member of the group" if verdict.group else verdict.kind.value
    ranked = [(item, stands.pop(" + ".join(item.identifiers), False)) for item in verdict.hypotheses]
    ranked.sort(key=lambda row: not row[1])
    none = next((item for item in verdict.hypotheses if not item.effects), None)
    rows = []
    for rank, (item, first) in enumerate(ranked):
        if rank < SHOWN_HYPOTHESES or item is none:
            row = words.hypothesis_name(item), role if first else "", probability_text(item.probability)
            over = nan if none is None else item.log_evidence - none.log_evidence
            told = f"{over:+,.1f}".replace("-", "\N{MINUS SIGN}")
            rows.append(row if none is None else (*row, told))
    inclusion = sorted(verdict.inclusion.items(), key=lambda row: -row[1])
    shown = [(name.replace("_", " "), p) for name, p in inclusion if p >= 1e-3][:6]
    part = listing(f"{name} {probability_text(p)}" for name, p in shown)
    takes_part = f" Probability that an effect takes part: {part}." if shown[1:] else ""
    WORDS.add_table(page, "evidence", rows, takes_part=takes_part)


def add_not_compared(page: Page, verdict: Verdict) -> None:
    """Add what was not compared, by the reason."""
    by_reason: dict[str, list[str]] = {}
    for item in verdict.not_fitted:
        gain = f" ({words.number(item.gain, 2)} nat)" if isfinite(item.gain) else ""
        reason = "screened out" if item.reason.startswith("screened out") else item.reason
        by_reason.setdefault(reason, []).append(item.identifier.replace("_", " ") + gain)
    rows = [(f"{reason[:1].upper()}{reason[1:]}", listing(names)) for reason, names in by_reason.items()]
    WORDS.add_table(page, "not_compared", rows)


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
        rows.append((found[0].name.replace("_", " "), words.unit_text(found[0].unit), *cells))
    return rows


def _beside(value: float, deviation: float) -> str:
    return plus_minus(value, NINETY * deviation) if deviation > 0.0 else f"{value:.6g}, exact"


_SCORES: dict[str, Callable[[Scores], str]] = {
    "χ²/dof (1 is noise)": lambda s: words.number(s.chi_square_per_dof, 4),
    "its deviation if the model is right": lambda s: words.number(s.chi_square_deviation, 2),
    "mean log score, nat per sample (best −1.42)": lambda s: words.number(s.log_score, 4),
    "coverage of 50 % intervals, %": lambda s: f"{100.0 * s.coverage_50:.1f}",
    "coverage of 90 % intervals, %": lambda s: f"{100.0 * s.coverage_90:.1f}",
    "whiteness, p": lambda s: words.p_value_text(s.whiteness),
    "flat histogram of transforms, p": lambda s: words.p_value_text(s.pit_p_value),
    "samples": lambda s: str(s.sample_count),
}
"""Rows of the table before and after."""


def add_proof(page: Page, investigation: Investigation, proof: Proof) -> None:
    """Add scores before and after."""
    if investigation.verdict.kind not in words.NAMING:
        label = words.added_label(investigation)
        page.add_notice(WORDS.say("not_named", label=label))
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
        sizes = (words.number(factor * item.rms.get(name, nan)) for item in scores.values())
        rows.append((f"rms of {name}, {unit}", *sizes))
    gain = "Nothing is held out, so that nothing is proved." if proof.held_out_after is None else (
        f"Gain in log score on held-out trials {words.number(proof.log_score_gain, 4)} "
        f"± {words.number(proof.log_score_gain_error, 2)} nat per sample. "
    )  # fmt: skip
    verdict, closed = investigation.verdict, proof.gap_reason
    # beside a share of the readings in units of their noise no other one is told
    if isfinite(proof.gap_closed) and (verdict.explained is None or words.rests_on_force(verdict)):
        closed = f"Gap closed: {words.percent(proof.gap_closed)} %."
    trials = f" Held out: {', '.join(held)}; only their own releases and zeros were adapted." if held else ""
    WORDS.add_table(page, "proof", rows, more=scores, gain=gain, closed=closed, trials=trials)


def add_self_calibration(page: Page, content: ReportInput) -> None:
    """Add verdicts on simulated campaigns."""
    found = content.self_calibration
    if found is None:
        return
    rows = [
        (title, outcome, found.share(outcome, null=null))
        for title, null in (("an effect was hidden", False), ("nothing was hidden", True))
        for outcome in outcomes(found, null=null)
    ]
    rows.append(("named rightly", "90 % intervals that hold the true value", found.coverage()))
    names = ", ".join(found.not_detectable)
    absent = f" Never detectable in draws of their priors, so not hidden: {names}." if names else ""
    WORDS.add_table(page, "calibration", rows, absent=absent)


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
    WORDS.add_table(page, "trials", investigation.campaign.trials)


def add_origin(page: Page, origin: Origin) -> None:
    """Add provenance."""
    page.add_section("Where it comes from")
    provenance = origin.provenance
    rows = [
        *((f"input {name}", f"SHA-256 {value}") for name, value in provenance.input_hashes.items()),
        ("software", ", ".join(f"{name} {version}" for name, version in provenance.versions.items())),
        ("sources", ", ".join(f"{name} {value[:12]}" for name, value in provenance.source_hashes.items())),
    ]
    WORDS.add_table(page, "origin", rows, origin=origin)


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
    investigation, origin = content.investigation, content.origin
    verdict = investigation.verdict
    page = Page(
        origin.campaign,
        f"What the model “{origin.model}” lacks beside these data: located, named, added, proved",
        footer=(
            f"Repeat it: {origin.short_command}",
            f"Data {origin.data_hash[:16]}, model {origin.model_hash[:16]}, seed {origin.provenance.seed}.",
        ),
    )

    def show(*names: str) -> None:
        for name in names:
            if name in figures:
                item = figures[name]
                page.add_figure(drawings[name], item.caption, title=item.title)

    page.add_section("Verdict")
    findings.add_verdict(page, content, partial(show, "missing_force"))
    if verdict.kind is VerdictKind.DATA_ERROR:
        add_data(page, investigation)
        add_origin(page, origin)
        return page.render()
    if verdict.next_experiments:
        page.add_section("Next experiment")
        findings.add_next(page, investigation)
    nothing = verdict.kind in NO_GAP
    page.add_section("What the model leaves" if nothing else "Where the gap is")
    findings.add_location(page, investigation)
    show("residual_map", "residual_table", "time_line")
    page.add_section("What it looks like")
    show("history", "backbone", "spectrum", "load")
    page.add_section("Why this verdict")
    WORDS.add_table(page, "gates", verdict.gates)
    add_evidence(page, verdict)
    add_not_compared(page, verdict)
    added = words.added_label(investigation)
    told = f"without and with {added}" if added else "without any effect"
    WORDS.add_table(page, "parameters", parameter_rows(investigation), added=told)
    if investigation.proof is not None:
        page.add_section("Proof on held-out trials")
        add_proof(page, investigation, investigation.proof)
        show("pit")
    if content.separability is not None or content.self_calibration is not None:
        page.add_section("What this campaign can decide")
        if content.separability is not None:
            for line in group_lines(content.separability):
                page.add_paragraph(line)
            rows = [[cell.replace("_", " ") for cell in row] for row in rows_of(content.separability)]
            WORDS.add_table(page, "decide", rows)
        show("separability")
        add_self_calibration(page, content)
        show("self_calibration")
    add_data(page, investigation)
    add_origin(page, origin)
    return page.render()
