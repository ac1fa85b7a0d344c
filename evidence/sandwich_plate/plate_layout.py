"""The parts of the wing on the grid of its mesh lines, seen from above, for the sandwich plate."""

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
    """Location of the parts of a design on the grid of its mesh lines, seen from above.

    Parameters
    ----------
    design : WingDesign
        The wing.
    straight_section : bool
        Whether the section is straight between mesh lines, as that of the box is, or the true one.

    Attributes
    ----------
    plate : Plate
        The plate on the grid; x points aft from the straight chord line, y outboard.
    across : (rows + 1,) array
        Distances of the mesh lines across the span [m].
    stiff_columns : (columns,) array of bool
        Whether a web or the leading-edge wall fills a column of cells over the whole height.
    web, rib : (cells,) arrays
        Number of the web or rib that fills a cell; -1 if there is none.
    wall : (cells,) array of bool
        Whether a cell belongs to the leading-edge wall.

    Raises
    ------
    MeshError
        If two mesh lines that the design asks for nearly coincide.
    """

    def __init__(self, design: WingDesign, *, straight_section: bool = False) -> None:
        self.design = design
        self._straight_section = straight_section
        self.across = span_lines(design)
        self._along = chord_lines(design)
        column_count = len(self._along) - 1
        row_count = len(self.across) - 1

        # Nodes of the plan
        grid = tensor_mesh(column_count, row_count)
        self._index_plate = Plate(grid)
        chord = self._chord(self.across)
        leading_edge = -design.planform.straight_chord_line * chord
        aft_of_leading_edge = np.array([line.at(chord) for line in self._along])
        i, j = np.rint(grid.p).astype(int)
        x = aft_of_leading_edge[i, j] + leading_edge[j]
        y = self.across[j]
        self.plate = Plate(MeshQuad(np.stack((x, y)), grid.t))

        # Parts that fill the cells
        web_of_column = web_cells(design, self._along)
        rib_of_row = rib_cells(design, self.across)
        is_first_column = np.arange(column_count) == 0
        wall_of_column = is_first_column & design.skin.closed_leading_edge
        self.stiff_columns = (web_of_column >= 0) | wall_of_column
        column, row = np.floor(grid.p[:, grid.t].mean(axis=1)).astype(int)
        self.web = web_of_column[column]
        self.wall = wall_of_column[column]
        self.rib = np.where(self.stiff_columns[column], -1, rib_of_row[row])

    def _chord(self, distance: FloatArray) -> FloatArray:
        """Return the chord (...,) [m] at distances (...,) from the root [m]."""
        return self.design.planform.chord(distance / self.design.planform.semi_span)

    def chord_fraction(self, positions: FloatArray) -> FloatArray:
        """Return the chord fraction (...,) of positions (..., 2) [m]."""
        x, y = np.moveaxis(positions, -1, 0)
        return np.asarray(x / self._chord(y) + self.design.planform.straight_chord_line)

    def lines_at(self, distance: float) -> FloatArray:
        """Return the positions of the mesh lines (columns + 1,) at a distance from the root [m].

        They are measured aft of the straight chord line [m].
        """
        plan = self.design.planform
        chord = plan.chord(distance / plan.semi_span)
        aft_of_leading_edge = np.array([line.at(chord) for line in self._along])
        return np.asarray(aft_of_leading_edge - plan.straight_chord_line * chord)

    def surface(self, positions: FloatArray, depth: float = 0.0) -> Surface:
        """Return a surface below the upper one.

        Parameters
        ----------
        positions : (..., 2) array
            Positions in the plan [m].
        depth : float
            Distance below the outer surface [m], measured across it.
        """
        x, y = np.moveaxis(positions, -1, 0)
        chord = self._chord(y)
        if self._straight_section:
            height, slope = self._straight_section_at(positions, depth)
        else:
            height, slope = self._true_section_at(self.chord_fraction(positions), chord, depth)
        plan = self.design.planform
        taper = (plan.tip_chord - plan.root_chord) / plan.semi_span
        # The section shrinks with the chord: z = c f(x / c). The skin does not, which is
        # negligible.
        spanwise_slope = taper * (height - slope * x) / chord
        return Surface(height, slope, spanwise_slope)

    def _true_section_at(
        self, chord_fraction: FloatArray, chord: FloatArray, depth: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return height [m] and slope (...,) of the true section.

        Parameters
        ----------
        chord_fraction, chord : (...,) arrays
            Chord fraction and chord [m] of each point.
        depth : float
            Distance below the outer surface [m], measured across it.
        """
        ratio = self.design.airfoil.thickness_ratio
        slope = four_digit_slope(chord_fraction, ratio)
        outer = four_digit_half_thickness(chord_fraction, ratio) * chord
        return outer - depth * np.sqrt(1.0 + slope**2), slope

    def _straight_section_at(
        self, positions: FloatArray, depth: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return height [m] and slope (...,) of a section that is straight between the mesh lines.

        Parameters
        ----------
        positions : (..., 2) array
            Positions in the plan [m].
        depth : float
            Distance below the outer surface [m], measured across it.
        """
        _, y = np.moveaxis(positions, -1, 0)
        chord = self._chord(y)
        aft_of_leading_edge = self.chord_fraction(positions) * chord
        ratio = self.design.airfoil.thickness_ratio

        # Heights at all mesh lines
        lines = np.stack([line.at(chord) for line in self._along], axis=-1)
        line_count = lines.shape[-1]
        flat_lines = lines.reshape(-1, line_count)
        flat_chord = np.broadcast_to(chord, aft_of_leading_edge.shape).ravel()
        outer = straight_edged(flat_lines.T, flat_chord, ratio).T.reshape(lines.shape)
        true_slope = four_digit_slope(lines / chord[..., np.newaxis], ratio)
        heights = outer - depth * np.sqrt(1.0 + true_slope**2)

        # The lines before and behind each point
        lines_before = (lines <= aft_of_leading_edge[..., np.newaxis]).sum(axis=-1)
        interval = np.clip(lines_before - 1, 0, line_count - 2)
        start = _entry_of_last_axis(lines, interval)
        end = _entry_of_last_axis(lines, interval + 1)
        height_at_start = _entry_of_last_axis(heights, interval)
        height_at_end = _entry_of_last_axis(heights, interval + 1)
        slope = (height_at_end - height_at_start) / (end - start)
        return height_at_start + slope * (aft_of_leading_edge - start), slope

    @cached_property
    def half_grid(self) -> IntArray:
        """Node (2 columns + 1, 2 rows + 1) at each point of the grid of corners and middles."""
        i, j = np.rint(2.0 * self._index_plate.node_points.T).astype(int)
        table = np.empty((i.max() + 1, j.max() + 1), dtype=np.int64)
        table[i, j] = np.arange(len(i))
        return table

    @cached_property
    def station(self) -> FloatArray:
        """Stations (cells, q) of the integration points, as fractions of the semi-span."""
        return self.plate.span_distance / self.design.planform.semi_span

    def skin_modulus_at(self, station: FloatArray) -> FloatArray:
        """Return Young's modulus (...,) of the skin [Pa] at fractions (...,) of the semi-span."""
        return self.design.skin.young_modulus(station)

    @cached_property
    def skin_modulus(self) -> FloatArray:
        """Young's modulus (cells, q) of the skin [Pa] at the integration points."""
        return self.skin_modulus_at(self.station)

    @cached_property
    def added_density(self) -> FloatArray:
        """Density (cells, q) [kg/m^3] that is added to that of all parts."""
        density = np.zeros(self.station.shape)
        for section in self.design.added_density:
            inside = (self.station > section.start) & (self.station < section.end)
            density[inside] += section.density
        return density

    def defect(self, number: int) -> BoolArray:
        """Return whether each integration point (cells, q) lies inside a defect."""
        defect = self.design.defects[number]
        distance = self.plate.span_distance
        chord_fraction = self.chord_fraction(self.plate.points)
        inside_span = (distance > defect.span_start) & (distance < defect.span_end)
        inside_chord = (chord_fraction > defect.chord_start) & (chord_fraction < defect.chord_end)
        return np.asarray(inside_span & inside_chord)


def _entry_of_last_axis(values: FloatArray, index: IntArray) -> FloatArray:
    """Return for each point the entry (...,) of values (..., k) at an index (...,)."""
    entries = np.take_along_axis(values, index[..., np.newaxis], axis=-1)
    return np.asarray(entries.squeeze(axis=-1))
