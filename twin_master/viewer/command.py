"""The process behind `--view`."""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import typer

from reporting import terminal
from reporting.errors import ReportingError
from twin_master.errors import TwinMasterError

_LOOK_AGAIN = 0.05
"""Seconds between two looks for a flight that is being prepared."""
_COURTESY = 5
"""Niceness of a view beside a mission: the mission comes first."""

Server = tuple[Callable[[Path], bool], Callable[[Path, int, Callable[[str], None], Callable[[], bool]], None]]
"""Whether a folder can be shown, and what shows it, as `viewer.server.serve`."""


@contextmanager
def shown(wanted: bool, server: Server | None = None) -> Iterator[Callable[[Path], None] | None]:
    """Give what shows a mission from its beginning in a process beside it; at the end wait for Ctrl-C.

    Parameters
    ----------
    wanted
        Whether to show it at all; if not, None is given.
    server
        Says whether a folder can be shown yet, and shows it; that of one flight if left out.
    """
    if not wanted:
        yield None
        return
    process: multiprocessing.process.BaseProcess | None = None

    def begin(folder: Path) -> None:
        nonlocal process
        context = multiprocessing.get_context("spawn")
        process = context.Process(target=_beside, args=(folder, os.getpid(), server), daemon=True)
        process.start()

    try:
        yield begin
        if process is not None and process.is_alive():
            with suppress(KeyboardInterrupt):  # from the sentence on, which a quick hand may answer at once
                _say("The view stays until Ctrl-C.")
                process.join()
    finally:
        if process is not None:
            process.terminate()
            process.join()


def _beside(folder: Path, mission: int, server: "Server | None") -> None:
    """Show a mission as soon as it is prepared; end with the process that flies it."""
    from twin_master.viewer.flight import is_prepared
    from twin_master.viewer.server import serve

    prepared, serving = server or (is_prepared, serve)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the mission ends it
    os.nice(_COURTESY)

    def wanted() -> bool:
        return os.getppid() == mission

    while wanted() and not prepared(folder):
        time.sleep(_LOOK_AGAIN)
    try:
        serving(folder, 0, lambda address: _say(f"View: {address}"), wanted)
    except (TwinMasterError, ReportingError) as error:
        typer.secho(f"The view ended: {error}", fg="red", err=True)


def _say(text: str) -> None:
    """Print beside the results of a mission, which may be JSON."""
    if not terminal.loudness.quiet:
        typer.echo(text, err=True)
