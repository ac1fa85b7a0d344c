"""The worker's side: it executes the calls that the twin sends, and answers them.

Of the project it imports `errors`, `instances` and this package only.
"""

import ctypes
import errno
import faulthandler
import os
import pickle
import select
import signal
import sys
import traceback
from collections.abc import Callable
from typing import Any, NamedTuple, NoReturn

import numpy as np

from fmu_asset.errors import FmuError, FmuWorkerError
from fmu_asset.instances.base import FmuInstance
from fmu_asset.instances.opening import open_instance
from reporting.arrays import Float

from .protocol import HEADER, Answer, Exit, Question, joined, poll_for_message, receive, send

LARGEST_FILE = 2 * 1024**3
"""Bytes that an FMU may write to one file, such as an endless log."""

_locate_errno = ctypes.CDLL(None).__errno_location
_locate_errno.restype = ctypes.c_void_p


# ---------------------------------------------------------------------- refusals of the sandbox


class _AuditEvent(NamedTuple):
    """An event of Python's audit hooks (PEP 578): its name and its arguments."""

    name: str
    arguments: tuple[object, ...]


_ACCESSES = ("open", "os.", "shutil.", "socket.", "subprocess.", "urllib.")
"""Beginnings of the names of audit events for accesses to files, sockets and other processes."""
_last_accesses: list[_AuditEvent] = []
"""The last such event since the last question; empty if there was none."""


def _record_access(event: str, arguments: tuple[object, ...]) -> None:
    """Record an audit event if it is an access to files, sockets or other processes.

    This is an audit hook, which Python calls at every event.
    """
    # the sandbox does not restrict os.chdir, and our own code calls it
    if event.startswith(_ACCESSES) and event != "os.chdir":
        _last_accesses[:] = [_AuditEvent(event, arguments)]


def _sandbox_hint() -> str:
    """Return a sentence on what the sandbox has refused, with Python's last access."""
    attempt = ""
    for event in _last_accesses:
        argument_texts = []
        for argument in event.arguments:
            if isinstance(argument, str | bytes | list | tuple):
                argument_texts.append(repr(argument))
        call = f"{event.name}({', '.join(argument_texts)})"
        attempt = f"; the last that its Python code tried was {call}"
    return (
        f" The system refused a call of the FMU (Permission denied{attempt}), as its sandbox does: "
        "grant what it needs by `read`, `write`, `ports` or `programs` in the table [limits] of "
        "its binding."
    )


# ---------------------------------------------------------------------- life of the worker


def serve(incoming: int, outgoing: int, *, confined: bool) -> NoReturn:
    """Answer the twin's questions until it asks for the end or closes its pipe; then exit.

    Parameters
    ----------
    incoming, outgoing : int
        File descriptors of the pipes.
    confined : bool
        Whether this process is in a sandbox, which may then be the cause of a failure.
    """
    # The twin decides what an interruption means; the worker ends when its pipe closes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable()
    _limit_file_size()
    was_asked_to_end = False
    try:
        server = _Server(incoming, outgoing, confined=confined)
        was_asked_to_end = server.answer_questions()
        if server.instance is not None:
            server.instance.close()
    except BrokenPipeError:
        pass  # the twin is gone, or this is a copy of the worker without one
    except OSError as error:
        os._exit(Exit.PIPES_GONE if error.errno == errno.EBADF else Exit.OWN_FAILURE)
    except BaseException:  # noqa: BLE001 - the twin reads the last words in worker.log
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(Exit.OWN_FAILURE)
    # Without the interpreter's shutdown, which some libraries do not survive.
    os._exit(0 if was_asked_to_end else Exit.ORPHANED)


def _limit_file_size() -> None:
    """Limit the size of files, so that the system kills an FMU that fills the disk."""
    import resource

    _, hard_limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    limit = LARGEST_FILE
    if hard_limit != resource.RLIM_INFINITY:
        limit = min(LARGEST_FILE, hard_limit)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard_limit))
    # Python ignores this signal, and the FMU would see a write that fails again and again.
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)


class _Call(NamedTuple):
    """A method call from the twin: name, request and arguments.

    Attributes
    ----------
    arguments : tuple
        Arguments of the method.
    """

    name: str
    request: bytes
    arguments: tuple[Any, ...]


