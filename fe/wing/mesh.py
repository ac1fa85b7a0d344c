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
from numpy.typing import NDArray

from fe.elements.cells import CellMesh, hexahedra_20
from fe.elements.kinds import HEXAHEDRA_20
from fe.runtime.errors import MeshError

from .design import WingDesign, rib_interval
from .grid import ChordLine, chord_lines, span_lines, web_faces
from .parts import four_digit_half_thickness, four_digit_slope

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

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
    chord_lines : tuple of ChordLine
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
    chord_lines: tuple[ChordLine, ...]
    grid_index: IntArray
    region: IntArray
    web: IntArray
    rib: IntArray
    leading_edge: NDArray[np.bool_]
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

    def upper_skin_lines(self, distance: float) -> tuple[int, float, FloatArray]:
        """Span cell j, local span coordinate and the chordwise places of the mesh lines.

        Parameters
        ----------
        distance : float
            Distance from the root [m].

        Returns
        -------
        j : int
        local : float
            0..1 inside the span cell.
        places : (nx + 1,) m
            Distances of the chord lines behind the leading edge.
        """
        span = self.design.planform.semi_span
        j = int(
            np.clip(np.searchsorted(self.span_lines, distance, side="right") - 1, 0, len(self.span_lines) - 2)
        )
        local = (distance - self.span_lines[j]) / (self.span_lines[j + 1] - self.span_lines[j])
        chord = self.design.planform.chord(distance / span)
        return j, float(local), np.array([line.behind_leading_edge(chord) for line in self.chord_lines])

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
        j, span_local, places = self.upper_skin_lines(distance)
        tolerance = 1e-9
        if not (
            places[0] - tolerance <= behind_leading_edge <= places[-1] + tolerance
            and -tolerance <= span_local <= 1.0 + tolerance
        ):
            raise MeshError(
                f"the point {distance:.4g} m from the root and {behind_leading_edge:.4g} m behind the "
                f"leading edge does not lie on the skin, which reaches from {places[0]:.4g} m to "
                f"{places[-1]:.4g} m there."
            )
        i = int(np.clip(np.searchsorted(places, behind_leading_edge, side="right") - 1, 0, len(places) - 2))
        chord_local = (behind_leading_edge - places[i]) / (places[i + 1] - places[i])
        k = self.height_cells + 1 if upper else 0
        return SurfacePoint(
            int(self._cell_of[i, j, k]), np.array([chord_local, span_local, 1.0 if upper else 0.0])
        )

    def cells_of(self, name: str) -> IntArray:
        """Numbers of the cells of a named region.

        Raises
        ------
        MeshError
            If there is no such region.
        """
        names = self.region_names
        if name not in names:
            raise MeshError(f"there is no region '{name}'; the regions are {', '.join(names)}.")
        return np.flatnonzero(self.region == names.index(name))

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
    design: WingDesign, across: FloatArray, along: tuple[ChordLine, ...], height_cells: int
) -> FloatArray:
    """Vertices of the whole grid (nx + 1, ny + 1, nz + 1, 3) [m]."""
    plan = design.planform
    chord = plan.root_chord + (plan.tip_chord - plan.root_chord) * across / plan.semi_span
    fraction = np.array([line.fraction for line in along])
    offset = np.array([line.offset for line in along])
    behind = fraction[:, None] * chord + offset[:, None]
    xi = behind / chord
    ratio = design.airfoil.thickness_ratio
    outer = straight_edged(behind, chord, ratio)
    # The skin's thickness is measured across it, the grid line runs upright.
    inner = outer - design.skin.thickness * np.sqrt(1.0 + four_digit_slope(xi, ratio) ** 2)
    levels = np.linspace(-1.0, 1.0, height_cells + 1)
    z = np.concatenate([-outer[..., None], inner[..., None] * levels, outer[..., None]], axis=2)
    points = np.empty((*z.shape, 3))
    points[..., 0] = (behind - plan.straight_chord_line * chord)[..., None]
    points[..., 1] = across[None, :, None]
    points[..., 2] = z
    return points


def _web_of_columns(design: WingDesign, along: tuple[ChordLine, ...]) -> IntArray:
    """Web of each chordwise cell, -1 for none."""
    root = design.planform.root_chord
    places = np.array([line.behind_leading_edge(root) for line in along])
    middle = 0.5 * (places[1:] + places[:-1])
    web = np.full(len(middle), -1, dtype=np.int64)
    for index in range(len(design.webs)):
        front, rear = (face.behind_leading_edge(root) for face in web_faces(design, index))
        web[(middle > front) & (middle < rear)] = index
    return web


