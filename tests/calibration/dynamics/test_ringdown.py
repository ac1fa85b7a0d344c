"""Modes of ring-downs and other records: closed forms, noise, edges, bad records; covariances of modes."""

import cmath
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.signal import lfilter

from calibration.dynamics.extremes import refine_by_extremes
from calibration.dynamics.modal_identification import identify_modes
from calibration.dynamics.records import RingDownRecord, read_records
from calibration.dynamics.trials import average, fit_ring_down, fit_trials, prepare
from calibration.errors import ExperimentDataError
from tests.calibration.decays import free_decay

TRUE = ((5.65, 29.97), (0.0281, 0.0717), (0.0115, 0.0137), (0.3, -0.8))

"""Natural frequencies [Hz], damping ratios, amplitudes [V] and phases of two modes."""


def ring_down(time, frequency=TRUE[0], ratio=TRUE[1], amplitude=TRUE[2], phase=TRUE[3], drift=0.0):
    """Return the signal [V] of two modes."""
    modes = zip(frequency, ratio, amplitude, phase, strict=True)
    return 1e-4 + drift * time + sum(free_decay(time, *mode) for mode in modes)


def fitted(time, signal, free=True, width=0.0):
    record = RingDownRecord(time, signal, averaging_width=width)
    return fit_ring_down(record, free=free, start=-1.0)


def test_a_mode_is_recovered_from_averages():
    width = 0.0081
    fine = np.arange(0.0, 6.5, width / 400.0) + 0.5 * width / 400.0
    columns = fine.size // 400
    signal = ring_down(fine)[: columns * 400].reshape(columns, 400).mean(axis=1)
    time = width * (np.arange(columns) + 0.5)
    _, second = fitted(time, signal, width=width).modes
    assert second.frequency == pytest.approx(29.97, rel=1e-6)
    assert second.damping_ratio == pytest.approx(0.0717, rel=1e-5)
    # Amplitudes refer to the first sample; without the averaging mode 2 would lack 9 %.
    amplitude = 0.0137 * math.exp(-0.0717 * 2.0 * math.pi * 29.97 * time[0])
    assert second.amplitude == pytest.approx(amplitude, rel=1e-4)


def test_a_fast_record_is_decimated_and_cropped():
    time = np.arange(0, 400_000) / 100_000.0
    noise = 1e-4 * np.random.default_rng(4).standard_normal(time.size)
    record = RingDownRecord(time, ring_down(time) + noise)
    prepared = prepare(record)
    assert prepared.sampling_rate == pytest.approx(2000.0)
    assert prepared.time[0] > 0.00548
    printed = RingDownRecord(np.round(time, 4), record.signal)  # to few digits, which is even enough
    for fit in (fit_ring_down(shown, free=True) for shown in (record, printed)):
        assert fit.modes[0].frequency == pytest.approx(5.65, rel=1e-4)
        assert fit.modes[1].frequency == pytest.approx(29.97, rel=1e-3)
        assert fit.modes[1].damping_ratio == pytest.approx(0.0717, rel=1e-2)


@pytest.mark.parametrize(("seconds", "ratio"), [(4.0, TRUE[1]), (0.5, (0.2, 0.0717))])
def test_standard_errors_are_those_of_the_linearised_signal(seconds, ratio):
    """By differences; in the short record decay rate and frequency of the first mode are correlated."""
    time, noise, step = np.arange(0.0, seconds, 1.0 / 500.0), 1e-4, 1e-5
    generator = np.random.default_rng(3)
    signal = ring_down(time, ratio=ratio) + noise * generator.standard_normal(time.size)
    fit = fitted(time, signal)
    waves = [
        (mode.frequency, mode.damping_ratio, mode.amplitude, cmath.phase(mode.wave)) for mode in fit.modes
    ]
    true = np.transpose(waves).ravel()
    columns = [
        (ring_down(time, *(true + shift).reshape(4, 2)) - ring_down(time, *(true - shift).reshape(4, 2)))
        / step
        for shift in 0.5 * step * np.eye(8)
    ]
    slopes = np.column_stack([*columns, np.ones(time.size), time])  # with offset and drift
    expected = fit.residual_deviation * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))[:4]
    assert fit.residual_deviation == pytest.approx(noise, rel=0.1)
    rest = np.linalg.norm(signal - fit.fitted)
    assert fit.residual_deviation == pytest.approx(rest / math.sqrt(time.size - 10), rel=1e-9)
    found = [mode.standard_error[name] for name in ("frequency", "damping_ratio") for mode in fit.modes]
    assert found == pytest.approx(expected, rel=1e-4)


