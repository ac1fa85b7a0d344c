"""Runs of an FMU from states that are given: an instance for each step size, kept and reset."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from fe.runtime.arrays import FloatArray
from fmu_asset.errors import FmuOutputError, said
from reporting.memory import Memory

from .binding import Binding
from .session import FmiAsset

MOST_INSTANCES = 8
"""Instances (step sizes) that are open at the same time."""
KEPT_BYTES = 256 * 2**20
"""Results that are remembered."""
SETTLE_CHUNK = 200
"""Steps after which it is asked whether the motion has come to rest."""


class State(NamedTuple):
    """Parameters and constant inputs of a run, sorted by name; by the names of the binding."""

    parameters: tuple[tuple[str, float], ...] = ()
    inputs: tuple[tuple[str, float], ...] = ()

    def having(self, more: Mapping[str, float]) -> "State":
        """Return it with other values of parameters."""
        return self._replace(parameters=tuple(sorted({**dict(self.parameters), **more}.items())))


class Run(NamedTuple):
    """A motion that is asked of an FMU: in which state, communication step [s], how many of them.

    `begin` has what is added to inputs before it, under which the FMU is at rest, `courses` (steps,) what is
    added over its steps.
    """

    state: State
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
        self._assets = Memory(MOST_INSTANCES, end=FmiAsset.close)
        self._kept = Memory(KEPT_BYTES, attrgetter("nbytes"))

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

    def _inputs(self, state: State, more: Mapping[str, float] = MappingProxyType({})) -> dict[str, float]:
        """Return all inputs in a state, with more on some of them."""
        found = {**dict.fromkeys(self._of[1].load, 0.0), **dict(state.inputs)}
        return found | {name: found[name] + value for name, value in more.items()}

    def _opened(self, state: State, step: float, begin: Mapping[str, float]) -> FmiAsset:
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

    def begun(self, run: Run) -> tuple[FmiAsset, FloatArray, dict[str, FloatArray]]:
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

    def followed(self, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion; raises `FmuError`."""
        asset, first, courses = self.begun(run)
        with self.refusals():
            return np.vstack((first, asset.simulate(load=courses, steps=run.steps).values))

    def resting(
        self, states: Sequence[State], loads: Mapping[str, FloatArray], step: float, *, settle: bool
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
