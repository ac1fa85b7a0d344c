"""Write fields on a mesh as a VTU file, VTK's XML format for ParaView.

Arrays are compressed by zlib, in one block each, and written in base64, as VTK's class
`vtkXMLUnstructuredGridReader` reads them. meshio writes the same format, but its import takes as
long as the work.
"""

import base64
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
import numpy.typing as npt

from fe.runtime.arrays import AnyArray, FloatArray, IntArray
from reporting.files import atomic_file

Data = Mapping[str, npt.ArrayLike]
"""Values of points or cells, by name."""

VTK_NUMBERS = {
    "vertex": 1,
    "tetra": 10,
    "hexahedron": 12,
    "wedge": 13,
    "tetra10": 24,
    "hexahedron20": 25,
    "wedge15": 26,
}
"""VTK's number of each kind of cell, by meshio's name."""

_WEDGE_ORDER = (0, 2, 1, 3, 5, 4)
"""Nodes of a 6-node wedge in VTK's order: its bases are counted the other way round there."""

_COMPRESSION_LEVEL = 1
"""The fastest level of zlib: a higher one takes three times as long for a tenth of the file."""


def write_vtu(
    path: Path | str,
    points: FloatArray,
    cells: tuple[str, IntArray],
    point_data: Data,
    cell_data: Data,
) -> None:
    """Write a VTU file, whole or not at all.

    Parameters
    ----------
    points : (nn, 3) array
        Positions of the nodes [m].
    cells : (str, (nc, k) array of int)
        The kind of the cells, a key of `VTK_NUMBERS`, and their nodes in the order of
        `fe.elements.kinds`.

    Raises
    ------
    FileNotWrittenError
        If the file cannot be written.
    """
    kind, nodes = cells
    if kind == "wedge":
        nodes = nodes[:, _WEDGE_ORDER]
    cell_count, nodes_per_cell = nodes.shape
    cell_arrays = {
        "connectivity": nodes.ravel(),
        "offsets": nodes_per_cell * np.arange(1, cell_count + 1),
        "types": np.full(cell_count, VTK_NUMBERS[kind]),
    }
    byte_order = "LittleEndian" if sys.byteorder == "little" else "BigEndian"
    lines = [
        '<?xml version="1.0"?>',
        f'<VTKFile type="UnstructuredGrid" version="1.0" byte_order="{byte_order}" '
        'header_type="UInt64" compressor="vtkZLibDataCompressor">',
        "<UnstructuredGrid>",
        f'<Piece NumberOfPoints="{len(points)}" NumberOfCells="{cell_count}">',
        *_section("Points", {"Points": points}),
        *_section("Cells", cell_arrays),
        *_section("PointData", point_data),
        *_section("CellData", cell_data),
        "</Piece>",
        "</UnstructuredGrid>",
        "</VTKFile>",
    ]
    with atomic_file(path) as temporary:
        Path(temporary).write_text("\n".join(lines) + "\n", encoding="ascii")


def _section(name: str, arrays: Data) -> list[str]:
    """Return the lines of an XML element that holds arrays."""
    lines = [f"<{name}>"]
    for array_name, values in arrays.items():
        lines.append(_data_array(array_name, np.ascontiguousarray(values)))
    lines.append(f"</{name}>")
    return lines


def _data_array(name: str, values: AnyArray) -> str:
    """Return the `DataArray` element of an array, converted to 64-bit numbers."""
    is_real = values.dtype.kind == "f"
    number_type = "Float64" if is_real else "Int64"
    content = values.astype(np.float64 if is_real else np.int64, copy=False).tobytes()
    compressed = zlib.compress(content, _COMPRESSION_LEVEL)
    # The header: one block, its size, no shorter last block, and its size when compressed.
    header = np.array([1, len(content), 0, len(compressed)], dtype=np.uint64).tobytes()
    text = (base64.b64encode(header) + base64.b64encode(compressed)).decode("ascii")
    components = f' NumberOfComponents="{values.shape[1]}"' if values.ndim > 1 else ""
    return (
        f'<DataArray type="{number_type}" Name={quoteattr(name)}{components} '
        f'format="binary">{text}</DataArray>'
    )
