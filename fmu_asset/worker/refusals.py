"""What the system refuses an FMU while it flies: which files, sockets, processes and other things it wanted.

The supervisor traces the worker and all that the FMU starts (ptrace(2)), reads what each system call returns,
and counts those that the sandbox lets fail. So the system itself says what is refused, and no rule of the
sandbox is written down twice. Tracing makes every system call slower: `fmu check` does so in one flight,
missions never.
"""

import ctypes
import json
import os
import signal
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from errno import EACCES, EPERM, EXDEV
from typing import IO, Any, Literal, NamedTuple

from .sandbox import refused_calls

Kind = Literal["files", "sockets", "processes", "others"]
_KINDS: dict[Kind, tuple[str, str]] = {
    "files": ("file or folder", "files or folders"),
    "sockets": ("socket or connection", "sockets or connections"),
    "processes": ("program or other process", "programs or other processes"),
    "others": ("other system call", "other system calls"),
}
"""What is counted, in the singular and in the plural."""


class _Call(NamedTuple):
    """A system call that the sandbox may refuse.

    Attributes
    ----------
    name : str
        As its manual page is called.
    kind : Kind
        What it reaches for.
    argument : int
        Which argument names that: the address of a path or socket address, or a number.
    """

    name: str
    kind: Kind
    argument: int


_PATH_CALLS = {
    "open": 0, "creat": 0, "truncate": 0, "unlink": 0, "rmdir": 0, "mkdir": 0, "mknod": 0, "rename": 0,
    "link": 0, "symlink": 1, "inotify_add_watch": 1, "openat": 1, "openat2": 1, "mkdirat": 1, "mknodat": 1,
    "unlinkat": 1, "renameat": 1, "renameat2": 1, "linkat": 1, "symlinkat": 2,
}  # fmt: skip
_SOCKET_CALLS = {
    "socket": 0, "socketpair": 0, "connect": 1, "bind": 1, "sendto": 4, "sendmsg": 0,
}  # fmt: skip
_PROCESS_CALLS = {
    "execve": 0, "execveat": 1, "kill": 0, "tkill": 0, "tgkill": 0, "ptrace": 1, "setpriority": 1,
    "ioprio_set": 1, "prlimit64": 0, "process_vm_readv": 0, "process_vm_writev": 0, "sched_setparam": 0,
    "sched_setscheduler": 0, "sched_setaffinity": 0, "sched_setattr": 0,
}  # fmt: skip
_SIGNALLING = ("kill", "tkill", "tgkill", "ptrace", "process_vm_readv", "process_vm_writev")
"""Calls that fail with EPERM where Landlock refuses them."""
_RENAMING = ("rename", "renameat", "renameat2", "link", "linkat")
"""Calls that fail with EXDEV where Landlock refuses them: as if the folders were on two disks."""
_CALLS_OF_FOLDERS = (
    "openat",
    "openat2",
    "mkdirat",
    "mknodat",
    "unlinkat",
    "renameat",
    "renameat2",
    "linkat",
)
"""Calls whose first argument is the folder at which a relative path begins."""
_PATH_OF_PROGRAM = ("execve", "execveat")

# <asm/unistd.h> of each processor.
_NUMBERS: dict[str, dict[str, int]] = {
    "x86_64": {
        "open": 2, "socket": 41, "connect": 42, "sendto": 44, "sendmsg": 46, "bind": 49,
        "socketpair": 53, "execve": 59, "kill": 62, "truncate": 76, "rename": 82, "mkdir": 83,
        "rmdir": 84, "creat": 85, "link": 86, "unlink": 87, "symlink": 88, "ptrace": 101, "mknod": 133,
        "setpriority": 141, "sched_setparam": 142, "sched_setscheduler": 144, "tkill": 200,
        "sched_setaffinity": 203, "tgkill": 234, "ioprio_set": 251, "inotify_add_watch": 254,
        "openat": 257, "mkdirat": 258, "mknodat": 259, "unlinkat": 263, "renameat": 264, "linkat": 265,
        "symlinkat": 266, "prlimit64": 302, "process_vm_readv": 310, "process_vm_writev": 311,
        "sched_setattr": 314, "renameat2": 316, "execveat": 322, "openat2": 437,
    },
    "aarch64": {
        "inotify_add_watch": 27, "ioprio_set": 30, "mknodat": 33, "mkdirat": 34, "unlinkat": 35,
        "symlinkat": 36, "linkat": 37, "renameat": 38, "truncate": 45, "openat": 56, "ptrace": 117,
        "sched_setparam": 118, "sched_setscheduler": 119, "sched_setaffinity": 122, "kill": 129,
        "tkill": 130, "tgkill": 131, "setpriority": 140, "socket": 198, "socketpair": 199, "bind": 200,
        "connect": 203, "sendto": 206, "sendmsg": 211, "execve": 221, "prlimit64": 261,
        "process_vm_readv": 270, "process_vm_writev": 271, "sched_setattr": 274, "renameat2": 276,
        "execveat": 281, "openat2": 437,
    },
}  # fmt: skip
_FAMILIES = {1: "Unix", 2: "IPv4", 10: "IPv6", 16: "netlink", 17: "packet"}
_UNIX, _IPV4, _IPV6 = 1, 2, 10


