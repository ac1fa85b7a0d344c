"""An FMU of FMI 2 or 3 in this process, call by call, through fmpy."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from fmpy.fmi1 import FMICallException

from fmu_asset.archive.declared import FLOAT_KINDS, VariableInfo
from fmu_asset.archive.fmu_file import extract_fmu, read_fmu
from fmu_asset.instances.opening import open_instance
from fmu_asset.instances.plan import Plan

OK, DISCARD, ERROR = 0, 2, 3


def elements(variable: VariableInfo) -> list[str]:
    """Return the names of the elements of a variable of FMI 3 in FMI 2."""
    if not variable.shape:
        return [variable.name]
    stem, end = (variable.name[:-1], ")") if variable.name.endswith(")") else (variable.name, "")
    form = "health.z{}" if stem == "health" else f"{stem}[{{}}]{end}"
    return [form.format(number) for number in range(1, variable.size + 1)]


class Slave:
    """An instance whose statuses and log messages are kept; none is an exception.

    Elements of the arrays of FMI 3 go by the names and value references of FMI 2: those of our
    FMUs begin at the reference of the array. With `like`, this is another instance of the FMU that
    the other one has extracted.
    """

    def __init__(self, path: Path, *, like: "Slave | None" = None) -> None:
        self.description = read_fmu(path) if like is None else like.description
        self.folder = extract_fmu(self.description) if like is None else like.folder
        self._owns_folder = like is None
        self._instance = open_instance(
            Plan(str(self.folder), self.description.identity, "wing", (), ())
        )
        self.fmu, self.log, self.take = (
            self._instance._fmu,
            self._instance.messages,
            self._instance.log,
        )
        self.three = self.description.major_version == 3
        self.real, self.whole = ("Float64", "Int64") if self.three else ("Real", "Integer")
        self.reference: dict[str, int] = {}
        self.variables: dict[str, VariableInfo] = {}
        self._arrays: dict[int, range] = {}
        for variable in self.description.variables:
            places = range(variable.reference, variable.reference + variable.size)
            names = elements(variable)
            self.reference |= dict(zip(names, places, strict=True))
            self.variables |= dict.fromkeys(names, variable)
            self._arrays |= dict.fromkeys(places, places)
        real = {
            n: v for n, v in self.variables.items() if v.kind in FLOAT_KINDS and v.name != "time"
        }
        self.names = list(real)
        self.inputs = [name for name, variable in real.items() if variable.causality == "input"]

    # ------------------------------------------------------------------ values

    def _whole(self, places: Sequence[int]) -> tuple[list[int], list[int]]:
        """Return the value references of the arrays that places lie in, and all places in these."""
        arrays = list(dict.fromkeys(self._arrays[place] for place in places))
        return [array.start for array in arrays], [place for array in arrays for place in array]

    def read(self, places: Sequence[int]) -> list[float]:
        """Return real values by value references."""
        starts, order = self._whole(places)
        get = partial(self.fmu.getFloat64, nValues=len(order)) if self.three else self.fmu.getReal
        values = dict(zip(order, map(float, get(starts)), strict=True))
        return [values[place] for place in places]

    def write(self, places: Sequence[int], values: Sequence[float]) -> None:
        """Set real values by value references; of an array the others stay."""
        given = dict(zip(places, values, strict=True))
        starts, order = self._whole(places)
        kept = {} if len(order) == len(given) else dict(zip(order, self.read(order), strict=True))
        set_real = self.fmu.setFloat64 if self.three else self.fmu.setReal
        set_real(starts, [(kept | given)[place] for place in order])

    def set(self, values: Mapping[str, float]) -> None:
        """Set real variables by name."""
        self.write([self.reference[name] for name in values], list(values.values()))

    def get(self, *names: str) -> list[float]:
        """Return real variables by name."""
        return self.read([self.reference[name] for name in names])

    def everything(self) -> list[float]:
        """Return all real variables."""
        return self.get(*self.names)

    @property
    def status(self) -> int:
        """The output `status`."""
        return int(getattr(self.fmu, f"get{self.whole}")([self.reference["status"]])[0])

    def derivative(self, unknowns: Sequence[str], seed: Mapping[str, float]) -> np.ndarray:
        """Return the directional derivative of variables."""
        unknown_references = [self.reference[name] for name in unknowns]
        seed_by_reference = {self.reference[name]: value for name, value in seed.items()}
        results, order = self._whole(unknown_references)
        knowns, known_order = self._whole(list(seed_by_reference))
        seeds = [seed_by_reference.get(reference, 0.0) for reference in known_order]
        count = [len(order)] if self.three else []
        derivatives = self.fmu.getDirectionalDerivative(results, knowns, seeds, *count)
        return np.array([derivatives[order.index(reference)] for reference in unknown_references])

    # ------------------------------------------------------------------ life

    def status_of(self, call: Callable[..., object], *arguments: object) -> int:
        """Return the FMI status of a call."""
        try:
            call(*arguments)
        except FMICallException as error:
            return int(error.status)
        return OK

    def initialising(self, start_time: float = 0.0) -> None:
        """Enter initialisation."""
        if self.three:
            self.fmu.enterInitializationMode(startTime=start_time)
        else:
            self.fmu.setupExperiment(startTime=start_time)
            self.fmu.enterInitializationMode()

    def choose(self, response: int) -> None:
        """Set the parameter `response`."""
        getattr(self.fmu, f"set{self.whole}")([self.reference["response"]], [response])

    def start(self, *, response: int | None = 1, anew: bool = True, **values: float) -> int:
        """Reset if `anew`, set values, and initialise.

        Dots in the names of values are written as two underscores.
        """
        if anew:
            self.fmu.reset()
        self.initialising()
        if response is not None:
            self.choose(response)
        for name, value in values.items():
            self.set({name.replace("__", "."): value})
        return self.status_of(self.fmu.exitInitializationMode)

    def step(self, inputs: Sequence[float], time: float, size: float) -> int:
        """Set the inputs in order (of a wing load factor, z1, z2, tip force) and make a step."""
        self.set(dict(zip(self.inputs, inputs, strict=True)))
        return self.status_of(self.fmu.doStep, time, size)

    def saved(self) -> bytes:
        """Return the serialised state."""
        state = self.fmu.getFMUState()
        try:
            return bytes(self.fmu.serializeFMUState(state))
        finally:
            self.fmu.freeFMUState(state)

    def restore(self, content: bytes) -> int:
        """Restore a serialised state and return the status."""

        def restored() -> None:
            state = self.fmu.deserializeFMUState(content)
            try:
                self.fmu.setFMUState(state)
            finally:
                self.fmu.freeFMUState(state)

        return self.status_of(restored)

    def close(self) -> None:
        """Free the instance."""
        self._instance.close()
        if self._owns_folder:
            shutil.rmtree(self.folder)
