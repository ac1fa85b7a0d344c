"""Primitive changes of what is read: what sensors and their recorders may be wrong by, and the record.

`fe.runtime.sensors` applies them to a response. NumPy and relative imports only: this file is copied into the
FMU.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt
from typing import Annotated, ClassVar

import numpy as np

from .arrays import FloatArray
from .errors import InvalidPatchError
from .primitive import Primitive, course_of

EVERY_CHANNEL = "*"
"""Name that stands for every channel of the primitive's quantity."""
CHANNEL_UNIT = "channel's unit"
PER_RELEASE = f"{CHANNEL_UNIT} per release amplitude"
"""Units of numbers that are shown by a channel."""

# `channel` is a channel's name, or `EVERY_CHANNEL` for all of `quantity` ("" for all quantities).


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
    start, release : float
        Of a dynamic trial since the campaign's start [s]; amplitude of a ring-down [m or the signal's unit].
    temperature : (N,) ndarray
        Less the reference temperature [K].
    run : str
        Label of the run.
    settled : bool
        Whether it does not begin in an unknown motion.
    """

    channels: Sequence[tuple[str, str]]
    kind: str
    time: FloatArray
    start: float
    temperature: FloatArray
    run: str = ""
    release: float = 1.0
    settled: bool = True

    @property
    def is_dynamic(self) -> bool:
        """Whether the rows are samples of a motion."""
        return self.kind in ("ringdown", "forced", "driven")


class Sensor(Primitive):
    """A primitive that changes what is read, not what happens."""

    of_strain: ClassVar[bool] = False
    """Whether it is for strain gauges alone."""

    def added(self, record: SensorRecord) -> tuple[FloatArray | float, FloatArray | float]:
        """Return what it adds at each sample of a record, and the rate of that."""
        return 0.0, 0.0

    def reading(
        self, record: SensorRecord, values: FloatArray, rates: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return what channels show of values (N, C), and its rates, given the rates (N, C) of the values."""
        added, rate = self.added(record)
        return values + np.reshape(added, (-1, 1)), rates + np.reshape(rate, (-1, 1))


