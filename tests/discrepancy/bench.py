"""Synthetic fits: a two-mode ring-down and a static test whose model is known exactly."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.location.residuals import FittedTrial, ResidualSet

FloatArray = NDArray[np.float64]

FREQUENCIES = (5.0, 28.0)
RATIOS = (0.02, 0.03)
SHAPES = np.array([[1.0, 0.8, 0.5, 0.2], [0.4, -0.6, -0.9, 0.5]])  # by mode and channel
NAMES = ("g1", "g2", "g3", "g4")
NOISE = 2.0
INTERVAL = 0.01


class Bench:
    """Linear-Gaussian fits of a wing-like structure with four gauges, exact by construction.

    Its parameters: frequency and decay of each mode (shared), amplitude by mode and release, stiffness. The
    noise deviation is known from a record with `noise_freedom` degrees of freedom.
    """

    def __init__(self, *, count=300, amplitudes=(200.0, 200.0), noise_freedom=200.0, held_out=None) -> None:
        self.noise_freedom = noise_freedom
        self.trials: list[Trial] = []
        self.rates: list[FloatArray | None] = []
        self.jacobians: list[FloatArray] = []
        width = 4 + 2 * len(amplitudes) + 1
        time = INTERVAL * np.arange(count)
        for number, amplitude in enumerate(amplitudes):
            value, rate = np.zeros((2, count, 4))
            jacobian = np.zeros((count, 4, width))
            for mode, (frequency, ratio, shape) in enumerate(zip(FREQUENCIES, RATIOS, SHAPES, strict=True)):
                pole = (-ratio + 1j) * 2.0 * np.pi * frequency
                size = amplitude * (1.0 if mode == 0 else 0.3)
                wave = size * np.exp(pole * time)
                value += np.outer(wave.real, shape)
                rate += np.outer((pole * wave).real, shape)
                jacobian[:, :, 2 * mode] = np.outer((1j * time * wave).real, shape)
                jacobian[:, :, 2 * mode + 1] = np.outer((-time * wave).real, shape)
                jacobian[:, :, 4 + 2 * number + mode] = np.outer((wave / size).real, shape)
            held = held_out is not None and held_out[number]
            given = {"start": 100.0 * number, "release": Release(amplitude), "held_out": held}
            self._add(f"release {number + 1}", TrialKind.RINGDOWN, time, value, rate, jacobian, **given)
        force = np.concatenate([np.linspace(0.0, 10.0, 6), np.linspace(8.0, -10.0, 10)])
        jacobian = np.zeros((len(force), 4, width))
        jacobian[:, :, -1] = value = np.outer(force, 20.0 * SHAPES[0])
        given = {"force": force, "temperature": np.linspace(0.0, 3.0, len(force)) ** 2}
        rows = 10.0 * np.arange(len(force))
        self._add("steps", TrialKind.STATIC, rows, value, None, jacobian, **given)

    def _add(self, name, kind, time, value, rate, jacobian, **given) -> None:
        self.trials.append(Trial.plain(name, kind, NAMES, time, values=value, run="A", **given))
        self.rates.append(rate)
        self.jacobians.append(jacobian)

    def fit(self, generator: np.random.Generator, extra=None) -> ResidualSet:
        """Draw noise, add what the model lacks (`extra`, by trial) and fit the linear parameters."""
        s0 = NOISE
        if np.isfinite(self.noise_freedom):
            s0 *= float(np.sqrt(generator.chisquare(self.noise_freedom) / self.noise_freedom))
        noise = np.full(4, s0)
        error = [NOISE * generator.standard_normal(trial.values.shape) for trial in self.trials]
        for number, add in (extra or {}).items():
            error[number] = error[number] + add
        rows = [n for n, trial in enumerate(self.trials) if not trial.held_out]
        J = np.vstack([self.jacobians[n].reshape(-1, self.jacobians[n].shape[2]) for n in rows])
        e = np.concatenate([error[n].ravel() for n in rows])
        size = np.linalg.norm(J, axis=0)
        size[size == 0.0] = 1.0
        precision = (J / size).T @ (J / size) / s0**2 + 1e-12 / s0**2 * np.eye(J.shape[1])
        covariance = np.linalg.inv(precision) / np.outer(size, size)
        shift = covariance @ (J.T @ e) / s0**2
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        root = vectors * np.sqrt(np.clip(values, 0.0, None))
        items = []
        for trial, off, rate, jacobian in zip(self.trials, error, self.rates, self.jacobians, strict=True):
            if trial.held_out:  # its own amplitudes are known exactly: only shared parameters are uncertain
                jacobian = jacobian.copy()
                jacobian[:, :, 4:-1] = 0.0
            S = (jacobian @ root) / noise[:, np.newaxis]  # S S^T holds the leverages
            leverage = np.sum(S**2, axis=2)
            change = jacobian @ shift
            items.append(
                FittedTrial(
                    trial=replace(trial, values=trial.values + off), prediction=trial.values + change,
                    residual=off - change, noise_deviation=noise,
                    predictive_deviation=s0 * np.sqrt(1.0 + leverage), leverage=leverage, rates=rate,
                    sensitivity=S,
                )
            )  # fmt: skip
        record = NoiseRecord(s0, self.noise_freedom)
        channels = {
            name: Channel(name, Quantity.STRAIN, f"strain[{number}]", record)
            for number, name in enumerate(NAMES)
        }
        return ResidualSet(channels, tuple(items))


def with_noise(residuals: ResidualSet, noise: NoiseRecord | None) -> ResidualSet:
    """Return residuals whose channels have another noise record."""
    channels = {name: replace(channel, noise=noise) for name, channel in residuals.channels.items()}
    return replace(residuals, channels=channels)
