"""Sets of effects as hypotheses on the missing force: prior, values that are tried, and columns.

A law acts along a motion that is known: its force is what it would have been, had the port moved
so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from math import comb, log

import numpy as np
from scipy.special import erf

from discrepancy.campaign.records import FloatArray, TrialKind
from discrepancy.catalogue.entry import Setting
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, EffectTerm, Point
from discrepancy.fits.gates import SHAPE_GAIN
from discrepancy.fits.problem import Problem
from discrepancy.search_settings import SEARCH
from discrepancy.system.response import Response
from discrepancy.system.sensing import observe_response
from fe.compilation import compiled, law_functions
from fe.runtime.arrays import FIRST_ELEMENT, POSITION
from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws import LAWS, advance, force_and_slope
from fe.runtime.laws.interface import PARAMETERS, PortForce
from fe.runtime.laws.speed import steady_force
from fe.runtime.patch import SENSORS, LoggerClock, ModelPatch
from fe.runtime.sensors import clock_of

from .filtered import Process
from .process_search import Processes
from .trial import SeenTrial, TrialColumn, seen_trial
from .view import EffectColumn, TrialMotion, View, combined

LEVELS = (-1.3, -0.4, 0.4, 1.3)
"""Standard normal values at which the parameters of an effect that are no magnitudes are tried."""
MOST_VALUES = 16
"""Largest number of values of all parameters at which an effect is tried."""
AWAY = 0.5
"""Standard normal value of a magnitude at which an effect is tried; the middle of a prior of both
signs would be no effect."""


def sees_forces(problem: Problem) -> bool:
    """Return whether missing forces can be seen.

    In trials in motion, of a model that says how ports move.
    """
    model = problem.model
    has_motion = any(data.trial.is_dynamic for data in problem.trials)
    return has_motion and model.shows_ports and bool(model.ports)


def log_prior(candidate: Candidate, count: int, setting: Setting) -> float:
    """Return the log prior probability of a candidate at its places, among `count` effects.

    All sets of the same length have the same prior, and so have all places of an effect. A free
    shape has to gain what the shape test asks for.
    """
    terms = candidate.terms
    if not terms:
        return log(SEARCH.prior_none)
    log_places = sum(log(len(term.effect.places(setting))) for term in terms)
    shape_price = sum(SHAPE_GAIN for term in terms if term.free_shape)
    probability_of_length = (1.0 - SEARCH.prior_none) * SEARCH.set_shares[len(terms) - 1]
    set_count = comb(max(count, len(terms)), len(terms))
    return log(probability_of_length / set_count) - log_places - shape_price


def trial_values(term: EffectTerm) -> list[FloatArray]:
    """Return standard normal values (E,) of a term's parameters at which it is tried."""
    others = [number for number, parameter in enumerate(term.parameters) if not parameter.magnitude]
    levels = LEVELS if len(others) < 2 else LEVELS[::3]
    values_to_try = []
    for chosen in list(product(levels, repeat=len(others)))[:MOST_VALUES]:
        values = np.full(len(term.parameters), AWAY)
        values[others] = chosen
        values_to_try.append(values)
    return values_to_try


def scaled(processes: Processes, size_factor: float, time_factor: float) -> Mapping[int, Process]:
    """Return processes with other sizes and correlation times."""
    scaled_processes = {}
    for port, process in processes.items():
        scaled_processes[port] = replace(
            process, size=process.size * size_factor, time=process.time * time_factor
        )
    return scaled_processes


# ---------------------------------------------------------------- force of a law along a motion

WIDER = 10.0
"""Factor on the deviation of the speed, which is too small: the process of a force does not know of
steps."""
SLOW = 0.02
"""Share of the usual speed below which a body creeps before it slides, and no law of the speed
holds."""


def fill_course(
    number: int,
    of_speed: bool,
    law: FloatArray,
    positions: FloatArray,
    speeds: FloatArray,
    memory: FloatArray,
    course: FloatArray,
) -> None:
    """Fill `course` (F,) with the force of a law along positions and speeds (F,).

    Parameters
    ----------
    number : int
        The index of the law's kind in `LAWS`.
    of_speed : bool
        Whether it is a law of the speed.
    law : (R,) array
        The row of the law.
    positions, speeds : (F,) array
        The motion of its port.
    memory : (M,) array
        The memory of the law, which is changed.
    course : (F,) array
        The force.
    """
    for k in range(len(positions)):
        if of_speed:
            course[k] = steady_force(law, positions[k], speeds[k])
        else:
            advance(number, law, memory, positions[k])
            memory[POSITION] = positions[k]
            course[k] = force_and_slope(number, law, memory, positions[k], 1.0)[0]


