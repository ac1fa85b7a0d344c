"""What is read from noise records, against processes with known parameters."""

from math import inf

import numpy as np
import pytest
from scipy import stats
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from discrepancy.campaign.noise import (
    MAINS_DEVIATION,
    NOISE_RECORD_LEVEL,
    NoiseModel,
    find_line,
    fit_autoregression,
    noise_model,
    remove_lines,
)
from discrepancy.campaign.noise_tests import (
    cumulative_periodogram,
    fisher_g,
    holm_rejections,
    ljung_box,
    pooled_variance_p_value,
    variance_p_value,
)
from discrepancy.campaign.records import Channel, NoiseRecord, Quantity
from tests.discrepancy.core.kit import coloured

INTERVAL = 0.002


def channel(samples, interval=INTERVAL):
    record = NoiseRecord(float(samples.std()), len(samples) - 1.0, samples, interval, "pre-trigger")
    return Channel("g", Quantity.STRAIN, "g", record)


@pytest.fixture(scope="module", params=[(0.8,), (1.2, -0.6), (0.5, 0.0, 0.3)])
def autoregression(request):
    """Coefficients and a series of that autoregression with innovations of one."""
    return request.param, coloured(np.random.default_rng(1), request.param, 8000)


def test_autoregression_is_recovered(autoregression):
    """Yule-Walker estimates have standard errors of about 1/sqrt(N)."""
    coefficients, series = autoregression
    estimate, innovation = fit_autoregression(series)
    error = np.zeros(max(len(estimate), len(coefficients)))
    error[: len(estimate)] = estimate
    error[: len(coefficients)] -= coefficients
    assert np.abs(error).max() < 5.0 / np.sqrt(8000)
    assert innovation == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / 8000))


def test_the_innovation_is_that_of_the_record_in_silence(autoregression):
    _, series = autoregression
    estimate, innovation = fit_autoregression(series)
    residual = np.convolve(series, np.r_[1.0, -estimate])
    expected = residual @ residual / (8000 - len(estimate) - 1.0)
    assert innovation == pytest.approx(expected, rel=1e-9)


def test_noise_has_the_deviation_of_its_innovation_and_that_of_its_samples(autoregression):
    _, series = autoregression
    noise = noise_model(channel(series[:3000]), 1.0)
    assert noise.standard_deviation == pytest.approx(1.0, rel=0.05)
    assert noise.static_deviation == pytest.approx(series.std(), rel=0.1)


def test_noise_is_whitened_at_the_interval_of_its_record_alone(autoregression):
    _, series = autoregression
    noise = noise_model(channel(series[:3000]), 1.0)
    assert (noise.can_whiten(INTERVAL), noise.can_whiten(2.0 * INTERVAL)) == (True, False)
    np.testing.assert_array_equal(noise.whiten(series, 2.0 * INTERVAL), series)


@pytest.mark.parametrize(("coefficients", "count", "records"), [((), 64, 1500), ((0.9,), 500, 300)])
def test_lines_are_not_found_in_noise(coefficients, count, records):
    """Level 1e-4 a line, three lines, however few neighbours tell the level of the noise."""
    generator = np.random.default_rng(7)
    drawn = (coloured(generator, coefficients, count, before=200) for _ in range(records))
    found = sum(len(remove_lines(noise, INTERVAL)[1]) for noise in drawn)
    assert found <= stats.binom.isf(1e-2, 3 * records, 1e-4)


