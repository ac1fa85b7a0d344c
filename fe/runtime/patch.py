"""Primitive changes of a model: what a missing effect is made of, and the patch that carries them.

A patch is plain data. The reduced model, the full model, the FMU and the twin understand the same
primitives; which physical effect a set of them stands for is not known here (`discrepancy.catalogue` knows).

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from math import pi, sqrt
from typing import Annotated, Any, ClassVar

import numpy as np

from .arrays import FloatArray
from .errors import InvalidPatchError
from .laws import LAWS
from .laws.interface import PortForce as PortForce
from .laws.position import BoucWen as BoucWen
from .laws.position import FreePlay as FreePlay
from .laws.position import MicroSlip as MicroSlip
from .laws.position import PowerStiffness as PowerStiffness
from .laws.position import SineForce as SineForce
from .laws.speed import Overflow as Overflow
from .laws.speed import PowerDamping as PowerDamping
from .primitive import Primitive as Primitive
from .primitive import Window as Window
from .primitive import course_of as course_of

EVERY_CHANNEL = "*"
"""Name that stands for every channel of the primitive's quantity."""
CHANNEL_UNIT = "channel's unit"
PER_RELEASE = f"{CHANNEL_UNIT} per release amplitude"
"""Units of numbers that are shown by a channel."""


# ---------------------------------------------------------------- mass and stiffness


class PointMass(Primitive):
    """A mass [kg] on the elastic line at `station` [m] from the root (lumped model: at a named place)."""

    mass: Annotated[float, "kg"]
    station: Annotated[float, "m"]


class RootCompliance(Primitive):
    """A rotational spring in series with the root: `compliance` [rad/(N m)] about the flapping axis."""

    compliance: Annotated[float, "rad/(N m)"]


class LocalStiffnessLoss(Primitive):
    """The skin between `start` and `start + length` [m] from the root keeps 1 - `loss` of its stiffness."""

    loss: Annotated[float, "1"]
    start: Annotated[float, "m"]
    length: Annotated[float, "m"]


class ModulusTemperature(Primitive):
    """Young's modulus falls with temperature: E (1 - `coefficient` (T - T_ref)), `coefficient` [1/K]."""

    coefficient: Annotated[float, "1/K"]


class StiffnessDrift(Primitive):
    """The whole stiffness changes with time within a record: K (1 + `rate` t), `rate` [1/s]."""

    rate: Annotated[float, "1/s"]


# ---------------------------------------------------------------- internal forces
# The laws of `fe.runtime.laws` act against the motion x of a port (displacement [m] or rotation [rad]): -F on
# x, F in N or N m. Ports of the wing: "root" (flapping rotation of the root), "tip" (upward displacement of
# the tip's load point), "span" (upward displacement of all stations, weighted by the share of planform area;
# the weights sum to one), "planform" (the law acts at every place on the place's own upward displacement,
# with a force by the place's share of the area: `motion.PLANFORM`). A lumped model declares its own.


# ---------------------------------------------------------------- loads


class LoadPlace(Primitive):
    """Applied forces act `along_span` [m] further outboard, `along_chord` [m] further aft than recorded."""

    along_span: Annotated[float, "m"]
    along_chord: Annotated[float, "m"]


class LoadGain(Primitive):
    """The force that acts is (1 + `gain`) times the recorded one plus `tare` [N], while one is applied."""

    gain: Annotated[float, "1"]
    tare: Annotated[float, "N"]


class Washout(Primitive):
    """Lift in flight is l (1 - `coefficient` n eta^`exponent`), eta = y / semi-span, n the load factor."""

    coefficient: Annotated[float, "1"]
    exponent: Annotated[float, "1"]


class InertiaRelief(Primitive):
    """In flight the structure's weight times n relieves the lift by this `fraction` more than modelled."""

    fraction: Annotated[float, "1"]


class PortLoad(Primitive):
    """A force [N or N m] that pushes a port along its motion, a formula in `time` [s] of the trial."""

    in_windows: ClassVar[bool] = True
    courses: ClassVar[tuple[str, ...]] = ("force",)
    port: str
    force: str


# ---------------------------------------------------------------- what is read
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


class SensorGain(Sensor):
    """A channel shows (1 + `gain`) times what it should."""

    in_windows: ClassVar[bool] = True
    channel: str
    gain: Annotated[float, "1"]
    quantity: str = ""


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


STRUCTURE = (PointMass, RootCompliance, LocalStiffnessLoss, ModulusTemperature)
"""Primitives that change the linear structure: it is solved anew."""
INTERNAL_FORCES = (*LAWS, StiffnessDrift)
"""Primitives that act as forces inside the structure while it moves."""
LOADS = (LoadPlace, LoadGain, Washout, InertiaRelief)
"""Primitives that change the loads that are known."""
SENSORS = (
    SensorGain, SensorDrift, ChannelOffset, SensorRotation, ThermalStrain, HighPass, Clock, LoggerClock, Line,
    DecayingLine, RunOffset,
)  # fmt: skip
"""Primitives that change what is read, not what happens."""
_EVERY: tuple[type[Primitive], ...] = (*STRUCTURE, StiffnessDrift, *LAWS, *LOADS, PortLoad, *SENSORS)
PRIMITIVES = {primitive.kind: primitive for primitive in _EVERY}
"""Every primitive by its kind."""


