"""The filter with a missing force against Gaussian conditioning on dense matrices."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import lfilter

from discrepancy.missing_force.filtered import Filtered, Process, regression
from discrepancy.missing_force.trial import SeenTrial
from discrepancy.models.interface import PortedSystem

FloatArray = NDArray[np.float64]

FREQUENCY, RATIO, PARTS = 9.0, 0.05, 8
PROCESS = Process(2.0, 0.15)


def oscillator():
    """One mass of 1 kg on a spring: its displacement and its accelerometer, a force at the mass."""
    generator = np.array([[0.0, 1.0], [-(FREQUENCY**2), -2.0 * RATIO * FREQUENCY]])
    return PortedSystem(
        generator, ("mass",), np.array([[0.0, 1.0]]), np.array([[1.0, 0.0]]), np.array([[0.0, 1.0]]),
        np.array([[1.0, 0.0], generator[1]]), np.array([[0.0, 1.0]]),
    )  # fmt: skip


def trial_of(time, residual, *, used=None, deviation=None, local=None, coloured=()):
    """Return a trial without shared unknowns; the residual is over the noise's deviation."""
    count = len(time)
    used = np.ones(residual.shape, dtype=bool) if used is None else used
    local = np.zeros((0, *residual.shape)) if local is None else local
    fine = (count - 1) * PARTS + 1
    return SeenTrial(
        "one", time, residual * used, used, np.array([0.02, 0.6]) if deviation is None else deviation,
        coloured, np.zeros((0, *residual.shape)), local, np.ones(len(local)), oscillator(), (), PARTS,
        np.zeros((fine, 1)), np.zeros((fine, 1)), False,
    )  # fmt: skip


def dense(trial, process, per_second=4000, window=(-np.inf, np.inf)):
    """Return the covariance (N C, N C) of the readings by the force, and of force and readings (N, N C).

    By quadrature of what a kernel over all pairs of moments, those of a window, does to an impulse response;
    nothing is stepped.
    """
    step = 1.0 / per_second
    moments = np.arange(0.0, trial.time[-1] + 0.5 * step, step) + 0.5 * step
    apart = np.abs(moments[:, None] - moments)
    rate = np.sqrt(3.0) / process.time
    kernel = process.size**2 * np.exp(-rate * apart)
    if not process.rough:
        kernel *= 1.0 + rate * apart
    else:
        kernel = process.size**2 * np.exp(-apart / process.time)
    inside = (moments > window[0]) & (moments < window[1])
    kernel *= np.outer(inside, inside)
    answers = np.zeros((len(trial.time), 2, len(moments)))
    nearest = np.zeros((len(trial.time), len(moments)))
    generator = trial.system.generator
    turn = np.sqrt(1.0 - RATIO**2) * FREQUENCY
    for k, now in enumerate(trial.time):
        since = now - moments
        decay = np.where(since > 0.0, np.exp(-RATIO * FREQUENCY * np.maximum(since, 0.0)), 0.0)
        x = -decay * np.sin(turn * since) / turn * step
        v = -decay * (np.cos(turn * since) - RATIO * FREQUENCY / turn * np.sin(turn * since)) * step
        place = np.clip(now / step - 0.5, 0.0, len(moments) - 1.001)
        nearest[k, int(place)], nearest[k, int(place) + 1] = 1.0 - place % 1.0, place % 1.0
        if now in window:  # what begins or ends at a sample does so before it
            nearest[k] = 0.0
            nearest[k, round(now / step)] = 1.0
        answers[k, 0] = x
        answers[k, 1] = generator[1, 0] * x + generator[1, 1] * v - nearest[k]
    rows = (answers / trial.deviation[:, None]).reshape(-1, len(moments))
    return rows @ kernel @ rows.T, nearest @ kernel @ rows.T


@pytest.mark.parametrize("rough", [False, True], ids=["bends", "jumps"])
@pytest.mark.parametrize("uneven", [False, True], ids=["even", "uneven"])
def test_evidence_and_force_are_those_of_dense_conditioning(rough, uneven):
    random = np.random.default_rng(3)
    time = 0.02 * np.arange(40)
    if uneven:
        time = time + np.r_[0.0, random.uniform(-0.006, 0.006, 39)]
    residual = random.standard_normal((40, 2)) * [3.0, 1.0]
    used = random.uniform(size=(40, 2)) > 0.2
    trial = trial_of(time, residual, used=used)
    process = Process(2.0, 0.15, rough)
    filtered = Filtered(trial, {0: process})
    covariance, cross = dense(trial, process)
    at = np.flatnonzero(used.ravel())
    covariance = covariance[np.ix_(at, at)] + np.eye(len(at))
    readings = residual.ravel()[at]
    wanted = -0.5 * readings @ np.linalg.solve(covariance, readings) - 0.5 * np.linalg.slogdet(covariance)[1]
    found = filtered.whitened(trial.residual[None])
    value = -0.5 * float(np.sum(found**2)) - filtered.log_determinant
    assert value == pytest.approx(wanted, abs=0.05 if rough else 0.02)
    force = filtered.smoothed(trial.residual)[1][0]
    mean = cross[:, at] @ np.linalg.solve(covariance, readings)
    np.testing.assert_allclose(force[::PARTS], mean, atol=0.02 * process.size)
    variance = process.size**2 - np.einsum(
        "nk,kn->n", cross[:, at], np.linalg.solve(covariance, cross[:, at].T)
    )
    np.testing.assert_allclose(filtered.deviation(0), np.sqrt(variance), atol=0.02 * process.size)


