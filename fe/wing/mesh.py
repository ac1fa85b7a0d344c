"""Mesh of the wing: a tensor grid of hexahedra from which skin, web and rib cells are kept.

First its mesh lines: those that the parts of the wing ask for, and lines between them. Axes: x aft along the
chord, y outboard along the span, z up; the straight chord line of the planform is x = 0. Cells run (chord i,
span j, height k): k = 0 is the lower skin, the last k the upper skin, between them lie the webs, the ribs and
the wall that closes the leading edge. Local axes of a cell follow (i, j, k) and its Jacobian is positive.
"""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fe.elements.cells import CellMesh, hexahedra_20
from fe.elements.kinds import HEXAHEDRA_20
from fe.runtime.arrays import BoolArray, FloatArray, IntArray
from fe.runtime.errors import MeshError
from fe.sentences import said

from .design import WingDesign, rib_interval
from .parts import four_digit_half_thickness, four_digit_slope

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
                place, gap = line.at(lengths)[0], SMALLEST_GAP * 1e3
                raise MeshError(said("wing.lines", line=line, other=lines[-1], gap=gap, place=place))
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


SKIN = 0
"""Index of the skin in `WingMesh.region_names`; the damage regions follow, then webs and ribs."""

_NARROW = 0.2  # of the widest cell


@dataclass(frozen=True)
class WingMesh(CellMesh):
    """Mesh of the wing with its named regions: 20-node hexahedra with straight edges.

    Attributes
    ----------
    kind, points, cells
        As of `CellMesh`, in metres.
    design : WingDesign
        The design that it was made from.
    span_lines : (ny + 1,) m
        Distances of the mesh lines from the root.
    chord_lines : tuple of MeshLine
        The nx + 1 mesh lines along the span.
    grid_index : (nc, 3)
        (i, j, k) of each cell.
    region : (nc,)
        Index into `region_names`.
    web, rib : (nc,)
        Which web or rib of the design the cell belongs to, -1 for none.
    leading_edge : (nc,) bool
        Cells of the wall that closes the leading edge; their thickness runs along the chord.
    height_cells : int
        Number of cells between the skins.
    """

    design: WingDesign
    span_lines: FloatArray
    chord_lines: tuple[MeshLine, ...]
    grid_index: IntArray
    region: IntArray
    web: IntArray
    rib: IntArray
    leading_edge: BoolArray
    height_cells: int

    @property
    def region_names(self) -> tuple[str, ...]:
        """Names of the regions: skin, the damage regions of the design, webs, ribs."""
        return ("skin", *self.design.regions, "webs", "ribs")

    @property
    def stiffness_term(self) -> IntArray:
        """Stiffness term (nc,) that each cell belongs to: the skin, a damage region, or the rest."""
        return np.minimum(self.region, len(self.design.regions) + 1)

    @cached_property
    def _cell_of(self) -> IntArray:
        shape = (len(self.chord_lines) - 1, len(self.span_lines) - 1, self.height_cells + 2)
        table = np.full(shape, -1, dtype=np.int64)
        table[tuple(self.grid_index.T)] = np.arange(len(self.cells))
        return table

    def chord_places(self, distance: float) -> FloatArray:
        """Places (nx + 1,) [m] of the mesh lines behind the leading edge, `distance` [m] from the root."""
        plan = self.design.planform
        chord = plan.chord(distance / plan.semi_span)
        return np.array([line.at(chord) for line in self.chord_lines])

    def skin_point(self, distance: float, behind: float, *, upper: bool = True) -> tuple[int, FloatArray]:
        """Cell and local place (3,) of a point on the outer surface of the skin of the box.

        A design has checked that it lies there.

        Parameters
        ----------
        distance : float
            Distance from the root [m].
        behind : float
            Distance from the leading edge [m].
        upper : bool
            On the upper skin, otherwise on the lower.
        """
        index, local = [], []
        for lines, place in ((self.chord_places(distance), behind), (self.span_lines, distance)):
            before = int(np.clip(np.searchsorted(lines, place, side="right") - 1, 0, len(lines) - 2))
            index.append(before)
            local.append((place - lines[before]) / (lines[before + 1] - lines[before]))
        height = self.height_cells + 1 if upper else 0
        return int(self._cell_of[*index, height]), np.array([*local, float(upper)])


