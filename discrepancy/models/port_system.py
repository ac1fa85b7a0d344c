"""The ports of a linear FMU as a linear system, made from its answers to single forces."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from warnings import catch_warnings, simplefilter

import numpy as np
from scipy.linalg import logm
from scipy.signal import cont2discrete

from discrepancy.campaign.records import FloatArray
from discrepancy.models.interface import Memory

KEPT_STEPS = 16
MOST_STATES = 40
"""Largest order of a linear system that is made from records."""
HANKEL_ROWS = 160
INDEPENDENT = 1e5
"""Condition up to which eigenvectors give the logarithm of a matrix, 20 times faster than `logm`."""
LINEAR = 1e-6
"""Largest deviation from superposition, as a share of the motion, of an FMU that is taken as linear."""
FIT = 1e-7
"""Largest error of a linear system against the record that it is made of, as a share of the record."""


@dataclass(frozen=True, eq=False)
class PortSystem:
    """What forces f at P ports do to C outputs of a linear FMU, beside its free motion.

    s' = G s + B f, y = C s + D f, f being that just before where it jumps.

    Attributes
    ----------
    generator, push, outputs, direct : ndarray
        G (n, n) [1/s], B (n, P), C (C, n), D (C, P).
    """

    generator: FloatArray
    push: FloatArray
    outputs: FloatArray
    direct: FloatArray
    _steps: Memory = field(default_factory=lambda: Memory(KEPT_STEPS), init=False, repr=False)

    def over(self, step: float) -> tuple[FloatArray, FloatArray]:
        """Return A (n, n) and B (n, P) of s(k+1) = A s(k) + B f(k), f held over steps [s]."""
        system = self.generator, self.push, self.outputs, self.direct
        found: tuple[FloatArray, FloatArray] = self._steps.get(step, lambda: cont2discrete(system, step)[:2])
        return found

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
        return PortSystem(back @ self.generator @ way, back @ self.push, self.outputs @ way, self.direct)

    def rows(self, shown: Sequence[tuple[int, int]]) -> tuple[FloatArray, FloatArray]:
        """Return what outputs show of the state (K, n), and of forces at once (K, P).

        `shown` holds their columns, and how often each is derived.
        """
        rows, at_once = np.empty((len(shown), len(self.push))), np.empty((len(shown), self.push.shape[1]))
        for number, (column, times) in enumerate(shown):
            row, once = self.outputs[column], self.direct[column]
            for _ in range(times):
                row, once = row @ self.generator, row @ self.push
            rows[number], at_once[number] = row, once
        return rows, at_once

    def of_ports(self, x: Sequence[int], v: Sequence[int]) -> "PortSystem":
        """Return it with 2 P outputs, displacements and speeds of the ports by their columns; -1: none."""
        speeds = [(fast, 0) if fast >= 0 else (slow, 1) for slow, fast in zip(x, v, strict=True)]
        rows, at_once = self.rows([*((column, 0) for column in x), *speeds])
        return replace(self, outputs=rows, direct=at_once)

    def motion(self, forces: FloatArray, step: float) -> FloatArray:
        """Return the outputs (N + 1, C) under forces (N, P) that are held over steps [s], from rest."""
        transition, drive = self.over(step)
        states = np.vstack((np.zeros(len(transition)), forces @ drive.T))
        for before, after in pairwise(states):
            after += transition @ before
        return self.seen(states, forces)

    def seen(
        self, states: FloatArray, forces: FloatArray, columns: Sequence[int] | slice = slice(None)
    ) -> FloatArray:
        """Return columns of the outputs (N + 1, L) of states (N + 1, n) and forces (N, P)."""
        values = states @ self.outputs[columns].T
        values[1:] += forces @ self.direct[columns].T
        return np.asarray(values)

    def starting(self, shown: int, step: float, count: int) -> FloatArray:
        """Return what tells the state (n, K * L) by L first outputs at the ends of K free steps [s]."""
        transition, _ = self.over(step)
        rows, power = (self.outputs[:shown] @ transition)[np.newaxis], transition
        while len(rows) < count:
            rows, power = np.concatenate((rows, rows @ power)), power @ power
        flat = rows[:count].reshape(-1, len(transition))
        unit = np.max(np.abs(flat), axis=0)
        unit[unit == 0.0] = 1.0
        return np.asarray(np.linalg.pinv(flat / unit, rcond=1e-14) / unit[:, None])

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


def _logarithm(transition: FloatArray) -> FloatArray:
    values, shapes = np.linalg.eig(transition)
    if np.linalg.cond(shapes) < INDEPENDENT:
        return np.asarray(np.real((shapes * np.log(values.astype(complex))) @ np.linalg.inv(shapes)))
    with catch_warnings():  # of rounding in what decays within a step
        simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.real(logm(transition)))


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
            whole = np.block([[transition, drive], [np.zeros((inputs, order)), np.eye(inputs)]])
            generator, push = np.split(_logarithm(whole)[:order] / step, [order], axis=1)
            return PortSystem(generator, push, rows, records[0] - rows @ drive)
    return None
