"""Mesh files of all programs by meshio: the same cells and sets, and faults in a sentence."""

from dataclasses import dataclass
from typing import Any

import meshio
import numpy as np
import pytest

from fe.elements.kinds import KINDS, meshio_with_wedges
from fe.runtime.errors import MeshError
from fe.structure.mesh import StructureMesh
from fe.structure.mesh_file import read_mesh
from fe.structure.meshio_file import read_by_meshio
from tests.fe.structure.mesh_texts import assert_mesh_refused, volume_of
from tests.meshes import box
from tests.refusals import Inputs

INPUTS = Inputs(__file__)


def is_at_root(points):
    """Return a mask of the points at x = 0."""
    x, _, _ = points.T
    return x == 0.0


def assert_at_root(mesh, set_name):
    """Assert that all nodes of a set lie at x = 0."""
    assert is_at_root(mesh.points[mesh.nodes_of(set_name, "here")]).all()


# ---------------------------------------------------------------- formats

SUFFIXES = {
    "vtu": "vtu",
    "gmsh": "msh",
    "gmsh22": "msh",
    "abaqus": "inp",
    "nastran": "bdf",
}
"""Endings of files by meshio's names of their formats."""
BOUNDARY_FACES = {4: 20, 6: 14, 8: 10}
"""Faces of the surface of two cubes, by the number of corners of their cells."""


@dataclass(frozen=True)
class ReadBox:
    """A box of two cubes, and the mesh that is read of its file."""

    kind: str
    points: np.ndarray[Any, Any]
    cells: np.ndarray[Any, Any]
    mesh: StructureMesh


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    return request.param


@pytest.fixture(scope="module", params=SUFFIXES)
def read_box(request, kind, tmp_path_factory):
    """The box in mm, in one of the formats."""
    points, cells = box(kind, (2, 1, 1))
    path = tmp_path_factory.mktemp("mesh") / f"m.{SUFFIXES[request.param]}"
    cell_data = {}
    if path.suffix == ".msh":
        tags = [np.zeros(len(cells), dtype=np.int32)]
        cell_data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    written = meshio_with_wedges().Mesh(points, [(kind, cells)], cell_data=cell_data)
    meshio.write(path, written, file_format=request.param)
    return ReadBox(kind, points, cells, read_mesh(path, 1e-3, "mm"))


def test_formats_have_the_same_cells(read_box):
    expected = 1e-3 * read_box.points[read_box.cells]

    assert read_box.mesh.kind is KINDS[read_box.kind]
    np.testing.assert_allclose(read_box.mesh.nodes, expected, atol=1e-12)


def test_formats_have_the_same_volume_and_surface(read_box):
    corner_count = len(read_box.mesh.kind.corners)

    assert volume_of(read_box.mesh) == pytest.approx(1e-9)
    assert len(read_box.mesh.boundary) == BOUNDARY_FACES[corner_count]


@pytest.fixture(scope="module")
def read_med(kind, tmp_path_factory):
    """The box as MED has it.

    MED counts the nodes of a cell as seen in a mirror; its families are of several groups.
    """
    points, cells = box(kind, (2, 1, 1))
    path = tmp_path_factory.mktemp("mesh") / "m.med"
    families = np.where(is_left(points, cells), -1, -2)
    written = meshio_with_wedges().Mesh(
        points * (-1, 1, 1), [(kind, cells)], cell_data={"cell_tags": [families]}
    )
    written.point_data["point_tags"] = np.where(is_at_root(points), 1, 0)
    written.point_tags = {1: ["root"]}
    written.cell_tags = {-1: ["left", "body"], -2: ["body"]}
    meshio.write(path, written, file_format="med")
    return ReadBox(kind, points, cells, read_mesh(path, 1e-3, "mm"))


def is_left(points, cells):
    """Return a mask of the cells in the left one of both cubes."""
    x, _, _ = points[cells].mean(axis=1).T
    return x < 0.5


def test_med_has_the_same_volume_and_surface(read_med):
    corner_count = len(read_med.mesh.kind.corners)

    assert read_med.mesh.kind is KINDS[read_med.kind]
    assert volume_of(read_med.mesh) == pytest.approx(1e-9)
    assert len(read_med.mesh.boundary) == BOUNDARY_FACES[corner_count]


def test_families_of_med_are_sets_of_cells(read_med):
    left_cells = np.flatnonzero(is_left(read_med.points, read_med.cells))

    assert sorted(read_med.mesh.cells_of("left", "here")) == left_cells.tolist()
    assert len(read_med.mesh.cells_of("body", "here")) == len(read_med.cells)


