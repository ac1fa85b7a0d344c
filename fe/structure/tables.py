"""The tables that every structure file has, whether its structure comes from a mesh or from matrices.

Also how well its reduced model is to hold.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, ConfigDict, Field, field_validator, model_validator

from fe.runtime.state import MOST_REGIONS
from fe.sentences import said
from reporting.toml_file import Fault, Section

Vector = tuple[float, float, float]
Name = Annotated[str, Field(max_length=32, pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
Modulus = Annotated[float, Field(ge=1e6, le=1e13, description="Pa")]

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
"""Units of length and their size [m]."""
MOTIONS = ("x", "y", "z", "rx", "ry", "rz")
"""Of a rigid set: along the axes, then about them."""


class Part(Section):
    """Section of a design file: unknown keys, non-finite numbers and booleans for numbers are refused."""

    model_config = ConfigDict(allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _lists_as_tuples(cls, content: object) -> object:
        if not isinstance(content, dict):
            return content
        return {key: _tuples(item) for key, item in content.items()}


def _tuples(item: object) -> object:
    """Return the lists of a file as the tuples that a strict section takes."""
    return tuple(map(_tuples, item)) if isinstance(item, list) else item


def _points_somewhere(vector: Vector) -> Vector:
    if not any(vector):
        raise ValueError("it must point somewhere, but is (0, 0, 0)")
    return vector


Direction = Annotated[Vector, AfterValidator(_points_somewhere)]


class Named(Part):
    """Something that is chosen or read by its name."""

    name: Name


class Given(Part):
    """A table that is given in one of several ways, each a few keys."""

    ways: ClassVar[tuple[tuple[str, ...], ...]]

    def faults(self) -> Iterator[Fault]:
        """Yield what is not given in one way."""
        yield from super().faults()
        given = {key for way in self.ways for key in way if getattr(self, key) is not None}
        ways = ", or ".join(map(" and ".join, self.ways))
        yield given not in map(set, self.ways), f"either {ways} is expected"


class Ranged(Named):
    """A quantity that can be chosen, and from where to where the reduced model is to hold."""

    minimum: float | None = None
    maximum: float | None = None

    usual: ClassVar[tuple[float, float]]
    """Ends of the range where none are given, as multiples of the nominal value."""
    nominal_key: ClassVar[str] = "nominal"
    """Which of its numbers is the nominal value."""

    @property
    def middle(self) -> float:
        """Nominal value."""
        return float(getattr(self, self.nominal_key))

    @property
    def range(self) -> tuple[float, float]:
        """Least and largest value."""
        low, high = sorted(share * self.middle for share in self.usual)
        return (
            low if self.minimum is None else self.minimum,
            high if self.maximum is None else self.maximum,
        )

    def faults(self) -> Iterator[Fault]:
        """Yield a range without the nominal value."""
        low, high = self.range
        told = said("design.range", middle=self.middle, low=low, high=high)
        yield not low <= self.middle <= high, told


class Parameter(Ranged):
    """Factor on the stiffness of materials, to be calibrated; 1 unless `nominal` says otherwise."""

    nominal: float = Field(default=1.0, gt=0.0, le=1e3)
    minimum: float | None = Field(default=None, gt=0.0)

    usual = (0.9, 1.1)


class Control(Ranged):
    """What commands loads; a load is its numbers times the value of its control."""

    unit: str = Field(default="1", pattern=r"^\S+$")
    nominal: float = 1.0

    usual = (-10.0, 10.0)

    def faults(self) -> Iterator[Fault]:
        """Yield a range that it cannot have, and one of zero."""
        yield from super().faults()
        yield not any(self.range), said("design.always_zero")


class Commanded(Named):
    """A load, constant or times the value of a control."""

    control: Name | None = None
    acceleration: Direction | None = None


class Region(Named):
    """Region that may lose stiffness, up to `largest_loss`; `name` is that of its loss."""

    largest_loss: float = Field(default=0.8, gt=0.0, le=0.95)

    @property
    def range(self) -> tuple[float, float]:
        """Least and largest loss."""
        return (0.0, self.largest_loss)


class ChosenMass(Ranged):
    """Mass [kg]; `free` where it is to be calibrated or chosen later."""

    mass: float = Field(ge=0.0, lt=1e6)
    free: bool = False
    minimum: float | None = Field(default=None, ge=0.0)

    usual = (0.5, 1.5)
    nominal_key = "mass"


class Damping(Part):
    """Rayleigh damping V = alpha M + beta K."""

    alpha: float = Field(default=0.0, ge=0.0, description="1/s")
    beta: float = Field(default=0.0, ge=0.0, description="s")


class ReductionLimits(Part):
    """How well the reduced model is to hold, and how many full solutions it may take."""

    tolerance: float = Field(default=6e-4, ge=1e-5, le=0.1, description="of the largest output")
    most_solutions: int = Field(default=401, ge=1, le=2000)


class StructureDesign(Part):
    """A structure: all that decides its model beside the files that it names. Read it with `load_structure`.

    Raises
    ------
    InvalidDesignError
        From `parse_structure` and `load_structure`, with one sentence that names the place.
    """

    name: str = Field(min_length=1)
    length_unit: Literal["m", "cm", "mm", "um", "in", "ft"]
    parameter: tuple[Parameter, ...] = ()
    control: tuple[Control, ...] = ()
    load: tuple[Commanded, ...] = ()
    damage: tuple[Region, ...] = Field(default=(), max_length=MOST_REGIONS)
    mass: tuple[ChosenMass, ...] = ()
    gauge: tuple[Named, ...] = ()
    displacement: tuple[Named, ...] = ()
    acceleration: tuple[Named, ...] = ()
    port: tuple[Named, ...] = ()
    damping: Damping = Damping()
    reduction: ReductionLimits = ReductionLimits()

    what: ClassVar[str]
    """What its files hold."""
    scaled_table: ClassVar[str] = ""
    """Name of the tables that a parameter may scale."""
    own_names: ClassVar[tuple[str, ...]] = ()
    """Further tables whose names must differ from one another."""

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files that it is made of, seen from its own."""
        raise NotImplementedError

    @field_validator("name", "mesh", check_fields=False)
    @classmethod
    def _one_line(cls, text: str) -> str:
        if not text.isprintable():
            raise ValueError("one line of text is expected, without line breaks or other control characters")
        return text

    def faults(self) -> Iterator[Fault]:
        """Yield names that do not fit together."""
        # What a state, a control or an output is called by must be one thing.
        for keys in (
            ("parameter", "damage", "mass", "control"),
            ("gauge", "displacement", "acceleration", "port"),
            ("load",),
            *((key,) for key in self.own_names),
        ):
            first: dict[str, str] = {}
            for place, part in (item for key in keys for item in self.numbered(key)):
                other = first.setdefault(part.name, place)
                yield other != place, said("design.names", first=other, second=place, name=part.name)
        if table := self.scaled_table:
            yield from self.wrong_ties(table, "scaled_by", "parameter", "is scaled by", f"scales no {table}")
        yield from self.wrong_ties("load", "control", "control", "is tied to the control", "commands no load")

    def wrong_ties(self, table: str, key: str, other: str, tied: str, untied: str) -> Iterator[Fault]:
        """Yield what is tied to a name of another table that is not there, and names that tie nothing."""
        known = [part.name for part in getattr(self, other)]
        came = {getattr(part, key): place for place, part in self.numbered(table)}
        for name, place in came.items():
            lost = name is not None and name not in known
            yield lost, f"{place} {tied} {name!r}, but no [[{other}]] has that name"
        yield from ((name not in came, f"the {other} {name!r} {untied}") for name in known)

    def numbered(self, key: str) -> Iterator[tuple[str, Any]]:
        """Yield the parts of a table, each behind its place in the file, such as `load[1]`."""
        for number, part in enumerate(getattr(self, key), start=1):
            yield f"{key}[{number}]", part

    @property
    def unit(self) -> float:
        """Metres in the unit of length."""
        return UNITS[self.length_unit]

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Least and largest value for which a reduced model is to hold of all that can be chosen, by name."""
        free = (part for part in self.mass if part.free)
        chosen: tuple[Ranged | Region, ...] = (*self.parameter, *self.damage, *free, *self.control)
        return {part.name: part.range for part in chosen}


@dataclass(frozen=True)
class StructureSettings:
    """How well the reduced model of a structure is to hold; where, and both limits, its design says.

    Attributes
    ----------
    bound_tolerance : float
        The certified bound wanted everywhere on the training set, for each load alone, of strains relative to
        the largest strain and of displacements relative to the largest of them.
    most_snapshots : int
        Limit of the greedy search.
    mode_count : int
        Modes that the reduced model returns.
    ranges : dict of str to (float, float)
        Least and largest value where it is to hold elsewhere than the design says, by name.
    """

    bound_tolerance: float = ReductionLimits().tolerance
    most_snapshots: int = ReductionLimits().most_solutions
    mode_count: int = 6
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
