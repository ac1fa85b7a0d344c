"""A trial at rest whose missing forces are estimated: load steps as linear equations with ports.

At rest, a force at a port moves all ports and changes all readings at once, by the compliance of
the model (`PortsAtRest`). A trial at rest is linear in its unknowns as a trial in motion is, and
its laws are evaluated along its positions, one for each load step.

Terms and shapes: N load steps, C channels, P ports, K shared unknowns, L unknowns of this trial.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby
from typing import ClassVar

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.fits.candidate import PARAMETER_STEP, SHARED_STEP, Point, with_step
from discrepancy.fits.problem import Problem
from discrepancy.system.response import PortsAtRest
from fe.compilation import compiled_kernel
from fe.runtime.laws.interface import PortForce
from fe.runtime.motion import static_solution
from fe.runtime.patch import ModelPatch
from fe.runtime.port_laws import port_laws

from .ported_trial import gain_unknowns, residual_and_derivatives
from .trajectory import Trajectory
from .trial import ColouredNoise, GainUnknown, PortedTrial


@dataclass(frozen=True, eq=False)
class TrialAtRest:
    """A trial at rest as linear equations with ports, with its residuals and their derivatives.

    Attributes
    ----------
    name : str
        The name of the trial.
    time : (N,) ndarray
        The stamps of the load steps [s].
    residual : (N, C) ndarray
        The readings minus the prediction of the linear model at zero unknowns, divided by the noise
        deviations.
    used : (N, C) ndarray of bool
        Whether each reading is compared with the model.
    deviation : (C,) ndarray
        The standard deviation of the noise of each channel [unit of the channel].
    shared_derivatives, local_derivatives : (K, N, C), (L, N, C) ndarray
        The derivatives of the readings with respect to the shared unknowns, and to those of this
        trial alone, divided by the standard deviations of the noise.
    local_precision : (L,) ndarray
        The prior precisions of the unknowns of this trial alone.
    response : PortsAtRest
        The ports of the linear model at `linearisation_point`. The outputs contain the gains of the
        channels, and are divided by the noise.
    response_derivatives : mapping of int to PortsAtRest
        The derivatives of `response`, by the number of the unknown in `linearisation_point`.
    linearisation_point : (K + L,) ndarray
        The values of the unknowns about which the trial is linear.
    gain_unknowns : sequence of GainUnknown
        The shared unknowns that are gains of its channels.
    """

    name: str
    time: FloatArray
    residual: FloatArray
    used: BoolArray
    deviation: FloatArray
    shared_derivatives: FloatArray
    local_derivatives: FloatArray
    local_precision: FloatArray
    response: PortsAtRest
    response_derivatives: Mapping[int, PortsAtRest]
    linearisation_point: FloatArray
    gain_unknowns: Sequence[GainUnknown]

    is_at_rest = True
    stride = 1
    substeps = 1
    coloured_noises: ClassVar[Sequence[ColouredNoise]] = ()

    @property
    def ports(self) -> tuple[str, ...]:
        """The names of the ports."""
        return self.response.ports

    @property
    def fine_time(self) -> FloatArray:
        """The times (N,) of the load steps [s]; a trial in motion has more stamps than samples."""
        return self.time

    def positions_without_forces(self, unknowns: FloatArray) -> FloatArray:
        """Return the positions (N, P) of the ports by the linear model, linear in the unknowns.

        Parameters
        ----------
        unknowns : (K + L,) array
            The values of the K unknowns that all trials share, then of the L of this trial alone.
        """
        positions = self.response.positions.copy()
        for unknown, derivative in self.response_derivatives.items():
            change = unknowns[unknown] - self.linearisation_point[unknown]
            positions += change * derivative.positions
        return positions

    def trajectory_at(self, positions: FloatArray, forces: Mapping[int, FloatArray]) -> Trajectory:
        """Return given positions (N, P) of the ports as a trajectory without speed.

        `forces` (N,) are those that the linear model does not contain, by the index of the port.
        """
        return Trajectory(
            added_state=np.zeros((len(self.time), 0)),
            positions=positions,
            speeds=np.zeros_like(positions),
            forces=forces,
        )

    def trajectory_of_model(self) -> Trajectory:
        """Return the positions by the linear model alone, to which no force adds anything."""
        return self.trajectory_at(self.response.positions, {})

    def trajectory_under(self, forces: Mapping[int, FloatArray]) -> Trajectory:
        """Return the positions by the linear model and by forces (N,) at ports, by port."""
        added_positions = self.added_positions(self.response, forces)
        return self.trajectory_at(self.response.positions + added_positions, forces)

    def trajectory_without(
        self, trajectory: Trajectory, forces: Mapping[int, FloatArray]
    ) -> Trajectory:
        """Return a trajectory minus what some of its forces (N,), by port, add to it."""
        remaining_forces = dict(trajectory.forces)
        for port, force in forces.items():
            remaining_forces[port] = remaining_forces[port] - force
        added_positions = self.added_positions(self.response, forces)
        return self.trajectory_at(trajectory.positions - added_positions, remaining_forces)

    def added_positions(
        self, response: PortsAtRest, forces: Mapping[int, FloatArray]
    ) -> FloatArray:
        """Return the change of the positions (N, P) of all ports caused by forces (N,) at ports.

        `response` is that of the trial, or its derivative with respect to an unknown.
        """
        positions = np.zeros_like(response.positions)
        for port, force in forces.items():
            positions -= force[:, None] * response.compliance[:, :, port]
        return positions

    def readings_of_forces(
        self, response: PortsAtRest, forces: Mapping[int, FloatArray]
    ) -> FloatArray:
        """Return what forces (N,) at ports, by port, add to the readings (N, C), over the noise."""
        readings = np.zeros_like(self.residual)
        for port, force in forces.items():
            readings -= force[:, None] * response.outputs_by_force[:, port]
        return readings

    def strength_of_port(self, port: int) -> float:
        """Return how strongly a force at a port acts on the readings, as a weight."""
        return float(np.linalg.norm(self.response.outputs_by_force[:, port]))

    def readings_of_forces_in_block(
        self, forces: Mapping[int, FloatArray], begin: int, end: int
    ) -> FloatArray:
        """Return the whitened readings (B, C) that forces cause in a block of B load steps."""
        return self.readings_of_forces(self.response, forces)[begin:end]

    def readings_of_state(self, states: FloatArray, forces: Mapping[int, FloatArray]) -> FloatArray:
        """Return `readings_of_forces`; a trial at rest has no states."""
        return self.readings_of_forces(self.response, forces)

    def divide_by_noise(self, columns: FloatArray) -> FloatArray:
        """Return columns (..., N, C) over the noise deviation; 0 if a reading does not count."""
        return np.asarray(columns / self.deviation * self.used)

    @cached_property
    def _blocks(self) -> list[slice]:
        """The successive load steps in which the structure, and so its compliance, is the same."""
        blocks = []
        start = 0
        for _, steps in groupby(self.response.compliance, np.ndarray.tobytes):
            stop = start + len(list(steps))
            blocks.append(slice(start, stop))
            start = stop
        return blocks

    def trajectory_under_laws(self, laws: Sequence[PortForce], unknowns: FloatArray) -> Trajectory:
        """Return the positions under laws at ports, without missing forces.

        `unknowns` (K + L,) are the shared ones, then those of this trial alone.

        Raises
        ------
        SolutionError
            If there is no equilibrium with the laws.
        """
        patch = ModelPatch(tuple(laws))
        active_laws = port_laws(patch, self.ports)
        law_ports = [self.ports.index(port) for port in active_laws.ports]
        free_positions = self.positions_without_forces(unknowns)
        forces: dict[int, FloatArray] = {port: np.zeros(len(self.time)) for port in law_ports}
        # Within a block of successive rows the compliance is constant. The laws keep their memory
        # from one block to the next.
        memory = None
        previous_positions = None
        for steps in self._blocks:
            compliance = self.response.compliance[steps.start]
            solution = static_solution(
                active_laws,
                free_positions[steps][:, law_ports],
                compliance[np.ix_(law_ports, law_ports)],
                memory=memory,
                start=previous_positions,
                kernel=compiled_kernel(),
            )
            memory = solution.memory
            previous_positions = free_positions[steps.stop - 1, law_ports]
            for number, port in enumerate(law_ports):
                forces[port][steps] += solution.forces[:, number]
        return self.trajectory_at(
            free_positions + self.added_positions(self.response, forces), forces
        )


LinearTrial = PortedTrial | TrialAtRest
"""A trial that is linear but for laws at its ports."""


def trial_at_rest(problem: Problem, trial_index: int, point: Point) -> TrialAtRest:
    """Return a trial at rest of a problem, linear about a point.

    Parameters
    ----------
    problem : Problem
        The campaign and model; the model must describe its ports at rest.
    trial_index : int
        The index of the trial in the problem.
    point : Point
        The values of the unknowns about which the trial is linear.

    Raises
    ------
    ModelError
        If the model has no position of rest, or does not describe its ports at rest.
    """
    data = problem.trials[trial_index]
    trial = data.trial
    gains = 1.0 + problem.shared.gains(point.shared, trial.channels)
    deviation = data.sample_deviation
    residual, by_shared, by_local = residual_and_derivatives(problem, trial_index, point)
    response, derivatives = _response_and_derivatives(problem, trial_index, point)
    readings_per_output = gains / deviation * trial.used[:, None, :]  # (N, 1, C)
    return TrialAtRest(
        name=trial.name,
        time=trial.time,
        residual=residual / deviation * trial.used,
        used=trial.used,
        deviation=deviation,
        shared_derivatives=by_shared / deviation * trial.used,
        local_derivatives=by_local / deviation * trial.used,
        local_precision=data.unknowns.precision,
        response=_with_readings(response, readings_per_output),
        response_derivatives={
            number: _with_readings(derivative, readings_per_output)
            for number, derivative in derivatives.items()
        },
        linearisation_point=np.concatenate((point.shared, point.local[trial_index])),
        gain_unknowns=gain_unknowns(problem, trial, gains),
    )


def _with_readings(response: PortsAtRest, readings_per_output: FloatArray) -> PortsAtRest:
    """Return a response whose outputs are multiplied by factors (N, 1, C)."""
    return replace(response, outputs_by_force=response.outputs_by_force * readings_per_output)


def _response_and_derivatives(
    problem: Problem, trial_index: int, point: Point
) -> tuple[PortsAtRest, dict[int, PortsAtRest]]:
    """Return the ports at rest at a point, and their derivatives with respect to the unknowns.

    The derivatives are given by the index of the unknown in `TrialAtRest.linearisation_point`.
    """
    data = problem.trials[trial_index]
    layout = problem.shared
    outputs = problem.campaign.outputs(data.trial)

    def response_at(shared_values: FloatArray, local_values: FloatArray) -> PortsAtRest:
        parameters = layout.parameters(shared_values)
        conditions = data.unknowns.conditions(data.trial, parameters, local_values)
        return problem.model.ports_at_rest(data.trial, outputs, conditions)

    local_at_point = point.local[trial_index]
    response = response_at(point.shared, local_at_point)
    derivatives = {}
    # central quotients by parameters, see `two_sided_quotient`
    for k in range(layout.parameter_count):
        above = response_at(with_step(point.shared, k, SHARED_STEP), local_at_point)
        below = response_at(with_step(point.shared, k, -SHARED_STEP), local_at_point)
        derivatives[k] = above.minus(below).times(0.5 / SHARED_STEP)
    # the first unknowns of the trial are the zeros of its channels, which do not move the ports
    for k in range(data.unknowns.zero_count, data.unknowns.unknown_count):
        stepped = response_at(point.shared, with_step(local_at_point, k))
        derivatives[layout.unknown_count + k] = stepped.minus(response).times(1.0 / PARAMETER_STEP)
    return response, derivatives
