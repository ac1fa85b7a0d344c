"""Runs of an FMU from states that are given, and the linear system that its answers show, if it is one.

An instance for each step size is kept and reset.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple
from warnings import catch_warnings, simplefilter

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import logm

from fe.runtime.arrays import FloatArray, IntArray
from fmu_asset.errors import FmuOutputError, said
from reporting.memory import ResultCache

from .binding import Binding
from .session import FmiAsset

MOST_INSTANCES = 8
"""Instances (step sizes) that are open at the same time."""
KEPT_BYTES = 256 * 2**20
"""Results that are remembered."""
SETTLE_CHUNK = 200
"""Steps after which it is asked whether the motion has come to rest."""


class OperatingPoint(NamedTuple):
    """Parameters and constant inputs of a run, sorted by name; by the names of the binding."""

    parameters: tuple[tuple[str, float], ...] = ()
    inputs: tuple[tuple[str, float], ...] = ()

    def having(self, more: Mapping[str, float]) -> "OperatingPoint":
        """Return it with other values of parameters."""
        return self._replace(parameters=tuple(sorted({**dict(self.parameters), **more}.items())))


class FmuRun(NamedTuple):
    """A motion that is asked of an FMU: in which state, communication step [s], how many of them.

    `begin` has what is added to inputs before it, under which the FMU is at rest, `courses` (steps,) what is
    added over its steps.
    """

    state: OperatingPoint
    step: float
    steps: int
    begin: Mapping[str, float] = MappingProxyType({})
    courses: Mapping[str, FloatArray] = MappingProxyType({})


class FmuRuns:
    """An FMU that is asked again and again.

    Parameters
    ----------
    path : Path
        The FMU.
    binding : Binding
        All inputs that are set are its loads; one that nothing is said of is zero.
    isolated : bool
        Whether instances run in processes of their own.
    limit : float
        Longest motion that is waited for until it rests [s].
    tolerance : float
        At rest, no output moves by more than this share of its largest value.
    """

    refusals: Callable[[], AbstractContextManager[None]] = nullcontext
    """What is said of refusals, where somebody has more to say."""

    def __init__(self, path: Path, binding: Binding, isolated: bool, limit: float, tolerance: float) -> None:
        self._of, self._limit, self._tolerance = (path, binding, isolated), limit, tolerance
        self._assets = ResultCache(MOST_INSTANCES, end=FmiAsset.close)
        self._kept = ResultCache(KEPT_BYTES, attrgetter("nbytes"))

    @cached_property
    def asset(self) -> FmiAsset:
        """The door to the FMU, for what it declares.

        Raises
        ------
        FmuError
            If the FMU is missing, or the binding does not fit it.
        """
        path, binding, isolated = self._of
        return FmiAsset(path, binding, isolated=isolated)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the door, which another process opens itself."""
        return {name: value for name, value in vars(self).items() if name != "asset"}

    def remembered(self, key: Hashable, make: Callable[[], FloatArray]) -> FloatArray:
        """Return what `make` returned for `key`; the oldest results are forgotten."""
        found = self._kept.get(key, make)
        found.setflags(write=False)
        return found

    def close(self) -> None:
        """End all instances; they are opened again when they are needed."""
        self._assets.clear()

    def size(self, name: str) -> float:
        """Return a value that an input can have, both signs."""
        low, high = self.asset.input_range("load", name)
        return min(1.0, 0.1 * abs(low), 0.1 * abs(high))

    def _inputs(
        self, state: OperatingPoint, more: Mapping[str, float] = MappingProxyType({})
    ) -> dict[str, float]:
        """Return all inputs in a state, with more on some of them."""
        found = {**dict.fromkeys(self._of[1].load, 0.0), **dict(state.inputs)}
        return found | {name: found[name] + value for name, value in more.items()}

    def _opened(self, state: OperatingPoint, step: float, begin: Mapping[str, float]) -> FmiAsset:
        """Return the instance of a step size [s] at its start."""
        path, binding, isolated = self._of
        own = binding.with_header(step_size=step)
        asset = self._assets.get(step, lambda: FmiAsset(path, own, isolated=isolated))
        asset.reset(dict(state.parameters), load=self._inputs(state, begin) or None)
        return asset

    def _settled(self, asset: FmiAsset) -> FloatArray:
        """Return the outputs (C,) of an instance that comes to rest under its inputs."""
        waited, largest = 0.0, 0.0
        while True:
            block = asset.simulate(steps=SETTLE_CHUNK).values
            waited += SETTLE_CHUNK * asset.binding.step_size
            high, low = block.max(axis=0), block.min(axis=0)
            largest = np.maximum(largest, np.abs(block).max(axis=0))
            if np.all(high - low <= self._tolerance * largest):
                return np.asarray(0.5 * (high + low))
            if waited >= self._limit:
                worst = int(np.argmax((high - low) / np.where(largest > 0.0, largest, 1.0)))
                output, moves = asset.binding.observation_variables[worst], high[worst] - low[worst]
                raise FmuOutputError(said("running.unrest", limit=self._limit, output=output, moves=moves))

    def begun(self, run: FmuRun) -> tuple[FmiAsset, FloatArray, dict[str, FloatArray]]:
        """Return an instance at the begin of a motion, its outputs there, and the inputs (steps,) to come.

        Raises
        ------
        FmuError
            If the FMU refuses, or does not come to rest.
        """
        courses = {name: value + np.zeros(run.steps) for name, value in self._inputs(run.state).items()}
        courses |= {name: courses[name] + values for name, values in run.courses.items()}
        with self.refusals():
            asset = self._opened(run.state, run.step, run.begin)
            first = self._settled(asset) if any(run.begin.values()) else np.array(asset.observe().values)
        return asset, first, courses

    def followed(self, run: FmuRun) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion; raises `FmuError`."""
        asset, first, courses = self.begun(run)
        with self.refusals():
            return np.vstack((first, asset.simulate(load=courses, steps=run.steps).values))

    def resting(
        self, states: Sequence[OperatingPoint], loads: Mapping[str, FloatArray], step: float, *, settle: bool
    ) -> FloatArray:
        """Return the outputs (L, C) at rest in states that differ in inputs, under more (L,) on some.

        With `settle` the motion in each is followed until it rests; else a step [s] gives the equilibrium.
        """
        more = [{name: float(values[row]) for name, values in loads.items()} for row in range(len(states))]
        with self.refusals():
            if settle:
                pairs = zip(states, more, strict=True)
                return np.array([self._settled(self._opened(state, step, own)) for state, own in pairs])
            rows = [self._inputs(*pair) for pair in zip(states, more, strict=True)]
            courses = {name: np.array([row[name] for row in rows]) for name in rows[0]}
            return self._opened(states[0], step, more[0]).simulate(load=courses, steps=len(rows)).values


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
class FmuStateSpace:
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

    def in_state_of(self, base: "FmuStateSpace") -> "FmuStateSpace":
        """Return the same system in the state of another of its order.

        Outputs and their rates say what that state is: those of a structure do not change with its
        parameters, wherever its modes go.
        """
        mine, others = (np.vstack((item.outputs, item.outputs @ item.generator)) for item in (self, base))
        size = _not_zero(np.linalg.norm(others, axis=1, keepdims=True))
        way = np.linalg.lstsq(mine / size, others / size, rcond=None)[0]
        back = np.linalg.inv(way)
        return FmuStateSpace(
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


def realise_state_space(records: FloatArray, forces: int, step: float) -> FmuStateSpace | None:
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
            return FmuStateSpace(
                generator, push, rows, first - rows @ held, np.linalg.solve(transition, starts)
            )
    return None
