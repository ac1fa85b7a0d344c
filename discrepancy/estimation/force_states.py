"""The state space of a trial with missing forces at ports and coloured noises.

A missing force is a Gaussian process in time with a standard deviation and a correlation time:
Matern 3/2 with two states (Hartikainen and Sarkka 2010, IEEE Workshop on Machine Learning for
Signal Processing), or Matern 1/2 with one state if it may jump.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.trials_in_motion.trial import PortedTrial
from reporting.arrays import LEAST_DIVISOR

LEAST_NATURAL_FREQUENCY = 1e-9
"""Frequency that stands for the highest one of a structure that no spring holds [rad/s]."""


@dataclass(frozen=True)
class Process:
    """The statistics of a missing force as a Gaussian process in time.

    Attributes
    ----------
    standard_deviation : float
        The standard deviation of the force [N, N m or the port's flow].
    correlation_time : float
        The correlation time [s].
    may_jump : bool
        Whether the force may jump (Matern 1/2). Otherwise it is differentiable (Matern 3/2).
    """

    standard_deviation: float
    correlation_time: float
    may_jump: bool = False

    @property
    def generator(self) -> FloatArray:
        """The rate matrix [1/s] of one or two states.

        The first state is the force over its standard deviation.
        """
        if self.may_jump:
            return np.array([[-1.0 / self.correlation_time]])
        rate = np.sqrt(3.0) / self.correlation_time
        return np.asarray(rate * np.array([[0.0, 1.0], [-1.0, -2.0]]))

    @property
    def intensity(self) -> float:
        """Spectral density of the white noise that drives the last state [1/s].

        With it the stationary variance of every state is one.
        """
        return (
            2.0 / self.correlation_time
            if self.may_jump
            else 4.0 * np.sqrt(3.0) / self.correlation_time
        )


class ForceStateSpace(NamedTuple):
    """The system of a trial, its missing forces and its coloured noises as n scaled states.

    Attributes
    ----------
    generator : (n, n) ndarray
        The rate matrix [1/s].
    intensity : (n, n) ndarray
        The spectral density of the white noise that drives the state [1/s].
    output_rows : (C, n) ndarray
        The readings for a unit of each state, divided by the deviation of the white part of their
        noise.
    initial_covariance : (n, n) ndarray
        The covariance of the state at the first sample.
    """

    generator: FloatArray
    intensity: FloatArray
    output_rows: FloatArray
    initial_covariance: FloatArray


@dataclass(frozen=True, eq=False)
class ForceStates:
    """The states of a trial with missing forces at ports, scaled to magnitudes of about one.

    Attributes
    ----------
    trial : PortedTrial
        The trial as a linear system with ports.
    processes : sequence of (int, Process)
        The missing forces, each with the index of its port. Several may act at one port.
    """

    trial: PortedTrial
    processes: Sequence[tuple[int, Process]]

    @cached_property
    def state_units(self) -> FloatArray:
        """The typical magnitude (n,) of each state of the structure, by which the filter divides.

        Let the missing force vary at the highest natural frequency omega with an amplitude of one
        standard deviation, and let it cause the acceleration a. A speed is then of the magnitude
        a / omega, and a position of a / omega^2.

        The system does not say which of its states are positions. An even number of states is taken
        as positions followed by as many speeds, as in a structure, and an odd number as speeds
        alone, as in a system of first order. If that is wrong, the states are scaled less well, but
        the estimates stay the same up to rounding.
        """
        system = self.trial.system
        state_count = len(system.generator)
        # the natural frequencies are the moduli of the eigenvalues
        eigenvalues = np.linalg.eigvals(system.generator)
        highest_frequency = max(
            float(np.max(np.abs(eigenvalues), initial=0.0)), LEAST_NATURAL_FREQUENCY
        )
        # a row of `actions` holds the rates (n,) of the states that a unit force at a port causes
        accelerations = [
            np.abs(system.actions[port]).max(initial=0.0) * process.standard_deviation
            for port, process in self.processes
        ]
        largest_acceleration = max([*accelerations, LEAST_DIVISOR])
        speed = largest_acceleration / highest_frequency
        units = np.full(state_count, speed)
        has_positions = state_count % 2 == 0
        if has_positions:
            units[: state_count // 2] = speed / highest_frequency
        return units

    @cached_property
    def force_state_indices(self) -> list[int]:
        """The index of each missing force in the state.

        A force that may not jump has a second state, its scaled rate, which follows it.
        """
        state_counts = [len(process.generator) for _, process in self.processes]
        first_force_state = len(self.trial.system.generator)
        return [
            first_force_state + sum(state_counts[:number]) for number in range(len(state_counts))
        ]

    @cached_property
    def white_noise_scale(self) -> FloatArray:
        """The standard deviation (C,) of each channel's noise over that of its white part.

        Readings are divided by the first in `PortedTrial`, and by the second in the filter.
        """
        ratios = np.ones(len(self.trial.deviation))
        for noise in self.trial.coloured_noises:
            ratios[noise.channel] = 1.0 / np.sqrt(1.0 - noise.share)
        return ratios

    @cached_property
    def state_space(self) -> ForceStateSpace:
        """The state space with the states of the structure, missing forces, and coloured noises."""
        trial = self.trial
        force_state_count = sum(len(process.generator) for _, process in self.processes)
        first_noise_state = len(trial.system.generator) + force_state_count
        state_count = first_noise_state + len(trial.coloured_noises)
        state_space = ForceStateSpace(
            generator=np.zeros((state_count, state_count)),
            intensity=np.zeros((state_count, state_count)),
            output_rows=np.zeros((len(trial.deviation), state_count)),
            initial_covariance=np.zeros((state_count, state_count)),
        )
        self._fill_structure(state_space)
        for (port, process), index in zip(self.processes, self.force_state_indices, strict=True):
            self._fill_missing_force(state_space, port, process, index)
        self._fill_coloured_noises(state_space, first_noise_state)
        # The rows so far give readings divided by the standard deviation of their whole noise. The
        # filter's readings are divided by that of the white part of the noise alone.
        return state_space._replace(
            output_rows=state_space.output_rows * self.white_noise_scale[:, None]
        )

    def _fill_structure(self, state_space: ForceStateSpace) -> None:
        """Fill the rates and outputs of the structure's own states, in units of these states."""
        system = self.trial.system
        structure = slice(0, len(system.generator))
        units = self.state_units
        state_space.generator[structure, structure] = system.generator * units / units[:, None]
        state_space.output_rows[:, structure] = (
            system.outputs * units / self.trial.deviation[:, None]
        )

    def _fill_missing_force(
        self, state_space: ForceStateSpace, port: int, process: Process, index: int
    ) -> None:
        """Fill the states of a missing force at a port, after those of the structure.

        `index` is that of the force in the state.
        """
        trial = self.trial
        generator = state_space.generator
        covariance = state_space.initial_covariance
        structure = slice(0, len(trial.system.generator))
        force_states = slice(index, index + len(process.generator))
        generator[structure, index] = (
            -trial.system.actions[port] * process.standard_deviation / self.state_units
        )
        generator[force_states, force_states] = process.generator
        last_state = force_states.stop - 1
        state_space.intensity[last_state, last_state] = process.intensity
        # an acceleration shows the force directly
        state_space.output_rows[:, index] = (
            -trial.system.through[port] * process.standard_deviation / trial.deviation
        )
        covariance[force_states, force_states] = np.eye(len(process.generator))
        # a trial that begins at rest does so under the missing force f: A s + b f = 0
        if trial.begins_at_rest:
            state_at_rest = np.linalg.lstsq(
                generator[structure, structure], -generator[structure, index], rcond=1e-12
            )[0]
            covariance[structure, structure] += np.outer(state_at_rest, state_at_rest)
            covariance[structure, index] = state_at_rest
            covariance[index, structure] = state_at_rest

    def _fill_coloured_noises(self, state_space: ForceStateSpace, first_state: int) -> None:
        """Fill the correlated parts of noises, processes of first order with variance one."""
        for index, noise in enumerate(self.trial.coloured_noises, first_state):
            state_space.generator[index, index] = -noise.decay_rate
            state_space.intensity[index, index] = 2.0 * noise.decay_rate
            state_space.initial_covariance[index, index] = 1.0
            state_space.output_rows[noise.channel, index] = np.sqrt(noise.share)
