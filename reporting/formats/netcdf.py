"""Writing and reading of NetCDF-4 files of several groups.

Labelled arrays are written without xarray, which takes seconds to import (pandas, and Dask where it
is installed); xarray reads them.

HDF5 trusts what a file says about its own structure, so a damaged file can keep it busy for ever or
crash it. Therefore a fork of this process reads the file, within limits of time and memory, and
sends the content back through a pipe.
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
from typing import TYPE_CHECKING, NamedTuple, NoReturn

from reporting.arrays import AnyArray
from reporting.errors import DamagedFileError
from reporting.system.operating_system import can_fork

if TYPE_CHECKING:
    import h5py
    import xarray as xr


class Variable(NamedTuple):
    """An array whose axes have names, as xarray takes it.

    Attributes
    ----------
    dims : tuple of str
        The name of each axis.
    values : array
        The numbers or texts.
    attrs : mapping of str to str
        The attributes, such as `units` and `long_name`.
    """

    dims: tuple[str, ...]
    values: AnyArray
    attrs: Mapping[str, str]


@dataclass(frozen=True)
class NetcdfGroup:
    """Variables together with the coordinates of their axes.

    Attributes
    ----------
    variables : mapping of str to Variable
        The data.
    coords : mapping of str to Variable
        The coordinates. A coordinate with the name of an axis labels the entries of this axis; the
        others are additional labels.
    attrs : mapping of str to str
        The attributes of the group.
    """

    variables: Mapping[str, Variable]
    coords: Mapping[str, Variable]
    attrs: Mapping[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Variable:
        """Return a variable or coordinate."""
        if name in self.variables:
            return self.variables[name]
        return self.coords[name]


def write_groups(
    path: Path, groups: Mapping[str, NetcdfGroup], attrs: Mapping[str, object]
) -> None:
    """Write a NetCDF-4 file, replacing one that exists; equal arguments give equal bytes.

    Parameters
    ----------
    attrs : mapping of str to object
        The attributes of the root.
    """
    import h5py

    with h5py.File(path, "w", track_order=True) as file:
        file.attrs.update(attrs)
        for name, group in groups.items():
            _write_group(file.create_group(name, track_order=True), group)


def _write_group(target: h5py.Group, group: NetcdfGroup) -> None:
    """Write a group in the form that NetCDF-4 prescribes for HDF5.

    Each axis is an HDF5 dimension scale, which is attached to the variables that have this axis.
    """
    target.attrs.update(group.attrs)
    entries = {**group.variables, **group.coords}
    axis_sizes: dict[str, int] = {}
    for entry in entries.values():
        axis_sizes.update(zip(entry.dims, entry.values.shape, strict=True))

    # The axes, with their labels or by their size alone
    for axis, size in axis_sizes.items():
        if axis in entries:
            _write_variable(target, axis, entries[axis]).make_scale(axis)
            continue
        unlabelled = target.create_dataset(axis, (size,), ">f4", track_order=True)
        # The NetCDF library recognises an axis without labels by this text.
        scale_name = f"This is a netCDF dimension but not a netCDF variable.{size:10}"
        unlabelled.make_scale(scale_name.encode("ascii"))

    # All else. By the CF conventions, the attribute "coordinates" of a variable names those of its
    # coordinates that are not labels of a whole axis.
    for name, entry in entries.items():
        if name in axis_sizes:
            continue
        dataset = _write_variable(target, name, entry)
        for number, axis in enumerate(entry.dims):
            dataset.dims[number].attach_scale(target[axis])
        if name in group.coords:
            continue
        coordinates = []
        for label, coordinate in group.coords.items():
            if label not in axis_sizes and set(coordinate.dims) <= set(entry.dims):
                coordinates.append(label)
        if coordinates:
            dataset.attrs["coordinates"] = " ".join(coordinates)


def _write_variable(target: h5py.Group, name: str, variable: Variable) -> h5py.Dataset:
    """Write an array with its attributes as a dataset of HDF5; texts get variable length."""
    import h5py

    values = variable.values
    is_text = values.dtype.kind == "U"
    # HDF5 accepts an axis without entries only if the axis may grow.
    is_empty = 0 in values.shape
    dataset = target.create_dataset(
        name,
        data=values.astype(object) if is_text else values,
        dtype=h5py.string_dtype() if is_text else None,
        maxshape=tuple(size or None for size in values.shape) if is_empty else None,
        track_order=True,
    )
    dataset.attrs.update(variable.attrs)
    return dataset


SECONDS = 10
"""Processor time that reading a small file may take [s]."""
BYTES_IN_A_SECOND = 5_000_000
"""Bytes of a file for which one more second is allowed; HDF5 reads about 1e8 in a second."""
WAITING = 6
"""Wall-clock time that is allowed for one second of processor time [s]."""
MEMORY = 512 * 1024**2
"""Memory that reading a small file may take [bytes]."""
MEMORY_OF_A_BYTE = 64
"""Further memory for each byte of the file, which may be compressed [bytes]."""


def read_groups(path: Path) -> xr.DataTree:
    """Return all groups of a NetCDF-4 file, loaded into memory.

    Times are not decoded: they stay the stored numbers.

    Raises
    ------
    DamagedFileError
        If the file is missing, damaged, truncated or of another kind.
    """
    if not path.is_file():
        raise DamagedFileError(f"there is no file {path}")
    # Imported in the parent process, so that the forks need not import them again.
    import h5netcdf  # noqa: F401
    import xarray as xr

    groups = _groups_read_by_fork(path) if can_fork() else _read_groups(path)
    if isinstance(groups, str):
        raise DamagedFileError(f"{path} is damaged or is not a NetCDF file ({groups})")
    return xr.DataTree.from_dict(groups)


def _groups_read_by_fork(path: Path) -> dict[str, xr.Dataset] | str:
    """Return the groups of a file by path, or one line on why the file cannot be read.

    A forked process reads the file, because a damaged file can make the HDF5 library crash, hang or
    fill the memory.
    """
    reading_end, writing_end = os.pipe()
    with warnings.catch_warnings():
        # Python 3.12 warns of threads. They are those of BLAS, and the fork does not call BLAS.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if not child:
        _send_groups_and_exit(path, writing_end)
    os.close(writing_end)
    groups: dict[str, xr.Dataset] | str
    try:
        with os.fdopen(reading_end, "rb") as pipe:
            groups = pickle.load(pipe)
    except (EOFError, pickle.UnpicklingError):
        groups = "HDF5 breaks down over it"
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    return groups


def _send_groups_and_exit(path: Path, writing_end: int) -> NoReturn:
    """In the forked process, send the groups of a file, or why it cannot be read, and end.

    `writing_end` is the descriptor of the pipe to the parent process. All other descriptors but
    those of standard streams are closed.
    """
    try:
        # Among the inherited descriptors may be the lock of a run folder, which must end with the
        # parent process even if this fork outlives it.
        os.closerange(3, writing_end)
        os.closerange(writing_end + 1, os.sysconf("SC_OPEN_MAX"))
        # No finalizers: they would end workers and remove folders that the parent still uses.
        gc.disable()
        faulthandler.disable()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # silence the C library
        _limit_resources(path.stat().st_size)
        with os.fdopen(writing_end, "wb") as pipe:
            pickle.dump(_read_groups(path), pipe, pickle.HIGHEST_PROTOCOL)
    finally:
        os._exit(0)


def _read_groups(path: Path) -> dict[str, xr.Dataset] | str:
    """Return the groups of a file by their paths, or one line on why the file cannot be read."""
    import xarray as xr

    try:
        with xr.open_datatree(path, engine="h5netcdf", decode_times=False) as tree:
            return {node.path: node.to_dataset(inherit=False).load() for node in tree.subtree}
    except Exception as error:  # noqa: BLE001 - damage of a file raises nearly any exception
        lines = str(error).strip().splitlines()
        reason = lines[0] if lines else type(error).__name__
        return reason.rstrip(".")


def _limit_resources(file_size: int) -> None:
    """Limit time and memory of this process to what a file of this size [bytes] may need.

    The kernel ends the process when it exceeds a limit of time; beyond the limit of memory,
    allocations fail. Signals that the parent process handles end this one.
    """
    import resource

    for signal_number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
        signal.signal(signal_number, signal.SIG_DFL)
    seconds = SECONDS + file_size // BYTES_IN_A_SECOND
    signal.alarm(WAITING * seconds)
    pages = int(Path("/proc/self/statm").read_text("ascii").split()[0])
    memory_in_use = pages * os.sysconf("SC_PAGE_SIZE")
    limits = {
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_CPU: seconds,
        resource.RLIMIT_AS: memory_in_use + MEMORY + MEMORY_OF_A_BYTE * file_size,
    }
    for kind, limit in limits.items():
        _, hard_limit = resource.getrlimit(kind)
        soft_limit = limit if hard_limit == resource.RLIM_INFINITY else min(limit, hard_limit)
        resource.setrlimit(kind, (soft_limit, hard_limit))
