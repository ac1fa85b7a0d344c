"""The missing forces at the ports of a model: at one port, at all, or at one with jumps."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.fits.candidate import (
    PARAMETER_STEP,
    Point,
)
from discrepancy.fits.problem import Problem
from fe.runtime.laws.interface import PortForce
from fe.runtime.patch import ModelPatch

from .explained import NO_EFFECTS, ForceHypothesis, fit_missing_forces
from .filtered import Process
from .hypotheses import ColumnBuilder, scale_processes

MOST_PORTS = 4
"""Largest number of ports at which forces are missing at once."""
FURTHER_PORT_FACTOR = 0.1
"""Factor on the standard deviation of a missing force as estimated at its port alone. The search
for the forces at all ports together begins with the product. At the best port the factor is one."""


class MissingForces:
    """The missing forces of a problem at the ports of its model, without any effect.

    Parameters
    ----------
    problem : Problem
        A problem with trials in motion, whose model has ports.
    sample_limit : int, optional
        The number of samples of all trials together to which trials are thinned, if they can be.

    Attributes
    ----------
    hypothesis_by_port : dict of str to ForceHypothesis
        The missing force at each port alone, by the name of the port. It is estimated twice: first
        along the motion of the model, which gives the initial states of the trials; then along the
        motion that was estimated first, with the model's own laws and with the parameters linear
        about their first estimates.
    ports : tuple of str
        The names of the ports.
    problem_with_laws : Problem
        The problem as it was given; `problem` has the same trials, and a model without laws.
    model_laws : ModelPatch
        The model's own laws at its ports, which its linear system does not contain.
    point : Point
        The unknowns about which the trials are linear. A hypothesis that was estimated with the
        motion has trials of its own, which are linear about its own unknowns.
    column_builder : ColumnBuilder
        The object that linearises the trials, and computes the columns of effects in them.
    """

    def __init__(self, problem: Problem, sample_limit: int | None = None) -> None:
        self.problem_with_laws = problem
        linear_model, self.model_laws = problem.model.without_laws()
        trials = tuple(data.trial for data in problem.trials)
        self.model = problem.model
        self.problem = problem.with_trials(trials, linear_model)
        self.trial_indices = [k for k, data in enumerate(problem.trials) if data.trial.is_dynamic]
        self.ports = tuple(linear_model.ports)
        self.hypothesis_by_port: dict[str, ForceHypothesis] = {}
        self.column_builder = ColumnBuilder(
            self.problem, self.trial_indices, self.model_laws, sample_limit
        )
        # first estimate, along the motion of the model at the prior means
        self.point = self.problem.prior_mean_point(NO_EFFECTS)
        linear_trials = self.column_builder.trials_about(self.point)
        for port, name in enumerate(self.ports):
            processes = self.prior_processes((port,))
            self.hypothesis_by_port[name] = fit_missing_forces(linear_trials, processes, processes)
        # second estimate, about the unknowns of the best port
        self.point = self.clipped_point(self.hypothesis_of_best_port())
        linear_trials = self.column_builder.trials_about(self.point)
        for port, name in enumerate(self.ports):
            last_processes = self.hypothesis_by_port[name].processes
            motions = linear_trials.smooth(last_processes).motions
            along_motion = self.column_builder.trials_along_motions(linear_trials, motions)
            prior_medians = self.prior_processes((port,))
            self.hypothesis_by_port[name] = fit_missing_forces(
                along_motion, prior_medians, last_processes
            )

    # ---------------------------------------------------------------- where a force is missing

    @cached_property
    def hypothesis_of_all_ports(self) -> ForceHypothesis:
        """The missing forces at several ports, estimated together.

        These are all ports of the model, or the `MOST_PORTS` ports with the largest evidence if
        there are more. With a single port the result is the estimate at that port.
        """
        best_alone = self.hypothesis_of_best_port()
        hypotheses_alone = sorted(
            self.hypothesis_by_port.values(), key=lambda at_port: -at_port.log_evidence
        )[:MOST_PORTS]
        if len(hypotheses_alone) == 1:
            return best_alone
        start_processes = dict(best_alone.processes)
        for at_port in hypotheses_alone[1:]:
            # alone, each port takes the whole gap: the further ports begin with a smaller force
            # of the same correlation time
            start_processes |= scale_processes(at_port.processes, FURTHER_PORT_FACTOR, 1.0)
        linear_trials = best_alone.linear_trials
        # The columns of the model's own laws depend on the motion, so forces and motion are
        # estimated twice. The second search begins at the first result and needs no grid.
        for skip_grid in (False, True):
            prior_medians = self.prior_processes(start_processes)
            hypothesis = fit_missing_forces(
                linear_trials, prior_medians, start_processes, skip_grid=skip_grid
            )
            linear_trials = self.column_builder.trials_along_motions(
                linear_trials, hypothesis.motions
            )
            start_processes = dict(hypothesis.processes)
        return hypothesis

    def hypothesis_of_best_port(self) -> ForceHypothesis:
        """Return the missing force at one port that has the largest evidence."""
        return max(self.hypothesis_by_port.values(), key=lambda at_port: at_port.log_evidence)

    def prior_processes(self, ports: Iterable[int]) -> dict[int, Process]:
        """Return the prior medians of missing forces, by the number of the port.

        The median standard deviation is 5 % of the elastic force at the port. The median
        correlation time is the time in which the vibration advances by one radian, or the duration
        of the trials if the port has no frequency.

        Parameters
        ----------
        ports : iterable of int
            The numbers of the ports.
        """
        scales = self.problem.setting.scales
        processes = {}
        for port in ports:
            scale = scales.ports[self.ports[port]]
            rate = scale.angular_frequency or 1.0 / scales.duration
            # 5 % of the elastic force is a small gap; the prior allows sizes far from this median
            processes[port] = Process(0.05 * scale.stiffness * scale.displacement, 1.0 / rate)
        return processes

    def evaluate_model_laws(self, shared_values: FloatArray) -> ModelPatch:
        """Return the model's own laws at values (K,) of the shared unknowns."""
        parameters = self.problem.shared.parameters(shared_values)
        return self.model.built_in_laws(parameters) + self.model.patch.of(PortForce)

    def force_deviation(self, port: int) -> float:
        """Return the standard deviation of the missing force at a port without any effect.

        Its unit is N, N m or the port's flow. It is the prior median if no force was estimated
        there.

        Parameters
        ----------
        port : int
            The number of the port.
        """
        process = self.hypothesis_of_all_ports.processes.get(port)
        if process is None:
            process = self.prior_processes((port,))[port]
        return process.standard_deviation

    def hypothesis_with_jumps(self, port: str) -> ForceHypothesis:
        """Return the missing force at a port as a process that may jump.

        The trials are linearised twice, the second time about the motion of the first estimate.

        Parameters
        ----------
        port : str
            The name of the port.
        """
        hypothesis = self.hypothesis_by_port[port]
        for _ in range(2):
            self.point = self.clipped_point(hypothesis)
            linear_trials = self.column_builder.trials_about(self.point)
            # the model's own laws depend on the motion, and it on them: iterate twice
            for _ in range(2):
                motions = linear_trials.smooth(hypothesis.processes).motions
                linear_trials = self.column_builder.trials_along_motions(linear_trials, motions)
            start_processes = {}
            for port_number, process in hypothesis.processes.items():
                start_processes[port_number] = replace(process, may_jump=True)
            hypothesis = fit_missing_forces(
                linear_trials, self.prior_processes(start_processes), start_processes
            )
        return hypothesis

    def point_with_effects(self, hypothesis: ForceHypothesis) -> Point:
        """Return the unknowns of a hypothesis with its effects, from which a fit may begin.

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The fitted hypothesis: its effects, and the motion and missing forces of each trial.
        """
        point = self.clipped_point(hypothesis)
        return Point(hypothesis.shared.copy(), point.local, hypothesis.effect.copy())

    def clipped_point(self, hypothesis: ForceHypothesis) -> Point:
        """Return the unknowns of a hypothesis without its effects, clipped to their ranges."""
        return self.point_of_unknowns(hypothesis.shared, hypothesis.local)

    def point_of_unknowns(
        self, shared_values: FloatArray, local_of_trials: Iterable[FloatArray]
    ) -> Point:
        """Return values of the unknowns as a point of the problem, clipped to their ranges.

        Parameters
        ----------
        shared_values : (K,) array
            The scaled values of the K unknowns that all trials share.
        local_of_trials : iterable of (L,) array
            The unknowns of each trial in motion.
        """
        local_values = [np.zeros(data.unknowns.unknown_count) for data in self.problem.trials]
        for number, values in zip(self.trial_indices, local_of_trials, strict=True):
            local_values[number] = values
        low, high = self.problem.shared.bounds
        # a margin of one difference step, so that derivatives by parameters stay in the ranges; and
        # within two prior standard deviations
        low = np.maximum(low + PARAMETER_STEP, -2.0)
        high = np.minimum(high - PARAMETER_STEP, 2.0)
        return Point(np.clip(shared_values, low, high), tuple(local_values), np.zeros(0))
