"""Motion of a linear system with internal forces at its ports: after a release, or under what acts.

A model makes a `LinearSystem` of its parameters and the structural part of a patch, keeps it, and asks for a
`Motion`, which says what outputs show. Between the stamps the linear part is exact (`fe.runtime.motion`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray, Hold, Start
from discrepancy.errors import ModelError
from discrepancy.system.excitation import SMOOTH_PARTS, Acting, Shown, by_order, straight
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.response import Response
from fe.compilation import compiled_kernel
from fe.runtime.arrays import FADING, LAGGED
from fe.runtime.motion import Begin, Boundaries, Laws, advance, steps_under, substeps
from fe.runtime.motion_arrays import ModalMotion, Steps

LEAST_PARTICIPATION = 0.03
"""A mode that moves the release point less than this share of the most moving one is scaled by the share."""
LEAST_LEAD = 1e-9
"""A first sample that is later than the begin by less than this share of an interval is at the begin."""
LEAST_SPEED = 1e-2
"""Share of the largest speed of a drive below which its spline does not tell its first one from rest."""


@dataclass(frozen=True)
class Motion:
    """Motion at the samples of a trial.

    Attributes
    ----------
    system : LinearSystem
        What moved.
    acting : Acting
        What acted.
    laws : Laws
        Internal forces.
    time : (N,) ndarray
        Times of the motion since the release or the begin of the record [s].
    q, velocity : (N, M + P) ndarray
        Modal coordinates, those of the drives too, and their rates (mass-normalised).
    port_forces : (N, J) ndarray
        Internal forces.
    lagged : (N, J) ndarray
        Internal forces as omitted modes follow them.
    held : int
        First samples that lie before the release, where the shape is held.
    holding : (n,) ndarray, optional
        Force that held the release point until then [N].
    """

    system: LinearSystem
    acting: Acting
    laws: Laws
    time: FloatArray
    q: FloatArray
    velocity: FloatArray
    port_forces: FloatArray
    lagged: FloatArray
    held: int = 0
    holding: FloatArray | None = None

    @cached_property
    def acceleration(self) -> FloatArray:
        """Second derivatives (N, M + P) of the modal coordinates, from the equation of motion."""
        system, modal = self.system, self.system.modal
        pull = self.q @ modal.whole.T
        if self.laws.rate != 0.0:
            pull *= 1.0 + self.laws.rate * (self.time[:, None] - self.laws.since)
        found = system.forces(self.acting, self.time) - pull - self.velocity @ modal.damping.T
        if len(self.laws):
            found -= self.port_forces @ self.laws.rows(modal.actions, self.q.shape[1])
        found[: self.held] = 0.0
        return found

    def at(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return positions and speeds (N, P) of rows (P, n); those of a state are its integral and itself."""
        shapes = (rows @ self.system.all_shapes).T
        still = self._left_out(rows) if self.system.truncated else 0.0
        return self.q @ shapes + still, self.velocity @ shapes

    def _left_out(self, rows: FloatArray) -> FloatArray:
        """Return what omitted modes add to row . u (N, C).

        They follow applied forces without delay, and internal ones and the end of a holding force with that
        of their damping.
        """
        system = self.system
        residual, found = system.residual(rows.T), np.zeros((len(self.time), len(rows)))
        if self.acting.loads:
            found += self.acting.load_at(self.time, residual)
        if len(self.laws):
            found -= self.lagged @ (system.port_rows(self.laws) @ residual)
        if self.holding is not None and system.relaxation > 0.0:
            lag = system.relaxation
            count = int(np.searchsorted(self.time, 40.0 * lag, side="right"))
            fading = np.exp(-np.maximum(self.time[:count], 0.0) / lag)
            found[:count] += np.outer(fading, self.holding @ residual)
        return found

    def seen(self, shown: Sequence[Shown]) -> Response:
        """Return what outputs show, and the rates; omitted modes are in what is not derived only."""
        system, moved = self.system, [self.q, self.velocity]
        values, rates = np.zeros((2, len(self.time), len(shown)))
        orders = by_order(shown, system.all_shapes)
        asked = np.any(orders, axis=(1, 2))
        if asked[1:].any():
            moved.append(self.acceleration)
        if asked[2:].any():
            moved.append(np.gradient(self.acceleration, self.time, axis=0))
        for order in np.flatnonzero(asked):
            values += moved[order] @ orders[order].T
            if order < 3:
                rates += moved[order + 1] @ orders[order].T
        if system.truncated:
            values += self._left_out(np.array([item.rows[0] for item in shown]))
        for number, item in enumerate(shown):
            values[:, number] += item.constant
            for factor, load in item.courses or ():
                values[:, number] += factor * load.course.at(self.time, load.order)
            if item.felt is not None:
                acts = self.laws.rows(system.acts, len(item.felt))
                values[:, number] += self.port_forces @ (acts @ item.felt)
            if item.courses or item.felt is not None:
                rates[:, number] = np.gradient(values[:, number], self.time)
        return Response(values, rates)


