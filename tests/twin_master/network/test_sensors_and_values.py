"""Likelihoods of sensors against integrals; rewards and plans against sums, solvers and enumeration."""

from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm
from scipy.stats import t as student_t

from benchmarks.studies.planning import PROBLEMS, tiger
from twin_master.errors import InvalidModelError, InvalidObservationError, PlanningError
from twin_master.mission.parts import object_by_name
from twin_master.network import simulated_missions
from twin_master.network.belief_planning import plan_on_belief
from twin_master.network.decision_problem import DecisionProblem
from twin_master.network.identified import IdentifiedSensorModel
from twin_master.network.inference import known_control
from twin_master.network.planner import BeliefPolicy, evaluate_policy, value_iteration
from twin_master.network.quantity import QuantityModel, RewardModel
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.network.simulated_missions import leaving_probability, simulated_returns
from twin_master.network.transition import TransitionModel

SEEDS = st.integers(0, 2**32 - 1)
DRAWS, STATES, CONTROLS, SENSORS = 5, 4, 2, 6
EXAMPLE = Path(__file__).parents[3] / "docs/how_to/add/example_plug_in/bar_plug_in/inference.py"


def random_sensors(seed, spread=1.0):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(DRAWS, STATES, CONTROLS, SENSORS)) * spread
    weight = rng.dirichlet(np.ones(DRAWS))
    deviation = rng.uniform(0.5, 2.0, SENSORS)
    observation = rng.normal(size=SENSORS) * spread
    return rng, values, weight, deviation, observation


@pytest.mark.parametrize("control", [[0, 1, 1], [0.0, 1.0, 1.0]])
def test_a_masked_reading_is_a_lost_one(control):
    rng, values, _, deviation, _ = random_sensors(0)
    sensors = GaussianSensorModel(values, deviation)
    readings = rng.normal(size=(3, SENSORS))
    is_lost = np.eye(3, SENSORS, dtype=bool)
    filled = np.where(is_lost, -9999.0, readings)

    masked = sensors.log_likelihood_sequence(np.ma.masked_equal(filled, -9999.0), control)

    lost = sensors.log_likelihood_sequence(np.where(is_lost, np.nan, readings), [0, 1, 1])
    np.testing.assert_array_equal(masked, lost)


def test_a_control_between_two_controls_is_refused():
    _, values, _, deviation, observation = random_sensors(0)

    with pytest.raises(InvalidModelError, match=r"must be whole numbers, but one is 0\.5"):
        GaussianSensorModel(values, deviation).log_likelihood(observation, 0.5)


class StudentByRow(GaussianSensorModel):
    """A Student-t model as SciPy has it, of one observation at a time."""

    def log_likelihood(self, observation, control_index):
        is_seen = ~np.isnan(observation)
        predicted = self.value_per_draw[:, :, control_index, is_seen]
        deviation = self.total_standard_deviation[:, control_index, is_seen]
        log_density = student_t.logpdf(observation[is_seen], df=4, loc=predicted, scale=deviation)
        return logsumexp(log_density.sum(axis=-1), b=self.draw_weight[:, None], axis=0)


StudentOfPage = object_by_name("sensor_model", f"{EXAMPLE}:StudentSensorModel")
"""The documented example, of many observations at once."""


@dataclass
class StudentCase:
    """Both forms of a Student-t model, and rows of readings of which some are lost."""

    by_row: StudentByRow
    vectorised: GaussianSensorModel
    readings: np.ndarray
    control: np.ndarray


@st.composite
def student_cases(draw) -> StudentCase:
    rng, values, weight, deviation, _ = random_sensors(draw(SEEDS), draw(st.sampled_from([1.0, 50.0])))
    rows = draw(st.integers(1, 6))
    readings = rng.normal(size=(rows, SENSORS)) * 3.0
    readings[rng.random((rows, SENSORS)) < draw(st.sampled_from([0.0, 0.4, 1.0]))] = np.nan
    interval = rng.normal(size=(STATES, CONTROLS, SENSORS, 1)) * draw(st.sampled_from([0.0, 1.0]))
    models = [
        model(values, deviation, draw_weight=weight, interval=interval)
        for model in (StudentByRow, StudentOfPage)
    ]
    return StudentCase(*models, readings, rng.integers(0, CONTROLS, rows))


@given(case=student_cases())
def test_a_vectorised_likelihood_is_that_of_its_rows(case):
    together = case.vectorised.log_likelihood_sequence(case.readings, case.control)

    one_by_one = case.by_row.log_likelihood_sequence(case.readings, case.control)
    np.testing.assert_allclose(together, one_by_one, rtol=1e-12, atol=1e-12)