class _Server:
    """Answers the questions of the twin; file descriptors of the pipes as for `serve`.

    Attributes
    ----------
    instance : FmuInstance or None
        None until it has been opened.
    """

    def __init__(self, incoming: int, outgoing: int, *, confined: bool) -> None:
        self._incoming = incoming
        self._outgoing = outgoing
        self._confined = confined
        if confined:
            sys.addaudithook(_record_access)
        self.instance: FmuInstance | None = None
        self._request = memoryview(b"")
        self._reply = memoryview(b"")
        self._question_number = 0
        self._answer_header = bytearray(HEADER.size)
        self._process = os.getpid()
        # the C variable `errno`, in which a call of the FMU leaves its error
        self._errno = ctypes.c_int.from_address(_locate_errno())

    def answer_questions(self) -> bool:
        """Answer questions until the last one; return whether the twin asked for the end.

        If it did not, its pipe was closed.
        """
        header = memoryview(bytearray(HEADER.size))
        poll = select.poll()
        poll.register(self._incoming, select.POLLIN | select.POLLHUP)
        while receive(self._incoming, header):
            kind, _, self._question_number, length = HEADER.unpack(header)
            try:
                if kind == Question.STEP:
                    if not receive(self._incoming, self._request) or self.instance is None:
                        return False
                    self.instance.step()
                    self._answer(Answer.RESULT, self._reply)
                else:
                    content = bytearray(length)
                    if not receive(self._incoming, memoryview(content)):
                        return False
                    call = _Call(*pickle.loads(content))
                    if call.name == "close":
                        return True
                    self._answer(Answer.RESULT, self._result_of(call))
            except FmuError as error:
                self._answer_failure(error)
            poll_for_message(poll)
        return False

    def _answer(self, kind: Answer, payload: bytes | memoryview) -> None:
        """Send an answer to the present question."""
        if os.getpid() != self._process:
            os._exit(0)  # this is a copy of the worker that the FMU has made
        has_log = False
        if kind != Answer.FAILURE and self.instance is not None:
            has_log = len(self.instance.messages) > 0
        HEADER.pack_into(self._answer_header, 0, kind, has_log, self._question_number, len(payload))
        send(self._outgoing, self._answer_header, payload)

    def _answer_failure(self, error: FmuError) -> None:
        """Send an error as the answer, with a hint if the sandbox may have caused it."""
        sentence = error.sentence
        is_refused = self._errno.value == errno.EACCES or "ermission denied" in str(error)
        if self._confined and is_refused:
            sentence += _sandbox_hint()
        is_lost = self.instance is None or self.instance.lost
        payload = joined(
            type(error).__name__,
            "lost" if is_lost else "",
            "" if error.time is None else repr(error.time),
            sentence,
            *error.messages,
        )
        self._answer(Answer.FAILURE, payload)

    def _result_of(self, call: _Call) -> bytes | memoryview:
        """Execute a call, and return its result as bytes."""
        self._errno.value = 0
        _last_accesses.clear()
        if call.name == "open":
            self._open(*call.arguments)
        instance = self.instance
        if instance is None:
            raise FmuWorkerError("The worker got a request before it had an FMU.")
        self._request[:] = call.request
        if call.name == "open":
            return b""
        if call.name == "run":
            requests, instance.report_period = call.arguments
            self._run(instance, requests)
            return b""
        if call.name == "take_log":
            return joined(*(f"{status} {text}" for status, text in instance.take_log()))
        method: Callable[..., bytes | None] = getattr(instance, call.name)
        result = method(*call.arguments)
        if call.name == "read":
            return self._reply
        return result or b""

    def _open(self, *arguments: Any) -> None:
        """Free the instance, if there is one, and make a new one; arguments of `open_instance`."""
        if self.instance is not None:
            self.instance.close()
        self.instance = open_instance(*arguments)
        self._request = memoryview(self.instance.request).cast("B")
        self._reply = memoryview(self.instance.reply).cast("B")

    def _run(self, instance: FmuInstance, requests: Float) -> None:
        """Make many steps, one for each request, and send their replies in parts meanwhile."""
        replies = np.empty((len(requests), len(instance.reply)))
        sent = 0

        def report(steps_done: int) -> None:
            nonlocal sent
            self._answer(Answer.PART, replies[sent:steps_done].tobytes())
            sent = steps_done

        instance.run(requests, replies, report)
