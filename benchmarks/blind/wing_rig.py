"""A wing with something hidden in it: what perfect sensors on it would show."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.changes import Changes
from benchmarks.blind.laws import DRAG, POWER, Law
from benchmarks.blind.plan import TrialPlan
from benchmarks.blind.structure import Release, Structure
from benchmarks.blind.wing_basis import WingBasis, WingBasisStore
from fe.runtime.state import STANDARD_GRAVITY

FloatArray = NDArray[np.float64]

MODES = 16
"""Modes that move with inertia; records reach 125 Hz, the twelfth mode 143 Hz."""
LOAD_POINT, TIP, MIDDLE = range(3)


class WingRig:
    """The wing of the shipped design.

    Parameters
    ----------
    store : WingBasisStore
        Its full model.
    """

    name = "wing"

    def __init__(self, store: WingBasisStore) -> None:
        self.store = store
        self.design = store.design
        self.outputs = (
            *(f"strain[{k + 1}]" for k in range(len(self.design.gauges.positions))),
            "load_point_displacement",
            "tip_displacement",
            "displacement[0.914, 0.3]",
        )

    def structure(
        self, parameters: Mapping[str, float], changes: Changes, temperature: float = 0.0
    ) -> Structure:
        """Return the wing at a temperature above the reference [K]."""
        basis = self.store.basis(changes.region)
        e = parameters["young_modulus_factor"] * (1.0 - changes.modulus_temperature * temperature)
        theta = np.array([e, 1.0, 1.0, 1.0])
        stiffness = np.tensordot(theta, basis.stiffness, 1)
        if changes.loss:
            stiffness = stiffness - changes.loss * np.tensordot(theta[:3], basis.damaged, 1)
        if changes.root_compliance:
            spring = 1.0 / (1.0 / basis.flap_spring + changes.root_compliance)
            stiffness = stiffness + (spring - basis.flap_spring) * np.outer(basis.root, basis.root)
        mass = np.tensordot(
            np.array([1.0, parameters["servo_mass"], parameters["pitot_mass"]]), basis.mass, 1
        )
        if changes.mass:
            for row in self._at(basis, changes.mass_station):
                mass = mass + changes.mass * np.outer(row, row)
        strain = basis.strain[0].copy()
        for fault in changes.faults:
            if fault.kind == "rotation":
                along, across, diagonal = (basis.strain[k] for k in range(3))
                cosine, sine = np.cos(fault.numbers[0]), np.sin(fault.numbers[0])
                shear = 2.0 * diagonal - along - across
                for channel in fault.channels:
                    g = int(channel[1:])
                    strain[g] = (
                        cosine**2 * along[g] + sine**2 * across[g] + sine * cosine * shear[g]
                    )
        return Structure(
            stiffness=stiffness,
            mass=mass,
            alpha=parameters["damping_alpha"],
            beta=parameters["damping_beta"],
            outputs=np.vstack([strain, basis.displacement]),
            ports=self._ports(basis),
            modes=MODES,
            stiffness_rate=changes.stiffness_rate,
        )

    def laws(self, changes: Changes) -> tuple[Law, ...]:
        """Return the laws of the forces inside, those that are spread over the wing included."""
        laws = list(changes.laws)
        for k, share in enumerate(self.area_shares().tolist()):
            if changes.drag:
                laws.append(Law(f"line{k}", DRAG, (changes.drag * share,)))
            if changes.spread_cubic:
                laws.append(Law(f"line{k}", POWER, (changes.spread_cubic * share, 3.0, 0.0)))
        return tuple(laws)

    def area_shares(self) -> FloatArray:
        """Shares (S,) of the planform's area, by station; inboard of the first there is more."""
        stations, plan = self.store.basis().stations, self.design.planform
        chord = plan.root_chord + (plan.tip_chord - plan.root_chord) * stations / plan.semi_span
        width = np.zeros(len(stations))
        gaps = np.diff(stations)
        width[:-1] += 0.5 * gaps
        width[1:] += 0.5 * gaps
        area = 0.5 * (plan.root_chord + plan.tip_chord) * plan.semi_span
        return np.asarray(width * chord / area)

    def _ports(self, basis: WingBasis) -> dict[str, FloatArray]:
        ports = {"root": basis.root, "tip": basis.displacement[LOAD_POINT]}
        ports |= {f"line{k}": row for k, row in enumerate(basis.line[2])}
        ports["span"] = self.mean_weights() @ basis.line[2]
        return ports

    def mean_weights(self) -> FloatArray:
        """Return weights (K,) of station displacements whose sum is the mean over the planform.

        Inboard of the first station, where the root bends too, it grows as the distance to the
        power 3/2.
        """
        stations, plan = self.store.basis().stations, self.design.planform
        taper = (plan.tip_chord - plan.root_chord) / plan.semi_span
        width = np.zeros(len(stations))
        width[:-1] += 0.5 * np.diff(stations)
        width[1:] += 0.5 * np.diff(stations)
        weights = width * (plan.root_chord + taper * stations)
        weights[0] += stations[0] * (plan.root_chord / 2.5 + taper * stations[0] / 3.5)
        return np.asarray(weights / (0.5 * (plan.root_chord + plan.tip_chord) * plan.semi_span))

    def _at(self, basis: WingBasis, station: float) -> FloatArray:
        """Return the displacement (3, r) of the chord line at a station [m].

        It is that of the mesh's quadratic cells: the parabola through the two mesh lines beside
        the station and the point half way between them.
        """
        lines_before = int(np.searchsorted(basis.stations, station))
        cell = min(max(lines_before - 1, 0), len(basis.stations) - 2)
        begin, end = basis.stations[cell : cell + 2]
        t = (station - begin) / (end - begin)
        return np.asarray(
            (1.0 - t) * (1.0 - 2.0 * t) * basis.line[:, cell]
            + 4.0 * t * (1.0 - t) * basis.line_between[:, cell]
            + t * (2.0 * t - 1.0) * basis.line[:, cell + 1]
        )

    def load(self, place: str, changes: Changes, region: int = -1) -> FloatArray:
        """Return the load (r,) of an upward force of 1 N said to act at a place.

        A displaced force is held by a clamp: it goes to the mesh lines beside it, and its couple
        about the web to the next web.
        """
        basis = self.store.basis(region)
        plan = self.design.planform
        nominal, y, chord = {
            "tip": (basis.displacement[LOAD_POINT], plan.semi_span - 0.05, 0),
            "middle": (basis.displacement[MIDDLE], 0.914, 0),
            "corner": (basis.corner, plan.semi_span - 0.05, 2),
        }[place]
        if not (changes.shift_span or changes.shift_chord):
            return np.asarray(nominal)
        stations, holders = (
            (basis.middle_stations, basis.middle_holders)
            if place == "middle"
            else (basis.tip_stations, basis.tip_holders)
        )

        def split(station: float, web: int) -> FloatArray:
            weights = np.array([np.interp(station, stations, row) for row in np.eye(len(stations))])
            return np.asarray(weights @ holders[web])

        moved = y + changes.shift_span
        arm = 0.3 * plan.chord(moved / plan.semi_span)
        ahead = min(chord, 1)  # of the two webs beside the force
        couple = (split(moved, ahead + 1) - split(moved, ahead)) * changes.shift_chord / arm
        return np.asarray(nominal + split(moved, chord) - split(y, chord) + couple)

    def flight_load(self, load_factor: float, changes: Changes) -> FloatArray:
        """Return the load (r,) of a steady turn."""
        basis = self.store.basis(changes.region)
        eta = basis.lift_stations / self.design.planform.semi_span
        washed = 1.0 - changes.washout * load_factor * eta**changes.washout_exponent
        load = washed @ basis.lift + (1.0 + changes.relief) * basis.weight
        if changes.mass:
            load = load - STANDARD_GRAVITY * changes.mass * self._at(basis, changes.mass_station)[2]
        return np.asarray(load_factor * load)

    def respond(
        self,
        structure: Structure,
        changes: Changes,
        trial: TrialPlan,
        amplitude: float = 0.0,
        place_error: float = 0.0,
        split: int = 1,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (n, C) of a trial in SI units, and their rows or times.

        Parameters
        ----------
        structure : Structure
            The wing at the trial's temperature.
        changes : Changes
            What is hidden.
        trial : TrialPlan
            The trial.
        amplitude : float
            True displacement of the release point [m].
        place_error : float
            How much further outboard the release is made than it should [m].
        split : int
            Rows per sample of ring-downs, for filters.
        """
        laws = self.laws(changes)
        if trial.kind == "flight":
            loads = np.array([self.flight_load(n, changes) for n in trial.rows]).T
            return structure.static(loads, laws), trial.rows
        if trial.kind == "static":
            force = (1.0 + changes.force_gain) * trial.rows + changes.force_tare
            load = self.load(trial.place, changes, changes.region)
            return structure.static(load[:, None] * force, laws), trial.rows
        times = (1.0 + changes.clock_rate) * trial.rows + changes.clock_zero
        hold = self.load("tip", Changes(shift_span=place_error), changes.region)
        release = Release(amplitude, hold, structure.ports["tip"], times)
        if changes.is_linear and split == 1:
            return structure.free_ringdown(release), trial.rows
        outputs, _ = structure.fine_ringdown(release, laws, split)
        return outputs, np.linspace(trial.rows[0], trial.rows[-1], len(outputs))

    def equivalents(self, structure: Structure) -> dict[str, float]:
        """Motion of the first mode at the root, the tip and the span port [mass-normalised]."""
        first = structure.shapes[:, 0]
        return {name: float(abs(structure.ports[name] @ first)) for name in ("root", "tip", "span")}

    def line_motion(self, structure: Structure) -> FloatArray:
        """Motion of the first mode (S,) at the stations of the basis."""
        count = len(self.store.basis().stations)
        return np.array(
            [structure.ports[f"line{k}"] @ structure.shapes[:, 0] for k in range(count)]
        )