@dataclass(frozen=True)
class ModelPatch:
    """A set of primitive changes; the empty patch is the model as it was.

    Attributes
    ----------
    primitives : tuple of Primitive
        The changes, applied together; sensors in the order given.
    """

    primitives: tuple[Primitive, ...] = ()

    def __iter__(self) -> Iterator[Primitive]:
        return iter(self.primitives)

    def __len__(self) -> int:
        return len(self.primitives)

    def __add__(self, other: "ModelPatch") -> "ModelPatch":
        return ModelPatch(self.primitives + other.primitives)

    def in_trial(self, trial: str) -> "ModelPatch":
        """Return what acts in a trial: no windows of other trials, and none of what acts throughout."""
        if not self.has_windows:
            return self
        found = []
        for item in self.primitives:
            own = tuple(window for window in item.windows if window.trial == trial)
            if own or not item.windows:
                open_ended = any(window.begin is None and window.end is None for window in own)
                found.append(replace(item, windows=() if open_ended else own))
        return ModelPatch(tuple(found))

    @property
    def has_windows(self) -> bool:
        """Whether a primitive acts in windows only."""
        return any(item.windows for item in self.primitives)

    def of(self, *kinds: type[Primitive]) -> "ModelPatch":
        """Return the part whose primitives are of the given classes."""
        return ModelPatch(tuple(item for item in self.primitives if isinstance(item, kinds)))

    def without(self, *kinds: type[Primitive]) -> "ModelPatch":
        """Return the part whose primitives are of other classes."""
        return ModelPatch(tuple(item for item in self.primitives if not isinstance(item, kinds)))

    def to_list(self) -> list[dict[str, Any]]:
        """Return the primitives as plain data; `from_list` gives the patch back, equal to the last bit."""
        return [primitive.to_mapping() for primitive in self.primitives]

    @classmethod
    def from_list(cls, rows: object, where: str = "The patch") -> "ModelPatch":
        """Return the patch that `to_list` wrote.

        Parameters
        ----------
        rows : list of mapping
            Kind and values of each primitive.
        where : str
            What is being read, for the error message.

        Raises
        ------
        InvalidPatchError
            If a kind is unknown, a value is missing, superfluous, of the wrong type or not finite.
        """
        if not isinstance(rows, list):
            raise InvalidPatchError(f"{where} must be a list of primitives, but is a {type(rows).__name__}.")
        return cls(tuple(_primitive(row, f"{where}, primitive {n}") for n, row in enumerate(rows, start=1)))


_ACCEPTED: dict[type, tuple[type, ...]] = {float: (float, int), int: (int,), str: (str,)}
_WINDOW = {"trial": str, "begin": float, "end": float}


def _values(row: Mapping[Any, Any], types: Mapping[str, Any], needed: Iterable[str], where: str) -> Any:
    """Return the values of a row of a file by name, each of its type."""
    for name, value in row.items():
        if name not in types:
            raise InvalidPatchError(f"{where} has no value {name!r}; it has {', '.join(types)}.")
        if isinstance(value, bool) or not isinstance(value, _ACCEPTED[types[name]]):
            wanted = "text" if types[name] is str else "a number"
            raise InvalidPatchError(f"{where}: {name} must be {wanted}, but is {value!r}.")
    missing = [name for name in needed if name not in row]
    if missing:
        raise InvalidPatchError(f"{where} lacks {', '.join(missing)}.")
    return {name: types[name](value) for name, value in row.items()}


def _primitive(row: object, where: str) -> Primitive:
    kind = row.get("kind") if isinstance(row, Mapping) else row
    if not isinstance(row, Mapping) or not isinstance(kind, str) or kind not in PRIMITIVES:
        raise InvalidPatchError(f"{where} has the kind {kind!r}, but known are {', '.join(PRIMITIVES)}.")
    primitive, windows = PRIMITIVES[kind], row.get("windows", ())
    if not isinstance(windows, list | tuple) or not all(isinstance(window, Mapping) for window in windows):
        raise InvalidPatchError(f"{where}: windows must be a list of tables, but is {windows!r}.")
    types, own = primitive.values(), {name: row[name] for name in row if name not in ("kind", "windows")}
    needed = [item.name for item in fields(primitive) if item.default is MISSING]
    spans = ({name: value for name, value in window.items() if value is not None} for window in windows)
    return primitive(
        **_values(own, types, needed, where),
        windows=tuple(Window(**_values(span, _WINDOW, ["trial"], f"{where}, a window")) for span in spans),
    )