@given(case=student_cases())
def test_a_single_observation_asks_a_vectorised_likelihood(case):
    last_row = case.vectorised.log_likelihood(case.readings[-1], int(case.control[-1]))

    expected = case.by_row.log_likelihood(case.readings[-1], int(case.control[-1]))
    np.testing.assert_allclose(last_row, expected, rtol=1e-12, atol=1e-12)


class Doubled(GaussianSensorModel):
    """Both forms of a likelihood, each made of that of the Gaussian model."""

    def log_likelihood(self, observation, control_index):
        return 2.0 * super().log_likelihood(observation, control_index)

    def log_likelihood_sequence(self, observations, control_index):
        return 2.0 * super().log_likelihood_sequence(observations, control_index)


def test_a_model_with_both_forms_of_a_likelihood_builds_on_the_gaussian_ones():
    _, values, _, deviation, observation = random_sensors(0)
    doubled = Doubled(values, deviation)

    forms = [doubled.log_likelihood(observation, 1), doubled.log_likelihood_sequence([observation], [1])[0]]

    gaussian = GaussianSensorModel(values, deviation).log_likelihood(observation, 1)
    np.testing.assert_array_equal(forms, [2.0 * gaussian] * 2)


class OfOneState(GaussianSensorModel):
    """A likelihood that forgets all states but the first."""

    def log_likelihood(self, observation, control_index):
        return super().log_likelihood(observation, control_index)[:1]


def test_a_likelihood_of_other_states_is_refused_in_many_rows():
    _, values, _, deviation, observation = random_sensors(0)

    with pytest.raises(InvalidModelError, match=rf"log-likelihood must have the shape \({STATES},\)"):
        OfOneState(values, deviation).log_likelihood_sequence([observation], [0])


@given(
    seed=SEEDS,
    spread=st.sampled_from([1.0, 50.0, 1e4]),
    relative=st.sampled_from([0.0, 0.5]),
    lost=st.lists(st.booleans(), min_size=SENSORS, max_size=SENSORS),
    control=st.integers(0, CONTROLS - 1),
)
def test_likelihood_is_the_integral_and_eq_32_its_approximation(seed, spread, relative, lost, control):
    """With a model error, which widens each density by a share of the prediction, and without."""
    rng, values, weight, deviation, observation = random_sensors(seed, spread)
    observation[lost] = np.nan
    error = relative * rng.uniform(0.0, 1.0, SENSORS)
    mean = np.einsum("e,esug->sug", weight, values)
    total = np.sqrt(deviation**2 + (error * mean) ** 2)
    seen = ~np.isnan(observation)
    density = norm.logpdf(observation, values[:, :, control], total[:, control])[..., seen]  # (E, S, G)
    expected = {
        "outside": logsumexp(density.sum(axis=2), b=weight[:, None], axis=0),
        "inside": logsumexp(density, b=weight[:, None, None], axis=0).sum(axis=1),
    }
    far = np.nanmax(np.abs((observation - values[:, :, control]) / total[:, control]), initial=1.0)
    rounding = 1e-12 + 4.0 * np.finfo(np.float64).eps * far**2  # squares of deviations are taken apart
    for average, wanted in expected.items():
        model = GaussianSensorModel(values, deviation, weight, average, model_error=error)
        np.testing.assert_allclose(model.total_standard_deviation, total, rtol=1e-13)
        wanted = wanted if seen.any() else np.zeros(STATES)
        likelihood = model.log_likelihood(observation, control)
        np.testing.assert_allclose(likelihood, wanted, rtol=1e-12, atol=rounding)
        assert np.all(np.isneginf(model.log_likelihood(np.full(SENSORS, 1e200), control)))  # no overflow
        # Nor does it depend on what the model was asked before.
        steps = [(np.nan * observation, 0), (-observation, 1), (observation, control)]
        rows = model.log_likelihood_sequence(*zip(*steps, strict=True))
        np.testing.assert_array_equal(rows, [model.log_likelihood(*step) for step in steps])
    joint = rng.dirichlet(np.ones(STATES * CONTROLS), 3).reshape(3, STATES, CONTROLS)
    noise = np.sqrt(np.einsum("bsu,sug->bg", joint, total**2))
    np.testing.assert_allclose(model.noise(joint), noise, rtol=1e-13)


