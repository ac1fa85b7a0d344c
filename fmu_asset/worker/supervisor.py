"""The supervisor: a process between twin and worker that ends what is left when one of them is gone.

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
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

from fmu_asset.folders import remove_folder

from .protocol import WORKER_NUMBER, Exit
from .protocol import ended as has_ended

if TYPE_CHECKING:
    from .refusals import RefusalTracer

_GRACE = 2.0
"""Seconds in which a worker without a twin ends by itself."""
_LONGEST_END = 5.0
_DEATH_SIGNAL, _CHILD_SUBREAPER = 1, 36  # of prctl(2)
_ALL_THREADS = 0x40000000  # __WALL of waitpid(2)
_MOST_STOPS = 1000
"""After how many stops of a traced worker the supervisor looks at the twin."""


def supervise(scratch: str, shared: str, grants: str, report: str) -> NoReturn:
    """Start the worker, await its end or the twin's, clear up, and end as the worker did.

    The pipes to the twin are the standard input and output; the worker has them elsewhere, and there what an
    FMU prints goes to the log.

    Parameters
    ----------
    scratch, shared : str
        Folder of the worker, and of the extracted FMU; the twin removes them unless it is dead.
    grants : str
        `Grants` of the sandbox as JSON; an empty text for none.
    report : str
        Number of the file descriptor to which refusals of the sandbox go; an empty text if none are counted.
    """
    import resource

    twin, supervisor = os.getppid(), os.getpid()
    gone = os.pidfd_open(
        twin
    )  # the pipe's end does not tell: an FMU can open its other side for itself
    if os.getppid() != twin:
        os._exit(0)
    incoming, outgoing = os.dup(0), os.dup(1)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    prctl = ctypes.CDLL(None).prctl
    prctl(_CHILD_SUBREAPER, 1, 0, 0, 0)
    asked = False
    reaped: dict[int, int] = {}

    def end_now(*_: object) -> None:
        nonlocal asked
        asked = True
        _kill(ended)

    def reap(*_: object) -> None:
        """Reap whoever has ended, and keep the exit status."""
        with suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                reaped.update([ended])

    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGCHLD})
    worker = os.fork()
    if worker == 0:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM, signal.SIGCHLD})
        os.close(gone)
        if report:
            os.close(int(report))
        os.setpgid(0, 0)
        prctl(_DEATH_SIGNAL, int(signal.SIGKILL), 0, 0, 0)
        if os.getppid() != supervisor:
            os._exit(0)
        _work(incoming, outgoing, scratch, shared, grants)
    ended = os.pidfd_open(worker)
    tracer = _tracer_of(worker, report)
    signal.signal(signal.SIGCHLD, reap if tracer is None else _wake)
    signal.signal(signal.SIGTERM, end_now)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM, signal.SIGCHLD})
    os.write(outgoing, WORKER_NUMBER.pack(worker))
    os.close(outgoing)
    deserted = _await_end(ended, incoming, gone, tracer, reaped)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # from here on nobody's number is free unseen
    status = reaped[worker] if worker in reaped else os.waitpid(worker, 0)[1]
    _end_descendants()
    # The twin's pipes are closed a moment before it is dead.
    if deserted and not asked and status != 0 and has_ended(gone, 1.0):
        remove_folder(scratch)
        remove_folder(shared)
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)
        os.kill(supervisor, number)
    os._exit(os.waitstatus_to_exitcode(status) % 256)


def _tracer_of(worker: int, report: str) -> "RefusalTracer | None":
    """Return what counts the refusals of a worker, if they are counted."""
    if not report:
        return None
    from .refusals import RefusalTracer

    tracer = RefusalTracer(int(report))
    tracer.begin(worker)
    return tracer


def _work(incoming: int, outgoing: int, scratch: str, shared: str, grants: str) -> NoReturn:
    """Be the worker."""
    # Here, so that the supervisor has nothing of it; before the sandbox, since some libraries start programs.
    try:
        import json

        from .sandbox import Grants, confine
        from .server import serve

        confined = grants != "" and confine(Grants(**json.loads(grants)), scratch, shared)
        serve(incoming, outgoing, confined=confined)
    except BaseException:  # noqa: BLE001 - the twin reads the last words in worker.log
        import traceback

        traceback.print_exc()
    os._exit(Exit.OWN_FAILURE)


def _kill(process: int) -> None:
    with suppress(ProcessLookupError):
        signal.pidfd_send_signal(process, signal.SIGKILL)


def _wake(*_: object) -> None:
    """Do nothing: that a signal came is seen by the wakeup descriptor."""


def _go_on_with_stopped(tracer: "RefusalTracer", reaped: dict[int, int]) -> bool:
    """Let go on who has stopped at a system call and reap who has ended; return whether there may be more."""
    with suppress(ChildProcessError):
        for _ in range(_MOST_STOPS):
            process, status = os.waitpid(-1, os.WNOHANG | _ALL_THREADS)
            if process == 0:
                return False
            if os.WIFSTOPPED(status):
                tracer.resume(process, status)
            else:
                reaped[process] = status
        return True
    return False


def _await_end(
    ended: int, incoming: int, gone: int, tracer: "RefusalTracer | None", reaped: dict[int, int]
) -> bool:
    """Await the worker's end; return whether the twin let go of its pipe or is gone.

    A traced worker stops at each of its system calls until it is told here to go on. That is not done in the
    handler of SIGCHLD: handlers interrupt each other.
    """
    woken, waking = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(waking, warn_on_full_buffer=False)
    has_stopped = tracer is not None
    poll = select.poll()
    poll.register(woken, select.POLLIN)
    poll.register(ended, select.POLLIN)
    poll.register(incoming, 0)  # the end of a pipe is reported in any case
    poll.register(gone, select.POLLIN)
    deadline: float | None = None
    while True:
        limit = None if deadline is None else 1000.0 * max(deadline - time.monotonic(), 0.0)
        events = {descriptor for descriptor, _ in poll.poll(0 if has_stopped else limit)}
        if woken in events:
            os.read(woken, 4096)
        if tracer is not None and (has_stopped or woken in events):
            has_stopped = _go_on_with_stopped(tracer, reaped)
        # First: a worker that its twin has left may end before we look.
        for descriptor in events - {ended, woken}:
            poll.unregister(descriptor)
            deadline = time.monotonic() + _GRACE
        if ended in events:
            return deadline is not None
        if deadline is not None and time.monotonic() >= deadline:
            _kill(ended)
            deadline = time.monotonic() + _GRACE


def _end_descendants() -> None:
    """End what the worker has left; the children of one that is ended are the supervisor's children next."""
    deadline = time.monotonic() + _LONGEST_END
    while time.monotonic() < deadline:
        try:
            if os.waitpid(-1, os.WNOHANG)[0]:
                continue
        except ChildProcessError:
            return
        for child in _children():
            os.kill(child, signal.SIGKILL)
            if (
                group := os.getpgid(child)
            ) != os.getpgrp():  # at once, so that nobody has a child meanwhile
                os.killpg(group, signal.SIGKILL)
        time.sleep(0.002)


def _children() -> list[int]:
    """Return the numbers of the supervisor's children."""
    found = []
    for name in os.listdir("/proc"):  # noqa: PTH208 - pathlib would be loaded for this alone
        with suppress(OSError):
            if name.isdigit():
                with open(f"/proc/{name}/stat", "rb") as file:  # noqa: PTH123
                    parent = file.read().rpartition(b")")[2].split()[1]
                found += [int(name)] * (int(parent) == os.getpid())
    return found
