import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

from twin_master.errors import InvalidModelError, InvalidObservationError
from twin_master.network.identified import IdentifiedSensorModel
from twin_master.network.sensor_model import GaussianSensorModel

DRAWS, STATES, CONTROLS, SENSORS = 5, 4, 2, 6


def random_case(seed, spread=1.0):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(DRAWS, STATES, CONTROLS, SENSORS)) * spread
    weight = rng.dirichlet(np.ones(DRAWS))
    deviation = rng.uniform(0.5, 2.0, SENSORS)
    observation = rng.normal(size=SENSORS) * spread
    return rng, values, weight, deviation, observation


@settings(deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    spread=st.sampled_from([1.0, 50.0, 1e4]),
    relative=st.sampled_from([0.0, 0.5]),
    lost=st.lists(st.booleans(), min_size=SENSORS, max_size=SENSORS),
    control=st.integers(0, CONTROLS - 1),
)
def test_likelihood_is_the_integral_and_eq_32_its_approximation(seed, spread, relative, lost, control):
    """With a model error, which widens each density by a share of the prediction, and without."""
    rng, values, weight, deviation, observation = random_case(seed, spread)
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
        turns = [(np.nan * observation, 0), (-observation, 1), (observation, control)]
        rows = model.log_likelihood_sequence(*zip(*turns, strict=True))
        np.testing.assert_array_equal(rows, [model.log_likelihood(*turn) for turn in turns])
    joint = rng.dirichlet(np.ones(STATES * CONTROLS), 3).reshape(3, STATES, CONTROLS)
    noise = np.sqrt(np.einsum("bsu,sug->bg", joint, total**2))
    np.testing.assert_allclose(model.noise(joint), noise, rtol=1e-13)


@settings(deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    factors=st.integers(0, 3),
    size=st.sampled_from([0.0, 0.3, 3.0, 1e3]),
    lost=st.lists(st.booleans(), min_size=SENSORS, max_size=SENSORS).filter(lambda lost: not all(lost)),
)
def test_an_interval_moves_all_sensors_together(seed, factors, size, lost):
    """Against densities with the whole covariance; a place in the interval and the rest make the same."""
    rng, values, weight, deviation, observation = random_case(seed)
    observation[lost] = np.nan
    seen = ~np.isnan(observation)
    interval = size * rng.normal(size=(STATES, CONTROLS, SENSORS, factors))
    covariance = interval @ interval.swapaxes(-1, -2) + np.diag(deviation**2)
    part = covariance[:, 1][:, seen][:, :, seen]
    each = np.array(
        [
            [
                multivariate_normal.logpdf(observation[seen], values[e, s, 1, seen], part[s])
                for e in range(DRAWS)
            ]
            for s in range(STATES)
        ]
    )
    expected = logsumexp(each, b=weight, axis=1)
    close = {"rtol": 1e-7, "atol": 1e-7}  # the covariance has a condition of up to 1e7
    model = GaussianSensorModel(values, deviation, weight, interval=interval)
    np.testing.assert_allclose(model.log_likelihood(observation, 1), expected, **close)
    np.testing.assert_allclose(model.log_density_of_draws(observation[None], [1])[0], each, **close)
    assert np.all(np.isneginf(model.log_likelihood(np.full(SENSORS, 1e200), 1)))
    identified = IdentifiedSensorModel(values, deviation, weight, interval=interval)
    np.testing.assert_allclose(identified.log_likelihood(observation, 1), expected, **close)
    np.testing.assert_allclose(identified.log_density_of_draws(observation[None], [1])[0], each, **close)
    total = np.sqrt(np.einsum("sugg->sug", covariance))
    np.testing.assert_allclose(model.total_standard_deviation, total)
    printed = GaussianSensorModel(values, deviation, weight, "inside", interval=interval)
    density = norm.logpdf(observation, values[:, :, 1], total[:, 1])[..., seen]
    apart = logsumexp(density, b=weight[:, None, None], axis=0).sum(axis=1)
    np.testing.assert_allclose(printed.log_likelihood(observation, 1), apart, **close)

    near = model.nearest(observation, 1, values[:, :, 1])
    rest = norm.logpdf(observation, near.value, deviation)[..., seen].sum(axis=-1)
    np.testing.assert_allclose((rest + near.log_density).T, each, **close)
    sensor = int(np.flatnonzero(seen)[0])
    others = np.flatnonzero(seen)[1:]
    for s in range(STATES if size < 100.0 else 0):  # of one sensor given the others; needs the condition
        gain = np.linalg.solve(covariance[s, 1][np.ix_(others, others)], covariance[s, 1][others, sensor])
        mean = values[:, s, 1, sensor] + (observation[others] - values[:, s, 1, others]) @ gain
        variance = covariance[s, 1, sensor, sensor] - gain @ covariance[s, 1][others, sensor]
        np.testing.assert_allclose(near.alone[:, s, sensor], mean, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(deviation[sensor] ** 2 / near.left[s, sensor], variance, rtol=1e-5)


_, VALUES, WEIGHT, DEVIATION, OBSERVATION = random_case(7)
HOLDING = GaussianSensorModel(VALUES, DEVIATION, WEIGHT)
REFUSED = [
    *((lambda bad=bad: GaussianSensorModel(VALUES, bad, WEIGHT), "positive noise standard deviation")
      for bad in (0.0, -1.0, np.nan, np.ones(SENSORS + 1), np.r_[DEVIATION[:-1], np.inf])),
    *((lambda bad=bad: GaussianSensorModel(VALUES, 1.0, WEIGHT, model_error=bad), "relative model error")
      for bad in (-0.1, np.nan, np.inf, np.ones(SENSORS + 1))),
    (lambda: GaussianSensorModel(VALUES, DEVIATION, WEIGHT, average="both"), "'outside' or 'inside'"),
    (lambda: GaussianSensorModel(np.zeros((1, 2, 1, 1)), 1.0, interval=np.ones((2, 1, 1))),
     r"intervals of shape \(2, 1, 1, factors\), got \(2, 1, 1\)"),
    (lambda: HOLDING.log_likelihood(OBSERVATION[:-1], 0), rf"sensor values of shape \({SENSORS},\)"),
    (lambda: HOLDING.log_likelihood(np.r_[OBSERVATION[:3], -np.inf, 0.0, 0.0], 0), r"\(3,\) is infinite"),
    (lambda: HOLDING.log_likelihood(OBSERVATION, 2), "control indices between 0 and 1"),
    (lambda: HOLDING.log_likelihood_sequence(OBSERVATION[None], [0, 1]), r"observations of shape \(2, 6\)"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "sentence"), REFUSED)
def test_bad_input_is_refused(make, sentence):
    with pytest.raises((InvalidModelError, InvalidObservationError), match=sentence):
        make()
