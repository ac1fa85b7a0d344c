"""Mesh files of several programs: the same cells and sets; what cannot be read is said."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from fe.elements.kinds import KINDS, meshio_with_wedges
from fe.runtime.errors import MeshError
from fe.structure.field import static_responses
from fe.structure.mesh import StructureMesh
from fe.structure.mesh_file import read_mesh
from fe.structure.operators import load_and_assemble

DECKS = Path("/usr/share/doc/calculix-ccx-test/examples/test")


@pytest.mark.parametrize("kind", ["tetra", "tetra10", "hexahedron", "hexahedron20", "wedge", "wedge15"])
@pytest.mark.parametrize(
    ("name", "file_format"),
    [("m.vtu", "vtu"), ("m.msh", "gmsh"), ("o.msh", "gmsh22"), ("m.inp", "abaqus"), ("m.bdf", "nastran")],
)
def test_formats_agree(
    kind: str, name: str, file_format: str, box: Callable[..., Any], tmp_path: Path
) -> None:
    points, cells = box(kind, (2, 1, 1))
    points = points * (20.0, 10.0, 5.0)
    path = tmp_path / name
    data = {}
    if file_format.startswith("gmsh"):
        tags = np.zeros(len(cells), dtype=np.int32)
        data = {"cell_data": {"gmsh:physical": [tags], "gmsh:geometrical": [tags]}}
    meshio_with_wedges().write(path, meshio.Mesh(points, [(kind, cells)], **data), file_format=file_format)
    mesh = read_mesh(path, 1e-3, "mm")
    assert mesh.kind is KINDS[kind]
    np.testing.assert_allclose(mesh.nodes, 1e-3 * points[cells], atol=1e-9)
    assert len(mesh.boundary) == {4: 20, 6: 14, 8: 10}[len(mesh.kind.corners)]


def test_a_nastran_deck_may_be_bulk_data_alone(box: Callable[..., Any], tmp_path: Path) -> None:
    """As Gmsh writes it; the property of an element is its set."""
    points, cells = box("tetra10", (1, 1, 1))
    meshio.write(tmp_path / "whole.bdf", meshio.Mesh(points, [("tetra10", cells)]))
    whole = (tmp_path / "whole.bdf").read_text()
    assert "BEGIN BULK" in whole
    (tmp_path / "bulk.bdf").write_text(whole.split("BEGIN BULK\n")[1])
    found, bulk = (read_mesh(tmp_path / name, 1.0, "m") for name in ("whole.bdf", "bulk.bdf"))
    np.testing.assert_array_equal(bulk.cells, found.cells)
    np.testing.assert_array_equal(bulk.points, found.points)


def test_physical_groups_of_gmsh_are_sets(box: Callable[..., Any], tmp_path: Path) -> None:
    points, cells = box("tetra10", (2, 1, 1))
    faces = [row for row in _faces(cells) if (points[list(row), 0] == 0.0).all()]
    mesh = meshio.Mesh(
        points,
        [("triangle6", faces), ("tetra10", cells)],
        cell_data={
            "gmsh:physical": [np.full(len(faces), 7), np.where(np.arange(len(cells)) < 6, 1, 2)],
            "gmsh:geometrical": [np.full(len(faces), 1), np.full(len(cells), 1)],
        },
        field_data={"wall": np.array([7, 2]), "left": np.array([1, 3]), "right": np.array([2, 3])},
    )
    meshio.write(tmp_path / "m.msh", mesh, file_format="gmsh22")
    found = read_mesh(tmp_path / "m.msh", 1.0, "m")
    assert sorted(found.cells_of("left", "here")) == list(range(6))
    assert sorted(found.cells_of("RIGHT", "here")) == list(range(6, 12))  # another case is the same name
    np.testing.assert_array_equal(found.points[found.nodes_of("wall", "here"), 0], 0.0)
    assert len(found.nodes_of("wall", "here")) == 9
    assert len(found.faces_of("wall", "here")) == 2


def _faces(cells: Any) -> list[list[int]]:
    return [[cell[n] for n in face] for cell in cells.tolist() for face in KINDS["tetra10"].face_nodes]


DECK = """*HEADING
two cubes, as another program writes them
** a comment
*Node, nset=Nall
1, 0, 0, 0
2, 1, 0., 0
3, 2, 0
4, 0, 1, 0
5, 1, 1, 0
6, 2, 1, 0
11, 0, 0, 1
12, 1, 0, 1
13, 2, 0, 1
14, 0, 1, 1
15, 1, 1, 1
16, 2, 1, 1
99, 5, 5, 5
*ELEMENT, TYPE=C3D8R, ELSET=Left
10, 1, 2, 5, 4,
11, 12, 15, 14
*element, type=C3D8, elset=right
20, 2, 3, 6, 5, 12, 13, 16, 15
*NSET, NSET=root, GENERATE
1, 4, 3
11, 14, 3
*NSET, NSET=Both
root, 3
*ELSET, ELSET=BODY
left, RIGHT
*SURFACE, NAME=TOP, TYPE=ELEMENT
left, S2
20, S2
*ELEMENT, TYPE=CPS4, ELSET=END
31, 3, 6, 16, 13
*MATERIAL, NAME=whatever
*ELASTIC
1., 0.3
"""


def test_a_deck_is_read_with_its_sets(tmp_path: Path) -> None:
    (tmp_path / "m.inp").write_text(DECK)
    mesh = read_mesh(tmp_path / "m.inp", 1.0, "m")
    assert mesh.cell_numbers.tolist() == [10, 20]
    assert mesh.cells_of("BODY", "here").tolist() == [0, 1]
    assert mesh.cells_of("left", "here").tolist() == [0]
    for name, numbers in {"root": [1, 4, 11, 14], "both": [1, 3, 4, 11, 14], "end": [3, 6, 13, 16]}.items():
        assert mesh.node_numbers[mesh.nodes_of(name, "here")].tolist() == numbers
    top = mesh.faces_of("top", "here")
    assert (top.cell.tolist(), top.face.tolist()) == ([0, 1], [1, 1])
    assert len(mesh.nodes_of("TOP", "here")) == 6
    assert len(mesh.faces_of("END", "here")) == 1
    assert mesh.loose.tolist() == [99]
    with pytest.raises(MeshError, match=r"1 of the nodes of the set 'Nall' .* touch no cell"):
        mesh.nodes_of("Nall", "support[1]")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("type=C3D8,", "type=S4R,", r"m\.inp, line 21: elements of type 'S4R' cannot be read; C3D4, "),
        (
            "*NSET, NSET=root",
            "*ELEMENT, TYPE=C3D6\n7, 1, 2, 4, 11, 12, 14\n8, 2, 5, 4, 12, 15, 14\n"
            "*NSET, NSET=root",
            "line 24: .* one kind .*, but 2 8-node hexahedra, 2 6-node wedges "
            "came; mesh it with tetrahedra alone",
        ),
        ("20, 2, 3", "12, 12, 15, 14, 1, 2, 5, 4, 11\n20, 2, 3", "1 elements, such as 12, have the"),
        ("3, 2, 0\n", "3, 2, 0\n3, 2, 1\n", "line 8: node 3 is there twice, at different places; delete one"),
        ("*MATERIAL", "*SOLID SECTION, ELSET=end\n*MATERIAL", "line 35: 1 bars, membranes or .* 'END'"),
        ("*Node, nset", "*Node, input=x, nset", r"line 4: \*NODE with 'INPUT' is not read; write"),
        ("*Node, nset", "*Node, system=s, nset", r"line 4: \*NODE with SYSTEM=S is not read"),
        ("*MATERIAL", "*SYSTEM\n0, 0, 0, 1, 0, 0\n2, 0, 0\n*MATERIAL", "line 35: the three points"),
        ("*MATERIAL", "*SYSTEM\n0, 0\n*MATERIAL", r"line 35: \*SYSTEM needs one, two or three points"),
        ("1, 4, 3\n", "1, 9999999999, 3\n", "line 24: the sets hold more than 5,000,000"),
        ("12, 13, 16, 15", "12, 13, 16", "line 21: 8 numbers are not a multiple of 9, as C3D8 needs"),
        ("2, 1, 0., 0\n", "2, 1, O., 0\n", r"line 6: a real number is expected, but 'O\.' came"),
        ("2, 1, 0., 0\n", "2, nan, 0., 0\n", "line 6: a real number is expected, but 'nan' came"),
        ("3, 2, 0\n", "3, 1e200, 1e200, 1e200\n", "1 of 2 elements are inside out or flat"),
        ("20, 2, 3", "20, 2, 77", "element 20 names node 77, which is not there"),
        ("20, 2, 3", "10, 2, 3", "line 22: element 10 is there twice"),
        ("20, 2, 3", "x, 2, 3", "line 22: a whole number is expected, but 'x' came"),
        ("1, 4, 3\n", "1, 7, 3\n", "the set 'root' names node 7, which is not there"),
        ("left, RIGHT", "left, 55", "the set 'BODY' names element 55, which is not there"),
        ("20, S2", "20, S7", r"line 32: a face S1 to S6 of 8-node hexahedra is expected, but 'S7' came"),
        ("1, 4, 3\n", "1\n", r"line 24: first, last and step are expected, but '1' came"),
        ("1, 4, 3\n", "1, 4, 0\n", r"first, last and step are expected, but '1,4,0' came"),
        ("*HEADING", "*PART", r"line 1: \*PART makes a deck of parts, which is not read; write it without"),
        ("*NSET, NSET=Both", "*NSET", r"line 26: \*NSET must say NSET=a name"),
        ("11, 12, 15, 14\n", "11, 14, 15, 12\n", r"1 of 2 elements .* flat .* element 10 at \(0\.5, "),
        ("2, 3, 6, 5, 12, 13, 16, 15", "3, 2, 5, 6, 13, 12, 15, 16", "1 of 2 elements are inside out"),
        (
            "13, 2, 0, 1",
            "13, 2, 0, 1\n" + "".join(f"{20 + n}, {9 + x}, {y}, {z}\n" for n, (x, y, z) in enumerate(
                [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
            )) + "*ELEMENT, TYPE=C3D8\n50, 20, 21, 22, 23, 24, 25, 26, 27\n*NODE",
            r"falls into 2 parts .* the smallest, of 1 elements, is around \(9\.5, 0\.5, 0\.5\)",
        ),
    ],
)  # fmt: skip
def test_a_fault_of_a_deck_is_said_with_its_line(old: str, new: str, sentence: str, tmp_path: Path) -> None:
    assert old in DECK
    (tmp_path / "m.inp").write_text(DECK.replace(old, new, 1))
    with pytest.raises(MeshError, match=sentence):
        read_mesh(tmp_path / "m.inp", 1.0, "m")


def test_other_files_that_cannot_be_read_are_refused(
    box: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def check(name: str, words: str) -> None:
        with pytest.raises(MeshError) as caught:
            read_mesh(tmp_path / name, 1.0, "m")
        assert words in str(caught.value)

    check("none.msh", "is not there")
    check(".", "is a folder; `mesh` must name it as seen")
    for name, content, words in (
        ("e.msh", "", "e.msh is empty"),
        ("e.inp", "", "e.inp is empty"),
        ("c.inp", "*NODE\n1, 0, 0, 0\n", "but none that is solid came"),
        ("m.msh", "nonsense", "cannot be read"),
        ("m.xyz", "nonsense", "cannot be read"),
        ("m.vtu", "<nonsense/>", "m.vtu cannot be read as .vtu: Couldn't read file"),
    ):
        (tmp_path / name).write_text(content)
        check(name, words)
    assert capsys.readouterr() == ("", "")
    points, cells = box("hexahedron", (1, 1, 1))
    finer, tetrahedra = box("tetra10", (1, 1, 1))
    kinds = (("hexahedron", 8), ("wedge", 6), ("hexahedron", 8))
    two_kinds = "wedges), but 2 8-node hexahedra, 1 6-node wedges came; mesh it with tetrahedra alone"
    swapped = tetrahedra[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]
    for places, blocks, words in (
        (points, [(kind, cells[:, :count]) for kind, count in kinds], two_kinds),
        (points, [("pyramid", cells[:, :5])], "wedges), but 1 pyramid came"),
        (points, [("quad", cells[:, :4])], "but none that is solid came"),
        (finer, [("tetra10", swapped)], "lies far from the middle of its edge"),
    ):
        meshio.write(tmp_path / "p.vtu", meshio.Mesh(places, blocks))
        check("p.vtu", words)


@pytest.mark.skipif(not DECKS.is_dir(), reason="Debian's calculix-ccx-test is not installed")
@pytest.mark.parametrize("name", ["beam10p", "beam20p", "beam8p"])
def test_decks_of_calculix_give_its_published_results(name: str, tmp_path: Path) -> None:
    # The same load at each node of a set along y; results are printed with seven digits.
    deck = gzip.decompress((DECKS / f"{name}.inp.gz").read_bytes()).decode()
    (tmp_path / "m.inp").write_text(deck)
    given = read_mesh(tmp_path / "m.inp", 1.0, "m")
    loaded, force, supports = _loads_and_supports(deck, given)
    text = ['name = "deck"', 'mesh = "m.inp"', 'length_unit = "mm"']
    text += ["[[material]]", 'name = "steel"', "density = 0", "young_modulus = 2.1e11", "poisson_ratio = 0.3"]
    for part, axes in supports:
        text += ["[[support]]", f'set = "{part}"', f"hold = {axes}"]
    for number, point in enumerate(given.points[loaded]):
        text += ["[[load]]", f'name = "n{number}"', f"point = {point.tolist()}", f"force = [0, {force}, 0]"]
    extra = [f"*NSET, NSET=NODE{n}\n{n}" for n in (1, 3)]
    (tmp_path / "m.inp").write_text(deck.rstrip() + "\n" + "\n".join(extra) + "\n")
    (tmp_path / "s.toml").write_text("\n".join(text))
    structure = load_and_assemble(tmp_path / "s.toml")
    total = sum(found.displacement for found in static_responses(structure).values())
    field = 1e3 * structure.full_displacement(np.asarray(total))
    raw = (DECKS / f"{name}.dat.ref.gz").read_bytes()
    printed = gzip.decompress(raw).decode().split("displacements")[1].splitlines()[2:]
    of_nodes = [line.split() for line in printed if len(line.split()) == 4][: len(given.points)]
    rows = np.array(of_nodes, dtype=float)
    assert rows[:, 0].tolist() == given.node_numbers.tolist()
    assert np.abs(rows[:, 1:] - field).max() < 1e-6 * np.abs(field).max()


def _loads_and_supports(deck: str, mesh: StructureMesh) -> tuple[Any, float, list[tuple[str, str]]]:
    """What the three decks say below *CLOAD and *BOUNDARY."""
    name, direction, force = deck.split("*CLOAD")[1].splitlines()[1].split(",")
    assert direction == "2"
    supports = []
    for block in deck.split("*BOUNDARY")[1:]:
        for line in block.splitlines()[1:]:
            if line.startswith("*"):
                break
            place, first, *last = (part.strip() for part in line.split(",") if part.strip())
            axes = "xyz"[int(first) - 1 : int((last or [first])[0])]
            supports.append((f"NODE{place}" if place.isdigit() else place, str([*axes])))
    return mesh.nodes_of(name, "here"), float(force), supports
