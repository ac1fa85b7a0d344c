"""Rest and motion of an FMU without laws at its ports, superposed where it proves to be linear."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from math import log2

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import ModelError
from discrepancy.models.fmu_runs import Excitation, FmuRuns, Loads, Run, State
from discrepancy.models.port_system import LINEAR
from fmu_asset.door.session import FmiAsset


class FmuMotion:
    """Rest and motion of an FMU.

    Parameters
    ----------
    runs : FmuRuns
        The FMU.
    """

    def __init__(self, runs: FmuRuns) -> None:
        self._description, self.runs = runs.description, runs
        self._linear: dict[Hashable, bool] = {}
        self._silent: dict[Hashable, bool] = {}
        self._units: dict[Hashable, float] = {}
        self._resting: State | None = None

    def rest(self, state: State, loads: Mapping[str, float]) -> FloatArray:
        """Return the outputs (C,) at rest under inputs; what is not given is zero."""
        given = [(Excitation("rest", name), value) for name, value in sorted(loads.items())]
        return self._superposed(
            ("rest", state),
            lambda loads: self._rest(state, {part.name: value for part, value in loads}),
            given,
            self._description.static.settle,
        )

    def _rest(self, state: State, loads: Mapping[str, float]) -> FloatArray:
        table = self._description.static
        inputs = self.runs.inputs(state, loads)
        if table.settle:
            return self.runs.started(table.step, dict(state.parameters), inputs, settle=True)[1]
        only = State(state.parameters, ())
        if self._resting != only:  # inputs change from step to step, parameters need a reset
            self.runs.started(table.step, dict(state.parameters), inputs, settle=False)
            self._resting = only
        asset = self.runs.open(table.step)
        return self.runs.stepped(asset, inputs)

    def free(self, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion."""
        return self._superposed(
            ("free", *run[:3]), lambda loads: self.stepped(run._replace(loads=loads)), run.loads
        )

    def stepped(self, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion by the FMU itself."""
        asset, first, histories = self.begin(run)
        return np.vstack((first, self.runs.advanced(asset, histories, run.steps)))

    def begin(self, run: Run) -> tuple[FmiAsset, FloatArray, dict[str, FloatArray]]:
        """Return an instance at the begin of a motion, its outputs there, and the inputs (steps,) to come."""
        state, step, steps, loads = run
        parameters = dict(state.parameters)
        histories = {name: np.full(steps, value) for name, value in self.runs.inputs(state).items()}
        held: dict[str, float] = {}
        way = self._description.release
        for part, value in loads:
            if part.kind in ("displacement", "velocity"):
                amount = value if part.kind == "velocity" else self._released(state, step, value)
                parameters[self.runs.parameter(str(getattr(way, part.kind)))] = amount
            elif part.kind == "hold":
                assert way is not None
                name = self.runs.variable(str(way.hold))
                held[name] = held.get(name, 0.0) + self._released(state, step, value)
            else:
                histories[part.name][: len(part.series)] += value * part.series[:steps]
                held[part.name] = held.get(part.name, 0.0) + value * part.begin
        settle = any(value != 0.0 for value in held.values())
        asset, first = self.runs.started(step, parameters, self.runs.inputs(state, held), settle=settle)
        return asset, first, histories

    def _released(self, state: State, step: float, displacement: float) -> float:
        """Return force [N] or parameter [m] that puts the release point at a displacement [m].

        Raises
        ------
        ModelError
            If there is none.
        """
        way = self._description.release
        assert way is not None
        if way.output is None:
            return displacement
        column = self.runs.columns["release"]

        def shown(amount: float) -> float:
            def start() -> FloatArray:
                parameters, held = dict(state.parameters), {}
                if way.hold is not None:
                    held = {self.runs.variable(way.hold): amount}
                else:
                    parameters[self.runs.parameter(str(way.displacement))] = amount
                inputs = self.runs.inputs(state, held)
                return self.runs.started(step, parameters, inputs, settle=bool(held))[1]

            return float(self.runs.remembered(("released", state, amount), start)[column])

        first = displacement if way.hold is None else min(1.0, 0.1 * self.runs.input_limit(way.hold))
        if displacement == 0.0:
            return 0.0
        kind = ("free", (("hold", ""),))
        if way.hold is not None and self._linear.get(kind) and self._silent.get(kind):
            return displacement * first / shown(first)
        zero = shown(0.0)
        amount, reached = first, shown(first) - zero
        slope = reached / first
        for _ in range(20):
            if abs(reached - displacement) <= 1e-9 * abs(displacement) or slope == 0.0:
                break
            new = amount + (displacement - reached) / slope
            now = shown(new) - zero
            if new != amount and now != reached:
                slope = (now - reached) / (new - amount)
            amount, reached = new, now
        if abs(reached - displacement) <= 1e-6 * abs(displacement):
            return amount
        raise ModelError(
            f"Nothing that [release] names puts {way.output!r} of the FMU model "
            f"{self._description.name!r} at {displacement:g} m; correct displacement, hold or output there."
        )

    def _superposed(
        self,
        key: tuple[Hashable, ...],
        answer: Callable[[Loads], FloatArray],
        loads: Loads,
        possible: bool = True,
    ) -> FloatArray:
        """Return the answer to loads, put together from answers to units where that is proven to be right."""
        parts = [part for part, value in loads if value != 0.0]
        values = [value for _, value in loads if value != 0.0]
        kind = (key[0], tuple((part.kind, part.name) for part in parts))

        def asked(values: Sequence[float]) -> FloatArray:
            given = list(zip(parts, values, strict=True))
            full = tuple((part.key, value) for part, value in given if value != 0.0)
            return self.runs.remembered((key, full or kind), lambda: answer(given))

        if not (possible and parts and self._description.superposition) or self._linear.get(kind) is False:
            return asked(values)
        units = [
            self._units.setdefault((part.kind, part.name), 2.0 ** round(log2(abs(value))))
            for part, value in zip(parts, values, strict=True)
        ]
        moved = [asked(one) for one in np.diag(units).tolist()]
        zero = np.zeros_like(moved[0])
        if not self._silent.get(kind):  # an FMU that shows nothing without excitation does so always
            zero = asked([0.0] * len(parts))
            self._silent.setdefault(kind, not np.any(zero))
        moved, result = [part - zero for part in moved], zero.copy()
        if kind not in self._linear:  # half of all excitations gives half of the sum of what each gives
            half = asked([0.5 * size for size in units]) - zero
            size = np.atleast_2d(np.sum(np.abs(moved), axis=0)).max(axis=0)
            allowed = LINEAR * size + 1e-12 * np.atleast_2d(np.abs(zero)).max(axis=0)
            self._linear[kind] = bool(np.all(np.abs(half - 0.5 * np.sum(moved, axis=0)) <= allowed))
            if not self._linear[kind]:
                return asked(values)
        for value, unit, part in zip(values, units, moved, strict=True):
            result += value / unit * part
        return result
