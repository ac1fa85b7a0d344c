"""Sampling in time: times of records, evenly spaced or not, and quanta of readings."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from discrepancy.errors import CampaignDataError
from reporting.words import counted

FloatArray = NDArray[np.float64]

EVENNESS_TOLERANCE = 1e-3
"""Largest departure of a sample from the even grid, as a fraction of the interval."""
LEAST_SAMPLES = 8
"""Fewest samples of a dynamic record."""
_EXACT_TOLERANCE = 1e-9
"""Departure from an even grid, in intervals, below which times stay as they are."""
LEAST_LEVELS = 5
"""Fewest values at which neighbouring readings must repeat to show a sensor's quantum."""
LATTICE_TOLERANCE = 0.1
"""Largest departure of a value from a lattice, in its steps."""
LEAST_LATTICE_SHARE = 0.8
"""Least fraction of distances between repeated values that are whole numbers of steps."""
ROUNDING_GAP = 10.0
"""Least ratio of a true difference to the largest one that rounding leaves."""
LEAST_ROUNDED = 8
"""Fewest differences that are taken as left by rounding."""
STEP_TOLERANCE = 0.1
"""Largest relative departure of a step from the mean one for filters of even samples."""


def check_sampling(time: FloatArray, cells: Sequence[str], user: str, file: str) -> FloatArray:
    """Return the times of a record, on an even grid if they are even to their printed digits.

    Parameters
    ----------
    time : (N,) ndarray
        The times of the samples [s].
    cells : sequence of str
        The same times as printed in the file.
    user, file : str
        The name of the trial or record that the times belong to, and that of the file, for
        messages.

    Returns
    -------
    (N,) ndarray
        Times [s]; see `undo_rounding`.

    Raises
    ------
    CampaignDataError
        If there are too few samples, or a time does not increase.
    """
    count = len(time)
    if count < LEAST_SAMPLES:
        raise CampaignDataError(
            f"{file} holds {counted(count, 'sample')} of {user}: a record in time needs at least "
            f"{LEAST_SAMPLES}."
        )
    steps = np.diff(time)
    shortest = int(np.argmin(steps))
    if steps[shortest] <= 0.0:
        raise CampaignDataError(decreasing_times_message(file, user, cells, shortest))
    return undo_rounding(time, cells)


def decreasing_times_message(file: str, user: str, cells: Sequence[str], index: int) -> str:
    """Return the message that the times of a record do not increase.

    Parameters
    ----------
    file, user : str
        The name of the file, and name of the trial or record that the times belong to.
    cells : sequence of str
        The times as printed in the file [s].
    index : int
        The index of the time that the next one does not exceed.
    """
    return (
        f"{file}: the time of {user} does not increase after sample {index + 1} "
        f"({cells[index]} s, then {cells[index + 1]} s); put the samples in order and keep each "
        "once."
    )


def undo_rounding(time: FloatArray, cells: Sequence[str]) -> FloatArray:
    """Undo the rounding of printed times: return an evenly spaced grid if rounding explains them.

    Times that were printed with few decimals are not evenly spaced even if the samples were. If
    their intervals differ by at most one unit of the last printed decimal plus `EVENNESS_TOLERANCE`
    intervals, the times are replaced by the even grid of least squares, which passes through zero
    if the first time is zero. Times that are even to 1e-9 of the interval already, and times that
    rounding does not explain, are returned as they are.

    Parameters
    ----------
    time : (N,) ndarray
        The times of the samples, in any unit.
    cells : sequence of str
        The same times as printed.

    Returns
    -------
    (N,) ndarray
        The times, in the same unit.
    """
    # Trailing zeros may be dropped in print, so that the cell with most decimals shows the last
    # decimal. A step between two times is wrong by up to one unit of it: half a unit at each end.
    rounding_of_a_step = min(_last_digit(cell) for cell in cells)
    interval = (time[-1] - time[0]) / (len(time) - 1)
    if (
        not _EXACT_TOLERANCE
        < unevenness(time)
        <= EVENNESS_TOLERANCE + rounding_of_a_step / interval
    ):
        return time
    if time[0] == 0.0:
        index = np.arange(len(time)) - 0.0
        origin = 0.0
    else:
        # centred, so that the origin and the slope of the straight line are independent
        index = np.arange(len(time)) - 0.5 * (len(time) - 1)
        origin = time.mean()
    # straight line of least squares through the origin: slope = index . (time - origin) / index^2
    return np.asarray(origin + index * (index @ (time - origin)) / (index @ index))


def unevenness(time: FloatArray) -> float:
    """Return the largest departure of times (N,) from an even grid, as a fraction of its interval.

    The grid goes through the first and the last time. For a single time the result is 0.
    """
    interval = (time[-1] - time[0]) / max(len(time) - 1, 1)
    departure = np.abs(time - time[0] - interval * np.arange(len(time)))
    return float(departure.max() / abs(interval or 1.0))


def is_even(time: FloatArray) -> bool:
    """Return whether times (N,) lie on an even grid to a thousandth of its interval."""
    return unevenness(time) <= EVENNESS_TOLERANCE


