"""The tracer by which a supervisor counts the calls that the sandbox refuses (ptrace(2))."""

import ctypes
import json
import os
import signal
import struct
from collections.abc import Mapping
from contextlib import suppress
from errno import EACCES, EPERM, EXDEV

from .traced_calls import (
    CALLS_OF_FOLDERS,
    PATH_OF_PROGRAM,
    RENAMING,
    SIGNALLING,
    SystemCall,
    calls_of_this_processor,
)

_FAMILIES = {1: "Unix", 2: "IPv4", 10: "IPv6", 16: "netlink", 17: "packet"}
_UNIX = 1
_IPV4 = 2
_IPV6 = 10

# requests of ptrace(2), <linux/ptrace.h>
_CONTINUE_TO_CALL = 24
_SEIZE = 0x4206
_INTERRUPT = 0x4207
_LISTEN = 0x4208
_GET_CALL = 0x420E
# options: mark stops at calls, and follow all descendants
_MARK_CALLS = 1 << 0
_FOLLOW_FORK = 1 << 1
_FOLLOW_VFORK = 1 << 2
_FOLLOW_CLONE = 1 << 3
_FOLLOW_EXEC = 1 << 4
_END_WITH_TRACER = 1 << 20
_OPTIONS = (
    _MARK_CALLS | _FOLLOW_FORK | _FOLLOW_VFORK | _FOLLOW_CLONE | _FOLLOW_EXEC | _END_WITH_TRACER
)
_CALL_STOP = signal.SIGTRAP | 0x80
"""Signal that waitpid(2) shows for a thread that has stopped at a call."""
_STOP_EVENT = 128
_HALTING = (signal.SIGSTOP, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU)
# struct ptrace_syscall_info: its head, and its parts at the entry and at the exit of a call
_CALL_HEAD = struct.Struct("<B3xIQQ")
_CALL_ENTRY = struct.Struct("<7Q")
_CALL_EXIT = struct.Struct("<qB")
_AT_ENTRY = 1
_AT_EXIT = 2
_LONGEST_PATH = 4096
_LONGEST_ADDRESS = 128
_WORKING_FOLDER = -100  # AT_FDCWD


