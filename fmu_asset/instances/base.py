"""An FMU instance in this process, alike for all versions of FMI and both interfaces.

A step is one batch of prepared set calls, the step itself, and one batch of get calls. The worker
process runs this; `FmiAsset` runs it directly if isolation is switched off.
"""

import ctypes
import itertools
import os
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import chdir, contextmanager
from typing import Any, ClassVar, Literal, NamedTuple

from fmpy.fmi1 import FMICallException

from fmu_asset.errors import (
    FmuCallError,
    FmuEndedError,
    FmuError,
    FmuStateError,
    FmuWorkerError,
    visible,
)

from .fmi_callbacks import callbacks, register, unregister
from .plan import (
    DoubleBlock,
    InitialValues,
    Instance,
    LinearInputs,
    Plan,
    VariableGroup,
    group_arguments,
    prepare_call,
)
from .statuses import (
    ACCEPTED,
    DISCARD,
    ERROR,
    FATAL,
    PENDING,
    instantiation_failure,
    refuse_negative,
    status_name,
)

_MESSAGES_IN_ERROR = 10
_LONGEST_LOG = 1000
_NO_STOP_TIME = (
    ". No end of the experiment was passed to it: if it asks for one, give `stop_time` in the "
    "table [binding] of its binding"
)
_LOST = "The instance was lost to a fatal error; reset the asset to go on."

FmpyInstance = Any
"""An instance by fmpy, which states no types."""

_instance_numbers = itertools.count(1)


class FmiCall(NamedTuple):
    """A prepared call that sets or reads a group of variables.

    Attributes
    ----------
    function : str
        Name of the C function, without the prefix of its version.
    call : callable
        Makes the call and returns its status.
    convert_before, convert_after : callable or None
        Converts values of the block before they are set, or into the block after they are read;
        None if no conversion is needed.
    """

    function: str
    call: Callable[[], int]
    convert_before: Callable[[], object] | None = None
    convert_after: Callable[[], object] | None = None


