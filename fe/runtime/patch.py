"""Model patches: sets of primitive changes that together represent a missing physical effect.

A patch is plain data. The reduced model, the full model, the FMU and the twin understand the same
primitives; only `discrepancy.catalogue` knows which physical effect a set of them represents.

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
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
from .laws.speed import TableDamping as TableDamping
from .laws.tables import TableStiffness as TableStiffness
from .primitive import Primitive as Primitive
from .primitive import Window as Window
from .primitive import time_formula as time_formula
from .sensor_primitives import CHANNEL_UNIT as CHANNEL_UNIT
from .sensor_primitives import EVERY_CHANNEL as EVERY_CHANNEL
from .sensor_primitives import PER_RELEASE as PER_RELEASE
from .sensor_primitives import ChannelOffset as ChannelOffset
from .sensor_primitives import Clock as Clock
from .sensor_primitives import DecayingLine as DecayingLine
from .sensor_primitives import Filter as Filter
from .sensor_primitives import HighPass as HighPass
from .sensor_primitives import Line as Line
from .sensor_primitives import LoggerClock as LoggerClock
from .sensor_primitives import LowPass as LowPass
from .sensor_primitives import RunOffset as RunOffset
from .sensor_primitives import Sensor as Sensor
from .sensor_primitives import SensorDrift as SensorDrift
from .sensor_primitives import SensorGain as SensorGain
from .sensor_primitives import SensorLag as SensorLag
from .sensor_primitives import SensorRecord as SensorRecord
from .sensor_primitives import SensorRotation as SensorRotation
from .sensor_primitives import SensorSaturation as SensorSaturation
from .sensor_primitives import ThermalStrain as ThermalStrain

ROOT_TURN = ("root", "rx")
"""Support and motion of the root of a wing or a lumped model: its turn about the flapping axis."""
FORMER_ROOT_COMPLIANCE = "root_compliance"
"""Kind of the root's compliance in files of earlier versions."""

# ---------------------------------------------------------------- mass and stiffness


class PointMass(Primitive):
    """A point mass [kg] on the elastic line at `station` [m] from the root.

    In a lumped model it sits at a named location.
    """

    mass: Annotated[float, "kg"]
    """Added mass."""
    station: Annotated[float, "m"]
    """Place, as a distance from the root."""


class PlaceMass(Primitive):
    """A mass is added at a named place of a structure; a negative one is lost.

    If the place is a point of a mesh, the mass may lie beside it on the structure, by `along` in
    the direction in which the structure extends most about the point and by `across` in the one in
    which it extends second most.
    """

    place: str
    """Name of the place: a set of nodes, a point or a node."""
    mass: Annotated[float, "kg"]
    """Added mass."""
    along: Annotated[float, "m"] = 0.0
    """Distance from the place in the direction of the largest extent."""
    across: Annotated[float, "m"] = 0.0
    """Distance from the place in the direction of the second largest extent."""


class SupportCompliance(Primitive):
    """A support yields: a motion that it holds is against a spring of this `compliance`.

    The motion is "x", "y" or "z", along an axis, or "rx", "ry" or "rz", about an axis through the
    centre of the support. If a spring resists it already, the new one is in series with it. The
    root of a wing or of a lumped model is the support "root" with the motion "rx".
    """

    support: str
    """Name of the support: its set of nodes, or its nodes."""
    motion: str
    """Motion of the support: "x", "y", "z", or "rx", "ry", "rz" about an axis."""
    compliance: Annotated[float, "m/N or rad/(N m)"]
    """Motion of the support for each unit of its reaction."""

    @property
    def location(self) -> str:
        """The support."""
        return self.support


class InterfaceCompliance(Primitive):
    """An interface of two parts yields: a motion that it holds is against a spring.

    The spring has the inverse of this `compliance`. The motion is "n", "s" or "t", along the normal
    and the longer and the shorter extent of the interface, or "rn", "rs" or "rt", about these axes
    through its centre. If a spring resists it already, the new one is in series with it.
    """

    interface: str
    """Name of the interface."""
    motion: str
    """Motion of the second part against the first one: "n", "s", "t", or "rn", "rs", "rt"."""
    compliance: Annotated[float, "m/N or rad/(N m)"]
    """Added compliance."""

    @property
    def location(self) -> str:
        """The interface."""
        return self.interface


