"""The effects of a hypothesis as forces at ports and errors of sensors along a trajectory."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.candidate import Candidate, EffectTerm, with_step
from discrepancy.missing_force.hypotheses import ColumnBuilder
from discrepancy.missing_force.trial import SeenTrial
from discrepancy.missing_force.view import TrialMotion
from fe.runtime.errors import InvalidPatchError
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch

from .laws import ForceAlong, force_along
from .linearised import Forces, SensorReadings, Trajectory

STEP = 0.02
"""Half the difference of a standard normal unknown in derivatives by it."""


@dataclass(frozen=True, eq=False)
class EffectLaws:
    """The laws and sensor errors of a candidate's effects, together with the model's own laws.

    Attributes
    ----------
    columns : ColumnBuilder
        The builder of the changes of readings by errors of sensors.
    trials : tuple of SeenTrial
        The dynamic trials.
    candidate : Candidate
        The effects at their places.
    own_laws : callable
        The function that takes shared unknowns (K,), and returns the model's own laws.
    adjustable : tuple of int
        The numbers of the shared unknowns that change the model's own laws.
    """

    columns: ColumnBuilder
    trials: tuple[SeenTrial, ...]
    candidate: Candidate
    own_laws: Callable[[FloatArray], ModelPatch]
    adjustable: tuple[int, ...]

    @property
    def size(self) -> int:
        """The number E of unknowns of the effects."""
        return self.candidate.size

    def along(
        self,
        number: int,
        trajectory: Trajectory,
        effect: FloatArray,
        shared: FloatArray,
        smoothing: float,
    ) -> tuple[Mapping[int, Forces], SensorReadings] | None:
        """Return forces at ports and changes of readings along a trajectory, and derivatives.

        Parameters
        ----------
        number : int
            The index of the trial.
        trajectory : Trajectory
            The motion of the trial.
        effect : (E,) array
            The values of the effects' unknowns.
        shared : (K,) array
            The values of the shared unknowns.
        smoothing : float
            Half the window of speeds over which laws of the speed are averaged, over the rms speed.

        Returns
        -------
        (mapping of int to Forces, SensorReadings) or None
            The forces by the number of the port, and the changes of the readings; None if an effect
            is not possible at these values.
        """
        try:
            forces = self._forces(number, trajectory, effect, shared, smoothing)
            return forces, self._readings(number, trajectory, effect)
        except (DiscrepancyError, InvalidPatchError):
            return None

    def forces(
        self,
        number: int,
        trajectory: Trajectory,
        effect: FloatArray,
        shared: FloatArray,
        smoothing: float,
    ) -> Mapping[int, ForceAlong] | None:
        """Return the forces of all laws at ports along a trajectory, not their derivatives.

        Parameters
        ----------
        number : int
            The index of the trial.
        trajectory : Trajectory
            The motion of the trial.
        effect : (E,) array
            The values of the effects' unknowns.
        shared : (K,) array
            The values of the shared unknowns.
        smoothing : float
            Half the window of speeds over which laws of the speed are averaged, over the rms speed.

        Returns
        -------
        mapping of int to ForceAlong or None
            The forces by the number of the port; None if an effect is not possible at these values.
        """
        try:
            return self._forces_at(number, trajectory, effect, shared, smoothing)
        except (DiscrepancyError, InvalidPatchError):
            return None

    # ------------------------------------------------------------ laws

    def _forces_at(
        self,
        number: int,
        trajectory: Trajectory,
        effect: FloatArray,
        shared: FloatArray,
        smoothing: float,
    ) -> dict[int, ForceAlong]:
        """Return the forces of all laws as `forces` does, but raise if one is not possible."""
        patch = self.own_laws(shared) + self._patch(number, effect).of(PortForce)
        return self._along(number, trajectory, patch, smoothing)

    def _forces(
        self,
        number: int,
        trajectory: Trajectory,
        effect: FloatArray,
        shared: FloatArray,
        smoothing: float,
    ) -> dict[int, Forces]:
        """Return the forces of all laws, by port, with their central differences by unknowns.

        The parameters are those of `along`. Unknowns are numbered with the K shared ones first,
        then those of the effects.
        """

        def at(values: FloatArray, parameters: FloatArray) -> dict[int, ForceAlong]:
            return self._forces_at(number, trajectory, values, parameters, smoothing)

        forces = at(effect, shared)
        slopes_by_port: dict[int, dict[int, FloatArray]] = {port: {} for port in forces}
        for k in range(self.size):
            above, below = (
                at(with_step(effect, k, STEP), shared),
                at(with_step(effect, k, -STEP), shared),
            )
            self._take_slopes(slopes_by_port, len(shared) + k, above, below)
        for k in self.adjustable:
            above, below = (
                at(effect, with_step(shared, k, STEP)),
                at(effect, with_step(shared, k, -STEP)),
            )
            self._take_slopes(slopes_by_port, k, above, below)
        return {
            port: Forces(force_at_port, slopes_by_port[port])
            for port, force_at_port in forces.items()
        }

    @staticmethod
    def _take_slopes(
        slopes: Mapping[int, dict[int, FloatArray]],
        unknown: int,
        above: Mapping[int, ForceAlong],
        below: Mapping[int, ForceAlong],
    ) -> None:
        """Store the derivatives of forces by an unknown in `slopes`, unless they are zero.

        Parameters
        ----------
        slopes : mapping of int to dict of int to (F,) array
            The derivatives by port and unknown, which are extended.
        unknown : int
            The number of the unknown.
        above, below : mapping of int to ForceAlong
            The forces with the unknown `STEP` above and below its value, by port.
        """
        for port, slopes_at_port in slopes.items():
            if port in above and port in below:
                slope = (above[port].force - below[port].force) / (2.0 * STEP)
                if np.any(slope):
                    slopes_at_port[unknown] = slope

    def _patch(self, number: int, effect: FloatArray) -> ModelPatch:
        """Return the change of the model by the effects (E,) in a trial, given by its index."""
        trial = self.columns.problem.trials[self.columns.numbers[number]].trial
        patch = ModelPatch()
        for term, term_values in self.candidate.split(effect):
            if trial.kind in term.effect.acts_on:
                patch = patch + term.patch(self.columns.problem.setting, term_values).in_trial(
                    trial.name
                )
        return patch

    def _along(
        self, number: int, trajectory: Trajectory, patch: ModelPatch, smoothing: float
    ) -> dict[int, ForceAlong]:
        """Return the forces of a patch's laws along a trajectory, summed by the number of the port.

        Parameters
        ----------
        number : int
            The index of the trial.
        trajectory : Trajectory
            The motion of the trial.
        patch : ModelPatch
            The patch; what is not a law at a port is left out.
        smoothing : float
            Half the window of speeds over which laws of the speed are averaged, over the rms speed.
        """
        trial = self.trials[number]
        forces: dict[int, ForceAlong] = {}
        for law in self.columns.problem.model.forces_at_ports(patch):
            if not isinstance(law, PortForce):
                continue
            port = trial.system.ports.index(law.port)
            force = force_along(
                law,
                trial.fine_time,
                trajectory.positions[:, port],
                trajectory.speeds[:, port],
                smoothing,
            )
            forces[port] = force.plus(forces[port]) if port in forces else force
        return forces

    # ------------------------------------------------------------ sensors

    def _readings(self, number: int, trajectory: Trajectory, effect: FloatArray) -> SensorReadings:
        """Return the changes of a trial's readings by errors of sensors, with their derivatives.

        Parameters
        ----------
        number : int
            The index of the trial.
        trajectory : Trajectory
            The motion of the trial.
        effect : (E,) array
            The values of the effects' unknowns.
        """
        trial = self.trials[number]
        change = np.zeros_like(trial.residual)
        slopes: dict[int, FloatArray] = {}
        first_unknown = len(trial.shared)
        motion = seen_motion(trajectory)
        for term, term_values in self.candidate.split(effect):
            # an effect without a law at a port changes readings only
            if not len(term.patch(self.columns.problem.setting, term_values).of(PortForce)):
                change = change + self._shown(number, motion, term, term_values)
                for k in range(len(term_values)):
                    above = self._shown(number, motion, term, with_step(term_values, k, STEP))
                    below = self._shown(number, motion, term, with_step(term_values, k, -STEP))
                    slopes[first_unknown + k] = (above - below) / (2.0 * STEP)
            first_unknown += len(term_values)
        return SensorReadings(change, slopes)

    def _shown(
        self, number: int, motion: TrialMotion, term: EffectTerm, values: FloatArray
    ) -> FloatArray:
        """Return the change (N, C) of a trial's readings by one effect, divided by the noise.

        Parameters
        ----------
        number : int
            The index of the trial.
        motion : TrialMotion
            The motion that the sensors measure.
        term : EffectTerm
            The effect.
        values : array
            The values of its unknowns.
        """
        patch = term.patch(self.columns.problem.setting, values)
        column = self.columns.part(self.trials[number], motion, number, patch, term.effect.acts_on)
        return column.readings


def seen_motion(trajectory: Trajectory) -> TrialMotion:
    """Return the motion that sensors measure along a trajectory, for the columns of sensor errors.

    All that laws and missing forces add counts as explained here, since it is part of the
    trajectory.
    """
    return TrialMotion(
        added=trajectory.added,
        forces=trajectory.forces,
        left={},
        explained=trajectory.added,
        positions=trajectory.positions,
        speeds=trajectory.speeds,
        deviations={},
    )
