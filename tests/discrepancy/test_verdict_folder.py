"""The folder of a verdict: a killed replacement loses nothing."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from discrepancy.errors import VerdictFileError
from discrepancy.files.verdict import read_verdict_folder
from discrepancy.verdict_folder import check_folder
from reporting.errors import FileNotWrittenError
from reporting.folders import lock_folder

SCRIPT = """
import os, signal, sys
from pathlib import Path
import discrepancy.verdict_folder as writer

def write(folder, content, *, report):
    (folder / "verdict.json").write_text("second", encoding="utf-8")

writer._write = write
rename, count = Path.rename, 0
def renamed(self, target):
    global count
    result = rename(self, target)
    count += 1
    if count == int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)
    return result
Path.rename = renamed
writer.write_verdict_folder(Path(sys.argv[1]), None, replace_it=True, report=False)
"""


def replaced(folder: Path, moves: int) -> subprocess.CompletedProcess[str]:
    """Replace a verdict in a process that is killed after so many moves."""
    arguments = [sys.executable, "-c", SCRIPT, str(folder), str(moves)]
    return subprocess.run(arguments, check=False, capture_output=True, text=True)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "verdict"
    place.mkdir()
    (place / "verdict.json").write_text("first", encoding="utf-8")
    (place / "notes.txt").write_text("mine", encoding="utf-8")
    return place


@pytest.mark.parametrize("moves", [1, 2, 3])
def test_a_kill_between_the_moves_of_a_replacement_loses_no_verdict(folder: Path, moves: int) -> None:
    assert replaced(folder, moves).returncode == -signal.SIGKILL
    check_folder(folder, replace_it=True)
    kept = (folder / "verdict.json").read_text(encoding="utf-8")
    assert kept == ("first" if moves == 1 else "second")
    assert (folder / "notes.txt").exists() is (moves == 1)
    assert not list(folder.parent.glob(".*.replaced-*"))


def test_who_reads_finds_it_too(folder: Path) -> None:
    replaced(folder, 1)
    assert not folder.exists()
    with pytest.raises(VerdictFileError, match="not valid JSON"):  # of the old verdict, which is a word
        read_verdict_folder(folder)
    assert (folder / "notes.txt").read_text(encoding="utf-8") == "mine"


def test_a_whole_replacement_leaves_one_folder_as_the_user_makes_them(folder: Path) -> None:
    assert replaced(folder, 0).returncode == 0
    assert [path.name for path in folder.parent.iterdir()] == ["verdict"]
    plain = folder.parent / "plain"
    plain.mkdir()
    assert stat.S_IMODE(folder.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


def test_a_folder_that_another_process_replaces_is_left_alone(folder: Path) -> None:
    lock = lock_folder(folder)
    assert lock is not None
    ended = replaced(folder, 0)
    os.close(lock)
    assert FileNotWrittenError.__name__ in ended.stderr
    assert "another process is replacing" in ended.stderr
    assert (folder / "verdict.json").read_text(encoding="utf-8") == "first"
    assert [path.name for path in folder.parent.iterdir()] == ["verdict"]
