"""Mesh of the wing: a tensor grid of hexahedra from which skin, web and rib cells are kept.

Axes: x aft along the chord, y outboard along the span, z up; the straight chord line of the planform is
x = 0. Cells run (chord i, span j, height k): k = 0 is the lower skin, the last k the upper skin, between
them lie the webs, the ribs and the wall that closes the leading edge. Local axes of a cell follow (i, j, k)
and its Jacobian is positive.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fe.elements.cells import CellMesh, hexahedra_20
from fe.elements.kinds import HEXAHEDRA_20
from fe.runtime.arrays import BoolArray, FloatArray, IntArray
from fe.runtime.errors import MeshError

from .design import WingDesign
from .grid import MeshLine, cells_within, chord_lines, rib_cells, span_lines, web_cells
from .parts import four_digit_half_thickness, four_digit_slope

SKIN = 0
"""Index of the skin in `WingMesh.region_names`; the damage regions follow, then webs and ribs."""

_NARROW = 0.2  # of the widest cell


class SurfacePoint(NamedTuple):
    """A point of a skin cell: the cell's number and local coordinates (3,) in 0..1."""

    cell: int
    local: FloatArray


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

    def skin_point(self, distance: float, behind_leading_edge: float, *, upper: bool = True) -> SurfacePoint:
        """Point on the outer surface of the skin.

        Parameters
        ----------
        distance : float
            Distance from the root [m].
        behind_leading_edge : float
            Distance from the leading edge [m].
        upper : bool
            On the upper skin, otherwise on the lower.

        Raises
        ------
        MeshError
            If the point does not lie on the skin of the box.
        """
        lines = (self.chord_places(distance), self.span_lines)
        index, local = [], []
        for places, place in zip(lines, (behind_leading_edge, distance), strict=True):
            if not places[0] - 1e-9 <= place <= places[-1] + 1e-9:
                raise MeshError(
                    f"the point {distance:.4g} m from the root and {behind_leading_edge:.4g} m behind the "
                    f"leading edge does not lie on the skin, which reaches from {lines[0][0]:.4g} m to "
                    f"{lines[0][-1]:.4g} m there."
                )
            before = int(np.clip(np.searchsorted(places, place, side="right") - 1, 0, len(places) - 2))
            index.append(before)
            local.append((place - places[before]) / (places[before + 1] - places[before]))
        height = self.height_cells + 1 if upper else 0
        return SurfacePoint(int(self._cell_of[*index, height]), np.array([*local, float(upper)]))

    def skin_cells(self, *, upper: bool) -> IntArray:
        """Numbers of the cells of the upper or lower skin, defect regions included."""
        return np.flatnonzero(self.grid_index[:, 2] == (self.height_cells + 1 if upper else 0))


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
