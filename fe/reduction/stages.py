"""Where a build reports how far it is."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol


class Stage(Protocol):
    """One stretch of work under way."""

    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Report `amount` more parts done."""


class Progress(Protocol):
    """Where the build reports how far it is; `reporting.progress` has implementations."""

    def stage(
        self, description: str, total: int | None = None, unit: str = ""
    ) -> AbstractContextManager[Stage]:
        """Open a stretch of work of `total` parts."""


@contextmanager
def stage_of(progress: Progress | None, description: str, total: int | None = None) -> Iterator[Stage]:
    """Open a stretch of work, silent without `progress`."""
    if progress is None:
        yield _Silent()
    else:
        with progress.stage(description, total) as stage:
            yield stage


class _Silent:
    def advance(self, amount: int = 1, detail: str | None = None) -> None:
        """Do nothing."""