class RefusalTracer:
    """Traces a worker and its descendants, and counts their refused system calls.

    Parameters
    ----------
    report : int
        File descriptor of the report, which may hold the refusals of earlier workers.
    """

    def __init__(self, report: int) -> None:
        self._report = report
        content = os.pread(report, os.fstat(report).st_size, 0)
        self._refused: dict[str, tuple[int, str]] = json.loads(content or b"{}").get("refused", {})
        self._calls = calls_of_this_processor()
        # number and arguments of the system call that each thread is in
        self._pending: dict[int, tuple[int, ...]] = {}
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._libc.ptrace.argtypes = [
            ctypes.c_long,
            ctypes.c_long,
            ctypes.c_void_p,
            ctypes.c_void_p,
        ]
        self._libc.ptrace.restype = ctypes.c_long
        self._buffer = ctypes.create_string_buffer(_CALL_HEAD.size + 8 * 8)

    def begin(self, worker: int) -> None:
        """Trace a process from now on; if the system does not allow it, the report says so."""
        try:
            if not self._calls:
                raise OSError(0, f"the system calls of {os.uname().machine} are not known")
            # SEIZE attaches without a stop; INTERRUPT stops the worker, and `resume` then lets it
            # run from system call to system call.
            self._ptrace(_SEIZE, worker, 0, _OPTIONS)
            self._ptrace(_INTERRUPT, worker)
        except OSError as error:
            self._write({"unavailable": error.strerror})
            return
        self._save()

    def resume(self, thread: int, status: int) -> None:
        """Resume a stopped thread, after inspecting the system call at which it stopped.

        Parameters
        ----------
        thread, status : int
            Number and status of the thread from waitpid(2).
        """
        stop_signal = os.WSTOPSIG(status)
        event = status >> 16
        signal_to_deliver = 0
        request = _CONTINUE_TO_CALL
        # ptrace(2): a thread stops for a system call, for a stop of its whole group (it must then
        # stay stopped: LISTEN), for another event, or for a signal, which it has to get.
        if stop_signal == _CALL_STOP:
            self._inspect_call(thread)
        elif event == _STOP_EVENT and stop_signal in _HALTING:
            request = _LISTEN
        elif not event:
            signal_to_deliver = stop_signal
        # it may have been killed meanwhile
        with suppress(OSError):
            self._ptrace(request, thread, 0, signal_to_deliver)

    def _ptrace(self, request: int, thread: int, address: int = 0, data: int = 0) -> None:
        """Make a request of ptrace(2); raise an `OSError` if it fails."""
        if self._libc.ptrace(request, thread, address, data) < 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    def _inspect_call(self, thread: int) -> None:
        """Record the system call that a thread enters, or count one that returns if it was refused.

        A thread stops at the entry and at the exit of a call. Its arguments are known only at the
        entry, and its result only at the exit.
        """
        try:
            self._ptrace(_GET_CALL, thread, len(self._buffer), ctypes.addressof(self._buffer))
        except OSError:
            return
        stop_kind, *_ = _CALL_HEAD.unpack_from(self._buffer)
        if stop_kind == _AT_ENTRY:
            self._pending[thread] = _CALL_ENTRY.unpack_from(self._buffer, _CALL_HEAD.size)
        elif stop_kind == _AT_EXIT:
            number, *arguments = self._pending.pop(thread, (0,))
            result, has_failed = _CALL_EXIT.unpack_from(self._buffer, _CALL_HEAD.size)
            call = self._calls.get(number)
            if has_failed and arguments and call is not None and _is_refusal(call, -result):
                self._count(thread, call, arguments)

    def _count(self, thread: int, call: SystemCall, arguments: list[int]) -> None:
        """Count a refused call, and describe the first one of its kind."""
        count, first_description = self._refused.get(call.kind, (0, ""))
        description = first_description or self._description(thread, call, arguments)
        self._refused[call.kind] = (count + 1, description)
        self._save()

    def _description(self, thread: int, call: SystemCall, arguments: list[int]) -> str:
        """Return the target and the name of a call with these arguments, for users."""
        target = arguments[call.argument]
        if call.kind == "others":
            return call.name
        if call.kind == "files" or call.name in PATH_OF_PROGRAM:
            folder = _WORKING_FOLDER
            if call.name in CALLS_OF_FOLDERS:
                folder = ctypes.c_int(arguments[0]).value
            return f"{self._path(thread, folder, target)} by {call.name}"
        if call.name in ("socket", "socketpair"):
            return f"{_FAMILIES.get(target, f'family {target}')} by {call.name}"
        if call.name == "sendmsg":
            return call.name
        if call.kind == "sockets":
            return f"{_address_text(self._memory(thread, target, _LONGEST_ADDRESS))} by {call.name}"
        return f"process {ctypes.c_int(target).value} by {call.name}"

    def _path(self, thread: int, folder: int, address: int) -> str:
        """Return the absolute path at an address in a thread's memory.

        A relative path begins in the folder of a file descriptor, or in `_WORKING_FOLDER`.
        """
        text, *_ = self._memory(thread, address, _LONGEST_PATH).split(b"\0")
        path = os.fsdecode(text)
        base_link = "cwd" if folder == _WORKING_FOLDER else f"fd/{folder}"
        with suppress(OSError):
            base = os.readlink(f"/proc/{thread}/{base_link}")  # noqa: PTH115 - light
            path = os.path.join(base, path)  # noqa: PTH118
        return path.encode("utf-8", "replace").decode()

    def _memory(self, thread: int, address: int, length: int) -> bytes:
        """Return bytes at an address of a thread's memory, or fewer if they cannot be read."""
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
        """Write the counts to the report, so that they survive the end of this process."""
        self._write({"refused": self._refused})

    def _write(self, record: Mapping[str, object]) -> None:
        """Replace the content of the report."""
        content = json.dumps(record).encode()
        os.pwrite(self._report, content, 0)
        os.ftruncate(self._report, len(content))


def _is_refusal(call: SystemCall, error: int) -> bool:
    """Return whether a failed call has an error with which the sandbox refuses calls."""
    if error == EACCES:
        return True
    if error == EPERM:
        return call.name in SIGNALLING
    return error == EXDEV and call.name in RENAMING


def _address_text(address: bytes) -> str:
    """Return a socket address (`struct sockaddr`) as a text for users."""
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
