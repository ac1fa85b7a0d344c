"""Motion of an FMU, laws at its ports: that of its system where it is linear, step by step where it is not.

Stepped with an FMU, the force of the laws is held over each step. In it a port moves as a mass would under
what accelerates it besides: what its speed answers to a force is measured beforehand, and the laws act on
that mass as they do on any structure. Second order in the step.
"""

from collections.abc import Callable, Mapping, Sequence
from math import ceil

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.errors import ModelError
from discrepancy.models.acting import Acting, Load
from discrepancy.models.fmu_pace import FmuPace, Motive
from discrepancy.models.fmu_runs import Run, State
from fe.compilation import compiled_kernel
from fe.runtime.arrays import PLACE
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import Laws, static_solution
from fe.runtime.motion_arrays import ModalMotion
from fe.runtime.motion_arrays import State as Moving
from fe.runtime.stepwise import ALIKE, Boundaries, steps_under

CONVERGED = 1e-4
"""Largest rms change of a motion with laws when steps are halved, as a share of the largest motion."""
STATIC_ITERATIONS, STATIC_TOLERANCE = 30, 1e-9
MOST_REFINEMENT = 64
"""Steps that do not converge at this refinement are given up."""
Sampled = tuple[FloatArray, FloatArray]
"""Values and rates (N, C) at the samples of a trial."""


