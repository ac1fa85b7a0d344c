"""What twin and worker say to each other.

Two pipes carry binary messages: a header (kind, whether there are log messages, number of the request,
length), then the payload. A reply bears the number of its request: an FMU that has made a copy of the
worker's process, which answers too, cannot shift the replies. A step is the request block of an instance one
way and the reply block the other, without copies. Any other call is a pickle of its name, the request block
and the arguments; what comes back is never one: bytes, or texts separated by zeros, which are not JSON, of
which an FMU in Python may have changed the module. The reply blocks of many steps come back in parts while
these go on, so that the twin sees how far they are and can stop one that takes too long.
"""

import os
import select
import struct
import time
from enum import IntEnum

HEADER = struct.Struct("<HHIQ")
WORKER_NUMBER = struct.Struct("<q")
"""First of all, the process number of the worker."""
LARGEST_MESSAGE = 2**23
"""Bytes of an answer in words; a header that announces more does not come from the other side's program."""


class Question(IntEnum):
    """Kinds of messages to a worker."""

    STEP, CALL = 1, 2


class Answer(IntEnum):
    """Kinds of messages from a worker."""

    RESULT, FAILURE, PART = 1, 2, 3


class Exit(IntEnum):
    """Exit statuses of a worker: its own program failed, the FMU closed its pipes, the twin is gone."""

    OWN_FAILURE, PIPES_GONE, DESERTED = 70, 71, 72


# Waking a process that sleeps on a pipe costs as much as a whole step. Whoever awaits the other side of a
# step therefore looks again for a moment before it sleeps, if there is a processor for each of the two.
_LOOK_AGAIN = 2.5e-4
_PROCESSORS = (
    len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
)


def joined(*texts: str) -> bytes:
    """Return texts as one message."""
    return "\0".join(text.replace("\0", "") for text in texts).encode("utf-8", "replace")


def separated(message: bytes | bytearray) -> list[str]:
    """Return the texts of a message."""
    return message.decode("utf-8", "replace").split("\0")


def receive(descriptor: int, target: memoryview) -> bool:
    """Fill `target`; return False if the other side is gone."""
    filled = 0
    while filled < len(target):
        count = os.readv(descriptor, [target[filled:]])
        if count == 0:
            return False
        filled += count
    return True


def send(descriptor: int, *parts: bytes | bytearray | memoryview) -> None:
    """Write all parts.

    Raises
    ------
    BrokenPipeError
        If the other side is gone.
    """
    sent = os.writev(descriptor, parts)
    if sent < sum(len(part) for part in parts):
        rest = memoryview(b"".join(parts))[sent:]
        while rest:
            rest = rest[os.write(descriptor, rest) :]


def ended(process: int, limit: float) -> bool:
    """Return whether the process of a file descriptor has ended, or ends within a limit [s]."""
    poll = select.poll()
    poll.register(process, select.POLLIN)
    return bool(poll.poll(1000.0 * limit))


def look(poll: select.poll) -> None:
    """Return as soon as there is something to read, or after a moment without."""
    if _PROCESSORS > 1:
        end = time.monotonic() + _LOOK_AGAIN
        while not poll.poll(0) and time.monotonic() < end:
            pass