def motion_of(system: LinearSystem, acting: Acting, laws: Laws, refinement: int = 1) -> Motion:
    """Return the motion of a trial; a record that the clock makes begin late is followed from its begin.

    Before a release from rest the shape is held. A release that is not from rest is continued backwards
    without internal forces where its clock asks for times before zero.

    Parameters
    ----------
    system : LinearSystem
        What moves.
    acting : Acting
        What acts.
    laws : Laws
        Internal forces.
    refinement : int
        Steps are this many times smaller.

    Raises
    ------
    ModelError
        If it begins at rest where there is none, or the release point cannot be moved.
    """
    times, laws = acting.sampled, replace(laws, since=float(acting.time[0]))
    if acting.release is None:
        first, begin = float(acting.time[0]), _first(system, acting, laws)
        found = _followed(system, acting, laws, first, times, begin, refinement)
        if acting.begins is not Start.UNKNOWN and times[0] <= first and len(laws) and len(system.drives):
            # Laws of speed at ports that only drives move are nothing where they begin at rest: the force by
            # which a drive would be held there, were it a mass, is none that a reading shows.
            rows = laws.rows(system.modal.ports, len(begin.v))
            driven = ~np.any(rows[:, : len(system.angular_frequency)], axis=1)
            found.port_forces[0, driven & (rows @ begin.v == 0.0) & (laws.of_speed == 1)] = 0.0
        return Motion(system, acting, laws, times, *found[:4])
    begin, holding = _released(system, acting, laws)
    q, v, _ = begin
    held = int(np.searchsorted(times, 0.0)) if acting.release[1].at_rest else 0
    stamps = times[held:] if held < len(times) - 1 else np.append(times[held:], abs(times[-1]) + 1.0)
    if stamps[0] < 0.0:
        back = system.modal.exact_steps(stamps[:1])[0][0]
        begin = Begin(*np.split(back @ np.concatenate((q, v)), 2))
    parts = list(_followed(system, acting, laws, 0.0, stamps, begin, refinement)[:4])
    if held:
        felt = np.zeros(len(laws)) if begin.memory is None else begin.memory[:, LAGGED]
        still = (np.tile(part, (held, 1)) for part in (q, v, felt, felt))
        parts = [np.vstack(both)[: len(times)] for both in zip(still, parts, strict=True)]
    q, v, forces, lagged = parts
    return Motion(system, acting, laws, times, q, v, forces, lagged, held, holding)


# ---------------------------------------------------------------- begin


def _first(system: LinearSystem, acting: Acting, laws: Laws) -> Begin:
    """Return the state at the first stamp."""
    count, moving, first = len(system.angular_frequency), system.moving, acting.time[:1]
    drives = list(acting.drives.values())
    drive, speeds = np.array([[float(item.at(first, order)[0]) for item in drives] for order in (0, 1)])
    (q, v), memory = np.zeros((2, count + len(drives))), None
    if acting.begins is Start.UNKNOWN:
        given = np.zeros(count + moving)  # displacement and speed of each mode, and the states
        given[: len(acting.initial)] = acting.initial[: len(given)]
        q[:moving], v[:count] = given[:moving], given[moving:]
    else:
        paces = [np.max(np.abs(item.at(acting.time, 1))) for item in drives]
        speeds[np.abs(speeds) < LEAST_SPEED * np.array(paces)] = 0.0  # dry friction is zero at rest
    if acting.begins is Start.SETTLED:
        load, held = acting.load_at(first, np.eye(len(system.mass))), system.lift @ drive
        if load.any() or drive.any():
            moved = load - system.stiffness @ held
            values, memory = system.static(moved, laws, held=held, time=float(first[0]))
            amounts = system.shapes.T @ (system.mass @ (values[0] - held))
            q[:moving], v[moving:count] = amounts[:moving], amounts[moving:]
    if drives:
        q[count:], v[count:] = system.heaviness * drive, system.heaviness * speeds
    return Begin(q, v, memory)


