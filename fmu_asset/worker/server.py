"""The worker's side: it imports fmpy, and of the project `errors`, `instances` and this folder only."""

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
from typing import Any, NoReturn

import numpy as np

from fmu_asset.errors import FmuError, FmuWorkerError
from fmu_asset.instances.base import FmuInstance
from fmu_asset.instances.opening import open_instance
from reporting.arrays import Float

from .protocol import HEADER, Answer, Exit, Question, joined, look, receive, send

LARGEST_FILE = 2 * 1024**3
"""Bytes that an FMU may write to one file, such as an endless log."""
_NOT_GRANTED = (
    " The system refused it something (Permission denied{}), as its sandbox does: what it needs can be "
    "granted by `read`, `write`, `ports` or `programs` in the table [limits] of its binding."
)
_REACHES = ("open", "os.", "shutil.", "socket.", "subprocess.", "urllib.")
_last_reach: list[tuple[str, tuple[object, ...]]] = []
"""What Python code has tried last beyond this process, if it has: the event of auditing and its arguments."""


def _notice(event: str, arguments: tuple[object, ...]) -> None:
    if (
        event.startswith(_REACHES) and event != "os.chdir"
    ):  # which is free, and which we do ourselves
        _last_reach[:] = [(event, arguments)]


def _refusal() -> str:
    """Return the sentence on what the sandbox has refused, with its name if Python knows it."""
    tried = ""
    for event, arguments in _last_reach:
        what = ", ".join(
            repr(value) for value in arguments if isinstance(value, str | bytes | list | tuple)
        )
        tried = f"; the last that its Python code tried was {event}({what})"
    return _NOT_GRANTED.format(tried)


_locate_errno = ctypes.CDLL(None).__errno_location
_locate_errno.restype = ctypes.c_void_p


def serve(incoming: int, outgoing: int, *, confined: bool) -> NoReturn:
    """Answer requests until the pipe closes, and end.

    Parameters
    ----------
    incoming, outgoing : int
        File descriptors of the pipes.
    confined : bool
        Whether this process is in a sandbox, so that a failure may come from it.
    """
    # The twin decides what an interruption means; the worker ends when its pipe closes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable()
    _restrict()
    asked = False
    try:
        asked, instance = _answer_requests(incoming, outgoing, confined=confined)
        if instance is not None:
            instance.close()
    except BrokenPipeError:
        pass  # the twin is gone, or this is a copy of the worker without one
    except OSError as error:
        os._exit(Exit.PIPES_GONE if error.errno == errno.EBADF else Exit.OWN_FAILURE)
    except BaseException:  # noqa: BLE001 - the twin reads the last words in worker.log
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(Exit.OWN_FAILURE)
    # Without the interpreter's shutdown, which third-party libraries may not survive.
    os._exit(0 if asked else Exit.DESERTED)


def _restrict() -> None:
    """End an FMU that fills the disk."""
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    limit = LARGEST_FILE if hard == resource.RLIM_INFINITY else min(LARGEST_FILE, hard)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    # Python ignores this signal, and the FMU would see a write that fails again and again.
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)


def _answer_requests(
    incoming: int, outgoing: int, *, confined: bool
) -> tuple[bool, FmuInstance | None]:
    """Answer requests; return whether the end was asked for, and the instance that is still open."""
    if confined:
        sys.addaudithook(_notice)
    instance: FmuInstance | None = None
    header = memoryview(bytearray(HEADER.size))
    reply_header = bytearray(HEADER.size)
    system_error = ctypes.c_int.from_address(
        _locate_errno()
    )  # what a call of the FMU leaves in `errno`
    request = reply = memoryview(b"")
    own_number, poll = os.getpid(), select.poll()
    poll.register(incoming, select.POLLIN | select.POLLHUP)

    def answer(kind: int, payload: bytes | memoryview) -> None:
        if os.getpid() != own_number:
            os._exit(0)  # a copy that the FMU has made of this process
        logged = kind != Answer.FAILURE and instance is not None and len(instance.messages) > 0
        HEADER.pack_into(reply_header, 0, kind, logged, number, len(payload))
        send(outgoing, reply_header, payload)

    while receive(incoming, header):
        kind, _, number, length = HEADER.unpack(header)
        try:
            if kind == Question.STEP:
                if not receive(incoming, request) or instance is None:
                    break
                instance.step()
                payload: bytes | memoryview = reply
            else:
                content = bytearray(length)
                if not receive(incoming, memoryview(content)):
                    break
                name, block, arguments = pickle.loads(content)
                system_error.value = 0
                _last_reach.clear()
                if name == "close":
                    return True, instance
                if name == "open":
                    if instance is not None:
                        instance.close()
                    instance = open_instance(*arguments)
                    request = memoryview(instance.request).cast("B")
                    reply = memoryview(instance.reply).cast("B")
                elif instance is None:
                    raise FmuWorkerError("The worker was asked before it had an FMU.")
                request[:] = block
                payload = _called(instance, name, arguments, answer) or (
                    reply if name == "read" else b""
                )
            answer(Answer.RESULT, payload)
        except FmuError as error:
            refused = system_error.value == errno.EACCES or "ermission denied" in str(error)
            sentence = error.sentence + (_refusal() if confined and refused else "")
            lost = instance is None or instance.lost
            time = "" if error.time is None else repr(error.time)
            answer(
                Answer.FAILURE,
                joined(type(error).__name__, "lost" * lost, time, sentence, *error.messages),
            )
        look(poll)
    return False, instance


def _called(
    instance: FmuInstance,
    name: str,
    arguments: tuple[Any, ...],
    answer: Callable[[int, bytes], None],
) -> bytes:
    """Call a method of the instance and return what it answers as bytes."""
    if name == "run":
        _run(instance, arguments[0], answer)
    elif name == "take_log":
        return joined(*(f"{status} {text}" for status, text in instance.take_log()))
    elif name != "open":
        return getattr(instance, name)(*arguments) or b""
    return b""


def _run(instance: FmuInstance, requests: Float, answer: Callable[[int, bytes], None]) -> None:
    """Make many steps, and send the replies in parts."""
    replies, sent = np.empty((len(requests), len(instance.reply))), 0

    def report(done: int) -> None:
        nonlocal sent
        answer(Answer.PART, replies[sent:done].tobytes())
        sent = done

    instance.run(requests, replies, report)
