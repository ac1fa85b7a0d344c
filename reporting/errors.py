"""Exceptions of the reporting room, one for each cause, and how one stands for those of floors below."""

from collections.abc import Iterator
from contextlib import contextmanager


class ReportingError(RuntimeError):
    """Something that this package was asked to write, read or draw could not be done."""


class FileNotWrittenError(ReportingError):
    """A file could not be written; what stood there before is untouched."""


class DiskFullError(FileNotWrittenError):
    """No space, or no quota, is left where a file should have been written."""


class DamagedFileError(ReportingError):
    """A file is there but cannot be read as what it should be."""


class InvalidChoiceError(ValueError):
    """An argument is none of the few values that are allowed."""


class InvalidFigureError(ValueError):
    """Data handed to a page or a figure does not fit it."""


class StandsForOthersError(Exception):
    """An error of one floor that is raised in the place of those of the floors below."""

    @classmethod
    @contextmanager
    def instead_of(cls, *causes: type[Exception], before: str = "", after: str = "") -> Iterator[None]:
        """Return a context whose errors of these classes are raised as this one, with words around theirs."""
        try:
            yield
        except causes as cause:
            raise cls(f"{before}{cause}{after}") from cause
