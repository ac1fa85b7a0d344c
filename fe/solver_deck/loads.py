"""Read the loads of a deck: nodal forces and moments, gravity, and pressure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.structure.abaqus import KeywordBlock
from fe.structure.deck_text import fail, real, whole

from .linear_model import ROTATIONS, TRANSLATIONS, LinearModel, block_lines
from .pressures import (
    FaceForces,
    NodalForces,
    NotReadError,
    element_pressure,
    surface_pressure,
)
from .shell_sides import ShellGeometry, ShellSide

_SECTORS = 180
"""CalculiX models a sector of two degrees of an axisymmetric body; forces act on the whole."""


@dataclass
class DeckLoad:
    """A load of a deck.

    Attributes
    ----------
    name : str
        Name in the structure file.
    lines : list of str
        The lines of the deck that apply it.
    forces : dict
        Forces by node and direction, in the deck's unit.
    side_forces : dict of ShellSide to dict
        Forces on one side of the thickness of shells, at the shell's nodes.
    moments : dict
        Moments by node and direction 4, 5 or 6, in the deck's unit.
    acceleration : (3,) array or None
        Acceleration of gravity, in the deck's units.
    """

    name: str
    lines: list[str] = field(default_factory=list)
    forces: NodalForces = field(default_factory=dict)
    side_forces: dict[ShellSide, NodalForces] = field(default_factory=dict)
    moments: NodalForces = field(default_factory=dict)
    acceleration: FloatArray | None = None

    @property
    def acts(self) -> bool:
        """Whether the load is not zero."""
        tables = [self.forces, self.moments, *self.side_forces.values()]
        has_force = any(any(table.values()) for table in tables)
        return has_force or (self.acceleration is not None and bool(self.acceleration.any()))

    def add(self, other: "DeckLoad") -> None:
        """Add the lines and forces of another load."""
        self.lines += other.lines
        _add_forces(self.forces, other.forces)
        _add_forces(self.moments, other.moments)
        for side, forces in other.side_forces.items():
            _add_forces(self.side_forces.setdefault(side, {}), forces)
        if other.acceleration is not None:
            previous = 0.0 if self.acceleration is None else self.acceleration
            self.acceleration = other.acceleration + previous


@dataclass
class DeckLoads:
    """The loads that were read, and sentences on those that are left out."""

    loads: list[DeckLoad]
    remarks: list[str]


def read_loads(model: LinearModel) -> DeckLoads:
    """Return the loads of a deck, and remarks on what was left out.

    All forces of one kind in one step, such as its pressures, are one load. Steps of any kind are
    read. Values are those of the lines: curves over time do not count.
    """
    loads: list[DeckLoad] = []
    remarks: list[str] = []
    shells = ShellGeometry(model.mesh, model.blocks)
    steps_with_loads = [step for step in model.steps if any(_is_load(block) for block in step)]
    for number, step in enumerate(steps_with_loads, start=1):
        suffix = f"_{number}" if len(steps_with_loads) > 1 else ""
        in_step: dict[str, DeckLoad] = {}
        for block in step:
            if _is_load(block):
                _add_block(model, shells, block, in_step, suffix, remarks)
        loads += in_step.values()
    return DeckLoads([load for load in loads if load.acts], list(dict.fromkeys(remarks)))


def _is_load(block: KeywordBlock) -> bool:
    return block.keyword in ("CLOAD", "DLOAD", "DSLOAD")


def _add_block(
    model: LinearModel,
    shells: ShellGeometry,
    block: KeywordBlock,
    loads: dict[str, DeckLoad],
    suffix: str,
    remarks: list[str],
) -> None:
    """Add the lines of a *CLOAD, *DLOAD or *DSLOAD to the loads of a step, by kind."""
    for line in block.data:
        where, values = line
        try:
            load = _load_of_line(model, shells, block.keyword, where, values)
        except NotReadError as error:
            remarks.append(f"{where}: {error}")
            continue
        load.lines = block_lines(KeywordBlock(where, block.keyword, {}, [line]))
        loads.setdefault(load.name, DeckLoad(load.name + suffix)).add(load)


def _load_of_line(
    model: LinearModel, shells: ShellGeometry, keyword: str, where: str, values: Sequence[str]
) -> DeckLoad:
    """Return the load of a line, named by its kind; raise `NotReadError` if it is left out."""
    if keyword == "CLOAD":
        return _nodal_load(model, where, values)
    if keyword == "DSLOAD":
        return _pressure(surface_pressure(shells, where, values))
    if _entry(values, 1).upper() == "GRAV":
        return DeckLoad("gravity", acceleration=_gravity(model, where, values))
    return _pressure(element_pressure(shells, where, values))


def _pressure(forces: FaceForces) -> DeckLoad:
    """Return forces on faces as a load."""
    return DeckLoad("pressure", forces=forces.solid, side_forces=forces.sides)


def _add_forces(forces: NodalForces, added: Mapping[tuple[int, int], float]) -> None:
    """Add nodal forces to other ones, in place."""
    for dof, force in added.items():
        forces[dof] = forces.get(dof, 0.0) + force


def _entry(values: Sequence[str], number: int) -> str:
    """Return an entry of a line; empty if the line is shorter."""
    return values[number] if number < len(values) else ""


def _nodal_load(model: LinearModel, where: str, values: Sequence[str]) -> DeckLoad:
    """Return the forces or moments of a line of *CLOAD."""
    direction = whole(where, _entry(values, 1))
    value = real(where, _entry(values, 2))
    if direction not in (*TRANSLATIONS, *ROTATIONS):
        raise NotReadError("a flux is left out; only forces and moments are read")
    nodes = model.mesh.nodes_named(values[0], where)
    systems = [block for block in model.blocks if block.keyword == "TRANSFORM"]
    transformed = {
        node
        for block in systems
        for node in model.mesh.node_sets.get(block.parameters.get("NSET", "").upper(), ())
    }
    if transformed.intersection(nodes):
        raise NotReadError("a force in the axes of *TRANSFORM is left out; give it along x, y, z")
    axisymmetric = model.mesh.axisymmetric_nodes
    # a load on an axisymmetric model is that of the whole ring, of which one sector is computed
    at_nodes = {
        (node, direction): value / _SECTORS if node in axisymmetric else value for node in nodes
    }
    if direction in ROTATIONS:
        return DeckLoad("moment", moments=at_nodes)
    return DeckLoad("force", forces=at_nodes)


def _gravity(model: LinearModel, where: str, values: Sequence[str]) -> FloatArray:
    """Return the acceleration of a line of gravity, which must act on all elements."""
    magnitude, *direction = (real(where, _entry(values, number)) for number in (2, 3, 4, 5))
    elements = set(model.mesh.elements_named(values[0], where))
    missing = set(model.mesh.elements) - elements
    if missing:
        raise NotReadError(
            f"gravity is left out, because it does not act on all elements: {values[0]} lacks "
            f"{len(missing)} of {len(model.mesh.elements)}; let it act on all"
        )
    axis = np.array(direction)
    if not axis.any():
        fail(where, "gravity needs a direction, but its three components are zero.")
    return np.asarray(magnitude * axis / np.linalg.norm(axis))