@settings(max_examples=25, deadline=None)
@given(
    first=st.floats(3.0, 9.0),
    second=st.floats(20.0, 55.0),
    ratios=st.tuples(st.floats(0.02, 0.05), st.floats(0.005, 0.04)),
    share=st.floats(1.0, 3.0),
    phase=st.floats(-3.1, 3.1),
)
@example(first=5.65, second=29.97, ratios=TRUE[1], share=1.2, phase=0.3)
def test_any_two_separate_modes_are_recovered(first, second, ratios, share, phase):
    """With their waves, beside an offset and a drift, which are no mode."""
    time = np.arange(0.0, 6.0, 1.0 / 200.0)
    fit = fitted(time, ring_down(time, (first, second), ratios, (0.01, 0.01 * share), (phase, 1.0), -2e-5))
    assert [m.frequency for m in fit.modes] == pytest.approx([first, second], rel=1e-5)
    assert [m.damping_ratio for m in fit.modes] == pytest.approx(ratios, rel=1e-4)
    assert [m.amplitude for m in fit.modes] == pytest.approx([0.01, 0.01 * share], rel=1e-4)
    assert [cmath.phase(m.wave) for m in fit.modes] == pytest.approx([phase, 1.0], abs=1e-4)
    assert fit.modes[0].damped_frequency == pytest.approx(first * math.sqrt(1.0 - ratios[0] ** 2), rel=1e-5)
    assert fit.residual_deviation < 1e-7


TIME = np.arange(0.0, 4.0, 1.0 / 200.0)

GOOD = ring_down(TIME)


DRAWN, SHORT = np.random.default_rng(330), np.arange(0.0, 3.0, 1.0 / 125.0)
GONE = 0.1 * DRAWN.standard_normal(SHORT.size) + sum(
    np.exp(-rate * SHORT) * np.cos(2.0 * np.pi * frequency * SHORT)
    for rate, frequency in zip((13.46484375, 15.625), DRAWN.uniform(0.5, 60.0, 2), strict=True)
)
"""A wave that is gone."""
FROM_100 = np.arange(TIME.size) >= 100


@pytest.mark.parametrize(
    ("time", "signal", "start", "words"),
    [
        (TIME, 0.01 * np.cos(2 * np.pi * 5.65 * TIME) + 0.01 * np.cos(2 * np.pi * 30.0 * TIME), -1.0,
         "does not decay"),
        (TIME, GOOD[::-1], -1.0, "does not decay"),
        (TIME, 0.01 * np.exp(-TIME) * np.cos(2.0 * np.pi * 5.65 * TIME), -1.0, "two spectral peaks"),
        (TIME, 0.01 * np.exp(-TIME), -1.0, "oscillation"),
        (TIME, np.random.default_rng(0).standard_normal(TIME.size), -1.0, "does not decay"),
        (TIME, ring_down(TIME, amplitude=(0.01, 3e-5), ratio=(0.05, -0.006)), -1.0, "decay"),  # a mode grows
        (SHORT, GONE, -1.0, "mode 2 at 44.9 Hz is not a decaying oscillation"),
        (1e3 * TIME, GOOD, -1.0, "shows nothing above"),
        (1e-6 * TIME, GOOD, -1.0, "too short"),
        (TIME, GOOD, 3.5, "remain"),
        (TIME, np.clip(GOOD, -0.008, 0.008), -1.0, "clipped"),
        (TIME, np.zeros(TIME.size), -1.0, "constant"),
        (TIME[:20], GOOD[:20], -1.0, "at least 64"),
        (TIME + 0.1 * FROM_100, GOOD, -1.0, "after sample 100"),
        (TIME[::-1], GOOD, -1.0, "even steps"),
    ],
)  # fmt: skip
def test_records_that_cannot_be_fitted(time, signal, start, words):
    with pytest.raises(ExperimentDataError, match=words):
        fit_ring_down(RingDownRecord(time, signal), start=start)


