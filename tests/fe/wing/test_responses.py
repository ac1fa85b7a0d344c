"""The wing at rest and its modes against what is published: frequencies, stiffness, a library of strains."""

import json

import numpy as np
import pytest

from fe.wing.operators import assemble
from fe.wing.responses import eigenmodes, solve_static
from tests.wings import tip_stiffness

STATE = (1.0, (0.0, 0.0), 0.16875, 0.1345)
LIBRARY_FACTOR = 1.0073  # the published library's mean strains belong to this e


@pytest.fixture(scope="module")
def library(published_library):
    """Strains (gauges,) of the published library at losses in per cent."""
    observations = json.loads(published_library.read_text())["observations"]
    return lambda z1, z2: np.array(observations[str(z1)][str(z2)]["3g"]["mean"]) * 1e-6


@pytest.fixture(scope="module")
def shipped_strain(shipped_operators):
    def strain(z1, z2):
        return solve_static(shipped_operators, LIBRARY_FACTOR, (z1 / 100, z2 / 100), load_factor=3.0).strain

    return {state: strain(*state) for state in ((0, 0), (40, 0), (80, 0), (0, 80))}


def test_lift_compresses_every_gauge_lifts_the_tip_and_is_reciprocal_to_a_force_there(coarse_operators):
    turn = solve_static(coarse_operators, load_factor=3.0)
    tip = solve_static(coarse_operators, load_factor=0.0, tip_force=1.0)
    assert np.all(turn.strain > 0.0)
    assert turn.output[0] > coarse_operators.load_tip @ turn.displacement > 0.0
    work = 3.0 * float(coarse_operators.load_lift @ tip.displacement)
    assert coarse_operators.load_tip @ turn.displacement == pytest.approx(work, rel=1e-5)


@pytest.mark.parametrize("factor", [0.98, 1.02])
def test_tip_stiffness_is_the_published_one(shipped_operators, factor):
    # Kapteyn et al. 2021, eq. (14): k(e) = 0.5752 e + 0.1018 N/mm.
    assert tip_stiffness(shipped_operators, factor) == pytest.approx(575.2 * factor + 101.8, rel=0.001)


def test_healthy_strains_at_3g_are_those_of_the_library(shipped_strain, library):
    ratio = shipped_strain[0, 0] / library(0, 0)
    assert np.abs(ratio - 1.0).max() < 0.055
    assert np.sqrt(np.mean((ratio - 1.0) ** 2)) < 0.03


@pytest.mark.parametrize("state", [(40, 0), (80, 0), (0, 80)])
def test_damage_raises_each_strain_as_in_the_library(shipped_strain, library, state):
    ours = shipped_strain[state] / shipped_strain[0, 0]
    theirs = library(*state) / library(0, 0)
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 0.016
    assert np.abs(ours - theirs).max() < 0.040


@pytest.mark.parametrize("z1", [0, 40, 80])
def test_the_gauge_that_limits_the_flight_is_that_of_the_library(shipped_strain, library, z1):
    ours, theirs = shipped_strain[z1, 0], library(z1, 0)
    assert ours.argmax() == theirs.argmax() == 16
    assert ours.max() == pytest.approx(theirs.max(), rel=0.011)


@pytest.mark.parametrize(("yaw_spring", "place"), [(1.5e3, [1, 2]), (1e9, None)])
def test_bending_is_found_wherever_the_lag_mode_lies(coarse_design, coarse_operators, yaw_spring, place):
    other = assemble(coarse_design.changed(root={"yaw_spring": yaw_spring}))
    modes, plain = (eigenmodes(wing, *STATE) for wing in (other, coarse_operators))
    assert place in (None, modes.flapwise_bending.tolist())
    wanted = plain.frequency[plain.flapwise_bending]
    assert modes.frequency[modes.flapwise_bending] == pytest.approx(wanted, rel=2e-3)


def test_the_wing_has_the_published_frequencies(shipped_operators):
    # The published model after calibration: 5.632 Hz and 28.544 Hz at e = 1, one other mode between them.
    modes = eigenmodes(shipped_operators, *STATE)
    assert modes.frequency[modes.flapwise_bending] == pytest.approx([5.632, 28.544], rel=0.0007)
    assert modes.flapwise_bending.tolist() == [0, 2]