class FmuMotion(FmuPace):
    """Rest and motion of an FMU with laws at its ports."""

    # ------------------------------------------------------------ motion

    def motion(
        self, trial: Trial, times: FloatArray, state: State, motive: Motive, laws: Laws,
        columns: Sequence[int], orders: Sequence[int], refinement: int,
    ) -> Sampled:  # fmt: skip
        """Return columns of the outputs at times (N,), derived so many times, and their rates.

        Raises
        ------
        ModelError
            If the FMU refuses; or, where it is stepped, if a port has no velocity, or the steps do not
            converge.
        """
        _, step = self.usual(trial)
        system, end = self.system(state, step, motive), max(float(times[-1]), float(trial.time[-1]))
        if system is None:
            # a little longer, so that a clock that is being fitted does not ask for another run
            end += trial.interval * (times[-1] != trial.time[-1])
            values, step = self._stepped(trial, end, state, motive, laws, columns, refinement)
            return sampled(values, step, times, orders, orders)
        inputs, at = self._pushed(motive), [self.ports.index(name) for name in laws.ports]
        amounts, still = self._amounts(state, step, motive, linear=True), self._still(state, step)
        loads = [] if motive.course is None else [Load(self._levers(motive), motive.course)]
        stamps, back = np.unique(np.append(np.maximum(times, 0.0), 0.0), return_inverse=True)
        even = np.ptp(np.diff(stamps[1:])) <= ALIKE * stamps[-1]
        if not even:  # as many lengths of steps as stamps would take long
            stamps = step * np.arange(ceil(end / step - 1e-6) + 1.0)
        states, forces = system.motion(
            Acting(trial.time, stamps, loads), self._start(system, motive, amounts),
            still[self._x[at]], laws, self._x[at],
            np.array([inputs.index(self.forces[port]) for port in at], dtype=np.int64), refinement,
        )  # fmt: skip
        rows, at_once = system.rows(columns, orders)
        values = states @ rows.T + forces @ at_once.T + np.where(np.array(orders) > 0, 0.0, still[columns])
        if motive.starts:  # the force that holds it until then may be seen at once
            held = [self._released(state, step, motive, name)[0] * amount for name, amount in amounts.items()]
            values[0] = np.where(np.array(orders) > 0, values[0], (still + sum(held))[columns])
        if not even:
            return sampled(values, step, times, orders, [0] * len(columns))
        rates = (states @ system.generator.T + forces @ system.push.T) @ rows.T
        if at_once.any():
            rates += np.gradient(forces, stamps, axis=0) @ at_once.T
        values, rates = values[back[:-1]], rates[back[:-1]]
        values[np.ix_(times < 0.0, np.array(orders) > 0)] = rates[times < 0.0] = 0.0
        return values, rates

    def _stepped(
        self, trial: Trial, end: float, state: State, motive: Motive, laws: Laws, columns: Sequence[int],
        refinement: int,
    ) -> tuple[FloatArray, float]:  # fmt: skip
        """Return outputs (K, L) of the FMU stepped with the laws beside it, and the step [s]."""
        fixed, usual = self.description.motion.step, self.usual(trial)[1]
        amounts = self._amounts(state, usual, motive, linear=False)
        whole = usual if motive.course is None else 0.5 * usual  # inputs are held over steps

        def moved(parts: int) -> FloatArray:
            step = fixed or whole / parts
            run = self._run(state, step, ceil(end / step - 1e-6), motive, amounts)
            if len(laws):
                with np.errstate(all="ignore"):  # an unstable coupling grows beyond all numbers
                    return self._beside(run, laws)
            given = tuple((name, values.tobytes()) for name, values in run.courses.items())
            key = (*run[:3], tuple(run.begin.items()), given)
            return self.remembered(key, lambda: self.followed(run))

        parts = 1
        if len(laws) and fixed is None:
            watched = [*columns, *self.x]
            parts = self._parts_for(laws, trial, watched, whole, lambda parts: moved(parts)[::parts, watched])
        parts *= refinement
        return moved(parts)[:, columns], fixed or whole / parts

    def _beside(self, run: Run, laws: Laws) -> FloatArray:
        """Return the outputs (K, C) of a run with laws at the ports."""
        at = [self.ports.index(name) for name in dict.fromkeys(laws.ports)]
        x, v, count = [self.x[port] for port in at], [self.v[port] for port in at], len(at)
        if min(v) < 0:
            raise ModelError(
                f"The FMU model {self.description.name!r} is not linear, so its port "
                f"{self.ports[at[v.index(-1)]]!r} needs a velocity output; name it in [[port]]."
            )
        names, h = [self.forces[port] for port in at], run.step
        one = run._replace(steps=1, courses={name: course[:1] for name, course in run.courses.items()})
        free = self.followed(one)
        pushes = ({name: one.courses.get(name, 0.0) + np.full(1, self.size(name))} for name in names)
        kicked = (self.followed(one._replace(courses={**one.courses, **push})) for push in pushes)
        sizes = np.array([self.size(name) for name in names])
        gain = np.stack([item[1, v] - free[1, v] for item in kicked], axis=1) / sizes
        ports, unit = [self.ports[port] for port in at], np.eye(count)
        modal = ModalSystem(
            np.zeros(count), np.zeros((count, count)), dict(zip(ports, unit, strict=True)),
            actions=dict(zip(ports, gain.T / h, strict=True)),
        )  # fmt: skip
        none = np.zeros((1, count))
        go = steps_under(
            modal, Boundaries(np.array([0.0, h]), np.arange(2), np.array([h])), none, none.copy(),
            np.zeros((2, len(laws))),
        )  # fmt: skip
        rows, rigid = laws.rows(modal.ports, count), np.zeros(len(laws))
        given = tuple(laws.at(rows, laws.rows(modal.actions, count), rigid, 0.0, go.transition))
        moving = Moving(np.zeros(count), np.zeros(count), laws.memory())
        (q, v_end), (pulls, lagged) = np.zeros((2, 2, count)), np.zeros((2, 2, len(laws)))
        out = ModalMotion(q, v_end, pulls, lagged, moving.memory)
        before, taken = 2.0 * free[0, v] - free[1, v], np.zeros(count)
        friction = laws.of_speed == 1
        asset, first, courses = self.begun(run)
        values, acts = [first], np.column_stack([*courses.values()])
        pushed = [list(courses).index(name) for name in names]
        for number, row in enumerate(acts):
            speed = values[-1][v]
            push = (speed - before + taken) / h
            moving.q[:], moving.v[:] = values[-1][x], speed
            go.push[:] = np.concatenate((0.5 * h * h * push, h * push))
            go.begin[:] = go.end[:] = push
            moving.memory[friction, PLACE] = rows[friction] @ moving.q  # where it holds the port
            compiled_kernel().integrate(
                tuple(go), 0, 1, 0, True, number > 0, given, tuple(moving), tuple(out)
            )
            before, taken = speed, speed + h * push - moving.v
            row[pushed] -= np.linalg.solve(gain, taken)
            if not np.isfinite(row).all():
                return np.full((len(acts) + 1, len(first)), np.nan)
            values.append(self.one_step(asset, dict(zip(courses, row.tolist(), strict=True))))
        return np.array(values)

    def _parts_for(
        self, laws: Laws, trial: Trial, watched: Sequence[int], step: float,
        moved: Callable[[int], FloatArray],
    ) -> int:  # fmt: skip
        """Return into how many parts steps [s] are divided for laws.

        Steps are halved until that changes nothing that is watched by more than `CONVERGED` of its largest
        motion (rms); what was enough is kept for laws of this kind up to twice as strong. An accelerometer
        that nobody reads would ask for steps many times smaller.

        Raises
        ------
        ModelError
            If the steps do not converge.
        """
        strength = float(np.max(np.abs(laws.values[:, 0])))
        exponents = np.round(np.clip(laws.values[:, 1:3], -9.0, 9.0), 1)  # roughness asks for short steps
        kinds = laws.ports, laws.numbers.tobytes(), exponents.tobytes()
        key = (tuple(sorted(set(watched))), trial.kind, trial.interval, *kinds)
        parts, tried = self._refinements.get(key, (1, 0.0))
        if strength <= 2.0 * tried:
            return parts
        coarse = moved(parts)
        while parts <= MOST_REFINEMENT:
            fine = moved(2 * parts)
            rows = min(len(fine), len(coarse))
            with np.errstate(all="ignore"):
                size = np.max(np.abs(fine[:rows] - fine[:rows].mean(axis=0)), axis=0)
                difference = np.sqrt(np.mean((coarse[:rows] - fine[:rows]) ** 2, axis=0))
                change = float(np.max(difference / np.where(size > 0.0, size, np.inf)))
            if np.isfinite(difference).all() and change <= CONVERGED:
                self._refinements[key] = (parts, strength)
                return parts
            parts, coarse = 2 * parts, fine
        raise ModelError(
            f"The internal force at {', '.join(dict.fromkeys(laws.ports))} does not converge in the "
            f"co-simulation with the FMU model {self.description.name!r}: halving steps of "
            f"{2.0 * step / parts:.2g} s still changes the motion by {change:.1g} of its size; the force is "
            f"too stiff for the port."
        )

    # ------------------------------------------------------------ rest

    def flexibility(self, state: State, ports: Sequence[int]) -> FloatArray:
        """Return the displacements (P, P) of ports at rest under unit forces at each."""
        if not ports:  # loads of zero may be outside of what the FMU takes
            return np.zeros((0, 0))
        loads = [{}, *({self.forces[port]: self.size(self.forces[port])} for port in ports)]
        columns = [self.x[port] for port in ports]
        found = np.array([self.rest([state], [load])[0, columns] for load in loads])
        sizes = np.array([self.size(self.forces[port]) for port in ports])
        return np.asarray((found[1:] - found[0]).T / sizes)

    def stiffness(self, state: State, step: float, record: int) -> list[tuple[float, float]] | None:
        """Return the stiffness of the first mode and the one at rest at each port [N/m or N m/rad].

        None if the FMU is not linear.
        """
        system, found = (
            self.system(state, step, Motive(tuple(self.ports), record=record)),
            list[tuple[float, float]](),
        )
        if system is None:
            return None
        for number, column in enumerate(self.x):
            at_rest = 1.0 / float(system.gain[column, number])
            frequency, shape = system.most_flexible(column, number) or (1.0, 0.0)
            of_mode = shape / frequency**2
            found.append((at_rest if of_mode * at_rest < 1e-6 else 1.0 / of_mode, at_rest))
        return found

    def at_rest(
        self, states: Sequence[State], loads: Sequence[Mapping[str, float]], laws: Laws, trial: str
    ) -> FloatArray:
        """Return the outputs (L, C) where laws follow the load path; the FMU itself is asked at the end.

        Raises
        ------
        ModelError
            If the law has no solution, or the FMU does not confirm it.
        """
        try:
            values = self.rest(states, loads)
        except ModelError as cause:
            if len(loads) == 1:
                raise
            for number, (state, load) in enumerate(zip(states, loads, strict=True), start=1):
                try:
                    self.rest([state], [load])
                except ModelError as own:
                    raise ModelError(f"The trial {trial!r}, row {number} of its table: {own}") from own
            raise cause
        if not len(laws):
            return values
        at = [self.ports.index(name) for name in laws.ports]
        columns, compliance = [self.x[port] for port in at], self.flexibility(states[0], at)
        linear = values[:, columns]
        for _ in range(STATIC_ITERATIONS):
            forces = static_solution(laws, linear, compliance, kernel=compiled_kernel()).forces
            given = [dict(load) for load in loads]
            for row, pulls in zip(given, forces.tolist(), strict=True):
                for port, pull in zip(at, pulls, strict=True):
                    row[self.forces[port]] = row.get(self.forces[port], 0.0) - pull
            values = self.rest(states, given)
            # where the FMU is not linear, the law is solved again about the points that were reached
            again = values[:, columns] + forces @ compliance.T
            change, linear = np.abs(again - linear).max(axis=1), again
            if np.all(change <= STATIC_TOLERANCE * np.maximum(np.abs(again).max(axis=1), 1e-300)):
                return values
        raise ModelError(
            f"The law at {', '.join(dict.fromkeys(laws.ports))} and the FMU model "
            f"{self.description.name!r} did not agree at load level {int(np.argmax(change)) + 1} of "
            f"{trial!r} within {STATIC_ITERATIONS} iterations; the force is too strong for the FMU."
        )


def sampled(
    values: FloatArray, step: float, times: FloatArray, orders: Sequence[int], left: Sequence[int]
) -> Sampled:
    """Return values and rates at times, from values on an even grid.

    Parameters
    ----------
    values : (K, C) ndarray
        At 0, `step`, 2 `step`, ...
    step : float
        Of the grid [s].
    times : (N,) ndarray
        Times of the samples [s]; before zero the first value holds.
    orders, left : sequence of int
        For each column, how often the output is derived in the response, and in the values not yet.
    """
    grid, before = step * np.arange(len(values)), times < 0.0
    curve, at = CubicSpline(grid, values), np.clip(times, 0.0, grid[-1])
    shown, rates = curve(at), curve(at, 1)
    for column, order in enumerate(left):
        if order > 0:
            # derivatives of the derivative's own spline keep the order of the first one
            own = CubicSpline(grid, curve(grid, 1)[:, column])
            shown[:, column], rates[:, column] = own(at, order - 1), own(at, order)
    rates[before] = 0.0
    shown[np.ix_(before, np.array(orders) > 0)] = 0.0
    return np.ascontiguousarray(shown), np.ascontiguousarray(rates)
