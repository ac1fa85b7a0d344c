"""Repeated runs of an FMU from given starts.

A model of a campaign needs thousands of short simulations and equilibria of its FMU. One instance
for each step size stays open and is reset, and results are cached.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from fe.runtime.arrays import FloatArray
from fmu_asset.errors import FmuOutputError
from reporting.system.memory import ResultCache

from .binding import Binding
from .session import FmiAsset

MOST_INSTANCES = 8
"""Instances (step sizes) that are open at the same time."""
CACHE_BYTES = 256 * 2**20
"""Largest memory of the results that are kept [bytes]."""
SETTLE_CHUNK = 200
"""Number of steps after which it is checked whether the motion has come to rest."""
NO_OFFSETS: Mapping[str, float] = MappingProxyType({})


def _close_asset(asset: object) -> None:
    """Close an asset that the cache drops."""
    if isinstance(asset, FmiAsset):
        asset.close()


class OperatingPoint(NamedTuple):
    """Parameters and constant inputs of a run, as sorted pairs of name and value."""

    parameters: tuple[tuple[str, float], ...] = ()
    inputs: tuple[tuple[str, float], ...] = ()

    def with_parameters(self, values: Mapping[str, float]) -> "OperatingPoint":
        """Return the operating point with changed values of some parameters."""
        parameters = {**dict(self.parameters), **values}
        return self._replace(parameters=tuple(sorted(parameters.items())))


class FmuRun(NamedTuple):
    """A simulation of an FMU that starts at rest.

    Attributes
    ----------
    step : float
        Communication step size [s].
    initial_offsets : mapping of str to float
        Values that are added to the constant inputs before the run, which starts from rest under
        these inputs.
    offsets : mapping of str to (steps,) array
        Values that are added to the constant inputs in each step of the run.
    """

    operating_point: OperatingPoint
    step: float
    steps: int
    initial_offsets: Mapping[str, float] = NO_OFFSETS
    offsets: Mapping[str, FloatArray] = MappingProxyType({})


class FmuRuns:
    """Simulates an FMU many times; instances stay open, and results are cached.

    Parameters
    ----------
    binding : Binding
        Binding of the FMU. The inputs of a run are its loads; they are zero unless the run gives a
        value.
    limit : float
        Longest simulation until rest [s].
    tolerance : float
        Largest variation of an output that counts as rest, as a fraction of its largest absolute
        value.
    """

    def __init__(
        self, path: Path, binding: Binding, isolated: bool, limit: float, tolerance: float
    ) -> None:
        self._path = path
        self._binding = binding
        self._isolated = isolated
        self._limit = limit
        self._tolerance = tolerance
        self._assets = ResultCache(MOST_INSTANCES, end=_close_asset)
        self._results = ResultCache(CACHE_BYTES, attrgetter("nbytes"))

    def refusal_context(self) -> AbstractContextManager[None]:
        """Return a context for calls of the FMU; a subclass can add a remark to errors there."""
        return nullcontext()

    @cached_property
    def asset(self) -> FmiAsset:
        """The FMU with its binding, which is not run but shows what the FMU declares.

        Raises
        ------
        FmuError
            If the FMU is missing, or the binding does not fit it.
        """
        return FmiAsset(self._path, self._binding, isolated=self._isolated)

    def __getstate__(self) -> dict[str, object]:
        """Return the state for another process, without the asset, which it opens anew."""
        return {name: value for name, value in vars(self).items() if name != "asset"}

    def cached(self, key: Hashable, compute: Callable[[], FloatArray]) -> FloatArray:
        """Return the result for a key, computed at the first call.

        If the results need too much memory, old ones are dropped and then computed again.
        """
        result = self._results.get(key, compute)
        result.setflags(write=False)
        return result

    def close(self) -> None:
        """Close all instances; they are opened again when they are needed."""
        self._assets.clear()

    def probing_amplitude(self, name: str) -> float:
        """Return the amplitude by which a test of linearity varies a load in both directions.

        It is 1 in the binding's unit, or a tenth of the smaller limit of the load if that is less.
        """
        low, high = self.asset.input_range("load", name)
        return min(1.0, 0.1 * abs(low), 0.1 * abs(high))

    def start_run(self, run: FmuRun) -> tuple[FmiAsset, FloatArray, dict[str, FloatArray]]:
        """Return an instance at the start of a run, with its outputs and the inputs of all steps.

        Returns
        -------
        asset : FmiAsset
            The instance; if there are initial offsets, at rest under them.
        outputs : (C,) ndarray
            Its outputs at the start.
        inputs : dict of str to (steps,) ndarray
            Each input in each step.

        Raises
        ------
        FmuError
            If the FMU fails, or does not come to rest.
        """
        constant_inputs = self._constant_inputs(run.operating_point, NO_OFFSETS)
        inputs = {name: value + np.zeros(run.steps) for name, value in constant_inputs.items()}
        for name, offsets in run.offsets.items():
            inputs[name] = inputs[name] + offsets
        with self.refusal_context():
            asset = self._reset_instance(run.operating_point, run.step, run.initial_offsets)
            if any(run.initial_offsets.values()):
                outputs = self._outputs_after_settling(asset)
            else:
                outputs = np.array(asset.observe().values)
        return asset, outputs, inputs

    def outputs_of_run(self, run: FmuRun) -> FloatArray:
        """Return the outputs (steps + 1, C) of a run, from its start on.

        Raises
        ------
        FmuError
            If the FMU fails, or does not come to rest.
        """
        asset, initial_outputs, inputs = self.start_run(run)
        with self.refusal_context():
            history = asset.simulate(load=inputs, steps=run.steps)
            return np.vstack((initial_outputs, history.values))

    def outputs_at_rest(
        self,
        points: Sequence[OperatingPoint],
        offsets: Mapping[str, FloatArray],
        step: float,
        *,
        settle: bool,
    ) -> FloatArray:
        """Return the outputs (L, C) of the FMU at rest at L operating points.

        Parameters
        ----------
        points : sequence of OperatingPoint
            Operating points, which differ in inputs only.
        offsets : mapping of str to (L,) ndarray
            Values that are added to inputs at each point.
        step : float
            Communication step [s].
        settle : bool
            Whether each point is simulated until it is at rest. Otherwise the FMU is quasi-static,
            and one step gives the equilibrium.

        Raises
        ------
        FmuError
            If the FMU refuses, or does not come to rest.
        """
        offsets_by_point = []
        for point_number in range(len(points)):
            offsets_by_point.append(
                {name: float(values[point_number]) for name, values in offsets.items()}
            )
        with self.refusal_context():
            if settle:
                outputs = []
                for point, point_offsets in zip(points, offsets_by_point, strict=True):
                    asset = self._reset_instance(point, step, point_offsets)
                    outputs.append(self._outputs_after_settling(asset))
                return np.array(outputs)
            # A quasi-static FMU has no memory: one run with a step for each point gives all
            # equilibria.
            inputs_of_points = []
            for point, point_offsets in zip(points, offsets_by_point, strict=True):
                inputs_of_points.append(self._constant_inputs(point, point_offsets))
            inputs = {
                name: np.array([point_inputs[name] for point_inputs in inputs_of_points])
                for name in inputs_of_points[0]
            }
            asset = self._reset_instance(points[0], step, offsets_by_point[0])
            return asset.simulate(load=inputs, steps=len(inputs_of_points)).values

    def _constant_inputs(
        self, point: OperatingPoint, offsets: Mapping[str, float]
    ) -> dict[str, float]:
        """Return all inputs at an operating point, with offsets added."""
        inputs = {**dict.fromkeys(self._binding.load, 0.0), **dict(point.inputs)}
        for name, offset in offsets.items():
            inputs[name] = inputs[name] + offset
        return inputs

    def _reset_instance(
        self, point: OperatingPoint, step: float, offsets: Mapping[str, float]
    ) -> FmiAsset:
        """Return the instance of a step size [s], reset to an operating point with offsets."""
        binding = self._binding.with_header(step_size=step)
        asset = self._assets.get(
            step, lambda: FmiAsset(self._path, binding, isolated=self._isolated)
        )
        inputs = self._constant_inputs(point, offsets)
        asset.reset(dict(point.parameters), load=inputs or None)
        return asset

    def _outputs_after_settling(self, asset: FmiAsset) -> FloatArray:
        """Return the outputs (C,) of an instance at rest under its present inputs.

        It is simulated until every output stays within the tolerance over `SETTLE_CHUNK` steps; an
        `FmuOutputError` is raised if that takes longer than the limit.
        """
        duration = 0.0
        largest: FloatArray | float = 0.0
        while True:
            recent_outputs = asset.simulate(steps=SETTLE_CHUNK).values
            duration += SETTLE_CHUNK * asset.binding.step_size
            high = recent_outputs.max(axis=0)
            low = recent_outputs.min(axis=0)
            largest = np.maximum(largest, np.abs(recent_outputs).max(axis=0))
            if np.all(high - low <= self._tolerance * largest):
                return np.asarray(0.5 * (high + low))
            if duration >= self._limit:
                relative = (high - low) / np.where(largest > 0.0, largest, 1.0)
                worst = int(np.argmax(relative))
                output = asset.binding.observation_variables[worst]
                raise FmuOutputError(
                    f"the motion did not come to rest within {self._limit:g} s: the output "
                    f"{output!r} still moves by {high[worst] - low[worst]:.2g}; raise `limit` or "
                    "`tolerance` in [static], or give the FMU's parameters for a state at rest "
                    "there."
                )
