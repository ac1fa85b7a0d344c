"""What an instance is asked, and what it exchanges with its FMU: plain values, sent to a worker."""

import ctypes
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

Interface = Literal["co-simulation", "model-exchange"]

SOLVER_TOLERANCE = 1e-6
"""Relative, of our solver, unless the binding gives another or the FMU declares a smaller one."""

REPORT_PERIOD = 0.02
"""Seconds after which many steps report what is done, at the end of the step that is being made."""

Floats = npt.NDArray[np.float64]
Settings = list[tuple[str, int, list[float]]]
"""FMI base type, value reference, values: one for a scalar, all elements for an array."""


@dataclass(frozen=True)
class Group:
    """Variables of one base type, set or read in one call.

    Attributes
    ----------
    kind : str
        FMI base type: Real, Integer, Boolean; Float64, Int32, ... in FMI 3.
    references : tuple of int
        Value references, in the order of the block.
    count : int
        Number of values; more than references if there are arrays.
    linear : bool
        Whether the values move in straight lines over a step; such inputs come first.
    """

    kind: str
    references: tuple[int, ...]
    count: int
    linear: bool = False


@dataclass(frozen=True)
class Plan:
    """What an instance is and what it exchanges.

    Attributes
    ----------
    folder : str
        Where the FMU is extracted.
    fmi_version : int
        1, 2 or 3.
    interface : {"co-simulation", "model-exchange"}
        How the FMU is run.
    guid, model_identifier, instance_name : str
        As FMI wants them.
    inputs, outputs : tuple of Group
        What is set and read at every step, in the order of the request and of the reply block.
    substeps : int
        Communication steps of the FMU between two observations.
    tolerance : float or None
        Relative tolerance that the FMU is told.
    solver_tolerance : float
        Relative tolerance of our solver (model exchange).
    states, event_indicators : int
        Numbers of continuous states and event indicators (model exchange).
    completed_step : bool
        Whether the FMU wants to hear of completed integrator steps (model exchange).
    configuration : Settings
        Structural parameters (FMI 3), set before everything else.
    """

    folder: str
    fmi_version: int
    interface: Interface
    guid: str
    model_identifier: str
    instance_name: str
    inputs: tuple[Group, ...]
    outputs: tuple[Group, ...]
    substeps: int = 1
    tolerance: float | None = None
    solver_tolerance: float = SOLVER_TOLERANCE
    states: int = 0
    event_indicators: int = 0
    completed_step: bool = False
    configuration: Settings = field(default_factory=list)

    @property
    def linear_count(self) -> int:
        """Number of input values that move in straight lines."""
        return sum(group.count for group in self.inputs if group.linear)

    @property
    def input_count(self) -> int:
        """Number of values behind time and step size in a request: all inputs, then where lines begin."""
        return sum(group.count for group in self.inputs) + self.linear_count

    @property
    def output_count(self) -> int:
        """Number of output values."""
        return sum(group.count for group in self.outputs)


class Instance(Protocol):
    """What an asset asks of an FMU in this process, in a worker, or of several.

    Parameters
    ----------
    plan : Plan
        What is exchanged.

    Attributes
    ----------
    request, reply : ctypes array of double
        Two blocks that are allocated once: time, step size, then all inputs; and all outputs. Integers and
        Booleans are doubles there.
    lost : bool
        Whether it cannot be used any more.
    """

    request: Any
    reply: Any
    lost: bool

    def __init__(self, plan: Plan) -> None:
        self.request = (ctypes.c_double * (2 + plan.input_count))()
        self.reply = (ctypes.c_double * max(plan.output_count, 1))()
        self.lost = False

    def initialise(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        """Set parameters, and inputs if wanted, and go to the first communication point.

        Parameters
        ----------
        start_time : float
            Start time [s].
        parameters : Settings
            What is set before initialisation.
        with_inputs : bool
            Whether the inputs of the request block are set, instead of the FMU's own start values.

        Raises
        ------
        FmuCallError
            If a call fails, or the FMU logs an error on the way.
        """

    def step(self) -> None:
        """Make the step that the request block describes; the reply block then holds the outputs.

        Raises
        ------
        FmuCallError
            If a call returns Discard, Error or Fatal.
        FmuEndedError
            If the FMU ends its simulation, or has done so before.
        FmuWorkerError
            If the instance was lost to an earlier fatal error.
        """

    def run(self, requests: Floats, replies: Floats, report: Callable[[int], object]) -> None:
        """Make many steps; end after one whose outputs are not all finite.

        Parameters
        ----------
        requests : (N, 2 + n_inputs) ndarray
            The request block of each step.
        replies : (N, n_outputs) ndarray
            Filled with the reply block of each step.
        report : callable
            Called with the number of steps made, now and then and in the end, also when one fails.

        Raises
        ------
        FmuCallError, FmuWorkerError
            As `step`.
        """
        request, reply = (np.frombuffer(memoryview(block).cast("B")) for block in (self.request, self.reply))
        step, dot, now, done = self.step, reply.dot, time.monotonic, 0
        due = now() + REPORT_PERIOD
        try:
            for asked, answered in zip(requests, replies, strict=True):
                request[:] = asked
                step()
                answered[:] = reply
                done += 1
                # The sum of squares can be infinite for large values too.
                if not math.isfinite(dot(reply)) and not np.isfinite(reply).all():
                    return
                if now() > due:
                    report(done)
                    due = now() + REPORT_PERIOD
        finally:
            report(done)

    def read(self) -> None:
        """Read the outputs of this moment into the reply block."""

    def save(self) -> bytes:
        """Return the serialised state."""

    def restore(self, content: bytes) -> None:
        """Go back to a state.

        Raises
        ------
        FmuCallError
            If a call fails.
        FmuStateError
            If the FMU refuses the state in its log.
        """

    def reset(self) -> None:
        """Go back to the moment after the instantiation."""

    def take_log(self) -> list[tuple[int, str]]:
        """Return and forget the messages that the FMU has logged: status and text."""

    def close(self) -> None:
        """Free it."""
