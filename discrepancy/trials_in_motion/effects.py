"""The effects of a hypothesis along a trajectory: forces at ports and errors of sensors."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, EffectTerm, Point, with_step
from discrepancy.fits.problem import Problem
from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch, Primitive
from reporting.arrays import LEAST_DIVISOR

from .laws import LawForce, force_and_tangents, holds_at_rest
from .sensor_errors import ReadingChanges
from .simulated import motion_under_laws
from .trajectory import LawArguments, LinearisedForce, LinearisedSensorErrors, Trajectory
from .trial import PortedTrial

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
    trials : tuple of PortedTrial
        The dynamic trials as linear systems with ports.
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
    trials: tuple[PortedTrial, ...]
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

        See `HypothesisLaws.linearise_along_trajectory`.
        """
        try:
            return self._linearised_forces(arguments), self._linearised_sensor_errors(arguments)
        except (DiscrepancyError, InvalidPatchError):
            return None

    def forces_along_trajectory(self, arguments: LawArguments) -> Mapping[int, LawForce] | None:
        """Return the forces of all laws at ports along a trajectory, not their derivatives.

        See `HypothesisLaws.forces_along_trajectory`.
        """
        try:
            return self._checked_forces(arguments)
        except (DiscrepancyError, InvalidPatchError):
            return None

    def motion_under_laws(
        self, arguments: LawArguments, local_values: FloatArray
    ) -> Trajectory | None:
        """Return the motion of a trial under all laws, without missing forces.

        See `HypothesisLaws.motion_under_laws`.
        """
        try:
            laws = self._laws_in_patch(self._patch_of_all_laws(arguments))
        except (DiscrepancyError, InvalidPatchError):
            return None
        # Windows are half as wide as those of the linear laws: there, a body that is held at rest
        # is then well within the window.
        rms_speeds = np.sqrt(np.mean(arguments.trajectory.speeds**2, axis=0))
        return motion_under_laws(
            self.trials[arguments.trial_index],
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

        See `HypothesisLaws.residual_of_simulation`.
        """
        trial = self.trials[arguments.trial_index]
        trial_index = self.trial_indices[arguments.trial_index]
        all_local_values = [np.zeros(0)] * len(self.problem.trials)
        all_local_values[trial_index] = local_values
        point = Point(arguments.shared, tuple(all_local_values), arguments.effect)
        try:
            patch = self.evaluate_model_laws(arguments.shared)
            patch = patch + self._patch_in_trial(arguments.trial_index, arguments.effect)
            response, _ = self.problem.response(trial_index, arguments.shared, local_values, patch)
        except (DiscrepancyError, InvalidPatchError):
            return None
        prediction = self.problem.prediction(trial_index, point, response)
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

    def model_forces_along_trajectory(self, arguments: LawArguments) -> dict[int, FloatArray]:
        """Return the forces (F,) of the model's own laws along a trajectory, by port."""
        model_laws = self.evaluate_model_laws(arguments.shared)
        forces = self._forces_of_patch(arguments, model_laws)
        return {port: force_at_port.force for port, force_at_port in forces.items()}

    def _checked_forces(self, arguments: LawArguments) -> dict[int, LawForce]:
        """Return the forces of all laws, by port; raise an error if an effect is not possible."""
        return self._forces_of_patch(arguments, self._patch_of_all_laws(arguments))

    def _patch_of_all_laws(self, arguments: LawArguments) -> ModelPatch:
        """Return the laws of the model and of the effects; raise an error if one is impossible."""
        laws_of_model = self.evaluate_model_laws(arguments.shared)
        changes = self._patch_in_trial(arguments.trial_index, arguments.effect)
        return laws_of_model + changes.of(PortForce)

    def _linearised_forces(self, arguments: LawArguments) -> dict[int, LinearisedForce]:
        """Return the forces of all laws, by port, with their derivatives by unknowns.

        The derivatives are central differences, but for a force of free shape, which is linear in
        its amplitudes. The K shared unknowns are numbered first, then those of the effects.
        """
        forces = self._checked_forces(arguments)
        derivatives: dict[int, dict[int, FloatArray]] = {port: {} for port in forces}

        effect_values, shared_values = arguments.effect, arguments.shared
        is_linear = np.repeat(
            [term.effect.table is not None for term in self.candidate.terms],
            [len(term.parameters) for term in self.candidate.terms],
        )
        for k in range(self.candidate.parameter_count):
            above = replace(arguments, effect=with_step(effect_values, k, HALF_DIFFERENCE))
            forces_below, difference = forces, HALF_DIFFERENCE
            if not is_linear[k]:
                below = replace(arguments, effect=with_step(effect_values, k, -HALF_DIFFERENCE))
                forces_below, difference = self._checked_forces(below), 2.0 * HALF_DIFFERENCE
            slopes = _slopes(self._checked_forces(above), forces_below, difference)
            for port, slope in slopes.items():
                derivatives[port][len(shared_values) + k] = slope
        for k in self.unknowns_of_model_laws:
            above = replace(arguments, shared=with_step(shared_values, k, HALF_DIFFERENCE))
            below = replace(arguments, shared=with_step(shared_values, k, -HALF_DIFFERENCE))
            slopes = _slopes(
                self._checked_forces(above), self._checked_forces(below), 2.0 * HALF_DIFFERENCE
            )
            for port, slope in slopes.items():
                derivatives[port][k] = slope
        return {
            port: LinearisedForce(force_at_port, derivatives[port])
            for port, force_at_port in forces.items()
        }

    def _patch_in_trial(self, trial_index: int, effect: FloatArray) -> ModelPatch:
        """Return the change of the model by the effects (E,) in a trial, given by its index."""
        trial = self.problem.trials[self.trial_indices[trial_index]].trial
        primitives: list[Primitive] = []
        for index, (term, term_values) in enumerate(self.candidate.split_by_term(effect)):
            if trial.kind in term.effect.acts_on:
                primitives += self._patch_of_term(index, term_values).in_trial(trial.name)
        return ModelPatch(tuple(primitives))

    def _patch_of_term(self, index: int, values: FloatArray) -> ModelPatch:
        """Return the change of the model by one effect, given its index and its unknowns."""
        return self._kept_patches(index, values.tobytes())

    @cached_property
    def _kept_patches(self) -> Callable[[int, bytes], ModelPatch]:
        """The change of the model by one effect, given its index and the bytes of its unknowns.

        It is kept, because all trials have the same effects, and a derivative by one unknown leaves
        the other effects as they are. To build it costs as much as to evaluate its law along a
        trial.
        """
        terms = self.candidate.terms
        setting = self.problem.setting

        @lru_cache(maxsize=MOST_KEPT_PATCHES)
        def patch_of_term(index: int, values: bytes) -> ModelPatch:
            return terms[index].patch(setting, np.frombuffer(values))

        return patch_of_term

    def _forces_of_patch(self, arguments: LawArguments, patch: ModelPatch) -> dict[int, LawForce]:
        """Return the forces of a patch's laws along a trajectory, by the number of the port.

        The forces of several laws at one port are added.
        """
        trial = self.trials[arguments.trial_index]
        trajectory = arguments.trajectory
        forces: dict[int, LawForce] = {}
        for law in self._laws_in_patch(patch):
            port_number = trial.system.ports.index(law.port)
            force = force_and_tangents(
                law,
                trial.fine_time,
                trajectory.positions[:, port_number],
                trajectory.speeds[:, port_number],
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

    def _linearised_sensor_errors(self, arguments: LawArguments) -> LinearisedSensorErrors:
        """Return the changes of a trial's readings by errors of sensors, with their derivatives."""
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
        explained = self._explained_trajectory(arguments)

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

    def _explained_trajectory(self, arguments: LawArguments) -> Trajectory:
        """Return the motion of a trial by the model and the laws, which errors of sensors act on.

        The motion by missing forces is left out. It is estimated from the readings, so that its
        product with an error would explain them by themselves.
        """
        trial = self.trials[arguments.trial_index]
        forces = {port: force.force for port, force in self._checked_forces(arguments).items()}
        added_state = np.zeros_like(arguments.trajectory.added_state)
        for port, force in forces.items():
            added_state += trial.state_under_force(port, force)
        return Trajectory(
            added_state,
            positions=trial.port_positions + added_state @ trial.system.positions.T,
            speeds=trial.port_speeds + added_state @ trial.system.speeds.T,
            forces=forces,
        )

    def readings_change(
        self, trial_index: int, trajectory: Trajectory, term: EffectTerm, values: FloatArray
    ) -> FloatArray:
        """Return the change (N, C) of a trial's readings by an effect that is no force at a port.

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
        return ReadingChanges(self.problem).change(trial, trajectory, index_in_problem, patch)


def _slopes(
    forces_above: Mapping[int, LawForce], forces_below: Mapping[int, LawForce], difference: float
) -> dict[int, FloatArray]:
    """Return the slopes (F,) of the forces at ports over a difference of an unknown, if not zero.

    Parameters
    ----------
    forces_above, forces_below : mapping of int to LawForce
        The forces by port at a larger and at a smaller value of the unknown.
    difference : float
        The difference of the two values.
    """
    slopes = {}
    for port in forces_above.keys() & forces_below.keys():
        rise = forces_above[port].force - forces_below[port].force
        if np.any(rise):
            slopes[port] = rise / difference
    return slopes
