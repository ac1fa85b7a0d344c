"""Primitive changes of a model: what a missing effect is made of, and the patch that carries them.

A patch is plain data. The reduced model, the full model, the FMU and the twin understand the same
primitives; which physical effect a set of them stands for is not known here (`discrepancy.catalogue` knows).

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, replace
from typing import Annotated, Any, ClassVar

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
from .sensor_primitives import Sensor as Sensor
from .sensor_primitives import SensorDrift as SensorDrift
from .sensor_primitives import SensorGain as SensorGain
from .sensor_primitives import SensorRecord as SensorRecord
from .sensor_primitives import SensorRotation as SensorRotation
from .sensor_primitives import SensorLag as SensorLag
from .sensor_primitives import SensorSaturation as SensorSaturation
from .sensor_primitives import ThermalStrain as ThermalStrain

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


STRUCTURE = (PointMass, RootCompliance, LocalStiffnessLoss, ModulusTemperature)
"""Primitives that change the linear structure: it is solved anew."""
INTERNAL_FORCES = (*LAWS, StiffnessDrift)
"""Primitives that act as forces inside the structure while it moves."""
LOADS = (LoadPlace, LoadGain, Washout, InertiaRelief)
"""Primitives that change the loads that are known."""
SENSORS = (
    SensorGain, SensorSaturation, SensorDrift, ChannelOffset, SensorRotation, ThermalStrain, HighPass, SensorLag, Clock,
    LoggerClock, Line, DecayingLine, RunOffset,
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