class LocalStiffnessLoss(Primitive):
    """The skin loses `loss` of its stiffness over `length` beyond `start` [m from the root]."""

    loss: Annotated[float, "1"]
    """Lost fraction of the stiffness."""
    start: Annotated[float, "m"]
    """Start of the stretch, as a distance from the root."""
    length: Annotated[float, "m"]
    """Length of the stretch."""


class ModulusTemperature(Primitive):
    """Young's modulus falls with temperature: E (1 - `coefficient` (T - T_ref))."""

    coefficient: Annotated[float, "1/K"]
    """Relative loss of the modulus for each kelvin."""


class RegionStiffnessLoss(Primitive):
    """A damage region loses `loss` of the stiffness that it has in a trial.

    The region may also be a patch of a structure that its file does not declare. If what lost
    stiffness extends over `extent` times the length of the patch, it lost more, or less, than the
    patch on average, and a strain gauge on it reads accordingly.
    """

    region: str
    """Name of the damage region."""
    loss: Annotated[float, "1"]
    """Lost fraction of the stiffness."""
    extent: Annotated[float, "1"] = 1.0
    """Length of what lost stiffness over that of the patch."""

    @property
    def strain_over_mean(self) -> float:
        """The strain of what lost stiffness over the mean strain of the patch.

        A loss d adds the compliance u = d / (1 - d) to a patch of unit length. Over the length f it
        adds u / f per length: the strain is (1 + u / f) / (1 + u) times the mean.
        """
        added = self.loss / (1.0 - self.loss)
        return (1.0 + added / self.extent) / (1.0 + added)


class StiffnessDrift(Primitive):
    """The whole stiffness drifts within a record: K (1 + `rate` t), t since its start."""

    rate: Annotated[float, "1/s"]
    """Relative change of the stiffness in each second."""


# ---------------------------------------------------------------- internal forces
# The laws of `fe.runtime.laws` act against the motion x of a port (displacement [m] or rotation
# [rad]): -F on x, F in N or N m. A lumped model declares its ports. Ports of the wing:
# - "root": flapping rotation of the root
# - "tip": upward displacement of the tip's load point
# - "span": mean upward displacement of all stations, weighted by planform area
# - "planform": every station by itself; the law acts on the station's upward displacement, with a
#   force in proportion to its fraction of the area (`motion.PLANFORM`)


# ---------------------------------------------------------------- loads


class LoadPlace(Primitive):
    """Forces act further outboard (`along_span` [m]) and further aft (`along_chord` [m])."""

    along_span: Annotated[float, "m"]
    """Distance by which the force acts further outboard."""
    along_chord: Annotated[float, "m"]
    """Distance by which the force acts further aft."""


class LoadOffset(Primitive):
    """The force of a `control` of a structure acts by `distance` along an axis from its place."""

    control: str
    """Name of the control whose force changes."""
    axis: str
    """Axis of the move."""
    distance: Annotated[float, "m"]
    """Distance of the force from its place."""


class LoadTilt(Primitive):
    """The force of a `control` of a structure is turned by `angle` towards an axis."""

    control: str
    """Name of the control whose force changes."""
    axis: str
    """Axis towards which the force turns."""
    angle: Annotated[float, "rad"]
    """Angle by which the force is turned."""


class GaugeOffset(Primitive):
    """A strain gauge of a structure lies by `distance` "along" itself or "across" from its place.

    It stays on the surface. "Across" is towards the normal of the surface times the direction of
    the gauge.
    """

    gauge: str
    """Name of the gauge."""
    axis: str
    """"along" the gauge or "across" it."""
    distance: Annotated[float, "m"]
    """Distance of the gauge from its place."""


class LoadGain(Primitive):
    """While a force is applied, (1 + `gain`) times the recorded force plus `tare` [N] acts."""

    gain: Annotated[float, "1"]
    """Relative error of the gain."""
    tare: Annotated[float, "N"]
    """Added force."""


class Washout(Primitive):
    """Bending unloads the outer wing: lift in flight is l (1 - `coefficient` n eta^`exponent`).

    eta is y / semi-span, n the load factor and l the lift of the model.
    """

    coefficient: Annotated[float, "1"]
    """Factor of the unloading."""
    exponent: Annotated[float, "1"]
    """Exponent of the place along the span."""


