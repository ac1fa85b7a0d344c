"""Modes of accelerations under white noise or after a release, and covariances of these modes."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import lfilter

from calibration.dynamics.modal_identification import identify_modes
from calibration.errors import ExperimentDataError

SAMPLING_RATE = 100.0
STIFFNESS = 4000.0 * np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
DAMPING_RATIOS = np.array([0.01, 0.012, 0.015])
SQUARES, SHAPES = np.linalg.eigh(STIFFNESS)
OMEGA = np.sqrt(SQUARES)
FREQUENCIES = OMEGA / (2.0 * np.pi)
BANDS = np.outer(FREQUENCIES, (0.85, 1.15))
MODES = np.column_stack([FREQUENCIES, DAMPING_RATIOS, (SHAPES[1:] / SHAPES[0]).T])
"""A row of frequency, damping ratio and shape at two places for each mode."""


def first_order_filter(pole, signal):
    """Return the response of y[k] = pole y[k - 1] + u[k]."""
    return lfilter([1.0], [1.0, -pole], signal)


def oscillator_filter(pole, signal):
    """Return the response of an oscillator with a pair of conjugate poles."""
    return lfilter([1.0], [1.0, -2.0 * pole.real, abs(pole) ** 2], signal)


@dataclass(frozen=True)
class Chain:
    """A chain of three masses in modal coordinates of one step.

    Attributes
    ----------
    motion : (6, 6) array
        Matrix of (x, v)'.
    step : (6, 6) array
        The same over one sample.
    poles, vectors : (6,), (6, 6) array
        Eigenvalues and eigenvectors of the step.
    """

    motion: NDArray[np.float64]
    step: NDArray[np.float64]
    poles: NDArray[np.complex128]
    vectors: NDArray[np.complex128]

    def accelerations(self, modal):
        """Return the accelerations (N, 3) without those of forces, given modal states (N, 6)."""
        return (modal @ self.vectors.T).real @ self.motion[3:].T


def make_chain():
    damping = SHAPES @ np.diag(2.0 * DAMPING_RATIOS * OMEGA) @ SHAPES.T
    motion = np.block([[np.zeros((3, 3)), np.eye(3)], [-STIFFNESS, -damping]])
    step = expm(motion / SAMPLING_RATE)
    poles, vectors = np.linalg.eig(step)
    return Chain(motion=motion, step=step, poles=poles, vectors=vectors)


CHAIN = make_chain()


def record_ambient(seed):
    """Return accelerations of the chain under white noise at each mass, with noise of 10 %."""
    random = np.random.default_rng(seed)
    force = random.standard_normal((20_000, 3))
    input_matrix = np.linalg.solve(CHAIN.motion, (CHAIN.step - np.eye(6))[:, 3:])
    driven = force @ np.linalg.solve(CHAIN.vectors, input_matrix).T
    modal = [
        first_order_filter(pole, drive) for pole, drive in zip(CHAIN.poles, driven.T, strict=True)
    ]
    acceleration = CHAIN.accelerations(np.stack(modal, axis=1)) + force
    noise = 0.1 * acceleration.std(axis=0) * random.standard_normal(acceleration.shape)
    return acceleration + noise


def record_decay(seed):
    """Return accelerations of the chain after a push, with noise and an offset."""
    random = np.random.default_rng(seed)
    start = np.linalg.solve(CHAIN.vectors, np.array([0.0, 0.0, 0.0, 1.0, 0.3, -0.2]))
    modal = start * CHAIN.poles ** np.arange(1500)[:, None]
    acceleration = CHAIN.accelerations(modal)
    return acceleration + 0.2 * random.standard_normal(acceleration.shape) + 3.0


RECORDERS = {"ambient": record_ambient, "decay": record_decay}
SAMPLES = {"ambient": 8000, "decay": 1500}


# ---------------------------------------------------------------- errors


@dataclass(frozen=True)
class Estimates:
    """Modes of several records of one kind, and their errors."""

    modes: list

    @property
    def standardised_errors(self):
        """Errors over their standard errors."""
        return np.array([(mode.value - MODES) / mode.standard_error for mode in self.modes])

    @property
    def whitened_errors(self):
        """Errors of the values of a mode, made independent by their covariance."""
        whitened = []
        for estimate in self.modes:
            for value, true, covariance in zip(
                estimate.value, MODES, estimate.covariance, strict=True
            ):
                whitened.append(np.linalg.solve(np.linalg.cholesky(covariance), value - true))
        return np.array(whitened)


@pytest.fixture(scope="module", params=RECORDERS)
def estimates(request):
    record = RECORDERS[request.param]
    return Estimates(
        [identify_modes(record(seed), SAMPLING_RATE, BANDS, request.param) for seed in range(14)]
    )


def test_squared_errors_are_as_large_as_their_variances(estimates):
    """They have a mean of one; 500 records of each kind gave 0.8 to 1.2."""
    assert 0.6 < np.mean(estimates.standardised_errors**2) < 1.6


def test_nearly_all_errors_lie_within_two_standard_errors(estimates):
    is_within = np.abs(estimates.standardised_errors) < 1.96

    assert np.mean(is_within) > 0.88


def test_errors_of_a_mode_are_correlated_as_the_covariance_has_it(estimates):
    """The shape of one mode at two places errs together."""
    assert 0.6 < np.mean(np.square(estimates.whitened_errors)) < 1.6


# ---------------------------------------------------------------- no mode


@pytest.mark.parametrize("kind", RECORDERS)
@pytest.mark.parametrize("channels", [1, 3])
def test_noise_alone_has_no_mode(kind, channels):
    """At 1e-3 over all frequencies: 200 records of each gave none."""
    for seed in range(8):
        random = np.random.default_rng([seed, channels])
        noise = random.standard_normal((SAMPLES[kind], channels))

        modes = identify_modes(noise, SAMPLING_RATE, BANDS, kind)

        assert np.isnan(modes.value).all(), seed


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", RECORDERS)
def test_a_band_without_a_mode_stays_empty_beside_one_with(kind, seed):
    random = np.random.default_rng(seed)
    pole = np.exp((-0.01 + 1j) * OMEGA[0] / SAMPLING_RATE)
    if kind == "ambient":
        signal = oscillator_filter(pole, random.standard_normal(20_000))
    else:
        signal = (pole ** np.arange(1500)).real
    record = signal[:, None] * [1.0, 0.8, 0.5]
    record += 0.2 * record.std() * random.standard_normal(record.shape)

    first_mode, *other_modes = identify_modes(record, SAMPLING_RATE, BANDS, kind).value

    assert np.isfinite(first_mode).all()
    assert np.isnan(other_modes).all()


# ---------------------------------------------------------------- what is refused


def slow_mode():
    """Return 80 s of a mode that remembers a minute."""
    pole = np.exp((-0.0003 + 1j) * 2.0 * np.pi * 5.0 / SAMPLING_RATE)
    return oscillator_filter(pole, np.random.default_rng(3).standard_normal(8000))


@pytest.mark.parametrize(
    ("record", "bands", "sentence"),
    [
        (slow_mode(), [[4.0, 6.0]], "a mode decays within .* less than 10 times"),
        (np.full((5000, 2), np.nan), [[1.0, 2.0]], "finite numbers"),
        (np.ma.masked_equal(np.arange(5000.0), 7.0), [[1.0, 2.0]], "finite numbers"),
        (np.linspace(0.0, 1.0, 100), [[1.0, 2.0]], "has 100 samples"),
        (np.zeros((5000, 1)), [[2.0, 1.0]], "two positive frequencies"),
        (np.zeros((5000, 1)), [[40.0, 60.0]], "nothing above 50 Hz"),
        (np.zeros((5000, 1)), [[1.0, 4.0]], "accelerometer 1 of the record shows the same value"),
        (np.zeros((5000, 1)), [[1.0, 2.0]] * 13, "12 modes are identified at most"),
        (np.ones((5000, 1)), [[1.0, 2.0], [1.9, 3.0]], "bands overlap"),
    ],
)
def test_a_record_or_bands_without_an_answer_are_refused(record, bands, sentence):
    with pytest.raises(ExperimentDataError, match=sentence):
        identify_modes(record, SAMPLING_RATE, bands)
