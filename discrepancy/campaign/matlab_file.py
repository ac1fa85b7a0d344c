"""MATLAB files as tables: vectors of one length are columns, by the names of variables and fields."""

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple, cast

import h5py
import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatlabFunction, MatlabOpaque

from discrepancy.campaign.heads import times_among
from discrepancy.errors import CampaignFileError
from reporting.words import counted, listing, one_line

_MOST_COLUMNS = 32
"""Most columns of a matrix that is taken as several columns of a table."""
_HDF5 = b"\x89HDF\r\n\x1a\n"
_HDF5_OFFSET = 512
"""Bytes before the HDF5 signature in a file of version 7.3."""


class MatlabTable(NamedTuple):
    """Names and cells of the columns of a MATLAB file, and what was passed over."""

    heads: tuple[str, ...]
    columns: tuple[tuple[str, ...], ...]
    remark: str


def read_matlab(path: Path) -> MatlabTable:
    """Return the table of a file of version 4 to 7.3.

    Vectors, the columns of matrices with up to 32 of them, and the same in fields of a struct are columns.
    They have one length, or several where each length has a time of its own.

    Raises
    ------
    CampaignFileError
        If the file cannot be read, or holds no columns of numbers.
    """
    columns: dict[str, np.ndarray] = {}
    passed_over: list[str] = []
    for name, value in _variables(path):
        found = dict(_columns(name, value))
        columns |= found
        if not found:
            passed_over.append(name)
    if not columns:
        has = listing(map(repr, passed_over)) or "nothing"
        raise CampaignFileError(
            f"{path.name} holds no vectors of numbers (it has {has}): save columns as plain vectors; a table "
            "as S = table2struct(T, 'ToScalar', true), and a datetime as seconds(t - t(1))."
        )
    table = _of_fitting_lengths(columns)
    passed_over += [name for name in columns if name not in table]
    cells = zip(*zip_longest(*map(_cells, table.values()), fillvalue=""), strict=True)
    count = max(map(len, table.values()))
    remark = f"rows 1 to {count} of {counted(len(table), 'vector')}"
    if passed_over:
        remark += f"; left out: {listing(map(repr, passed_over))}"
    return MatlabTable(tuple(table), tuple(cells), remark)


def _variables(path: Path) -> Iterator[tuple[str, object]]:
    """Yield the variables of a file, and the fields of structs as `NAME.FIELD`."""
    try:
        with path.open("rb") as stream:
            start = stream.read(_HDF5_OFFSET + len(_HDF5))
        is_hdf5 = start.endswith(_HDF5) or start.startswith(_HDF5)
        content = _hdf5_content(path) if is_hdf5 else _plain_content(path)
    except Exception as cause:  # readers of damaged files raise nearly anything
        raise CampaignFileError(
            f"{path} cannot be read as a MATLAB file ({one_line(cause)}): save it anew with "
            "save('FILE.mat', '-v7')."
        ) from cause
    for name, value in content.items():
        if isinstance(value, Mapping):
            for field, inner in value.items():
                yield f"{name}.{field}", inner
        else:
            yield name, value


def _plain_content(path: Path) -> dict[str, object]:
    """Return the variables of a file of version 4 to 7, structs as mappings."""
    with warnings.catch_warnings(action="ignore"):
        content = loadmat(path, squeeze_me=False, struct_as_record=True)
    variables = {name: value for name, value in content.items() if not name.startswith("__")}
    return {name: _struct(value) for name, value in variables.items()}


def _struct(value: object) -> object:
    """Return a single struct as a mapping of its fields, anything else as it is."""
    if isinstance(value, np.ndarray) and value.dtype.names and value.size == 1:
        record = value.reshape(-1)[0]
        return {field: record[field] for field in value.dtype.names}
    return value


def _hdf5_content(path: Path) -> dict[str, object]:
    """Return the variables of a file of version 7.3, which stores matrices transposed."""

    def value(item: h5py.Dataset | h5py.Group, depth: int = 0) -> object:
        if isinstance(item, h5py.Group):
            return {name: value(inner, 1) for name, inner in item.items()} if depth == 0 else None
        is_text = item.attrs.get("MATLAB_class", b"") in (b"char", b"cell", b"string")
        return None if is_text or "MATLAB_empty" in item.attrs else np.transpose(item[()])

    with h5py.File(path, "r") as file:
        return {name: value(item) for name, item in file.items() if not name.startswith("#")}


def _columns(name: str, value: object) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the columns of a variable; none of what is no real vector, or no matrix of few columns."""
    if isinstance(value, MatlabOpaque | MatlabFunction) or not isinstance(value, np.ndarray):
        return
    if value.dtype.kind not in "iufb" or value.ndim != 2 or value.size < 2:
        return
    if min(value.shape) == 1:
        yield name, value.reshape(-1)
    elif min(value.shape) <= _MOST_COLUMNS:
        matrix = value if value.shape[1] <= value.shape[0] else value.T
        for number, column in enumerate(matrix.T, start=1):
            yield f"{name} {number}", column


def _of_fitting_lengths(columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the columns of the length that most numbers have, and of others that have times of their own."""
    lengths = Counter(len(column) for column in columns.values())
    main = max(lengths, key=lambda length: (length * lengths[length], length))
    times = times_among([*columns], [""] * len(columns))
    timed = {len(columns[name]) for name in times}
    kept = timed | {main} if len(timed) > 1 else {main}
    return {name: column for name, column in columns.items() if len(column) in kept}


def _cells(column: np.ndarray) -> Sequence[str]:
    """Return the cells of a column; one that is not a number is empty."""
    values = cast("list[float]", (column.astype(int) if column.dtype == bool else column).tolist())
    return ["" if value != value else repr(value) for value in values]
