"""The folder that an investigation leaves: verdict, patch, residuals, figures, report; whole or not."""

import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from discrepancy.files.residuals import RESIDUALS_NAME, write_residuals
from discrepancy.files.verdict import (
    PATCH_NAME,
    PATCHED,
    VERDICT_NAME,
    StoredPatch,
    fmu_outputs,
    patch_effects,
    write_patch,
    write_verdict,
)
from discrepancy.judgement.conclusion import named_effects
from discrepancy.report.figures import ReportInput, report_figures
from discrepancy.report.page import render_report
from discrepancy.report.text import added_label
from discrepancy.self_calibration import SELF_CALIBRATION_NAME, write_self_calibration
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import patch_draws
from reporting.errors import FileNotWrittenError
from reporting.figures import save_figure
from reporting.files import atomic_write_text, write_error
from reporting.folders import fresh_folder, lock_folder, replace_folder, restore_folder

REPORT_NAME = "report.html"
FMU_NAME = "patched.fmu"
FIGURES = "figures"
Pack = Callable[[Path, Path], str]
"""(patch.json, FMU to be written) -> what to say about it."""


@dataclass(frozen=True)
class VerdictContent(ReportInput):
    """What is written: what the report shows, and more.

    Attributes
    ----------
    pack : callable, optional
        Makes the patched FMU; called where an effect is named.
    """

    pack: Pack | None = None


def check_folder(folder: Path, *, replace_it: bool) -> None:
    """Look at the place before the work begins; a verdict that a killed process had moved aside comes back.

    Raises
    ------
    FileNotWrittenError
        If it is no folder, holds something else than a verdict, or a verdict that is not to be replaced.
    """
    restore_folder(folder)
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise FileNotWrittenError(f"{folder} exists and is no folder: choose another --out.")
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    if not (folder / VERDICT_NAME).is_file():
        raise FileNotWrittenError(
            f"{folder} exists and holds no {VERDICT_NAME}, so it is not touched: choose another --out."
        )
    if not replace_it:
        raise FileNotWrittenError(
            f"{folder} holds a verdict already: choose another --out or give --replace."
        )


def write_verdict_folder(
    folder: Path, content: VerdictContent, *, replace_it: bool = False, report: bool = True
) -> Path:
    """Write everything beside the folder first, and move it into place when it is complete.

    Parameters
    ----------
    folder : Path
        Where; an empty folder is as good as none.
    content : VerdictContent
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
        As `check_folder`, or if the disk is full or the place not writable; the folder is as it was.
    """
    check_folder(folder, replace_it=replace_it)
    try:
        fresh = fresh_folder(folder)
        try:
            _write(fresh, content, report=report)
            _move(fresh, folder)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)
    except OSError as error:
        raise write_error(error, folder) from error
    return folder / REPORT_NAME if report else folder


def _move(fresh: Path, folder: Path) -> None:
    if not folder.is_dir():
        fresh.rename(folder)
        return
    held = lock_folder(folder)
    if held is None:
        raise FileNotWrittenError(f"another process is replacing {folder}: look at what it leaves.")
    try:
        replace_folder(fresh, folder)
    finally:
        os.close(held)


def _write(folder: Path, content: VerdictContent, *, report: bool) -> None:
    found, origin = content.investigation, content.origin
    verdict = found.verdict
    write_verdict(folder / VERDICT_NAME, verdict, found.proof, origin)
    if found.problem is not None and found.fit is not None and found.fit.candidate.terms:
        if verdict.kind in PATCHED:
            draws = patch_draws(found.problem, found.fit, origin.provenance.seed or 0)
            effects = patch_effects(named_effects(found.problem, found.fit), draws)
            content = replace(content, intervals=[effect.intervals for effect in effects])
            outputs = fmu_outputs(found.campaign.channels)
            patch = StoredPatch(verdict.kind, verdict.sentence, effects, outputs, verdict.parameters, origin)
            write_patch(folder / PATCH_NAME, patch)
        if verdict.kind is VerdictKind.NAMED and content.pack is not None:
            content = replace(content, fmu=content.pack(folder / PATCH_NAME, folder / FMU_NAME))
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
