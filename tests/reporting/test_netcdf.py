"""NetCDF is written for xarray without it, and read whole or refused in one sentence, whatever HDF5 does."""

import gc
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from reporting import netcdf
from reporting.errors import DamagedFileError
from reporting.netcdf import Group, Variable, read_groups, write_groups
from tests.refusals import refused

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
def group(draw: st.DrawFn) -> Group:
    """Draw a group: some axes have labels, others have coordinates beside them."""
    axes = st.lists(st.sampled_from(list(SIZES)), unique=True, max_size=3).map(tuple)
    told = draw(st.dictionaries(_NAMES, axes.flatmap(variables), min_size=1, max_size=4))
    used = {axis for variable in told.values() for axis in variable.dims}
    coords = {axis: draw(variables((axis,))) for axis in sorted(used) if draw(st.booleans())}
    beside = {f"w_{axis}": draw(variables((axis,))) for axis in sorted(used) if draw(st.booleans())}
    return Group(told, {**coords, **beside}, {"parameter": "e"} if draw(st.booleans()) else {})


@settings(max_examples=15)
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


def test_a_run_is_flown_and_stored_without_heavy_libraries():
    """`uav-twin run --no-report` reads the program's modules and none of these."""
    code = (
        "import sys, twin_master.workflow, twin_master.assets.design_source\n"
        "import calibration.paper.load_test\n"
        "import calibration.static.errors_in_variables, calibration.static.experiments\n"
        "import calibration.static.posterior\n"
        "heavy = {'xarray', 'pandas', 'dask', 'distributed', 'zarr', 'matplotlib', 'bokeh', 'skfem', 'pymor',"
        " 'meshio', 'scipy.interpolate', 'scipy.optimize', 'scipy.sparse'}\n"
        "print(*sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.fixture
def path(tmp_path: Path) -> Path:
    begin = Variable(("trial",), np.array([0.0, 1.0]), {"units": "hours since 2020-01-01"})
    write_groups(tmp_path / "a.nc", {"a": Group({"begin": begin}, {})}, {"schema": "outer"})
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
    monkeypatch.setattr(netcdf, "_groups", reading)
    begin = time.perf_counter()
    with refused(DamagedFileError, "HDF5 breaks down over it"):
        read_groups(path)
    assert time.perf_counter() - begin < 30.0
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
