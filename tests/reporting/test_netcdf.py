"""Reading NetCDF: all of a file, or one sentence, whatever HDF5 does about it."""

import gc
import os
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from reporting import netcdf
from reporting.errors import DamagedFileError
from reporting.netcdf import read_groups


def tree() -> xr.DataTree:
    first = xr.Dataset(
        {
            "strain": (("time", "gauge"), np.array([[1e-300, -0.0], [np.nan, 5e-324]]), {"units": "1"}),
            "count": ("time", np.array([1, 2], dtype=np.int8)),
            "mass": ((), 3.5),
        },
        coords={"time": ("time", [0.0, 1.0], {"units": "hours since 2020-01-01"}), "gauge": ["a", "µ"]},
        attrs={"title": "ä", "seed": 7},
    )
    inner = xr.Dataset({"x": ("row", np.arange(3))}, attrs={"schema": "inner"})
    return xr.DataTree.from_dict({"/": xr.Dataset(attrs={"schema": "outer"}), "a": first, "a/b": inner})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    tree().to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    return tmp_path / "a.nc"


def test_what_was_written_comes_back_to_the_last_bit(path):
    with xr.open_datatree(path, engine="h5netcdf", decode_times=False) as opened:
        plain = opened.load()
    found = read_groups(path)
    assert found.identical(plain)
    assert [node.path for node in found.subtree] == [node.path for node in plain.subtree]
    for node in plain.subtree:
        for name, variable in node.variables.items():
            other = found[node.path].variables[name]
            assert (other.dtype, other.values.tobytes()) == (variable.dtype, variable.values.tobytes())
    assert found["a"].to_dataset()["time"].dtype == np.float64
    found["a/strain"].values[0, 0] = 1.0  # as any array in memory


@pytest.mark.parametrize("content", [b"", b"text", b"\x89HDF\r\n\x1a\n", b"CDF\x01" + bytes(40)])
def test_what_is_no_netcdf_is_one_sentence(tmp_path, content):
    with pytest.raises(DamagedFileError, match="there is no file"):
        read_groups(tmp_path / "a.nc")
    (tmp_path / "a.nc").write_bytes(content)
    with pytest.raises(DamagedFileError, match=r"a\.nc is damaged or no NetCDF file \(.+\)$") as caught:
        read_groups(tmp_path / "a.nc")
    assert "\n" not in str(caught.value)


def spin(path: Path) -> object:
    while True:
        pass


def wait(path: Path) -> object:
    time.sleep(1000.0)
    return {}


def crash(path: Path) -> object:
    os.abort()


def fill(path: Path) -> object:
    return {"a": xr.Dataset({"a": ("row", np.zeros(10**9, dtype=np.uint8))})}


def refuse(path: Path) -> object:
    raise KeyError("a\nb")


@pytest.mark.parametrize("reading", [spin, wait, crash, fill, refuse])
def test_no_end_a_crash_and_a_full_memory_are_one_sentence(path, monkeypatch, capfd, reading):
    fork, readers = os.fork, []

    def forked() -> int:
        readers.append(fork())
        return readers[-1]

    monkeypatch.setattr(os, "fork", forked)
    monkeypatch.setattr(netcdf, "SECONDS", 1)
    monkeypatch.setattr(netcdf, "WAITING", 2)
    monkeypatch.setattr(netcdf, "_groups", reading)
    begin = time.perf_counter()
    with pytest.raises(DamagedFileError, match="HDF5 breaks down over it") as caught:
        read_groups(path)
    assert "\n" not in str(caught.value)
    assert time.perf_counter() - begin < 30.0
    assert capfd.readouterr() == ("", "")
    with pytest.raises(ProcessLookupError):
        os.kill(readers[0], 0)


def test_finalizers_of_this_process_do_not_run_in_the_reader(path, tmp_path):
    """A worker of an FMU must not be ended by a fork that collects the garbage of its parent."""
    told = tmp_path / "told"

    class Ended:
        def __del__(self) -> None:
            with told.open("a") as file:
                file.write(f"{os.getpid()} ")

    gc.collect()
    one = Ended()
    one.itself = one  # type: ignore[attr-defined]
    del one
    gc.disable()
    try:
        read_groups(path)
    finally:
        gc.enable()
    gc.collect()
    assert told.read_text().split() == [str(os.getpid())]


def test_a_warning_of_threads_is_no_error(path, monkeypatch):
    fork = os.fork

    def warned() -> int:
        warnings.warn("multi-threaded, use of fork() may lead to deadlocks", DeprecationWarning, stacklevel=2)
        return fork()

    monkeypatch.setattr(os, "fork", warned)
    assert read_groups(path).attrs["schema"] == "outer"


def test_the_fork_holds_no_file_of_this_process(path, monkeypatch):
    """Or the lock of a run folder would outlive a process that is killed while a file is read."""
    monkeypatch.setattr(
        netcdf, "_groups", lambda path: " ".join(found.name for found in Path("/proc/self/fd").iterdir())
    )
    with path.open("rb") as held:
        with pytest.raises(DamagedFileError) as raised:
            read_groups(path)
        number = str(held.fileno())
    listed = str(raised.value).partition("(")[2].rstrip(")").split()
    assert {"0", "1", "2"} < set(listed)
    assert number not in listed
    assert len(listed) <= 6  # the pipe, the null device beside its place as 2, and this listing
