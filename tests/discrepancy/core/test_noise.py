"""What is read from noise records, against processes with known parameters."""

from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import toeplitz
from scipy.signal import lfilter
from scipy.stats import binom

from discrepancy.campaign.noise import (
    MAINS_DEVIATION,
    NoiseModel,
    aliased,
    autoregression,
    noise_model,
    without_lines,
)
from discrepancy.campaign.noise_tests import ljung_box
from discrepancy.campaign.records import Channel, NoiseRecord, Quantity


def test_records_that_say_little():
    """No record, a stated deviation, and a record too short for a spectrum."""
    for record, freedom, deviation in ((None, 0.0, 0.7), (NoiseRecord(2.0, inf), inf, 2.0)):
        found = noise_model(Channel("g", Quantity.STRAIN, "g", record), 0.7)
        assert found.degrees_of_freedom == freedom
        assert found.standard_deviation == found.static_deviation == deviation
    short = noise_model(channel(np.random.default_rng(0).standard_normal(30)), 0.7)
    assert not short.autoregression.size


INTERVAL = 0.002


def coloured(generator, coefficients, count, burn=2000):
    white = generator.standard_normal(count + burn)
    return lfilter([1.0], np.r_[1.0, -np.asarray(coefficients)], white)[burn:]


def channel(samples, interval=INTERVAL):
    record = NoiseRecord(float(samples.std()), len(samples) - 1.0, samples, interval, "pre-trigger")
    return Channel("g", Quantity.STRAIN, "g", record)


@pytest.mark.parametrize("coefficients", [(0.8,), (1.2, -0.6), (0.5, 0.0, 0.3)])
def test_autoregression_is_recovered(coefficients):
    """Yule-Walker estimates have standard errors of about 1/sqrt(N)."""
    found, innovation = autoregression(coloured(np.random.default_rng(1), coefficients, 8000))
    padded = np.zeros(max(len(found), len(coefficients)))
    padded[: len(found)] = found
    padded[: len(coefficients)] -= coefficients
    assert np.abs(padded).max() < 5.0 / np.sqrt(8000)
    assert innovation == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / 8000))


def test_model_of_a_coloured_record():
    samples = 3.0 * coloured(np.random.default_rng(2), (0.8,), 4000)
    noise = noise_model(channel(samples), 1.0)
    assert noise.standard_deviation == pytest.approx(3.0, rel=0.05)  # of the innovation
    assert noise.static_deviation == pytest.approx(3.0 / 0.6, rel=0.1)  # sigma / sqrt(1 - a^2)
    assert noise.degrees_of_freedom > 0.0
    assert noise.applies(INTERVAL)
    assert not noise.applies(2.0 * INTERVAL)
    np.testing.assert_array_equal(noise.whiten(samples, 2.0 * INTERVAL), samples)


def test_white_records_stay_white():
    generator = np.random.default_rng(3)
    orders = [
        len(noise_model(channel(generator.standard_normal(400)), 1.0).autoregression) for _ in range(300)
    ]
    # the Ljung-Box test of the record has level 1e-3
    assert np.count_nonzero(orders) <= binom.isf(1e-4, 300, 1e-3)


@pytest.mark.parametrize("coefficients", [pytest.param((), marks=pytest.mark.long), (0.9,)])
def test_lines_are_not_found_in_noise(coefficients):
    """Level 1e-4 a line against a level known from 20 neighbours: (1 + 9.2 / 20)^-20 = 5e-4, three lines."""
    generator = np.random.default_rng(7)
    found = sum(
        len(without_lines(coloured(generator, coefficients, 500, 200), INTERVAL)[1]) for _ in range(700)
    )
    assert found <= binom.isf(1e-3, 2100, 6e-4)


@pytest.mark.parametrize(
    ("interval", "count", "shown", "size", "line"),
    [
        (INTERVAL, 1000, 50.0, 0.5, 50.0),
        (INTERVAL, 1000, 60.0, 0.5, 60.0),
        (INTERVAL, 1000, 100.0, 1.0, 400.0),  # above half the rate: it shows at 100 Hz
        # a record of 8 s resolves 0.125 Hz, and 400 Hz may be off by 0.4 Hz
        *(
            (1e-3, 8000, 400.0 * (1.0 + share * MAINS_DEVIATION), 2.0, 400.0)
            for share in (-0.8, -0.2, 0.5, 1.0)
        ),
    ],
)
def test_lines_are_found_where_they_are_and_taken_out(interval, count, shown, size, line):
    time = interval * np.arange(count)
    noise = np.random.default_rng(9).standard_normal(count)
    rest, lines = without_lines(noise + size * np.cos(2.0 * np.pi * shown * time + 0.3), interval)
    assert lines == (line,)
    assert rest.std() == pytest.approx(1.0, rel=0.1 if count == 1000 else 0.03)
    assert ljung_box(rest)[1] > 1e-3


@given(st.floats(0.0, 1e3), st.floats(1e-4, 1e-1))
def test_aliases_agree_at_the_samples(frequency, interval):
    shown = aliased(frequency, interval)
    assert 0.0 <= shown <= 0.5 / interval * (1.0 + 1e-9)
    time = interval * np.arange(6)
    np.testing.assert_allclose(
        np.cos(2.0 * np.pi * frequency * time), np.cos(2.0 * np.pi * shown * time), atol=1e-5
    )


@pytest.mark.parametrize("coefficients", [(0.9,), (1.2, -0.6), (0.5, 0.0, 0.3)])
def test_whitening_is_that_of_the_whole_covariance(coefficients):
    """Sum of squares of whitened samples = x' C^-1 x with the Toeplitz covariance of the process."""
    pulse = np.r_[1.0, np.zeros(3000)]
    impulse = lfilter([1.0], np.r_[1.0, -np.asarray(coefficients)], pulse)
    covariance = toeplitz([impulse[: len(impulse) - lag] @ impulse[lag:] for lag in range(40)])
    noise = NoiseModel(1.0, float(np.sqrt(covariance[0, 0])), inf, np.array(coefficients), INTERVAL, ())
    x = np.random.default_rng(0).standard_normal((2, 40))
    white = noise.whiten(x, INTERVAL)
    np.testing.assert_allclose(white @ white.T, x @ np.linalg.solve(covariance, x.T), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(noise.whiten(x[:, :2], INTERVAL), white[:, :2], rtol=1e-12)
