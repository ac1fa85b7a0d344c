"""The command line of a system that lacks what POSIX alone has.

`python -m tests.portable.other_system WORDS` runs `uav-twin WORDS`. On Linux and macOS, it first hides what
Windows does not have: modules, functions of `os` and `signal`, and the question whether a pipe has content.
`os.name` stays, because Python itself chooses paths and processes by it. On Windows nothing needs to be
hidden.
"""

import os
import select
import signal
import sys
from contextlib import suppress
from typing import Any, NoReturn

MODULES = ("fcntl", "grp", "pwd", "resource", "termios")
OF_OS = (
    "fork", "forkpty", "getpgid", "getpriority", "getuid", "geteuid", "killpg", "mkfifo", "nice",
    "pidfd_open", "pread", "pwrite", "readv", "writev", "sched_getaffinity", "setpgid", "setpriority",
    "setsid", "sysconf", "O_PATH", "O_NOFOLLOW", "O_DIRECTORY", "O_NONBLOCK", "O_CLOEXEC", "WNOHANG",
)  # fmt: skip
OF_SIGNAL = (
    "alarm", "pthread_sigmask", "pidfd_send_signal", "SIGALRM", "SIGBUS", "SIGCHLD", "SIGHUP", "SIGKILL",
    "SIGPIPE", "SIGQUIT", "SIGSTOP", "SIGTRAP", "SIGTSTP", "SIGTTIN", "SIGTTOU", "SIGUSR1", "SIGXFSZ",
)  # fmt: skip


def _refuse_pipes(*_arguments: Any) -> NoReturn:
    """Refuse as Windows does, where only sockets can be asked."""
    raise OSError(10038, "an operation was attempted on something that is not a socket")


def hide_posix() -> None:
    """Hide from this process what Windows does not have."""
    if os.name != "posix":
        return
    # What Python itself has loaded of these keeps what it has
    import asyncio  # noqa: F401
    import subprocess  # noqa: F401
    import tempfile

    tempfile.gettempdir()
    # So does this library, which has a module of its own for each system
    with suppress(ImportError):
        import distributed  # noqa: F401
    for name in MODULES:
        sys.modules[name] = None  # type: ignore[assignment]
    for module, names in ((os, OF_OS), (signal, OF_SIGNAL)):
        for name in names:
            if hasattr(module, name):
                delattr(module, name)
    select.select = _refuse_pipes
    del select.poll


def main() -> None:
    """Run the command line where POSIX is hidden."""
    hide_posix()
    from uav_twin.__main__ import main as run

    run()


if __name__ == "__main__":
    main()
