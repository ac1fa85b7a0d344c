"""Runs of an FMU for a model: an instance for each step size, kept and reset; results are remembered."""

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import log2, pi
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray, Quantity
from discrepancy.campaign.units import UNITS
from discrepancy.errors import ModelError
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.interface import Memory
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.binding import Binding, Input, Parameter, Vector, expand, load_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuError
from reporting.words import counted

MOST_INSTANCES = 8
"""Instances (step sizes) that are open at the same time."""
KEPT_BYTES = 256 * 2**20
"""Results that are remembered."""
REVOLUTIONS = ("1/min", "rpm", "r/min", "rev/min")
"""Units of FMUs in which an angular velocity is revolutions in a minute."""
LINEAR = 1e-6
"""Largest deviation from superposition, as a share of the motion, of an FMU that is taken as linear."""
SETTLE_CHUNK = 200
"""Steps after which it is asked whether the motion has come to rest."""


class State(NamedTuple):
    """Parameters and constant inputs of a run, sorted by name; by keys of the binding and the FMU's names."""

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
    """An FMU with the variables that a model needs, in SI units.

    Parameters
    ----------
    description : FmuModelDescription
        The model's file.
    folder : Path
        Its folder, where relative names begin.

    Attributes
    ----------
    columns : dict of str to int
        Column of each output of the description, and of `port.NAME.displacement` and `.velocity`.
    asset : FmiAsset
        The door to the FMU, for what it declares.
    input_factors : dict of str to float
        By which an `[[input]]` of the description is multiplied, by the FMU's name: revolutions in a minute
        stand for an angular velocity and have no unit that converts to rad/s.

    Raises
    ------
    ModelError
        If FMU or binding are missing, or a variable is missing or of another causality or unit.
    """

    def __init__(self, description: FmuModelDescription, folder: Path) -> None:
        self.description = description
        self._path = folder / description.fmu
        self._assets = Memory(MOST_INSTANCES, end=FmiAsset.close)
        self._kept = Memory(KEPT_BYTES, lambda found: found.nbytes)
        self._adds = dict[tuple[str, ...], bool]()  # whether what some inputs do adds up
        self._units = dict[str, float]()  # of which this is made
        with self._refusals():
            self._fmu = read_fmu(self._path)
            file = description.binding_file(folder)
            self._base = base = None if file is None else load_binding(file)
            header: dict[str, Any] = {} if base is None else base.binding.model_dump(exclude={"decimation"})
            header |= {"name": description.name}
            header["step_size"] = description.motion.step or description.static.step
            content: dict[str, Any] = {} if base is None else {"limits": base.limits}
            content |= {"binding": header, "load": self._inputs(), "parameter": self._parameters()}
            self._binding = Binding.model_validate(content | {"observation": self._observed()})
            self.asset = FmiAsset(self._path, self._binding, isolated=description.isolated)
        self._none = dict.fromkeys(self.asset.binding.load, 0.0)

    @contextmanager
    def _refusals(self) -> Iterator[None]:
        """Say of which model it is what the FMU refuses."""
        try:
            yield
        except FmuError as cause:
            raise ModelError(f"The FMU model {self.description.name!r}: {cause}") from cause

    # ------------------------------------------------------------ names

    def variable(self, name: str) -> str:
        """Return the FMU's name of an input or output that the description names."""
        if self._base is None:
            return name
        plain = name.rpartition(".")[2] if name.partition(".")[0] in ("control", "health", "load") else name
        for role in ("control", "health", "load", "monitor"):
            table: Mapping[str, Any] = getattr(self._base, role)
            if plain in table and (plain == name or name.startswith(role)):
                return str(table[plain].variable)
        return name

    def parameter(self, name: str) -> str:
        """Return the key under which a parameter is set: that of the binding, or the FMU's own name."""
        if self._base is None or name in self._base.parameter:
            return name
        return next((key for key, item in self._base.parameter.items() if item.variable == name), name)

    def _inputs(self) -> dict[str, Input]:
        given, wanted = self.description, self.description.inputs
        units: dict[str | None, str] = {
            **dict.fromkeys(wanted.forces.values(), "N"),
            **dict.fromkeys((wanted.load_factor, *wanted.regions.values()), "1"),
            wanted.temperature: "K" if wanted.temperature_reference is None else "degC",
            wanted.bending_moment: "N.m", wanted.torque: "N.m",
            given.release.hold if given.release else None: "N",
        }  # fmt: skip
        units |= {port.force: "N.m" if port.rotation else "N" for port in given.port}
        self.input_factors = dict[str, float]()
        for held in given.input:
            driven = held.variable or held.name
            unit = self._own_unit(self.variable(driven))
            turning = held.quantity is Quantity.ANGULAR_VELOCITY and unit in REVOLUTIONS
            self.input_factors[self.variable(driven)] = 30.0 / pi if turning else 1.0
            units[driven] = unit if turning or held.quantity is Quantity.SIGNAL else _si(held.quantity)
        named = ((self.variable(name), unit) for name, unit in units.items() if name is not None)
        return {variable: Input(variable=variable, unit=unit) for variable, unit in named}

    def _parameters(self) -> dict[str, Parameter]:
        given, found = self.description, {} if self._base is None else dict(self._base.parameter)
        # without a unit here, one has that of the binding, or its own
        units: dict[str | None, str | None] = {
            **dict.fromkeys((*given.static.parameters, *given.motion.parameters)),
            **{f"effect.{identifier}.active": None for identifier in given.effects.values()},
            **{item.variable or item.name: item.unit for item in given.parameter},
        }
        if given.release is not None:
            units |= {given.release.displacement: "m", given.release.velocity: "m/s"}
        for key, unit in ((self.parameter(name), unit) for name, unit in units.items() if name is not None):
            known = found.get(key) or Parameter(variable=key, unit=self._own_unit(key))
            if unit not in (None, known.unit):  # a value of another unit is none of this
                known = known.model_copy(update={"unit": unit, "value": None})
            found[key] = known
        return found

    def _observed(self) -> dict[str, Vector]:
        given, shown = self.description, list[tuple[str, str | None, str]]()
        self.columns, self.quantities = dict[str, int](), dict[str, Quantity]()
        for item in given.output:
            names, variables = expand(item.name), expand(item.variable or item.name)
            if len(names) != len(variables):
                raise ModelError(
                    f"The FMU model {given.name!r}: the output {item.name!r} stands for "
                    f"{counted(len(names), 'name')}, but its variable for {len(variables)}; give as many."
                )
            self.quantities |= dict.fromkeys(names, item.quantity)
            unit = "" if item.quantity is Quantity.SIGNAL else _si(item.quantity)  # what the FMU gives it
            shown += [(name, variable, unit) for name, variable in zip(names, variables, strict=True)]
        for port in given.port:
            unit = "rad" if port.rotation else "m"
            shown.append((f"port.{port.name}.displacement", port.displacement, unit))
            shown.append((f"port.{port.name}.velocity", port.velocity, f"{unit}/s"))
        if given.release is not None:
            shown.append(("release", given.release.output, "m"))
        columns: dict[tuple[str, str], int] = {}
        for name, wanted, unit in shown:
            if wanted is not None:
                self.columns[name] = columns.setdefault((self.variable(wanted), unit), len(columns))
        return {
            f"y{at}": Vector(variables=(variable,), unit=unit or self._own_unit(variable))
            for (variable, unit), at in columns.items()
        }

    def _own_unit(self, variable: str) -> str:
        found = self._fmu.variable(variable)
        return (found.unit if found is not None else None) or "1"

    # ------------------------------------------------------------ running

    def remembered(self, key: Hashable, make: Callable[[], FloatArray]) -> FloatArray:
        """Return what `make` returned for `key`; the oldest results are forgotten."""
        found = self._kept.get(key, make)
        found.setflags(write=False)
        return found

    def open(self, step: float) -> FmiAsset:
        """Return the instance of a step size [s], as it was left; raises `ModelError`."""

        def opened() -> FmiAsset:
            binding = self._binding.with_header(step_size=step)
            return FmiAsset(self._path, binding, isolated=self.description.isolated)

        with self._refusals():
            return self._assets.get(step, opened)

    def close(self) -> None:
        """End all instances; they are opened again when they are needed."""
        self._assets.clear()

    def inputs(self, state: State, more: Mapping[str, float] = MappingProxyType({})) -> dict[str, float]:
        """Return all inputs in a state, by the FMU's names, with more on some of them."""
        found = {**self._none, **dict(state.inputs)}
        for name, value in more.items():
            found[name] = found.get(name, 0.0) + value
        return found

    def started(
        self, state: State, step: float, begin: Mapping[str, float], *, settle: bool
    ) -> tuple[FmiAsset, FloatArray]:
        """Return an instance at its start, at rest under its inputs if wanted, and its outputs (C,).

        Raises
        ------
        ModelError
            If the FMU refuses, or does not come to rest.
        """
        with self._refusals():
            asset, rest = self.open(step), self.description.static
            asset.reset(dict(state.parameters), load=self.inputs(state, begin) or None)
            if not settle:
                return asset, np.array(asset.observe().values)
        waited, largest = 0.0, np.zeros(len(self._binding.observation_variables))
        while True:
            block = self.advanced(asset, {}, SETTLE_CHUNK)
            waited += SETTLE_CHUNK * step
            high, low = block.max(axis=0), block.min(axis=0)
            largest = np.maximum(largest, np.abs(block).max(axis=0))
            if np.all(high - low <= rest.tolerance * largest):
                return asset, np.asarray(0.5 * (high + low))
            if waited >= rest.limit:
                worst = int(np.argmax((high - low) / np.where(largest > 0.0, largest, 1.0)))
                raise ModelError(
                    f"The FMU {self._path} did not come to rest within {rest.limit:g} s: the output "
                    f"{self._binding.observation_variables[worst]!r} still moves by "
                    f"{high[worst] - low[worst]:.2g}; raise `limit` or `tolerance` in "
                    "[static], or give the FMU's parameters for a state at rest there."
                )

    def advanced(self, asset: FmiAsset, courses: Mapping[str, FloatArray], steps: int) -> FloatArray:
        """Return the outputs (steps, C) at the ends of steps, inputs held in each; raises `ModelError`."""
        with self._refusals():
            return asset.simulate(load=courses, steps=steps).values

    def begun(self, run: Run) -> tuple[FmiAsset, FloatArray, dict[str, FloatArray]]:
        """Return an instance at the begin of a motion, its outputs there, and the inputs (steps,) to come."""
        courses = {name: value + np.zeros(run.steps) for name, value in self.inputs(run.state).items()}
        for name, values in run.courses.items():
            courses[name] += values
        settle = any(run.begin.values())
        return *self.started(run.state, run.step, run.begin, settle=settle), courses

    def followed(self, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion; raises `ModelError`."""
        asset, first, courses = self.begun(run)
        return np.vstack((first, self.advanced(asset, courses, run.steps)))

    # ------------------------------------------------------------ rest

    def rest(self, states: Sequence[State], loads: Sequence[Mapping[str, float]]) -> FloatArray:
        """Return the outputs (L, C) at rest in states that differ in inputs, under more on some of them."""
        step = self.description.static.step
        if self.description.static.settle:
            return np.array([self._settled(*row) for row in zip(states, loads, strict=True)])
        rows = [self.inputs(*row) for row in zip(states, loads, strict=True)]
        asset, _ = self.started(states[0], step, loads[0], settle=False)
        return self.advanced(
            asset, {name: np.array([row[name] for row in rows]) for name in rows[0]}, len(rows)
        )

    def _settled(self, state: State, loads: Mapping[str, float]) -> FloatArray:
        """Return the outputs (C,) when a motion has come to rest.

        Put together from answers to units where half of all loads gives half of the sum of what each gives.
        """

        def asked(loads: Mapping[str, float]) -> FloatArray:
            step, key = self.description.static.step, (state, tuple(sorted(loads.items())))
            return self.remembered(key, lambda: self.started(state, step, loads, settle=True)[1])

        loads = {name: value for name, value in loads.items() if value != 0.0}
        names = tuple(sorted(loads))
        if not (self.description.superposition and names) or self._adds.get(names) is False:
            return asked(loads)
        units = {name: self._units.setdefault(name, 2.0 ** round(log2(abs(loads[name])))) for name in names}
        zero = asked({})
        moved = np.array([asked({name: unit}) - zero for name, unit in units.items()])
        if names not in self._adds:
            half = asked({name: 0.5 * unit for name, unit in units.items()}) - zero
            allowed = LINEAR * np.sum(np.abs(moved), axis=0) + 1e-12 * np.abs(zero)
            self._adds[names] = bool(np.all(np.abs(half - 0.5 * np.sum(moved, axis=0)) <= allowed))
            return self._settled(state, loads)
        return np.asarray(zero + np.array([loads[name] / unit for name, unit in units.items()]) @ moved)

    def size(self, name: str) -> float:
        """Return a force that an input can have."""
        return min(1.0, 0.1 * self.input_limit(name))

    def one_step(self, asset: FmiAsset, inputs: Mapping[str, float]) -> FloatArray:
        """Return the outputs (C,) after one step; `ModelError` if the FMU refuses."""
        with self._refusals():
            return asset.step(load=inputs).values

    def input_limit(self, name: str) -> float:
        """Return the largest size that an input may have, both signs."""
        low, high = self.asset.input_range("load", self.variable(name))
        return min(abs(low), abs(high))


def _si(quantity: Quantity) -> str:
    """Return the SI unit of a quantity as FMUs write it."""
    return UNITS[quantity].si.replace(" ", ".")
