"""Checks of an FMU."""

from .file import check_fmu as check_fmu
