"""The sandbox of an FMU: it sees its own folder, Python and the system's libraries, no socket.

FMUs are native code with the permissions of their user. Two restrictions, which any process may
impose on itself and all its children inherit, take permissions away: Landlock (landlock(7)) those
for files, programs, TCP ports and signals; a filter of system calls those that Landlock leaves.
"""

import os
import stat
import struct
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache

from .call_filter import checked, filter_calls, libc

# numbers of the system calls of Landlock, the same on every processor
_CREATE_RULESET = 444
_ADD_RULE = 445
_RESTRICT_SELF = 446
_GET_VERSION = 1
# kinds of rules, <linux/landlock.h>
_PATH_BENEATH = 1
_NET_PORT = 2
# rights to files, <linux/landlock.h>
_EXECUTE = 1 << 0
_WRITE_FILE = 1 << 1
_READ_FILE = 1 << 2
_READ_FOLDER = 1 << 3
_TRUNCATE = 1 << 14
_USE_DEVICE = 1 << 15
_READ = _READ_FILE | _READ_FOLDER
_OF_FILES = _EXECUTE | _WRITE_FILE | _READ_FILE | _TRUNCATE | _USE_DEVICE
"""Rights that a file, not a folder, can have."""
_RIGHT_COUNTS = {1: 13, 2: 14, 3: 15, 4: 15}
"""Number of rights to files that an older version of Landlock knows."""
_RIGHT_COUNT = 16
# rights to TCP ports, and scopes
_BIND_TCP = 1 << 0
_CONNECT_TCP = 1 << 1
_ABSTRACT_SOCKETS = 1 << 0
_SIGNALS = 1 << 1
_PR_SET_NO_NEW_PRIVS = 38

_CONFIGURATION = (
    "alternatives",
    "fonts",
    "gai.conf",
    "group",
    "host.conf",
    "hosts",
    "ld.so.cache",
    "ld.so.conf",
    "ld.so.conf.d",
    "locale.alias",
    "localtime",
    "machine-id",
    "nsswitch.conf",
    "os-release",
    "passwd",
    "protocols",
    "resolv.conf",
    "services",
    "ssl/certs",
    "ssl/openssl.cnf",
    "timezone",
)
"""Files and folders of /etc that libraries read."""
_SYSTEM = (
    "/usr",
    "/bin",
    "/sbin",
    "/lib",
    "/lib32",
    "/lib64",
    "/opt",
    "/nix/store",
    "/gnu/store",
    "/proc/self",
    "/proc/cpuinfo",
    "/proc/meminfo",
    "/proc/stat",
    "/proc/version",
    "/proc/filesystems",
    "/proc/sys",
    "/sys/devices/system",
    "/sys/fs/cgroup",
    *(f"/etc/{name}" for name in _CONFIGURATION),
)
"""Files and folders of the system that every FMU may read."""
_DEVICES = ("/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom")
"""Devices that every FMU may read and write."""
_ROOT = os.path.realpath(f"{__file__}/../../..")
"""Folder in which our packages lie."""
_OUR_PACKAGES = ("fmu_asset", "fe", "reporting")
"""Our packages that a worker imports."""


@dataclass(frozen=True)
class Grants:
    """Rights that the binding grants an FMU in addition to those that every FMU has.

    Attributes
    ----------
    read, write : tuple of str
        Files, and folders with everything in them. A path is absolute, begins with a home folder
        (`~`), or is relative to the FMU's own folder.
    ports : tuple of int
        TCP ports to which the FMU may connect, on any host. If there are any, the FMU may also
        look up the names of hosts.
    programs : bool
        Whether the FMU may start the programs that it can read. They are confined as the FMU is.
    """

    read: tuple[str, ...] = ()
    write: tuple[str, ...] = ()
    ports: tuple[int, ...] = ()
    programs: bool = False


@cache
def landlock_version() -> int:
    """Return the version of the kernel's Landlock; 0 if there is none, or a container hides it."""
    version = int(libc().syscall(_CREATE_RULESET, None, 0, _GET_VERSION))
    return max(version, 0)


