"""Many steps in one go: their requests and replies, row by row."""

import math
import time
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from .plan import Settings

REPORT_PERIOD = 0.02
"""Seconds after which a running series reports what is done, at the end of the step that is being made."""


class Instance(Protocol):
    """What an asset asks of an FMU in this process, in a worker, or of several; see `FmuInstance`.

    Attributes
    ----------
    request, reply : ctypes array of double
        The blocks; see `instances`.
    """

    request: Any
    reply: Any

    @property
    def has_log(self) -> bool:
        """Whether there are messages."""

    @property
    def lost(self) -> bool:
        """Whether it cannot be used any more."""

    def initialise(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        """Set parameters, and inputs if wanted, and go to the first communication point."""

    def step(self) -> None:
        """Make the step that the request block describes."""

    def run(self, series: "Series", report: Callable[[], object]) -> None:
        """Make many steps."""

    def read(self) -> None:
        """Read the outputs of this moment into the reply block."""

    def save(self) -> bytes:
        """Return the state."""

    def restore(self, content: bytes) -> None:
        """Go back to a state."""

    def reset(self) -> None:
        """Go back to the moment after the instantiation."""

    def take_log(self) -> list[tuple[int, str]]:
        """Return and forget the messages: status and text."""

    def close(self) -> None:
        """Free it."""


class Series:
    """Steps that follow one another.

    Parameters
    ----------
    requests : (N, 2 + n_inputs) ndarray
        The request block of each step.
    replies : (N, n_outputs) ndarray
        Filled with the reply block of each step.

    Attributes
    ----------
    done : int
        Number of steps made; the replies of these are filled.
    """

    def __init__(self, requests: npt.NDArray[np.float64], replies: npt.NDArray[np.float64]) -> None:
        self.requests = requests.reshape(-1).data.cast("B")
        self.replies = replies.reshape(-1).data.cast("B")
        self.count, self.done = len(requests), 0
        self.reply_size = replies.itemsize * replies.shape[1]


def run(instance: Instance, series: Series, report: Callable[[], object]) -> None:
    """Make the steps of a series; end after one whose outputs are not all finite.

    Parameters
    ----------
    instance : Stepped
        An instance in this process.
    series : Series
        The steps; `done` counts them also when one fails.
    report : callable
        Called now and then between two steps, when `done` has grown.

    Raises
    ------
    FmuCallError, FmuWorkerError
        As `FmuInstance.step`.
    """
    request, reply = memoryview(instance.request).cast("B"), memoryview(instance.reply).cast("B")
    outputs = np.frombuffer(reply)
    asked, answered = len(request), series.reply_size
    requests, replies, step, dot, now = (
        series.requests,
        series.replies,
        instance.step,
        outputs.dot,
        time.monotonic,
    )
    due = now() + REPORT_PERIOD
    for row in range(series.count):
        request[:] = requests[row * asked : (row + 1) * asked]
        step()
        replies[row * answered : (row + 1) * answered] = reply
        series.done = row + 1
        # The sum of squares can be infinite for large values too.
        if not math.isfinite(dot(outputs)) and not np.isfinite(outputs).all():
            return
        if now() > due:
            report()
            due = now() + REPORT_PERIOD