def test_steady_gains_are_those_of_every_step():
    random = np.random.default_rng(4)
    time = 0.02 * np.arange(900)
    trial = trial_of(time, random.standard_normal((900, 2)))
    filtered = Filtered(trial, {0: PROCESS})
    slots = filtered._passed[1]
    assert slots[-1] < 450  # most steps share one
    jittered = trial_of(time * (1.0 + 1e-12 * np.arange(900)), trial.residual)
    object.__setattr__(jittered, "steps", (np.full(900, 0.02), np.arange(900)))  # as if each were its own
    every = Filtered(jittered, {0: PROCESS})
    assert every._passed[1][-1] == 899
    np.testing.assert_allclose(
        filtered.whitened(trial.residual[None]), every.whitened(trial.residual[None]), atol=1e-7
    )
    np.testing.assert_allclose(
        filtered.smoothed(trial.residual)[1][0], every.smoothed(trial.residual)[1][0], atol=1e-7
    )
    np.testing.assert_allclose(filtered.deviation(0), every.deviation(0), atol=1e-8)


def test_the_state_between_samples_is_that_of_samples_in_between():
    random = np.random.default_rng(5)
    count = 30
    residual = random.standard_normal((count, 2))
    coarse = Filtered(trial_of(0.04 * np.arange(count), residual), {0: PROCESS})
    dense_count = (count - 1) * PARTS + 1
    filled, used = np.zeros((dense_count, 2)), np.zeros((dense_count, 2), dtype=bool)
    filled[::PARTS], used[::PARTS] = residual, True
    fine = Filtered(trial_of(0.04 / PARTS * np.arange(dense_count), filled, used=used), {0: PROCESS})
    added, (force,) = coarse.smoothed(residual)
    other, (again,) = fine.smoothed(filled)
    np.testing.assert_allclose(force, again[::PARTS], atol=1e-9)
    np.testing.assert_allclose(added, other[::PARTS], atol=1e-9)


def test_unknowns_of_a_trial_and_coloured_noise_are_those_of_dense_conditioning():
    random = np.random.default_rng(6)
    time = 0.02 * np.arange(60)
    residual = random.standard_normal((60, 2))
    local = random.standard_normal((2, 60, 2))
    share, rate = 0.8, 12.0
    trial = trial_of(time, residual, local=local, coloured=((0, share, rate),))
    found = regression([Filtered(trial, {0: PROCESS})], [residual], [np.zeros((0, 60, 2))])
    value = -0.5 * found.products[0, 0] - found.log_determinant
    covariance, _ = dense(trial, PROCESS)
    noise = np.eye(120)
    first = np.arange(0, 120, 2)
    decay = share * np.exp(-rate * np.abs(time[:, None] - time))
    noise[np.ix_(first, first)] = decay + (1.0 - share) * np.eye(60)
    flat = local.reshape(2, -1)
    covariance = covariance + noise + flat.T @ flat
    readings = residual.ravel()
    wanted = -0.5 * readings @ np.linalg.solve(covariance, readings) - 0.5 * np.linalg.slogdet(covariance)[1]
    assert value == pytest.approx(wanted, abs=0.02)


def test_a_long_correlation_within_a_short_step_stays_finite():
    """Backwards the force would grow by e^1000 within a step."""
    trial = trial_of(1.0 * np.arange(20), np.ones((20, 2)))
    filtered = Filtered(trial, {0: Process(1.0, 1e-3)})
    assert np.isfinite(filtered.log_determinant)
    assert np.all(np.isfinite(filtered.smoothed(trial.residual)[1]))


def test_a_pushed_state_follows_the_closed_form():
    trial = trial_of(0.02 * np.arange(50), np.zeros((50, 2)))
    state = trial.pushed(0, np.ones(len(trial.fine_time)))
    generator = trial.system.generator
    push = -trial.system.actions[0]
    wanted = np.array(
        [np.linalg.solve(generator, (expm(generator * t) - np.eye(2)) @ push) for t in trial.fine_time]
    )
    np.testing.assert_allclose(state, wanted, atol=1e-12)


def test_noise_of_first_order_is_taken_apart_exactly():
    from discrepancy.campaign.noise import NoiseModel
    from discrepancy.missing_force.trial import decaying_part

    noise = NoiseModel(1.0, 1.0 / np.sqrt(1.0 - 0.81), np.inf, np.array([0.9]), 0.01, ())
    found = decaying_part(noise, 0.01)
    assert found[0] == pytest.approx(1.0 - 1e-3, abs=2e-3)
    assert found[1] == pytest.approx(-np.log(0.9) / 0.01, rel=1e-6)
    answer = lfilter([1.0], [1.0, -0.9], np.r_[1.0, np.zeros(3)])
    assert np.exp(-found[1] * 0.01) == pytest.approx(answer[1], rel=1e-6)
    assert decaying_part(noise, 0.02) is None
