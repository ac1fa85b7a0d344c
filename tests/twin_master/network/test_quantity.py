from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin_master.errors import InvalidDistributionError, InvalidModelError
from twin_master.network.quantity import QuantityModel


def random_case(seed, ties=False):
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


@given(st.integers(0, 2**32 - 1))
def test_moments_are_those_of_the_mixture(seed):
    values, weight, joint = random_case(seed)
    mean, deviation = QuantityModel(values, weight).moments(joint)
    for b in range(7):
        for g in range(5):
            x, p = points(values, weight, joint[b], g)
            assert mean[b, g] == pytest.approx(p @ x, abs=1e-13)
            assert deviation[b, g] == pytest.approx(np.sqrt(p @ (x - p @ x) ** 2), abs=1e-13)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_quantiles_are_those_of_the_mixture(seed, ties):
    """The smallest value whose cumulative probability reaches the level; ties and zero weights included."""
    values, weight, joint = random_case(seed, ties)
    levels = [0.025, 0.3, 0.5, 0.975, 1.0]
    result = QuantityModel(values, weight).quantiles(joint, levels)
    assert result.shape == (7, 5, 5)
    for b in range(7):
        for g in range(5):
            x, p = points(values, weight, joint[b], g)
            x, p = x[p > 0], p[p > 0]
            order = np.argsort(x)
            cumulative = np.cumsum(p[order])
            for i, level in enumerate(levels):
                expected = x[order][np.argmax(cumulative >= level - 1e-12)] if level < 1 else x.max()
                assert result[b, i, g] == expected


def test_leading_axes_are_kept():
    values, weight, joint = random_case(1)
    model = QuantityModel(values, weight)
    nested = joint[:6].reshape(2, 3, 3, 2)
    mean, deviation = model.moments(nested)
    assert mean.shape == deviation.shape == (2, 3, 5)
    np.testing.assert_array_equal(mean.reshape(6, 5), model.moments(joint[:6])[0])
    assert model.quantiles(nested, [0.5]).shape == (2, 3, 1, 5)
    assert model.quantiles(joint[0], [0.5]).shape == (1, 5)


def test_bad_input_is_refused():
    values, weight, joint = random_case(0)
    with pytest.raises(InvalidModelError, match=r"\(draws, states, controls, sensors\)"):
        QuantityModel(values[0])
    values[0, 1, 0, 2] = np.nan
    with pytest.raises(InvalidModelError, match=r"\(0, 1, 0, 2\) is nan"):
        QuantityModel(values)
    values[0, 1, 0, 2] = 0.0
    with pytest.raises(InvalidDistributionError, match="draw weights"):
        QuantityModel(values, weight * 2)
    model = QuantityModel(values, weight)
    with pytest.raises(InvalidModelError, match="known_control"):
        model.moments(joint[:, :, 0])
    for levels in ([0.9, 0.1], [0.0], [1.1], 0.5, [np.nan]):
        with pytest.raises(InvalidModelError, match="increasing quantile levels"):
            model.quantiles(joint, levels)
