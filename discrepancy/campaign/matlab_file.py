"""MATLAB files as tables: vectors of one length are columns."""

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, cast

import h5py
import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatlabFunction, MatlabOpaque

from discrepancy.campaign.heads import time_heads
from discrepancy.errors import CampaignFileError
from reporting.words import counted, listing, one_line

_MOST_COLUMNS = 32
"""Most columns of a matrix that is taken as several columns of a table."""
_HDF5 = b"\x89HDF\r\n\x1a\n"
_HDF5_OFFSET = 512
"""Bytes before the HDF5 signature in a file of version 7.3."""


class MatlabTable(NamedTuple):
    """The table in a MATLAB file.

    Attributes
    ----------
    heads : tuple of str
        The names of its C columns.
    columns : tuple of tuple of str
        The cells of C columns with N rows each.
    remark : str
        How many rows there are, and which variables are left out.
    """

    heads: tuple[str, ...]
    columns: tuple[tuple[str, ...], ...]
    remark: str


def read_matlab(path: Path) -> MatlabTable:
    """Read the table in a MATLAB file of version 4 to 7.3.

    Its columns are vectors and the columns of matrices with at most 32 columns, also in the fields
    of structs. Usually they have one length: that whose columns hold most numbers in total. If
    columns of times have several lengths, the columns of these lengths belong to the table, too.
    Variables that do not fit are left out, and the remark names them.

    Raises
    ------
    CampaignFileError
        If the file cannot be read, or holds no columns of numbers.
    """
    columns: dict[str, np.ndarray] = {}
    left_out: list[str] = []
    for name, value in _variables(path):
        new_columns = _columns_of_variable(name, value)
        columns |= new_columns
        if not new_columns:
            left_out.append(name)
    if not columns:
        content = listing(map(repr, left_out)) or "nothing"
        raise CampaignFileError(
            f"{path.name} holds no vectors of numbers (it has {content}): save columns as plain "
            "vectors; a table as S = table2struct(T, 'ToScalar', true), and a datetime as "
            "seconds(t - t(1))."
        )
    table = _columns_of_fitting_lengths(columns)
    left_out += [name for name in columns if name not in table]
    cells = [_texts_of_cells(column) for column in table.values()]
    row_count = max(map(len, cells))
    # shorter columns end with empty cells
    padded_columns = tuple((*column, *[""] * (row_count - len(column))) for column in cells)
    remark = f"rows 1 to {row_count} of {counted(len(table), 'vector')}"
    if left_out:
        remark += f"; left out: {listing(map(repr, left_out))}"
    return MatlabTable(tuple(table), padded_columns, remark)


def _variables(path: Path) -> Iterator[tuple[str, object]]:
    """Yield the names and values of variables of a file; fields of structs are called `NAME.FIELD`.

    Raises
    ------
    CampaignFileError
        If the file cannot be read.
    """
    try:
        content = _hdf5_content(path) if _is_hdf5(path) else _content_before_hdf5(path)
    except Exception as cause:  # the libraries raise almost any error for damaged files
        raise CampaignFileError(
            f"{path} cannot be read as a MATLAB file ({one_line(cause)}): save it again with "
            "save('FILE.mat', '-v7')."
        ) from cause
    for name, value in content.items():
        if isinstance(value, Mapping):
            for field, field_value in value.items():
                yield f"{name}.{field}", field_value
        else:
            yield name, value


def _is_hdf5(path: Path) -> bool:
    """Return whether a file is of version 7.3: HDF5, with or without a user block before it."""
    with path.open("rb") as stream:
        start = stream.read(_HDF5_OFFSET + len(_HDF5))
    return start.endswith(_HDF5) or start.startswith(_HDF5)


def _content_before_hdf5(path: Path) -> dict[str, object]:
    """Return the variables of a file of version 4 to 7.

    A single struct is a mapping of its fields.
    """
    with warnings.catch_warnings(action="ignore"):
        content = loadmat(path, squeeze_me=False, struct_as_record=True)
    return {name: _struct(value) for name, value in content.items() if not name.startswith("__")}


def _struct(value: object) -> object:
    """Return a single struct as a mapping of its fields, and any other value as it is."""
    if isinstance(value, np.ndarray) and value.dtype.names and value.size == 1:
        record = value.reshape(-1)[0]
        return {field: record[field] for field in value.dtype.names}
    return value


def _hdf5_content(path: Path) -> dict[str, object]:
    """Return the variables of a file of version 7.3; a struct is a mapping of its fields.

    Structs within structs are None, and so are texts and empty arrays.
    """
    variables: dict[str, object] = {}
    with h5py.File(path, "r") as file:
        for name, stored_object in file.items():
            if name.startswith("#"):  # references that the format keeps for itself
                continue
            if isinstance(stored_object, h5py.Group):
                variables[name] = {
                    field: _hdf5_array(value) for field, value in stored_object.items()
                }
            else:
                variables[name] = _hdf5_array(stored_object)
    return variables


def _hdf5_array(stored_object: h5py.Dataset | h5py.Group) -> np.ndarray | None:
    """Return a matrix, which HDF5 has transposed; None for a group, a text or an empty array."""
    if isinstance(stored_object, h5py.Group):
        return None
    is_text = stored_object.attrs.get("MATLAB_class", b"") in (b"char", b"cell", b"string")
    if is_text or "MATLAB_empty" in stored_object.attrs:
        return None
    return np.transpose(stored_object[()])


def _columns_of_variable(name: str, value: object) -> dict[str, np.ndarray]:
    """Return the columns (N,) of a variable, which is a vector or a matrix, by name.

    The samples lie along the longer side of a matrix NAME, whose columns are called NAME 1, NAME 2
    and so on. Texts, complex numbers, scalars and matrices wider than `_MOST_COLUMNS` give no
    column.
    """
    if isinstance(value, MatlabOpaque | MatlabFunction) or not isinstance(value, np.ndarray):
        return {}
    is_real = value.dtype.kind in "iufb"
    if not is_real or value.ndim != 2 or value.size < 2:
        return {}
    if min(value.shape) == 1:
        return {name: value.reshape(-1)}
    if min(value.shape) > _MOST_COLUMNS:
        return {}
    matrix = value if value.shape[1] <= value.shape[0] else value.T
    return {f"{name} {number}": column for number, column in enumerate(matrix.T, start=1)}


def _columns_of_fitting_lengths(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Choose, by their lengths, the columns of a file that make up one table.

    These are the columns of one length: that whose columns hold most numbers in total. If columns
    of times have several lengths, the table has several clocks, and the columns of these lengths
    belong to it too.
    """
    lengths = {name: len(column) for name, column in columns.items()}
    number_count: Counter[int] = Counter()  # in all columns of a length
    for length in lengths.values():
        number_count[length] += length
    # of two lengths whose columns hold equally many numbers, the larger one
    main_length = max(number_count, key=lambda length: (number_count[length], length))
    accepted_lengths = {main_length}
    # MATLAB variables have no units, so that columns of times are recognised by their names
    no_units = [""] * len(columns)
    clock_lengths = {lengths[name] for name in time_heads([*columns], no_units)}
    if len(clock_lengths) > 1:
        accepted_lengths.update(clock_lengths)
    return {name: column for name, column in columns.items() if lengths[name] in accepted_lengths}


def _texts_of_cells(column: np.ndarray) -> list[str]:
    """Return the cells of a column as texts; a value that is not a number is an empty cell."""
    if column.dtype == bool:
        column = column.astype(int)
    cells = []
    for value in cast("list[float]", column.tolist()):
        is_nan = value != value
        cells.append("" if is_nan else repr(value))
    return cells
