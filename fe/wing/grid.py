"""Mesh lines of the wing: those that its parts ask for, and lines between them."""

import itertools
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import MeshError

from .design import WingDesign, rib_interval

SMALLEST_GAP = 2e-4
"""Two mesh lines that the design asks for may not lie closer than this [m]."""
_SAME = 1e-9


class MeshLine(NamedTuple):
    """Mesh line at `fraction` of a length, moved by `offset` [m]: of the local chord, or of nothing."""

    fraction: float
    offset: float
    label: str = "between"

    def at(self, length: FloatArray | float) -> FloatArray:
        """Distance (...,) [m] from the leading edge where the chord is `length` [m]; else from the root."""
        return np.asarray(self.fraction * length + self.offset)


def _filled(
    firm: Iterable[MeshLine],
    wished: Iterable[tuple[MeshLine, float]],
    lengths: FloatArray,
    size: float,
) -> list[MeshLine]:
    """Return the firm lines, of those wished the ones with room, and lines between, `size` apart at most.

    Parameters
    ----------
    firm : iterable of MeshLine
        What the design asks for; of two on the same place one is kept.
    wished : iterable of (MeshLine, float)
        Lines, taken where they cross no other and all others are farther than a distance [m].
    lengths : (k,) m
        The chords at root and tip, of which all lines are seen.
    size : float
        Largest cell [m] at the first of them.

    Raises
    ------
    MeshError
        If firm lines nearly coincide or cross.
    """
    lines: list[MeshLine] = []
    for line in sorted(firm, key=lambda line: (line.at(lengths)[0], line.label)):
        if lines:
            gaps = line.at(lengths) - lines[-1].at(lengths)
            if np.abs(gaps).max() <= _SAME:
                continue
            if gaps.min() < SMALLEST_GAP:
                raise MeshError(
                    f"{line.label} and {lines[-1].label} come closer than {SMALLEST_GAP * 1e3:g} mm or cross "
                    f"between root and tip, at {line.at(lengths)[0]:.5f} m; move one of them or put them on "
                    "the same line."
                )
        lines.append(line)
    for line, room in wished:
        gaps = line.at(lengths) - np.array([other.at(lengths) for other in lines])
        before, behind = (gaps > 0.0).all(axis=1), (gaps < 0.0).all(axis=1)
        if before.any() and behind.any() and (before | behind).all() and np.abs(gaps).min() > room:
            lines.append(line)
    lines.sort(key=lambda line: line.at(lengths)[0])
    filled = lines[:1]
    for start, end in itertools.pairwise(lines):
        count = max(1, int(np.ceil((end.at(lengths) - start.at(lengths))[0] / size - 1e-9)))
        steps = (end.fraction - start.fraction, end.offset - start.offset)
        filled += [
            MeshLine(start.fraction + n / count * steps[0], start.offset + n / count * steps[1])
            for n in range(1, count)
        ]
        filled.append(end)
    return filled


def _beside(design: WingDesign, edges: list[MeshLine]) -> list[tuple[MeshLine, float]]:
    """Lines on both sides of the edges of defects, where the design asks for small cells."""
    if design.mesh.edge_size is None:
        return []
    edge = design.mesh.edge_size / design.mesh.refinement
    return [
        (MeshLine(line.fraction, line.offset + side), 0.5 * edge) for line in edges for side in (-edge, edge)
    ]


def span_lines(design: WingDesign) -> FloatArray:
    """Mesh lines across the span (ny + 1,) [m]: rib faces, defect edges, band ends, and lines between.

    Raises
    ------
    MeshError
        If two lines that the design asks for nearly coincide.
    """
    span, mesh = design.planform.semi_span, design.mesh
    edges = [
        MeshLine(0.0, place, f"the {side} edge of defects[{index}]")
        for index, defect in enumerate(design.defects)
        for place, side in ((defect.span_start, "inner"), (defect.span_end, "outer"))
    ]
    ribs = [
        MeshLine(0.0, place, f"the {side} face of ribs[{index}]")
        for index in range(len(design.ribs))
        for place, side in zip(rib_interval(design, index), ("inner", "outer"), strict=True)
    ]
    ends = {band.end for band in design.skin.bands} | {rod.reach for rod in design.rods}
    ends |= {place for added in design.added_density for place in (added.start, added.end)}
    soft = [(MeshLine(0.0, place * span), 0.1 * mesh.span_size) for place in sorted(ends)]
    firm = [MeshLine(0.0, 0.0, "the root"), MeshLine(0.0, span, "the tip"), *ribs, *edges]
    found = _filled(firm, [*soft, *_beside(design, edges)], np.zeros(1), mesh.span_size / mesh.refinement)
    return np.array([line.offset for line in found])


def web_faces(design: WingDesign, index: int) -> tuple[MeshLine, MeshLine]:
    """Front and rear mesh line of a web: the first web lies behind its chord, the last before it."""
    web = design.webs[index]
    front = {0: 0.0, len(design.webs) - 1: -web.thickness}.get(index, -0.5 * web.thickness)
    return (
        MeshLine(web.chord, front, f"the front of webs[{index}]"),
        MeshLine(web.chord, front + web.thickness, f"the rear of webs[{index}]"),
    )


def chord_lines(design: WingDesign) -> tuple[MeshLine, ...]:
    """Mesh lines along the span: web faces, defect edges, the leading-edge wall, and lines between.

    Raises
    ------
    MeshError
        If two lines that the design asks for nearly coincide or cross between root and tip.
    """
    plan, mesh = design.planform, design.mesh
    edges = [
        MeshLine(place, 0.0, f"the {side} edge of defects[{index}]")
        for index, defect in enumerate(design.defects)
        for place, side in ((defect.chord_start, "front"), (defect.chord_end, "rear"))
    ]
    firm = [*(face for index in range(len(design.webs)) for face in web_faces(design, index)), *edges]
    if design.skin.closed_leading_edge:
        firm.append(MeshLine(design.front_chord, -design.skin.thickness, "the leading-edge wall"))
    lengths = np.array([plan.root_chord, plan.tip_chord])
    size = mesh.chord_size / mesh.refinement * plan.root_chord
    return tuple(_filled(firm, _beside(design, edges), lengths, size))


def cells_within(lines: FloatArray, parts: Iterable[tuple[float, float]]) -> IntArray:
    """Find the part (n,) whose start and end hold the middle of each cell between lines (n + 1,), or -1."""
    middle = 0.5 * (lines[1:] + lines[:-1])
    found = np.full(len(middle), -1, dtype=np.int64)
    for number, (start, end) in enumerate(parts):
        found[(middle > start) & (middle < end)] = number
    return found


def web_cells(design: WingDesign, along: Iterable[MeshLine]) -> IntArray:
    """Web (nx,) of each cell between the mesh lines along the span, -1 for none."""
    root = design.planform.root_chord
    faces = [web_faces(design, index) for index in range(len(design.webs))]
    lines = np.array([line.at(root) for line in along])
    return cells_within(lines, [(float(front.at(root)), float(rear.at(root))) for front, rear in faces])


def rib_cells(design: WingDesign, across: FloatArray) -> IntArray:
    """Rib (ny,) of each cell between the mesh lines across the span, -1 for none."""
    return cells_within(across, [rib_interval(design, index) for index in range(len(design.ribs))])
