"""Motion of a linear system with internal forces at its ports: after a release, or under what acts.

A model makes a `SecondOrderSystem` from its parameters and the structural part of a patch, keeps it, and asks
it for a `Motion`, which says what outputs show. Between the stamps the linear part is exact
(`fe.runtime.stepwise`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray, Hold, Release, Start
from discrepancy.errors import ModelError
from discrepancy.models.acting import SMOOTH_PARTS, Acting, Shown
from discrepancy.models.compiled_motion import compiled_kernel
from discrepancy.models.interface import Response
from discrepancy.models.linear_system import LinearSystem
from discrepancy.models.scales import PortScale
from fe.runtime.motion import NO_LAWS, Laws, static_solution
from fe.runtime.motion_arrays import Steps
from fe.runtime.stepwise import Begin, Boundaries, ModalMotion, advance, steps_under, substeps


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
            pull *= 1.0 + self.laws.rate * self.time[:, None]
        found = self.acting.load_at(self.time, system.all_shapes) - pull - self.velocity @ modal.damping.T
        if len(self.laws):
            found -= self.port_forces @ self.laws.rows(modal.actions or modal.ports, self.q.shape[1])
        for number, drive in enumerate(self.acting.drives.values()):
            moved = [drive.at(self.time, order) for order in range(3)]
            for amount, part in zip(moved, system.driven(number), strict=True):
                found -= np.outer(amount, part)
            found[:, len(system.angular_frequency) + number] = system.heaviness * moved[2]
        found[: self.held] = 0.0
        return found

    @property
    def at_ports(self) -> tuple[FloatArray, FloatArray]:
        """Positions and speeds (N, P) of the ports; that of a state is its integral."""
        rows = np.array(list(self.system.ports.values())).reshape(-1, len(self.system.mass))
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
        system = self.system
        values, rates = np.zeros((2, len(self.time), len(shown)))
        by_order = system.by_order(shown, system.all_shapes)
        moved, asked = [self.q, self.velocity], np.any(by_order, axis=(1, 2))
        if asked[1:].any():
            moved.append(self.acceleration)
        if asked[2:].any():
            still = len(self.time) < 2
            moved.append(0.0 * self.q if still else np.gradient(self.acceleration, self.time, axis=0))
        for order in np.flatnonzero(asked):
            values += moved[order] @ by_order[order].T
            if order < 3:
                rates += moved[order + 1] @ by_order[order].T
        if system.truncated:
            values += self._left_out(np.array([item.rows[0] for item in shown]))
        for number, item in enumerate(shown):
            if item.constant:
                values[:, number] += item.constant
            if item.reaction is not None:
                along = system.lift[:, item.reaction]
                values[:, number] -= self.acting.load_at(self.time, along[:, None])[:, 0]
                if len(self.laws):
                    acts = self.laws.rows({**system.ports, **system.actions}, len(along))
                    values[:, number] += self.port_forces @ (acts @ along)
            for factor, course in item.courses or ():
                values[:, number] += factor * course.at(self.time)
            if item.reaction is not None or item.courses:
                rates[:, number] = np.gradient(values[:, number], self.time)
        return Response(values, rates)


LEAST_PARTICIPATION = 0.03
"""A mode that moves the release point less than this share of the most moving one is scaled by the share."""
INSTANT = 1e-6
"""Duration of the step after a record that has one sample [s]."""
LEAST_LEAD = 1e-9
"""A first sample that is later than the begin by less than this share of the record is at the begin."""


class SecondOrderSystem(LinearSystem):
    """A linear system that moves."""

    def motion(self, acting: Acting, laws: Laws, refinement: int = 1) -> Motion:
        """Return the motion of a trial; a record that the clock makes begin late is followed from its begin.

        Before a release from rest the shape is held. A release that is not from rest is continued backwards
        without internal forces where its clock asks for times before zero.

        Parameters
        ----------
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
        if acting.release is not None:
            return self._let_go(acting, laws, refinement)
        times, first = acting.sampled, float(acting.time[0])
        begin = self._first(acting, laws)
        found = self._followed(acting, laws, first, times, begin, refinement)
        if acting.begins is not Start.UNKNOWN and times[0] <= first and len(laws) and len(self.drives):
            # Laws of speed at ports that only drives move are nothing where they begin at rest: the force by
            # which a drive would be held there, were it a mass, is none that a reading shows.
            rows = laws.rows(self.modal.ports, len(begin.v))
            driven = ~np.any(rows[:, : len(self.angular_frequency)], axis=1)
            found.port_forces[0, driven & (rows @ begin.v == 0.0) & (laws.of_speed == 1)] = 0.0
        return Motion(self, acting, laws, times, *found[:4])

    def _let_go(self, acting: Acting, laws: Laws, refinement: int) -> Motion:
        """Return the motion of a structure that springs hold after a release."""
        assert acting.release is not None
        (row, release), times, acts = acting.release, acting.sampled, laws.act_at(0.0)
        loaded = laws.only(acts) if laws.spans else laws
        begin, holding = self._released(row, release, acting.initial, loaded)
        q, v, memory = begin
        if memory is not None and laws.spans:
            begin = begin._replace(memory=laws.filled(memory, acts))
        held = int(np.searchsorted(times, 0.0)) if release.at_rest else 0
        stamps = times[held:] if held < len(times) else np.zeros(1)  # which nobody looks at
        if stamps[0] < 0.0:
            back = self.modal.exact_steps(-stamps[:1])[0][0]
            begin = Begin(*np.split(np.linalg.solve(back, np.concatenate((q, v))), 2))
        found = self._followed(acting, laws, 0.0, stamps, begin, refinement)
        parts = list(found[:4])
        if held:
            felt = np.zeros(len(laws)) if begin.memory is None else begin.memory[:, 2]
            still = (np.tile(part, (held, 1)) for part in (q, v, felt, felt))
            parts = [np.vstack(both)[: len(times)] for both in zip(still, parts, strict=True)]
        q, v, forces, lagged = parts
        return Motion(self, acting, laws, times, q, v, forces, lagged, held, holding)

    # ------------------------------------------------------------ begin

    def _first(self, acting: Acting, laws: Laws) -> Begin:
        """Return the state at the first stamp."""
        count, moving, first = len(self.angular_frequency), self.moving, acting.time[:1]
        known = acting.begins is not Start.UNKNOWN and acting.clock[1] == 0.0  # dry friction is zero at rest
        drive = np.array([float(item.at(first, 0)[0]) for item in acting.drives.values()])
        speeds = [one.first_speed if known else float(one.at(first, 1)[0]) for one in acting.drives.values()]
        (q, v), memory = np.zeros((2, count + len(drive))), None
        if acting.begins is Start.SETTLED:
            load = acting.load_at(first, np.eye(len(self.mass)))
            if load.any() or drive.any():
                acts = laws.act_at(float(first[0]))
                values, felt = self.static(load, laws.only(acts) if laws.spans else laws, drive=drive)
                amounts = self.shapes.T @ (self.mass @ (values[0] - self.lift @ drive))
                q[:moving], v[moving:count] = amounts[:moving], amounts[moving:]
                memory = None if felt is None else laws.filled(felt, acts)
        elif acting.begins is Start.UNKNOWN:
            given = np.zeros(count + moving)  # displacement and speed of each mode, and the states
            given[: len(acting.initial)] = acting.initial[: len(given)]
            q[:moving], v[:count] = given[:moving], given[moving:]
        if len(drive):
            q[count:], v[count:] = self.heaviness * drive, self.heaviness * np.array(speeds)
        return Begin(q, v, memory)

    def _released(
        self, row: FloatArray, release: Release, initial: FloatArray, laws: Laws
    ) -> tuple[Begin, FloatArray | None]:
        """Return the state at the release, and the force (n,) that held it until then."""
        w, shape = self.angular_frequency, np.asarray(row @ self.shapes)
        largest = float(np.max(np.abs(shape)))
        if largest == 0.0:
            raise ModelError("The release point of a ring-down does not move in any mode of the model.")
        least = LEAST_PARTICIPATION * largest
        safe = np.where(np.abs(shape) >= least, shape, np.where(shape < 0.0, -least, least))
        given = np.zeros((len(w), 2))
        given[: min(len(w), len(initial))] = initial[: len(w)]
        unit, size = release.displacement / safe, release.displacement
        if not release.at_rest:
            return Begin(given[:, 0] * unit, given[:, 1] * unit * w), None
        compliance = float(row @ self.flexibility(row))  # release point, all modes
        holding, memory = size * (1.0 + given[0, 0]) / compliance, None
        acts = holding * row
        if len(laws):
            # With the release point held at its displacement: x = x_linear - (C - a a^T / a_0) F.
            rows = self.port_rows(laws)
            along = rows @ self.flexibility(row)
            held = rows @ self.flexibility(rows.T) - np.outer(along, along) / compliance
            solution = static_solution(laws, (holding * along)[None], held, kernel=compiled_kernel())
            holding += float(along @ solution.forces[0]) / compliance
            acts, memory = holding * row - solution.forces[0] @ rows, solution.memory
            if self.truncated:  # of the port's position, fades after the release
                memory[:, 3] = holding * (rows @ self.residual(row))
        deviation = given[:, 0] * unit
        deviation[0] = 0.0
        return Begin(acts @ self.shapes / w**2 + deviation, np.zeros(len(w)), memory), holding * row

    # ------------------------------------------------------------ steps

    def _followed(
        self, acting: Acting, laws: Laws, first: float, stamps: FloatArray, begin: Begin, refinement: int
    ) -> ModalMotion:
        """Return the motion at stamps from a state at a time that may lie before them [s]."""
        if stamps[0] - first > LEAST_LEAD * (stamps[-1] - stamps[0]) / max(len(stamps) - 1, 1):
            lead = self._advanced(acting, laws, np.array([first, stamps[0]]), begin, refinement)
            begin = Begin(lead.q[-1], lead.v[-1], lead.memory)
        return self._advanced(acting, laws, stamps, begin, refinement)

    def _advanced(
        self, acting: Acting, laws: Laws, stamps: FloatArray, begin: Begin, refinement: int
    ) -> ModalMotion:
        """Return the motion at stamps from a state at the first of them."""
        if len(stamps) == 1:  # a step that nobody looks at
            found = self._advanced(acting, laws, stamps[0] + np.array([0.0, INSTANT]), begin, refinement)
            return found._replace(
                q=found.q[:1], v=found.v[:1], port_forces=found.port_forces[:1], lagged=found.lagged[:1]
            )
        pushed = acting.loads or acting.drives or acting.constant.any() or not laws.linear
        free = None if pushed else self.modal.free(begin.q, begin.v, stamps - stamps[0])
        if free is not None:
            none = np.zeros((len(stamps), 0))
            return ModalMotion(*free, none, none, NO_LAWS.memory())
        smooth = bool(acting.drives) or any(course.hold is Hold.SMOOTH for _, course in acting.loads)
        edges = (*laws.edges, *(moment for _, course in acting.loads for moment in course.edges))
        boundaries = substeps(self.modal, laws, stamps, refinement, SMOOTH_PARTS if smooth else 1, edges)
        feed = np.zeros((len(boundaries.time), len(laws)))
        if self.truncated and len(laws) and acting.loads:
            feed = acting.load_at(boundaries.time, self.residual(self.port_rows(laws).T))
        return advance(self.modal, laws, self._steps(acting, boundaries, feed), begin, compiled_kernel())

    def _steps(self, acting: Acting, boundaries: Boundaries, feed: FloatArray) -> Steps:
        """Return the steps of all coordinates; the drives follow from nothing but what is prescribed."""
        time, count, heaviness = boundaries.time, len(self.angular_frequency), self.heaviness
        begin, end = acting.ends(time, self.all_shapes)
        for number, drive in enumerate(acting.drives.values(), count):
            for order, part in enumerate(self.driven(number - count)):
                for side, amount in zip((begin, end), drive.ends(time, order), strict=True):
                    side -= np.outer(amount, part)
                    side[:, number] = heaviness * amount
        steps = steps_under(self.modal, boundaries, begin, end, feed)
        if acting.drives:
            steps = steps._replace(transition=steps.transition.copy())
        for number, drive in enumerate(acting.drives.values(), count):
            for order, coordinate in enumerate((number, begin.shape[1] + number)):
                steps.transition[:, coordinate] = 0.0
                steps.push[:, coordinate] = heaviness * drive.at(time[1:], order)
        return steps


