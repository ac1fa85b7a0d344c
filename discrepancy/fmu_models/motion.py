"""Motion and rest of an FMU, laws at its ports: that of its system where it is linear, else step by step.

Stepped with an FMU, the force of the laws is held over each step. In it a port moves as a mass would under
what accelerates it besides: what its speed answers to a force is measured beforehand, and the laws act on
that mass as they do on any structure. Second order in the step.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from math import ceil
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.errors import ModelError, said
from discrepancy.fmu_models.description import FmuModelDescription
from discrepancy.fmu_models.system import LINEAR, RECORD, Case, FmuPace, state_motion
from discrepancy.system.excitation import Acting, Load
from fe.compilation import compiled_kernel
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import ALIKE, Boundaries, Laws, StaticSolution, static_solution, steps_under
from fe.runtime.motion_arrays import ModalMotion
from fe.runtime.motion_arrays import State as Moving
from fmu_asset.door.runs import Run, State

CONVERGED = 1e-4
"""Largest rms change of a motion with laws when steps are halved, as a share of the largest motion."""
STATIC_ITERATIONS, STATIC_TOLERANCE = 30, 1e-9
MOST_REFINEMENT = 64
"""Steps that do not converge at this refinement are given up."""
Sampled = tuple[FloatArray, FloatArray]
"""Values and rates (N, C) at the samples of a trial."""


class FmuMotion(FmuPace):
    """Rest and motion of an FMU with laws at its ports."""

    def __init__(self, description: FmuModelDescription, folder: Path) -> None:
        super().__init__(description, folder)
        self._refinements = dict[Hashable, tuple[int, float]]()
        self._adds = dict[tuple[str, ...], bool]()  # whether the rest under some inputs is that of a system

    # ------------------------------------------------------------ motion

    def motion(
        self, case: Case, trial: Trial, times: FloatArray, laws: Laws, columns: Sequence[int],
        orders: Sequence[int], refinement: int,
    ) -> Sampled:  # fmt: skip
        """Return columns of the outputs at times (N,), derived so many times, and their rates.

        Raises
        ------
        ModelError
            If the FMU refuses; or, where it is stepped, if a port has no velocity, or the steps do not
            converge.
        """
        system, end = self.system(case), max(float(times[-1]), float(trial.time[-1]))
        at, derived = [self.ports.index(name) for name in laws.ports], np.array(orders) > 0
        seen = np.array([self.x[port] for port in at], dtype=np.int64)
        numbers = np.array([case.inputs.index(self.forces[port]) for port in at], dtype=np.int64)
        if system is None or system.jumps(seen, numbers):
            # a little longer, so that a clock that is being fitted does not ask for another run
            end += trial.interval * (times[-1] != trial.time[-1])
            values, step = self._stepped(case, trial, end, laws, columns, refinement)
            return sampled(values, step, times, orders, orders)
        amounts, still = self._amounts(case, linear=True), self._still(case)
        stamps, back = np.unique(np.append(np.maximum(times, 0.0), 0.0), return_inverse=True)
        even = len(stamps) > 2 and np.ptp(np.diff(stamps[1:])) <= ALIKE * stamps[-1]
        if not even:  # as many lengths of steps as stamps would take long
            stamps = case.step * np.arange(ceil(end / case.step - 1e-6) + 1.0)
        loads = [] if case.course is None else [Load(case.lever, case.course)]
        acting, start, memory = Acting(trial.time, stamps, loads), self._start(system, case, amounts), None
        if len(laws) and case.course is not None:  # it has settled under the first force
            first, gain = float(case.course.values[0]) * case.lever, system.gain
            free, compliance = (still + gain @ first)[seen], gain[np.ix_(seen, numbers)]
            rest = static_solution(laws, free[None], compliance, kernel=compiled_kernel())
            start = system.at_rest(first - np.bincount(numbers, rest.forces[0], len(first)))
            memory = rest.memory
        law = seen, numbers, still[seen], refinement, memory
        found = state_motion(system, acting, start, laws, *law)
        (states, forces), (rows, at_once) = found, system.rows(columns, orders)
        values = states @ rows.T + forces @ at_once.T + np.where(derived, 0.0, still[columns])
        if case.starts:  # the force that holds it until then may be seen at once
            held = [self._answer(case, name, released=True)[0] * amount for name, amount in amounts.items()]
            values[0] = np.where(derived, values[0], (still + sum(held))[columns])
        if not even:
            return sampled(values, case.step, times, orders, [0] * len(columns))
        rates = (states @ system.generator.T + forces @ system.push.T) @ rows.T
        if at_once.any():
            rates += np.gradient(forces, stamps, axis=0) @ at_once.T
        values, rates = values[back[:-1]], rates[back[:-1]]
        values[np.ix_(times < 0.0, derived)] = rates[times < 0.0] = 0.0
        return values, rates

    def _stepped(
        self, case: Case, trial: Trial, end: float, laws: Laws, columns: Sequence[int], refinement: int
    ) -> tuple[FloatArray, float]:
        """Return outputs (K, L) of the FMU stepped with the laws beside it, and the step [s]."""
        fixed, amounts, parts = self.description.motion.step, self._amounts(case, linear=False), 1
        whole = case.step if case.course is None else 0.5 * case.step  # inputs are held over steps

        def moved(parts: int) -> FloatArray:
            step = fixed or whole / parts
            run = self._run(case._replace(step=step, record=ceil(end / step - 1e-6)), amounts)
            if len(laws):
                with np.errstate(all="ignore"):  # an unstable coupling grows beyond all numbers
                    return self._beside(run, laws, trial.name)
            given = (values.tobytes() for values in run.courses.values())
            return self.remembered((*run[:3], *run.begin.items(), *given), lambda: self.followed(run))

        if len(laws) and fixed is None:
            # an accelerometer that nobody reads would ask for steps many times smaller
            watched = sorted({*columns, *self.x})
            key = (*watched, trial.kind, trial.interval)
            parts = self._parts_for(laws, key, whole, lambda parts: moved(parts)[::parts, watched])
        parts *= refinement
        return moved(parts)[:, columns], fixed or whole / parts

    def _begun(self, run: Run, laws: Laws, trial: str) -> tuple[Run, FloatArray | None]:
        """Return a run that has settled with laws under its first loads, and the memory of these."""
        free = self.begun(run)[1][None]
        if not run.courses or not np.any(free[:, [self.x[self.ports.index(name)] for name in laws.ports]]):
            return run, None

        def under(pulls: FloatArray) -> Run:
            begin = self._less({name: np.full(1, value) for name, value in run.begin.items()}, laws, pulls)
            return run._replace(begin={name: float(values[0]) for name, values in begin.items()})

        def asked(pulls: FloatArray) -> FloatArray:
            return self.begun(under(pulls))[1][None]

        rest = self._with_laws(laws, asked, free, run.state, trial)[1]
        return under(rest.forces), rest.memory

    def _beside(self, run: Run, laws: Laws, trial: str) -> FloatArray:
        """Return the outputs (K, C) of a run with laws at the ports."""
        run, memory = self._begun(run, laws, trial)
        at = [self.ports.index(name) for name in dict.fromkeys(laws.ports)]
        ports, names, x, v = zip(
            *((self.ports[port], self.forces[port], self.x[port], self.v[port]) for port in at), strict=True
        )
        if min(v) < 0:
            raise ModelError(said("models.velocity_needed", model=self, port=ports[v.index(-1)]))
        count, h = len(at), run.step
        one = run._replace(steps=1, courses={name: course[:1] for name, course in run.courses.items()})
        free = self.followed(one)
        pushes = ({name: one.courses.get(name, 0.0) + np.full(1, self.size(name))} for name in names)
        kicked = (self.followed(one._replace(courses={**one.courses, **push})) for push in pushes)
        sizes = np.array([self.size(name) for name in names])
        gain = np.stack([item[1, v] - free[1, v] for item in kicked], axis=1) / sizes
        modal = ModalSystem(
            np.zeros(count), np.zeros((count, count)), dict(zip(ports, np.eye(count), strict=True)),
            actions=dict(zip(ports, gain.T / h, strict=True)),
        )  # fmt: skip
        none = np.zeros((1, count))
        go = steps_under(
            modal, Boundaries(np.array([0.0, h]), np.arange(2), np.array([h])), none, none.copy(),
            np.zeros((2, len(laws))),
        )  # fmt: skip
        rows, rigid = laws.rows(modal.ports, count), np.zeros(len(laws))
        given = tuple(laws.at(rows, laws.rows(modal.actions, count), rigid, 0.0, go.transition))
        moving = Moving(np.zeros(count), np.zeros(count), laws.memory() if memory is None else memory)
        (q, v_end), (pulls, lagged) = np.zeros((2, 2, count)), np.zeros((2, 2, len(laws)))
        out = ModalMotion(q, v_end, pulls, lagged, moving.memory)
        before, taken = 2.0 * free[0, v] - free[1, v], np.zeros(count)
        asset, first, courses = self.begun(run)
        values, acts = [first], np.column_stack([*courses.values()])
        pushed = [list(courses).index(name) for name in names]
        for number, row in enumerate(acts):
            speed = values[-1][v,]
            push = (speed - before + taken) / h
            moving.q[:], moving.v[:] = values[-1][x,], speed
            go.push[:] = np.concatenate((0.5 * h * h * push, h * push))
            go.begin[:] = go.end[:] = push
            compiled_kernel().integrate(
                tuple(go), 0, 1, 0, True, memory is not None or number > 0, given, tuple(moving), tuple(out)
            )
            before, taken = speed, speed + h * push - moving.v
            row[pushed] -= np.linalg.solve(gain, taken)
            if not np.isfinite(row).all():
                return np.full((len(acts) + 1, len(first)), np.nan)
            with self.refusals():
                values.append(asset.step(load=dict(zip(courses, row.tolist(), strict=True))).values)
        return np.array(values)

    def _parts_for(self, laws: Laws, key: Hashable, step: float, moved: Callable[[int], FloatArray]) -> int:
        """Return into how many parts steps [s] are divided for laws.

        Steps are halved until that changes nothing that moves by more than `CONVERGED` of its largest motion
        (rms); what was enough is kept for laws of this kind up to twice as strong.

        Raises
        ------
        ModelError
            If the steps do not converge.
        """
        strength = float(np.max(np.abs(laws.values[:, 0])))
        exponents = np.round(np.clip(laws.values[:, 1:3], -9.0, 9.0), 1)  # roughness asks for short steps
        key = (key, laws.ports, laws.numbers.tobytes(), exponents.tobytes())
        parts, tried = self._refinements.get(key, (1, 0.0))
        if strength <= 2.0 * tried:
            return parts
        fine = moved(parts)
        while parts <= MOST_REFINEMENT:
            coarse, fine = fine, moved(2 * parts)
            rows = min(len(fine), len(coarse))
            with np.errstate(all="ignore"):
                size = np.max(np.abs(fine - fine.mean(axis=0)), axis=0)
                difference = np.sqrt(np.mean((coarse[:rows] - fine[:rows]) ** 2, axis=0))
                change = float(np.max(difference / np.where(size == 0.0, np.inf, size)))
            if change <= CONVERGED:
                self._refinements[key] = (parts, strength)
                return parts
            parts *= 2
        at, step = ", ".join(dict.fromkeys(laws.ports)), 2.0 * step / parts
        raise ModelError(said("models.too_stiff", at=at, model=self, step=step, change=change))

    # ------------------------------------------------------------ rest

    def rest(self, states: Sequence[State], loads: Mapping[str, FloatArray]) -> FloatArray:
        """Return the outputs (L, C) at rest in states that differ in inputs, under more (L,) on some of them.

        Where the FMU has to come to rest and is linear, what loads add is that of its system.
        """
        how = self.description.static
        if not how.settle:
            return self.resting(states, loads, how.step, settle=False)
        names = tuple(sorted(name for name, values in loads.items() if np.any(values)))
        rows = np.array([loads[name] for name in names]).reshape(-1, len(states)).T
        order = np.argsort(-np.abs(rows).sum(axis=1), kind="stable")  # the largest load says whether it is
        found = {row: self._rested(states[row], rows[row], names) for row in order.tolist()}
        return np.array([found[row] for row in range(len(states))])

    def _rested(self, state: State, amounts: FloatArray, names: tuple[str, ...]) -> FloatArray:
        """Return the outputs (C,) when a motion has come to rest under amounts (E,) on some inputs."""
        step = self.description.static.step

        def asked(amounts: FloatArray) -> FloatArray:
            loads, key = dict(zip(names, amounts[:, None], strict=True)), (state, names, amounts.tobytes())
            return self.remembered(key, lambda: self.resting([state], loads, step, settle=True)[0])

        case = Case(state, step, RECORD, names, at_rest=True)
        if self._adds.get(names) is False or (system := self.system(case)) is None:
            return asked(amounts)
        zero, moved = asked(0.0 * amounts), system.gain @ amounts
        if names not in self._adds:
            passing = [np.max(np.abs(self._answer(case, name)), axis=0) for name in names]
            allowed = LINEAR * (np.abs(moved) + np.abs(amounts) @ passing)
            self._adds[names] = bool(np.all(np.abs(asked(amounts) - zero - moved) <= allowed))
        return np.asarray(zero + moved) if self._adds[names] else asked(amounts)

    def flexibility(self, state: State) -> FloatArray:
        """Return the displacements (P, P) of ports at rest under unit forces at each."""
        if not self.ports:  # loads of zero may be outside of what the FMU takes
            return np.zeros((0, 0))
        pushes = np.diag([self.size(name) for name in self.forces])
        loads = dict.fromkeys(self.forces, np.zeros(len(pushes) + 1))
        for name, push in zip(self.forces, pushes, strict=True):
            loads[name] = loads[name] + np.append(0.0, push)
        found = self.rest([state] * (len(pushes) + 1), loads)[:, self.x]
        return np.asarray((found[1:] - found[0]).T / np.diag(pushes))

    def at_rest(
        self, states: Sequence[State], loads: Mapping[str, FloatArray], laws: Laws, trial: str
    ) -> FloatArray:
        """Return the outputs (L, C) where laws follow the load path; the FMU itself is asked at the end.

        Raises
        ------
        ModelError
            If the law has no solution, or the FMU does not confirm it.
        """
        try:
            values = self.rest(states, loads)
        except ModelError:
            for row, state in enumerate(states):
                where = f"The trial {trial!r}, row {row + 1} of its table: "
                with ModelError.instead_of(ModelError, before=where):
                    self.rest([state], {name: values[row : row + 1] for name, values in loads.items()})
            raise
        if not len(laws):
            return values

        def asked(pulls: FloatArray) -> FloatArray:
            return self.rest(states, self._less(loads, laws, pulls))

        return self._with_laws(laws, asked, values, states[0], trial)[0]

    def _less(self, loads: Mapping[str, FloatArray], laws: Laws, pulls: FloatArray) -> dict[str, FloatArray]:
        """Return loads less the forces (L, J) of laws, by input."""
        given = dict(loads)
        for name, pull in zip(laws.ports, pulls.T, strict=True):
            force = self.forces[self.ports.index(name)]
            given[force] = given.get(force, 0.0) - pull
        return given

    def _with_laws(
        self, laws: Laws, asked: Callable[[FloatArray], FloatArray], values: FloatArray, state: State,
        trial: str,
    ) -> tuple[FloatArray, StaticSolution]:  # fmt: skip
        """Return the outputs (L, C) at rest with laws, and what these do then.

        Parameters
        ----------
        laws : Laws
            J of them.
        asked : callable
            Forces (L, J) of the laws to outputs at rest.
        values : (L, C) ndarray
            Outputs without laws.
        state : State
            Whose flexibility leads to where laws and FMU agree.
        trial : str
            Where.
        """
        at = [self.ports.index(name) for name in laws.ports]
        columns, compliance = [self.x[port] for port in at], self.flexibility(state)[np.ix_(at, at)]
        linear = values[:, columns]
        for _ in range(STATIC_ITERATIONS):
            rest = static_solution(laws, linear, compliance, kernel=compiled_kernel())
            values = asked(rest.forces)
            # where the FMU is not linear, the law is solved again about the points that were reached
            again = values[:, columns] + rest.forces @ compliance.T
            change, linear = np.abs(again - linear).max(axis=1), again
            if np.all(change <= STATIC_TOLERANCE * np.maximum(np.abs(again).max(axis=1), 1e-300)):
                return values, rest
        names, level = ", ".join(dict.fromkeys(laws.ports)), int(np.argmax(change)) + 1
        raise ModelError(
            said("models.too_strong", at=names, model=self, level=level, trial=trial, most=STATIC_ITERATIONS)
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