def is_nearly_even(time: FloatArray) -> bool:
    """Return whether every step of times (N,) is within a tenth of the mean step.

    A filter for evenly spaced samples then still holds.
    """
    if len(time) < 2:
        return True
    steps = np.diff(time)
    return bool(np.allclose(steps, steps.mean(), rtol=STEP_TOLERANCE, atol=0.0))


def quantum_of(values: FloatArray) -> float:
    """Return the quantum of a sensor: the smallest step between two of its readings (N,).

    The quantum is the step of the lattice on which the readings repeat (`lattice_step`). If there
    is no such lattice, the quantum is the least difference between readings that rounding of
    printed decimals does not explain. The result is 0 if all readings are equal.
    """
    step = lattice_step(values)
    if step is not None:
        return step
    return least_beyond_rounding(np.diff(np.unique(values)))


def lattice_step(values: FloatArray) -> float | None:
    """Return the step between the output levels of a quantised sensor, if its readings show it.

    A level is a value that two consecutive readings share; levels must be evenly spaced (a
    lattice). For example, the readings of an encoder of 4096 steps, printed with six decimals,
    differ by 0.001534 or 0.001533: the step is this difference, and not 0.000001, by which the two
    differ. If readings were resampled by linear interpolation, values between the levels occur too,
    but consecutive readings rarely share them.

    Parameters
    ----------
    values : (N,) ndarray
        Readings in the order of time.

    Returns
    -------
    float or None
        The step; None if neighbouring readings repeat at fewer than `LEAST_LEVELS` values, or at
        values that are not evenly spaced.
    """
    equals_previous = np.diff(values) == 0.0  # (N - 1,)
    levels = np.unique(values[1:][equals_previous])
    if len(levels) < LEAST_LEVELS:
        return None
    distances = np.diff(levels)
    # a low quantile, because levels that do not repeat leave distances of several steps
    step = float(np.quantile(distances, 0.25))
    # a distance is on the lattice if it is a whole number of steps, at least one
    distance_from_whole_steps = np.abs(distances / step - np.round(distances / step))
    share_on_lattice = np.mean(
        (distance_from_whole_steps < LATTICE_TOLERANCE)
        & (distances > (1.0 - LATTICE_TOLERANCE) * step)
    )
    return step if share_on_lattice >= LEAST_LATTICE_SHARE else None


def least_beyond_rounding(differences: FloatArray) -> float:
    """Return the smallest positive difference of readings that is not caused by rounding in print.

    Rounding causes many differences that are far smaller than the true ones. In the sorted
    differences the two are separated by a gap: a difference that exceeds the previous one by the
    factor `ROUNDING_GAP`, with at least `LEAST_ROUNDED` differences before it. The difference after
    the first such gap is returned; without a gap, no difference counts as rounding.

    Parameters
    ----------
    differences : (M,) ndarray
        The differences between readings, of any sign.

    Returns
    -------
    float
        The smallest true difference; 0 if no difference is positive.
    """
    sorted_differences = np.sort(differences[differences > 0.0])
    if not sorted_differences.size:
        return 0.0
    # a gap is the index of the first difference above it, and so the number of those below it
    gaps = np.flatnonzero(sorted_differences[1:] > ROUNDING_GAP * sorted_differences[:-1]) + 1
    gaps_above_rounding = gaps[gaps >= LEAST_ROUNDED]
    first_true_difference = gaps_above_rounding[0] if gaps_above_rounding.size else 0
    return float(sorted_differences[first_true_difference])


def spacing_sentence(times: Mapping[str, FloatArray]) -> str | None:
    """Return the remark for the user on trials whose samples are not evenly spaced.

    The remark states the range of the intervals, and the widest gap if that exceeds 1.5 times the
    median interval.

    Parameters
    ----------
    times : mapping of str to (N,) ndarray
        Times of the samples [s] by the name of the trial.

    Returns
    -------
    str or None
        The remark; None if all trials are evenly sampled.
    """
    uneven_times = {name: time for name, time in times.items() if not is_even(time)}
    if not uneven_times:
        return None
    steps = np.concatenate([np.diff(time) for time in uneven_times.values()])
    usual_step = float(np.median(steps))
    plural = "s" if len(uneven_times) > 1 else ""
    names = ", ".join(map(repr, uneven_times))
    sentence = (
        f"The samples of the trial{plural} {names} are not evenly spaced (steps of "
        f"{steps.min():.4g} to {steps.max():.4g} s, usually {usual_step:.4g} s): they are taken as "
        "stamped, and spectra are approximate."
    )
    if steps.max() > 1.5 * usual_step:
        name = max(uneven_times, key=lambda trial: float(np.diff(uneven_times[trial]).max()))
        time_of_gap = float(uneven_times[name][int(np.argmax(np.diff(uneven_times[name])))])
        sentence += (
            f" The widest gap, {steps.max():.4g} s, begins at {time_of_gap:.6g} s of {name!r}."
        )
    return sentence


def _last_digit(cell: str) -> float:
    """Return the value of one unit of the last decimal of a number in print: 0.01 for "1.25"."""
    mantissa, _, exponent = cell.strip().lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return 10.0 ** (int(exponent or 0) - decimals)
