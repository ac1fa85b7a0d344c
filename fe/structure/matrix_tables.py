"""Read matrices and vectors of other finite element codes.

The content of a file tells its format: MatrixMarket; archives of NumPy and SciPy (`.npz`, `.npy`);
DMIG of Nastran; tables of `row column value` (CalculiX' `.sti` and `.mas`, Abaqus' COORDINATE) or
of `node component node component value` (Abaqus' MATRIX INPUT), which also tell what each row is.
"""

import io
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import io as scipy_io
from scipy import sparse

from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import MeshError
from reporting.text_file import read_text

from .deck_text import fail
from .matrix_design import file_of
from .nastran import cards

Dof = tuple[int, int]
"""Degree of freedom: a node and its component, 1, 2, 3 along x, y, z, then 4, 5, 6 about them."""

_PLACE = re.compile(r"\s*(\d+)\s*[.,;\s]\s*([1-6])\s*")
_SQUARE_FORMS = (1, 6)
"""Forms of DMIG matrices that are square, or symmetric."""

_REAL_TYPES = (1, 2)
"""Types of DMIG matrices that are real."""


class _FileContent(NamedTuple):
    """The array in a file, and whether its rows are entries: positions and a value."""

    array: FloatArray | sparse.sparray
    is_table: bool


def read_unknowns(path: Path) -> list[Dof]:
    """Read the node and component of each row, one a line: `97.3`, `97 3` or `97,3`.

    Raises
    ------
    MeshError
        If the file cannot be read, or a line is not such a pair.
    """
    text = read_text(path, MeshError, what="file of unknowns")
    unknowns = []
    for number, line in enumerate(text.splitlines(), start=1):
        match = _PLACE.fullmatch(line)
        if match is not None:
            unknowns.append((int(match[1]), int(match[2])))
        elif line.strip():
            fail(
                f"{path}, line {number}",
                f"a node and its component from 1 to 6 are expected, but {line!r} was given.",
            )
    return unknowns


def read_matrix(folder: Path, name: str) -> tuple[sparse.csr_array, list[Dof] | None]:
    """Read a matrix and, if the file has them, the node and component of each row.

    A table may hold one triangle of a symmetric matrix only.

    Parameters
    ----------
    name : str
        `FILE` or `FILE:MATRIX`, relative to the folder.

    Returns
    -------
    matrix : (n, n) sparse array
        The matrix.
    unknowns : list of (int, int) or None
        Node and component of each row; None if the file does not have them.

    Raises
    ------
    MeshError
        If the file cannot be read, or holds no such matrix.
    """
    file, matrix_name = file_of(name)
    path = folder / file
    content = _read(path, matrix_name)
    if not content.is_table:
        return _square_matrix(path, content.array), None
    table = content.array
    width = table.shape[1]
    are_positions_whole = np.array_equal(table[:, :-1], np.rint(table[:, :-1]))
    if width not in (3, 5) or not table.size or not are_positions_whole:
        fail(
            str(path),
            "lines of row, column and value, or of node, component, node, component and value, "
            f"are expected, but there are {len(table)} lines of {width} numbers.",
        )
    positions = table[:, :-1].astype(np.int64)
    unknowns = None
    if width == 5:
        dof_pairs = positions.reshape(-1, 2)
        dofs, index_of_dof = np.unique(dof_pairs, axis=0, return_inverse=True)
        unknowns = [(node, component) for node, component in dofs.tolist()]
        indices = index_of_dof.reshape(-1, 2)
    else:
        if positions.min() < 1:
            fail(str(path), "rows and columns are counted from 1, but there is a smaller one.")
        indices = positions - 1
    return _symmetric_matrix(indices, table[:, -1]), unknowns


def _square_matrix(path: Path, matrix: FloatArray | sparse.sparray) -> sparse.csr_array:
    """Return a matrix as a sparse one; raise `MeshError` if it is not square or not real."""
    is_square = matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1]
    if not is_square or matrix.dtype.kind not in "fiu":
        fail(
            str(path),
            f"a square matrix of real numbers is expected, but {matrix.dtype} of shape "
            f"{matrix.shape} was given.",
        )
    return sparse.csr_array(matrix, dtype=np.float64)


def _symmetric_matrix(indices: IntArray, values: FloatArray) -> sparse.csr_array:
    """Assemble a matrix from entries, and mirror it if only one triangle is given.

    Parameters
    ----------
    indices : (N, 2) array
        Row and column of each entry, from 0.
    values : (N,) array
        The entries; those at the same position are added.
    """
    size = int(indices.max()) + 1
    shape = (size, size)
    positions = tuple(indices.T)
    matrix = sparse.coo_array((values, positions), shape).tocsr()
    # in a table of one triangle, only the entries on the diagonal are mirrored by an entry
    ones = np.ones(len(values))
    pattern = sparse.coo_array((ones, positions), shape).tocsr()
    mirrored_entries = pattern.multiply(pattern.T).tocoo()
    has_one_triangle = (mirrored_entries.row == mirrored_entries.col).all()
    if has_one_triangle:
        diagonal = sparse.diags_array(matrix.diagonal())
        matrix = (matrix + matrix.T - diagonal).tocsr()
    return matrix


