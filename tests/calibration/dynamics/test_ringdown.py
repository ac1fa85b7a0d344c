"""Modes of ring-downs: closed forms, standard errors, drawn records, bad records."""

import cmath
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from calibration.dynamics.extremes import refine_by_extremes
from calibration.dynamics.records import RingDownRecord, read_records
from calibration.dynamics.trials import average, fit_ring_down, fit_trials, prepare
from calibration.errors import ExperimentDataError
from tests.calibration.decays import free_decay

FREQUENCIES = (5.65, 29.97)
"""Natural frequencies of the two modes [Hz]."""
DAMPING_RATIOS = (0.0281, 0.0717)
AMPLITUDES = (0.0115, 0.0137)
"""Amplitudes of the two modes [V]."""
PHASES = (0.3, -0.8)
FROM_FIRST_SAMPLE = -1.0
"""A start before all samples: none is cropped."""


def ring_down(
    time,
    frequency=FREQUENCIES,
    ratio=DAMPING_RATIOS,
    amplitude=AMPLITUDES,
    phase=PHASES,
    drift=0.0,
):
    """Return the signal [V] of two modes, with an offset and a drift [V/s]."""
    modes = zip(frequency, ratio, amplitude, phase, strict=True)
    return 1e-4 + drift * time + sum(free_decay(time, *mode) for mode in modes)


def fit_record(time, signal, width=0.0):
    """Return the fit of all samples, with free frequencies."""
    record = RingDownRecord(time, signal, averaging_width=width)
    return fit_ring_down(record, frequencies_fitted=True, start=FROM_FIRST_SAMPLE)


def test_a_masked_sample_is_lost():
    signal = np.ma.masked_equal(np.append(ring_down(np.arange(499) * 0.001), -9999.0), -9999.0)

    with pytest.raises(ExperimentDataError, match="sample 500 is lost"):
        RingDownRecord(np.arange(500) * 0.001, signal)


# ---------------------------------------------------------------- modes are recovered


def test_a_mode_is_recovered_from_averages():
    width = 0.0081
    fine_time = np.arange(0.0, 6.5, width / 400.0) + 0.5 * width / 400.0
    columns = fine_time.size // 400
    fine_signal = ring_down(fine_time)[: columns * 400]
    signal = fine_signal.reshape(columns, 400).mean(axis=1)
    time = width * (np.arange(columns) + 0.5)

    _, second = fit_record(time, signal, width=width).modes

    # Amplitudes refer to the first sample; without the averaging mode 2 would lack 9 %.
    amplitude = 0.0137 * math.exp(-0.0717 * 2.0 * math.pi * 29.97 * time[0])
    assert second.frequency == pytest.approx(29.97, rel=1e-6)
    assert second.damping_ratio == pytest.approx(0.0717, rel=1e-5)
    assert second.amplitude == pytest.approx(amplitude, rel=1e-4)


@settings(max_examples=25, deadline=None)
@given(
    first=st.floats(3.0, 9.0),
    second=st.floats(20.0, 55.0),
    ratios=st.tuples(st.floats(0.02, 0.05), st.floats(0.005, 0.04)),
    amplitude_ratio=st.floats(1.0, 3.0),
    phase=st.floats(-3.1, 3.1),
)
@example(first=5.65, second=29.97, ratios=DAMPING_RATIOS, amplitude_ratio=1.2, phase=0.3)
def test_any_two_separate_modes_are_recovered(first, second, ratios, amplitude_ratio, phase):
    """With their waves, beside an offset and a drift, which are no mode."""
    time = np.arange(0.0, 6.0, 1.0 / 200.0)
    frequencies = (first, second)
    amplitudes = (0.01, 0.01 * amplitude_ratio)
    phases = (phase, 1.0)

    fit = fit_record(time, ring_down(time, frequencies, ratios, amplitudes, phases, drift=-2e-5))

    expected = zip(frequencies, ratios, amplitudes, phases, strict=True)
    for mode, values in zip(fit.modes, expected, strict=True):
        assert_mode(mode, *values)
    assert fit.residual_deviation < 1e-7


