"""Primitive changes of a model: what a missing effect is made of, and the patch that carries them.

A patch is plain data. The reduced model, the full model, the FMU and the twin understand the same
primitives; which physical effect a set of them stands for is not known here (`discrepancy.catalogue` knows).

NumPy and relative imports only: this file is copied into the FMU.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from .errors import InvalidPatchError
from .laws import LAWS
from .laws.bouc_wen import BoucWen as BoucWen
from .laws.free_play import FreePlay as FreePlay
from .laws.interface import PortForce as PortForce
from .laws.micro_slip import MicroSlip as MicroSlip
from .laws.overflow import Overflow as Overflow
from .laws.power_damping import PowerDamping as PowerDamping
from .laws.power_stiffness import PowerStiffness as PowerStiffness
from .laws.sine_force import SineForce as SineForce
from .primitive import Primitive as Primitive
from .primitive import Window as Window
from .sensor_primitives import CHANNEL_UNIT as CHANNEL_UNIT
from .sensor_primitives import EVERY_CHANNEL as EVERY_CHANNEL
from .sensor_primitives import PER_RELEASE as PER_RELEASE
from .sensor_primitives import ChannelOffset as ChannelOffset
from .sensor_primitives import Clock as Clock
from .sensor_primitives import DecayingLine as DecayingLine
from .sensor_primitives import HighPass as HighPass
from .sensor_primitives import Line as Line
from .sensor_primitives import LoggerClock as LoggerClock
from .sensor_primitives import RunOffset as RunOffset
from .sensor_primitives import SensorDrift as SensorDrift
from .sensor_primitives import SensorGain as SensorGain
from .sensor_primitives import SensorRotation as SensorRotation
from .sensor_primitives import ThermalStrain as ThermalStrain
from .sensor_primitives import course_of as course_of

# ---------------------------------------------------------------- mass and stiffness


@dataclass(frozen=True, slots=True)
class PointMass(Primitive):
    """A mass [kg] on the elastic line at `station` [m] from the root (lumped model: at a named place)."""

    kind: ClassVar[str] = "point_mass"
    units: ClassVar[dict[str, str]] = {"mass": "kg", "station": "m"}
    mass: float
    station: float


@dataclass(frozen=True, slots=True)
class RootCompliance(Primitive):
    """A rotational spring in series with the root: `compliance` [rad/(N m)] about the flapping axis."""

    kind: ClassVar[str] = "root_compliance"
    units: ClassVar[dict[str, str]] = {"compliance": "rad/(N m)"}
    compliance: float


@dataclass(frozen=True, slots=True)
class LocalStiffnessLoss(Primitive):
    """The skin between `start` and `start + length` [m] from the root keeps 1 - `loss` of its stiffness."""

    kind: ClassVar[str] = "local_stiffness_loss"
    units: ClassVar[dict[str, str]] = {"loss": "1", "start": "m", "length": "m"}
    loss: float
    start: float
    length: float


@dataclass(frozen=True, slots=True)
class ModulusTemperature(Primitive):
    """Young's modulus falls with temperature: E (1 - `coefficient` (T - T_ref)), `coefficient` [1/K]."""

    kind: ClassVar[str] = "modulus_temperature"
    units: ClassVar[dict[str, str]] = {"coefficient": "1/K"}
    coefficient: float


@dataclass(frozen=True, slots=True)
class StiffnessDrift(Primitive):
    """The whole stiffness changes with time within a record: K (1 + `rate` t), `rate` [1/s]."""

    kind: ClassVar[str] = "stiffness_drift"
    units: ClassVar[dict[str, str]] = {"rate": "1/s"}
    rate: float


# ---------------------------------------------------------------- internal forces
#
# The laws of `fe.runtime.laws` act against the motion x of a port (displacement [m] or rotation [rad]): -F on
# x, F in N or N m. Ports of the wing: "root" (flapping rotation of the root), "tip" (upward displacement of
# the tip's load point), "span" (upward displacement of all stations, weighted by the share of planform area;
# the weights sum to one), "planform" (the law acts at every place on the place's own upward displacement,
# with a force by the place's share of the area: `planform_forces`). A lumped model declares its own.


# ---------------------------------------------------------------- loads


@dataclass(frozen=True, slots=True)
class LoadPlace(Primitive):
    """Applied forces act `along_span` [m] further outboard, `along_chord` [m] further aft than recorded."""

    kind: ClassVar[str] = "load_place"
    units: ClassVar[dict[str, str]] = {"along_span": "m", "along_chord": "m"}
    along_span: float
    along_chord: float


@dataclass(frozen=True, slots=True)
class LoadGain(Primitive):
    """The force that acts is (1 + `gain`) times the recorded one plus `tare` [N], while one is applied."""

    kind: ClassVar[str] = "load_gain"
    units: ClassVar[dict[str, str]] = {"gain": "1", "tare": "N"}
    gain: float
    tare: float


@dataclass(frozen=True, slots=True)
class Washout(Primitive):
    """Lift in flight is l (1 - `coefficient` n eta^`exponent`), eta = y / semi-span, n the load factor."""

    kind: ClassVar[str] = "washout"
    units: ClassVar[dict[str, str]] = {"coefficient": "1", "exponent": "1"}
    coefficient: float
    exponent: float


