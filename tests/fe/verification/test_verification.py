import math

import numpy as np
import pytest

from fe.verification.known_answers import (
    cantilever_check,
    macneal_harder_beam,
    mesh_convergence,
    observed_order,
    patch_test,
    rigid_body_residual,
    rigid_body_values,
    wing_balance,
)


def test_a_constant_strain_passes_through_distorted_cells():
    assert max(patch_test()) < 1e-12


def test_an_unsupported_body_has_six_rigid_motions():
    values = rigid_body_values()
    assert (values < 1e-12).sum() == 6
    assert values[6] > 1e-6


def test_a_cantilever_bends_as_timoshenko_says():
    assert abs(cantilever_check()) < 1e-3
    # It converges to the beam, and a coarse one is already near.
    coarse, fine = (abs(cantilever_check(cells)) for cells in (5, 10))
    assert abs(cantilever_check(20)) < fine < coarse < 0.01
    assert 2.5 < np.log2(coarse / fine) < 4.5  # the tip of a quadratic element: third to fourth order


# R. H. MacNeal and R. L. Harder (1985), table 3, column HEX20: the same element in another code.
@pytest.mark.parametrize(
    ("shape", "in_plane", "out_of_plane"),
    [("regular", 0.970, 0.961), ("trapezoid", 0.886, 0.920), ("parallelogram", 0.967, 0.941)],
)
def test_the_slender_beam_of_macneal_and_harder_is_reproduced(shape, in_plane, out_of_plane):
    assert macneal_harder_beam(shape, across_depth=True) == pytest.approx(in_plane, abs=6e-4)
    assert macneal_harder_beam(shape, across_depth=False) == pytest.approx(out_of_plane, abs=6e-4)


def test_the_wing_resists_no_rigid_motion(coarse_operators):
    assert rigid_body_residual(coarse_operators) < 1e-12


def test_mass_reactions_and_energy_balance(coarse_operators):
    balance = wing_balance(coarse_operators)
    assert list(balance) == ["mass", "reaction", "root moment", "energy and work"]
    for name, (found, expected, _) in balance.items():
        assert found == pytest.approx(expected, rel=1e-10 if name == "mass" else 1e-5)


def test_the_structure_weighs_what_it_should(shipped_operators):
    # No weight is published: this is what the parts of the shipped design weigh on the shipped mesh.
    assert wing_balance(shipped_operators)["mass"][0] == pytest.approx(0.947, rel=0.002)


@pytest.mark.long
def test_the_mesh_converges(shipped_design):
    found = mesh_convergence(shipped_design, (0.25, 0.5, 1.0))
    assert (np.diff(found["unknowns"]) > 0).all()
    for name in ("tip stiffness", "first bending", "second bending"):
        coarse, half, one = found[name]
        assert one == pytest.approx(half, rel=0.025)
        assert half == pytest.approx(coarse, rel=0.025)
    assert np.sqrt(np.mean((found["strain"][2] / found["strain"][1] - 1.0) ** 2)) < 0.05


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0, 3.7])
@pytest.mark.parametrize("refinements", [(0.5, 1.0, 2.0), (1.0, 1.5, 2.25), (0.25, 0.5, 1.5, 4.5)])
def test_the_order_of_a_power_law_is_found(refinements, order):
    values = [7.0 - 0.3 * refinement**-order for refinement in refinements]
    assert observed_order(refinements[-1] / refinements[-2], values) == pytest.approx(order, abs=1e-6)


@pytest.mark.parametrize("values", [(1.0, 2.0, 1.5), (1.0, 2.0, 4.0), (1.0, 1.0, 1.0)])
def test_no_order_where_values_do_not_settle(values):  # to and fro, running away, standing still
    assert math.isnan(observed_order(2.0, values))
