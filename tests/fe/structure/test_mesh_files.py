"""Mesh files of all programs: the same cells and sets, coordinates of any kind, faults in a sentence."""

import re
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fe.elements.cells import jacobians
from fe.elements.kinds import KINDS, meshio_with_wedges
from fe.runtime.errors import MeshError
from fe.structure.deck_text import words_of
from fe.structure.mesh import StructureMesh
from fe.structure.mesh_file import read_mesh
from fe.structure.meshio_file import read_by_meshio
from fe.structure.nastran import cards
from tests.meshes import box
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)
CUBES, TETRAHEDRON = INPUTS.text("cubes.inp"), INPUTS.text("tetrahedron.bdf").splitlines()
SOLID = INPUTS.text("tetrahedron.inp").splitlines()
DIALECTS = {"abaqus": ("m.inp", SOLID), "nastran": ("m.bdf", TETRAHEDRON)}
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


def refuses(path: Path, sentence: str) -> None:
    with refused(MeshError, sentence):
        read_mesh(path, 1.0, "m")


# ---------------------------------------------------------------- formats


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("file_format", ["vtu", "gmsh", "gmsh22", "abaqus", "nastran", "med"])
def test_formats_agree(kind, file_format, tmp_path):
    """MED counts the nodes of a cell as seen in a mirror; its families are of several groups."""
    points, cells = box(kind, (2, 1, 1))
    ending = {"gmsh": "msh", "gmsh22": "msh", "abaqus": "inp", "nastran": "bdf"}.get(
        file_format, file_format
    )
    tags, half = [np.zeros(len(cells), dtype=np.int32)], points[cells].mean(axis=1)[:, 0] < 0.5
    data = {"gmsh:physical": tags, "gmsh:geometrical": tags} if ending == "msh" else {}
    data |= {"cell_tags": [np.where(half, -1, -2)]} if ending == "med" else {}
    mesh = meshio_with_wedges().Mesh(
        points * (-1 if ending == "med" else 1, 1, 1), [(kind, cells)], cell_data=data
    )
    if ending == "med":
        mesh.point_data["point_tags"] = np.where(points[:, 0] == 0.0, 1, 0)
        mesh.point_tags, mesh.cell_tags = {1: ["root"]}, {-1: ["left", "body"], -2: ["body"]}
    meshio.write(tmp_path / f"m.{ending}", mesh, file_format=file_format)
    found = read_mesh(tmp_path / f"m.{ending}", 1e-3, "mm")
    assert found.kind is KINDS[kind]
    assert volume(found) == pytest.approx(1e-9)
    assert len(found.boundary) == {4: 20, 6: 14, 8: 10}[len(found.kind.corners)]
    if ending == "med":
        assert sorted(found.cells_of("left", "here")) == np.flatnonzero(half).tolist()
        assert len(found.cells_of("body", "here")) == len(cells)
        np.testing.assert_array_equal(found.points[found.nodes_of("root", "here"), 0], 0.0)
    else:
        np.testing.assert_allclose(found.nodes, 1e-3 * points[cells], atol=1e-12)


def test_physical_groups_of_gmsh_are_sets(tmp_path):
    """An element of two groups, which version 2 writes again for each, counts once."""
    points, cells = box("tetra10", (2, 1, 1))
    faces = [
        [cell[n] for n in face] for cell in cells.tolist() for face in KINDS["tetra10"].face_nodes
    ]
    faces = [row for row in faces if (points[row, 0] == 0.0).all()]
    names = {"wall": (7, 2), "left": (1, 3), "right": (2, 3), "lug": (3, 3)}
    groups = [[7] * len(faces), [1] * 6 + [2] * 6 + [3] * 2]
    mesh = meshio.Mesh(
        points,
        [("triangle6", faces), ("tetra10", np.concatenate((cells, cells[:2])))],
        cell_data={
            "gmsh:physical": groups,
            "gmsh:geometrical": [[1] * len(group) for group in groups],
        },
        field_data={name: np.array(pair) for name, pair in names.items()},
    )
    meshio.write(tmp_path / "m.msh", mesh, file_format="gmsh22")
    found = read_mesh(tmp_path / "m.msh", 1.0, "m")
    assert volume(found) == pytest.approx(1.0)
    assert sorted(found.cells_of("left", "here")) == list(range(6))
    assert sorted(found.cells_of("RIGHT", "here")) == list(
        range(6, 12)
    )  # another case is the same name
    np.testing.assert_array_equal(found.cells[found.cells_of("lug", "here")], cells[:2])
    np.testing.assert_array_equal(found.points[found.nodes_of("wall", "here"), 0], 0.0)
    assert (len(found.nodes_of("wall", "here")), len(found.faces_of("wall", "here"))) == (9, 2)
    meshio.write(tmp_path / "m.vtu", meshio.Mesh(points, mesh.cells[1:]))
    refuses(tmp_path / "m.vtu", r"m\.vtu: 2 elements, such as 13, have the nodes of another")


