"""Hypotheses estimated with their laws inside the smoother, on simulated rigs."""

import numpy as np
import pytest

from discrepancy.estimation.effects import EffectLaws
from discrepancy.estimation.estimator import MotionEstimator
from discrepancy.estimation.gauss_newton import EstimatorStart
from discrepancy.estimation.refinement import refine_hypotheses, unknowns_of_model_laws
from discrepancy.estimation.trajectory import Trajectory
from discrepancy.fits.candidate import Candidate
from discrepancy.missing_force.naming import ForceSearch
from tests.discrepancy.missing_force.test_force import CART, CART_IN_AIR, available, blind


@pytest.fixture(scope="module")
def friction(tmp_path_factory):
    """Return the search for the force of a cart that dry friction brings to rest, and its effects."""
    problem = blind(tmp_path_factory.mktemp("friction"), CART)
    return ForceSearch(problem), available(problem)


def test_without_a_law_it_is_the_missing_force_as_it_was_seen(tmp_path):
    search = ForceSearch(blind(tmp_path, CART_IN_AIR))
    seen = search.hypothesis_of_all_ports
    trials = tuple(seen.linear_trials.trials)
    nothing = EffectLaws(
        search.column_builder, trials, Candidate(), search.evaluate_model_laws, unknowns_of_model_laws(search)
    )
    trajectories = tuple(
        Trajectory(motion.added_state, motion.positions, motion.speeds, motion.forces)
        for motion in seen.motions
    )
    estimator = MotionEstimator(
        trials, search.problem.shared.precision, search.prior_processes(seen.processes)
    )
    start = EstimatorStart(np.zeros(0), seen.shared, trajectories, seen.processes)
    found = estimator.estimate(nothing, start)
    assert found.log_evidence == pytest.approx(seen.log_evidence, abs=0.05)
    for one, motion in zip(found.trials, seen.motions, strict=True):
        scale = np.abs(motion.forces[0]).max()
        np.testing.assert_allclose(one.missing_forces[0], motion.forces[0], atol=0.02 * scale)


def test_friction_that_ends_a_motion_leads_over_a_free_exponent(friction):
    search, effects = friction
    followed = search.rank_hypotheses(effects)
    assert followed[0].candidate.identifiers != ("coulomb_friction",)  # along a motion taken as known
    ranked = refine_hypotheses(search, followed, len(effects))
    assert ranked[0].candidate.identifiers == ("coulomb_friction",)
