"""The supervisor: a process between twin and worker that cleans up when one of them ends.

The worker is a fork of the supervisor, made before any library is loaded. Nothing of the FMU ever
runs in the supervisor, so neither an endless loop nor an FMU in Python that holds the interpreter
can stop it. The kernel makes it the parent of all orphans of the worker (`PR_SET_CHILD_SUBREAPER`),
so that processes that the FMU has started are ended whatever their process group or session.

`PR_SET_PDEATHSIG` alone would leave folders and orphans behind. Set by a child of the twin, it
would also act when the thread that started the worker ends, and not the process.
"""

import ctypes
import os
import select
import signal
import time
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple, NoReturn

from fmu_asset.folders import remove_folder

from .protocol import WORKER_NUMBER, Exit, has_ended

if TYPE_CHECKING:
    from .refusal_tracer import RefusalTracer

_GRACE = 2.0
"""Time that a worker without a twin has to end by itself [s]."""
_LONGEST_END = 5.0
"""Time for which the supervisor waits for the end of a worker's descendants [s]."""
_PR_SET_PDEATHSIG = 1
_PR_SET_CHILD_SUBREAPER = 36
_ALL_THREADS = 0x40000000  # __WALL of waitpid(2)
_MOST_STOPS = 1000
"""Number of stops of a traced worker after which the supervisor checks whether the twin runs."""
_HANDLED_SIGNALS = (signal.SIGTERM, signal.SIGCHLD)


class _Twin(NamedTuple):
    """The twin as its supervisor sees it, by file descriptors.

    Attributes
    ----------
    process : int
        Its process.
    incoming, outgoing : int
        The two pipes.
    """

    process: int
    incoming: int
    outgoing: int


class _Worker(NamedTuple):
    """The worker as its supervisor sees it.

    Attributes
    ----------
    number : int
        Process number.
    process : int
        File descriptor of its process.
    """

    number: int
    process: int


def supervise(scratch: str, fmu_folder: str, grants: str, report: str) -> NoReturn:
    """Start the worker, wait until it or the twin ends, clean up, and exit as the worker did.

    At the start, the pipes to the twin are the standard input and output. They are moved to other
    descriptors for the worker, so that what an FMU prints goes to the log.

    Parameters
    ----------
    scratch, fmu_folder : str
        The folder of the worker, and that of the extracted FMU. They are removed here only if the
        twin is dead; otherwise the twin removes them.
    grants : str
        The `Grants` of the sandbox as JSON; empty for no sandbox.
    report : str
        The number of the file descriptor for the report of refusals; empty if they are not counted.
    """
    twin = _move_pipes_of_twin()
    _limit_this_process()
    # start the worker
    signal.pthread_sigmask(signal.SIG_BLOCK, _HANDLED_SIGNALS)
    worker = _start_worker(twin, scratch, fmu_folder, grants, report)
    tracer = _tracer_of(worker.number, report)
    statuses: dict[int, int] = {}
    was_asked_to_end = False

    def end_worker(*_: object) -> None:
        nonlocal was_asked_to_end
        was_asked_to_end = True
        _kill(worker.process)

    def reap_children(*_: object) -> None:
        _reap_children(statuses)

    signal.signal(signal.SIGCHLD, reap_children if tracer is None else _do_nothing)
    signal.signal(signal.SIGTERM, end_worker)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _HANDLED_SIGNALS)
    os.write(twin.outgoing, WORKER_NUMBER.pack(worker.number))
    os.close(twin.outgoing)
    # wait for its end
    twin_has_left = _wait_for_end(worker, twin, tracer, statuses)
    # From here on children are reaped only by the calls below, so that the number of an ended
    # process is not given to another one unnoticed.
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    if worker.number in statuses:
        worker_status = statuses[worker.number]
    else:
        _, worker_status = os.waitpid(worker.number, 0)
    # clear up
    _end_descendants()
    # the pipes of a twin are closed a moment before it is dead
    if (
        twin_has_left
        and not was_asked_to_end
        and worker_status != 0
        and has_ended(twin.process, 1.0)
    ):
        remove_folder(scratch)
        remove_folder(fmu_folder)
    _end_as(worker_status)


def _move_pipes_of_twin() -> _Twin:
    """Move the twin's pipes away from the standard input and output."""
    parent = os.getppid()
    # The end of the twin is seen at its process. A pipe does not show it for certain, since an FMU
    # can keep the other side of the pipe open.
    process = os.pidfd_open(parent)
    if os.getppid() != parent:
        os._exit(0)  # the twin has ended meanwhile
    twin = _Twin(process, incoming=os.dup(0), outgoing=os.dup(1))
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    return twin


def _limit_this_process() -> None:
    """Disable core files, and become the parent of all orphaned descendants."""
    import resource

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def _start_worker(twin: _Twin, scratch: str, fmu_folder: str, grants: str, report: str) -> _Worker:
    """Fork the worker from this process, and return its number and descriptor.

    The worker has a process group of its own, and dies with the supervisor. The arguments are those
    of `supervise`.
    """
    supervisor = os.getpid()
    number = os.fork()
    if number == 0:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _HANDLED_SIGNALS)
        os.close(twin.process)
        if report:
            os.close(int(report))
        os.setpgid(0, 0)
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
        if os.getppid() != supervisor:
            os._exit(0)  # the supervisor has ended meanwhile
        _work(twin, scratch, fmu_folder, grants)
    return _Worker(number, os.pidfd_open(number))


