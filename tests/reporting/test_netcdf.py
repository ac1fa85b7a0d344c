"""NetCDF is written for xarray without it, and read whatever HDF5 does."""

import gc
import os
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from reporting.errors import DamagedFileError
from reporting.formats import netcdf
from reporting.formats.netcdf import NetcdfGroup, Variable, read_groups, write_groups
from tests.refusals import refused

# ---------------------------------------------------------------- written and read

SIZES = {"step": 4, "sensor": 3, "state": 2, "empty": 0}
"""Lengths of the axes."""
TYPES = ("f8", "f4", "i8", "i1", "U5")
NAMES = st.text("abcxyz", min_size=1, max_size=6).map("v_{}".format)


@st.composite
def draw_variable(draw: st.DrawFn, axes: tuple[str, ...]) -> Variable:
    """Draw a variable of some axes."""
    shape = [SIZES[axis] for axis in axes]
    values = np.arange(np.prod(shape, dtype=int)) * draw(st.integers(1, 5))
    typed = values.reshape(shape).astype(draw(st.sampled_from(TYPES)))
    attributes = {"units": "1", "long_name": draw(st.text("abc äµ", max_size=9))}
    return Variable(axes, typed, attributes)


@st.composite
def draw_group(draw: st.DrawFn) -> NetcdfGroup:
    """Draw a group: some axes have labels, others have coordinates beside them."""
    axes = st.lists(st.sampled_from(list(SIZES)), unique=True, max_size=3).map(tuple)
    variables = draw(st.dictionaries(NAMES, axes.flatmap(draw_variable), min_size=1, max_size=4))
    used_axes = sorted({axis for variable in variables.values() for axis in variable.dims})
    coordinates = {}
    for axis in used_axes:
        if draw(st.booleans()):
            coordinates[axis] = draw(draw_variable((axis,)))
    for axis in used_axes:
        if draw(st.booleans()):
            coordinates[f"w_{axis}"] = draw(draw_variable((axis,)))
    attributes = {"parameter": "e"} if draw(st.booleans()) else {}
    return NetcdfGroup(variables, coordinates, attributes)


def tree_of(groups, attributes):
    """Return groups as a tree of xarray."""
    datasets = {
        name: xr.Dataset(group.variables, group.coords, group.attrs)
        for name, group in groups.items()
    }
    return xr.DataTree.from_dict({"/": xr.Dataset(attrs=attributes), **datasets})


def read_by_xarray(path):
    with xr.open_datatree(path, engine="h5netcdf") as tree:
        return tree.load()


def assert_same_bits(tree, groups):
    """Assert that numbers have the type and the bits that were written; texts may be widened."""
    for name, group in groups.items():
        for key, variable in {**group.variables, **group.coords}.items():
            if variable.values.dtype.kind != "U":
                read_values = tree[name][key].values
                assert read_values.dtype == variable.values.dtype
                assert read_values.tobytes() == variable.values.tobytes()


