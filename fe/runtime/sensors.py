"""What sensors make of a response: gain, drift, rotation, thermal strain, high-pass, lines, offset of a run.

Pure functions on arrays for the primitives of `fe.runtime.patch.SENSORS`; clocks are not here, because they
say when the response is taken and so belong to whoever computes it. Without sensors the input comes back
untouched.

NumPy and standard library only: this file is copied into the FMU.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import gamma, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidPatchError
from .patch import (
    EVERY_CHANNEL,
    SENSORS,
    Clock,
    DecayingLine,
    HighPass,
    Line,
    LoggerClock,
    ModelPatch,
    Primitive,
    RunOffset,
    SensorDrift,
    SensorGain,
    SensorRotation,
    ThermalStrain,
)

FloatArray = NDArray[np.float64]

STRAIN = "strain"
"""Quantity of a strain gauge."""

_SERIES_LIMIT = 30.0  # beyond it the asymptotic series of the confluent function is exact to rounding


@dataclass(frozen=True)
class SensorRecord:
    """The record that sensors show.

    Attributes
    ----------
    channels : sequence of (str, str)
        Name and quantity of each column.
    kind : str
        "static", "flight", "ringdown", "forced" or "driven".
    time : (N,) ndarray
        Dynamic: since the trial's start [s]. Static, flight: since the campaign's start [s].
    start : float
        Of a dynamic trial since the campaign's start [s].
    temperature : (N,) ndarray
        Less the reference temperature [K].
    run : str
        Label of the run.
    release : float
        Release amplitude of a ring-down [m or the signal's unit].
    """

    channels: Sequence[tuple[str, str]]
    kind: str
    time: FloatArray
    start: float
    temperature: FloatArray
    run: str = ""
    release: float = 1.0

    @property
    def is_dynamic(self) -> bool:
        """Whether the rows are samples of a motion."""
        return self.kind in ("ringdown", "forced", "driven")


def uses_sensors(patch: ModelPatch) -> bool:
    """Return whether a patch changes what is read (the clock included)."""
    return any(isinstance(item, SENSORS) for item in patch)


def needs_components(patch: ModelPatch) -> bool:
    """Return whether a patch asks for the strain across the gauges and the shear strain."""
    return any(isinstance(item, SensorRotation) for item in patch)


def clock_of(patch: ModelPatch) -> tuple[float, float]:
    """Return rate [1] and zero [s] of the clock primitives of a patch, added up."""
    clocks = [item for item in patch if isinstance(item, Clock)]
    return sum(item.rate for item in clocks), sum(item.zero for item in clocks)


def check_channels(patch: ModelPatch, channels: Sequence[tuple[str, str]]) -> None:
    """Check that the channels which sensor primitives name exist and are of the right quantity.

    Raises
    ------
    InvalidPatchError
        If one does not; the sentence names it and what there is.
    """
    quantities = dict(channels)
    for item in patch:
        name = getattr(item, "channel", EVERY_CHANNEL)
        if name == EVERY_CHANNEL:
            continue
        if name not in quantities:
            raise InvalidPatchError(
                f"The primitive {item.kind!r} names the channel {name!r}, which does not exist; there are "
                f"{', '.join(quantities)}."
            )
        if isinstance(item, SensorRotation | ThermalStrain) and quantities[name] != STRAIN:
            raise InvalidPatchError(
                f"The primitive {item.kind!r} is for strain gauges, but the channel {name!r} measures "
                f"{quantities[name]}."
            )


def apply_sensors(
    patch: ModelPatch,
    record: SensorRecord,
    values: FloatArray,
    rates: FloatArray | None = None,
    transverse: FloatArray | None = None,
    shear: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray | None]:
    """Return what the channels show and its time derivative.

    Rotations come first, because a gauge sees the strain of the skin before anything is made of it (several
    rotations of one gauge add up); the other primitives follow in the order of the patch. A primitive whose
    channel is not among `record.channels` changes nothing (`check_channels` finds names that exist nowhere).
    High-pass and lines touch dynamic trials only: static and flight rows are settled readings.

    Parameters
    ----------
    patch : ModelPatch
        Other primitives than those of sensors are ignored, the clock too.
    record : SensorRecord
        The record.
    values : (N, C) ndarray
        What perfect sensors show, in the channels' units.
    rates : (N, C) ndarray, optional
        Its time derivative, for dynamic trials.
    transverse, shear : (N, C) ndarray, optional
        Strain across each gauge's direction and engineering shear strain; needed for rotations.

    Raises
    ------
    InvalidPatchError
        If a gauge is turned and the components are missing, or a time constant, an order or a drift's time
        is not positive.
    """
    active = [
        item for item in patch if isinstance(item, SENSORS) and not isinstance(item, Clock | LoggerClock)
    ]
    if not active:
        return values, rates
    values = np.array(values, dtype=np.float64)
    rates = None if rates is None else np.array(rates, dtype=np.float64)
    _rotate(active, record, values, rates, transverse, shear)
    for item in active:
        columns = _columns(item, record)
        if columns.size and not isinstance(item, SensorRotation):
            _apply(item, record, columns, values, rates)
    return values, rates


def _columns(item: Primitive, record: SensorRecord) -> NDArray[np.intp]:
    """Return the columns that a primitive acts on; a named channel is meant whatever its quantity."""
    name = getattr(item, "channel", EVERY_CHANNEL)
    if name != EVERY_CHANNEL:
        chosen = [index for index, (channel, _) in enumerate(record.channels) if channel == name]
    else:
        quantity = (
            STRAIN if isinstance(item, SensorRotation | ThermalStrain) else str(getattr(item, "quantity", ""))
        )
        chosen = [index for index, (_, own) in enumerate(record.channels) if quantity in ("", own)]
    return np.array(chosen, dtype=np.intp)


def _rotate(
    active: Sequence[Primitive],
    record: SensorRecord,
    values: FloatArray,
    rates: FloatArray | None,
    transverse: FloatArray | None,
    shear: FloatArray | None,
) -> None:
    """Turn gauges in place: eps' = eps cos^2 + eps_t sin^2 + gamma sin cos (strain in a plane)."""
    angles = np.zeros(len(record.channels))
    for item in active:
        if isinstance(item, SensorRotation):
            angles[_columns(item, record)] += item.angle
    turned = np.flatnonzero(angles)
    if not turned.size:
        return
    if transverse is None or shear is None:
        raise InvalidPatchError(
            "A gauge is turned, but the model gives no transverse and shear strain to turn it in."
        )
    cosine, sine = np.cos(angles[turned]), np.sin(angles[turned])
    across = transverse[:, turned] * sine**2 + shear[:, turned] * (sine * cosine)
    values[:, turned] = values[:, turned] * cosine**2 + across
    if rates is not None:
        # A response has no rates of the components; a central difference of this small share will do.
        rates[:, turned] = rates[:, turned] * cosine**2 + np.gradient(across, record.time, axis=0)


def _apply(
    item: Primitive,
    record: SensorRecord,
    columns: NDArray[np.intp],
    values: FloatArray,
    rates: FloatArray | None,
) -> None:
    """Apply one primitive to columns in place."""
    added: FloatArray | float = 0.0
    added_rate: FloatArray | float = 0.0
    if isinstance(item, SensorGain):
        values[:, columns] *= 1.0 + item.gain
        if rates is not None:
            rates[:, columns] *= 1.0 + item.gain
        return
    if isinstance(item, HighPass):
        if record.is_dynamic:
            _filter(item, record, columns, values, rates)
        return
    if isinstance(item, SensorDrift):
        added, added_rate = _drift(item, record)
    elif isinstance(item, ThermalStrain):
        added = item.coefficient * record.temperature
    elif isinstance(item, Line) and record.is_dynamic:
        omega = 2.0 * pi * item.frequency
        c, s = np.cos(omega * record.time), np.sin(omega * record.time)
        added = item.cosine * c + item.sine * s
        added_rate = omega * (item.sine * c - item.cosine * s)
    elif isinstance(item, DecayingLine) and record.kind == "ringdown":
        added, added_rate = _decaying_line(item, record)
    elif isinstance(item, RunOffset) and record.kind == "static" and item.run == record.run:
        added = item.offset
    else:
        return
    values[:, columns] += np.reshape(added, (-1, 1))
    if rates is not None:
        rates[:, columns] += np.reshape(added_rate, (-1, 1))


def _drift(item: SensorDrift, record: SensorRecord) -> tuple[FloatArray, FloatArray]:
    if item.time <= 0.0:
        raise InvalidPatchError(f"The time of a sensor's drift must be positive, but is {item.time} s.")
    since = record.time + (record.start if record.is_dynamic else 0.0)
    share = np.maximum(since, 0.0) / item.time
    if item.exponent == 1.0:
        return item.amplitude * share, np.full_like(share, item.amplitude / item.time)
    moving = share > 0.0  # before and at the start there is no drift yet, whatever the exponent
    safe = np.where(moving, share, 1.0)
    value = np.where(moving, item.amplitude * safe**item.exponent, 0.0)
    return value, np.where(moving, item.exponent * value / (safe * item.time), 0.0)


def _decaying_line(item: DecayingLine, record: SensorRecord) -> tuple[FloatArray, FloatArray]:
    omega, zeta = 2.0 * pi * item.frequency, item.damping_ratio
    if not -1.0 < zeta < 1.0:
        raise InvalidPatchError(f"The damping ratio of a decaying line must be below one, but is {zeta}.")
    damped = omega * sqrt(1.0 - zeta**2)
    envelope = record.release * np.exp(-zeta * omega * record.time)
    c, s = np.cos(damped * record.time), np.sin(damped * record.time)
    value = envelope * (item.cosine * c + item.sine * s)
    return value, -zeta * omega * value + envelope * damped * (item.sine * c - item.cosine * s)


# ---------------------------------------------------------------- high-pass


def _filter(
    item: HighPass,
    record: SensorRecord,
    columns: NDArray[np.intp],
    values: FloatArray,
    rates: FloatArray | None,
) -> None:
    signal, slope = values[:, columns], None if rates is None else rates[:, columns]
    time = record.time
    count = max(len(time) - 1, 1)
    interval = float(time[-1] - time[0]) / count
    even = len(time) < 3 or bool(np.max(np.abs(np.diff(time) - interval)) <= 2e-3 * interval)
    if not even:  # on a grid twice as fine as the usual step, and back
        count = int(np.ceil(2.0 * float(time[-1] - time[0]) / float(np.median(np.diff(time)))))
        interval = float(time[-1] - time[0]) / count
        grid = np.linspace(time[0], time[-1], count + 1)
        signal = _at(grid, time, signal)
        slope = None if slope is None else _at(grid, time, slope)
    held = signal[0] if record.kind == "ringdown" else np.zeros(columns.size)
    filtered = high_pass(signal, interval, item.time_constant, item.order, held)
    if rates is not None and slope is not None:
        changed = _filtered_rates(item, interval, signal, filtered, held, slope)
        rates[:, columns] = changed if even else _at(time, grid, changed)
    values[:, columns] = filtered if even else _at(time, grid, filtered)


def _at(times: FloatArray, known: FloatArray, values: FloatArray) -> FloatArray:
    """Return columns (N, C) that are known at some times at others, linear in between."""
    return np.stack([np.interp(times, known, column) for column in values.T], axis=1)


def _filtered_rates(
    item: HighPass,
    interval: float,
    signal: FloatArray,
    filtered: FloatArray,
    held: FloatArray,
    rates: FloatArray,
) -> FloatArray:
    """Return the derivative of the output; each stage obeys y' = x' - y / tau, so whole orders are exact."""
    if item.order not in (1.0, 2.0):
        return high_pass(rates, interval, item.time_constant, item.order, np.zeros(len(held)))
    if item.order == 2.0:
        rates = rates - high_pass(signal, interval, item.time_constant, 1.0, held) / item.time_constant
    return rates - filtered / item.time_constant


def high_pass(
    signal: FloatArray,
    interval: float,
    time_constant: float,
    order: float = 1.0,
    held: FloatArray | float | None = None,
) -> FloatArray:
    """Return the output of (s tau / (1 + s tau))^order for a signal that is linear between its samples.

    The response to a unit step is 1F1(order; 1; -t / tau), whose integral is t 1F1(order; 2; -t / tau): the
    inverse of s^(order - 1) tau^order / (1 + s tau)^order, Abramowitz and Stegun 1964, 13.1.2 termwise. The
    output is the convolution of the signal's increments with it, exact to rounding for every order.

    Parameters
    ----------
    signal : (N, ...) ndarray
        Samples, time along the first axis.
    interval : float
        Of sampling [s].
    time_constant : float
        tau [s].
    order : float
        Number of equal first-order stages, not necessarily whole, from 0 to 4.
    held : (...) ndarray or float, optional
        Value that the signal had held for ever before its first sample; that first sample by default.

    Raises
    ------
    InvalidPatchError
        If interval or time constant are not positive, or the order is not within 0 to 4.
    """
    if not (time_constant > 0.0 and interval > 0.0):
        raise InvalidPatchError(
            f"A high-pass needs a positive time constant and sampling interval, but has {time_constant} s "
            f"and {interval} s."
        )
    if not 0.0 <= order <= 4.0:
        raise InvalidPatchError(f"The order of a high-pass must be within 0 to 4, but is {order}.")
    count = len(signal)
    if count == 0:
        return np.array(signal, dtype=np.float64)
    step, spectrum, length = _kernel(count, interval / time_constant, float(order))
    shape = signal.shape
    rows = np.ascontiguousarray(np.asarray(signal, dtype=np.float64).reshape(count, -1).T)
    increments = np.zeros((len(rows), count))
    np.subtract(rows[:, 1:], rows[:, :-1], out=increments[:, 1:])
    output = np.fft.irfft(np.fft.rfft(increments, length) * spectrum, length)[:, :count].T
    if held is not None:
        jump = rows[:, 0] - np.broadcast_to(held, shape[1:]).reshape(-1)
        if np.any(jump):
            output = output + step[:, np.newaxis] * jump
    return output.reshape(shape)


@lru_cache(maxsize=32)
def _kernel(count: int, ratio: float, order: float) -> tuple[FloatArray, NDArray[np.complex128], int]:
    """Return step response, spectrum of the ramp's kernel and the length of the transform.

    `ratio` is the sampling interval over tau. Entry k of the kernel is what is left, k samples later, of a
    unit increment that was spread over one interval: the mean of the step response over that interval.
    """
    u: FloatArray = ratio * np.arange(count + 1, dtype=np.float64)
    integral = u * _confluent(order, 2, u)
    ramp = np.diff(integral) / ratio
    step = _confluent(order, 1, u[:-1])
    length = 1 << (2 * count - 1).bit_length()
    return step, np.fft.rfft(ramp, length), length


def _confluent(order: float, b: int, u: FloatArray) -> FloatArray:
    """Return 1F1(order; b; -u) for u >= 0, b = 1 or 2.

    Kummer's transformation turns it into e^-u 1F1(b - order; b; u), whose series has terms of one sign (after
    finitely many); far out the asymptotic series takes over (Abramowitz and Stegun 1964, 13.1.27, 13.5.1).
    """
    a = b - order
    if a <= 0.0 and float(a).is_integer():  # whole orders: a polynomial times e^-u
        return np.exp(-u) * _polynomial(int(-a), b, u)
    if order == 1.0:
        return np.where(u > 0.0, -np.expm1(-u) / np.where(u > 0.0, u, 1.0), 1.0)
    near = u <= _SERIES_LIMIT
    result = np.empty_like(u)
    x = u[near]
    term = np.ones_like(x)
    total = np.ones_like(x)
    for k in range(160):
        term = term * ((a + k) / ((b + k) * (k + 1.0))) * x
        total += term
    result[near] = np.exp(-x) * total
    x = u[~near]
    if x.size:
        term = np.ones_like(x)
        total = np.ones_like(x)
        for k in range(24):
            term = term * ((order + k) * (order - b + 1.0 + k) / ((k + 1.0) * x))
            total += term
        result[~near] = gamma(b) / gamma(a) * x**-order * total
    return result


def _polynomial(degree: int, b: int, u: FloatArray) -> FloatArray:
    """Return the terminating series 1F1(-degree; b; u)."""
    term = np.ones_like(u)
    total = np.ones_like(u)
    for k in range(degree):
        term = term * ((k - degree) / ((b + k) * (k + 1.0))) * u
        total = total + term
    return total
