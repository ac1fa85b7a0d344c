"""NetCDF files of several groups, read as a whole or refused in one sentence.

HDF5 believes what a file says of its own structure: a damaged one can keep it busy for ever, or crash it. So
a fork of this process reads, within limits, and hands over what it read; the process itself opens no file.
"""

from __future__ import annotations

import faulthandler
import gc
import os
import pickle
import signal
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from reporting.errors import DamagedFileError

if TYPE_CHECKING:
    import xarray as xr

SECONDS, BYTES_IN_A_SECOND = 10, 5_000_000
"""Processor time for a file: so much for any, and a second more for so many bytes (1e8 are read in truth)."""
WAITING = 6
"""Seconds on the clock for one of processor time."""
MEMORY, MEMORY_OF_A_BYTE = 512 * 1024**2, 64
"""Bytes for any file, and for each byte of it, which may be compressed."""


def read_groups(path: Path) -> xr.DataTree:
    """Return all groups of a NetCDF-4 file, loaded into memory; times stay the numbers that are stored.

    Raises
    ------
    DamagedFileError
        The file is missing, damaged, cut off or of another kind.
    """
    if not path.is_file():
        raise DamagedFileError(f"there is no file {path}")
    # Here, and not again in each fork.
    import h5netcdf  # noqa: F401
    import xarray as xr

    reading, writing = os.pipe()
    with warnings.catch_warnings():
        # Python 3.12 warns of threads (those of BLAS); the fork calls nothing that they could have locked.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if not child:
        _answer(path, writing)
    os.close(writing)
    groups: dict[str, xr.Dataset] | str = ""
    try:
        with os.fdopen(reading, "rb") as pipe:
            groups = pickle.load(pipe)
    except (EOFError, pickle.UnpicklingError):
        groups = "HDF5 breaks down over it"
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    if isinstance(groups, str):
        raise DamagedFileError(f"{path} is damaged or no NetCDF file ({groups})")
    return xr.DataTree.from_dict(groups)


def _answer(path: Path, writing: int) -> NoReturn:
    """Send the groups of a file, or why there are none, and end this process."""
    try:
        # A fork inherits the lock of a run folder, which must end with the process if that is killed.
        os.closerange(3, writing)
        os.closerange(writing + 1, os.sysconf("SC_OPEN_MAX"))
        gc.disable()  # what is garbage here is in use there: finalizers end workers and remove folders
        faulthandler.disable()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # the C library's last words
        _limit(path.stat().st_size)
        with os.fdopen(writing, "wb") as pipe:
            pickle.dump(_groups(path), pipe, pickle.HIGHEST_PROTOCOL)
    finally:
        os._exit(0)


def _groups(path: Path) -> dict[str, xr.Dataset] | str:
    import xarray as xr

    try:
        with xr.open_datatree(path, engine="h5netcdf", decode_times=False) as tree:
            return {node.path: node.to_dataset(inherit=False).load() for node in tree.subtree}
    except Exception as error:  # noqa: BLE001 - HDF5 answers damage with nearly every exception that there is
        reason = str(error).strip().splitlines()[:1] or [type(error).__name__]
        return reason[0].rstrip(".")


def _limit(size: int) -> None:
    """Let the kernel end this process when it takes more time or memory than a file of `size` bytes may."""
    import resource

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
        signal.signal(number, signal.SIG_DFL)
    seconds = SECONDS + size // BYTES_IN_A_SECOND
    signal.alarm(WAITING * seconds)
    taken = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    for what, limit in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, seconds),
        (resource.RLIMIT_AS, taken + MEMORY + MEMORY_OF_A_BYTE * size),
    ):
        hard = resource.getrlimit(what)[1]
        resource.setrlimit(what, (limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
