"""Sets of effects as hypotheses on the missing force: priors, values to try, and columns.

A *column* contains, for each trial, the change of readings and state by an effect, or by a unit of
an unknown. The force of a law is evaluated along the estimated motion of its port, which is taken
as known.
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
from discrepancy.fits.gates import LEAST_SHAPE_GAIN
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
from .linear_trials import EffectColumn, LinearTrials, TrialMotion, sum_of_columns
from .ported_trial import ported_trial, thin_trial
from .process_search import Processes
from .trial import PortedTrial, TrialColumn

SHAPE_VALUES = (-1.3, -0.4, 0.4, 1.3)
"""Standard normal values at which a parameter that is not a magnitude is tried."""
MOST_COMBINATIONS = 16
"""Largest number of combinations of parameter values at which an effect is tried."""
MAGNITUDE_VALUE = 0.5
"""Standard normal value at which a magnitude is tried. At zero, the middle of a prior with both
signs, the effect would do nothing."""


def can_estimate_forces(problem: Problem) -> bool:
    """Return whether missing forces can be estimated in a problem.

    That needs trials in motion, and a model that describes how its ports move.
    """
    model = problem.model
    has_motion = any(data.trial.is_dynamic for data in problem.trials)
    return has_motion and model.shows_ports and bool(model.ports)


def log_prior(candidate: Candidate, effect_count: int, setting: Setting) -> float:
    """Return the log prior probability of a candidate [nat].

    The prior of a set of effects is proportional to the product of their prior weights, and the
    same at all places of an effect. An effect with a free shape has the smaller prior that the
    shape test asks for.

    Parameters
    ----------
    candidate : Candidate
        The effects at their places.
    effect_count : int
        The number of effects that are compared.
    setting : Setting
        The setting of the problem, which says at which places an effect may act.
    """
    terms = candidate.terms
    if not terms:
        return log(SEARCH.prior_none)
    # The number of effects has a prior probability, which the sets of this number share by their
    # weights, and the places of each effect equally. As the mean weight is 1, the priors of single
    # effects add up to that of their number, and those of larger sets nearly do.
    log_weights = sum(log(term.effect.prior_weight) for term in terms)
    log_places = sum(log(len(term.effect.places(setting))) for term in terms)
    shape_penalty = sum(LEAST_SHAPE_GAIN for term in terms if term.free_shape)
    probability_of_length = (1.0 - SEARCH.prior_none) * SEARCH.set_probabilities[len(terms) - 1]
    set_count = comb(max(effect_count, len(terms)), len(terms))
    return log(probability_of_length / set_count) + log_weights - log_places - shape_penalty


def values_to_try(term: EffectTerm) -> list[FloatArray]:
    """Return sets of standard normal parameter values (E,) at which an effect is tried."""
    shape_indices = [
        number for number, parameter in enumerate(term.parameters) if not parameter.magnitude
    ]
    # with several such parameters, only the lowest and the highest value of each
    levels = SHAPE_VALUES if len(shape_indices) < 2 else SHAPE_VALUES[::3]
    combinations = []
    for shape_values in list(product(levels, repeat=len(shape_indices)))[:MOST_COMBINATIONS]:
        values = np.full(len(term.parameters), MAGNITUDE_VALUE)
        values[shape_indices] = shape_values
        combinations.append(values)
    return combinations


def scale_processes(
    processes: Processes, size_factor: float, time_factor: float
) -> Mapping[int, Process]:
    """Return processes with their sizes and correlation times multiplied by factors.

    Parameters
    ----------
    processes : mapping of int to Process
        The processes, by the number of the port.
    size_factor, time_factor : float
        The factors on all standard deviations and on all correlation times.
    """
    scaled_processes = {}
    for port, process in processes.items():
        scaled_processes[port] = replace(
            process,
            standard_deviation=process.standard_deviation * size_factor,
            correlation_time=process.correlation_time * time_factor,
        )
    return scaled_processes


# ---------------------------------------------------------------- force of a law along a motion

SPEED_DEVIATION_FACTOR = 10.0
"""Factor on the posterior deviation of a speed. That deviation is too small, since the process of a
missing force has no steps."""
CREEP_SHARE = 0.02
"""Share of the rms speed below which a body creeps before it slides, so that no law of the speed is
valid."""


def fill_law_force(
    law_index: int,
    of_speed: bool,
    law: FloatArray,
    positions: FloatArray,
    speeds: FloatArray,
    memory: FloatArray,
    force: FloatArray,
) -> None:
    """Fill `force` with the force of a law along a motion of its port.

    Parameters
    ----------
    law_index : int
        The index of the law's class in `LAWS`.
    of_speed : bool
        Whether the law is one of the speed, which has no memory.
    law : (R,) array
        The parameter row of the law.
    positions, speeds : (F,) array
        The motion of the port at the fine stamps [m or rad, and per s].
    memory : (M,) array
        The memory of the law, which is changed.
    force : (F,) array
        The force to fill [N or N m].
    """
    for k in range(len(positions)):
        if of_speed:
            force[k] = steady_force(law, positions[k], speeds[k])
        else:
            advance(law_index, law, memory, positions[k])
            memory[POSITION] = positions[k]
            force[k] = force_and_slope(law_index, law, memory, positions[k], 1.0)[0]


@cache
def _compiled_fill_law_force() -> Callable[..., None]:
    """Return `fill_law_force`, compiled if numba is installed."""
    return compiled(fill_law_force, law_functions())


def law_force(
    law: PortForce,
    time: FloatArray,
    position: FloatArray,
    speed: FloatArray,
    speed_deviation: float = 0.0,
    holding_force: FloatArray | float = 0.0,
) -> FloatArray:
    """Return the force (F,) of a law along a motion of its port [N or N m].

    The force is zero outside of the law's windows in time. A law of the speed with a force at rest,
    such as dry friction, holds the port while the speed is zero within its uncertainty. Its force
    is then the one that keeps the port at rest, at most as large as the law allows.

    Parameters
    ----------
    law : PortForce
        The law of the force at the port.
    time, position, speed : (F,) array
        The fine stamps [s], and the motion of the port there [m or rad, and per s].
    speed_deviation : float
        The standard deviation of the speed.
    holding_force : (F,) array or float
        The missing force at the port, which holds it at rest.
    """
    row = law.parameter_row
    force = np.zeros(len(position))
    memory = np.zeros(FIRST_ELEMENT + max(1, len(row) - PARAMETERS))
    law_class = type(law)
    _compiled_fill_law_force()(
        LAWS.index(law_class),
        law_class.depends_on_speed,
        row,
        np.ascontiguousarray(position),
        np.ascontiguousarray(speed),
        memory,
        force,
    )
    if law_class.depends_on_speed and speed_deviation > 0.0:
        slow_speed = max(
            SPEED_DEVIATION_FACTOR * speed_deviation,
            CREEP_SHARE * float(np.sqrt(np.mean(speed**2))),
        )
        # probability that a normal error of deviation `slow_speed` is smaller than the speed
        probability_of_motion = erf(np.abs(speed) / (np.sqrt(2.0) * slow_speed))
        force_at_rest = np.clip(holding_force, -np.abs(force), np.abs(force))
        force = probability_of_motion * force + (1.0 - probability_of_motion) * force_at_rest
    return force * law.acts_at(time)


# ---------------------------------------------------------------- columns


class ColumnBuilder:
    """Computes columns: the changes of trials by effects, along an estimated motion.

    Parameters
    ----------
    problem : Problem
        The campaign and the model, with the layout of their unknowns.
    trial_indices : sequence of int
        The indices, in the problem, of the trials in motion.
    model_laws : ModelPatch
        The model's own laws.
    sample_limit : int, optional
        The number of samples of all trials together to which trials are thinned, if they can be.
    """

    def __init__(
        self,
        problem: Problem,
        trial_indices: Sequence[int],
        model_laws: ModelPatch,
        sample_limit: int | None = None,
    ) -> None:
        self.problem = problem
        self.trial_indices = trial_indices
        self.model_laws = model_laws
        sample_count = sum(len(problem.trials[number].trial.time) for number in trial_indices)
        self._wanted_stride = 1.0 if sample_limit is None else sample_count / sample_limit

    def trials_about(self, point: Point) -> LinearTrials:
        """Return the trials without any effect, linear about values of the unknowns."""
        trials = []
        for number in self.trial_indices:
            trial = ported_trial(self.problem, number, point)
            trials.append(thin_trial(trial, self._wanted_stride))
        return LinearTrials(trials, self.problem.shared.precision)

    def trials_along_motions(
        self,
        linear_trials: LinearTrials,
        motions: Sequence[TrialMotion],
        constant_column: EffectColumn | None = None,
    ) -> LinearTrials:
        """Return the trials with columns along new motions, and with the model's own laws.

        Parameters
        ----------
        linear_trials : LinearTrials
            The trials in motion as one linear model.
        motions : sequence of TrialMotion
            The motion of each trial, along which parameters and the model's own laws act.
        constant_column : EffectColumn, optional
            The change of the trials by the effects of a hypothesis at zero unknowns.
        """
        model_laws_column = None
        if len(self.model_laws):
            model_laws_column = self.column_of_patch(linear_trials, motions, self.model_laws)
        return replace(
            linear_trials,
            motions=motions,
            model_laws_column=model_laws_column,
            constant_column=constant_column,
        )

    def column_of_candidate(
        self,
        linear_trials: LinearTrials,
        motions: Sequence[TrialMotion],
        candidate: Candidate,
        values: FloatArray,
    ) -> EffectColumn | None:
        """Return how all effects of a candidate together change the readings, for given motions.

        Parameters
        ----------
        linear_trials : LinearTrials
            The trials in motion as one linear model.
        motions : sequence of TrialMotion
            The motion of each trial.
        candidate : Candidate
            The effects of the hypothesis, each at its place.
        values : (E,) array
            The scaled parameters of the effects.

        Returns
        -------
        EffectColumn or None
            The sum of the changes by all effects; None if an effect cannot act with these values.
        """
        columns = []
        for term, term_values in candidate.split_by_term(values):
            try:
                patch = term.patch(self.problem.setting, term_values)
            except DiscrepancyError:
                return None
            column = self.column_of_patch(linear_trials, motions, patch, term.effect.acts_on)
            if column is None:
                return None
            columns.append(column)
        return sum_of_columns(columns, [1.0] * len(columns))

    def column_of_patch(
        self,
        linear_trials: LinearTrials,
        motions: Sequence[TrialMotion],
        patch: ModelPatch,
        acts_on: frozenset[TrialKind] = frozenset(TrialKind),
    ) -> EffectColumn | None:
        """Return how a change of the model alters each trial, along the estimated motions.

        Parameters
        ----------
        linear_trials : LinearTrials
            The trials in motion as one linear model.
        motions : sequence of TrialMotion
            The motion of each trial.
        patch : ModelPatch
            The change of the model.
        acts_on : frozenset of TrialKind
            The kinds of trials in which the patch acts; it leaves all others unchanged.

        Returns
        -------
        EffectColumn or None
            The column: the changes of readings and state in each trial. None if the patch is
            invalid, or if the changes of the readings are not finite.
        """
        trial_columns = []
        try:
            for trial, motion, trial_index in zip(
                linear_trials.trials, motions, self.trial_indices, strict=True
            ):
                patch_in_trial = patch.in_trial(trial.name)
                trial_columns.append(
                    self.column_in_trial(trial, motion, trial_index, patch_in_trial, acts_on)
                )
        except (DiscrepancyError, InvalidPatchError):
            return None
        is_finite = all(
            np.all(np.isfinite(trial_column.readings)) for trial_column in trial_columns
        )
        return trial_columns if is_finite else None

    def column_in_trial(
        self,
        trial: PortedTrial,
        motion: TrialMotion,
        trial_index: int,
        patch: ModelPatch,
        acts_on: frozenset[TrialKind],
    ) -> TrialColumn:
        """Return the change of one trial by a change of the model, along a motion.

        Parameters
        ----------
        trial : PortedTrial
            The trial as a linear system with ports.
        motion : TrialMotion
            The estimated motion of the trial, with the forces at its ports.
        trial_index : int
            The index of the trial in the problem.
        patch : ModelPatch
            The change of the model.
        acts_on : frozenset of TrialKind
            The kinds of trials that the patch changes.
        """
        kind = self.problem.trials[trial_index].trial.kind
        if kind not in acts_on or not len(patch):
            return TrialColumn(np.zeros_like(trial.residual))
        # laws act along the motion; changes of the structure and of the clock are simulated; other
        # errors of sensors act on the explained motion
        laws = patch.of(PortForce)
        if len(laws):
            return self._column_of_laws(trial, motion, laws)
        sensors = patch.of(*SENSORS)
        changes_structure = len(sensors) < len(patch)
        if changes_structure or len(sensors.of(LoggerClock)):
            return TrialColumn(self._readings_of_changed_model(trial, trial_index, patch))
        return TrialColumn(self._readings_of_sensor_errors(trial, motion, trial_index, sensors))

    def _column_of_laws(
        self, trial: PortedTrial, motion: TrialMotion, laws: ModelPatch
    ) -> TrialColumn:
        """Return the change of a trial by laws at ports, along a motion.

        Parameters
        ----------
        trial : PortedTrial
            The trial as a linear system with ports.
        motion : TrialMotion
            The estimated motion of the trial's ports.
        laws : ModelPatch
            The change of the model that consists of these laws.
        """
        added_state = np.zeros_like(motion.added_state)
        readings = np.zeros_like(trial.residual)
        # sum over all laws: the force along the motion, and what it adds to state and readings
        forces: dict[int, FloatArray] = {}
        for law in self.problem.model.forces_at_ports(laws):
            if not isinstance(law, PortForce):
                continue
            port = trial.system.ports.index(law.port)
            deviations = motion.deviations_by_port.get(port)
            force = law_force(
                law,
                trial.fine_time,
                motion.positions[:, port],
                motion.speeds[:, port],
                0.0 if deviations is None else deviations.speed,
                motion.forces.get(port, 0.0),
            )
            # response of the linear system to the force
            added_by_law = trial.state_under_force(port, force)
            added_state += added_by_law
            readings += trial.readings_of_state(added_by_law, {port: force})
            forces[port] = forces.get(port, 0.0) + force
        return TrialColumn(readings, added_state, forces)

    def _readings_of_changed_model(
        self, trial: PortedTrial, trial_index: int, patch: ModelPatch
    ) -> FloatArray:
        """Return the simulated change (N, C) of the readings by a patch, divided by the noise.

        It is the response of the patched model minus that of the model. The estimated motion is not
        used.

        Parameters
        ----------
        trial : PortedTrial
            The trial as a linear system with ports.
        trial_index : int
            The index of the trial in the problem.
        patch : ModelPatch
            The change of the model.
        """
        shared_values, local_values = self._linearisation_point(trial)
        # both responses are without the gains of the channels
        patched_response, _ = self.problem.response(trial_index, shared_values, local_values, patch)
        response, _ = self.problem.response(trial_index, shared_values, local_values, ModelPatch())
        gains = 1.0 + self.problem.shared.gains(
            shared_values, self.problem.trials[trial_index].trial.channels
        )
        return trial.divide_by_noise(((patched_response - response) * gains)[:: trial.stride])

    def _readings_of_sensor_errors(
        self, trial: PortedTrial, motion: TrialMotion, trial_index: int, sensors: ModelPatch
    ) -> FloatArray:
        """Return the change (N, C) of the readings by errors of sensors, divided by the noise.

        The sensors measure the explained motion: the response of the model and what laws add to it.
        The motion by unexplained forces is left out. As these may have any size, they would fit any
        gain of a sensor.

        Parameters
        ----------
        trial : PortedTrial
            The trial as a linear system with ports.
        motion : TrialMotion
            The estimated motion of the trial, with the forces at its ports.
        trial_index : int
            The index of the trial in the problem.
        sensors : ModelPatch
            The change of the model that consists of errors of sensors.
        """
        problem = self.problem
        data = problem.trials[trial_index]
        # a thinned trial has some of the samples of the record
        samples = slice(None, None, trial.stride)
        recorded_trial = data.trial if trial.stride == 1 else data.trial.rows(samples)
        shared_values, local_values = self._linearisation_point(trial)
        # the true values at the sensors, and their rates
        response, rates = problem.response(trial_index, shared_values, local_values, ModelPatch())
        response = response[samples]
        rates = None if rates is None else rates[samples]
        gains = 1.0 + problem.shared.gains(shared_values, data.trial.channels)
        # readings are divided by the noise and contain the gains: undo both
        explained_readings = trial.readings_of_state(motion.explained_state, motion.law_forces)
        true_values = response + explained_readings * trial.deviation / gains
        true_rates = None
        if rates is not None:
            true_rates = rates + _explained_rates(trial, motion) / gains
        # the readings of the sensors with their errors
        conditions = data.unknowns.conditions(
            data.trial, problem.shared.parameters(shared_values), local_values
        )
        observation = observe_response(
            problem.campaign, recorded_trial, sensors, conditions, Response(true_values, true_rates)
        )
        change = observation.values - true_values
        # an error of the clock shifts the readings in time: to first order by their rates
        clock_rate, clock_zero = clock_of(sensors)
        if true_rates is not None:
            clock_error = clock_rate * (trial.time - trial.time[0]) + clock_zero
            change += true_rates * clock_error[:, None]
        return trial.divide_by_noise(change * gains)

    def _linearisation_point(self, trial: PortedTrial) -> tuple[FloatArray, FloatArray]:
        """Return the shared (K,) and the local (L,) unknowns about which a trial is linear."""
        shared_count = self.problem.shared.unknown_count
        shared_values, local_values = np.split(trial.linearisation_point, [shared_count])
        return shared_values, local_values


def _explained_rates(trial: PortedTrial, motion: TrialMotion) -> FloatArray:
    """Return the rates (N, C) of the outputs by the explained state, with the gains [unit per s].

    Parameters
    ----------
    trial : PortedTrial
        The trial as a linear system with ports.
    motion : TrialMotion
        The estimated motion of the trial, with the forces at its ports.
    """
    # s' = A s - sum_p b_p force_p, see `PortedSystem`
    state_rates = motion.explained_state @ trial.system.generator.T
    for port, force in motion.law_forces.items():
        state_rates = state_rates - np.outer(force, trial.system.actions[port])
    return np.asarray((state_rates @ trial.system.outputs.T)[:: trial.substeps])