@cache
def _compiled_fill_course() -> Callable[..., None]:
    """Return `fill_course`, compiled where numba is there."""
    return compiled(fill_course, law_functions())


def law_course(
    law: PortForce,
    time: FloatArray,
    position: FloatArray,
    speed: FloatArray,
    speed_deviation: float = 0.0,
    holding_force: FloatArray | float = 0.0,
) -> FloatArray:
    """Return the force (F,) of a law along a motion of its port; zero outside of the law's windows.

    Where the speed may be zero within its deviation, a law of the speed that has a force at rest
    holds the port: its force is then the holding force, up to its own largest.

    Parameters
    ----------
    law : PortForce
        The law.
    time, position, speed : (F,) array
        The motion of its port.
    speed_deviation : float
        The standard deviation of the speed.
    holding_force : (F,) array or float
        The missing force at the port, which holds it at rest.
    """
    row = law.parameter_row
    course = np.zeros(len(position))
    memory = np.zeros(FIRST_ELEMENT + max(1, len(row) - PARAMETERS))
    kind = type(law)
    _compiled_fill_course()(
        LAWS.index(kind),
        kind.depends_on_speed,
        row,
        np.ascontiguousarray(position),
        np.ascontiguousarray(speed),
        memory,
        course,
    )
    if kind.depends_on_speed and speed_deviation > 0.0:
        slow_speed = max(WIDER * speed_deviation, SLOW * float(np.sqrt(np.mean(speed**2))))
        moves = erf(np.abs(speed) / (np.sqrt(2.0) * slow_speed))
        held = np.clip(holding_force, -np.abs(course), np.abs(course))
        course = moves * course + (1.0 - moves) * held
    return course * law.acts_at(time)


# ---------------------------------------------------------------- columns


