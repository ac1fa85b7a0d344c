"""Mesh lines of the wing: those that its parts ask for, and lines between them."""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fe.runtime.errors import MeshError

from .design import WingDesign, rib_interval

FloatArray = NDArray[np.float64]

SMALLEST_GAP = 2e-4
"""Two mesh lines that the design asks for may not lie closer than this [m]."""
_SAME = 1e-9


class ChordLine(NamedTuple):
    """Mesh line along the span: at `fraction` of the local chord, moved aft by `offset` [m]."""

    fraction: float
    offset: float
    label: str

    def behind_leading_edge(self, chord: float) -> float:
        """Distance [m] from the leading edge where the chord is `chord` [m]."""
        return self.fraction * chord + self.offset


def _merge_lines(wanted: list[tuple[float, str]], what: str) -> list[float]:
    """Sort, drop exact doubles, refuse lines that nearly coincide."""
    kept: list[tuple[float, str]] = []
    for place, label in sorted(wanted):
        if kept and place - kept[-1][0] <= _SAME:
            continue
        if kept and place - kept[-1][0] < SMALLEST_GAP:
            raise MeshError(
                f"{label} at {place:.5f} m and {kept[-1][1]} at {kept[-1][0]:.5f} m from the {what} are "
                f"closer than {SMALLEST_GAP * 1e3:g} mm; move one of them or put them on the same line."
            )
        kept.append((place, label))
    return [place for place, _ in kept]


def _subdivide(lines: list[float], size: float) -> list[float]:
    filled = [lines[0]]
    for start, end in itertools.pairwise(lines):
        count = max(1, int(np.ceil((end - start) / size - 1e-9)))
        filled.extend(start + (end - start) * (n + 1) / count for n in range(count - 1))
        filled.append(end)
    return filled


def span_lines(design: WingDesign) -> FloatArray:
    """Mesh lines across the span (ny + 1,) [m]: rib faces, defect edges, band ends, and lines between.

    Raises
    ------
    MeshError
        If two lines that the design asks for nearly coincide.
    """
    span = design.planform.semi_span
    wanted: list[tuple[float, str]] = [(0.0, "the root"), (span, "the tip")]
    for index in range(len(design.ribs)):
        start, end = rib_interval(design, index)
        wanted += [(start, f"the inner face of ribs[{index}]"), (end, f"the outer face of ribs[{index}]")]
    for index, defect in enumerate(design.defects):
        wanted += [
            (defect.span_start, f"the inner edge of defects[{index}]"),
            (defect.span_end, f"the outer edge of defects[{index}]"),
        ]
    firm = _merge_lines(wanted, "root")
    size = design.mesh.span_size / design.mesh.refinement
    soft = [band.end * span for band in design.skin.bands]
    soft += [added.start * span for added in design.added_density]
    soft += [added.end * span for added in design.added_density]
    soft += [rod.reach * span for rod in design.rods]
    for place in sorted(set(soft)):
        if min(abs(place - line) for line in firm) > 0.1 * design.mesh.span_size:
            firm.append(place)
    edge = design.mesh.edge_size
    if edge is not None:
        edge /= design.mesh.refinement
        for defect in design.defects:
            for place in (defect.span_start, defect.span_end):
                for beside in (place - edge, place + edge):
                    if 0.0 < beside < span and min(abs(beside - line) for line in firm) > 0.5 * edge:
                        firm.append(beside)
    return np.array(_subdivide(sorted(firm), size))


def web_faces(design: WingDesign, index: int) -> tuple[ChordLine, ChordLine]:
    """Front and rear mesh line of a web: the first web lies behind its chord, the last before it."""
    web = design.webs[index]
    front = {0: 0.0, len(design.webs) - 1: -web.thickness}.get(index, -0.5 * web.thickness)
    return (
        ChordLine(web.chord, front, f"the front of webs[{index}]"),
        ChordLine(web.chord, front + web.thickness, f"the rear of webs[{index}]"),
    )


def _with_edge_lines(design: WingDesign, firm: list[ChordLine]) -> list[ChordLine]:
    """Lines beside the edges of the defects, where the chord holds no other line near by."""
    if design.mesh.edge_size is None:
        return firm
    edge = design.mesh.edge_size / design.mesh.refinement
    chords = design.planform.root_chord, design.planform.tip_chord
    lines = list(firm)
    for defect in design.defects:
        for fraction in (defect.chord_start, defect.chord_end):
            for offset in (-edge, edge):
                line = ChordLine(fraction, offset, "beside a defect")
                gaps = [
                    [line.behind_leading_edge(c) - other.behind_leading_edge(c) for c in chords]
                    for other in lines
                ]
                ends = [firm[0], firm[-1]]
                inside = all(
                    ends[0].behind_leading_edge(c)
                    < line.behind_leading_edge(c)
                    < ends[1].behind_leading_edge(c)
                    for c in chords
                )
                # Lines must not cross between root and tip either.
                if inside and all(
                    min(map(abs, pair)) > 0.5 * edge and pair[0] * pair[1] > 0.0 for pair in gaps
                ):
                    lines.append(line)
    return sorted(lines, key=lambda line: line.behind_leading_edge(design.planform.root_chord))


def chord_lines(design: WingDesign) -> tuple[ChordLine, ...]:
    """Mesh lines along the span: web faces, defect edges, the leading-edge wall, and lines between.

    Raises
    ------
    MeshError
        If two lines that the design asks for nearly coincide or cross between root and tip.
    """
    root, tip = design.planform.root_chord, design.planform.tip_chord
    wanted = [face for index in range(len(design.webs)) for face in web_faces(design, index)]
    if design.skin.closed_leading_edge:
        wanted.append(ChordLine(design.front_chord, -design.skin.thickness, "the leading-edge wall"))
    for index, defect in enumerate(design.defects):
        wanted += [
            ChordLine(defect.chord_start, 0.0, f"the front edge of defects[{index}]"),
            ChordLine(defect.chord_end, 0.0, f"the rear edge of defects[{index}]"),
        ]
    wanted.sort(key=lambda line: line.behind_leading_edge(root))
    firm: list[ChordLine] = []
    for line in wanted:
        if firm:
            gaps = [line.behind_leading_edge(c) - firm[-1].behind_leading_edge(c) for c in (root, tip)]
            if max(abs(gap) for gap in gaps) <= _SAME:
                continue
            if min(gaps) < SMALLEST_GAP:
                raise MeshError(
                    f"{line.label} and {firm[-1].label} come closer than {SMALLEST_GAP * 1e3:g} mm or cross "
                    f"between root and tip; move one of them or put them on the same chord fraction."
                )
        firm.append(line)
    firm = _with_edge_lines(design, firm)
    lines = [firm[0]]
    size = design.mesh.chord_size / design.mesh.refinement * root
    for start, end in itertools.pairwise(firm):
        width = end.behind_leading_edge(root) - start.behind_leading_edge(root)
        count = max(1, int(np.ceil(width / size - 1e-9)))
        for n in range(1, count):
            t = n / count
            lines.append(
                ChordLine(
                    start.fraction + t * (end.fraction - start.fraction),
                    start.offset + t * (end.offset - start.offset),
                    "between",
                )
            )
        lines.append(end)
    return tuple(lines)
