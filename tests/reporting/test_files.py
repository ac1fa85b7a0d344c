"""Files are whole or not there; NetCDF is written for xarray without it, and read whatever HDF5 does.

Provenance names what made a result and nothing else; records as plain data; what is kept in memory.
"""

import errno
import gc
import json
import math
import os
import pickle
import socket
import stat
import subprocess
import sys
import time
import warnings
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from reporting import files, netcdf, provenance
from reporting.errors import DamagedFileError, DiskFullError, FileNotWrittenError
from reporting.json_file import plain
from reporting.memory import ResultCache
from reporting.netcdf import NetcdfGroup, Variable, read_groups, write_groups
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


# ---------------------------------------------------------------- NetCDF

SIZES = {"step": 4, "sensor": 3, "state": 2, "empty": 0}
_TYPES = ("f8", "f4", "i8", "i1", "U5")
_NAMES = st.text("abcxyz", min_size=1, max_size=6).map("v_{}".format)


@st.composite
def variables(draw: st.DrawFn, axes: tuple[str, ...]) -> Variable:
    """Draw a variable of some axes."""
    values = np.arange(np.prod([SIZES[axis] for axis in axes], dtype=int)) * draw(st.integers(1, 5))
    shaped = values.reshape([SIZES[axis] for axis in axes]).astype(draw(st.sampled_from(_TYPES)))
    attrs = {"units": "1", "long_name": draw(st.text("abc äµ", max_size=9))}
    return Variable(axes, shaped, attrs)


@st.composite
def group(draw: st.DrawFn) -> NetcdfGroup:
    """Draw a group: some axes have labels, others have coordinates beside them."""
    axes = st.lists(st.sampled_from(list(SIZES)), unique=True, max_size=3).map(tuple)
    told = draw(st.dictionaries(_NAMES, axes.flatmap(variables), min_size=1, max_size=4))
    used = {axis for variable in told.values() for axis in variable.dims}
    coords = {axis: draw(variables((axis,))) for axis in sorted(used) if draw(st.booleans())}
    beside = {f"w_{axis}": draw(variables((axis,))) for axis in sorted(used) if draw(st.booleans())}
    return NetcdfGroup(told, {**coords, **beside}, {"parameter": "e"} if draw(st.booleans()) else {})


@settings(max_examples=10)
@given(groups=st.dictionaries(st.sampled_from(["one", "two", "three/inner"]), group(), min_size=1))
def test_xarray_and_we_read_what_was_written(groups, tmp_path_factory):
    """To the last bit; and what is written twice has equal bytes."""
    file, again = (tmp_path_factory.mktemp("groups") / "file.nc" for _ in range(2))
    attrs = {"title": "a tree", "seed": 7}
    write_groups(file, groups, attrs)
    write_groups(again, groups, attrs)
    assert file.read_bytes() == again.read_bytes()
    sets = {name: xr.Dataset(one.variables, one.coords, one.attrs) for name, one in groups.items()}
    expected = xr.DataTree.from_dict({"/": xr.Dataset(attrs=attrs), **sets})
    with xr.open_datatree(file, engine="h5netcdf") as tree:
        read = tree.load()
    for found in (read, read_groups(file)):
        xr.testing.assert_identical(found, expected)
        for name, one in groups.items():
            for key, variable in {**one.variables, **one.coords}.items():
                values = found[name][key].values
                assert variable.values.dtype.kind == "U" or values.dtype == variable.values.dtype
                assert variable.values.dtype.kind == "U" or values.tobytes() == variable.values.tobytes()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    begin = Variable(("trial",), np.array([0.0, 1.0]), {"units": "hours since 2020-01-01"})
    write_groups(tmp_path / "a.nc", {"a": NetcdfGroup({"begin": begin}, {})}, {"schema": "outer"})
    return tmp_path / "a.nc"


@pytest.mark.parametrize("content", [b"", b"text", b"\x89HDF\r\n\x1a\n", b"CDF\x01" + bytes(40)])
def test_what_is_no_netcdf_is_one_sentence(tmp_path, content):
    with pytest.raises(DamagedFileError, match="there is no file"):
        read_groups(tmp_path / "a.nc")
    (tmp_path / "a.nc").write_bytes(content)
    with refused(DamagedFileError, r"a\.nc is damaged or no NetCDF file \(.+\)$"):
        read_groups(tmp_path / "a.nc")


def spin(path: Path) -> object:
    while True:
        pass


READINGS = {
    "spin": spin,
    "wait": lambda _: time.sleep(1000.0),
    "crash": lambda _: os.abort(),
    "fill": lambda _: {"a": xr.Dataset({"a": ("row", np.zeros(10**9, dtype=np.uint8))})},
    "refuse": lambda _: {}["a\nb"],
}


@pytest.mark.parametrize("reading", READINGS.values(), ids=READINGS)
def test_no_end_a_crash_and_a_full_memory_are_one_sentence(path, monkeypatch, capfd, reading):
    fork, readers = os.fork, []

    def forked() -> int:
        readers.append(fork())
        return readers[-1]

    monkeypatch.setattr(os, "fork", forked)
    monkeypatch.setattr(netcdf, "SECONDS", 1)
    monkeypatch.setattr(netcdf, "WAITING", 2)
    monkeypatch.setattr(netcdf, "_read_groups", reading)
    with refused(DamagedFileError, "HDF5 breaks down over it"):
        read_groups(path)
    assert capfd.readouterr() == ("", "")
    with pytest.raises(ProcessLookupError):
        os.kill(readers[0], 0)


