"""Labelled arrays in groups, and their NetCDF-4 file, which xarray reads, written without loading that.

xarray brings pandas, and asks for Dask where that is installed: seconds before the first byte is written.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray


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
