"""The page: verdict first, then where the gap is, why this name, the proof, and the limits."""

from functools import partial

from discrepancy.verdict import VerdictKind
from reporting.page import Page, ReportFigure

from . import findings, grounds
from .figures import ReportInput


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
        grounds.add_data(page, investigation)
        grounds.add_origin(page, origin)
        return page.render()
    if verdict.next_experiments:
        page.add_section("Next experiment")
        findings.add_next(page, investigation)
    nothing = verdict.kind in (VerdictKind.NOTHING_MISSING, VerdictKind.BELOW_LIMIT)
    page.add_section("What the model leaves" if nothing else "Where the gap is")
    findings.add_location(page, investigation)
    show("residual_map", "residual_table", "time_line")
    page.add_section("What it looks like")
    show("history", "backbone", "spectrum", "load")
    page.add_section("Why this verdict")
    grounds.add_gates(page, investigation)
    grounds.add_evidence(page, verdict)
    grounds.add_not_compared(page, verdict)
    grounds.add_parameters(page, investigation)
    if investigation.proof is not None:
        page.add_section("Proof on held-out trials")
        grounds.add_proof(page, investigation, investigation.proof)
        show("pit")
    if content.separability is not None or content.self_calibration is not None:
        page.add_section("What this campaign can decide")
        grounds.add_separability(page, content)
        show("separability")
        grounds.add_self_calibration(page, content)
        show("self_calibration")
    grounds.add_data(page, investigation)
    grounds.add_origin(page, origin)
    return page.render()
