"""Effects of the catalogue as laws and sensors of a hypothesis, along a trajectory."""

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
"""Standard normal step of the derivatives of an effect by its unknowns."""


@dataclass(frozen=True, eq=False)
class EffectLaws:
    """The effects of a candidate beside the laws that the model has itself.

    Attributes
    ----------
    columns : ColumnBuilder
        Makes what sensors do to readings.
    trials : tuple of SeenTrial
        Dynamic trials.
    candidate : Candidate
        Effects at places.
    own_laws : callable
        Takes shared unknowns (K,); returns the laws that the model has itself.
    adjustable : tuple of int
        Shared unknowns by which these change.
    """

    columns: ColumnBuilder
    trials: tuple[SeenTrial, ...]
    candidate: Candidate
    own_laws: Callable[[FloatArray], ModelPatch]
    adjustable: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number E of unknowns of the effects."""
        return self.candidate.size

    def along(
        self,
        number: int,
        trajectory: Trajectory,
        effect: FloatArray,
        shared: FloatArray,
        smoothing: float,
    ) -> tuple[Mapping[int, Forces], SensorReadings] | None:
        """Return forces at ports and readings of a trial along a trajectory.

        None where they cannot be.
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
        """Return the forces of all laws at ports along a trajectory; None where they cannot be."""
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
        """Return the forces of all laws at ports along a trajectory."""
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
        """Return the forces of all laws at ports, with their derivatives by unknowns."""

        def at(values: FloatArray, parameters: FloatArray) -> dict[int, ForceAlong]:
            return self._forces_at(number, trajectory, values, parameters, smoothing)

        along = at(effect, shared)
        slopes: dict[int, dict[int, FloatArray]] = {port: {} for port in along}
        for k in range(self.size):
            above, below = (
                at(with_step(effect, k, STEP), shared),
                at(with_step(effect, k, -STEP), shared),
            )
            self._take_slopes(slopes, len(shared) + k, above, below)
        for k in self.adjustable:
            above, below = (
                at(effect, with_step(shared, k, STEP)),
                at(effect, with_step(shared, k, -STEP)),
            )
            self._take_slopes(slopes, k, above, below)
        return {port: Forces(force, slopes[port]) for port, force in along.items()}

    @staticmethod
    def _take_slopes(
        slopes: Mapping[int, dict[int, FloatArray]],
        unknown: int,
        above: Mapping[int, ForceAlong],
        below: Mapping[int, ForceAlong],
    ) -> None:
        """Add the derivatives of forces by an unknown where they are not zero."""
        for port, of_port in slopes.items():
            if port in above and port in below:
                slope = (above[port].force - below[port].force) / (2.0 * STEP)
                if np.any(slope):
                    of_port[unknown] = slope

    def _patch(self, number: int, effect: FloatArray) -> ModelPatch:
        """Return what the effects add to the model in a trial."""
        trial = self.columns.problem.trials[self.columns.numbers[number]].trial
        patch = ModelPatch()
        for term, part in self.candidate.split(effect):
            if trial.kind in term.effect.acts_on:
                patch = patch + term.patch(self.columns.problem.setting, part).in_trial(trial.name)
        return patch

    def _along(
        self, number: int, trajectory: Trajectory, patch: ModelPatch, smoothing: float
    ) -> dict[int, ForceAlong]:
        """Return the forces of a patch's laws, by port."""
        trial = self.trials[number]
        forces: dict[int, ForceAlong] = {}
        for law in self.columns.problem.model.at_ports(patch):
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
        """Return what effects of sensors do to readings, with derivatives by their unknowns."""
        trial = self.trials[number]
        known = np.zeros_like(trial.residual)
        by_unknown: dict[int, FloatArray] = {}
        first_unknown = len(trial.shared)
        motion = seen_motion(trajectory)
        for term, part in self.candidate.split(effect):
            if not len(term.patch(self.columns.problem.setting, part).of(PortForce)):
                known = known + self._shown(number, motion, term, part)
                for k in range(len(part)):
                    above = self._shown(number, motion, term, with_step(part, k, STEP))
                    below = self._shown(number, motion, term, with_step(part, k, -STEP))
                    by_unknown[first_unknown + k] = (above - below) / (2.0 * STEP)
            first_unknown += len(part)
        return SensorReadings(known, by_unknown)

    def _shown(
        self, number: int, motion: TrialMotion, term: EffectTerm, values: FloatArray
    ) -> FloatArray:
        """Return what one effect does to the readings (N, C) of a trial, over their noise."""
        patch = term.patch(self.columns.problem.setting, values)
        part = self.columns.part(self.trials[number], motion, number, patch, term.effect.acts_on)
        return part.readings


def seen_motion(trajectory: Trajectory) -> TrialMotion:
    """Return a trajectory as sensors see it: what laws and missing forces add."""
    return TrialMotion(
        added=trajectory.added,
        forces=trajectory.forces,
        left={},
        explained=trajectory.added,
        positions=trajectory.positions,
        speeds=trajectory.speeds,
        deviations={},
    )
