"""Sets of effects as hypotheses on the missing force: their priors, trial values and columns.

The force of a law is evaluated along a motion that is taken as known: the estimated motion of its
port. A column is the change of each trial for a unit of an unknown.
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
"""Standard normal values at which a parameter that is not a magnitude is tried."""
MOST_VALUES = 16
"""Largest number of combinations of parameter values at which an effect is tried."""
AWAY = 0.5
"""Standard normal value at which a magnitude is tried. At zero, the middle of a prior with both
signs, the effect would do nothing."""


def sees_forces(problem: Problem) -> bool:
    """Return whether missing forces can be estimated in a problem.

    That needs trials in motion, and a model that describes how its ports move.
    """
    model = problem.model
    has_motion = any(data.trial.is_dynamic for data in problem.trials)
    return has_motion and model.shows_ports and bool(model.ports)


def log_prior(candidate: Candidate, count: int, setting: Setting) -> float:
    """Return the log prior probability of a candidate [nat].

    All sets with the same number of effects have the same prior, and so have all places of an
    effect. An effect with a free shape has the smaller prior that the shape test asks for.

    Parameters
    ----------
    candidate : Candidate
        The effects at their places.
    count : int
        The number of effects that are compared.
    setting : Setting
        The setting of the problem, which says at which places an effect may act.
    """
    terms = candidate.terms
    if not terms:
        return log(SEARCH.prior_none)
    log_places = sum(log(len(term.effect.places(setting))) for term in terms)
    shape_price = sum(SHAPE_GAIN for term in terms if term.free_shape)
    probability_of_length = (1.0 - SEARCH.prior_none) * SEARCH.set_probabilities[len(terms) - 1]
    number_of_sets = comb(max(count, len(terms)), len(terms))
    return log(probability_of_length / number_of_sets) - log_places - shape_price


def trial_values(term: EffectTerm) -> list[FloatArray]:
    """Return sets of standard normal parameter values (E,) at which an effect is tried."""
    shape_parameters = [
        number for number, parameter in enumerate(term.parameters) if not parameter.magnitude
    ]
    levels = LEVELS if len(shape_parameters) < 2 else LEVELS[::3]
    values_to_try = []
    for shape_values in list(product(levels, repeat=len(shape_parameters)))[:MOST_VALUES]:
        values = np.full(len(term.parameters), AWAY)
        values[shape_parameters] = shape_values
        values_to_try.append(values)
    return values_to_try


def scaled(processes: Processes, size_factor: float, time_factor: float) -> Mapping[int, Process]:
    """Return processes with their sizes and correlation times multiplied by factors.

    Parameters
    ----------
    processes : mapping of int to Process
        The processes, by the number of the port.
    size_factor, time_factor : float
        The factors.
    """
    scaled_processes = {}
    for port, process in processes.items():
        scaled_processes[port] = replace(
            process, size=process.size * size_factor, time=process.time * time_factor
        )
    return scaled_processes


# ---------------------------------------------------------------- force of a law along a motion

WIDER = 10.0
"""Factor on the posterior deviation of a speed. That deviation is too small, since the process of a
missing force has no steps."""
SLOW = 0.02
"""Share of the rms speed below which a body creeps before it slides, so that no law of the speed is
valid."""


def fill_course(
    number: int,
    of_speed: bool,
    law: FloatArray,
    positions: FloatArray,
    speeds: FloatArray,
    memory: FloatArray,
    course: FloatArray,
) -> None:
    """Fill `course` with the force of a law along a motion of its port.

    Parameters
    ----------
    number : int
        The index of the law's class in `LAWS`.
    of_speed : bool
        Whether the law is one of the speed, which has no memory.
    law : (R,) array
        The parameter row of the law.
    positions, speeds : (F,) array
        The motion of the port at the fine stamps [m or rad, and per s].
    memory : (M,) array
        The memory of the law, which is changed.
    course : (F,) array
        The force to fill [N or N m].
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
    """Return `fill_course`, compiled if numba is installed."""
    return compiled(fill_course, law_functions())


