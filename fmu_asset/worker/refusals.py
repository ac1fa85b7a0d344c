"""Counts what the sandbox refuses an FMU: files, sockets, processes and other things.

The supervisor traces the worker and everything that the FMU starts, inspects the result of each
system call, and counts those that the sandbox made fail. The kernel itself reports what it refuses,
so no rule of the sandbox is repeated here. Tracing makes every system call slower: `fmu check` does
so in one run, missions never. This module is the twin's side of it.
"""

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import IO, Literal, TypedDict

from .traced_calls import RefusalKind

_KINDS: dict[RefusalKind, tuple[str, str]] = {
    "files": ("file or folder", "files or folders"),
    "sockets": ("socket or connection", "sockets or connections"),
    "processes": ("program or other process", "programs or other processes"),
    "others": ("other system call", "other system calls"),
}
"""Names of each kind, in the singular and in the plural."""

_report: ContextVar[IO[bytes] | None] = ContextVar("report", default=None)


class RefusalRecord(TypedDict, total=False):
    """The supervisor's record; both keys are missing if no worker was started.

    Attributes
    ----------
    unavailable : str
        The reason why refusals cannot be counted on this machine.
    refused : dict
        The number of refused calls of each kind, and a description of the first of them.
    """

    unavailable: str
    refused: dict[RefusalKind, tuple[int, str]]


class RefusalReport:
    """Refusals of all workers that are started while it is open; see `watch_for_refusals`.

    Parameters
    ----------
    file : binary file
        File to which the supervisors write their records.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    @property
    def _record(self) -> RefusalRecord:
        self._file.seek(0)
        content: RefusalRecord = json.loads(self._file.read() or b"{}")
        return content

    @property
    def unavailable(self) -> str:
        """Reason why refusals cannot be counted on this machine; an empty text if they were."""
        record = self._record
        if not record:
            return "no worker was started"
        return record.get("unavailable", "")

    @property
    def counts(self) -> dict[RefusalKind, tuple[int, str]]:
        """How many calls of each kind were refused, and a description of the first one."""
        return self._record.get("refused", {})

    def verdict(self) -> Literal["ok", "warning", "skipped"]:
        """Return "warning" if something was refused, "skipped" if that could not be counted."""
        if self.unavailable:
            return "skipped"
        return "warning" if self.counts else "ok"

    def sentence(self) -> str:
        """Return a sentence with the number of refused calls of each kind, and the first one."""
        if self.unavailable:
            return (
                "What the sandbox refuses could not be counted on this machine "
                f"({self.unavailable})."
            )
        if not self.counts:
            return "The sandbox refused nothing."
        phrases = []
        for kind, (count, first_refusal) in self.counts.items():
            singular, plural = _KINDS[kind]
            if count == 1:
                phrases.append(f"1 {singular} ({first_refusal})")
            else:
                phrases.append(f"{count} {plural} (first {first_refusal})")
        return f"The sandbox refused {', '.join(phrases)}."


@contextmanager
def watch_for_refusals() -> Iterator[RefusalReport]:
    """Count the refusals of the workers that are started in this context, one after the other.

    The report is complete when the workers have ended.
    """
    with tempfile.TemporaryFile() as file:
        token = _report.set(file)
        try:
            yield RefusalReport(file)
        finally:
            _report.reset(token)


def report_descriptor() -> int | None:
    """Return the file descriptor of the report while workers are watched, else None."""
    file = _report.get()
    return None if file is None else file.fileno()