class InertiaRelief(Primitive):
    """In flight the structure's weight relieves the lift by this `fraction` more than modelled.

    The weight counts with the load factor n.
    """

    fraction: Annotated[float, "1"]
    """Additional fraction of the weight."""


class PortLoad(Primitive):
    """A `force` [N or N m] acts on a port, given as a formula in the `time` [s] of the trial."""

    can_act_in_windows: ClassVar[bool] = True
    formula_fields: ClassVar[tuple[str, ...]] = ("force",)
    port: str
    """Name of the port."""
    force: str
    """Formula of the force in the `time` of the trial."""


STRUCTURE = (
    PointMass,
    PlaceMass,
    SupportCompliance,
    InterfaceCompliance,
    LocalStiffnessLoss,
    ModulusTemperature,
)
"""Primitives that change the linear structure, which must be solved anew."""
INTERNAL_FORCES = (*LAWS, StiffnessDrift)
"""Primitives that act as forces inside the structure while it moves."""
LOADS = (LoadPlace, LoadOffset, LoadTilt, LoadGain, Washout, InertiaRelief)
"""Primitives that change the known loads."""
READ_PLACES = (GaugeOffset,)
"""Primitives that change the positions of gauges."""
SENSORS = (
    SensorGain,
    SensorSaturation,
    SensorDrift,
    ChannelOffset,
    SensorRotation,
    ThermalStrain,
    HighPass,
    LowPass,
    SensorLag,
    Clock,
    LoggerClock,
    Line,
    DecayingLine,
    RunOffset,
)
"""Primitives that change readings of sensors, but not the motion of the structure."""
_PRIMITIVE_TYPES: tuple[type[Primitive], ...] = (
    *STRUCTURE,
    RegionStiffnessLoss,
    StiffnessDrift,
    *LAWS,
    *LOADS,
    PortLoad,
    *READ_PLACES,
    *SENSORS,
)
PRIMITIVES = {primitive_type.kind: primitive_type for primitive_type in _PRIMITIVE_TYPES}
"""The class of every primitive by its kind."""


@dataclass(frozen=True)
class ModelPatch:
    """A set of primitive changes of a model; an empty patch changes nothing.

    Attributes
    ----------
    primitives : tuple of Primitive
        The changes, applied together; sensors in this order.
    """

    primitives: tuple[Primitive, ...] = ()

    def __iter__(self) -> Iterator[Primitive]:
        return iter(self.primitives)

    def __len__(self) -> int:
        return len(self.primitives)

    def __add__(self, other: "ModelPatch") -> "ModelPatch":
        return ModelPatch(self.primitives + other.primitives)

    def in_trial(self, trial: str) -> "ModelPatch":
        """Return the part of the patch that acts in the trial of this name.

        A primitive keeps only its windows in this trial. It is left out if all its windows are in
        other trials. If it has no windows, or one of them spans the whole trial, it acts always,
        and is returned without windows.
        """
        if not self.has_windows:
            return self
        acting_primitives: list[Primitive] = []
        for primitive in self.primitives:
            if not primitive.windows:
                acting_primitives.append(primitive)
                continue
            windows = tuple(window for window in primitive.windows if window.trial == trial)
            if not windows:
                continue
            spans_trial = any(window.begin is None and window.end is None for window in windows)
            acting_primitives.append(replace(primitive, windows=() if spans_trial else windows))
        return ModelPatch(tuple(acting_primitives))

    @property
    def has_windows(self) -> bool:
        """Whether any primitive is restricted to windows."""
        return any(primitive.windows for primitive in self.primitives)

    def of(self, *kinds: type[Primitive]) -> "ModelPatch":
        """Return the part of the patch whose primitives are of given classes."""
        return ModelPatch(
            tuple(primitive for primitive in self.primitives if isinstance(primitive, kinds))
        )

    def without(self, *kinds: type[Primitive]) -> "ModelPatch":
        """Return the part of the patch whose primitives are of none of the given classes."""
        return ModelPatch(
            tuple(primitive for primitive in self.primitives if not isinstance(primitive, kinds))
        )

    def to_list(self) -> list[dict[str, object]]:
        """Return the primitives as plain data; `from_list` restores the patch to the last bit."""
        return [primitive.to_mapping() for primitive in self.primitives]

    @classmethod
    def from_list(cls, rows: object, where: str = "The patch") -> "ModelPatch":
        """Return the patch that `to_list` wrote.

        Parameters
        ----------
        rows : list of mapping
            Kind and values of each primitive.
        where : str
            The name of the source, as the beginning of error messages.

        Raises
        ------
        InvalidPatchError
            If a kind is unknown, or a value is missing, superfluous, of the wrong type or not
            finite.
        """
        if not isinstance(rows, list):
            raise InvalidPatchError(
                f"{where} must be a list of primitives, but is a {type(rows).__name__}."
            )
        return cls(
            tuple(
                _primitive_from_row(row, f"{where}, primitive {number}")
                for number, row in enumerate(rows, start=1)
            )
        )


