import re
from dataclasses import replace
from pathlib import Path

import meshio
import numpy as np
import pytest

from fe.elements.cells import gradients, strain_matrix
from fe.reduction.fields import WingFields, field_basis, write_modes_vtu, write_wing_vtu
from fe.reduction.reduced_basis import Reduction
from fe.runtime.errors import OutsideModelError, ReducedModelFileError
from fe.wing.operators import AffineOperators
from fe.wing.responses import eigenmodes, solve_static
from reporting.errors import FileNotWrittenError

STATE = {"young_modulus_factor": 0.95, "stiffness_loss": (0.3, 0.6), "load_factor": 3.0, "tip_force": 5.0}


@pytest.fixture(scope="module")
def wing(coarse_operators: AffineOperators, coarse_reduction: Reduction) -> WingFields:
    return field_basis(coarse_operators, coarse_reduction)


@pytest.fixture(scope="module")
def written(wing: WingFields, tmp_path_factory: pytest.TempPathFactory) -> meshio.Mesh:
    path = tmp_path_factory.mktemp("vtu") / "wing.vtu"
    write_wing_vtu(path, wing, wing.vector(**STATE))
    assert [p.name for p in path.parent.iterdir()] == ["wing.vtu"]
    return meshio.read(path)


def test_cells_are_right_handed_hexahedra_of_20_nodes(
    written: meshio.Mesh, coarse_operators: AffineOperators
) -> None:
    (block,) = written.cells
    assert block.type == "hexahedron20"
    nodes = written.points[block.data]
    # edges that leave the first corner along VTK's three axes
    axes = nodes[:, [1, 3, 4]] - nodes[:, :1]
    assert np.all(np.linalg.det(axes) > 0)
    # nodes 8 to 19 lie in the middle of VTK's edges
    edges = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
    for number, (a, b) in enumerate(edges):
        np.testing.assert_allclose(nodes[:, 8 + number], 0.5 * (nodes[:, a] + nodes[:, b]), atol=1e-12)
    assert len(written.points) == len(coarse_operators.wing_mesh.points)


def test_displacement_is_that_of_the_full_model(
    written: meshio.Mesh, coarse_operators: AffineOperators
) -> None:
    full = solve_static(coarse_operators, *STATE.values())
    wanted = coarse_operators.full_displacement(full.displacement)
    found = written.point_data["displacement"]
    np.testing.assert_allclose(found, wanted, atol=1e-3 * np.abs(wanted).max())
    assert found[:, 2].max() == pytest.approx(full.output[0], rel=0.1)


def test_strain_is_that_of_the_full_model(written: meshio.Mesh, coarse_operators: AffineOperators) -> None:
    full = solve_static(coarse_operators, *STATE.values())
    mesh = coarse_operators.wing_mesh
    slopes, _ = gradients(mesh.kind, mesh.nodes, np.full((1, 3), 0.5))
    nodal = coarse_operators.full_displacement(full.displacement).ravel()[
        mesh.unknowns_of(np.arange(len(mesh.cells)))
    ]
    wanted = np.einsum("cij,cj->ci", strain_matrix(slopes[:, 0]), nodal)
    (found,) = written.cell_data["strain"]
    np.testing.assert_allclose(found, wanted, atol=1e-2 * np.abs(wanted).max())
    np.testing.assert_array_equal(written.cell_data["spanwise_strain"][0], -found[:, 1])
    # the upper skin is compressed where the gauges are
    plan = mesh.design.planform
    cells = [
        mesh.skin_point(distance, chord * plan.chord(distance / plan.semi_span)).cell
        for distance, chord in mesh.design.gauges.positions[1:4]
    ]
    np.testing.assert_allclose(written.cell_data["spanwise_strain"][0][cells], full.strain[1:4], rtol=0.35)


def test_damage_is_written_where_it_is(written: meshio.Mesh, coarse_operators: AffineOperators) -> None:
    region, loss = written.cell_data["region"][0], written.cell_data["stiffness_loss"][0]
    np.testing.assert_array_equal(region, coarse_operators.wing_mesh.region)
    assert set(np.unique(loss[region == 1])) == {0.3}
    assert set(np.unique(loss[region == 2])) == {0.6}
    assert not loss[(region != 1) & (region != 2)].any()


def test_modes_are_those_of_the_full_model(
    wing: WingFields, coarse_operators: AffineOperators, tmp_path: Path
) -> None:
    path = tmp_path / "modes.vtu"
    write_modes_vtu(path, wing, wing.nominal)
    written = meshio.read(path)
    full = eigenmodes(coarse_operators, 1.0, (0.0, 0.0), 0.169, 0.134)
    assert len(written.point_data) == wing.mode_count
    for number, name in enumerate(list(written.point_data)[:3]):
        label, frequency = name.rsplit("_", 1)
        assert label == f"mode_{number + 1}"
        assert float(frequency.removesuffix("Hz")) == pytest.approx(full.frequency[number], rel=1e-4)
        wanted = coarse_operators.full_displacement(full.shape[:, number])
        np.testing.assert_allclose(
            np.abs(written.point_data[name]), np.abs(wanted), atol=1e-2 * np.abs(wanted).max()
        )


def test_equal_states_give_equal_files(wing: WingFields, tmp_path: Path) -> None:
    for name in ("one.vtu", "two.vtu"):
        write_wing_vtu(tmp_path / name, wing, wing.vector(**STATE))
    assert (tmp_path / "one.vtu").read_bytes() == (tmp_path / "two.vtu").read_bytes()


def test_bad_states_and_places_leave_no_file(wing: WingFields, tmp_path: Path) -> None:
    state = wing.vector(**STATE)
    with pytest.raises(OutsideModelError):
        write_wing_vtu(tmp_path / "wing.vtu", wing, wing.vector(load_factor=float("nan")))
    assert not list(tmp_path.iterdir())
    (tmp_path / "folder.vtu").mkdir()
    with pytest.raises(FileNotWrittenError, match=re.escape(f"{tmp_path / 'folder.vtu'}")):
        write_wing_vtu(tmp_path / "folder.vtu", wing, state)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.vtu"]


def test_basis_comes_back_to_the_last_bit(wing: WingFields) -> None:
    content = wing.to_bytes()
    assert WingFields.from_bytes(content, "the basis").to_bytes() == content
    for wrong, sentence in ((content[:1000], "the basis"), (wing.model.to_bytes(), "lacks")):
        with pytest.raises(ReducedModelFileError, match=sentence):
            WingFields.from_bytes(wrong, "the basis")
    for name in ("points", "cells", "region", "static_displacement", "modal_displacement"):
        for value in (np.array(1.0), np.array("a"), getattr(wing, name)[:-1, ...]):
            with pytest.raises(ReducedModelFileError, match="field basis"):
                replace(wing, **{name: value})
    with pytest.raises(ReducedModelFileError, match="nodes that are not there"):
        replace(wing, cells=wing.cells + 1)
