"""Errors of the identification."""

from calibration.errors import CalibrationError


class IdentificationError(CalibrationError, ValueError):
    """A wing design cannot be identified from the start and data that were given."""