class ColumnBuilder:
    """Computes what effects do along the motion of a view: its columns.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    numbers : sequence of int
        The indices in the problem of the trials of the view.
    point : Point
        The unknowns about which the trials are linear.
    own_laws : ModelPatch
        The model's own laws.
    """

    def __init__(
        self, problem: Problem, numbers: Sequence[int], point: Point, own_laws: ModelPatch
    ) -> None:
        self.problem = problem
        self.numbers = numbers
        self.point = point
        self.own_laws = own_laws

    def bare(self) -> View:
        """Return the view of the trials without any effect, linear about the point."""
        trials = [seen_trial(self.problem, number, self.point) for number in self.numbers]
        return View(trials, self.problem.shared.precision)

    def along(
        self, view: View, motions: Sequence[TrialMotion], known: EffectColumn | None = None
    ) -> View:
        """Return a view along motions, with the model's own laws.

        Parameters
        ----------
        view : View
            The trials.
        motions : sequence of TrialMotion
            The motion of each trial.
        known : EffectColumn, optional
            What acts besides, without an unknown.
        """
        own = None
        if len(self.own_laws):
            own = self.of_patch(view, motions, self.own_laws)
        return replace(view, motions=motions, own=own, known=known)

    def of(
        self,
        view: View,
        motions: Sequence[TrialMotion],
        candidate: Candidate,
        values: FloatArray,
    ) -> EffectColumn | None:
        """Return the column of a candidate at scaled parameters (E,); None if it cannot act."""
        columns = []
        for term, term_values in candidate.split(values):
            try:
                patch = term.patch(self.problem.setting, term_values)
            except DiscrepancyError:
                return None
            column = self.of_patch(view, motions, patch, term.effect.acts_on)
            if column is None:
                return None
            columns.append(column)
        return combined(columns, [1.0] * len(columns))

    def of_patch(
        self,
        view: View,
        motions: Sequence[TrialMotion],
        patch: ModelPatch,
        acts_on: frozenset[TrialKind] = frozenset(TrialKind),
    ) -> EffectColumn | None:
        """Return the column of a patch that acts in some kinds of trials; None if it cannot act."""
        parts = []
        try:
            for trial, motion, number in zip(view.trials, motions, self.numbers, strict=True):
                in_trial = patch.in_trial(trial.name)
                parts.append(self.part(trial, motion, number, in_trial, acts_on))
        except (DiscrepancyError, InvalidPatchError):
            return None
        is_finite = all(np.all(np.isfinite(part.readings)) for part in parts)
        return parts if is_finite else None

    def part(
        self,
        trial: SeenTrial,
        motion: TrialMotion,
        number: int,
        patch: ModelPatch,
        acts_on: frozenset[TrialKind],
    ) -> TrialColumn:
        """Return what a patch does in a trial along a motion.

        Parameters
        ----------
        trial : SeenTrial
            The trial.
        motion : TrialMotion
            Its motion.
        number : int
            Its index in the problem.
        patch : ModelPatch
            The patch.
        acts_on : frozenset of TrialKind
            The kinds of trials that it changes.
        """
        kind = self.problem.trials[number].trial.kind
        if kind not in acts_on or not len(patch):
            return TrialColumn(np.zeros_like(trial.residual))
        laws = patch.of(PortForce)
        if len(laws):
            return self._of_laws(trial, motion, laws)
        sensors = patch.of(*SENSORS)
        changes_structure = len(sensors) < len(patch)
        if changes_structure or len(sensors.of(LoggerClock)):
            return TrialColumn(self._of_changed_response(trial, number, patch))
        return TrialColumn(self._of_sensors(trial, motion, number, sensors))

    def _of_laws(self, trial: SeenTrial, motion: TrialMotion, laws: ModelPatch) -> TrialColumn:
        """Return what laws at ports do in a trial along a motion."""
        added = np.zeros_like(motion.added)
        readings = np.zeros_like(trial.residual)
        forces: dict[int, FloatArray] = {}
        for law in self.problem.model.at_ports(laws):
            if not isinstance(law, PortForce):
                continue
            port = trial.system.ports.index(law.port)
            _, speed_deviation = motion.deviations.get(port, (0.0, 0.0))
            course = law_course(
                law,
                trial.fine_time,
                motion.positions[:, port],
                motion.speeds[:, port],
                speed_deviation,
                motion.forces.get(port, 0.0),
            )
            state = trial.pushed(port, course)
            added += state
            readings += trial.readings(state, {port: course})
            forces[port] = forces.get(port, 0.0) + course
        return TrialColumn(readings, added, forces)

    def _of_changed_response(self, trial: SeenTrial, number: int, patch: ModelPatch) -> FloatArray:
        """Return what a patch changes in the model's own response (N, C), over the noise."""
        shared = self.point.shared
        local = self.point.local[number]
        patched, _ = self.problem.response(number, shared, local, patch)
        response, _ = self.problem.response(number, shared, local, ModelPatch())
        gains = 1.0 + self.problem.shared.gains(shared, self.problem.trials[number].trial.channels)
        return trial.over_noise((patched - response) * gains)

    def _of_sensors(
        self, trial: SeenTrial, motion: TrialMotion, number: int, sensors: ModelPatch
    ) -> FloatArray:
        """Return what errors of sensors change in the readings (N, C), over the noise.

        They act on what is explained: the model's own response and what laws add to it. A missing
        force without a law is left out, since its part of any size would show any gain.
        """
        problem = self.problem
        data = problem.trials[number]
        shared = self.point.shared
        local = self.point.local[number]
        # what the sensors see, and its rates
        response, rates = problem.response(number, shared, local, ModelPatch())
        gains = 1.0 + problem.shared.gains(shared, data.trial.channels)
        by_laws = trial.readings(motion.explained, motion.laws) * trial.deviation / gains
        seen = response + by_laws
        seen_rates = None
        if rates is not None:
            state_rates = motion.explained @ trial.system.generator.T
            for port, force in motion.laws.items():
                state_rates = state_rates - np.outer(force, trial.system.actions[port])
            rates_by_laws = (state_rates @ trial.system.outputs.T)[:: trial.parts] / gains
            seen_rates = rates + rates_by_laws
        # what they show of it
        conditions = data.unknowns.conditions(data.trial, problem.shared.parameters(shared), local)
        observed = observe_response(
            problem.campaign, data.trial, sensors, conditions, Response(seen, seen_rates)
        )
        change = observed.values - seen
        clock_rate, clock_zero = clock_of(sensors)
        if seen_rates is not None:
            clock_error = clock_rate * (trial.time - trial.time[0]) + clock_zero
            change += seen_rates * clock_error[:, None]
        return trial.over_noise(change * gains)
