"""Labelled arrays in groups, and their NetCDF-4 file: the bytes that xarray would write, without loading it.

xarray brings pandas, and asks for Dask where that is installed: seconds before the first byte is written.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib import metadata
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Variable:
    """An array whose axes have names.

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

    Dimension scales and hidden attributes are made in the order of h5netcdf, which looks each object up again
    and again, and takes four times as long.

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
        for name, value in attrs.items():
            file.attrs[name] = value if isinstance(value, str) else np.atleast_1d(value)
        numbers = count()
        for title, group in groups.items():
            _GroupWriter(file.create_group(title, track_order=True), group, numbers).write()
        version = metadata.version("h5netcdf")
        written = f"version=2,h5netcdf={version},hdf5={h5py.version.hdf5_version},h5py={h5py.__version__}"
        file.attrs["_NCProperties"] = np.array(
            written, dtype=h5py.string_dtype(encoding="ascii", length=len(written))
        )


class _GroupWriter:
    """Writes one group; `numbers` counts the axes of the file."""

    def __init__(self, target: Any, group: Group, numbers: Iterator[int]) -> None:
        self._target, self._group, self._numbers = target, group, numbers
        self._axes: dict[str, int] = {}
        self._stored: dict[str, Any] = {}

    def write(self) -> None:
        """Write attributes, axes, and then variables and coordinates."""
        group = self._group
        for name, value in group.attrs.items():
            self._target.attrs[name] = value
        everything = {**group.variables, **group.coords}
        for variable in everything.values():
            for axis, size in zip(variable.dims, variable.values.shape, strict=True):
                if axis not in self._axes:
                    self._add_axis(axis, size)
        for name, variable in everything.items():
            stored = self._label(name, variable) if name in self._axes else self._variable(name, variable)
            for key, value in variable.attrs.items():
                stored.attrs[key] = value
            if beside := self._beside(name, variable):
                stored.attrs["coordinates"] = beside
            values = variable.values
            stored[...] = values.astype(object) if values.dtype.kind == "U" else values

    def _beside(self, name: str, variable: Variable) -> str:
        """Return the names of the coordinates that stand beside a variable and label none of its axes."""
        if name not in self._group.variables:
            return ""
        others = self._group.coords.items()
        return " ".join(
            sorted(
                other
                for other, coordinate in others
                if other not in self._axes and set(coordinate.dims) <= set(variable.dims)
            )
        )

    def _add_axis(self, name: str, size: int) -> None:
        number = next(self._numbers)
        scale = self._create(name, (size,), ">f4")
        scale.attrs["_Netcdf4Dimid"] = np.array(number, np.int32)
        scale.make_scale(f"This is a netCDF dimension but not a netCDF variable.{size:10}".encode("ascii"))
        self._axes[name], self._stored[name] = number, scale

    def _variable(self, name: str, variable: Variable) -> Any:
        stored = self._create_for(name, variable.values)
        for place, axis in enumerate(variable.dims):
            stored.dims[place].attach_scale(self._stored[axis])
        self._tell(stored, variable)
        return stored

    def _label(self, name: str, variable: Variable) -> Any:
        """Put a coordinate in the place of its bare axis."""
        axis = self._stored.pop(name)
        uses = list(axis.attrs.get("REFERENCE_LIST", []))
        for user, place in uses:
            self._target[user].dims[place].detach_scale(axis)
        del axis  # an open object keeps its place in the file
        del self._target[name]
        stored = self._create_for(name, variable.values)
        stored.attrs["_Netcdf4Dimid"] = np.array(self._axes[name], np.int32)
        stored.make_scale(name)
        for user, place in uses:
            self._target[user].dims[place].attach_scale(stored)
        self._stored[name] = stored
        self._tell(stored, variable)
        return stored

    def _tell(self, stored: Any, variable: Variable) -> None:
        """Write the hidden attributes of a variable: its axes, and what stands for a missing number."""
        if variable.dims:
            numbers = np.array([self._axes[axis] for axis in variable.dims], np.int32)
            stored.attrs["_Netcdf4Coordinates"] = numbers
            if not stored.attrs.get("_Netcdf4Dimid"):
                stored.attrs["_Netcdf4Dimid"] = numbers[0]
        if variable.values.dtype.kind == "f":
            stored.attrs["_FillValue"] = np.array([np.nan], variable.values.dtype)

    def _create_for(self, name: str, values: NDArray[Any]) -> Any:
        import h5py

        dtype = h5py.string_dtype() if values.dtype.kind == "U" else values.dtype
        fill = np.nan if values.dtype.kind == "f" else None
        return self._create(name, values.shape, dtype, fillvalue=fill)

    def _create(self, name: str, shape: tuple[int, ...], dtype: Any, **options: Any) -> Any:
        if 0 in shape:  # NetCDF knows no empty axis but one that may grow
            options["maxshape"] = tuple(size or None for size in shape)
        return self._target.create_dataset(name, shape, dtype=dtype, track_order=True, **options)
