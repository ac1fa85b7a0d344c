"""Faults of sensors and recorders, and the record on which they act.

`fe.runtime.sensors` applies them to a response. NumPy and relative imports only: this file is
copied into the FMU.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi, sqrt
from typing import Annotated, ClassVar, NamedTuple

import numpy as np

from .arrays import FloatArray
from .errors import InvalidPatchError
from .primitive import Primitive, time_formula

EVERY_CHANNEL = "*"
"""Name that stands for every channel of the primitive's quantity."""
CHANNEL_UNIT = "channel's unit"
"""Stands for the unit of the channel that the primitive acts on."""
PER_RELEASE = f"{CHANNEL_UNIT} per release amplitude"
"""Unit of amplitudes that are relative to the amplitude of a ring-down."""

# `channel` is a channel's name, or `EVERY_CHANNEL` for all channels of `quantity` ("": any
# quantity).


@dataclass(frozen=True)
class SensorRecord:
    """The record of a trial that sensors read.

    Attributes
    ----------
    channels : sequence of (str, str)
        Name and quantity of each of the C columns.
    kind : str
        "static", "flight", "ringdown", "forced" or "driven".
    time : (N,) array
        Times of the rows [s]: since the trial's start in a dynamic trial, since the campaign's
        start in a static trial or a flight.
    start : float
        Start of a dynamic trial since the campaign's start [s].
    temperature : (N,) array
        Temperature minus the reference temperature [K].
    run : str
        Label of the run.
    release : float
        Amplitude of a ring-down [m, or the unit of the signal].
    settled : bool
        Whether the structure was at rest at the beginning, not in an unknown motion.
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


class SensorError(NamedTuple):
    """What a sensor adds to its readings, and its time derivative; (N,) arrays or numbers."""

    value: FloatArray | float
    rate: FloatArray | float


NO_ERROR = SensorError(0.0, 0.0)
"""The error of a sensor that adds nothing."""


class Sensor(Primitive):
    """A primitive that changes the readings of channels, but not the motion of the structure.

    A subclass either adds something to its channels (it defines `error`), or changes their
    readings in another way (it defines `readings`).
    """

    strain_only: ClassVar[bool] = False
    """Whether the primitive is for strain gauges alone."""

    def error(self, record: SensorRecord) -> SensorError:
        """Return the error that the sensor adds to each sample of a record."""
        return NO_ERROR

    def readings(
        self, record: SensorRecord, values: FloatArray, rates: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Add the fault to readings.

        Parameters
        ----------
        values : (N, C) array
            The readings without the fault, in the units of the channels.
        rates : (N, C) array
            The time derivatives of the readings.

        Returns
        -------
        values, rates : (N, C) array
            The readings with the fault, and their time derivatives.
        """
        error = self.error(record)
        return values + np.reshape(error.value, (-1, 1)), rates + np.reshape(error.rate, (-1, 1))