@dataclass(frozen=True)
class IntervalCase:
    """Sensors that an interval of values moves together, one observation, and their densities in closed form.

    Arrays are by draw (E), state (S), control (U) and sensor (G); the control of the observation is 1.
    """

    values: np.ndarray
    weight: np.ndarray
    deviation: np.ndarray
    observation: np.ndarray
    interval: np.ndarray
    covariance: np.ndarray

    @property
    def is_seen(self):
        """Return which sensors are not lost."""
        return ~np.isnan(self.observation)

    @property
    def log_densities(self):
        """Return the logarithm of the density (S, E) of what is seen, with the whole covariance."""
        seen = self.is_seen
        residual = (self.observation - self.values[:, :, 1])[..., seen]
        covariances = self.covariance[:, 1][:, seen][:, :, seen]
        by_state = [
            multivariate_normal.logpdf(residual[:, state], cov=covariances[state]) for state in range(STATES)
        ]
        return np.array(by_state)

    @property
    def total_deviation(self):
        """Return the standard deviation (S, U, G) of each sensor alone."""
        return np.sqrt(np.einsum("sugg->sug", self.covariance))

    def model(self, kind=GaussianSensorModel, *options):
        return kind(self.values, self.deviation, self.weight, *options, interval=self.interval)


@st.composite
def interval_cases(draw):
    """Draw sensors, some of them lost, and the size of their interval over their noise."""
    rng, values, weight, deviation, observation = random_sensors(draw(SEEDS))
    some_lost = st.lists(st.booleans(), min_size=SENSORS, max_size=SENSORS).filter(lambda lost: not all(lost))
    observation[draw(some_lost)] = np.nan
    size = draw(st.sampled_from([0.0, 0.3, 3.0, 1e3]))
    factor_count = draw(st.integers(0, 3))
    interval = size * rng.normal(size=(STATES, CONTROLS, SENSORS, factor_count))
    covariance = interval @ interval.swapaxes(-1, -2) + np.diag(deviation**2)
    return IntervalCase(values, weight, deviation, observation, interval, covariance)


CLOSE = {"rtol": 1e-7, "atol": 1e-7}
"""The covariance has a condition of up to 1e7."""


@given(case=interval_cases())
@pytest.mark.parametrize("kind", [GaussianSensorModel, IdentifiedSensorModel])
def test_an_interval_moves_all_sensors_together(kind, case):
    """Against densities with the whole covariance."""
    model = case.model(kind)
    log_likelihood = logsumexp(case.log_densities, b=case.weight, axis=1)
    log_density_of_draws = model.log_density_of_draws(case.observation[None], [1])[0]
    np.testing.assert_allclose(model.log_likelihood(case.observation, 1), log_likelihood, **CLOSE)
    np.testing.assert_allclose(log_density_of_draws, case.log_densities, **CLOSE)


@given(case=interval_cases())
def test_an_observation_far_outside_an_interval_has_no_likelihood(case):
    assert np.all(np.isneginf(case.model().log_likelihood(np.full(SENSORS, 1e200), 1)))


@given(case=interval_cases())
def test_the_total_deviation_of_a_sensor_is_that_of_noise_and_interval(case):
    np.testing.assert_allclose(case.model().total_standard_deviation, case.total_deviation)


@given(case=interval_cases())
def test_inside_the_product_over_sensors_an_interval_moves_each_sensor_apart(case):
    """Where the average over draws is that of each sensor."""
    model = case.model(GaussianSensorModel, "inside")
    log_density = norm.logpdf(case.observation, case.values[:, :, 1], case.total_deviation[:, 1])
    by_sensor = logsumexp(log_density[..., case.is_seen], b=case.weight[:, None, None], axis=0)
    np.testing.assert_allclose(model.log_likelihood(case.observation, 1), by_sensor.sum(axis=1), **CLOSE)


@given(case=interval_cases())
def test_the_place_within_an_interval_and_the_noise_beside_it_make_the_whole_density(case):
    fitted = case.model().fit_within_interval(case.observation, 1, case.values[:, :, 1])
    log_density_of_noise = norm.logpdf(case.observation, fitted.value, case.deviation)
    of_all_sensors = log_density_of_noise[..., case.is_seen].sum(axis=-1)
    np.testing.assert_allclose((of_all_sensors + fitted.log_density).T, case.log_densities, **CLOSE)