def assert_mode(mode, frequency, ratio, amplitude, phase):
    """Compare a fitted mode with the one that a signal has."""
    assert mode.frequency == pytest.approx(frequency, rel=1e-5)
    assert mode.damping_ratio == pytest.approx(ratio, rel=1e-4)
    assert mode.amplitude == pytest.approx(amplitude, rel=1e-4)
    assert cmath.phase(mode.wave) == pytest.approx(phase, abs=1e-4)
    damped_frequency = frequency * math.sqrt(1.0 - ratio**2)
    assert mode.damped_frequency == pytest.approx(damped_frequency, rel=1e-5)


# ---------------------------------------------------------------- fast records


@pytest.fixture(scope="module")
def fast_record():
    """100,000 samples a second for 4 s, with noise."""
    time = np.arange(0, 400_000) / 100_000.0
    noise = 1e-4 * np.random.default_rng(4).standard_normal(time.size)
    return RingDownRecord(time, ring_down(time) + noise)


def test_a_fast_record_is_decimated_and_cropped(fast_record):
    prepared = prepare(fast_record)

    assert prepared.sampling_rate == pytest.approx(2000.0)
    assert prepared.time[0] > 0.00548


@pytest.mark.parametrize("digits", [None, 4])  # stamps printed to few digits are even enough
def test_modes_of_a_fast_record_are_recovered(fast_record, digits):
    time = fast_record.time if digits is None else np.round(fast_record.time, digits)

    first, second = fit_ring_down(
        RingDownRecord(time, fast_record.signal), frequencies_fitted=True
    ).modes

    assert first.frequency == pytest.approx(5.65, rel=1e-4)
    assert second.frequency == pytest.approx(29.97, rel=1e-3)
    assert second.damping_ratio == pytest.approx(0.0717, rel=1e-2)


# ---------------------------------------------------------------- standard errors

NOISE = 1e-4
"""Standard deviation of the noise [V]."""


@dataclass(frozen=True)
class NoisyFit:
    """The fit of a signal with noise."""

    time: NDArray[np.float64]
    signal: NDArray[np.float64]
    fit: object


@pytest.fixture(
    scope="module",
    params=[(4.0, DAMPING_RATIOS), (0.5, (0.2, 0.0717))],
    ids=["long", "short and damped"],
)
def noisy_fit(request):
    """In the short record decay rate and frequency of the first mode are correlated."""
    seconds, ratios = request.param
    time = np.arange(0.0, seconds, 1.0 / 500.0)
    noise = NOISE * np.random.default_rng(3).standard_normal(time.size)
    signal = ring_down(time, ratio=ratios) + noise
    return NoisyFit(time, signal, fit_record(time, signal))


def test_the_residual_deviation_is_the_noise(noisy_fit):
    residual = np.linalg.norm(noisy_fit.signal - noisy_fit.fit.fitted)
    degrees_of_freedom = noisy_fit.time.size - 10  # four of each mode, offset and drift

    deviation = noisy_fit.fit.residual_deviation

    assert deviation == pytest.approx(NOISE, rel=0.1)
    assert deviation == pytest.approx(residual / math.sqrt(degrees_of_freedom), rel=1e-9)


def derivatives_of_ring_down(time, parameters, step=1e-5):
    """Return the derivatives (N, 8) of the signal by its parameters, by central differences.

    Parameters are frequencies, damping ratios, amplitudes and phases of both modes.
    """
    columns = []
    for shift in 0.5 * step * np.eye(8):
        ahead = ring_down(time, *(parameters + shift).reshape(4, 2))
        behind = ring_down(time, *(parameters - shift).reshape(4, 2))
        columns.append((ahead - behind) / step)
    return np.column_stack(columns)


