"""Progress of long work: one protocol, shown on a terminal or kept silent.

Library code takes a `Progress` and never asks what it is::

    with progress.stage("Flying", total=50, unit="turns") as stage:
        for turn in range(50):
            ...
            stage.advance()
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, runtime_checkable

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.progress import Progress as RichBars


@runtime_checkable
class Stage(Protocol):
    """One stretch of work under way."""

    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Report `amount` more parts done; `detail` (a few words) replaces the text beside the bar."""


@runtime_checkable
class Progress(Protocol):
    """Where work reports how far it is."""

    def stage(
        self, description: str, total: int | None = None, unit: str = ""
    ) -> AbstractContextManager[Stage]:
        """Open a stretch of work of `total` parts (None: unknown); it ends with the ``with`` block."""

    def note(self, message: str) -> None:
        """Tell one line, such as where a file was written."""


class _SilentStage:
    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Do nothing."""


class SilentProgress:
    """Progress that shows nothing: the default of every library function."""

    @contextmanager
    def stage(self, description: str, total: int | None = None, unit: str = "") -> Iterator[Stage]:
        """Give a stage that does nothing."""
        yield _SilentStage()

    def note(self, message: str) -> None:
        """Do nothing."""


class _BarStage:
    def __init__(self, bars: RichBars, task: TaskID) -> None:
        self._bars = bars
        self._task = task

    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Move the bar."""
        if detail is None:
            self._bars.update(self._task, advance=amount)
        else:
            self._bars.update(self._task, advance=amount, detail=detail)


class RichProgress:
    """Progress on a terminal: a bar for each stage; on a pipe or in a log, one line as each stage ends.

    Parameters
    ----------
    console
        Where to show it; the standard error stream by default, so that results can be piped.
    """

    def __init__(self, console: Console | None = None) -> None:
        self.console = console if console is not None else Console(stderr=True, highlight=False)
        self._bars: RichBars | None = None
        self._open_stages = 0

    @contextmanager
    def stage(self, description: str, total: int | None = None, unit: str = "") -> Iterator[Stage]:
        """Show a stage; stages may be nested."""
        start = time.perf_counter()
        if not self.console.is_terminal:
            yield _SilentStage()
            self._line(description, total, unit, time.perf_counter() - start)
            return
        bars = self._start()
        task = bars.add_task(description, total=total, unit=unit, detail="")
        try:
            yield _BarStage(bars, task)
        except BaseException:
            # An interrupted stage must not look finished: its bar stays where it stood.
            bars.stop_task(task)
            raise
        else:
            done = total if total is not None else 1
            bars.update(task, total=done, completed=done, detail="")
        finally:
            self._stop()

    def note(self, message: str) -> None:
        """Print one line, above the bars if there are any."""
        console = self._bars.console if self._bars is not None else self.console
        console.print(message, markup=False, highlight=False, soft_wrap=True)

    def _start(self) -> RichBars:
        if self._bars is None:
            self._bars = RichBars(
                SpinnerColumn(finished_text="✓"),
                TextColumn("{task.description}", markup=False),
                BarColumn(bar_width=28),
                MofNCompleteColumn(),
                TextColumn("{task.fields[unit]}", markup=False),
                TimeElapsedColumn(),
                TextColumn("{task.fields[detail]}", style="dim", markup=False),
                console=self.console,
            )
            self._bars.start()
        self._open_stages += 1
        return self._bars

    def _stop(self) -> None:
        self._open_stages -= 1
        if self._open_stages == 0 and self._bars is not None:
            self._bars.stop()
            self._bars = None

    def _line(self, description: str, total: int | None, unit: str, seconds: float) -> None:
        amount = f", {total} {unit}".rstrip() if total is not None else ""
        self.note(f"{description}{amount}: {seconds:.1f} s")
