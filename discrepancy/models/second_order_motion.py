"""What a structure did in a trial, in modal coordinates, and what sensors on it show of that."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.records import Quantity
from discrepancy.models.interface import Response
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import Laws

FloatArray = NDArray[np.float64]


class Structure(Protocol):
    """What a motion asks of the structure that moved; see `second_order.SecondOrderSystem`."""

    @property
    def relaxation(self) -> float:
        """Delay of the modes without inertia [s]."""

    @property
    def angular_frequency(self) -> FloatArray:
        """Angular frequencies (M,) [rad/s]."""

    @property
    def shapes(self) -> FloatArray:
        """Mass-normalised mode shapes (n, M)."""

    @property
    def truncated(self) -> bool:
        """Whether modes are left out."""

    @property
    def modal(self) -> ModalSystem:
        """The modes with damping and ports."""

    def residual(self, loads: FloatArray) -> FloatArray:
        """Return the displacements by loads (n,) or (n, k) that the modes leave out."""

    def port_rows(self, laws: Laws) -> FloatArray:
        """Return the rows (J, n) of the laws' ports."""


@dataclass(frozen=True)
class Motion:
    """Motion at the samples of a trial.

    Attributes
    ----------
    system : Structure
        What moved.
    time : (N,) ndarray
        Times of the motion since the release or the begin of the force [s].
    q, velocity : (N, M) ndarray
        Modal coordinates and their rates (mass-normalised).
    force : (N,) ndarray
        Applied force [N].
    input_row : (n,) ndarray
        Where it acts.
    port_forces : (N, J) ndarray
        Internal forces.
    lagged : (N, J) ndarray
        Internal forces as omitted modes follow them.
    laws : Laws
        Their laws.
    held : int
        First samples that lie before the release, where the shape is held.
    holding : float
        Force that held the input point until the release [N].
    """

    system: Structure
    time: FloatArray
    q: FloatArray
    velocity: FloatArray
    force: FloatArray
    input_row: FloatArray
    port_forces: FloatArray
    lagged: FloatArray
    laws: Laws
    held: int = 0
    holding: float = 0.0

    @cached_property
    def acceleration(self) -> FloatArray:
        """Second derivatives (N, M) of the modal coordinates, from the equation of motion."""
        square = self.system.angular_frequency**2
        modal = self.system.modal
        acceleration = -self.q * square - self.velocity @ modal.damping.T
        if self.laws.rate != 0.0:
            acceleration -= self.laws.rate * self.time[:, None] * self.q * square
        if len(self.laws):
            acceleration -= self.port_forces @ self.laws.rows(modal.ports, self.q.shape[1])
        if np.any(self.force):
            acceleration += np.outer(self.force, self.input_row @ self.system.shapes)
        acceleration[: self.held] = 0.0
        return np.asarray(acceleration)

    @property
    def _fading(self) -> FloatArray:
        """What is left of a holding force in omitted modes (n,), at the first samples where any is."""
        lag = self.system.relaxation
        count = int(np.searchsorted(self.time, 40.0 * lag, side="right"))
        return np.asarray(np.exp(-np.maximum(self.time[:count], 0.0) / lag))

    def values(self, rows: FloatArray) -> FloatArray:
        """Return row . u (N, C) of rows (C, n).

        Omitted modes follow applied forces without delay, and internal ones and the end of a holding force
        with that of their damping.
        """
        values = self.q @ (rows @ self.system.shapes).T
        if self.system.truncated:
            if np.any(self.force):
                values += np.outer(self.force, rows @ self.system.residual(self.input_row))
            if len(self.laws):
                port_rows = self.system.port_rows(self.laws)
                values -= self.lagged @ (rows @ self.system.residual(port_rows.T)).T
            if self.holding != 0.0 and self.system.relaxation > 0.0:
                fading = self.holding * self._fading
                count = len(fading)
                values[:count] += np.outer(fading, rows @ self.system.residual(self.input_row))
        return np.asarray(values)

    def response(self, rows: FloatArray, quantities: Sequence[Quantity]) -> Response:
        """Return what sensors at rows (C, n) show, and the rates.

        Velocity and acceleration are derivatives of row . u, the other quantities row . u itself. Omitted
        modes are part of values that are not derivatives only.
        """
        modal = rows @ self.system.shapes
        values, rates = np.empty((2, len(self.q), len(rows)))
        jerk: FloatArray | None = None
        still = self.values(rows)
        for column, quantity in enumerate(quantities):
            if quantity is Quantity.VELOCITY:
                values[:, column] = self.velocity @ modal[column]
                rates[:, column] = self.acceleration @ modal[column]
            elif quantity is Quantity.ACCELERATION:
                if jerk is None:
                    jerk = _slope(self.acceleration, self.time)
                values[:, column] = self.acceleration @ modal[column]
                rates[:, column] = jerk @ modal[column]
            else:
                values[:, column] = still[:, column]
                rates[:, column] = self.velocity @ modal[column]
        return Response(values, rates)


def _slope(values: FloatArray, time: FloatArray) -> FloatArray:
    return np.asarray(np.gradient(values, time, axis=0)) if len(time) > 1 else np.zeros_like(values)