def _released(system: LinearSystem, acting: Acting, laws: Laws) -> tuple[Begin, FloatArray | None]:
    """Return the state at the release, and the force (n,) that held it until then."""
    assert acting.release is not None
    (row, release), w = acting.release, system.angular_frequency
    shape = np.asarray(row @ system.shapes)
    largest = float(np.max(np.abs(shape)))
    if largest == 0.0:
        raise ModelError("The release point of a ring-down does not move in any mode of the model.")
    least = LEAST_PARTICIPATION * largest
    safe = np.where(np.abs(shape) >= least, shape, np.where(shape < 0.0, -least, least))
    given = np.zeros((len(w), 2))
    given[: len(acting.initial)] = acting.initial[: len(w)]
    unit, size = release.displacement / safe, release.displacement
    load = acting.load_at(acting.time[:1], np.eye(len(system.mass)))
    if not release.at_rest:
        rest = (load @ system.shapes)[0] / w**2 if load.any() else 0.0
        return Begin(given[:, 0] * unit + rest, given[:, 1] * unit * w), None
    answer, deviation = system.flexibility(row), given[:, 0] * unit
    deviation[0], compliance = 0.0, float(row @ answer)
    holding = size * (1.0 + given[0, 0]) / compliance
    memory, acts = system.static(holding * row + load, laws, fixed=row, time=0.0)[1], holding * row + load[0]
    if memory is not None:
        rows = system.port_rows(laws, 0.0)
        holding += float(rows @ answer @ memory[:, LAGGED]) / compliance
        acts = holding * row + load[0] - memory[:, LAGGED] @ rows
        if system.truncated:  # of the port's position, fades after the release
            memory[:, FADING] = holding * (rows @ system.residual(row))
    return Begin(acts @ system.shapes / w**2 + deviation, np.zeros(len(w)), memory), holding * row


# ---------------------------------------------------------------- steps


def _followed(
    system: LinearSystem, acting: Acting, laws: Laws, first: float, stamps: FloatArray, begin: Begin,
    refinement: int,
) -> ModalMotion:  # fmt: skip
    """Return the motion at stamps from a state at a time that may lie before them [s]."""
    late = stamps[0] - first > LEAST_LEAD * (stamps[-1] - stamps[0]) / max(len(stamps) - 1, 1)
    times, modal, smooth = np.append(first, stamps) if late else stamps, system.modal, bool(acting.drives)
    pushed = acting.loads or acting.drives or not laws.linear
    free = None if pushed else modal.free(begin.q, begin.v, stamps - (first if late else stamps[0]))
    if free is not None:
        none = np.zeros((len(stamps), 0))
        return ModalMotion(*free, none, none, laws.memory())
    smooth |= any(load.course.hold is Hold.SMOOTH for load in acting.loads)
    edges, least = (*laws.edges, *acting.edges), SMOOTH_PARTS if smooth else 1
    boundaries = substeps(modal, laws, times, refinement, least, edges)
    feed = np.zeros((len(boundaries.time), len(laws)))
    if system.truncated and len(laws) and acting.loads:
        feed = acting.load_at(boundaries.time, system.residual(system.port_rows(laws).T))
    found = advance(modal, laws, _steps(system, acting, boundaries, feed), begin, compiled_kernel())
    q, v, forces, lagged, memory = found
    since = slice(int(late), None)
    return ModalMotion(q[since], v[since], forces[since], lagged[since], memory)


def _steps(system: LinearSystem, acting: Acting, boundaries: Boundaries, feed: FloatArray) -> Steps:
    """Return the steps of all coordinates; the drives follow from nothing but what is prescribed."""
    time, first, drives = boundaries.time, len(system.angular_frequency), list(acting.drives.values())
    begin, end = straight(lambda moments: system.forces(acting, moments), time)
    steps = steps_under(system.modal, boundaries, begin, end, feed)
    if drives:
        steps = steps._replace(transition=steps.transition.copy())
    for number, drive in enumerate(drives, first):
        for order, coordinate in enumerate((number, begin.shape[1] + number)):
            steps.transition[:, coordinate] = 0.0
            steps.push[:, coordinate] = system.heaviness * drive.at(time[1:], order)
    return steps
