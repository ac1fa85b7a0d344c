"""Sampling in time: strictly increasing stamps, even to a thousandth of the interval or as they came."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from discrepancy.errors import CampaignDataError, said
from reporting.words import counted

FloatArray = NDArray[np.float64]

EVEN = 1e-3
"""Largest departure of a sample from the even grid, as a share of the interval."""
LEAST_SAMPLES = 8
"""Fewest samples of a dynamic record."""
_EXACT = 1e-9
LEAST_LEVELS = 5
"""Fewest values at which neighbouring readings must repeat to show a sensor's quantum."""
OFF_LATTICE = 0.1
"""Largest departure of a value from a lattice, in its steps."""
ON_LATTICE = 0.8
"""Least share of the distances between repeated values that are whole numbers of a lattice's steps."""
ROUNDING_GAP = 10.0
"""Least ratio of a true difference to the largest one that rounding leaves."""
LEAST_ROUNDED = 8
"""Fewest differences that are taken as left by rounding."""
ALIKE = 0.1
"""Largest departure of a step, as a share of the interval, at which a filter of even samples holds."""


def check_sampling(time: FloatArray, cells: Sequence[str], user: str, file: str) -> FloatArray:
    """Return the times of a record: on the even grid where they are even as printed, else as they came.

    Times may be printed with few decimals: half a unit of the last one is allowed in addition, and the times
    are then put on the even grid that is nearest to all of them, through zero where they begin there. Times
    that are even to 1e-9 stay as they are.

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
        Too few samples, or a time that does not increase.
    """
    count = len(time)
    if count < LEAST_SAMPLES:
        samples = counted(count, "sample")
        raise CampaignDataError(
            said("campaign.few_samples", file=file, samples=samples, user=user, least=LEAST_SAMPLES)
        )
    steps = np.diff(time)
    back = int(np.argmin(steps))
    if steps[back] <= 0.0:
        told = {"at": back + 1, "time": cells[back], "then": cells[back + 1]}
        raise CampaignDataError(said("campaign.time_goes_back", file=file, user=user, **told))
    return as_meant(time, cells)


def as_meant(time: FloatArray, cells: Sequence[str]) -> FloatArray:
    """Return the times (N,) of printed cells, in any unit: on an even grid where they are even as printed."""
    # Trailing zeros may be dropped in print, so the finest cell says how many decimals there are.
    rounding = min(_last_digit(cell) for cell in cells)  # twice half of it
    interval = (time[-1] - time[0]) / (len(time) - 1)
    if not _EXACT < unevenness(time) <= EVEN + rounding / interval:
        return time
    place = np.arange(len(time)) - (0.0 if time[0] == 0.0 else 0.5 * (len(time) - 1))
    about = 0.0 if time[0] == 0.0 else time.mean()
    return np.asarray(about + place * (place @ (time - about)) / (place @ place))


def unevenness(time: FloatArray) -> float:
    """Return how far times (N,) are off the even grid through first and last [intervals]."""
    interval = (time[-1] - time[0]) / max(len(time) - 1, 1)
    off = np.abs(time - time[0] - interval * np.arange(len(time)))
    return float(off.max() / abs(interval or 1.0))


def is_even(time: FloatArray) -> bool:
    """Whether samples lie on an even grid to a thousandth of the interval."""
    return unevenness(time) <= EVEN


def nearly_even(time: FloatArray) -> bool:
    """Whether every step is within a tenth of the interval, so that a filter of even samples still holds."""
    steps = np.diff(time)
    return bool(np.allclose(steps, steps.mean(), rtol=ALIKE, atol=0.0)) if len(steps) else True


def quantum_of(values: FloatArray) -> float:
    """Return the step between two readings of a sensor, 0 where all readings (N,) are alike.

    It is the step of the lattice on which the readings repeat (`lattice_step`). Where they do not repeat it
    is the least difference of two readings that is more than the rounding of their printed decimals.
    """
    step = lattice_step(values)
    if step is not None:
        return step
    return least_beyond_rounding(np.diff(np.unique(values)))


def lattice_step(values: FloatArray) -> float | None:
    """Return the step of the lattice on which the readings (N,) of a quantised sensor stand still.

    An encoder of 4096 steps, printed with six decimals, has steps of 0.001534 and 0.001533: the quantum is
    the step and not their difference. Resampled by straight lines it also shows readings between its steps,
    but does not repeat them.

    Parameters
    ----------
    values : (N,) ndarray
        Readings in the order of time.

    Returns
    -------
    float or None
        The step; None where neighbouring readings repeat at fewer than `LEAST_LEVELS` values, or at values
        that are not evenly spaced.
    """
    repeats = np.diff(values) == 0.0
    levels = np.unique(values[1:][repeats])
    if len(levels) < LEAST_LEVELS:
        return None
    distances = np.diff(levels)
    step = float(np.quantile(distances, 0.25))
    off_lattice = np.abs(distances / step - np.round(distances / step))
    on_lattice = np.mean((off_lattice < OFF_LATTICE) & (distances > (1.0 - OFF_LATTICE) * step))
    return step if on_lattice >= ON_LATTICE else None


def least_beyond_rounding(differences: FloatArray) -> float:
    """Return the least positive difference that is not left by the rounding of printed decimals; 0 if none.

    Differences left by rounding are many, and far below all others.
    """
    sizes = np.sort(differences[differences > 0.0])
    if not sizes.size:
        return 0.0
    gaps = np.flatnonzero(sizes[1:] > ROUNDING_GAP * sizes[:-1]) + 1
    beyond = gaps[gaps >= LEAST_ROUNDED]
    return float(sizes[beyond[0]] if beyond.size else sizes[0])


def spacing_sentence(times: Mapping[str, FloatArray]) -> str | None:
    """Return what a reader has to know of uneven stamps, by trial; None where all are even."""
    uneven = {name: time for name, time in times.items() if not is_even(time)}
    if not uneven:
        return None
    steps = np.concatenate([np.diff(time) for time in uneven.values()])
    usual = float(np.median(steps))
    names = f"trial{'s' * (len(uneven) > 1)} {', '.join(map(repr, uneven))}"
    text = said("remarks.uneven", trials=names, least=steps.min(), most=steps.max(), usual=usual)
    if steps.max() > 1.5 * usual:
        name, time = max(uneven.items(), key=lambda item: float(np.diff(item[1]).max()))
        at = float(time[int(np.argmax(np.diff(time)))])
        text += said("remarks.widest_gap", most=steps.max(), at=at, trial=name)
    return text


def _last_digit(cell: str) -> float:
    """Return the value of one unit of the last printed decimal."""
    mantissa, _, exponent = cell.strip().lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 10.0 ** (int(exponent or 0) - decimals)