@pytest.mark.parametrize(
    ("header", "columns", "width"),
    [
        ("chordwise (V),time (s),spanwise [V]", [0.1 * GOOD, TIME, GOOD], 0.0),
        ("# t_s,V_low,V_mid,V_high  (from a plot)", [TIME, GOOD - 1e-4, GOOD, GOOD + 1e-4], 0.005),
    ],
)
def test_layouts_of_files(tmp_path, header, columns, width):
    """The authors' own is in the folder of a laboratory, in `test_lab_files.py`."""
    file = tmp_path / "trial.csv"
    np.savetxt(file, np.transpose(columns), "%.9g", ",", header=header, comments="", encoding="utf-8")
    (record,) = read_records(file)
    assert record.signal == pytest.approx(GOOD, abs=1e-9)
    assert record.averaging_width == pytest.approx(width)


# ---------------------------------------------------------------- the extremes of a drawn record


WIDTH = 0.00811


def drawn():
    """A signal of two modes drawn with a line 0.4 mV wide in columns of pixels."""
    fine = np.arange(0.0, 6.4, WIDTH / 64.0)
    signal = ring_down(fine, amplitude=(0.0115, 0.018), phase=(0.2, 2.0))
    columns = fine.size // 64
    table = signal[: 64 * columns].reshape(columns, 64)
    lowest, highest = table.min(axis=1) - 2e-4, table.max(axis=1) + 2e-4
    time = WIDTH * (np.arange(columns) + 0.5)
    return RingDownRecord(time, 0.5 * (lowest + highest), lowest, highest, WIDTH)


def test_damping_of_a_drawn_signal():
    record = drawn()
    trials = fit_trials([record])
    refined = refine_by_extremes(trials)
    first, second = refined[0].modes
    assert first.damping_ratio == pytest.approx(0.0281, rel=0.02)
    # The spectral peak of a mode damped by 7 % lies a little off its frequency.
    assert second.damping_ratio == pytest.approx(0.0717, rel=0.10)
    assert second.damped_frequency == trials[0].modes[1].damped_frequency
    middle = abs(average(trials, "damping_ratio", 1).mean / 0.0717 - 1.0)
    assert abs(second.damping_ratio / 0.0717 - 1.0) <= middle + 0.02
    assert 0.0 < second.standard_error["damping_ratio"] < 0.02
    with pytest.raises(ExperimentDataError, match="no lowest and highest"):
        refine_by_extremes(fit_trials([RingDownRecord(record.time, record.signal)]))
    with pytest.raises(ExperimentDataError, match="no ring-down record"):
        fit_trials([])


# ---------------------------------------------------------------- modes of records


RATE = 100.0
STIFFNESS = 4000.0 * np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
RATIO = np.array([0.01, 0.012, 0.015])
SQUARES, SHAPES = np.linalg.eigh(STIFFNESS)
OMEGA = np.sqrt(SQUARES)
FREQUENCY = OMEGA / (2.0 * np.pi)
BANDS = np.outer(FREQUENCY, (0.85, 1.15))
MODES = np.column_stack([FREQUENCY, RATIO, (SHAPES[1:] / SHAPES[0]).T])

POLE = np.exp((-0.0003 + 1j) * 2.0 * np.pi * 5.0 / RATE)
LONG = lfilter([1.0], [1.0, -2.0 * POLE.real, abs(POLE) ** 2], np.random.default_rng(3).standard_normal(8000))
"""A mode that remembers a minute, in 80 s."""