def test_families_of_med_are_sets_of_nodes(read_med):
    assert_at_root(read_med.mesh, "root")


# ---------------------------------------------------------------- physical groups of Gmsh


def faces_at_root(kind, points, cells):
    """Return the nodes of the faces at x = 0 of all cells."""
    faces = []
    for cell in cells.tolist():
        for face in KINDS[kind].face_nodes:
            nodes = [cell[number] for number in face]
            if is_at_root(points[nodes]).all():
                faces.append(nodes)
    return faces


@pytest.fixture(scope="module")
def grouped_box():
    """Points and cells of a box whose first two cells are in a second group, the lug.

    Version 2 of the format writes an element of two groups again for each group.
    """
    return box("tetra10", (2, 1, 1))


@pytest.fixture(scope="module")
def grouped_mesh(grouped_box, tmp_path_factory):
    points, cells = grouped_box
    faces = faces_at_root("tetra10", points, cells)
    blocks = [("triangle6", faces), ("tetra10", np.concatenate((cells, cells[:2])))]
    groups = [[7] * len(faces), [1] * 6 + [2] * 6 + [3] * 2]
    geometrical = [[1] * len(group) for group in groups]
    names = {"wall": (7, 2), "left": (1, 3), "right": (2, 3), "lug": (3, 3)}
    written = meshio.Mesh(
        points,
        blocks,
        cell_data={"gmsh:physical": groups, "gmsh:geometrical": geometrical},
        field_data={name: np.array(pair) for name, pair in names.items()},
    )
    path = tmp_path_factory.mktemp("mesh") / "m.msh"
    meshio.write(path, written, file_format="gmsh22")
    return read_mesh(path, 1.0, "m")


def test_an_element_of_two_groups_of_gmsh_counts_once(grouped_box, grouped_mesh):
    _, cells = grouped_box
    lug = grouped_mesh.cells[grouped_mesh.cells_of("lug", "here")]

    assert volume_of(grouped_mesh) == pytest.approx(1.0)
    np.testing.assert_array_equal(lug, cells[:2])


def test_physical_groups_of_gmsh_are_sets_of_cells(grouped_mesh):
    assert sorted(grouped_mesh.cells_of("left", "here")) == list(range(6))


def test_the_case_of_a_name_does_not_matter(grouped_mesh):
    assert sorted(grouped_mesh.cells_of("RIGHT", "here")) == list(range(6, 12))


def test_physical_groups_of_gmsh_are_sets_of_nodes_and_faces(grouped_mesh):
    assert_at_root(grouped_mesh, "wall")
    assert len(grouped_mesh.nodes_of("wall", "here")) == 9
    assert len(grouped_mesh.faces_of("wall", "here")) == 2


def test_elements_that_stand_twice_without_groups_are_refused(grouped_box, tmp_path):
    points, cells = grouped_box
    twice = [("tetra10", np.concatenate((cells, cells[:2])))]
    meshio.write(tmp_path / "m.vtu", meshio.Mesh(points, twice))

    assert_mesh_refused(
        tmp_path / "m.vtu", r"m\.vtu: 2 elements, such as 13, have the nodes of another"
    )


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        (
            ["$PartitionedEntities", "2", "0", "0 0 0 0", "$EndPartitionedEntities"],
            "is partitioned",
        ),
        (["$ParametricNodes", "0", "$EndParametricNodes"], "have parametric coordinates"),
        (
            ["$Nodes", "1 1 1 1", "2 1 1 1", "1", "0 0 0 0.5 0.5", "$EndNodes"],
            "have parametric coord",
        ),
    ],
)
def test_a_mesh_of_gmsh_with_parts_or_parameters_is_refused(tmp_path, lines, sentence):
    file = tmp_path / "m.msh"
    file.write_text("\n".join(["$MeshFormat", "4.1 0 8", "$EndMeshFormat", *lines]) + "\n")
    with pytest.raises(MeshError, match=f"m.msh: .*{sentence}.*save the mesh again"):
        read_mesh(file, 1.0, "m")


# ---------------------------------------------------------------- all elements saved by Gmsh


