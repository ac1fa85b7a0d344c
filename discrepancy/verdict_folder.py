"""The folder with the results of an investigation: verdict, patch, residuals, figures, report.

It is written completely or not at all.
"""

from dataclasses import replace
from pathlib import Path

from discrepancy.files import verdict as files
from discrepancy.files.residuals import RESIDUALS_NAME, write_residuals
from discrepancy.judgement.hypotheses import named_effects
from discrepancy.report.figures import ReportInput, report_figures
from discrepancy.report.page import verdict_page
from discrepancy.report.text import added_label
from discrepancy.self_calibration_file import SELF_CALIBRATION_NAME, write_self_calibration
from discrepancy.verdict import VerdictKind
from discrepancy.verdict_so_far import SO_FAR_NAME
from discrepancy.workflow import patch_draws
from reporting.errors import FileNotWrittenError
from reporting.files import atomic_write_text
from reporting.folders import restore_folder, whole_folder
from reporting.pages.figures import save_figure
from reporting.pages.page import render_page

REPORT_NAME = "report.html"
FMU_NAME = "patched.fmu"
FIGURES = "figures"


def check_verdict_folder(folder: Path, *, replace_it: bool) -> None:
    """Check that the folder of a verdict can be written, before the work begins.

    A verdict that a killed process had moved aside is restored first.

    Parameters
    ----------
    folder : Path
        The folder that is to be written.
    replace_it : bool
        True if a verdict in it may be replaced.

    Raises
    ------
    FileNotWrittenError
        If the path is not a folder, or if the folder contains other files than a verdict, or a
        verdict that must not be replaced.
    """
    restore_folder(folder)
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise FileNotWrittenError(f"{folder} exists and is not a folder: choose another --out.")
    if not folder.is_dir():
        return
    names = {path.name for path in folder.iterdir()}
    if names <= {SO_FAR_NAME}:  # nothing, or what an interrupted search left
        return
    if not (folder / files.VERDICT_NAME).is_file():
        raise FileNotWrittenError(
            f"{folder} exists and holds no {files.VERDICT_NAME}, so that it was left unchanged: "
            "choose another --out."
        )
    if not replace_it:
        raise FileNotWrittenError(
            f"{folder} holds a verdict already: choose another --out or give --replace."
        )


def write_verdict_folder(
    folder: Path, content: ReportInput, *, replace_it: bool = False, report: bool = True
) -> Path:
    """Write the results of an investigation into a folder.

    All files are first written into a temporary folder next to it, which is renamed when it is
    complete.

    Parameters
    ----------
    folder : Path
        The folder to write; it may exist if it is empty.
    content : ReportInput
        The investigation and its origin.
    replace_it : bool
        True to replace a verdict in the folder. Other files are never replaced.
    report : bool
        True to write the report page and its figures.

    Returns
    -------
    Path
        Path of the report, or of the folder if no report is written.

    Raises
    ------
    FileNotWrittenError
        For the causes of `check_verdict_folder`, or if the disk is full or not writable. The folder
        is then unchanged.
    """
    check_verdict_folder(folder, replace_it=replace_it)
    with whole_folder(folder) as fresh:
        _write_files(fresh, content, report=report)
    return folder / REPORT_NAME if report else folder


def _write_files(folder: Path, content: ReportInput, *, report: bool) -> None:
    """Write all files of an investigation into an empty folder."""
    investigation = content.investigation
    origin = content.origin
    files.write_verdict(
        folder / files.VERDICT_NAME, investigation.verdict, investigation.proof, origin
    )
    content = _with_patch_files(folder, content)
    if investigation.after is not None:
        attributes = {
            "hypothesis": added_label(investigation) or "nothing added",
            "verdict": investigation.verdict.sentence,
            "data_hash": origin.data_hash,
            "command": origin.command,
        }
        write_residuals(folder / RESIDUALS_NAME, investigation.after, attributes)
    if content.self_calibration is not None:
        path = folder / SELF_CALIBRATION_NAME
        write_self_calibration(path, content.self_calibration, origin)
    if not report:
        return
    figures = {}
    for name, figure in report_figures(content).items():
        figures[name] = save_figure(figure, folder / FIGURES)
    atomic_write_text(folder / REPORT_NAME, render_page(verdict_page(content, figures)))


def _with_patch_files(folder: Path, content: ReportInput) -> ReportInput:
    """Write the patch of a verdict into a folder and, if `content.pack` is given, an FMU.

    The FMU is written only if the verdict names one effect or one set of effects.

    Returns
    -------
    ReportInput
        The content with the intervals of the patch and the remark on the FMU added; unchanged if
        the verdict has no patch.
    """
    investigation = content.investigation
    problem = investigation.problem
    fit = investigation.fit
    verdict = investigation.verdict
    if problem is None or fit is None or not fit.candidate.terms:
        return content
    patch_file = folder / files.PATCH_NAME
    if verdict.kind in files.PATCHED:
        draws = patch_draws(problem, fit, content.origin.provenance.seed or 0)
        effects = files.patch_effects(named_effects(problem, fit), draws)
        content = replace(content, intervals=[effect.intervals for effect in effects])
        patch = files.StoredPatch(
            verdict=verdict.kind,
            sentence=verdict.sentence,
            effects=effects,
            channels=files.fmu_outputs(investigation.campaign.channels),
            parameters=verdict.parameters,
            origin=content.origin,
        )
        files.write_patch(patch_file, patch)
    if verdict.kind is VerdictKind.NAMED and content.pack is not None:
        content = replace(content, fmu=content.pack(patch_file, folder / FMU_NAME))
    return content
