"""Operators of the full wing model for the primitives of `fe.runtime.patch`.

Stations are the sections of the mesh that contain nodes: its lines across the span and the middles
between them. Forces and displacements of a section are those of lines along the span: the elastic
line (the chord line of the static test) and the webs. Between two of them the section moves as a
straight line, beyond the outermost as the straight line through the last two. A force is shared by
two lines by the law of the lever, so that a force between two webs does not dent the thin skin; nor
would one in a test, where a clamp or a cord around the section takes it.
"""

from dataclasses import dataclass
from typing import NamedTuple, TypedDict

import numpy as np
from scipy import sparse

from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.state import STANDARD_GRAVITY

from .design import WingDesign
from .gauges import gauge_output
from .mesh import WingMesh
from .operators import AffineOperators, section_displacement, turn_load, upward

LEAST_LINE_DISTANCE = 0.1
"""Smallest distance between lines of a section, as a fraction of the chord."""


class LineRows(NamedTuple):
    """Displacements of lines along the span at P stations, as rows on the n free unknowns.

    Attributes
    ----------
    elastic_x, elastic_y, elastic_z : csr (P, n)
        The elastic line, along each axis.
    others_z : tuple of csr (P, n)
        The other lines, upwards.
    """

    elastic_x: sparse.csr_array
    elastic_y: sparse.csr_array
    elastic_z: sparse.csr_array
    others_z: tuple[sparse.csr_array, ...]

    @property
    def stacked(self) -> tuple[sparse.csr_array, ...]:
        """The rows in the order of `PatchArrays.line_rows`."""
        return (self.elastic_x, self.elastic_y, self.elastic_z, *self.others_z)


class StrainRows(NamedTuple):
    """Strains at the G gauges as rows on the n free unknowns, positive as measured.

    Attributes
    ----------
    along, across : csr (G, n)
        Strain along the span, and across it.
    shear : csr (G, n)
        Engineering shear strain.
    """

    along: sparse.csr_array
    across: sparse.csr_array
    shear: sparse.csr_array


class WingLayout(TypedDict):
    """The fields of `fe.runtime.wing_rows.PatchArrays` that do not depend on a basis."""

    strip_lines: FloatArray
    strip_of: IntArray
    term_of: IntArray
    flap_spring: float
    semi_span: float
    root_chord: float
    tip_chord: float
    straight_chord_line: float
    load_place: float
    stations: FloatArray
    line_chord: FloatArray
    station_weights: FloatArray
    gauge_stations: FloatArray
    gauge_length: float


@dataclass(frozen=True)
class PatchOperators:
    """The content of `fe.runtime.wing_rows.PatchArrays` on the n free unknowns.

    Attributes
    ----------
    layout : WingLayout
        Positions and lengths, which are the same in every basis.
    line_rows : LineRows
        Displacements of the lines along the span.
    strain_rows : StrainRows
        Strains at the gauges.
    lift_rows : csr (P, n)
        Lift of load factor 1 at each station, without the weight [N].
    weight : (n,) array
        Weight, downwards [N].
    flap_row : (n,) array
        Flapping rotation of the root [rad].
    strips : tuple of csr (n, n)
        The parts of the skin's stiffness terms that lie in the strips between mesh lines [N/m].
    """

    operators: AffineOperators
    layout: WingLayout
    line_rows: LineRows
    strain_rows: StrainRows
    lift_rows: sparse.csr_array
    weight: FloatArray
    flap_row: FloatArray
    strips: tuple[sparse.csr_array, ...]


class _SkinStrips(NamedTuple):
    """The T parts of the skin's stiffness, each of one strip and one stiffness term.

    Attributes
    ----------
    strip_of, term_of : (T,) array of int
        Strip and stiffness term of each part.
    stiffness : tuple of csr (n, n)
        The stiffness of each part [N/m].
    """

    strip_of: IntArray
    term_of: IntArray
    stiffness: tuple[sparse.csr_array, ...]


def area_weights(stations: FloatArray, root_chord: float, tip_chord: float) -> FloatArray:
    """Return the weights (P,) of a mean over the planform, by Simpson's rule along the span.

    Parameters
    ----------
    stations : (P,) array
        Distances from the root [m], P odd: the ends of the intervals and, between two ends, the
        middle of the interval.
    root_chord, tip_chord : float
        The chords [m]; between them the chord is linear.
    """
    length = stations[2::2] - stations[:-2:2]
    weights = np.zeros(len(stations))
    # Simpson's weights 1, 4, 1 of each interval; a station between two intervals belongs to both
    weights[:-2:2] += length
    weights[1::2] += 4.0 * length
    weights[2::2] += length
    chord = root_chord + (tip_chord - root_chord) * stations / stations[-1]
    weights *= chord
    return np.asarray(weights / weights.sum())


def section_lines(design: WingDesign) -> tuple[float, ...]:
    """Return the chord fractions of the lines along the span on which forces act.

    The elastic line comes first, then webs in ascending order. A web closer to another line than
    `LEAST_LINE_DISTANCE` is left out, since a moment would need large opposite forces on a short
    lever arm. Of two webs that are close together, the one nearer to the elastic line is kept.
    """
    elastic_line = design.tip_load.chord
    webs = sorted((web.chord for web in design.webs), key=lambda web: abs(web - elastic_line))
    lines = [elastic_line]
    for web in webs:
        if min(abs(web - line) for line in lines) >= LEAST_LINE_DISTANCE:
            lines.append(web)
    return elastic_line, *sorted(lines[1:])


