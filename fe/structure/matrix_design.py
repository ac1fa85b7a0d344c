"""A structure from matrices of any finite element code, as its engineer describes it: a TOML file, checked.

The matrices are in newtons, seconds and the unit of length that the file names; a mass in kg and an
acceleration in m/s^2 are turned into these units.
"""

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from fe.runtime.state import MOST_REGIONS

from .tables import ChosenMass, Commanded, Direction, Given, Name, Named, Part, Region, StructureDesign

FileName = Annotated[str, Field(min_length=1)]
Files = Annotated[tuple[FileName, ...], Field(min_length=1)]
Node = Annotated[int, Field(ge=0)]


class MatrixSupport(Part):
    """Motions of nodes that are held: `rx`, `ry`, `rz` are the components 4, 5 and 6."""

    nodes: Annotated[tuple[Node, ...], Field(min_length=1)]
    hold: Annotated[tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...], Field(min_length=1)]


class StiffnessPart(Given):
    """Share of the stiffness that a parameter scales, a region may lose, or both.

    Either its own `matrix`, or that of the whole structure, `changed` by making the part's modulus `times`
    what it is.
    """

    matrix: FileName | None = None
    changed: FileName | None = None
    times: float | None = Field(default=None, ge=0.0, lt=1.0)
    scaled_by: Name | None = None
    damage: Name | None = None

    ways = (("matrix",), ("changed", "times"))


class MatrixLoad(Given, Commanded):
    """A load: a `vector` of its own, a `force` [N] at a node, or an `acceleration` [m/s^2] of all mass."""

    vector: FileName | None = None
    node: Node | None = None
    force: Direction | None = None

    ways = (("vector",), ("node", "force"), ("acceleration",))


class MatrixMass(Given, ChosenMass):
    """Mass at a `node`, or times the `matrix` of 1 kg."""

    node: Node | None = None
    matrix: FileName | None = None

    ways = (("node",), ("matrix",))


class Extension(Given, Named):
    """Strain: a `vector` of its own, or how far two nodes move apart along a direction, over a length."""

    vector: FileName | None = None
    nodes: tuple[Node, Node] | None = None
    direction: Direction | None = None
    length: float | None = Field(default=None, gt=0.0)

    ways = (("vector",), ("nodes", "direction", "length"))


class NodeOutput(Given, Named):
    """Displacement, or acceleration: a `vector` of its own, or of a node along a direction."""

    vector: FileName | None = None
    node: Node | None = None
    direction: Direction | None = None

    ways = (("vector",), ("node", "direction"))


class MatrixDesign(StructureDesign):
    """A structure from matrices.

    `stiffness_matrix` and `mass_matrix` are those of the whole structure, undamaged and with nominal
    parameters, or files whose matrices sum to them; `unknowns` says which node and component each row is,
    where they do not.
    """

    stiffness_matrix: Files
    mass_matrix: Files
    unknowns: FileName | None = None
    part: tuple[StiffnessPart, ...] = ()
    support: tuple[MatrixSupport, ...] = ()
    load: tuple[MatrixLoad, ...] = ()
    damage: tuple[Region, ...] = Field(default=(), max_length=MOST_REGIONS)
    mass: tuple[MatrixMass, ...] = ()
    gauge: tuple[Extension, ...] = ()
    displacement: tuple[NodeOutput, ...] = ()
    acceleration: tuple[NodeOutput, ...] = ()

    what = "matrix"
    scaled_table = "part"

    @field_validator("stiffness_matrix", "mass_matrix", mode="before")
    @classmethod
    def _one_or_several(cls, files: Any) -> Any:
        return (files,) if isinstance(files, str) else files

    @model_validator(mode="after")
    def _regions_have_parts(self) -> "MatrixDesign":
        self._check_ties("part", "damage", "damage", "is of the region", "has no stiffness: no part names it")
        return self

    @property
    def files(self) -> tuple[str, ...]:
        """Every file that is named, once, in the order of the tables."""
        tables = (self.part, self.load, self.mass, self.gauge, self.displacement, self.acceleration)
        own = (getattr(part, key, None) for table in tables for part in table for key in _FILES)
        named = filter(None, (*self.stiffness_matrix, *self.mass_matrix, self.unknowns, *own))
        return tuple(dict.fromkeys(file_of(name)[0] for name in named))


_FILES = ("matrix", "changed", "vector")


def file_of(name: str) -> tuple[str, str]:
    """Return the file, and the matrix in it, that `FILE` or `FILE:MATRIX` names."""
    file, _, matrix = name.partition(":")
    return file, matrix
