"""Mesh of the wing: the cells of a tensor grid of hexahedra that are skin, webs or ribs.

Axes: x aft along the chord, y outboard along the span, z up; the straight chord line of the
planform is x = 0. Cells are indexed by chord i, span j and height k: k = 0 is the lower skin, the
last k the upper skin. Between them lie the webs, the ribs and the wall that closes the leading
edge. Local axes of a cell follow (i, j, k), and its Jacobian is positive.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fe.elements.cells import CellMesh, hexahedra_20
from fe.elements.kinds import HEXAHEDRA_20
from fe.runtime.arrays import BoolArray, FloatArray, IntArray

from .design import WingDesign
from .mesh_lines import MeshLine, cells_within, chord_lines, rib_cells, span_lines, web_cells
from .parts import four_digit_half_thickness, four_digit_slope

SKIN = 0
"""Index of the skin in `WingMesh.region_names`; the damage regions follow, then webs and ribs."""

_NARROW = 0.2
"""A cell is narrow below this fraction of the widest one."""


@dataclass(frozen=True)
class WingMesh(CellMesh):
    """Mesh of the wing with its named regions: 20-node hexahedra with straight edges.

    Attributes
    ----------
    kind, points, cells
        As in `CellMesh`.
    design : WingDesign
        The design that it was made from.
    span_lines : (ny + 1,) array
        Distances of the mesh lines across the span from the root [m].
    chord_lines : tuple of MeshLine
        The nx + 1 mesh lines along the span.
    grid_index : (nc, 3) array of int
        (i, j, k) of each cell.
    region : (nc,) array of int
        Number of each cell's region in `region_names`.
    web, rib : (nc,) array of int
        The web or rib of the design that the cell belongs to, -1 for none.
    leading_edge : (nc,) array of bool
        Whether a cell belongs to the wall that closes the leading edge, whose thickness runs along
        the chord.
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
        """Names of the regions: skin, damage regions, webs, ribs."""
        return ("skin", *self.design.regions, "webs", "ribs")

    @property
    def stiffness_term(self) -> IntArray:
        """Stiffness term (nc,) of each cell: the skin, a damage region, or all others."""
        return np.minimum(self.region, len(self.design.regions) + 1)

    @property
    def is_skin(self) -> BoolArray:
        """Whether each cell (nc,) belongs to the skin, with the leading-edge wall."""
        return np.asarray((self.web < 0) & (self.rib < 0))

    @cached_property
    def centre_stations(self) -> FloatArray:
        """Position (nc,) of each cell's centre as a fraction of the semi-span."""
        _, y, _ = self.centres.T
        return np.asarray(y / self.design.planform.semi_span)

    @property
    def _upper_layer(self) -> int:
        """The k of the upper skin."""
        return self.height_cells + 1

    def skin_cells(self, *, upper: bool) -> IntArray:
        """Return the cells (n,) of the upper or of the lower skin."""
        _, _, layer = self.grid_index.T
        return np.flatnonzero(layer == (self._upper_layer if upper else 0))

    @cached_property
    def _cell_at(self) -> IntArray:
        """Number of the cell at each (i, j, k), -1 for none."""
        shape = (len(self.chord_lines) - 1, len(self.span_lines) - 1, self.height_cells + 2)
        table = np.full(shape, -1, dtype=np.int64)
        table[tuple(self.grid_index.T)] = np.arange(len(self.cells))
        return table

    def chord_positions(self, distance: float) -> FloatArray:
        """Return the distances (nx + 1,) [m] of the lines along the span from the leading edge.

        `distance` is that of the section from the root [m].
        """
        planform = self.design.planform
        chord = planform.chord(distance / planform.semi_span)
        return np.array([line.at(chord) for line in self.chord_lines])

    def skin_point(
        self, distance: float, behind: float, *, upper: bool = True
    ) -> tuple[int, FloatArray]:
        """Return the cell of a point on the outer surface of the skin, and its position (3,) in it.

        The check of the design guarantees that the point lies on the box.

        Parameters
        ----------
        distance : float
            Distance from the root [m].
        behind : float
            Distance from the leading edge [m].
        upper : bool
            Whether the point is on the upper skin or on the lower one.
        """
        i, x = _interval_of(self.chord_positions(distance), behind)
        j, y = _interval_of(self.span_lines, distance)
        k = self._upper_layer if upper else 0
        return int(self._cell_at[i, j, k]), np.array([x, y, float(upper)])


def _interval_of(lines: FloatArray, position: float) -> tuple[int, float]:
    """Return the interval between mesh lines that contains a position, and the position in it."""
    last_interval = len(lines) - 2
    line = np.searchsorted(lines, position, side="right") - 1
    interval = int(np.clip(line, 0, last_interval))
    start = lines[interval]
    return interval, (position - start) / (lines[interval + 1] - start)


