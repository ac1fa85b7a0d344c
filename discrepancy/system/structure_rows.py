"""Rows of a structure beside its own outputs: strains near gauges, and possible sensors."""

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.system.response import ACROSS
from fe.runtime.changeable import ChangeableModel

AXES = ("x", "y", "z")
"""Axes along which a place of the structure may be measured or loaded."""
ROUNDING = 1e-9
"""Differences of two rows below this fraction of the largest entry are rounding errors."""


def strains_near_gauges(model: ChangeableModel) -> dict[str, FloatArray]:
    """Return the rows of strains near gauges, by output.

    They are the transverse and the shear strain of a gauge (n,), and for each axis along which a
    gauge may be shifted, such as `g1.along`, the slope and curvature of its strain (2, n).
    """
    rows = {}
    for ending, strain_rows in zip(ACROSS, model.across_output, strict=True):
        for gauge, row in zip(model.gauges[: len(strain_rows)], strain_rows, strict=True):
            rows[gauge + ending] = row
    shifts = zip(model.shifted_gauges, model.shift_axes, model.shift_output, strict=True)
    rows |= {f"{gauge}.{axis}": derivatives for gauge, axis, derivatives in shifts}
    return rows


def strains_of_possible_gauges(model: ChangeableModel) -> dict[str, FloatArray]:
    """Return the rows (n,) of strains along and across possible gauges, and of shear strains."""
    rows = {}
    for ending, strains in zip(("", *ACROSS), model.possible_gauge_output, strict=True):
        for gauge, row in zip(model.possible_gauges, strains, strict=True):
            rows[gauge + ending] = row
    return rows


def displacements_of_places(model: ChangeableModel) -> dict[str, FloatArray]:
    """Return the rows (n,) of displacements at places of masses, such as "NOSE along z".

    They are the loads of forces of 1 N there, too.
    """
    rows = {}
    for place, displacements in zip(model.mass_places, model.mass_rows, strict=True):
        for axis, row in zip(AXES, displacements, strict=True):
            rows[f"{place} along {axis}"] = row
    return rows


def acts_along(load: FloatArray, row: FloatArray) -> bool:
    """Return whether a load (n,) is a multiple of the row (n,) of a displacement, up to rounding.

    A load of zeros is not.
    """
    largest_entry = float(np.abs(load).max())
    factor = float(load @ row) / (float(row @ row) or 1.0)  # of least squares
    return (
        largest_entry > 0.0 and float(np.abs(load - factor * row).max()) <= ROUNDING * largest_entry
    )
