"""NetCDF-4 files of several groups: written, and read as a whole or refused in one sentence.

Labelled arrays are written without xarray, which reads them: it brings pandas, and asks for Dask where that
is installed, seconds before the first byte is written.

HDF5 believes what a file says of its own structure: a damaged one can keep it busy for ever, or crash it. So
a fork of this process reads, within limits, and hands over what it read; the process itself opens no file.
"""

from __future__ import annotations

import faulthandler
import gc
import os
import pickle
import signal
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from numpy.typing import NDArray

from reporting.errors import DamagedFileError

if TYPE_CHECKING:
    import xarray as xr


class Variable(NamedTuple):
    """An array whose axes have names, as xarray takes it.

    Attributes
    ----------
    dims : tuple of str
        Name of each axis.
    values : array
        Numbers or texts.
    attrs : mapping of str to str
        Such as `units` and `long_name`.
    """

    dims: tuple[str, ...]
    values: NDArray[Any]
    attrs: Mapping[str, str]


@dataclass(frozen=True)
class Group:
    """Variables, and the coordinates that say what stands along their axes.

    Attributes
    ----------
    variables : mapping of str to Variable
        What is told.
    coords : mapping of str to Variable
        One of the name of an axis labels it; others stand beside.
    attrs : mapping of str to str
        Of the whole group.
    """

    variables: Mapping[str, Variable]
    coords: Mapping[str, Variable]
    attrs: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Variable:
        """Return a variable or coordinate."""
        return self.variables[name] if name in self.variables else self.coords[name]


def write_groups(path: Path, groups: Mapping[str, Group], attrs: Mapping[str, Any]) -> None:
    """Write a NetCDF-4 file; the bytes depend on nothing but what is given.

    Parameters
    ----------
    path : Path
        The file.
    groups : mapping of str to Group
        By name.
    attrs : mapping
        Attributes of the root.
    """
    import h5py

    with h5py.File(path, "w", track_order=True) as file:
        file.attrs.update(attrs)
        for name, group in groups.items():
            _write_group(file.create_group(name, track_order=True), group)


def _write_group(target: Any, group: Group) -> None:
    """Write axes with their labels, then all that stands along them, as HDF5 has them."""
    target.attrs.update(group.attrs)
    everything = {**group.variables, **group.coords}
    sizes = {
        axis: size
        for variable in everything.values()
        for axis, size in zip(variable.dims, variable.values.shape, strict=True)
    }
    for axis, size in sizes.items():
        if axis in everything:
            _written(target, axis, everything[axis]).make_scale(axis)
        else:
            bare = target.create_dataset(axis, (size,), ">f4", track_order=True)
            bare.make_scale(f"This is a netCDF dimension but not a netCDF variable.{size:10}".encode("ascii"))
    beside = {name: own for name, own in group.coords.items() if name not in sizes}
    for name, variable in everything.items():
        if name in sizes:
            continue
        stored = _written(target, name, variable)
        for place, axis in enumerate(variable.dims):
            stored.dims[place].attach_scale(target[axis])
        own = [other for other, label in beside.items() if {*label.dims} <= {*variable.dims}]
        if own and name in group.variables:
            stored.attrs["coordinates"] = " ".join(own)


def _written(target: Any, name: str, variable: Variable) -> Any:
    import h5py

    values, text = variable.values, variable.values.dtype.kind == "U"
    stored = target.create_dataset(
        name,
        data=values.astype(object) if text else values,
        dtype=h5py.string_dtype() if text else None,
        maxshape=tuple(size or None for size in values.shape) if 0 in values.shape else None,
        track_order=True,
    )
    stored.attrs.update(variable.attrs)
    return stored


SECONDS, BYTES_IN_A_SECOND = 10, 5_000_000
"""Processor time for a file: so much for any, and a second more for so many bytes (1e8 are read in truth)."""
WAITING = 6
"""Seconds on the clock for one of processor time."""
MEMORY, MEMORY_OF_A_BYTE = 512 * 1024**2, 64
"""Bytes for any file, and for each byte of it, which may be compressed."""


def read_groups(path: Path) -> xr.DataTree:
    """Return all groups of a NetCDF-4 file, loaded into memory; times stay the numbers that are stored.

    Raises
    ------
    DamagedFileError
        The file is missing, damaged, cut off or of another kind.
    """
    if not path.is_file():
        raise DamagedFileError(f"there is no file {path}")
    # Here, and not again in each fork.
    import h5netcdf  # noqa: F401
    import xarray as xr

    reading, writing = os.pipe()
    with warnings.catch_warnings():
        # Python 3.12 warns of threads (those of BLAS); the fork calls nothing that they could have locked.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if not child:
        _answer(path, writing)
    os.close(writing)
    groups: dict[str, xr.Dataset] | str = ""
    try:
        with os.fdopen(reading, "rb") as pipe:
            groups = pickle.load(pipe)
    except (EOFError, pickle.UnpicklingError):
        groups = "HDF5 breaks down over it"
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    if isinstance(groups, str):
        raise DamagedFileError(f"{path} is damaged or no NetCDF file ({groups})")
    return xr.DataTree.from_dict(groups)


def _answer(path: Path, writing: int) -> NoReturn:
    """Send the groups of a file, or why there are none, and end this process."""
    try:
        # A fork inherits the lock of a run folder, which must end with the process if that is killed.
        os.closerange(3, writing)
        os.closerange(writing + 1, os.sysconf("SC_OPEN_MAX"))
        gc.disable()  # what is garbage here is in use there: finalizers end workers and remove folders
        faulthandler.disable()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the C library's last words
        _limit(path.stat().st_size)
        with os.fdopen(writing, "wb") as pipe:
            pickle.dump(_groups(path), pipe, pickle.HIGHEST_PROTOCOL)
    finally:
        os._exit(0)


def _groups(path: Path) -> dict[str, xr.Dataset] | str:
    import xarray as xr

    try:
        with xr.open_datatree(path, engine="h5netcdf", decode_times=False) as tree:
            return {node.path: node.to_dataset(inherit=False).load() for node in tree.subtree}
    except Exception as error:  # noqa: BLE001 - HDF5 answers damage with nearly every exception that there is
        reason = str(error).strip().splitlines()[:1] or [type(error).__name__]
        return reason[0].rstrip(".")


def _limit(size: int) -> None:
    """Let the kernel end this process when it takes more time or memory than a file of `size` bytes may."""
    import resource

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)
    seconds = SECONDS + size // BYTES_IN_A_SECOND
    signal.alarm(WAITING * seconds)
    taken = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    for what, limit in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_AS, taken + MEMORY + MEMORY_OF_A_BYTE * size),
    ):
        hard = resource.getrlimit(what)[1]
        resource.setrlimit(what, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
