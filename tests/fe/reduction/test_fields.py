import re
from pathlib import Path

import meshio
import numpy as np
import pytest

from fe.reduction.fields import WingFields, write_modes_vtu, write_wing_vtu
from fe.runtime.errors import OutsideModelError
from fe.structure.mesh_file import read_mesh
from fe.wing.responses import eigenmodes, solve_static
from reporting.errors import FileNotWrittenError
from tests.refusals import refused

STATE = {"young_modulus_factor": 0.95, "stiffness_loss": (0.3, 0.6), "load_factor": 3.0, "tip_force": 5.0}


@pytest.fixture(scope="module")
def written(coarse_fields: WingFields, coarse_operators, tmp_path_factory) -> meshio.Mesh:
    """What two files of the same state hold, which are the same bytes, and are read as the wing's mesh."""
    first, again = (tmp_path_factory.mktemp("vtu") / "wing.vtu" for _ in range(2))
    for path in (first, again):
        write_wing_vtu(path, coarse_fields, coarse_fields.vector(**STATE))
        assert list(path.parent.iterdir()) == [path]
    assert first.read_bytes() == again.read_bytes()
    mesh, wanted = read_mesh(first, 1.0, "m"), coarse_operators.wing_mesh
    assert mesh.kind is wanted.kind
    np.testing.assert_allclose(mesh.nodes, wanted.nodes, atol=1e-12)
    return meshio.read(first)


def test_displacement_strain_and_damage_are_those_of_the_full_model(
    written: meshio.Mesh, coarse_operators
) -> None:
    full = solve_static(coarse_operators, *STATE.values())
    wanted = coarse_operators.full_displacement(full.displacement)
    found = written.point_data["displacement"]
    np.testing.assert_allclose(found, wanted, atol=1e-3 * np.abs(wanted).max())
    assert found[:, 2].max() == pytest.approx(full.output[0], rel=0.1)
    mesh = coarse_operators.wing_mesh
    strain, data = mesh.strains(wanted)[:, 0], {name: own for name, (own,) in written.cell_data.items()}
    np.testing.assert_allclose(data["strain"], strain, atol=1e-2 * np.abs(strain).max())
    np.testing.assert_array_equal(data["spanwise_strain"], -data["strain"][:, 1])
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
    place = tmp_path / "folder.vtu"
    place.mkdir()
    with refused(OutsideModelError, "load_factor must"):
        write_wing_vtu(tmp_path / "wing.vtu", coarse_fields, coarse_fields.vector(load_factor=np.nan))
    with refused(FileNotWrittenError, re.escape(str(place))):
        write_wing_vtu(place, coarse_fields, coarse_fields.vector(**STATE))
    assert list(tmp_path.iterdir()) == [place]
