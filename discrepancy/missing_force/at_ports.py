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

from .explained import NOTHING, ForceHypothesis, with_most_probable_forces
from .filtered import Process
from .hypotheses import ColumnBuilder, scaled
from .view import View

MOST_PORTS = 4
"""Largest number of ports at which forces are missing at once."""
BESIDE = 0.1
"""Factor on the size of a further port's missing force, estimated alone, with which the search for
all of them together begins."""


class MissingForces:
    """The missing forces of a problem at the ports of its model, without any effect.

    Parameters
    ----------
    problem : Problem
        A problem with trials in motion, whose model has ports.

    Attributes
    ----------
    at : dict of str to ForceHypothesis
        The missing force at each port alone. It is estimated twice: first along the motion of the
        model, for the initial states of the trials; then along the motion estimated so, with the
        parameters linear about their estimates, and with the model's own laws.
    ports : tuple of str
        The names of the ports.
    laws : ModelPatch
        The model's own laws at its ports, which its linear system does not contain.
    point : Point
        The unknowns about which the trials are linear.
    columns : ColumnBuilder
        The builder of the columns of effects in these trials.
    """

    def __init__(self, problem: Problem) -> None:
        linear_model, self.laws = problem.model.without_laws()
        trials = tuple(data.trial for data in problem.trials)
        self.model = problem.model
        self.problem = problem.with_trials(trials, linear_model)
        self.numbers = [k for k, data in enumerate(problem.trials) if data.trial.is_dynamic]
        self.ports = tuple(linear_model.ports)
        self.at: dict[str, ForceHypothesis] = {}
        self.point = self.problem.start(NOTHING)
        view = self._linear_view()
        for port, name in enumerate(self.ports):
            processes = self.prior_processes((port,))
            self.at[name] = with_most_probable_forces(view, processes, processes)
        self.point = self._point(self.best())
        view = self._linear_view()
        for port, name in enumerate(self.ports):
            last_processes = self.at[name].processes
            _, _, motions = view.smoothed(last_processes)
            along_motion = self.columns.along(view, motions)
            median = self.prior_processes((port,))
            self.at[name] = with_most_probable_forces(along_motion, median, last_processes)

    # ---------------------------------------------------------------- where a force is missing

    @cached_property
    def whole(self) -> ForceHypothesis:
        """The missing forces at all ports at once.

        If there are more than `MOST_PORTS` ports, those with the most evidence are taken.
        """
        best = self.best()
        best_ports = sorted(self.at.values(), key=lambda at_port: -at_port.log_evidence)[
            :MOST_PORTS
        ]
        if len(best_ports) == 1:
            return best
        begin = dict(best.processes)
        for at_port in best_ports[1:]:
            begin |= scaled(at_port.processes, BESIDE, 1.0)
        view = best.view
        # the second time along the motion that the first one has estimated
        for near in (False, True):
            median = self.prior_processes(begin)
            hypothesis = with_most_probable_forces(view, median, begin, near=near)
            view = self.columns.along(view, hypothesis.motions)
            begin = dict(hypothesis.processes)
        return hypothesis

    def best(self) -> ForceHypothesis:
        """Return the missing force at one port that has the largest evidence."""
        return max(self.at.values(), key=lambda at_port: at_port.log_evidence)

    def prior_processes(self, ports: Iterable[int]) -> dict[int, Process]:
        """Return the prior medians of missing forces, by the number of the port.

        The median size is 5 % of the elastic force at the port; the median time is that of a radian
        of the vibration, or the duration of the trials if there is no frequency.

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
            processes[port] = Process(0.05 * scale.stiffness * scale.displacement, 1.0 / rate)
        return processes

    def own_laws(self, shared: FloatArray) -> ModelPatch:
        """Return the model's own laws at values (K,) of the shared unknowns."""
        parameters = self.problem.shared.parameters(shared)
        return self.model.built_in_laws(parameters) + self.model.patch.of(PortForce)

    def whole_size(self, port: int) -> float:
        """Return the standard deviation of the missing force at a port without any effect.

        Its unit is N, N m or the port's flow. It is the prior median if no force was estimated
        there.

        Parameters
        ----------
        port : int
            The number of the port.
        """
        process = self.whole.processes.get(port)
        if process is None:
            process = self.prior_processes((port,))[port]
        return process.size

    def rough(self, port: str) -> ForceHypothesis:
        """Return the missing force at a port as a process that may jump.

        The trials are made linear about the motion that it gives, twice.

        Parameters
        ----------
        port : str
            The name of the port.
        """
        hypothesis = self.at[port]
        for _ in range(2):
            self.point = self._point(hypothesis)
            view = self._linear_view()
            # the model's own laws and the motion depend on each other: twice
            for _ in range(2):
                _, _, motions = view.smoothed(hypothesis.processes)
                view = self.columns.along(view, motions)
            begin = {}
            for number, process in hypothesis.processes.items():
                begin[number] = replace(process, rough=True)
            hypothesis = with_most_probable_forces(view, self.prior_processes(begin), begin)
        return hypothesis

    def whole_point(self, hypothesis: ForceHypothesis) -> Point:
        """Return the unknowns of a hypothesis with its effects, from which a fit may begin.

        Parameters
        ----------
        hypothesis : ForceHypothesis
            The hypothesis.
        """
        point = self._point(hypothesis)
        return Point(hypothesis.shared.copy(), point.local, hypothesis.effect.copy())

    def _linear_view(self) -> View:
        """Return the trials, linear about `point`, and rebuild `columns` there."""
        self.columns = ColumnBuilder(self.problem, self.numbers, self.point, self.laws)
        return self.columns.bare()

    def _point(self, hypothesis: ForceHypothesis) -> Point:
        """Return the unknowns of a hypothesis without its effects, clipped to their ranges."""
        local = [np.zeros(data.unknowns.size) for data in self.problem.trials]
        for number, values in zip(self.numbers, hypothesis.local, strict=True):
            local[number] = values
        low, high = self.problem.shared.ends
        # a margin of one difference step, so that derivatives by parameters stay in the ranges; and
        # within two prior standard deviations
        low = np.maximum(low + PARAMETER_STEP, -2.0)
        high = np.minimum(high - PARAMETER_STEP, 2.0)
        return Point(np.clip(hypothesis.shared, low, high), tuple(local), np.zeros(0))