def straight_edged(
    distance_aft: FloatArray, chord: FloatArray, thickness_ratio: float
) -> FloatArray:
    """Return the half thicknesses at mesh lines with which straight edges fit the airfoil best.

    Straight edges between points of the airfoil would make the section too thin, the more so the
    coarser the mesh is. Therefore each line is moved off the airfoil, by offsets that minimise the
    squared distance between the edges and the airfoil. This preserves the area and, to fourth
    order, the second moment of area. Lines that bound a narrow cell, such as a web, get the same
    offset, so that the skin has no kink there.

    Parameters
    ----------
    distance_aft : (nx + 1, ny + 1) array
        Distances of the mesh lines from the leading edge at each station [m].
    chord : (ny + 1,) array
        Chord at the stations [m].
    thickness_ratio : float
        Largest thickness over the chord.

    Returns
    -------
    (nx + 1, ny + 1) array
        The half thickness [m].
    """
    width = np.diff(distance_aft, axis=0)
    on_airfoil = _half_thickness(distance_aft, chord, thickness_ratio)
    gram = _hat_function_gram(width)
    moment = _airfoil_moments(distance_aft, chord, thickness_ratio)
    # lines that bound a narrow cell belong to one group, which moves as one
    root_width = width.T[0]
    is_wide = root_width > _NARROW * root_width.max()
    group = np.concatenate([[0], np.cumsum(is_wide)])
    group_numbers = np.arange(group[-1] + 1)
    in_group = (group[:, np.newaxis] == group_numbers).astype(np.float64)
    # normal equations of the least squares for the offset of each group
    right_hand_side = (moment @ in_group)[..., np.newaxis]
    group_gram = in_group.T @ gram @ in_group
    offset = np.linalg.solve(group_gram, right_hand_side).squeeze(axis=-1)
    return np.asarray(on_airfoil + in_group @ offset.T)


def _half_thickness(behind: FloatArray, chord: FloatArray, thickness_ratio: float) -> FloatArray:
    """Return the half thickness of the airfoil [m] at distances from the leading edge [m]."""
    return four_digit_half_thickness(behind / chord, thickness_ratio) * chord


def _hat_function_gram(width: FloatArray) -> FloatArray:
    """Return the inner products (ny + 1, nx + 1, nx + 1) of the lines' hat functions.

    `width` (nx, ny + 1) is the width of the cells at each station [m].
    """
    cells, stations = width.shape
    gram = np.zeros((stations, cells + 1, cells + 1))
    front = np.arange(cells)
    rear = front + 1
    gram[:, front, front] += width.T / 3.0
    gram[:, rear, rear] += width.T / 3.0
    gram[:, front, rear] = width.T / 6.0
    gram[:, rear, front] = width.T / 6.0
    return gram


def _airfoil_moments(
    distance_aft: FloatArray, chord: FloatArray, thickness_ratio: float
) -> FloatArray:
    """Return moments (ny + 1, nx + 1) [m^2] of the gap between the airfoil and straight edges.

    The moment of a mesh line is the integral over the chord of the gap times the linear shape
    function (hat) of the line, by Gauss-Legendre quadrature in each cell.

    Parameters
    ----------
    distance_aft : (nx + 1, ny + 1) array
        The distance of each line from the leading edge at each station [m].
    chord : (ny + 1,) array
        The chord at each station [m].
    """
    width = np.diff(distance_aft, axis=0)
    height_on_lines = _half_thickness(distance_aft, chord, thickness_ratio)
    line_count, station_count = distance_aft.shape
    moments = np.zeros((station_count, line_count))
    abscissas, weights = np.polynomial.legendre.leggauss(5)
    for abscissa, weight in zip(abscissas, weights, strict=True):
        # shape functions of the rear and the front line at this point of each cell, and the gap
        rear = 0.5 * (1.0 + abscissa)
        front = 1.0 - rear
        position = distance_aft[:-1] + rear * width
        height = _half_thickness(position, chord, thickness_ratio)
        gap = height - front * height_on_lines[:-1] - rear * height_on_lines[1:]
        fraction = 0.5 * weight
        front_moment = front * gap * width * fraction
        rear_moment = rear * gap * width * fraction
        moments[:, :-1] += front_moment.T
        moments[:, 1:] += rear_moment.T
    return moments


