"""Rows of a wing under patches: displacements, loads, ports and outputs.

NumPy and relative imports only: this file is copied into the FMU. The equations are in
`docs/explanation/patches.md`.
"""

import re
from functools import cached_property
from typing import NamedTuple

import numpy as np

from .arrays import FloatArray
from .errors import InvalidPatchError
from .patch import INTERNAL_FORCES, InertiaRelief, LoadPlace, ModelPatch, PointMass, Washout
from .patch_arrays import PatchArrays
from .port_laws import STATION_COUNT, STATION_PORTS, spread_over_stations
from .skin_losses import remaining_skin
from .state import STANDARD_GRAVITY

LoadLocation = str | tuple[float, float]
"""A point where a force acts: "tip_load", or distance from the root [m] and chord fraction."""

STATIC_TEST_LOAD = "tip_load"
"""Name of the point of the static test's load."""
OVERHANG = 0.15
"""How far beyond the tip a force may act, as a fraction of the semi-span."""
PORTS = ("root", "tip", "span")
"""Ports of the wing other than those of the planform."""
LEAST_GAUGE_LENGTH = 1e-3
"""Averaging length of a gauge that has no length [m]."""
NO_PATCH = ModelPatch()

_ARM_ROOT = 0.97
"""Where an arm beyond the tip is attached: its direction follows from here to the tip [span]."""
_STRAIN = re.compile(r"strain\[(?P<gauge>\d+)\](?P<component>\.transverse|\.shear)?")
_NUMBER = r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*"
_DISPLACEMENT = re.compile(rf"displacement\[{_NUMBER},{_NUMBER}\]")
_STRAIN_COMPONENTS = (None, ".transverse", ".shear")


def strain_gauge(output: str) -> int:
    """Return the index from 0 of an output's gauge, or -1 if the output is not a strain.

    In the names strain[k], strain[k].transverse and strain[k].shear k counts from 1.
    """
    strain = _STRAIN.fullmatch(output)
    return -1 if strain is None else int(strain["gauge"]) - 1


class PlanformStations(NamedTuple):
    """The integration points on a planform.

    Attributes
    ----------
    distance : (S,) array
        Distances from the root [m].
    area_fraction : (S,) array
        Fraction of the planform's area of each station; sums to one.
    """

    distance: FloatArray
    area_fraction: FloatArray


def planform_stations(semi_span: float, root_chord: float, tip_chord: float) -> PlanformStations:
    """Return the points of Gauss-Legendre integration over a tapered planform, in metres."""
    abscissa, weight = np.polynomial.legendre.leggauss(STATION_COUNT)
    eta = 0.5 * (1.0 + abscissa)
    area = weight * (root_chord + (tip_chord - root_chord) * eta)
    return PlanformStations(semi_span * eta, area / area.sum())


