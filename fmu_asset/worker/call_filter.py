"""A filter of system calls (seccomp(2)) against those that Landlock leaves open to an FMU.

These are sockets of other kinds, through which a service of the user would do what the FMU may not,
memory and messages that the user's processes share, changes of other processes, and changes of the
rights of files. The filter is a program of the kernel's classic BPF machine.
"""

import ctypes
import os
import struct
import sys
from errno import EACCES
from typing import NamedTuple

from .system_calls import checked, libc

_PR_SET_SECCOMP = 22
_SECCOMP_MODE_FILTER = 2

# operations of the BPF machine, <linux/bpf_common.h>
_LOAD_WORD = 0x20
_AND = 0x54
_JUMP_IF_EQUAL = 0x15
_JUMP_IF_AT_LEAST = 0x35
_RETURN = 0x06
# offsets in `struct seccomp_data` [bytes]
_CALL_NUMBER = 0
_ARCHITECTURE = 4
_FIRST_ARGUMENT = 16
_ARGUMENT_SIZE = 8
# results of the filter, <linux/seccomp.h>
_ALLOW = 0x7FFF0000
_RETURN_ERROR = 0x50000
_INSTRUCTION = struct.Struct("HBBI")

_OTHER_ABI = 0x40000000
"""Numbers from here on are the same calls for another size of pointers (x32)."""
_IPV4 = 2
_IPV6 = 10
_TCP = 6
_UDP = 17
_UNIX = 1
_STREAM = 1
_SOCKET_KIND = 0xF
"""Bits of a socket's type without its flags."""
_ALL_BITS = 0xFFFFFFFF


class _ProcessorCalls(NamedTuple):
    """Numbers of system calls on a processor, <asm/unistd.h>.

    Attributes
    ----------
    architecture : int
        Number of the processor, <linux/audit.h>.
    socket, socketpair, setpriority, ioprio_set, truncate : int
        Numbers of these calls.
    of_process : tuple of int
        Calls whose first argument is the process that they change.
    refused : tuple of int
        Calls that are refused whatever their arguments: shared memory, semaphores, messages and
        keys of the user's processes, notices of what is done to files, and io_uring, by which
        sockets could be made all the same.
    ignored : tuple of int
        Calls that return OK and do nothing: changes of the rights, owners, times and attributes of
        files. Programs that copy files make them in vain.
    """

    architecture: int
    socket: int
    socketpair: int
    setpriority: int
    ioprio_set: int
    truncate: int
    of_process: tuple[int, ...]
    refused: tuple[int, ...]
    ignored: tuple[int, ...]


_CALLS: dict[str, _ProcessorCalls] = {
    "x86_64": _ProcessorCalls(
        architecture=0xC000003E,
        socket=41,
        socketpair=53,
        setpriority=141,
        ioprio_set=251,
        truncate=76,
        of_process=(
            142,  # sched_setparam
            144,  # sched_setscheduler
            203,  # sched_setaffinity
            302,  # prlimit64
            314,  # sched_setattr
        ),
        refused=(
            *range(29, 32),  # shmget, shmat, shmctl
            *range(64, 72),  # semget, semop, semctl, shmdt, msgget, msgsnd, msgrcv, msgctl
            220,  # semtimedop
            *range(240, 242),  # mq_open, mq_unlink
            *range(248, 251),  # add_key, request_key, keyctl
            254,  # inotify_add_watch
            425,  # io_uring_setup
        ),
        ignored=(
            *range(90, 95),  # chmod, fchmod, chown, fchown, lchown
            132,  # utime
            *range(188, 191),  # setxattr, lsetxattr, fsetxattr
            *range(197, 200),  # removexattr, lremovexattr, fremovexattr
            235,  # utimes
            *range(260, 262),  # fchownat, futimesat
            268,  # fchmodat
            280,  # utimensat
            452,  # fchmodat2
            463,  # setxattrat
            466,  # removexattrat
            469,  # file_setattr
        ),
    ),
    "aarch64": _ProcessorCalls(
        architecture=0xC00000B7,
        socket=198,
        socketpair=199,
        setpriority=140,
        ioprio_set=30,
        truncate=45,
        of_process=(
            118,  # sched_setparam
            119,  # sched_setscheduler
            122,  # sched_setaffinity
            261,  # prlimit64
            274,  # sched_setattr
        ),
        refused=(
            27,  # inotify_add_watch
            *range(180, 182),  # mq_open, mq_unlink
            *range(186, 198),  # msgget to shmdt
            *range(217, 220),  # add_key, request_key, keyctl
            425,  # io_uring_setup
        ),
        ignored=(
            *range(5, 8),  # setxattr, lsetxattr, fsetxattr
            *range(14, 17),  # removexattr, lremovexattr, fremovexattr
            *range(52, 56),  # fchmod, fchmodat, fchownat, fchown
            88,  # utimensat
            452,  # fchmodat2
            463,  # setxattrat
            466,  # removexattrat
            469,  # file_setattr
        ),
    ),
}


