"""System calls that the sandbox may refuse: names, kinds and numbers on each processor."""

import os
from typing import Literal, NamedTuple

from .call_filter import refused_calls

RefusalKind = Literal["files", "sockets", "processes", "others"]
"""Kind of thing that a refused call reached for."""


class SystemCall(NamedTuple):
    """A system call that the sandbox may refuse.

    Attributes
    ----------
    kind : RefusalKind
        Kind of its target.
    argument : int
        Number of the argument that names its target: the address of a path or of a socket address,
        or a number.
    """

    name: str
    kind: RefusalKind
    argument: int


_PATH_CALLS = {
    "open": 0,
    "creat": 0,
    "truncate": 0,
    "unlink": 0,
    "rmdir": 0,
    "mkdir": 0,
    "mknod": 0,
    "rename": 0,
    "link": 0,
    "symlink": 1,
    "inotify_add_watch": 1,
    "openat": 1,
    "openat2": 1,
    "mkdirat": 1,
    "mknodat": 1,
    "unlinkat": 1,
    "renameat": 1,
    "renameat2": 1,
    "linkat": 1,
    "symlinkat": 2,
}
_SOCKET_CALLS = {
    "socket": 0,
    "socketpair": 0,
    "connect": 1,
    "bind": 1,
    "sendto": 4,
    "sendmsg": 0,
}
_PROCESS_CALLS = {
    "execve": 0,
    "execveat": 1,
    "kill": 0,
    "tkill": 0,
    "tgkill": 0,
    "ptrace": 1,
    "setpriority": 1,
    "ioprio_set": 1,
    "prlimit64": 0,
    "process_vm_readv": 0,
    "process_vm_writev": 0,
    "sched_setparam": 0,
    "sched_setscheduler": 0,
    "sched_setaffinity": 0,
    "sched_setattr": 0,
}
SIGNALLING = ("kill", "tkill", "tgkill", "ptrace", "process_vm_readv", "process_vm_writev")
"""Calls that fail with EPERM where Landlock refuses them."""
RENAMING = ("rename", "renameat", "renameat2", "link", "linkat")
"""Calls that fail with EXDEV where Landlock refuses them: as for folders on two disks."""
CALLS_OF_FOLDERS = (
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
PATH_OF_PROGRAM = ("execve", "execveat")

# <asm/unistd.h> of each processor.
_NUMBERS: dict[str, dict[str, int]] = {
    "x86_64": {
        "open": 2,
        "socket": 41,
        "connect": 42,
        "sendto": 44,
        "sendmsg": 46,
        "bind": 49,
        "socketpair": 53,
        "execve": 59,
        "kill": 62,
        "truncate": 76,
        "rename": 82,
        "mkdir": 83,
        "rmdir": 84,
        "creat": 85,
        "link": 86,
        "unlink": 87,
        "symlink": 88,
        "ptrace": 101,
        "mknod": 133,
        "setpriority": 141,
        "sched_setparam": 142,
        "sched_setscheduler": 144,
        "tkill": 200,
        "sched_setaffinity": 203,
        "tgkill": 234,
        "ioprio_set": 251,
        "inotify_add_watch": 254,
        "openat": 257,
        "mkdirat": 258,
        "mknodat": 259,
        "unlinkat": 263,
        "renameat": 264,
        "linkat": 265,
        "symlinkat": 266,
        "prlimit64": 302,
        "process_vm_readv": 310,
        "process_vm_writev": 311,
        "sched_setattr": 314,
        "renameat2": 316,
        "execveat": 322,
        "openat2": 437,
    },
    "aarch64": {
        "inotify_add_watch": 27,
        "ioprio_set": 30,
        "mknodat": 33,
        "mkdirat": 34,
        "unlinkat": 35,
        "symlinkat": 36,
        "linkat": 37,
        "renameat": 38,
        "truncate": 45,
        "openat": 56,
        "ptrace": 117,
        "sched_setparam": 118,
        "sched_setscheduler": 119,
        "sched_setaffinity": 122,
        "kill": 129,
        "tkill": 130,
        "tgkill": 131,
        "setpriority": 140,
        "socket": 198,
        "socketpair": 199,
        "bind": 200,
        "connect": 203,
        "sendto": 206,
        "sendmsg": 211,
        "execve": 221,
        "prlimit64": 261,
        "process_vm_readv": 270,
        "process_vm_writev": 271,
        "sched_setattr": 274,
        "renameat2": 276,
        "execveat": 281,
        "openat2": 437,
    },
}


def calls_of_this_processor() -> dict[int, SystemCall]:
    """Return the system calls that may be refused, by number; none for an unknown processor."""
    kinds: list[tuple[RefusalKind, dict[str, int]]] = [
        ("files", _PATH_CALLS),
        ("sockets", _SOCKET_CALLS),
        ("processes", _PROCESS_CALLS),
    ]
    numbers = _NUMBERS.get(os.uname().machine, {})
    calls = {number: SystemCall(f"system call {number}", "others", 0) for number in refused_calls()}
    for kind, arguments in kinds:
        for name, argument in arguments.items():
            if name in numbers:
                calls[numbers[name]] = SystemCall(name, kind, argument)
    return calls
