"""The interface of FMU instances, and the plan of what an instance exchanges with its FMU.

The plan is sent to the worker process, and the C calls of a step are prepared from it.
"""

import ctypes
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import numpy as np

from reporting.arrays import Float

if TYPE_CHECKING:
    from ctypes import _NamedFuncPointer as CFunction  # a name for type checkers alone

Interface = Literal["co-simulation", "model-exchange"]

SOLVER_TOLERANCE = 1e-6
"""Relative tolerance of our solver, unless the binding states one or the FMU a smaller one."""

REPORT_PERIOD = 0.02
"""Seconds after which a run of many steps reports how many it has made."""

DoubleBlock = ctypes.Array[ctypes.c_double]
"""A C array of doubles."""


class InitialValue(NamedTuple):
    """Values of a variable that are set before the initialisation.

    Attributes
    ----------
    kind : str
        FMI base type.
    reference : int
        Value reference.
    values : list of float or list of str
        One value for a scalar, all elements for an array; texts for a String.
    """

    kind: str
    reference: int
    values: list[float] | list[str]


InitialValues = list[InitialValue]


@dataclass(frozen=True)
class VariableGroup:
    """Variables of one base type that are set or read by one call.

    Attributes
    ----------
    kind : str
        FMI base type: Real, Integer, Boolean; Float64, Int32, ... in FMI 3.
    references : tuple of int
        Value references, in the order of the values.
    count : int
        The number of values; with arrays it exceeds that of the references.
    linear : bool
        Whether the values change linearly over a step. Such inputs come first in the block.
    """

    kind: str
    references: tuple[int, ...]
    count: int
    linear: bool = False


@dataclass(frozen=True, kw_only=True)
class FmuIdentity:
    """Declarations of an FMU that an instance of it needs.

    Attributes
    ----------
    fmi_version, guid, model_identifier : str
        As declared; the identifier is that of `interface`.
    interface : {"co-simulation", "model-exchange"}
        Interface by which it is run.
    states, event_indicators : int
        Numbers of continuous states and event indicators (model exchange).
    completed_step : bool
        Whether it needs a call after each completed integrator step (model exchange).
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
        """The major version of FMI: 1, 2 or 3."""
        return int(self.fmi_version[0])


@dataclass(frozen=True)
class Plan:
    """How an instance is made, and what each call exchanges with it.

    Attributes
    ----------
    instance_name : str
        Name that FMI requires.
    inputs, outputs : tuple of VariableGroup
        Variables that are set and read at every step, in the order of request and reply.
    substeps : int
        Communication steps of the FMU between two observations.
    tolerance : float or None
        Relative tolerance that is passed to the FMU.
    solver_tolerance : float
        Relative tolerance of our solver (model exchange).
    stop_time : float or None
        End of the experiment [s], which is passed to the FMU.
    configuration : list of InitialValue
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
    configuration: InitialValues = field(default_factory=list)

    @property
    def linear_count(self) -> int:
        """The number of input values that change linearly over a step."""
        return sum(group.count for group in self.inputs if group.linear)

    @property
    def input_count(self) -> int:
        """The number of values after time and step size in a request.

        These are all inputs, and then the values of linear inputs at the beginning of the step.
        """
        return sum(group.count for group in self.inputs) + self.linear_count


# ---------------------------------------------------------------------- C calls

CType = Any
"""A simple C type by ctypes, which states none for their common use."""
_C_TYPES: dict[str, CType] = {
    "Real": ctypes.c_double,
    "Float64": ctypes.c_double,
    "Float32": ctypes.c_float,
    "Integer": ctypes.c_int,
    "Int8": ctypes.c_int8,
    "Int16": ctypes.c_int16,
    "Int32": ctypes.c_int32,
    "Int64": ctypes.c_int64,
    "UInt8": ctypes.c_uint8,
    "UInt16": ctypes.c_uint16,
    "UInt32": ctypes.c_uint32,
    "UInt64": ctypes.c_uint64,
}
_BOOLEAN_TYPES: dict[int, CType] = {1: ctypes.c_ubyte, 2: ctypes.c_int, 3: ctypes.c_bool}
"""C type of a Boolean, by the major version of FMI."""


