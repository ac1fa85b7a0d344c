"""Files are whole or not there; hashes of files and of records."""

import errno
import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from reporting import files
from reporting.errors import DiskFullError, FileNotWrittenError
from reporting.folders import whole_folder
from tests.refusals import refused


def names_in(folder):
    return [path.name for path in folder.iterdir()]


# ---------------------------------------------------------------- writing


def test_bytes_arrive_in_a_new_folder_and_nothing_else_is_left(tmp_path):
    target = tmp_path / "new" / "data.bin"

    assert files.atomic_write_bytes(target, b"\x00first") == target

    assert target.read_bytes() == b"\x00first"
    assert names_in(target.parent) == ["data.bin"]


def test_a_file_has_the_permissions_of_the_umask(tmp_path):
    target = tmp_path / "data.bin"
    previous = os.umask(0o027)
    try:
        files.atomic_write_bytes(target, b"first")
    finally:
        os.umask(previous)

    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_a_link_is_followed(tmp_path):
    target = tmp_path / "data.bin"
    target.write_bytes(b"first")
    link = tmp_path / "link"
    link.symlink_to(target)

    files.atomic_write_bytes(link, b"second")

    assert link.is_symlink()
    assert target.read_bytes() == b"second"


def test_text_arrives_with_its_line_ends(tmp_path):
    files.atomic_write_text(tmp_path / "text.csv", "ä\nb\r\n")

    assert (tmp_path / "text.csv").read_bytes() == "ä\nb\r\n".encode()


# ---------------------------------------------------------------- writing that fails


@pytest.fixture
def old_file(tmp_path):
    return files.atomic_write_bytes(tmp_path / "data", b"old")


@pytest.mark.parametrize(
    ("number", "error", "sentence"),
    [
        (errno.ENOSPC, DiskFullError, "No space is left"),
        (errno.EDQUOT, DiskFullError, "No space is left"),
        (errno.EACCES, FileNotWrittenError, "not permitted"),
        (errno.EROFS, FileNotWrittenError, "not permitted"),
        (errno.EMFILE, FileNotWrittenError, "too many files are open: allow more by `ulimit -n`"),
        (errno.EIO, FileNotWrittenError, "could not be written"),
    ],
)
def test_a_failing_disk_gives_one_sentence_and_keeps_the_old_file(
    old_file, monkeypatch, number, error, sentence
):
    def fail(descriptor: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    with refused(error, sentence) as caught:
        files.atomic_write_bytes(old_file, b"new")

    assert str(old_file) in str(caught.value)
    assert old_file.read_bytes() == b"old"
    assert names_in(old_file.parent) == [old_file.name]


def test_an_address_is_not_taken_for_a_folder_of_this_machine(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with refused(FileNotWrittenError, "s3:/bucket/learnt.toml is an address"):
        files.atomic_write_bytes(Path("s3://bucket/learnt.toml"), b"new")
    with (
        refused(FileNotWrittenError, "s3:/bucket/run is an address"),
        whole_folder(Path("s3://bucket/run")),
    ):
        pass
    assert names_in(tmp_path) == []


def test_a_writer_that_fails_keeps_the_old_file(old_file):
    with pytest.raises(KeyError), files.atomic_file(old_file):
        raise KeyError("writer failed")

    assert old_file.read_bytes() == b"old"
    assert names_in(old_file.parent) == [old_file.name]


def test_a_folder_is_never_replaced(tmp_path):
    with pytest.raises(FileNotWrittenError, match="a folder"):
        files.atomic_write_bytes(tmp_path, b"x")


def test_a_device_is_never_replaced():
    with pytest.raises(FileNotWrittenError, match="not an ordinary file"):
        files.atomic_write_bytes(os.devnull, b"x")


def test_nothing_is_written_below_a_file(tmp_path):
    (tmp_path / "file").write_bytes(b"")

    with pytest.raises(FileNotWrittenError):
        files.atomic_write_bytes(tmp_path / "file" / "below", b"x")


WRITE_FOR_EVER = """
import sys
from reporting.files import atomic_write_bytes
number = 0
while True:
    atomic_write_bytes(sys.argv[1], bytes([number % 256]) * 200_000)
    number += 1
"""


@pytest.mark.parametrize("delay", [0.0, 0.013, 0.031])
def test_a_kill_at_any_moment_leaves_a_whole_file(tmp_path, delay):
    target = tmp_path / "state"
    process = subprocess.Popen([sys.executable, "-c", WRITE_FOR_EVER, str(target)])
    try:
        while not target.exists() and process.poll() is None:
            time.sleep(0.01)
        time.sleep(delay)
    finally:
        process.kill()
        process.wait()

    content = target.read_bytes()
    files.remove_leftovers(tmp_path)

    assert len(content) == 200_000
    assert len(set(content)) == 1
    assert list(tmp_path.iterdir()) == [target]


def test_leftovers_are_removed_and_other_hidden_files_stay(tmp_path):
    (tmp_path / f".run.1-0{files.TEMPORARY_SUFFIX}.nc").write_bytes(b"half")
    (tmp_path / ".hidden").write_bytes(b"mine")

    assert files.remove_leftovers(tmp_path) == 1

    assert names_in(tmp_path) == [".hidden"]


# ---------------------------------------------------------------- hashes


@pytest.fixture
def hash_sources(tmp_path_factory):
    """A function that hashes a folder of Python files, in which another file lies, too."""

    def hash_folder(**contents: bytes) -> str:
        folder = tmp_path_factory.mktemp("sources")
        for name, content in contents.items():
            (folder / f"{name}.py").write_bytes(content)
        (folder / "ignored.pyc").write_bytes(b"cache")
        return files.hash_tree(folder, suffixes=[".py"])

    return hash_folder


def test_the_hash_of_a_folder_sees_neither_line_ends_nor_order(hash_sources):
    assert hash_sources(a=b"x\n", b=b"y\n") == hash_sources(b=b"y\n", a=b"x\r\n")


def test_the_hash_of_a_folder_sees_names(hash_sources):
    assert hash_sources(a=b"x\n", b=b"y\n") != hash_sources(a=b"x\n", c=b"y\n")


@pytest.mark.parametrize("end", [b"", b"\n"])
def test_the_hash_of_a_folder_sees_where_a_file_ends(hash_sources, end):
    apart = hash_sources(a=b"x" + end, b=b"y" + end)

    assert apart != hash_sources(a=b"x" + end + b"y" + end, b=b"")


def test_the_hash_of_a_record_does_not_see_the_order_of_keys():
    record = {"a": 1, "b": [1.5, "µ"]}
    reordered = {"b": [1.5, "µ"], "a": 1}

    assert files.hash_record(record) == files.hash_record(reordered)


def test_a_record_that_is_no_json_has_no_hash():
    with pytest.raises(ValueError, match=r"[Oo]ut of range|not JSON"):
        files.hash_record({"a": float("nan")})
