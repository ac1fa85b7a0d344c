"""What a worker may use.

The limit of memory is of resident memory, and the twin keeps it: it looks at the worker while it waits for a
long call, and now and then between short ones. `RLIMIT_AS` would refuse FMUs that reserve address space and
never use it (Java, .NET, CUDA, the stacks of threads); under either resource limit an allocation fails inside
the FMU, which then crashes somewhere, and nobody could say why.
"""

import os
import signal

LARGEST_FILE = 2 * 1024**3
"""Bytes that an FMU may write to one file, such as an endless log."""


def restrict() -> None:
    """End an FMU that fills the disk."""
    import resource

    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    limit = LARGEST_FILE if hard == resource.RLIM_INFINITY else min(LARGEST_FILE, hard)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    # Python ignores this signal, and the FMU would see a write that fails again and again.
    signal.signal(signal.SIGXFSZ, signal.SIG_DFL)


def resident_memory(process: int) -> int | None:
    """Return the resident memory of a process [bytes], or None if it is gone or the system does not say."""
    try:
        with open(f"/proc/{process}/statm", "rb") as file:  # noqa: PTH123 - half the time of Path.open
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError):
        return None