def test_standard_errors_are_those_of_the_linearised_signal(noisy_fit):
    modes = noisy_fit.fit.modes
    time = noisy_fit.time
    waves = [
        (mode.frequency, mode.damping_ratio, mode.amplitude, cmath.phase(mode.wave))
        for mode in modes
    ]
    derivatives = derivatives_of_ring_down(time, np.transpose(waves).ravel())
    slopes = np.column_stack([derivatives, np.ones(time.size), time])  # with offset and drift
    variance = np.diag(np.linalg.inv(slopes.T @ slopes))
    expected = noisy_fit.fit.residual_deviation * np.sqrt(variance[:4])

    frequency_errors = [mode.standard_error["frequency"] for mode in modes]
    ratio_errors = [mode.standard_error["damping_ratio"] for mode in modes]

    assert frequency_errors + ratio_errors == pytest.approx(expected, rel=1e-4)


# ---------------------------------------------------------------- records that cannot be fitted

TIME = np.arange(0.0, 4.0, 1.0 / 200.0)
GOOD_SIGNAL = ring_down(TIME)
IS_AFTER_SAMPLE_100 = np.arange(TIME.size) >= 100


def wave_of(frequency):
    """Return a wave that does not decay."""
    return 0.01 * np.cos(2 * np.pi * frequency * TIME)


SHORT_TIME = np.arange(0.0, 3.0, 1.0 / 125.0)


def signal_that_dies_at_once():
    """Return two waves that are gone after a tenth of a second, in noise."""
    random = np.random.default_rng(330)
    noise = 0.1 * random.standard_normal(SHORT_TIME.size)
    first_frequency, second_frequency = random.uniform(0.5, 60.0, 2)
    first = np.exp(-13.46484375 * SHORT_TIME) * np.cos(2.0 * np.pi * first_frequency * SHORT_TIME)
    second = np.exp(-15.625 * SHORT_TIME) * np.cos(2.0 * np.pi * second_frequency * SHORT_TIME)
    return noise + (first + second)


class BadRecord(NamedTuple):
    """A record that is refused, and the sentence that says so."""

    sentence: str
    signal: NDArray[np.float64]
    time: NDArray[np.float64] = TIME
    start: float = FROM_FIRST_SAMPLE


BAD_RECORDS = {
    "waves without decay": BadRecord("does not decay", wave_of(5.65) + wave_of(30.0)),
    "a signal that grows": BadRecord("does not decay", GOOD_SIGNAL[::-1]),
    "one mode": BadRecord("two spectral peaks", np.exp(-TIME) * wave_of(5.65)),
    "no wave": BadRecord("oscillation", 0.01 * np.exp(-TIME)),
    "noise": BadRecord("does not decay", np.random.default_rng(0).standard_normal(TIME.size)),
    "a mode that grows": BadRecord(
        "decay", ring_down(TIME, amplitude=(0.01, 3e-5), ratio=(0.05, -0.006))
    ),
    "waves that are gone": BadRecord(
        "mode 2 at 44.9 Hz is not a decaying oscillation",
        signal_that_dies_at_once(),
        time=SHORT_TIME,
    ),
    "milliseconds": BadRecord("shows nothing above", GOOD_SIGNAL, time=1e3 * TIME),
    "megaseconds": BadRecord("too short", GOOD_SIGNAL, time=1e-6 * TIME),
    "a late start": BadRecord("remain", GOOD_SIGNAL, start=3.5),
    "clipped": BadRecord("clipped", np.clip(GOOD_SIGNAL, -0.008, 0.008)),
    "zeros": BadRecord("constant", np.zeros(TIME.size)),
    "few samples": BadRecord("at least 64", GOOD_SIGNAL[:20], time=TIME[:20]),
    "a gap": BadRecord("after sample 100", GOOD_SIGNAL, time=TIME + 0.1 * IS_AFTER_SAMPLE_100),
    "time that runs back": BadRecord("must increase in equal steps", GOOD_SIGNAL, time=TIME[::-1]),
}


@pytest.mark.parametrize("name", BAD_RECORDS)
def test_a_bad_record_is_refused_with_its_reason(name):
    bad = BAD_RECORDS[name]

    with pytest.raises(ExperimentDataError, match=bad.sentence):
        fit_ring_down(RingDownRecord(bad.time, bad.signal), start=bad.start)


