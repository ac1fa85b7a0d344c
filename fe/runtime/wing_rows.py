"""The wing for patches: its arrays, checked, and its rows: displacements, loads, ports, outputs.

First the arrays and their file, then local losses of the skin: what strips of the wing keep of its stiffness,
what gauges among them read. NumPy and relative imports only: this file is copied into the FMU. The equations
are in `docs/patches.md`.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from math import inf
from sys import float_info
from typing import Annotated, NamedTuple

import numpy as np
import numpy.typing as npt

from . import patch as primitives
from .arrays import FloatArray, IntArray, KeptArrays
from .errors import InvalidPatchError
from .motion import STATION_COUNT, STATION_PORTS, at_stations
from .state import STANDARD_GRAVITY, wing_names

Positive = Annotated[float, float_info.min, inf]


@dataclass(frozen=True, repr=False)
class PatchArrays(KeptArrays):
    """Dense matrices and rows of a wing in a basis of n vectors, made for changes of `fe.runtime.patch`.

    Attributes
    ----------
    validity_box : (K + 5, 2) ndarray
        Least and largest value of each of `fe.runtime.state.wing_names`, SI units.
    largest_loss, largest_compliance, largest_mass : float
        Stiffness loss of a strip [1], root compliance [rad/(N m)] and point mass [kg] up to which the basis
        was made; the accuracy falls slowly beyond.
    stiffness : (K + 2, n, n) ndarray
        Stiffness terms: skin, the K damage regions, the rest.
    mass : (3, n, n) ndarray
        Mass terms: structure, 1 kg in each servo, 1 kg in the pitot.
    strip_lines : (S + 1,) ndarray
        Edges of the strips of the skin [m from the root].
    strip_stiffness : (T, n (n + 1) / 2) ndarray of float32
        Lower triangles, row by row, of the parts of the stiffness terms of the skin that lie in strips.
    strip_of, term_of : (T,) ndarray of int64
        Strip, and stiffness term, of each part.
    flap_row : (n,) ndarray
        Flapping rotation of the root [rad].
    flap_spring : float
        Spring at the root [N m/rad].
    semi_span, root_chord, tip_chord : float
        L and the chords [m].
    straight_chord_line : float
        Chord fraction of the line that runs straight along the span.
    load_place : float
        Distance of the static test's load from the root [m].
    stations : (P,) ndarray
        Sections: mesh lines and the middles between them [m from the root], P odd.
    line_chord : (L,) ndarray
        Chord fractions of the elastic line and of the other lines, ascending; L at least 2.
    line_rows : (L + 2, P, n) ndarray
        Displacement of the elastic line along x, y and z and of the other lines along z.
    station_weights : (P,) ndarray
        Share of the planform's area; sums to one.
    load_tip : (n,) ndarray
        Load of 1 N at the place of the static test; as a row, the displacement there.
    load_lift : (n,) ndarray
        Load of load factor 1 [N].
    lift_rows : (P, n) ndarray
        The same without the weight, by stations.
    weight : (n,) ndarray
        Weight, downwards [N].
    strain_rows : (3, G, n) ndarray
        Strain of the gauges along the span, across it, and engineering shear strain, positive as measured.
    gauge_stations : (G,) ndarray
        Middles of the gauges [m from the root].
    gauge_length : float
        Length along the span over which they average [m].
    tip_row : (n,) ndarray
        Displacement of the tip.
    start_shapes : (n, r) ndarray
        Modes of the wing as it was, from which the modes of a patched one are iterated.
    """

    what = "a wing for patches"
    version = 4

    validity_box: Annotated[FloatArray, "chosen", 2]
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
        places = ((self.strip_of, len(self.strip_lines) - 1), (self.term_of, len(self.regions) + 1))
        if any(not set(numbers) <= set(range(count)) for numbers, count in places):
            self.refuse("has strips that do not fit its strip lines")
        if np.any(np.diff(self.stations) <= 0.0) or np.any(np.diff(self.strip_lines) <= 0.0):
            self.refuse("must have stations that rise from the root to the tip")

    def _lengths(self) -> dict[str | int, int]:
        size, chords = self.stiffness.shape[-1], len(self.line_chord)
        return {
            "chosen": len(wing_names(self.regions)),
            "terms": len(self.regions) + 2,
            "triangle": size * (size + 1) // 2,
            "chords": max(chords, 2),
            "directions": chords + 2,
        }


TIP_OFFSET = 1.02
"""Where the weight of a part of the skin would vanish, in semi-spans."""
LEAST_GAUGE_LENGTH = 1e-3
"""A gauge without a length averages over this [m]."""


class RemainingSkin(NamedTuple):
    """What the skin keeps of its stiffness along the span.

    Attributes
    ----------
    breaks : (m + 1,) ndarray
        Edges of strips and boxes [m from the root].
    exact : (m,) ndarray
        What it keeps between them.
    strip : (m,) ndarray of int
        The strip that each piece lies in.
    of_strips : (S,) ndarray
        What each strip as a whole keeps, so that the tip moves as much as with the boxes as they are.
    """

    breaks: FloatArray
    exact: FloatArray
    strip: IntArray
    of_strips: FloatArray


def remaining_skin(patch: primitives.ModelPatch, lines: FloatArray) -> RemainingSkin | None:
    """Return what the skin keeps under the local losses of a patch; None where there are none.

    Losses multiply where they overlap. A strip keeps the harmonic mean of its pieces, since they bend one
    after the other, weighed by the square of the distance from the tip: the moment of a force there, and the
    way on which the tip follows the bending.

    Parameters
    ----------
    patch : ModelPatch
        The losses.
    lines : (S + 1,) ndarray
        Edges of the strips [m from the root].

    Raises
    ------
    InvalidPatchError
        If nothing is left somewhere.
    """
    boxes = [item for item in patch if isinstance(item, primitives.LocalStiffnessLoss) and item.loss != 0.0]
    if not boxes:
        return None
    edges = [edge for box in boxes for edge in (box.start, box.start + box.length)]
    breaks = np.unique(np.concatenate((lines, np.clip(edges, lines[0], lines[-1]))))
    middles = 0.5 * (breaks[1:] + breaks[:-1])
    exact = np.ones(len(middles))
    for box in boxes:
        exact *= 1.0 - box.loss * ((middles > box.start) & (middles < box.start + box.length))
    if exact.min() <= 0.0:
        raise InvalidPatchError(
            f"A local stiffness loss must leave some stiffness, but leaves {exact.min():g} of it."
        )
    strip = np.maximum(np.searchsorted(lines, middles) - 1, 0)  # one may begin next to nothing above zero
    weights = -np.diff((TIP_OFFSET * lines[-1] - breaks) ** 3)
    count = len(lines) - 1
    of_strips = np.bincount(strip, weights, count) / np.bincount(strip, weights / exact, count)
    return RemainingSkin(breaks, exact, strip.astype(np.int64), of_strips)


Place = str | tuple[float, float]

LOAD_PLACE = "tip_load"
"""Name of the place of the static test."""
OVERHANG = 0.15
"""How far beyond the tip a place may lie, as a share of the semi-span."""
PORTS = ("root", "tip", "span")
"""Ports where internal forces act on the motion of one place, or of the mean."""
_STRAIN = re.compile(r"strain\[(\d+)\](\.transverse|\.shear)?")
_NUMBER = r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*"
_DISPLACEMENT = re.compile(rf"displacement\[{_NUMBER},{_NUMBER}\]")

EMPTY = primitives.ModelPatch()


def strain_gauge(output: str) -> int:
    """Return the row k - 1 of an output strain[k] and the like, k from 1; -1 for other outputs."""
    strain = _STRAIN.fullmatch(output)
    return -1 if strain is None else int(strain.group(1)) - 1


def planform_stations(semi_span: float, root_chord: float, tip_chord: float) -> tuple[FloatArray, FloatArray]:
    """Return the stations (S,) [m from the root] of the integral over the planform, and their shares (S,).

    The chord is linear along the span; the shares are of the area and sum to one.
    """
    place, weight = np.polynomial.legendre.leggauss(STATION_COUNT)
    eta = 0.5 * (1.0 + place)
    area = weight * (root_chord + (tip_chord - root_chord) * eta)
    return semi_span * eta, area / area.sum()


class WingRows:
    """Rows of the wing in the basis of its arrays.

    Parameters
    ----------
    arrays : PatchArrays
        From `fe.reduction.model_cache.patch_arrays`, or read from a file.
    """

    def __init__(self, arrays: PatchArrays) -> None:
        self.arrays, self.size, self.span = arrays, len(arrays.load_tip), arrays.semi_span

    def _along(self, y: float) -> FloatArray:
        """Weights (P,) of the stations at `y` m from the root: the parabola of the mesh cell."""
        stations, span = self.arrays.stations, self.span
        if not 0.0 <= y <= (1.0 + OVERHANG) * span:
            raise InvalidPatchError(
                f"A place must lie on the wing, 0 to {span:g} m from the root, but is {y:g} m."
            )
        if y > span:  # a force beyond the tip hangs on a stiff arm
            inboard = 0.97 * span
            arm = (y - inboard) / (span - inboard)
            return np.asarray(arm * self._along(span) + (1.0 - arm) * self._along(inboard))
        cell = min(max(int(np.searchsorted(stations[2::2], y)), 0), (len(stations) - 3) // 2)
        first, last = stations[2 * cell], stations[2 * cell + 2]
        t = (y - first) / (last - first)
        weights, parabola = np.zeros(len(stations)), np.array((1.0 - t, 4.0 * t * (1.0 - t), t))
        parabola[::2] *= (1.0 - 2.0 * t, 2.0 * t - 1.0)
        weights[2 * cell : 2 * cell + 3] = parabola
        return weights

    def displacement_row(self, y: float, chord: float, beside: float | None = None) -> FloatArray:
        """Return the row (n,) of the upward displacement of a section at a chord fraction.

        Parameters
        ----------
        y : float
            Distance from the root [m].
        chord : float
            Chord fraction.
        beside : float, optional
            The section is straight through the two lines beside this chord fraction; `chord` by default.

        Raises
        ------
        InvalidPatchError
            If `y` lies off the wing.
        """
        along, chords = self._along(y), self.arrays.line_chord
        order = np.argsort(chords)  # from the leading edge to the trailing edge
        within = chord if beside is None else beside
        behind = min(max(int(np.searchsorted(chords[order], within, side="right")), 1), len(order) - 1)
        first, last = order[behind - 1 : behind + 1]
        share = (chord - chords[first]) / (chords[last] - chords[first])
        rows = self.arrays.line_rows[2:]
        return np.asarray(along @ ((1.0 - share) * rows[first] + share * rows[last]))

    def force_row(self, place: Place, patch: primitives.ModelPatch = EMPTY) -> FloatArray:
        """Return the load (n,) of 1 N at a place; as a row, the displacement there.

        Parameters
        ----------
        place : str or tuple of float
            "tip_load", or distance from the root [m] and chord fraction.
        patch : ModelPatch
            Its load places act.

        Raises
        ------
        InvalidPatchError
            If the place is not known or lies off the wing.
        """
        arrays = self.arrays
        if isinstance(place, str):
            if place != LOAD_PLACE:
                raise InvalidPatchError(
                    f"The place {place!r} is not known; give {LOAD_PLACE!r} or the distance from the root "
                    "in metres and the chord fraction."
                )
            y, chord, row = arrays.load_place, float(arrays.line_chord[0]), arrays.load_tip
        else:
            y, chord = place
            row = self.displacement_row(y, chord)
        moves = [
            (item.along_span, item.along_chord) for item in patch if isinstance(item, primitives.LoadPlace)
        ]
        along_span, along_chord = np.sum([(0.0, 0.0), *moves], axis=0).tolist()
        if along_span == 0.0 and along_chord == 0.0:
            return row

        def chord_at(distance: float) -> float:
            return arrays.root_chord + (arrays.tip_chord - arrays.root_chord) * distance / arrays.semi_span

        # how far aft of the straight chord line; outboard is along that line
        aft = (chord - arrays.straight_chord_line) * chord_at(y) + along_chord
        moved = y + along_span
        moved_chord = arrays.straight_chord_line + aft / chord_at(moved)
        # the clamp grips the same two lines wherever it pulls, else the response had a kink at each web
        return row + self.displacement_row(moved, moved_chord, chord) - self.displacement_row(y, chord)

    def load_parts(self, patch: primitives.ModelPatch = EMPTY) -> FloatArray:
        """Return the loads (2, n) of a turn that go with the load factor and with its square [N].

        Washout, relief by weight and point masses of the patch act.
        """
        arrays = self.arrays
        parts = np.stack((arrays.load_lift, np.zeros(self.size)))
        for item in patch:
            if isinstance(item, primitives.Washout):
                if item.exponent < 0.0:
                    raise InvalidPatchError(
                        f"The exponent of a washout must not be negative, but is {item.exponent:g}."
                    )
                eta = np.clip(arrays.stations / arrays.semi_span, 0.0, 1.0) ** item.exponent
                parts[1] -= item.coefficient * (eta @ arrays.lift_rows)
            elif isinstance(item, primitives.InertiaRelief):
                parts[0] += item.fraction * arrays.weight
            elif isinstance(item, primitives.PointMass):
                parts[0] -= STANDARD_GRAVITY * item.mass * (self._along(item.station) @ arrays.line_rows[2])
        return parts

    @cached_property
    def planform(self) -> tuple[FloatArray, FloatArray]:
        """Stations of forces that are spread over the planform, and their shares."""
        return planform_stations(self.span, self.arrays.root_chord, self.arrays.tip_chord)

    def internal_forces(self, patch: primitives.ModelPatch) -> primitives.ModelPatch:
        """Return the internal forces of a patch by ports of `port_rows`, of the planform by station."""
        return at_stations(patch.of(*primitives.INTERNAL_FORCES), self.planform[1])

    @cached_property
    def port_rows(self) -> dict[str, FloatArray]:
        """Rows (n,) of `PORTS`, "root" in rad and the others in m, then of the planform's stations."""
        upwards = self.arrays.line_rows[2]
        stations = [self._along(distance) @ upwards for distance in self.planform[0].tolist()]
        places = (self.arrays.flap_row, self.arrays.load_tip, self.arrays.station_weights @ upwards)
        return dict(zip((*PORTS, *STATION_PORTS), (*places, *stations), strict=True))

    @cached_property
    def held(self) -> FloatArray:
        """Rows (s, n) of the load point and of `PORTS`, whose static shapes a motion holds."""
        return np.vstack((self.arrays.load_tip, *(self.port_rows[name] for name in PORTS)))

    def output_row(self, name: str) -> FloatArray | None:
        """Return the row (n,) of an output, None if there is no such output.

        Parameters
        ----------
        name : str
            strain[k] (gauges count from 1, as in the FMU), strain[k].transverse across it, strain[k].shear
            (engineering strain), tip_displacement, load_point_displacement, displacement[y, x].
        """
        strain = _STRAIN.fullmatch(name)
        if strain is not None:
            strains = self.arrays.strain_rows[(None, ".transverse", ".shear").index(strain[2])]
            return strains[int(strain[1]) - 1] if 0 < int(strain[1]) <= len(strains) else None
        known = {"tip_displacement": self.arrays.tip_row, "load_point_displacement": self.arrays.load_tip}
        row = known.get(name)
        place = _DISPLACEMENT.fullmatch(name)
        if place is not None and 0.0 <= float(place.group(1)) <= self.span:
            row = self.displacement_row(float(place.group(1)), float(place.group(2)))
        return row

    @cached_property
    def _skin_share(self) -> FloatArray:
        """Share (G,) of the bending stiffness at each gauge that the skin has, as the strain shows it."""
        terms = len(self.arrays.stiffness)
        softer = np.append(np.full(terms - 1, 0.7), 1.0)
        whole, less = (
            self.arrays.strain_rows[0]
            @ np.linalg.solve(np.tensordot(theta, self.arrays.stiffness, 1), self.arrays.load_lift)
            for theta in (np.ones(terms), softer)
        )
        return np.asarray((1.0 - whole / less) / (1.0 - softer[0]))

    def strain_factors(self, patch: primitives.ModelPatch) -> FloatArray | None:
        """Return factors (G,) on the strain rows, by where the edges of local losses lie in their strips.

        The structure has a loss smeared over the strip that the edge of its box parts; what a gauge there
        reads is the curvature of its own section. At a given bending moment the strain of a section whose
        skin keeps r of its stiffness goes as 1 / (1 - s (1 - r)), s the skin's share of the bending
        stiffness; the factor is the mean of that over the gauge with the boxes as they are, over the same
        with the strips' means. It is one where boxes end at edges of strips.

        Returns
        -------
        (G,) ndarray or None
            None: there is no local loss.
        """
        skin = remaining_skin(patch, self.arrays.strip_lines)
        if skin is None:
            return None
        half = 0.5 * max(self.arrays.gauge_length, LEAST_GAUGE_LENGTH)
        middle, share = self.arrays.gauge_stations[:, None], self._skin_share[:, None]
        begin, end = skin.breaks[:-1], skin.breaks[1:]
        covered = np.maximum(np.minimum(end, middle + half) - np.maximum(begin, middle - half), 0.0)
        exact, smeared = (
            (covered / (1.0 - share * (1.0 - remaining))).sum(axis=1)
            for remaining in (skin.exact, skin.of_strips[skin.strip])
        )
        return np.asarray(exact / smeared)
