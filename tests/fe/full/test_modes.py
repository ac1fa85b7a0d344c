import numpy as np
import pytest
from scipy import sparse

from fe.full.factorisation import lowest_eigenpairs
from fe.runtime.errors import SolutionError
from fe.wing.operators import assemble, point_masses
from fe.wing.responses import eigenmodes

STATE = (1.0, (0.0, 0.0), 0.16875, 0.1345)


@pytest.fixture(scope="module")
def coarse_modes(coarse_operators):
    return eigenmodes(coarse_operators, *STATE)


def test_shapes_are_mass_normalised_and_give_their_frequencies(coarse_operators, coarse_modes):
    shape, stiffness = coarse_modes.shape, coarse_operators.stiffness()
    assert shape.T @ (coarse_operators.mass(point_masses(*STATE[2:])) @ shape) == pytest.approx(
        np.eye(6), abs=1e-8
    )
    square = (2.0 * np.pi * coarse_modes.frequency) ** 2
    assert np.diag(shape.T @ (stiffness @ shape)) == pytest.approx(square, rel=1e-5)
    assert np.all(np.diff(coarse_modes.frequency) > 0.0)


@pytest.mark.parametrize(("yaw_spring", "place"), [(1.5e3, [1, 2]), (1e9, None)])
def test_bending_is_found_wherever_the_lag_mode_lies(coarse_design, coarse_modes, yaw_spring, place):
    modes = eigenmodes(assemble(coarse_design.changed(root={"yaw_spring": yaw_spring})), *STATE)
    assert place in (None, modes.flapwise_bending.tolist())
    wanted = coarse_modes.frequency[coarse_modes.flapwise_bending]
    assert modes.frequency[modes.flapwise_bending] == pytest.approx(wanted, rel=2e-3)


def test_eigenpairs_equal_the_dense_ones():
    random = np.random.default_rng(3).standard_normal((40, 40))
    stiffness, mass = random @ random.T + np.eye(40), np.linspace(1.0, 2.0, 40)
    values, _ = lowest_eigenpairs(sparse.csr_array(stiffness), sparse.diags_array(mass).tocsr(), 4)
    dense = np.linalg.eigvals(stiffness / mass[:, None]).real
    assert values == pytest.approx(np.sort(dense)[:4], rel=1e-9)


def test_an_unsupported_structure_is_refused():
    stiffness = sparse.csr_array(np.diag([0.0, *np.arange(1.0, 20.0)]))
    with pytest.raises(SolutionError, match="not held"):
        lowest_eigenpairs(stiffness, sparse.eye_array(20).tocsr(), 3)


def test_the_wing_has_the_published_frequencies(shipped_operators):
    # The published model after calibration: 5.632 Hz and 28.544 Hz at e = 1, one other mode between them.
    modes = eigenmodes(shipped_operators, *STATE)
    assert modes.frequency[modes.flapwise_bending] == pytest.approx([5.632, 28.544], rel=0.0007)
    assert modes.flapwise_bending.tolist() == [0, 2]
