"""Messages between the twin and the worker process of an FMU.

Two pipes carry binary messages: a header (kind, whether there are log messages, number of the
request, length), then the payload. A reply bears the number of its request: an FMU that has copied
the worker's process, so that the copy answers too, cannot shift the replies.

A step is the request block of an instance one way and the reply block the other, without copies.
Any other call is a pickle of its name, the request block and the arguments. What comes back is
never a pickle: bytes, or texts separated by zeros (not JSON, since an FMU in Python may have
changed that module). The reply blocks of many steps come back in parts while the steps go on, so
that the twin sees how far they are, and can stop one that takes too long.
"""

import os
import select
import struct
import time
from enum import IntEnum

from reporting.system.operating_system import usable_processors

HEADER = struct.Struct("<HHIQ")
WORKER_NUMBER = struct.Struct("<q")
"""Process number of the worker, which is sent first of all."""
LARGEST_MESSAGE = 2**23
"""Largest answer in words [bytes]; a header that announces more is not from our program."""


class Question(IntEnum):
    """Kinds of messages to a worker."""

    STEP = 1
    CALL = 2


class Answer(IntEnum):
    """Kinds of messages from a worker."""

    RESULT = 1
    FAILURE = 2
    PART = 3


class Exit(IntEnum):
    """Exit statuses of a worker.

    Its own program failed, the FMU closed its pipes, or the twin is gone.
    """

    OWN_FAILURE = 70
    PIPES_GONE = 71
    ORPHANED = 72


_POLLING_TIME = 2.5e-4
"""Time for which a message is awaited by repeated polling, before the process sleeps [s].

Waking a process that sleeps on a pipe takes as long as a whole step of an FMU. If there is a
processor for each of twin and worker, both therefore poll for a moment first.
"""


_PROCESSOR_COUNT = usable_processors()


def joined(*texts: str) -> bytes:
    """Return texts as one message."""
    return "\0".join(text.replace("\0", "") for text in texts).encode("utf-8", "replace")


def separated(message: bytes | bytearray) -> list[str]:
    """Return the texts of a message."""
    return message.decode("utf-8", "replace").split("\0")


def receive(descriptor: int, target: memoryview) -> bool:
    """Fill a buffer from a pipe, given by its file descriptor; return False if it is closed."""
    filled = 0
    while filled < len(target):
        count = os.readv(descriptor, [target[filled:]])
        if count == 0:
            return False
        filled += count
    return True


def send(descriptor: int, *parts: bytes | bytearray | memoryview) -> None:
    """Write a message of several parts to a pipe, given by its file descriptor.

    Raises
    ------
    BrokenPipeError
        If the other side is gone.
    """
    sent_bytes = os.writev(descriptor, parts)
    if sent_bytes < sum(len(part) for part in parts):
        # only then are the parts copied
        remaining = memoryview(b"".join(parts))[sent_bytes:]
        while remaining:
            count = os.write(descriptor, remaining)
            remaining = remaining[count:]


def has_ended(process: int, limit: float) -> bool:
    """Return whether a process ends within a limit [s]; it is given by `os.pidfd_open`."""
    poll = select.poll()
    poll.register(process, select.POLLIN)
    return bool(poll.poll(1000.0 * limit))


def poll_for_message(poll: "select.poll") -> None:
    """Return once there is something to read, or after `_POLLING_TIME`."""
    if _PROCESSOR_COUNT > 1:
        end = time.monotonic() + _POLLING_TIME
        while not poll.poll(0) and time.monotonic() < end:
            pass
