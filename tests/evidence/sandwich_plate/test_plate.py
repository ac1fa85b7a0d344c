import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evidence.sandwich_plate.plate import (
    FIELDS,
    Plate,
    Surface,
    U,
    W,
    plane_stress,
    tensor_mesh,
)
from evidence.sandwich_plate.plate_frame import strip_stiffness
from evidence.sandwich_plate.plate_known_answers import (
    FlatSandwich,
    cantilever_strip,
    square_plate_deflection,
    square_plate_frequency,
)

SOFT_CORE, STIFF_CORE = 20e6, 200e9


def sandwich(check, core_shear):
    return FlatSandwich(core_shear=core_shear, poisson_ratio=0.0 if check is cantilever_strip else 0.3)


CHECKS = (square_plate_deflection, square_plate_frequency, cantilever_strip)


@pytest.mark.parametrize("check", CHECKS)
def test_closed_forms_are_met_with_the_order_of_the_element(check):
    # The core shears as much as the plate bends: the element's order four.
    coarse, fine = (abs(check(cells, sandwich(check, SOFT_CORE)).relative_error) for cells in (4, 8))
    assert fine < 2e-4
    assert 3.6 < np.log2(coarse / fine) < 4.4


@pytest.mark.parametrize("check", CHECKS)
def test_a_core_that_hardly_shears_locks_mildly_and_converges(check):
    errors = [abs(check(cells, sandwich(check, STIFF_CORE)).relative_error) for cells in (4, 8, 16)]
    assert errors[-1] < 2e-3
    assert all(1.8 < np.log2(coarse / fine) < 2.5 for coarse, fine in itertools.pairwise(errors))


def test_an_inclined_sheet_stretches_along_itself():
    # A flat sheet z = 0.75 x moved along its own slope by 0.01 of its length: strain 0.01 in it.
    plate = Plate(tensor_mesh(2, 2))
    ones = np.ones(plate.weights.shape)
    x = plate.node_points[:, 0]
    surface = Surface(0.75 * plate.points[..., 0], 0.75 * ones, 0.0 * ones)
    fields = np.zeros((len(FIELDS), plate.nodes))
    fields[U], fields[W] = 0.01 * x, 0.01 * 0.75 * x
    sheet = plane_stress(ones, 0.0, 0.5 * ones)
    stiffness = plate.face_stiffness(np.arange(4), surface, 1.0, sheet)
    energy = 0.5 * fields.ravel() @ (stiffness @ fields.ravel())
    assert energy == pytest.approx(0.5 * 0.01**2 * 4.0 * 1.25)  # area 4 of the plan, 5/4 along the slope


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_turned_strains_are_those_of_the_tangent_basis(seed):
    random = np.random.default_rng(seed)
    z_x, z_y = random.standard_normal(2)
    tensor = random.standard_normal((3, 3))
    tensor = tensor + tensor.T  # any symmetric strain in space
    along = [np.array([1.0, 0.0, z_x]), np.array([0.0, 1.0, z_y])]
    plan = np.array(
        [along[0] @ tensor @ along[0], along[1] @ tensor @ along[1], 2 * along[0] @ tensor @ along[1]]
    )
    first = along[0] / np.linalg.norm(along[0])
    second = along[1] - (along[1] @ first) * first
    second /= np.linalg.norm(second)
    surface = Surface(np.array(0.0), np.array(z_x), np.array(z_y))
    expected = [first @ tensor @ first, second @ tensor @ second, 2.0 * first @ tensor @ second]
    assert surface.turned(plan[:, None])[:, 0] == pytest.approx(expected)
    assert surface.area_ratio == pytest.approx(np.linalg.norm(np.cross(*along)))


def test_a_strip_is_a_beam():
    stiffness = strip_stiffness(np.array([0.5, 2.0]))[1]
    assert np.linalg.eigvalsh(stiffness)[:2] == pytest.approx(0.0, abs=1e-12)
    # Clamped on the left, a unit force on the right: L^3 / 3 and L^2 / 2.
    assert np.linalg.solve(stiffness[2:, 2:], [1.0, 0.0]) == pytest.approx([8.0 / 3.0, 2.0])
