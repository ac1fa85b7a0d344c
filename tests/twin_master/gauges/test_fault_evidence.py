"""The densities of faults by products, against the same by logarithms."""

import numpy as np
import pytest

from twin_master.gauges.exchanged_densities import GaugeDensities
from twin_master.gauges.fault_kernels import (
    StandardizedObservation,
    log_density_of_sound_gauges,
    multiply_by_power,
    number_products,
    update_sound_gauges,
)
from twin_master.gauges.free_gains import weigh_free_gains, weigh_free_gains_in_logs
from twin_master.gauges.gauge_faults import SumsOfFaults, weigh_gauge_fault_in_logs, weigh_gauge_faults
from twin_master.gauges.model_likelihood import ModelLikelihood, model_likelihood

PAIRS, GAUGES, GAINS = 40, 3, 4
FAULTS = GAUGES * GAINS
SCALE_SQUARES = np.array([12.0, 9.0, 10.0])
SINGLE = 1e-5
"""Difference that single precision makes."""


def drawn_observation(degrees: list[float], deviation: float = 3.0) -> StandardizedObservation:
    """Return an observation of three gauges, of which the last is lost."""
    random = np.random.default_rng(5)
    present = np.array([True, True, False])
    product = np.empty(GAUGES, np.int64)
    number_products(np.array(degrees), product)
    return StandardizedObservation(
        present=present,
        residual=np.where(present, random.normal(0.0, deviation, (PAIRS, GAUGES)), 0.0),
        prediction=np.where(present, random.normal(10.0, 5.0, (PAIRS, GAUGES)), 0.0),
        log_density=random.normal(0.0, 5.0, PAIRS),
        degrees_after=np.array(degrees),
        product=product,
    )


def likelihood(observation: StandardizedObservation, scale_squares: np.ndarray) -> ModelLikelihood:
    """Return how the model explains an observation at all pairs."""
    log_density = np.empty(PAIRS)
    log_density_of_sound_gauges(observation, np.arange(PAIRS), scale_squares, log_density)
    largest = log_density.max()
    density = np.exp(log_density - largest)
    return model_likelihood(observation, np.arange(PAIRS), scale_squares, density, largest)


def drawn_faults(scale: float = 1.0) -> tuple[GaugeDensities, np.ndarray]:
    """Return faults with learnt gains, and beliefs of which a third is zero."""
    random = np.random.default_rng(6)
    faults = GaugeDensities(
        gauge=np.arange(FAULTS) // GAINS,
        gain=random.normal(0.0, 0.1, FAULTS),
        gain_variance=random.uniform(0.001, 0.01, FAULTS),
        scale_squares=scale * random.uniform(8.0, 20.0, FAULTS),
    )
    belief = random.random((PAIRS, FAULTS)).astype(np.float32)
    belief[::3] = 0.0
    return faults, belief


@pytest.mark.parametrize(
    ("degrees", "scale"),
    [
        ([11.0, 11.0, 11.0], 1.0),
        ([11.0, 31.0, 12.0], 1.0),
        ([10.5, 10.5, 10.25], 1.0),
        ([5000.0, 5000.5, 4999.0], 500.0),
    ],
)
def test_gauge_faults_by_products_weigh_as_by_logarithms(degrees, scale):
    observation = drawn_observation(degrees)
    model = likelihood(observation, scale * SCALE_SQUARES)
    faults, belief = drawn_faults(scale)
    weight, sums = weigh_gauge_faults(observation, model, faults, belief)
    weight_in_logs = np.empty_like(weight)
    sums_in_logs = SumsOfFaults(*(np.empty(FAULTS, np.float32) for _ in range(4)))
    for fault in range(FAULTS):
        weigh_gauge_fault_in_logs(observation, model, faults, belief, fault, weight_in_logs, sums_in_logs)
    np.testing.assert_allclose(
        weight / sums.weight, weight_in_logs / sums_in_logs.weight, rtol=SINGLE, atol=1e-12
    )
    for name in ("squares", "predictions", "products"):
        by_products = getattr(sums, name) / sums.weight
        by_logarithms = getattr(sums_in_logs, name) / sums_in_logs.weight
        np.testing.assert_allclose(by_products, by_logarithms, rtol=SINGLE, atol=SINGLE)


