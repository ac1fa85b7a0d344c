"""Damage that grows: the stiffness losses of two regions, by script, by load and by chance.

This file is copied into the FMU: standard library only.

The loss of a region is the sum of three parts, kept below a ceiling:

- a script: at each mark of time between `first` and `last` of an entry, the entry's gain;
- growth with the load, as in crack growth (Paris and Erdogan 1963), dz/dt = rate (|n| / n_ref)^exponent;
- chance: at each mark but the first, one level more with probability min(1, p (|n| / n_ref)^exponent), where
  n is the load factor that was held before the mark.

A mark is a multiple of `period` after the start. What happens at a mark belongs to the step that begins at
it, so that the damage that a step does is felt from the next step on. The numbers of a mark follow from the
seed, the region and the mark alone: they do not depend on the step size, on the other region or on earlier
marks.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence

REGIONS = ("z1", "z2")
SCRIPT_LENGTH = 8
_DECIMALS = 12
"""Losses are given rounded to this many digits, so that ten times 2 % and 40 % are 60 %."""


class DamageGrowth:
    """The growing damage; see the module."""

    def __init__(self) -> None:
        self._loss = [0.0, 0.0]
        self._begin = 0.0
        self._mark = 0
        self._last_load = 0.0

    def _take(self, parameters: Mapping[str, float]) -> None:
        """Keep the parameters in the form in which a step needs them."""
        self._ceiling = parameters["ceiling"]
        self._period = parameters["period"]
        self._reference = parameters["reference_load_factor"]
        self._exponent = parameters["exponent"]
        self._level, self._seed = parameters["level"], int(parameters["seed"])
        self._rate = [parameters[f"rate.{region}"] for region in REGIONS]
        self._chance = [parameters[f"probability.{region}"] for region in REGIONS]
        entries = [
            [parameters[f"script[{entry}].{key}"] for key in ("first", "last", *REGIONS)]
            for entry in range(1, SCRIPT_LENGTH + 1)
        ]
        self._script = [entry for entry in entries if any(entry[2:])]

    def start(self, parameters: Mapping[str, float], time: float, inputs: Sequence[float]) -> list[float]:
        """Begin with the initial losses."""
        self._take(parameters)
        self._loss = [parameters[f"initial.{region}"] for region in REGIONS]
        self._begin, self._mark, self._last_load = time, 0, inputs[0]
        return self._outputs()

    def advance(self, time: float, duration: float, inputs: Sequence[float]) -> list[float]:
        """Let the damage of one step happen."""
        load, period = inputs[0], self._period
        tolerance = 1e-9 * period
        end = time + duration - tolerance
        if not (self._script or any(self._chance)):
            self._mark = max(self._mark, math.ceil((end - self._begin) / period))
        while self._begin + self._mark * period < end:
            moment = self._begin + self._mark * period
            self._pass_mark(moment - self._begin, self._last_load if moment <= time + tolerance else load)
            self._mark += 1
        for index, rate in enumerate(self._rate):
            if rate:
                grown = self._loss[index] + rate * self._severity(load) * duration
                self._loss[index] = min(grown, self._ceiling)
        self._last_load = load
        return self._outputs()

    def _pass_mark(self, elapsed: float, load: float) -> None:
        tolerance = 1e-9 * self._period
        for index, region in enumerate(REGIONS):
            gain = 0.0
            for entry in self._script:
                if entry[0] - tolerance <= elapsed <= entry[1] + tolerance:
                    gain += entry[2 + index]
            if self._chance[index] and self._mark > 0:
                uniform = random.Random(f"{self._seed}:{region}:{self._mark}").random()
                if uniform < self._chance[index] * self._severity(load):
                    gain += self._level
            self._loss[index] = max(0.0, min(self._loss[index] + gain, self._ceiling))

    def _severity(self, load: float) -> float:
        return float((abs(load) / self._reference) ** self._exponent)

    def _outputs(self) -> list[float]:
        return [round(loss, _DECIMALS) for loss in self._loss]

    def state(self) -> list[float]:
        """Return losses, start time, number of the next mark, last load factor."""
        return [*self._loss, self._begin, float(self._mark), self._last_load]

    def restore(self, parameters: Mapping[str, float], state: Sequence[float]) -> None:
        """Take back what `state` returned."""
        self._take(parameters)
        self._loss = list(state[:2])
        self._begin, self._mark, self._last_load = state[2], int(state[3]), state[4]
