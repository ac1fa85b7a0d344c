"""Errors of the calibration, named by cause, and the sentences that say why."""

from reporting.sentences import Sentences

said = Sentences(__file__).said
"""A sentence by "table.name" with its values."""


class CalibrationError(Exception):
    """Any error that the calibration raises on purpose."""


class ExperimentFileError(CalibrationError, ValueError):
    """A file of measurements is missing, empty, or not laid out as expected."""


class ExperimentDataError(CalibrationError, ValueError):
    """Measurements hold values that no experiment can give or no model meets, or in another unit."""


class PosteriorError(CalibrationError, ValueError):
    """A density, a prior, a stiffness curve or a request for quantiles or samples makes no sense."""


class OutsideValidityError(CalibrationError, RuntimeError):
    """The posterior reaches beyond the range in which the stiffness curve may be trusted."""


class CalibrationRecordError(CalibrationError, ValueError):
    """A stored calibration cannot be read back."""
