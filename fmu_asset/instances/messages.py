"""What FMUs log: every message reaches the instance whose name it carries."""

import ctypes
import itertools
import os
from collections import deque
from typing import Any

from fmpy import calloc, fmi1, fmi2, free
from fmpy.logging import addLoggerProxy

from fmu_asset.errors import visible

_LONGEST_LOG = 1000

# fmpy's native proxy, which formats the messages of C FMUs, knows one logger in a process.
_mailboxes: "dict[bytes, Mailbox]" = {}
_instance_numbers = itertools.count(1)
_ERROR, _FATAL = 3, 4


def _log(_: object, instance_name: bytes, status: int, category: bytes, message: bytes) -> None:
    mailbox = _mailboxes.get(instance_name or b"")
    if mailbox is not None:
        mailbox.log(None, status, category, message)


_MODULES = {1: fmi1, 2: fmi2}
_LOGGERS = {1: fmi1.fmi1CallbackLoggerTYPE(_log), 2: fmi2.fmi2CallbackLoggerTYPE(_log)}


class Mailbox:
    """The messages of one instance.

    Parameters
    ----------
    wish : str
        Name of the instance; made unique in the process.

    Attributes
    ----------
    name : str
        The unique name.
    messages : deque of (int, str)
        The last ones that were not taken yet: status and text.
    errors : int
        How many messages were errors so far.
    """

    def __init__(self, wish: str) -> None:
        self.name = f"{wish}-{os.getpid()}-{next(_instance_numbers)}"
        self.messages: deque[tuple[int, str]] = deque(maxlen=_LONGEST_LOG)
        self.errors = 0
        _mailboxes[self.name.encode()] = self

    def log(self, _: object, status: int, category: bytes, message: bytes) -> None:
        """Take a message."""
        self.errors += status in (_ERROR, _FATAL)
        text = (message or b"").decode("utf-8", "replace").rstrip()
        self.messages.append((int(status), visible(text)))

    def take(self) -> list[tuple[int, str]]:
        """Return and forget the messages: status and text."""
        messages = list(self.messages)
        self.messages.clear()
        return messages

    def close(self) -> None:
        """Take no more messages."""
        _mailboxes.pop(self.name.encode(), None)


def callbacks(fmi_version: int) -> Any:
    """Return new callbacks for FMI 1 or 2, whose logger knows all mailboxes."""
    module, name = _MODULES[fmi_version], f"fmi{fmi_version}Callback"
    given = getattr(module, f"{name}Functions")()  # what is not said, such as `stepFinished`, is none
    given.logger = _LOGGERS[fmi_version]
    given.allocateMemory = getattr(module, f"{name}AllocateMemoryTYPE")(calloc)
    given.freeMemory = getattr(module, f"{name}FreeMemoryTYPE")(free)
    addLoggerProxy(ctypes.byref(given))
    return given