def law_course(
    law: PortForce,
    time: FloatArray,
    position: FloatArray,
    speed: FloatArray,
    speed_deviation: float = 0.0,
    holding_force: FloatArray | float = 0.0,
) -> FloatArray:
    """Return the force (F,) of a law along a motion of its port [N or N m].

    The force is zero outside of the law's windows in time. A law of the speed with a force at rest,
    such as dry friction, holds the port if its speed may be zero within its uncertainty: the force
    is then the holding force, up to the force of the law.

    Parameters
    ----------
    law : PortForce
        The law.
    time, position, speed : (F,) array
        The fine stamps [s], and the motion of the port there [m or rad, and per s].
    speed_deviation : float
        The standard deviation of the speed.
    holding_force : (F,) array or float
        The missing force at the port, which holds it at rest.
    """
    row = law.parameter_row
    course = np.zeros(len(position))
    memory = np.zeros(FIRST_ELEMENT + max(1, len(row) - PARAMETERS))
    law_class = type(law)
    _compiled_fill_course()(
        LAWS.index(law_class),
        law_class.depends_on_speed,
        row,
        np.ascontiguousarray(position),
        np.ascontiguousarray(speed),
        memory,
        course,
    )
    if law_class.depends_on_speed and speed_deviation > 0.0:
        slow_speed = max(WIDER * speed_deviation, SLOW * float(np.sqrt(np.mean(speed**2))))
        # probability that a normal error of deviation `slow_speed` is smaller than the speed
        probability_of_motion = erf(np.abs(speed) / (np.sqrt(2.0) * slow_speed))
        force_at_rest = np.clip(holding_force, -np.abs(course), np.abs(course))
        course = probability_of_motion * course + (1.0 - probability_of_motion) * force_at_rest
    return course * law.acts_at(time)


# ---------------------------------------------------------------- columns


