"""Primitive changes of what is read: sensors and clocks.

Standard library and relative imports only: this file is copied into the FMU.
"""

from dataclasses import dataclass
from typing import ClassVar

from .expression import Expression
from .primitive import Primitive

EVERY_CHANNEL = "*"
"""Name that stands for every channel of the primitive's quantity."""
CHANNEL_UNIT = "channel's unit"
PER_RELEASE = f"{CHANNEL_UNIT} per release amplitude"
"""Units of numbers that are shown by a channel."""


def course_of(text: str, kind: str) -> Expression:
    """Return a formula in `time`; raises `InvalidPatchError`."""
    return Expression(text, ("time", "pi"), f"The formula of the primitive {kind!r}")


# `channel` is a channel's name, or `EVERY_CHANNEL` for all of `quantity` ("" for all quantities).


@dataclass(frozen=True, slots=True)
class SensorGain(Primitive):
    """A channel shows (1 + `gain`) times what it should."""

    kind: ClassVar[str] = "sensor_gain"
    in_windows: ClassVar[bool] = True
    units: ClassVar[dict[str, str]] = {"gain": "1"}
    channel: str
    gain: float
    quantity: str = ""


@dataclass(frozen=True, slots=True)
class SensorDrift(Primitive):
    """A channel's zero moves by `amplitude` (t / `time`)^`exponent`, t since the campaign's start [s]."""

    kind: ClassVar[str] = "sensor_drift"
    in_windows: ClassVar[bool] = True
    units: ClassVar[dict[str, str]] = {"amplitude": CHANNEL_UNIT, "time": "s", "exponent": "1"}
    channel: str
    amplitude: float
    time: float
    exponent: float = 1.0
    quantity: str = ""


@dataclass(frozen=True, slots=True)
class ChannelOffset(Primitive):
    """A channel shows `offset` more, a formula in `time` [s] of the trial, in the channel's unit."""

    kind: ClassVar[str] = "channel_offset"
    in_windows: ClassVar[bool] = True
    courses: ClassVar[tuple[str, ...]] = ("offset",)
    channel: str
    offset: str
    quantity: str = ""

    def __post_init__(self) -> None:
        super(ChannelOffset, self).__post_init__()
        course_of(self.offset, self.kind)


@dataclass(frozen=True, slots=True)
class SensorRotation(Primitive):
    """A strain gauge is turned by `angle` [rad] in the skin, from spanwise towards the tip's rear."""

    kind: ClassVar[str] = "sensor_rotation"
    units: ClassVar[dict[str, str]] = {"angle": "rad"}
    channel: str
    angle: float


@dataclass(frozen=True, slots=True)
class ThermalStrain(Primitive):
    """Strain channels show `coefficient` [1/K] times (T - T_ref) more."""

    kind: ClassVar[str] = "thermal_strain"
    in_windows: ClassVar[bool] = True
    units: ClassVar[dict[str, str]] = {"coefficient": "1/K"}
    channel: str
    coefficient: float


@dataclass(frozen=True, slots=True)
class HighPass(Primitive):
    """Channels pass through `order` equal first-order high-pass filters s tau / (1 + s tau), tau [s].

    They had settled at the value before the record's first sample.
    """

    kind: ClassVar[str] = "high_pass"
    units: ClassVar[dict[str, str]] = {"time_constant": "s", "order": "1"}
    channel: str
    time_constant: float
    order: float = 1.0
    quantity: str = ""


@dataclass(frozen=True, slots=True)
class Clock(Primitive):
    """A sample that is stamped t was taken at (1 + `rate`) t + `zero` [s]."""

    kind: ClassVar[str] = "clock"
    units: ClassVar[dict[str, str]] = {"rate": "1", "zero": "s"}
    rate: float
    zero: float


@dataclass(frozen=True, slots=True)
class LoggerClock(Primitive):
    """The clock of a logger: what it stamps t, readings and recorded inputs alike, was at (1 + `rate`) t.

    `logger` is the name of a logger of the campaign, or `EVERY_CHANNEL` where one logger records everything.
    """

    kind: ClassVar[str] = "logger_clock"
    units: ClassVar[dict[str, str]] = {"rate": "1"}
    logger: str
    rate: float


@dataclass(frozen=True, slots=True)
class Line(Primitive):
    """A line at `frequency` [Hz] is added: cosine cos + sine sin (2 pi f t), t since the trial's start.

    Amplitudes in the channel's unit. It is in the noise record too.
    """

    kind: ClassVar[str] = "line"
    in_windows: ClassVar[bool] = True
    units: ClassVar[dict[str, str]] = {"frequency": "Hz", "cosine": CHANNEL_UNIT, "sine": CHANNEL_UNIT}
    channel: str
    frequency: float
    cosine: float
    sine: float
    quantity: str = ""


@dataclass(frozen=True, slots=True)
class DecayingLine(Primitive):
    """A mode that the model does not have, e^(-zeta w t) (cosine cos w_d t + sine sin w_d t), in ring-downs.

    t since the trial's start; amplitudes in the channel's unit per unit of the trial's release amplitude.
    """

    kind: ClassVar[str] = "decaying_line"
    units: ClassVar[dict[str, str]] = {
        "frequency": "Hz", "damping_ratio": "1", "cosine": PER_RELEASE, "sine": PER_RELEASE
    }  # fmt: skip
    channel: str
    frequency: float
    damping_ratio: float
    cosine: float
    sine: float
    quantity: str = ""


@dataclass(frozen=True, slots=True)
class RunOffset(Primitive):
    """Static readings of the trials labelled `run` have this `offset` (channel's unit): seating of a run."""

    kind: ClassVar[str] = "run_offset"
    units: ClassVar[dict[str, str]] = {"offset": CHANNEL_UNIT}
    run: str
    offset: float
    channel: str = EVERY_CHANNEL
    quantity: str = "displacement"
