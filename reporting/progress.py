"""Progress of long work: one protocol, shown on a terminal or kept silent.

Library code takes a `Progress` and never asks what it is::

    with progress.stage("Flying", total=50, unit="turns") as stage:
        for turn in range(50):
            ...
            stage.advance()
"""

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # rich takes a while to import, and most code only names what it reports to
    from rich.console import Console
    from rich.progress import Progress as RichBars
    from rich.progress import TaskID

SECONDS_BETWEEN_LINES = 10.0
"""On a pipe, how long a stage is silent at most while its parts advance."""


class Stage:
    """One stretch of work under way; this one shows nothing."""

    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Report `amount` more parts done; `detail` (a few words) replaces the text beside the bar."""


class Progress:
    """Where work reports how far it is; this one shows nothing: the default of every library function."""

    @contextmanager
    def stage(self, description: str, total: int | None = None, unit: str = "") -> Iterator[Stage]:
        """Open a stretch of work of `total` parts (None: unknown); it ends with the ``with`` block."""
        yield Stage()

    def note(self, message: str) -> None:
        """Tell one line, such as where a file was written."""


SilentProgress = Progress
"""By the name that says that nothing is shown."""


narrator: Callable[[], Progress] = SilentProgress
"""Where work reports that was handed no `Progress`: nowhere but while a command runs."""


def reporter(progress: Progress | None = None) -> Progress:
    """Return the progress that was handed on, else that of the command that runs, else a silent one."""
    return progress or narrator()


def stage(description: str, total: int | None = None, unit: str = "") -> AbstractContextManager[Stage]:
    """Open a stretch of work of the command that runs, see `Progress.stage`."""
    return narrator().stage(description, total, unit)


def tell(message: str) -> None:
    """Tell one line of what a library does unasked, such as to compile, where no `Progress` was handed on."""
    narrator().note(message)


class _BarStage(Stage):
    def __init__(self, bars: "RichBars", task: "TaskID") -> None:
        self._bars = bars
        self._task = task

    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Move the bar."""
        told: dict[str, Any] = {} if detail is None else {"detail": detail}
        self._bars.update(self._task, advance=amount, **told)


class _LineStage(Stage):
    """A stage on a pipe: a line now and then, so that nobody takes long work for a standstill."""

    def __init__(self, note: Callable[[str], None], description: str, total: int | None, unit: str) -> None:
        self._note, self._description, self._total, self._unit = note, description, total, unit
        self._begin = self._last = time.perf_counter()
        self._done = 0
        amount = f", {total} {unit}".rstrip() if total is not None else ""
        note(f"{description}{amount} ...")

    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Tell how far the work is, if the last line is old."""
        self._done += amount
        now = time.perf_counter()
        if now - self._last >= SECONDS_BETWEEN_LINES:
            self._last = now
            total = "" if self._total is None else f" of {self._total} {self._unit}".rstrip()
            told = f"{self._done}{total}" if detail is None else f"{self._done}{total}, {detail}"
            self._note(f"{self._description}: {told}, {now - self._begin:.0f} s ...")

    def end(self) -> None:
        """Tell that the stage is done, and how long it took."""
        self._note(f"{self._description}: done, {time.perf_counter() - self._begin:.1f} s")


class RichProgress(Progress):
    """Progress on a terminal: a bar for each stage; on a pipe or in a log, lines as a stage begins and ends.

    Parameters
    ----------
    console
        Where to show it; the standard error stream by default, so that results can be piped.
    lines
        Show lines on a terminal too.
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
            yield stage
            stage.end()
            return
        first = self._bars is None
        bars = self._bars = self._bars or self._started()
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
            if first:
                bars.stop()
                self._bars = None

    def note(self, message: str) -> None:
        """Print one line, above the bars if there are any."""
        console = self._bars.console if self._bars is not None else self.console
        console.print(message, markup=False, highlight=False, soft_wrap=True)

    def _started(self) -> "RichBars":
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
