"""A body of finite elements, of a structure file or a wing: cells, what they are made of, what holds them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from scipy import sparse

from fe.elements.cells import CellMesh
from fe.elements.kinds import Rule
from fe.runtime.arrays import FloatArray, IntArray

from .affine import StiffnessTerm, designed
from .mesh import Supports
from .tables import StructureDesign

Mesh = TypeVar("Mesh", bound=CellMesh, covariant=True)


class PointMass(NamedTuple):
    """Mass [kg] at each of k points, by its name, and the shares (k, nodes) of the nodes in these points."""

    name: str
    mass: float
    shares: FloatArray


@dataclass(frozen=True)
class Body(Generic[Mesh]):
    """What is assembled.

    Attributes
    ----------
    mesh : CellMesh
        Nodes and cells.
    supports : Supports
        What is held, sprung and rigid.
    elasticity, density : (nc, 6, 6) Pa, (nc,) kg/m^3
        Of the cells, in space, nominal and undamaged.
    part : (nc,)
        Part of the stiffness that each cell belongs to.
    parts : tuple of (str or None, str or None)
        Parameter and damage region of each part.
    masses : tuple of PointMass
        Point masses with their nominal values.
    variation : (nc, q) or (1, 1)
        Elasticity at the points of the stiffness rule over that of the cell.
    mass_rule : points (q, 3) and weights (q,), optional
        Integration of the mass, by default that of the kind of the cells.
    """

    mesh: Mesh
    supports: Supports
    elasticity: FloatArray
    density: FloatArray
    part: IntArray
    parts: tuple[tuple[str | None, str | None], ...]
    masses: tuple[PointMass, ...]
    variation: FloatArray = field(default_factory=lambda: np.ones((1, 1)))
    mass_rule: Rule | None = None

    def stiffness(self, cells: IntArray) -> sparse.csr_array:
        """Stiffness (n, n) [N/m] of some of the cells on the free unknowns."""
        factor = np.broadcast_to(self.variation, (len(self.part), len(self.mesh.kind.stiffness_rule[1])))
        own = self.mesh.stiffness(cells, self.elasticity[cells], factor[cells])
        return (self.supports.expansion.T @ (own @ self.supports.expansion)).tocsr()

    @property
    def stiffness_terms(self) -> tuple[StiffnessTerm, ...]:
        """The parts in their order; springs are with the part of nothing, which comes last."""
        terms = {pair: self.stiffness(np.flatnonzero(self.part == n)) for n, pair in enumerate(self.parts)}
        springs, nothing = self.supports.stiffness, (None, None)
        if self.supports.springs.any():
            terms[nothing] = terms[nothing] + springs if nothing in terms else springs
        return tuple(StiffnessTerm(term, *pair) for pair, term in terms.items())

    @cached_property
    def cell_mass(self) -> sparse.csr_array:
        """Mass (nodes, nodes) [kg] of the cells, of one component."""
        return self.mesh.mass(np.arange(len(self.part)), self.density, self.mass_rule)

    @property
    def nodal_mass(self) -> FloatArray:
        """Share (nodes,) [kg] of each node in the mass of cells and nominal point masses."""
        heavy = (own.mass * own.shares.sum(axis=0) for own in self.masses)
        return sum(heavy, np.asarray(self.cell_mass.sum(axis=1)))

    def assembled(
        self, design: StructureDesign, loads: Iterable[FloatArray], outputs: Mapping[str, sparse.csr_array]
    ) -> dict[str, Any]:
        """Return fields of the affine model of the body, all but the hash, see `designed`."""
        three = sparse.eye_array(3)
        points = (sparse.csr_array(own.shares) for own in self.masses)
        masses = (sparse.kron(own.T @ own, three, format="csr") for own in points)
        mass = sparse.kron(self.cell_mass, three, format="csr")
        fields = designed(design, self.supports.expansion, mass, masses, loads, outputs)
        return fields | {"stiffness_terms": self.stiffness_terms, "body": self}
