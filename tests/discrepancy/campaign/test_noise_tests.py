"""Statistics of residuals against oracles: exact sums, levels under white noise, power of the weights."""

import numpy as np
import pytest
from scipy import stats

from discrepancy.campaign.noise_tests import (
    benjamini_yekutieli,
    combine,
    cumulative_periodogram,
    fisher_g,
    holm,
    ljung_box,
    periodogram,
    pooled_variance_p_value,
    variance_p_value,
)


def test_periodogram_of_a_cosine_and_of_white_noise():
    count = 101
    series = np.cos(2.0 * np.pi * 7 * np.arange(count) / count)
    ordinates = periodogram(series)
    assert ordinates.size == 50
    assert ordinates[6] == pytest.approx(count / 4)
    assert np.delete(ordinates, 6).max() < 1e-20
    noise = np.random.default_rng(0).standard_normal((4000, 64))
    assert np.mean([periodogram(row) for row in noise]) == pytest.approx(1.0, abs=0.01)
    assert periodogram(np.ones(64)).size == 31


@pytest.mark.parametrize("count", [64, 301])
def test_p_values_of_serial_tests_are_uniform_under_white_noise(count):
    noise = np.random.default_rng(count).standard_normal((1500, count))
    for test in (ljung_box, cumulative_periodogram, fisher_g):
        p = np.array([test(row)[1] for row in noise])
        for level in (0.2, 0.05, 0.01, 0.0025):
            error = np.sqrt(level / len(noise))
            assert np.mean(p <= level) == pytest.approx(level, abs=4.0 * error), (test.__name__, level)


def test_fisher_g_against_his_exact_sum():
    from math import comb

    series = np.random.default_rng(2).standard_normal(41) + 1.1 * np.cos(0.9 * np.arange(41))
    g, p, _ = fisher_g(series)
    count = periodogram(series).size
    exact = sum(
        (-1) ** (j - 1) * comb(count, j) * (1.0 - j * g) ** (count - 1) for j in range(1, int(1.0 / g) + 1)
    )
    assert p == pytest.approx(exact, rel=0.02)


def test_serial_tests_see_what_they_are_for():
    generator = np.random.default_rng(4)
    noise = generator.standard_normal(400)
    correlated = np.empty(400)
    correlated[0] = noise[0]
    for n in range(1, 400):
        correlated[n] = 0.4 * correlated[n - 1] + noise[n]
    assert ljung_box(correlated)[1] < 1e-6
    assert cumulative_periodogram(correlated)[1] < 1e-4
    share, p, place = fisher_g(noise + 0.6 * np.cos(2.0 * np.pi * 50 / 400 * np.arange(400)))
    assert p < 1e-6
    assert place == 50
    assert share == pytest.approx(0.18 / 1.18, rel=0.5)


def test_holm_and_benjamini_yekutieli_by_hand():
    assert holm([0.004, 0.011, 0.03, np.nan], 0.03) == (True, True, True, False)
    assert holm([0.011, 0.02, 0.03], 0.03) == (False, False, False)
    assert holm([], 0.01) == ()
    # c(4) = 25/12: limits are 0.006, 0.012, 0.018, 0.024 for a rate of 0.05.
    assert benjamini_yekutieli(np.array([0.5, 0.007, 0.0115, 0.0179]), 0.05).tolist() == [
        False, True, True, True,
    ]  # fmt: skip
    assert not benjamini_yekutieli(np.array([0.0061, 0.5, 0.5, 0.5]), 0.05).any()
    assert benjamini_yekutieli(np.zeros(0), 0.05).size == 0


def test_combined_p_values_are_valid():
    p = np.random.default_rng(8).uniform(size=(4000, 7))
    combined = np.array([combine(row) for row in p])
    for level in (0.1, 0.01):
        assert np.mean(combined <= level) <= level + 3.0 * np.sqrt(level / 4000)
    assert combine([0.3]) == 0.3


def test_ljung_box_allows_for_samples_that_do_not_count():
    """A third is left out, in blocks and singly: levels hold, and its value there does not matter."""
    generator = np.random.default_rng(12)
    used = np.ones(150, dtype=bool)
    used[40:70] = False
    used[generator.choice(150, 20, replace=False)] = False
    rows = generator.standard_normal((4000, 150))
    p = np.array([ljung_box(row, used=used)[1] for row in rows])
    for level in (0.2, 0.05, 0.01, 0.0025):
        assert np.mean(p <= level) == pytest.approx(level, abs=4.0 * np.sqrt(level / 4000) + 0.2 * level)
    rows[:, ~used] = 100.0
    assert ljung_box(rows[0], used=used)[1] == p[0]
    assert ljung_box(rows[0], used=np.zeros(150, dtype=bool)) == (0.0, 1.0)
    every = np.ones(150, dtype=bool)
    again = generator.standard_normal(150)
    assert ljung_box(again, used=every)[0] == pytest.approx(ljung_box(again)[0], rel=1e-12)


def test_weights_of_the_pooled_variance_have_the_most_power():
    """A gap that raises all channels alike is found more often than with any simpler weights.

    Channels of a short record, of few readings and of many: what tells most is neither the most readings
    (their record is short) nor every channel alike.
    """
    freedom = np.array([4000.0, 4000.0, 300.0, 6.0, 6.0, 6.0, 6.0])
    record = np.array([12.0, 12.0, np.inf, np.inf, 50.0, np.inf, 50.0])
    generator = np.random.default_rng(5)
    draws, gap, level = 2000, 0.35, 1e-3
    noise = np.where(np.isinf(record), 1.0, generator.chisquare(np.minimum(record, 1e6), (draws, 7)) / record)

    def p_values(size):
        squares = size * generator.chisquare(freedom, (draws, 7)) / freedom / noise
        return np.array(
            [
                [variance_p_value(*row) for row in zip(square, freedom, record, strict=True)]
                for square in squares
            ]
        )

    def share(p, weights):
        scores = stats.norm.isf(np.clip(p, 1e-300, 1.0 - 1e-16)) @ weights / np.sqrt(weights @ weights)
        return float(np.mean(stats.norm.sf(scores) < level))

    gapped = p_values(1.0 + gap)
    found = np.mean([pooled_variance_p_value(row, freedom, record) < level for row in gapped])
    known = np.where(np.isinf(record), 1e9, record)
    simpler = (np.ones(7), np.sqrt(freedom), freedom, known, freedom / (1.0 + freedom / record))
    for weights in simpler:
        assert found > share(gapped, weights) + 0.02
    silent = [pooled_variance_p_value(row, freedom, record) for row in p_values(1.0)]
    assert stats.kstest(silent, "uniform").pvalue > 1e-3
