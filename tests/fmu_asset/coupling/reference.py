"""Systems of FMUs by name, and the recursion of linear ones, in matrices: what coupling must do."""

from collections.abc import Mapping, Sequence
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


PARTS = {"damage": "damage_growth", "wing": "python", "gauges": "strain_gauges", "spring": "spring_mass"}
"""Components of systems of ours."""


def linear(name: str, fmu: Path, substeps: int = 1, **values: Any) -> Component:
    """Return a component of `linear2.c`; matrices as nested lists, `initial` as a pair."""
    settings = {}
    for key, value in values.items():
        for place, x in np.ndenumerate(np.array(value, dtype=float)):
            settings[key + "".join(str(index + 1) for index in place)] = ComponentSetting(float(x))
    return Component(name, fmu, settings, substeps)


OUTPUTS = '<Outputs><Unknown index="3"{}/><Unknown index="4"{}/>'


def coupled(name: str, foreign_fmu: Any, substeps: int = 1) -> SystemStructure:
    """Return a system of `linear2.c`, which is told on which of its inputs, 1 and 2, each output depends."""
    components = []
    for part, told in SYSTEMS[name]["parts"].items():
        inputs, fmu = told.get("inputs"), foreign_fmu("linear2")
        if inputs:
            outputs = OUTPUTS.format(*(f' dependencies="{numbers}"' for numbers in inputs))
            fmu = foreign_fmu.changed(
                "linear2", "_".join(("linear", *inputs)), (OUTPUTS.format("", ""), outputs)
            )
        values = {key: value for key, value in told.items() if key != "inputs"}
        components.append(linear(part, fmu, substeps, **values))
    return system(components, SYSTEMS[name]["links"])


def of_ours(ours: OurFmus, told: Mapping[str, Any] = SYSTEMS["three"], name: str = "test") -> SystemStructure:
    """Return a system of our FMUs: what is set in them, and how they are joined."""
    components = [
        Component(part, ours(PARTS[part]), {key: ComponentSetting(*value) for key, value in given.items()})
        for part, given in told["given"].items()
    ]
    return system(components, told["links"], name)


def recursion(
    name: str, order: Sequence[str], step: float, pushes: Sequence[float], *,
    jacobi: bool = False, delayed: Sequence[str] = (), sweeps: int = 1,
) -> dict[str, Floats]:  # fmt: skip
    """Return the outputs of each part at the start and after each step.

    A sweep takes the parts in their order, with what the others show by now; by Jacobi, before the sweep.
    """
    parts, links = SYSTEMS[name]["parts"], SYSTEMS[name]["links"]
    zero = {**dict.fromkeys("abcd", np.zeros((2, 2))), "initial": np.zeros(2)}
    its = {part: {key: np.array(told.get(key, zero[key])) for key in zero} for part, told in parts.items()}
    moves = {
        part: expm(step * np.block([[m["a"], m["b"]], [np.zeros((2, 4))]]))[:2] for part, m in its.items()
    }
    states = {part: m["initial"] for part, m in its.items()}

    def taken(part: str, push: float, now: Mapping[str, Floats], before: Mapping[str, Floats]) -> Floats:
        """Return the inputs of a part; what nobody shows yet is zero."""
        u = np.zeros(2)
        for source, target in links:
            known, of = before if target in delayed else now, source.partition(".")[0]
            value = push if of == "push" else known[of][int(source[-1]) - 1] if of in known else 0.0
            u[int(target[-1]) - 1] += value * (target[:-3] == part)
        return u

    def shown(part: str, u: Floats) -> Floats:
        return np.array(its[part]["c"] @ states[part] + its[part]["d"] @ u)

    now: dict[str, Floats] = {}
    for part in order:
        now[part] = shown(part, taken(part, 0.0, now, now))
    history = [dict(now)]
    for push in pushes:
        before, begin = dict(now), dict(states)
        for _ in range(sweeps):
            last = dict(now)
            for part in order:
                u = taken(part, push, last if jacobi else now, before)
                states[part] = moves[part] @ [*begin[part], *u]
                now[part] = shown(part, u)
        history.append(dict(now))
    return {part: np.array([row[part] for row in history]) for part in order}
