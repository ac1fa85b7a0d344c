"""The shape of a force over the motion in words, such as "no force up to 2 mm, then 480 N/m".

A force counts positive against the motion, as that of a spring. At a port of a state the force is a
flow over the state, which counts positive where it takes from the state.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.catalogue.force_curve import IDENTIFIERS
from discrepancy.verdict import NamedEffect
from fe.runtime.patch import TableDamping, TableStiffness
from reporting.words import listing, number

NO_FORCE = 0.12
"""Fraction of the largest force below which a force counts as none."""
LEAST_DEAD_BAND = 0.15
"""Least width of a stretch without force, as a fraction of the range of the displacement."""
STEADY_SLOPE = 0.5
"""Slope next to a stretch without force over the slope at the end of the range, from which on the
force rises like that of a spring with play."""
STRAIGHT, LEAST_STRAIGHT = 0.05, 0.4
"""Largest difference of a force from a straight line, over that at its end, where it counts as
straight; and least length of such a stretch, as a fraction of the range."""
ONE_SIDED = 0.2
"""Largest force on one side over that on the other, up to which the force acts on one side only."""
PEAK_OVER_END = 1.2
"""Friction near rest over that at the largest velocity, from which on it has a peak near rest."""
OTHER_SIDE = 0.1
"""Range of motion on one side of zero over that on the other, from which on both were seen."""
LARGEST_MISFIT_OF_POWER = 0.25
"""Share of the variance of a force about its value at rest that a power of the motion may leave. If
it leaves more, the force is told at three points instead."""
LEAST_POINTS_OF_FRICTION = 6
"""Least number of points in each direction that can show such a peak."""
CONSTANT_EXPONENT, LINEAR_EXPONENT = 0.3, 1.2
"""Exponents of the displacement below which a force is constant, and proportional."""


def curve_of(effects: Sequence[NamedEffect]) -> TableStiffness | TableDamping | None:
    """Return the table of the only effect if that is a force of free shape; else None."""
    if len(effects) != 1 or len(effects[0].patch) != 1:
        return None
    (law,) = effects[0].patch
    return law if isinstance(law, TableStiffness | TableDamping) else None


def followed_variable_text(effect: NamedEffect) -> str:
    """Return a force of free shape in words, such as "force that follows the velocity"."""
    if effect.identifier == IDENTIFIERS["state"]:
        return "flow that follows the state"
    (law,) = effect.patch
    variable = "displacement" if isinstance(law, TableStiffness) else "velocity"
    return f"force that follows the {variable}"


def curve_in_words(curve: TableStiffness | TableDamping, force_unit: str) -> str:
    """Return how a force depends on the motion, as the end of a sentence on that force.

    Parameters
    ----------
    curve : TableStiffness or TableDamping
        The force at displacements or velocities of its port.
    force_unit : str
        The unit of the force: N, N m or, where the port is not known, "N or N m"; at a port of a
        state, that of the flow, such as "degC/s times capacity".
    """
    state_unit, is_flow, _ = force_unit.partition("/s times")
    if is_flow and isinstance(curve, TableDamping):
        flows = np.array(curve.forces)
        return _at_three_points(np.array(curve.speeds), flows, force_unit, state_unit)
    motion_unit = {"N": "m", "N m": "rad"}.get(force_unit, "m or rad")
    forces = np.array(curve.forces)
    if isinstance(curve, TableDamping):
        return _friction_in_words(np.array(curve.speeds), forces, force_unit, f"{motion_unit}/s")
    points = np.array(curve.displacements)
    dead_band = _stretch_without_force(points, forces)
    line_text = ""
    if dead_band is None:
        # an error of the stiffness adds a line to a force with a stretch without force
        line = _line_of_longest_stretch(points, forces)
        if line is not None:
            dead_band = _stretch_without_force(points, forces - line.force_at(points))
            forces = forces if dead_band is None else forces - line.force_at(points)
            line_text = (
                f" (without a line of {number(line.slope)} {force_unit}/{motion_unit}, which an "
                "error of the stiffness would give)"
            )
    if dead_band is None:
        return _growth("displacement", points, forces, force_unit, motion_unit)
    low, high = dead_band
    slopes, slope_texts = [], []
    is_below, is_above = points <= low, points >= high
    # a force at one end that is small beside that at the other is none, either
    least_force = ONE_SIDED * np.abs(forces).max()
    if low > points[0] and np.abs(forces[is_below]).max() < least_force:
        low = float(points[0])
    if high < points[-1] and np.abs(forces[is_above]).max() < least_force:
        high = float(points[-1])
    if low > points[0]:
        slope, low = _line_to_zero(points, forces, is_below)
        slopes.append(slope)
        slope_texts.append(f"{number(slope)} {force_unit}/{motion_unit} below")
    if high < points[-1]:
        slope, high = _line_to_zero(points, forces, is_above)
        slopes.append(slope)
        slope_texts.append(f"{number(slope)} {force_unit}/{motion_unit} above")
    if low >= high:  # the forces beyond the stretch are no lines that begin at its ends
        return _growth("displacement", points, forces, force_unit, motion_unit)
    begin, end = _position_text(low, motion_unit), _position_text(high, motion_unit)
    likeness = ""
    if min(slopes) > 0.0:
        likeness = ", as at a stop" if len(slopes) == 1 else ", as at two stops"
    slope_text = listing(slope_texts)
    return f"it is zero from {begin} to {end}, with a slope of {slope_text}{likeness}{line_text}"


class _Line(NamedTuple):
    """A straight line: a force with its slope."""

    slope: float
    at_zero: float

    def force_at(self, displacements: FloatArray) -> FloatArray:
        """Return the force (N,) of the line at displacements (N,)."""
        return self.at_zero + self.slope * displacements


def _line_of_longest_stretch(displacements: FloatArray, forces: FloatArray) -> _Line | None:
    """Return the line that a force follows on the longest stretch of displacements.

    A force follows a line if it differs by at most `STRAIGHT` of the largest difference anywhere.
    None if the longest such stretch is shorter than `LEAST_STRAIGHT` of the range.
    """
    count = len(displacements)
    for length in range(count - 1, int(LEAST_STRAIGHT * count), -1):
        for first in range(count - length + 1):
            stretch = slice(first, first + length)
            slope, at_zero = np.polyfit(displacements[stretch], forces[stretch], 1)
            line = _Line(float(slope), float(at_zero))
            difference = np.abs(forces - line.force_at(displacements))
            if difference[stretch].max() <= STRAIGHT * difference.max():
                return line
    return None


def _at_three_points(
    motion: FloatArray, forces: FloatArray, force_unit: str, motion_unit: str
) -> str:
    """Return the force at the first, the middle and the last point of its curve."""
    indices = (0, len(motion) // 2, len(motion) - 1)
    texts = [
        f"{number(forces[index])} at {number(motion[index])} {motion_unit}" for index in indices
    ]
    return f"it is {listing(texts)} (in {force_unit})"


def _position_text(position: float, unit: str) -> str:
    """Return a position with its unit; metres are converted to millimetres."""
    return f"{number(round(1e3 * position, 3))} mm" if unit == "m" else f"{number(position)} {unit}"


def _friction_in_words(
    velocities: FloatArray, forces: FloatArray, force_unit: str, velocity_unit: str
) -> str:
    """Return how a force depends on the velocity: as friction with a peak near rest, or a power."""
    resistances = []
    for direction in (-1.0, 1.0):
        is_in_direction = direction * velocities > 0.0
        ascending = np.argsort(np.abs(velocities[is_in_direction]))
        resistances.append(direction * forces[is_in_direction][ascending])
    count = min(len(resistance) for resistance in resistances)
    if count < LEAST_POINTS_OF_FRICTION:
        return _growth("velocity", velocities, forces, force_unit, velocity_unit)
    # The mean of both directions, from the slowest points to the fastest. The k-th slowest points
    # of both are taken as a pair: their speeds are nearly equal if both ranges of velocity are.
    mean_resistance = 0.5 * (resistances[0][:count] + resistances[1][:count])
    speeds = np.sort(np.abs(velocities[velocities > 0.0]))[:count]
    peak = int(np.argmax(mean_resistance))
    if mean_resistance[peak] > PEAK_OVER_END * abs(mean_resistance[-1]) and peak < count // 2:
        return (
            f"it is largest near rest, and falls to {number(float(mean_resistance[-1]))} "
            f"{force_unit} at {number(float(speeds[-1]))} {velocity_unit}"
        )
    return _growth("velocity", velocities, forces, force_unit, velocity_unit)


def _line_to_zero(
    displacements: FloatArray, forces: FloatArray, is_beyond: BoolArray
) -> tuple[float, float]:
    """Fit a line to a force beyond a stretch without force; return its slope and its zero."""
    slope, at_zero = np.polyfit(displacements[is_beyond], forces[is_beyond], 1)
    return float(slope), float(-at_zero / slope)


def _stretch_without_force(
    displacements: FloatArray, forces: FloatArray
) -> tuple[float, float] | None:
    """Return the ends of the longest stretch without force; None if it is no play.

    It is play if it covers at least `LEAST_DEAD_BAND` of the range, and if the force next to it
    rises at least half as steeply as at the end of the range. The force of a cubic spring is also
    small in the middle, but rises slowly there.
    """
    is_zero = np.abs(forces) <= NO_FORCE * np.abs(forces).max()
    # the longest stretch of zeros
    edges = np.flatnonzero(np.diff(np.r_[False, is_zero, False].astype(int)))
    stretches = [(first, end - 1) for first, end in zip(edges[::2], edges[1::2], strict=True)]
    if not stretches:
        return None
    first, last = max(stretches, key=lambda stretch: stretch[1] - stretch[0])
    low, high = float(displacements[first]), float(displacements[last])
    if high - low < LEAST_DEAD_BAND * np.ptp(displacements):
        return None
    slopes = np.abs(np.gradient(forces, displacements))
    for beyond in (slopes[: first + 1][::-1], slopes[last:]):
        count = len(beyond) // 3
        if len(beyond) > 1 and not count:
            return None
        if count and beyond[:count].mean() < STEADY_SLOPE * beyond[-count:].mean():
            return None
    return low, high


def _growth(
    variable: str, motion: FloatArray, forces: FloatArray, force_unit: str, motion_unit: str
) -> str:
    """Return in words how a force grows with the motion, how far, and whether on one side only.

    `variable` says whether the motion is a displacement or a velocity. A force that is no power of
    the motion is told at three points.
    """
    changes = forces - float(np.interp(0.0, motion, forces))
    largest_by_side = {}
    for side in (1.0, -1.0):
        is_on_side = side * motion > 0.0
        largest_by_side[side] = float(np.max(np.abs(changes[is_on_side]), initial=0.0))
    stronger = max(largest_by_side, key=lambda side: largest_by_side[side])
    # a body that only falls shows nothing of the other side
    range_of_other_side = float(np.max(-stronger * motion))
    saw_other_side = range_of_other_side > OTHER_SIDE * float(np.max(stronger * motion))
    is_weak_there = largest_by_side[-stronger] < ONE_SIDED * largest_by_side[stronger]
    is_one_sided = saw_other_side and is_weak_there
    # the exponent of the force on the stronger side is a slope in logarithms
    on_side = (stronger * motion > 0.0) & (np.abs(changes) > 0.0)
    log_force = np.log(np.abs(changes[on_side]))
    log_motion = np.log(np.abs(motion[on_side]))
    weights = np.sqrt(np.abs(changes[on_side]))  # small forces tell little of the exponent
    exponent, log_factor = np.polyfit(log_motion, log_force, 1, w=weights).tolist()
    changes_on_side = changes[on_side]
    power_on_side = np.exp(log_factor + exponent * log_motion)
    misfit = changes_on_side - np.sign(changes_on_side.sum()) * power_on_side
    if misfit @ misfit > LARGEST_MISFIT_OF_POWER * (changes_on_side @ changes_on_side):
        return _at_three_points(motion, forces, force_unit, motion_unit)
    largest = int(np.argmax(np.where(on_side, np.abs(changes), 0.0)))
    acts_against = changes[largest] * motion[largest] > 0.0
    largest_force = f"{number(float(np.abs(changes[largest])))} {force_unit}"
    end = _position_text(float(motion[largest]), motion_unit)
    if exponent < CONSTANT_EXPONENT:
        growth = f"it is nearly constant, at most {largest_force}"
    elif exponent < LINEAR_EXPONENT:
        slope = float(np.dot(changes, motion) / np.dot(motion, motion))
        slope_unit = f"{force_unit}/{f'({motion_unit})' if '/' in motion_unit else motion_unit}"
        growth = f"it is proportional to the {variable}, {number(slope)} {slope_unit}"
    else:
        verb = "stiffens" if acts_against else "softens"
        begin = f"it {verb}" if variable == "displacement" else "it grows"
        power = f"about as the power {exponent:.2g} of the {variable}"
        growth = f"{begin} by {largest_force} at {end}, {power}"
        if variable == "velocity":
            growth = f"{begin} to {largest_force} at {end}, {power}"
    side_text = "positive" if stronger > 0.0 else "negative"
    plural = "displacements" if variable == "displacement" else "velocities"
    where = f", at {side_text} {plural} only" if is_one_sided else ""
    return f"{growth}{where}"
