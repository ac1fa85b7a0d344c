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
LOCAL, WEIGHT = gauss_points(3)


@pytest.fixture(scope="module")
def coarse_mesh(coarse_design):
    return build_mesh(coarse_design)


def determinants(mesh):
    return np.linalg.det(jacobians(mesh.kind, mesh.nodes, LOCAL))


def cells_of(mesh, name):
    return np.flatnonzero(mesh.region == mesh.region_names.index(name))


def test_every_cell_has_a_positive_jacobian_and_a_region(coarse_mesh, shipped_design):
    for mesh in (coarse_mesh, build_mesh(shipped_design)):
        assert determinants(mesh).min() > 0.0
        assert set(mesh.region) == set(range(len(mesh.region_names)))


def test_parts_have_the_volumes_of_the_design(coarse_design, coarse_mesh):
    plan, volume = coarse_design.planform, determinants(coarse_mesh) @ WEIGHT
    for name, defect in zip(coarse_design.regions, coarse_design.defects, strict=True):
        middle = plan.chord(0.5 * (defect.span_start + defect.span_end) / plan.semi_span)
        area = (defect.span_end - defect.span_start) * (defect.chord_end - defect.chord_start) * middle
        # The skin is curved, so that the patch is a little larger than its shadow.
        assert 1.0 <= volume[cells_of(coarse_mesh, name)].sum() / (area * 0.0006) <= 1.1
    for index, web in enumerate(coarse_design.webs):
        inside = coarse_mesh.web == index
        _, length, height = np.ptp(coarse_mesh.corners[inside], axis=1).T
        assert volume[inside].sum() == pytest.approx((height * length * web.thickness).sum(), rel=0.1)


def test_mesh_lines_lie_on_the_edges_of_the_defects(coarse_design, coarse_mesh):
    plan = coarse_design.planform
    for name, defect in zip(coarse_design.regions, coarse_design.defects, strict=True):
        x, y, _ = coarse_mesh.corners[cells_of(coarse_mesh, name)].reshape(-1, 3).T
        chord = plan.root_chord + (plan.tip_chord - plan.root_chord) * y / plan.semi_span
        fraction = x / chord + plan.straight_chord_line
        assert (y.min(), y.max()) == pytest.approx((defect.span_start, defect.span_end))
        assert (fraction.min(), fraction.max()) == pytest.approx((defect.chord_start, defect.chord_end))


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(stations=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=4))
def test_a_rib_never_vanishes(coarse_design, stations):
    try:
        mesh = build_mesh(coarse_design.changed(ribs=[{**RIB, "station": station} for station in stations]))
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
    plan, defects = coarse_design.planform, [dict(defect) for defect in coarse_design.defects]
    station = (defects[0]["span_start"] + 0.0015 + 1e-5) / plan.semi_span
    defects[0]["chord_start"] = 0.29999 - 0.0015 / plan.root_chord
    for changes, sentence in (
        ({"ribs": [{**RIB, "station": station}]}, r"inner face of ribs\[0\].*inner edge of defects\[0\]"),
        ({"defects": defects}, r"webs\[1\].*come closer"),
    ):
        with pytest.raises(MeshError, match=sentence):
            build_mesh(coarse_design.changed(**changes))


@pytest.mark.parametrize("upper", [True, False])
def test_a_point_of_the_skin_is_found_where_it_is(coarse_mesh, upper):
    chord = coarse_mesh.design.planform.chord(0.8 / 1.828)
    point = coarse_mesh.skin_point(0.8, 0.2 * chord, upper=upper)
    place = coarse_mesh.positions(np.array([point.cell]), point.local[None])[0, 0]
    assert place[:2] == pytest.approx([(0.2 - 0.3) * chord, 0.8])
    assert (place[2] > 0.0) == upper
    with pytest.raises(MeshError, match="does not lie on the skin"):
        coarse_mesh.skin_point(0.8, 0.99 * chord)


@pytest.mark.parametrize(("refinement", "limit"), [(0.25, 1e-3), (1.0, 1e-4)])
def test_straight_edges_keep_the_area_and_inertia_of_the_airfoil(shipped_design, refinement, limit):
    # Points on the airfoil would make the section thinner, by 1.5 % in inertia on the coarse mesh.
    ratio, line = shipped_design.airfoil.thickness_ratio, np.linspace(0.03, 0.9116, 20001)
    entries = chord_lines(shipped_design.changed(mesh={"refinement": refinement}))
    lines = np.array([[float(entry.at(0.433))] for entry in entries])
    half = straight_edged(lines, np.array([0.433]), ratio)[:, 0] / 0.433
    line = line[(line >= lines[0, 0] / 0.433) & (line <= lines[-1, 0] / 0.433)]
    exact, found = four_digit_half_thickness(line, ratio), np.interp(line, lines[:, 0] / 0.433, half)
    assert found.mean() == pytest.approx(exact.mean(), rel=limit)
    assert (found**2).mean() == pytest.approx((exact**2).mean(), rel=2.0 * limit)
    assert np.abs(found - exact).max() < 0.03 * exact.max()


def test_cells_beside_the_edges_of_defects_are_small(shipped_design):
    size = 0.012
    mesh = build_mesh(shipped_design.changed(mesh={"edge_size": size}))
    for place in {
        place for defect in shipped_design.defects for place in (defect.span_start, defect.span_end)
    }:
        at = int(np.argmin(np.abs(mesh.span_lines - place)))
        assert mesh.span_lines[at] == pytest.approx(place)
        assert np.diff(mesh.span_lines)[at - 1 : at + 1].max() <= 1.5 * size + 1e-9
    assert determinants(mesh).min() > 0.0


def test_refinement_refines_the_whole_grid_and_the_shipped_one_has_the_intended_size(
    shipped_design, coarse_mesh
):
    middle, one, fine = (build_mesh(shipped_design.changed(mesh={"refinement": r})) for r in (0.5, 1.0, 2.0))
    assert len(coarse_mesh.cells) < len(middle.cells) < len(one.cells) < len(fine.cells)
    assert fine.height_cells == 2
    assert 24_000 <= build_mesh(shipped_design).unknowns <= 40_000
