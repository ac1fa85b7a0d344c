"""VTU files, read by meshio."""

import meshio
import numpy as np
import pytest

from fe.structure.vtu import write_vtu

UNIT_CUBE = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
    dtype=float,
)


def test_fields_of_points_and_cells_come_back(tmp_path):
    """Numbers, vectors and whole numbers."""
    displacement = np.random.default_rng(1).normal(size=UNIT_CUBE.shape)
    cells = np.arange(8)[None]
    write_vtu(
        tmp_path / "cube.vtu",
        UNIT_CUBE,
        ("hexahedron", cells),
        {"displacement": displacement},
        {"region": np.array([3])},
    )
    mesh = meshio.read(tmp_path / "cube.vtu")
    np.testing.assert_array_equal(mesh.points, UNIT_CUBE)
    np.testing.assert_array_equal(mesh.point_data["displacement"], displacement)
    assert mesh.cell_data["region"][0].tolist() == [3]


@pytest.mark.parametrize(("kind", "nodes"), [("vertex", 1), ("tetra", 4), ("wedge", 6)])
def test_cells_have_the_kind_and_the_nodes_that_meshio_writes(tmp_path, kind, nodes):
    """The order of the nodes of a wedge differs between VTK and mesh files."""
    cells = np.arange(nodes)[None]
    write_vtu(tmp_path / "ours.vtu", UNIT_CUBE, (kind, cells), {}, {})
    meshio.write(tmp_path / "theirs.vtu", meshio.Mesh(UNIT_CUBE, [(kind, cells)]))
    ours = meshio.read(tmp_path / "ours.vtu").cells_dict
    theirs = meshio.read(tmp_path / "theirs.vtu").cells_dict
    np.testing.assert_array_equal(ours[kind], theirs[kind])
