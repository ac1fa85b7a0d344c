"""The folder of a verdict: whole or not there, the same bytes again, never lost when it is replaced."""

import os
import re
import stat
from contextlib import suppress

import pytest

from discrepancy.errors import VerdictFileError
from discrepancy.files.residuals import read_residuals
from discrepancy.files.verdict import read_patch
from discrepancy.files.verdict import read_verdict as read_verdict_folder
from discrepancy.files.verdict import read_verdict_file as read_verdict
from discrepancy.report.figures import ReportInput, report_figures
from discrepancy.report.page import render_report
from discrepancy.verdict import VerdictKind
from discrepancy.verdict_folder import check_verdict_folder, write_verdict_folder
from reporting.errors import FileNotWrittenError
from reporting.figures import to_svg
from reporting.folders import lock_folder
from reporting.words import listing
from tests.discrepancy.rigs import ORIGIN

pytestmark = pytest.mark.xdist_group("verdict")  # one worker finds it


def old_verdict(place):
    """Make a folder that looks like one of a verdict, with something of the user's in it."""
    place.mkdir(parents=True)
    (place / "verdict.json").write_text("first", encoding="utf-8")
    (place / "notes.txt").write_text("mine", encoding="utf-8")
    return place


def test_an_old_verdict_is_not_lost(drag, tmp_path):
    """Where writing fails, another process replaces it, or a killed one had moved it aside.

    How a kill between the moves leaves it is in test_workflow of twin_master.
    """
    folder = old_verdict(tmp_path / "v")

    def refuse(patch, target):
        raise OSError(28, "No space left on device")

    with pytest.raises(FileNotWrittenError, match="No space"):
        write_verdict_folder(folder, ReportInput(drag, ORIGIN, pack=refuse), replace_it=True, report=False)
    lock = lock_folder(folder)
    with pytest.raises(FileNotWrittenError, match="another process is replacing"):
        write_verdict_folder(folder, ReportInput(drag, ORIGIN), replace_it=True, report=False)
    os.close(lock)
    aside = tmp_path / ".v.old-x" / "v"
    for put_back in (
        lambda: check_verdict_folder(folder, replace_it=True),
        lambda: read_verdict_folder(folder),  # which is a word
    ):
        aside.parent.mkdir()
        folder.rename(aside)
        with suppress(VerdictFileError):
            put_back()
        assert (folder / "verdict.json").read_text(encoding="utf-8") == "first"
        assert (folder / "notes.txt").read_text(encoding="utf-8") == "mine"
        assert [path.name for path in tmp_path.iterdir()] == ["v"]
    # replaced on demand only, and nothing else ever
    other = tmp_path / "thesis"
    other.mkdir()
    with pytest.raises(FileNotWrittenError, match="--replace"):
        write_verdict_folder(folder, ReportInput(drag, ORIGIN), report=False)
    write_verdict_folder(folder, ReportInput(drag, ORIGIN), replace_it=True, report=False)
    assert not (folder / "notes.txt").exists()
    assert stat.S_IMODE(folder.stat().st_mode) == stat.S_IMODE(other.stat().st_mode)
    (other / "chapter.tex").write_text("x", encoding="utf-8")
    for place, words in ((other, "not touched"), (other / "chapter.tex", "no folder")):
        with pytest.raises(FileNotWrittenError, match=words):
            check_verdict_folder(place, replace_it=True)


def test_the_folder_of_a_named_effect(drag, able, tmp_path):
    written = tmp_path / "verdict"
    write_verdict_folder(written, ReportInput(drag, ORIGIN, able))
    assert drag.verdict.kind is VerdictKind.NAMED
    page = next(written.glob("*.html")).read_text(encoding="utf-8")
    assert "quadratic aerodynamic damping" in page
    assert "F = c |v| v" in page  # the equation of the catalogue
    assert page.count("<script>") == page.count("<script") == 1
    assert not re.search(r'(?:src|href)="(?!#|data:)', page)  # self-contained
    assert str(written.parent) not in page
    for title in ("Verdict", "Where the gap is", "Proof on held-out trials", "What this campaign can decide"):
        assert f">{title}<" in page
    identifiers = re.findall(r'\bid="([^"]+)"', page)
    assert len(set(identifiers)) == len(identifiers)
    assert read_verdict(written / "verdict.json").verdict.sentence == drag.verdict.sentence
    patch = read_patch(written / "patch.json")
    assert patch.patch == drag.verdict.effects[0].patch
    assert patch.verdict is VerdictKind.NAMED
    row = patch.effects[0].intervals[0]
    assert row.low < row.value < row.high
    assert len(read_residuals(written / "residuals.nc").trials) == len(drag.campaign.trials)
    pictures = {path.name for path in (written / "figures").iterdir()}
    assert {"history.svg", "history.png", "missing_force.svg", "backbone.svg", "separability.png"} <= pictures
    assert not list(written.parent.glob(".*"))  # nothing half-written is left
    # the report repeats bit for bit
    content = ReportInput(drag, ORIGIN, able, intervals=[effect.intervals for effect in patch.effects])
    figures = report_figures(content)
    held_out = listing(trial.name for trial in drag.campaign.held_out)
    assert f"Held out: {held_out};" in figures["residual_table"].caption
    again = render_report(content, {name: to_svg(item.figure) for name, item in figures.items()}, figures)
    assert again == page
