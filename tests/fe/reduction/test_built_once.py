"""What is built once: a wait for another process says so, and ends when that one does."""

import errno
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fe.reduction.built_once import built_once

BUILDER = """
import sys, time
from pathlib import Path
from fe.reduction.built_once import built_once

path, seconds = Path(sys.argv[1]), float(sys.argv[2])

def build():
    print("building", flush=True)
    time.sleep(seconds)
    return "theirs"

built_once(path, path.read_text, build, path.write_text)
"""

Start = Callable[[float], "subprocess.Popen[str]"]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cache" / "model.npz"


@pytest.fixture
def other(path: Path) -> Iterator[Start]:
    """Start a process that builds, and return it when it has begun."""
    started: list[subprocess.Popen[str]] = []

    def start(seconds: float) -> subprocess.Popen[str]:
        words = [sys.executable, "-c", BUILDER, str(path), str(seconds)]
        process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "building\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


def ours(path: Path) -> str:
    return built_once(path, path.read_text, lambda: "ours", path.write_text)


@pytest.mark.parametrize(("seconds", "killed", "wanted"), [(2.0, False, "theirs"), (60.0, True, "ours")])
def test_a_wait_is_said_and_ends_with_the_other(path, other, caplog, seconds, killed, wanted) -> None:
    """With what it made, or, where it was killed, with what is made here."""
    process = other(seconds)
    if killed:
        threading.Timer(1.0, process.kill).start()
    begin = time.monotonic()
    assert ours(path) == path.read_text() == wanted
    assert time.monotonic() - begin < 20.0
    assert caplog.messages == [f"Waiting for another process (number {process.pid}) that makes {path}."]


def test_a_full_disk_stops_no_build(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(handle: int, content: bytes, at: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", full)
    assert ours(path) == "ours"