class SensorGain(Sensor):
    """A channel shows (1 + `gain`) times what it should."""

    in_windows: ClassVar[bool] = True
    channel: str
    gain: Annotated[float, "1"]
    quantity: str = ""

    def reading(
        self, record: SensorRecord, values: FloatArray, rates: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return what channels show of values (N, C), and its rates, given the rates (N, C) of the values."""
        return (1.0 + self.gain) * values, (1.0 + self.gain) * rates


class SensorSaturation(Sensor):
    """A channel shows `limit` tanh(x / `limit`) of x: it saturates softly, alike in both directions."""

    in_windows: ClassVar[bool] = True
    channel: str
    limit: Annotated[float, CHANNEL_UNIT]
    quantity: str = ""

    def reading(
        self, record: SensorRecord, values: FloatArray, rates: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return what channels show of values (N, C), and its rates, given the rates (N, C) of the values.

        Raises
        ------
        InvalidPatchError
            If the limit is not positive.
        """
        if self.limit <= 0.0:
            raise InvalidPatchError(
                f"The limit at which a sensor saturates must be positive, but that of the channel "
                f"{self.channel!r} is {self.limit}."
            )
        share = np.tanh(values / self.limit)
        return self.limit * share, (1.0 - share**2) * rates


class SensorDrift(Sensor):
    """A channel's zero moves by `amplitude` (t / `time`)^`exponent`, t since the campaign's start [s]."""

    in_windows: ClassVar[bool] = True
    channel: str
    amplitude: Annotated[float, CHANNEL_UNIT]
    time: Annotated[float, "s"]
    exponent: Annotated[float, "1"] = 1.0
    quantity: str = ""

    def added(self, record: SensorRecord) -> tuple[FloatArray | float, FloatArray | float]:
        """Return what it adds at each sample, and the rate of that."""
        if self.time <= 0.0:
            raise InvalidPatchError(f"The time of a sensor's drift must be positive, but is {self.time} s.")
        since = record.time + (record.start if record.is_dynamic else 0.0)
        share = np.maximum(since, 0.0) / self.time
        if self.exponent == 1.0:
            return self.amplitude * share, np.full_like(share, self.amplitude / self.time)
        moving = share > 0.0  # before and at the start there is no drift yet, whatever the exponent
        safe = np.where(moving, share, 1.0)
        value = np.where(moving, self.amplitude * safe**self.exponent, 0.0)
        return value, np.where(moving, self.exponent * value / (safe * self.time), 0.0)


class ChannelOffset(Sensor):
    """A channel shows `offset` more, a formula in `time` [s] of the trial, in the channel's unit."""

    in_windows: ClassVar[bool] = True
    courses: ClassVar[tuple[str, ...]] = ("offset",)
    channel: str
    offset: str
    quantity: str = ""

    def added(self, record: SensorRecord) -> tuple[FloatArray | float, FloatArray | float]:
        """Return what it adds at each sample, and the rate of that."""
        course = course_of(self.offset, self.kind).course(record.time, {"pi": pi})
        return course, np.gradient(course, record.time) if record.is_dynamic else 0.0


class SensorRotation(Sensor):
    """A strain gauge is turned by `angle` [rad] in the skin, from spanwise towards the tip's rear."""

    of_strain: ClassVar[bool] = True
    channel: str
    angle: Annotated[float, "rad"]


class ThermalStrain(Sensor):
    """Strain channels show `coefficient` [1/K] times (T - T_ref) more."""

    of_strain: ClassVar[bool] = True
    in_windows: ClassVar[bool] = True
    channel: str
    coefficient: Annotated[float, "1/K"]

    def added(self, record: SensorRecord) -> tuple[FloatArray | float, FloatArray | float]:
        """Return what it adds at each sample, and the rate of that."""
        return self.coefficient * record.temperature, 0.0


class HighPass(Sensor):
    """Channels pass through `order` equal first-order high-pass filters s tau / (1 + s tau), tau [s]."""

    channel: str
    time_constant: Annotated[float, "s"]
    order: Annotated[float, "1"] = 1.0
    quantity: str = ""


class SensorLag(Sensor):
    """A channel shows what it should have shown `lag` [s] before: a filter's or a logger's delay.

    A lag below zero says that the recorded force is late instead.
    """

    channel: str
    lag: Annotated[float, "s"]
    quantity: str = ""

    def reading(
        self, record: SensorRecord, values: FloatArray, rates: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return what channels show of values (N, C), and its rates, given the rates (N, C) of the values.

        Between samples the values follow a cubic through values and rates (Hermite). Before the first
        sample they stood still, if the record is settled, and else went on with their first rate. A
        ring-down has no force that its readings could follow late: its time zero is an unknown anyway.
        """
        if record.kind not in ("forced", "driven") or len(record.time) == 1:
            return values, rates
        earlier = record.time - self.lag
        last_interval = len(record.time) - 2
        interval = np.clip(np.searchsorted(record.time, earlier, side="right") - 1, 0, last_interval)
        begin = record.time[interval][:, np.newaxis]
        length = record.time[interval + 1][:, np.newaxis] - begin
        s = (earlier[:, np.newaxis] - begin) / length
        value, next_value = values[interval], values[interval + 1]
        rate, next_rate = rates[interval], rates[interval + 1]
        # cubic Hermite polynomial over the interval, and its derivative
        shown = (1.0 + 2.0 * s) * (1.0 - s) ** 2 * value + s**2 * (3.0 - 2.0 * s) * next_value
        shown += length * s * (1.0 - s) * ((1.0 - s) * rate - s * next_rate)
        shown_rate = 6.0 * s * (1.0 - s) * (next_value - value) / length
        shown_rate += (1.0 - s) * (1.0 - 3.0 * s) * rate + s * (3.0 * s - 2.0) * next_rate
        # beyond the record
        first_rate = np.zeros_like(rates[:1]) if record.settled else rates[:1]
        before = earlier < record.time[0]
        shown[before] = values[:1] + first_rate * (earlier[before, np.newaxis] - record.time[0])
        shown_rate[before] = first_rate
        after = earlier > record.time[-1]
        shown[after] = values[-1:] + rates[-1:] * (earlier[after, np.newaxis] - record.time[-1])
        shown_rate[after] = rates[-1:]
        return shown, shown_rate


class Clock(Sensor):
    """A sample stamped t was taken at (1 + `rate`) t + `zero` [s], t since the record's first stamp."""

    rate: Annotated[float, "1"]
    zero: Annotated[float, "s"]


class LoggerClock(Sensor):
    """The clock of a logger: what it stamps t, readings and recorded inputs alike, was at (1 + `rate`) t.

    t counts from the record's first stamp.
    `logger` is the name of a logger of the campaign, or `EVERY_CHANNEL` where one logger records everything.
    """

    logger: str
    rate: Annotated[float, "1"]


class Line(Sensor):
    """A line at `frequency` [Hz] is added: cosine cos + sine sin (2 pi f t), t since the trial's start.

    Amplitudes in the channel's unit. It is in the noise record too.
    """

    in_windows: ClassVar[bool] = True
    channel: str
    frequency: Annotated[float, "Hz"]
    cosine: Annotated[float, CHANNEL_UNIT]
    sine: Annotated[float, CHANNEL_UNIT]
    quantity: str = ""

    def added(self, record: SensorRecord) -> tuple[FloatArray | float, FloatArray | float]:
        """Return what it adds at each sample, and the rate of that."""
        if not record.is_dynamic:
            return 0.0, 0.0
        omega = 2.0 * pi * self.frequency
        c, s = np.cos(omega * record.time), np.sin(omega * record.time)
        return self.cosine * c + self.sine * s, omega * (self.sine * c - self.cosine * s)


class DecayingLine(Sensor):
    """A mode that the model does not have, e^(-zeta w t) (cosine cos w_d t + sine sin w_d t), in ring-downs.

    t since the trial's start; amplitudes in the channel's unit per unit of the trial's release amplitude.
    """

    channel: str
    frequency: Annotated[float, "Hz"]
    damping_ratio: Annotated[float, "1"]
    cosine: Annotated[float, PER_RELEASE]
    sine: Annotated[float, PER_RELEASE]
    quantity: str = ""

    def added(self, record: SensorRecord) -> tuple[FloatArray | float, FloatArray | float]:
        """Return what it adds at each sample, and the rate of that."""
        if record.kind != "ringdown":
            return 0.0, 0.0
        omega, zeta = 2.0 * pi * self.frequency, self.damping_ratio
        if not -1.0 < zeta < 1.0:
            raise InvalidPatchError(f"The damping ratio of a decaying line must be below one, but is {zeta}.")
        damped = omega * sqrt(1.0 - zeta**2)
        envelope = record.release * np.exp(-zeta * omega * record.time)
        c, s = np.cos(damped * record.time), np.sin(damped * record.time)
        value = envelope * (self.cosine * c + self.sine * s)
        return value, -zeta * omega * value + envelope * damped * (self.sine * c - self.cosine * s)


class RunOffset(Sensor):
    """Static readings of the trials labelled `run` have this `offset` (channel's unit): seating of a run."""

    run: str
    offset: Annotated[float, CHANNEL_UNIT]
    channel: str = EVERY_CHANNEL
    quantity: str = "displacement"

    def added(self, record: SensorRecord) -> tuple[FloatArray | float, FloatArray | float]:
        """Return what it adds at each sample, and the rate of that."""
        return self.offset if record.kind == "static" and record.run == self.run else 0.0, 0.0
