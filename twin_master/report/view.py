"""What the report shows of a run: which turn, which sensors, and the lines and bands drawn of them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_master.report.data import Estimate, RunRecord, Uncertain, moments, smoothed_until

Float = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Band:
    """A line with a band around it.

    Attributes
    ----------
    step, center, lower, upper : (n,)
    """

    step: Float
    center: Float
    lower: Float
    upper: Float


def sensor_word(record: RunRecord) -> str:
    """Return what one sensor is called."""
    return "Gauge" if record.observation_name == "strain" else "Sensor"


def sensor_title(record: RunRecord, sensor: int) -> str:
    """Return the name of one sensor, or its number."""
    if record.sensor_titles:
        return record.sensor_titles[sensor]
    return f"{sensor_word(record)} {record.sensors[sensor]}"


def default_now(record: RunRecord) -> int:
    """Return the turn that shows most: a few turns before the flown control first changes.

    Without a change, two thirds into the mission.
    """
    changes = np.flatnonzero(np.diff(record.control_index)) + 1
    last = record.step_count - 1
    if len(changes):
        return int(np.clip(changes[0] - 3, 0, last))
    return int(np.clip(round(2 * last / 3), 0, last))


def observation_scale(record: RunRecord, sensor: int | None = None) -> tuple[float, str]:
    """Return the factor from the stored unit of a sensor to the printed one, and its name.

    Without a sensor those of all sensors; an empty name where they have several.
    """
    if record.sensor_units:
        return 1.0, "" if sensor is None else record.sensor_units[sensor]
    return printed_observation(record.observation_name, record.observation_unit)


def printed_observation(name: str, unit: str) -> tuple[float, str]:
    """Return the factor from the stored unit of an observation to the printed one, and its name."""
    return (1.0e6, "µε") if name == "strain" and unit in {"1", ""} else (1.0, unit)


def state_scale(record: RunRecord, factor: int) -> tuple[float, str]:
    """Return the factor from the stored unit of a state factor to the printed one, and its name."""
    return printed_state(record.state_units[factor] if factor < len(record.state_units) else "1")


def printed_state(unit: str) -> tuple[float, str]:
    """Return the factor from the stored unit of a state factor to the printed one, and its name."""
    return (100.0, "%") if unit == "1" else (1.0, unit)


def short_number(value: float) -> str:
    """Return a number that fits beside an axis: 0.5, 1500, 1e-4."""
    text = f"{value:g}"
    if len(text.lstrip("-")) <= 4:
        return text
    mantissa, exponent = f"{value:.2e}".split("e")
    return f"{float(mantissa):g}e{int(exponent)}"


def state_scales(record: RunRecord) -> Float:
    """Return the factors from the stored units to the printed ones: (K,)."""
    return np.array([state_scale(record, factor)[0] for factor in range(len(record.state_names))])


def state_label(record: RunRecord, factor: int) -> str:
    """Return symbol and printed unit of a state factor."""
    return f"{symbol(record.state_names[factor])} ({state_scale(record, factor)[1]})"


def choose_sensors(record: RunRecord, count: int = 4) -> list[int]:
    """Return indices of sensors worth a panel: the one strained most, the first, and one for each factor.

    The sensor of a factor is the one whose expected value answers most to it: the largest coefficient of a
    least-squares fit of its logarithm to the means of the factors, apart for each control.
    """
    if record.observation is None or not len(record.sensors):
        return []
    if record.sensor_units:  # what has different units cannot be compared: the first ones
        return list(range(min(count, len(record.sensors))))
    quantity = None if record.filtered.quantity is None else record.filtered.quantity.mean
    reference = np.abs(record.observation if quantity is None else quantity)
    level = np.nanmax(np.where(np.isfinite(reference), reference, 0.0), axis=0)
    chosen = [int(np.argmax(level))]
    if 0 not in chosen:
        chosen.append(0)
    if quantity is not None and bool(np.all(quantity > 0.0)):
        columns = [record.filtered.mean, np.eye(len(record.controls))[record.control_index]]
        coefficient = np.linalg.lstsq(np.concatenate(columns, axis=1), np.log(quantity), rcond=None)[0]
        for factor in range(len(record.state_names)):
            order = np.argsort(-coefficient[factor], kind="stable")
            fresh = [int(sensor) for sensor in order if int(sensor) not in chosen]
            if fresh and coefficient[factor, fresh[0]] > 1e-3:
                chosen.append(fresh[0])
    return chosen[:count]


@dataclass(frozen=True)
class Course:
    """One quantity as seen at one turn.

    Attributes
    ----------
    past : Band or None
        Turns 0..now.
    predicted : Band or None
        Turns now + 1..now + H.
    truth : (n,) or None
        Turns 0..n-1, at most to the last predicted one.
    """

    past: Band | None
    predicted: Band | None
    truth: Float | None


def state_course(record: RunRecord, factor: int, now: int) -> Course:
    """Return one factor of the state as printed: mean and two standard deviations, within the levels.

    The past is p(D_t | o_0..o_now), the prediction p(D_{now+h} | o_0..o_now).
    """
    mean, deviation = record.filtered.mean[: now + 1], record.filtered.standard_deviation[: now + 1]
    if now == record.step_count - 1 and record.smoothed is not None:
        mean, deviation = record.smoothed.mean, record.smoothed.standard_deviation
    else:
        belief = smoothed_until(record, now)
        if belief is not None:
            mean, deviation = moments(belief, record.coordinates)
    low, high = float(record.levels[factor][0]), float(record.levels[factor][-1])
    scale, _ = state_scale(record, factor)

    def band(first: int, mean: Float, deviation: Float) -> Band:
        lower, upper = (np.clip(mean + sign * deviation, low, high) for sign in (-2.0, 2.0))
        return Band(np.arange(float(first), first + len(mean)), scale * mean, scale * lower, scale * upper)

    predicted = None
    if record.predicted is not None and record.horizon:
        coming = record.predicted
        predicted = band(now + 1, coming.mean[now, :, factor], coming.standard_deviation[now, :, factor])
    truth = None if record.truth_state is None else scale * record.truth_state[: _end(record, now), factor]
    return Course(band(0, mean[:, factor], deviation[:, factor]), predicted, truth)


def sensor_course(record: RunRecord, sensor: int, now: int) -> Course:
    """Return the noise-free observation of one sensor in its printed unit, with 95 % intervals.

    The past is seen in hindsight at the last turn and as seen at the time before that.
    """
    scale, _ = observation_scale(record, sensor)
    past = _past(record, now).quantity
    predicted = None if record.predicted is None else record.predicted.quantity
    truth = record.truth_observation
    return Course(
        None if past is None else _band(past, sensor, scale, 0, slice(0, now + 1)),
        None if predicted is None else _band(predicted, sensor, scale, now + 1, now),
        None if truth is None else scale * truth[: _end(record, now), sensor],
    )


def reward_course(record: RunRecord, reward: int, now: int) -> Course:
    """Return one reward with 95 % intervals; the past as in `sensor_course`."""
    past = _past(record, now).reward
    predicted = None if record.predicted is None else record.predicted.reward
    return Course(
        None if past is None else _band(past, reward, 1.0, 0, slice(0, now + 1)),
        None if predicted is None else _band(predicted, reward, 1.0, now + 1, now),
        None,
    )


def _end(record: RunRecord, now: int) -> int:
    return min(now + 1 + record.horizon, record.step_count)


def _past(record: RunRecord, now: int) -> Estimate:
    last = now == record.step_count - 1
    return record.smoothed if last and record.smoothed is not None else record.filtered


def _band(values: Uncertain, index: int, scale: float, first: int, part: int | slice) -> Band | None:
    """Return the part (a range of turns, or the predictions of one turn) of one quantity; None if unknown."""
    center, lower, upper = (
        scale * array[part][..., index] for array in (values.mean, values.lower, values.upper)
    )
    known = np.isfinite(center)
    if not known.any():
        return None
    return Band(
        np.arange(float(first), first + len(center))[known], center[known], lower[known], upper[known]
    )


def symbol(name: str) -> str:
    """Return the name with its trailing digits as a subscript: ``z1`` -> z₁."""
    stem = name.rstrip("0123456789")
    digits = name[len(stem) :]
    return stem + digits.translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")) if stem else name


def capital(text: str) -> str:
    """Return the text with its first letter capital."""
    return text[:1].upper() + text[1:]
