"""A process of its own for every FMU: what it crashes, blocks or prints is not the twin's.

Two pipes carry binary messages: a header (operation or kind, whether there are log messages, length), then
the payload. A step is the request block of `instance` one way and the reply block the other, without copies.

The worker imports fmpy and nothing of the project but `errors` and `instance`.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import json
import os
import select
import shutil
import signal
import struct
import subprocess
import sys
import time
import traceback
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from . import errors
from .errors import FmuError, FmuTimeoutError, FmuWorkerError
from .instance import FmuInstance, Plan, Settings

_HEADER = struct.Struct("<HHI")
_STEP, _OPEN, _INITIALISE, _READ, _SAVE, _RESTORE, _RESET, _LOG, _CLOSE = range(1, 10)
_RESULT, _FAILURE = 1, 2
_START_LIMIT = 60.0
_CLOSE_LIMIT = 2.0
# Waking a process that sleeps on a pipe costs as much as a whole step. Whoever awaits the other side of a
# step therefore looks again for a moment before it sleeps, if there is a processor for each of the two.
_LOOK_AGAIN = 2.5e-4
_PROCESSORS = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_ERRORS: Mapping[str, type[FmuError]] = {
    kind.__name__: kind
    for kind in vars(errors).values()
    if isinstance(kind, type) and issubclass(kind, FmuError)
}


def _receive(descriptor: int, target: memoryview) -> bool:
    """Fill `target`; return False if the other side is gone."""
    filled = 0
    while filled < len(target):
        count = os.readv(descriptor, [target[filled:]])
        if count == 0:
            return False
        filled += count
    return True


def _look(poll: select.poll) -> None:
    """Return as soon as there is something to read, or after a moment without."""
    if _PROCESSORS > 1:
        end = time.monotonic() + _LOOK_AGAIN
        while not poll.poll(0) and time.monotonic() < end:
            pass


def _send(descriptor: int, *parts: bytes | bytearray | memoryview) -> None:
    total = sum(len(part) for part in parts)
    sent = os.writev(descriptor, parts)
    if sent < total:
        rest = memoryview(b"".join(parts))[sent:]
        while rest:
            rest = rest[os.write(descriptor, rest) :]


# ---------------------------------------------------------------------- in the worker


def serve(incoming: int, outgoing: int, folder: str) -> None:
    """Answer requests until the pipe closes; then remove the folder.

    Parameters
    ----------
    incoming, outgoing : int
        File descriptors of the pipes.
    folder : str
        The scratch folder of this worker, which holds the extracted FMU.
    """
    # The twin decides what an interruption means; the worker ends when its pipe closes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable()
    instance: FmuInstance | None = None
    header = bytearray(_HEADER.size)
    header_view = memoryview(header)
    reply_header = bytearray(_HEADER.size)
    request = reply = memoryview(b"")
    poll = select.poll()
    poll.register(incoming, select.POLLIN | select.POLLHUP)
    try:
        while _receive(incoming, header_view):
            operation, _, length = _HEADER.unpack(header)
            try:
                if operation == _STEP:
                    if not _receive(incoming, request) or instance is None:
                        break
                    instance.step()
                    payload: bytes | memoryview = reply
                else:
                    content = bytearray(length)
                    if not _receive(incoming, memoryview(content)) or operation == _CLOSE:
                        break
                    if operation == _OPEN:
                        instance = FmuInstance(Plan(**json.loads(content)))
                        request = memoryview(instance.request).cast("B")
                        reply = memoryview(instance.reply).cast("B")
                    payload = _answer(operation, bytes(content), instance, reply)
                logged = instance is not None and instance.has_log and operation != _LOG
                _HEADER.pack_into(reply_header, 0, _RESULT, logged, len(payload))
            except FmuError as error:
                lost = instance is None or instance.lost
                payload = json.dumps([type(error).__name__, error.sentence, error.messages, lost]).encode()
                _HEADER.pack_into(reply_header, 0, _FAILURE, 0, len(payload))
            _send(outgoing, reply_header, payload)
            if operation == _STEP:
                _look(poll)
        if instance is not None:
            instance.close()
    except BrokenPipeError:
        pass  # the twin is gone
    except BaseException:  # noqa: BLE001 - the twin reads the last words in worker.log
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    shutil.rmtree(folder, ignore_errors=True)
    # Without the interpreter's shutdown, which third-party libraries may not survive.
    os._exit(0)


def _answer(
    operation: int, content: bytes, instance: FmuInstance | None, reply: memoryview
) -> bytes | memoryview:
    if instance is None:
        raise FmuWorkerError("The worker was asked before it had an FMU.")
    if operation == _INITIALISE:
        setting = json.loads(content)
        inputs = bytes.fromhex(setting["inputs"])
        if inputs:
            memoryview(instance.request).cast("B")[16:] = inputs
        instance.initialise(setting["start_time"], setting["parameters"], with_inputs=bool(inputs))
    elif operation == _READ:
        instance.read()
        return reply
    elif operation == _SAVE:
        return instance.save()
    elif operation == _RESTORE:
        instance.restore(content)
    elif operation == _RESET:
        instance.reset()
    elif operation == _LOG:
        return json.dumps(instance.take_log()).encode()
    return b""


# ---------------------------------------------------------------------- in the twin


class WorkerInstance:
    """The same calls as `FmuInstance`, answered by a worker process.

    Parameters
    ----------
    plan : Plan
        What is exchanged; the worker removes the plan's folder when it ends.
    step_timeout : float
        Wall-clock limit of a step, of reading and of saving or restoring a state [s].

    Attributes
    ----------
    request, reply : ctypes array of double
        The blocks; see `instance`.

    Raises
    ------
    FmuWorkerError
        If the worker cannot be started.
    FmuCallError
        If the FMU cannot be instantiated.
    """

    def __init__(self, plan: Plan, *, step_timeout: float) -> None:
        self.request = (ctypes.c_double * (2 + plan.input_count))()
        self.reply = (ctypes.c_double * max(plan.output_count, 1))()
        self._request = memoryview(self.request).cast("B")
        self._reply = memoryview(self.reply).cast("B")
        self._header = bytearray(_HEADER.size)
        self._header_view = memoryview(self._header)
        self._step_header = _HEADER.pack(_STEP, 0, len(self._request))
        self._limit = step_timeout
        self._folder = Path(plan.folder)
        self._logged = False
        self._lost = False
        # An exception between question and answer, such as an interruption, leaves the two out of step.
        self._busy = False
        self._process, self._out, self._in = self._start()
        self._poll = select.poll()
        self._poll.register(self._in, select.POLLIN | select.POLLHUP)
        try:
            self._call(_OPEN, json.dumps(asdict(plan)).encode(), "instantiation", _START_LIMIT)
        except BaseException:
            self.close()
            raise

    def _start(self) -> tuple[subprocess.Popen[bytes], int, int]:
        their_in, our_out = os.pipe()
        our_in, their_out = os.pipe()
        root = str(Path(__file__).parents[1])
        program = (
            "import sys; sys.path.append(sys.argv[1]); from fmu_asset.worker import serve; "
            "serve(int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])"
        )
        # One thread: the matrices are small, and results do not depend on the number of cores.
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        try:
            with (self._folder / "worker.log").open("wb") as log:
                process = subprocess.Popen(
                    [
                        sys.executable,
                        "-P",
                        "-c",
                        program,
                        root,
                        str(their_in),
                        str(their_out),
                        str(self._folder),
                    ],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    cwd=self._folder,
                    env=environment,
                    pass_fds=(their_in, their_out),
                )
        except OSError as error:
            for descriptor in (our_out, our_in):
                os.close(descriptor)
            raise FmuWorkerError(f"The worker process could not be started ({error}).") from error
        finally:
            os.close(their_in)
            os.close(their_out)
        return process, our_out, our_in

    # The next five have the meaning of their namesakes in FmuInstance.

    def initialise(self, start_time: float, parameters: Settings, *, with_inputs: bool) -> None:
        """Set parameters and inputs and initialise."""
        setting = {
            "start_time": start_time,
            "parameters": parameters,
            "inputs": bytes(self._request[16:]).hex() if with_inputs else "",
        }
        self._call(_INITIALISE, json.dumps(setting).encode(), "initialisation", _START_LIMIT)

    def step(self) -> None:
        """Make the step that the request block describes."""
        self._begin()
        try:
            _send(self._out, self._step_header, self._request)
        except BrokenPipeError:
            raise self._died(f"the step from t = {self.request[0]:g} s") from None
        what = "the step"
        _look(self._poll)
        kind, length = self._await(what, self._limit)
        if kind == _RESULT and length == len(self._reply):
            self._fill(self._reply, what)
            self._busy = False
        else:
            self._fail(length, what)

    def read(self) -> None:
        """Read the outputs of this moment."""
        content = self._call(_READ, b"", "reading the outputs", self._limit)
        self._reply[:] = content

    def save(self) -> bytes:
        """Return the serialised FMU state."""
        return self._call(_SAVE, b"", "saving the state", self._limit)

    def restore(self, content: bytes) -> None:
        """Restore a serialised FMU state."""
        self._call(_RESTORE, content, "restoring the state", self._limit)

    def reset(self) -> None:
        """Bring the instance back to the moment after its instantiation."""
        self._call(_RESET, b"", "reset", _START_LIMIT)

    def take_log(self) -> list[tuple[int, str]]:
        """Return and forget the messages that the FMU has logged: status and text."""
        if not self._logged or self.lost:
            return []
        self._logged = False
        content = json.loads(self._call(_LOG, b"", "reading the log", self._limit))
        return [(int(status), str(text)) for status, text in content]

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
        return self._process.pid

    def close(self) -> None:
        """End the worker, kindly at first, and remove its folder."""
        if self._out < 0:
            return
        if not (self._lost or self._busy):
            with contextlib.suppress(BrokenPipeError):
                _send(self._out, _HEADER.pack(_CLOSE, 0, 0))
        self._lost = True
        os.close(self._out)
        os.close(self._in)
        self._out = self._in = -1
        try:
            self._process.wait(0.0 if self._busy else _CLOSE_LIMIT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _call(self, operation: int, content: bytes, what: str, limit: float) -> bytes:
        self._begin()
        try:
            _send(self._out, _HEADER.pack(operation, 0, len(content)), content)
        except BrokenPipeError:
            raise self._died(what) from None
        kind, length = self._await(what, limit)
        if kind == _FAILURE:
            self._fail(length, what)
        answer = bytearray(length)
        self._fill(memoryview(answer), what)
        self._busy = False
        return bytes(answer)

    def _begin(self) -> None:
        if self._lost or self._busy:
            raise FmuWorkerError("The FMU's worker is gone or was interrupted; reset the asset to go on.")
        self._busy = True

    def _await(self, what: str, limit: float) -> tuple[int, int]:
        if not self._poll.poll(1000.0 * limit):
            self._lost = True
            self._process.kill()
            self._process.wait()
            raise FmuTimeoutError(
                f"The FMU took longer than {limit:g} s for {what}; its worker was stopped. "
                "Give a longer step_timeout if it is only slow."
            )
        self._fill(self._header_view, what)
        kind, logged, length = _HEADER.unpack(self._header)
        self._logged = self._logged or logged != 0
        return kind, length

    def _fill(self, target: memoryview, what: str) -> None:
        if not _receive(self._in, target):
            raise self._died(what)

    def _fail(self, length: int, what: str) -> None:
        content = bytearray(length)
        self._fill(memoryview(content), what)
        self._busy = False
        name, sentence, messages, lost = json.loads(content)
        self._lost = self._lost or bool(lost)
        self._logged = False
        raise _ERRORS.get(name, FmuWorkerError)(sentence, messages)

    def _died(self, what: str) -> FmuWorkerError:
        self._lost = True
        deadline = time.monotonic() + _CLOSE_LIMIT
        while self._process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        code = self._process.poll()
        if code is None:
            how = "closed its pipe"
        elif code < 0:
            name = {item.value: item.name for item in signal.Signals}.get(-code, "a real-time signal")
            how = f"was ended by signal {-code} ({name})"
        else:
            how = f"ended with exit status {code}"
        return FmuWorkerError(f"The worker process of the FMU {how} during {what}.", self._last_words())

    def _last_words(self) -> list[str]:
        with contextlib.suppress(OSError):
            text = (self._folder / "worker.log").read_text(encoding="utf-8", errors="replace")
            return [line for line in text.splitlines() if line.strip()][-5:]
        return []
