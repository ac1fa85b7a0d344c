"""What the ring-down is made to say: a linear wing, one that softens, the published records."""

import math
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from calibration.dynamics.damped_cosine import RingDownMode
from calibration.dynamics.records import RingDownRecord, read_records
from calibration.dynamics.ringdown import Frequencies
from calibration.dynamics.trials import fit_trials
from calibration.joint.measurement import PUBLISHED_MODES, _mean_of, measured_modes

TIME = np.arange(0.0, 6.4, 1.0 / 250.0)
F1, F2, ZETA1, ZETA2 = 5.65, 29.0, 0.028, 0.05


def by_name(trials):
    """What `measured_modes` reads, by name."""
    return {item.name: item for item in measured_modes(trials)}


def second_mode(time):
    omega = 2.0 * math.pi * F2
    damped = omega * math.sqrt(1.0 - ZETA2**2)
    return np.asarray(0.008 * np.exp(-ZETA2 * omega * time) * np.cos(damped * time))


def trials(softening, seed, noise=1e-4, scatter=0.0):
    """Records whose first frequency falls by `softening` [Hz] with every factor e of the amplitude."""
    generator = np.random.default_rng(seed)
    records = []
    for trial in range(5):
        decay = 2.0 * math.pi * F1 * ZETA1
        # f(t) = F1 + softening (ln A(0) - ln A(t)) - middle, integrated over time
        frequency = F1 - 0.5 * softening * decay * TIME[-1] + scatter * generator.standard_normal()
        phase = 2.0 * math.pi * (frequency * TIME + 0.5 * softening * decay * TIME**2)
        signal = 0.012 * np.exp(-decay * TIME) * np.cos(phase) + second_mode(TIME)
        signal += generator.normal(0.0, noise, TIME.size)
        records.append(RingDownRecord(TIME, signal, source=f"drawn {trial + 1}"))
    return tuple(records)


def test_a_linear_wing_is_given_its_statistical_error_alone():
    scores = []
    for seed in range(3):
        fitted = fit_trials(trials(0.0, seed), Frequencies.FITTED, start=None)
        found = by_name(fitted)
        scores.append(
            (
                (found["frequency_2"].value - F2) / found["frequency_2"].deviation,
                (found["damping_ratio_1"].value - ZETA1) / found["damping_ratio_1"].deviation,
                (found["damping_ratio_2"].value - ZETA2) / found["damping_ratio_2"].deviation,
            )
        )
        errors = [fit.modes[0].standard_error["frequency"] for fit in fitted.fits]
        expected = math.sqrt(sum(error**2 for error in errors)) / 5.0
        # Five trials in a row seldom scatter, and windows seldom slope, beyond chance.
        assert found["frequency_1"].deviation < 6.0 * expected
        assert found["frequency_1"].deviation >= 0.999 * expected
    assert 0.4 < math.sqrt(float(np.mean(np.square(scores)))) < 1.6


def test_a_wing_that_softens_is_given_its_spread():
    slope = 0.07
    found = by_name(fit_trials(trials(slope, 1), Frequencies.FITTED, start=None))
    # Windows of 0.8 s from 0.4 s on, as far as the mode stands above the noise; spread of the log amplitude.
    decay = 2.0 * math.pi * F1 * ZETA1
    last = min(5.6, math.log(0.012 / (4.0 * 1e-4)) / decay)
    middles = np.arange(0.8, last + 0.4, 0.4)
    assert found["frequency_1"].deviation == pytest.approx(slope * decay * middles.std(), rel=0.25)


def test_frequencies_of_spectral_peaks_carry_their_bias():
    """Skirts of the first mode move the second peak: the authors' procedure is off, and says so."""
    found = by_name(fit_trials(trials(0.0, 2), Frequencies.PEAKS, start=None))
    fitted = by_name(fit_trials(trials(0.0, 2), Frequencies.FITTED, start=None))
    bias = abs(found["frequency_2"].value - F2)
    assert bias > 5.0 * fitted["frequency_2"].deviation
    assert found["frequency_2"].deviation > 0.5 * bias
    assert found["frequency_2"].deviation < 2.0 * bias


def _mean_of_values(values, errors):
    """Return mean and standard error of trials whose fits give these frequencies and standard errors."""
    pairs = zip(values, errors, strict=True)
    modes = [SimpleNamespace(frequency=value, standard_error={"frequency": error}) for value, error in pairs]
    return _mean_of(cast(list[RingDownMode], modes), "frequency")


def test_mean_over_trials():
    mean, error = _mean_of_values([1.0, 1.1, 0.9, 1.05, 0.95], [0.1] * 5)  # scatter as expected
    assert (mean, error) == (pytest.approx(1.0), pytest.approx(0.1 / math.sqrt(5.0)))
    _, error = _mean_of_values([1.0, 1.1, 0.9, 1.05, 0.95], [1e-3] * 5)  # scatter beyond the fits' errors
    assert error == pytest.approx(math.sqrt(2.0) * np.std([1.0, 1.1, 0.9, 1.05, 0.95], ddof=1) / math.sqrt(5))
    assert _mean_of_values([3.0], [0.2]) == (3.0, pytest.approx(0.2))
    assert _mean_of_values([1.0, 2.0], [1e-3, 1e-3])[1] == pytest.approx(1.0)


def test_the_published_records(reference):
    found = measured_modes(fit_trials(read_records(reference)))
    for read, published in zip(found, PUBLISHED_MODES, strict=True):
        assert read.deviation == pytest.approx(published.deviation, rel=0.02), read.name
        if read.name.startswith("frequency"):
            assert read.value == pytest.approx(published.value, rel=3e-3)