@settings(max_examples=10)
@given(
    groups=st.dictionaries(st.sampled_from(["one", "two", "three/inner"]), draw_group(), min_size=1)
)
def test_xarray_and_we_read_what_was_written(groups, tmp_path_factory):
    """To the last bit; and what is written twice has equal bytes."""
    folder = tmp_path_factory.mktemp("groups")
    attributes = {"title": "a tree", "seed": 7}
    write_groups(folder / "file.nc", groups, attributes)
    write_groups(folder / "again.nc", groups, attributes)

    assert (folder / "file.nc").read_bytes() == (folder / "again.nc").read_bytes()
    for tree in (read_by_xarray(folder / "file.nc"), read_groups(folder / "file.nc")):
        xr.testing.assert_identical(tree, tree_of(groups, attributes))
        assert_same_bits(tree, groups)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A file with times whose unit xarray could decode."""
    begin = Variable(("trial",), np.array([0.0, 1.0]), {"units": "hours since 2020-01-01"})
    file = tmp_path / "a.nc"
    write_groups(file, {"a": NetcdfGroup({"begin": begin}, {})}, {"schema": "outer"})
    return file


def test_values_are_read_as_they_are_stored_and_can_be_changed(path):
    tree = read_groups(path)

    assert tree.attrs["schema"] == "outer"
    assert tree["a/begin"].dtype == np.float64
    tree["a/begin"].values[0] = 1.0  # as any array in memory


# ---------------------------------------------------------------- damaged files


def test_a_missing_file_is_one_sentence(tmp_path):
    with pytest.raises(DamagedFileError, match="there is no file"):
        read_groups(tmp_path / "a.nc")


@pytest.mark.parametrize("content", [b"", b"text", b"\x89HDF\r\n\x1a\n", b"CDF\x01" + bytes(40)])
def test_a_file_that_is_no_netcdf_is_one_sentence(tmp_path, content):
    (tmp_path / "a.nc").write_bytes(content)

    with refused(DamagedFileError, r"a\.nc is damaged or is not a NetCDF file \(.+\)$"):
        read_groups(tmp_path / "a.nc")


def spin(_: Path) -> object:
    while True:
        pass


def fill_memory(_: Path) -> object:
    return {"a": xr.Dataset({"a": ("row", np.zeros(10**9, dtype=np.uint8))})}


BAD_READERS = {
    "spins": spin,
    "waits": lambda _: time.sleep(1000.0),
    "crashes": lambda _: os.abort(),
    "fills the memory": fill_memory,
    "raises over two lines": lambda _: {}["a\nb"],
}


@dataclass
class CountedFork:
    """`os.fork`, which keeps the numbers of the processes that it made."""

    processes: list[int]
    fork = staticmethod(os.fork)

    def __call__(self) -> int:
        process = self.fork()
        self.processes.append(process)
        return process


@pytest.mark.parametrize("name", BAD_READERS)
def test_a_reader_that_breaks_down_is_one_sentence(path, monkeypatch, capfd, name):
    """No end, a crash and a full memory; its process is gone, and it says nothing."""
    fork = CountedFork([])
    monkeypatch.setattr(os, "fork", fork)
    monkeypatch.setattr(netcdf, "SECONDS", 1)
    monkeypatch.setattr(netcdf, "WAITING", 2)
    monkeypatch.setattr(netcdf, "_read_groups", BAD_READERS[name])

    with refused(DamagedFileError, "HDF5 breaks down over it"):
        read_groups(path)

    assert capfd.readouterr() == ("", "")
    with pytest.raises(ProcessLookupError):
        os.kill(fork.processes[0], 0)


# ---------------------------------------------------------------- the process of the reader


class Garbage:
    """An object in a circle, which writes into a file who collects it."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self.itself = self

    def __del__(self) -> None:
        with self.file.open("a") as file:
            file.write(f"{os.getpid()} ")


def test_the_reader_collects_no_garbage_of_this_process(path, tmp_path):
    """A worker of an FMU must not be ended by a fork that collects the garbage of its parent."""
    collectors = tmp_path / "collectors"
    gc.collect()
    garbage = Garbage(collectors)
    del garbage
    gc.disable()
    try:
        read_groups(path)
    finally:
        gc.enable()
    gc.collect()

    assert collectors.read_text().split() == [str(os.getpid())]


def test_a_warning_at_the_fork_is_no_error(path, monkeypatch):
    """Newer Pythons warn of threads at a fork."""
    fork = os.fork

    def fork_with_warning() -> int:
        text = "multi-threaded, use of fork() may lead to deadlocks"
        warnings.warn(text, DeprecationWarning, stacklevel=2)
        return fork()

    monkeypatch.setattr(os, "fork", fork_with_warning)

    assert read_groups(path).attrs["schema"] == "outer"


def list_descriptors(_: Path) -> str:
    return " ".join(link.name for link in Path("/proc/self/fd").iterdir())


def test_the_fork_holds_no_file_of_this_process(path, monkeypatch):
    """Or the lock of a run folder would outlive a process that is killed while a file is read."""
    monkeypatch.setattr(
        netcdf, "_read_groups", list_descriptors
    )  # a text is not a tree: it is refused
    with path.open("rb") as held:
        with pytest.raises(DamagedFileError) as raised:
            read_groups(path)
        held_descriptor = str(held.fileno())

    listed = str(raised.value).partition("(")[2].rstrip(")").split()
    assert {"0", "1", "2"} < set(listed)
    assert held_descriptor not in listed
    assert len(listed) <= 6  # the pipe, the null device beside its place as 2, and this listing
