"""A mesh with materials, supports and point masses."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from scipy import sparse

from fe.elements.cells import CellMesh
from fe.elements.kinds import Rule
from fe.runtime.arrays import FloatArray, IntArray

from .affine import StiffnessTerm
from .affine_fields import AffineFields, OutputRows, affine_fields
from .supports import Supports
from .tables import StructureDesign

Mesh = TypeVar("Mesh", bound=CellMesh, covariant=True)


class MassAtPoints(NamedTuple):
    """The same mass at each of k points.

    Attributes
    ----------
    mass : float
        The mass at each point [kg].
    weights : (k, nodes) array
        Weights of the nodes in the displacement of each point.
    """

    name: str
    mass: float
    weights: FloatArray


@dataclass(frozen=True)
class Body(Generic[Mesh]):
    """A mesh with materials, supports and point masses.

    Attributes
    ----------
    mesh : CellMesh
        Nodes and nc cells.
    supports : Supports
        The nodes that are held, sprung and rigid; n unknowns are free.
    elasticity : (nc, 6, 6) array
        Elasticity of the cells in space, nominal and undamaged [Pa].
    density : (nc,) array
        Density of the cells [kg/m^3].
    part : (nc,) array of int
        Part of the stiffness that each cell belongs to.
    parts : tuple of (str or None, str or None)
        Parameter and damage region of each part.
    masses : tuple of MassAtPoints
        Point masses with their nominal values.
    variation : (nc, q) or (1, 1) array
        Elasticity at the points of the stiffness rule over that of the cell.
    mass_rule : Rule, optional
        Integration of the mass; by default that of the kind of the cells.
    """

    mesh: Mesh
    supports: Supports
    elasticity: FloatArray
    density: FloatArray
    part: IntArray
    parts: tuple[tuple[str | None, str | None], ...]
    masses: tuple[MassAtPoints, ...]
    variation: FloatArray = field(default_factory=lambda: np.ones((1, 1)))
    mass_rule: Rule | None = None

    def stiffness(self, cells: IntArray) -> sparse.csr_array:
        """Return the stiffness (n, n) [N/m] of the given cells on the free unknowns."""
        point_count = len(self.mesh.kind.stiffness_rule.weights)
        shape = (len(self.part), point_count)
        factor = np.broadcast_to(self.variation, shape)
        stiffness = self.mesh.stiffness(cells, self.elasticity[cells], factor[cells])
        expansion = self.supports.expansion
        return (expansion.T @ (stiffness @ expansion)).tocsr()

    @property
    def stiffness_terms(self) -> tuple[StiffnessTerm, ...]:
        """The stiffness terms of the structure: one matrix for each pair of parameter and region.

        Springs of the supports are added to the term of the parameter that scales them and of no
        region. If there is no such term, it is appended.
        """
        terms = {}
        for number, pair in enumerate(self.parts):
            terms[pair] = self.stiffness(np.flatnonzero(self.part == number))
        for parameter, springs in self.supports.springs_by_parameter.items():
            pair = (parameter, None)
            stiffness = sparse.diags_array(springs).tocsr()
            terms[pair] = terms[pair] + stiffness if pair in terms else stiffness
        return tuple(
            StiffnessTerm(matrix, parameter, region)
            for (parameter, region), matrix in terms.items()
        )

    @cached_property
    def cell_mass(self) -> sparse.csr_array:
        """Mass (nodes, nodes) [kg] of the cells for one displacement component."""
        return self.mesh.mass(np.arange(len(self.part)), self.density, self.mass_rule)

    @property
    def nodal_mass(self) -> FloatArray:
        """Mass (nodes,) [kg] at each node: that of the cells, lumped, and nominal point masses."""
        nodal_masses: FloatArray = np.asarray(self.cell_mass.sum(axis=1))
        for point_mass in self.masses:
            nodal_masses = nodal_masses + point_mass.mass * point_mass.weights.sum(axis=0)
        return nodal_masses

    def affine_fields(
        self, design: StructureDesign, loads: Iterable[FloatArray], outputs: OutputRows
    ) -> AffineFields:
        """Return all fields of the affine model but the design, its hash and the stiffness terms.

        Parameters
        ----------
        loads : iterable of (full,) array
            Nodal loads, as in `fe.structure.affine_fields.affine_fields`.
        """
        components = sparse.eye_array(3)  # a mass acts equally along x, y and z
        mass = sparse.kron(self.cell_mass, components, format="csr")
        point_masses = []
        for point_mass in self.masses:
            weights = sparse.csr_array(point_mass.weights)
            nodal_mass = weights.T @ weights
            point_masses.append(sparse.kron(nodal_mass, components, format="csr"))
        return affine_fields(
            design,
            self.supports.expansion,
            mass,
            point_masses,
            loads,
            outputs,
            self.supports.motions,
        )
