"""The twin's side: the calls of an instance, answered by a worker process."""

import contextlib
import os
import pickle
import select
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from pydantic import Field

from fmu_asset import errors
from fmu_asset.errors import FmuError, FmuMemoryError, FmuTimeoutError, FmuWorkerError, said
from fmu_asset.folders import remove_folder
from fmu_asset.instances.plan import REPORT_PERIOD, InitialValues, Instance, Plan
from reporting.arrays import Float
from reporting.toml_file import Positive, Section

from .process import CLOSE_LIMIT, WorkerProcess
from .protocol import HEADER, LARGEST_MESSAGE, Answer, Question, look, send, separated
from .sandbox import Grants

_MEBIBYTE = 1024**2
_GLANCE = 0.05
"""Seconds between two looks at the memory of a worker that is at work."""
_CALLS = {
    "open": ("load_time", "loading and instantiation"),
    "initialise": ("load_time", "initialisation"),
    "reset": ("load_time", "reset"),
    "step": ("step_time", "the step"),
    "run": ("step_time", "a step"),
    "read": ("step_time", "reading the outputs"),
    "save": ("step_time", "saving the state"),
    "restore": ("step_time", "restoring the state"),
    "take_log": ("step_time", "reading the log"),
    "close": ("step_time", "the end"),
}
"""Which limit holds for a call, and what it is in a sentence."""

_Paths = Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(strict=False)]


class WorkerLimits(Section):
    """The table `[limits]` of a binding: what the FMU's worker may take.

    Attributes
    ----------
    step_time : float
        Wall clock for a step, reading, saving or restoring a state [s].
    load_time : float
        Wall clock for loading, instantiation, initialisation and reset [s].
    memory : float
        Resident memory [MiB].
    sandbox : bool
        Whether the system keeps the FMU from the user's files, from programs and from the network.
    read, write, ports, programs
        What it may touch all the same; see `Grants`.
    """

    step_time: Positive = 60.0
    load_time: Positive = 60.0
    memory: Positive = 4096.0
    sandbox: bool = True
    read: _Paths = ()
    write: _Paths = ()
    ports: Annotated[tuple[Annotated[int, Field(ge=1, le=65535)], ...], Field(strict=False)] = ()
    programs: bool = False

    @property
    def grants(self) -> Grants | None:
        """What it may touch beyond what every FMU may; None for all that its user may."""
        return Grants(self.read, self.write, self.ports, self.programs) if self.sandbox else None


