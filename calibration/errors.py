"""Errors of the calibration, one for each cause."""


class CalibrationError(Exception):
    """The base of all errors of the calibration."""


class ExperimentFileError(CalibrationError, ValueError):
    """A file of measurements is missing, empty, or has another layout."""


class ExperimentDataError(CalibrationError, ValueError):
    """Measurements are impossible, in another unit, or do not fit any model."""


class PosteriorError(CalibrationError, ValueError):
    """A density, a prior, a stiffness curve or a request for samples makes no sense."""


class OutsideValidityError(CalibrationError, RuntimeError):
    """The posterior reaches beyond the range in which the stiffness curve may be trusted."""


class CalibrationRecordError(CalibrationError, ValueError):
    """A stored calibration cannot be read back."""
