"""The ports of a linear FMU as a linear system, made from its answers to single forces."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from warnings import catch_warnings, simplefilter

import numpy as np
from scipy.linalg import expm, logm

from discrepancy.campaign.records import FloatArray
from discrepancy.models.interface import PortedSystem

MOST_STATES = 40
"""Largest order of a linear system that is made from records."""
HANKEL_ROWS = 160
INDEPENDENT = 1e5
"""Condition up to which eigenvectors give the logarithm of a matrix, 20 times faster than `logm`."""
FIT = 1e-7
"""Largest error of a linear system against the record that it is made of, as a share of the record."""


@dataclass(frozen=True, eq=False)
class PortSystem:
    """What forces at P ports do to C outputs of a linear FMU, step by step, beside its free motion.

    s(k+1) = A s(k) + B f(k), y(k+1) = C s(k+1) + D f(k), f held over the step.

    Attributes
    ----------
    transition, drive, outputs, direct : ndarray
        A (n, n), B (n, P), C (C, n), D (C, P).
    step : float
        [s].
    """

    transition: FloatArray
    drive: FloatArray
    outputs: FloatArray
    direct: FloatArray
    step: float

    @cached_property
    def generator(self) -> FloatArray:
        """Matrix (n, n) of the motion in time, s' = G s without forces [1/s]."""
        values, shapes = np.linalg.eig(self.transition)
        if np.linalg.cond(shapes) < INDEPENDENT:
            logarithm = (shapes * np.log(values.astype(complex))) @ np.linalg.inv(shapes)
            return np.asarray(np.real(logarithm) / self.step)
        with catch_warnings():  # of rounding in what decays within a step
            simplefilter("ignore", RuntimeWarning)
            return np.asarray(np.real(logm(self.transition)) / self.step)

    @property
    def largest_turn(self) -> float:
        """Largest turn of a mode in a step [rad]; beyond pi it would look like a smaller one."""
        return float(np.max(np.abs(np.angle(np.linalg.eigvals(self.transition)))))

    @cached_property
    def push(self) -> FloatArray:
        """Matrix (n, P) by which forces act in time, s' = G s + push f."""
        return np.asarray(np.linalg.solve(self._over(self.step)[1], self.drive))

    def _over(self, step: float) -> tuple[FloatArray, FloatArray]:
        """Return the transition (n, n) of a step [s], and its integral over the step."""
        order = len(self.transition)
        block = np.zeros((2 * order, 2 * order))
        block[:order, :order], block[:order, order:] = self.generator, np.eye(order)
        whole = expm(block * step)
        return whole[:order, :order], whole[:order, order:]

    def refined(self, parts: int) -> "PortSystem":
        """Return the same system with steps that are so many times smaller."""
        transition, integral = self._over(self.step / parts)
        finer = PortSystem(transition, integral @ self.push, self.outputs, self.direct, self.step / parts)
        vars(finer)["generator"] = self.generator  # the motion in time is the same
        return finer

    def in_state_of(self, base: "PortSystem") -> "PortSystem":
        """Return the same system in the state of another of its order.

        Outputs and their rates say what that state is: those of a structure do not change with its
        parameters, wherever its modes go.
        """
        mine, others = (np.vstack((item.outputs, item.outputs @ item.generator)) for item in (self, base))
        size = np.linalg.norm(others, axis=1, keepdims=True)
        size[size == 0.0] = 1.0
        way = np.linalg.lstsq(mine / size, others / size, rcond=None)[0]
        back = np.linalg.inv(way)
        found = PortSystem(
            back @ self.transition @ way, back @ self.drive, self.outputs @ way, self.direct, self.step
        )
        vars(found)["generator"], vars(found)["push"] = back @ self.generator @ way, back @ self.push
        return found

    def ported(
        self,
        ports: tuple[str, ...],
        at: Sequence[int],
        speeds: Sequence[int],
        shown: Sequence[tuple[int, int]],
    ) -> PortedSystem:
        """Return it as the system by which outputs see missing forces.

        Parameters
        ----------
        ports : tuple of str
            Names.
        at, speeds : sequence of int
            Columns of the ports' displacements and velocities; -1: there is no velocity.
        shown : sequence of (int, int)
            Columns of the outputs, and how often each is derived.
        """
        position, _, speed, _ = self.port_rows(at, speeds)
        rows, at_once = self.rows(shown)
        return PortedSystem(self.generator, ports, self.push.T, position, speed, rows, at_once.T)

    def rows(self, shown: Sequence[tuple[int, int]]) -> tuple[FloatArray, FloatArray]:
        """Return what outputs, see `ported`, show of the state (K, n), and of forces at once (K, P)."""
        rows, at_once = np.empty((len(shown), len(self.push))), np.empty((len(shown), self.push.shape[1]))
        for number, (column, times) in enumerate(shown):
            row, once = self.outputs[column], self.direct[column]
            for _ in range(times):
                row, once = row @ self.generator, row @ self.push
            rows[number], at_once[number] = row, once
        return rows, at_once

    def port_rows(self, at: Sequence[int], speeds: Sequence[int]) -> tuple[FloatArray, ...]:
        """Return what `rows` does of the ports' positions, then of their speeds; columns as in `ported`."""
        moving = [(v, 0) if v >= 0 else (x, 1) for x, v in zip(at, speeds, strict=True)]
        return *self.rows([(x, 0) for x in at]), *self.rows(moving)

    def motion(self, forces: FloatArray) -> FloatArray:
        """Return the outputs (N + 1, C) under forces (N, P), from rest."""
        states = np.zeros((len(forces) + 1, len(self.transition)))
        for k, force in enumerate(forces):
            states[k + 1] = self.transition @ states[k] + self.drive @ force
        return self.seen(states, forces)

    def seen(self, states: FloatArray, forces: FloatArray) -> FloatArray:
        """Return the outputs (N + 1, C) of states (N + 1, n) and forces (N, P)."""
        values = states @ self.outputs.T
        values[1:] += forces @ self.direct.T
        return np.asarray(values)

    def start_of(self, free: FloatArray, tolerance: float) -> FloatArray | None:
        """Return the state (n,) from which the system moves as `free` (K, C), None if it does not.

        The first row of `free` does not count: what holds the structure until then may act on outputs.
        """
        free = free[1:]
        rows, power = (self.outputs @ self.transition)[np.newaxis], self.transition
        while len(rows) < len(free):
            rows, power = np.concatenate((rows, rows @ power)), power @ power
        rows = rows[: len(free)]
        size = np.max(np.abs(free), axis=0)
        weight = 1.0 / np.where(size > 0.0, size, 1.0)
        flat = (rows * weight[:, None]).reshape(-1, len(self.transition))
        unit = np.max(np.abs(flat), axis=0)
        unit[unit == 0.0] = 1.0
        goal = (free * weight).ravel()
        start = np.linalg.lstsq(flat / unit, goal, rcond=1e-14)[0]
        if np.max(np.abs(flat / unit @ start - goal)) > tolerance:
            return None
        return np.asarray(start / unit)

    def free(self, start: FloatArray, steps: int) -> FloatArray:
        """Return the free motion (steps + 1, C) from a state (n,)."""
        states, power = start[np.newaxis], self.transition
        while len(states) <= steps:
            states, power = np.concatenate((states, states @ power.T)), power @ power
        return np.asarray(states[: steps + 1] @ self.outputs.T)

    def gain(self) -> FloatArray:
        """Return the outputs (C, P) at rest under constant unit forces."""
        still = np.linalg.solve(np.eye(len(self.transition)) - self.transition, self.drive)
        return np.asarray(self.outputs @ still + self.direct)

    def most_flexible(self, column: int, port: int) -> tuple[float, float] | None:
        """Return the mode that gives an output the most at rest under a port's force; None if none vibrates.

        Its angular frequency [rad/s], and the squared shape that both see [1/kg].
        """
        rates, shapes = np.linalg.eig(self.generator)
        into = np.linalg.solve(shapes, self.push[:, port].astype(complex))
        residues = (self.outputs[column] @ shapes) * into
        found = [
            (float(abs(rate)), float(abs(2.0 * rate.imag * residue)))
            for rate, residue in zip(rates, residues, strict=True)
            if rate.imag > 1e-9 * abs(rate)
        ]
        return max(found, key=lambda mode: mode[1] / mode[0] ** 2, default=None)


