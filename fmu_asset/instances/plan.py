"""What an instance is asked, and what it exchanges with its FMU: a plan, sent to a worker, and C calls."""

import ctypes
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, Protocol

import numpy as np

from reporting.arrays import Float

Interface = Literal["co-simulation", "model-exchange"]

SOLVER_TOLERANCE = 1e-6
"""Relative, of our solver, unless the binding gives another or the FMU declares a smaller one."""

REPORT_PERIOD = 0.02
"""Seconds after which many steps report what is done, at the end of the step that is being made."""

Settings = list[tuple[str, int, list[float] | list[str]]]
"""FMI base type, value reference, values: one for a scalar, all elements for an array; texts of a String."""


@dataclass(frozen=True)
class VariableGroup:
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


@dataclass(frozen=True, kw_only=True)
class FmuIdentity:
    """What an FMU declares that an instance of it has to know.

    Attributes
    ----------
    fmi_version, guid, model_identifier : str
        As declared; the identifier is that of `interface`.
    interface : {"co-simulation", "model-exchange"}
        How it is run.
    states, event_indicators : int
        Numbers of continuous states and event indicators (model exchange).
    completed_step : bool
        Whether it wants to hear of completed integrator steps (model exchange).
    """

    fmi_version: str = "2.0"
    guid: str = ""
    model_identifier: str = ""
    interface: Interface = "co-simulation"
    states: int = 0
    event_indicators: int = 0
    completed_step: bool = False

    @property
    def major_version(self) -> int:
        """1, 2 or 3."""
        return int(self.fmi_version[0])


@dataclass(frozen=True)
class Plan:
    """What an instance is and what it exchanges.

    Attributes
    ----------
    folder : str
        Where the FMU is extracted.
    fmu : FmuIdentity
        Which FMU it is.
    instance_name : str
        As FMI wants it.
    inputs, outputs : tuple of VariableGroup
        What is set and read at every step, in the order of the request and of the reply block.
    substeps : int
        Communication steps of the FMU between two observations.
    tolerance : float or None
        Relative tolerance that the FMU is told.
    solver_tolerance : float
        Relative tolerance of our solver (model exchange).
    stop_time : float or None
        End of the experiment that the FMU is told [s].
    configuration : Settings
        Structural parameters (FMI 3), set before everything else.
    """

    folder: str
    fmu: FmuIdentity
    instance_name: str
    inputs: tuple[VariableGroup, ...]
    outputs: tuple[VariableGroup, ...]
    substeps: int = 1
    tolerance: float | None = None
    solver_tolerance: float = SOLVER_TOLERANCE
    stop_time: float | None = None
    configuration: Settings = field(default_factory=list)

    @property
    def linear_count(self) -> int:
        """Number of input values that move in straight lines."""
        return sum(group.count for group in self.inputs if group.linear)

    @property
    def input_count(self) -> int:
        """Number of values behind time and step size in a request: all inputs, then where lines begin."""
        return sum(group.count for group in self.inputs) + self.linear_count


_C_TYPES: dict[str, Any] = {
    "Real": ctypes.c_double, "Float64": ctypes.c_double, "Float32": ctypes.c_float, "Integer": ctypes.c_int,
    **{name: getattr(ctypes, f"c_{name.lower()}") for bits in (8, 16, 32, 64)
       for name in (f"Int{bits}", f"UInt{bits}")},
}  # fmt: skip
_BOOLEANS: dict[int, Any] = {1: ctypes.c_ubyte, 2: ctypes.c_int, 3: ctypes.c_bool}


def values_of(block: Any) -> Float:
    """Return a ctypes array of doubles as an array that shares its memory."""
    return np.frombuffer(memoryview(block).cast("B"))


