"""The effects of a hypothesis along a trajectory: forces at ports and errors of sensors."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError, ModelError
from discrepancy.fits.candidate import Candidate, EffectTerm, Point, with_step
from discrepancy.fits.problem import Problem
from discrepancy.system.interface import NO_PATCH
from fe.runtime.errors import InvalidPatchError, SolutionError
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch, Primitive
from reporting.arrays import LEAST_DIVISOR

from .laws import LawForce, force_and_tangents, holds_at_rest
from .sensor_errors import ReadingChanges
from .simulated import motion_under_laws
from .trajectory import LawArguments, LinearisedForce, LinearisedSensorErrors, Trajectory
from .trial_at_rest import LinearTrial, TrialAtRest

HALF_DIFFERENCE = 0.02
"""Half the difference of an unknown in a derivative by it; unknowns are standard normal."""
MOST_KEPT_PATCHES = 128
"""Patches that are kept of a hypothesis: those of several linearisations."""


@dataclass(frozen=True, eq=False)
class EffectLaws:
    """The laws and sensor errors of a candidate's effects, together with the model's own laws.

    Attributes
    ----------
    problem : Problem
        The campaign and the model without its own laws, with the layout of their unknowns.
    trials : tuple of PortedTrial or TrialAtRest
        The trials, linear, with ports.
    trial_indices : sequence of int
        The indices of these trials in the problem.
    candidate : Candidate
        The effects at their places.
    evaluate_model_laws : callable
        The function that takes the shared unknowns (K,) and returns the model's own laws at ports.
    unknowns_of_model_laws : tuple of int
        The numbers of the shared unknowns that change the model's own laws.
    """

    problem: Problem
    trials: tuple[LinearTrial, ...]
    trial_indices: Sequence[int]
    candidate: Candidate
    evaluate_model_laws: Callable[[FloatArray], ModelPatch]
    unknowns_of_model_laws: tuple[int, ...]

    @cached_property
    def hold_at_rest(self) -> bool:
        """Whether a law of the hypothesis may hold a body at rest, as dry friction does.

        The exponent of a law of the speed with a free shape may become that of dry friction.
        """
        for term in self.candidate.terms:
            for law in term.patch(self.problem.setting, term.start_values()):
                if not isinstance(law, PortForce) or not type(law).depends_on_speed:
                    continue
                if term.free_shape or holds_at_rest(law):
                    return True
        return False

    def linearise_along_trajectory(
        self, arguments: LawArguments
    ) -> tuple[Mapping[int, LinearisedForce], LinearisedSensorErrors] | None:
        """Return forces at ports and changes of readings along a trajectory, and derivatives.

        The forces are those of all laws, by the index of the port. The result is None if an effect
        is not possible at these values.
        """
        try:
            forces = self._linearised_forces(arguments)
            return forces, self._linearised_sensor_errors(arguments, forces)
        except (DiscrepancyError, InvalidPatchError):
            return None

    def forces_along_trajectory(self, arguments: LawArguments) -> Mapping[int, LawForce] | None:
        """Return the forces of all laws along a trajectory, by the index of the port.

        The result is None if an effect is not possible at these values.
        """
        try:
            return self._forces_of_patch(arguments, self._patch_of_all_laws(arguments))
        except (DiscrepancyError, InvalidPatchError):
            return None

    def motion_under_laws(
        self, arguments: LawArguments, local_values: FloatArray
    ) -> Trajectory | None:
        """Return the motion of a trial under all laws, without missing forces.

        The trajectory of the arguments begins in the same state. `local_values` (L,) are the
        unknowns of the trial alone. The result is None if an effect is not possible at these
        values.
        """
        try:
            laws = self._laws_in_patch(self._patch_of_all_laws(arguments))
        except (DiscrepancyError, InvalidPatchError):
            return None
        trial = self.trials[arguments.trial_index]
        if isinstance(trial, TrialAtRest):
            try:
                return trial.trajectory_under_laws(
                    laws, np.concatenate((arguments.shared, local_values))
                )
            except (SolutionError, InvalidPatchError):
                return None
        # The smoothed steps of friction are half as wide as in the linearised laws, so that a body
        # at rest in this motion lies well within the window of the linearised laws.
        rms_speeds = np.sqrt(np.mean(arguments.trajectory.speeds**2, axis=0))
        return motion_under_laws(
            trial,
            laws,
            arguments.shared,
            local_values,
            start=arguments.trajectory.added_state[0],
            least_half_widths=0.5 * arguments.speed_window * np.maximum(rms_speeds, LEAST_DIVISOR),
        )

    def residual_of_simulation(
        self, arguments: LawArguments, local_values: FloatArray
    ) -> FloatArray | None:
        """Return the residuals (N, C) of a trial that is simulated under all laws.

        They are the readings minus the prediction, divided by the noise; `local_values` (L,) are
        the unknowns of the trial alone. The result is None if an effect is not possible at these
        values.
        """
        trial = self.trials[arguments.trial_index]
        trial_index = self.trial_indices[arguments.trial_index]
        all_local_values = [np.zeros(0)] * len(self.problem.trials)
        all_local_values[trial_index] = local_values
        unknowns = Point(arguments.shared, tuple(all_local_values), arguments.effect)
        try:
            patch = self.evaluate_model_laws(arguments.shared)
            patch = patch + self._patch_in_trial(arguments.trial_index, arguments.effect)
            response, _ = self.problem.response(trial_index, arguments.shared, local_values, patch)
        except (DiscrepancyError, InvalidPatchError):
            return None
        prediction = self.problem.prediction(trial_index, unknowns, response)
        readings = self.problem.trials[trial_index].trial.values
        return np.asarray((readings - prediction) / trial.deviation)[:: trial.stride]

    # ------------------------------------------------------------ laws

    def effect_forces_along_trajectory(self, arguments: LawArguments) -> dict[int, LawForce]:
        """Return the forces of the effects' laws alone along a trajectory, by port.

        Raises
        ------
        DiscrepancyError, InvalidPatchError
            If an effect is not possible at these values.
        """
        patch = self._patch_in_trial(arguments.trial_index, arguments.effect)
        return self._forces_of_patch(arguments, patch)

    def _patch_of_all_laws(self, arguments: LawArguments) -> ModelPatch:
        """Return the laws of the model and of the effects; raise an error if one is impossible."""
        laws_of_model = self.evaluate_model_laws(arguments.shared)
        changes = self._patch_in_trial(arguments.trial_index, arguments.effect)
        return laws_of_model + changes.of(PortForce)

    def _linearised_forces(self, arguments: LawArguments) -> dict[int, LinearisedForce]:
        """Return the forces of all laws at each port, with their derivatives.

        The derivatives are those with respect to the unknowns: first the K shared ones, then those
        of the effects. For each, only the laws that it changes are evaluated: those of the model or
        of one effect.
        """
        forces = self._forces_of_patch(arguments, self.evaluate_model_laws(arguments.shared))
        by_model = {port: force.force for port, force in forces.items()}
        derivatives: dict[int, dict[int, FloatArray]] = defaultdict(dict)
        for unknown in self.unknowns_of_model_laws:
            slopes = self._slopes(arguments, self.evaluate_model_laws, arguments.shared, unknown)
            for port, slope in slopes.items():
                derivatives[port][unknown] = slope

        first_unknown = len(arguments.shared)
        for index, (term, values) in enumerate(self.candidate.split_by_term(arguments.effect)):
            laws_of_term = partial(self._patch_of_term_in_trial, arguments.trial_index, index)
            forces_of_term = self._forces_of_patch(arguments, laws_of_term(values))
            for port, force in forces_of_term.items():
                forces[port] = force.plus(forces[port]) if port in forces else force
            if forces_of_term:  # else it changes readings, see `_linearised_sensor_errors`
                # a force of free shape is linear in its amplitudes
                forces_below = forces_of_term if term.effect.table is not None else None
                for value_index in range(len(values)):
                    slopes = self._slopes(
                        arguments, laws_of_term, values, value_index, forces_below
                    )
                    for port, slope in slopes.items():
                        derivatives[port][first_unknown + value_index] = slope
            first_unknown += len(values)
        return {
            port: LinearisedForce(force, derivatives[port], by_model.get(port, 0.0))
            for port, force in forces.items()
        }

    def _slopes(
        self,
        arguments: LawArguments,
        laws_at: Callable[[FloatArray], ModelPatch],
        values: FloatArray,
        unknown: int,
        forces_below: Mapping[int, LawForce] | None = None,
    ) -> dict[int, FloatArray]:
        """Return the derivative (F,) of the force at each port by one unknown, where not zero.

        Parameters
        ----------
        arguments : LawArguments
            The trial and its motion.
        laws_at : callable
            Returns the laws for given values of some unknowns.
        values : array
            The present values of these unknowns.
        unknown : int
            The index of the one unknown among them.
        forces_below : mapping of int to LawForce, optional
            The forces at the present values. If given, the derivative is a one-sided difference,
            which is exact if the forces are linear in the unknown; else it is a central one.
        """
        difference = HALF_DIFFERENCE
        if forces_below is None:
            below = laws_at(with_step(values, unknown, -HALF_DIFFERENCE))
            forces_below, difference = self._forces_of_patch(arguments, below), 2.0 * difference
        above = laws_at(with_step(values, unknown, HALF_DIFFERENCE))
        forces_above = self._forces_of_patch(arguments, above)
        slopes = {}
        for port in forces_above.keys() & forces_below.keys():
            rise = forces_above[port].force - forces_below[port].force
            if np.any(rise):
                slopes[port] = rise / difference
        return slopes

    def _patch_in_trial(self, trial_index: int, effect_values: FloatArray) -> ModelPatch:
        """Return the change of the model by the effects (E,) in a trial, given by its index."""
        primitives: list[Primitive] = []
        for index, (_, values) in enumerate(self.candidate.split_by_term(effect_values)):
            primitives += self._patch_of_term_in_trial(trial_index, index, values)
        return ModelPatch(tuple(primitives))

    def _patch_of_term_in_trial(
        self, trial_index: int, index: int, values: FloatArray
    ) -> ModelPatch:
        """Return the change of the model by one effect in a trial, given the indices of both."""
        trial = self.problem.trials[self.trial_indices[trial_index]].trial
        if trial.kind not in self.candidate.terms[index].effect.acts_on:
            return NO_PATCH
        return self._patch_of_term(index, values).in_trial(trial.name)

    def _patch_of_term(self, index: int, values: FloatArray) -> ModelPatch:
        """Return the change of the model by one effect, given its index and its unknowns."""
        return self._kept_patches(index, values.tobytes())

    @cached_property
    def _kept_patches(self) -> Callable[[int, bytes], ModelPatch]:
        """A function that returns the patch of an effect by its index and its unknowns as bytes.

        The last patches are kept: all trials have the same effects, and a derivative by one unknown
        leaves the other effects as they are. Building a patch takes as long as evaluating its law
        along a trial.
        """
        terms = self.candidate.terms
        setting = self.problem.setting

        @lru_cache(maxsize=MOST_KEPT_PATCHES)
        def patch_of_term(index: int, values: bytes) -> ModelPatch:
            return terms[index].patch(setting, np.frombuffer(values))

        return patch_of_term

    def _forces_of_patch(self, arguments: LawArguments, patch: ModelPatch) -> dict[int, LawForce]:
        """Return the forces of a patch's laws along a trajectory, by the index of the port.

        The forces of several laws at one port are added.
        """
        trial = self.trials[arguments.trial_index]
        forces: dict[int, LawForce] = {}
        for law in self._laws_in_patch(patch):
            if trial.is_at_rest and type(law).depends_on_speed:
                continue  # a law of the speed has no force at rest
            if trial.is_at_rest and law.windows:
                raise ModelError(
                    f"The trial {trial.name!r} has no time, which a law in time asks for."
                )
            port_number = trial.ports.index(law.port)
            force = force_and_tangents(
                law,
                trial.fine_time,
                arguments.trajectory.port_motions[port_number],
                arguments.speed_window,
            )
            if port_number in forces:
                force = force.plus(forces[port_number])
            forces[port_number] = force
        return forces

    def _laws_in_patch(self, patch: ModelPatch) -> list[PortForce]:
        """Return the laws of a patch at ports; other changes, as of stiffness, are left out."""
        laws = self.problem.model.forces_at_ports(patch)
        return [law for law in laws if isinstance(law, PortForce)]

    # ------------------------------------------------------------ sensors

    def _linearised_sensor_errors(
        self, arguments: LawArguments, linearised_forces: Mapping[int, LinearisedForce]
    ) -> LinearisedSensorErrors:
        """Return the change of a trial's readings due to errors of sensors, and its derivatives.

        The derivatives are those with respect to the unknowns.

        `linearised_forces` are the forces of all laws, by the index of the port.
        """
        trial = self.trials[arguments.trial_index]
        change = np.zeros_like(trial.residual)
        derivatives: dict[int, FloatArray] = {}
        terms = self.candidate.split_by_term(arguments.effect)
        # an effect without a law at a port changes readings only
        is_error = [
            not len(self._patch_of_term(index, values).of(PortForce))
            for index, (_, values) in enumerate(terms)
        ]
        if not any(is_error):
            return LinearisedSensorErrors(change, derivatives)
        forces = {port: force.law_force.force for port, force in linearised_forces.items()}
        # Errors of sensors act on the motion by the model and the forces of all laws. That by
        # missing forces is left out: it is estimated from the readings, so that its product with an
        # error would explain them by themselves.
        explained = trial.trajectory_under(forces)

        def change_by_effect(term: EffectTerm, values: FloatArray) -> FloatArray:
            return self.readings_change(arguments.trial_index, explained, term, values)

        # the unknowns of effects follow the shared ones
        first_unknown = len(trial.shared_derivatives)
        for (term, values), changes_readings in zip(terms, is_error, strict=True):
            if changes_readings:
                change = change + change_by_effect(term, values)
                for k in range(len(values)):
                    change_above = change_by_effect(term, with_step(values, k, HALF_DIFFERENCE))
                    change_below = change_by_effect(term, with_step(values, k, -HALF_DIFFERENCE))
                    derivatives[first_unknown + k] = (change_above - change_below) / (
                        2.0 * HALF_DIFFERENCE
                    )
            first_unknown += len(values)
        return LinearisedSensorErrors(change, derivatives)

    def readings_change(
        self, trial_index: int, trajectory: Trajectory, term: EffectTerm, values: FloatArray
    ) -> FloatArray:
        """Return the change (N, C) of a trial's readings due to an effect that is no port force.

        Such an effect is an error of a sensor or of a clock, for example. The change is divided by
        the noise. It is zero if the effect does not act in trials of this kind.

        Parameters
        ----------
        trial_index : int
            The index of the trial in `trials`.
        trajectory : Trajectory
            The motion that the sensors measure.
        term : EffectTerm
            The effect at its place.
        values : array
            The values of its unknowns.
        """
        trial = self.trials[trial_index]
        index_in_problem = self.trial_indices[trial_index]
        if self.problem.trials[index_in_problem].trial.kind not in term.effect.acts_on:
            return np.zeros_like(trial.residual)
        patch = term.patch(self.problem.setting, values).in_trial(trial.name)
        if len(patch.of(PortForce)):  # a law of the speed in a trial at rest
            return np.zeros_like(trial.residual)
        return ReadingChanges(self.problem).change(trial, trajectory, index_in_problem, patch)
