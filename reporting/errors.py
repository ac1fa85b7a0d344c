"""Exceptions of `reporting`, one for each cause, and their translation between layers."""

from collections.abc import Iterator
from contextlib import contextmanager


class ReportingError(RuntimeError):
    """Something could not be written, read or drawn."""


class FileNotWrittenError(ReportingError):
    """A file could not be written; the previous file is untouched."""


class DiskFullError(FileNotWrittenError):
    """No space, or no quota, is left for a file."""


class DamagedFileError(ReportingError):
    """A file exists but does not hold what it should hold."""


class InvalidChoiceError(ValueError):
    """An argument is not one of the few allowed values."""


class InvalidFigureError(ValueError):
    """Data handed to a page or a figure does not fit it."""


class StandsForOthersError(Exception):
    """An error of one layer that is raised in the place of errors of the layers below."""

    @classmethod
    @contextmanager
    def instead_of(
        cls, *causes: type[Exception], before: str = "", after: str = ""
    ) -> Iterator[None]:
        """Return a context that re-raises errors of the given classes as this class.

        Parameters
        ----------
        *causes : type of Exception
            The classes that are replaced.
        before, after : str
            Words around the message of the original error.
        """
        try:
            yield
        except causes as cause:
            raise cls(f"{before}{cause}{after}") from cause