@pytest.mark.parametrize(
    ("interval", "count", "shown", "size", "line"),
    [
        (INTERVAL, 1000, 50.0, 0.5, 50.0),
        (INTERVAL, 1000, 60.0, 0.5, 60.0),
        (INTERVAL, 1000, 100.0, 1.0, 400.0),  # above half the rate: it shows at 100 Hz
        # a record of 8 s resolves 0.125 Hz, and 400 Hz may be off by 0.4 Hz
        (1e-3, 8000, 400.0 * (1.0 - 0.2 * MAINS_DEVIATION), 2.0, 400.0),
        (1e-3, 8000, 400.0 * (1.0 + MAINS_DEVIATION), 2.0, 400.0),
    ],
)
def test_lines_are_found_where_they_are_and_taken_out(interval, count, shown, size, line):
    time = interval * np.arange(count)
    noise = np.random.default_rng(9).standard_normal(count)
    rest, lines = remove_lines(noise + size * np.cos(2.0 * np.pi * shown * time + 0.3), interval)
    assert lines == (line,)
    assert rest.std() == pytest.approx(1.0, rel=0.1 if count == 1000 else 0.03)
    assert ljung_box(rest)[1] > 1e-3


def covariance_of_autoregression(coefficients, count):
    """Return the Toeplitz covariance of so many samples of a process with innovations of deviation one."""
    pulse = np.r_[1.0, np.zeros(3000)]
    impulse_response = lfilter([1.0], np.r_[1.0, -np.asarray(coefficients)], pulse)
    length = len(impulse_response)
    return toeplitz([impulse_response[: length - lag] @ impulse_response[lag:] for lag in range(count)])


@pytest.mark.parametrize("coefficients", [(0.9,), (1.2, -0.6), (0.5, 0.0, 0.3)])
def test_whitening_is_that_of_the_whole_covariance(coefficients):
    """Sum of squares of whitened samples = x' C^-1 x with the Toeplitz covariance of the process."""
    covariance = covariance_of_autoregression(coefficients, 40)
    deviation = float(np.sqrt(covariance[0, 0]))
    noise = NoiseModel(1.0, deviation, inf, np.array(coefficients), INTERVAL, ())
    samples = np.random.default_rng(0).standard_normal((2, 40))
    white = noise.whiten(samples, INTERVAL)
    white_of_first_two = noise.whiten(samples[:, :2], INTERVAL)
    expected = samples @ np.linalg.solve(covariance, samples.T)
    np.testing.assert_allclose(white @ white.T, expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(white_of_first_two, white[:, :2], rtol=1e-12)


# ---------------------------------------------------------------- statistics of residuals


@pytest.mark.parametrize("count", [64, 301])
def test_p_values_of_serial_tests_are_uniform_under_white_noise(count):
    noise = np.random.default_rng(count).standard_normal((800, count))
    for test in (ljung_box, cumulative_periodogram, fisher_g):
        p = np.array([test(row)[1] for row in noise])
        for level in (0.2, 0.05, 0.01, 0.0025):
            error = np.sqrt(level / len(noise))
            assert np.mean(p <= level) == pytest.approx(level, abs=4.0 * error), (test.__name__, level)


def test_correlated_noise_is_not_white():
    correlated = coloured(np.random.default_rng(4), (0.4,), 400)
    assert ljung_box(correlated)[1] < 1e-6
    assert cumulative_periodogram(correlated)[1] < 1e-4


def test_a_line_in_noise_is_found_with_its_share_of_the_power():
    line = 0.6 * np.cos(2.0 * np.pi * 50 / 400 * np.arange(400))
    share, p_value, frequency = fisher_g(np.random.default_rng(4).standard_normal(400) + line)
    assert p_value < 1e-6
    assert frequency == 50
    assert share == pytest.approx(0.18 / 1.18, rel=0.5)


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.6, 0.9])
def test_slow_noise_is_not_taken_for_a_line(correlation):
    """The level is 0.1 %; of 200 records at most 2 % are said to hold a line."""
    generator = np.random.default_rng(31)
    records = [coloured(generator, (correlation,), 400) for _ in range(200)]
    p_values = np.array([find_line(record - record.mean()).p_value for record in records])
    assert np.mean(p_values < NOISE_RECORD_LEVEL) <= 0.02