def test_a_fault_that_explains_far_more_than_the_model_is_told_to_take_logarithms():
    """A residual of hundreds of deviations that a gain explains, at a pair where the model is bad."""
    observation = drawn_observation([5000.0] * 3)
    observation.residual[1] = [300.0, 0.0, 0.0]
    observation.prediction[1] = [1000.0, 10.0, 0.0]
    model = likelihood(observation, 500.0 * SCALE_SQUARES)
    faults, belief = drawn_faults(500.0)
    faults.gain[0] = 0.3
    belief[1] = 0.5
    _, sums = weigh_gauge_faults(observation, model, faults, belief)
    assert not np.isfinite(sums.weight[0])


@pytest.mark.parametrize("free_probability", [0.0, 0.3, 1.0])
def test_free_gains_by_products_weigh_as_by_logarithms(free_probability):
    observation = drawn_observation([25.0, 25.0, 25.0])
    model = likelihood(observation, SCALE_SQUARES)
    densities = GaugeDensities(
        gauge=np.array([0, 1, 2, 0, 1, 2]),
        gain=np.array([0.04, -0.1, 0.02, 0.0, 0.0, 0.0]),
        gain_variance=np.array([0.01, 0.02, 0.01, 0.0, 0.0, 0.0]),
        scale_squares=np.array([14.0, 11.0, 12.0, 11.0, 10.0, 12.0]),
    )
    believed = np.arange(0, PAIRS, 2)
    belief = np.random.default_rng(2).random(PAIRS).astype(np.float32)
    arguments = (observation, model, densities, np.full(GAUGES, free_probability), believed, belief)
    by_products = weigh_free_gains(*arguments)
    weight = by_products.weight.copy()
    free_probability = by_products.free_probability.copy()
    with np.errstate(divide="ignore"):
        log_scale = weigh_free_gains_in_logs(*arguments, by_products)
    np.testing.assert_allclose(weight, by_products.weight * np.exp(log_scale), rtol=SINGLE, atol=1e-30)
    np.testing.assert_allclose(free_probability, by_products.free_probability, rtol=SINGLE, atol=1e-12)


@pytest.mark.parametrize("deviation", [3.0, 1e60])
def test_sound_gauges_are_weighed_as_by_logarithms(deviation):
    """The second deviation is so large that products of kernels overflow."""
    observation = drawn_observation([25.0, 31.0, 25.0], deviation)
    pairs = np.arange(PAIRS)
    log_density = np.empty(PAIRS)
    log_density_of_sound_gauges(observation, pairs, 10.0 + SCALE_SQUARES, log_density)
    belief = np.full(PAIRS, 1.0 / PAIRS)
    evidence = update_sound_gauges(observation, pairs, 10.0, belief, SCALE_SQUARES.copy(), np.empty(PAIRS))
    expected = np.exp(log_density - log_density.max())
    np.testing.assert_allclose(belief, expected / expected.sum(), rtol=1e-9, atol=1e-250)
    log_expected = log_density.max() + np.log(expected.mean())
    assert evidence.log_evidence == pytest.approx(log_expected, rel=1e-12)


@pytest.mark.parametrize("exponent", [0.0, 1.0, 7.0, 61.0, 10.5])
def test_powers_are_those_of_numpy(exponent):
    base = np.random.default_rng(1).uniform(0.5, 1.5, 9)
    product = np.full(9, 2.0)
    multiply_by_power(base.copy(), exponent, product)
    np.testing.assert_allclose(product, 2.0 * base**exponent, rtol=1e-13)


def test_gauges_of_one_product_have_the_same_degrees_of_freedom():
    product = np.empty(6, np.int64)
    number_products(np.array([3.0, 4.0, 3.0, 5.0, 4.0, 3.0]), product)
    np.testing.assert_array_equal(product, [0, 1, 0, 2, 1, 0])
