"""A linear FMU as a linear system in state space, made from records of its answers to forces and releases."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from warnings import catch_warnings, simplefilter

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import logm

from fe.runtime.arrays import FloatArray, IntArray

ComplexArray = NDArray[np.complex128]
JUMP = 1e-2
"""Share of a port's speed that may come at once with a force: a solver of coarse steps shows a little."""
MOST_STATES = 40
"""Largest order of a linear system that is made from records."""
HANKEL_ROWS, MIXTURES = 64, 3
"""Rows, and mixtures of all outputs in each, in which a system shows its states."""
HANKEL_COLUMNS = 160
INDEPENDENT = 1e5
"""Condition up to which eigenvectors give the logarithm of a matrix, 20 times faster than `logm`."""
THRESHOLDS = 10.0 ** np.arange(-12, -6)
"""Shares of the largest singular value below which one is rounding, one after the other."""
FIT = 1e-7
"""Largest error of a linear system against the record that it is made of, as a share of the record."""


@dataclass(frozen=True, eq=False)
class StateSpace:
    """What E forces f and R releases do to C outputs of a linear FMU, beside what it shows without.

    s' = G s + B f, y = C s + D f, f being that just before where it jumps.

    Attributes
    ----------
    generator, push, outputs, direct, starts : ndarray
        G (n, n) [1/s], B (n, E), C (C, n), D (C, E), and the states (n, R) after unit releases.
    """

    generator: FloatArray
    push: FloatArray
    outputs: FloatArray
    direct: FloatArray
    starts: FloatArray

    def in_state_of(self, base: "StateSpace") -> "StateSpace":
        """Return the same system in the state of another of its order.

        Outputs and their rates say what that state is: those of a structure do not change with its
        parameters, wherever its modes go.
        """
        mine, others = (np.vstack((item.outputs, item.outputs @ item.generator)) for item in (self, base))
        size = _not_zero(np.linalg.norm(others, axis=1, keepdims=True))
        way = np.linalg.lstsq(mine / size, others / size, rcond=None)[0]
        back = np.linalg.inv(way)
        return StateSpace(
            back @ self.generator @ way, back @ self.push, self.outputs @ way, self.direct, back @ self.starts
        )

    def rows(self, columns: Sequence[int], orders: Sequence[int] | int = 0) -> tuple[FloatArray, FloatArray]:
        """Return what outputs, each derived so many times, show of the state (K, n), of forces (K, E)."""
        row, at_once = self.outputs[columns], self.direct[columns]
        for times in (0, 1):
            further = np.broadcast_to(orders, len(columns))[:, None] > times
            at_once = np.where(further, row @ self.push, at_once)
            row = np.where(further, row @ self.generator, row)
        return row, at_once

    def at_rest(self, forces: FloatArray) -> FloatArray:
        """Return the state (n, ...) at rest under forces (E, ...)."""
        return np.asarray(np.linalg.solve(self.generator, -self.push @ forces))

    @property
    def gain(self) -> FloatArray:
        """Outputs (C, E) at rest under unit forces."""
        return np.asarray(self.direct + self.outputs @ self.at_rest(np.eye(self.push.shape[1])))

    @cached_property
    def modes(self) -> tuple[ComplexArray, ComplexArray]:
        """Rates (n,) [1/s] and shapes (n, n) of the modes."""
        rates, shapes = np.linalg.eig(self.generator.astype(complex))
        return rates, shapes

    def _residues(self, column: int, number: int) -> tuple[ComplexArray, ComplexArray]:
        """Return the rates (n,) [1/s] of the modes, and the residues of an output's answer to a force."""
        rates, shapes = self.modes
        into = np.linalg.solve(shapes, self.push[:, number].astype(complex))
        return rates, (self.outputs[column] @ shapes) * into

    def most_flexible(self, column: int, number: int) -> tuple[float, float] | None:
        """Return the mode that gives an output the most at rest under a force; None if none vibrates.

        Its angular frequency [rad/s], and its flexibility between the two [m/N].
        """
        rates, residues = self._residues(column, number)
        frequency, vibrating = np.abs(rates), rates.imag > 1e-9 * np.abs(rates)
        flexible = np.where(vibrating, np.abs(2.0 * rates.imag * residues) / frequency**2, 0.0)
        best = int(np.argmax(flexible))
        return (float(frequency[best]), float(flexible[best])) if vibrating.any() else None

    def stiffness(self, column: int, number: int) -> tuple[float, float]:
        """Return the stiffness of the most flexible mode between output and force, and that at rest [N/m]."""
        at_rest, mode = 1.0 / float(self.gain[column, number]), self.most_flexible(column, number)
        return (at_rest if mode is None or mode[1] * at_rest < 1e-6 else 1.0 / mode[1]), at_rest

    def jumps(self, columns: IntArray, numbers: IntArray) -> bool:
        """Whether the speed of an output jumps with its force, so that laws there find no mass."""
        found = (self._residues(*pair)[1] for pair in zip(columns, numbers, strict=True))
        return any(abs(item.sum()) > JUMP * np.abs(item).sum() for item in found)