@pytest.mark.parametrize("correlation", [0.0, 0.6, 0.9])
def test_a_line_in_slow_noise_is_found_with_its_frequency_and_share(correlation):
    """It has 30 % of the variance, and lies between two frequencies of the periodogram."""
    noise = coloured(np.random.default_rng(32), (correlation,), 800)
    amplitude = np.sqrt(2.0 * 0.3 / 0.7) * noise.std()
    record = noise + amplitude * np.cos(2.0 * np.pi * 100.3 / 800 * np.arange(800))
    line = find_line(record - record.mean())
    assert line.p_value < 1e-6
    assert line.frequency_index == 100
    # the ordinate has this part of the power of a line that is 0.3 resolutions away
    assert line.statistic == pytest.approx(0.3 * np.sinc(0.3) ** 2, rel=0.2)


def test_holm_by_hand():
    assert holm_rejections([0.004, 0.011, 0.03, np.nan], 0.03) == (True, True, True, False)
    assert holm_rejections([0.011, 0.02, 0.03], 0.03) == (False, False, False)
    assert holm_rejections([], 0.01) == ()


@pytest.fixture(scope="module")
def samples_that_count():
    """Which of 150 samples count: a third is left out, in blocks and singly."""
    used = np.ones(150, dtype=bool)
    used[40:70] = False
    used[np.random.default_rng(12).choice(150, 20, replace=False)] = False
    return used


def test_ljung_box_allows_for_samples_that_do_not_count(samples_that_count):
    rows = np.random.default_rng(13).standard_normal((4000, 150))
    p_values = np.array([ljung_box(row, is_used=samples_that_count)[1] for row in rows])
    for level in (0.2, 0.05, 0.01, 0.0025):
        tolerance = 4.0 * np.sqrt(level / 4000) + 0.2 * level
        assert np.mean(p_values <= level) == pytest.approx(level, abs=tolerance)


def test_values_of_samples_that_do_not_count_do_not_matter(samples_that_count):
    row = np.random.default_rng(13).standard_normal(150)
    p_value = ljung_box(row, is_used=samples_that_count)[1]
    row[~samples_that_count] = 100.0
    assert ljung_box(row, is_used=samples_that_count)[1] == p_value
    assert ljung_box(row, is_used=np.zeros(150, dtype=bool)) == (0.0, 1.0)


def test_ljung_box_of_samples_that_all_count_is_that_without_a_mask():
    row = np.random.default_rng(13).standard_normal(150)
    with_mask = ljung_box(row, is_used=np.ones(150, dtype=bool))[0]
    assert with_mask == pytest.approx(ljung_box(row)[0], rel=1e-12)


def test_weights_of_the_pooled_variance_have_the_most_power():
    """A gap that raises all channels alike is found more often than with any simpler weights.

    Channels of a short record, of few readings and of many: what tells most is neither the most readings
    (their record is short) nor every channel alike.
    """
    freedom = np.array([4000.0, 4000.0, 300.0, 6.0, 6.0, 6.0, 6.0])
    record = np.array([12.0, 12.0, np.inf, np.inf, 50.0, np.inf, 50.0])
    generator = np.random.default_rng(5)
    noise = generator.chisquare(np.minimum(record, 1e9), (2000, 7)) / np.minimum(record, 1e9)

    def pooled(gap):
        squares = (1.0 + gap) * generator.chisquare(freedom, (2000, 7)) / freedom / noise
        p_values = [list(map(variance_p_value, square, freedom, record)) for square in squares]
        return np.array(p_values), [pooled_variance_p_value(np.array(p), freedom, record) for p in p_values]

    separate, found = pooled(0.35)
    scores = stats.norm.isf(np.clip(separate, 1e-300, 1.0 - 1e-16))
    known = np.minimum(record, 1e9)
    for weights in (np.ones(7), np.sqrt(freedom), freedom, known, freedom / (1.0 + freedom / record)):
        simpler = stats.norm.sf(scores @ weights / np.sqrt(weights @ weights))
        assert np.mean(np.array(found) < 1e-3) > np.mean(simpler < 1e-3) + 0.02
    assert stats.kstest(pooled(0.0)[1], "uniform").pvalue > 1e-3
