"""Full operators of the primitives of `fe.runtime.patch`: what a missing effect does to the full model.

Stations are the sections of the mesh that hold nodes: its lines along the span and the middles between them.
Forces and displacements of a section are those of lines along the span, the elastic line (the chord line of
the static test) and the webs; between two of them the section moves as a straight line, beyond the outermost
as the straight line through the last two, and a force goes to two lines by the law of the lever. A force
between two webs therefore does not dent the thin skin; nor would one in a test, where a clamp or a cord
around the section takes it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.wing.design import WingDesign

from .assembly import Discretisation, point_jacobians
from .operators import (
    AffineOperators,
    all_point_mass_weights,
    cell_density,
    cell_elasticity,
    gauge_output,
    modulus_variation,
    point_mass_weights,
    section_displacement,
)
from .turn_load import STANDARD_GRAVITY, inertia_relief, lift_load

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LEAST_LINE_DISTANCE = 0.1
"""Least distance between lines of a section, as a fraction of the chord."""


class TurnedStrain(Discretisation):
    """A discretisation that takes strains along a direction turned in the skin by `angle` [rad].

    From the spanwise direction towards the tip's rear: with angle pi/2, `gauge_output` gives
    the strain across the gauges, at the same points and with the same weights.
    """

    angle: float

    @classmethod
    def of(cls, discretisation: Discretisation, angle: float) -> "TurnedStrain":
        """Return the same degrees of freedom, strains turned."""
        turned = cls(discretisation.mesh)
        turned.__dict__.update(discretisation.__dict__)  # its caches too
        turned.__dict__["angle"] = angle
        return turned

    def strain_along(
        self, cells: IntArray, local: FloatArray, direction: FloatArray
    ) -> tuple[IntArray, FloatArray]:
        """Unknowns (p, 60) and weights (p, 60) [1/m] of the strain along the turned directions."""
        jacobian = point_jacobians(self.mesh.p.T[self.mesh.t.T][cells], local)
        normal = np.cross(jacobian[:, :, 0], jacobian[:, :, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        aft = np.cross(direction, normal)
        return super().strain_along(cells, local, np.cos(self.angle) * direction + np.sin(self.angle) * aft)


@dataclass(frozen=True)
class PatchOperators:
    """Operators of the primitives on the n free unknowns of the wing, P stations, G gauges.

    Attributes
    ----------
    operators : AffineOperators
        The wing that they belong to.
    stations : (P,) m
        Distances of the sections from the root, ascending.
    line_chord : (L,)
        Chord fractions of the elastic line and of the other lines, ascending.
    line_rows : tuple of L + 2 csr (P, n)
        Displacement of the elastic line along x, y and z, and of the other lines along z, at the stations.
    lift_rows : csr (P, n) N
        Load of load factor 1 without the weight, by stations of its nodes.
    weight : (n,) N
        Weight of structure and nominal point masses, downwards.
    strain_rows : tuple of csr (G, n) 1/m
        Strain across the gauges, and engineering shear strain between span and chord, with the sign and at
        the points of `AffineOperators.gauge_output`.
    strip_lines : (S + 1,) m
        Edges of the strips, which are mesh lines.
    strip_stiffness : tuple of csr (n, n) N/m
        Parts of the stiffness terms of the skin that lie in the strips.
    strip_of, term_of : (T,)
        Strip, and stiffness term (skin, damage regions), of each of these parts.
    flap : int
        Unknown that is the flapping rotation of the root.
    flap_spring : float
        Its spring [N m/rad].
    """

    operators: AffineOperators
    stations: FloatArray
    line_chord: FloatArray
    line_rows: tuple[sparse.csr_array, ...]
    lift_rows: sparse.csr_array
    weight: FloatArray
    strain_rows: tuple[sparse.csr_array, sparse.csr_array]
    strip_lines: FloatArray
    strip_stiffness: tuple[sparse.csr_array, ...]
    strip_of: IntArray
    term_of: IntArray
    flap: int
    flap_spring: float


def section_lines(design: WingDesign) -> tuple[float, ...]:
    """Return the chord fractions of the elastic line and of the webs that are other lines, ascending."""
    elastic = design.tip_load.chord
    webs = sorted((web.chord for web in design.webs), key=lambda chord: abs(chord - elastic))
    lines = [elastic]
    for chord in webs:  # the nearest first: what is too near to one gives no lever
        if min(abs(chord - line) for line in lines) >= LEAST_LINE_DISTANCE:
            lines.append(chord)
    return elastic, *sorted(lines[1:])


def strip_edges(lines: FloatArray, count: int) -> FloatArray:
    """Return at most `count` + 1 of the mesh lines, ends included, that part the span most evenly."""
    if count >= len(lines) - 1:
        return np.array(lines)
    wanted = np.linspace(lines[0], lines[-1], count + 1)
    nearest = np.abs(lines[:, np.newaxis] - wanted).argmin(axis=0)
    return np.asarray(lines[np.unique(nearest)])


def assemble_patch_operators(operators: AffineOperators, strip_count: int = 64) -> PatchOperators:
    """Assemble the operators of the primitives for a wing.

    Parameters
    ----------
    operators : AffineOperators
        The wing.
    strip_count : int
        Largest number of strips of the skin.
    """
    mesh, discretisation = operators.wing_mesh, operators.discretisation
    design, expansion = mesh.design, operators.expansion
    restriction = expansion.T.tocsr()
    lines = mesh.span_lines
    stations = np.sort(np.concatenate([lines, 0.5 * (lines[1:] + lines[:-1])]))
    chords = section_lines(design)

    def rows(chord: float, component: int) -> sparse.csr_array:
        weights = [section_displacement(mesh, discretisation, place, chord) for place in stations]
        nodal = sparse.csr_array(np.array(weights))
        spread = sparse.kron(nodal, sparse.csr_array(np.eye(3)[component : component + 1]))
        return sparse.csr_array(spread @ expansion)

    density = cell_density(mesh)
    nodal_mass = discretisation.nodal_mass(density)
    for place in design.point_masses:
        nodal_mass += getattr(design.masses, place.kind) * point_mass_weights(mesh, discretisation, place)
    full_weight = np.zeros(discretisation.unknowns)
    full_weight[2::3] = -STANDARD_GRAVITY * nodal_mass
    weight = np.asarray(restriction @ full_weight)
    lift = _full_lift(operators, full_weight)
    node_station = np.abs(discretisation.node_points[:, 1:2] - stations).argmin(axis=1)
    unknown = np.arange(discretisation.unknowns)
    by_station = sparse.coo_array(
        (lift, (np.repeat(node_station, 3), unknown)), shape=(len(stations), len(lift))
    ).tocsr()

    along = operators.gauge_output
    across, diagonal = (
        sparse.csr_array(gauge_output(mesh, TurnedStrain.of(discretisation, angle)) @ expansion)
        for angle in (0.5 * np.pi, 0.25 * np.pi)
    )

    edges = strip_edges(lines, strip_count)
    strips = np.searchsorted(edges, mesh.centres[:, 1]) - 1
    elasticity, variation = cell_elasticity(mesh), modulus_variation(mesh)
    parts, strip_of, term_of = [], [], []
    for strip in range(len(edges) - 1):
        for term in range(len(design.regions) + 1):
            cells = np.flatnonzero((strips == strip) & (mesh.stiffness_term == term))
            if cells.size:
                matrix = discretisation.stiffness(cells, elasticity[cells], variation[cells])
                parts.append(sparse.csr_array(restriction @ (matrix @ expansion)))
                strip_of.append(strip)
                term_of.append(term)
    return PatchOperators(
        operators=operators,
        stations=stations,
        line_chord=np.array(chords),
        line_rows=(
            *(rows(chords[0], component) for component in range(3)),
            *(rows(chord, 2) for chord in chords[1:]),
        ),
        lift_rows=sparse.csr_array(by_station @ expansion),
        weight=weight,
        strain_rows=(across, sparse.csr_array(2.0 * diagonal - along - across)),
        strip_lines=edges,
        strip_stiffness=tuple(parts),
        strip_of=np.array(strip_of),
        term_of=np.array(term_of),
        flap=operators.unknowns - 2,
        flap_spring=design.root.flap_spring,
    )


def _full_lift(operators: AffineOperators, weight: FloatArray) -> FloatArray:
    """Return the load (full,) [N] of load factor 1 without the weight that the design's load holds."""
    mesh, discretisation = operators.wing_mesh, operators.discretisation
    lift = lift_load(mesh, discretisation)
    if not mesh.design.lift.inertia_relief:
        return lift
    places = all_point_mass_weights(mesh, discretisation)
    return lift + inertia_relief(mesh.design, discretisation, cell_density(mesh), places, lift) - weight