class WingRows:
    """Rows of displacements, loads, ports and outputs of a wing, in the basis of its arrays.

    Parameters
    ----------
    arrays : PatchArrays
        From `fe.reduction.model_cache.patch_arrays`, or read from a file.
    """

    def __init__(self, arrays: PatchArrays) -> None:
        self.arrays = arrays
        self.size = len(arrays.load_tip)
        self.span = arrays.semi_span

    def _station_weights(self, y: float) -> FloatArray:
        """Return weights (P,) that interpolate values at the stations to `y` [m from the root].

        The stations are the ends and the middles of the cells along the span; a value is
        interpolated by a parabola in each cell. Beyond the tip, up to `OVERHANG` of the span, it is
        extrapolated linearly, as on a rigid arm. Raises `InvalidPatchError` if `y` lies off the
        wing.
        """
        stations = self.arrays.stations
        if not 0.0 <= y <= (1.0 + OVERHANG) * self.span:
            raise InvalidPatchError(
                f"A place must lie on the wing, 0 to {self.span:g} m from the root, but is {y:g} m."
            )
        if y > self.span:
            # The arm continues the straight line through the tip and a point close to it.
            inboard_station = _ARM_ROOT * self.span
            arm = (y - inboard_station) / (self.span - inboard_station)
            at_tip = self._station_weights(self.span)
            at_inboard = self._station_weights(inboard_station)
            return np.asarray(arm * at_tip + (1.0 - arm) * at_inboard)
        # cell c has its ends at the stations 2 c and 2 c + 2
        last_cell = (len(stations) - 3) // 2
        ends_of_cells = stations[2::2]
        cell = min(int(np.searchsorted(ends_of_cells, y)), last_cell)
        begin = stations[2 * cell]
        end = stations[2 * cell + 2]
        # Shape functions: each is one at begin, middle or end of the cell, and zero at the others
        t = (y - begin) / (end - begin)
        at_begin = (1.0 - t) * (1.0 - 2.0 * t)
        at_middle = 4.0 * t * (1.0 - t)
        at_end = t * (2.0 * t - 1.0)
        weights = np.zeros(len(stations))
        weights[2 * cell : 2 * cell + 3] = (at_begin, at_middle, at_end)
        return weights

    @property
    def _upward_rows(self) -> FloatArray:
        """Upward displacement (P, n) of the elastic line at the stations."""
        return np.asarray(self.arrays.line_rows[2])

    def displacement_row(
        self, y: float, chord: float, between_lines_at: float | None = None
    ) -> FloatArray:
        """Return the row (n,) of the upward displacement of a section at a chord fraction.

        The displacement is linear between two neighbouring lines along the span.

        Parameters
        ----------
        y : float
            Distance from the root [m].
        chord : float
            Chord fraction.
        between_lines_at : float, optional
            The chord fraction whose neighbouring lines are taken; `chord` by default.

        Raises
        ------
        InvalidPatchError
            If `y` lies off the wing.
        """
        weights = self._station_weights(y)
        # the two lines, from the leading edge to the trailing edge
        chords = self.arrays.line_chord
        order = np.argsort(chords)
        chord_in_interval = chord if between_lines_at is None else between_lines_at
        aft_number = int(np.searchsorted(chords[order], chord_in_interval, side="right"))
        aft_number = min(max(aft_number, 1), len(order) - 1)
        fore, aft = order[aft_number - 1 : aft_number + 1]
        # linear between the two lines, or extrapolated beyond them
        fraction = (chord - chords[fore]) / (chords[aft] - chords[fore])
        rows = self.arrays.line_rows[2:]
        rows_at_chord = (1.0 - fraction) * rows[fore] + fraction * rows[aft]
        return np.asarray(weights @ rows_at_chord)

    def force_row(self, location: LoadLocation, patch: ModelPatch = NO_PATCH) -> FloatArray:
        """Return the load (n,) of 1 N at a location; as a row, the displacement there.

        Parameters
        ----------
        location : str or tuple of float
            "tip_load", or distance from the root [m] and chord fraction.
        patch : ModelPatch
            Its load places move the force.

        Raises
        ------
        InvalidPatchError
            If the location is not known or lies off the wing.
        """
        arrays = self.arrays
        if isinstance(location, str):
            if location != STATIC_TEST_LOAD:
                raise InvalidPatchError(
                    f"The place {location!r} is not known; give {STATIC_TEST_LOAD!r} or the "
                    "distance from the root in metres and the chord fraction."
                )
            y = arrays.load_place
            chord = float(arrays.line_chord[0])
            row = arrays.load_tip
        else:
            y, chord = location
            row = self.displacement_row(y, chord)
        moves = [
            (primitive.along_span, primitive.along_chord)
            for primitive in patch
            if isinstance(primitive, LoadPlace)
        ]
        along_span, along_chord = np.sum([(0.0, 0.0), *moves], axis=0).tolist()
        if along_span == 0.0 and along_chord == 0.0:
            return row
        # The force moves outboard parallel to the straight chord line, at a constant distance.
        distance_aft = (chord - arrays.straight_chord_line) * self._chord_at(y) + along_chord
        moved_y = y + along_span
        moved_chord = arrays.straight_chord_line + distance_aft / self._chord_at(moved_y)
        # The moved force acts on the same two lines: otherwise the response would have a kink where
        # the force passes a web.
        moved_row = self.displacement_row(moved_y, moved_chord, between_lines_at=chord)
        return row + moved_row - self.displacement_row(y, chord)

    def _chord_at(self, y: float) -> float:
        """Return the chord of the wing [m] at `y` [m from the root]."""
        arrays = self.arrays
        taper = arrays.tip_chord - arrays.root_chord
        return arrays.root_chord + taper * y / arrays.semi_span

    def manoeuvre_loads(self, patch: ModelPatch = NO_PATCH) -> FloatArray:
        """Return the loads of a manoeuvre with load factor N: row 0 times N plus row 1 times N^2.

        Lift and weight are proportional to N, and so are their changes by reliefs by weight and
        point masses of the patch. A washout takes lift off in proportion to the lift itself and to
        the bending that it causes, each proportional to N: this load is proportional to N^2.

        Returns
        -------
        (2, n) array
            The loads [N].

        Raises
        ------
        InvalidPatchError
            If the exponent of a washout is negative, or a point mass lies off the wing.
        """
        arrays = self.arrays
        linear_load = arrays.load_lift.copy()
        quadratic_load = np.zeros(self.size)
        for primitive in patch:
            if isinstance(primitive, Washout):
                if primitive.exponent < 0.0:
                    raise InvalidPatchError(
                        "The exponent of a washout must not be negative, but is "
                        f"{primitive.exponent:g}."
                    )
                eta = np.clip(arrays.stations / arrays.semi_span, 0.0, 1.0)
                quadratic_load -= primitive.coefficient * (
                    eta**primitive.exponent @ arrays.lift_rows
                )
            elif isinstance(primitive, InertiaRelief):
                linear_load += primitive.fraction * arrays.weight
            elif isinstance(primitive, PointMass):
                row = self._station_weights(primitive.station) @ self._upward_rows
                linear_load -= STANDARD_GRAVITY * primitive.mass * row
        return np.stack((linear_load, quadratic_load))

    @cached_property
    def planform_stations(self) -> PlanformStations:
        """The stations of forces that are spread over the planform."""
        return planform_stations(self.span, self.arrays.root_chord, self.arrays.tip_chord)

    def internal_forces(self, patch: ModelPatch) -> ModelPatch:
        """Return the internal forces of a patch at ports of `port_rows`.

        A force over the planform becomes one at every station.
        """
        forces = patch.of(*INTERNAL_FORCES)
        return spread_over_stations(forces, self.planform_stations.area_fraction)

    @cached_property
    def port_rows(self) -> dict[str, FloatArray]:
        """Rows (n,) of `PORTS` ("root" in rad, others in m), then of the planform's stations."""
        rows = {
            "root": self.arrays.flap_row,
            "tip": self.arrays.load_tip,
            "span": self.arrays.station_weights @ self._upward_rows,
        }
        distances = self.planform_stations.distance.tolist()
        for name, distance in zip(STATION_PORTS, distances, strict=True):
            rows[name] = self._station_weights(distance) @ self._upward_rows
        return rows

    @cached_property
    def static_shape_rows(self) -> FloatArray:
        """Loads (s, n) whose static shapes a basis of motion contains: load point and `PORTS`."""
        return np.vstack((self.arrays.load_tip, *(self.port_rows[name] for name in PORTS)))

    def output_row(self, name: str) -> FloatArray | None:
        """Return the row (n,) of an output; None if there is no such output.

        Parameters
        ----------
        name : str
            strain[k] (gauges count from 1, as in the FMU), strain[k].transverse for the strain
            across it, strain[k].shear for engineering strain, tip_displacement,
            load_point_displacement, or displacement[y, x] with the distance from the root [m] and
            the chord fraction.
        """
        if name == "tip_displacement":
            return self.arrays.tip_row
        if name == "load_point_displacement":
            return self.arrays.load_tip
        strain = _STRAIN.fullmatch(name)
        if strain is not None:
            component = _STRAIN_COMPONENTS.index(strain["component"])
            rows = self.arrays.strain_rows[component]
            gauge = int(strain["gauge"])
            return rows[gauge - 1] if 0 < gauge <= len(rows) else None
        displacement = _DISPLACEMENT.fullmatch(name)
        if displacement is not None:
            y, chord = map(float, displacement.groups())
            if 0.0 <= y <= self.span:
                return self.displacement_row(y, chord)
        return None

    @cached_property
    def _skin_fraction(self) -> FloatArray:
        """The skin's fraction (G,) of the bending stiffness at each gauge, computed from strains.

        At a given bending moment the strain is proportional to 1 / stiffness. If a skin with the
        fraction s of the bending stiffness loses the fraction d of its own stiffness, the ratio of
        the strains before and after is 1 - s d.
        """
        trial_loss = 0.3  # s follows from any loss d; this one is far from rounding
        terms = len(self.arrays.stiffness)
        healthy = np.ones(terms)
        # The last term of the stiffness is not that of the skin.
        soft_skin = np.append(np.full(terms - 1, 1.0 - trial_loss), 1.0)
        ratio = self._strain_under_lift(healthy) / self._strain_under_lift(soft_skin)
        return np.asarray((1.0 - ratio) / (1.0 - soft_skin[0]))

    def _strain_under_lift(self, theta: FloatArray) -> FloatArray:
        """Return the strains (G,) under lift for coefficients of the stiffness terms."""
        stiffness = np.tensordot(theta, self.arrays.stiffness, 1)
        displacement = np.linalg.solve(stiffness, self.arrays.load_lift)
        return np.asarray(self.arrays.strain_rows[0] @ displacement)

    def strain_factors(self, patch: ModelPatch) -> FloatArray | None:
        """Return factors that correct the strains of gauges for local losses within a strip.

        The model averages a local loss over a strip between mesh lines, but a gauge reads the
        curvature at its own section. If the skin contributes the fraction s of the bending
        stiffness of a section, and keeps the fraction r of its own stiffness, the strain at a given
        bending moment is proportional to 1 / (1 - s (1 - r)). The factor of a gauge is the mean of
        this strain over the length of the gauge with the local losses, divided by the mean with
        averaged losses. It is one if losses end at the edges of strips.

        Returns
        -------
        (G,) array or None
            The factors; None if the patch has no local loss.
        """
        skin = remaining_skin(patch, self.arrays.strip_lines)
        if skin is None:
            return None
        # length of each piece under each gauge
        half_length = 0.5 * max(self.arrays.gauge_length, LEAST_GAUGE_LENGTH)
        gauge_begin = self.arrays.gauge_stations[:, None] - half_length
        gauge_end = self.arrays.gauge_stations[:, None] + half_length
        covered_begin = np.maximum(skin.breaks[:-1], gauge_begin)
        covered_end = np.minimum(skin.breaks[1:], gauge_end)
        covered_lengths = np.maximum(covered_end - covered_begin, 0.0)
        # mean strains
        strain_with_local_losses = self._mean_strain(covered_lengths, skin.by_piece)
        strain_with_averaged_losses = self._mean_strain(
            covered_lengths, skin.by_strip[skin.strip_of_piece]
        )
        return np.asarray(strain_with_local_losses / strain_with_averaged_losses)

    def _mean_strain(self, covered: FloatArray, remaining: FloatArray) -> FloatArray:
        """Return relative mean strains (G,) of gauges over pieces of the skin.

        `covered` (G, m) is the length of each piece under each gauge [m]; `remaining` (m,) is the
        fraction of its stiffness that each piece keeps.
        """
        relative_stiffness = 1.0 - self._skin_fraction[:, None] * (1.0 - remaining)
        return np.asarray((covered / relative_stiffness).sum(axis=1))