class FmuInstance(Instance):
    """An FMU instance in this process, by way of fmpy.

    Subclasses implement the two interfaces; `classes` names fmpy's class for each version of FMI.

    Attributes
    ----------
    messages : deque of (int, str)
        The last messages of the FMU that were not taken yet: status and text.

    Raises
    ------
    FmuCallError
        If the binary cannot be loaded or the instance cannot be made.
    """

    # An FMU, or fmpy, may change the working directory: `with chdir(".")` comes back to it.

    classes: ClassVar[dict[int, type[FmpyInstance]]]
    """fmpy's class for each version of FMI: that of FMI 2, or one with its methods."""

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        # time and step size as views of the first two numbers of the request block
        self._step_begin = ctypes.c_double.from_buffer(self.request, 0)
        self._step_size = ctypes.c_double.from_buffer(self.request, 8)
        self._plan = plan
        self._version = plan.fmu.major_version
        self._prefix = "fmi" if self._version == 1 else f"fmi{self._version}"
        self._linear_inputs = LinearInputs(self.request, plan) if plan.linear_count else None
        self._name = f"{plan.instance_name}-{os.getpid()}-{next(_instance_numbers)}"
        self.messages: deque[tuple[int, str]] = deque(maxlen=_LONGEST_LOG)
        self._error_count = 0
        self._end_time: float | None = None
        self._phase: Literal["instantiated", "stepping"] = "instantiated"
        self._fmu = self._load()
        # prepare the calls of a step
        self._values = self.request if self._linear_inputs is None else self._linear_inputs.values
        self._set_calls = self._group_calls("Set", plan.inputs, self._values, 2)
        self._get_calls = self._group_calls("Get", plan.outputs, self.reply, 0)
        self._per_step_calls = (
            [] if self._linear_inputs is None else self._interpolation_calls(self._linear_inputs)
        )

    def _load(self) -> FmpyInstance:
        """Load the binary, instantiate the FMU, and return fmpy's object for it."""
        register(self._name, self)
        with chdir("."):
            try:
                fmu = self._instantiate()
            except Exception as error:
                unregister(self._name)
                sentence = instantiation_failure(error)
                raise FmuCallError(sentence, self._last_messages()) from error
        for function in vars(fmu.dll).values():
            # fmpy ignores negative statuses
            if getattr(function, "restype", None) is ctypes.c_int:
                function.errcheck = refuse_negative
        return fmu

    def _instantiate(self) -> FmpyInstance:
        """Instantiate the FMU and return fmpy's object for it."""
        plan = self._plan
        fmu = self.classes[self._version](
            guid=plan.fmu.guid,
            modelIdentifier=plan.fmu.model_identifier,
            unzipDirectory=plan.folder,
            instanceName=self._name,
        )
        if self._version == 1:
            fmu.instantiate(loggingOn=True, functions=callbacks(1))
        elif self._version == 2:
            fmu.instantiate(loggingOn=True, callbacks=callbacks(2))
        else:
            fmu.instantiate(loggingOn=True, logMessage=self.log)
        if not fmu.component:
            raise RuntimeError("no instance was returned")
        return fmu

    # ------------------------------------------------------------------ what an interface does

    def _go_to_start(
        self, start_time: float, parameters: InitialValues, *, with_inputs: bool
    ) -> None:
        """Set the parameters and initialise the FMU; see `initialise`."""
        fmu = self._fmu
        experiment = {
            "startTime": start_time,
            "stopTime": self._plan.stop_time,
            "tolerance": self._plan.tolerance,
        }
        if self._version < 3:
            fmu.setupExperiment(**experiment)
        if self._plan.configuration:
            fmu.enterConfigurationMode()
            self._set_initial_values(self._plan.configuration)
            fmu.exitConfigurationMode()
        self._set_initial_values(parameters)
        if self._version < 3:
            fmu.enterInitializationMode()
        else:
            fmu.enterInitializationMode(**experiment)
        if with_inputs:
            self._make_calls(self._set_calls)
        fmu.exitInitializationMode()

    @abstractmethod
    def _do_step(self) -> None:
        """Make the step from `_step_begin` over `_step_size`; the inputs are set already."""

    @abstractmethod
    def _interpolation_calls(self, linear_inputs: LinearInputs) -> list[FmiCall]:
        """Return the calls that make linear inputs change over a step.

        Co-simulation sets their derivatives; model exchange sets the inputs at each evaluation.
        """

    def _send_inputs(self) -> None:
        """Set the inputs of the request."""
        if self._linear_inputs is not None:
            self._linear_inputs.begin_step()
        self._make_calls(self._set_calls + self._per_step_calls)

    def _send_interpolated_inputs(self, linear_inputs: LinearInputs) -> None:
        """Set linear inputs at a later communication point between two observations."""
        linear_inputs.move_to(self._step_begin.value)
        self._make_calls(self._set_calls + self._per_step_calls)

    def _terminate_and_free(self) -> None:
        """Terminate the simulation if it has begun, and free the instance.

        An instance that reports a fatal error is not freed, since that can crash.
        """
        if self._phase == "stepping":
            try:
                self._fmu.terminate()
            except FMICallException as error:
                if error.status == FATAL:
                    return
        self._fmu.freeInstance()

    # ------------------------------------------------------------------ calls of `Instance`

    def initialise(self, start_time: float, parameters: InitialValues, with_inputs: bool) -> None:
        """Set parameters, and inputs if asked for, and go to the first communication point."""
        previous_error_count = self._error_count
        if self._linear_inputs is not None:
            self._linear_inputs.hold()
        with self._fmpy_calls("initialisation"):
            self._go_to_start(start_time, parameters, with_inputs=with_inputs)
            self._phase = "stepping"
        if self._error_count > previous_error_count:
            hint = "" if self._plan.stop_time is not None else _NO_STOP_TIME
            raise FmuCallError(f"The FMU refused its initialisation{hint}.", self._last_messages())

    def step(self) -> None:
        """Make the communication step that the request describes."""
        if self.lost:
            raise FmuWorkerError(_LOST)
        if self._end_time is not None:
            raise FmuEndedError(
                f"The FMU has ended its simulation at t = {self._end_time:g} s; reset the asset to "
                "start again.",
                time=self._end_time,
            )
        self._send_inputs()
        if self._plan.substeps == 1:
            self._do_step()
        else:
            self._do_substeps()
        self._make_calls(self._get_calls, "reading outputs")

    def _do_substeps(self) -> None:
        """Make all communication steps between two observations.

        If one fails after the first, the instance is lost, because it cannot return to the last
        observation.
        """
        begin = self._step_begin.value
        size = self._step_size.value
        substep = 0
        try:
            for substep in range(self._plan.substeps):
                self._step_begin.value = begin + substep * size
                if substep and self._linear_inputs is not None:
                    self._send_interpolated_inputs(self._linear_inputs)
                self._do_step()
        except FmuError as error:
            if substep == 0 or isinstance(error, FmuEndedError):
                raise
            # between two observations it cannot go back to the last one
            self.lost = True
            sentence = (
                f"{error.sentence} It was step {substep + 1} of the {self._plan.substeps} between "
                "two observations: reset the asset or restore a state to go on."
            )
            raise type(error)(sentence, error.messages) from error
        finally:
            # restore the request block: the caller compares it with those of later starts
            self._step_begin.value = begin

    def read(self) -> None:
        """Read the present outputs into the reply."""
        with self._fmpy_calls("reading the outputs"):
            self._make_calls(self._get_calls, "reading outputs")

    def save(self) -> bytes:
        """Return the serialised FMU state."""
        fmu = self._fmu
        with self._fmpy_calls("saving the state"):
            state = fmu.getFMUState()
            try:
                return bytes(fmu.serializeFMUState(state))
            finally:
                fmu.freeFMUState(state)

    def restore(self, content: bytes) -> None:
        """Restore a serialised FMU state."""
        fmu = self._fmu
        previous_error_count = self._error_count
        with self._fmpy_calls("restoring the state"):
            state = fmu.deserializeFMUState(content)
            try:
                fmu.setFMUState(state)
            finally:
                fmu.freeFMUState(state)
        self._end_time = None
        if self._error_count > previous_error_count:
            raise FmuStateError("The FMU refused the state.", self._last_messages())

    def reset(self) -> None:
        """Return the instance to its state after instantiation."""
        with self._fmpy_calls("reset"):
            if self._phase == "stepping":
                self._fmu.terminate()
            self._fmu.reset()
            self._phase = "instantiated"
            self._end_time = None

    def log(self, environment: object, status: int, category: bytes, message: bytes) -> None:
        """Store a message of the FMU; the signature is that of fmpy's callback in FMI 3."""
        if status in (ERROR, FATAL):
            self._error_count += 1
        text = (message or b"").decode("utf-8", "replace").rstrip()
        self.messages.append((int(status), visible(text)))

    def take_log(self) -> list[tuple[int, str]]:
        """Return status and text of the messages that the FMU has logged, and clear them."""
        messages = list(self.messages)
        self.messages.clear()
        return messages

    def close(self) -> None:
        """Free the instance, unless a fatal error has occurred: freeing it could then crash."""
        unregister(self._name)
        if self.lost:
            return
        self.lost = True
        with chdir("."):
            self._terminate_and_free()

    # ------------------------------------------------------------------ C calls

    def _prepared_call(self, name: str, *arguments: object) -> Callable[[], int]:
        """Return a prepared call of a C function, named without the prefix of its version."""
        model_prefix = f"{self._plan.fmu.model_identifier}_" if self._version == 1 else ""
        function = getattr(self._fmu.dll, f"{model_prefix}{self._prefix}{name}")
        component = ctypes.c_void_p.from_param(self._fmu.component)
        return prepare_call(function, component, *arguments)

    def _group_calls(
        self,
        verb: Literal["Set", "Get"],
        groups: tuple[VariableGroup, ...],
        doubles: DoubleBlock,
        begin: int,
    ) -> list[FmiCall]:
        """Return the calls that set or read groups of variables.

        The groups follow one another in the block of doubles from position `begin` on.
        """
        is_sent = verb == "Set"
        calls = []
        for group in groups:
            arguments = group_arguments(self._version, group, doubles, begin, sent=is_sent)
            function = f"{verb}{group.kind}"
            call = self._prepared_call(function, *arguments.values)
            if is_sent:
                calls.append(FmiCall(function, call, convert_before=arguments.convert))
            else:
                calls.append(FmiCall(function, call, convert_after=arguments.convert))
            begin += group.count
        return calls

    def _set_initial_values(self, initial_values: InitialValues) -> None:
        """Set start values and parameters, one variable after the other."""
        for kind, reference, values in initial_values:
            if kind == "String":
                self._fmu.setString([reference], values)
                continue
            doubles = (ctypes.c_double * len(values))(*map(float, values))
            group = VariableGroup(kind, (reference,), len(values))
            self._make_calls(self._group_calls("Set", (group,), doubles, 0))

    def _make_calls(self, calls: list[FmiCall], purpose: str = "setting inputs") -> None:
        """Make prepared calls in order; raise an error that names the purpose if one is refused."""
        for function, call, convert_before, convert_after in calls:
            if convert_before is not None:
                convert_before()
            status = call()
            if status not in ACCEPTED:
                raise self._call_error(f"{self._prefix}{function}", status, purpose)
            if convert_after is not None:
                convert_after()

    @contextmanager
    def _fmpy_calls(self, purpose: str) -> Iterator[None]:
        """Turn failures of fmpy's methods into `FmuCallError`, and keep the working directory."""
        if self.lost:
            raise FmuWorkerError(_LOST)
        with chdir("."):
            try:
                yield
            except FMICallException as error:
                status = int(error.status)
                raise self._call_error(str(error.function), status, purpose) from error

    # ------------------------------------------------------------------ errors

    def _ended_error(self, time: float) -> FmuEndedError:
        """Record that the FMU has ended its simulation at a time [s], and return the error."""
        self._end_time = time
        return FmuEndedError(
            f"The FMU asked to end the simulation in {self._step_label()}, and ended at "
            f"t = {time:g} s.",
            self._last_messages(),
            time,
        )

    def _step_label(self) -> str:
        """Return the name of the present step for messages."""
        return f"the step from t = {self._step_begin.value:g} s"

    def _call_error(self, function: str, status: int, purpose: str) -> FmuCallError:
        """Return the error for a call that the FMU did not accept, such as in "initialisation".

        The instance then counts as lost, unless the FMU only discarded the call. FMI would allow
        some further calls to it; none is made, and the asset replaces the instance.
        """
        self.lost = self.lost or status != DISCARD
        consequence = {
            DISCARD: "the FMU did not accept it and stays where it was; try other inputs or a "
            "smaller step",
            ERROR: "its values are no longer to be trusted; reset the asset or restore a state",
            PENDING: "asynchronous steps are not supported; export it to step synchronously",
        }.get(status, "the instance is lost; reset the asset or restore a state")
        if purpose == "initialisation" and self._plan.stop_time is None:
            consequence += _NO_STOP_TIME
        return FmuCallError(
            f"{function} returned {status_name(status)} in {purpose}: {consequence}.",
            self._last_messages(),
        )

    def _last_messages(self) -> list[str]:
        """Return the last messages of the FMU, and clear its log."""
        return [text for _, text in self.take_log()][-_MESSAGES_IN_ERROR:]