def record(kind, seed):
    """Accelerations of a chain of three masses, shaken by white noise or let go, with noise."""
    random = np.random.default_rng(seed)
    damping = SHAPES @ np.diag(2.0 * RATIO * OMEGA) @ SHAPES.T
    motion = np.block([[np.zeros((3, 3)), np.eye(3)], [-STIFFNESS, -damping]])
    step = expm(motion / RATE)
    eigenvalue, vector = np.linalg.eig(step)
    if kind == "ambient":
        force = random.standard_normal((20_000, 3))
        entering = np.linalg.solve(motion, (step - np.eye(6))[:, 3:])
        driven = force @ np.linalg.solve(vector, entering).T
        modal = np.stack(
            [lfilter([1.0], [1.0, -value], driven[:, n]) for n, value in enumerate(eigenvalue)], 1
        )
        seen = (modal @ vector.T).real @ motion[3:].T + force
        return seen + 0.1 * seen.std(axis=0) * random.standard_normal(seen.shape)
    begin = np.linalg.solve(vector, np.array([0.0, 0.0, 0.0, 1.0, 0.3, -0.2]))
    modal = begin * eigenvalue ** np.arange(1500)[:, None]
    seen = (modal @ vector.T).real @ motion[3:].T
    return seen + 0.2 * random.standard_normal(seen.shape) + 3.0


@pytest.mark.parametrize(("kind", "count"), [("ambient", 14), ("decay", 14)])
def test_errors_are_those_of_the_records(kind, count):
    """Squared errors over their variances have a mean of one; 500 records of each kind gave 0.8 to 1.2."""
    found = [identify_modes(record(kind, seed), RATE, BANDS, kind) for seed in range(count)]
    errors = np.array([(one.value - MODES) / one.standard_error for one in found])
    assert 0.6 < np.mean(errors**2) < 1.6
    assert np.mean(np.abs(errors) < 1.96) > 0.88
    # the shape of one mode at two places errs together, and the covariance knows
    white = [
        np.linalg.solve(np.linalg.cholesky(one.covariance[mode]), one.value[mode] - MODES[mode])
        for one in found
        for mode in range(3)
    ]
    assert 0.6 < np.mean(np.square(white)) < 1.6


@pytest.mark.parametrize(("kind", "samples"), [("ambient", 8000), ("decay", 1500)])
@pytest.mark.parametrize("channels", [1, 3])
def test_noise_alone_has_no_mode(kind, samples, channels):
    """At 1e-3 over all frequencies: 200 records of each gave none."""
    for seed in range(8):
        noise = np.random.default_rng([seed, channels]).standard_normal((samples, channels))
        found = identify_modes(noise, RATE, BANDS, kind)
        assert np.isnan(found.value).all(), seed


@pytest.mark.parametrize("kind", ["ambient", "decay"])
def test_a_band_without_a_mode_stays_empty_beside_one_with(kind):
    pole = np.exp((-0.01 + 1j) * OMEGA[0] / RATE)
    for seed in range(4):
        random = np.random.default_rng(seed)
        if kind == "ambient":
            moved = lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], random.standard_normal(20_000))
        else:
            moved = (pole ** np.arange(1500)).real
        seen = moved[:, None] * [1.0, 0.8, 0.5]
        seen += 0.2 * seen.std() * random.standard_normal(seen.shape)
        found = identify_modes(seen, RATE, BANDS, kind)
        assert np.isfinite(found.value[0]).all()
        assert np.isnan(found.value[1:]).all()


@pytest.mark.parametrize(
    ("record_of", "bands", "sentence"),
    [
        (LONG, [[4.0, 6.0]], "a mode dies away in .* less than 10 times"),
        (np.full((5000, 2), np.nan), [[1.0, 2.0]], "finite numbers"),
        (np.linspace(0.0, 1.0, 100), [[1.0, 2.0]], "has 100 samples"),
        (np.zeros((5000, 1)), [[2.0, 1.0]], "its least and its largest"),
        (np.zeros((5000, 1)), [[40.0, 60.0]], "nothing above 50 Hz"),
        (np.zeros((5000, 1)), [[1.0, 4.0]], "accelerometer 1 of the record shows one value"),
        (np.zeros((5000, 1)), [[1.0, 2.0]] * 13, "12 modes are identified at most"),
        (np.ones((5000, 1)), [[1.0, 2.0], [1.9, 3.0]], "bands overlap"),
    ],
)
def test_what_cannot_be_told_is_refused(record_of, bands, sentence):
    with pytest.raises(ExperimentDataError, match=sentence):
        identify_modes(record_of, RATE, bands)
