"""Modes of records against closed forms, their covariance against many records."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import lfilter

from calibration.dynamics.modal_identification import identify_modes
from calibration.errors import ExperimentDataError
from tests.calibration.decays import free_decay

Float = NDArray[np.float64]

RATE = 100.0
STIFFNESS = 4000.0 * np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
RATIO = np.array([0.01, 0.012, 0.015])
SQUARES, SHAPES = np.linalg.eigh(STIFFNESS)
OMEGA = np.sqrt(SQUARES)
FREQUENCY = OMEGA / (2.0 * np.pi)
BANDS = np.outer(FREQUENCY, (0.85, 1.15))
TRUE = np.column_stack([FREQUENCY, RATIO, (SHAPES[1:] / SHAPES[0]).T])

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
    errors = np.array([(one.value - TRUE) / one.standard_error for one in found])
    assert 0.6 < np.mean(errors**2) < 1.6
    assert np.mean(np.abs(errors) < 1.96) > 0.88
    # the shape of one mode at two places errs together, and the covariance knows
    white = [
        np.linalg.solve(np.linalg.cholesky(one.covariance[mode]), one.value[mode] - TRUE[mode])
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


def test_a_record_without_noise_is_told_to_all_digits():
    """A free decay of one channel, sampled from its closed form."""
    time = np.arange(400) / RATE
    found = identify_modes(free_decay(time, 5.0, 0.02), RATE, [[4.0, 6.0], [20.0, 30.0]], "decay")
    np.testing.assert_allclose(found.value[0], [5.0, 0.02], rtol=1e-9)
    assert found.standard_error[0, 0] < 1e-6
    assert np.isnan(found.value[1]).all()
    assert np.isnan(found.covariance[1]).all()


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
