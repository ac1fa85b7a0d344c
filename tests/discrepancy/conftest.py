"""Synthetic fits: a two-mode ring-down and a static test whose model is known exactly."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from discrepancy.campaign.records import Channel, NoiseRecord, Quantity, Release, Trial, TrialKind
from discrepancy.location.residuals import FittedTrial, ResidualSet
from tests.discrepancy.rigs import sensitivity

FloatArray = NDArray[np.float64]

FREQUENCIES = (5.0, 28.0)
RATIOS = (0.02, 0.03)
SHAPES = np.array([[1.0, 0.8, 0.5, 0.2], [0.4, -0.6, -0.9, 0.5]])  # by mode and channel
NAMES = ("g1", "g2", "g3", "g4")
NOISE = 2.0
INTERVAL = 0.01


class Bench:
    """Linear-Gaussian fits of a wing-like structure with four gauges, exact by construction."""

    def __init__(
        self,
        *,
        count: int = 300,
        amplitudes: Sequence[float] = (200.0, 200.0),
        noise_freedom: float = 200.0,
        static: bool = True,
        held_out: Sequence[bool] | None = None,
    ) -> None:
        self.noise_freedom = noise_freedom
        held_out = held_out or [False] * len(amplitudes)
        self.trials: list[Trial] = []
        self.clean: list[FloatArray] = []
        self.rates: list[FloatArray | None] = []
        self.jacobians: list[FloatArray] = []
        releases = len(amplitudes)
        # Parameters: frequency and decay of each mode (shared), amplitude by mode and release, stiffness.
        width = 4 + 2 * releases + 1
        time = INTERVAL * np.arange(count)
        for number, amplitude in enumerate(amplitudes):
            value, rate = np.zeros((count, 4)), np.zeros((count, 4))
            jacobian = np.zeros((count, 4, width))
            for mode in range(2):
                w = 2.0 * np.pi * FREQUENCIES[mode]
                d = RATIOS[mode] * w
                size = amplitude * (1.0 if mode == 0 else 0.3)
                wave = size * np.exp((-d + 1j * w) * time)
                shape = SHAPES[mode]
                value += wave.real[:, np.newaxis] * shape
                rate += ((-d + 1j * w) * wave).real[:, np.newaxis] * shape
                jacobian[:, :, 2 * mode] = (1j * time * wave).real[:, np.newaxis] * shape
                jacobian[:, :, 2 * mode + 1] = (-time * wave).real[:, np.newaxis] * shape
                jacobian[:, :, 4 + 2 * number + mode] = (wave / size).real[:, np.newaxis] * shape
            self._add(
                Trial.plain(
                    f"release {number + 1}", TrialKind.RINGDOWN, NAMES, time, values=value,
                    start=100.0 * number, run="A", release=Release(amplitude), held_out=held_out[number],
                ),
                value, rate, jacobian,
            )  # fmt: skip
        if static:
            force = np.concatenate([np.linspace(0.0, 10.0, 6), np.linspace(8.0, -10.0, 10)])
            value = force[:, np.newaxis] * SHAPES[0] * 20.0
            jacobian = np.zeros((len(force), 4, width))
            jacobian[:, :, -1] = value
            self._add(
                Trial.plain(
                    "steps", TrialKind.STATIC, NAMES, 10.0 * np.arange(len(force)), values=value, force=force,
                    temperature=np.linspace(0.0, 3.0, len(force)) ** 2, run="A",
                ),
                value, None, jacobian,
            )  # fmt: skip

    def _add(self, trial: Trial, value: FloatArray, rate: FloatArray | None, jacobian: FloatArray) -> None:
        self.trials.append(trial)
        self.clean.append(value)
        self.rates.append(rate)
        self.jacobians.append(jacobian)

    def channels(self, deviation: float = NOISE) -> dict[str, Channel]:
        noise = NoiseRecord(deviation, self.noise_freedom)
        return {
            name: Channel(name, Quantity.STRAIN, f"strain[{number}]", noise)
            for number, name in enumerate(NAMES)
        }

    def fit(
        self,
        generator: np.random.Generator,
        *,
        extra: Mapping[int, FloatArray] | None = None,
        with_sensitivity: bool = True,
    ) -> ResidualSet:
        """Draw noise, add what the model lacks (`extra`, by trial) and fit the linear parameters.

        The noise deviation is known from a record with `noise_freedom` degrees of freedom.
        """
        s0 = NOISE
        if np.isfinite(self.noise_freedom):
            s0 *= float(np.sqrt(generator.chisquare(self.noise_freedom) / self.noise_freedom))
        noise = np.full(4, s0)
        error = [NOISE * generator.standard_normal(value.shape) for value in self.clean]
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
        items = []
        for number, trial in enumerate(self.trials):
            jacobian = self.jacobians[number]
            if trial.held_out:  # its own amplitudes are known exactly: only shared parameters are uncertain
                jacobian = jacobian.copy()
                jacobian[:, :, 4:-1] = 0.0
            S = sensitivity(jacobian, covariance, noise)
            leverage = np.sum(S**2, axis=2)
            change = jacobian @ shift
            items.append(
                FittedTrial(
                    trial=replace(trial, values=self.clean[number] + error[number]),
                    prediction=self.clean[number] + change,
                    residual=error[number] - change,
                    noise_deviation=noise,
                    predictive_deviation=s0 * np.sqrt(1.0 + leverage),
                    leverage=leverage,
                    rates=self.rates[number],
                    sensitivity=S if with_sensitivity else None,
                )
            )
        return ResidualSet(self.channels(s0), tuple(items))


@pytest.fixture(scope="session")
def make_bench() -> Callable[..., Bench]:
    """What makes a bench."""
    return Bench