def _largest(matrix: FloatArray, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the singular vectors and values of a matrix, the largest ones only where there are more.

    From its image of random vectors (Halko, Martinsson and Tropp 2011). The caller uses values far above the
    rounding of the first alone, so that what is left out changes nothing but rounding.
    """
    if min(matrix.shape) <= count:
        return np.linalg.svd(matrix, full_matrices=False)
    random = np.random.default_rng(0).standard_normal((matrix.shape[1], count))
    image = np.linalg.qr(matrix @ random)[0]
    left, values, right = np.linalg.svd(image.T @ matrix, full_matrices=False)
    return image @ left, values, right


def port_system(records: FloatArray, ports: list[int], step: float) -> PortSystem | None:
    """Return the linear system of answers to unit forces that are held over the first step only.

    The realisation of Ho and Kalman (1966) as by Juang and Pappa (1985), from the displacements of the ports.

    Parameters
    ----------
    records : (K, C, P) ndarray
        Outputs at the ends of the steps for a force at each port.
    ports : list of int
        Columns of the ports' displacements.
    step : float
        [s].

    Returns
    -------
    PortSystem or None
        None if no system of at most `MOST_STATES` states shows the records within `FIT`.
    """
    count, columns, inputs = records.shape
    size = np.max(np.abs(records), axis=(0, 2))
    seen = records[:, ports, :] / np.where(size[ports] > 0.0, size[ports], 1.0)[None, :, None]
    width = min(HANKEL_ROWS, (count - 2) // 2)
    if width < 4:
        return None
    row = np.arange(width)
    both = seen[1 + np.arange(width + 1)[:, None] + row].transpose(0, 2, 1, 3)
    both = both.reshape((width + 1) * len(ports), width * inputs)
    hankel, shifted = both[: -len(ports)], both[len(ports) :]
    left, values, right = _largest(hankel, MOST_STATES + 16)
    if values[0] == 0.0:
        return None
    tried = 0
    for threshold in (1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7):
        order = int(np.sum(values > threshold * values[0]))
        if order == tried or order > MOST_STATES:
            continue
        tried = order
        root = np.sqrt(values[:order])
        transition = (left[:, :order] / root).T @ shifted @ (right[:order].T / root)
        if np.max(np.abs(np.linalg.eigvals(transition))) > 1.0 + 1e-9:
            continue
        try:
            drive = np.linalg.solve(transition, (root[:, None] * right[:order])[:, :inputs])
        except np.linalg.LinAlgError:
            continue
        states = np.empty((count, order, inputs))
        states[0] = drive
        for k in range(1, count):
            states[k] = transition @ states[k - 1]
        flat = states[1:].transpose(0, 2, 1).reshape(-1, order)
        goal = records[1:].transpose(0, 2, 1).reshape(-1, columns)
        unit = np.max(np.abs(flat), axis=0)
        rows = np.linalg.lstsq(flat / unit, goal, rcond=1e-14)[0].T / unit
        error = np.max(np.abs(goal - flat @ rows.T), axis=0)
        if np.all(error <= FIT * np.max(np.abs(goal), axis=0) + 1e-300):
            return PortSystem(transition, drive, rows, records[0] - rows @ drive, step)
    return None
