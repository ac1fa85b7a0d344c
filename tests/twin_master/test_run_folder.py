"""The run folder: one process holds it, a killed replacement loses nothing, leftovers go and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from reporting.folders import restore_folder
from twin_master.errors import NotResumableError, RunFolderError, RunFolderExistsError
from twin_master.run_folder import (
    FIELD_NAME,
    KIND,
    create_run_folder,
    is_run_folder,
    lock_run_folder,
    read_config,
    tidy,
)
from twin_master.store.writing import finished_run


def make(folder: Path, name: str, *, replace: bool = False) -> None:
    os.close(create_run_folder(folder, {"kind": KIND, "name": name}, replace=replace))


def test_a_run_that_flies_is_not_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    lock = create_run_folder(folder, {"kind": KIND, "name": "first"})
    with pytest.raises(RunFolderError, match="another process is flying"):
        make(folder, "second", replace=True)
    with pytest.raises(RunFolderError, match="another process is flying"):
        lock_run_folder(folder)
    assert "first" in (folder / "config.json").read_text(encoding="utf-8")
    os.close(lock)
    make(folder, "second", replace=True)
    assert "second" in (folder / "config.json").read_text(encoding="utf-8")
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("moves", [1, 2, 3])
def test_a_kill_between_the_moves_of_a_replacement_loses_no_run(tmp_path: Path, moves: int) -> None:
    folder = tmp_path / "run[1]"
    make(folder, "first")
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    script = f"""
import os, signal
from pathlib import Path
from twin_master.run_folder import create_run_folder
rename, count = Path.rename, 0
def renamed(self, target):
    global count
    result = rename(self, target)
    count += 1
    if count == {moves}:
        os.kill(os.getpid(), signal.SIGKILL)
    return result
Path.rename = renamed
create_run_folder(Path({str(folder)!r}), {{"kind": {KIND!r}, "name": "second"}}, replace=True)
"""
    ended = subprocess.run([sys.executable, "-c", script], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert restore_folder(folder) is (moves == 1)
    kept = "first" if moves == 1 else "second"
    assert kept in (folder / "config.json").read_text(encoding="utf-8")
    assert (folder / "notes.txt").exists() is (moves == 1)
    assert not list(tmp_path.glob(".*.replaced-*"))
    assert restore_folder(folder) is False


def test_a_folder_that_is_being_replaced_is_not_put_back(tmp_path: Path) -> None:
    aside = tmp_path / ".run.old-x" / "run"
    make(aside, "first")
    lock = lock_run_folder(aside)
    assert restore_folder(tmp_path / "run") is False
    os.close(lock)
    assert restore_folder(tmp_path / "run") is True
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_what_killed_writers_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    half_field = tmp_path / f".{FIELD_NAME}.ab12"
    half_field.mkdir()
    (half_field / "wing.vtu").write_bytes(b"half")
    (tmp_path / f".{FIELD_NAME}.cd34").write_bytes(b"half")
    (tmp_path / FIELD_NAME).write_bytes(b"whole")
    (tmp_path / ".mine").write_bytes(b"mine")
    (tmp_path / "csv").mkdir()
    tidy(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".mine", "csv", FIELD_NAME]
    tidy(tmp_path)


DEEP = '{"a":' * 5000 + "1" + "}" * 5000


@pytest.mark.parametrize("text", [DEEP, "[1]", "", '{"kind": NaN}', '{"kind": ' + "1" * 5000 + "}"])
def test_a_configuration_that_cannot_be_read_is_that_of_no_run(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.json").write_text(text, encoding="utf-8")
    assert not is_run_folder(tmp_path)
    with pytest.raises(NotResumableError, match="is no run folder"):
        read_config(tmp_path)
    with pytest.raises(RunFolderExistsError, match="not touched"):
        make(tmp_path, "second", replace=True)


@pytest.mark.parametrize("name", ["timing.json", "summary.json"])
def test_a_run_whose_results_cannot_be_read_is_not_finished(tmp_path: Path, name: str) -> None:
    for file in ("timing.json", "summary.json"):
        (tmp_path / file).write_text(DEEP if file == name else "{}", encoding="utf-8")
    assert finished_run(tmp_path) is None
