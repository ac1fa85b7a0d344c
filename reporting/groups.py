"""Labelled arrays in groups, and their NetCDF-4 file: the bytes that xarray would write, without loading it.

xarray brings pandas, and asks for Dask where that is installed: seconds before the first byte is written.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Group", "Variable", "write_groups"]


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

    Parameters
    ----------
    path : Path
        The file.
    groups : mapping of str to Group
        By name.
    attrs : mapping
        Attributes of the root.
    """
    import h5netcdf

    with h5netcdf.File(path, "w") as file:
        for name, value in attrs.items():
            file.attrs[name] = value
        for title, group in groups.items():
            _write_group(file.create_group(title), group)


def _write_group(target: Any, group: Group) -> None:
    for name, value in group.attrs.items():
        target.attrs[name] = value
    everything = {**group.variables, **group.coords}
    for variable in everything.values():
        for axis, size in zip(variable.dims, variable.values.shape, strict=True):
            if axis not in target.dimensions:
                target.dimensions[axis] = size
    for name, variable in everything.items():
        beside = [
            other
            for other, coordinate in group.coords.items()
            if name in group.variables
            and other not in target.dimensions
            and set(coordinate.dims) <= set(variable.dims)
        ]
        listed = {"coordinates": " ".join(sorted(beside))} if beside else {}
        _write_variable(target, name, variable, {**variable.attrs, **listed})


def _write_variable(target: Any, name: str, variable: Variable, attrs: Mapping[str, str]) -> None:
    import h5py

    values = variable.values
    is_text = values.dtype.kind == "U"
    stored = target.create_variable(
        name,
        variable.dims,
        h5py.string_dtype() if is_text else values.dtype,
        # What labels an axis is never missing.
        fillvalue=np.nan if values.dtype.kind == "f" and name not in target.dimensions else None,
    )
    for key, value in attrs.items():
        stored.attrs[key] = value
    stored[...] = values.astype(object) if is_text else values
