"""The densities of faults by products, against the same by logarithms."""

import numpy as np
import pytest

from twin_master.learning.fault_kernels import StandardizedObservation
from twin_master.learning.free_gains import (
    GaugeWithFreeGain,
    PairsOfFreeGains,
    mix_densities,
    mix_densities_in_logs,
)
from twin_master.learning.gauge_faults import (
    GaugeFaults,
    SumsOfFaults,
    weigh_gauge_fault_in_logs,
    weigh_gauge_faults,
)
from twin_master.learning.model_likelihood import ModelLikelihood, model_likelihood, multiply_by_power

PAIRS, GAUGES, GAINS = 40, 3, 4
FAULTS = GAUGES * GAINS


def drawn_observation(degrees: list[float]) -> tuple[StandardizedObservation, ModelLikelihood]:
    """Return an observation of three gauges, of which the last is lost, and its likelihood."""
    random = np.random.default_rng(5)
    present = np.array([True, True, False])
    residual = np.where(present[:, None], random.normal(0.0, 3.0, (GAUGES, PAIRS)), 0.0)
    prediction = np.where(present[:, None], random.normal(10.0, 5.0, (GAUGES, PAIRS)), 0.0)
    log_density = random.normal(0.0, 5.0, PAIRS)
    observation = StandardizedObservation(present, residual, prediction, log_density, np.array(degrees))
    scale_squares = np.array([12.0, 9.0, 10.0])
    return observation, model_likelihood(observation, np.arange(PAIRS), scale_squares, log_density)


def drawn_faults() -> tuple[GaugeFaults, np.ndarray]:
    """Return faults with learnt gains, and beliefs of which a third is zero."""
    random = np.random.default_rng(6)
    faults = GaugeFaults(
        gain=random.normal(0.0, 0.3, FAULTS),
        gain_deviation=np.full(FAULTS, 0.1),
        fitted_gain=random.uniform(-1.0, 1.0, FAULTS),
        gain_variance=random.uniform(0.1, 1.0, FAULTS),
        scale_squares=random.uniform(8.0, 20.0, FAULTS),
    )
    belief = random.random((PAIRS, FAULTS)).astype(np.float32)
    belief[::3] = 0.0
    return faults, belief


@pytest.mark.parametrize("degrees", [[11.0, 11.0, 11.0], [11.0, 31.0, 12.0], [10.5, 10.5, 10.25]])
def test_gauge_faults_by_products_weigh_as_by_logarithms(degrees):
    observation, model = drawn_observation(degrees)
    faults, belief = drawn_faults()
    weight, sums = weigh_gauge_faults(observation, model, faults, belief)
    weight_in_logs = np.empty_like(weight)
    sums_in_logs = SumsOfFaults(*(np.empty(FAULTS) for _ in range(4)))
    for fault in range(FAULTS):
        weigh_gauge_fault_in_logs(observation, model, faults, belief, fault, weight_in_logs, sums_in_logs)
    np.testing.assert_allclose(
        weight / sums.weight, weight_in_logs / sums_in_logs.weight, rtol=1e-11, atol=1e-300
    )
    for name in ("squares", "cc", "cx"):
        by_products = getattr(sums, name) / sums.weight
        by_logarithms = getattr(sums_in_logs, name) / sums_in_logs.weight
        np.testing.assert_allclose(by_products, by_logarithms, rtol=1e-11)


@pytest.mark.parametrize("free_probability", [0.0, 0.3, 1.0])
def test_a_free_gain_by_products_weighs_as_by_logarithms(free_probability):
    _, model = drawn_observation([25.0, 25.0, 25.0])
    pairs = PairsOfFreeGains(
        np.arange(PAIRS),
        np.ascontiguousarray(model.residual.T),
        np.ascontiguousarray(0.1 * model.prediction.T),
        np.ascontiguousarray(model.kernel.T),
    )
    gauge = GaugeWithFreeGain(1, free_probability, 0.4, 0.3, 25.0, 9.0, 11.0, 14.0)
    mixture, part, log_mixture, part_in_logs = np.empty((4, PAIRS))
    assert mix_densities(pairs, gauge, mixture, part)
    with np.errstate(divide="ignore"):
        mix_densities_in_logs(pairs, gauge, log_mixture, part_in_logs)
    np.testing.assert_allclose(np.log(mixture), log_mixture, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(part, part_in_logs, rtol=1e-11)


def test_densities_that_overflow_are_told():
    """After a million steps, a residual of hundreds of deviations that a gain explains."""
    pairs = PairsOfFreeGains(np.arange(1), *(np.array([[value]]) for value in (300.0, 300.0, 1.09)))
    gauge = GaugeWithFreeGain(0, 0.5, 1.0, 1e-6, 1e6, 1e6, 1e6, 1e6)
    assert not mix_densities(pairs, gauge, np.empty(1), np.empty(1))


@pytest.mark.parametrize("exponent", [0.0, 1.0, 7.0, 61.0, 10.5])
def test_powers_are_those_of_numpy(exponent):
    base = np.random.default_rng(1).uniform(0.5, 1.5, 9)
    product = np.full(9, 2.0)
    multiply_by_power(base.copy(), exponent, product)
    np.testing.assert_allclose(product, 2.0 * base**exponent, rtol=1e-13)
