"""What operating systems lack: each substitute does the same, or says once what is weaker."""

import io
import logging
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from reporting.system import operating_system
from reporting.system.operating_system import (
    can_fork,
    is_lock_of,
    lock_descriptor,
    lock_folder,
    pieces_read_by_thread,
    polled_pieces,
    read_at,
    usable_processors,
)

FCNTL = pytest.importorskip("fcntl")  # hidden from the package in some of these tests
OTHER_PROCESS = """
import sys
from pathlib import Path
if sys.argv[1] == "bytes":
    from tests.reporting.test_operating_system import stand_in_for_windows
    stand_in_for_windows()
from reporting.system.operating_system import lock_folder
print(lock_folder(Path(sys.argv[2])) is not None)
"""


def lock_byte(descriptor: int, mode: int, count: int) -> None:
    """Lock bytes at the position of a file, as `msvcrt.locking` does, by record locks of POSIX."""
    position = os.lseek(descriptor, 0, os.SEEK_CUR)
    FCNTL.lockf(descriptor, FCNTL.LOCK_EX | FCNTL.LOCK_NB, count, position)


def stand_in_for_windows() -> None:
    """Hide the locks of POSIX from the package, and give it the function that Windows has."""
    sys.modules["msvcrt"] = SimpleNamespace(locking=lock_byte, LK_LOCK=1, LK_NBLCK=2)  # type: ignore[assignment]
    sys.modules["fcntl"] = None  # type: ignore[assignment]


@pytest.fixture(params=["folders", "bytes"])
def kind_of_lock(request: pytest.FixtureRequest, monkeypatch, tmp_path) -> str:
    """Locks on folders as POSIX has them, and locks on a byte of a file as Windows has."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    if request.param == "bytes":
        monkeypatch.setitem(
            sys.modules, "msvcrt", SimpleNamespace(locking=lock_byte, LK_LOCK=1, LK_NBLCK=2)
        )
        monkeypatch.setitem(sys.modules, "fcntl", None)
    return request.param


def other_process_locks(folder: Path, kind: str) -> bool:
    """Return whether another process can lock a folder."""
    words = [sys.executable, "-c", OTHER_PROCESS, kind, str(folder)]
    return (
        subprocess.run(words, capture_output=True, text=True, check=True).stdout.strip() == "True"
    )


def test_a_locked_folder_is_refused_to_another_process_until_the_lock_is_closed(
    kind_of_lock, tmp_path
):
    folder = tmp_path / "run"
    folder.mkdir()
    lock = lock_folder(folder)
    assert lock is not None
    assert not other_process_locks(folder, kind_of_lock)
    os.close(lock)
    assert other_process_locks(folder, kind_of_lock)


def test_a_lock_stays_with_a_folder_that_is_renamed(kind_of_lock, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    lock = lock_folder(folder)
    moved = folder.rename(tmp_path / "moved")
    folder.mkdir()
    assert is_lock_of(lock, moved)
    assert not is_lock_of(lock, folder)
    assert not other_process_locks(moved, kind_of_lock)
    os.close(lock)


def test_without_any_lock_this_is_said_once(monkeypatch, tmp_path, caplog):
    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setattr(operating_system, "_reported_weaknesses", set())
    with (tmp_path / "file").open("wb") as file, caplog.at_level(logging.WARNING, "uav_twin"):
        lock_descriptor(file.fileno(), wait=False)
        lock_descriptor(file.fileno(), wait=True)
    (record,) = caplog.records
    assert "two processes that write into the same folder are not kept apart" in record.message


@pytest.mark.parametrize("has_pread", [True, False])
def test_bytes_are_read_at_a_position_without_moving_the_file(monkeypatch, tmp_path, has_pread):
    path = tmp_path / "file"
    path.write_bytes(b"0123456789")
    if not has_pread:
        monkeypatch.delattr(os, "pread")
    with path.open("rb", buffering=0) as file:
        file.seek(7)
        assert read_at(file.fileno(), 3, 2) == b"234"
        assert file.read() == b"789"


def test_all_processors_count_where_no_limit_is_stated(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity")
    assert usable_processors() == os.cpu_count()


def test_a_system_without_fork_says_once_that_files_are_read_without_limits(monkeypatch, caplog):
    monkeypatch.delattr(os, "fork")
    monkeypatch.setattr(operating_system, "_reported_weaknesses", set())
    with caplog.at_level(logging.WARNING, "uav_twin"):
        assert not can_fork()
        assert not can_fork()
    assert len(caplog.records) == 1


@pytest.mark.parametrize("read", [polled_pieces, pieces_read_by_thread])
def test_a_pipe_is_polled_to_its_end(read):
    """Nothing comes at first; then all bytes come in their order."""
    reading_end, writing_end = os.pipe()
    with os.fdopen(reading_end, "rb") as stream:
        pieces = read(stream, 100)
        assert next(pieces) is None
        os.write(writing_end, b"a\nb")
        os.write(writing_end, b"\nc\n")
        os.close(writing_end)
        came = b""
        for piece in pieces:
            came += piece or b""
            time.sleep(0.0 if piece else 0.001)
    assert came == b"a\nb\nc\n"


def test_an_error_of_a_stream_that_a_thread_reads_is_raised_where_it_is_read():
    class Broken(io.BytesIO):
        def read1(self, size: int | None = -1, /) -> bytes:
            raise OSError("the device is gone")

    pieces = pieces_read_by_thread(Broken(), 100)
    with pytest.raises(OSError, match="the device is gone"):
        list(pieces)