class GroupArguments(NamedTuple):
    """The arguments of a C function that sets or reads a group, after the instance.

    Attributes
    ----------
    values : tuple
        C values.
    convert : callable or None
        Converts the numbers before they are set or after they are read. None for doubles, which the
        FMU reads and writes in place.
    """

    values: tuple[object, ...]
    convert: Callable[[], object] | None


def values_of(block: DoubleBlock) -> Float:
    """Return an array that shares the memory of a C array of doubles."""
    return np.frombuffer(memoryview(block).cast("B"))


def group_arguments(
    fmi_version: int, group: VariableGroup, doubles: DoubleBlock, begin: int, *, sent: bool
) -> GroupArguments:
    """Prepare the arguments of a C function that sets or reads a group of variables.

    Parameters
    ----------
    fmi_version : int
        1, 2 or 3.
    group : VariableGroup
        The variables; enumerations are integers, see `FmuDescription.exchange_kind`.
    begin : int
        Position of the group's first value in `doubles`.
    sent : bool
        Whether the values are set, not read.
    """
    c_type = _BOOLEAN_TYPES[fmi_version] if group.kind == "Boolean" else _C_TYPES[group.kind]
    convert = None
    # Values of type double are passed as they stand in `doubles`; others are converted to or from
    # an array of their own type.
    if c_type is ctypes.c_double and group.count:
        values = (c_type * group.count).from_buffer(doubles, 8 * begin)
    else:
        values = (c_type * group.count)()
        block_values = values_of(doubles)[begin : begin + group.count]
        fmu_values = np.ctypeslib.as_array(values)
        if sent:
            convert = partial(np.copyto, fmu_values, block_values, casting="unsafe")
        else:
            convert = partial(np.copyto, block_values, fmu_values, casting="unsafe")
    reference_count = len(group.references)
    references = (ctypes.c_uint * reference_count)(*group.references)
    arguments: tuple[object, ...] = (
        ctypes.byref(references),
        ctypes.c_size_t.from_param(reference_count),
        ctypes.byref(values),
    )
    if fmi_version == 3:
        arguments += (ctypes.c_size_t.from_param(group.count),)
    return GroupArguments(arguments, convert)


# Without declared types ctypes passes C values as they are, in a third of the time.
_Function = ctypes.CFUNCTYPE(ctypes.c_int)


def prepare_call(function: "CFunction", *arguments: object) -> Callable[[], int]:
    """Bind a C function to fixed arguments, so that a step neither looks up nor converts anything.

    Parameters
    ----------
    function : C function
        Function that returns an FMI status.
    *arguments
        C values: results of `from_param` and `byref`, or objects such as `c_double`, whose value at
        the time of the call is passed. A Python number would not be of the right type.

    Returns
    -------
    callable
        Makes the call and returns its status.
    """
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None  # ctypes finds no function at 0
    return partial(_Function(address), *arguments)


_ROUNDING = 1e-12
"""Fraction of a step by which a time may miss the end of the step."""


class LinearInputs:
    """Inputs that change linearly over a step, by their derivatives in FMI.

    The request block holds their values at the end of the step, before the other inputs, and in its
    last part their values at the beginning of the step.

    Parameters
    ----------
    request : C array of double
        The request: time, step size, all inputs at the end of the step beginning with the linear
        ones, and the linear ones at its beginning.

    Attributes
    ----------
    values : C array of double
        Time, step size, and all inputs at the present time within the step.
    slopes : C array of double
        The derivatives in time of the linear inputs.
    """

    def __init__(self, request: DoubleBlock, plan: Plan) -> None:
        count = plan.linear_count
        self.values = (ctypes.c_double * (len(request) - count))()
        self.slopes = (ctypes.c_double * count)()
        self._request = values_of(request)
        self._at_end = self._request[2 : 2 + count]
        self._at_begin = self._request[-count:]
        self._present = values_of(self.values)
        self._present_linear = self._present[2 : 2 + count]
        self._slopes = values_of(self.slopes)
        self._substeps = plan.substeps
        self._start_time = 0.0
        self._duration = 1.0

    def hold(self) -> None:
        """Set the present inputs to those at the end of the step, as for an initialisation."""
        self._present[:] = self._request[: len(self._present)]

    def begin_step(self) -> None:
        """Compute the slopes for a new request, and set the inputs to the beginning of the step."""
        self._start_time = self._request[0]
        self._duration = self._request[1] * self._substeps
        self._slopes[:] = (self._at_end - self._at_begin) / self._duration
        self.hold()
        self._present_linear[:] = self._at_begin

    def move_to(self, time: float) -> None:
        """Set the linear inputs to their values at a time [s].

        At the end of the step they equal the request bit by bit, despite rounding of the time.
        """
        fraction = (time - self._start_time) / self._duration
        if fraction >= 1.0 - _ROUNDING:
            self._present_linear[:] = self._at_end
        else:
            change = fraction * (self._at_end - self._at_begin)
            self._present_linear[:] = self._at_begin + change


