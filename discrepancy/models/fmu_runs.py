"""Runs of an FMU for a model: an instance for each step size, kept and reset; results are remembered."""

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import pi
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray, Quantity
from discrepancy.campaign.units import UNITS
from discrepancy.errors import ModelError
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.interface import Memory
from discrepancy.sentences import said
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.binding import Binding, Header, Input, Parameter, Vector, expand, load_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuError
from reporting.words import counted

MOST_INSTANCES = 8
"""Instances (step sizes) that are open at the same time."""
KEPT_BYTES = 256 * 2**20
"""Results that are remembered."""
REVOLUTIONS = ("1/min", "rpm", "r/min", "rev/min")
"""Units of FMUs in which an angular velocity is revolutions in a minute."""
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
    quantities : dict of str to Quantity
        What each output of the description is.
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
        step, file = description.motion.step or description.static.step, description.binding_file(folder)
        with self.refusals():
            self._declared = read_fmu(self._path)
            usual = Binding(binding=Header(name=description.name, step_size=step))
            base = usual if file is None else load_binding(file)
            self._variables = dict[str, str]()  # of the FMU by the names of the binding
            for role in ("monitor", "load", "health", "control"):
                for key, item in getattr(base, role).items():
                    self._variables |= {key: item.variable, f"{role}.{key}": item.variable}
            self._keys = {item.variable: key for key, item in base.parameter.items()}
            self._keys |= {key: key for key in base.parameter}
            self._binding = Binding(
                binding=base.with_header(name=description.name, step_size=step, decimation=1).binding,
                limits=base.limits,
                load=self._inputs(),
                parameter=base.parameter | self._parameters(base.parameter),
                observation={"outputs": self._observed()},
            )
            self.asset = FmiAsset(self._path, self._binding, isolated=description.isolated)
            for (
                item
            ) in description.parameter:  # beyond its own range it refuses, and a posterior is cut there
                for end in (item.low, item.high):
                    self.asset.check_parameters({self.parameter(item.variable): end})
        self._none = dict.fromkeys(self._binding.load, 0.0)

    @contextmanager
    def refusals(self) -> Iterator[None]:
        """Say of which model it is what the FMU refuses."""
        try:
            yield
        except FmuError as cause:
            raise ModelError(f"The FMU model {self.description.name!r}: {cause}") from cause

    # ------------------------------------------------------------ names

    def variable(self, name: str) -> str:
        """Return the FMU's name of an input or output that the description names."""
        return self._variables.get(name, name)

    def parameter(self, name: str) -> str:
        """Return the key under which a parameter is set: that of the binding, or the FMU's own name."""
        return self._keys.get(name, name)

    def _inputs(self) -> dict[str, Input]:
        given, wanted = self.description, self.description.inputs
        units: dict[str | None, str] = {
            **dict.fromkeys(wanted.force.values(), "N"),
            **dict.fromkeys((wanted.load_factor, *wanted.regions.values()), "1"),
            wanted.temperature: "K" if wanted.temperature_reference is None else "degC",
            wanted.bending_moment: "N.m", wanted.torque: "N.m",
            given.release.hold if given.release else None: "N",
            **{port.force: "N.m" if port.rotation else "N" for port in given.port},
        }  # fmt: skip
        self.input_factors = dict[str, float]()
        for held in given.input:
            unit = self._own_unit(held.variable)
            turning = held.quantity is Quantity.ANGULAR_VELOCITY and unit in REVOLUTIONS
            self.input_factors[self.variable(held.variable)] = 30.0 / pi if turning else 1.0
            units[held.variable] = unit if turning else self._unit(held.quantity, held.variable)
        named = ((self.variable(name), unit) for name, unit in units.items() if name is not None)
        return {variable: Input(variable=variable, unit=unit) for variable, unit in named}

    def _parameters(self, known: Mapping[str, Parameter]) -> dict[str, Parameter]:
        """Return the parameters that are not known so: a value or range in another unit is none of theirs."""
        given, way = self.description, self.description.release
        units: dict[str | None, str | None] = {
            **dict.fromkeys((*given.static.parameters, *given.motion.parameters)),  # in their own
            **{f"effect.{identifier}.active": None for identifier in given.effects.values()},
            **{item.variable: item.unit for item in given.parameter},
            **({way.displacement: "m", way.velocity: "m/s"} if way is not None else {}),
        }
        named = ((self.parameter(name), unit) for name, unit in units.items() if name is not None)
        return {
            key: Parameter(
                variable=known[key].variable if key in known else key, unit=unit or self._own_unit(key)
            )
            for key, unit in named
            if key not in known or unit not in (None, known[key].unit)
        }

    def _observed(self) -> Vector:
        given, shown = self.description, list[tuple[str, str | None, str]]()
        self.quantities = dict[str, Quantity]()
        for item in given.output:
            names, variables = expand(item.name), expand(item.variable)
            if len(names) != len(variables):
                came = counted(len(names), "name"), len(variables)
                raise ModelError(said("models.as_many", model=given, item=item, came=came))
            self.quantities |= dict.fromkeys(names, item.quantity)
            pairs = zip(names, variables, strict=True)
            shown += [(name, variable, self._unit(item.quantity, variable)) for name, variable in pairs]
        for port in given.port:
            unit = "rad" if port.rotation else "m"
            shown.append((f"port.{port.name}.displacement", port.displacement, unit))
            shown.append((f"port.{port.name}.velocity", port.velocity, f"{unit}/s"))
        shown.append(("release", given.release.output if given.release else None, "m"))
        read = [(name, self.variable(variable), unit) for name, variable, unit in shown if variable]
        names, variables, units = zip(*read, strict=True)
        self.columns = {name: column for column, name in enumerate(names)}
        return Vector(variables=variables, unit=units)

    def _unit(self, quantity: Quantity, variable: str) -> str:
        """Return the SI unit of a quantity as FMUs write it, of a signal the variable's own."""
        si = UNITS[quantity].si.replace(" ", ".")
        return self._own_unit(variable) if quantity is Quantity.SIGNAL else si

    def _own_unit(self, variable: str) -> str:
        found = self._declared.variable(self.variable(variable))
        return (found.unit if found is not None else None) or "1"

    # ------------------------------------------------------------ running

    def remembered(self, key: Hashable, make: Callable[[], FloatArray]) -> FloatArray:
        """Return what `make` returned for `key`; the oldest results are forgotten."""
        found = self._kept.get(key, make)
        found.setflags(write=False)
        return found

    def close(self) -> None:
        """End all instances; they are opened again when they are needed."""
        self._assets.clear()

    def inputs(self, state: State, more: Mapping[str, float] = MappingProxyType({})) -> dict[str, float]:
        """Return all inputs in a state, by the FMU's names, with more on some of them."""
        found = {**self._none, **dict(state.inputs)}
        return found | {name: found.get(name, 0.0) + value for name, value in more.items()}

    def _opened(self, state: State, step: float, begin: Mapping[str, float]) -> FmiAsset:
        """Return the instance of a step size [s] at its start."""
        binding, isolated = self._binding.with_header(step_size=step), self.description.isolated
        asset = self._assets.get(step, lambda: FmiAsset(self._path, binding, isolated=isolated))
        asset.reset(dict(state.parameters), load=self.inputs(state, begin) or None)
        return asset

    def _settled(self, asset: FmiAsset) -> FloatArray:
        """Return the outputs (C,) of an instance that comes to rest under its inputs.

        Raises
        ------
        ModelError
            If it does not.
        """
        rest, waited, largest = self.description.static, 0.0, np.zeros(len(self.columns))
        while True:
            block = asset.simulate(steps=SETTLE_CHUNK).values
            waited += SETTLE_CHUNK * asset.binding.step_size
            high, low = block.max(axis=0), block.min(axis=0)
            largest = np.maximum(largest, np.abs(block).max(axis=0))
            if np.all(high - low <= rest.tolerance * largest):
                return np.asarray(0.5 * (high + low))
            if waited >= rest.limit:
                worst = int(np.argmax((high - low) / np.where(largest > 0.0, largest, 1.0)))
                output, moves = self._binding.observation_variables[worst], high[worst] - low[worst]
                raise ModelError(said("models.unrest", fmu=self._path, rest=rest, output=output, moves=moves))

    def begun(self, run: Run) -> tuple[FmiAsset, FloatArray, dict[str, FloatArray]]:
        """Return an instance at the begin of a motion, its outputs there, and the inputs (steps,) to come.

        Raises
        ------
        ModelError
            If the FMU refuses, or does not come to rest.
        """
        courses = {name: value + np.zeros(run.steps) for name, value in self.inputs(run.state).items()}
        courses |= {name: courses[name] + values for name, values in run.courses.items()}
        with self.refusals():
            asset = self._opened(run.state, run.step, run.begin)
            first = self._settled(asset) if any(run.begin.values()) else np.array(asset.observe().values)
        return asset, first, courses

    def followed(self, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion; raises `ModelError`."""
        asset, first, courses = self.begun(run)
        with self.refusals():
            return np.vstack((first, asset.simulate(load=courses, steps=run.steps).values))

    def resting(self, states: Sequence[State], loads: Mapping[str, FloatArray]) -> FloatArray:
        """Return the outputs (L, C) at rest in states that differ in inputs, under more (L,) on some."""
        step = self.description.static.step
        more = [{name: float(values[row]) for name, values in loads.items()} for row in range(len(states))]
        with self.refusals():
            if self.description.static.settle:
                pairs = zip(states, more, strict=True)
                return np.array([self._settled(self._opened(state, step, own)) for state, own in pairs])
            rows = [self.inputs(*pair) for pair in zip(states, more, strict=True)]
            courses = {name: np.array([row[name] for row in rows]) for name in rows[0]}
            return self._opened(states[0], step, more[0]).simulate(load=courses, steps=len(rows)).values

    def size(self, name: str) -> float:
        """Return a force that an input can have, both signs."""
        low, high = self.asset.input_range("load", name)
        return min(1.0, 0.1 * abs(low), 0.1 * abs(high))