def saved_all(path: Path, groups: list[list[int]], cells: np.ndarray, points: np.ndarray) -> None:
    """Write edges, faces and tetrahedra with their physical groups as Gmsh does with Mesh.SaveAll = 1."""
    edges = [cell[:2] for cell in cells.tolist()[:4]]
    faces = [
        [cell[n] for n in face] for cell in cells.tolist() for face in KINDS["tetra"].face_nodes
    ]
    faces = [row for row in faces if (points[row, 0] == 0.0).all()]
    blocks = [("line", edges), ("triangle", faces), ("tetra", cells)]
    geometrical = [[number] * len(rows) for number, (_, rows) in enumerate(blocks, start=1)]
    data = {"gmsh:physical": groups, "gmsh:geometrical": geometrical}
    names = {"body": np.array([1, 3]), "wall": np.array([7, 2])}
    mesh = meshio.Mesh(points, blocks, cell_data=data, field_data=names)
    meshio.write(path, mesh, file_format="gmsh22", binary=False)


def test_elements_of_gmsh_without_a_physical_group_are_left_out(tmp_path):
    """Solid ones stay where no solid element has a group: then groups are of faces alone."""
    points, cells = box("tetra", (2, 1, 1))
    half = len(cells) // 2
    path = tmp_path / "m.msh"
    saved_all(path, [[0] * 4, [7] * 2, [1] * half + [0] * half], cells, points)
    mesh = read_mesh(path, 1.0, "m")
    np.testing.assert_array_equal(mesh.nodes, points[cells[:half]])
    assert {*mesh.cell_sets} | {*mesh.node_sets} == {
        "body",
        "wall",
        "gmsh:geometrical=2",
        "gmsh:geometrical=3",
    }
    (remark,) = mesh.remarks
    assert f"{half + 4} elements of no physical group are left out; set Mesh.SaveAll = 0" in remark
    saved_all(path, [[0] * 4, [7] * 2, [0] * len(cells)], cells, points)
    mesh = read_mesh(path, 1.0, "m")
    assert len(mesh.cells) == len(cells)
    saved_all(path, [[0] * 4, [0] * 2, [0] * len(cells)], cells, points)
    assert (len(read_mesh(path, 1.0, "m").cells), read_mesh(path, 1.0, "m").remarks) == (
        len(cells),
        (),
    )