def read_vector(
    folder: Path, name: str, unit_vector: Callable[[Dof], FloatArray], size: int
) -> FloatArray:
    """Read a vector (n,): n numbers, or lines of node, component and value.

    Parameters
    ----------
    name : str
        `FILE` or `FILE:ARRAY`, relative to the folder.
    unit_vector : callable
        Returns the vector (n,) with 1 at a component of a node.
    size : int
        Number n of unknowns.

    Raises
    ------
    MeshError
        If the file cannot be read or has another length.
    """
    file, array_name = file_of(name)
    content = _read(folder / file, array_name)
    if content.is_table and content.array.shape[1] == 3:
        terms = []
        for node, component, value in content.array:
            terms.append(value * unit_vector((int(node), int(component))))
        return np.asarray(np.sum(terms, axis=0))
    array = content.array
    dense = array.todense() if isinstance(array, sparse.sparray | sparse.spmatrix) else array
    values = np.asarray(dense, dtype=np.float64)
    if values.size != size or max(values.shape) != size:
        fail(
            str(folder / file),
            f"a vector of {size} numbers, or lines of node, component and value, are expected, but "
            f"an array of shape {values.shape} was given.",
        )
    return values.ravel()


def _read(path: Path, array_name: str) -> _FileContent:
    """Read a file of any format; `array_name` is empty if the file has one array only."""
    try:
        if path.suffix in (".npz", ".npy"):
            return _FileContent(_numpy_array(path, array_name), is_table=False)
        text = read_text(path, MeshError, what="matrix file", otherwise="latin-1")
        if text.startswith("%%MatrixMarket"):
            return _FileContent(scipy_io.mmread(path), is_table=False)
        if re.search(r"^DMIG", text, re.MULTILINE):
            return _FileContent(_dmig_table(path, array_name), is_table=True)
        if not text.strip():
            raise ValueError("it is empty")
        lines = io.StringIO(text.replace(",", " "))
        table = np.loadtxt(lines, comments=("**", "#", "$"), ndmin=2)
        return _FileContent(table, is_table=True)
    except (ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile) as error:
        reason = " ".join(str(error).split())
        fail(str(path), f"the file cannot be read as a matrix: {reason}.")


def _numpy_array(path: Path, array_name: str) -> FloatArray | sparse.sparray:
    """Load an array from a file of NumPy or SciPy."""
    if path.suffix == ".npy":
        array: FloatArray = np.load(path, allow_pickle=False)
        return array
    with np.load(path, allow_pickle=False) as archive:
        if "format" in archive:  # of SciPy
            return sparse.load_npz(path)
        names = list(archive)
        is_only_one = not array_name and len(names) == 1
        if array_name not in names and not is_only_one:
            fail(
                str(path),
                f"one of its arrays is expected, as FILE:ARRAY; it has {', '.join(names)}.",
            )
        archived: FloatArray = archive[array_name or names[0]]
        return archived


class _DmigMatrix(NamedTuple):
    """A matrix in the bulk data of Nastran.

    Attributes
    ----------
    form : int
        Nastran's number of the form: square, symmetric, ...
    entries : list of tuple of float
        Node and component of the row, node and component of the column, and value of each entry.
    """

    form: int
    entries: list[tuple[float, ...]]


def _dmig_table(path: Path, matrix_name: str) -> FloatArray:
    """Read a real square matrix from DMIG entries of the bulk data, as a table (N, 5)."""
    matrices: dict[str, _DmigMatrix] = {}
    for card in cards(path):
        if card.keyword != "DMIG":
            continue
        name = card.fields[0].upper()
        is_head = name not in matrices
        if is_head:
            matrices[name] = _DmigMatrix(form=card.integer(2), entries=[])
            if card.integer(3) not in _REAL_TYPES:
                fail(card.where, f"a real matrix is expected, but {name} is complex.")
            continue
        column = (card.integer(1), max(card.integer(2), 1))
        for first in range(4, len(card.fields), 4):
            if card.fields[first]:
                row = (card.integer(first), max(card.integer(first + 1), 1))
                (value,) = card.floats(first + 2, 1)
                matrices[name].entries.append((*row, *column, value))
    chosen_name = matrix_name.upper()
    if not chosen_name and len(matrices) == 1:
        (chosen_name,) = matrices
    if chosen_name not in matrices or not matrices[chosen_name].entries:
        fail(
            str(path),
            f"one of its matrices is expected, as FILE:MATRIX; it has {', '.join(matrices)}.",
        )
    matrix = matrices[chosen_name]
    if matrix.form not in _SQUARE_FORMS:
        fail(
            str(path),
            f"a square or symmetric matrix is expected, but {chosen_name} is of form "
            f"{matrix.form}.",
        )
    return np.array(matrix.entries)
