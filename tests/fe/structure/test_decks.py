"""Decks of Abaqus and Nastran: coordinates of any kind, what is generated, what must not be lost, faults."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fe.elements.cells import jacobians
from fe.elements.kinds import meshio_with_wedges
from fe.runtime.errors import MeshError
from fe.structure.deck import words_of
from fe.structure.mesh import StructureMesh
from fe.structure.mesh_file import read_by_meshio, read_mesh

ORIGIN = np.array([0.3, -1.2, 0.7])
TURN = Rotation.from_rotvec([0.4, -0.9, 1.3])


def coordinates(points: Any, kind: str) -> Any:
    """Coordinates (n, 3) of points in the system at ORIGIN that TURN turned: what a reader undoes."""
    x, y, z = TURN.inv().apply(points - ORIGIN).T
    flat = np.hypot(x, y)
    around, down = np.rad2deg(np.arctan2(y, x)), np.rad2deg(np.arctan2(flat, z))
    found = {"R": (x, y, z), "C": (flat, around, z), "S": (np.hypot(flat, z), down, around)}
    return np.column_stack(found[kind])


def written(path: Path, *lines: str) -> StructureMesh:
    path.write_text("\n".join(lines) + "\n", encoding="latin-1")
    return read_mesh(path, 1.0, "m")


def volume(mesh: StructureMesh) -> float:
    local, weight = mesh.kind.mass_rule
    return float((np.linalg.det(jacobians(mesh.kind, mesh.nodes, local)) * weight).sum())


def card(*fields: object) -> str:
    return ",".join(f"{field:.12g}" if isinstance(field, float) else str(field) for field in fields)


@pytest.mark.parametrize("kind", ["R", "C", "S"])
@pytest.mark.parametrize("form", [1, 2])
def test_grid_points_of_any_coordinate_system(
    kind: str, form: int, box: Callable[..., Any], tmp_path: Path
) -> None:
    """The system stands on another one that is shifted and turned; its grid points come before it."""
    points, cells = box("hexahedron20", (2, 1, 1))
    axes = TURN.as_matrix().T
    three = [ORIGIN, ORIGIN + 2.0 * axes[2], ORIGIN + 3.0 * axes[0] - axes[2]]
    shift = np.array([5.0, 6.0, 7.0])
    given = [(point - shift)[[1, 2, 0]] for point in three]  # in a system whose x is the y of space
    lines = [
        *(card("GRID", n, 4, *row.tolist()) for n, row in enumerate(coordinates(points, kind), start=1)),
        card("CORD2R", 9, 0, *shift.tolist(), 6.0, 6.0, 7.0, "+"),
        card("+", 5.0, 7.0, 7.0),
        *(card("GRID", 900 + n, "", *row.tolist()) for n, row in enumerate(given)),
        "GRDSET,,9",
        f"CORD1{kind}       4     900     901     902"
        if form == 1
        else card(f"CORD2{kind}", 4, 9, *given[0].tolist(), *given[1].tolist(), "\n", *given[2].tolist()),
    ]
    order = [*range(12), *range(16, 20), *range(12, 16)]
    for number, cell in enumerate(cells[:, order] + 1, start=1):
        lines += [card("CHEXA", number, 7, *cell[:6], "+"), card("+", *cell[6:14], ""), card("", *cell[14:])]
    mesh = written(tmp_path / "m.bdf", "SOL 101", "BEGIN BULK", *lines, "ENDDATA", "nonsense")
    np.testing.assert_allclose(mesh.nodes, points[cells], atol=1e-10)
    assert len(mesh.cells_of("nastran:ref=7", "here")) == 2
    assert volume(mesh) == pytest.approx(1.0)
    assert mesh.remarks == ()


def test_real_numbers_and_lines_of_nastran(tmp_path: Path) -> None:
    """Exponents without E, fields of 8 and 16, lines that go on by a comma, a marker or a blank."""
    mesh = written(
        tmp_path / "m.bdf",
        "$ Größe",
        "GRID*                  1                              0.              0.*A",
        "*A                   0.0",
        "GRID           2            1.+0      0.      0.",
        "GRID,3,,0.,10.-1,0.",
        "GRID,4,,0.,0.,1.D0",
        "CTETRA,8,,1,2,3,4   $ its property is its number",
        "RWHAT   1       2",
        "RWHAT   3",
    )
    np.testing.assert_array_equal(mesh.nodes[0], [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert len(mesh.cells_of("nastran:ref=8", "here")) == 1
    assert len(mesh.remarks) == 1
    assert "m.bdf, line 8: RWHAT (2 times) is not known and was passed over" in mesh.remarks[0]


BULK = ["GRID,1,,0.,0.,0.", "GRID,2,,1.,0.,0.", "GRID,3,,0.,1.,0.", "GRID,4,,0.,0.,1.", "CTETRA,8,1,1,2,3,4"]


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("GRID,2,,", "GRID,2,5,", "line 2: the coordinate system 5 is not there"),
        ("GRID,2,,", "CORD1R,5,1,2,3\nGRID,2,5,", "the coordinate system 5 rests on itself, or on too many"),
        ("GRID,2,,", "CORD2R,5,5,0.,0.,0.,0.,0.,1.\n,1.\nGRID,2,5,", "coordinate system 5 rests on itself"),
        ("GRID,2,,", "CORD2C,5,,0.,0.,0.,0.,0.,1.\n,0.,0.,2.\nGRID,2,5,", "line 2: the three points .* line"),
        ("GRID,2,,", "CORD1C,5,1,3,77\nGRID,2,5,", "line 2: the grid point 77 is not there"),
        ("GRID,2,,1.", "GRID,2,,1.x", "line 2: a real number is expected, but '1.x' came"),
        ("1,1,2,3,4", "1,1,2,3,4,5", "line 5: CTETRA 8 must have 4 or 10 nodes, but 5 came"),
        ("CTETRA,8,1", "CTRIA3,7,1,1,2,3\nPSHELL,1,1,.1\nCTETRA,8,2", "line 6: 1 bars, membranes or shells"),
        ("CTETRA,8,1", "CPYRAM,9,1,1,2,3,4,1\nCTETRA,8,1", "line 5: CPYRAM makes pyramids, which are not"),
        ("GRID,1", ",5.\nGRID,1", "line 1: the continuation '' stands behind no line that it continues"),
        ("2,3,4", "2,3,4,+A\n+B", r"line 6: the continuation '\+B' stands behind no line that it continues"),
        ("2,3,4", "2,3,4,,,,9", "line 5: a line of at most 10 fields is expected, but 11 came"),
        ("GRID,1", "INCLUDE 'm.bdf'\nGRID,1", r"m\.bdf, line 1: .*m\.bdf includes itself"),
        ("CTETRA,8,1,1,2,3,4", "", "a whole mesh of .* but none that is solid came"),
    ],
)
def test_a_fault_of_a_nastran_deck_is_said_with_its_line(
    old: str, new: str, sentence: str, tmp_path: Path
) -> None:
    text = "\n".join(BULK)
    assert old in text
    with pytest.raises(MeshError, match=sentence):
        written(tmp_path / "m.bdf", text.replace(old, new, 1))


NODES = ["*NODE", "1, 0, 0, 0", "2, 1, 0, 0", "3, 0, 1, 0", "4, 0, 0, 1"]
SOLID = [*NODES, "*ELEMENT, TYPE=C3D4", "8, 1, 2, 3, 4"]


@pytest.mark.parametrize(
    ("dialect", "word"),
    [(name, word) for name in ("abaqus", "nastran") for word in sorted(words_of(name).refused)],
)
def test_what_must_not_be_lost_is_refused_with_a_remedy(dialect: str, word: str, tmp_path: Path) -> None:
    name, lines = ("m.inp", SOLID) if dialect == "abaqus" else ("m.bdf", BULK)
    mark = words_of(dialect).mark
    with pytest.raises(MeshError) as caught:
        written(tmp_path / name, *lines, f"{mark}{word.lower()}, 1", "1, 2, 3")
    sentence = str(caught.value)
    assert f"{name}, line {len(lines) + 1}: {mark}{word} " in sentence
    assert "; " in sentence  # what it does, and what to do


@pytest.mark.parametrize("dialect", ["abaqus", "nastran"])
def test_a_word_is_read_or_harmless_or_refused_or_told(dialect: str, tmp_path: Path) -> None:
    words = words_of(dialect)
    assert not words.harmless & words.refused.keys()
    assert not words.read.keys() & (words.harmless | words.refused.keys())
    name, lines = ("m.inp", SOLID) if dialect == "abaqus" else ("m.bdf", BULK)
    passed = [f"{words.mark}{word}" for word in sorted(words.harmless)]
    mesh = written(tmp_path / name, *lines, *passed, f"{words.mark}NEWWORD")
    (remark,) = mesh.remarks
    assert f"line {len(lines) + len(passed) + 1}: {words.mark}NEWWORD is not known and was passed" in remark


@pytest.mark.parametrize("kind", ["R", "C"])
def test_nodes_of_abaqus_in_a_system_of_their_own(kind: str, box: Callable[..., Any], tmp_path: Path) -> None:
    points, cells = box("tetra10", (1, 1, 1))
    axes = TURN.as_matrix().T
    system = np.concatenate((ORIGIN, ORIGIN + 2.0 * axes[0], ORIGIN + axes[1] + axes[0]))
    rows = [
        "*SYSTEM",
        card(*system[:6].tolist()),
        card(*system[6:].tolist()),
        f"*NODE, NSET=A,\n SYSTEM={kind}",
        *(card(n, *row.tolist()) for n, row in enumerate(coordinates(points, kind), start=1)),
        "*SYSTEM",
        "*NODE",
        "99, 1, 2, 3",
        "*ELEMENT, TYPE=C3D10, ELSET=E",
        *(card(n, *(cell + 1).tolist()) for n, cell in enumerate(cells, start=1)),
    ]
    mesh = written(tmp_path / "m.inp", *rows)
    np.testing.assert_allclose(mesh.nodes, points[cells], atol=1e-10)
    assert len(mesh.nodes_of("a", "here")) == len(points)
    assert mesh.loose.tolist() == [99]
    shifted = written(tmp_path / "m.inp", "*SYSTEM", "1, 2, 3", *SOLID)
    np.testing.assert_allclose(shifted.nodes[0, 0], (1.0, 2.0, 3.0))
    # A point on x alone turns x about z, after its height is left out.
    turned = written(tmp_path / "m.inp", "*SYSTEM", ",, 0, , 3, 4,", *SOLID)
    np.testing.assert_allclose(turned.nodes[0], [[0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-15)


def test_decks_that_include_others(tmp_path: Path) -> None:
    (tmp_path / "nodes.inp").write_text("\n".join(SOLID[:5]))
    mesh = written(tmp_path / "m.inp", "*INCLUDE, INPUT=nodes.inp", *SOLID[5:])
    assert volume(mesh) == pytest.approx(1.0 / 6.0)
    (tmp_path / "grids.bdf").write_text("\n".join(BULK[:4]))
    mesh = written(tmp_path / "m.bdf", "BEGIN BULK", "include 'grids.bdf'", *BULK[4:])
    assert volume(mesh) == pytest.approx(1.0 / 6.0)
    with pytest.raises(MeshError, match=r"m\.inp, line 1: .*m\.inp includes itself"):
        written(tmp_path / "m.inp", *["*INCLUDE, INPUT=../" + tmp_path.name + "/m.inp"] * 100, *SOLID)


def test_an_element_of_two_physical_groups_counts_once(box: Callable[..., Any], tmp_path: Path) -> None:
    """As Gmsh writes it in version 2: the element again for each group."""
    points, cells = box("tetra", (1, 1, 1))
    mesh = meshio.Mesh(
        points,
        [("tetra", np.concatenate((cells, cells[:2])))],
        cell_data={"gmsh:physical": [[1] * 6 + [2] * 2], "gmsh:geometrical": [[1] * 8]},
        field_data={"body": np.array([1, 3]), "lug": np.array([2, 3])},
    )
    meshio.write(tmp_path / "m.msh", mesh, file_format="gmsh22")
    found = read_mesh(tmp_path / "m.msh", 1.0, "m")
    assert volume(found) == pytest.approx(1.0)
    assert len(found.cells_of("body", "here")) == 6
    np.testing.assert_array_equal(found.cells[found.cells_of("lug", "here")], cells[:2])
    meshio.write(tmp_path / "m.vtu", mesh)
    with pytest.raises(MeshError, match=r"m\.vtu: 2 elements, such as 7, have the nodes of another"):
        read_mesh(tmp_path / "m.vtu", 1.0, "m")


@pytest.mark.parametrize("kind", ["tetra", "tetra10", "hexahedron", "hexahedron20", "wedge", "wedge15"])
def test_cells_and_groups_of_med(kind: str, box: Callable[..., Any], tmp_path: Path) -> None:
    """MED counts the nodes of a cell as seen in a mirror; families are of several groups."""
    meshio = meshio_with_wedges()
    points, cells = box(kind, (2, 1, 1))
    half = np.where(points[cells].mean(axis=1)[:, 0] < 0.5, -1, -2)
    found = meshio.Mesh(points * (-1, 1, 1), [(kind, cells)], cell_data={"cell_tags": [half]})
    found.point_tags, found.cell_tags = {}, {-1: ["left", "body"], -2: ["body"]}
    found.point_data["point_tags"] = np.where(points[:, 0] == 0.0, 1, 0)
    found.point_tags = {1: ["root"]}
    meshio.write(tmp_path / "m.med", found)
    mesh = read_mesh(tmp_path / "m.med", 1.0, "m")
    assert volume(mesh) == pytest.approx(1.0)
    assert len(mesh.cells_of("left", "here")) == len(cells) // 2
    assert len(mesh.cells_of("body", "here")) == len(cells)
    np.testing.assert_array_equal(mesh.points[mesh.nodes_of("root", "here"), 0], 0.0)


def test_arrays_of_a_vtu_that_are_sets(box: Callable[..., Any], tmp_path: Path) -> None:
    """As meshio writes sets, and as a mask of zeros and ones; the values keep their names."""
    points, cells = box("hexahedron", (2, 1, 1))
    mesh = meshio.Mesh(
        points,
        [("hexahedron", cells)],
        cell_sets={"left": [[0]]},
        point_sets={"root": np.flatnonzero(points[:, 0] == 0.0)},
        cell_data={"right": [[0, 1]]},
    )
    mesh.cell_sets_to_data()
    mesh.point_sets_to_data()
    meshio.write(tmp_path / "m.vtu", mesh)
    found = read_mesh(tmp_path / "m.vtu", 1.0, "m")
    far = points + 10.0
    blocks = [("hexahedron", cells), ("hexahedron", cells + len(points))]
    parted = {"part": [[0, 1], [1, 1]], "set": [[-1, 0], [0, 0]]}  # all of the second block
    meshio.write(tmp_path / "n.vtu", meshio.Mesh(np.vstack((points, far)), blocks, cell_data=parted))
    with pytest.raises(MeshError, match="falls into 2 parts"):
        read_mesh(tmp_path / "n.vtu", 1.0, "m")
    sets = read_by_meshio(tmp_path / "n.vtu").mesh(1.0, "m").cell_sets
    assert sets["part"].tolist() == sets["set"].tolist() == [1, 2, 3]
    for name, cell in {"left": 0, "left=0": 0, "left=-1": 1, "right": 1, "right=1": 1}.items():
        assert found.cells_of(name, "here").tolist() == [cell]
    np.testing.assert_array_equal(found.points[found.nodes_of("root", "here"), 0], 0.0)
    assert len(found.faces_of("root", "here")) == 1