class ColumnBuilder:
    """Computes the columns of effects along the motion of a view: their change of each trial.

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
        """Return a view whose laws and parameters act along motions, with the model's own laws.

        Parameters
        ----------
        view : View
            The trials.
        motions : sequence of TrialMotion
            The motion of each trial.
        known : EffectColumn, optional
            The part of the hypothesis that has no unknown.
        """
        own_column = None
        if len(self.own_laws):
            own_column = self.of_patch(view, motions, self.own_laws)
        return replace(view, motions=motions, own=own_column, known=known)

    def of(
        self,
        view: View,
        motions: Sequence[TrialMotion],
        candidate: Candidate,
        values: FloatArray,
    ) -> EffectColumn | None:
        """Return the column of a candidate along motions.

        Parameters
        ----------
        view : View
            The trials.
        motions : sequence of TrialMotion
            The motion of each trial.
        candidate : Candidate
            The effects.
        values : (E,) array
            The scaled parameters of the effects.

        Returns
        -------
        EffectColumn or None
            The sum of the changes by all effects; None if an effect cannot act with these values.
        """
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
        """Return the column of a patch along motions.

        Parameters
        ----------
        view : View
            The trials.
        motions : sequence of TrialMotion
            The motion of each trial.
        patch : ModelPatch
            The change of the model.
        acts_on : frozenset of TrialKind
            The kinds of trials that it changes.

        Returns
        -------
        EffectColumn or None
            The change of each trial; None if the patch is invalid or gives numbers that are not
            finite.
        """
        changes = []
        try:
            for trial, motion, number in zip(view.trials, motions, self.numbers, strict=True):
                patch_in_trial = patch.in_trial(trial.name)
                changes.append(self.part(trial, motion, number, patch_in_trial, acts_on))
        except (DiscrepancyError, InvalidPatchError):
            return None
        is_finite = all(np.all(np.isfinite(change.readings)) for change in changes)
        return changes if is_finite else None

    def part(
        self,
        trial: SeenTrial,
        motion: TrialMotion,
        number: int,
        patch: ModelPatch,
        acts_on: frozenset[TrialKind],
    ) -> TrialColumn:
        """Return the change of one trial by a patch, along a motion.

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
            The kinds of trials that the patch changes.
        """
        kind = self.problem.trials[number].trial.kind
        if kind not in acts_on or not len(patch):
            return TrialColumn(np.zeros_like(trial.residual))
        # laws act along the motion; changes of the structure and of the clock are simulated; other
        # errors of sensors act on the explained motion
        laws = patch.of(PortForce)
        if len(laws):
            return self._of_laws(trial, motion, laws)
        sensors = patch.of(*SENSORS)
        changes_structure = len(sensors) < len(patch)
        if changes_structure or len(sensors.of(LoggerClock)):
            return TrialColumn(self._of_changed_response(trial, number, patch))
        return TrialColumn(self._of_sensors(trial, motion, number, sensors))

    def _of_laws(self, trial: SeenTrial, motion: TrialMotion, laws: ModelPatch) -> TrialColumn:
        """Return the change of a trial by laws at ports, along a motion.

        Parameters
        ----------
        trial : SeenTrial
            The trial.
        motion : TrialMotion
            The motion of its ports.
        laws : ModelPatch
            The laws.
        """
        added_by_all = np.zeros_like(motion.added)
        readings = np.zeros_like(trial.residual)
        forces: dict[int, FloatArray] = {}
        for law in self.problem.model.forces_at_ports(laws):
            if not isinstance(law, PortForce):
                continue
            port = trial.system.ports.index(law.port)
            _, speed_deviation = motion.deviations.get(port, (0.0, 0.0))
            force = law_course(
                law,
                trial.fine_time,
                motion.positions[:, port],
                motion.speeds[:, port],
                speed_deviation,
                motion.forces.get(port, 0.0),
            )
            added_by_law = trial.pushed(port, force)
            added_by_all += added_by_law
            readings += trial.readings(added_by_law, {port: force})
            forces[port] = forces.get(port, 0.0) + force
        return TrialColumn(readings, added_by_all, forces)

    def _of_changed_response(self, trial: SeenTrial, number: int, patch: ModelPatch) -> FloatArray:
        """Return the change (N, C) of the readings by a patch in a simulation, over the noise.

        It is the model's response with the patch minus that without it; the estimated motion is not
        used.

        Parameters
        ----------
        trial : SeenTrial
            The trial.
        number : int
            Its index in the problem.
        patch : ModelPatch
            The patch.
        """
        shared = self.point.shared
        local = self.point.local[number]
        # both responses are without the gains of the channels
        patched, _ = self.problem.response(number, shared, local, patch)
        response, _ = self.problem.response(number, shared, local, ModelPatch())
        gains = 1.0 + self.problem.shared.gains(shared, self.problem.trials[number].trial.channels)
        return trial.over_noise((patched - response) * gains)

    def _of_sensors(
        self, trial: SeenTrial, motion: TrialMotion, number: int, sensors: ModelPatch
    ) -> FloatArray:
        """Return the change (N, C) of the readings by errors of sensors, divided by the noise.

        The sensors see the explained motion only: the response of the model and what laws add to
        it. A missing force without a law is left out. As it may have any size, it would fit any
        gain.

        Parameters
        ----------
        trial : SeenTrial
            The trial.
        motion : TrialMotion
            Its motion.
        number : int
            Its index in the problem.
        sensors : ModelPatch
            The errors of sensors.
        """
        problem = self.problem
        data = problem.trials[number]
        shared = self.point.shared
        local = self.point.local[number]
        # the true values at the sensors, and their rates
        response, rates = problem.response(number, shared, local, ModelPatch())
        gains = 1.0 + problem.shared.gains(shared, data.trial.channels)
        # `readings` are divided by the noise and contain the gains: undo both
        change_by_laws = trial.readings(motion.explained, motion.laws) * trial.deviation / gains
        true_values = response + change_by_laws
        true_rates = None
        if rates is not None:
            state_rates = motion.explained @ trial.system.generator.T
            for port, force in motion.laws.items():
                state_rates = state_rates - np.outer(force, trial.system.actions[port])
            rates_by_laws = (state_rates @ trial.system.outputs.T)[:: trial.parts] / gains
            true_rates = rates + rates_by_laws
        # the readings of the sensors with their errors
        conditions = data.unknowns.conditions(data.trial, problem.shared.parameters(shared), local)
        observed = observe_response(
            problem.campaign, data.trial, sensors, conditions, Response(true_values, true_rates)
        )
        change = observed.values - true_values
        # an error of the clock shifts the readings in time
        clock_rate, clock_zero = clock_of(sensors)
        if true_rates is not None:
            clock_error = clock_rate * (trial.time - trial.time[0]) + clock_zero
            change += true_rates * clock_error[:, None]
        return trial.over_noise(change * gains)