def refused_calls() -> tuple[int, ...]:
    """Return the numbers of the system calls that are refused whatever their arguments are."""
    machine = os.uname().machine
    return _CALLS[machine].refused if machine in _CALLS else ()


def filter_calls(*, tcp: bool, truncates: bool) -> None:
    """Filter the system calls of this process and its children from now on.

    Nothing is filtered on other processors than those of the table.

    Parameters
    ----------
    tcp : bool
        Whether sockets of the internet may be made: TCP, and UDP to look up the names of hosts.
    truncates : bool
        Whether Landlock knows that truncate(2) empties a file; otherwise that is refused here.

    Raises
    ------
    OSError
        If the system refuses.
    """
    is_32_bit = sys.maxsize < 2**32
    machine = os.uname().machine
    if machine not in _CALLS or is_32_bit:
        return
    calls = _CALLS[machine]
    refused = calls.refused if truncates else (*calls.refused, calls.truncate)
    program = _program(calls, refused, tcp=tcp)
    instructions = ctypes.create_string_buffer(program, len(program))
    # struct sock_fprog: number and address of the instructions
    count = len(program) // _INSTRUCTION.size
    head = struct.pack("HxxxxxxQ", count, ctypes.addressof(instructions))
    filter_program = ctypes.create_string_buffer(head)
    checked(libc().prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, filter_program, 0, 0))


def _program(calls: _ProcessorCalls, refused: tuple[int, ...], *, tcp: bool) -> bytes:
    """Return the BPF program of the filter.

    Parameters
    ----------
    calls : _ProcessorCalls
        Numbers of the calls.
    refused : tuple of int
        Calls that are refused.
    tcp : bool
        Whether sockets of the internet may be made.
    """
    # Landlock does not watch other protocols, such as multipath TCP.
    internet_only = _require(0, (_IPV4, _IPV6)) + _require(2, (0, _TCP, _UDP))
    # Pairs of datagram sockets can send to anybody.
    local_streams_only = _require(0, (_UNIX,)) + _require(1, (_STREAM,), bits=_SOCKET_KIND)
    # The number 0 means this process; in other places it means all processes of the user.
    this_process_only = _require(0, (0, os.getpid()))
    conditions = {
        calls.socket: internet_only if tcp else _DENY,
        calls.socketpair: local_streams_only,
        calls.setpriority: _require(0, (0,)) + _require(1, (0,)),
        calls.ioprio_set: _require(0, (1,)) + _require(1, (0,)),
    }
    for number in calls.of_process:
        conditions[number] = this_process_only
    program = _load(_ARCHITECTURE) + _unless_equal(calls.architecture, _DENY)
    program += _load(_CALL_NUMBER) + _if_at_least(_OTHER_ABI, _DENY)
    for number in refused:
        program += _if_equal(number, _DENY)
    for number in calls.ignored:
        program += _if_equal(number, _DO_NOTHING)
    for number, condition in conditions.items():
        program += _if_equal(number, condition + _GRANT)
    return program + _GRANT


# ---------------------------------------------------------------------- BPF instructions


def _return(value: int) -> bytes:
    return _INSTRUCTION.pack(_RETURN, 0, 0, value)


_GRANT = _return(_ALLOW)
_DENY = _return(_RETURN_ERROR | EACCES)
_DO_NOTHING = _return(_RETURN_ERROR)


def _load(offset: int) -> bytes:
    """Load a word of `struct seccomp_data`, at an offset [bytes]."""
    return _INSTRUCTION.pack(_LOAD_WORD, 0, 0, offset)


def _if_equal(value: int, instructions: bytes) -> bytes:
    """Run instructions if the loaded word has a value."""
    skipped = len(instructions) // _INSTRUCTION.size
    return _INSTRUCTION.pack(_JUMP_IF_EQUAL, 0, skipped, value) + instructions


def _if_at_least(value: int, instructions: bytes) -> bytes:
    """Run instructions if the loaded word is at least a value."""
    skipped = len(instructions) // _INSTRUCTION.size
    return _INSTRUCTION.pack(_JUMP_IF_AT_LEAST, 0, skipped, value) + instructions


def _unless_equal(value: int, instructions: bytes) -> bytes:
    """Run instructions unless the loaded word has a value."""
    skipped = len(instructions) // _INSTRUCTION.size
    return _INSTRUCTION.pack(_JUMP_IF_EQUAL, skipped, 0, value) + instructions


def _require(argument: int, values: tuple[int, ...], bits: int = _ALL_BITS) -> bytes:
    """Deny a call unless an argument is one of some values.

    The upper half of the argument has no meaning for these calls.

    Parameters
    ----------
    argument : int
        Number of the argument, from 0.
    values : tuple of int
        The values.
    bits : int
        Bits of the argument that count.
    """
    code = _load(_FIRST_ARGUMENT + _ARGUMENT_SIZE * argument)
    code += _INSTRUCTION.pack(_AND, 0, 0, bits)
    for number, value in enumerate(values):
        # jump behind the other comparisons and the denial
        distance = len(values) - number
        code += _INSTRUCTION.pack(_JUMP_IF_EQUAL, distance, 0, value)
    return code + _DENY
