"""Measured figures with their targets and references, and timers of function calls."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Measurement:
    """One measured figure.

    Attributes
    ----------
    name : str
        What was measured.
    value : float
        The figure, in `unit`.
    unit : str
        Unit of `value` and `target`.
    target : float or None
        The figure wanted; None where none was set.
    reference_name, reference_value
        What ran beside it in the same process, and its figure in the same unit, so that the ratio
        of the two does not depend on the machine.
    larger_is_better : bool
        True for speed-ups; False for times, sizes and errors.
    """

    name: str
    value: float
    unit: str
    target: float | None = None
    reference_name: str = ""
    reference_value: float | None = None
    larger_is_better: bool = False

    @property
    def reached(self) -> bool | None:
        """Whether the target is reached; None without a target."""
        if self.target is None:
            return None
        return self.value >= self.target if self.larger_is_better else self.value <= self.target


def median_seconds(function: Callable[[], object], *, repeats: int = 15, inner: int = 1) -> float:
    """Return the median wall-clock seconds of one call, over `repeats` batches of `inner` calls."""
    function()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        for _ in range(inner):
            function()
        times.append((time.perf_counter() - begin) / inner)
    return float(np.median(times))


def least_seconds(
    functions: Mapping[str, Callable[[], object]], *, repeats: int, inner: int
) -> dict[str, float]:
    """Return the least seconds of one call of each function, over alternating batches of calls.

    On a busy machine the least of many short batches is one that nothing has interrupted.
    """
    least = dict.fromkeys(functions, float("inf"))
    for function in functions.values():
        function()
    for _ in range(repeats):
        for name, function in functions.items():
            begin = time.perf_counter()
            for _ in range(inner):
                function()
            least[name] = min(least[name], (time.perf_counter() - begin) / inner)
    return least