def test_no_records_have_no_fit():
    with pytest.raises(ExperimentDataError, match="no ring-down record"):
        fit_trials([])


# ---------------------------------------------------------------- files


@pytest.mark.parametrize(
    ("header", "columns", "width"),
    [
        ("chordwise (V),time (s),spanwise [V]", [0.1 * GOOD_SIGNAL, TIME, GOOD_SIGNAL], 0.0),
        (
            "# t_s,V_low,V_mid,V_high  (from a plot)",
            [TIME, GOOD_SIGNAL - 1e-4, GOOD_SIGNAL, GOOD_SIGNAL + 1e-4],
            0.005,
        ),
    ],
    ids=["of a laboratory", "digitised"],
)
def test_layouts_of_files_are_read(tmp_path, header, columns, width):
    """The authors' own layout is in the folder of a laboratory, in `test_lab_files.py`."""
    file = tmp_path / "trial.csv"
    np.savetxt(
        file, np.transpose(columns), "%.9g", ",", header=header, comments="", encoding="utf-8"
    )

    (record,) = read_records(file)

    assert record.signal == pytest.approx(GOOD_SIGNAL, abs=1e-9)
    assert record.averaging_width == pytest.approx(width)


# ---------------------------------------------------------------- the extremes of a drawn record

WIDTH = 0.00811
"""Time of a column of pixels [s]."""


@pytest.fixture(scope="module")
def drawn_record():
    """A signal of two modes that is drawn with a line 0.4 mV wide in columns of pixels."""
    fine_time = np.arange(0.0, 6.4, WIDTH / 64.0)
    fine_signal = ring_down(fine_time, amplitude=(0.0115, 0.018), phase=(0.2, 2.0))
    columns = fine_time.size // 64
    table = fine_signal[: 64 * columns].reshape(columns, 64)
    lowest = table.min(axis=1) - 2e-4
    highest = table.max(axis=1) + 2e-4
    time = WIDTH * (np.arange(columns) + 0.5)
    return RingDownRecord(time, 0.5 * (lowest + highest), lowest, highest, WIDTH)


@pytest.fixture(scope="module")
def trials_by_middles(drawn_record):
    """The fit of the middles between the extremes."""
    return fit_trials([drawn_record])


@pytest.fixture(scope="module")
def modes_by_extremes(trials_by_middles):
    """The two modes by lowest and highest values."""
    (trial,) = refine_by_extremes(trials_by_middles)
    return trial.modes


def test_extremes_of_a_drawn_signal_have_its_damping(modes_by_extremes):
    first, second = modes_by_extremes

    assert first.damping_ratio == pytest.approx(0.0281, rel=0.02)
    # The spectral peak of a mode damped by 7 % lies a little off its frequency.
    assert second.damping_ratio == pytest.approx(0.0717, rel=0.10)


def test_extremes_keep_the_frequency_of_the_fit(trials_by_middles, modes_by_extremes):
    (trial,) = trials_by_middles
    _, second_by_middles = trial.modes
    _, second = modes_by_extremes

    assert second.damped_frequency == second_by_middles.damped_frequency


def test_extremes_are_no_worse_than_the_middles(trials_by_middles, modes_by_extremes):
    _, second = modes_by_extremes
    by_middles = average(trials_by_middles, "damping_ratio", 1).mean

    error_by_middles = abs(by_middles / 0.0717 - 1.0)
    assert abs(second.damping_ratio / 0.0717 - 1.0) <= error_by_middles + 0.02


def test_damping_by_extremes_has_a_standard_error(modes_by_extremes):
    _, second = modes_by_extremes

    assert 0.0 < second.standard_error["damping_ratio"] < 0.02


def test_a_record_without_extremes_cannot_be_refined(drawn_record):
    trials = fit_trials([RingDownRecord(drawn_record.time, drawn_record.signal)])

    with pytest.raises(ExperimentDataError, match="no lowest and highest"):
        refine_by_extremes(trials)