class WorkerInstance(Instance):
    """The same calls as `FmuInstance`, answered by a worker process.

    Parameters
    ----------
    plan : Plan
        What is exchanged.
    scratch : Path
        Folder of the worker alone; it is removed when the worker ends.
    limits : WorkerLimits
        What it may take.

    Attributes
    ----------
    process_id : int
        Process number of the worker.
    lost : bool
        Also from a question until its answer: an exception between the two, such as an interruption, leaves
        them out of step.

    Raises
    ------
    FmuWorkerError
        If the worker cannot be started.
    FmuCallError
        If the FMU cannot be instantiated.
    """

    def __init__(self, plan: Plan, scratch: Path, *, limits: WorkerLimits) -> None:
        super().__init__(plan)
        self._plan, self._folder, self._limits = plan, scratch, limits
        self._request = memoryview(self.request).cast("B")
        self._reply = memoryview(self.reply).cast("B")
        self._header = memoryview(bytearray(HEADER.size))
        self._number, self._logged = 0, False
        self._process = WorkerProcess(scratch, plan.folder, limits.grants)
        self.process_id = self._process.number
        self._out, self._in = self._process.outgoing, self._process.incoming
        # The worker may leave it at half an answer.
        os.set_blocking(self._in, False)
        self._next_glance = 0.0
        self._poll = select.poll()
        self._poll.register(self._in, select.POLLIN | select.POLLHUP)
        try:
            self.renew()
        except BaseException:
            self.close()
            raise

    def initialise(self, start_time: float, parameters: InitialValues, with_inputs: bool) -> None:
        """Set parameters and inputs and initialise."""
        self._call("initialise", start_time, parameters, with_inputs)

    def step(self) -> None:
        """Make the step that the request block describes."""
        self._ask(Question.STEP, "step", self._request)
        length = self._await(len(self._reply))[1]
        if length != len(self._reply):
            raise self._died()
        self._fill(self._reply)
        self.lost = False

    def run(self, requests: Float, replies: Float, report: Callable[[int], object]) -> None:
        """Make many steps; each may take the time of a step."""
        self._ask(Question.CALL, "run", self._pickled("run", requests))
        target, size, filled, more = replies.data.cast("B"), replies[0].nbytes, 0, True
        while more:
            kind, length = self._await(len(target) - filled, part=True)
            if length % size:
                raise self._died()
            self._fill(target[filled : filled + length])
            filled += length
            self.lost = more = kind == Answer.PART
            report(filled // size)

    def read(self) -> None:
        """Read the outputs of this moment."""
        answer = self._call("read")
        if len(answer) != len(self._reply):
            raise self._died()
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
        """Return and forget the messages that the FMU has logged: status and text."""
        if not self._logged or self.lost:
            return []
        self._logged = False
        content = self._call("take_log")
        texts = [entry.partition(" ") for entry in separated(content)] if content else []
        try:
            return [(int(status), text) for status, _, text in texts]
        except ValueError:
            raise self._died() from None

    @property
    def memory(self) -> int:
        """Resident memory of the worker [bytes]; 0 if it is gone, or if the system does not say.

        The limit of memory is of resident memory, and the twin keeps it: it looks at the worker while it
        waits for a long call, and now and then between short ones. `RLIMIT_AS` would refuse FMUs that reserve
        address space and never use it (Java, .NET, CUDA, the stacks of threads); under a resource limit an
        allocation fails inside the FMU, which then crashes, and nobody could say why.
        """
        try:
            with open(f"/proc/{self.process_id}/statm", "rb") as file:  # noqa: PTH123 - half the time
                return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except (OSError, IndexError, ValueError):
            return 0

    def close(self) -> None:
        """End the worker, kindly at first, and remove its folder."""
        if self._process.closed:
            return
        kindly = not self.lost
        if kindly:
            with contextlib.suppress(FmuWorkerError):
                self._ask(Question.CALL, "close", self._pickled("close"))
        self.lost = True
        self._process.end(CLOSE_LIMIT if kindly else 0.0)
        remove_folder(self._folder)

    # ------------------------------------------------------------------ questions and answers

    def _pickled(self, name: str, *arguments: object) -> bytes:
        return pickle.dumps((name, bytes(self._request), arguments))

    def _ask(self, kind: int, name: str, content: bytes | memoryview) -> None:
        if self.lost:
            raise FmuWorkerError(
                "The FMU's worker is gone or was interrupted; reset the asset to go on."
            )
        self.lost, (self._limit, self._what) = True, _CALLS[name]
        self._number = (self._number + 1) % 2**32
        try:
            send(self._out, HEADER.pack(kind, 0, self._number, len(content)), content)
        except BrokenPipeError:
            raise self._died() from None

    def _call(self, name: str, *arguments: object) -> bytes:
        """Call a method of the instance; only what the twin says is pickled, and never what comes back."""
        self._ask(Question.CALL, name, self._pickled(name, *arguments))
        largest = int(self._limits.memory * _MEBIBYTE) if name == "save" else LARGEST_MESSAGE
        answer = bytearray(self._await(largest)[1])
        self._next_glance = 0.0
        self._fill(memoryview(answer))
        self.lost = False
        return bytes(answer)

    def _await(self, largest: int, *, part: bool = False) -> tuple[int, int]:
        """Return kind and length of the answer; a failure is raised."""
        look(self._poll)
        self._fill(self._header, REPORT_PERIOD * part)
        kind, logged, number, length = HEADER.unpack(self._header)
        last = Answer.PART if part else Answer.RESULT
        known = kind in (Answer.RESULT, Answer.FAILURE, last) and number == self._number
        if not known or length > (LARGEST_MESSAGE if kind == Answer.FAILURE else largest):
            raise self._died()
        self._logged = self._logged or logged != 0
        if kind == Answer.FAILURE:
            self._fail(length)
        return kind, length

    def _fail(self, length: int) -> None:
        """Raise the error that the worker tells."""
        content = bytearray(length)
        self._fill(memoryview(content))
        try:
            name, lost, ended, sentence, *messages = separated(content)
            moment = float(ended) if ended else None
        except ValueError:
            raise self._died() from None
        self.lost, self._logged = bool(lost), False
        kind = getattr(errors, name, FmuWorkerError)
        known = isinstance(kind, type) and issubclass(kind, FmuError)
        raise (kind if known else FmuWorkerError)(sentence, messages, moment)

    def _fill(self, target: memoryview, grace: float = 0.0) -> None:
        """Read what comes, as long as the call may take and a grace [s]; look at the memory meanwhile."""
        filled, deadline = 0, 0.0
        while filled < len(target):
            try:
                count = os.readv(self._in, [target[filled:]])
            except BlockingIOError:
                deadline = deadline or time.monotonic() + getattr(self._limits, self._limit) + grace
                self._wait(deadline)
                continue
            if count == 0:
                raise self._died()
            filled += count
        if time.monotonic() > self._next_glance:
            self._check_memory()

    def _wait(self, deadline: float) -> None:
        """Wait a moment for something to read."""
        left = deadline - time.monotonic()
        if self._poll.poll(1000.0 * max(min(left, _GLANCE), 0.0)):
            return
        self._check_memory()
        if left <= 0.0:
            self._process.kill()
            most = getattr(self._limits, self._limit)
            raise FmuTimeoutError(
                said("running.timeout", most=most, what=self._what, limit=self._limit)
            )

    def _check_memory(self) -> None:
        self._next_glance = time.monotonic() + 5.0 * _GLANCE
        used, limit = self.memory, self._limits.memory * _MEBIBYTE
        if used > limit:
            self._process.kill()
            taken, most = used / _MEBIBYTE, self._limits.memory
            raise FmuMemoryError(said("running.memory", used=taken, what=self._what, most=most))

    def _died(self) -> FmuWorkerError:
        self.lost = True
        return self._process.death(self._what)
