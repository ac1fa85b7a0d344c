"""The interface of a search for the cause of an alarm, which a package above implements.

The watch knows when to search, and in which steps. How to search is known by the workflow on
discrepancies, which this package does not import: `uav_twin` hands in a `CauseSearch`.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


@dataclass(frozen=True)
class SearchRequest:
    """A request to search some steps of a watch for an effect that its model lacks.

    Attributes
    ----------
    run_folder : Path
        The folder of the watch, which is only read.
    first_step, last_step : int
        The first and the last step that the search uses.
    verdict_folder : Path
        The folder for `verdict.json` and, if the verdict gives one, `patch.json`. It must appear
        complete or not at all.
    log : Path
        The file for the messages of the search.
    seed : int
        The seed of all random numbers of the search.
    low_priority : bool
        Whether the search runs with low priority, because a live watch runs at the same time.
    """

    run_folder: Path
    first_step: int
    last_step: int
    verdict_folder: Path
    log: Path
    seed: int
    low_priority: bool


class RunningSearch(Protocol):
    """A search that is running or has ended."""

    def has_ended(self) -> bool:
        """Return whether the search has ended, with a verdict or without one."""

    def stop(self) -> None:
        """Terminate the search if it still runs, and wait for its end."""


class CauseSearch(Protocol):
    """Starts searches for the cause of an alarm.

    A search must not disturb the watch: it runs in a process of its own, and no error, terminal key
    or process state of it reaches the watch.
    """

    def start(self, request: SearchRequest) -> RunningSearch:
        """Start a search without waiting for its end."""