@dataclass(frozen=True, slots=True)
class InertiaRelief(Primitive):
    """In flight the structure's weight times n relieves the lift by this `fraction` more than modelled."""

    kind: ClassVar[str] = "inertia_relief"
    units: ClassVar[dict[str, str]] = {"fraction": "1"}
    fraction: float


@dataclass(frozen=True, slots=True)
class PortLoad(Primitive):
    """A force [N or N m] that pushes a port along its motion, a formula in `time` [s] of the trial."""

    kind: ClassVar[str] = "port_load"
    in_windows: ClassVar[bool] = True
    courses: ClassVar[tuple[str, ...]] = ("force",)
    port: str
    force: str

    def __post_init__(self) -> None:
        super(PortLoad, self).__post_init__()
        course_of(self.force, self.kind)


_EVERY: tuple[type[Primitive], ...] = (
    PointMass, RootCompliance, LocalStiffnessLoss, ModulusTemperature, StiffnessDrift,
    *LAWS,
    LoadPlace, LoadGain, Washout, InertiaRelief, PortLoad,
    SensorGain, SensorDrift, ChannelOffset, SensorRotation, ThermalStrain, HighPass, Clock, LoggerClock, Line,
    DecayingLine,
    RunOffset,
)  # fmt: skip
PRIMITIVES: dict[str, type[Primitive]] = {primitive.kind: primitive for primitive in _EVERY}
"""Every primitive by its kind."""

STRUCTURE = (PointMass, RootCompliance, LocalStiffnessLoss, ModulusTemperature)
"""Primitives that change the linear structure: it is solved anew."""
INTERNAL_FORCES = (*LAWS, StiffnessDrift)
"""Primitives that act as forces inside the structure while it moves."""
LOADS = (LoadPlace, LoadGain, Washout, InertiaRelief)
"""Primitives that change the loads that are known."""
SENSORS = (
    SensorGain,
    SensorDrift,
    ChannelOffset,
    SensorRotation,
    ThermalStrain,
    HighPass,
    Clock,
    LoggerClock,
    Line,
    DecayingLine,
    RunOffset,
)
"""Primitives that change what is read, not what happens."""


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
        """Return what acts in a trial: without the primitives whose windows are in other trials only.

        A primitive that acts throughout the trial has no window in it.
        """
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

    def to_json(self) -> str:
        """Return the patch as JSON; floats keep every bit."""
        return json.dumps(self.to_list(), allow_nan=False)

    @classmethod
    def from_json(cls, text: str, where: str = "The patch") -> "ModelPatch":
        """Return the patch of a JSON text; raises `InvalidPatchError`."""
        try:
            rows = json.loads(text)
        except json.JSONDecodeError as cause:
            raise InvalidPatchError(f"{where} is not JSON ({cause}).") from cause
        return cls.from_list(rows, where)


def _primitive(row: object, where: str) -> Primitive:
    kind = row.get("kind") if isinstance(row, Mapping) else row
    if not isinstance(row, Mapping) or not isinstance(kind, str) or kind not in PRIMITIVES:
        raise InvalidPatchError(f"{where} has the kind {kind!r}, but known are {', '.join(PRIMITIVES)}.")
    primitive = PRIMITIVES[kind]
    types = primitive.values()
    values = {str(name): value for name, value in row.items() if name not in ("kind", "windows")}
    for name, value in values.items():
        wanted = types.get(name)
        if wanted is None:
            raise InvalidPatchError(f"{where} has no value {name!r}; it has {', '.join(types)}.")
        fits = (
            isinstance(value, str)
            if wanted is str
            else isinstance(value, int) and not isinstance(value, bool)
            if wanted is int
            else isinstance(value, float | int) and not isinstance(value, bool)
        )
        if not fits:
            raise InvalidPatchError(
                f"{where}: {name} must be {'text' if wanted is str else 'a number'}, but is {value!r}."
            )
        if wanted is float:
            values[name] = float(value)
    windows = _windows(row.get("windows", ()), where)
    try:
        return primitive(**values, windows=windows)
    except TypeError as cause:
        missing = [name for name in types if name not in values]
        raise InvalidPatchError(f"{where} lacks {', '.join(missing)}.") from cause


def _windows(rows: object, where: str) -> tuple[Window, ...]:
    """Return the windows of a primitive as a file has them."""
    if not isinstance(rows, list | tuple):
        raise InvalidPatchError(f"{where}: windows must be a list, but is {rows!r}.")
    found = []
    for row in rows:
        times = [row.get(key) for key in ("begin", "end")] if isinstance(row, Mapping) else []
        sound = all(
            value is None or (isinstance(value, float | int) and not isinstance(value, bool))
            for value in times
        )
        if not times or not sound or not isinstance(row.get("trial"), str) or len(row) > 3:
            raise InvalidPatchError(
                f"{where}: a window has trial, begin and end (seconds or null), but is {row!r}."
            )
        found.append(Window(row["trial"], *(None if value is None else float(value) for value in times)))
    return tuple(found)