class SensorGain(Sensor):
    """A channel shows (1 + `gain`) times what it should."""

    can_act_in_windows: ClassVar[bool] = True
    channel: str
    """Name of the channel, or "*" for all channels of `quantity`."""
    gain: Annotated[float, "1"]
    """Relative error of the gain."""
    quantity: str = ""
    """Quantity of the channels if `channel` is "*"; empty for all quantities."""

    def readings(
        self, record: SensorRecord, values: FloatArray, rates: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the readings (N, C) times the gain, and their rates; see `Sensor.readings`."""
        return (1.0 + self.gain) * values, (1.0 + self.gain) * rates


class SensorSaturation(Sensor):
    """A channel shows `limit` tanh(x / `limit`) of x: it saturates softly in both directions."""

    can_act_in_windows: ClassVar[bool] = True
    channel: str
    """Name of the channel, or "*" for all channels of `quantity`."""
    limit: Annotated[float, CHANNEL_UNIT]
    """Largest reading."""
    quantity: str = ""
    """Quantity of the channels if `channel` is "*"; empty for all quantities."""

    def readings(
        self, record: SensorRecord, values: FloatArray, rates: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the saturated readings (N, C), and their rates; see `Sensor.readings`.

        Raises
        ------
        InvalidPatchError
            If the limit is not positive.
        """
        if self.limit <= 0.0:
            raise InvalidPatchError(
                "The limit at which a sensor saturates must be positive, but that of the channel "
                f"{self.channel!r} is {self.limit}."
            )
        saturation = np.tanh(values / self.limit)
        return self.limit * saturation, (1.0 - saturation**2) * rates


class SensorDrift(Sensor):
    """A channel's zero moves by `amplitude` (t / `time`)^`exponent`, t the campaign's time."""

    can_act_in_windows: ClassVar[bool] = True
    channel: str
    """Name of the channel, or "*" for all channels of `quantity`."""
    amplitude: Annotated[float, CHANNEL_UNIT]
    """Change of the zero after `time`."""
    time: Annotated[float, "s"]
    """Time in which the zero moves by `amplitude`."""
    exponent: Annotated[float, "1"] = 1.0
    """Exponent of the course of the zero over time."""
    quantity: str = ""
    """Quantity of the channels if `channel` is "*"; empty for all quantities."""

    def error(self, record: SensorRecord) -> SensorError:
        """Return the drift of the zero, amplitude (t / time)^exponent, at each sample.

        The time t runs from the begin of the campaign.

        Raises
        ------
        InvalidPatchError
            If the time of the drift is not positive.
        """
        if self.time <= 0.0:
            raise InvalidPatchError(
                f"The time of a sensor's drift must be positive, but is {self.time} s."
            )
        campaign_time = record.time + (record.start if record.is_dynamic else 0.0)
        ratio = np.maximum(campaign_time, 0.0) / self.time
        if self.exponent == 1.0:
            return SensorError(
                self.amplitude * ratio, np.full_like(ratio, self.amplitude / self.time)
            )
        # no drift at and before the start, where 0^exponent may be 1 or infinite
        drifting = ratio > 0.0
        safe_ratio = np.where(drifting, ratio, 1.0)
        value = np.where(drifting, self.amplitude * safe_ratio**self.exponent, 0.0)
        rate = np.where(drifting, self.exponent * value / (safe_ratio * self.time), 0.0)
        return SensorError(value, rate)


class ChannelOffset(Sensor):
    """A channel shows `offset` more, a formula in the trial's `time` [s]."""

    can_act_in_windows: ClassVar[bool] = True
    formula_fields: ClassVar[tuple[str, ...]] = ("offset",)
    channel: str
    """Name of the channel, or "*" for all channels of `quantity`."""
    offset: str
    """Added reading, as a formula in the `time` of the trial."""
    quantity: str = ""
    """Quantity of the channels if `channel` is "*"; empty for all quantities."""

    def error(self, record: SensorRecord) -> SensorError:
        """Return the offset at each sample; its rate is a difference quotient."""
        offset = time_formula(self.offset, self.kind).values_over_time(record.time, {"pi": pi})
        rate = np.gradient(offset, record.time) if record.is_dynamic else 0.0
        return SensorError(offset, rate)


class SensorRotation(Sensor):
    """A strain gauge is turned by `angle` [rad] in the skin, from spanwise towards the tip's rear.

    `fe.runtime.sensors` turns the gauge, because a turned gauge needs strain components that are
    not among the readings.
    """

    strain_only: ClassVar[bool] = True
    channel: str
    """Name of the channel, or "*" for all channels of `quantity`."""
    angle: Annotated[float, "rad"]
    """Angle by which the gauge is turned."""


class ThermalStrain(Sensor):
    """Strain channels show `coefficient` [1/K] times (T - T_ref) more."""

    strain_only: ClassVar[bool] = True
    can_act_in_windows: ClassVar[bool] = True
    channel: str
    """Name of the channel, or "*" for all channels of `quantity`."""
    coefficient: Annotated[float, "1/K"]
    """Apparent strain for each kelvin."""

    def error(self, record: SensorRecord) -> SensorError:
        """Return the thermal strain at each sample; the temperature changes slowly."""
        return SensorError(self.coefficient * record.temperature, 0.0)


class HighPass(Sensor):
    """Channels pass `order` equal high-pass filters s tau / (1 + s tau), tau the `time_constant`.

    The caller of `fe.runtime.sensors.apply_sensors` supplies the filter.
    """

    channel: str
    """Name of the channel, or "*" for all channels of `quantity`."""
    time_constant: Annotated[float, "s"]
    """Time constant of the filter."""
    order: Annotated[float, "1"] = 1.0
    """Order of the filter."""
    quantity: str = ""
    """Quantity of the channels if `channel` is "*"; empty for all quantities."""


class LowPass(Sensor):
    """Channels respond with a delay of first order, 1 / (1 + s tau), tau the `time_constant`.

    Examples are a thermometer in its housing and an anti-aliasing filter. The caller of
    `fe.runtime.sensors.apply_sensors` supplies the filter.
    """

    order: ClassVar[float] = 1.0
    channel: str
    """Name of the channel, or "*" for all channels of `quantity`."""
    time_constant: Annotated[float, "s"]
    """Time in which a reading follows a step to 63 %."""
    quantity: str = ""
    """Quantity of the channels if `channel` is "*"; empty for all quantities."""


Filter = HighPass | LowPass
"""The sensors that filter: each is computed from its high-pass, see `apply_sensors`."""


class SensorLag(Sensor):
    """A channel shows each value `lag` [s] too late, because of a filter or a logger.

    A negative lag means that the recorded force is late. A ring-down has no recorded force that a
    reading could lag behind, so a lag changes only forced and driven trials.
    """

    channel: str
    """Name of the channel, or "*" for all channels of `quantity`."""
    lag: Annotated[float, "s"]
    """Time by which the reading is late."""
    quantity: str = ""
    """Quantity of the channels if `channel` is "*"; empty for all quantities."""

    def readings(
        self, record: SensorRecord, values: FloatArray, rates: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Delay readings (N, C) and their rates by `lag`.

        Outside the record, the readings are extrapolated linearly. Before the first sample the rate
        is zero if the structure was at rest at the beginning (`record.settled`), else the rate at
        the first sample; after the last sample it is the rate at the last one.
        """
        # only forced and driven trials have a recorded input that a reading can lag behind; a
        # single sample has no interval to interpolate in
        if record.kind not in ("forced", "driven") or len(record.time) == 1:
            return values, rates
        delayed_time = record.time - self.lag
        delayed_values, delayed_rates = interpolated_by_cubics(
            record.time, values, rates, delayed_time
        )
        # linear extrapolation before the first and after the last sample
        first_rate = np.zeros_like(rates[0]) if record.settled else rates[0]
        is_before_record = delayed_time < record.time[0]
        delayed_values[is_before_record] = values[0] + np.outer(
            delayed_time[is_before_record] - record.time[0], first_rate
        )
        delayed_rates[is_before_record] = first_rate
        is_after_record = delayed_time > record.time[-1]
        delayed_values[is_after_record] = values[-1] + np.outer(
            delayed_time[is_after_record] - record.time[-1], rates[-1]
        )
        delayed_rates[is_after_record] = rates[-1]
        return delayed_values, delayed_rates


def interpolated_by_cubics(
    time: FloatArray, values: FloatArray, rates: FloatArray, new_time: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Interpolate signals and their time derivatives by cubic Hermite polynomials.

    Parameters
    ----------
    time : (N,) array
        Increasing times [s], at least two.
    values, rates : (N, C) array
        C signals at these times, and their time derivatives.
    new_time : (M,) array
        The times to interpolate at [s]. Outside the samples, the first or last cubic is continued.

    Returns
    -------
    values, rates : (M, C) array
        The signals and their time derivatives at `new_time`.
    """
    # the interval of each new time, and the fraction s of the interval before the time
    last_interval = len(time) - 2
    samples_before = np.searchsorted(time, new_time, side="right")
    interval = np.clip(samples_before - 1, 0, last_interval)
    next_sample = interval + 1
    begin_time = time[interval]
    length = (time[next_sample] - begin_time)[:, np.newaxis]
    s = (new_time - begin_time)[:, np.newaxis] / length
    remaining = 1.0 - s
    begin = values[interval]
    end = values[next_sample]
    begin_rate = rates[interval]
    end_rate = rates[next_sample]
    # The Hermite basis is (1 + 2 s) (1 - s)^2 and s^2 (3 - 2 s) for the values, and s (1 - s)^2
    # and -s^2 (1 - s) times the length for the rates.
    weight_of_begin = (1.0 + 2.0 * s) * remaining**2
    weight_of_end = s**2 * (3.0 - 2.0 * s)
    interpolated = weight_of_begin * begin + weight_of_end * end
    weighted_rates = remaining * begin_rate - s * end_rate
    interpolated += length * s * remaining * weighted_rates
    # The time derivative of the basis is that in s, divided by the length: +-6 s (1 - s) / length
    # for the values, and (1 - s) (1 - 3 s) and s (3 s - 2) for the rates.
    interpolated_rates = 6.0 * s * remaining * (end - begin) / length
    weight_of_begin_rate = remaining * (1.0 - 3.0 * s)
    weight_of_end_rate = s * (3.0 * s - 2.0)
    interpolated_rates += weight_of_begin_rate * begin_rate + weight_of_end_rate * end_rate
    return interpolated, interpolated_rates


class Clock(Sensor):
    """A sample with the time stamp t was taken at (1 + `rate`) t + `zero` [s].

    t counts from the first stamp.
    """

    rate: Annotated[float, "1"]
    """Relative error of the rate of the clock."""
    zero: Annotated[float, "s"]
    """Error of the first time stamp."""


class LoggerClock(Sensor):
    """A logger's clock runs wrong: the event with time stamp t happened at (1 + `rate`) t.

    That holds for readings and for recorded inputs; t is counted from the record's first stamp.
    `logger` is the name of a logger of the campaign, or `EVERY_CHANNEL` where one logger records
    everything.
    """

    logger: str
    """Name of the logger, or "*" for all."""
    rate: Annotated[float, "1"]
    """Relative error of the rate of the clock."""


class Line(Sensor):
    """A spectral line is added: cosine cos(2 pi f t) + sine sin(2 pi f t), f the `frequency` [Hz].

    t is the time since the trial's start; amplitudes are in the channel's unit. The line also
    appears in the noise record.
    """

    can_act_in_windows: ClassVar[bool] = True
    channel: str
    """Name of the channel, or "*" for all channels of `quantity`."""
    frequency: Annotated[float, "Hz"]
    """Frequency."""
    cosine: Annotated[float, CHANNEL_UNIT]
    """Amplitude of the cosine."""
    sine: Annotated[float, CHANNEL_UNIT]
    """Amplitude of the sine."""
    quantity: str = ""
    """Quantity of the channels if `channel` is "*"; empty for all quantities."""

    def error(self, record: SensorRecord) -> SensorError:
        """Return the line at each sample of a dynamic record."""
        if not record.is_dynamic:
            return NO_ERROR
        omega = 2.0 * pi * self.frequency
        cos = np.cos(omega * record.time)
        sin = np.sin(omega * record.time)
        return SensorError(
            value=self.cosine * cos + self.sine * sin,
            rate=omega * (self.sine * cos - self.cosine * sin),
        )


class DecayingLine(Sensor):
    """A decaying oscillation is added in ring-downs, as of a mode that the model lacks.

    It is e^(-zeta w t) (cosine cos w_d t + sine sin w_d t), t the time since the trial's start,
    w = 2 pi `frequency`, zeta the `damping_ratio`, w_d the damped angular frequency. Amplitudes are
    in the channel's unit per unit of the trial's release amplitude.
    """

    channel: str
    """Name of the channel, or "*" for all channels of `quantity`."""
    frequency: Annotated[float, "Hz"]
    """Frequency."""
    damping_ratio: Annotated[float, "1"]
    """Fraction of critical damping."""
    cosine: Annotated[float, PER_RELEASE]
    """Amplitude of the cosine."""
    sine: Annotated[float, PER_RELEASE]
    """Amplitude of the sine."""
    quantity: str = ""
    """Quantity of the channels if `channel` is "*"; empty for all quantities."""

    def error(self, record: SensorRecord) -> SensorError:
        """Return the oscillation at each sample of a ring-down.

        Raises
        ------
        InvalidPatchError
            If the damping ratio does not lie between -1 and 1.
        """
        if record.kind != "ringdown":
            return NO_ERROR
        omega = 2.0 * pi * self.frequency
        zeta = self.damping_ratio
        if not -1.0 < zeta < 1.0:
            raise InvalidPatchError(
                f"The damping ratio of a decaying line must be below one, but is {zeta}."
            )
        damped_omega = omega * sqrt(1.0 - zeta**2)
        envelope = record.release * np.exp(-zeta * omega * record.time)
        cos = np.cos(damped_omega * record.time)
        sin = np.sin(damped_omega * record.time)
        value = envelope * (self.cosine * cos + self.sine * sin)
        # derivative at a constant envelope; the decay of the envelope adds -zeta omega value
        quadrature = envelope * damped_omega * (self.sine * cos - self.cosine * sin)
        return SensorError(value, -zeta * omega * value + quadrature)


class RunOffset(Sensor):
    """Static readings of the trials labelled `run` have this `offset`: the seating of a run."""

    run: str
    """Label of the run."""
    offset: Annotated[float, CHANNEL_UNIT]
    """Added reading."""
    channel: str = EVERY_CHANNEL
    """Name of the channel, or "*" for all channels of `quantity`."""
    quantity: str = "displacement"
    """Quantity of the channels if `channel` is "*"; empty for all quantities."""

    def error(self, record: SensorRecord) -> SensorError:
        """Return the offset in static trials of the run."""
        if record.kind == "static" and record.run == self.run:
            return SensorError(self.offset, 0.0)
        return NO_ERROR
