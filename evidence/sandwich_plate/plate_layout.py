"""The wing's parts on the grid of its mesh lines, seen from above, for the sandwich plate."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from skfem import MeshQuad

from fe.wing.design import WingDesign
from fe.wing.mesh import straight_edged
from fe.wing.mesh_lines import chord_lines, rib_cells, span_lines, web_cells
from fe.wing.parts import four_digit_half_thickness, four_digit_slope

from .plate import Plate, Surface, tensor_mesh

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


class PlateLayout:
    """Where the parts of a design lie on the grid of its mesh lines, seen from above.

    Parameters
    ----------
    design : WingDesign
        The wing.
    straight_section : bool
        Whether the section is straight between mesh lines, as that of the box is, or the true one.

    Attributes
    ----------
    plate : Plate
        The grid; x aft of the straight chord line, y outboard.
    across : (rows + 1,) m
        Mesh lines across the span.
    stiff_columns : (columns,) bool
        Columns of cells that a web or the leading-edge wall fills over the whole height.
    web, rib : (cells,)
        Which web or rib of the design fills a cell, -1 for none.
    wall : (cells,) bool
        Cells of the leading-edge wall.

    Raises
    ------
    MeshError
        If two mesh lines that the design asks for nearly coincide.
    """

    def __init__(self, design: WingDesign, *, straight_section: bool = False) -> None:
        self.design, self._straight_section = design, straight_section
        self.across, along = span_lines(design), chord_lines(design)
        self._along = along
        columns, rows = len(along) - 1, len(self.across) - 1
        grid = tensor_mesh(columns, rows)
        self._index_plate = Plate(grid)
        chord = self._chord(self.across)
        lead = -design.planform.straight_chord_line * chord
        behind = np.array([line.at(chord) for line in along])
        i, j = np.rint(grid.p).astype(int)
        self.plate = Plate(MeshQuad(np.stack((behind[i, j] + lead[j], self.across[j])), grid.t))

        web, rib = web_cells(design, along), rib_cells(design, self.across)
        wall = (np.arange(columns) == 0) & design.skin.closed_leading_edge
        column, row = np.floor(grid.p[:, grid.t].mean(axis=1)).astype(int)
        self.stiff_columns = (web >= 0) | wall
        self.web, self.wall = web[column], wall[column]
        self.rib = np.where(self.stiff_columns[column], -1, rib[row])

    def _chord(self, distance: FloatArray) -> FloatArray:
        return self.design.planform.chord(distance / self.design.planform.semi_span)

    def chord_fraction(self, places: FloatArray) -> FloatArray:
        """Chord fraction (...,) of places (..., 2)."""
        return np.asarray(
            places[..., 0] / self._chord(places[..., 1]) + self.design.planform.straight_chord_line
        )

    def lines_at(self, distance: float) -> FloatArray:
        """Places (columns + 1,) aft of the straight chord line [m] of the mesh lines at a distance [m]."""
        plan = self.design.planform
        chord = plan.chord(distance / plan.semi_span)
        behind = np.array([line.at(chord) for line in self._along])
        return np.asarray(behind - plan.straight_chord_line * chord)

    def surface(self, places: FloatArray, depth: float = 0.0) -> Surface:
        """Upper surface at places (..., 2), `depth` [m] below the outer one, measured across it."""
        chord = self._chord(places[..., 1])
        if self._straight_section:
            height, slope = self._straight(places, depth)
        else:
            height, slope = self._section(self.chord_fraction(places), chord, depth)
        plan = self.design.planform
        taper = (plan.tip_chord - plan.root_chord) / plan.semi_span
        # The section shrinks with the chord: z = c f(x / c); that the skin does not, counts for nothing here.
        return Surface(height, slope, taper * (height - slope * places[..., 0]) / chord)

    def _section(
        self, chord_fraction: FloatArray, chord: FloatArray, depth: float
    ) -> tuple[FloatArray, FloatArray]:
        ratio = self.design.airfoil.thickness_ratio
        slope = four_digit_slope(chord_fraction, ratio)
        outer = four_digit_half_thickness(chord_fraction, ratio) * chord
        return outer - depth * np.sqrt(1.0 + slope**2), slope

    def _straight(self, places: FloatArray, depth: float) -> tuple[FloatArray, FloatArray]:
        """Height and slope (...,) of a section that is straight between the mesh lines."""
        chord = self._chord(places[..., 1])
        behind = self.chord_fraction(places) * chord
        lines = np.stack([line.at(chord) for line in self._along], axis=-1)
        before = np.clip((lines <= behind[..., None]).sum(axis=-1) - 1, 0, lines.shape[-1] - 2)
        start, end = (
            np.take_along_axis(lines, (before + step)[..., None], axis=-1)[..., 0] for step in (0, 1)
        )
        ratio = self.design.airfoil.thickness_ratio
        flat = lines.reshape(-1, lines.shape[-1])
        outer = straight_edged(flat.T, np.broadcast_to(chord, behind.shape).ravel(), ratio).T.reshape(
            lines.shape
        )
        height = outer - depth * np.sqrt(1.0 + four_digit_slope(lines / chord[..., None], ratio) ** 2)
        first, second = (
            np.take_along_axis(height, (before + step)[..., None], axis=-1)[..., 0] for step in (0, 1)
        )
        slope = (second - first) / (end - start)
        return first + slope * (behind - start), slope

    @cached_property
    def half_grid(self) -> IntArray:
        """Number (2 columns + 1, 2 rows + 1) of the node at each place of the grid of corners and middles."""
        i, j = np.rint(2.0 * self._index_plate.node_points.T).astype(int)
        table = np.empty((i.max() + 1, j.max() + 1), dtype=np.int64)
        table[i, j] = np.arange(len(i))
        return table

    def skin_modulus_at(self, station: FloatArray) -> FloatArray:
        """Young's modulus (...,) of the skin [Pa] at fractions (...,) of the semi-span."""
        return self.design.skin.young_modulus(station)

    @cached_property
    def skin_modulus(self) -> FloatArray:
        """Young's modulus (cells, q) of the skin [Pa] at the integration points."""
        return self.skin_modulus_at(self.plate.points[..., 1] / self.design.planform.semi_span)

    @cached_property
    def added_density(self) -> FloatArray:
        """Density (cells, q) added to all that is there [kg/m^3]."""
        station = self.plate.points[..., 1] / self.design.planform.semi_span
        added = np.zeros(station.shape)
        for part in self.design.added_density:
            added[(station > part.start) & (station < part.end)] += part.density
        return added

    def defect(self, number: int) -> BoolArray:
        """Integration points (cells, q) inside a defect."""
        part, points = self.design.defects[number], self.plate.points
        xi, distance = self.chord_fraction(points), points[..., 1]
        return np.asarray(
            (distance > part.span_start)
            & (distance < part.span_end)
            & (xi > part.chord_start)
            & (xi < part.chord_end)
        )
