"""The wing for patches, its rows: displacements, loads, ports and outputs as `patch` changes them.

First local losses of the skin: what strips of the wing keep of its stiffness, what gauges among them read.

NumPy and relative imports only: this file is copied into the FMU. The arrays are those of
`fe.runtime.patch_arrays`; the equations are in `docs/patches.md`.
"""

import re
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .errors import InvalidPatchError
from .patch import (
    INTERNAL_FORCES,
    InertiaRelief,
    LoadPlace,
    LocalStiffnessLoss,
    ModelPatch,
    PointMass,
    PortForce,
    Washout,
)
from .patch_arrays import PatchArrays
from .planform_forces import PLANFORM, STATION_PORTS, PlanformStations, at_stations, planform_stations

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

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
    strip: npt.NDArray[np.int64]
    of_strips: FloatArray


def boxes_of(patch: ModelPatch) -> list[LocalStiffnessLoss]:
    """Return the local losses of a patch that are not zero."""
    return [item for item in patch if isinstance(item, LocalStiffnessLoss) and item.loss != 0.0]


def remaining_skin(boxes: list[LocalStiffnessLoss], lines: FloatArray) -> RemainingSkin:
    """Return what the skin keeps under local losses, which multiply where they overlap.

    A strip keeps the harmonic mean of its pieces, since they bend one after the other, weighed by the square
    of the distance from the tip: the moment of a force there, and the way on which the tip follows the
    bending.

    Parameters
    ----------
    boxes : list of LocalStiffnessLoss
        The losses.
    lines : (S + 1,) ndarray
        Edges of the strips [m from the root].

    Raises
    ------
    InvalidPatchError
        If nothing is left somewhere.
    """
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


def strain_factors(
    skin: RemainingSkin, stations: FloatArray, length: float, skin_share: FloatArray
) -> FloatArray:
    """Return factors (G,) on the strains of gauges, by where the edges of boxes lie in their strips.

    The structure has a loss smeared over the strip that the edge of its box parts; what a gauge there reads
    is the curvature of its own section. At a given bending moment the strain of a section whose skin keeps r
    of its stiffness goes as 1 / (1 - s (1 - r)), s the skin's share of the bending stiffness; the factor is
    the mean of that over the gauge with the boxes as they are, over the same with the strips' means.

    Parameters
    ----------
    skin : RemainingSkin
        The losses.
    stations : (G,) ndarray
        Middles of the gauges [m from the root].
    length : float
        Length over which they average [m].
    skin_share : (G,) ndarray
        s at each gauge.
    """
    half, middle = 0.5 * max(length, LEAST_GAUGE_LENGTH), stations[:, None]
    begin, end = skin.breaks[:-1], skin.breaks[1:]
    covered = np.maximum(np.minimum(end, middle + half) - np.maximum(begin, middle - half), 0.0)
    exact, smeared = (
        (covered / (1.0 - skin_share[:, None] * (1.0 - remaining))).sum(axis=1)
        for remaining in (skin.exact, skin.of_strips[skin.strip])
    )
    return np.asarray(exact / smeared)


Place = str | tuple[float, float]

LOAD_PLACE = "tip_load"
"""Name of the place of the static test."""
OVERHANG = 0.15
"""How far beyond the tip a place may lie, as a share of the semi-span."""
PORTS = ("root", "tip", "span")
"""Ports where internal forces act on the motion of one place, or of the mean."""
KNOWN_PORTS = (*PORTS, PLANFORM)
"""All places that an internal force may name."""
_STRAIN = re.compile(r"strain\[(\d+)\]")
_NUMBER = r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*"
_DISPLACEMENT = re.compile(rf"displacement\[{_NUMBER},{_NUMBER}\]")

STANDARD_GRAVITY = 9.80665
"""[m/s^2]; that of `fe.wing.turn_load`, which is not copied into the FMU."""
EMPTY = ModelPatch()


def strain_gauge(output: str) -> int:
    """Return the row k - 1 of an output strain[k], k from 1; -1 for other outputs."""
    strain = _STRAIN.fullmatch(output)
    return -1 if strain is None else int(strain.group(1)) - 1


