"""What is built once: a wait for another process says so, and ends when that one does."""

import errno
import multiprocessing
import os
from pathlib import Path
from threading import Timer
from typing import Any

import pytest

from fe.reduction.built_once import built_once


def ours(path: Path) -> str:
    return built_once(path, path.read_text, lambda: "ours", path.write_text)


def theirs(path: Path, began: Any, finish: Any) -> None:
    """Build in another process, until that is told."""

    def build() -> str:
        began.set()
        finish.wait(60.0)
        return "theirs"

    built_once(path, path.read_text, build, path.write_text)


@pytest.mark.parametrize("killed", [False, True])
def test_a_wait_is_said_and_ends_with_the_other(tmp_path: Path, caplog, killed: bool) -> None:
    """With what it made, or, where it was killed, with what is made here."""
    path, context = tmp_path / "cache" / "model.npz", multiprocessing.get_context("spawn")
    began, finish = context.Event(), context.Event()
    other = context.Process(target=theirs, args=(path, began, finish), daemon=True)
    other.start()
    assert began.wait(60.0)
    Timer(0.3, other.kill if killed else finish.set).start()
    assert ours(path) == path.read_text() == ("ours" if killed else "theirs")
    assert caplog.messages == [f"Waiting for another process (number {other.pid}) that makes {path}."]
    other.join(60.0)


def test_a_full_disk_stops_no_build(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(handle: int, content: bytes, at: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", full)
    assert ours(tmp_path / "model.npz") == "ours"
