"""The stored arrays of a wing under patches; the equations are in `docs/explanation/patches.md`.

NumPy and relative imports only: this file is copied into the FMU.
"""

from dataclasses import dataclass
from math import inf
from sys import float_info
from typing import Annotated

import numpy as np
import numpy.typing as npt

from .arrays import FloatArray, IntArray, StoredArrays
from .state import wing_input_names

Positive = Annotated[float, float_info.min, inf]


@dataclass(frozen=True, repr=False)
class PatchArrays(StoredArrays):
    """Dense matrices and rows of a wing in a basis of n vectors, made for `fe.runtime.patch`.

    Attributes
    ----------
    validity_box : (K + 5, 2) array
        Least and largest value of each of `fe.runtime.state.wing_input_names`, SI units.
    largest_loss, largest_compliance, largest_mass : float
        Largest stiffness loss of a strip [1], root compliance [rad/(N m)] and point mass [kg] for
        which the basis was made; beyond them the accuracy decreases slowly.
    stiffness : (K + 2, n, n) array
        Stiffness terms: the skin, the K damage regions, the rest.
    mass : (3, n, n) array
        Mass terms: the structure, 1 kg in each servo, 1 kg in the pitot tube.
    strip_lines : (S + 1,) array
        Edges of the strips of the skin [m from the root].
    strip_stiffness : (T, n (n + 1) / 2) array of float32
        Lower triangles, row by row, of the parts of the stiffness terms of the skin that lie in
        strips.
    strip_of, term_of : (T,) array of int64
        Strip, and stiffness term, of each part.
    flap_row : (n,) array
        Flapping rotation of the root [rad].
    flap_spring : float
        Spring at the root [N m/rad].
    semi_span, root_chord, tip_chord : float
        Semi-span and chords [m].
    straight_chord_line : float
        Chord fraction of the line that runs straight along the span.
    load_place : float
        Distance of the static test's load from the root [m].
    stations : (P,) array
        Sections: mesh lines and the middles between them [m from the root], P odd.
    line_chord : (L,) array
        Chord fractions of the elastic line and of the other lines, ascending; L at least 2.
    line_rows : (L + 2, P, n) array
        Displacement of the elastic line along x, y and z and of the other lines along z.
    station_weights : (P,) array
        Fraction of the planform's area; sums to one.
    load_tip : (n,) array
        Load of 1 N at the point of the static test; as a row, the displacement there.
    load_lift : (n,) array
        Load of load factor 1 [N].
    lift_rows : (P, n) array
        The lift of load factor 1 without the weight, as one load for each station [N].
    weight : (n,) array
        Weight, downwards [N].
    strain_rows : (3, G, n) array
        Strain of the gauges along the span, across it, and engineering shear strain, positive as
        measured.
    gauge_stations : (G,) array
        Middles of the gauges [m from the root].
    gauge_length : float
        Length along the span over which they average [m].
    tip_row : (n,) array
        Displacement of the tip.
    start_shapes : (n, r) array
        Modes of the unchanged wing, from which the modes of a patched one are iterated.
    """

    record_name = "a wing for patches"
    version = 4

    validity_box: Annotated[FloatArray, "inputs", 2]
    largest_loss: Positive
    largest_compliance: Positive
    largest_mass: Positive
    stiffness: Annotated[FloatArray, "terms", "basis", "basis"]
    mass: Annotated[FloatArray, 3, "basis", "basis"]
    strip_lines: Annotated[FloatArray, "lines"]
    strip_stiffness: Annotated[npt.NDArray[np.float32], "parts", "triangle"]
    strip_of: Annotated[IntArray, "parts"]
    term_of: Annotated[IntArray, "parts"]
    flap_row: Annotated[FloatArray, "basis"]
    flap_spring: Positive
    semi_span: Positive
    root_chord: Positive
    tip_chord: Positive
    straight_chord_line: Annotated[float, 0.0, 1.0]
    load_place: Positive
    stations: Annotated[FloatArray, "stations"]
    line_chord: Annotated[FloatArray, "chords"]
    line_rows: Annotated[FloatArray, "directions", "stations", "basis"]
    station_weights: Annotated[FloatArray, "stations"]
    load_tip: Annotated[FloatArray, "basis"]
    load_lift: Annotated[FloatArray, "basis"]
    lift_rows: Annotated[FloatArray, "stations", "basis"]
    weight: Annotated[FloatArray, "basis"]
    strain_rows: Annotated[FloatArray, 3, "gauges", "basis"]
    gauge_stations: Annotated[FloatArray, "gauges"]
    gauge_length: Annotated[float, 0.0, inf]
    tip_row: Annotated[FloatArray, "basis"]
    start_shapes: Annotated[FloatArray, "basis", "started"]

    def __post_init__(self) -> None:
        super().__post_init__()
        strips = set(range(len(self.strip_lines) - 1))
        terms = set(range(len(self.regions) + 1))
        if not set(self.strip_of) <= strips or not set(self.term_of) <= terms:
            raise self._error("has strips that do not fit its strip lines")
        stations_rise = np.all(np.diff(self.stations) > 0.0)
        strip_lines_rise = np.all(np.diff(self.strip_lines) > 0.0)
        if not (stations_rise and strip_lines_rise):
            raise self._error("must have stations that rise from the root to the tip")

    def _axis_lengths(self) -> dict[str, int]:
        size = self.stiffness.shape[-1]
        chords = len(self.line_chord)
        return {
            "inputs": len(wing_input_names(self.regions)),
            "terms": len(self.regions) + 2,
            "triangle": size * (size + 1) // 2,
            "chords": max(chords, 2),
            "directions": chords + 2,
        }
