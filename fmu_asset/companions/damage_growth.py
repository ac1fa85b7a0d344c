"""Growing damage: the stiffness losses of two regions, by script, by load and by chance.

This file is copied into the FMU: standard library only.

The loss of a region is the sum of three parts, limited to a ceiling:

- a script: at each mark of time between `first` and `last` of an entry, the entry's gain;
- growth with the load, as in crack growth (Paris and Erdogan 1963):
  dz/dt = rate (|n| / n_ref)^exponent;
- chance: at each mark but the first, one more level with probability
  min(1, p (|n| / n_ref)^exponent), where n is the load factor before the mark.

A mark is a multiple of `period` after the start. What happens at a mark belongs to the step that
begins at it, so that damage from one step acts from the next step on. The random number of a mark
depends only on seed, region and mark: not on the step size, the other region or earlier marks.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from typing import NamedTuple

REGIONS = ("z1", "z2")
SCRIPT_LENGTH = 8
_DECIMALS = 12
"""Losses are rounded to this many digits, so that ten times 2 % and 40 % are 60 %."""

_RELATIVE_TIME_TOLERANCE = 1e-9
"""The tolerance of times against marks, as a fraction of the period."""


class ScriptEntry(NamedTuple):
    """An entry of the script.

    Attributes
    ----------
    first, last : float
        The times after the start between which its marks lie [s].
    gains : tuple of float
        The loss that is added to each region at each of these marks.
    """

    first: float
    last: float
    gains: tuple[float, ...]


class DamageGrowthBehaviour:
    """The behaviour of the FMU of growing damage; see the module."""

    def __init__(self) -> None:
        self._losses = [0.0, 0.0]
        self._start_time = 0.0
        self._next_mark = 0
        self._previous_load_factor = 0.0

    def _set_parameters(self, parameters: Mapping[str, float]) -> None:
        """Store the parameters in the form that a step needs."""
        self._ceiling = parameters["ceiling"]
        self._period = parameters["period"]
        self._reference_load_factor = parameters["reference_load_factor"]
        self._exponent = parameters["exponent"]
        self._level = parameters["level"]
        self._seed = int(parameters["seed"])
        self._rates = [parameters[f"rate.{region}"] for region in REGIONS]
        self._probabilities = [parameters[f"probability.{region}"] for region in REGIONS]
        self._script = []
        for number in range(1, SCRIPT_LENGTH + 1):
            prefix = f"script[{number}]"
            gains = tuple(parameters[f"{prefix}.{region}"] for region in REGIONS)
            if any(gains):
                first, last = parameters[f"{prefix}.first"], parameters[f"{prefix}.last"]
                self._script.append(ScriptEntry(first, last, gains))

    def start(
        self, parameters: Mapping[str, float], time: float, inputs: Sequence[float]
    ) -> list[float]:
        """Set the initial losses, and return the outputs."""
        self._set_parameters(parameters)
        self._losses = [parameters[f"initial.{region}"] for region in REGIONS]
        self._start_time = time
        self._next_mark = 0
        self._previous_load_factor = inputs[0]
        return self._outputs()

    def advance(self, time: float, duration: float, inputs: Sequence[float]) -> list[float]:
        """Add the damage of one step, and return the outputs at its end.

        Parameters
        ----------
        time, duration : float
            Beginning and length of the step [s].
        inputs : sequence of float
            The constant load factor of the step.
        """
        load_factor = inputs[0]
        period = self._period
        tolerance = _RELATIVE_TIME_TOLERANCE * period
        end = time + duration - tolerance
        # Nothing happens at marks: all of them are passed at once.
        if not self._script and not any(self._probabilities):
            self._next_mark = max(self._next_mark, math.ceil((end - self._start_time) / period))
        # script and chance, mark by mark
        while self._start_time + self._next_mark * period < end:
            mark_time = self._start_time + self._next_mark * period
            at_begin = mark_time <= time + tolerance
            load_before_mark = self._previous_load_factor if at_begin else load_factor
            self._pass_mark(mark_time - self._start_time, load_before_mark)
            self._next_mark += 1
        # growth with the load
        for region, rate in enumerate(self._rates):
            if rate:
                loss = self._losses[region] + rate * self._severity(load_factor) * duration
                self._losses[region] = min(loss, self._ceiling)
        self._previous_load_factor = load_factor
        return self._outputs()

    def _pass_mark(self, elapsed: float, load_factor: float) -> None:
        """Add the damage of the next mark.

        `elapsed` is its time after the start [s], `load_factor` that before the mark.
        """
        tolerance = _RELATIVE_TIME_TOLERANCE * self._period
        for region, name in enumerate(REGIONS):
            gain = 0.0
            for entry in self._script:
                if entry.first - tolerance <= elapsed <= entry.last + tolerance:
                    gain += entry.gains[region]
            probability = self._probabilities[region]
            if probability and self._next_mark > 0:
                uniform = random.Random(f"{self._seed}:{name}:{self._next_mark}").random()
                if uniform < probability * self._severity(load_factor):
                    gain += self._level
            self._losses[region] = max(0.0, min(self._losses[region] + gain, self._ceiling))

    def _severity(self, load_factor: float) -> float:
        """Return the factor (|n| / n_ref)^exponent on rates and probabilities."""
        return float((abs(load_factor) / self._reference_load_factor) ** self._exponent)

    def _outputs(self) -> list[float]:
        return [round(loss, _DECIMALS) for loss in self._losses]

    def state(self) -> list[float]:
        """Return losses, start time, index of the next mark, and last load factor."""
        return [
            *self._losses,
            self._start_time,
            float(self._next_mark),
            self._previous_load_factor,
        ]

    def restore(self, parameters: Mapping[str, float], state: Sequence[float]) -> None:
        """Restore a state that `state` returned."""
        self._set_parameters(parameters)
        *losses, start_time, next_mark, load_factor = state
        self._losses = losses
        self._start_time = start_time
        self._next_mark = int(next_mark)
        self._previous_load_factor = load_factor
