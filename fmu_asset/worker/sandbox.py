"""What an FMU may touch: its own folder, what Python and the system's libraries are made of, and no socket.

FMUs are native code with the rights of their user. Two things that any process may do to itself, and that
all its children inherit, take rights away: Landlock (landlock(7)) those to files, programs, TCP ports and
signals, and a filter of system calls (seccomp(2)) those that Landlock leaves: sockets of all other kinds,
through which a service of the user would do what the FMU may not, and changes of the rights of files.
"""

import ctypes
import os
import stat
import struct
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from errno import EACCES
from functools import cache

# <linux/landlock.h>; the numbers of the system calls are those of every processor.
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_BENEATH, _PORT = 1, 2
_EXECUTE, _WRITE_FILE, _READ_FILE, _READ_FOLDER, _TRUNCATE, _DEVICE = (
    1 << k for k in (0, 1, 2, 3, 14, 15)
)
_READ = _READ_FILE | _READ_FOLDER
_ALL = (1 << 16) - 1
_FILE = _EXECUTE | _WRITE_FILE | _READ_FILE | _TRUNCATE | _DEVICE
_TCP, _CONNECT = 3, 2
_SOCKETS_AND_SIGNALS = 3
_NO_NEW_PRIVILEGES, _SET_FILTER = 38, 22  # of prctl(2)

_CONFIGURATION = (
    "alternatives", "fonts", "gai.conf", "group", "host.conf", "hosts", "ld.so.cache", "ld.so.conf",
    "ld.so.conf.d", "locale.alias", "localtime", "machine-id", "nsswitch.conf", "os-release", "passwd",
    "protocols", "resolv.conf", "services", "ssl/certs", "ssl/openssl.cnf", "timezone",
)  # fmt: skip
_SYSTEM = (
    "/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/opt", "/nix/store", "/gnu/store",
    "/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/proc/version", "/proc/filesystems",
    "/proc/sys", "/sys/devices/system", "/sys/fs/cgroup", *(f"/etc/{name}" for name in _CONFIGURATION),
)  # fmt: skip
_ROOT, _PACKAGES = os.path.realpath(f"{__file__}/../../.."), ("fmu_asset", "fe", "reporting")
_DEVICES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom")


@dataclass(frozen=True)
class Grants:
    """What an FMU may touch beyond what every FMU may.

    Attributes
    ----------
    read, write : tuple of str
        Files and folders with all that is in them: absolute, of a home (`~`), or in the FMU's own folder.
    ports : tuple of int
        TCP ports to which it may connect, on any host; names of hosts are looked up then, too.
    programs : bool
        Whether it may start the programs that it can read; they are as confined as it is.
    """

    read: tuple[str, ...] = ()
    write: tuple[str, ...] = ()
    ports: tuple[int, ...] = ()
    programs: bool = False


@cache
def landlock_version() -> int:
    """Return the version of the kernel's Landlock; 0 where there is none, or where a container hides it."""
    return max(int(_libc().syscall(_CREATE_RULESET, None, 0, 1)), 0)


def confine(grants: Grants, own: str, shared: str) -> bool:
    """Take from this process, for good, what an FMU does not need; return False where there is no Landlock.

    Parameters
    ----------
    grants : Grants
        What it may touch beyond that.
    own : str
        The one folder in which it may write.
    shared : str
        Folder or file of the FMU, which it may read.

    Raises
    ------
    OSError
        If the system refuses; the process is not to go on then.
    """
    version = landlock_version()
    if not version:
        return False
    if len(os.listdir("/proc/self/task")) > 1:  # noqa: PTH208
        raise OSError(
            "the sandbox: another thread runs in this process already, and would not be confined"
        )
    # What a version does not know would be refused: it is left out.
    handled = _ALL >> (3, 2, 1, 1)[version - 1] if version < 5 else _ALL
    attributes = struct.pack(
        "QQQ", handled, _TCP * (version > 3), _SOCKETS_AND_SIGNALS * (version > 5)
    )
    rules = _done(_libc().syscall(_CREATE_RULESET, attributes, len(attributes), 0))
    program = _EXECUTE * grants.programs
    read, write = (_READ | program) & handled, (_ALL & ~_EXECUTE | program) & handled
    _allow(rules, (*_SYSTEM, *_paths_of_python(), shared, *_located(grants.read, shared)), read)
    _allow(rules, (*_DEVICES, own, *_located(grants.write, shared)), write)
    for port in grants.ports if version > 3 else ():
        _done(_libc().syscall(_ADD_RULE, rules, _PORT, struct.pack("QQ", _CONNECT, port), 0))
    _done(_libc().prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0))
    _done(_libc().syscall(_RESTRICT_SELF, rules, 0))
    os.close(rules)
    _filter_calls(tcp=bool(grants.ports))
    return True


