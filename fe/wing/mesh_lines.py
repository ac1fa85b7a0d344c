"""Mesh lines of the wing: those that its parts require, and lines between them."""

import itertools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import MeshError

from .design import WingDesign, rib_interval

SMALLEST_GAP = 2e-4
"""Smallest distance of two mesh lines that the design requires [m]."""
_SAME = 1e-9


class MeshLine(NamedTuple):
    """A mesh line along the span, or across it.

    Attributes
    ----------
    fraction : float
        The position of the line as a fraction of the local chord; zero across the span.
    offset : float
        The distance of the line from this position [m].
    label : str
        The name of the line in messages.
    """

    fraction: float
    offset: float
    label: str = "between"

    def at(self, length: FloatArray | float) -> FloatArray:
        """Return the distance (...,) [m] of the line where the chord is `length` [m].

        It is measured from the leading edge; that of a line across the span from the root.
        """
        return np.asarray(self.fraction * length + self.offset)


class OptionalLine(NamedTuple):
    """A mesh line that is used if it crosses no other and none is nearer than `room` [m]."""

    line: MeshLine
    room: float


def _filled(
    required: Iterable[MeshLine],
    optional: Iterable[OptionalLine],
    chords: FloatArray,
    size: float,
) -> list[MeshLine]:
    """Fill a direction with mesh lines: the required ones, optional ones with room, lines between.

    Lines are compared at the chords (k,) [m]; `size` is the largest distance of neighbouring lines
    at the first chord [m]. Raises `MeshError` if required lines nearly coincide or cross.
    """
    lines = _distinct_lines(required, chords)
    for line, room in optional:
        if _has_room(line, room, lines, chords):
            lines.append(line)
    lines.sort(key=lambda line: line.at(chords)[0])
    filled = lines[:1]
    for start, end in itertools.pairwise(lines):
        filled += _lines_between(start, end, chords, size)
        filled.append(end)
    return filled


def _distinct_lines(required: Iterable[MeshLine], chords: FloatArray) -> list[MeshLine]:
    """Sort required lines and drop duplicates; raise `MeshError` if two are too close."""
    lines: list[MeshLine] = []
    for line in sorted(required, key=lambda line: (line.at(chords)[0], line.label)):
        if lines:
            previous_line = lines[-1]
            gaps = line.at(chords) - previous_line.at(chords)
            if np.abs(gaps).max() <= _SAME:
                continue
            if gaps.min() < SMALLEST_GAP:
                raise MeshError(
                    f"{line.label} and {previous_line.label} come closer than "
                    f"{SMALLEST_GAP * 1e3:g} mm or cross between root and tip, at "
                    f"{line.at(chords)[0]:.5f} m; move one of them or put them on the same line."
                )
        lines.append(line)
    return lines


def _has_room(line: MeshLine, room: float, lines: list[MeshLine], chords: FloatArray) -> bool:
    """Return whether a new line lies between others, crosses none and keeps its distance.

    The distance is `room` [m], at each of the chords.
    """
    other_positions = np.array([other_line.at(chords) for other_line in lines])
    gaps = line.at(chords) - other_positions
    is_behind = (gaps > 0.0).all(axis=1)
    is_ahead = (gaps < 0.0).all(axis=1)
    lies_between = bool(is_behind.any() and is_ahead.any())
    crosses_none = bool((is_behind | is_ahead).all())
    narrowest_gap = np.abs(gaps).min()
    keeps_distance = bool(narrowest_gap > room)
    return lies_between and crosses_none and keeps_distance


def _lines_between(
    start: MeshLine, end: MeshLine, chords: FloatArray, size: float
) -> list[MeshLine]:
    """Return evenly spaced mesh lines between two lines, excluding these.

    `size` is the largest distance of neighbouring lines at the first of the chords (k,) [m].
    """
    distance = (end.at(chords) - start.at(chords))[0]
    # 1e-9: a quotient that is an integer but for rounding errors needs no additional cell
    cell_count = max(1, int(np.ceil(distance / size - 1e-9)))
    fraction_difference = end.fraction - start.fraction
    offset_difference = end.offset - start.offset
    return [
        MeshLine(
            start.fraction + number / cell_count * fraction_difference,
            start.offset + number / cell_count * offset_difference,
        )
        for number in range(1, cell_count)
    ]


def _lines_beside(design: WingDesign, edges: list[MeshLine]) -> list[OptionalLine]:
    """Return optional lines on both sides of edges of defects, if the design has an edge size."""
    if design.mesh.edge_size is None:
        return []
    distance = design.mesh.edge_size / design.mesh.refinement
    lines = []
    for edge in edges:
        for offset in (-distance, distance):
            line = MeshLine(edge.fraction, edge.offset + offset)
            lines.append(OptionalLine(line, room=0.5 * distance))
    return lines