@given(case=interval_cases().filter(lambda case: np.abs(case.interval).max(initial=0.0) < 100.0))
def test_a_sensor_within_an_interval_is_predicted_from_the_others(case):
    """By conditioning of Gaussians; needs the condition of the covariance, so the interval is not large."""
    fitted = case.model().fit_within_interval(case.observation, 1, case.values[:, :, 1])
    seen = np.flatnonzero(case.is_seen)
    sensor = seen[0]
    others = seen[1:]
    for state in range(STATES):
        covariance = case.covariance[state, 1]
        gain = np.linalg.solve(covariance[np.ix_(others, others)], covariance[others, sensor])
        residual = case.observation[others] - case.values[:, state, 1, others]  # by draw and sensor
        mean = case.values[:, state, 1, sensor] + residual @ gain
        variance = covariance[sensor, sensor] - gain @ covariance[others, sensor]
        variance_by_leverage = case.deviation[sensor] ** 2 / fitted.one_minus_leverage[state, sensor]
        predicted = fitted.value_by_others[:, state, sensor]
        np.testing.assert_allclose(predicted, mean, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(variance_by_leverage, variance, rtol=1e-5)


def random_values(seed, ties=False):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(4, 3, 2, 5))
    if ties:
        values = np.round(values)
    weight = rng.dirichlet(np.ones(4))
    joint = rng.dirichlet(np.ones(6), size=7).reshape(7, 3, 2)
    joint[0] = 0.0
    joint[0, 1, 1] = 1.0
    return values, weight, joint


def points(values, weight, joint, sensor):
    """Every value of one sensor with its probability, under one joint belief."""
    probability = weight[:, None, None] * joint
    return values[..., sensor].ravel(), probability.ravel()


LEVELS = [0.025, 0.3, 0.5, 0.975, 1.0]


@given(SEEDS, st.booleans())
def test_moments_are_those_of_the_mixture(seed, ties):
    values, weight, joint = random_values(seed, ties)
    mean, deviation = QuantityModel(values, weight).moments(joint)
    for belief, sensor in np.ndindex(7, 5):
        x, p = points(values, weight, joint[belief], sensor)
        expected = np.sqrt(p @ (x - p @ x) ** 2)
        assert mean[belief, sensor] == pytest.approx(p @ x, abs=1e-13)
        assert deviation[belief, sensor] == pytest.approx(expected, abs=1e-13)


@given(SEEDS, st.booleans())
def test_quantiles_are_those_of_the_mixture(seed, ties):
    """The smallest value whose cumulative probability reaches the level; ties and zero weights included."""
    values, weight, joint = random_values(seed, ties)
    quantiles = QuantityModel(values, weight).quantiles(joint, LEVELS)
    assert quantiles.shape == (7, 5, 5)
    for belief, sensor in np.ndindex(7, 5):
        x, p = points(values, weight, joint[belief], sensor)
        smallest = np.quantile(x[p > 0], LEVELS, weights=p[p > 0], method="inverted_cdf")
        np.testing.assert_array_equal(quantiles[belief, :, sensor], smallest)


def test_beliefs_may_have_several_axes():
    values, weight, joint = random_values(1, ties=False)
    model = QuantityModel(values, weight)
    nested = joint[:6].reshape(2, 3, 3, 2)
    deviation = model.moments(nested)[1]
    np.testing.assert_array_equal(deviation.reshape(6, 5), model.moments(joint)[1][:6])
    assert model.quantiles(nested, LEVELS).shape == (2, 3, 5, 5)


LIMIT, LOAD = 2500e-6, (2.0, 3.0)
SETTINGS = LIMIT, (-0.1, 0.1), 125e-6, LOAD


@pytest.fixture
def quantity():
    """Strains of five gauges in three states under two controls, in four draws."""
    rng = np.random.default_rng(11)
    return QuantityModel(rng.uniform(500e-6, 4000e-6, size=(4, 3, 2, 5)), rng.dirichlet(np.ones(4)))


@given(SEEDS)
def test_rewards_are_sums_over_states_controls_and_draws(seed):
    rng = np.random.default_rng(seed)
    quantity = QuantityModel(rng.uniform(500e-6, 4000e-6, size=(4, 3, 2, 5)), rng.dirichlet(np.ones(4)))
    joint = rng.dirichlet(np.ones(6)).reshape(3, 2)
    observation = rng.uniform(500e-6, 4000e-6, 5)
    observation[rng.integers(5)] = np.nan
    value = quantity.value_per_draw
    probability = quantity.draw_weight[:, None, None] * joint
    rewards = [
        1.0 - value.max(axis=3) / LIMIT,
        np.broadcast_to([-0.1, 0.1], probability.shape),
        -np.nanmean(np.abs(observation - value), axis=3) / 125e-6 / LOAD,
    ]
    means, deviations = RewardModel(quantity, *SETTINGS).expectation(joint, observation)
    for reward, mean, deviation in zip(rewards, means, deviations, strict=True):
        expected_mean = (probability * reward).sum()
        expected_deviation = np.sqrt((probability * (reward - expected_mean) ** 2).sum())
        assert mean == pytest.approx(expected_mean, abs=1e-12)
        assert deviation == pytest.approx(expected_deviation, abs=1e-7)


