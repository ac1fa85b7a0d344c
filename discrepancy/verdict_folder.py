"""The folder that an investigation leaves: verdict, patch, residuals, figures, report; whole or not."""

from dataclasses import replace
from pathlib import Path

from discrepancy.errors import said
from discrepancy.files import verdict as files
from discrepancy.files.residuals import RESIDUALS_NAME, write_residuals
from discrepancy.judgement.conclusion import named_effects
from discrepancy.report.figures import ReportInput, report_figures
from discrepancy.report.page import render_report
from discrepancy.report.text import added_label
from discrepancy.self_calibration import SELF_CALIBRATION_NAME, write_self_calibration
from discrepancy.verdict import VerdictKind
from discrepancy.verdict_so_far import SO_FAR_NAME
from discrepancy.workflow import patch_draws
from reporting.errors import FileNotWrittenError
from reporting.figures import save_figure
from reporting.files import atomic_write_text
from reporting.folders import restore_folder, whole_folder

REPORT_NAME = "report.html"
FMU_NAME = "patched.fmu"
FIGURES = "figures"


def check_verdict_folder(folder: Path, *, replace_it: bool) -> None:
    """Look at the place before the work begins; a verdict that a killed process had moved aside comes back.

    Raises
    ------
    FileNotWrittenError
        If it is no folder, holds something else than a verdict, or a verdict that is not to be replaced.
    """
    restore_folder(folder)
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise FileNotWrittenError(f"{folder} exists and is no folder: choose another --out.")
    if not folder.is_dir():
        return
    names = {path.name for path in folder.iterdir()}
    if names <= {SO_FAR_NAME}:  # nothing, or what an interrupted search left
        return
    if not (folder / files.VERDICT_NAME).is_file():
        raise FileNotWrittenError(said("models.no_verdict", folder=folder, name=files.VERDICT_NAME))
    if not replace_it:
        raise FileNotWrittenError(said("models.verdict_there", folder=folder))


def write_verdict_folder(
    folder: Path, content: ReportInput, *, replace_it: bool = False, report: bool = True
) -> Path:
    """Write everything beside the folder first, and move it into place when it is complete.

    Parameters
    ----------
    folder : Path
        Where; an empty folder is as good as none.
    content : ReportInput
        What is written.
    replace_it : bool
        Put it in the place of an existing folder of a verdict. Anything else is never replaced.
    report : bool
        Draw the page and its figures.

    Returns
    -------
    Path
        Of the report, or of the folder where there is none.

    Raises
    ------
    FileNotWrittenError
        As `check_verdict_folder`, or if the disk is full or the place not writable; the folder is as it was.
    """
    check_verdict_folder(folder, replace_it=replace_it)
    with whole_folder(folder) as fresh:
        _write(fresh, content, report=report)
    return folder / REPORT_NAME if report else folder


def _write(folder: Path, content: ReportInput, *, report: bool) -> None:
    found, origin = content.investigation, content.origin
    verdict = found.verdict
    files.write_verdict(folder / files.VERDICT_NAME, verdict, found.proof, origin)
    if found.problem is not None and found.fit is not None and found.fit.candidate.terms:
        if verdict.kind in files.PATCHED:
            draws = patch_draws(found.problem, found.fit, origin.provenance.seed or 0)
            effects = files.patch_effects(named_effects(found.problem, found.fit), draws)
            content = replace(content, intervals=[effect.intervals for effect in effects])
            outputs = files.fmu_outputs(found.campaign.channels)
            patch = files.StoredPatch(
                verdict.kind, verdict.sentence, effects, outputs, verdict.parameters, origin
            )
            files.write_patch(folder / files.PATCH_NAME, patch)
        if verdict.kind is VerdictKind.NAMED and content.pack is not None:
            content = replace(content, fmu=content.pack(folder / files.PATCH_NAME, folder / FMU_NAME))
    if found.after is not None:
        label = added_label(found) or "nothing added"
        write_residuals(
            folder / RESIDUALS_NAME, found.after,
            {"hypothesis": label, "verdict": verdict.sentence, "data_hash": origin.data_hash,
             "command": origin.command},
        )  # fmt: skip
    if content.self_calibration is not None:
        write_self_calibration(folder / SELF_CALIBRATION_NAME, content.self_calibration, origin)
    if not report:
        return
    figures = report_figures(content)
    drawings = {name: save_figure(item.figure, folder / FIGURES, name) for name, item in figures.items()}
    atomic_write_text(folder / REPORT_NAME, render_report(content, drawings, figures))
