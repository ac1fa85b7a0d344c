"""What a worker may use, and what happens to it when the twin is gone.

The limit of memory is of resident memory, and the twin keeps it: it looks at the worker while it waits for a
long call, and now and then between short ones. `RLIMIT_AS` would refuse FMUs that reserve address space and
never use it (Java, .NET, CUDA, the stacks of threads); under either resource limit an allocation fails inside
the FMU, which then crashes somewhere, and nobody could say why.
"""

from __future__ import annotations

import contextlib
import os
import resource
import select
import shutil
import signal
import threading
import time
from typing import NoReturn

LARGEST_FILE = 2 * 1024**3
"""Bytes that an FMU may write to one file, such as an endless log."""
_GRACE = 2.0


def restrict() -> None:
    """Leave no core dump, and end an FMU that fills the disk."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    limit = LARGEST_FILE if hard == resource.RLIM_INFINITY else min(LARGEST_FILE, hard)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    # Python ignores this signal, and the FMU would see a write that fails again and again.
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)


class Household:
    """The folders of a worker, and the end of the worker when the twin is gone.

    A thread watches the pipe: it runs even while the FMU is in an endless loop. (`PR_SET_PDEATHSIG` would
    leave the folders behind, and it goes off when the thread that started the worker ends, not the process.)

    Parameters
    ----------
    incoming : int
        The pipe from the twin; its end is that of the twin, or the twin's wish.
    scratch : str
        The folder of this worker alone.

    Attributes
    ----------
    shared : str
        The folder of the extracted FMU, which the twin removes unless it is dead.
    """

    def __init__(self, incoming: int, scratch: str) -> None:
        self._scratch = scratch
        self.shared = ""
        self._twin = os.getppid()
        threading.Thread(target=self._watch, args=(incoming,), daemon=True).start()

    def leave(self, *, asked: bool) -> NoReturn:
        """Remove the folders that nobody else will remove, and end.

        Parameters
        ----------
        asked : bool
            Whether the twin asked for the end, so that it lives and ends what the FMU has started.
        """
        shutil.rmtree(self._scratch, ignore_errors=True)
        if self.shared and not asked and self._orphaned():
            shutil.rmtree(self.shared, ignore_errors=True)
        if not asked and os.getpgrp() == os.getpid():
            with contextlib.suppress(OSError):
                os.killpg(os.getpid(), signal.SIGKILL)
        # Without the interpreter's shutdown, which third-party libraries may not survive.
        os._exit(0)

    def _orphaned(self) -> bool:
        """Return whether the twin is dead; its pipes are closed a moment before it is."""
        for _ in range(100):
            if os.getppid() != self._twin:
                return True
            time.sleep(0.01)
        return False

    def _watch(self, incoming: int) -> None:
        poll = select.poll()
        poll.register(incoming, 0)  # the end of the pipe is reported in any case
        poll.poll()
        time.sleep(_GRACE)  # a worker that is not busy ends by itself
        self.leave(asked=False)


def resident_memory(process: int) -> int | None:
    """Return the resident memory of a process [bytes], or None if it is gone or the system does not say."""
    try:
        with open(f"/proc/{process}/statm", "rb") as file:  # noqa: PTH123 - half the time of Path.open
            return int(file.read().split()[1]) * resource.getpagesize()
    except (OSError, IndexError, ValueError):
        return None
