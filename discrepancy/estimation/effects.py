"""The effects of a hypothesis along a trajectory: forces at ports and errors of sensors."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, EffectTerm, with_step
from discrepancy.missing_force.hypotheses import ColumnBuilder
from discrepancy.missing_force.linear_trials import TrialMotion
from discrepancy.missing_force.trial import PortedTrial
from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch

from .laws import LawForce, force_and_tangents
from .linearised import LinearisedForce, LinearisedSensorErrors, Trajectory

HALF_DIFFERENCE = 0.02
"""Half the difference of an unknown in a derivative by it; unknowns are standard normal."""


@dataclass(frozen=True, eq=False)
class EffectLaws:
    """The laws and sensor errors of a candidate's effects, together with the model's own laws.

    Attributes
    ----------
    column_builder : ColumnBuilder
        The object that computes the changes of readings by errors of sensors.
    trials : tuple of PortedTrial
        The dynamic trials.
    candidate : Candidate
        The effects at their places.
    evaluate_model_laws : callable
        The function that takes the shared unknowns (K,) and returns the model's own laws at ports.
    unknowns_of_model_laws : tuple of int
        The numbers of the shared unknowns that change the model's own laws.
    """

    column_builder: ColumnBuilder
    trials: tuple[PortedTrial, ...]
    candidate: Candidate
    evaluate_model_laws: Callable[[FloatArray], ModelPatch]
    unknowns_of_model_laws: tuple[int, ...]

    @property
    def effect_unknown_count(self) -> int:
        """The number E of unknowns of the effects."""
        return self.candidate.parameter_count

    def linearise_along_trajectory(
        self,
        trial_index: int,
        trajectory: Trajectory,
        effect: FloatArray,
        shared: FloatArray,
        speed_window: float,
    ) -> tuple[Mapping[int, LinearisedForce], LinearisedSensorErrors] | None:
        """Return forces at ports and changes of readings along a trajectory, and derivatives.

        Parameters
        ----------
        trial_index : int
            The index of the trial.
        trajectory : Trajectory
            The motion of the trial.
        effect : (E,) array
            The values of the effects' unknowns.
        shared : (K,) array
            The values of the shared unknowns.
        speed_window : float
            The half width of the window of speeds over which laws of the speed are averaged,
            divided by the rms speed.

        Returns
        -------
        (mapping of int to LinearisedForce, LinearisedSensorErrors) or None
            The forces by the number of the port, and the changes of the readings; None if an effect
            is not possible at these values.
        """
        try:
            forces = self._linearised_forces(trial_index, trajectory, effect, shared, speed_window)
            return forces, self._linearised_sensor_errors(trial_index, trajectory, effect)
        except (DiscrepancyError, InvalidPatchError):
            return None

    def forces_along_trajectory(
        self,
        trial_index: int,
        trajectory: Trajectory,
        effect: FloatArray,
        shared: FloatArray,
        speed_window: float,
    ) -> Mapping[int, LawForce] | None:
        """Return the forces of all laws at ports along a trajectory, not their derivatives.

        Parameters
        ----------
        trial_index : int
            The index of the trial.
        trajectory : Trajectory
            The motion of the trial.
        effect : (E,) array
            The values of the effects' unknowns.
        shared : (K,) array
            The values of the shared unknowns.
        speed_window : float
            The half width of the window of speeds over which laws of the speed are averaged,
            divided by the rms speed.

        Returns
        -------
        mapping of int to LawForce or None
            The forces by the number of the port; None if an effect is not possible at these values.
        """
        try:
            return self._checked_forces(trial_index, trajectory, effect, shared, speed_window)
        except (DiscrepancyError, InvalidPatchError):
            return None

    # ------------------------------------------------------------ laws

    def _checked_forces(
        self,
        trial_index: int,
        trajectory: Trajectory,
        effect: FloatArray,
        shared: FloatArray,
        speed_window: float,
    ) -> dict[int, LawForce]:
        """Return the forces of all laws, by port; raise an error if an effect is not possible."""
        patch = self.evaluate_model_laws(shared) + self._patch_in_trial(trial_index, effect).of(
            PortForce
        )
        return self._forces_of_patch(trial_index, trajectory, patch, speed_window)

    def _linearised_forces(
        self,
        trial_index: int,
        trajectory: Trajectory,
        effect: FloatArray,
        shared: FloatArray,
        speed_window: float,
    ) -> dict[int, LinearisedForce]:
        """Return the forces of all laws, by port, with their derivatives by unknowns.

        The parameters are those of `linearise_along_trajectory`. The derivatives are central
        differences. The K shared unknowns are numbered first, then those of the effects.
        """

        def forces_at(effect_values: FloatArray, shared_values: FloatArray) -> dict[int, LawForce]:
            return self._checked_forces(
                trial_index, trajectory, effect_values, shared_values, speed_window
            )

        forces = forces_at(effect, shared)
        derivatives: dict[int, dict[int, FloatArray]] = {port: {} for port in forces}
        for k in range(self.effect_unknown_count):
            above = forces_at(with_step(effect, k, HALF_DIFFERENCE), shared)
            below = forces_at(with_step(effect, k, -HALF_DIFFERENCE), shared)
            self._store_derivatives(derivatives, len(shared) + k, above, below)
        for k in self.unknowns_of_model_laws:
            above = forces_at(effect, with_step(shared, k, HALF_DIFFERENCE))
            below = forces_at(effect, with_step(shared, k, -HALF_DIFFERENCE))
            self._store_derivatives(derivatives, k, above, below)
        return {
            port: LinearisedForce(force_at_port, derivatives[port])
            for port, force_at_port in forces.items()
        }

    @staticmethod
    def _store_derivatives(
        derivatives: Mapping[int, dict[int, FloatArray]],
        unknown: int,
        above: Mapping[int, LawForce],
        below: Mapping[int, LawForce],
    ) -> None:
        """Store the derivatives of the forces at ports by one unknown, unless they are zero.

        Parameters
        ----------
        derivatives : mapping of int to dict of int to (F,) array
            The derivatives by port and unknown, to which those of the unknown are added.
        unknown : int
            The number of the unknown.
        above, below : mapping of int to LawForce
            The forces with the unknown `HALF_DIFFERENCE` above and below its value, by port.
        """
        for port, slopes_at_port in derivatives.items():
            if port in above and port in below:
                slope = (above[port].force - below[port].force) / (2.0 * HALF_DIFFERENCE)
                if np.any(slope):
                    slopes_at_port[unknown] = slope

    def _patch_in_trial(self, trial_index: int, effect: FloatArray) -> ModelPatch:
        """Return the change of the model by the effects (E,) in a trial, given by its index."""
        problem = self.column_builder.problem
        trial = problem.trials[self._index_in_problem(trial_index)].trial
        patch = ModelPatch()
        for term, term_values in self.candidate.split_by_term(effect):
            if trial.kind in term.effect.acts_on:
                patch = patch + term.patch(problem.setting, term_values).in_trial(trial.name)
        return patch

    def _index_in_problem(self, trial_index: int) -> int:
        """Return the index in the problem, which has static trials too, of a dynamic trial."""
        return self.column_builder.trial_indices[trial_index]

    def _forces_of_patch(
        self, trial_index: int, trajectory: Trajectory, patch: ModelPatch, speed_window: float
    ) -> dict[int, LawForce]:
        """Return the forces of a patch's laws along a trajectory, summed by the number of the port.

        Parameters
        ----------
        trial_index : int
            The index of the trial.
        trajectory : Trajectory
            The motion of the trial.
        patch : ModelPatch
            The patch; what is not a law at a port is left out.
        speed_window : float
            The half width of the window of speeds over which laws of the speed are averaged,
            divided by the rms speed.
        """
        trial = self.trials[trial_index]
        forces: dict[int, LawForce] = {}
        for law in self.column_builder.problem.model.forces_at_ports(patch):
            if not isinstance(law, PortForce):
                continue
            port = trial.system.ports.index(law.port)
            force = force_and_tangents(
                law,
                trial.fine_time,
                trajectory.positions[:, port],
                trajectory.speeds[:, port],
                speed_window,
            )
            forces[port] = force.plus(forces[port]) if port in forces else force
        return forces

    # ------------------------------------------------------------ sensors

    def _linearised_sensor_errors(
        self, trial_index: int, trajectory: Trajectory, effect: FloatArray
    ) -> LinearisedSensorErrors:
        """Return the changes of a trial's readings by errors of sensors, with their derivatives.

        Parameters
        ----------
        trial_index : int
            The index of the trial.
        trajectory : Trajectory
            The motion of the trial.
        effect : (E,) array
            The values of the effects' unknowns.
        """
        trial = self.trials[trial_index]
        setting = self.column_builder.problem.setting
        motion = motion_for_columns(trajectory)

        def change_by_effect(term: EffectTerm, values: FloatArray) -> FloatArray:
            return self._readings_change_by_effect(trial_index, motion, term, values)

        change = np.zeros_like(trial.residual)
        derivatives: dict[int, FloatArray] = {}
        # the unknowns of effects follow the shared ones
        first_unknown = len(trial.shared_derivatives)
        for term, values in self.candidate.split_by_term(effect):
            has_law = bool(len(term.patch(setting, values).of(PortForce)))
            # an effect without a law at a port changes readings only
            if not has_law:
                change = change + change_by_effect(term, values)
                for k in range(len(values)):
                    above = change_by_effect(term, with_step(values, k, HALF_DIFFERENCE))
                    below = change_by_effect(term, with_step(values, k, -HALF_DIFFERENCE))
                    derivatives[first_unknown + k] = (above - below) / (2.0 * HALF_DIFFERENCE)
            first_unknown += len(values)
        return LinearisedSensorErrors(change, derivatives)

    def _readings_change_by_effect(
        self, trial_index: int, motion: TrialMotion, term: EffectTerm, values: FloatArray
    ) -> FloatArray:
        """Return the change (N, C) of a trial's readings by one effect, divided by the noise.

        Parameters
        ----------
        trial_index : int
            The index of the trial.
        motion : TrialMotion
            The motion that the sensors measure.
        term : EffectTerm
            The effect.
        values : array
            The values of its unknowns.
        """
        patch = term.patch(self.column_builder.problem.setting, values)
        column = self.column_builder.column_in_trial(
            self.trials[trial_index],
            motion,
            self._index_in_problem(trial_index),
            patch,
            term.effect.acts_on,
        )
        return column.readings


def motion_for_columns(trajectory: Trajectory) -> TrialMotion:
    """Return a trajectory in the form in which `ColumnBuilder` takes the motion of a trial.

    All that laws and missing forces add counts as explained: it is part of the trajectory, so that
    sensors measure it.
    """
    return TrialMotion(
        added_state=trajectory.added_state,
        forces=trajectory.forces,
        unexplained_forces={},
        explained_state=trajectory.added_state,
        positions=trajectory.positions,
        speeds=trajectory.speeds,
        deviations_by_port={},
    )
