"""The twin's side: the calls of an instance, answered by a worker process."""

import contextlib
import ctypes
import os
import pickle
import select
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

from pydantic import Field

from fmu_asset import errors
from fmu_asset.errors import FmuError, FmuMemoryError, FmuTimeoutError, FmuWorkerError
from fmu_asset.folders import remove_folder
from fmu_asset.instances.plan import Plan, Settings
from fmu_asset.instances.series import REPORT_PERIOD, Series
from reporting.section import Section

from .process import CLOSE_LIMIT, WorkerProcess
from .protocol import (
    FAILURE,
    HEADER,
    LARGEST_MESSAGE,
    PART,
    RESULT,
    Operation,
    look,
    send,
    separated,
)
from .sandbox import Grants

_MEBIBYTE = 1024**2
_STEP = int(Operation.STEP)
_GLANCE = 0.05
"""Seconds between two looks at the memory of a worker that is at work."""
_OPENING, _INITIALISING, _RESETTING = "loading and instantiation", "initialisation", "reset"
_RENEWING = "freeing the instance and making another"
_LOADING = (_OPENING, _INITIALISING, _RESETTING, _RENEWING)
_ERRORS: Mapping[str, type[FmuError]] = {
    kind.__name__: kind
    for kind in vars(errors).values()
    if isinstance(kind, type) and issubclass(kind, FmuError)
}


_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
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

    step_time: _Positive = 60.0
    load_time: _Positive = 60.0
    memory: _Positive = 4096.0
    sandbox: bool = True
    read: _Paths = ()
    write: _Paths = ()
    ports: Annotated[tuple[Annotated[int, Field(ge=1, le=65535)], ...], Field(strict=False)] = ()
    programs: bool = False

    @property
    def grants(self) -> Grants | None:
        """What it may touch beyond what every FMU may; None for all that its user may."""
        return Grants(self.read, self.write, self.ports, self.programs) if self.sandbox else None