def assemble_patch_operators(operators: AffineOperators) -> PatchOperators:
    """Assemble the operators that change a wing: rows, loads and stiffness for patches."""
    mesh = operators.wing_mesh
    design = mesh.design
    planform = design.planform
    lines = mesh.span_lines
    stations = np.sort(np.concatenate([lines, 0.5 * (lines[1:] + lines[:-1])]))
    line_chords = section_lines(design)
    strips = _skin_strips(operators)
    weight = -STANDARD_GRAVITY * upward(operators.body.nodal_mass)
    flap_row = np.zeros(operators.unknowns)
    flap_row[-2] = 1.0  # the last three unknowns are heave, flap and yaw of the root
    return PatchOperators(
        operators,
        layout={
            "strip_lines": np.array(lines),
            "strip_of": strips.strip_of,
            "term_of": strips.term_of,
            "flap_spring": design.root.flap_spring,
            "semi_span": planform.semi_span,
            "root_chord": planform.root_chord,
            "tip_chord": planform.tip_chord,
            "straight_chord_line": planform.straight_chord_line,
            "load_place": planform.semi_span - design.tip_load.distance_from_tip,
            "stations": stations,
            "line_chord": np.array(line_chords),
            "station_weights": area_weights(stations, planform.root_chord, planform.tip_chord),
            "gauge_stations": np.array([distance for distance, _ in design.gauges.positions]),
            "gauge_length": design.gauges.averaging_spanwise,
        },
        line_rows=_line_rows(mesh, stations, line_chords, operators.expansion),
        strain_rows=_strain_rows(operators),
        lift_rows=_lift_rows(operators, weight, stations),
        weight=np.asarray(operators.expansion.T.tocsr() @ weight),
        flap_row=flap_row,
        strips=strips.stiffness,
    )


def _line_rows(
    mesh: WingMesh, stations: FloatArray, chords: tuple[float, ...], expansion: sparse.csr_array
) -> LineRows:
    """Return the rows that give displacements of the elastic line and the other lines.

    Each has a row for each of the stations (P,), and a column for each unknown.
    """

    def rows(chord: float, component: int) -> sparse.csr_array:
        nodal_weights = np.array(
            [section_displacement(mesh, station, chord) for station in stations]
        )
        return sparse.csr_array(sparse.csr_array(nodal_weights) @ expansion[component::3])

    elastic_chord, *other_chords = chords
    return LineRows(
        elastic_x=rows(elastic_chord, 0),
        elastic_y=rows(elastic_chord, 1),
        elastic_z=rows(elastic_chord, 2),
        others_z=tuple(rows(chord, 2) for chord in other_chords),
    )


def _strain_rows(operators: AffineOperators) -> StrainRows:
    """Return the strains of the gauges along the span, across it, and in shear.

    The shear strain follows from the strain at 45 degrees, as in a rosette: that strain is
    (along + across + shear) / 2.
    """
    mesh = operators.wing_mesh
    along = operators.gauge_output
    across = gauge_output(mesh, 0.5 * np.pi) @ operators.expansion
    diagonal = gauge_output(mesh, 0.25 * np.pi) @ operators.expansion
    return StrainRows(along, across, sparse.csr_array(2.0 * diagonal - along - across))


def _lift_rows(
    operators: AffineOperators, weight: FloatArray, stations: FloatArray
) -> sparse.csr_array:
    """Divide the lift at load factor 1 among the stations along the span: (P, n) [N].

    The force at each node is assigned to the nearest station; the sum of the rows is the lift
    without the weight. `weight` (3 nodes,) is the weight at all nodes, negative as it points
    downwards [N].
    """
    mesh = operators.wing_mesh
    lift_of_unknowns = turn_load(operators.body)
    if mesh.design.lift.inertia_relief:  # the turn's load is then lift + weight
        lift_of_unknowns = lift_of_unknowns - weight
    _, span_position, _ = mesh.points.T
    nearest_station = np.abs(span_position[:, np.newaxis] - stations).argmin(axis=1)
    # each node has three unknowns, which go to the same station
    rows_and_columns = (np.repeat(nearest_station, 3), np.arange(mesh.unknowns))
    lift_by_station = sparse.coo_array(
        (lift_of_unknowns, rows_and_columns), shape=(len(stations), len(lift_of_unknowns))
    ).tocsr()
    return sparse.csr_array(lift_by_station @ operators.expansion)


def _skin_strips(operators: AffineOperators) -> _SkinStrips:
    """Divide the stiffness of the skin among strips between mesh lines, and stiffness terms."""
    mesh = operators.wing_mesh
    _, centre_position, _ = mesh.centres.T
    strip_of_cell = np.searchsorted(mesh.span_lines, centre_position) - 1
    is_skin = mesh.stiffness_term <= len(mesh.design.regions)
    skin_cells = np.flatnonzero(is_skin)
    strip_and_term = np.stack((strip_of_cell, mesh.stiffness_term), axis=1)
    parts, part_of_cell = np.unique(
        strip_and_term[skin_cells],
        axis=0,
        return_inverse=True,
    )
    strip_of, term_of = parts.T
    stiffness = []
    for part in range(len(parts)):
        cells_of_part = skin_cells[part_of_cell == part]
        stiffness.append(operators.body.stiffness(cells_of_part))
    return _SkinStrips(strip_of, term_of, tuple(stiffness))
