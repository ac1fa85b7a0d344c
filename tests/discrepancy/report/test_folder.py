"""The folder of a verdict: whole or not there, the same bytes again, never lost when it is replaced."""

import os
import re
import signal
import stat
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from pathlib import Path

import pytest

from discrepancy.catalogue.library import library
from discrepancy.errors import VerdictFileError
from discrepancy.files.residuals import read_residuals
from discrepancy.files.verdict import read_patch
from discrepancy.files.verdict import read_verdict as read_verdict_folder
from discrepancy.files.verdict import read_verdict_file as read_verdict
from discrepancy.report.figures import ReportInput, report_figures
from discrepancy.report.page import render_report
from discrepancy.verdict import VerdictKind
from discrepancy.verdict_folder import check_folder, write_verdict_folder
from discrepancy.workflow import investigate
from reporting.errors import FileNotWrittenError
from reporting.figures import to_svg
from reporting.folders import lock_folder
from tests.discrepancy.rigs import ORIGIN, measured

SCRIPT = """
import os, signal, sys, traceback
from pathlib import Path
import discrepancy.verdict_folder as writer

def write(folder, content, *, report):
    (folder / "verdict.json").write_text("second", encoding="utf-8")

def replaced(folder, moves):
    rename, count = Path.rename, 0
    def renamed(self, target):
        nonlocal count
        result = rename(self, target)
        count += 1
        if count == moves:
            os.kill(os.getpid(), signal.SIGKILL)
        return result
    Path.rename = renamed
    writer.write_verdict_folder(folder, None, replace_it=True, report=False)

writer._write = write
for line in sys.stdin:
    folder, moves, said = line.rstrip("\\n").split("\\t")
    child = os.fork()
    if not child:
        status = 1
        try:
            replaced(Path(folder), int(moves))
            status = 0
        except BaseException:
            Path(said).write_text(traceback.format_exc(), encoding="utf-8")
        finally:
            os._exit(status)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""

Replaced = Callable[[Path, int], tuple[int, str]]


@pytest.fixture(scope="module")
def replaced(tmp_path_factory):
    """What replaces a verdict in a process that is killed after so many moves: how it ended, and said why.

    The processes are forks of one that has imported what they need.
    """
    said = tmp_path_factory.mktemp("said") / "error.txt"
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", SCRIPT], stdin=pipe, stdout=pipe, text=True) as server:
        asks, answers = server.stdin, server.stdout

        def replace(folder, moves):
            said.write_text("", encoding="utf-8")
            asks.write(f"{folder}\t{moves}\t{said}\n")
            asks.flush()
            return int(answers.readline()), said.read_text(encoding="utf-8")

        yield replace
        asks.close()


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "verdict"
    place.mkdir()
    (place / "verdict.json").write_text("first", encoding="utf-8")
    (place / "notes.txt").write_text("mine", encoding="utf-8")
    return place


@pytest.mark.parametrize("moves", [1, 2, 3])
def test_a_kill_between_the_moves_of_a_replacement_loses_no_verdict(replaced, folder, moves):
    assert replaced(folder, moves)[0] == -signal.SIGKILL
    check_folder(folder, replace_it=True)
    kept = (folder / "verdict.json").read_text(encoding="utf-8")
    assert kept == ("first" if moves == 1 else "second")
    assert (folder / "notes.txt").exists() is (moves == 1)
    assert not list(folder.parent.glob(".*.replaced-*"))


def test_who_reads_finds_it_too(replaced, folder):
    replaced(folder, 1)
    assert not folder.exists()
    with pytest.raises(VerdictFileError, match="not valid JSON"):  # of the old verdict, which is a word
        read_verdict_folder(folder)
    assert (folder / "notes.txt").read_text(encoding="utf-8") == "mine"


def test_a_whole_replacement_leaves_one_folder_as_the_user_makes_them(replaced, folder):
    assert replaced(folder, 0) == (0, "")
    assert [path.name for path in folder.parent.iterdir()] == ["verdict"]
    plain = folder.parent / "plain"
    plain.mkdir()
    assert stat.S_IMODE(folder.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


def test_a_folder_that_another_process_replaces_is_left_alone(replaced, folder):
    lock = lock_folder(folder)
    assert lock is not None
    _, said = replaced(folder, 0)
    os.close(lock)
    assert FileNotWrittenError.__name__ in said
    assert "another process is replacing" in said
    assert (folder / "verdict.json").read_text(encoding="utf-8") == "first"
    assert [path.name for path in folder.parent.iterdir()] == ["verdict"]


# ---------------------------------------------------------------- the folder of a verdict


pytestmark = pytest.mark.xdist_group("verdict")  # one worker finds it


def test_the_folder_of_a_named_effect(drag, written):
    assert drag.verdict.kind is VerdictKind.NAMED
    folder = written
    page = next(folder.glob("*.html")).read_text(encoding="utf-8")
    assert "quadratic aerodynamic damping" in page
    assert "F = c |v| v" in page  # the equation of the catalogue
    assert page.count("<script>") == page.count("<script") == 1
    assert not re.search(r'(?:src|href)="(?!#|data:)', page)  # self-contained
    assert str(folder.parent) not in page
    for title in ("Verdict", "Where the gap is", "Proof on held-out trials", "What this campaign can decide"):
        assert f">{title}<" in page
    assert len(set(re.findall(r'\bid="([^"]+)"', page))) == len(re.findall(r'\bid="([^"]+)"', page))
    stored = read_verdict(folder / "verdict.json")
    assert stored.verdict.sentence == drag.verdict.sentence
    patch = read_patch(folder / "patch.json")
    assert patch.patch == drag.verdict.effects[0].patch
    assert patch.verdict is VerdictKind.NAMED
    row = patch.effects[0].intervals[0]
    assert row.low < row.value < row.high
    residuals = read_residuals(folder / "residuals.nc")
    assert len(residuals.trials) == len(drag.campaign.trials)
    pictures = {path.name for path in (folder / "figures").iterdir()}
    assert {"history.svg", "history.png", "missing_force.svg", "backbone.svg", "separability.png"} <= pictures
    assert not list(folder.parent.glob(".*"))  # nothing half-written is left


def test_a_report_repeats_bit_for_bit(drag, able, written):
    effects = read_patch(written / "patch.json").effects
    content = ReportInput(drag, ORIGIN, able, intervals=[effect.intervals for effect in effects])
    figures = report_figures(content)
    page = render_report(content, {name: to_svg(item.figure) for name, item in figures.items()}, figures)
    assert page == next(written.glob("*.html")).read_text(encoding="utf-8")


def test_a_null_has_no_patch_and_no_model_after(tmp_path):
    campaign, model = measured(kind="static")
    found = investigate(campaign, model, library())
    assert found.verdict.kind is VerdictKind.NOTHING_MISSING
    report = write_verdict_folder(tmp_path / "v", ReportInput(found, ORIGIN))
    assert not (tmp_path / "v" / "patch.json").exists()
    page = report.read_text(encoding="utf-8")
    assert "with the effect" not in page
    assert "nothing is missing" in page


def test_faults_of_the_data_are_reported_and_nothing_else(tmp_path):
    campaign, model = measured(kind="static")
    wrong = tuple(replace(trial, values=1e6 * trial.values) for trial in campaign.trials)
    found = investigate(replace(campaign, trials=wrong), model, library())
    assert found.verdict.kind is VerdictKind.DATA_ERROR
    report = write_verdict_folder(tmp_path / "v", ReportInput(found, ORIGIN))
    page = report.read_text(encoding="utf-8")
    assert found.verdict.sentence.split(",")[0] in unescape(page)
    assert "Proof" not in page
    assert sorted(path.name for path in (tmp_path / "v").iterdir()) == ["report.html", "verdict.json"]


def test_a_folder_is_replaced_on_demand_only_and_only_if_it_is_a_verdict(tmp_path):
    campaign, model = measured(kind="static")
    content = ReportInput(investigate(campaign, model, library()), ORIGIN)
    folder = tmp_path / "v"
    write_verdict_folder(folder, content)
    (folder / "stray.txt").write_text("x", encoding="utf-8")
    with pytest.raises(FileNotWrittenError, match="--replace"):
        write_verdict_folder(folder, content)
    write_verdict_folder(folder, content, replace_it=True)
    assert not (folder / "stray.txt").exists()
    other = tmp_path / "thesis"
    other.mkdir()
    (other / "chapter.tex").write_text("x", encoding="utf-8")
    with pytest.raises(FileNotWrittenError, match="not touched"):
        check_folder(other, replace_it=True)
    with pytest.raises(FileNotWrittenError, match="no folder"):
        check_folder(other / "chapter.tex", replace_it=True)


def test_a_failure_while_writing_leaves_the_old_folder(drag, tmp_path, monkeypatch):
    folder = tmp_path / "v"
    folder.mkdir()
    (folder / "verdict.json").write_text("old", encoding="utf-8")

    def refuse(patch, target):
        raise OSError(28, "No space left on device")

    with pytest.raises(FileNotWrittenError, match="No space"):
        write_verdict_folder(folder, ReportInput(drag, ORIGIN, pack=refuse), replace_it=True)
    assert (folder / "verdict.json").read_text(encoding="utf-8") == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["v"]
