"""Evidence of twins whose parameter is unknown but constant, against sums over all its values."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import norm

from tests.twin_master.fleet.test_learning import tiny
from twin_master.fleet.learning.evidence import TransitionFamily
from twin_master.fleet.learning.grid_density import Axes
from twin_master.fleet.learning.noise import ParameterNodes
from twin_master.fleet.learning.parameter_evidence import (
    LEAST_POSTERIOR,
    likelihood_at_nodes,
    parameter_evidence,
)
from uav_twin import GaussianSensorModel

TRUTH = {"2g": 0.07, "3g": 0.2}
NODES = np.linspace(-6.0, 6.0, 61)
"""The values of the parameter, in standard deviations of the population."""
PRIOR = norm.pdf(NODES) / norm.pdf(NODES).sum()
TWINS, STEPS, GAUGES = 200, 20, 4
NOISE = 1e-4


class Springs:
    """Twins whose strain grows with damage and falls with a stiffness of their own, spread by 5 %."""

    def __init__(self) -> None:
        generator = np.random.default_rng(8)
        self.family = TransitionFamily.learnable(tiny(TRUTH))
        damage = np.add.outer(np.linspace(0.0, 0.4, 3), np.linspace(0.0, 0.4, 3)).ravel()
        strain = 1e-3 * (1.0 + damage) / (1.0 + 0.05 * NODES[:, None])
        self.values = np.broadcast_to(strain[:, :, None, None], (len(NODES), 9, 2, GAUGES))
        self.model = GaussianSensorModel(self.values, NOISE)
        # A flight at 3g, and from some step on at 2g.
        self.control = -np.sort(-generator.integers(0, 2, (TWINS, STEPS)), axis=1)
        levels = np.zeros((TWINS, STEPS, 2), dtype=np.int64)
        for t in range(1, STEPS):
            worsens = generator.random((TWINS, 2)) < np.array([0.07, 0.2])[self.control[:, t - 1, None]]
            levels[:, t] = np.minimum(levels[:, t - 1] + worsens, 2)
        self.state = 3 * levels[:, :, 0] + levels[:, :, 1]
        node = np.rint(30 + 5 * generator.standard_normal(TWINS)).astype(np.int64)
        exact = self.values[node[:, None], self.state, self.control]
        self.observed = exact + NOISE * generator.standard_normal(exact.shape)

    def by_all_nodes(self, point: np.ndarray) -> np.ndarray:
        """Return the log evidence (B,) for some probabilities, by a sum over all nodes."""
        at_nodes = parameter_evidence(self.family, point, self.model, self.observed, self.control)
        return logsumexp(at_nodes, b=PRIOR, axis=1)

    def by_probable_nodes(self, point: np.ndarray, axes: Axes) -> np.ndarray:
        """Return the log evidence (B, N^K), by the nodes that are probable at a point."""
        likelihood = likelihood_at_nodes(self.family, point, PRIOR, self.model, self.observed, self.control)
        return likelihood.evidence_on_grid(self.family, axes)


@pytest.fixture(scope="module")
def springs() -> Springs:
    """The twins, with what they have seen."""
    return Springs()


def test_probable_nodes_have_the_evidence_of_all(springs):
    """Each of the 61 nodes that are left out has less than a ten-thousandth of it."""
    point = np.array([0.05, 0.1])
    found = springs.by_probable_nodes(point, tuple(point[:, None]))[:, 0]
    missing = springs.by_all_nodes(point) - found
    assert (missing > -1e-12).all()
    assert (missing < 61 * LEAST_POSTERIOR).all()


def test_probable_nodes_give_a_fleet_the_likelihood_of_all_nodes(springs):
    """Over the range of the interval; a shift by a standard deviation would change it by 0.5."""
    rates = np.array([0.177, 0.2, 0.225])
    axes = (np.array([0.07]), rates)
    found = springs.by_probable_nodes(np.array([0.07, 0.2]), axes).sum(axis=0)
    expected = np.array([springs.by_all_nodes(np.array([0.07, rate])).sum() for rate in rates])
    np.testing.assert_allclose(found - found[1], expected - expected[1], atol=0.01)


def test_every_second_node_gives_a_fleet_the_likelihood_of_all_nodes(springs):
    nodes = ParameterNodes(NODES, PRIOR, springs.values).every_second
    rates = np.array([0.177, 0.2, 0.225])
    axes = (np.array([0.07]), rates)
    model = GaussianSensorModel(nodes.predicted, NOISE)
    likelihood = likelihood_at_nodes(
        springs.family, np.array([0.07, 0.2]), nodes.prior, model, springs.observed, springs.control
    )
    found = likelihood.evidence_on_grid(springs.family, axes).sum(axis=0)
    expected = np.array([springs.by_all_nodes(np.array([0.07, rate])).sum() for rate in rates])
    np.testing.assert_allclose(found - found[1], expected - expected[1], atol=0.02)


def test_draws_of_a_calibration_give_a_fleet_the_likelihood_of_all_nodes(springs):
    """An average over the draws in each step anew would be off by one."""
    draws = np.random.default_rng(5).standard_normal(300)
    strain = springs.values[0] * (1.0 + 0.05 * NODES[0])
    model = GaussianSensorModel(strain / (1.0 + 0.05 * draws[:, None, None, None]), NOISE)
    rates = np.array([0.177, 0.2, 0.225])
    axes = (np.array([0.07]), rates)
    likelihood = likelihood_at_nodes(
        springs.family,
        np.array([0.07, 0.2]),
        model.draw_weight,
        model,
        springs.observed,
        springs.control,
    )
    found = likelihood.evidence_on_grid(springs.family, axes).sum(axis=0)
    expected = np.array([springs.by_all_nodes(np.array([0.07, rate])).sum() for rate in rates])
    np.testing.assert_allclose(found - found[1], expected - expected[1], atol=0.1)


def test_twins_whose_observations_are_impossible_are_left_out(springs):
    """Readings without noise say that damage of the second twin goes back, which is impossible."""
    state = springs.state[:3].copy()
    state[1] = np.repeat([8, 0], STEPS // 2)
    control = springs.control[:3]
    observed = springs.values[30, state, control]
    model = GaussianSensorModel(springs.values, 0.05 * NOISE)
    likelihood = likelihood_at_nodes(springs.family, np.array([0.07, 0.2]), PRIOR, model, observed, control)
    axes = (np.array([0.07]), np.array([0.2]))
    evidence = likelihood.evidence_on_grid(springs.family, axes)
    assert len(evidence) == 2
    assert np.isfinite(evidence).all()
    np.testing.assert_array_equal(likelihood.control[likelihood.first_row], control[[0, 2]])