@pytest.fixture
def write_all_saved(tmp_path):
    """A writer of edges, faces and tetrahedra as Gmsh writes them with Mesh.SaveAll = 1.

    It takes the physical groups of the elements, 0 for none.
    """

    def write(edge_groups, face_groups, cell_groups):
        points, cells = box("tetra", (2, 1, 1))
        edges = [cell[:2] for cell in cells.tolist()[:4]]
        faces = faces_at_root("tetra", points, cells)
        blocks = [("line", edges), ("triangle", faces), ("tetra", cells)]
        geometrical = [[number] * len(rows) for number, (_, rows) in enumerate(blocks, start=1)]
        groups = [edge_groups, face_groups, cell_groups]
        mesh = meshio.Mesh(
            points,
            blocks,
            cell_data={"gmsh:physical": groups, "gmsh:geometrical": geometrical},
            field_data={"body": np.array([1, 3]), "wall": np.array([7, 2])},
        )
        path = tmp_path / "m.msh"
        meshio.write(path, mesh, file_format="gmsh22", binary=False)
        return path

    return write


CELL_COUNT = 12
"""Tetrahedra of two cubes."""
HALF = CELL_COUNT // 2


def test_elements_of_gmsh_without_a_physical_group_are_left_out(write_all_saved):
    points, cells = box("tetra", (2, 1, 1))
    path = write_all_saved([0] * 4, [7] * 2, [1] * HALF + [0] * HALF)

    mesh = read_mesh(path, 1.0, "m")

    names = {"body", "wall", "gmsh:geometrical=2", "gmsh:geometrical=3"}
    np.testing.assert_array_equal(mesh.nodes, points[cells[:HALF]])
    assert {*mesh.cell_sets, *mesh.node_sets} == names


def test_elements_of_gmsh_that_are_left_out_are_remarked_on(write_all_saved):
    path = write_all_saved([0] * 4, [7] * 2, [1] * HALF + [0] * HALF)

    (remark,) = read_mesh(path, 1.0, "m").remarks

    sentence = f"{HALF + 4} elements of no physical group are left out; set Mesh.SaveAll = 0"
    assert sentence in remark


def test_solid_elements_of_gmsh_stay_if_groups_are_of_faces_alone(write_all_saved):
    path = write_all_saved([0] * 4, [7] * 2, [0] * CELL_COUNT)

    assert len(read_mesh(path, 1.0, "m").cells) == CELL_COUNT


def test_elements_of_gmsh_stay_without_a_remark_if_there_are_no_groups(write_all_saved):
    path = write_all_saved([0] * 4, [0] * 2, [0] * CELL_COUNT)

    mesh = read_mesh(path, 1.0, "m")

    assert len(mesh.cells) == CELL_COUNT
    assert mesh.remarks == ()