def confine(grants: Grants, scratch_folder: str, fmu_folder: str) -> bool:
    """Irrevocably take from this process all rights that an FMU does not need.

    Parameters
    ----------
    scratch_folder : str
        The only folder in which the FMU may always write: the worker's scratch folder.
    fmu_folder : str
        The folder or file of the FMU, which it may read.

    Returns
    -------
    bool
        False if the kernel has no Landlock, so that nothing was changed.

    Raises
    ------
    OSError
        If the system refuses a step. The process may then be confined in part, so the caller must
        end it without running the FMU.
    """
    version = landlock_version()
    if not version:
        return False
    if len(os.listdir("/proc/self/task")) > 1:  # noqa: PTH208
        raise OSError(
            "the sandbox: another thread runs in this process already, and would not be confined"
        )
    # An older Landlock refuses a rule with a right that it does not know. Rights are consecutive
    # bits, so the mask of the known rights has as many ones as there are rights.
    all_rights = (1 << _RIGHT_COUNTS.get(version, _RIGHT_COUNT)) - 1
    rules = _ruleset(version, all_rights)
    _grant_paths(rules, grants, scratch_folder, fmu_folder, all_rights)
    # Landlock controls TCP connections from its version 4, and truncate(2) from its version 3.
    if version > 3:
        for port in grants.ports:
            rule = struct.pack("QQ", _CONNECT_TCP, port)
            checked(libc().syscall(_ADD_RULE, rules, _NET_PORT, rule, 0))
    # put the rules in force; without NO_NEW_PRIVS a program with set-user-ID could escape them
    checked(libc().prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0))
    checked(libc().syscall(_RESTRICT_SELF, rules, 0))
    os.close(rules)
    filter_calls(tcp=bool(grants.ports), truncates=version >= 3)
    return True


def _ruleset(version: int, all_rights: int) -> int:
    """Return the file descriptor of a set of rules that withdraws all rights and grants none.

    `all_rights` is the mask of all rights to files that this version of Landlock knows.
    """
    # TCP ports are controlled from version 4; abstract sockets and signals from version 6
    network = _BIND_TCP | _CONNECT_TCP if version > 3 else 0
    scopes = _ABSTRACT_SOCKETS | _SIGNALS if version > 5 else 0
    attributes = struct.pack("QQQ", all_rights, network, scopes)
    return checked(libc().syscall(_CREATE_RULESET, attributes, len(attributes), 0))


def _grant_paths(
    rules: int, grants: Grants, scratch_folder: str, fmu_folder: str, all_rights: int
) -> None:
    """Add rules that grant an FMU its rights to files and folders; arguments as for `confine`."""
    programs = _EXECUTE if grants.programs else 0
    read_rights = (_READ | programs) & all_rights
    write_rights = (all_rights & ~_EXECUTE | programs) & all_rights
    readable = (*_SYSTEM, *_paths_of_python(), fmu_folder, *_located(grants.read, fmu_folder))
    writable = (*_DEVICES, scratch_folder, *_located(grants.write, fmu_folder))
    _allow(rules, readable, read_rights)
    _allow(rules, writable, write_rights)


def _allow(rules: int, paths: Iterable[str], rights: int) -> None:
    """Add rules that grant a mask of rights to the paths that exist.

    A folder stands for everything in it. For a file, rights that only folders can have are left
    out.
    """
    for path in filter(os.path.exists, paths):
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
        is_folder = stat.S_ISDIR(os.fstat(descriptor).st_mode)
        rule = struct.pack("=Qi", rights if is_folder else rights & _OF_FILES, descriptor)
        checked(libc().syscall(_ADD_RULE, rules, _PATH_BENEATH, rule, 0))
        os.close(descriptor)


def missing_path(grants: Grants, fmu_folder: str) -> str:
    """Return the first granted path that does not exist; an empty text if all exist.

    Relative paths start at the FMU's folder.
    """
    for path in _located(grants.read + grants.write, fmu_folder):
        if not os.path.exists(path):  # noqa: PTH110
            return path
    return ""


def _located(paths: tuple[str, ...], fmu_folder: str) -> list[str]:
    """Return granted paths with `~` expanded; relative paths are taken from the FMU's folder."""
    return [
        os.path.join(fmu_folder, os.path.expanduser(path))  # noqa: PTH111, PTH118 - light
        for path in paths
    ]


def _paths_of_python() -> Iterator[str]:
    """Yield the folders in which Python finds its modules and libraries.

    A folder that contains the user's home is left out, since it would open all of the user's files.
    If our packages run from a checkout of the repository, only the packages that a worker imports
    are readable there.
    """
    home = os.path.realpath(os.path.expanduser("~"))  # noqa: PTH111
    libraries = os.environ.get("LD_LIBRARY_PATH", "").split(":")
    for path in {sys.prefix, sys.base_prefix, *sys.path, *libraries}:
        real_path = os.path.realpath(path)
        is_checkout = real_path == _ROOT and os.path.exists(f"{_ROOT}/pyproject.toml")  # noqa: PTH110
        if path and is_checkout:
            # a checkout contains much else
            for name in _OUR_PACKAGES:
                yield f"{_ROOT}/{name}"
        elif path and os.path.commonpath((home, real_path)) != real_path:
            yield path
