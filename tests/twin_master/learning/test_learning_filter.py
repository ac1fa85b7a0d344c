"""What is learnt and expected, against sums over all trajectories, draws and factors, and closed forms."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import foldnorm, invgamma, multivariate_normal, multivariate_t, norm

from tests.costs import once
from tests.twin_master.network.decision_oracles import trajectories
from tests.twin_master.runs import estimates_of
from twin_master.errors import InvalidModelError
from twin_master.learning.draw_posterior import posterior_of_draws
from twin_master.learning.expectation import LearntExpectation, mixture_quantiles
from twin_master.learning.learning_filter import LearningFilter
from twin_master.learning.saturation import LOST_FRACTIONS
from twin_master.network.estimator import Learnt
from twin_master.network.graphical_model import worsening_table
from twin_master.network.quantity import RewardModel
from twin_master.scenario.tables import Learning
from uav_twin import GaussianSensorModel, GraphicalModel

Float = NDArray[np.float64]

STEPS, DRAWS, GAUGES = 4, 3, 2
FACTORS = (0.5, 1.0, 2.0)
CONTROLS = [0, 1, 0, 1]
NOTHING = Learning(noise=False)


def model(factor: float = 1.0, levels: int = 3) -> GraphicalModel:
    tables = {name: {"z": worsening_table(levels, factor * p)} for name, p in (("slow", 0.1), ("fast", 0.4))}
    first = np.full(levels, 1.0 / levels)
    return GraphicalModel.from_tables({"z": range(levels)}, tables, {"z": first})


def sensors() -> GaussianSensorModel:
    value = np.random.default_rng(1).normal(size=(DRAWS, 3, 2, GAUGES))
    return GaussianSensorModel(value, [0.7, 1.1], [0.2, 0.5, 0.3])


def observations() -> Float:
    seen = np.random.default_rng(2).normal(size=(STEPS, GAUGES))
    seen[1, 0] = np.nan
    seen[2] = np.nan
    return seen


@once
def enumerated(steps: int) -> Float:
    """Return p(path, draw, factor, o) over everything: (paths of S^T, E, R), not normalised."""
    sensor = sensors()
    table = np.zeros((3,) * steps + (DRAWS, len(FACTORS)))
    shown = sensor.value_per_draw[:, :, CONTROLS[:steps]].swapaxes(1, 2)  # (E, T, S, G)
    density = norm.logpdf(observations()[:steps, None], shown, sensor.standard_deviation)
    for draw, (place, factor) in product(range(DRAWS), enumerate(FACTORS)):
        *_, (_, joint) = trajectories(model(factor), CONTROLS, np.nansum(density[draw], axis=-1))
        table[..., draw, place] = joint * sensor.draw_weight[draw] / len(FACTORS)
    return table


def learner_of_all() -> LearningFilter:
    moves = {factor: model(factor).transition for factor in FACTORS}
    return LearningFilter(model(), sensors(), NOTHING, ("e", [0.9, 1.0, 1.1]), moves)


@pytest.mark.parametrize("degrees", [0.0, 6.0])
@pytest.mark.parametrize(("gain", "offset"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.5), (0.3, 0.5)])
def test_noise_gain_and_offset_of_a_gauge_are_a_conjugate_regression(degrees, gain, offset):
    """With one state the evidence is that of a multivariate Student or normal density, for each draw."""
    value = np.random.default_rng(3).normal(2.0, 1.0, size=(DRAWS, 1, 2, 1))
    sensor = GaussianSensorModel(value, 0.7, [0.2, 0.5, 0.3])
    seen = np.random.default_rng(4).normal(2.0, 1.5, size=(STEPS, 1))
    seen[2] = np.nan
    settings = Learning(
        noise=degrees > 0.0, noise_degrees=degrees or 10.0, gauge_gain=gain, gauge_offset=offset
    )
    learner = LearningFilter(model(levels=1), sensor, settings, ("e", [0.9, 1.0, 1.1]))
    estimates = estimates_of(learner, seen, CONTROLS)
    there = ~np.isnan(seen[:, 0])
    log_density = np.log(sensor.draw_weight)
    for draw in range(DRAWS):
        mean = value[draw, 0, CONTROLS, 0][there]
        shape = 0.49 * np.eye(there.sum()) + gain**2 * np.outer(mean, mean) + offset**2
        density = multivariate_t(mean, shape, degrees) if degrees else multivariate_normal(mean, shape)
        # The prior of the coefficients is in units of the noise: N(0, lambda² prior²).
        log_density[draw] += density.logpdf(seen[there, 0])
    evidence = sum(estimate.log_evidence for estimate in estimates)
    assert evidence == pytest.approx(np.logaddexp.reduce(log_density), abs=1e-10)
    weight = np.exp(log_density - np.logaddexp.reduce(log_density))
    np.testing.assert_allclose(np.exp(estimates[-1].carried.arrays["log_belief"][:, 0]), weight, rtol=1e-9)


def test_the_interval_of_a_state_is_not_learnt_as_noise():
    """Four gauges that two regions move together: half of what is seen could be explained by either."""
    random = np.random.default_rng(6)
    interval = 2.0 * random.normal(size=(1, 2, 4, 2))
    sensor = GaussianSensorModel(np.full((1, 1, 2, 4), 5.0), 0.7, interval=interval)
    controls = (np.arange(400) % 2).tolist()
    place = random.normal(size=(400, 2, 1))
    seen = 5.0 + (interval[0, controls] @ place)[..., 0] + 0.7 * random.normal(size=(400, 4))
    learner = LearningFilter(model(levels=1), sensor, Learning(noise_degrees=5.0))
    estimates = estimates_of(learner, seen, controls)
    learnt = estimates[-1].learnt
    for gauge in range(1, 5):
        assert learnt[f"noise_scale[{gauge}]"].mean == pytest.approx(1.0, abs=0.12)
    known = LearningFilter(model(levels=1), sensor, NOTHING)
    evidence = [estimate.log_evidence for estimate in estimates_of(known, seen, controls)]
    np.testing.assert_allclose(evidence, sensor.log_likelihood_sequence(seen, controls)[:, 0], atol=1e-10)


def posterior_on_grid(values: Float) -> Learnt:
    """Return the posterior of a parameter with prior N(0, 1) and likelihood N(0.61, 0.08) on some draws."""
    prior = np.exp(-0.5 * values**2) / np.exp(-0.5 * values**2).sum()
    weight = prior * np.exp(-0.5 * ((values - 0.61) / 0.08) ** 2)
    return posterior_of_draws(values, prior, weight / weight.sum())


def test_the_interval_of_a_parameter_does_not_depend_on_where_its_draws_lie():
    """Draws wider apart than the posterior: the evidence between them is interpolated."""
    exact = posterior_on_grid(np.linspace(-3, 3, 2001))
    coarse = posterior_on_grid(np.linspace(-3, 3, 25))
    assert coarse.mean == pytest.approx(exact.mean, abs=0.005)
    assert coarse.standard_deviation == pytest.approx(exact.standard_deviation, rel=0.05)
    assert (coarse.lower, coarse.upper) == pytest.approx((exact.lower, exact.upper), abs=0.01)


def test_the_posterior_of_many_draws_is_the_closed_form():
    exact = posterior_on_grid(np.linspace(-3, 3, 2001))
    standard_deviation = 0.08 / np.sqrt(1 + 0.08**2)
    assert exact.standard_deviation == pytest.approx(standard_deviation, rel=0.01)


def test_draws_may_be_few_and_the_same():
    posterior = posterior_of_draws([2.0, 1.0, 2.0], [0.25, 0.5, 0.25], [0.4, 0.2, 0.4])
    assert (posterior.mean, posterior.lower, posterior.upper) == pytest.approx((1.8, 1.0, 2.0))


def test_a_single_draw_is_certain():
    posterior = posterior_of_draws([2.0], [1.0], [1.0])
    assert (posterior.mean, posterior.standard_deviation) == (2.0, 0.0)


def test_a_belief_that_underflows_comes_back():
    """The hypothesis that is right from the second step on had a weight below the doubles."""
    value = np.array([0.0, 60.0])[:, None, None, None].repeat(2, axis=2)  # (E, 1, U, 1)
    learner = LearningFilter(model(levels=1), GaussianSensorModel(value, 1.0), NOTHING, ("e", [0, 60]))
    estimates = estimates_of(learner, np.array([[0.0], [60.0], [60.0]]), [0, 0, 0])
    log_belief = [estimate.carried.arrays["log_belief"][:, 0] for estimate in estimates]
    np.testing.assert_allclose(log_belief[0][1], -1800.0, rtol=1e-12)
    np.testing.assert_allclose(log_belief[2][0], -1800.0, rtol=1e-12)


SETTINGS = 2.0, (-0.1, 0.1), 0.8, (2.0, 3.0)
POLICY = np.array([[0.0, 1.0], [0.3, 0.7], [1.0, 0.0]])


def moments(values: Float, weight: Float) -> tuple[Float, Float]:
    """Return mean and standard deviation of values (..., n) under weights (...)."""
    share = weight / weight.sum()
    mean = np.tensordot(share, values, axes=weight.ndim)
    return mean, np.sqrt(np.tensordot(share, (values - mean) ** 2, axes=weight.ndim))


@pytest.mark.parametrize("other", [None, np.array([0.2, 0.7, 0.1])])
def test_filtered_and_smoothed_are_sums_over_all_trajectories(other):
    """States, draws and transition factors; what is expected to be seen, also of another belief."""
    learner, seen, rewards = learner_of_all(), observations(), RewardModel(sensors(), *SETTINGS)
    expectation, steps = LearntExpectation(learner, rewards, POLICY), estimates_of(learner, seen, CONTROLS)
    carried = [step.carried for step in steps]
    now, later = np.array([step.filtered for step in steps]), learner.smoothed(carried)
    value, whole, evidence = sensors().value_per_draw, enumerated(STEPS), 0.0
    for t, step in enumerate(steps):
        until = enumerated(t + 1)
        evidence += step.log_evidence
        assert evidence == pytest.approx(np.log(until.sum()), abs=1e-12)
        joint = until.reshape(-1, 3, DRAWS, len(FACTORS)).sum(axis=0) / until.sum()
        np.testing.assert_allclose(now[t], joint.sum(axis=(1, 2)), rtol=1e-11)
        belief = np.exp(step.carried.arrays["log_belief"]).reshape(len(FACTORS), DRAWS, 3)
        np.testing.assert_allclose(belief, joint.transpose(2, 1, 0), rtol=1e-11)
        factor = step.learnt["transition_factor"]
        assert factor.mean == pytest.approx(joint.sum(axis=(0, 1)) @ FACTORS, rel=1e-9)
        others = tuple(axis for axis in range(STEPS + 2) if axis != t)
        np.testing.assert_allclose(later[t], whole.sum(axis=others) / whole.sum(), rtol=1e-10)
    if other is not None:
        now = later = np.tile(other, (STEPS, 1))
    filtered, smoothed = expectation.filtered(carried, now, seen), expectation.smoothed(carried, later, seen)
    for t in range(STEPS):
        until = enumerated(t + 1)
        for found, table, axis in ((filtered, until, t), (smoothed, whole, t)):
            others = tuple(n for n in range(table.ndim - 2) if n != axis)
            weight = table.sum(axis=(*others, table.ndim - 1))  # (S, E)
            if other is not None:
                weight *= (other / weight.sum(axis=1))[:, None]
            shown = value[:, :, CONTROLS[t]].swapaxes(0, 1)  # (S, E, G)
            mean, deviation = moments(shown, weight)
            np.testing.assert_allclose(found.mean[t], mean, atol=1e-8)
            np.testing.assert_allclose(found.standard_deviation[t], deviation, atol=1e-8)
            np.testing.assert_allclose(found.noise_standard_deviation[t], [0.7, 1.1])
            health = rewards.health_per_draw[:, :, CONTROLS[t]].T[..., None]
            distance = np.ma.masked_invalid(np.abs(seen[t] - shown)).mean(axis=-1, keepdims=True)
            error = -distance.filled(np.nan) / (0.8 * np.array((2.0, 3.0))[CONTROLS[t]])
            for place, reward in ((0, health), (2, error)):
                mean, deviation = moments(reward, weight)
                np.testing.assert_allclose(found.reward_mean[t, place], mean[0], atol=1e-8)
                np.testing.assert_allclose(found.reward_standard_deviation[t, place], deviation[0], atol=1e-7)


@pytest.fixture(scope="module")
def predicted_two_steps():
    """What is predicted two steps ahead of the last one."""
    *_, step = estimates_of(learner_of_all(), observations(), CONTROLS)
    expectation = LearntExpectation(learner_of_all(), RewardModel(sensors(), *SETTINGS), POLICY)
    return expectation.predicted([step.carried], [step.filtered], [POLICY], 2)


def joint_two_steps_ahead():
    """Return p(D_t+1, D_t+2, U_t+2, draw), over D_t = n and U_t+1 = u."""
    joint = enumerated(STEPS).sum(axis=(0, 1, 2, 5))  # (S, E)
    filtered = joint / joint.sum()
    transition = model().transition.matrix
    return np.einsum("nd,no,ou,uot,tv->otvd", filtered, transition[CONTROLS[-1]], POLICY, transition, POLICY)


def test_predicted_follows_the_scenario_through_the_policy(predicted_two_steps):
    values = sensors().value_per_draw.transpose(1, 2, 0, 3)
    by_first_state = np.broadcast_to(values, (3, 3, 2, DRAWS, GAUGES))
    mean, deviation = moments(by_first_state, joint_two_steps_ahead())
    np.testing.assert_allclose(predicted_two_steps.mean[0, 1], mean, atol=1e-8)
    np.testing.assert_allclose(predicted_two_steps.standard_deviation[0, 1], deviation, atol=1e-8)


def test_of_the_rewards_that_of_the_control_is_predicted(predicted_two_steps):
    """That of what is observed is not: nothing has been observed there."""
    control_probability = joint_two_steps_ahead().sum(axis=(0, 1, 3))
    reward = predicted_two_steps.reward_mean
    assert np.isnan(reward[..., 2]).all()
    assert reward[0, 1, 1] == pytest.approx(control_probability @ [-0.1, 0.1])


SIGMA = 0.5
PRIOR = {"gauge_offset[1]": 2.0, "gauge_gain[1]": 0.1}
"""Noise of the gauge, and prior standard deviations of its offset and gain."""


class Regression:
    """Readings of one gauge with an offset, a gain and noise: as they are learnt, and in closed form.

    The closed form is the Bayesian linear regression of (o - h) / sigma on offset and gain in units of
    their prior standard deviations, with the noise scale integrated out.
    """

    def __init__(self) -> None:
        value = np.full((1, 1, 2, 1), 5.0)
        value[0, 0, 1] = 8.0
        controls = [0, 1, 1, 0, 1, 1, 0]
        self.sensor = GaussianSensorModel(value, [SIGMA])
        priors = Learning(noise_degrees=10.0, gauge_gain=0.1, gauge_offset=2.0)
        self.learner = LearningFilter(model(levels=1), self.sensor, priors)
        self.shown = value[0, 0, controls, 0]
        errors = np.array([0.1, -0.7, 0.4, 0.2, -0.1, np.nan, 0.9])
        self.observed = 1.5 + 0.93 * self.shown + errors
        self.estimates = estimates_of(self.learner, self.observed[:, None], controls)
        self.learnt = self.estimates[-1].learnt
        self.solve()

    def solve(self) -> None:
        is_read = ~np.isnan(self.observed)
        self.design = np.stack([np.full(6, 2.0), 0.1 * self.shown[is_read]], axis=1) / SIGMA
        residual = (self.observed - self.shown)[is_read] / SIGMA
        self.covariance = np.linalg.inv(np.eye(2) + self.design.T @ self.design)
        self.mean = self.covariance @ self.design.T @ residual
        self.squares = 10.0 + residual @ residual - self.mean @ self.design.T @ residual
        self.squared_scale = self.squares / (10.0 + 6.0 - 2.0)

    def last_prediction(self) -> tuple[float, float]:
        """Return mean and standard deviation of the quantity under the last reading."""
        row = self.design[-1]
        variance = self.squared_scale * row @ self.covariance @ row
        return self.shown[-1] + SIGMA * row @ self.mean, SIGMA * np.sqrt(variance)


@pytest.fixture(scope="module")
def regression() -> Regression:
    return Regression()


@pytest.mark.parametrize(("number", "name"), [*enumerate(PRIOR)])
def test_offset_and_gain_are_those_of_the_regression(regression, number, name):
    learnt, prior = regression.learnt[name], PRIOR[name]
    mean = prior * regression.mean[number]
    variance = regression.squared_scale * regression.covariance[number, number]
    standard_deviation = prior * np.sqrt(variance)
    interval = norm(mean, standard_deviation).ppf([0.05, 0.95])
    assert (learnt.mean, learnt.standard_deviation) == pytest.approx((mean, standard_deviation))
    assert (learnt.lower, learnt.upper) == pytest.approx(interval)


def test_the_noise_is_that_of_the_regression(regression):
    noise = regression.learnt["noise_scale[1]"]
    squared = invgamma(8.0, scale=0.5 * regression.squares)
    assert noise.mean == pytest.approx(squared.expect(np.sqrt))
    assert (noise.lower, noise.upper) == pytest.approx(np.sqrt(squared.ppf([0.05, 0.95])))


@pytest.fixture(scope="module")
def expected_by_regression(regression: Regression) -> Any:
    """What is expected of the gauge and of the reward from what was learnt."""
    rewards = RewardModel(regression.sensor, 9.0, (0.0, 0.0), 0.8)
    expectation = LearntExpectation(regression.learner, rewards, np.array([[1.0, 0.0]]))
    carried = [step.carried for step in regression.estimates]
    beliefs = [step.filtered for step in regression.estimates]
    return expectation.filtered(carried, beliefs, regression.observed[:, None])


def test_the_quantity_that_is_expected_is_that_of_the_regression(regression, expected_by_regression):
    mean, standard_deviation = regression.last_prediction()
    noise = SIGMA * np.sqrt(regression.squared_scale)
    assert expected_by_regression.mean[-1, 0] == pytest.approx(mean)
    assert expected_by_regression.standard_deviation[-1, 0] == pytest.approx(standard_deviation)
    assert expected_by_regression.noise_standard_deviation[-1, 0] == pytest.approx(noise)


def test_the_reward_that_is_expected_is_that_of_a_folded_normal(regression, expected_by_regression):
    _, standard_deviation = regression.last_prediction()
    distance = abs(regression.observed[-1] - expected_by_regression.mean[-1, 0])
    folded = foldnorm(distance / standard_deviation, scale=standard_deviation)
    reward = expected_by_regression.reward_mean[-1, 2]
    deviation = expected_by_regression.reward_standard_deviation[-1, 2]
    assert reward == pytest.approx(-folded.mean() / 0.8)
    assert deviation == pytest.approx(folded.std() / 0.8)


def test_the_interval_that_is_expected_is_that_of_a_normal(regression, expected_by_regression):
    _, standard_deviation = regression.last_prediction()
    mean = expected_by_regression.mean[-1, 0]
    interval = norm(mean, standard_deviation).ppf([0.025, 0.975])
    found = (expected_by_regression.lower[-1, 0], expected_by_regression.upper[-1, 0])
    assert found == pytest.approx(tuple(interval), abs=1e-3 * standard_deviation)


def test_quantiles_are_those_of_the_mixture():
    weight, mean, deviation = np.array([0.5, 0.3, 0.2]), np.array([0.0, 4.0, 5.0]), np.array([1.0, 0.5, 0.0])
    levels = np.array([0.025, 0.5, 0.9])
    result = mixture_quantiles(weight, mean[:, None], deviation[:, None], levels)
    reached = norm.cdf((result[:2] - mean[:2]) / deviation[:2]) @ weight[:2]
    np.testing.assert_allclose(reached, levels[:2], atol=1e-4)
    assert result[2, 0] == pytest.approx(5.0, abs=1e-3)


def test_a_parameter_known_by_its_moments_stands_a_deviation_to_either_side():
    """Its mean lies half way between draws on both sides."""
    sensor = sensors()
    learner = LearningFilter(model(), sensor, NOTHING, ("e", [1.1, 0.9, 1.0]))
    rewards = RewardModel(sensor, 1.0, (0.0, 0.1), 1.0)
    expectation = LearntExpectation(learner, rewards, np.full((3, 2), 0.5))
    joint = np.zeros((1, 3, 2))
    joint[0, 1, 1] = 1.0
    learnt = {"e": Learnt(1.0, 0.05, 0.9, 1.1)}
    expected = expectation.from_marginals(learnt, joint, slice(None), None)
    values = sensor.value_per_draw[:, 1, 1]
    weights = np.array([0.25, 0.25, 0.5])
    mean = weights @ values
    deviation = np.sqrt(weights @ (values - mean) ** 2)
    np.testing.assert_allclose(expected.mean[0], mean, rtol=1e-12)
    np.testing.assert_allclose(expected.standard_deviation[0], deviation, rtol=1e-9)


LARGEST = 3.0


def saturating_learner(*, draws_are_learnt: bool) -> tuple[LearningFilter, Float, Float]:
    """Return a filter that learns saturation, what its draws show (N, E, G), and readings (T, G)."""
    value = np.array([0.9, 1.0, 1.1])[:, None] * [1.0, 2.0, LARGEST]  # (E, G)
    largest = LARGEST * (0.2 * 0.9 + 0.5 + 0.3 * 1.1)  # the mean over the draws
    limit = largest / np.sqrt(3.0 * LOST_FRACTIONS[1:, None, None])
    shown = np.concatenate([value[None], limit * np.tanh(value / limit)])
    seen = shown[4, 1] + np.random.default_rng(5).normal(0.0, 0.1, size=(6, 3))
    sensor = GaussianSensorModel(value[:, None, None].repeat(2, axis=2), 0.1, [0.2, 0.5, 0.3])
    settings = Learning(noise=False, saturation=0.4)
    parameter = ("e", [0.9, 1.0, 1.1]) if draws_are_learnt else None
    return LearningFilter(model(levels=1), sensor, settings, parameter), shown, seen


@pytest.mark.parametrize("draws_are_learnt", [True, False])
def test_saturation_is_weighed_as_further_draws_of_all_gauges(draws_are_learnt):
    learner, shown, seen = saturating_learner(draws_are_learnt=draws_are_learnt)
    estimates = estimates_of(learner, seen, [0, 1] * 3)
    density = norm.logpdf(seen[:, None, None], shown, 0.1).sum(axis=-1)  # (T, N, E)
    log_draw = np.log([0.2, 0.5, 0.3])
    if draws_are_learnt:
        of_share = np.logaddexp.reduce(density.sum(axis=0) + log_draw, axis=-1)
    else:  # they are averaged anew in each step
        of_share = np.logaddexp.reduce(density + log_draw, axis=-1).sum(axis=0)
    of_share += np.log([0.6, *[0.4 / 6] * 6])
    weight = np.exp(of_share - np.logaddexp.reduce(of_share))
    learnt = estimates[-1].learnt["saturation"]
    assert sum(estimate.log_evidence for estimate in estimates) == pytest.approx(
        np.logaddexp.reduce(of_share)
    )
    assert learnt.mean == pytest.approx(weight @ LOST_FRACTIONS)
    assert learner.prior["saturation"].mean == pytest.approx(0.4 * LOST_FRACTIONS[1:].mean())


def test_saturation_that_is_believed_is_told_and_expected():
    learner, shown, seen = saturating_learner(draws_are_learnt=True)
    estimates = estimates_of(learner, np.tile(seen, (4, 1)), [0] * 24)
    (notice,) = [notice for estimate in estimates for notice in estimate.notices]
    assert "large readings of all gauges are too small" in notice.sentence
    rewards = RewardModel(
        GaussianSensorModel(shown[0][:, None, None].repeat(2, axis=2), 0.1),
        limit=1.0,
        control_reward=(0, 0),
        error_scale=1.0,
    )
    expected = LearntExpectation(learner, rewards, np.eye(2)[:1])
    of_filter = expected.filtered([estimates[-1].carried], np.ones((1, 1)), seen[:1])
    np.testing.assert_allclose(of_filter.mean[0], shown[4, 1], rtol=0.03)
    of_moments = expected.from_marginals(estimates[-1].learnt, np.ones((1, 1, 1)), slice(0, 1), seen[0])
    np.testing.assert_allclose(of_moments.mean[0], of_filter.mean[0], rtol=0.01)
    assert of_filter.reward_mean[0, 0] == pytest.approx(of_moments.reward_mean[0, 0], rel=0.02)


def test_saturation_needs_sensors_with_gaussian_noise():
    class Mine(GaussianSensorModel):
        pass

    sensor = Mine(np.ones((1, 1, 2, 1)), 0.1)
    with pytest.raises(InvalidModelError, match=r"needs sensors with Gaussian noise, and got a Mine"):
        LearningFilter(model(levels=1), sensor, Learning(saturation=0.01))