def _calls_of_this_processor() -> dict[int, _Call]:
    """Return the system calls that may be refused, by their numbers; none of a processor without a table."""
    kinds: list[tuple[Kind, dict[str, int]]] = [
        ("files", _PATH_CALLS),
        ("sockets", _SOCKET_CALLS),
        ("processes", _PROCESS_CALLS),
    ]
    numbers = _NUMBERS.get(os.uname().machine, {})
    calls = {number: _Call(f"system call {number}", "others", 0) for number in refused_calls()}
    for kind, arguments in kinds:
        for name, argument in arguments.items():
            if name in numbers:
                calls[numbers[name]] = _Call(name, kind, argument)
    return calls


# ---------------------------------------------------------------------- the twin's side

_report: ContextVar[IO[bytes] | None] = ContextVar("report", default=None)


class RefusalReport:
    """The refusals of all workers that are started while it is open, as `watch_for_refusals` opens it.

    Parameters
    ----------
    file : binary file
        Where the supervisors of the workers write them.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    @property
    def _record(self) -> dict[str, Any]:
        self._file.seek(0)
        content: dict[str, Any] = json.loads(self._file.read() or b"{}")
        return content

    @property
    def unavailable(self) -> str:
        """Why refusals cannot be counted on this machine; an empty text if they were."""
        record = self._record
        return str(record.get("unavailable", "" if record else "no worker was started"))

    @property
    def counts(self) -> dict[Kind, tuple[int, str]]:
        """How many calls of each kind were refused, and the first of each."""
        refused: dict[Kind, tuple[int, str]] = self._record.get("refused", {})
        return refused

    def verdict(self) -> Literal["ok", "warning", "skipped"]:
        """Return "warning" if something was refused, and "skipped" if that could not be counted."""
        if self.unavailable:
            return "skipped"
        return "warning" if self.counts else "ok"

    def sentence(self) -> str:
        """Return how many calls of each kind were refused, and the first of each, in one sentence."""
        if self.unavailable:
            return f"What the sandbox refuses could not be counted on this machine ({self.unavailable})."
        if not self.counts:
            return "The sandbox refused nothing."
        phrases = []
        for kind, (count, first) in self.counts.items():
            singular, plural = _KINDS[kind]
            phrases.append(
                f"1 {singular} ({first})" if count == 1 else f"{count} {plural} (first {first})"
            )
        return f"The sandbox refused {', '.join(phrases)}."


@contextmanager
def watch_for_refusals() -> Iterator[RefusalReport]:
    """Watch all workers that are started inside, one after the other; complete when they have ended."""
    with tempfile.TemporaryFile() as file:
        token = _report.set(file)
        try:
            yield RefusalReport(file)
        finally:
            _report.reset(token)


def report_descriptor() -> int | None:
    """Return the file descriptor for the supervisor of a worker that is to be watched, else None."""
    file = _report.get()
    return None if file is None else file.fileno()


# ---------------------------------------------------------------------- the supervisor's side

# <linux/ptrace.h>
_CONTINUE_TO_CALL, _SEIZE, _INTERRUPT, _LISTEN, _GET_CALL = 24, 0x4206, 0x4207, 0x4208, 0x420E
_MARK_CALLS, _FOLLOW_FORK, _FOLLOW_VFORK, _FOLLOW_CLONE, _FOLLOW_EXEC = (1 << k for k in range(5))
_OPTIONS = _MARK_CALLS | _FOLLOW_FORK | _FOLLOW_VFORK | _FOLLOW_CLONE | _FOLLOW_EXEC
_END_WITH_TRACER = 1 << 20
_CALL_STOP, _STOP_EVENT = signal.SIGTRAP | 0x80, 128
_HALTING = (signal.SIGSTOP, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
_CALL_HEADER = struct.Struct("<B3xIQQ")
_ENTRY, _EXIT = struct.Struct("<7Q"), struct.Struct("<qB")
_AT_ENTRY, _AT_EXIT = 1, 2
_LONGEST_PATH = 4096
_WORKING_FOLDER = -100  # AT_FDCWD


class RefusalTracer:
    """The supervisor's tracer of one worker and its descendants.

    Parameters
    ----------
    report : int
        File descriptor of the report, which holds what earlier workers were refused.
    """

    def __init__(self, report: int) -> None:
        self._report = report
        content = os.pread(report, os.fstat(report).st_size, 0)
        self._refused: dict[str, tuple[int, str]] = json.loads(content or b"{}").get("refused", {})
        self._calls = _calls_of_this_processor()
        self._pending: dict[int, tuple[int, ...]] = {}
        """By thread: number and arguments of the system call that it is in."""
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._libc.ptrace.argtypes = [
            ctypes.c_long,
            ctypes.c_long,
            ctypes.c_void_p,
            ctypes.c_void_p,
        ]
        self._libc.ptrace.restype = ctypes.c_long
        self._buffer = ctypes.create_string_buffer(_CALL_HEADER.size + 8 * 8)

    def begin(self, worker: int) -> None:
        """Trace a process from now on; where the system does not allow it, the report says so."""
        try:
            if not self._calls:
                raise OSError(0, f"the system calls of {os.uname().machine} are not known")
            self._ptrace(_SEIZE, worker, 0, _OPTIONS | _END_WITH_TRACER)
            self._ptrace(_INTERRUPT, worker)
        except OSError as error:
            self._write({"unavailable": error.strerror})
            return
        self._save()

    def resume(self, thread: int, status: int) -> None:
        """Let a thread go on that has stopped, and look at the system call that it has made.

        Parameters
        ----------
        thread, status : int
            As waitpid(2) gives them.
        """
        stop_signal, event = os.WSTOPSIG(status), status >> 16
        delivered = 0
        request = _CONTINUE_TO_CALL
        if stop_signal == _CALL_STOP:
            self._look_at_call(thread)
        elif event == _STOP_EVENT and stop_signal in _HALTING:
            request = _LISTEN
        elif not event:
            delivered = stop_signal
        with suppress(OSError):  # it has been killed meanwhile
            self._ptrace(request, thread, 0, delivered)

    def _ptrace(self, request: int, thread: int, address: int = 0, data: int = 0) -> None:
        if self._libc.ptrace(request, thread, address, data) < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    def _look_at_call(self, thread: int) -> None:
        """Remember a call that begins; count one that has failed as the sandbox lets it fail."""
        try:
            self._ptrace(_GET_CALL, thread, len(self._buffer), ctypes.addressof(self._buffer))
        except OSError:
            return
        stage = _CALL_HEADER.unpack_from(self._buffer)[0]
        if stage == _AT_ENTRY:
            self._pending[thread] = _ENTRY.unpack_from(self._buffer, _CALL_HEADER.size)
        elif stage == _AT_EXIT:
            number, *arguments = self._pending.pop(thread, (0,))
            result, failed = _EXIT.unpack_from(self._buffer, _CALL_HEADER.size)
            if failed and arguments:
                self._count(thread, number, arguments, -result)

    def _count(self, thread: int, number: int, arguments: list[int], error: int) -> None:
        call = self._calls.get(number)
        if call is None:
            return
        refused = error == EACCES
        refused = refused or (error == EPERM and call.name in _SIGNALLING)
        refused = refused or (error == EXDEV and call.name in _RENAMING)
        if not refused:
            return
        count, first = self._refused.get(call.kind, (0, ""))
        self._refused[call.kind] = (count + 1, first or self._described(thread, call, arguments))
        self._save()

    def _described(self, thread: int, call: _Call, arguments: list[int]) -> str:
        """Return what a call wanted, and its name."""
        value = arguments[call.argument]
        if call.kind == "others":
            return call.name
        if call.kind == "files" or call.name in _PATH_OF_PROGRAM:
            folder = _WORKING_FOLDER
            if call.name in _CALLS_OF_FOLDERS:
                folder = ctypes.c_int(arguments[0]).value
            return f"{self._path(thread, folder, value)} by {call.name}"
        if call.name in ("socket", "socketpair"):
            return f"{_FAMILIES.get(value, f'family {value}')} by {call.name}"
        if call.name == "sendmsg":
            return call.name
        if call.kind == "sockets":
            return f"{_address_text(self._memory(thread, value, 128))} by {call.name}"
        return f"process {ctypes.c_int(value).value} by {call.name}"

    def _path(self, thread: int, folder: int, address: int) -> str:
        """Return the path at an address, made absolute."""
        path = os.fsdecode(self._memory(thread, address, _LONGEST_PATH).split(b"\0")[0])
        start = "cwd" if folder == _WORKING_FOLDER else f"fd/{folder}"
        with suppress(OSError):
            path = os.path.join(os.readlink(f"/proc/{thread}/{start}"), path)  # noqa: PTH115, PTH118 - light
        return path.encode("utf-8", "replace").decode()

    def _memory(self, thread: int, address: int, length: int) -> bytes:
        """Return what is at an address; less where the memory ends, nothing where there is none."""
        try:
            memory = os.open(f"/proc/{thread}/mem", os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            return b""
        try:
            return os.pread(memory, length, address)
        except (OSError, OverflowError):
            return b""
        finally:
            os.close(memory)

    def _save(self) -> None:
        self._write({"refused": self._refused})

    def _write(self, record: dict[str, Any]) -> None:
        content = json.dumps(record).encode()
        os.pwrite(self._report, content, 0)
        os.ftruncate(self._report, len(content))


def _address_text(address: bytes) -> str:
    """Return a socket address (`struct sockaddr`) as it is written."""
    if len(address) < 2:
        return "an address"
    family = int.from_bytes(address[:2], "little")
    port = int.from_bytes(address[2:4], "big")
    if family == _IPV4:
        return f"{'.'.join(str(byte) for byte in address[4:8])}:{port}"
    if family == _IPV6:
        groups = ":".join(address[k : k + 2].hex() for k in range(8, 24, 2))
        return f"[{groups}]:{port}"
    if family == _UNIX:
        return address[2:].split(b"\0")[0].decode("utf-8", "replace") or "a Unix socket"
    return f"family {family}"