_ACCEPTED_TYPES: dict[type, tuple[type, ...]] = {
    float: (float, int),
    int: (int,),
    str: (str,),
    tuple: (list, tuple),
}
"""The types that a value may have in a file, by the type to which it is converted. A tuple holds
numbers."""
_NAMES_OF_TYPES = {float: "a number", int: "a number", str: "text", tuple: "a list of numbers"}
_WINDOW_TYPES: dict[str, type] = {"trial": str, "begin": float, "end": float}


def _primitive_from_row(row: object, where: str) -> Primitive:
    """Build a primitive from a row of a file; raise `InvalidPatchError` as `from_list` does."""
    # files of earlier versions have a kind of its own for the compliance of the root's turn
    if isinstance(row, Mapping) and row.get("kind") == FORMER_ROOT_COMPLIANCE:
        support, motion = ROOT_TURN
        row = {**row, "kind": SupportCompliance.kind, "support": support, "motion": motion}
    # a row that is no table is shown whole in the place of its kind
    kind = row.get("kind") if isinstance(row, Mapping) else row
    if not isinstance(row, Mapping) or not isinstance(kind, str) or kind not in PRIMITIVES:
        raise InvalidPatchError(
            f"{where} has the kind {kind!r}, but the known ones are {', '.join(PRIMITIVES)}."
        )
    primitive_type = PRIMITIVES[kind]
    values = {name: value for name, value in row.items() if name not in ("kind", "windows")}
    types, required = primitive_type.value_types(), primitive_type.required_values()
    return primitive_type(
        **_checked_values(values, types, required, where),
        windows=_windows_from_rows(row.get("windows", ()), where),
    )


def _windows_from_rows(rows: object, where: str) -> tuple[Window, ...]:
    """Build the windows of a primitive from rows of a file; raise `InvalidPatchError`."""
    if not isinstance(rows, list | tuple) or not all(isinstance(row, Mapping) for row in rows):
        raise InvalidPatchError(f"{where}: windows must be a list of tables, but is {rows!r}.")
    windows = []
    for row in rows:
        limits = {name: value for name, value in row.items() if value is not None}
        values = _checked_values(limits, _WINDOW_TYPES, ["trial"], f"{where}, a window")
        windows.append(Window(**values))
    return tuple(windows)


def _checked_values(
    row: Mapping[str, object], types: Mapping[str, type], required: Iterable[str], where: str
) -> dict[str, Any]:
    """Convert the values of a row to their types.

    Raises `InvalidPatchError` if a value is missing, superfluous or of another type; the message
    begins with `where`.
    """
    checked: dict[str, Any] = {}
    for name, value in row.items():
        if name not in types:
            raise InvalidPatchError(f"{where} has no value {name!r}; it has {', '.join(types)}.")
        value_type = types[name]
        elements = value if isinstance(value, list | tuple) else ()
        if not _is_accepted(value, value_type) or not all(
            _is_accepted(element, float) for element in elements
        ):
            type_name = _NAMES_OF_TYPES[value_type]
            raise InvalidPatchError(f"{where}: {name} must be {type_name}, but is {value!r}.")
        checked[name] = tuple(map(float, elements)) if value_type is tuple else value_type(value)
    missing_names = [name for name in required if name not in row]
    if missing_names:
        raise InvalidPatchError(f"{where} lacks {', '.join(missing_names)}.")
    return checked


def _is_accepted(value: object, value_type: type) -> bool:
    """Return whether a value in a file may be converted to a type; true and false may not."""
    return isinstance(value, _ACCEPTED_TYPES[value_type]) and not isinstance(value, bool)
