"""What is built once: a wait for another process says so, and ends when that one does, or takes too long."""

import errno
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fe.reduction import built_once as module
from fe.reduction.built_once import built_once
from fe.runtime.errors import ReductionError

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


def test_a_wait_is_said_and_ends_with_what_the_other_made(path, other, caplog) -> None:
    process = other(2.0)
    begin = time.monotonic()
    found: list[str] = []
    waiting = threading.Thread(target=lambda: found.append(ours(path)))
    waiting.start()
    while not caplog.messages and time.monotonic() - begin < 2.0:
        time.sleep(0.02)
    assert caplog.messages == [f"Waiting for another process (number {process.pid}) that makes {path}."]
    waiting.join()
    assert found == ["theirs"]
    assert len(caplog.messages) == 1


def test_when_the_other_is_killed_it_is_made_here(path, other, caplog) -> None:
    process = other(60.0)
    threading.Timer(1.5, process.kill).start()
    begin = time.monotonic()
    assert ours(path) == "ours"
    assert time.monotonic() - begin < 20.0
    assert caplog.messages[1:] == [f"The other process has ended without leaving {path}; it is made here."]
    assert path.read_text() == "ours"


@pytest.mark.parametrize("known", [True, False])
def test_a_wait_has_an_end(path: Path, other: Start, monkeypatch, caplog, known: bool) -> None:
    """Also where the lock does not say whose it is."""
    process = other(60.0)
    if not known:
        os.truncate(path.with_suffix(".lock"), 0)
    monkeypatch.setattr(module, "_PAUSE", 0.02)
    monkeypatch.setattr(module, "_MOST_LOOKS", 15)
    named = rf"\(number {process.pid}\) .* if it hangs, end it first"
    with pytest.raises(ReductionError, match=named if known else "^Another process has been"):
        ours(path)
    assert not path.exists()
    assert process.poll() is None
    whose = f" (number {process.pid})" * known
    assert caplog.messages == [f"Waiting for another process{whose} that makes {path}."]


def test_a_full_disk_stops_no_build(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(handle: int, content: bytes, at: int) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwrite", full)
    assert ours(path) == "ours"