ALL_SAVED_IN_VERSION_4 = """$MeshFormat
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
"""A tetrahedron in a physical group, and one of its faces in none."""


def test_a_file_of_gmsh_of_version_4_with_all_saved_is_refused_with_the_remedy(tmp_path):
    path = tmp_path / "m.msh"
    path.write_text(ALL_SAVED_IN_VERSION_4)

    assert_mesh_refused(
        path,
        r"m\.msh: some elements are in a physical group and others in none, .* Mesh.SaveAll = 0",
    )


def test_a_file_of_gmsh_of_version_4_with_groups_of_all_elements_is_read(tmp_path):
    path = tmp_path / "m.msh"
    face_in_group = ("5 0 0 0 1 1 0 0 0", "5 0 0 0 1 1 0 1 7 0")
    path.write_text(ALL_SAVED_IN_VERSION_4.replace(*face_in_group))

    assert read_mesh(path, 1.0, "m").cells_of("body", "here").tolist() == [0]


@pytest.fixture(params=["gmsh22", "gmsh"])
def text_of_gmsh(request, tmp_path):
    """A file of tetrahedra of one cube as text."""
    points, cells = box("tetra", (1, 1, 1))
    tags = [np.ones(len(cells), dtype=np.int32)]
    cell_data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    path = tmp_path / "m.msh"
    mesh = meshio.Mesh(points, [("tetra", cells)], cell_data=cell_data)
    meshio.write(path, mesh, file_format=request.param, binary=False)
    return path


def test_text_of_gmsh_is_read(text_of_gmsh):
    assert len(read_mesh(text_of_gmsh, 1.0, "m").cells) == HALF


def test_a_doubled_line_of_gmsh_loses_no_element(text_of_gmsh):
    """The count in the file stays what it was, so that its last element would not be read."""
    lines = text_of_gmsh.read_text().splitlines()
    last_element = lines.index("$EndElements") - 1
    lines.insert(last_element, lines[last_element - 1])
    text_of_gmsh.write_text("\n".join(lines) + "\n")

    assert_mesh_refused(text_of_gmsh, "but .* follow, and the last would be lost")


# ---------------------------------------------------------------- arrays of VTU


@pytest.fixture(scope="module")
def vtu_with_sets(tmp_path_factory):
    """Two cubes with sets as meshio writes them, and as a mask of zeros and ones."""
    points, cells = box("hexahedron", (2, 1, 1))
    written = meshio.Mesh(
        points,
        [("hexahedron", cells)],
        cell_sets={"left": [[0]]},
        point_sets={"root": np.flatnonzero(is_at_root(points))},
        cell_data={"right": [[0, 1]]},
    )
    written.cell_sets_to_data()
    written.point_sets_to_data()
    path = tmp_path_factory.mktemp("mesh") / "m.vtu"
    meshio.write(path, written)
    return read_mesh(path, 1.0, "m")


@pytest.mark.parametrize(
    ("name", "cell"), [("left", 0), ("left=0", 0), ("left=-1", 1), ("right", 1), ("right=1", 1)]
)
def test_arrays_of_cells_are_sets_by_name_and_by_value(vtu_with_sets, name, cell):
    assert vtu_with_sets.cells_of(name, "here").tolist() == [cell]


def test_arrays_of_points_are_sets_of_nodes_and_faces(vtu_with_sets):
    assert_at_root(vtu_with_sets, "root")
    assert len(vtu_with_sets.faces_of("root", "here")) == 1


@pytest.fixture
def two_blocks(tmp_path):
    """A file with two blocks of two cells each, which do not touch."""
    points, cells = box("hexahedron", (2, 1, 1))
    blocks = [("hexahedron", cells), ("hexahedron", cells + len(points))]
    cell_data = {"part": [[0, 1], [1, 1]], "set": [[-1, 0], [0, 0]]}
    mesh = meshio.Mesh(np.vstack((points, points + 10.0)), blocks, cell_data=cell_data)
    path = tmp_path / "n.vtu"
    meshio.write(path, mesh)
    return path


def test_a_mesh_that_falls_apart_is_refused(two_blocks):
    assert_mesh_refused(two_blocks, "falls into 2 parts")


@pytest.mark.parametrize("name", ["part", "set"])
def test_sets_go_over_all_blocks(two_blocks, name):
    sets = read_by_meshio(two_blocks).mesh(1.0, "m").cell_sets

    assert sets[name].tolist() == [1, 2, 3]


# ---------------------------------------------------------------- what is refused


def test_a_missing_file_is_refused(tmp_path):
    assert_mesh_refused(tmp_path / "none.msh", "is not there")


def test_a_folder_is_refused(tmp_path):
    assert_mesh_refused(tmp_path, "is a folder; `mesh` must name it as seen")


@pytest.mark.parametrize(("name", "content", "sentence"), INPUTS.refused("files"))
def test_a_damaged_file_is_refused_and_nothing_is_printed(
    tmp_path, capsys, name, content, sentence
):
    (tmp_path / name).write_text(content)

    assert_mesh_refused(tmp_path / name, sentence)

    assert capsys.readouterr() == ("", "")


CUBE_POINTS, CUBE = box("hexahedron", (1, 1, 1))


@pytest.mark.parametrize(
    ("blocks", "sentence"),
    [
        (
            [("hexahedron", CUBE), ("wedge", CUBE[:, :6]), ("hexahedron", CUBE)],
            r"one kind of elements is expected .*, but the mesh has 2 8-node hexahedra, 1 6-node "
            "wedges",
        ),
        ([("pyramid", CUBE[:, :5])], r"is expected \(.*\), but the mesh has 1 pyramid"),
        ([("quad", CUBE[:, :4])], "but the mesh has none that is solid"),
    ],
    ids=["several kinds", "pyramid", "quadrangle"],
)
def test_other_elements_are_refused(tmp_path, blocks, sentence):
    meshio.write(tmp_path / "p.vtu", meshio.Mesh(CUBE_POINTS, blocks))

    assert_mesh_refused(tmp_path / "p.vtu", sentence)


def test_middles_of_edges_in_another_order_are_refused(tmp_path):
    points, cells = box("tetra10", (1, 1, 1))
    last_two_exchanged = cells[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]
    meshio.write(tmp_path / "p.vtu", meshio.Mesh(points, [("tetra10", last_two_exchanged)]))

    assert_mesh_refused(tmp_path / "p.vtu", "lies far from the middle of its edge")