class WorkerInstance:
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
    request, reply : ctypes array of double
        The blocks; see `instances`.

    Raises
    ------
    FmuWorkerError
        If the worker cannot be started.
    FmuCallError
        If the FMU cannot be instantiated.
    """

    def __init__(self, plan: Plan, scratch: Path, *, limits: WorkerLimits) -> None:
        self.request = (ctypes.c_double * (2 + plan.input_count))()
        self.reply = (ctypes.c_double * max(plan.output_count, 1))()
        self._request = memoryview(self.request).cast("B")
        self._reply = memoryview(self.reply).cast("B")
        self._header = bytearray(HEADER.size)
        self._header_view = memoryview(self._header)
        self._number = 0
        self._limits = limits
        self._folder = scratch
        self._logged = False
        self._lost = False
        # An exception between question and answer, such as an interruption, leaves the two out of step.
        self._busy = False
        self._process = WorkerProcess(scratch, plan.folder, limits.grants)
        self._out, self._in = self._process.outgoing, self._process.incoming
        # The worker may leave it at half an answer.
        os.set_blocking(self._in, False)
        self._next_glance = 0.0
        self._first_wait = 1000.0 * min(limits.step_time, _GLANCE)
        self._poll = select.poll()
        self._poll.register(self._in, select.POLLIN | select.POLLHUP)
        try:
            self._call("open", _OPENING, plan)
        except BaseException:
            self.close()
            raise

    # These have the meaning of their namesakes in FmuInstance.

    def initialise(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        """Set parameters and inputs and initialise."""
        inputs = bytes(self._request[16:]) if with_inputs else b""
        self._call("initialise", _INITIALISING, start_time, parameters, inputs)

    def step(self) -> None:
        """Make the step that the request block describes."""
        self._turn(_STEP, self._request, "the step")

    def run(self, series: Series, report: Callable[[], object]) -> None:
        """Make many steps; each may take the time of a step."""
        what = "a step"
        self._ask(Operation.RUN, series.requests, what)
        kind = PART
        while kind == PART:
            kind, length = self._await(what, len(series.replies), part=True)
            steps, rest = divmod(length, series.reply_size)
            if rest or series.done + steps > series.count:
                raise self._died(what)
            begin = series.done * series.reply_size
            self._fill(series.replies[begin : begin + length], what)
            series.done += steps
            if kind == RESULT:
                self._busy = False
            if time.monotonic() > self._next_glance:
                self._check_memory(what)
            report()

    def read(self) -> None:
        """Read the outputs of this moment."""
        self._turn(Operation.READ, b"", "reading the outputs")

    def save(self) -> bytes:
        """Return the serialised FMU state."""
        largest = int(self._limits.memory * _MEBIBYTE)
        return self._call("save", "saving the state", largest=largest)

    def restore(self, content: bytes) -> None:
        """Restore a serialised FMU state."""
        self._call("restore", "restoring the state", content)

    def reset(self) -> None:
        """Bring the instance back to the moment after its instantiation."""
        self._call("reset", _RESETTING)

    def take_log(self) -> list[tuple[int, str]]:
        """Return and forget the messages that the FMU has logged: status and text."""
        if not self._logged or self.lost:
            return []
        self._logged = False
        what = "reading the log"
        content = self._call("take_log", what)
        texts = separated(content) if content else []
        try:
            return [(int(status), text) for status, _, text in (entry.partition(" ") for entry in texts)]
        except ValueError:
            raise self._died(what) from None

    def renew(self) -> None:
        """Free the instance and make a new one in the same process."""
        self._call("renew", _RENEWING)

    @property
    def has_log(self) -> bool:
        """Whether there are messages."""
        return self._logged

    @property
    def lost(self) -> bool:
        """Whether worker or instance is gone."""
        return self._lost or self._busy

    @property
    def process_id(self) -> int:
        """Process number of the worker."""
        return self._process.number

    @property
    def memory(self) -> int:
        """Resident memory of the worker [bytes]; 0 if it is gone."""
        return _resident_memory(self._process.number) or 0

    def close(self) -> None:
        """End the worker, kindly at first, and remove its folder."""
        if self._out < 0:
            return
        kindly = not (self._lost or self._busy)
        if kindly:
            with contextlib.suppress(BrokenPipeError):
                send(self._out, HEADER.pack(Operation.CLOSE, 0, 0, 0))
        self._lost = True
        self._process.close_pipes()
        self._out = self._in = -1
        self._process.end(CLOSE_LIMIT if kindly else 0.0)
        remove_folder(self._folder)

    def _ask(self, operation: int, content: bytes | memoryview, what: str) -> None:
        if self._lost or self._busy:
            raise FmuWorkerError("The FMU's worker is gone or was interrupted; reset the asset to go on.")
        self._busy = True
        self._number = (self._number + 1) % 2**32
        try:
            send(self._out, HEADER.pack(operation, 0, self._number, len(content)), content)
        except BrokenPipeError:
            raise self._died(what) from None

    def _turn(self, operation: int, content: bytes | memoryview, what: str) -> None:
        """Ask for outputs, and fill the reply block with them."""
        self._ask(operation, content, what)
        look(self._poll)
        _, length = self._await(what, len(self._reply))
        if length != len(self._reply):
            raise self._died(what)
        self._fill(self._reply, what)
        self._busy = False
        if time.monotonic() > self._next_glance:
            self._check_memory(what)

    def _call(self, name: str, what: str, *arguments: object, largest: int = LARGEST_MESSAGE) -> bytes:
        """Call a method of the instance; only what the twin says is pickled, and never what comes back."""
        self._ask(Operation.CALL, pickle.dumps((name, arguments)), what)
        look(self._poll)
        _, length = self._await(what, largest)
        answer = bytearray(length)
        self._fill(memoryview(answer), what)
        self._busy = False
        self._check_memory(what)
        return bytes(answer)

    def _await(self, what: str, largest: int, *, part: bool = False) -> tuple[int, int]:
        """Return kind and length of the answer; a failure is raised."""
        # The first wait covers the usual step; a longer one is a chance to look at the worker's memory.
        if not self._poll.poll(self._first_wait):
            slack = REPORT_PERIOD * part - self._first_wait / 1000.0
            self._await_long(what, time.monotonic() + self._limit(what) + slack)
        self._fill(self._header_view, what)
        kind, logged, number, length = HEADER.unpack(self._header)
        known = kind in (RESULT, FAILURE, PART if part else RESULT) and number == self._number
        if not known or length > (LARGEST_MESSAGE if kind == FAILURE else largest):
            raise self._died(what)
        self._logged = self._logged or logged != 0
        if kind == FAILURE:
            self._fail(length, what)
        return kind, length

    def _limit(self, what: str) -> float:
        return self._limits.load_time if what in _LOADING else self._limits.step_time

    def _await_long(self, what: str, deadline: float) -> None:
        while True:
            self._check_memory(what)
            left = deadline - time.monotonic()
            if left <= 0.0:
                break
            if self._poll.poll(1000.0 * min(left, _GLANCE)):
                return
        self._lost = True
        self._process.kill()
        name = "load_time" if what in _LOADING else "step_time"
        raise FmuTimeoutError(
            f"The FMU took longer than {self._limit(what):g} s for {what}; its worker was stopped. "
            f"If it is only slow, give it more `{name}` in the table [limits] of its binding; "
            "otherwise it hangs."
        )

    def _check_memory(self, what: str) -> None:
        self._next_glance = time.monotonic() + 5.0 * _GLANCE
        used, limit = self.memory, self._limits.memory * _MEBIBYTE
        if used > limit:
            self._lost = True
            self._process.kill()
            raise FmuMemoryError(
                f"The FMU took {used / _MEBIBYTE:.0f} MiB of memory during {what}, more than the limit of "
                f"{self._limits.memory:g} MiB; its worker was stopped. If it needs that much, "
                "give it more `memory` in the table [limits] of its binding; otherwise it leaks."
            )

    def _fill(self, target: memoryview, what: str) -> None:
        filled, deadline = 0, 0.0
        while filled < len(target):
            try:
                count = os.readv(self._in, [target[filled:]])
            except BlockingIOError:
                deadline = deadline or time.monotonic() + self._limit(what)
                self._await_long(what, deadline)
                continue
            if count == 0:
                raise self._died(what)
            filled += count

    def _fail(self, length: int, what: str) -> None:
        content = bytearray(length)
        self._fill(memoryview(content), what)
        self._busy = False
        try:
            name, lost, ended, sentence, *messages = separated(content)
            time = float(ended) if ended else None
        except ValueError:
            raise self._died(what) from None
        self._lost = self._lost or bool(lost)
        self._logged = False
        raise _ERRORS.get(name, FmuWorkerError)(sentence, messages, time)

    def _died(self, what: str) -> FmuWorkerError:
        self._lost = True
        return self._process.death(what)


def _resident_memory(process: int) -> int | None:
    """Return the resident memory of a process [bytes], or None if it is gone or the system does not say.

    The limit of memory is of resident memory, and the twin keeps it: it looks at the worker while it waits
    for a long call, and now and then between short ones. `RLIMIT_AS` would refuse FMUs that reserve address
    space and never use it (Java, .NET, CUDA, the stacks of threads); under a resource limit an allocation
    fails inside the FMU, which then crashes, and nobody could say why.
    """
    try:
        with open(f"/proc/{process}/statm", "rb") as file:  # noqa: PTH123 - half the time of Path.open
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError):
        return None
