"""Errors of the calibration, named by cause."""


class CalibrationError(Exception):
    """Any error that the calibration raises on purpose."""


class ExperimentFileError(CalibrationError, ValueError):
    """A file of measurements is missing, empty, or not laid out as expected."""


class ExperimentDataError(CalibrationError, ValueError):
    """Measurements hold values that no experiment can give, or values in another unit than stated."""


class StiffnessCurveError(CalibrationError, ValueError):
    """A stiffness curve is not positive, not increasing, or cannot be tabulated accurately."""


class PosteriorError(CalibrationError, ValueError):
    """A density, a prior or a request for quantiles or samples makes no sense."""


class OutsideValidityError(CalibrationError, RuntimeError):
    """The posterior reaches beyond the range in which the stiffness curve may be trusted."""


class DegenerateFilterError(CalibrationError, RuntimeError):
    """No particle of the filter explains the measurements."""


class CalibrationRecordError(CalibrationError, ValueError):
    """A stored calibration cannot be read back."""


class RingDownError(CalibrationError, ValueError):
    """A ring-down record does not show two decaying modes, or was cut off by the range of its recorder."""


class MassConstraintError(CalibrationError, ValueError):
    """No masses within the range of the model keep the weighed total."""