def missing_path(grants: Grants, shared: str) -> str:
    """Return the first path that is granted and does not exist; an empty text if all do."""
    paths = _located(grants.read + grants.write, shared)
    return next((path for path in paths if not os.path.exists(path)), "")  # noqa: PTH110


@cache
def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def _done(result: int) -> int:
    if result < 0:
        raise OSError(ctypes.get_errno(), f"the sandbox: {os.strerror(ctypes.get_errno())}")
    return result


def _located(paths: tuple[str, ...], shared: str) -> list[str]:
    return [os.path.join(shared, os.path.expanduser(path)) for path in paths]  # noqa: PTH111, PTH118 - light


def _paths_of_python() -> Iterator[str]:
    """Yield where Python finds modules and libraries; never a folder that the user's own lies in."""
    home = os.path.realpath(os.path.expanduser("~"))  # noqa: PTH111
    libraries = os.environ.get("LD_LIBRARY_PATH", "").split(":")
    for path in {sys.prefix, sys.base_prefix, *sys.path, *libraries}:
        place = os.path.realpath(path)
        if path and place == _ROOT and os.path.exists(f"{_ROOT}/pyproject.toml"):  # noqa: PTH110
            yield from (f"{_ROOT}/{name}" for name in _PACKAGES)  # a checkout holds much else
        elif path and os.path.commonpath((home, place)) != place:
            yield path


def _allow(rules: int, paths: Iterable[str], access: int) -> None:
    for path in filter(os.path.exists, paths):
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
        is_folder = stat.S_ISDIR(os.fstat(descriptor).st_mode)
        rule = struct.pack("=Qi", access if is_folder else access & _FILE, descriptor)
        _done(_libc().syscall(_ADD_RULE, rules, _BENEATH, rule, 0))
        os.close(descriptor)


# ---------------------------------------------------------------------- system calls

_LOAD, _AND, _EQUAL, _AT_LEAST, _RETURN = 0x20, 0x54, 0x15, 0x35, 0x06  # <linux/bpf_common.h>
_NUMBER, _PROCESSOR, _FIRST_ARGUMENT = (
    0,
    4,
    16,
)  # of `seccomp_data`, in bytes; each argument has eight
_GRANTED, _ERROR = 0x7FFF0000, 0x50000
_OTHER_NUMBERS = 0x40000000  # of the same calls, for another size of pointers
_INTERNET, _PLAIN_PROTOCOLS = (
    (2, 10),
    (0, 6, 17),
)  # IPv4 and IPv6; TCP, and UDP for the names of hosts
_LOCAL, _STREAM, _KIND, _WHOLE = (
    (1,),
    (1,),
    0xF,
    0xFFFFFFFF,
)  # the kind of a socket, without its flags