def straight_edged(behind: FloatArray, chord: FloatArray, thickness_ratio: float) -> FloatArray:
    """Half thickness (nx + 1, ny + 1) [m] at the mesh lines: the straight edges nearest to the airfoil.

    Straight edges between points of the airfoil would make the section thinner, the more so the coarser the
    mesh. Here each line is moved off the airfoil so that the straight edges are nearest to it in the sense of
    least squares; that keeps the area and, to fourth order, the second moment. Lines that bound a narrow
    cell, such as a web, move together, so that the skin does not kink there.

    Parameters
    ----------
    behind : (nx + 1, ny + 1) m
        Mesh lines behind the leading edge at each station.
    chord : (ny + 1,) m
        Chord at the stations.
    thickness_ratio : float
        Largest thickness over the chord.
    """

    def airfoil(place: FloatArray) -> FloatArray:
        return four_digit_half_thickness(place / chord, thickness_ratio) * chord

    width, on_airfoil = np.diff(behind, axis=0), airfoil(behind)
    nodes, stations = behind.shape
    gram = np.zeros((stations, nodes, nodes))
    i = np.arange(nodes - 1)
    gram[:, i, i] += width.T / 3.0
    gram[:, i + 1, i + 1] += width.T / 3.0
    gram[:, i, i + 1] = gram[:, i + 1, i] = width.T / 6.0
    moment = np.zeros((stations, nodes))
    for point, weight in zip(*np.polynomial.legendre.leggauss(5), strict=True):
        share = 0.5 * (1.0 + point)
        gap = airfoil(behind[:-1] + share * width) - (1.0 - share) * on_airfoil[:-1] - share * on_airfoil[1:]
        moment[:, :-1] += ((1.0 - share) * gap * width * (0.5 * weight)).T
        moment[:, 1:] += (share * gap * width * (0.5 * weight)).T
    group = np.concatenate([[0], np.cumsum(width[:, 0] > _NARROW * width[:, 0].max())])
    tie = (group[:, None] == np.arange(group[-1] + 1)).astype(np.float64)
    offset = np.linalg.solve(tie.T @ gram @ tie, (moment @ tie)[..., None])[..., 0]
    return np.asarray(on_airfoil + tie @ offset.T)


def _grid_points(
    design: WingDesign, across: FloatArray, along: tuple[MeshLine, ...], height_cells: int
) -> FloatArray:
    """Vertices of the whole grid (nx + 1, ny + 1, nz + 1, 3) [m]."""
    plan, ratio = design.planform, design.airfoil.thickness_ratio
    chord = plan.chord(across / plan.semi_span)
    behind = np.array([line.at(chord) for line in along])
    outer = straight_edged(behind, chord, ratio)
    # The skin's thickness is measured across it, the grid line runs upright.
    inner = outer - design.skin.thickness * np.sqrt(1.0 + four_digit_slope(behind / chord, ratio) ** 2)
    levels = np.linspace(-1.0, 1.0, height_cells + 1)
    z = np.concatenate([-outer[..., None], inner[..., None] * levels, outer[..., None]], axis=2)
    x = (behind - plan.straight_chord_line * chord)[..., None]
    return np.stack(np.broadcast_arrays(x, across[None, :, None], z), axis=-1)


def build_mesh(design: WingDesign) -> WingMesh:
    """Mesh of a wing design.

    Raises
    ------
    MeshError
        If lines of the design nearly coincide.
    """
    across, along = span_lines(design), chord_lines(design)
    height_cells = max(1, round(design.mesh.refinement))
    grid = _grid_points(design, across, along, height_cells)
    i, j, k = np.indices([n - 1 for n in grid.shape[:3]])
    upper = k == height_cells + 1
    skin = upper | (k == 0)
    wall = ~skin & (i == 0) & design.skin.closed_leading_edge
    web = np.where(skin | wall, -1, web_cells(design, along)[i])
    rib = np.where(skin | wall | (web >= 0), -1, rib_cells(design, across)[j])
    webs = len(design.regions) + 1
    region = np.select([web >= 0, rib >= 0], [webs, webs + 1], SKIN)
    fractions = np.array([line.at(design.planform.root_chord) for line in along]) / design.planform.root_chord
    for number, defect in enumerate(design.defects, start=1):
        columns = cells_within(fractions, [(defect.chord_start, defect.chord_end)])
        rows = cells_within(across, [(defect.span_start, defect.span_end)])
        region[upper & (columns[i] == 0) & (rows[j] == 0)] = number

    kept = skin | wall | (web >= 0) | (rib >= 0)
    cell_index = np.argwhere(kept)
    corner = cell_index[:, None, :] + np.array(HEXAHEDRA_20.corners)
    flat = np.ravel_multi_index(tuple(np.moveaxis(corner, 2, 0)), grid.shape[:3])
    used, cells = np.unique(flat, return_inverse=True)
    body = hexahedra_20(grid.reshape(-1, 3)[used], cells.reshape(flat.shape))
    return WingMesh(
        **vars(body),
        design=design,
        span_lines=across,
        chord_lines=along,
        grid_index=cell_index,
        region=region[kept],
        web=web[kept],
        rib=rib[kept],
        leading_edge=wall[kept],
        height_cells=height_cells,
    )