def test_a_known_control_has_a_reward_without_a_deviation(quantity):
    known = known_control(np.full((2, 3), 1 / 3), np.array([0, 1]), 2)
    mean, deviation = RewardModel(quantity, *SETTINGS).expectation(known)
    np.testing.assert_allclose(mean[:, 1], [-0.1, 0.1], rtol=1e-14)
    np.testing.assert_allclose(deviation[:, 1], 0.0, atol=1e-15)


def test_without_an_observation_there_is_no_error(quantity):
    model = RewardModel(quantity, *SETTINGS)
    mean, deviation = model.expectation(known_control(np.full((2, 3), 1 / 3), np.array([0, 1]), 2))
    mean_of_lost, _ = model.expectation(np.full((3, 2), 1 / 6), np.full(5, np.nan))
    assert np.isnan([*mean[:, 2], *deviation[:, 2], mean_of_lost[2]]).all()


def test_the_reward_of_planning_is_that_of_health_and_of_the_weighted_control(quantity):
    health_per_draw = 1.0 - quantity.value_per_draw.max(axis=3) / LIMIT
    health = np.tensordot(quantity.draw_weight, health_per_draw, axes=1)
    planning_reward = RewardModel(quantity, *SETTINGS).planning_reward(1.0, 2.5)
    np.testing.assert_allclose(planning_reward, health + np.array([-0.25, 0.25]), rtol=1e-13)


def random_problem(seed, states=7, controls=3):
    rng = np.random.default_rng(seed)
    transition = rng.dirichlet(np.full(states, 0.3), (controls, states))
    transition /= transition.sum(axis=2, keepdims=True)
    return transition, rng.normal(size=(states, controls))


@settings(max_examples=50, deadline=None)
@given(seed=SEEDS, discount=st.sampled_from([0.0, 0.6, 0.9, 0.99]), of_blocks=st.booleans())
def test_the_value_is_optimal_and_that_of_its_policy(seed, discount, of_blocks):
    transition, reward = random_problem(seed, 6)
    model = TransitionModel((transition,))
    if of_blocks:
        model = TransitionModel(tuple(random_problem(seed, states)[0] for states in (2, 3)))
        transition = model.matrix
    plan = value_iteration(model, reward, discount)
    scale = np.abs(reward).max() / (1.0 - discount)
    for policy in (np.random.default_rng(seed).dirichlet(np.ones(3), 6), plan.policy):
        closed_loop = discount * np.einsum("su,ust->st", policy, transition)
        exact = np.linalg.solve(np.eye(6) - closed_loop, (policy * reward).sum(axis=1))
        found = evaluate_policy(model, reward, discount, policy)
        np.testing.assert_allclose(found.value, exact, rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(plan.value, exact, rtol=0, atol=1e-11 * scale)
    action_value = reward + discount * np.einsum("ust,t->su", transition, plan.value)
    np.testing.assert_allclose(plan.action_value, action_value, rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(plan.value, action_value.max(axis=1), rtol=0, atol=1e-11 * scale)
    np.testing.assert_array_equal(plan.policy.argmax(axis=1), plan.control_index)


def value_by_enumeration(transition, reward, discount):
    """The value (S,) of the best of all policies, each by a linear solve."""
    states, controls = reward.shape
    values = []
    for policy in product(range(controls), repeat=states):
        chosen = np.arange(states), np.array(policy)
        closed_loop = discount * transition[chosen[1], chosen[0]]
        values.append(np.linalg.solve(np.eye(states) - closed_loop, reward[chosen]))
    return np.max(values, axis=0)


NEAR_ONE = st.sampled_from([0.6, 0.99, 1.0 - 1e-5, 1.0 - 1e-7, 1.0 - 1e-9])


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, discount=NEAR_ONE, absorbing=st.booleans())
def test_the_plan_is_as_good_as_the_best_of_all_policies(seed, discount, absorbing):
    """Also where the discount is nearly one, and where the first state cannot be left."""
    transition, reward = random_problem(seed, 4)
    if absorbing:
        transition[:, 0] = [1.0, 0.0, 0.0, 0.0]
    plan = value_iteration(transition, reward, discount)
    best = value_by_enumeration(transition, reward, discount)
    rounding = 1e-14 / (1.0 - discount) * np.abs(best).max()
    np.testing.assert_allclose(plan.value, best, rtol=0, atol=rounding)


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, discount=NEAR_ONE, tie=st.sampled_from([0.0, 1e-15, 1e-9, 1e-6]))
def test_the_told_value_is_that_of_the_returned_policy(seed, discount, tie):
    """Also where controls that are nearly equal stand in the place of one another."""
    transition, reward = random_problem(seed, 4)
    transition = np.concatenate([transition, transition])
    reward = np.concatenate([reward, reward + tie], axis=1)
    plan = value_iteration(transition, reward, discount)
    chosen = np.arange(4), plan.control_index
    closed_loop = discount * transition[chosen[1], chosen[0]]
    exact = np.linalg.solve(np.eye(4) - closed_loop, reward[chosen])
    rounding = 1e-14 / (1.0 - discount) * np.abs(exact).max()
    np.testing.assert_allclose(plan.value, exact, rtol=0, atol=rounding)


