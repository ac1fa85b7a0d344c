"""The box and the sandwich plate side by side: two idealisations of one design, nothing fitted to either."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fe.full.factorisation import Factorisation, lowest_eigenpairs, most_compliant_modes
from fe.runtime.state import Losses
from fe.wing.design import WingDesign
from fe.wing.operators import AffineOperators, AffineWing, assemble, point_masses

from .sandwich_plate import assemble_plate

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

DAMAGE = 0.8
"""Stiffness loss of either defect at which its effect is compared."""
MODES = 6
"""Number of modes compared."""


@dataclass(frozen=True)
class WingResults:
    """What a model says about a wing.

    Attributes
    ----------
    unknowns : int
        Free unknowns of the model.
    tip_stiffness : float
        Of the static test at e = 1 [N/m].
    tip_stiffness_slope : float
        d ln k / d ln e at e = 1.
    frequency : (6,) Hz
        Lowest frequencies at the nominal masses.
    first_bending, second_bending : float
        Those of the flapwise bending modes [Hz].
    strain : (gauges,) dimensionless
        At the load factor of the design's lift.
    strain_slope : (gauges,)
        d ln strain / d ln e at e = 1.
    damage_ratio : (2, gauges)
        Strain with a loss of `DAMAGE` in either defect, over the healthy strain.
    """

    unknowns: int
    tip_stiffness: float
    tip_stiffness_slope: float
    frequency: FloatArray
    first_bending: float
    second_bending: float
    strain: FloatArray
    strain_slope: FloatArray
    damage_ratio: FloatArray


@dataclass(frozen=True)
class PlateAgreement:
    """Box and plate of one design on the same mesh lines; differences are plate against box.

    Attributes
    ----------
    box, plate : WingResults
        What either says.
    at_edges : (gauges,) bool
        `gauges_at_edges` of the design.
    """

    box: WingResults
    plate: WingResults
    at_edges: BoolArray

    def relative(self, name: str) -> float:
        """Plate over box, less one, of a single figure of `WingResults`."""
        return float(getattr(self.plate, name) / getattr(self.box, name) - 1.0)

    @property
    def tip_stiffness_slope(self) -> float:
        """Difference of d ln k / d ln e."""
        return self.plate.tip_stiffness_slope - self.box.tip_stiffness_slope

    @property
    def strain(self) -> FloatArray:
        """Relative differences (gauges,) of the healthy strains."""
        return np.asarray(self.plate.strain / self.box.strain - 1.0)

    @property
    def strain_slope(self) -> FloatArray:
        """Differences (gauges,) of d ln strain / d ln e."""
        return np.asarray(self.plate.strain_slope - self.box.strain_slope)

    @property
    def damage_ratio(self) -> FloatArray:
        """Differences (2, gauges) of the strain ratios under damage."""
        return np.asarray(self.plate.damage_ratio - self.box.damage_ratio)


def compare_with_plate(
    design: WingDesign, box: AffineOperators | None = None, *, straight_section: bool = False
) -> PlateAgreement:
    """Evaluate both models of a design.

    The box's section is straight between its mesh lines, along the straight edges that are nearest to the
    airfoil in the sense of least squares (`fe.wing.mesh.straight_edged`). With the same section in the plate,
    what is left is the idealisation alone.

    Parameters
    ----------
    design : WingDesign
        The wing.
    box : AffineOperators, optional
        Its box, where that is at hand.
    straight_section : bool
        Whether the plate has the section of the box, or the true one.

    Raises
    ------
    MeshError
        If the mesh cannot hold what the design asks for.
    SolutionError
        If a solution is not accurate.
    """
    solid = assemble(design) if box is None else box
    plate = assemble_plate(design, straight_section=straight_section)
    return PlateAgreement(
        wing_results(solid, design),
        wing_results(plate, design),
        gauges_at_edges(design),
    )


def gauges_at_edges(design: WingDesign) -> BoolArray:
    """Whether the patch of each gauge (gauges,) comes near an edge of a defect region.

    Near is `mesh.edge_size`, whatever the refinement, so that the answer is the same on every mesh; without
    it, the largest cell along the span and along the chord. Over an edge the stiffness of the skin jumps, and
    strain with it; at a corner two idealisations do not agree on how it does.
    """
    plan, gauges, mesh = design.planform, design.gauges, design.mesh

    def chordwise(chord_fraction: float, distance: float) -> float:
        return (chord_fraction - plan.straight_chord_line) * plan.chord(distance / plan.semi_span)

    found = np.zeros(len(gauges.positions), dtype=bool)
    for gauge, (distance, chord_fraction) in enumerate(gauges.positions):
        local_chord = plan.chord(distance / plan.semi_span)
        near_span = mesh.span_size if mesh.edge_size is None else mesh.edge_size
        near_chord = mesh.chord_size * local_chord if mesh.edge_size is None else mesh.edge_size
        half_span = 0.5 * gauges.averaging_spanwise + near_span
        half_chord = 0.5 * gauges.averaging_chordwise + near_chord
        inner, outer = distance - half_span, distance + half_span
        middle = chordwise(chord_fraction, distance)

        def reached(ends: tuple[float, float], low: float, high: float) -> bool:
            return min(ends) <= high and max(ends) >= low

        for defect in design.defects:
            start, end = max(inner, defect.span_start), min(outer, defect.span_end)
            if start > end:
                continue
            chords = defect.chord_start, defect.chord_end
            # Front and rear edge over the shared part of the span, then the inner and the outer edge.
            edges = [(chordwise(chord, start), chordwise(chord, end)) for chord in chords]
            edges += [
                (chordwise(chords[0], place), chordwise(chords[1], place))
                for place in (defect.span_start, defect.span_end)
                if inner <= place <= outer
            ]
            found[gauge] |= any(reached(edge, middle - half_chord, middle + half_chord) for edge in edges)
    return found


def wing_results(model: AffineWing, design: WingDesign) -> WingResults:
    """Evaluate a model.

    Parameters
    ----------
    model : AffineWing
        Box or plate.
    design : WingDesign
        The wing, for its load factor and masses.
    """
    loads = np.column_stack((model.load_tip, design.lift.load_factor * model.load_lift))

    def strain(found: FloatArray) -> FloatArray:
        return np.asarray(model.gauge_output @ found[:, 1])

    def damaged(loss: Losses) -> FloatArray:
        return strain(Factorisation(model.stiffness(None, loss)).solve(loads))

    factors = Factorisation(model.stiffness())
    found = factors.solve(loads)
    # K = e K_skin + ...: the derivative of the solution with respect to e, at e = 1
    slope = -factors.solve(model.stiffness_terms[0].matrix @ found)
    tip, healthy = float(model.load_tip @ found[:, 0]), strain(found)
    mass = model.mass(point_masses(design.masses.servo, design.masses.pitot))
    values, shapes = lowest_eigenpairs(model.stiffness(), mass, MODES)
    frequency = np.sqrt(values) / (2.0 * np.pi)
    first, second = frequency[most_compliant_modes(model.load_tip, values, shapes)]
    return WingResults(
        unknowns=model.unknowns,
        tip_stiffness=1.0 / tip,
        tip_stiffness_slope=-float(model.load_tip @ slope[:, 0]) / tip,
        frequency=frequency,
        first_bending=float(first),
        second_bending=float(second),
        strain=healthy,
        strain_slope=strain(slope) / healthy,
        damage_ratio=np.stack(
            [damaged(tuple(loss)) / healthy for loss in DAMAGE * np.eye(len(model.regions))]
        ),
    )
