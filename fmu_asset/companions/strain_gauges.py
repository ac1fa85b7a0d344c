"""Strain gauges: true strains in; gain, offset, drift, noise and dropout; readings out.

This file is copied into the FMU: standard library only.

At time t, a gauge reads gain * strain + offset + drift_rate * max(0, t - drift_start) + noise. It is lost
where dropout_start < t <= dropout_end, where blackout.start < t <= blackout.end (all gauges), and by chance
with `dropout_probability`: then it reads 0 and `received` is false. A step that begins at `dropout_start` is
therefore the first one that is lost. The random numbers of a reading follow from the seed and the number of
the reading alone.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence


class StrainGauges:
    """The gauges, as many as there are gains; see the module."""

    _samples = 0

    def _take(self, parameters: Mapping[str, float]) -> None:
        """Keep the parameters in the form in which a reading needs them."""
        gauges = range(1, sum(name.startswith("gain[") for name in parameters) + 1)

        def each(name: str) -> list[float]:
            return [parameters[f"{name}[{gauge}]"] for gauge in gauges]

        self._gain, self._offset = each("gain"), each("offset")
        self._drift = [
            (index, rate, parameters[f"drift_start[{index + 1}]"])
            for index, rate in enumerate(each("drift_rate"))
            if rate
        ]
        windows = zip(each("dropout_start"), each("dropout_end"), strict=True)
        self._windows = [(index, *window) for index, window in enumerate(windows) if window[1] > window[0]]
        self._blackout = (parameters["blackout.start"], parameters["blackout.end"])
        self._noise, self._seed = parameters["noise"], int(parameters["seed"])
        self._chance = parameters["dropout_probability"]

    def start(self, parameters: Mapping[str, float], time: float, inputs: Sequence[float]) -> list[float]:
        """Give the first readings."""
        self._take(parameters)
        self._samples = 0
        return self._read(time, inputs)

    def advance(self, time: float, duration: float, inputs: Sequence[float]) -> list[float]:
        """Give the readings at the end of the step."""
        outputs = self._read(time + duration, inputs, self._samples + 1)
        self._samples += 1
        return outputs

    def _read(self, time: float, strains: Sequence[float], sample: int = 0) -> list[float]:
        readings = [
            gain * strain + offset
            for gain, strain, offset in zip(self._gain, strains, self._offset, strict=True)
        ]
        for index, rate, begin in self._drift:
            readings[index] += rate * max(0.0, time - begin)
        received = [1.0] * len(strains)
        if self._noise or self._chance:
            generator = random.Random(f"{self._seed}:{sample}")
            readings = [value + self._noise * normal(generator) for value in readings]
            if self._chance:
                received = [float(generator.random() >= self._chance) for _ in received]
        for index, begin, end in self._windows:
            if begin < time <= end:
                received[index] = 0.0
        if self._blackout[0] < time <= self._blackout[1]:
            received = [0.0] * len(strains)
        return [v if there else 0.0 for v, there in zip(readings, received, strict=True)] + received

    def state(self) -> list[float]:
        """Return the number of the last reading."""
        return [float(self._samples)]

    def restore(self, parameters: Mapping[str, float], state: Sequence[float]) -> None:
        """Take back what `state` returned."""
        self._take(parameters)
        self._samples = int(state[0])


def normal(generator: random.Random) -> float:
    """Return a standard normal number, by the formula of Box and Muller (1958).

    The library's own is not promised to stay the same from one version of Python to the next.
    """
    radius = math.sqrt(-2.0 * math.log(1.0 - generator.random()))
    return radius * math.cos(2.0 * math.pi * generator.random())
