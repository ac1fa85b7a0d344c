"""The keeper: a process between twin and worker that ends what is left when one of them is gone.

The worker is a fork of it, made before any library is loaded, and nothing of the FMU ever runs in it:
neither an endless loop nor an FMU in Python that holds the interpreter keeps it from its work. The system
hands it all orphans of the worker (`PR_SET_CHILD_SUBREAPER`), so that what the FMU has started is ended in
whatever process group or session it hides. (`PR_SET_PDEATHSIG` alone would leave folders and orphans behind,
and from the twin it goes off when the thread that started the worker ends, not the process.)
"""

import ctypes
import os
import select
import signal
import time
from typing import NoReturn

from fmu_asset.folders import remove_folder

from .protocol import OWN_FAILURE, WORKER_NUMBER

_GRACE = 2.0
"""Seconds in which a worker without a twin ends by itself."""
_LONGEST_END = 5.0
_DEATH_SIGNAL, _CHILD_SUBREAPER = 1, 36  # of prctl(2)


def keep(incoming: int, outgoing: int, scratch: str, shared: str, grants: str) -> NoReturn:
    """Start the worker, await its end or the twin's, clear up, and end as the worker did.

    Parameters
    ----------
    incoming, outgoing : int
        The worker's ends of the pipes.
    scratch, shared : str
        Folder of the worker, and of the extracted FMU; the twin removes them unless it is dead.
    grants : str
        `Grants` of the sandbox as JSON; an empty text for none.
    """
    import resource

    twin, keeper = os.getppid(), os.getpid()
    gone = os.pidfd_open(twin)  # the pipe's end does not tell: an FMU can open its other side for itself
    if os.getppid() != twin:
        os._exit(0)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    prctl = ctypes.CDLL(None).prctl
    prctl(_CHILD_SUBREAPER, 1, 0, 0, 0)
    woken, waker = os.pipe()
    os.set_blocking(waker, False)
    signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
    worker = 0
    asked = False

    def end_now(*_: object) -> None:
        nonlocal asked
        asked = True
        os.kill(worker, signal.SIGKILL)  # it is reaped below only, so that the number is still its own

    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    signal.signal(signal.SIGCHLD, lambda *_: None)
    worker = os.fork()
    if worker == 0:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        os.close(woken)
        os.close(waker)
        os.close(gone)
        os.setpgid(0, 0)
        prctl(_DEATH_SIGNAL, int(signal.SIGKILL), 0, 0, 0)
        if os.getppid() != keeper:
            os._exit(0)
        _work(incoming, outgoing, scratch, shared, grants)
    signal.signal(signal.SIGTERM, end_now)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    os.write(outgoing, WORKER_NUMBER.pack(worker))
    os.close(outgoing)
    deserted, status = _await_end(worker, incoming, gone, woken)
    _end_descendants()
    if deserted and not asked and status != 0 and _ended(gone):
        remove_folder(scratch)
        remove_folder(shared)
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)
        os.kill(keeper, number)
    os._exit(os.waitstatus_to_exitcode(status) % 256)


def _work(incoming: int, outgoing: int, scratch: str, shared: str, grants: str) -> NoReturn:
    """Be the worker."""
    # Here, so that the keeper has nothing of it; before the sandbox, since some libraries start programs.
    try:
        import json

        from .sandbox import Grants, confine
        from .server import serve

        confined = grants != "" and confine(Grants(**json.loads(grants)), scratch, shared)
        serve(incoming, outgoing, confined=confined)
    except BaseException:  # noqa: BLE001 - the twin reads the last words in worker.log
        import traceback

        traceback.print_exc()
    os._exit(OWN_FAILURE)


def _await_end(worker: int, incoming: int, gone: int, woken: int) -> tuple[bool, int]:
    """Return whether the twin let go of its pipe or is gone, and the worker's exit status."""
    poll = select.poll()
    poll.register(woken, select.POLLIN)
    poll.register(incoming, 0)  # the end of a pipe is reported in any case
    poll.register(gone, select.POLLIN)
    deadline: float | None = None
    while True:
        status = _reaped(worker)
        if status is not None:
            return deadline is not None, status
        limit = None if deadline is None else 1000.0 * max(deadline - time.monotonic(), 0.0)
        events = [descriptor for descriptor, _ in poll.poll(limit)]
        if woken in events:
            os.read(woken, 4096)
        for descriptor in {incoming, gone}.intersection(events):
            poll.unregister(descriptor)
            deadline = time.monotonic() + _GRACE
        if deadline is not None and time.monotonic() >= deadline:
            os.kill(worker, signal.SIGKILL)
            deadline = time.monotonic() + _GRACE


def _reaped(worker: int) -> int | None:
    """Reap whoever has ended; return the worker's exit status if it was among them."""
    status = None
    while True:
        try:
            number, its_status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return status
        if number == 0:
            return status
        if number == worker:
            status = its_status


def _end_descendants() -> None:
    """End what the worker has left; the children of one that is ended are the keeper's children next."""
    deadline = time.monotonic() + _LONGEST_END
    while time.monotonic() < deadline:
        try:
            if os.waitpid(-1, os.WNOHANG)[0]:
                continue
        except ChildProcessError:
            return
        for child, group in _children():
            os.kill(child, signal.SIGKILL)
            if group != os.getpgrp():  # at once, so that nobody in it can have a child meanwhile
                os.killpg(group, signal.SIGKILL)
        time.sleep(0.002)


def _children() -> list[tuple[int, int]]:
    """Return the keeper's children with their process groups."""
    keeper, found = os.getpid(), []
    for name in os.listdir("/proc"):  # noqa: PTH208 - pathlib would be loaded for this alone
        if name.isdigit():
            try:
                with open(f"/proc/{name}/stat", "rb") as file:  # noqa: PTH123
                    fields = file.read().rpartition(b")")[2].split()
            except OSError:
                continue
            if int(fields[1]) == keeper:
                found.append((int(name), int(fields[2])))
    return found


def _ended(process: int) -> bool:
    """Return whether the twin is dead; its pipes are closed a moment before it is."""
    poll = select.poll()
    poll.register(process, select.POLLIN)
    return bool(poll.poll(1000))
