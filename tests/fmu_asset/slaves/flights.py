"""Flights at random, the same for every kind of FMU, and the comparison of their numbers."""

import re

import numpy as np
from numpy.typing import NDArray

from fmu_asset.archive.declared import VariableInfo
from tests.fmu_asset.slaves.slave import OK, Slave

STEP_LENGTHS = [1e-5, 1e-4, 1e-3, 0.01, 0.1, 1.0]
"""Lengths of steps [s]; a motion without damping takes the first four only."""
KIND_OF_VARIABLE = re.compile("strain|acceleration|(tip_|load_point_)?displacement|")


def draw_parameters(
    slave: Slave, ranged: dict[str, VariableInfo], rng: np.random.Generator, damping: str
) -> dict[str, float]:
    """Return start values within their ranges.

    Parameters
    ----------
    slave : Slave
    ranged : dict
        Variables that have a range, by name.
    rng : Generator
    damping : str
        "" for typical damping, "over" for overdamped modes, "none" for none.
    """
    parameters = {}
    for name, variable in ranged.items():
        is_free = not name.startswith(("damping", "initial", "response"))
        if variable.causality == "parameter" and is_free:
            value = rng.uniform(variable.minimum, variable.maximum)
            parameters[name.replace(".", "__")] = value
    alpha = rng.choice([0.0, rng.uniform(0.5, 5.0)])
    beta = rng.uniform(3e-4, 1e-3)
    if "initial_tip_displacement" in slave.reference:
        parameters["initial_tip_displacement"] = rng.uniform(-0.1, 0.1)
        parameters["damping__beta"] = {"": beta, "over": 20.0 * beta, "none": 0.0}[damping]
    overdamping_alpha = rng.uniform(60.0, 900.0)
    parameters["damping__alpha"] = {"": alpha, "over": overdamping_alpha, "none": 0.0}[damping]
    return parameters


def fly_at_random(
    slave: Slave, seed: int, response: int, damping: str = "", steps: int = 25
) -> NDArray[np.float64]:
    """Return all real variables (S + 1, V) of steps with random parameters, inputs and lengths.

    Health mostly stays; a load is often none at all.
    """
    rng = np.random.default_rng(seed)
    ranged = {
        name: variable for name, variable in slave.variables.items() if variable.maximum is not None
    }
    parameters = draw_parameters(slave, ranged, rng, damping)
    assert slave.start(response=response, **parameters) == OK, slave.log
    inputs = {name: float(name == "load_factor") for name in slave.inputs}
    loads = [name for name in inputs if not name.startswith("health")]
    lengths = STEP_LENGTHS[: 4 if damping == "none" else 6]
    time = 0.0
    rows = [slave.everything()]
    for _ in range(steps):
        for name in inputs:
            if rng.random() < (0.3 if name.startswith("health") else 0.5):
                inputs[name] = float(rng.uniform(ranged[name].minimum, ranged[name].maximum))
        if rng.random() < 0.2:
            inputs[str(rng.choice(loads))] = 0.0
        length = float(rng.choice(lengths))
        assert slave.step(list(inputs.values()), time, length) == OK, slave.log
        time += length
        rows.append(slave.everything())
    return np.array(rows)


def kind_of(name: str) -> str:
    """Return the kind of a variable: strain, displacement, acceleration or none."""
    match = KIND_OF_VARIABLE.match(name)
    assert match is not None
    return match[0].removeprefix("tip_").removeprefix("load_point_")


def assert_same_numbers(
    names: list[str],
    ours: NDArray[np.float64],
    expected: NDArray[np.float64],
    *,
    so_far: bool = True,
) -> None:
    """Compare flights (S, V) to 1e-12 of the largest value of a kind, modal outputs of each.

    A bound is made of strains or displacements that cancel. The largest value is that of the flight
    up to a sample if `so_far`, else that of the whole flight; accelerations jump, so that theirs
    is always that of the whole flight.
    """
    sizes = np.abs(expected)
    largest_so_far = np.maximum.accumulate(sizes)
    kinds = [kind_of(name) for name in names]
    for number, (name, kind) in enumerate(zip(names, kinds, strict=True)):
        if kind:
            is_of_kind = [other == kind for other in kinds]
            scale = largest_so_far[:, is_of_kind].max(axis=1)
            if kind == "acceleration" or not so_far:
                scale = scale[-1]
        else:
            scale = sizes[:, number]
        error = np.abs(ours[:, number] - expected[:, number])
        assert np.all(error <= 1e-12 * scale), name
