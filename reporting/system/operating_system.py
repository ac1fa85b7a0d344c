"""What differs between operating systems, each with its substitute where a system lacks it.

The package is tested on Linux. What POSIX alone has (locks that belong to a folder, forks, limits
of resources, priorities, the processors that a process may use) is called from here, and from the
worker of FMUs, which needs Linux. A substitute that is weaker says so once, in the log.
"""

import math
import os
import queue
import select
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Protocol

from reporting.system.log import module_logger

_logger = module_logger(__name__)
_reported_weaknesses: set[str] = set()
_BINARY = getattr(os, "O_BINARY", 0)
"""The flag without which Windows translates line feeds of files that `os.open` has opened."""
_LOCK_SUFFIX = ".lock"


class ReadableStream(Protocol):
    """A stream of bytes that can be read in pieces."""

    def fileno(self) -> int:
        """Return the descriptor of the stream."""

    def read1(self, size: int, /) -> bytes:
        """Return what has come, waiting only if nothing has; empty at the end of the stream."""


def _report_weakness(sentence: str) -> None:
    """Log what this system lacks, once in a process."""
    if sentence not in _reported_weaknesses:
        _reported_weaknesses.add(sentence)
        _logger.warning(sentence)


def open_descriptor(path: Path, flags: int, mode: int = 0o666) -> int:
    """Return a descriptor of a file whose bytes are read and written unchanged.

    Parameters
    ----------
    flags : int
        The flags of `os.open`.
    mode : int
        The permissions of a new file.
    """
    return os.open(path, flags | _BINARY, mode)


def read_at(descriptor: int, count: int, position: int) -> bytes:
    """Return at most `count` bytes at a position of an open file, without moving its position."""
    if hasattr(os, "pread"):
        return os.pread(descriptor, count, position)
    former_position = os.lseek(descriptor, 0, os.SEEK_CUR)
    os.lseek(descriptor, position, os.SEEK_SET)
    try:
        return os.read(descriptor, count)
    finally:
        os.lseek(descriptor, former_position, os.SEEK_SET)


def lock_descriptor(descriptor: int, *, wait: bool, shared: bool = False) -> None:
    """Lock an open file for this process until its descriptor is closed.

    On Windows a byte far beyond the end of the content is locked, so that other processes can still
    read the content. A system without locks on files locks nothing, and says so once in the log.

    Parameters
    ----------
    descriptor : int
        The descriptor of the open file.
    wait : bool
        Whether to wait while another process holds the lock.
    shared : bool
        Whether other processes may hold shared locks at the same time. Windows has no shared locks,
        so that the lock is exclusive there.

    Raises
    ------
    BlockingIOError
        If another process holds the lock and `wait` is False.
    """
    try:
        import fcntl
    except ImportError:
        _lock_byte(descriptor, wait=wait)
        return
    kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
    fcntl.flock(descriptor, kind | (0 if wait else fcntl.LOCK_NB))


def _lock_byte(descriptor: int, *, wait: bool) -> None:
    """Lock a byte of an open file on Windows; see `lock_descriptor`."""
    try:
        import msvcrt
    except ImportError:
        _report_weakness(
            "This system has no locks on files: two processes that write into the same folder are "
            "not kept apart."
        )
        return
    functions = vars(msvcrt)  # of Windows alone, so that no stub of another system has them
    mode = functions["LK_LOCK" if wait else "LK_NBLCK"]
    former_position = os.lseek(descriptor, 0, os.SEEK_CUR)
    os.lseek(descriptor, 2**30, os.SEEK_SET)
    try:
        while True:
            try:
                functions["locking"](descriptor, mode, 1)
                return
            except OSError as error:
                # A lock that is waited for is tried for ten seconds only
                if not wait:
                    raise BlockingIOError(error.errno, error.strerror) from None
    finally:
        os.lseek(descriptor, former_position, os.SEEK_SET)


def lock_folder(folder: Path, *, shared: bool = False) -> int | None:
    """Lock a folder for this process.

    The lock belongs to the folder itself, so it stays when the folder is renamed. The system
    releases it when the process ends. Windows cannot open a folder: there a file in the folder for
    temporary files, named after the number of the folder, is locked instead, and only processes
    with the same folder for temporary files see the lock.

    Parameters
    ----------
    folder : Path
        The folder.
    shared : bool
        Whether other processes may hold shared locks at the same time; see `lock_descriptor`.

    Returns
    -------
    int or None
        The file descriptor that holds the lock until it is closed; None if another process has
        locked the folder.
    """
    if _can_lock_folders():
        descriptor = os.open(folder, os.O_RDONLY)
    else:
        descriptor = open_descriptor(_lock_file_of(folder), os.O_RDWR | os.O_CREAT)
    try:
        lock_descriptor(descriptor, wait=False, shared=shared)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def is_lock_of(descriptor: int, folder: Path) -> bool:
    """Return whether a lock is that of the folder that now has a path.

    Another process may have replaced the folder after it was locked.
    """
    if not folder.is_dir():
        return False
    locked = folder if _can_lock_folders() else _lock_file_of(folder)
    return locked.exists() and os.path.samestat(os.fstat(descriptor), locked.stat())


def _can_lock_folders() -> bool:
    """Return whether a folder itself can be locked."""
    try:
        import fcntl  # noqa: F401
    except ImportError:
        return False
    return True