def test_work_is_planned_where_rest_is_worth_nothing_and_the_discount_is_nearly_one():
    """Work brings 1 and 0.5 until the part is lost, each state lasting 20 steps: 30 and 10 in all."""
    rest, work = np.eye(3), np.array([[0.95, 0.05, 0.0], [0.0, 0.95, 0.05], [0.0, 0.0, 1.0]])
    reward = np.array([[0.0, 1.0], [0.0, 0.5], [0.0, -2.0]])
    plan = value_iteration(np.stack([rest, work]), reward, 0.999999)
    np.testing.assert_array_equal(plan.control_index, [1, 1, 0])
    np.testing.assert_allclose(plan.value, [30.0, 10.0, 0.0], atol=1e-3)


def test_a_small_gain_counts_beside_the_large_value_of_a_state_that_is_not_reached():
    transition = np.stack([np.eye(2), np.eye(2)])
    reward = np.array([[0.0, 1e-6], [1.0, 1.0]])
    plan = value_iteration(transition, reward, 1.0 - 1e-9)
    np.testing.assert_allclose(plan.value, [1e3, 1e9], rtol=1e-6)


def test_the_value_of_many_states_is_iterated_and_that_of_the_returned_policy():
    """A product of two parts of 40 levels: too many states for a dense system."""
    rest = np.eye(40)
    work = 0.9 * np.eye(40) + 0.1 * np.eye(40)[np.minimum(np.arange(40) + 1, 39)]
    model = TransitionModel.from_factors([(rest, rest), (work, work)])
    level = np.add.outer(np.arange(40.0), np.arange(40.0)).ravel()
    reward = np.column_stack([np.zeros(1600), 1.0 - level / 30.0])
    plan = value_iteration(model, reward, 0.99)
    closed_loop = np.array([model.row(control, state) for state, control in enumerate(plan.control_index)])
    exact = np.linalg.solve(np.eye(1600) - 0.99 * closed_loop, reward[np.arange(1600), plan.control_index])
    np.testing.assert_allclose(plan.value, exact, rtol=0, atol=1e-11)


def test_ties_go_to_the_first_control():
    transition, reward = random_problem(0)
    doubled = TransitionModel((np.concatenate([transition, transition]),))
    plan = value_iteration(doubled, np.concatenate([reward, reward + 1e-15], axis=1), 0.9)
    assert np.all(plan.control_index < 3)
    assert np.all(value_iteration(TransitionModel((transition,)), np.zeros((7, 3)), 0.9).control_index == 0)