def _work(twin: _Twin, scratch: str, fmu_folder: str, grants: str) -> NoReturn:
    """As the worker, enter the sandbox and serve the twin; arguments as for `supervise`."""
    # Imports are here so that the supervisor has nothing of them, and before the sandbox, since
    # some libraries start programs.
    try:
        import json

        from .sandbox import Grants, confine
        from .server import serve

        is_confined = False
        if grants:
            is_confined = confine(Grants(**json.loads(grants)), scratch, fmu_folder)
        serve(twin.incoming, twin.outgoing, confined=is_confined)
    except BaseException:  # noqa: BLE001 - the twin reads the last words in worker.log
        import traceback

        traceback.print_exc()
    os._exit(Exit.OWN_FAILURE)


def _end_as(status: int) -> NoReturn:
    """Exit as the worker did: by the same signal or with the same exit status.

    The twin sees only this process, and reports how the worker died. `status` is that of
    waitpid(2).
    """
    if os.WIFSIGNALED(status):
        number = os.WTERMSIG(status)
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    os._exit(os.waitstatus_to_exitcode(status) % 256)


def _tracer_of(worker: int, report: str) -> "RefusalTracer | None":
    """Return the tracer that counts the refused calls of a worker; None without a report."""
    if not report:
        return None
    from .refusal_tracer import RefusalTracer

    tracer = RefusalTracer(int(report))
    tracer.begin(worker)
    return tracer


def _kill(process: int) -> None:
    """Kill the process of a file descriptor, unless it has ended."""
    with suppress(ProcessLookupError):
        signal.pidfd_send_signal(process, signal.SIGKILL)


def _do_nothing(*_: object) -> None:
    """Ignore a signal; the wakeup descriptor shows that it was received."""


def _reap_children(statuses: dict[int, int]) -> None:
    """Reap all children that have ended, and record their statuses by process number."""
    with suppress(ChildProcessError):
        while True:
            process, status = os.waitpid(-1, os.WNOHANG)
            if process == 0:
                return
            statuses[process] = status


def _resume_stopped(tracer: "RefusalTracer", statuses: dict[int, int]) -> bool:
    """Resume threads that have stopped at a system call, and reap ended processes.

    Return whether more of them may be waiting, because the limit of stops was reached.
    """
    with suppress(ChildProcessError):
        for _ in range(_MOST_STOPS):
            process, status = os.waitpid(-1, os.WNOHANG | _ALL_THREADS)
            if process == 0:
                return False
            if os.WIFSTOPPED(status):
                tracer.resume(process, status)
            else:
                statuses[process] = status
        return True
    return False


def _wait_for_end(
    worker: _Worker, twin: _Twin, tracer: "RefusalTracer | None", statuses: dict[int, int]
) -> bool:
    """Wait for the end of the worker; return whether the twin had left before.

    The twin has left if it has ended or closed its pipe. The worker is then killed unless it ends
    soon. A traced worker stops at each of its system calls until it is resumed here; the handler of
    SIGCHLD must not do so, since handlers can interrupt each other. The statuses of reaped
    processes are added to `statuses`.
    """
    wakeup_read_end, wakeup_write_end = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(wakeup_write_end, warn_on_full_buffer=False)
    has_stopped = tracer is not None
    poll = select.poll()
    poll.register(wakeup_read_end, select.POLLIN)
    poll.register(worker.process, select.POLLIN)
    poll.register(twin.incoming, 0)  # the end of a pipe is reported in any case
    poll.register(twin.process, select.POLLIN)
    deadline: float | None = None
    while True:
        timeout = None if deadline is None else 1000.0 * max(deadline - time.monotonic(), 0.0)
        events = {descriptor for descriptor, _ in poll.poll(0 if has_stopped else timeout)}
        if wakeup_read_end in events:
            os.read(wakeup_read_end, 4096)
        if tracer is not None and (has_stopped or wakeup_read_end in events):
            has_stopped = _resume_stopped(tracer, statuses)
        # Check the twin first: if it has left, the worker may have ended for that reason already.
        for descriptor in events - {worker.process, wakeup_read_end}:
            poll.unregister(descriptor)
            deadline = time.monotonic() + _GRACE
        if worker.process in events:
            return deadline is not None
        if deadline is not None and time.monotonic() >= deadline:
            _kill(worker.process)
            deadline = time.monotonic() + _GRACE


def _end_descendants() -> None:
    """Kill the processes that the worker has left behind.

    When a process is killed, its children become children of the supervisor, and are killed next.
    """
    deadline = time.monotonic() + _LONGEST_END
    while time.monotonic() < deadline:
        try:
            process, _ = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if process:
            continue
        for child in _children():
            os.kill(child, signal.SIGKILL)
            group = os.getpgid(child)
            if group != os.getpgrp():
                # the whole group at once, so that none of them starts a child meanwhile
                os.killpg(group, signal.SIGKILL)
        time.sleep(0.002)


def _children() -> list[int]:
    """Return the process numbers of the supervisor's children."""
    children = []
    for name in os.listdir("/proc"):  # noqa: PTH208 - pathlib would be loaded for this alone
        if not name.isdigit():
            continue
        with suppress(OSError):
            with open(f"/proc/{name}/stat", "rb") as file:  # noqa: PTH123
                fields_after_name = file.read().rpartition(b")")[2].split()
            if int(fields_after_name[1]) == os.getpid():
                children.append(int(name))
    return children
