"""The box and the sandwich plate side by side: two idealisations of one design, neither fitted."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fe.full.factorisation import Factorisation, lowest_eigenpairs, most_compliant_modes
from fe.wing.design import WingDesign
from fe.wing.operators import AffineOperators, AffineWing, assemble, point_masses
from fe.wing.parts import Defect

from .sandwich_plate import assemble_plate

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

DAMAGE = 0.8
"""Stiffness loss of either defect at which its effect is compared."""
MODES = 6
"""Number of modes compared."""


@dataclass(frozen=True)
class WingResults:
    """Results of a model of a wing.

    Attributes
    ----------
    unknowns : int
        Number of free unknowns of the model.
    tip_stiffness : float
        Stiffness [N/m] k in the static test at e = 1.
    tip_stiffness_slope : float
        d ln k / d ln e at e = 1.
    frequency : (6,) array
        Lowest frequencies [Hz] at the nominal masses.
    first_bending, second_bending : float
        Frequencies [Hz] of the flapwise bending modes.
    strain : (gauges,) array
        Strains [1] at the load factor of the design's lift.
    strain_slope : (gauges,) array
        d ln strain / d ln e at e = 1.
    damage_ratio : (2, gauges) array
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
    """Results of box and plate of one design on the same mesh lines.

    Differences are those of the plate from the box.

    Attributes
    ----------
    box, plate : WingResults
        Results of either model.
    at_edges : (gauges,) array of bool
        Whether the patch of a gauge comes near an edge of a defect; see `gauges_at_edges`.
    """

    box: WingResults
    plate: WingResults
    at_edges: BoolArray

    def relative(self, name: str) -> float:
        """Return the relative difference of a figure of `WingResults`, given its name."""
        plate_figure = getattr(self.plate, name)
        box_figure = getattr(self.box, name)
        return float(plate_figure / box_figure - 1.0)

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

    The section of the box is straight between its mesh lines, along the straight edges that are
    nearest to the airfoil in the sense of least squares (`fe.wing.mesh.straight_edged`). If the
    plate has the same section, the differences come from the idealisation alone.

    Parameters
    ----------
    design : WingDesign
        The wing.
    box : AffineOperators, optional
        Box of the design; assembled if not given.
    straight_section : bool
        Whether the plate has the section of the box, or the true one.

    Raises
    ------
    MeshError
        If the mesh cannot hold what the design asks for.
    SolutionError
        If a solution is not accurate.
    """
    box = assemble(design) if box is None else box
    plate = assemble_plate(design, straight_section=straight_section)
    return PlateAgreement(
        box=wing_results(box, design),
        plate=wing_results(plate, design),
        at_edges=gauges_at_edges(design),
    )


class _Interval(NamedTuple):
    """An interval of positions [m], from low to high."""

    low: float
    high: float

    def holds(self, position: float) -> bool:
        """Return whether a position lies in the interval."""
        return self.low <= position <= self.high

    def overlap(self, low: float, high: float) -> "_Interval":
        """Return the overlap with another interval; its low exceeds its high if there is none."""
        return _Interval(max(self.low, low), min(self.high, high))

    def touches(self, positions: tuple[float, float]) -> bool:
        """Return whether the interval between two positions, in any order, touches this one."""
        return min(positions) <= self.high and max(positions) >= self.low


def gauges_at_edges(design: WingDesign) -> BoolArray:
    """Return whether the patch of each gauge (gauges,) comes near an edge of a defect region.

    Near means within `mesh.edge_size` at any refinement, so that the answer is the same on every
    mesh. If the design has no such size, it means within the largest cell along the span and along
    the chord. Over an edge the stiffness of the skin jumps, and the strain with it. At a corner,
    two idealisations do not agree on the jump.
    """
    plan = design.planform
    gauges = design.gauges
    mesh = design.mesh
    at_edge = np.zeros(len(gauges.positions), dtype=bool)
    for gauge, (distance, chord_fraction) in enumerate(gauges.positions):
        if mesh.edge_size is None:
            near_span = mesh.span_size
            near_chord = mesh.chord_size * plan.chord(distance / plan.semi_span)
        else:
            near_span = mesh.edge_size
            near_chord = mesh.edge_size
        half_span = 0.5 * gauges.averaging_spanwise + near_span
        half_chord = 0.5 * gauges.averaging_chordwise + near_chord
        middle = _chordwise_position(design, chord_fraction, distance)
        span = _Interval(distance - half_span, distance + half_span)
        chord = _Interval(middle - half_chord, middle + half_chord)
        at_edge[gauge] = any(
            chord.touches(edge)
            for defect in design.defects
            for edge in _edges_within(design, defect, span)
        )
    return at_edge


def _edges_within(
    design: WingDesign, defect: Defect, span: _Interval
) -> Iterator[tuple[float, float]]:
    """Yield the chordwise positions [m] of both ends of each edge of a defect within a span.

    Parameters
    ----------
    design : WingDesign
        The wing.
    defect : Defect
        The defect.
    span : _Interval
        Interval of distances from the root [m].
    """
    overlap = span.overlap(defect.span_start, defect.span_end)
    if overlap.low > overlap.high:
        return
    # Front and rear edge over the overlap
    for fraction in (defect.chord_start, defect.chord_end):
        yield (
            _chordwise_position(design, fraction, overlap.low),
            _chordwise_position(design, fraction, overlap.high),
        )
    # Inner and outer edge
    for distance in (defect.span_start, defect.span_end):
        if span.holds(distance):
            yield (
                _chordwise_position(design, defect.chord_start, distance),
                _chordwise_position(design, defect.chord_end, distance),
            )


def _chordwise_position(design: WingDesign, chord_fraction: float, distance: float) -> float:
    """Return the position aft of the straight chord line [m] at a chord fraction and a distance."""
    plan = design.planform
    chord = plan.chord(distance / plan.semi_span)
    return (chord_fraction - plan.straight_chord_line) * chord


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

    # Both load cases, and their derivatives at e = 1, where K = e K_skin + ...
    factors = Factorisation(model.stiffness())
    solutions = factors.solve(loads)
    slopes = -factors.solve(model.stiffness_terms[0].matrix @ solutions)
    under_tip_force, in_turn = solutions.T
    slope_under_tip_force, slope_in_turn = slopes.T
    tip_flexibility = float(model.load_tip @ under_tip_force)
    tip_flexibility_slope = float(model.load_tip @ slope_under_tip_force)
    healthy_strain = np.asarray(model.gauge_output @ in_turn)
    strain_slope = np.asarray(model.gauge_output @ slope_in_turn)

    damage_ratios = []
    for loss in DAMAGE * np.eye(len(model.regions)):
        damaged = Factorisation(model.stiffness(None, tuple(loss)))
        _, damaged_in_turn = damaged.solve(loads).T
        damage_ratios.append(np.asarray(model.gauge_output @ damaged_in_turn) / healthy_strain)

    # Modes
    mass = model.mass(point_masses(design.masses.servo, design.masses.pitot))
    eigenvalues, shapes = lowest_eigenpairs(model.stiffness(), mass, MODES)
    frequency = np.sqrt(eigenvalues) / (2.0 * np.pi)
    bending_modes = most_compliant_modes(model.load_tip, eigenvalues, shapes)
    first_bending, second_bending = frequency[bending_modes]
    return WingResults(
        unknowns=model.unknowns,
        tip_stiffness=1.0 / tip_flexibility,
        tip_stiffness_slope=-tip_flexibility_slope / tip_flexibility,
        frequency=frequency,
        first_bending=float(first_bending),
        second_bending=float(second_bending),
        strain=healthy_strain,
        strain_slope=strain_slope / healthy_strain,
        damage_ratio=np.stack(damage_ratios),
    )
