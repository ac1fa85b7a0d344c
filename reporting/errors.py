"""Exceptions of the reporting room, one for each cause, and how one stands for those of floors below."""

from contextlib import AbstractContextManager
from typing import NamedTuple


class ReportingError(RuntimeError):
    """Something that this package was asked to write, read or draw could not be done."""


class FileNotWrittenError(ReportingError):
    """A file could not be written; what stood there before is untouched."""


class DiskFullError(FileNotWrittenError):
    """No space, or no quota, is left where a file should have been written."""


class DamagedFileError(ReportingError):
    """A file is there but cannot be read as what it should be."""


class InvalidFigureError(ValueError):
    """Data handed to a page or a figure does not fit it."""


class _Instead(NamedTuple):
    """Context in which errors of some classes are raised as another one, which says what they say."""

    error: type[Exception]
    causes: tuple[type[Exception], ...]
    before: str

    def __enter__(self) -> None:
        """Enter."""

    def __exit__(self, kind: object, cause: BaseException | None, trace: object) -> None:
        """Raise the other error."""
        if isinstance(cause, self.causes):
            raise self.error(f"{self.before}{cause}") from cause


class StandsForOthersError(Exception):
    """An error of one floor that is raised in the place of those of the floors below."""

    @classmethod
    def instead_of(cls, *causes: type[Exception], before: str = "") -> AbstractContextManager[None, None]:
        """Return a context whose errors of these classes are raised as this one, `before` their sentences."""
        return _Instead(cls, causes, before)
