"""Systems of FMUs by name, and the recursion of linear ones, in matrices: what coupling must do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from fmu_asset.coupling.structure import Component, ComponentSetting, SystemStructure
from tests.fmu_asset.making import system, tables
from tests.fmu_asset.ours import OurFmus

Floats = npt.NDArray[np.float64]
SYSTEMS = tables(__file__, "systems")
PARTS = {
    "damage": "damage_growth",
    "wing": "python",
    "gauges": "strain_gauges",
    "spring": "spring_mass",
}
"""Our FMUs by the names of components."""


def linear(name: str, fmu: Path, substeps: int = 1, **values: Any) -> Component:
    """Return a component of `linear2.c`; matrices as nested lists, `initial` as a pair."""
    settings = {}
    for key, value in values.items():
        for place, x in np.ndenumerate(np.array(value, dtype=float)):
            indices = "".join(str(index + 1) for index in place)
            settings[key + indices] = ComponentSetting(float(x))
    return Component(name, fmu, settings, substeps)


OUTPUTS = '<Outputs><Unknown index="3"{}/><Unknown index="4"{}/>'


def coupled(name: str, foreign_fmu: Any, substeps: int = 1) -> SystemStructure:
    """Return a system of `linear2.c`.

    The description of a component may say on which of its inputs, 1 and 2, each output depends.
    """
    components = []
    for component, keys in SYSTEMS[name]["parts"].items():
        inputs = keys.get("inputs")
        fmu = foreign_fmu("linear2")
        if inputs:
            dependencies = [f' dependencies="{numbers}"' for numbers in inputs]
            change = (OUTPUTS.format("", ""), OUTPUTS.format(*dependencies))
            fmu = foreign_fmu.changed("linear2", "_".join(("linear", *inputs)), change)
        values = {key: value for key, value in keys.items() if key != "inputs"}
        components.append(linear(component, fmu, substeps, **values))
    return system(components, SYSTEMS[name]["links"])


def of_ours(
    ours: OurFmus, content: Mapping[str, Any] = SYSTEMS["three"], name: str = "test"
) -> SystemStructure:
    """Return a system of our FMUs: what is set in them, and how they are joined."""
    components = []
    for component, values in content["given"].items():
        settings = {key: ComponentSetting(*value) for key, value in values.items()}
        components.append(Component(component, ours(PARTS[component]), settings))
    return system(components, content["links"], name)


# ---------------------------------------------------------------------- the recursion


@dataclass(frozen=True)
class LinearComponent:
    """x' = A x + B u, y = C x + D u, with two states, inputs and outputs.

    Attributes
    ----------
    step : (2, 4) array
        The state after a step, by the state before it and the inputs, which are held.
    output, feedthrough : (2, 2) array
        C and D.
    initial : (2,) array
        The state at the start.
    """

    step: Floats
    output: Floats
    feedthrough: Floats
    initial: Floats

    def outputs(self, state: Floats, inputs: Floats) -> Floats:
        return np.asarray(self.output @ state + self.feedthrough @ inputs)


def linear_component(keys: Mapping[str, Any], step_size: float) -> LinearComponent:
    """Return a component from its table; what is not there is zero."""
    zero = np.zeros((2, 2))
    a = np.array(keys.get("a", zero))
    b = np.array(keys.get("b", zero))
    generator = np.block([[a, b], [np.zeros((2, 4))]])
    return LinearComponent(
        step=expm(step_size * generator)[:2],
        output=np.array(keys.get("c", zero)),
        feedthrough=np.array(keys.get("d", zero)),
        initial=np.array(keys.get("initial", np.zeros(2))),
    )


def recursion(
    name: str,
    order: Sequence[str],
    step: float,
    pushes: Sequence[float],
    *,
    jacobi: bool = False,
    delayed: Sequence[str] = (),
    sweeps: int = 1,
) -> dict[str, Floats]:
    """Return the outputs of each component at the start and after each step.

    Parameters
    ----------
    name : str
        The system.
    order : sequence of str
        The components in the order in which they are stepped.
    step : float
        The length of a step.
    pushes : sequence of float
        The input of the system in each step.
    jacobi : bool
        Whether a component sees the outputs before the sweep; else the newest ones.
    delayed : sequence of str
        Inputs that see the outputs before the step.
    sweeps : int
        How often all components make the step.
    """
    tables_of_components = SYSTEMS[name]["parts"]
    components = {
        component: linear_component(keys, step) for component, keys in tables_of_components.items()
    }
    states = {component: each.initial for component, each in components.items()}

    def inputs_of(
        component: str,
        push: float,
        outputs: Mapping[str, Floats],
        previous_outputs: Mapping[str, Floats],
    ) -> Floats:
        """Return the inputs of a component; what nobody shows yet is zero."""
        inputs = np.zeros(2)
        for source, target in SYSTEMS[name]["links"]:
            if target[:-3] != component:
                continue
            source_component, _, _ = source.partition(".")
            known = previous_outputs if target in delayed else outputs
            number = int(target[-1]) - 1
            if source_component == "push":
                inputs[number] += push
            elif source_component in known:
                inputs[number] += known[source_component][int(source[-1]) - 1]
        return inputs

    outputs: dict[str, Floats] = {}
    for component in order:
        inputs = inputs_of(component, 0.0, outputs, outputs)
        outputs[component] = components[component].outputs(states[component], inputs)
    history = [dict(outputs)]
    for push in pushes:
        previous_outputs = dict(outputs)
        previous_states = dict(states)
        for _ in range(sweeps):
            before_sweep = dict(outputs)
            for component in order:
                seen_outputs = before_sweep if jacobi else outputs
                inputs = inputs_of(component, push, seen_outputs, previous_outputs)
                state = np.concatenate((previous_states[component], inputs))
                states[component] = components[component].step @ state
                outputs[component] = components[component].outputs(states[component], inputs)
        history.append(dict(outputs))
    return {component: np.array([row[component] for row in history]) for component in order}
