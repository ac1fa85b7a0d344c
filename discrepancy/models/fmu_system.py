"""A linear FMU as a linear system, made from its answers to single forces and releases."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from warnings import catch_warnings, simplefilter

import numpy as np
from scipy.linalg import logm
from scipy.signal import cont2discrete

from discrepancy.campaign.records import FloatArray, Hold
from discrepancy.models.acting import SMOOTH_PARTS, Acting, straight
from discrepancy.models.interface import Memory
from fe.compilation import compiled_kernel
from fe.runtime.arrays import IntArray
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import Laws
from fe.runtime.stepwise import Begin, advance, steps_under, substeps

KEPT = 16
"""Lengths of steps, and sets of ports, that a system keeps."""
MOST_STATES = 40
"""Largest order of a linear system that is made from records."""
HANKEL_ROWS, MIXTURES = 64, 3
"""Rows, and mixtures of all outputs in each, in which a system shows its states."""
HANKEL_COLUMNS = 160
INDEPENDENT = 1e5
"""Condition up to which eigenvectors give the logarithm of a matrix, 20 times faster than `logm`."""
FIT = 1e-7
"""Largest error of a linear system against the record that it is made of, as a share of the record."""
ROUNDING = 1e-9
"""Share of the displacement at rest below which what a force moves at once is rounding."""


@dataclass(frozen=True, eq=False)
class FmuSystem:
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
    _kept: Memory = field(default_factory=lambda: Memory(KEPT), init=False, repr=False)

    def in_state_of(self, base: "FmuSystem") -> "FmuSystem":
        """Return the same system in the state of another of its order.

        Outputs and their rates say what that state is: those of a structure do not change with its
        parameters, wherever its modes go.
        """
        mine, others = (np.vstack((item.outputs, item.outputs @ item.generator)) for item in (self, base))
        size = np.linalg.norm(others, axis=1, keepdims=True)
        size[size == 0.0] = 1.0
        way = np.linalg.lstsq(mine / size, others / size, rcond=None)[0]
        back = np.linalg.inv(way)
        return FmuSystem(
            back @ self.generator @ way, back @ self.push, self.outputs @ way, self.direct, back @ self.starts
        )

    def rows(self, columns: Sequence[int], orders: Sequence[int] | int = 0) -> tuple[FloatArray, FloatArray]:
        """Return what outputs, each derived so many times, show of the state (K, n), of forces (K, E)."""
        row, at_once = self.outputs[columns], self.direct[columns]
        for times in (0, 1):
            further = np.broadcast_to(orders, len(columns))[:, None] > times
            row, at_once = (
                np.where(further, row @ self.generator, row),
                np.where(further, row @ self.push, at_once),
            )
        return row, at_once

    def at_rest(self, forces: FloatArray) -> FloatArray:
        """Return the state (n, ...) at rest under forces (E, ...)."""
        return np.asarray(np.linalg.solve(self.generator, -self.push @ forces))

    @property
    def gain(self) -> FloatArray:
        """Outputs (C, E) at rest under unit forces."""
        return np.asarray(self.direct + self.outputs @ self.at_rest(np.eye(self.push.shape[1])))

    def most_flexible(self, column: int, number: int) -> tuple[float, float] | None:
        """Return the mode that gives an output the most at rest under a force; None if none vibrates.

        Its angular frequency [rad/s], and the squared shape that both see [1/kg].
        """
        rates, shapes = np.linalg.eig(self.generator)
        into = np.linalg.solve(shapes, self.push[:, number].astype(complex))
        residues = (self.outputs[column] @ shapes) * into
        found = [
            (float(abs(rate)), float(abs(2.0 * rate.imag * residue)))
            for rate, residue in zip(rates, residues, strict=True)
            if rate.imag > 1e-9 * abs(rate)
        ]
        return max(found, key=lambda mode: mode[1] / mode[0] ** 2, default=None)

    # ------------------------------------------------------------ motion

    def stepped(self, start: FloatArray, forces: FloatArray, step: float) -> FloatArray:
        """Return the outputs (N + 1, C) from a state under forces (N, E) held over steps [s]."""
        system = self.generator, self.push, self.outputs, self.direct
        transition, drive = self._kept.get(step, lambda: cont2discrete(system, step)[:2])
        states = np.vstack((start, forces @ drive.T))
        for k in range(len(forces)):
            states[k + 1] += transition @ states[k]
        return np.asarray(states @ self.outputs.T + np.vstack((forces[:1], forces)) @ self.direct.T)

    def motion(
        self, acting: Acting, start: FloatArray, still: FloatArray, laws: Laws, columns: IntArray,
        numbers: IntArray, refinement: int,
    ) -> tuple[FloatArray, FloatArray]:  # fmt: skip
        """Return states (N, n) and forces (N, E) at the times of what acts, with laws at ports.

        Position and speed of a law's port are coordinates beside the state, from which they follow: so laws
        act on this system as on any other.

        Parameters
        ----------
        acting : Acting
            Forces, in rows (E,).
        start : (n,) ndarray
            State at the first time.
        still : (J,) ndarray
            Position of each law's port without forces.
        laws : Laws
            J internal forces.
        columns, numbers : (J,) ndarray of int
            Column of the displacement, and number of the force, of each law's port.
        refinement : int
            Steps with laws are this many times smaller.
        """
        key = (laws.ports, columns.tobytes(), numbers.tobytes())
        acts, modal, law = self._kept.get(key, lambda: self._with_ports(laws.ports, columns, numbers))
        smooth = any(course.hold is Hold.SMOOTH for _, course, _ in acting.loads)
        boundaries = substeps(modal, laws, acting.sampled, refinement, SMOOTH_PARTS if smooth else 1)
        begin, end = straight(lambda time: acting.load_at(time, acts.T), boundaries.time)
        feed = acting.load_at(boundaries.time, self.direct[columns].T)
        seen = self.outputs[columns[law]]
        first = Begin(
            np.concatenate((seen @ start + still[law], 0.0 * start)),
            np.concatenate((seen @ self.generator @ start, start)),
        )
        steps = steps_under(modal, boundaries, begin, end, feed)
        found = advance(modal, laws, steps, first, compiled_kernel())
        forces = acting.load_at(acting.sampled, np.eye(self.push.shape[1]))
        np.subtract.at(forces.T, numbers, found.port_forces.T)
        return found.v[:, len(law) :], forces

    def _with_ports(
        self, names: tuple[str, ...], columns: IntArray, numbers: IntArray
    ) -> tuple[FloatArray, ModalSystem, IntArray]:
        """Return along what forces act (N, E), the system of ports and state, and a law of each port."""
        places, law = np.unique(names, return_index=True)
        count, order = len(law), len(self.generator)
        seen = self.outputs[columns[law]] @ self.generator
        acts = np.vstack((seen @ self.push, self.push))
        damping = np.zeros((count + order, count + order))
        damping[:, count:] = -np.vstack((seen @ self.generator, self.generator))
        at_once, gain = (item[columns[law], numbers[law]] for item in (self.direct, self.gain))
        modal = ModalSystem(
            np.zeros(count + order), damping, dict(zip(places, np.eye(count, count + order), strict=True)),
            np.where(at_once > ROUNDING * gain, at_once, 0.0),
            actions=dict(zip(places, acts.T[numbers[law]], strict=True)),
        )  # fmt: skip
        return acts, modal, law


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


def fmu_system(records: FloatArray, forces: int, step: float) -> FmuSystem | None:
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
    size = np.max(np.abs(records[1:]), axis=(0, 2), keepdims=True)
    size[size == 0.0] = 1.0
    amount = np.max(np.abs(records[1:]) / size, axis=(0, 1))
    amount[amount == 0.0] = 1.0
    records = records / (size * amount)
    mixing = np.random.default_rng(1).standard_normal((MIXTURES, columns))
    seen, height = mixing @ records, min(HANKEL_ROWS, (count - 2) // 2)
    width = min(HANKEL_COLUMNS, count - 2 - height)
    both = seen[1 + np.arange(height + 1)[:, None] + np.arange(width)].transpose(0, 2, 1, 3)
    both = both.reshape((height + 1) * MIXTURES, width * inputs)
    hankel, shifted = both[:-MIXTURES], both[MIXTURES:]
    for most in (MOST_STATES // 4, MOST_STATES):
        left, values, right = _largest(hankel, most + 16)
        if values[-1] <= 1e-13 * values[0]:
            break
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
        states, power = drive[None], transition
        while len(states) < count:
            states, power = np.concatenate((states, power @ states)), power @ power
        states = states[:count]
        flat = states[1:].transpose(0, 2, 1).reshape(-1, order)
        goal = records[1:].transpose(0, 2, 1).reshape(-1, columns)
        unit = np.max(np.abs(flat), axis=0)
        rows = np.linalg.lstsq(flat / unit, goal, rcond=1e-14)[0].T / unit
        error = np.max(np.abs(goal - flat @ rows.T), axis=0)
        if np.all(error <= FIT * np.max(np.abs(goal), axis=0) + 1e-300):
            held, starts = np.split(drive * amount, [forces], axis=1)
            whole = np.block([[transition, held], [np.zeros((forces, order)), np.eye(forces)]])
            generator, push = np.split(_logarithm(whole)[:order] / step, [order], axis=1)
            rows, first = rows * size[0], records[0] * size[0] * amount
            starts = np.linalg.solve(transition, starts)
            return FmuSystem(generator, push, rows, first[:, :forces] - rows @ held, starts)
    return None
