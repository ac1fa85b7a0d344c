"""The folder of a verdict: a killed replacement loses nothing."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from discrepancy.errors import VerdictFileError
from discrepancy.files.verdict import read_verdict as read_verdict_folder
from discrepancy.verdict_folder import check_folder
from reporting.errors import FileNotWrittenError
from reporting.folders import lock_folder

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
def replaced(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Replaced]:
    """What replaces a verdict in a process that is killed after so many moves: how it ended, and said why.

    The processes are forks of one that has imported what they need.
    """
    said = tmp_path_factory.mktemp("said") / "error.txt"
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", SCRIPT], stdin=pipe, stdout=pipe, text=True) as server:
        asks, answers = server.stdin, server.stdout
        assert asks is not None
        assert answers is not None

        def replace(folder: Path, moves: int) -> tuple[int, str]:
            said.write_text("", encoding="utf-8")
            asks.write(f"{folder}\t{moves}\t{said}\n")
            asks.flush()
            return int(answers.readline()), said.read_text(encoding="utf-8")

        yield replace
        asks.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    place = tmp_path / "verdict"
    place.mkdir()
    (place / "verdict.json").write_text("first", encoding="utf-8")
    (place / "notes.txt").write_text("mine", encoding="utf-8")
    return place


@pytest.mark.parametrize("moves", [1, 2, 3])
def test_a_kill_between_the_moves_of_a_replacement_loses_no_verdict(
    replaced: Replaced, folder: Path, moves: int
) -> None:
    assert replaced(folder, moves)[0] == -signal.SIGKILL
    check_folder(folder, replace_it=True)
    kept = (folder / "verdict.json").read_text(encoding="utf-8")
    assert kept == ("first" if moves == 1 else "second")
    assert (folder / "notes.txt").exists() is (moves == 1)
    assert not list(folder.parent.glob(".*.replaced-*"))


def test_who_reads_finds_it_too(replaced: Replaced, folder: Path) -> None:
    replaced(folder, 1)
    assert not folder.exists()
    with pytest.raises(VerdictFileError, match="not valid JSON"):  # of the old verdict, which is a word
        read_verdict_folder(folder)
    assert (folder / "notes.txt").read_text(encoding="utf-8") == "mine"


def test_a_whole_replacement_leaves_one_folder_as_the_user_makes_them(
    replaced: Replaced, folder: Path
) -> None:
    assert replaced(folder, 0) == (0, "")
    assert [path.name for path in folder.parent.iterdir()] == ["verdict"]
    plain = folder.parent / "plain"
    plain.mkdir()
    assert stat.S_IMODE(folder.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


def test_a_folder_that_another_process_replaces_is_left_alone(replaced: Replaced, folder: Path) -> None:
    lock = lock_folder(folder)
    assert lock is not None
    _, said = replaced(folder, 0)
    os.close(lock)
    assert FileNotWrittenError.__name__ in said
    assert "another process is replacing" in said
    assert (folder / "verdict.json").read_text(encoding="utf-8") == "first"
    assert [path.name for path in folder.parent.iterdir()] == ["verdict"]