def _not_zero(sizes: FloatArray) -> FloatArray:
    return np.where(sizes == 0.0, 1.0, sizes)


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


def realised(records: FloatArray, forces: int, step: float) -> StateSpace | None:
    """Return the linear system of answers to unit forces, held over the first step only, and to releases.

    The realisation of Ho and Kalman (1966) as by Juang and Pappa (1985), from mixtures of the outputs.

    Parameters
    ----------
    records : (K, C, E + R) ndarray
        Outputs at the ends of the steps for each force, then for each release.
    forces : int
        E.
    step : float
        [s].

    Returns
    -------
    FmuSystem or None
        None if no system of at most `MOST_STATES` states shows the records within `FIT`.
    """
    count, columns, inputs = records.shape
    size = _not_zero(np.max(np.abs(records[1:]), axis=(0, 2)))
    amount = _not_zero(np.max(np.abs(records[1:]) / size[:, None], axis=(0, 1)))
    records = records / (size[:, None] * amount)
    seen = np.random.default_rng(1).standard_normal((MIXTURES, columns)) @ records
    height = min(HANKEL_ROWS, (count - 2) // 2)
    width = min(HANKEL_COLUMNS, count - 2 - height)
    both = seen[1 + np.arange(height + 1)[:, None] + np.arange(width)].transpose(0, 2, 1, 3)
    both = both.reshape((height + 1) * MIXTURES, width * inputs)
    hankel, shifted = both[:-MIXTURES], both[MIXTURES:]
    for most in (MOST_STATES // 4, MOST_STATES):
        left, values, right = _largest(hankel, most + 16)
        if values[-1] <= 1e-13 * values[0]:
            break
    goal = records[1:].transpose(0, 2, 1).reshape(-1, columns)
    for order in dict.fromkeys(int(np.sum(values > least * values[0])) for least in THRESHOLDS):
        root = np.sqrt(values[:order])
        transition = (left[:, :order] / root).T @ shifted @ (right[:order].T / root)
        rates = np.linalg.eigvals(transition)
        if not 0 < order <= MOST_STATES or np.max(np.abs(rates)) > 1.0 + 1e-9:
            continue
        drive = np.linalg.lstsq(transition, (root[:, None] * right[:order])[:, :inputs])[0]
        states, power = drive[None], transition
        while len(states) < count:
            states, power = np.concatenate((states, power @ states)), power @ power
        flat = states[1:count].transpose(0, 2, 1).reshape(-1, order)
        unit = np.max(np.abs(flat), axis=0)
        rows = np.linalg.lstsq(flat / unit, goal, rcond=1e-14)[0].T / unit
        error = np.max(np.abs(goal - flat @ rows.T), axis=0)
        if np.all(error <= FIT * np.max(np.abs(goal), axis=0) + 1e-300):
            held, starts = np.split(drive * amount, [forces], axis=1)
            whole = np.block([[transition, held], [np.zeros((forces, order)), np.eye(forces)]])
            generator, push = np.split(_logarithm(whole)[:order] / step, [order], axis=1)
            rows, first = rows * size[:, None], records[0, :, :forces] * size[:, None] * amount[:forces]
            return StateSpace(generator, push, rows, first - rows @ held, np.linalg.solve(transition, starts))
    return None