ALL_SAVED = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
1
3 1 "body"
$EndPhysicalNames
$Entities
0 0 1 1
5 0 0 0 1 1 0 0 0
1 0 0 0 1 1 1 1 1 0
$EndEntities
$Nodes
1 4 1 4
3 1 0 4
1
2
3
4
0 0 0
1 0 0
0 1 0
0 0 1
$EndNodes
$Elements
2 2 1 2
2 5 2 1
1 1 2 3
3 1 4 1
2 1 2 3 4
$EndElements
"""
"""Of version 4: a tetrahedron in a physical group, and one of its faces in none."""


def test_a_file_of_gmsh_of_version_4_with_all_saved_is_refused_with_the_remedy(tmp_path):
    path = tmp_path / "m.msh"
    path.write_text(ALL_SAVED)
    refuses(
        path,
        r"m\.msh: some elements are in a physical group and others in none, .* Mesh.SaveAll = 0",
    )
    path.write_text(ALL_SAVED.replace("5 0 0 0 1 1 0 0 0", "5 0 0 0 1 1 0 1 7 0"))
    assert read_mesh(path, 1.0, "m").cells_of("body", "here").tolist() == [0]


@pytest.mark.parametrize("file_format", ["gmsh22", "gmsh"])
def test_a_doubled_line_of_gmsh_loses_no_element(file_format, tmp_path):
    """The count in the file stays what it was, so that its last element would not be read."""
    points, cells = box("tetra", (1, 1, 1))
    tags = [np.ones(len(cells), dtype=np.int32)]
    data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    path = tmp_path / "m.msh"
    mesh = meshio.Mesh(points, [("tetra", cells)], cell_data=data)
    meshio.write(path, mesh, file_format=file_format, binary=False)
    assert len(read_mesh(path, 1.0, "m").cells) == len(cells)
    lines = path.read_text().splitlines()
    last = lines.index("$EndElements") - 1
    lines.insert(last, lines[last - 1])
    path.write_text("\n".join(lines) + "\n")
    refuses(path, "but .* follow, and the last would be lost")


def test_arrays_of_a_vtu_that_are_sets(tmp_path):
    """As meshio writes sets, and as a mask of zeros and ones; the values keep their names."""
    points, cells = box("hexahedron", (2, 1, 1))
    root = np.flatnonzero(points[:, 0] == 0.0)
    sets = {
        "cell_sets": {"left": [[0]]},
        "point_sets": {"root": root},
        "cell_data": {"right": [[0, 1]]},
    }
    mesh = meshio.Mesh(points, [("hexahedron", cells)], **sets)
    mesh.cell_sets_to_data()
    mesh.point_sets_to_data()
    meshio.write(tmp_path / "m.vtu", mesh)
    found = read_mesh(tmp_path / "m.vtu", 1.0, "m")
    for name, cell in {"left": 0, "left=0": 0, "left=-1": 1, "right": 1, "right=1": 1}.items():
        assert found.cells_of(name, "here").tolist() == [cell]
    np.testing.assert_array_equal(found.points[found.nodes_of("root", "here"), 0], 0.0)
    assert len(found.faces_of("root", "here")) == 1
    blocks = [("hexahedron", cells), ("hexahedron", cells + len(points))]
    parted = {"part": [[0, 1], [1, 1]], "set": [[-1, 0], [0, 0]]}  # all of the second block
    far = meshio.Mesh(np.vstack((points, points + 10.0)), blocks, cell_data=parted)
    meshio.write(tmp_path / "n.vtu", far)
    refuses(tmp_path / "n.vtu", "falls into 2 parts")
    sets = read_by_meshio(tmp_path / "n.vtu").mesh(1.0, "m").cell_sets
    assert sets["part"].tolist() == sets["set"].tolist() == [1, 2, 3]


def test_other_files_that_cannot_be_read_are_refused(tmp_path, capsys):
    refuses(tmp_path / "none.msh", "is not there")
    refuses(tmp_path, "is a folder; `mesh` must name it as seen")
    for name, content, words in INPUTS.refused("files"):
        (tmp_path / name).write_text(content)
        refuses(tmp_path / name, words)
    assert capsys.readouterr() == ("", "")
    points, cells = box("hexahedron", (1, 1, 1))
    finer, tetrahedra = box("tetra10", (1, 1, 1))
    kinds = [
        (kind, cells[:, :count])
        for kind, count in (("hexahedron", 8), ("wedge", 6), ("hexahedron", 8))
    ]
    swapped = tetrahedra[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]
    for places, blocks, words in (
        (
            points,
            kinds,
            "one kind of elements is expected .*, but 2 8-node hexahedra, 1 6-node wedges",
        ),
        (points, [("pyramid", cells[:, :5])], r"is expected \(.*\), but 1 pyramid came"),
        (points, [("quad", cells[:, :4])], "but none that is solid came"),
        (finer, [("tetra10", swapped)], "lies far from the middle of its edge"),
    ):
        meshio.write(tmp_path / "p.vtu", meshio.Mesh(places, blocks))
        refuses(tmp_path / "p.vtu", words)


# ---------------------------------------------------------------- decks


def test_a_deck_is_read_with_its_sets(tmp_path):
    mesh = written(tmp_path / "m.inp", CUBES, "*SURFACE, NAME=sides", "10, S3", "10, S5")
    assert mesh.cell_numbers.tolist() == [10, 20]
    assert mesh.cells_of("BODY", "here").tolist() == [0, 1]
    assert mesh.cells_of("left", "here").tolist() == [0]
    for name, numbers in {
        "root": [1, 4, 11, 14],
        "both": [1, 3, 4, 11, 14],
        "end": [3, 6, 13, 16],
    }.items():
        assert mesh.node_numbers[mesh.nodes_of(name, "here")].tolist() == numbers
    top = mesh.faces_of("top", "here")
    assert (top.cell.tolist(), top.face.tolist()) == ([0, 1], [1, 1])
    assert (len(mesh.nodes_of("TOP", "here")), len(mesh.faces_of("END", "here"))) == (6, 1)
    assert (
        len(mesh.faces_of("sides", "here")) == 2
    )  # whose nodes are those of all faces of the cube
    assert mesh.loose.tolist() == [99]
    with pytest.raises(MeshError, match=r"1 of the nodes of the set 'Nall' .* touch no cell"):
        mesh.nodes_of("Nall", "support[1]")


@pytest.mark.parametrize(
    ("name", "old", "new", "sentence"),
    [
        (name, *row)
        for name in ("cubes.inp", "tetrahedron.bdf")
        for row in INPUTS.refused(name.split(".")[0])
    ],
)
def test_a_fault_of_a_deck_is_said_with_its_line(name, old, new, sentence, tmp_path):
    path = tmp_path / f"m.{name[-3:]}"
    path.write_text(INPUTS.text(name, (old, new)))
    refuses(path, sentence)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_word_is_read_or_harmless_or_refused_or_told(dialect, tmp_path):
    """What must not be lost is refused with what it does and what to do; what is unknown is told."""
    words, (name, lines) = words_of(dialect), DIALECTS[dialect]
    assert not words.harmless & words.refused.keys()
    assert not words.read.keys() & (words.harmless | words.refused.keys())
    passed = [f"{words.mark}{word}" for word in sorted(words.harmless)]
    (remark,) = written(tmp_path / name, *lines, *passed, f"{words.mark}NEWWORD").remarks
    assert (
        f"line {len(lines) + len(passed) + 1}: {words.mark}NEWWORD is not known and was passed"
        in remark
    )
    for word in sorted(words.refused):
        told = re.escape(f"{name}, line {len(lines) + 1}: {words.mark}{word} ")
        with refused(MeshError, f"{told}.*; "):
            written(tmp_path / name, *lines, f"{words.mark}{word.lower()}, 1", "1, 2, 3")


def test_decks_that_include_others(tmp_path):
    for name, include, count in (
        ("m.inp", "*INCLUDE, INPUT=", 5),
        ("m.bdf", "BEGIN BULK\ninclude ", 4),
    ):
        lines = SOLID if name == "m.inp" else TETRAHEDRON
        (tmp_path / f"part{name}").write_text("\n".join(lines[:count]))
        mesh = written(tmp_path / name, f"{include}part{name}", *lines[count:])
        assert volume(mesh) == pytest.approx(1.0 / 6.0)
    with pytest.raises(MeshError, match=r"m\.inp, line 1: .*m\.inp includes itself"):
        written(tmp_path / "m.inp", *[f"*INCLUDE, INPUT=../{tmp_path.name}/m.inp"] * 100, *SOLID)


@pytest.mark.parametrize("kind", ["R", "C", "S"])
@pytest.mark.parametrize("form", [1, 2])
def test_grid_points_of_any_coordinate_system(kind, form, tmp_path):
    """The system stands on another one that is shifted and turned; its grid points come before it."""
    points, cells = box("hexahedron20", (2, 1, 1))
    axes = TURN.as_matrix().T
    three = [ORIGIN, ORIGIN + 2.0 * axes[2], ORIGIN + 3.0 * axes[0] - axes[2]]
    shift = np.array([5.0, 6.0, 7.0])
    given = [
        (point - shift)[[1, 2, 0]].tolist() for point in three
    ]  # in a system whose x is the y of space
    lines = [
        *(
            card("GRID", n, 4, *row.tolist())
            for n, row in enumerate(coordinates(points, kind), start=1)
        ),
        card("CORD2R", 9, 0, *shift.tolist(), 6.0, 6.0, 7.0, "+"),
        card("+", 5.0, 7.0, 7.0),
        *(card("GRID", 900 + n, "", *row) for n, row in enumerate(given)),
        "GRDSET,,9",
        f"CORD1{kind}       4     900     901     902"
        if form == 1
        else card(f"CORD2{kind}", 4, 9, *given[0], *given[1], "\n", *given[2]),
    ]
    order = [*range(12), *range(16, 20), *range(12, 16)]
    for number, cell in enumerate(cells[:, order] + 1, start=1):
        lines += [
            card("CHEXA", number, 7, *cell[:6], "+"),
            card("+", *cell[6:14], ""),
            card("", *cell[14:]),
        ]
    mesh = written(tmp_path / "m.bdf", "SOL 101", "BEGIN BULK", *lines, "ENDDATA", "nonsense")
    np.testing.assert_allclose(mesh.nodes, points[cells], atol=1e-10)
    assert len(mesh.cells_of("nastran:ref=7", "here")) == 2
    assert volume(mesh) == pytest.approx(1.0)
    assert mesh.remarks == ()


@pytest.mark.parametrize("marker", ["+A", "+a"])
def test_a_continuation_of_nastran_goes_to_the_line_with_its_marker(marker, tmp_path):
    """Other lines may stand between, and the case of a marker does not count."""
    first = "CHEXA          1       1       1       2       3       4       5       6"
    grid = "GRID           1              0.      0.      0."
    rest = "+A             7       8"
    (tmp_path / "m.bdf").write_text("\n".join([first + marker, grid, rest]))
    hexahedron, point = cards(tmp_path / "m.bdf")
    assert hexahedron.fields[2:10] == list("12345678")
    assert point.fields[2:5] == ["0."] * 3
    assert not any(point.fields[5:])


@pytest.mark.parametrize("end", ["", "+C"])
def test_a_continuation_of_nastran_may_stand_before_its_line(end, tmp_path):
    """Also a chain of two, and behind a line that goes on, or not, by itself."""
    first = "CHEXA          1       1       1       2       3       4       5       6+A"
    middle = "+A             7       8       9      10      11      12      13      14+B"
    last = "+B            15      16      17      18      19      20"
    grid = f"{'GRID           1              0.      0.      0.':72}{end}"
    lines = [grid, last, middle, first, *(["+C             5"] if end else [])]
    (tmp_path / "m.bdf").write_text("\n".join(lines))
    point, hexahedron = cards(tmp_path / "m.bdf")
    nodes = [field for field in hexahedron.fields[2:] if field]
    assert nodes == [str(number) for number in range(1, 21)]
    assert [field for field in point.fields if field] == [
        "1",
        "0.",
        "0.",
        "0.",
        *(["5"] if end else []),
    ]


def test_a_continuation_of_nastran_that_continues_nothing_is_refused(tmp_path):
    lines = ["GRID,1,,0.,0.,0.,,,+A", "+B,7,8", "GRID,2,,0.,0.,1."]
    (tmp_path / "m.bdf").write_text("\n".join(lines))
    with refused(
        MeshError, r"line 2: the continuation '\+B' stands behind no line that it continues"
    ):
        cards(tmp_path / "m.bdf")


def test_real_numbers_and_lines_of_nastran(tmp_path):
    """Exponents without E, fields of 8 and 16, lines that go on by a comma, a marker or a blank.

    Bulk data may stand alone, as Gmsh writes it; the property of an element is its set.
    """
    lines = INPUTS.text("fields.bdf").splitlines()
    mesh = written(tmp_path / "m.bdf", *lines)
    np.testing.assert_array_equal(mesh.nodes[0], [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert len(mesh.cells_of("nastran:ref=8", "here")) == 1
    (remark,) = mesh.remarks
    assert "m.bdf, line 8: RWHAT (2 times) is not known and was passed over" in remark
    whole = written(tmp_path / "w.bdf", "SOL 101", "CEND", "BEGIN BULK", *lines, "ENDDATA")
    np.testing.assert_array_equal(whole.nodes, mesh.nodes)


@pytest.mark.parametrize("kind", ["R", "C"])
def test_nodes_of_abaqus_in_a_system_of_their_own(kind, tmp_path):
    points, cells = box("tetra10", (1, 1, 1))
    axes = TURN.as_matrix().T
    system = np.concatenate((ORIGIN, ORIGIN + 2.0 * axes[0], ORIGIN + axes[1] + axes[0])).tolist()
    rows = ["*SYSTEM", card(*system[:6]), card(*system[6:]), f"*NODE, NSET=A,\n SYSTEM={kind}"]
    rows += [card(n, *row.tolist()) for n, row in enumerate(coordinates(points, kind), start=1)]
    rows += ["*SYSTEM", "*NODE", "99, 1, 2, 3", "*ELEMENT, TYPE=C3D10, ELSET=E"]
    rows += [card(n, *(cell + 1).tolist()) for n, cell in enumerate(cells, start=1)]
    mesh = written(tmp_path / "m.inp", *rows)
    np.testing.assert_allclose(mesh.nodes, points[cells], atol=1e-10)
    assert len(mesh.nodes_of("a", "here")) == len(points)
    assert mesh.loose.tolist() == [99]
    shifted = written(tmp_path / "m.inp", "*SYSTEM", "1, 2, 3", *SOLID)
    np.testing.assert_allclose(shifted.nodes[0, 0], (1.0, 2.0, 3.0))
    # A point on x alone turns x about z, after its height is left out.
    turned = written(tmp_path / "m.inp", "*SYSTEM", ",, 0, , 3, 4,", *SOLID)
    np.testing.assert_allclose(
        turned.nodes[0], [[0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-15
    )
