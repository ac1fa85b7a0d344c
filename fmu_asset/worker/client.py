"""The twin's side of a worker: an instance whose methods are called in a worker process."""

import contextlib
import os
import pickle
import select
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from fmu_asset import errors
from fmu_asset.errors import FmuError, FmuMemoryError, FmuTimeoutError, FmuWorkerError
from fmu_asset.folders import remove_folder
from fmu_asset.instances.plan import REPORT_PERIOD, InitialValues, Instance, Plan
from reporting.arrays import Float
from reporting.formats.toml_file import Positive, Section

from .process import CLOSE_LIMIT, WorkerProcess
from .protocol import (
    HEADER,
    LARGEST_MESSAGE,
    Answer,
    Question,
    poll_for_message,
    send,
    separated,
)
from .refusals import report_descriptor
from .sandbox import Grants

_MEBIBYTE = 1024**2
_MEMORY_CHECK_PERIOD = 0.05
"""Seconds between two looks at the memory of a worker that is at work."""


class _CallKind(NamedTuple):
    """The time limit of a call, and its name in messages.

    Attributes
    ----------
    limit : str
        Attribute of `WorkerLimits`.
    action : str
        What the call does, as part of a sentence.
    """

    limit: Literal["load_time", "step_time"]
    action: str


_CALL_KINDS = {
    "open": _CallKind("load_time", "loading and instantiation"),
    "initialise": _CallKind("load_time", "initialisation"),
    "reset": _CallKind("load_time", "reset"),
    "step": _CallKind("step_time", "the step"),
    "run": _CallKind("step_time", "a step"),
    "read": _CallKind("step_time", "reading the outputs"),
    "save": _CallKind("step_time", "saving the state"),
    "restore": _CallKind("step_time", "restoring the state"),
    "take_log": _CallKind("step_time", "reading the log"),
    "close": _CallKind("step_time", "the end"),
}

_Paths = Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(strict=False)]
_Ports = Annotated[tuple[Annotated[int, Field(ge=1, le=65535)], ...], Field(strict=False)]


class WorkerLimits(Section):
    """The table `[limits]` of a binding: limits and grants of the FMU's worker.

    Arguments of `FmiAsset` and `step_timeout` of a scenario take precedence.
    """

    step_time: Positive = 60.0
    """Wall clock for a step, reading, saving or restoring a state [s]."""
    load_time: Positive = 60.0
    """Wall clock for loading, instantiation, initialisation and reset [s]."""
    memory: Positive = 4096.0
    """Resident memory [MiB]."""
    sandbox: bool = True
    """Whether the system keeps the FMU from the user's files, from programs and from the
    network."""
    read: _Paths = ()
    """Files and folders that the FMU may read in the sandbox: absolute paths, `~/...`, or paths
    relative to the extracted FMU, which is `.`."""
    write: _Paths = ()
    """Files and folders that the FMU may write in the sandbox, by paths as in `read`."""
    ports: _Ports = ()
    """TCP ports to which the FMU may connect from the sandbox, on any host."""
    programs: bool = False
    """Whether the FMU may start programs in the sandbox."""

    @property
    def grants(self) -> Grants | None:
        """Grants of the sandbox; None if there is no sandbox."""
        if not self.sandbox:
            return None
        return Grants(self.read, self.write, self.ports, self.programs)


class _AnswerHeader(NamedTuple):
    """The header of an answer: its kind, and the length of its payload [bytes]."""

    kind: int
    length: int


