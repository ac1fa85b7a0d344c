"""Files are whole or not there."""

import errno
import os
import stat
import subprocess
import sys
import time

import pytest

from reporting import files
from reporting.errors import DiskFullError, FileNotWrittenError
from tests.refusals import refused


def test_bytes_and_text_arrive_and_nothing_else_is_left(tmp_path):
    """With the permissions of the umask; a link is followed."""
    target = tmp_path / "new" / "data.bin"
    previous = os.umask(0o027)
    try:
        assert files.atomic_write_bytes(target, b"\x00first") == target
    finally:
        os.umask(previous)
    assert stat.S_IMODE(target.stat().st_mode) == 0o640
    (tmp_path / "link").symlink_to(target)
    files.atomic_write_bytes(tmp_path / "link", b"second")
    assert (tmp_path / "link").is_symlink()
    assert target.read_bytes() == b"second"
    files.atomic_write_text(tmp_path / "text.csv", "ä\nb\r\n")
    assert (tmp_path / "text.csv").read_bytes() == "ä\nb\r\n".encode()
    assert [path.name for path in target.parent.iterdir()] == ["data.bin"]


@pytest.mark.parametrize(
    ("number", "expected", "words"),
    [
        (errno.ENOSPC, DiskFullError, "No space is left"),
        (errno.EDQUOT, DiskFullError, "No space is left"),
        (errno.EACCES, FileNotWrittenError, "not permitted"),
        (errno.EROFS, FileNotWrittenError, "not permitted"),
        (errno.EIO, FileNotWrittenError, "could not be written"),
    ],
)
def test_a_failing_disk_gives_one_sentence_and_keeps_the_old_file(
    tmp_path, monkeypatch, number, expected, words
):
    target = tmp_path / "data"
    files.atomic_write_bytes(target, b"old")

    def fail(descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    with refused(expected, words) as caught:
        files.atomic_write_bytes(target, b"new")
    assert str(target) in str(caught.value)
    with pytest.raises(KeyError), files.atomic_file(target):
        raise KeyError("writer failed")
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_folders_and_devices_are_never_replaced(tmp_path):
    with pytest.raises(FileNotWrittenError, match="a folder"):
        files.atomic_write_bytes(tmp_path, b"x")
    with pytest.raises(FileNotWrittenError, match="not an ordinary file"):
        files.atomic_write_bytes(os.devnull, b"x")
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(FileNotWrittenError):
        files.atomic_write_bytes(tmp_path / "file" / "below", b"x")


def test_a_kill_at_any_moment_leaves_a_whole_file(tmp_path):
    target = tmp_path / "state"
    script = (
        "import sys; from reporting.files import atomic_write_bytes\n"
        "number = 0\n"
        "while True:\n"
        "    atomic_write_bytes(sys.argv[1], bytes([number % 256]) * 200_000); number += 1\n"
    )
    for delay in (0.0, 0.013, 0.031):
        process = subprocess.Popen([sys.executable, "-c", script, str(target)])
        while not target.exists():
            time.sleep(0.01)
        time.sleep(delay)
        process.kill()
        process.wait()
        content = target.read_bytes()
        assert len(content) == 200_000
        assert len(set(content)) == 1
        files.remove_leftovers(tmp_path)
        assert list(tmp_path.iterdir()) == [target]
        target.unlink()
    (tmp_path / f".run.1-0{files.TEMPORARY_SUFFIX}.nc").write_bytes(b"half")
    (tmp_path / ".hidden").write_bytes(b"mine")
    assert files.remove_leftovers(tmp_path) == 1
    assert [path.name for path in tmp_path.iterdir()] == [".hidden"]