def _lock_file_of(folder: Path) -> Path:
    """Return the file that is locked in the place of a folder."""
    status = folder.stat()
    parent = Path(tempfile.gettempdir(), "uav-twin-locks")
    parent.mkdir(parents=True, exist_ok=True)
    return parent / f"{status.st_dev}-{status.st_ino}{_LOCK_SUFFIX}"


def can_flush(path: Path) -> bool:
    """Return whether the system can flush a file or a folder to the disk.

    Windows cannot flush a folder. A file that was moved into it may be lost in a power failure; the
    former file is then still there.
    """
    return os.name == "posix" or not path.is_dir()


def flag_for_flushing() -> int:
    """Return the flag with which a file is opened to flush it; Windows needs write access."""
    return os.O_RDONLY if os.name == "posix" else os.O_RDWR | _BINARY


def can_fork() -> bool:
    """Return whether a process can be forked; if not, the log says once what follows from it."""
    if hasattr(os, "fork"):
        return True
    _report_weakness(
        "This system cannot fork a process: files of results are read by this process itself, "
        "without limits of time and memory, and a damaged file may end it."
    )
    return False


def can_supervise() -> bool:
    """Return whether a process can be isolated and supervised as the worker of an FMU is.

    That needs Linux 5.3 or later. If it is not possible, the log says once what follows from it.
    """
    if hasattr(os, "pidfd_open") and hasattr(os, "fork"):
        return True
    _report_weakness(
        "This system cannot isolate FMUs, which needs Linux 5.3 or later: an FMU runs inside the "
        "twin with all rights of its user and without limits of time and memory, and its crash "
        "ends the twin."
    )
    return False


def usable_processors() -> int:
    """Return how many processors this process may use: all, unless the system limits it to some."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def allow_many_files() -> float:
    """Raise this process's limit of open files to the largest allowed, and return it.

    The limit is infinite if the system has none.
    """
    try:
        import resource
    except ImportError:
        return math.inf
    _, hard_limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard_limit, hard_limit))
    return math.inf if hard_limit == resource.RLIM_INFINITY else hard_limit


def lower_priority(niceness: int, process_id: int = 0) -> None:
    """Let other processes run first, if the system has priorities.

    Parameters
    ----------
    niceness : int
        The niceness of POSIX, from 0 to 19. A process that has a higher one keeps it.
    process_id : int
        The number of the process; 0 for this one. One that has ended is left alone.
    """
    if not hasattr(os, "setpriority"):
        return
    with suppress(ProcessLookupError):
        present_niceness = os.getpriority(os.PRIO_PROCESS, process_id)
        # Only a privileged process may lower its niceness again
        os.setpriority(os.PRIO_PROCESS, process_id, max(niceness, present_niceness))


@contextmanager
def call_on_end_signal(request_end: Callable[[], None]) -> Iterator[None]:
    """Let SIGINT and SIGTERM call a function, instead of ending the process, within a context.

    The former handlers are restored at the end. Only the main thread of a process may set handlers;
    in another thread the context changes nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former_handlers = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        former_handlers[number] = signal.signal(number, lambda *_: request_end())
    try:
        yield
    finally:
        for number, handler in former_handlers.items():
            signal.signal(number, handler)


def polled_pieces(stream: ReadableStream, size: int) -> Iterator[bytes | None]:
    """Yield the pieces of a stream as they arrive, until it ends, without ever waiting.

    None is yielded whenever no piece has arrived, so that the caller can do something else before
    it asks again. Where the system cannot tell whether bytes have arrived (on Windows it can for
    sockets only), a thread reads the stream.

    Parameters
    ----------
    stream : file
        The stream, open to be read as bytes.
    size : int
        The greatest length of a piece.
    """
    if not _can_poll(stream):
        yield from pieces_read_by_thread(stream, size)
        return
    while True:
        readable, _, _ = select.select([stream], [], [], 0.0)
        if not readable:
            yield None
            continue
        piece = stream.read1(size)
        if piece == b"":
            return
        yield piece


def _can_poll(stream: ReadableStream) -> bool:
    """Return whether the system can tell whether something has come on a stream."""
    try:
        select.select([stream], [], [], 0.0)
    except OSError:
        return False
    return True


def pieces_read_by_thread(stream: ReadableStream, size: int) -> Iterator[bytes | None]:
    """Yield the pieces of a stream as they arrive, and None as long as there is no new one.

    A thread waits for the stream and puts each piece into a queue, so that the caller never waits.
    An error in the thread is raised in the caller.
    """
    end_of_stream = b""
    arrivals: queue.SimpleQueue[bytes | BaseException] = queue.SimpleQueue()

    def read_until_end() -> None:
        try:
            piece = stream.read1(size)
            while piece:
                arrivals.put(piece)
                piece = stream.read1(size)
            arrivals.put(end_of_stream)
        except BaseException as error:  # noqa: BLE001 - raised again where the stream is read
            arrivals.put(error)

    threading.Thread(target=read_until_end, daemon=True).start()
    while True:
        try:
            arrival = arrivals.get_nowait()
        except queue.Empty:
            yield None
            continue
        if isinstance(arrival, BaseException):
            raise arrival
        if arrival == end_of_stream:
            return
        yield arrival


def is_same_beginning(file: BinaryIO, beginning: bytes) -> bool:
    """Return whether an open file still begins with some bytes, without moving its position."""
    return read_at(file.fileno(), len(beginning), 0) == beginning
