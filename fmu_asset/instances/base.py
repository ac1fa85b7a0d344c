"""One instance of an FMU in this process: one batched set and get per step, whatever the FMI version.

The worker process runs this; `FmiAsset` runs it directly when it is told not to isolate. Values travel in two
blocks of doubles that are allocated once: `request` is time, step size, then all inputs; `reply` is all
outputs. Integers and Booleans are doubles in the blocks.
"""

import ctypes
import os
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

from fmpy.fmi1 import FMICallException

from fmu_asset.errors import FmuCallError, FmuEndedError, FmuError, FmuStateError, FmuWorkerError

from .block import Block, Lines, prepared
from .messages import Mailbox, callbacks
from .plan import Group, Plan, Settings
from .series import Series, run

STATUS_NAMES = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
OK, WARNING, DISCARD, ERROR, FATAL, PENDING = range(6)
ACCEPTED = frozenset({OK, WARNING})
_MESSAGES_IN_ERROR = 10

Calls = list[tuple[str, Callable[[], int], Callable[[], None] | None]]
"""Name of the function, the prepared call, and what converts the values before or after it, if needed."""


class FmuInstance(ABC):
    """One instance; the subclasses speak the FMI versions.

    Parameters
    ----------
    plan : Plan
        What is exchanged.

    Attributes
    ----------
    request, reply : ctypes array of double
        The blocks; see the module.

    Raises
    ------
    FmuCallError
        If the binary cannot be loaded or the instance cannot be made.
    """

    def __init__(self, plan: Plan) -> None:
        self.request = (ctypes.c_double * (2 + plan.input_count))()
        self.reply = (ctypes.c_double * max(plan.output_count, 1))()
        # Communication point and step size of a step, where they stand in the request.
        self._begin = ctypes.c_double.from_buffer(self.request, 0)
        self._size = ctypes.c_double.from_buffer(self.request, 8)
        self._plan = plan
        self._substeps = plan.substeps
        self._lines = Lines(self.request, plan) if plan.linear_count else None
        self._mailbox = Mailbox(plan.instance_name)
        self._lost = False
        self._ended: float | None = None
        self._phase = "instantiated"
        with _guarded_directory():
            try:
                self._fmu = self._instantiate(plan, self._mailbox)
            except Exception as error:
                messages = self._texts()
                self._mailbox.close()
                raise FmuCallError(_why_not_instantiated(error), messages) from error
        for function in vars(self._fmu.dll).values():
            # fmpy lets negative statuses pass.
            if getattr(function, "restype", None) is ctypes.c_int:
                function.errcheck = _refuse_negative
        self._component = self._fmu.component
        self._values = self.request if self._lines is None else self._lines.values
        self._set = self._blocks("Set", plan.inputs, self._values, 2)
        self._get = self._blocks("Get", plan.outputs, self.reply, 0)
        self._moving = [] if self._lines is None else self._calls_of(self._lines)

    _fmpy_class: ClassVar[type[Any]]
    """fmpy's class for the FMI version and interface."""

    # ------------------------------------------------------------------ what an FMI version says

    def _made(self, plan: Plan, name: str) -> Any:
        """Return fmpy's object, not yet instantiated."""
        return self._fmpy_class(
            guid=plan.guid,
            modelIdentifier=plan.model_identifier,
            unzipDirectory=plan.folder,
            instanceName=name,
        )

    def _instantiate(self, plan: Plan, mailbox: Mailbox) -> Any:
        """Return fmpy's object, instantiated."""
        fmu = self._made(plan, mailbox.name)
        if plan.fmi_version == 3:
            fmu.instantiate(loggingOn=True, logMessage=mailbox.log)
        else:
            given = {"functions" if plan.fmi_version == 1 else "callbacks": callbacks(plan.fmi_version)}
            fmu.instantiate(loggingOn=True, **given)
        return fmu

    def _c_name(self, name: str) -> str:
        """Return what the standard calls a C function such as SetReal."""
        return f"fmi{name}" if self._plan.fmi_version == 1 else f"fmi{self._plan.fmi_version}{name}"

    def _function(self, name: str, fmu: Any = None) -> Callable[..., int]:
        """Return a C function such as SetReal, with the types that fmpy has given it."""
        before = f"{self._plan.model_identifier}_" if self._plan.fmi_version == 1 else ""
        function: Callable[..., int] = getattr((fmu or self._fmu).dll, before + self._c_name(name))
        return function

    def _initialise(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        """Bring the instance to its first communication point."""
        self._start(start_time, parameters, with_inputs=with_inputs)

    def _start(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        """Initialise, as far as versions 2 and 3 do it alike whatever the interface."""
        fmu, tolerance = self._fmu, self._plan.tolerance
        experiment = {"startTime": start_time, "tolerance": tolerance}
        if self._plan.fmi_version == 2:
            fmu.setupExperiment(**experiment)
        if self._plan.configuration:
            fmu.enterConfigurationMode()
            self._apply(self._plan.configuration)
            fmu.exitConfigurationMode()
        self._apply(parameters)
        fmu.enterInitializationMode(**(experiment if self._plan.fmi_version == 3 else {}))
        if with_inputs:
            self._set_values(self._set)
        fmu.exitInitializationMode()

    @abstractmethod
    def _advance(self) -> None:
        """Make one communication step from `_begin` over `_size`; the inputs are set."""

    @abstractmethod
    def _calls_of(self, lines: Lines) -> Calls:
        """Return what makes inputs move: calls that tell how fast, or that set them again."""

    def _send(self) -> None:
        """Set the inputs of the request block."""
        if self._lines is None:
            self._set_values(self._set)
        else:
            self._lines.aim()
            self._set_values(self._set + self._moving)

    def _follow(self, lines: Lines) -> None:
        """Set the inputs where their lines are at a later communication point of the step."""
        lines.move(self._begin.value)
        self._set_values(self._set + self._moving)

    def _receive(self) -> None:
        """Read the outputs into the reply block."""
        for name, call, convert in self._get:
            status = call()
            if status not in ACCEPTED:
                raise self._call_error(f"fmi{self._plan.fmi_version}{name}", status, "reading outputs")
            if convert is not None:
                convert()

    def _free(self) -> None:
        """Terminate and free the instance."""
        if self._phase == "stepping":
            try:
                self._fmu.terminate()
            except FMICallException as error:
                if error.status == FATAL:
                    return
        self._fmu.freeInstance()

    # ------------------------------------------------------------------ what the twin asks

    def initialise(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        """Set parameters, and inputs if wanted, and bring the instance to its first communication point.

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
        errors = self._mailbox.errors
        if self._lines is not None:
            self._lines.stand()
        with self._calls("initialisation"):
            self._initialise(start_time, parameters, with_inputs=with_inputs)
            self._phase = "stepping"
        if self._mailbox.errors > errors:
            raise FmuCallError("The FMU refused its initialisation.", self._texts())

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
        if self._lost:
            raise FmuWorkerError("The instance was lost to a fatal error; reset the asset to go on.")
        if self._ended is not None:
            raise FmuEndedError(
                f"The FMU has ended its simulation at t = {self._ended:g} s; reset the asset to start anew.",
                time=self._ended,
            )
        self._send()
        if self._substeps == 1:
            self._advance()
        else:
            self._advance_many()
        self._receive()

    def _advance_many(self) -> None:
        first, size = self._begin.value, self._size.value
        for number in range(self._substeps):
            self._begin.value = first + number * size
            try:
                if number and self._lines is not None:
                    self._follow(self._lines)
                self._advance()
            except FmuEndedError:
                raise
            except FmuError as error:
                if number == 0:
                    raise
                # Between two observations it cannot go back to the last one.
                self._lost = True
                raise type(error)(
                    f"{error.sentence} It was step {number + 1} of the {self._substeps} between two "
                    "observations: reset the asset or restore a state to go on.",
                    error.messages,
                ) from error

    def run(self, series: Series, report: Callable[[], object]) -> None:
        """Make many steps; see `series.run`."""
        run(self, series, report)

    def read(self) -> None:
        """Read the outputs of this moment into the reply block."""
        with self._calls("reading the outputs"):
            self._receive()

    def save(self) -> bytes:
        """Return the serialised FMU state."""
        fmu = self._fmu
        with self._calls("saving the state"):
            state = fmu.getFMUState()
            try:
                return bytes(fmu.serializeFMUState(state))
            finally:
                fmu.freeFMUState(state)

    def restore(self, content: bytes) -> None:
        """Restore a serialised FMU state.

        Raises
        ------
        FmuCallError
            If a call fails.
        FmuStateError
            If the FMU refuses the state in its log.
        """
        fmu, errors = self._fmu, self._mailbox.errors
        with self._calls("restoring the state"):
            state = fmu.deserializeFMUState(content)
            try:
                fmu.setFMUState(state)
            finally:
                fmu.freeFMUState(state)
        self._ended = None
        if self._mailbox.errors > errors:
            raise FmuStateError("The FMU refused the state.", self._texts())

    def reset(self) -> None:
        """Bring the instance back to the moment after its instantiation."""
        with self._calls("reset"):
            if self._phase == "stepping":
                self._fmu.terminate()
            self._fmu.reset()
            self._phase, self._ended = "instantiated", None

    def take_log(self) -> list[tuple[int, str]]:
        """Return and forget the messages that the FMU has logged: status and text."""
        return self._mailbox.take()

    @property
    def has_log(self) -> bool:
        """Whether there are messages."""
        return self._mailbox.filled

    @property
    def lost(self) -> bool:
        """Whether a fatal error has made the instance unusable."""
        return self._lost

    def close(self) -> None:
        """Free the instance; one that was lost to a fatal error is left alone, since freeing it can crash."""
        self._mailbox.close()
        if self._lost:
            return
        self._lost = True
        with _guarded_directory():
            self._free()

    # ------------------------------------------------------------------ inside

    def _blocks(self, verb: str, groups: tuple[Group, ...], doubles: Any, begin: int) -> Calls:
        calls: Calls = []
        for group in groups:
            name = f"{verb}{group.kind}"
            block = Block(self._plan.fmi_version, self._component, group, doubles, begin)
            convert = block.to_fmu if verb == "Set" else block.from_fmu
            call = prepared(self._function(name), *block.arguments)
            calls.append((name, call, None if block.direct else convert))
            begin += group.count
        return calls

    def _apply(self, parameters: Settings) -> None:
        for kind, reference, values in parameters:
            doubles = (ctypes.c_double * len(values))(*values)
            group = Group(kind, (reference,), len(values))
            self._set_values(self._blocks("Set", (group,), doubles, 0))

    def _set_values(self, calls: Calls) -> None:
        for name, call, convert in calls:
            if convert is not None:
                convert()
            status = call()
            if status not in ACCEPTED:
                raise self._call_error(f"fmi{self._plan.fmi_version}{name}", status, "setting inputs")

    def _end(self, time: float) -> FmuEndedError:
        """Take note that the FMU has ended its simulation, and return the error that says so."""
        self._ended = time
        return FmuEndedError(
            f"The FMU asked to end the simulation in {self._where()}, and ended at t = {time:g} s.",
            self._texts(),
            time,
        )

    def _where(self) -> str:
        """Return which step is made, for an error."""
        return f"the step from t = {self._begin.value:g} s"

    @contextmanager
    def _calls(self, what: str) -> Iterator[None]:
        if self._lost:
            raise FmuWorkerError("The instance was lost to a fatal error; reset the asset to go on.")
        with _guarded_directory():
            try:
                yield
            except FMICallException as error:
                raise self._call_error(str(error.function), int(error.status), what) from error

    def _call_error(self, function: str, status: int, what: str) -> FmuCallError:
        name = STATUS_NAMES[status] if 0 <= status < len(STATUS_NAMES) else str(status)
        if status == PENDING:
            self._lost = True
            after = "asynchronous steps are not supported; export it to step synchronously"
        elif not 0 <= status < FATAL:
            self._lost = True
            after = "the instance is lost; reset the asset or restore a state"
        elif status == DISCARD:
            after = "the FMU did not accept it and stays where it was; other inputs or a smaller step may do"
        else:
            # What the standard still allows then is not worth the trouble: another instance is made.
            self._lost = True
            after = "its values are no longer to be trusted; reset the asset or restore a state"
        return FmuCallError(f"{function} returned {name} in {what}: {after}.", self._texts())

    def _texts(self) -> list[str]:
        return [text for _, text in self.take_log()][-_MESSAGES_IN_ERROR:]


def _refuse_negative(status: int, function: Any, arguments: tuple[Any, ...]) -> int:
    """Check what a C function that fmpy calls has returned."""
    if status < 0:
        raise FMICallException(function=function.__name__, status=status)
    return status


def _why_not_instantiated(error: Exception) -> str:
    text = " ".join(str(error).split())
    text = text.rpartition(".so: ")[2]  # without our folder
    if "shared library" in str(error):
        return (
            f"The FMU's binary cannot be loaded on this machine ({text.removesuffix('.')}); it was built for "
            "another processor or system, or it needs a library that is not installed."
        )
    if "undefined symbol" in text:
        return f"The FMU's binary lacks a function that its FMI version requires ({text}); export it again."
    return f"The FMU could not be instantiated ({text.removesuffix('.')})."


def forget_modules(folder: str) -> None:
    """Take what an FMU in Python has imported from its folder out of this process.

    Otherwise the next FMU with a module of the same name, or the caller, would be given that module, and the
    folder is about to be removed. Instances that still run keep what they have.
    """
    inside = folder.rstrip(os.sep) + os.sep
    sys.path[:] = [entry for entry in sys.path if not (entry + os.sep).startswith(inside)]
    for (
        name,
        module,
    ) in sys.modules.copy().items():  # one step, unlike a list of items: other threads import too
        if str(getattr(module, "__file__", None) or "").startswith(inside):
            sys.modules.pop(name, None)


@contextmanager
def _guarded_directory() -> Iterator[None]:
    """Come back to the working directory, wherever the FMU or fmpy goes."""
    here = Path.cwd()
    try:
        yield
    finally:
        os.chdir(here)