def _grid_points(
    design: WingDesign, across: FloatArray, along: tuple[MeshLine, ...], height_cells: int
) -> FloatArray:
    """Return the vertices (nx + 1, ny + 1, nz + 1, 3) [m] of the whole grid.

    `across` (ny + 1,) are the mesh lines across the span [m], `along` the nx + 1 lines along it.
    """
    planform = design.planform
    thickness_ratio = design.airfoil.thickness_ratio
    chord = planform.chord(across / planform.semi_span)
    distance_aft = np.array([line.at(chord) for line in along])
    outer_surface = straight_edged(distance_aft, chord, thickness_ratio)
    # The skin's thickness is measured normal to it, and the grid line is vertical: a slope makes
    # the vertical thickness larger by sqrt(1 + slope^2).
    slope = four_digit_slope(distance_aft / chord, thickness_ratio)
    vertical_thickness = design.skin.thickness * np.sqrt(1.0 + slope**2)
    inner_surface = outer_surface - vertical_thickness
    # lower skin, levels between the inner surfaces, upper skin
    levels = np.linspace(-1.0, 1.0, height_cells + 1)
    upper_surface = outer_surface[..., np.newaxis]
    inner_levels = inner_surface[..., np.newaxis] * levels
    z = np.concatenate([-upper_surface, inner_levels, upper_surface], axis=2)
    # the straight chord line is the y axis
    distance_from_chord_line = distance_aft - planform.straight_chord_line * chord
    x = distance_from_chord_line[..., np.newaxis]
    y = across[np.newaxis, :, np.newaxis]
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


@dataclass(frozen=True)
class _GridCells:
    """The part of the wing to which each cell of the grid belongs.

    Attributes
    ----------
    web, rib : (nx, ny, nz) array of int
        The web or rib, -1 for none.
    leading_edge, is_kept : (nx, ny, nz) array of bool
        Whether a cell belongs to the leading-edge wall, and to the wing at all.
    region : (nx, ny, nz) array of int
        Index of the region in `WingMesh.region_names`.
    """

    web: IntArray
    rib: IntArray
    leading_edge: BoolArray
    is_kept: BoolArray
    region: IntArray


def _grid_cells(
    design: WingDesign, across: FloatArray, along: tuple[MeshLine, ...], height_cells: int
) -> _GridCells:
    """Assign each cell of the grid to a part; the parameters are those of `_grid_points`."""
    # numbers of a cell along the chord, along the span and over the height
    shape = (len(along) - 1, len(across) - 1, height_cells + 2)
    i, j, k = np.indices(shape)
    # skin, closed leading edge, webs and ribs; where several meet, the first one counts
    is_lower = k == 0
    is_upper = k == height_cells + 1
    is_skin = is_upper | is_lower
    is_foremost = i == 0
    leading_edge = ~is_skin & is_foremost & design.skin.closed_leading_edge
    is_shell = is_skin | leading_edge
    web_of_chord_cell = web_cells(design, along)
    web = np.where(is_shell, -1, web_of_chord_cell[i])
    is_web = web >= 0
    rib_of_span_cell = rib_cells(design, across)
    rib = np.where(is_shell | is_web, -1, rib_of_span_cell[j])
    is_rib = rib >= 0
    # webs and ribs follow the damage regions, which are numbered from one
    web_region = len(design.regions) + 1
    rib_region = web_region + 1
    region = np.select([is_web, is_rib], [web_region, rib_region], SKIN)
    root_chord = design.planform.root_chord
    chord_fractions = np.array([line.at(root_chord) for line in along]) / root_chord
    for number, defect in enumerate(design.defects, start=1):
        chord_interval = (defect.chord_start, defect.chord_end)
        span_interval = (defect.span_start, defect.span_end)
        along_chord = cells_within(chord_fractions, [chord_interval]) == 0
        along_span = cells_within(across, [span_interval]) == 0
        is_in_defect = is_upper & along_chord[i] & along_span[j]
        region[is_in_defect] = number
    return _GridCells(
        web=web,
        rib=rib,
        leading_edge=leading_edge,
        is_kept=is_shell | is_web | is_rib,
        region=region,
    )


def build_mesh(design: WingDesign) -> WingMesh:
    """Return the mesh of a wing design.

    Raises
    ------
    MeshError
        If lines of the design nearly coincide.
    """
    across = span_lines(design)
    along = chord_lines(design)
    height_cells = max(1, round(design.mesh.refinement))
    grid = _grid_points(design, across, along, height_cells)
    grid_cells = _grid_cells(design, across, along, height_cells)
    # number the vertices that the kept cells use
    grid_index = np.argwhere(grid_cells.is_kept)
    i, j, k = np.moveaxis(grid_index[:, np.newaxis] + np.array(HEXAHEDRA_20.corners), 2, 0)
    vertex_numbers = np.ravel_multi_index((i, j, k), grid.shape[:3])
    used_vertices, cells = np.unique(vertex_numbers, return_inverse=True)
    vertices = grid.reshape(-1, 3)[used_vertices]
    mesh = hexahedra_20(vertices, cells.reshape(vertex_numbers.shape))
    return WingMesh(
        kind=mesh.kind,
        points=mesh.points,
        cells=mesh.cells,
        design=design,
        span_lines=across,
        chord_lines=along,
        grid_index=grid_index,
        region=grid_cells.region[grid_cells.is_kept],
        web=grid_cells.web[grid_cells.is_kept],
        rib=grid_cells.rib[grid_cells.is_kept],
        leading_edge=grid_cells.leading_edge[grid_cells.is_kept],
        height_cells=height_cells,
    )
