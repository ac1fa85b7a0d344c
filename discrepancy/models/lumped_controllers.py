"""Controllers of a lumped model: loops that are closed in its matrices, and what they give."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import FloatArray, Hold, RecordedInput, Trial
from discrepancy.errors import ModelError
from discrepancy.models.acting import Course, Load, Shown
from discrepancy.models.lumped_file import GAINS
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
        n = self.displacements
        proportional, derivative, integral = self.gains
        into = damping if self.of_speed else stiffness
        into[:, :n] += proportional * np.outer(self.acts, self.sees[:n])
        damping[:, n:] += proportional * np.outer(self.acts, self.sees[n:])
        damping[:, :n] += derivative * np.outer(self.acts, self.sees[:n])
        if self.state is not None:
            into[self.state, :n] += self.sees[:n]
            damping[self.state, n:] += self.sees[n:]
            damping[:, self.state] -= integral * self.acts

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
        n, row, speed = self.displacements, np.zeros(len(self.acts)), np.zeros(len(self.acts))
        proportional, derivative, integral = self.gains
        (speed if self.of_speed else row)[:n] -= proportional * self.sees[:n]
        speed[:n] -= derivative * self.sees[:n]
        row[n:] -= proportional * self.sees[n:]
        if self.state is not None:
            row[self.state] += integral
        along = self.acts / float(self.acts @ self.acts)
        courses = tuple((float(push @ along), course) for push, course in loads if push @ along != 0.0)
        return Shown(row, speed=speed[:n], courses=courses)


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


def loops(
    sections: Sequence[ControllerSection], size: int, states: int, factors: Mapping[str, float]
) -> tuple[Loop, ...]:
    """Return the controllers of a model with `size` displacements and `states` states of its own."""
    width = size + states + sum(item.integral != 0.0 for item in sections)
    found, next_state = [], size + states
    for item in sections:
        whole = factors.get(item.name, 1.0)
        gains = [whole * factors.get(f"{item.name}.{gain}", 1.0) * getattr(item, gain) for gain in GAINS]
        state = next_state if item.integral else None
        next_state += item.integral != 0.0
        sees, acts = (np.pad(np.array(row), (0, width - size - states)) for row in (item.vector, item.acts))
        found.append(Loop(item, (gains[0], gains[1], gains[2]), sees, acts, size, state))
    return tuple(found)
