"""Errors of the identification."""

from calibration.errors import CalibrationError


class IdentificationError(CalibrationError, ValueError):
    """A wing design cannot be identified: the start is laid out otherwise, or the fit does not converge."""
