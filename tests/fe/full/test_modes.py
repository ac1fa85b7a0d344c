import numpy as np
import pytest
from scipy import sparse

from fe.full.modes import lowest_eigenpairs
from fe.runtime.errors import SolutionError
from fe.wing.operators import assemble, point_masses
from fe.wing.responses import eigenmodes

MASSES = (0.16875, 0.1345)


@pytest.fixture(scope="module")
def coarse_modes(coarse_operators):
    return eigenmodes(coarse_operators, 1.0, (0.0, 0.0), *MASSES)


def test_shapes_are_mass_normalised_and_give_their_frequencies(coarse_operators, coarse_modes):
    shape = coarse_modes.shape
    mass, stiffness = coarse_operators.mass(point_masses(*MASSES)), coarse_operators.stiffness()
    assert shape.T @ (mass @ shape) == pytest.approx(np.eye(6), abs=1e-8)
    square = (2.0 * np.pi * coarse_modes.frequency) ** 2
    assert np.diag(shape.T @ (stiffness @ shape)) == pytest.approx(square, rel=1e-5)
    assert np.all(np.diff(coarse_modes.frequency) > 0.0)


def test_bending_is_found_wherever_the_lag_mode_lies(coarse_design, coarse_operators, coarse_modes):
    first, second = coarse_modes.frequency[coarse_modes.flapwise_bending]
    for yaw_spring, place in ((1.5e3, [1, 2]), (1e9, None)):
        design = coarse_design.changed(root={"yaw_spring": yaw_spring})
        modes = eigenmodes(assemble(design), 1.0, (0.0, 0.0), *MASSES)
        if place is not None:
            assert modes.flapwise_bending.tolist() == place
        assert modes.frequency[modes.flapwise_bending] == pytest.approx([first, second], rel=2e-3)


def test_eigenpairs_equal_the_dense_ones():
    random = np.random.default_rng(3).standard_normal((40, 40))
    stiffness = sparse.csr_array(random @ random.T + np.eye(40))
    mass = sparse.diags_array(np.linspace(1.0, 2.0, 40)).tocsr()
    values, _ = lowest_eigenpairs(stiffness, mass, 4)
    dense = np.linalg.eigvals(np.linalg.solve(mass.toarray(), stiffness.toarray())).real
    assert values == pytest.approx(np.sort(dense)[:4], rel=1e-9)


def test_an_unsupported_structure_is_refused():
    stiffness = sparse.csr_array(np.diag([0.0, *np.arange(1.0, 20.0)]))
    with pytest.raises(SolutionError, match="not held"):
        lowest_eigenpairs(stiffness, sparse.eye_array(20).tocsr(), 3)


def test_the_wing_has_the_published_frequencies(shipped_operators):
    # The published model after calibration: 5.632 Hz and 28.544 Hz at e = 1, one other mode between them.
    modes = eigenmodes(shipped_operators, 1.0, (0.0, 0.0), *MASSES)
    assert modes.frequency[modes.flapwise_bending] == pytest.approx([5.632, 28.544], rel=0.0007)
    assert modes.flapwise_bending.tolist() == [0, 2]
