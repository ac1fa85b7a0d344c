import re
from pathlib import Path

import meshio
import numpy as np
import pytest

from fe.elements.cells import gradients, strain_matrix
from fe.reduction.fields import WingFields, write_modes_vtu, write_wing_vtu
from fe.runtime.errors import OutsideModelError
from fe.wing.responses import eigenmodes, solve_static
from reporting.errors import FileNotWrittenError

STATE = {"young_modulus_factor": 0.95, "stiffness_loss": (0.3, 0.6), "load_factor": 3.0, "tip_force": 5.0}


@pytest.fixture(scope="module")
def written(coarse_fields: WingFields, tmp_path_factory) -> meshio.Mesh:
    """What two files of the same state hold, which are the same bytes."""
    folder = tmp_path_factory.mktemp("vtu")
    for name in ("wing.vtu", "again.vtu"):
        write_wing_vtu(folder / name, coarse_fields, coarse_fields.vector(**STATE))
    assert sorted(p.name for p in folder.iterdir()) == ["again.vtu", "wing.vtu"]
    assert (folder / "wing.vtu").read_bytes() == (folder / "again.vtu").read_bytes()
    return meshio.read(folder / "wing.vtu")


def test_cells_are_right_handed_hexahedra_of_20_nodes(written: meshio.Mesh, coarse_operators) -> None:
    (block,) = written.cells
    assert block.type == "hexahedron20"
    nodes = written.points[block.data]
    # edges that leave the first corner along VTK's three axes
    assert np.all(np.linalg.det(nodes[:, [1, 3, 4]] - nodes[:, :1]) > 0)
    # nodes 8 to 19 lie in the middle of VTK's edges
    first, last = [0, 1, 2, 3, 4, 5, 6, 7, 0, 1, 2, 3], [1, 2, 3, 0, 5, 6, 7, 4, 4, 5, 6, 7]
    np.testing.assert_allclose(nodes[:, 8:], 0.5 * (nodes[:, first] + nodes[:, last]), atol=1e-12)
    assert len(written.points) == len(coarse_operators.wing_mesh.points)


def test_displacement_strain_and_damage_are_those_of_the_full_model(
    written: meshio.Mesh, coarse_operators
) -> None:
    full = solve_static(coarse_operators, *STATE.values())
    wanted = coarse_operators.full_displacement(full.displacement)
    found = written.point_data["displacement"]
    np.testing.assert_allclose(found, wanted, atol=1e-3 * np.abs(wanted).max())
    assert found[:, 2].max() == pytest.approx(full.output[0], rel=0.1)
    mesh = coarse_operators.wing_mesh
    slopes, _ = gradients(mesh.kind, mesh.nodes, np.full((1, 3), 0.5))
    nodal = wanted.ravel()[mesh.unknowns_of(np.arange(len(mesh.cells)))]
    strain = np.einsum("cij,cj->ci", strain_matrix(slopes[:, 0]), nodal)
    data = {name: values for name, (values,) in written.cell_data.items()}
    np.testing.assert_allclose(data["strain"], strain, atol=1e-2 * np.abs(strain).max())
    np.testing.assert_array_equal(data["spanwise_strain"], -data["strain"][:, 1])
    # the upper skin is compressed where the gauges are
    plan = mesh.design.planform
    cells = [
        mesh.skin_point(distance, chord * plan.chord(distance / plan.semi_span)).cell
        for distance, chord in mesh.design.gauges.positions[1:4]
    ]
    np.testing.assert_allclose(data["spanwise_strain"][cells], full.strain[1:4], rtol=0.35)
    np.testing.assert_array_equal(data["region"], mesh.region)
    lost = np.select([mesh.region == 1, mesh.region == 2], [0.3, 0.6])
    np.testing.assert_array_equal(data["stiffness_loss"], lost)


def test_modes_are_those_of_the_full_model(coarse_fields, coarse_operators, tmp_path: Path) -> None:
    write_modes_vtu(tmp_path / "modes.vtu", coarse_fields, coarse_fields.nominal)
    written = meshio.read(tmp_path / "modes.vtu").point_data
    full = eigenmodes(coarse_operators, 1.0, (0.0, 0.0), 0.169, 0.134)
    assert len(written) == coarse_fields.mode_count
    for number, name in enumerate(list(written)[:3]):
        label, frequency = name.rsplit("_", 1)
        assert label == f"mode_{number + 1}"
        assert float(frequency.removesuffix("Hz")) == pytest.approx(full.frequency[number], rel=1e-4)
        wanted = np.abs(coarse_operators.full_displacement(full.shape[:, number]))
        np.testing.assert_allclose(np.abs(written[name]), wanted, atol=1e-2 * wanted.max())


def test_bad_states_and_places_leave_no_file(coarse_fields: WingFields, tmp_path: Path) -> None:
    (tmp_path / "folder.vtu").mkdir()
    state = coarse_fields.vector(**STATE)
    for name, vector, error, sentence in (
        ("wing.vtu", coarse_fields.vector(load_factor=np.nan), OutsideModelError, "load_factor must"),
        ("folder.vtu", state, FileNotWrittenError, re.escape(f"{tmp_path / 'folder.vtu'}")),
    ):
        with pytest.raises(error, match=sentence):
            write_wing_vtu(tmp_path / name, coarse_fields, vector)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.vtu"]
