"""Changes of readings due to errors of sensors and changed models, which are no port forces."""

from dataclasses import dataclass

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.problem import Problem
from discrepancy.system.response import Response
from discrepancy.system.sensing import observe_response
from fe.runtime.patch import SENSORS, LoggerClock, ModelPatch
from fe.runtime.sensors import clock_of

from .trajectory import Trajectory
from .trial import PortedTrial
from .trial_at_rest import LinearTrial


@dataclass(frozen=True, eq=False)
class ReadingChanges:
    """Computes the changes of readings caused by effects that are no forces at ports.

    Attributes
    ----------
    problem : Problem
        The campaign and the model, with the layout of their unknowns.
    """

    problem: Problem

    def change(
        self,
        trial: LinearTrial,
        trajectory: Trajectory,
        trial_index: int,
        patch: ModelPatch,
    ) -> FloatArray:
        """Return the change (N, C) of a trial's readings due to a patch, divided by the noise.

        Changes of the structure and of the clock are simulated; other errors of sensors act on the
        motion that they measure.

        Parameters
        ----------
        trial : PortedTrial or TrialAtRest
            The linear trial with ports.
        trajectory : Trajectory
            The motion that the sensors measure, with the forces at ports.
        trial_index : int
            The index of the trial in the problem.
        patch : ModelPatch
            The change of the model, without forces at ports.
        """
        if not len(patch):
            return np.zeros_like(trial.residual)
        sensors = patch.of(*SENSORS)
        changes_structure = len(sensors) < len(patch)
        if changes_structure or len(sensors.of(LoggerClock)):
            return self._readings_of_changed_model(trial, trial_index, patch)
        return self._readings_of_sensor_errors(trial, trajectory, trial_index, sensors)

    def _readings_of_changed_model(
        self, trial: LinearTrial, trial_index: int, patch: ModelPatch
    ) -> FloatArray:
        """Return the simulated change (N, C) of the readings due to a patch, divided by the noise.

        It is the response of the patched model minus that of the model. The estimated motion is not
        used.
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
        self,
        trial: LinearTrial,
        trajectory: Trajectory,
        trial_index: int,
        sensors: ModelPatch,
    ) -> FloatArray:
        """Return the change (N, C) of the readings by errors of sensors, divided by the noise.

        The errors act on the true values at the sensors: the model's response plus what the forces
        at ports add to it.
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
        added_readings = trial.readings_of_state(trajectory.added_state, trajectory.forces)
        true_values = response + added_readings * trial.deviation / gains
        true_rates = None
        if rates is not None and isinstance(trial, PortedTrial):
            true_rates = rates + _added_rates(trial, trajectory) / gains
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

    def _linearisation_point(self, trial: LinearTrial) -> tuple[FloatArray, FloatArray]:
        """Return the shared (K,) and the local (L,) unknowns about which a trial is linear."""
        shared_count = self.problem.shared.unknown_count
        shared_values, local_values = np.split(trial.linearisation_point, [shared_count])
        return shared_values, local_values


def _added_rates(trial: PortedTrial, trajectory: Trajectory) -> FloatArray:
    """Return the rates (N, C) of the outputs by the added state, with the gains [unit per s]."""
    # s' = A s - sum_p b_p force_p, see `PortedSystem`
    state_rates = trajectory.added_state @ trial.system.generator.T
    for port, force in trajectory.forces.items():
        state_rates = state_rates - np.outer(force, trial.system.actions[port])
    return np.asarray((state_rates @ trial.system.outputs.T)[:: trial.substeps])