class WorkerInstance(Instance):
    """An instance in a worker process, with the methods of `FmuInstance`.

    Parameters
    ----------
    scratch : Path
        Folder of this worker alone; it is removed when the worker ends.

    Attributes
    ----------
    process_id : int
        Process number of the worker.
    lost : bool
        Whether it cannot be used any more. It is also True from a question until its answer has
        been read: if an exception such as an interruption comes between the two, the next answer
        would not belong to the next question.

    Raises
    ------
    FmuWorkerError
        If the worker cannot be started.
    FmuCallError
        If the FMU cannot be instantiated.
    """

    def __init__(self, plan: Plan, scratch: Path, *, limits: WorkerLimits) -> None:
        super().__init__(plan)
        self._plan = plan
        self._folder = scratch
        self._limits = limits
        self._request = memoryview(self.request).cast("B")
        self._reply = memoryview(self.reply).cast("B")
        self._header = memoryview(bytearray(HEADER.size))
        self._question_number = 0
        self._call_kind = _CALL_KINDS["open"]
        self._has_log = False
        self._process = WorkerProcess(scratch, plan.folder, limits.grants)
        self.process_id = self._process.number
        self._outgoing = self._process.outgoing
        self._incoming = self._process.incoming
        # so that a read returns if the worker stops in the middle of an answer
        os.set_blocking(self._incoming, False)
        self._next_memory_check = 0.0
        self._poll = select.poll()
        self._poll.register(self._incoming, select.POLLIN | select.POLLHUP)
        try:
            self.renew()
        except BaseException:
            self.close()
            raise

    def initialise(self, start_time: float, parameters: InitialValues, with_inputs: bool) -> None:
        """Set parameters and inputs, and initialise the FMU."""
        self._call("initialise", start_time, parameters, with_inputs)

    def step(self) -> None:
        """Make the communication step that the request describes, and fill the reply."""
        self._ask(Question.STEP, "step", self._request)
        header = self._wait_for_answer(len(self._reply))
        if header.length != len(self._reply):
            raise self._death_error()
        self._read_into(self._reply)
        self.lost = False

    def run(self, requests: Float, replies: Float, report: Callable[[int], object]) -> None:
        """Make N steps in one call of the worker.

        The worker sends the replies in parts of one or more whole steps. Progress is reported after
        each part, and the time limit of a step applies to a part, not to the whole call.

        Parameters
        ----------
        requests : (N, 2 + n_inputs) array
            The request of each step.
        replies : (N, n_outputs) array
            Filled with the reply of each step.
        report : callable
            Called with the number of finished steps whenever a part has arrived.
        """
        # While the refusals of the sandbox are counted, each step is a part, so that a crash names
        # the step itself.
        period = REPORT_PERIOD if report_descriptor() is None else 0.0
        self._ask(Question.CALL, "run", self._pickled("run", requests, period))
        reply_bytes = replies.data.cast("B")
        bytes_per_step = replies[0].nbytes
        filled_bytes = 0
        is_complete = False
        while not is_complete:
            header = self._wait_for_answer(len(reply_bytes) - filled_bytes, may_be_part=True)
            # A worker that works sends whole steps only.
            if header.length % bytes_per_step:
                raise self._death_error()
            self._read_into(reply_bytes[filled_bytes : filled_bytes + header.length])
            filled_bytes += header.length
            is_complete = header.kind != Answer.PART
            # If an exception comes between two parts, such as an interruption by the user, the rest
            # of this reply stays in the pipe, and no further request can be made. Therefore the
            # instance counts as lost until the last part has arrived.
            self.lost = not is_complete
            report(filled_bytes // bytes_per_step)

    def read(self) -> None:
        """Read the present outputs into the reply."""
        answer = self._call("read")
        if len(answer) != len(self._reply):
            raise self._death_error()
        self._reply[:] = answer

    def save(self) -> bytes:
        """Return the serialised FMU state."""
        return self._call("save")

    def restore(self, content: bytes) -> None:
        """Restore a serialised FMU state."""
        self._call("restore", content)

    def reset(self) -> None:
        """Bring the instance back to the moment after its instantiation."""
        self._call("reset")

    def renew(self) -> None:
        """Free the instance, if there is one, and make a new one in the same process."""
        self._call("open", self._plan)

    def take_log(self) -> list[tuple[int, str]]:
        """Return status and text of the messages that the FMU has logged since the last call.

        The worker is asked only if the header of an answer has announced messages.
        """
        if not self._has_log or self.lost:
            return []
        self._has_log = False
        content = self._call("take_log")
        if not content:
            return []
        messages = []
        for entry in separated(content):
            status, _, text = entry.partition(" ")
            try:
                messages.append((int(status), text))
            except ValueError:
                raise self._death_error() from None
        return messages

    @property
    def memory(self) -> int:
        """Resident memory of the worker [bytes]; 0 if it is gone or the system does not say.

        The twin itself limits the resident memory: it checks the worker while it waits for a long
        call, and from time to time between short ones. `RLIMIT_AS` would refuse FMUs that reserve
        address space and never use it (Java, .NET, CUDA, the stacks of threads). Under a resource
        limit an allocation fails inside the FMU, which then crashes without a recognisable cause.
        """
        try:
            with open(f"/proc/{self.process_id}/statm", "rb") as file:  # noqa: PTH123 - half the time
                resident_pages = int(file.read().split()[1])
        except (OSError, IndexError, ValueError):
            return 0
        return resident_pages * os.sysconf("SC_PAGE_SIZE")

    def close(self) -> None:
        """Ask the worker to end, kill it if it does not, and remove its folder."""
        if self._process.closed:
            return
        can_be_asked = not self.lost
        if can_be_asked:
            with contextlib.suppress(FmuWorkerError):
                self._ask(Question.CALL, "close", self._pickled("close"))
        self.lost = True
        self._process.end(CLOSE_LIMIT if can_be_asked else 0.0)
        remove_folder(self._folder)

    # ------------------------------------------------------------------ questions and answers

    def _pickled(self, name: str, *arguments: object) -> bytes:
        """Return a call as bytes: its name, the request and the arguments."""
        return pickle.dumps((name, bytes(self._request), arguments))

    def _ask(self, kind: Question, name: str, content: bytes | memoryview) -> None:
        """Send a question to the worker; `name` is that of the call in `_CALL_KINDS`.

        An `FmuWorkerError` is raised if the worker is gone, or did not answer the last question.
        """
        if self.lost:
            raise FmuWorkerError(
                "The FMU's worker is gone or was interrupted; reset the asset to go on."
            )
        # The instance counts as lost until the answer has been read: see the attribute `lost`.
        self.lost = True
        self._call_kind = _CALL_KINDS[name]
        self._question_number = (self._question_number + 1) % 2**32
        header = HEADER.pack(kind, 0, self._question_number, len(content))
        try:
            send(self._outgoing, header, content)
        except BrokenPipeError:
            raise self._death_error() from None

    def _call(self, name: str, *arguments: object) -> bytes:
        """Call a method of the instance in the worker, and return the bytes of its answer.

        Questions are pickled, but answers never are: unpickling runs code, and the twin does not
        trust a process in which an FMU runs.
        """
        self._ask(Question.CALL, name, self._pickled(name, *arguments))
        longest_answer = LARGEST_MESSAGE
        # Only a saved state may be as large as the memory of the worker.
        if name == "save":
            longest_answer = int(self._limits.memory * _MEBIBYTE)
        header = self._wait_for_answer(longest_answer)
        answer = bytearray(header.length)
        # Check the memory at the end of every such call, whenever the last check was.
        self._next_memory_check = 0.0
        self._read_into(memoryview(answer))
        self.lost = False
        return bytes(answer)

    def _wait_for_answer(self, longest_result: int, *, may_be_part: bool = False) -> _AnswerHeader:
        """Wait for the answer to the last question, and return its header.

        The caller reads the payload, which may have at most `longest_result` bytes. If the call
        failed, the error that the worker reports is raised. An invalid header means that the FMU
        has overwritten the memory or the pipe of the worker, which then counts as dead.
        """
        poll_for_message(self._poll)
        # A worker that answers in parts collects steps for a report period before it sends a part.
        self._read_into(self._header, grace=REPORT_PERIOD if may_be_part else 0.0)
        kind, has_log, question_number, length = HEADER.unpack(self._header)
        is_known = kind in (Answer.RESULT, Answer.FAILURE) or (may_be_part and kind == Answer.PART)
        length_limit = LARGEST_MESSAGE if kind == Answer.FAILURE else longest_result
        if not is_known or question_number != self._question_number or length > length_limit:
            raise self._death_error()
        self._has_log = self._has_log or has_log != 0
        if kind == Answer.FAILURE:
            self._raise_failure(length)
        return _AnswerHeader(kind, length)

    def _raise_failure(self, length: int) -> None:
        """Read the payload of a failure, `length` bytes, and raise the error in it."""
        content = bytearray(length)
        self._read_into(memoryview(content))
        try:
            name, lost, end_time, sentence, *messages = separated(content)
            time_of_end = float(end_time) if end_time else None
        except ValueError:
            raise self._death_error() from None
        self.lost = bool(lost)
        self._has_log = False
        error_class = getattr(errors, name, FmuWorkerError)
        if not (isinstance(error_class, type) and issubclass(error_class, FmuError)):
            error_class = FmuWorkerError
        raise error_class(sentence, messages, time_of_end)

    def _read_into(self, target: memoryview, grace: float = 0.0) -> None:
        """Fill a buffer with bytes from the worker, within the time limit of the call.

        `grace` is added to the limit [s].
        """
        filled = 0
        deadline = 0.0
        while filled < len(target):
            try:
                byte_count = os.readv(self._incoming, [target[filled:]])
            except BlockingIOError:
                # The deadline starts when a read would block first: most answers are there at
                # once, and then the clock is not asked.
                if not deadline:
                    deadline = time.monotonic() + self._time_limit() + grace
                self._wait_until(deadline)
                continue
            # A pipe without bytes whose other side is closed: the worker is dead.
            if byte_count == 0:
                raise self._death_error()
            filled += byte_count
        if time.monotonic() > self._next_memory_check:
            self._check_memory()

    def _time_limit(self) -> float:
        """Return the time limit of the present call [s]."""
        limit: float = getattr(self._limits, self._call_kind.limit)
        return limit

    def _wait_until(self, deadline: float) -> None:
        """Wait briefly for bytes from the worker; kill it if the deadline has passed.

        The deadline is on the monotonic clock [s]. The wait ends after `_MEMORY_CHECK_PERIOD` at
        the latest, so that the memory of the worker is checked meanwhile; the caller then tries to
        read again.
        """
        remaining = deadline - time.monotonic()
        timeout_in_milliseconds = 1000.0 * max(min(remaining, _MEMORY_CHECK_PERIOD), 0.0)
        if self._poll.poll(timeout_in_milliseconds):
            return
        self._check_memory()
        if remaining <= 0.0:
            self._process.kill()
            raise FmuTimeoutError(
                f"The FMU took longer than {self._time_limit():g} s for {self._call_kind.action}; "
                "its worker was stopped. If it is only slow, give it more "
                f"`{self._call_kind.limit}` in the table [limits] of its binding; otherwise it "
                "hangs."
            )

    def _check_memory(self) -> None:
        """Kill the worker and raise an error if it uses more memory than its limit."""
        self._next_memory_check = time.monotonic() + 5.0 * _MEMORY_CHECK_PERIOD
        used_memory = self.memory
        if used_memory > self._limits.memory * _MEBIBYTE:
            self._process.kill()
            raise FmuMemoryError(
                f"The FMU took {used_memory / _MEBIBYTE:.0f} MiB of memory during "
                f"{self._call_kind.action}, more than the limit of {self._limits.memory:g} MiB; "
                "its worker was stopped. If it needs that much, give it more `memory` in the table "
                "[limits] of its binding; otherwise it leaks."
            )

    def _death_error(self) -> FmuWorkerError:
        """Mark the worker as lost, and return the error that says how it died."""
        self.lost = True
        return self._process.death_error(self._call_kind.action)