# By processor: its number, those of socket(), socketpair(), setpriority() and ioprio_set(), of truncate(), of
# calls whose first argument is the process that they change, and calls that are refused (memory, semaphores
# and messages that the user's processes share, notices of what is done to files, io_uring, by which sockets
# could be made all the same, and the user's keys), and calls that return OK and do nothing: the rights,
# owners, times and attributes of files, whoever's they are; who copies a file changes them in vain.
_Numbers = tuple[int, ...]
_CALLS: dict[str, tuple[int, tuple[int, int, int, int], int, _Numbers, _Numbers, _Numbers]] = {
    "x86_64": (
        0xC000003E, (41, 53, 141, 251), 76, (142, 144, 203, 302, 314),
        (29, 30, 31, *range(64, 72), 220, 240, 241, 248, 249, 250, 254, 425),
        (90, 91, 92, 93, 94, 132, 188, 189, 190, 197, 198, 199, 235, 260, 261, 268, 280, 452, 463, 466, 469),
    ),
    "aarch64": (
        0xC00000B7, (198, 199, 140, 30), 45, (118, 119, 122, 261, 274),
        (27, 180, 181, *range(186, 198), 217, 218, 219, 425),
        (5, 6, 7, 14, 15, 16, 52, 53, 54, 55, 88, 452, 463, 466, 469),
    ),
}  # fmt: skip


def refused_calls() -> tuple[int, ...]:
    """Return the numbers of the system calls that the filter refuses whatever their arguments are."""
    machine = os.uname().machine
    return _CALLS[machine][4] if machine in _CALLS else ()


def _filter_calls(*, tcp: bool) -> None:
    """Refuse what else reaches other processes; sockets of the internet only where a port is granted."""
    if os.uname().machine not in _CALLS or sys.maxsize < 2**32:
        return
    processor, (socket, pair, priority, io_priority), truncate, of_process, refused, idle = _CALLS[
        os.uname().machine
    ]
    if landlock_version() < 3:  # which does not know that this empties a file
        refused += (truncate,)
    granted, denied, done = (
        struct.pack("HBBI", _RETURN, 0, 0, value) for value in (_GRANTED, _ERROR | EACCES, _ERROR)
    )

    def load(place: int) -> bytes:
        return struct.pack("HBBI", _LOAD, 0, 0, place)

    def where(test: int, value: int, then: bytes, *, otherwise: bool = False) -> bytes:
        skipped = len(then) // 8
        return (
            struct.pack("HBBI", test, skipped * otherwise, skipped * (not otherwise), value) + then
        )

    def among(argument: int, values: tuple[int, ...], bits: int = _WHOLE) -> bytes:
        """Go on if an argument is one of the values; upper halves count for none of these calls."""
        code = load(_FIRST_ARGUMENT + 8 * argument) + struct.pack("HBBI", _AND, 0, 0, bits)
        for following, value in zip(range(len(values), 0, -1), values, strict=True):
            code += struct.pack("HBBI", _EQUAL, following, 0, value)
        return code + denied

    # Other protocols, such as multipath TCP, Landlock does not watch. Pairs of datagram sockets can send to
    # anybody. The priority of all processes of a user is changed by the number 0, too.
    conditions = {
        socket: among(0, _INTERNET) + among(2, _PLAIN_PROTOCOLS) if tcp else denied,
        pair: among(0, _LOCAL) + among(1, _STREAM, _KIND),
        priority: among(0, (0,)) + among(1, (0,)),
        io_priority: among(0, (1,)) + among(1, (0,)),
    } | dict.fromkeys(of_process, among(0, (0, os.getpid())))
    code = load(_PROCESSOR) + where(_EQUAL, processor, denied, otherwise=True) + load(_NUMBER)
    code += where(_AT_LEAST, _OTHER_NUMBERS, denied)
    code += b"".join(where(_EQUAL, number, denied) for number in refused)
    code += b"".join(where(_EQUAL, number, done) for number in idle)
    code += (
        b"".join(where(_EQUAL, number, then + granted) for number, then in conditions.items())
        + granted
    )
    content = ctypes.create_string_buffer(code, len(code))
    filter_ = ctypes.create_string_buffer(
        struct.pack("HxxxxxxQ", len(code) // 8, ctypes.addressof(content))
    )
    _done(_libc().prctl(_SET_FILTER, 2, filter_, 0, 0))
