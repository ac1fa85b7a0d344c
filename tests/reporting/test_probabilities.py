"""Probabilities that are normalised are never larger than one."""

import numpy as np
import pytest

from reporting.probabilities import normalised_probabilities, probability_of_some


def test_probabilities_are_weights_over_their_sum():
    log_weights = np.log([1.0, 2.0, 5.0]) + 7000.0
    assert normalised_probabilities(log_weights) == pytest.approx([0.125, 0.25, 0.625])


def test_no_rounding_makes_a_probability_larger_than_one():
    generator = np.random.default_rng(0)
    for _ in range(2000):
        log_weights = generator.normal(-5000.0, 3000.0, 12)
        log_weights[0] = 6734.2 + generator.random()
        assert normalised_probabilities(log_weights).max() <= 1.0
        assert probability_of_some(log_weights, log_weights > -9e9) <= 1.0
