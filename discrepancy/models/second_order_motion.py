"""What a system did in a trial, in modal coordinates, and what outputs show of that."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray, Quantity
from discrepancy.models.interface import Response
from discrepancy.models.linear_system import LinearSystem
from discrepancy.models.rig_records import Acting, Shown, shown_rows
from fe.runtime.motion import Laws


@dataclass(frozen=True)
class Motion:
    """Motion at the samples of a trial.

    Attributes
    ----------
    system : LinearSystem
        What moved.
    acting : Acting
        What acted.
    time : (N,) ndarray
        Times of the motion since the release or the begin of the record [s].
    q, velocity : (N, M + P) ndarray
        Modal coordinates, those of the drives too, and their rates (mass-normalised).
    port_forces : (N, J) ndarray
        Internal forces.
    lagged : (N, J) ndarray
        Internal forces as omitted modes follow them.
    laws : Laws
        Their laws.
    held : int
        First samples that lie before the release, where the shape is held.
    holding : (n,) ndarray, optional
        Force that held the release point until then [N].
    """

    system: LinearSystem
    acting: Acting
    time: FloatArray
    q: FloatArray
    velocity: FloatArray
    port_forces: FloatArray
    lagged: FloatArray
    laws: Laws
    held: int = 0
    holding: FloatArray | None = None

    @cached_property
    def acceleration(self) -> FloatArray:
        """Second derivatives (N, M + P) of the modal coordinates, from the equation of motion."""
        system, count = self.system, len(self.system.angular_frequency)
        found = np.empty_like(self.q)
        pull = self.q[:, :count] @ system.free.whole.T
        if self.laws.rate != 0.0:
            pull *= 1.0 + self.laws.rate * self.time[:, None]
        found[:, :count] = system.forces_at(self.acting, self.time) - pull
        found[:, :count] -= self.velocity[:, :count] @ system.free.damping.T
        if len(self.laws):
            rows = self.laws.rows(system.modal.actions or system.modal.ports, self.q.shape[1])
            found[:, :count] -= self.port_forces @ rows[:, :count]
        for number, drive in enumerate(self.acting.drives):
            found[:, count + number] = system.heaviness * drive.at(self.time, 2)
        found[: self.held] = 0.0
        return found

    @cached_property
    def _jerk(self) -> FloatArray:
        if len(self.time) < 2:
            return np.zeros_like(self.q)
        return np.asarray(np.gradient(self.acceleration, self.time, axis=0))

    def derivative(self, order: int) -> FloatArray:
        """Return a derivative (N, M + P) of the modal coordinates, up to the third."""
        if order < 2:
            return (self.q, self.velocity)[order]
        return self.acceleration if order == 2 else self._jerk

    def values(self, rows: FloatArray) -> FloatArray:
        """Return row . u and row . x (N, C) of rows (C, n + m)."""
        n, shapes = self.system.displacements, self.system.all_shapes
        found = self.q @ (rows[:, :n] @ shapes[:n]).T
        if self.system.states:
            found += self.velocity @ (rows[:, n:] @ shapes[n:]).T
        return found + self._left_out(rows) if self.system.truncated else np.asarray(found)

    def _left_out(self, rows: FloatArray) -> FloatArray:
        """Return what omitted modes add to row . u (N, C).

        They follow applied forces without delay, and internal ones and the end of a holding force with that
        of their damping.
        """
        system = self.system
        residual, found = system.residual(rows.T), np.zeros((len(self.time), len(rows)))
        if self.acting.loads:
            found += self.acting.load_at(self.time, residual)
        if len(self.laws):
            found -= self.lagged @ (system.port_rows(self.laws) @ residual)
        if self.holding is not None and system.relaxation > 0.0:
            lag = system.relaxation
            count = int(np.searchsorted(self.time, 40.0 * lag, side="right"))
            fading = np.exp(-np.maximum(self.time[:count], 0.0) / lag)
            found[:count] += np.outer(fading, self.holding @ residual)
        return found

    def response(self, rows: FloatArray, quantities: Sequence[Quantity]) -> Response:
        """Return what sensors at rows (C, n) show, and the rates; see `seen`."""
        return self.seen(shown_rows(rows, quantities))

    def seen(self, shown: Sequence[Shown]) -> Response:
        """Return what outputs show, and the rates; omitted modes are in what is not derived only."""
        system = self.system
        values, rates = np.zeros((2, len(self.time), len(shown)))
        for order, rows in enumerate(system.by_order(shown, system.all_shapes)):
            if np.any(rows):
                values += self.derivative(order) @ rows.T
                if order < 3:
                    rates += self.derivative(order + 1) @ rows.T
        still = [number for number, item in enumerate(shown) if item.order == 0]
        if system.truncated and still:
            values[:, still] += self._left_out(np.array([shown[number].row for number in still]))
        for number, item in enumerate(shown):
            if item.constant:
                values[:, number] += item.constant
            if item.reaction is not None:
                along = system.lift[:, item.reaction]
                values[:, number] -= self.acting.load_at(self.time, along[:, None])[:, 0]
                if len(self.laws):
                    values[:, number] += self.port_forces @ (
                        self.laws.rows(system.acting_rows, len(along)) @ along
                    )
            for factor, course in item.courses:
                values[:, number] += factor * course.at(self.time)
            if item.reaction is not None or item.courses:
                rates[:, number] = np.gradient(values[:, number], self.time)
        return Response(values, rates)