def exchanged(
    fmi_version: int, group: VariableGroup, doubles: Any, begin: int, *, sent: bool
) -> tuple[tuple[Any, ...], Callable[[], object] | None]:
    """Return what a C function that sets or reads variables takes after the instance, and a conversion.

    Parameters
    ----------
    fmi_version : int
        1, 2 or 3.
    group : VariableGroup
        The variables, of one base type; enumerations are integers, see `FmuDescription.exchange_kind`.
    doubles : ctypes array of double
        The block of their values.
    begin : int
        Where the group begins in it.
    sent : bool
        Whether the values are set.

    Returns
    -------
    tuple of (tuple, callable or None)
        C values; what converts the numbers of the block before they are set, or into the block after they
        are read: None where the FMU reads and writes the block itself.
    """
    kind = _BOOLEANS[fmi_version] if group.kind == "Boolean" else _C_TYPES[group.kind]
    convert = None
    if kind is ctypes.c_double and group.count:
        values = (kind * group.count).from_buffer(doubles, 8 * begin)
    else:
        values = (kind * group.count)()
        pair = [np.ctypeslib.as_array(values), values_of(doubles)[begin : begin + group.count]]
        target, source = pair if sent else reversed(pair)
        convert = partial(np.copyto, target, source, casting="unsafe")
    length = len(group.references)
    counts = [length, group.count] if fmi_version == 3 else [length]
    first, *further = [ctypes.c_size_t.from_param(count) for count in counts]
    references = ctypes.byref((ctypes.c_uint * length)(*group.references))
    return (references, first, ctypes.byref(values), *further), convert


# Without declared types ctypes passes C values as they are: a third of the time of a call that converts.
_Function = ctypes.CFUNCTYPE(ctypes.c_int)


def prepared(function: Any, *arguments: Any) -> Callable[[], int]:
    """Return a call without arguments.

    Parameters
    ----------
    function : C function
        One that returns an FMI status.
    *arguments
        C values: results of `from_param` and `byref`, or objects such as `c_double`, whose value at the
        moment of the call is passed. A Python number would not be of the right type.

    Returns
    -------
    callable
        Makes the call and returns its status.
    """
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None  # ctypes finds no function at 0
    return partial(_Function(address), *arguments)


_ROUNDING = 1e-12
"""Of the step: what the moment of its end may lack."""


class LinearInputs:
    """What the FMU is given within a step, of a request that says where each line begins and ends.

    Parameters
    ----------
    request : ctypes array of double
        The request block: time, step size, the inputs at the end of the step (those that move first), and
        where they begin.
    plan : Plan
        What is exchanged.

    Attributes
    ----------
    values : ctypes array of double
        Time, step size, and the inputs of the moment.
    slopes : ctypes array of double
        Derivatives in time of the inputs that move.
    """

    def __init__(self, request: Any, plan: Plan) -> None:
        count = plan.linear_count
        self.values = (ctypes.c_double * (len(request) - count))()
        self.slopes = (ctypes.c_double * count)()
        self._request, self._all = values_of(request), values_of(self.values)
        self._moving, self._slopes = self._all[2 : 2 + count], values_of(self.slopes)
        self._end, self._begin = self._request[2 : 2 + count], self._request[-count:]
        self._substeps, self._start, self._span = plan.substeps, 0.0, 1.0

    def stand(self) -> None:
        """Give the inputs of the request as they are, as in an initialisation."""
        self._all[:] = self._request[: len(self._all)]

    def aim(self) -> None:
        """Take the lines of a new request, and give the inputs of its begin."""
        self._start, self._span = self._request[0], self._request[1] * self._substeps
        self._slopes[:] = (self._end - self._begin) / self._span
        self.stand()
        self._moving[:] = self._begin

    def move(self, time: float) -> None:
        """Give the inputs of a moment [s]; one that stays keeps its value to the bit, and so does the end."""
        share = (time - self._start) / self._span
        there = share >= 1.0 - _ROUNDING
        self._moving[:] = self._end if there else self._begin + share * (self._end - self._begin)


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
        self.reply = (ctypes.c_double * max(sum(group.count for group in plan.outputs), 1))()
        self.lost = False

    def initialise(self, start_time: float, parameters: Settings, with_inputs: bool) -> None:
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

    def run(self, requests: Float, replies: Float, report: Callable[[int], object]) -> None:
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