TABLE, REWARD = random_problem(0)
MOVES = TransitionModel((TABLE,))
MANY = TransitionModel((random_problem(1, 50)[0], random_problem(2, 40)[0]))
VALUES, WEIGHT, JOINT = random_values(0)
HOLED = np.where(np.arange(VALUES.size).reshape(VALUES.shape) == 12, np.nan, VALUES)  # at (0, 1, 0, 2)
QUANTITY = QuantityModel(VALUES, WEIGHT)
REWARDS = RewardModel(QUANTITY, 1.0, (0.0, 1.0), 1.0)
_, SHOWN, SHARE, DEVIATION, OBSERVATION = random_sensors(7)
HOLDING = GaussianSensorModel(SHOWN, DEVIATION, SHARE)
PLANS = BeliefPolicy(np.eye(3), np.array([0, 1, 1]))
REFUSED = [
    *((lambda bad=bad: GaussianSensorModel(SHOWN, bad, SHARE), "positive noise standard deviation")
      for bad in (0.0, -1.0, np.nan, np.ones(SENSORS + 1), np.r_[DEVIATION[:-1], np.inf])),
    *((lambda bad=bad: GaussianSensorModel(SHOWN, 1.0, SHARE, model_error=bad), "relative model error")
      for bad in (-0.1, np.nan, np.inf, np.ones(SENSORS + 1))),
    (lambda: GaussianSensorModel(np.zeros((1, 2, 1, 1)), 1.0, interval=np.ones((2, 1, 1))),
     r"intervals must have the shape \(2, 1, 1, factors\), but the shape is \(2, 1, 1\)"),
    (lambda: HOLDING.log_likelihood(OBSERVATION[:-1], 0), rf"values must have the shape \({SENSORS},\)"),
    (lambda: HOLDING.log_likelihood(np.r_[OBSERVATION[:3], -np.inf, 0.0, 0.0], 0), r"\(3,\) is infinite"),
    (lambda: HOLDING.log_likelihood(OBSERVATION, 2), "indices of controls must be from 0 to 1"),
    (lambda: HOLDING.log_likelihood_sequence(OBSERVATION[None], [0, 1]), r"must have the shape \(2, 6\)"),
    (lambda: QuantityModel(VALUES[0]), r"\(draws, states, controls, sensors\)"),
    (lambda: QuantityModel(HOLED), r"\(0, 1, 0, 2\) is nan"),
    (lambda: QuantityModel(VALUES, WEIGHT * 2), "draw weights"),
    (lambda: QUANTITY.moments(JOINT[:, :, 0]), "known_control"),
    *((lambda bad=bad: QUANTITY.quantiles(JOINT, bad), "levels of quantiles must increase")
      for bad in ([0.9, 0.1], [0.0], [1.1], 0.5, [np.nan])),
    (lambda: REWARDS.expectation(JOINT[1, 0]), "joint belief"),
    (lambda: value_iteration(MOVES, REWARD.T, 0.6), "rewards must have the shape"),
    *((lambda bad=bad: value_iteration(MOVES, REWARD, bad), r"discount factor in \[0, 1\)")
      for bad in (1.0, -0.1, np.nan)),
    (lambda: value_iteration(MOVES, REWARD, 1.0 - 1e-15), "so close to 1 that rounding decides"),
    (lambda: value_iteration(MANY, np.ones((2000, 3)), 0.9, max_iterations=3), "after 3 sweeps"),
    (lambda: value_iteration(TABLE * 0.95, REWARD, 0.6), "does not sum to one"),
    (lambda: value_iteration(MOVES, np.full((7, 3), np.nan), 0.6), r"\(0, 0\) is nan"),
    (lambda: value_iteration(MOVES, np.ma.masked_equal(REWARD, REWARD[2, 1]), 0.6), r"\(2, 1\) is nan"),
    (lambda: value_iteration(np.ma.masked_equal(TABLE, TABLE[0, 0, 0]), REWARD, 0.6), "a value that is not"),
    (lambda: value_iteration(MOVES, REWARD, np.ma.masked_equal([0.6, 0.7, 0.6], 0.7)), "discount factor"),
    (lambda: BeliefPolicy(np.ma.masked_equal(np.eye(2), 1.0), [0, 1]), "returns of plans must be finite"),
    (lambda: BeliefPolicy(np.eye(2), [0.0, 1.5]), r"must be whole numbers, but one is 1\.5"),
    *((lambda ask=ask: ask(np.ma.masked_equal([0.2, 0.3, 0.5], 0.3)), "NaN stands for a masked one")
      for ask in (PLANS.decide, PLANS.value, lambda belief: PLANS.action_value(belief, 2))),
    (lambda: known_control(np.ones(3) / 3, 1.5, 2), r"must be whole numbers, but one is 1\.5"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "sentence"), REFUSED)
def test_what_does_not_fit_is_refused(make, sentence):
    with pytest.raises((InvalidModelError, InvalidObservationError, PlanningError), match=sentence):
        make()


def drawn(seed: int, states: int, moves_first: bool, discount: float = 0.8) -> DecisionProblem:
    rng = np.random.default_rng(seed)
    moves = rng.dirichlet(np.ones(states), (3, states))
    seen = tuple(rng.dirichlet(np.full(3, 0.4), states).T for _ in range(3))
    factors = np.array([discount, discount, 0.0 if seed % 2 else discount])
    return DecisionProblem(
        TransitionModel((moves,)), rng.normal(size=(states, 3)), factors, seen,
        rng.dirichlet(np.ones(states)), moves_first,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("problem", "below", "above", "gap"),
    # as published, and by Storm 2.0, see `benchmarks.studies.planning`: 200,000 beliefs, grids of 400 and 24
    [
        (tiger(0.75), 1.933 - 5e-4, 1.933 + 5e-4, 1e-4),
        (tiger(0.95), 19.3711, 19.3716, 1e-4),
        (PROBLEMS["maze of 4 x 3"](), 1.8490, 1.9066, 1e-2),
    ],
)
def test_the_value_is_what_was_published_and_what_an_independent_solver_finds(problem, below, above, gap):
    plan = plan_on_belief(problem, gap=gap, most_beliefs=5000)
    assert plan.lower <= above
    assert plan.upper >= below
    assert plan.upper - plan.lower <= gap * plan.upper


