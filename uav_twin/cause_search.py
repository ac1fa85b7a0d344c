"""The search for the cause of a watch's alarm: `uav-twin discrepancy run` in its own process.

This package passes the search to a watch, because `twin_master` does not import `discrepancy`.
"""

import functools
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import ParamSpec, TypeVar

from reporting.system.operating_system import lower_priority
from twin_master.watch.cause_search import RunningSearch, SearchRequest

COMMAND = (sys.executable, "-m", "uav_twin", "discrepancy", "run")
"""The command that an alarm names, run by this interpreter."""
NICENESS = 10
"""Niceness of a search beside a live watch, whose steps come first."""

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


class _SearchProcess:
    """A search in a process of its own."""

    def __init__(self, process: "subprocess.Popen[bytes]") -> None:
        self._process = process

    def has_ended(self) -> bool:
        """Return whether the process has ended."""
        return self._process.poll() is not None

    def stop(self) -> None:
        """Terminate the process if it still runs, and wait for its end."""
        if not self.has_ended():
            self._process.terminate()
            self._process.wait()


class DiscrepancySearch:
    """Starts `uav-twin discrepancy run` for an alarm; a `CauseSearch` of `twin_master`.

    Parameters
    ----------
    command : sequence of str
        The words of the command, to which the options of the search are added.
    """

    def __init__(self, command: Sequence[str] = COMMAND) -> None:
        self._command = command

    def start(self, request: SearchRequest) -> RunningSearch:
        """Start a search without waiting for its end.

        The process has its own session, so that Ctrl-C in the terminal does not end it.
        """
        options = {
            "--from-run": request.run_folder,
            "--from-step": request.first_step,
            "--to-step": request.last_step,
            "--out": request.verdict_folder,
            "--seed": request.seed,
        }
        arguments = []
        for option, value in options.items():
            arguments += [option, str(value)]
        with request.log.open("wb") as log:
            process = subprocess.Popen(
                [*self._command, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        if request.low_priority:
            lower_priority(NICENESS, process.pid)
        return _SearchProcess(process)


def with_discrepancy_search(
    function: Callable[_Parameters, _Result],
) -> Callable[_Parameters, _Result]:
    """Make a `DiscrepancySearch` the default `cause_search` of a function of `twin_master`."""

    @functools.wraps(function)
    def with_search(*arguments: _Parameters.args, **options: _Parameters.kwargs) -> _Result:
        options.setdefault("cause_search", DiscrepancySearch())
        return function(*arguments, **options)

    return with_search