def run_steps(
    step: Callable[[], object],
    requests: Float,
    replies: Float,
    report: Callable[[int], object],
    *,
    request: Float,
    reply: Float,
    report_period: float = REPORT_PERIOD,
) -> None:
    """Make many steps one by one; stop after one with an output that is not finite.

    Parameters
    ----------
    step : callable
        Makes the step in `request`, and writes its outputs to `reply`.
    requests, replies, report
        As for `Instance.run`.
    request, reply : ndarray
        The request and the reply of one step.
    report_period : float
        Seconds between reports; at 0 each step is reported.
    """
    sum_of_squares = reply.dot
    now = time.monotonic
    steps_done = 0
    next_report = now() + report_period
    try:
        for request_row, reply_row in zip(requests, replies, strict=True):
            request[:] = request_row
            step()
            reply_row[:] = reply
            steps_done += 1
            # a fast test first: the sum of squares can be infinite for large values, too
            if not math.isfinite(sum_of_squares(reply)) and not np.isfinite(reply).all():
                return
            if now() >= next_report:
                report(steps_done)
                next_report = now() + report_period
    finally:
        report(steps_done)


class Instance(Protocol):
    """An FMU instance in this process or in a worker, or several coupled FMUs.

    Attributes
    ----------
    request, reply : C array of double
        Blocks of memory that are allocated once. The request holds time, step size and all inputs,
        the reply all outputs. Integers and Booleans are stored as doubles.
    lost : bool
        Whether the instance can no longer be used.
    report_period : float
        Seconds between two reports of a run of many steps; at 0 each step is reported.
    """

    request: DoubleBlock
    reply: DoubleBlock
    lost: bool
    report_period: float = REPORT_PERIOD

    def __init__(self, plan: Plan) -> None:
        output_count = sum(group.count for group in plan.outputs)
        self.request = (ctypes.c_double * (2 + plan.input_count))()
        self.reply = (ctypes.c_double * max(output_count, 1))()
        self.lost = False

    def initialise(self, start_time: float, parameters: InitialValues, with_inputs: bool) -> None:
        """Set parameters, and inputs if asked for, and go to the first communication point.

        Parameters
        ----------
        start_time : float
            Start time [s].
        parameters : list of InitialValue
            Values that are set before the initialisation.
        with_inputs : bool
            Whether the inputs of the request are set during the initialisation; if not, the FMU's
            start values hold.

        Raises
        ------
        FmuCallError
            If a call fails, or the FMU logs an error meanwhile.
        """

    def step(self) -> None:
        """Make the step that the request describes; its outputs are then in the reply.

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
        """Make many steps; stop after one with an output that is not finite.

        Parameters
        ----------
        requests : (N, 2 + n_inputs) ndarray
            The request of each step.
        replies : (N, n_outputs) ndarray
            Filled with the reply of each step.
        report : callable
            Called with the number of steps made, from time to time and at the end, even if a step
            fails.

        Raises
        ------
        FmuCallError, FmuWorkerError
            As `step`.
        """
        run_steps(
            self.step,
            requests,
            replies,
            report,
            request=values_of(self.request),
            reply=values_of(self.reply),
            report_period=self.report_period,
        )

    def read(self) -> None:
        """Read the present outputs into the reply."""

    def save(self) -> bytes:
        """Return the serialised state."""

    def restore(self, content: bytes) -> None:
        """Restore a serialised state.

        Raises
        ------
        FmuCallError
            If a call fails.
        FmuStateError
            If the FMU refuses the state in its log.
        """

    def reset(self) -> None:
        """Return to the state after instantiation."""

    def take_log(self) -> list[tuple[int, str]]:
        """Return status and text of the messages that the FMU has logged, and clear them."""

    def close(self) -> None:
        """Free the instance."""
