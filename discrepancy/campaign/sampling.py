"""Sampling in time: even to a thousandth of the interval, without gaps, long enough to be a record."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from discrepancy.errors import CampaignDataError
from reporting.words import counted

FloatArray = NDArray[np.float64]

EVEN = 1e-3
"""Largest departure of a sample from the even grid, as a share of the interval."""
LEAST_SAMPLES = 8
"""Fewest samples of a dynamic record."""
_EXACT = 1e-9


def check_sampling(time: FloatArray, cells: Sequence[str], user: str, file: str) -> FloatArray:
    """Return evenly spaced times.

    Times may be printed with few decimals: half a unit of the last one is allowed in addition, and the times
    are then put on the even grid through first and last. Times that are even to 1e-9 stay as they are.

    Parameters
    ----------
    time : (N,) ndarray
        [s].
    cells : sequence of str
        The same as printed.
    user, file : str
        Whose they are, for error messages.

    Raises
    ------
    CampaignDataError
        Too few samples, a time that does not increase, a gap, or uneven sampling.
    """
    count = len(time)
    if count < LEAST_SAMPLES:
        raise CampaignDataError(
            f"{file} holds {counted(count, 'sample')} of {user}: a record in time needs at least "
            f"{LEAST_SAMPLES}."
        )
    steps = np.diff(time)
    back = int(np.argmin(steps))
    if steps[back] <= 0.0:
        raise CampaignDataError(
            f"{file}: the time of {user} does not increase after sample {back + 1} ({cells[back]} s, then "
            f"{cells[back + 1]} s); put the samples in order and keep each once."
        )
    usual = float(np.median(steps))
    # Trailing zeros may be dropped in print, so the finest cell says how many decimals there are.
    rounding = 0.5 * min(_last_digit(cell) for cell in cells)
    wide = int(np.argmax(steps))
    if steps[wide] > 1.5 * usual + 2.0 * rounding:
        raise CampaignDataError(
            f"{file}: the time of {user} has a gap of {steps[wide]:.4g} s after {cells[wide]} s, and the "
            "usual "
            f"interval is {usual:.4g} s; fill it with rows whose readings are empty, or cut the record there."
        )
    even: FloatArray = time[0] + (time[-1] - time[0]) / (count - 1) * np.arange(count)
    interval = float(time[-1] - time[0]) / (count - 1)
    off = float(np.max(np.abs(time - even)))
    if off <= _EXACT * interval:
        return time
    if off > EVEN * interval + 2.0 * rounding:
        raise CampaignDataError(
            f"{file}: the samples of {user} are up to {off / interval:.2%} of an interval off an even "
            "spacing of "
            f"{interval:.4g} s ({EVEN:.1%} is allowed); resample the record evenly."
        )
    return even


def _last_digit(cell: str) -> float:
    """Return the value of one unit of the last printed decimal."""
    mantissa, _, exponent = cell.strip().lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 10.0 ** (int(exponent or 0) - decimals)
