"""A structure from matrices of any finite element code, as its engineer describes it: a TOML file, checked.

The matrices are in newtons, seconds and the unit of length that the file names; a mass in kg and an
acceleration in m/s^2 are turned into these units.
"""

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from fe.runtime.state import MOST_REGIONS
from fe.wing.parts import Part

from .rosettes import Name, Named, Vector, refuse_zero
from .tables import ChosenMass, Commanded, Region, StructureDesign

FileName = Annotated[str, Field(min_length=1)]
Files = Annotated[tuple[FileName, ...], Field(min_length=1)]
Node = Annotated[int, Field(ge=0)]


def _one_of(part: Part, ways: dict[str, tuple[str, ...]]) -> None:
    """Refuse a table that is not given in one of some ways, each a few keys."""
    keys = {key for way in ways.values() for key in way}
    given = {key for key in keys if getattr(part, key) is not None}
    if given not in [set(way) for way in ways.values()]:
        raise ValueError(f"either {', or '.join(ways)} is expected")
    refuse_zero(getattr(part, "direction", None), "direction")


class MatrixSupport(Part):
    """Motions of nodes that are held: `rx`, `ry`, `rz` are the components 4, 5 and 6."""

    nodes: Annotated[tuple[Node, ...], Field(min_length=1)]
    hold: Annotated[tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...], Field(min_length=1)]


class StiffnessPart(Part):
    """Share of the stiffness that a parameter scales, a region may lose, or both.

    Either its own `matrix`, or that of the whole structure, `changed` by making the part's modulus `times`
    what it is.
    """

    matrix: FileName | None = None
    changed: FileName | None = None
    times: float | None = Field(default=None, ge=0.0, le=10.0)
    scaled_by: Name | None = None
    damage: Name | None = None

    @model_validator(mode="after")
    def _says_what_it_is(self) -> "StiffnessPart":
        _one_of(self, {"matrix": ("matrix",), "changed with times": ("changed", "times")})
        if self.times == 1.0:
            raise ValueError("times must not be 1: the matrix would not differ from that of the whole")
        if self.scaled_by is None and self.damage is None:
            raise ValueError("scaled_by, damage or both are expected")
        return self


class MatrixLoad(Commanded):
    """A load: a `vector` of its own, a `force` [N] at a node, or an `acceleration` [m/s^2] of all mass."""

    vector: FileName | None = None
    node: Node | None = None
    force: Vector | None = None
    acceleration: Vector | None = None

    @model_validator(mode="after")
    def _one_kind_of_load(self) -> "MatrixLoad":
        ways: dict[str, tuple[str, ...]] = {"vector": ("vector",), "node with force": ("node", "force")}
        _one_of(self, ways | {"acceleration": ("acceleration",)})
        refuse_zero(self.force, "force")
        refuse_zero(self.acceleration, "acceleration")
        return self

    @property
    def place(self) -> int | None:
        """Where it acts, of a force at a node."""
        return self.node


class MatrixMass(ChosenMass):
    """Mass at a `node`, or times the `matrix` of 1 kg."""

    node: Node | None = None
    matrix: FileName | None = None

    @model_validator(mode="after")
    def _is_somewhere(self) -> "MatrixMass":
        _one_of(self, {"node": ("node",), "matrix": ("matrix",)})
        return self


class Extension(Named):
    """Strain: a `vector` of its own, or how far two nodes move apart along a direction, over a length."""

    vector: FileName | None = None
    nodes: tuple[Node, Node] | None = None
    direction: Vector | None = None
    length: float | None = Field(default=None, gt=0.0)

    @model_validator(mode="after")
    def _one_kind_of_gauge(self) -> "Extension":
        _one_of(
            self, {"vector": ("vector",), "nodes, direction and length": ("nodes", "direction", "length")}
        )
        return self

    @property
    def ends(self) -> tuple[int, ...]:
        """Nodes that are read."""
        return self.nodes or ()


class NodeOutput(Named):
    """Displacement, or acceleration: a `vector` of its own, or of a node along a direction."""

    vector: FileName | None = None
    node: Node | None = None
    direction: Vector | None = None

    @model_validator(mode="after")
    def _is_somewhere(self) -> "NodeOutput":
        _one_of(self, {"vector": ("vector",), "node with direction": ("node", "direction")})
        return self

    @property
    def place(self) -> int | None:
        """Where it is read, at a node."""
        return self.node

    @property
    def ends(self) -> tuple[int, ...]:
        """Nodes that are read."""
        return () if self.node is None else (self.node,)


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
        named = [*self.stiffness_matrix, *self.mass_matrix, self.unknowns]
        for table in (self.part, self.load, self.mass, self.gauge, self.displacement, self.acceleration):
            for part in table:
                named += [getattr(part, key, None) for key in ("matrix", "changed", "vector")]
        return tuple(dict.fromkeys(file_of(name)[0] for name in named if name is not None))


def file_of(name: str) -> tuple[str, str]:
    """Return the file, and the matrix in it, that `FILE` or `FILE:MATRIX` names."""
    file, _, matrix = name.partition(":")
    return file, matrix
