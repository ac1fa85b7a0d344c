"""Matrices and vectors of finite element codes, read from their files.

What stands in a file tells its format: MatrixMarket; archives of NumPy and SciPy (`.npz`, `.npy`); DMIG of
Nastran; tables of `row column value` (CalculiX' `.sti` and `.mas`, Abaqus' COORDINATE) or of `node component
node component value` (Abaqus' MATRIX INPUT). Those that name nodes bring their own unknowns.
"""

import io
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy import io as scipy_io
from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import MeshError
from fe.sentences import said
from reporting.text_file import read_text

from .deck import fail
from .decks import cards
from .design import file_of

Place = tuple[int, int]
"""Node and component: 1, 2, 3 along x, y, z, then 4, 5, 6 about them."""

_PLACE = re.compile(r"\s*(\d+)\s*[.,;\s]\s*([1-6])\s*")
_SQUARE, _REAL = (1, 6), (1, 2)  # forms and types of Nastran


def read_unknowns(path: Path) -> list[Place]:
    """Read the node and component of each row, a line each: `97.3`, `97 3` or `97,3`.

    Raises
    ------
    MeshError
        If it cannot be read, or a line is no such pair.
    """
    found = []
    for number, line in enumerate(read_text(path, MeshError, what="file of unknowns").splitlines(), start=1):
        match = _PLACE.fullmatch(line)
        if match is not None:
            found.append((int(match[1]), int(match[2])))
        elif line.strip():
            fail(f"{path}, line {number}", said("matrices.unknowns", came=line))
    return found


def read_matrix(folder: Path, name: str) -> tuple[sparse.csr_array, list[Place] | None]:
    """Read the matrix that `FILE` or `FILE:MATRIX` names, and the unknown of each row where the file says it.

    One of each two entries that mirror each other may be left out of a table.

    Raises
    ------
    MeshError
        If it cannot be read, or holds no such matrix.
    """
    file, chosen = file_of(name)
    path = folder / file
    table, is_table = _read(path, chosen)
    if not is_table:
        if table.ndim != 2 or table.shape[0] != table.shape[1] or table.dtype.kind not in "fiu":
            came = f"{table.dtype} of shape {table.shape}"
            fail(str(path), f"a square matrix of real numbers is expected, but {came} came.")
        return sparse.csr_array(table, dtype=np.float64), None
    width = table.shape[1]
    if width not in (3, 5) or not table.size or not np.array_equal(table[:, :-1], np.rint(table[:, :-1])):
        fail(str(path), said("matrices.lines", count=len(table), width=width))
    whole, places = table[:, :-1].astype(np.int64), None
    if width == 5:
        own, number = np.unique(whole.reshape(-1, 2), axis=0, return_inverse=True)
        places = [(node, component) for node, component in own.tolist()]
        whole = number.reshape(-1, 2) + 1
    elif whole.min() < 1:
        fail(str(path), "rows and columns are counted from 1, but there is a smaller one.")
    at, size = tuple(whole.T - 1), int(whole.max())
    matrix, pattern = (
        sparse.coo_array((values, at), (size, size)).tocsr() for values in (table[:, -1], np.ones(len(table)))
    )
    both = pattern.multiply(pattern.T).tocoo()
    if (both.row == both.col).all():
        matrix = (matrix + matrix.T - sparse.diags_array(matrix.diagonal())).tocsr()
    return matrix, places


def read_vector(folder: Path, name: str, named: Callable[[Place], FloatArray], size: int) -> FloatArray:
    """Read a vector (n,): as many numbers as there are unknowns, or lines of node, component and value.

    Parameters
    ----------
    folder : Path
        Where the file is.
    name : str
        `FILE` or `FILE:ARRAY`.
    named : callable
        Return the vector (n,) that 1 at a node's component stands for.
    size : int
        Number n of unknowns.

    Raises
    ------
    MeshError
        If it cannot be read or has another length.
    """
    file, chosen = file_of(name)
    found, is_table = _read(folder / file, chosen)
    if is_table and found.shape[1] == 3:
        parts = [value * named((int(node), int(component))) for node, component, value in found]
        return np.asarray(np.sum(parts, axis=0))
    values = np.asarray(found.todense() if sparse.issparse(found) else found, dtype=np.float64)
    if values.size != size or max(values.shape) != size:
        fail(str(folder / file), said("matrices.vector", size=size, shape=values.shape))
    return values.ravel()


def _read(path: Path, chosen: str) -> tuple[Any, bool]:
    """Return the array of a file, and whether it is a table: lines of a place or two, and a value."""
    try:
        if path.suffix in (".npz", ".npy"):
            return _archived(path, chosen), False
        text = read_text(path, MeshError, what="matrix file", otherwise="latin-1")
        if text.startswith("%%MatrixMarket"):
            return scipy_io.mmread(path), False
        if re.search(r"^DMIG", text, re.MULTILINE):
            return _nastran(path, chosen), True
        if not text.strip():
            raise ValueError("it is empty")
        lines = io.StringIO(text.replace(",", " "))
        return np.loadtxt(lines, comments=("**", "#", "$"), ndmin=2), True
    except (ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile) as error:
        fail(str(path), f"the file cannot be read as a matrix: {' '.join(str(error).split())}.")


def _archived(path: Path, chosen: str) -> Any:
    if path.suffix == ".npy":
        return np.load(path, allow_pickle=False)
    with np.load(path, allow_pickle=False) as archive:
        if "format" in archive:
            return sparse.load_npz(path)
        names = list(archive)
        if chosen not in names and (chosen or len(names) != 1):
            fail(str(path), f"one of its arrays is expected, as FILE:ARRAY; it has {', '.join(names)}.")
        return archive[chosen or names[0]]


def _nastran(path: Path, chosen: str) -> FloatArray:
    """Read a real square matrix from the DMIG of the bulk data."""
    kind: dict[str, int] = {}
    entries: dict[str, list[tuple[float, ...]]] = {}
    for card in cards(path):
        if card.word != "DMIG":
            continue
        name = card.fields[0].upper()
        if name not in kind:  # the first of a name is its head
            kind[name] = card.whole(2)
            if card.whole(3) not in _REAL:
                fail(card.where, f"a real matrix is expected, but {name} is complex.")
            entries[name] = []
            continue
        column = (card.whole(1), max(card.whole(2), 1))
        for first in range(4, len(card.fields), 4):
            if card.fields[first]:
                row = (card.whole(first), max(card.whole(first + 1), 1))
                entries[name].append((*row, *column, *card.reals(first + 2, 1)))
    wanted = chosen.upper() or (next(iter(kind)) if len(kind) == 1 else "")
    if wanted not in entries or not entries[wanted]:
        fail(str(path), f"one of its matrices is expected, as FILE:MATRIX; it has {', '.join(kind)}.")
    if kind[wanted] not in _SQUARE:
        fail(str(path), f"a square or symmetric matrix is expected, but {wanted} is of form {kind[wanted]}.")
    return np.array(entries[wanted])
