"""Controllers of a lumped model: loops that are closed in its matrices, and what they give."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import FloatArray, Hold, RecordedInput, Trial
from discrepancy.errors import ModelError
from discrepancy.models.acting import Course, Load, Shown
from discrepancy.models.lumped_file import GAINS, LumpedDescription
from discrepancy.models.lumped_sections import ControllerSection


@dataclass(frozen=True)
class Loop:
    """A controller in a rig of N unknowns, n of them displacements.

    Attributes
    ----------
    section : ControllerSection
        As in the file.
    gains : tuple of float
        Proportional, derivative and integral, times their factors.
    sees, acts : (N,) ndarray
        What it measures, and along which it acts.
    displacements : int
        n.
    state : int or None
        Unknown that is the integral of its error; None without an integral gain.
    """

    section: ControllerSection
    gains: tuple[float, float, float]
    sees: FloatArray
    acts: FloatArray
    displacements: int
    state: int | None

    @property
    def of_speed(self) -> bool:
        """Whether it measures the speed of a displacement."""
        moving = self.section.quantity.moving
        return bool(moving) and self.section.quantity is moving[1]

    def close(self, damping: FloatArray, stiffness: FloatArray) -> None:
        """Add the feedback to the matrices (N, N) of a rig."""
        n, (row, speed) = self.displacements, self._gives
        stiffness[:, :n] -= np.outer(self.acts, row[:n])
        damping[:, n:] -= np.outer(self.acts, row[n:])
        damping[:, :n] -= np.outer(self.acts, speed)
        if self.state is not None:
            (damping if self.of_speed else stiffness)[self.state, :n] += self.sees[:n]
            damping[self.state, n:] += self.sees[n:]

    def loads(self, trial: Trial, item: RecordedInput, offset: float) -> list[Load]:
        """Return what a recorded reference does, as loads.

        Raises
        ------
        ModelError
            If it is of another quantity, or its steps would have to be differentiated.
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
        row, speed = self._gives
        along = self.acts / float(self.acts @ self.acts)
        courses = tuple((float(push @ along), course) for push, course in loads if push @ along != 0.0)
        return Shown(row, speed=speed, courses=courses)

    @property
    def _gives(self) -> tuple[FloatArray, FloatArray]:
        """Rows (N,) of the unknowns and (n,) of the speeds that it gives without a reference."""
        n, (proportional, derivative, integral) = self.displacements, self.gains
        row, speed = -proportional * self.sees, -derivative * self.sees[:n]
        if self.of_speed:
            speed, row[:n] = speed + row[:n], 0.0
        if self.state is not None:
            row[self.state] += integral
        return row, speed


def _slope(course: Course, trial: Trial, section: ControllerSection) -> Course:
    """Return the derivative of a reference."""
    if course.hold is Hold.ZERO_ORDER:
        raise ModelError(
            f"The reference {section.reference!r} of the trial {trial.name!r} goes in steps, which "
            f"the controller {section.name!r} cannot differentiate: say derivative_of = 'measurement' in the "
            "model, or hold = 'linear' in the campaign."
        )
    if course.hold is Hold.SMOOTH:
        return Course(course.time, CubicSpline(course.time, course.values)(course.time, 1), Hold.SMOOTH)
    slopes = np.diff(course.values) / np.diff(course.time)
    return Course(course.time, np.append(slopes, slopes[-1]), Hold.ZERO_ORDER)


def loops(description: LumpedDescription, factors: Mapping[str, float]) -> tuple[Loop, ...]:
    """Return the controllers of a model; the integrals of their errors are its last unknowns."""
    found, next_state = [], description.size + description.states
    for item in description.controller:
        whole = factors.get(item.name, 1.0)
        gains = [whole * factors.get(f"{item.name}.{gain}", 1.0) * getattr(item, gain) for gain in GAINS]
        state = next_state if item.integral else None
        next_state += item.integral != 0.0
        sees, acts = description.padded(item.vector), description.padded(item.acts)
        found.append(Loop(item, (gains[0], gains[1], gains[2]), sees, acts, description.size, state))
    return tuple(found)