FORCES = 5.0
"""Force scale of a port that no stiffness holds over the rms of the forces there: friction of 1 to 25 % of
what acts is in the middle of its prior, and drag of as much at the largest speed."""
TURNS = 1e-3
"""Share of the largest speed of a port that both directions must reach, for a motion that turns."""
Rested = tuple[FloatArray, bool]
"""Where the ports were (N, P) in a trial at rest or after a release, and whether it is fitted."""
Moved = tuple[Motion, float, bool]
"""Motion in a trial under recorded inputs, the largest force measured in it [N], and whether it is fitted."""


def port_scales(
    bare: LinearSystem, still: Mapping[str, float], rests: Sequence[Rested], motions: Sequence[Moved]
) -> dict[str, PortScale]:
    """Return natural scales of ports under a campaign: what acts and moves where the structure has none.

    Where no stiffness of the structure holds a port (that of a controller is none), its force scale is
    `FORCES` times the rms of inertia, damping, own laws and loads there, its displacement and speed the
    largest: effects are measured by what acts and moves. At a port of a state likewise, of flows. Where
    drives alone move a port, no frequency of the structure says how fast: its force scale is the largest
    measured force.

    Parameters
    ----------
    bare : LinearSystem
        The system at the prior mean, without controllers.
    still : mapping of str to float
        The ports, and the stiffness of each at rest; zero where the modes tell it.
    rests, motions : sequences of Rested and Moved
        What the campaign shows. Where all trials are followed in time from known inputs, what was not seen to
        turn does not.
    """
    names, driven_only = list(still), not rests
    sizes, squares, count = np.zeros((3, len(names))), np.zeros(len(names)), 0
    turned, follows = np.zeros(len(names), bool), np.ones(len(names), bool)
    rows = np.array([bare.ports[name] for name in names]).reshape(len(names), len(bare.mass))
    for position, fitted in rests:
        x = np.max(np.abs(position), axis=0, initial=0.0)
        sizes = np.maximum(sizes, (x * fitted, x, 0.0 * x))
    for motion, measured, fitted in motions:
        system = motion.system
        at = [list(system.ports).index(name) for name in names]
        position, speed = (item[:, at] for item in motion.at_ports)
        x, v = (np.max(np.abs(item), axis=0, initial=0.0) for item in (position, speed))
        sizes = np.maximum(sizes, (x * fitted, x, v))
        least = TURNS * np.max(np.abs(speed), axis=0)
        turned |= (np.min(speed, axis=0) < -least) & (np.max(speed, axis=0) > least)
        if system.mode_count is not None:
            follows[:] = False
            continue
        shapes = system.shapes
        pushed = (
            motion.acceleration[:, : shapes.shape[1]] @ (system.mass @ shapes).T,
            motion.velocity[:, : shapes.shape[1]] @ (bare.damping @ shapes).T,
            motion.acting.load_at(motion.time, np.eye(len(system.mass))),
        )
        # modal force along the port, over what a unit force there gives
        lent = np.sum((rows @ shapes) ** 2, axis=1)
        along = shapes @ (shapes.T @ rows.T) / np.where(lent > 0.0, lent, 1.0)
        largest = np.max([np.mean((item @ along) ** 2, axis=0) for item in pushed], axis=0)
        squares += len(motion.time) * np.where(lent > 0.0, largest, (measured / FORCES) ** 2)
        count += len(motion.time)
        follows &= lent == 0.0
    found, frequency = dict[str, PortScale](), bare.angular_frequency[: bare.moving]
    for number, (name, row, stiff) in enumerate(zip(names, rows, still.values(), strict=True)):
        usual, most, pace = sizes[:, number].tolist()
        weight = (row @ bare.shapes)[: bare.moving] ** 2
        holds = weight > 1e-6 * float(weight.sum())
        size, free = usual or most or 1.0, not np.any(frequency[holds] > 0.0)
        force = FORCES * float(np.sqrt(squares[number] / max(count, 1)))
        if np.any(holds) and np.all(frequency[holds] > 0.0):
            stiff = stiff or 1.0 / float(np.sum(weight[holds] / frequency[holds] ** 2))
            w, of_mode = float(frequency[holds][0]), float(weight[holds][0])
            if driven_only and follows[number] and force > 0.0 < pace:
                found[name] = PortScale(size, force / size, pace / size, stiff, most or size, driven=True)
            else:
                found[name] = PortScale(size, w**2 / of_mode, w, stiff, most or 1.0)
            continue
        found[name] = PortScale(
            size, (force or 1.0) / size, (pace or 1.0) / size, None, most or size, free=free,
            turns=bool(turned[number]) or not (free and driven_only and np.any(holds)),
            of_state=not np.any(row[: bare.displacements]),
        )  # fmt: skip
    return found