@pytest.mark.parametrize("moves_first", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_the_value_is_that_on_a_fine_grid_of_beliefs(seed, moves_first):
    """Also under a control that is given for the first step."""
    problem = drawn(seed, 2, moves_first)
    grid = np.linspace(0.0, 1.0, 2001)
    beliefs = np.column_stack((1.0 - grid, grid))
    value, first = np.zeros_like(grid), np.empty((3, len(grid)))
    for _ in range(120):  # straight lines between the points of a convex function lie above it
        for control, seen in enumerate(problem.likelihood):
            first[control], moves = beliefs @ problem.reward[:, control], problem.transition.matrix[control]
            for shown in seen:
                after = (beliefs @ moves) * shown if moves_first else (beliefs * shown) @ moves
                weight = after.sum(axis=1)
                later = weight * np.interp(after[:, 1] / weight, grid, value)
                first[control] += problem.discount[control] * later
        value = first.max(axis=0)
    for control, values in ((None, value), (1, first[1])):
        exact = np.interp(problem.prior[1], grid, values)
        plan = plan_on_belief(problem, first=control, gap=1e-4)
        assert plan.lower <= exact + 1e-6
        assert plan.upper >= exact - 1e-4
        assert plan.upper - plan.lower <= 1e-3


@pytest.mark.parametrize("moves_first", [False, True])
def test_simulated_missions_bring_what_the_plan_promises(moves_first):
    problem = drawn(6, 4, moves_first)
    plan = plan_on_belief(problem, gap=1e-3)
    rng = np.random.default_rng(0)
    total = simulated_returns(problem, lambda belief, *_: plan.policy.decide(belief), 4000, 40, rng)
    error = 4.0 * total.std() / np.sqrt(len(total))
    known = value_iteration(problem.transition, problem.reward, problem.discount)
    assert plan.lower - error <= total.mean() <= plan.upper + error
    assert plan.upper <= problem.prior @ known.value + 1e-9


@pytest.mark.parametrize(("moves_first", "worth"), [(False, 0.92), (True, 0.37)])
def test_the_difference_of_two_rules_varies_little_from_mission_to_mission(moves_first, worth):
    """Rewards that are drawn with the states differ by 1.4."""
    problem = drawn(6, 4, moves_first)
    known = value_iteration(problem.transition, problem.reward, problem.discount)

    def returns(values: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(0)
        return simulated_returns(
            problem, lambda belief, *_: np.argmax(belief @ values, axis=1), 1000, 20, rng
        )

    first = returns(known.action_value)
    second = returns(known.action_value + np.array([0.3, 0.0, 0.0]))
    assert first.mean() - second.mean() == pytest.approx(worth, abs=0.05)
    assert (first - second).std() < 0.4


def test_a_control_is_left_as_often_as_all_courses_of_observations_say(monkeypatch):
    monkeypatch.setattr(simulated_missions, "FUTURES", 4000)
    problem, rng = drawn(8, 4, moves_first=False), np.random.default_rng(1)
    vectors = 0.3 * rng.normal(size=(3, 4)) + np.array([[0.15], [0.0], [0.0]])
    policy = BeliefPolicy(vectors, np.array([1, 0, 2]))

    def leaves(belief: np.ndarray, steps: int) -> float:
        if policy.decide(belief) != 1:
            return 1.0
        after = problem.next_beliefs(belief, 1) if steps > 1 else np.zeros((0, 4))
        return float(sum(row.sum() * leaves(row / row.sum(), steps - 1) for row in after))

    beliefs = rng.dirichlet(np.ones(4), 5)
    exact = [leaves(belief, 4) for belief in beliefs]
    found = leaving_probability(problem, policy, beliefs, 1, 4, rng)
    np.testing.assert_allclose(found, exact, atol=0.03)
    assert sum(0.05 < value < 0.95 for value in exact) > 1


def test_a_masked_belief_has_no_moments():
    is_masked = np.zeros(JOINT.shape, dtype=bool)
    is_masked[0, 0] = True

    mean, deviation = QUANTITY.moments(np.ma.masked_array(JOINT, is_masked))

    assert np.isnan(mean[0, 0]).all()
    assert np.isnan(deviation[0, 0]).all()
    assert np.isfinite(mean[1:]).all()
