"""Readings of faulty sensors: the primitives of `fe.runtime.patch.SENSORS` applied to a response.

Pure functions on arrays. Clocks are not applied here: they say at which times the response is
needed, so they belong to the code that computes it. A high-pass needs the whole record; for a
record that is read row by row it needs the filter states of the previous row (`FilterMemory`).

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Callable, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray
from .errors import InvalidPatchError
from .modal_system import exponential
from .patch import (
    EVERY_CHANNEL,
    Clock,
    Filter,
    LoggerClock,
    LowPass,
    ModelPatch,
    Sensor,
    SensorRotation,
)
from .patch import SensorRecord as SensorRecord
from .primitive import Primitive

Channels = Sequence[tuple[str, str]]
"""Name and quantity of each column of a record."""

HighPassFilter = Callable[
    [Filter, SensorRecord, FloatArray, FloatArray], tuple[FloatArray, FloatArray]
]
"""A function that filters columns (N, C) of a dynamic record and their rates (N, C)."""

STRAIN = "strain"
"""Quantity of a strain gauge."""

RATES = frozenset({"velocity", "acceleration", "angular_velocity", "angular_acceleration"})
"""Quantities that are zero at rest."""

LARGEST_ORDER = 4
"""Largest number of stages of a high-pass filter that works row by row."""


class ClockError(NamedTuple):
    """A clock error: a sample with time stamp t was taken at (1 + `rate`) t + `zero` [s]."""

    rate: float
    zero: float


def needs_structure(patch: ModelPatch) -> bool:
    """Return whether a patch changes more than the readings of the existing channels.

    Rotated gauges need strains of the structure that no gauge reads.
    """
    return any(
        isinstance(primitive, SensorRotation) or not isinstance(primitive, Sensor)
        for primitive in patch
    )


def clock_of(patch: ModelPatch) -> ClockError:
    """Return the sum of the clock errors of a patch."""
    clocks = [primitive for primitive in patch if isinstance(primitive, Clock)]
    return ClockError(
        rate=sum(clock.rate for clock in clocks), zero=sum(clock.zero for clock in clocks)
    )


def check_channels(patch: ModelPatch, channels: Channels) -> None:
    """Check that sensor primitives name channels that exist and have the right quantity.

    Raises
    ------
    InvalidPatchError
        If a channel does not; the message names it and the channels that exist.
    """
    quantities = dict(channels)
    for primitive in patch:
        name = _channel_name(primitive)
        if name == EVERY_CHANNEL:
            continue
        if name not in quantities:
            raise InvalidPatchError(
                f"The primitive {primitive.kind!r} names the channel {name!r}, which does not "
                f"exist; there are {', '.join(quantities)}."
            )
        if _is_for_strain(primitive) and quantities[name] != STRAIN:
            raise InvalidPatchError(
                f"The primitive {primitive.kind!r} is for strain gauges, but the channel {name!r} "
                f"measures {quantities[name]}."
            )


def apply_sensors(
    patch: ModelPatch,
    record: SensorRecord,
    values: FloatArray,
    rates: FloatArray | None = None,
    transverse: FloatArray | None = None,
    shear: FloatArray | None = None,
    *,
    high_pass: HighPassFilter,
) -> tuple[FloatArray, FloatArray | None]:
    """Apply the sensor faults of a patch to perfect readings.

    Rotations come first, because a gauge senses the strain of the skin before anything else happens
    to it; several rotations of one gauge add up. The other primitives follow in the order of the
    patch. A primitive whose channel is not in the record changes nothing; `check_channels` finds
    names that exist nowhere. Filters and lines act in dynamic trials only: rows of static trials
    and of flights are settled readings. Without sensor faults the input is returned as it
    is.

    Parameters
    ----------
    patch : ModelPatch
        Only its sensor primitives act, without clocks.
    values : (N, C) array
        Readings of perfect sensors, in the units of the channels.
    rates : (N, C) array, optional
        The time derivatives of the readings, for dynamic trials.
    transverse, shear : (N, C) array, optional
        Strain across the direction of each gauge and engineering shear strain, for rotations.
    high_pass : callable
        The high-pass with the stages of a filter: `fe.high_pass.filtered_record`, or
        `FilterMemory.filter_row` for one row of a longer record, which has no rates.

    Returns
    -------
    values : (N, C) array
        The readings with the faults.
    rates : (N, C) array or None
        Their time derivatives, if `rates` was given.

    Raises
    ------
    InvalidPatchError
        If a gauge is turned and the strains for it are missing, or a time constant, an order, a
        drift's time or a limit is not positive.
    """
    sensors = [
        primitive
        for primitive in patch
        if isinstance(primitive, Sensor) and not isinstance(primitive, Clock | LoggerClock)
    ]
    if not sensors:
        return values, rates
    readings = np.array(values, dtype=np.float64)
    slopes = np.zeros_like(readings) if rates is None else np.array(rates, dtype=np.float64)
    _rotate_gauges(sensors, record, readings, slopes, transverse, shear)
    for sensor in sensors:
        columns = columns_of(sensor, record.channels)
        if not columns.size or isinstance(sensor, SensorRotation):
            continue
        signal = readings[:, columns]
        signal_rate = slopes[:, columns]
        if not isinstance(sensor, Filter):
            faulty_signal, faulty_rate = sensor.readings(record, signal, signal_rate)
        elif record.is_dynamic:
            faulty_signal, faulty_rate = high_pass(sensor, record, signal, signal_rate)
            if isinstance(sensor, LowPass):
                # a low-pass of first order passes what the high-pass removes
                faulty_signal = signal - faulty_signal
                faulty_rate = signal_rate - faulty_rate
        else:
            continue
        acts = sensor.acts_at(record.time)[:, np.newaxis]
        readings[:, columns] = np.where(acts, faulty_signal, signal)
        slopes[:, columns] = np.where(acts, faulty_rate, signal_rate)
    return readings, None if rates is None else slopes


def _rotate_gauges(
    sensors: Sequence[Sensor],
    record: SensorRecord,
    readings: FloatArray,
    slopes: FloatArray,
    transverse: FloatArray | None,
    shear: FloatArray | None,
) -> None:
    """Change the readings and rates (N, C) in place to those of gauges that are turned.

    A gauge turned by the angle a in the plane of the skin reads the strain eps cos^2 a +
    eps_t sin^2 a + gamma sin a cos a, with the strain eps along its nominal direction, `transverse`
    strain eps_t and `shear` strain gamma. If one of the latter is missing, `InvalidPatchError` is
    raised. The angles of several `sensors` that turn the same gauge add up.
    """
    angles = np.zeros(len(record.channels))
    for sensor in sensors:
        if isinstance(sensor, SensorRotation):
            angles[columns_of(sensor, record.channels)] += sensor.angle
    turned_columns = np.flatnonzero(angles)
    if not turned_columns.size:
        return
    if transverse is None or shear is None:
        raise InvalidPatchError(
            "A gauge is turned, but the model does not give the transverse and shear strains that "
            "its reading depends on."
        )
    cosine = np.cos(angles[turned_columns])
    sine = np.sin(angles[turned_columns])
    other_strains = transverse[:, turned_columns] * sine**2 + shear[:, turned_columns] * (
        sine * cosine
    )
    readings[:, turned_columns] = readings[:, turned_columns] * cosine**2 + other_strains
    if len(other_strains) > 1 and record.is_dynamic:
        # a response has no rates of these strains; central differences will do, as they are small
        other_strain_rates = np.gradient(other_strains, record.time, axis=0)
        slopes[:, turned_columns] = slopes[:, turned_columns] * cosine**2 + other_strain_rates


def _channel_name(primitive: Primitive) -> str:
    """Return the channel of a primitive; without one it acts on every channel."""
    return str(getattr(primitive, "channel", EVERY_CHANNEL))


def _is_for_strain(primitive: Primitive) -> bool:
    """Return whether a primitive acts on strain gauges only."""
    return isinstance(primitive, Sensor) and primitive.strain_only


def columns_of(primitive: Primitive, channels: Channels) -> NDArray[np.intp]:
    """Return the columns that a primitive acts on.

    If the primitive names a channel, its quantity does not matter. Otherwise the columns are those
    of the primitive's quantity, or all if it has none.
    """
    name = _channel_name(primitive)
    if name != EVERY_CHANNEL:
        columns = [column for column, (channel, _) in enumerate(channels) if channel == name]
        return np.array(columns, dtype=np.intp)
    quantity = STRAIN if _is_for_strain(primitive) else str(getattr(primitive, "quantity", ""))
    columns = [
        column
        for column, (_, channel_quantity) in enumerate(channels)
        if quantity in ("", channel_quantity)
    ]
    return np.array(columns, dtype=np.intp)


def levels_before_record(sensor: Filter, record: SensorRecord, first_row: FloatArray) -> FloatArray:
    """Return the constant inputs (C,) of a filter before the first row of a record.

    If the structure was at rest before, the input was the first reading, or zero for a channel that
    measures a rate. If it moved already, the input of a high-pass is taken as zero, the middle of
    its motion, and a slow sensor as showing what it measures.
    """
    if not record.settled:
        return first_row if isinstance(sensor, LowPass) else np.zeros_like(first_row)
    columns = columns_of(sensor, record.channels)
    is_rate = [record.channels[column][1] in RATES for column in columns]
    return np.where(is_rate, 0.0, first_row)


class FilterMemory:
    """The states of filters between two rows of a record that is read row by row.

    The signal is taken as linear between the rows.

    Parameters
    ----------
    previous : sequence of float or None
        `states` of the previous row; None before the first row, see `levels_before_record`.
    duration : float
        Time since the previous row [s].

    Attributes
    ----------
    states : list of float
        States after this row: the signal and the output of each stage, column after column and
        filter after filter.
    """

    def __init__(self, previous: Sequence[float] | None, duration: float) -> None:
        self._previous = None if previous is None else iter(previous)
        self._duration = duration
        self.states: list[float] = []

    def filter_row(
        self, sensor: Filter, record: SensorRecord, row: FloatArray, rates: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Pass one row (1, C) through the high-pass of a filter, and return zeros for its rates.

        Raises
        ------
        InvalidPatchError
            If the time constant is not positive, or there are not 1 to `LARGEST_ORDER` stages.
        """
        if not (sensor.time_constant > 0.0 and sensor.order in range(1, LARGEST_ORDER + 1)):
            raise InvalidPatchError(
                "A filter that is read sample by sample needs a positive time constant and 1 to "
                f"{LARGEST_ORDER} stages, but {sensor} was given."
            )
        order = int(sensor.order)
        signals = row[0].tolist()
        levels = levels_before_record(sensor, record, row[0]).tolist()
        outputs = []
        for signal, level in zip(signals, levels, strict=True):
            if self._previous is None:
                stages = np.full(order, signal - level)
            else:
                previous_signal, *previous_stages = islice(self._previous, 1 + order)
                stages = high_pass_step(
                    np.array(previous_stages),
                    signal - previous_signal,
                    self._duration / sensor.time_constant,
                )
            outputs.append(stages[-1])
            self.states += [signal, *stages.tolist()]
        return np.array([outputs]), np.zeros_like(row)


def high_pass_step(stages: FloatArray, increment: float, ratio: float) -> FloatArray:
    """Advance a chain of equal first-order high-pass stages by one time step.

    The outputs obey y_i' = x' - (y_1 + ... + y_i) / tau; the input x changes linearly.

    Parameters
    ----------
    stages : (n,) array
        Outputs y of the stages before the step.
    increment : float
        Change of the input.
    ratio : float
        Duration of the step over tau.

    Returns
    -------
    (n,) array
        Outputs of the stages after the step.
    """
    count = len(stages)
    # the increment is one more state, which stays constant
    matrix = np.zeros((count + 1, count + 1))
    matrix[:count, :count] = -ratio * np.tri(count)
    matrix[:count, count] = increment
    state = np.append(stages, 1.0)
    outputs = exponential(matrix)[:count] @ state
    return np.asarray(outputs)