class WingRows:
    """Rows of the wing in the basis of its arrays.

    Parameters
    ----------
    arrays : PatchArrays
        From `fe.reduction.model_cache.patch_arrays`, or read from a file.
    """

    def __init__(self, arrays: PatchArrays) -> None:
        self.arrays = arrays
        self.size = len(arrays.load_tip)

    @property
    def gauge_count(self) -> int:
        """Number of gauges G."""
        return int(self.arrays.strain_rows.shape[1])

    @property
    def span(self) -> float:
        """Semi-span [m]."""
        return self.arrays.semi_span

    @cached_property
    def _line_order(self) -> IntArray:
        """Numbers (L,) of the lines of a section from the leading edge to the trailing edge."""
        return np.argsort(self.arrays.line_chord)

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
        weights = np.zeros(len(stations))
        weights[2 * cell : 2 * cell + 3] = (
            (1.0 - t) * (1.0 - 2.0 * t),
            4.0 * t * (1.0 - t),
            t * (2.0 * t - 1.0),
        )
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
        along = self._along(y)
        chords, order = self.arrays.line_chord, self._line_order
        within = chord if beside is None else beside
        number = int(np.searchsorted(chords[order], within, side="right"))
        behind = min(max(number, 1), len(order) - 1)
        first, last = order[behind - 1], order[behind]
        share = (chord - chords[first]) / (chords[last] - chords[first])
        rows = self.arrays.line_rows[2:]
        row = (1.0 - share) * (along @ rows[first])
        return np.asarray(row + share * (along @ rows[last]) if share != 0.0 else row)

    def force_row(self, place: Place, patch: ModelPatch = EMPTY) -> FloatArray:
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
        along_span = sum(item.along_span for item in patch if isinstance(item, LoadPlace))
        along_chord = sum(item.along_chord for item in patch if isinstance(item, LoadPlace))
        if isinstance(place, str):
            if place != LOAD_PLACE:
                raise InvalidPatchError(
                    f"The place {place!r} is not known; give {LOAD_PLACE!r} or the distance from the root "
                    "in metres and the chord fraction."
                )
            row = self.arrays.load_tip
            y, chord = self.arrays.load_place, float(self.arrays.line_chord[0])
        else:
            y, chord = place
            row = self.displacement_row(y, chord)
        if along_span == 0.0 and along_chord == 0.0:
            return row
        arrays = self.arrays

        def chord_at(distance: float) -> float:
            return arrays.root_chord + (arrays.tip_chord - arrays.root_chord) * distance / arrays.semi_span

        # how far aft of the straight chord line; outboard is along that line
        aft = (chord - arrays.straight_chord_line) * chord_at(y) + along_chord
        moved = y + along_span
        moved_chord = arrays.straight_chord_line + aft / chord_at(moved)
        # the clamp grips the same two lines wherever it pulls, else the response had a kink at each web
        shift = self.displacement_row(moved, moved_chord, chord) - self.displacement_row(y, chord)
        return np.asarray(row + shift)

    def load(self, load_factor: float, patch: ModelPatch = EMPTY) -> FloatArray:
        """Return the load (n,) [N] of a turn at a load factor under a patch: washout, relief by weight."""
        linear, square = self.load_parts(patch)
        return np.asarray(load_factor * linear + load_factor**2 * square)

    def load_parts(self, patch: ModelPatch = EMPTY) -> FloatArray:
        """Return the parts (2, n) of `load` that go with the load factor and with its square [N]."""
        arrays = self.arrays
        parts = np.stack((arrays.load_lift, np.zeros(self.size)))
        for item in patch:
            if isinstance(item, Washout):
                if item.exponent < 0.0:
                    raise InvalidPatchError(
                        f"The exponent of a washout must not be negative, but is {item.exponent:g}."
                    )
                eta = np.clip(arrays.stations / arrays.semi_span, 0.0, 1.0) ** item.exponent
                parts[1] -= item.coefficient * (eta @ arrays.lift_rows)
            elif isinstance(item, InertiaRelief):
                parts[0] += item.fraction * arrays.weight
            elif isinstance(item, PointMass):
                parts[0] -= STANDARD_GRAVITY * item.mass * (self._along(item.station) @ arrays.line_rows[2])
        return parts

    @cached_property
    def planform(self) -> PlanformStations:
        """Stations of forces that are spread over the planform."""
        arrays = self.arrays
        return planform_stations(arrays.semi_span, arrays.root_chord, arrays.tip_chord)

    def internal_forces(self, patch: ModelPatch) -> ModelPatch:
        """Return the internal forces of a patch by the ports of `port_row`, those of the planform by station.

        Raises
        ------
        InvalidPatchError
            If a force acts at a place that the wing does not have.
        """
        forces = patch.of(*INTERNAL_FORCES)
        for item in forces:
            if isinstance(item, PortForce) and item.port not in KNOWN_PORTS:
                raise InvalidPatchError(
                    f"The primitive {item.kind!r} acts on the port {item.port!r}, which this model does not "
                    f"have; it has {', '.join(KNOWN_PORTS)}."
                )
        return at_stations(forces, self.planform.share)

    @cached_property
    def port_rows(self) -> dict[str, FloatArray]:
        """Rows (n,) of all ports of `internal_forces`: `PORTS`, then the stations of the planform."""
        return {name: self.port_row(name) for name in (*PORTS, *STATION_PORTS)}

    def held_ports(self, ports: tuple[str, ...]) -> dict[str, FloatArray]:
        """Return the rows (n,) of the ports whose static shapes a motion with forces on `ports` holds.

        They are `PORTS`, and the stations of the planform where forces act on these.
        """
        spread = any(port in STATION_PORTS for port in ports)
        return {name: row for name, row in self.port_rows.items() if spread or name in PORTS}

    def port_row(self, name: str) -> FloatArray:
        """Return the row (n,) of a port: "root" [rad], "tip", "span" or a station of the planform [m].

        Raises
        ------
        InvalidPatchError
            If there is no such port.
        """
        if name == "root":
            return self.arrays.flap_row
        if name == "tip":
            return self.arrays.load_tip
        if name == "span":
            return np.asarray(self.arrays.station_weights @ self.arrays.line_rows[2])
        if name in STATION_PORTS:
            distance = float(self.planform.distance[STATION_PORTS.index(name)])
            return np.asarray(self._along(distance) @ self.arrays.line_rows[2])
        known = ", ".join((*PORTS, *STATION_PORTS))
        raise InvalidPatchError(f"The wing has no port {name!r}; it has {known}.")

    def output_row(self, name: str, component: int = 0, patch: ModelPatch = EMPTY) -> FloatArray | None:
        """Return the row (n,) of an output, None if there is no such output.

        Parameters
        ----------
        name : str
            strain[k] (gauges count from 1, as in the FMU), tip_displacement, load_point_displacement,
            displacement[y, x].
        component : int
            Of a strain: 0 along the span, 1 across, 2 engineering shear strain; zero for displacements.
        patch : ModelPatch
            Its local losses act on the strains, see `strain_factors`.
        """
        gauge = strain_gauge(name)
        if gauge >= 0:
            if gauge >= self.gauge_count:
                return None
            factors = self.strain_factors(patch)
            measured = self.arrays.strain_rows[component, gauge]
            return measured if factors is None else np.asarray(factors[gauge] * measured)
        row: FloatArray | None = None
        if name == "tip_displacement":
            row = self.arrays.tip_row
        elif name == "load_point_displacement":
            row = self.arrays.load_tip
        else:
            place = _DISPLACEMENT.fullmatch(name)
            if place is not None and 0.0 <= float(place.group(1)) <= self.span:
                row = self.displacement_row(float(place.group(1)), float(place.group(2)))
        return row if row is None or component == 0 else np.zeros_like(row)

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

    def strain_factors(self, patch: ModelPatch) -> FloatArray | None:
        """Return factors (G,) on the strain rows by where the edges of local losses lie in their strips.

        `fe.runtime.wing_rows.strain_factors` says what they are. They are one where boxes end at edges of
        strips.

        Returns
        -------
        (G,) ndarray or None
            None: there is no local loss.
        """
        boxes = boxes_of(patch)
        if not boxes:
            return None
        arrays = self.arrays
        skin = remaining_skin(boxes, arrays.strip_lines)
        return strain_factors(skin, arrays.gauge_stations, arrays.gauge_length, self._skin_share)