def test_what_is_read_is_in_memory_and_no_finalizer_of_this_process_runs_in_the_reader(
    path, tmp_path, monkeypatch
):
    """A worker of an FMU must not be ended by a fork that collects the garbage of its parent.

    A warning of threads, as newer Pythons give at a fork, is no error.
    """
    told, fork = tmp_path / "told", os.fork

    class Ended:
        def __del__(self) -> None:
            with told.open("a") as file:
                file.write(f"{os.getpid()} ")

    def warned() -> int:
        warnings.warn("multi-threaded, use of fork() may lead to deadlocks", DeprecationWarning, stacklevel=2)
        return fork()

    monkeypatch.setattr(os, "fork", warned)
    gc.collect()
    one = Ended()
    one.itself = one  # type: ignore[attr-defined]
    del one
    gc.disable()
    try:
        found = read_groups(path)
    finally:
        gc.enable()
    gc.collect()
    assert told.read_text().split() == [str(os.getpid())]
    assert found.attrs["schema"] == "outer"
    assert found["a/begin"].dtype == np.float64  # as it is stored
    found["a/begin"].values[0] = 1.0  # as any array in memory


def test_the_fork_holds_no_file_of_this_process(path, monkeypatch):
    """Or the lock of a run folder would outlive a process that is killed while a file is read."""
    monkeypatch.setattr(
        netcdf, "_read_groups", lambda path: " ".join(found.name for found in Path("/proc/self/fd").iterdir())
    )
    with path.open("rb") as held:
        with pytest.raises(DamagedFileError) as raised:
            read_groups(path)
        number = str(held.fileno())
    listed = str(raised.value).partition("(")[2].rstrip(")").split()
    assert {"0", "1", "2"} < set(listed)
    assert number not in listed
    assert len(listed) <= 6  # the pipe, the null device beside its place as 2, and this listing


# ---------------------------------------------------------------- provenance, plain data, memory


def test_a_record_names_versions_and_sources_and_no_machine():
    def collected(**hashes: str) -> provenance.Provenance:
        names = ["numpy", "no-such-distribution"]
        return provenance.collect_provenance(7, input_hashes=hashes, distributions=names)

    record = collected(z="1", a="2")
    assert record == collected(a="2", z="1")
    told = record.as_dict()
    python = told["versions"].pop("python")
    assert python.count(".") == 2
    assert told["versions"] == {"numpy": np.__version__, "no-such-distribution": "not installed"}
    assert (told["seed"], list(told["input_hashes"])) == (7, ["a", "z"])
    assert {len(value) for value in told["source_hashes"].values()} == {64}
    assert len({*told["source_hashes"].values()}) == len(provenance.SOURCE_PACKAGES)
    assert "/" not in json.dumps(told)
    assert socket.gethostname() not in json.dumps(told)
    with pytest.raises(ValueError, match="no package"):
        provenance.source_hash("no_such_package")


def test_hashes_see_names_and_contents_but_neither_line_ends_nor_order(tmp_path):
    def hashed(**contents: bytes) -> str:
        for path in tmp_path.iterdir():
            path.unlink()
        for name, content in contents.items():
            (tmp_path / f"{name}.py").write_bytes(content)
        (tmp_path / "ignored.pyc").write_bytes(b"cache")
        return files.hash_tree(tmp_path, suffixes=[".py"])

    reference = hashed(a=b"x\n", b=b"y\n")
    assert reference == hashed(b=b"y\n", a=b"x\r\n")
    assert reference != hashed(a=b"x\n", c=b"y\n")
    assert reference != hashed(a=b"x\ny\n", b=b"")
    assert hashed(a=b"x", b=b"y") != hashed(a=b"xy", b=b"")
    one, other = {"a": 1, "b": [1.5, "µ"]}, {"b": [1.5, "µ"], "a": 1}
    assert files.hash_record(one) == files.hash_record(other)
    with pytest.raises(ValueError, match=r"[Oo]ut of range|not JSON"):
        files.hash_record({"a": float("nan")})


@dataclass(frozen=True, eq=False)
class Record:
    value: float
    inner: "tuple[Record, ...]" = ()
    words: tuple[str, ...] = ("x",)
    values: NDArray[np.float64] | None = None


def test_a_record_is_plain_data_of_json():
    record = Record(math.nan, (Record(0.1), Record(2)), values=np.array([0.1, 2.0]))
    own = {"inner": [], "words": ["x"], "values": None}
    expected = {"value": None, "inner": [{"value": 0.1} | own, {"value": 2} | own], "words": ["x"]}
    assert json.loads(json.dumps(plain(record), allow_nan=False)) == expected | {"values": [0.1, 2.0]}
    assert plain({7: HTTPStatus.NOT_FOUND}) == {"7": 404}


def test_the_least_recently_used_are_forgotten_where_there_is_no_room():
    ended = list[str]()
    kept = ResultCache(6, weight=len, end=ended.append)
    for text in ("one", "two", "one", "four"):  # seven letters do not fit
        assert kept.get(text, lambda text=text: text) == text
    assert ended == ["two", "one"]
    kept.get("a", lambda: "a")
    assert kept.get("four", lambda: "made anew") == "four"
    assert (
        pickle.loads(pickle.dumps(kept)).get("a", lambda: "anew") == "anew"
    )  # another process is handed nothing
    kept.clear()
    assert ended == ["two", "one", "a", "four"]