def build_mesh(design: WingDesign) -> WingMesh:
    """Mesh of a wing design.

    Raises
    ------
    MeshError
        If lines of the design nearly coincide, or a rib, web or defect region found no cells.
    """
    across, along = span_lines(design), chord_lines(design)
    height_cells = max(1, round(design.mesh.refinement))
    grid = _grid_points(design, across, along, height_cells)
    shape = tuple(n - 1 for n in grid.shape[:3])
    i, j, k = np.meshgrid(*(np.arange(n) for n in shape), indexing="ij")

    web_column = _web_of_columns(design, along)
    middle = 0.5 * (across[1:] + across[:-1])
    rib_row = np.full(len(middle), -1, dtype=np.int64)
    for index in range(len(design.ribs)):
        start, end = rib_interval(design, index)
        rib_row[(middle > start) & (middle < end)] = index
    wall_column = np.zeros(shape[0], dtype=bool)
    wall_column[0] = design.skin.closed_leading_edge

    is_skin = (k == 0) | (k == shape[2] - 1)
    wall = wall_column[i]
    kept = is_skin | wall | (web_column[i] >= 0) | (rib_row[j] >= 0)
    cell_index = np.stack([i[kept], j[kept], k[kept]], axis=1)
    is_skin, wall = is_skin[kept], wall[kept]
    shell = is_skin | wall
    web = np.where(shell, -1, web_column[cell_index[:, 0]])
    rib = np.where(shell | (web >= 0), -1, rib_row[cell_index[:, 1]])
    webs = len(design.regions) + 1
    region = np.select([web >= 0, rib >= 0], [webs, webs + 1], SKIN)
    _mark_defects(design, across, along, cell_index, region)

    corner = cell_index[:, None, :] + np.array(HEXAHEDRA_20.corners)
    flat = np.ravel_multi_index(tuple(np.moveaxis(corner, 2, 0)), grid.shape[:3])
    used, cells = np.unique(flat, return_inverse=True)
    body = hexahedra_20(grid.reshape(-1, 3)[used], cells.reshape(flat.shape))
    mesh = WingMesh(
        kind=body.kind,
        points=body.points,
        cells=body.cells,
        design=design,
        span_lines=across,
        chord_lines=along,
        grid_index=cell_index,
        region=region,
        web=web,
        rib=rib,
        leading_edge=wall & ~is_skin,
        height_cells=height_cells,
    )
    _check_nothing_vanished(mesh)
    return mesh


def _mark_defects(
    design: WingDesign, across: FloatArray, along: tuple[ChordLine, ...], index: IntArray, region: IntArray
) -> None:
    root = design.planform.root_chord
    places = np.array([line.behind_leading_edge(root) for line in along]) / root
    chord_middle = 0.5 * (places[1:] + places[:-1])[index[:, 0]]
    span_middle = 0.5 * (across[1:] + across[:-1])[index[:, 1]]
    upper = index[:, 2] == index[:, 2].max()
    for number, defect in enumerate(design.defects, start=1):
        inside = (
            upper
            & (span_middle > defect.span_start)
            & (span_middle < defect.span_end)
            & (chord_middle > defect.chord_start)
            & (chord_middle < defect.chord_end)
        )
        region[inside] = number


def _check_nothing_vanished(mesh: WingMesh) -> None:
    """Every part that the design asks for must be in the mesh with its full thickness."""
    design = mesh.design
    thickness = np.diff(mesh.span_lines)[mesh.grid_index[:, 1]]
    for index, rib in enumerate(design.ribs):
        rows = np.unique(mesh.grid_index[mesh.rib == index, 1])
        found = float(np.diff(mesh.span_lines)[rows].sum())
        if abs(found - rib.thickness) > 1e-6 * rib.thickness:
            raise MeshError(
                f"ribs[{index}] at {rib.station:g} of the span should be {rib.thickness:g} m thick, but the "
                f"mesh holds {found:.3g} m of it; move it away from the mesh lines or refine the mesh."
            )
    for index in range(len(design.webs)):
        if not np.any(mesh.web == index):
            raise MeshError(
                f"webs[{index}] at chord {design.webs[index].chord:g} found no cells in the mesh."
            )
    for number, defect in enumerate(design.defects, start=1):
        inside = mesh.region == number
        length = float(thickness[inside].sum() / max(1, len(np.unique(mesh.grid_index[inside, 0]))))
        if abs(length - (defect.span_end - defect.span_start)) > 1e-6:
            raise MeshError(
                f"defects[{number - 1}] should be {defect.span_end - defect.span_start:g} m long, but the "
                f"mesh holds {length:.4g} m of it."
            )
