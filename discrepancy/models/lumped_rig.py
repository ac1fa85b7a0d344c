"""A lumped model at values of its parameters: matrices, controllers, and the systems that they make."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from discrepancy.campaign.records import FloatArray, Hold, RecordedInput, Trial
from discrepancy.errors import ModelError
from discrepancy.models.acting import Course, Load, Shown, order_of
from discrepancy.models.lumped_file import GAINS, KINDS, LumpedDescription
from discrepancy.models.lumped_sections import ControllerSection
from discrepancy.models.memory import Memory
from discrepancy.models.second_order import SecondOrderSystem
from fe.runtime.patch import PointMass, Primitive, RootCompliance

MOST_MODES = 8
"""Modes that move of a structure on springs; the others follow without inertia."""


@dataclass(frozen=True)
class Loop:
    """A controller in a rig of N unknowns, n of them displacements.

    Attributes
    ----------
    section : ControllerSection
        As in the file.
    gains : sequence of float
        Proportional, derivative and integral, times their factors.
    sees : (4, N) ndarray
        What it measures, as `Shown.rows`.
    acts : (N,) ndarray
        Along which it acts.
    state : int or None
        Unknown that is the integral of its error; None without an integral gain.
    """

    section: ControllerSection
    gains: Sequence[float]
    sees: FloatArray
    acts: FloatArray
    state: int | None

    @property
    def gives(self) -> FloatArray:
        """What it gives without a reference, as `Shown.rows`."""
        proportional, derivative, integral = self.gains
        rows = -proportional * self.sees - derivative * np.roll(self.sees, 1, axis=0)
        if self.state is not None:
            rows[1, self.state] += integral
        return np.asarray(rows)

    def close(self, stiffness: FloatArray, damping: FloatArray) -> None:
        """Add the feedback to the matrices (N, N) of a rig."""
        for matrix, row, seen in zip((stiffness, damping), self.gives[:2], self.sees[:2], strict=True):
            matrix -= np.outer(self.acts, row)
            if self.state is not None:
                matrix[self.state] += seen

    def loads(self, trial: Trial, item: RecordedInput, offset: float) -> list[Load]:
        """Return what a recorded reference does, as loads.

        Raises
        ------
        ModelError
            If the reference is of another quantity, or goes in steps and is to be differentiated.
        """
        section = self.section
        if item.quantity is not section.quantity:
            raise ModelError(
                f"The controller {section.name!r} follows {section.quantity.value}, but the trial "
                f"{trial.name!r} records its reference {item.name!r} as {item.quantity.value}."
            )
        course = Course.of(trial.time, item.values + offset, item.hold)
        found: list[Load] = [(self.gains[0] * self.acts, course)]
        if self.gains[1] != 0.0 and section.derivative_of == "error":
            found.append((self.gains[1] * self.acts, _slope(course, trial, section)))
        if self.state is not None:
            found.append((np.eye(len(self.acts))[self.state], course))
        return found

    def effort(self, loads: Sequence[Load]) -> Shown:
        """Return what it gives, from the `loads` of its reference (none where there is no reference)."""
        along = self.acts / float(self.acts @ self.acts)
        courses = tuple((float(push @ along), course) for push, course in loads if push @ along != 0.0)
        return Shown(self.gives, courses=courses)


def _slope(course: Course, trial: Trial, section: ControllerSection) -> Course:
    """Return the derivative of a reference."""
    if course.hold is Hold.ZERO_ORDER:
        raise ModelError(
            f"The reference {section.reference!r} of the trial {trial.name!r} goes in steps, which "
            f"the controller {section.name!r} cannot differentiate: say derivative_of = 'measurement' in the "
            "model, or hold = 'linear' in the campaign."
        )
    if course.hold is Hold.SMOOTH:
        return Course(course.time, course.at(course.time, 1), Hold.SMOOTH)
    slopes = np.diff(course.values) / np.diff(course.time)
    return Course(course.time, np.append(slopes, slopes[-1]), Hold.ZERO_ORDER)


class LumpedRig:
    """A lumped model's description with the factors of its parameters.

    Parameters
    ----------
    description : LumpedDescription
        Content of the file.
    factors : mapping of str to float
        Of terms, by name.
    structure : sequence of Primitive
        What a patch changes of the structure.
    softening : float
        Share of the stiffness that the temperature takes.
    """

    def __init__(
        self,
        description: LumpedDescription,
        factors: Mapping[str, float],
        structure: Sequence[Primitive] = (),
        softening: float = 0.0,
    ) -> None:
        self.description, self.factors, self._systems = description, factors, Memory()
        softened = {**factors, "stiffness": factors.get("stiffness", 1.0) * (1.0 - softening)}
        self._terms = {kind: description.whole(kind, softened) for kind in KINDS} | {
            part.name: factors.get(part.name, 1.0) * description.placed(part.matrix, kind)
            for kind in KINDS
            for part in description.parts(kind)
        }
        if n := description.size:
            mass, stiffness, damping = (self._terms[kind][:n, :n] for kind in KINDS[:3])
            for change in structure:
                self._change(change, mass, stiffness)
            damping += factors.get("damping", 1.0) * self._damping(mass, stiffness)
        self.constant = sum(
            (self.along(item.vector, item.through, item.name) for item in description.load),
            np.zeros(description.width),
        )
        self.loops, state = dict[str, Loop](), n + description.states
        for item in description.controller:
            named = (factors.get(f"{item.name}.{gain}", 1.0) * getattr(item, gain) for gain in GAINS)
            gains = [factors.get(item.name, 1.0) * gain for gain in named]
            row, acts = description.padded(item.vector), description.padded(item.acts)
            sees = Shown.of(row, order_of(item.quantity), states=description.width - n).rows
            self.loops[item.name] = Loop(item, gains, sees, acts, state if item.integral else None)
            state += item.integral != 0.0

    def _change(self, change: Primitive, mass: FloatArray, stiffness: FloatArray) -> None:
        """Put a point mass or a compliance of the root into the matrices."""
        root = self.description.root
        if isinstance(change, PointMass):
            places = sorted(self.description.place, key=lambda place: place.station)
            stations = [place.station for place in places]
            columns = zip(*(place.vector for place in places), strict=True)
            row = np.array([np.interp(change.station, stations, column) for column in columns])
            mass += change.mass * np.outer(row, row)
        elif isinstance(change, RootCompliance) and root is not None:
            # in series: K^-1 + c l l^T, by Sherman and Morrison
            pull = stiffness @ np.array(root.lever)
            stiff = float(pull @ np.array(root.lever))
            stiffness -= np.outer(pull, pull) * change.compliance / (1.0 + change.compliance * stiff)

    def _damping(self, mass: FloatArray, stiffness: FloatArray) -> FloatArray:
        """Return what ratios of modes or Rayleigh coefficients add to the damping."""
        given = self.description.damping
        if given is None or given.ratios is None:
            alpha, beta = (0.0, 0.0) if given is None else (given.alpha or 0.0, given.beta or 0.0)
            return alpha * mass + beta * stiffness
        square, shapes = eigh(stiffness, mass)
        weighted, w = mass @ shapes, np.sqrt(np.maximum(square, 0.0))
        return np.asarray((weighted * (2.0 * np.array(given.ratios) * w)) @ weighted.T)

    def along(self, vector: Sequence[float] | FloatArray, through: str | None, name: str) -> FloatArray:
        """Return the vector (N,) of a load, through a matrix where it says so, times its own factor."""
        row = self.description.padded(vector)
        return np.asarray(
            self.factors.get(name, 1.0) * (row if through is None else self._terms[through] @ row)
        )

    def system(self, drives: tuple[str, ...] = (), *, closed: bool = True) -> SecondOrderSystem:
        """Return the system with the motions of some inputs prescribed, with its controllers or without."""
        return self._systems.get((drives, closed), lambda: self._made(drives, closed=closed))

    def _made(self, drives: tuple[str, ...], *, closed: bool) -> SecondOrderSystem:
        description, terms, padded = self.description, self._terms, self.description.padded
        n = description.size
        own, rest = description.unknowns("capacity"), slice(n + description.states, None)
        mass, damping = terms["mass"] + terms["capacity"], terms["damping"] + terms["conductance"]
        stiffness = terms["stiffness"].copy()
        mass[rest, rest] = np.eye(len(mass[rest]))
        coupling = description.coupling
        for content, into, rows, columns in (
            (coupling.force_of_states, damping, slice(n), own),
            (coupling.flow_of_speeds, damping, own, slice(n)),
            (coupling.flow_of_displacements, stiffness, own, slice(n)),
        ):
            if content is not None:
                into[rows, columns] = -np.array(content)
        for loop in self.loops.values() if closed else ():
            loop.close(stiffness, damping)
        beta = description.damping.beta if description.damping is not None else None
        inputs = {item.name: padded(item.vector) for item in description.input}
        return SecondOrderSystem(
            mass, damping, stiffness,
            {item.name: padded(item.vector) for item in description.port},
            mode_count=MOST_MODES if description.is_plain else None,
            relaxation=self.factors.get("damping", 1.0) * (beta or 0.0),
            states=len(mass) - n,
            drives=np.array([inputs[name] for name in drives]),
            actions={item.name: padded(item.acts) for item in description.port if item.acts is not None},
        )  # fmt: skip
