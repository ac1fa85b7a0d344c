"""A filter of system calls (seccomp(2)) for those that Landlock leaves open to an FMU.

These are other kinds of sockets, through which a service of the user could do what the FMU may not;
memory and messages that the user's processes share; changes of other processes; and changes of file
permissions. The filter is a program for the kernel's classic BPF machine.
"""

import ctypes
import os
import struct
import sys
from errno import EACCES
from functools import cache
from typing import NamedTuple

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
    """Numbers of the filtered system calls on one kind of processor, from <asm/unistd.h>.

    The numbers are those of <asm/unistd.h>.

    Attributes
    ----------
    architecture : int
        Number of the processor, <linux/audit.h>.
    socket, socketpair, setpriority, ioprio_set, truncate : int
        Numbers of these calls.
    of_process : tuple of int
        Calls whose first argument is the process that they change.
    refused : tuple of int
        Calls that are refused whatever their arguments are. They serve shared memory, semaphores,
        messages and keys of the user's processes, notices of changes to files, and io_uring, which
        could make sockets without the call `socket`.
    ignored : tuple of int
        Calls that do nothing and report success. They change permissions, owners, times and
        attributes of files. Programs that copy files make such calls, and would fail if the calls
        were refused.
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
    """Return the numbers of the system calls that the filter always refuses.

    The result is empty on a processor that the table `_CALLS` does not contain.
    """
    machine = os.uname().machine
    return _CALLS[machine].refused if machine in _CALLS else ()


def filter_calls(*, tcp: bool, truncates: bool) -> None:
    """Filter the system calls of this process and its children from now on.

    Nothing is filtered on processors that the table `_CALLS` does not contain.

    Parameters
    ----------
    tcp : bool
        Whether the process may open internet sockets: TCP, and UDP to look up the names of hosts.
    truncates : bool
        Whether Landlock controls truncate(2), which empties a file. If it does not, the filter
        refuses that call altogether.

    Raises
    ------
    OSError
        If the system does not accept the filter.
    """
    is_32_bit = sys.maxsize < 2**32
    machine = os.uname().machine
    if machine not in _CALLS or is_32_bit:
        return
    calls = _CALLS[machine]
    always_refused = calls.refused if truncates else (*calls.refused, calls.truncate)
    program = _program(calls, always_refused, tcp=tcp)
    instructions = ctypes.create_string_buffer(program, len(program))
    # struct sock_fprog: number and address of the instructions
    instruction_count = len(program) // _INSTRUCTION.size
    program_header = struct.pack("HxxxxxxQ", instruction_count, ctypes.addressof(instructions))
    filter_program = ctypes.create_string_buffer(program_header)
    checked(libc().prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, filter_program, 0, 0))


def _program(calls: _ProcessorCalls, refused_calls: tuple[int, ...], *, tcp: bool) -> bytes:
    """Return the BPF program of the filter; `tcp` allows internet sockets.

    The kernel runs the program from its first instruction at every system call, until an
    instruction returns "grant", "deny", or "do nothing and report success".
    """
    # Each `_require(argument, allowed values)` either denies the call or continues with the next
    # instruction, so a sum of two means "both must hold".

    # Arguments of socket: family (0), type (1), protocol (2). Other protocols, such as multipath
    # TCP, are denied, because Landlock does not watch them.
    internet_only = _require(0, (_IPV4, _IPV6)) + _require(2, (0, _TCP, _UDP))
    # Pairs of datagram sockets can send to anybody.
    local_streams_only = _require(0, (_UNIX,)) + _require(1, (_STREAM,), bits=_SOCKET_KIND)
    # As the target of these calls, 0 means this process.
    own_process_only = _require(0, (0, os.getpid()))
    # setpriority and ioprio_set: argument 0 says what kind of target argument 1 names; a process
    # is PRIO_PROCESS = 0 and IOPRIO_WHO_PROCESS = 1. Process 0 is this process.
    condition_of_call = {
        calls.socket: internet_only if tcp else _DENY,
        calls.socketpair: local_streams_only,
        calls.setpriority: _require(0, (0,)) + _require(1, (0,)),
        calls.ioprio_set: _require(0, (1,)) + _require(1, (0,)),
    }
    for number in calls.of_process:
        condition_of_call[number] = own_process_only
    # The order matters only at the beginning: call numbers have no meaning on another
    # architecture.
    program = _load(_ARCHITECTURE) + _unless_equal(calls.architecture, _DENY)
    program += _load(_CALL_NUMBER) + _if_at_least(_OTHER_ABI, _DENY)
    for number in refused_calls:
        program += _if_equal(number, _DENY)
    for number in calls.ignored:
        program += _if_equal(number, _DO_NOTHING)
    # A condition loads an argument over the call number; it always ends with deny or grant, so no
    # later comparison sees the argument.
    for number, condition in condition_of_call.items():
        program += _if_equal(number, condition + _GRANT)
    return program + _GRANT


# ---------------------------------------------------------------------- BPF instructions


def _return(value: int) -> bytes:
    """Return the instruction that ends the program with a result for the kernel."""
    return _INSTRUCTION.pack(_RETURN, 0, 0, value)


_GRANT = _return(_ALLOW)
_DENY = _return(_RETURN_ERROR | EACCES)
_DO_NOTHING = _return(_RETURN_ERROR)


def _load(offset: int) -> bytes:
    """Return the instruction that loads a word of `struct seccomp_data` at an offset [bytes]."""
    return _INSTRUCTION.pack(_LOAD_WORD, 0, 0, offset)


def _if_equal(value: int, instructions: bytes) -> bytes:
    """Return code that runs instructions only if the loaded word equals a value."""
    instruction_count = len(instructions) // _INSTRUCTION.size
    return _INSTRUCTION.pack(_JUMP_IF_EQUAL, 0, instruction_count, value) + instructions


def _if_at_least(value: int, instructions: bytes) -> bytes:
    """Return code that runs instructions only if the loaded word is at least a value."""
    instruction_count = len(instructions) // _INSTRUCTION.size
    return _INSTRUCTION.pack(_JUMP_IF_AT_LEAST, 0, instruction_count, value) + instructions


def _unless_equal(value: int, instructions: bytes) -> bytes:
    """Return code that runs instructions unless the loaded word equals a value."""
    instruction_count = len(instructions) // _INSTRUCTION.size
    return _INSTRUCTION.pack(_JUMP_IF_EQUAL, instruction_count, 0, value) + instructions


def _require(argument: int, values: tuple[int, ...], bits: int = _ALL_BITS) -> bytes:
    """Return code that denies a call unless an argument, counted from 0, has an allowed value.

    If the value is allowed, the program continues after this code. Only the given bits of the lower
    32 bits are compared: the upper half has no meaning for the calls that are filtered here.
    """
    code = _load(_FIRST_ARGUMENT + _ARGUMENT_SIZE * argument)
    code += _INSTRUCTION.pack(_AND, 0, 0, bits)
    for position, value in enumerate(values):
        # if equal, jump behind the remaining comparisons and the denial
        instructions_to_skip = len(values) - position
        code += _INSTRUCTION.pack(_JUMP_IF_EQUAL, instructions_to_skip, 0, value)
    return code + _DENY


@cache
def libc() -> ctypes.CDLL:
    """Return the C library of this process."""
    return ctypes.CDLL(None, use_errno=True)


def checked(result: int) -> int:
    """Return the result of a call of the C library; raise an `OSError` if it is negative."""
    if result < 0:
        error = ctypes.get_errno()
        raise OSError(error, f"the sandbox: {os.strerror(error)}")
    return result
