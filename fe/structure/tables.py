"""The tables that every structure file has, for a mesh as for matrices.

They also say how accurate its reduced model must be, and where.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, ConfigDict, Field, field_validator, model_validator

from fe.runtime.state import MOST_REGIONS
from reporting.formats.toml_file import Check, Section

Vector = tuple[float, float, float]
Name = Annotated[str, Field(max_length=32, pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
Modulus = Annotated[float, Field(ge=1e6, le=1e13)]

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
"""Units of length in metres."""
MOTIONS = ("x", "y", "z", "rx", "ry", "rz")
"""Motions of a rigid set of nodes: along the axes, then about them."""

INTERFACE_MOTIONS = ("n", "s", "t", "rn", "rs", "rt")
"""Motions of the second part of an interface against the first one: along the normal, the long and
the short axis of the interface, then about them."""


class DesignSection(Section):
    """Section of a design file; unknown keys and non-finite numbers are refused."""

    model_config = ConfigDict(allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _lists_as_tuples(cls, content: object) -> object:
        if not isinstance(content, dict):
            return content
        return {key: _tuples(item) for key, item in content.items()}


def _tuples(item: object) -> object:
    """Return a TOML value with its lists as tuples, as strict sections need them."""
    if isinstance(item, list):
        return tuple(_tuples(entry) for entry in item)
    return item


def _points_somewhere(vector: Vector) -> Vector:
    if not any(vector):
        raise ValueError("it must point somewhere, but is (0, 0, 0)")
    return vector


Direction = Annotated[Vector, AfterValidator(_points_somewhere)]


class Named(DesignSection):
    """A table with a name, by which it is chosen or read."""

    name: Name
    """Name, of letters, digits and underscores, a letter first."""


class AlternativeKeys(DesignSection):
    """A table that has one of several alternative groups of keys."""

    alternatives: ClassVar[tuple[tuple[str, ...], ...]]

    def checks(self) -> Iterator[Check]:
        """Yield a fault if the table has not exactly the keys of one group."""
        yield from super().checks()
        keys_present: set[str] = set()
        for way in self.alternatives:
            keys_present.update(key for key in way if getattr(self, key) is not None)
        is_one_way = any(keys_present == set(way) for way in self.alternatives)
        expected_keys = ", or ".join(" and ".join(way) for way in self.alternatives)
        yield not is_one_way, f"either {expected_keys} is expected"


class Ranged(Named):
    """A quantity that can be chosen, with the range in which the reduced model is valid."""

    minimum: float | None = None
    """Least value for which the reduced model is valid [unit of the nominal value]."""
    maximum: float | None = None
    """Largest value for which the reduced model is valid [unit of the nominal value]."""

    usual: ClassVar[tuple[float, float]]
    """The default ends of the range, as multiples of the nominal value."""
    nominal_key: ClassVar[str] = "nominal"
    """The key that holds the nominal value."""

    @property
    def middle(self) -> float:
        """The nominal value."""
        return float(getattr(self, self.nominal_key))

    @property
    def range(self) -> tuple[float, float]:
        """The least and the largest value for which the reduced model is valid."""
        low, high = sorted(factor * self.middle for factor in self.usual)
        if self.minimum is not None:
            low = self.minimum
        if self.maximum is not None:
            high = self.maximum
        return low, high

    def checks(self) -> Iterator[Check]:
        """Yield a fault if the range does not contain the nominal value."""
        low, high = self.range
        yield (
            not low <= self.middle <= high,
            f"its nominal value {self.middle:g} must lie between minimum {low:g} and maximum "
            f"{high:g}",
        )


class StiffnessParameter(Ranged):
    """A factor on the stiffness of what names it in `scaled_by`, to be calibrated."""

    nominal: float = Field(default=1.0, gt=0.0, le=1e3)
    """Nominal value of the factor [1]."""
    minimum: float | None = Field(default=None, gt=0.0)
    """Least value for which the reduced model is valid; by default 0.9 times the nominal one
    [1]."""
    maximum: float | None = None
    """Largest value for which the reduced model is valid; by default 1.1 times the nominal one
    [1]."""

    usual = (0.9, 1.1)


class LoadControl(Ranged):
    """A control, which scales loads: a load is its numbers times the value of its control."""

    unit: str = Field(default="1", pattern=r"^\S+$")
    """Unit of the control."""
    nominal: float = 1.0
    """Nominal value [unit of the control]."""
    minimum: float | None = None
    """Least value for which the reduced model is valid; by default -10 times the nominal one, but
    needed if that is 0 [unit of the control]."""
    maximum: float | None = None
    """Largest value for which the reduced model is valid; by default 10 times the nominal one, but
    needed if that is 0 [unit of the control]."""

    usual = (-10.0, 10.0)

    def checks(self) -> Iterator[Check]:
        """Yield the checks that the range holds the nominal value, and more than zero."""
        yield from super().checks()
        yield (
            not any(self.range),
            "with its nominal value 0 it would always be 0; give its `minimum` and `maximum`",
        )


class ControlledLoad(Named):
    """A load, constant or times the value of a control."""

    control: Name | None = None
    """Name of the control that scales the load; without it the load is constant."""
    acceleration: Direction | None = None
    """Acceleration of everything that has mass, as a vector [m/s^2]."""


class Region(Named):
    """A region that may lose stiffness, up to `largest_loss`; its loss has its name."""

    largest_loss: float = Field(default=0.8, gt=0.0, le=0.95)
    """Largest stiffness loss for which the reduced model is valid, as a fraction [1]."""

    @property
    def range(self) -> tuple[float, float]:
        """The least and the largest loss."""
        return (0.0, self.largest_loss)


class ChosenMass(Ranged):
    """A mass [kg]; a `free` one is calibrated or chosen later."""

    mass: float = Field(ge=0.0, lt=1e6)
    """Nominal mass [kg]."""
    free: bool = False
    """Whether the mass is calibrated or chosen later."""
    minimum: float | None = Field(default=None, ge=0.0)
    """Least mass for which the reduced model is valid; by default half the nominal one [kg]."""
    maximum: float | None = None
    """Largest mass for which the reduced model is valid; by default 1.5 times the nominal one
    [kg]."""

    usual = (0.5, 1.5)
    nominal_key = "mass"


class RayleighDamping(DesignSection):
    """Rayleigh damping V = alpha M + beta K."""

    alpha: float = Field(default=0.0, ge=0.0)
    """Factor on the mass matrix [1/s]."""
    beta: float = Field(default=0.0, ge=0.0)
    """Factor on the stiffness matrix [s]."""


class ReductionLimits(DesignSection):
    """The accuracy of the reduced model, and the number of full solutions that it may take."""

    tolerance: float = Field(default=6e-4, ge=1e-5, le=0.1)
    """Largest error of the reduced model, as a fraction of the largest output [1]."""
    most_solutions: int = Field(default=401, ge=1, le=2000)
    """Largest number of solutions of the full model that the reduction may take."""
    modes: int = Field(default=6, ge=1, le=50)
    """Number of modes of the reduced model; motion in higher ones follows the loads at once."""


class StructureDesign(DesignSection):
    """A structure: all that its model depends on beside files; read it with `load_structure`.

    Raises
    ------
    InvalidDesignError
        From `parse_structure` and `load_structure`, with one sentence that names the place.
    """

    name: str = Field(min_length=1)
    """Name of the structure."""
    length_unit: Literal["m", "cm", "mm", "um", "in", "ft"]
    """Unit of length of the mesh or matrices, and of places and lengths in this file."""
    parameter: tuple[StiffnessParameter, ...] = ()
    """Factors on stiffness, to be calibrated."""
    control: tuple[LoadControl, ...] = ()
    """Controls, which scale loads."""
    load: tuple[ControlledLoad, ...] = ()
    """Loads."""
    damage: tuple[Region, ...] = Field(default=(), max_length=MOST_REGIONS)
    """Regions that may lose stiffness."""
    mass: tuple[ChosenMass, ...] = ()
    """Point masses."""
    gauge: tuple[Named, ...] = ()
    """Strain gauges."""
    displacement: tuple[Named, ...] = ()
    """Displacements that are outputs."""
    acceleration: tuple[Named, ...] = ()
    """Accelerations that are outputs."""
    port: tuple[Named, ...] = ()
    """Ports, where a force that the model lacks may act."""
    damping: RayleighDamping = RayleighDamping()
    """Rayleigh damping."""
    reduction: ReductionLimits = ReductionLimits()
    """Accuracy and cost of the reduced model."""

    what: ClassVar[str]
    """The content of its files: "mesh" or "matrix"."""
    scaled_tables: ClassVar[tuple[str, ...]] = ()
    """The tables whose stiffness a parameter may scale."""
    own_names: ClassVar[tuple[str, ...]] = ()
    """Further tables whose names must differ from one another."""

    @property
    def files(self) -> tuple[str, ...]:
        """The names of the files with mesh or matrices, relative to the structure file."""
        raise NotImplementedError

    @field_validator("name", "mesh", check_fields=False)
    @classmethod
    def _one_line(cls, text: str) -> str:
        if not text.isprintable():
            raise ValueError(
                "one line of text is expected, without line breaks or other control characters"
            )
        return text

    def checks(self) -> Iterator[Check]:
        """Yield the checks that names are unique where they must be, and that references exist."""
        # The names of states and controls are read together, and so are those of outputs.
        groups_of_tables = [
            ("parameter", "damage", "mass", "control"),
            ("gauge", "displacement", "acceleration", "port"),
            ("load",),
        ]
        groups_of_tables += [(key,) for key in self.own_names]
        for keys in groups_of_tables:
            yield from self._equal_names(keys)
        if self.scaled_tables:
            yield from self.wrong_ties(
                self.scaled_tables,
                "scaled_by",
                "parameter",
                tied="is scaled by",
                untied=f"scales no {' or '.join(self.scaled_tables)}",
            )
        yield from self.wrong_ties(
            ("load",),
            "control",
            "control",
            tied="is tied to the control",
            untied="commands no load",
        )

    def _equal_names(self, keys: tuple[str, ...]) -> Iterator[Check]:
        """Yield the checks that no two rows of some tables have the same name."""
        first_place: dict[str, str] = {}
        for key in keys:
            for place, row in self.numbered(key):
                other_place = first_place.setdefault(row.name, place)
                yield (
                    other_place != place,
                    f"{other_place} and {place} are both named {row.name!r}; give each a name of "
                    "its own",
                )

    def wrong_ties(
        self, tables: tuple[str, ...], key: str, named_table: str, *, tied: str, untied: str
    ) -> Iterator[Check]:
        """Yield the checks that references to a table exist, and that each of its rows is used.

        Parameters
        ----------
        tables, key
            The tables whose rows refer to names, and the key that holds the name.
        named_table : str
            The table whose rows have these names.
        tied, untied : str
            The verbs of the messages on a row that refers to an unknown name, and on a name to
            which no row refers.
        """
        known_names = [row.name for row in getattr(self, named_table)]
        place_of_name = {}
        for table in tables:
            for place, row in self.numbered(table):
                place_of_name[getattr(row, key)] = place
        for name, place in place_of_name.items():
            is_unknown = name is not None and name not in known_names
            yield is_unknown, f"{place} {tied} {name!r}, but no [[{named_table}]] has that name"
        for name in known_names:
            yield name not in place_of_name, f"the {named_table} {name!r} {untied}"

    def numbered(self, key: str) -> Iterator[tuple[str, Any]]:
        """Yield each row of a table with its label in messages, such as `load[1]`."""
        for number, part in enumerate(getattr(self, key), start=1):
            yield f"{key}[{number}]", part

    @property
    def unit(self) -> float:
        """The unit of length [m]."""
        return UNITS[self.length_unit]

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Range of validity of the reduced model for everything that can be chosen, by name."""
        free_masses = [mass for mass in self.mass if mass.free]
        rows: tuple[Ranged | Region, ...]
        rows = (*self.parameter, *self.damage, *free_masses, *self.control)
        return {row.name: row.range for row in rows}


@dataclass(frozen=True)
class StructureSettings:
    """The accuracy that the reduced model of a structure must have, and where.

    Attributes
    ----------
    bound_tolerance : float
        The certified bound wanted everywhere on the training set, for each load alone, of strains
        relative to the largest strain and of displacements relative to the largest of them.
    most_snapshots : int
        Limit of the greedy search.
    mode_count : int
        Modes that the reduced model returns.
    ranges : dict of str to (float, float)
        Least and largest values for which the reduced model is valid, by name, where they differ
        from those of the design.
    """

    bound_tolerance: float = ReductionLimits().tolerance
    most_snapshots: int = ReductionLimits().most_solutions
    mode_count: int = ReductionLimits().modes
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)
