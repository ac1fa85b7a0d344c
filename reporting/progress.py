"""Progress of long work, shown on a terminal or not at all.

Library code takes a `Progress` and need not know which one it is::

    with progress.stage("Flying", total=50, unit="steps") as stage:
        for step in range(50):
            ...
            stage.advance()
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING

from reporting.system.log import module_logger

if TYPE_CHECKING:  # rich takes long to import, and most code needs only the names of types
    from rich.console import Console
    from rich.progress import Progress as RichBars
    from rich.progress import TaskID

_logger = module_logger(__name__)

SECONDS_BETWEEN_LINES = 10.0
"""Longest time between two lines of a stage on a pipe, while the stage advances [s]."""
LONGEST_SILENCE = 20.0
"""Longest time between two lines of a stage on a pipe, also where the stage reports nothing [s]."""


class Stage:
    """One part of the work that is in progress; this one shows nothing."""

    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Report that more of the stage is done.

        Parameters
        ----------
        amount : int
            The units of work that were done since the last report.
        detail : str, optional
            A few words, which replace the text beside the bar.
        """


class Progress:
    """The receiver of progress reports; this class, the default of libraries, shows nothing."""

    @contextmanager
    def stage(self, description: str, total: int | None = None, unit: str = "") -> Iterator[Stage]:
        """Return a context for a part of the work; it yields the `Stage` that takes its reports.

        Parameters
        ----------
        description : str
            What is being done, such as "Flying".
        total : int, optional
            The number of units of work; None if it is not known.
        unit : str
            The name of a unit of work, in the plural.
        """
        yield Stage()

    def note(self, message: str) -> None:
        """Show one line, such as where a file was written; here it only goes to the log."""
        _logger.info(message)


SilentProgress = Progress
"""The same class, under the name that says that it shows nothing."""


default_progress: Callable[[], Progress] = SilentProgress
"""Makes the progress of work whose caller gives none. A running command replaces this function."""


def reporter(progress: Progress | None = None) -> Progress:
    """Return the given progress, or that of the running command, or a silent one."""
    return progress or default_progress()


def stage(
    description: str, total: int | None = None, unit: str = ""
) -> AbstractContextManager[Stage]:
    """Return a context for a part of the work of the running command, see `Progress.stage`."""
    return default_progress().stage(description, total, unit)


def note(message: str) -> None:
    """Show one line about the running command, such as that a function is being compiled."""
    default_progress().note(message)


class _BarStage(Stage):
    def __init__(self, bars: "RichBars", task: "TaskID") -> None:
        self._bars = bars
        self._task = task

    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Move the bar."""
        if detail is None:
            self._bars.update(self._task, advance=amount)
        else:
            self._bars.update(self._task, advance=amount, detail=detail)


class _LineStage(Stage):
    """A stage that is shown as lines, on a pipe or in a log.

    A thread shows the last detail again before the work has been silent for `LONGEST_SILENCE`, so
    that the reader sees that it goes on. `stop` or `end` ends the thread.
    """

    def __init__(
        self, note: Callable[[str], None], description: str, total: int | None, unit: str
    ) -> None:
        self._note = note
        self._description = description
        self._total = total
        self._unit = unit
        self._start_time = time.perf_counter()
        self._time_of_last_line = self._start_time
        self._done = 0
        self._detail: str | None = None
        self._lines_shown = 0
        self._has_ended = threading.Event()
        amount = f", {total} {unit}".rstrip() if total is not None else ""
        note(f"{description}{amount} ...")
        threading.Thread(target=self._break_silence, daemon=True).start()

    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Note how much is done; show it if the last line is `SECONDS_BETWEEN_LINES` old."""
        self._done += amount
        self._detail = detail
        now = time.perf_counter()
        if now - self._time_of_last_line >= SECONDS_BETWEEN_LINES:
            self._show(now)

    def _show(self, now: float) -> None:
        """Show how much is done, with the present time of the clock [s]."""
        self._time_of_last_line = now
        self._lines_shown += 1
        parts = []
        if self._total is not None:
            parts.append(f"{self._done} of {self._total} {self._unit}".rstrip())
        elif self._done:
            parts.append(str(self._done))
        if self._detail is not None:
            parts.append(self._detail)
        parts.append(f"{now - self._start_time:.0f} s ...")
        self._note(f"{self._description}: {', '.join(parts)}")

    def _break_silence(self) -> None:
        """Show a line whenever none has been shown during half of the longest silence."""
        previous_count = self._lines_shown
        while not self._has_ended.wait(0.5 * LONGEST_SILENCE):
            if self._lines_shown == previous_count:
                self._show(time.perf_counter())
            previous_count = self._lines_shown

    def stop(self) -> None:
        """Show no further line."""
        self._has_ended.set()

    def end(self) -> None:
        """Show that the stage is done, and how long it took."""
        self.stop()
        duration = time.perf_counter() - self._start_time
        self._note(f"{self._description}: done, {duration:.1f} s")


class RichProgress(Progress):
    """Progress as a bar for each stage on a terminal, and as lines on a pipe or in a log.

    Parameters
    ----------
    console : Console, optional
        Where to show it; the standard error stream by default, so that results can be piped.
    lines : bool
        Whether to show lines on a terminal, too.
    """

    def __init__(self, console: "Console | None" = None, *, lines: bool = False) -> None:
        from rich.console import Console

        self.console = console if console is not None else Console(stderr=True, highlight=False)
        self._lines = lines or not self.console.is_terminal
        self._bars: RichBars | None = None

    @contextmanager
    def stage(self, description: str, total: int | None = None, unit: str = "") -> Iterator[Stage]:
        """Show a stage; stages may be nested."""
        if self._lines:
            stage = _LineStage(self.note, description, total, unit)
            try:
                yield stage
            finally:  # a stage that is interrupted must not look finished
                stage.stop()
            stage.end()
            return
        is_outermost = self._bars is None
        if self._bars is None:
            self._bars = self._start_bars()
        bars = self._bars
        task = bars.add_task(description, total=total, unit=unit, detail="")
        try:
            yield _BarStage(bars, task)
        except BaseException:
            # The bar of an interrupted stage stays where it is: the stage must not look finished.
            bars.stop_task(task)
            raise
        else:
            completed = total if total is not None else 1
            bars.update(task, total=completed, completed=completed, detail="")
        finally:
            if is_outermost:
                bars.stop()
                self._bars = None

    def note(self, message: str) -> None:
        """Show one line, above the bars if there are any."""
        console = self._bars.console if self._bars is not None else self.console
        console.print(message, markup=False, highlight=False, soft_wrap=True)

    def _start_bars(self) -> "RichBars":
        """Start the display of bars on the terminal, and return it."""
        from rich import progress as rich

        bars = rich.Progress(
            rich.SpinnerColumn(finished_text="✓"),
            rich.TextColumn("{task.description}", markup=False),
            rich.BarColumn(bar_width=28),
            rich.MofNCompleteColumn(),
            rich.TextColumn("{task.fields[unit]}", markup=False),
            rich.TimeElapsedColumn(),
            rich.TextColumn("{task.fields[detail]}", style="dim", markup=False),
            console=self.console,
        )
        bars.start()
        return bars
