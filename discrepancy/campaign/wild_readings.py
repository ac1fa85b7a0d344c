"""Readings that no other reading of their column supports, and the fill values among them."""

import re
from collections.abc import Sequence

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray

SUPPORTED_DISTANCE = 10.0
"""Largest distance from the median of a supported reading, over that of all other readings."""
_MOST_WILD_VALUES = 2
"""Most wild values of a column; more are an event, such as an impact."""
_LEAST_SUPPORTED_VALUES = 3
"""Fewest different values that show the range of a column."""
_FILL_VALUE = re.compile(r"-?(?:9{3,6}|[678]999|3276[78])(?:\.0*)?", re.ASCII)
"""What loggers write for no reading: -9999, 99999, 7999 and the ends of 16 bits."""


def wild_readings(values: FloatArray) -> BoolArray:
    """Return which readings (N,) of a column no other reading supports; none that is NaN.

    One or two values, however often they come, are wild if they lie more than ten times as far
    from the median of the different values as all the others do.
    """
    distinct_values = np.unique(values[np.isfinite(values)])
    if not distinct_values.size:
        return np.zeros(len(values), dtype=bool)
    centre = np.median(distinct_values)
    distances = np.sort(np.abs(distinct_values - centre))[::-1]
    limit = np.inf
    for count in range(1, _MOST_WILD_VALUES + 1):
        if len(distances) < count + _LEAST_SUPPORTED_VALUES:
            break
        largest_of_others = distances[count]
        if distances[count - 1] > SUPPORTED_DISTANCE * largest_of_others:
            limit = largest_of_others
    return np.abs(values - centre) > limit


def is_fill_value(cell: str) -> bool:
    """Return whether a number is one that loggers write where they have no reading."""
    return _FILL_VALUE.fullmatch(cell) is not None


def numbers_or_nan(cells: Sequence[str]) -> FloatArray:
    """Return the numbers (N,) in cells with decimal points; NaN for an empty cell."""
    return np.array([float(cell or "nan") for cell in cells])
