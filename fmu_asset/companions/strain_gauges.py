"""Strain gauges: true strains in, readings with gain, offset, drift, noise and dropout out.

This file is copied into the FMU: standard library only.

At time t, a gauge reads gain * strain + offset + drift_rate * max(0, t - drift_start) + noise. It
is lost where dropout_start < t <= dropout_end, where blackout.start < t <= blackout.end (all
gauges), and by chance with `dropout_probability`: then it reads 0 and `received` is false. So the
step that begins at `dropout_start` is the first one that is lost. The random numbers of a reading
depend only on the seed and the number of the reading.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from typing import NamedTuple


class Drift(NamedTuple):
    """The drift of a gauge (counted from 0): its rate [1/s] from a start time on [s]."""

    gauge: int
    rate: float
    start: float


class LossWindow(NamedTuple):
    """The times between which a gauge (counted from 0) is lost [s]."""

    gauge: int
    start: float
    end: float


class StrainGaugesBehaviour:
    """The behaviour of the FMU of strain gauges; see the module."""

    _reading_number = 0

    def _set_parameters(self, parameters: Mapping[str, float]) -> None:
        """Store the parameters in the form that a reading needs."""
        gauge_count = sum(name.startswith("gain[") for name in parameters)

        def values_of_gauges(name: str) -> list[float]:
            return [parameters[f"{name}[{number}]"] for number in range(1, gauge_count + 1)]

        self._gains = values_of_gauges("gain")
        self._offsets = values_of_gauges("offset")
        drift_starts = values_of_gauges("drift_start")
        self._drifts = []
        for gauge, rate in enumerate(values_of_gauges("drift_rate")):
            if rate:
                self._drifts.append(Drift(gauge, rate, drift_starts[gauge]))
        loss_ends = values_of_gauges("dropout_end")
        self._loss_windows = []
        for gauge, start in enumerate(values_of_gauges("dropout_start")):
            if loss_ends[gauge] > start:
                self._loss_windows.append(LossWindow(gauge, start, loss_ends[gauge]))
        self._blackout_start = parameters["blackout.start"]
        self._blackout_end = parameters["blackout.end"]
        self._noise = parameters["noise"]
        self._loss_probability = parameters["dropout_probability"]
        self._seed = int(parameters["seed"])

    def start(
        self, parameters: Mapping[str, float], time: float, inputs: Sequence[float]
    ) -> list[float]:
        """Return the first readings."""
        self._set_parameters(parameters)
        self._reading_number = 0
        return self._outputs(time, inputs, reading_number=0)

    def advance(self, time: float, duration: float, inputs: Sequence[float]) -> list[float]:
        """Return the readings at the end of a step.

        Parameters
        ----------
        time, duration : float
            Beginning and length of the step [s].
        inputs : sequence of float
            The true strains.
        """
        outputs = self._outputs(time + duration, inputs, self._reading_number + 1)
        self._reading_number += 1
        return outputs

    def _outputs(self, time: float, strains: Sequence[float], reading_number: int) -> list[float]:
        """Return the readings, then a flag for each gauge: 1 if received, 0 if lost."""
        # systematic errors
        readings = []
        for gain, strain, offset in zip(self._gains, strains, self._offsets, strict=True):
            readings.append(gain * strain + offset)
        for drift in self._drifts:
            readings[drift.gauge] += drift.rate * max(0.0, time - drift.start)
        # noise, and loss by chance
        received_flags = [1.0] * len(strains)
        if self._noise or self._loss_probability:
            generator = random.Random(f"{self._seed}:{reading_number}")
            readings = [reading + self._noise * normal(generator) for reading in readings]
            if self._loss_probability:
                received_flags = [
                    float(generator.random() >= self._loss_probability) for _ in strains
                ]
        # loss by the clock
        for window in self._loss_windows:
            if window.start < time <= window.end:
                received_flags[window.gauge] = 0.0
        if self._blackout_start < time <= self._blackout_end:
            received_flags = [0.0] * len(strains)
        for gauge, is_received in enumerate(received_flags):
            if not is_received:
                readings[gauge] = 0.0
        return readings + received_flags

    def state(self) -> list[float]:
        """Return the number of the last reading."""
        return [float(self._reading_number)]

    def restore(self, parameters: Mapping[str, float], state: Sequence[float]) -> None:
        """Restore a state that `state` returned."""
        self._set_parameters(parameters)
        self._reading_number = int(state[0])


def normal(generator: random.Random) -> float:
    """Return a standard normal number, by the formula of Box and Muller (1958).

    Python's own generator may change from one version to the next.
    """
    radius = math.sqrt(-2.0 * math.log(1.0 - generator.random()))
    return radius * math.cos(2.0 * math.pi * generator.random())
