"""The tables of a structure file that describes a structure by matrices."""

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from fe.runtime.state import MOST_REGIONS
from reporting.formats.toml_file import Check

from . import tables

FileName = Annotated[str, Field(min_length=1)]


Files = Annotated[
    tuple[FileName, ...],
    Field(min_length=1),
    BeforeValidator(
        lambda files: (files,) if isinstance(files, str) else files,
        json_schema_input_type=FileName | tuple[FileName, ...],
    ),
]


Node = Annotated[int, Field(ge=0)]


class MatrixSupport(tables.DesignSection):
    """Motions of nodes that are held: `rx`, `ry`, `rz` are the components 4, 5 and 6."""

    nodes: Annotated[tuple[Node, ...], Field(min_length=1)]
    """Numbers of the nodes."""
    hold: Annotated[tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...], Field(min_length=1)]
    """Motions that are held."""


class StiffnessPart(tables.AlternativeKeys):
    """Share of the stiffness that a parameter scales, a region may lose, or both.

    Either its own `matrix`, or that of the whole structure, `changed` by multiplying the part's
    modulus by `times`.
    """

    matrix: FileName | None = None
    """File with the stiffness matrix of the part."""
    changed: FileName | None = None
    """File with the stiffness matrix of the whole structure in which the part's modulus is
    changed."""
    times: float | None = Field(default=None, ge=0.0, lt=1.0)
    """Number by which the part's modulus is multiplied in `changed` [1]."""
    scaled_by: tables.Name | None = None
    """Name of the parameter that scales the part."""
    damage: tables.Name | None = None
    """Name of the region that takes stiffness from the part."""

    alternatives = (("matrix",), ("changed", "times"))


class MatrixLoad(tables.AlternativeKeys, tables.ControlledLoad):
    """A load: its own `vector`, a `force` [N] at a node, or an `acceleration` [m/s^2]."""

    vector: FileName | None = None
    """File with the load of each row."""
    node: Node | None = None
    """Number of the node at which the force acts."""
    force: tables.Direction | None = None
    """Force, as a vector [N]."""

    alternatives = (("vector",), ("node", "force"), ("acceleration",))


class MatrixMass(tables.AlternativeKeys, tables.ChosenMass):
    """Mass at a `node`, or times the `matrix` of 1 kg."""

    node: Node | None = None
    """Number of the node at which the mass sits."""
    matrix: FileName | None = None
    """File with the mass matrix of 1 kg."""

    alternatives = (("node",), ("matrix",))


class Extension(tables.AlternativeKeys, tables.Named):
    """Strain: its own `vector`, or how far two nodes move apart along a direction over a length."""

    vector: FileName | None = None
    """File with a row, whose product with the displacements is the strain."""
    nodes: tuple[Node, Node] | None = None
    """Numbers of the two nodes that move apart."""
    direction: tables.Direction | None = None
    """Direction of the strain, as a vector [1]."""
    length: float | None = Field(default=None, gt=0.0)
    """Length over which the nodes move apart [unit of length]."""

    alternatives = (("vector",), ("nodes", "direction", "length"))


class NodeOutput(tables.AlternativeKeys, tables.Named):
    """Displacement, acceleration or port: a `vector` of its own, or of a node along a direction."""

    vector: FileName | None = None
    """File with a row, whose product with the displacements is the output."""
    node: Node | None = None
    """Number of the node."""
    direction: tables.Direction | None = None
    """Direction, as a vector [1]."""

    alternatives = (("vector",), ("node", "direction"))


class MatrixDesign(tables.StructureDesign):
    """A structure from matrices.

    `stiffness_matrix` and `mass_matrix` are those of the whole structure, undamaged and with
    nominal parameters, or files whose matrices sum to them; `unknowns` says which node and
    component each row is, where they do not.
    """

    stiffness_matrix: Files
    """File with the stiffness matrix, or a list of files whose matrices are summed."""
    mass_matrix: Files
    """File with the mass matrix, or a list of files whose matrices are summed."""
    unknowns: FileName | None = None
    """File with node and component of each row; not needed if the matrices name nodes."""
    part: tuple[StiffnessPart, ...] = ()
    """Parts of the stiffness that a parameter scales or a region may lose."""
    support: tuple[MatrixSupport, ...] = ()
    """Nodes that are held."""
    load: tuple[MatrixLoad, ...] = ()
    damage: tuple[tables.Region, ...] = Field(default=(), max_length=MOST_REGIONS)
    mass: tuple[MatrixMass, ...] = ()
    gauge: tuple[Extension, ...] = ()
    displacement: tuple[NodeOutput, ...] = ()
    acceleration: tuple[NodeOutput, ...] = ()
    port: tuple[NodeOutput, ...] = ()

    what = "matrix"
    scaled_tables = ("part",)

    def checks(self) -> Iterator[Check]:
        """Yield the checks against tables that do not fit together and regions without parts."""
        yield from super().checks()
        yield from self.wrong_ties(
            ("part",),
            "damage",
            "damage",
            tied="is of the region",
            untied="has no stiffness: no part names it",
        )

    @property
    def files(self) -> tuple[str, ...]:
        """Every file that is named, once, in the order of the tables."""
        names = [*self.stiffness_matrix, *self.mass_matrix]
        if self.unknowns:
            names.append(self.unknowns)
        rows = [*self.part, *self.load, *self.mass]
        rows += [*self.gauge, *self.displacement, *self.acceleration, *self.port]
        for row in rows:
            for key in _FILE_KEYS:
                name = getattr(row, key, None)
                if name:
                    names.append(name)
        files = [file_of(name)[0] for name in names]
        return tuple(dict.fromkeys(files))


_FILE_KEYS = ("matrix", "changed", "vector")
"""Keys of the tables that name a file."""


def file_of(name: str) -> tuple[str, str]:
    """Return the file, and the matrix in it, that `FILE` or `FILE:MATRIX` names."""
    file, _, matrix = name.partition(":")
    return file, matrix