def span_lines(design: WingDesign) -> FloatArray:
    """Return the distances (ny + 1,) from the root [m] of the mesh lines that cross the span.

    They are the faces of ribs, the edges of defects, the ends of material bands, and lines between
    these.

    Raises
    ------
    MeshError
        If two lines that the design requires nearly coincide.
    """
    span = design.planform.semi_span
    settings = design.mesh
    edges = []
    for index, defect in enumerate(design.defects):
        edges.append(MeshLine(0.0, defect.span_start, f"the inner edge of defects[{index}]"))
        edges.append(MeshLine(0.0, defect.span_end, f"the outer edge of defects[{index}]"))
    rib_faces = []
    for index in range(len(design.ribs)):
        start, end = rib_interval(design, index)
        rib_faces.append(MeshLine(0.0, start, f"the inner face of ribs[{index}]"))
        rib_faces.append(MeshLine(0.0, end, f"the outer face of ribs[{index}]"))
    ends = [
        OptionalLine(MeshLine(0.0, fraction * span), room=0.1 * settings.span_size)
        for fraction in _material_ends(design)
    ]
    root = MeshLine(0.0, 0.0, "the root")
    tip = MeshLine(0.0, span, "the tip")
    lines = _filled(
        required=[root, tip, *rib_faces, *edges],
        optional=[*ends, *_lines_beside(design, edges)],
        chords=np.zeros(1),
        size=settings.span_size / settings.refinement,
    )
    return np.array([line.offset for line in lines])


def _material_ends(design: WingDesign) -> list[float]:
    """Return the fractions of the span where bands, rods and added densities end, ascending."""
    ends = {band.end for band in design.skin.bands}
    ends |= {rod.reach for rod in design.rods}
    ends |= {added.start for added in design.added_density}
    ends |= {added.end for added in design.added_density}
    return sorted(ends)


def web_faces(design: WingDesign, index: int) -> tuple[MeshLine, MeshLine]:
    """Return the front and the rear mesh line of a web.

    The first web lies aft of its chord fraction, the last one fore of it, and the others are
    centred on it.
    """
    web = design.webs[index]
    if index == 0:
        front = 0.0
    elif index == len(design.webs) - 1:
        front = -web.thickness
    else:
        front = -0.5 * web.thickness
    return (
        MeshLine(web.chord, front, f"the front of webs[{index}]"),
        MeshLine(web.chord, front + web.thickness, f"the rear of webs[{index}]"),
    )


def chord_lines(design: WingDesign) -> tuple[MeshLine, ...]:
    """Return the nx + 1 mesh lines that run along the span.

    They are the faces of webs, the edges of defects, the leading-edge wall, and lines between
    these.

    Raises
    ------
    MeshError
        If two lines that the design requires nearly coincide, or cross between root and tip.
    """
    planform = design.planform
    settings = design.mesh
    edges = []
    for index, defect in enumerate(design.defects):
        edges.append(MeshLine(defect.chord_start, 0.0, f"the front edge of defects[{index}]"))
        edges.append(MeshLine(defect.chord_end, 0.0, f"the rear edge of defects[{index}]"))
    required = list(edges)
    for index in range(len(design.webs)):
        required += web_faces(design, index)
    if design.skin.closed_leading_edge:
        thickness = design.skin.thickness
        required.append(MeshLine(design.front_chord, -thickness, "the leading-edge wall"))
    lines = _filled(
        required,
        optional=_lines_beside(design, edges),
        chords=np.array([planform.root_chord, planform.tip_chord]),
        size=settings.chord_size / settings.refinement * planform.root_chord,
    )
    return tuple(lines)


def cells_within(lines: FloatArray, intervals: Iterable[tuple[float, float]]) -> IntArray:
    """Return for each of n cells between lines the interval that contains its middle, -1 for none.

    Parameters
    ----------
    lines : (n + 1,) array
        Mesh lines, ascending.
    intervals : iterable of (float, float)
        Start and end of each interval.
    """
    middle = 0.5 * (lines[1:] + lines[:-1])
    interval_of_cell = np.full(len(middle), -1, dtype=np.int64)
    for number, (start, end) in enumerate(intervals):
        is_within = (middle > start) & (middle < end)
        interval_of_cell[is_within] = number
    return interval_of_cell


def web_cells(design: WingDesign, along: Iterable[MeshLine]) -> IntArray:
    """Return the web (nx,) of each cell between the mesh lines along the span, -1 for none."""
    root_chord = design.planform.root_chord
    intervals = []
    for index in range(len(design.webs)):
        front, rear = web_faces(design, index)
        start = float(front.at(root_chord))
        end = float(rear.at(root_chord))
        intervals.append((start, end))
    positions = np.array([line.at(root_chord) for line in along])
    return cells_within(positions, intervals)


def rib_cells(design: WingDesign, across: FloatArray) -> IntArray:
    """Return the rib (ny,) of each cell between the mesh lines across the span, -1 for none."""
    intervals = [rib_interval(design, index) for index in range(len(design.ribs))]
    return cells_within(across, intervals)
