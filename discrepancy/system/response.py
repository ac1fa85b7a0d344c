"""Records that models take and return: conditions, response, a system with ports."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray, Quantity

Place = str | tuple[float, float]
"""Where a force acts: the name of a load place, or station [m] and chord fraction [1]."""
MOVES = ("N", "m")
TURNS = ("N m", "rad")
EITHER = ("N or N m", "m or rad")
"""Units of a force and of a motion at a port that moves, that turns, or may do either."""


@dataclass(frozen=True)
class Conditions:
    """The conditions on which a response depends, in addition to trial and patch.

    Attributes
    ----------
    parameters : (P,) ndarray
        Values of `Model.parameters`, in order.
    initial : (R, 2) ndarray
        The initial state of a ring-down by mode. At rest: column 0 is the deviation from the static
        release shape, in units of the release displacement, with that of the whole shape in row 0
        (so the motion starts at (1 + initial[0, 0]) times the static shape plus initial[r, 0] of
        mode r); column 1 is zero. Not at rest: displacement and velocity / w_r of mode r, in units
        of the release displacement, at the release point.
    clock : tuple of float
        (rate, zero): a sample stamped t shows the motion at (1 + rate) t + zero [1], [s].
    health : (N, 2) ndarray
        Stiffness losses z1, z2 of each row (dynamic trials: row 0 holds for all).
    offset : tuple of float
        The constants that the recorded inputs of a driven trial lack, in their order [SI]; empty:
        none.
    refinement : int
        Time steps are this many times smaller than usual, to check the integration.
    """

    parameters: FloatArray
    initial: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    clock: tuple[float, float] = (0.0, 0.0)
    health: FloatArray = field(default_factory=lambda: np.zeros((1, 2)))
    offset: tuple[float, ...] = ()
    refinement: int = 1

    def motion_times(self, time: FloatArray) -> FloatArray:
        """Return the times at which samples with stamps (N,) show the motion [s]."""
        return (1.0 + self.clock[0]) * time + self.clock[1]

    @property
    def key(self) -> tuple[object, ...]:
        """All conditions as one hashable value, under which a response is kept in a cache."""
        return (
            self.parameters.tobytes(),
            self.initial.tobytes(),
            self.clock,
            self.health.tobytes(),
            self.offset,
            self.refinement,
        )


class Response(NamedTuple):
    """The readings of perfect sensors.

    Attributes
    ----------
    values : (N, C) ndarray
        The value of each output [SI].
    rates : (N, C) ndarray or None
        The time derivatives of the values, for dynamic trials.
    """

    values: FloatArray
    rates: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class PortedSystem:
    """A model in motion as a linear system, from missing forces at ports to outputs.

    s' = A s - sum_p b_p g_p, y = C s - sum_p e_p g_p, in the coordinates s = (q, q') of the modes.
    The known loads are in the model's own response; s is the change of the state by a missing force
    g.

    Attributes
    ----------
    generator : (n, n) ndarray
        The matrix A of the state equation [1/s].
    ports : tuple of str
        The names of the P ports.
    actions : (P, n) ndarray
        b of each port: a unit force there lowers the rate of the state by b.
    positions, speeds : (P, n) ndarray
        Rows of the ports' positions and speeds. A port of a state has the state as its speed.
    outputs : (C, n) ndarray
        The rows that give the C outputs from the n states.
    through : (P, C) ndarray
        e of each port: a unit force there lowers the outputs by e at once.
    """

    generator: FloatArray
    ports: tuple[str, ...]
    actions: FloatArray
    positions: FloatArray
    speeds: FloatArray
    outputs: FloatArray
    through: FloatArray


@dataclass(frozen=True, eq=False)
class PortsAtRest:
    """The ports of a linear model in a trial at rest of N rows, and what forces at them do.

    With forces g at the ports, which act against their motion, the positions of the ports are
    x - C g, and the C outputs change by -E g.

    Attributes
    ----------
    ports : tuple of str
        The names of the P ports: those of the model, and places of forces that are spread over it.
    positions : (N, P) ndarray
        The positions x of the P ports without these forces [m or rad]; 0 at a port of a state.
    compliance : (N, P, P) ndarray
        C: the positions of the ports (second axis) by a unit force at each port (last axis).
    outputs_by_force : (N, P, C) ndarray
        E: the outputs by a unit force at each port.
    """

    ports: tuple[str, ...]
    positions: FloatArray
    compliance: FloatArray
    outputs_by_force: FloatArray

    def minus(self, other: "PortsAtRest") -> "PortsAtRest":
        """Return the difference to the ports under other conditions."""
        return PortsAtRest(
            self.ports,
            self.positions - other.positions,
            self.compliance - other.compliance,
            self.outputs_by_force - other.outputs_by_force,
        )

    def times(self, factor: float) -> "PortsAtRest":
        """Return all arrays times a factor."""
        return PortsAtRest(
            self.ports,
            factor * self.positions,
            factor * self.compliance,
            factor * self.outputs_by_force,
        )


Outputs = tuple[tuple[str, Quantity], ...]
"""Names of outputs, and the quantity wanted of each."""
ACROSS = ".transverse", ".shear"
"""Endings of the names of a gauge's transverse and engineering shear strain."""
