import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fe.elements.cells import jacobians
from fe.elements.kinds import gauss_points
from fe.runtime.errors import InvalidDesignError, MeshError
from fe.wing.grid import chord_lines
from fe.wing.mesh import build_mesh, straight_edged
from fe.wing.parts import four_digit_half_thickness

RIB = {"thickness": 0.003, "young_modulus": 6e9, "poisson_ratio": 0.3, "density": 500.0}


@pytest.fixture(scope="module")
def coarse_mesh(coarse_design):
    return build_mesh(coarse_design)


def cells_of(mesh, name):
    return np.flatnonzero(mesh.region == mesh.region_names.index(name))


def _volumes(mesh):
    local, weight = gauss_points(3)
    return np.linalg.det(jacobians(mesh.kind, mesh.nodes, local)) @ weight


def test_every_cell_has_a_positive_jacobian_everywhere(coarse_mesh, shipped_design):
    local, _ = gauss_points(3)
    for mesh in (coarse_mesh, build_mesh(shipped_design)):
        assert np.linalg.det(jacobians(mesh.kind, mesh.nodes, local)).min() > 0.0


def test_every_named_region_has_cells_and_they_partition_the_mesh(coarse_mesh):
    assert set(coarse_mesh.region) == set(range(len(coarse_mesh.region_names)))


def test_parts_have_the_volumes_of_the_design(coarse_design, coarse_mesh):
    plan = coarse_design.planform
    volume = _volumes(coarse_mesh)
    for name, defect in zip(coarse_design.regions, coarse_design.defects, strict=True):
        middle = plan.chord(0.5 * (defect.span_start + defect.span_end) / plan.semi_span)
        area = (defect.span_end - defect.span_start) * (defect.chord_end - defect.chord_start) * middle
        found = volume[cells_of(coarse_mesh, name)].sum()
        # The skin is curved, so that the patch is a little larger than its shadow.
        assert area * 0.0006 <= found <= 1.1 * area * 0.0006
    for index, web in enumerate(coarse_design.webs):
        inside = coarse_mesh.web == index
        height = np.ptp(coarse_mesh.corners[inside][:, :, 2], axis=1)
        length = np.ptp(coarse_mesh.corners[inside][:, :, 1], axis=1)
        assert volume[inside].sum() == pytest.approx((height * length * web.thickness).sum(), rel=0.1)


def test_mesh_lines_lie_on_the_edges_of_the_defects(coarse_design, coarse_mesh):
    for name, defect in zip(coarse_design.regions, coarse_design.defects, strict=True):
        corners = coarse_mesh.corners[cells_of(coarse_mesh, name)].reshape(-1, 3)
        assert corners[:, 1].min() == pytest.approx(defect.span_start)
        assert corners[:, 1].max() == pytest.approx(defect.span_end)
        plan = coarse_design.planform
        chord = plan.root_chord + (plan.tip_chord - plan.root_chord) * corners[:, 1] / plan.semi_span
        fraction = corners[:, 0] / chord + plan.straight_chord_line
        assert fraction.min() == pytest.approx(defect.chord_start)
        assert fraction.max() == pytest.approx(defect.chord_end)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(stations=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=4))
def test_a_rib_never_vanishes(coarse_design, stations):
    ribs = [{**RIB, "station": station} for station in stations]
    try:
        mesh = build_mesh(coarse_design.changed(ribs=ribs))
    except (InvalidDesignError, MeshError) as error:
        refusal = str(error)
    else:
        refusal = ""
        for index in range(len(stations)):
            corners = mesh.corners[mesh.rib == index].reshape(-1, 3)
            assert np.ptp(corners[:, 1]) == pytest.approx(RIB["thickness"])
    # What cannot be meshed is said, with the rib's name, and never swallowed.
    assert refusal == "" or "ribs[" in refusal


def test_mesh_lines_that_nearly_coincide_are_named(coarse_design):
    start = coarse_design.defects[0].span_start
    station = (start + 0.0015 + 1e-5) / coarse_design.planform.semi_span
    with pytest.raises(MeshError, match=r"inner face of ribs\[0\].*inner edge of defects\[0\]"):
        build_mesh(coarse_design.changed(ribs=[{**RIB, "station": station}]))
    defects = [dict(defect) for defect in coarse_design.defects]
    defects[0]["chord_start"] = 0.29999 - 0.0015 / coarse_design.planform.root_chord
    with pytest.raises(MeshError, match=r"webs\[1\].*come closer"):
        build_mesh(coarse_design.changed(defects=defects))


def test_a_point_of_the_skin_is_found_where_it_is(coarse_mesh):
    chord = coarse_mesh.design.planform.chord(0.8 / 1.828)
    for upper in (True, False):
        point = coarse_mesh.skin_point(0.8, 0.2 * chord, upper=upper)
        place = coarse_mesh.positions(np.array([point.cell]), point.local[None])[0, 0]
        assert place[:2] == pytest.approx([(0.2 - 0.3) * chord, 0.8])
        assert (place[2] > 0.0) == upper
    with pytest.raises(MeshError, match="does not lie on the skin"):
        coarse_mesh.skin_point(0.8, 0.99 * chord)


def test_straight_edges_keep_the_area_and_inertia_of_the_airfoil(shipped_design):
    # Points on the airfoil would make the section thinner, by 1.5 % in inertia on the coarse mesh.
    ratio = shipped_design.airfoil.thickness_ratio
    line = np.linspace(0.03, 0.9116, 20001)
    exact = four_digit_half_thickness(line, ratio)
    for refinement, limit in ((0.25, 1e-3), (1.0, 1e-4)):
        design = shipped_design.changed(mesh={"refinement": refinement})
        lines = np.array([[float(entry.at(0.433))] for entry in chord_lines(design)])
        half = straight_edged(lines, np.array([0.433]), ratio)[:, 0] / 0.433
        inside = (line >= lines[0, 0] / 0.433) & (line <= lines[-1, 0] / 0.433)
        found = np.interp(line[inside], lines[:, 0] / 0.433, half)
        assert found.mean() == pytest.approx(exact[inside].mean(), rel=limit)
        assert (found**2).mean() == pytest.approx((exact[inside] ** 2).mean(), rel=2.0 * limit)
        assert np.abs(found - exact[inside]).max() < 0.03 * exact.max()


def test_cells_beside_the_edges_of_defects_are_small(shipped_design):
    size = 0.012
    mesh = build_mesh(shipped_design.changed(mesh={"edge_size": size}))
    for defect in shipped_design.defects:
        for place in (defect.span_start, defect.span_end):
            at = int(np.argmin(np.abs(mesh.span_lines - place)))
            assert mesh.span_lines[at] == pytest.approx(place)
            assert np.diff(mesh.span_lines)[at - 1 : at + 1].max() <= 1.5 * size + 1e-9
    local, _ = gauss_points(3)
    assert np.linalg.det(jacobians(mesh.kind, mesh.nodes, local)).min() > 0.0


def test_the_shipped_mesh_is_of_the_intended_size(shipped_operators):
    assert 24_000 <= shipped_operators.wing_mesh.unknowns <= 40_000


def test_refinement_refines_the_whole_grid(shipped_design, coarse_mesh):
    middle = build_mesh(shipped_design.changed(mesh={"refinement": 0.5}))
    fine = build_mesh(shipped_design.changed(mesh={"refinement": 2.0}))
    assert (
        len(coarse_mesh.cells) < len(middle.cells) < len(build_mesh(shipped_design).cells) < len(fine.cells)
    )
    assert fine.height_cells == 2
