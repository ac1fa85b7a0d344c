"""Exceptions of the reporting room, one for each cause."""


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
