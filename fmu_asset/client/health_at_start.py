"""Simulation with health that an FMU accepts at its start only.

If damage is a parameter of the FMU, it cannot change during a simulation. A history in which it
changes is therefore cut into runs of constant health, each with a start of its own.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from reporting.arrays import Float

from .blocks import Blocks, step_count
from .bound_input import BoundInput
from .values import InputsByRole


class ConstantHealthRun(NamedTuple):
    """Successive steps with constant health, which need only one start.

    Attributes
    ----------
    first_inputs : dict of str to dict
        All inputs of the first step by role and name, including the health.
    histories : dict of str to dict
        Inputs of all steps as `FmiAsset.simulate` takes them, without health that is set at the
        start.
    steps : int
        The number of steps.
    """

    first_inputs: dict[str, dict[str, npt.ArrayLike]]
    histories: dict[str, dict[str, npt.ArrayLike]]
    steps: int


class _CheckedHistory(NamedTuple):
    """The history of one input, with checked values.

    Attributes
    ----------
    role, name : str
        The role and the name in the binding.
    values : array_like
        The values as the caller gave them.
    numbers : (n,) or (N, n) ndarray
        The values in the FMU's unit.
    is_at_start : bool
        Whether the FMU accepts the input only before its initialisation.
    """

    role: str
    name: str
    values: npt.ArrayLike
    bound_input: BoundInput
    numbers: Float
    is_at_start: bool

    @property
    def varies(self) -> bool:
        """Whether there is a value for each step."""
        return self.numbers.ndim == 2

    def part(self, begin: int, end: int) -> npt.ArrayLike:
        """Return the values from one step to before another, as the caller gave them."""
        return np.asarray(self.values)[begin:end] if self.varies else self.values

    def first_value(self, begin: int) -> npt.ArrayLike:
        """Return the value of a step, as the caller gave it."""
        if self.varies:
            value: npt.ArrayLike = np.asarray(self.values)[begin]
            return value
        return self.values


def split_where_health_changes(
    blocks: Blocks, inputs: InputsByRole, steps: int | None
) -> list[ConstantHealthRun]:
    """Split histories of inputs into runs of constant health, each with its own start.

    Health that is a parameter of the FMU can only be set before its initialisation, so each run
    needs a new start.

    Parameters
    ----------
    inputs : mapping of str to mapping
        Inputs by role and name: one value for all steps, or one for each.
    steps : int, optional
        The number of steps; by default that of the histories.

    Raises
    ------
    BindingError
        If a name is not in the binding.
    FmuInputError
        If a value is wrong, or the histories have different lengths.
    """
    histories = _checked_histories(blocks, inputs)
    count = step_count([(entry.bound_input, entry.numbers) for entry in histories], steps)
    first_steps = _first_steps(histories, count)
    runs = []
    for begin, end in zip(first_steps, [*first_steps[1:], count], strict=True):
        first_inputs: dict[str, dict[str, npt.ArrayLike]] = {}
        step_histories: dict[str, dict[str, npt.ArrayLike]] = {}
        for history in histories:
            first_inputs.setdefault(history.role, {})[history.name] = history.first_value(begin)
            if not history.is_at_start:
                step_histories.setdefault(history.role, {})[history.name] = history.part(begin, end)
        runs.append(ConstantHealthRun(first_inputs, step_histories, end - begin))
    return runs


def _checked_histories(blocks: Blocks, inputs: InputsByRole) -> list[_CheckedHistory]:
    """Return the histories of all inputs, checked and converted."""
    histories = []
    for role, by_name in inputs.items():
        table: Mapping[str, npt.ArrayLike] = by_name or {}
        for name, values in table.items():
            bound_input = blocks.bound_input(role, name)
            numbers = bound_input.numbers(values, history=True)
            is_at_start = role == "health" and name in blocks.health_at_start
            histories.append(_CheckedHistory(role, name, values, bound_input, numbers, is_at_start))
    return histories


def _first_steps(histories: list[_CheckedHistory], count: int) -> list[int]:
    """Return the first step of each run of constant health among `count` steps."""
    health_columns = []
    for history in histories:
        if history.is_at_start:
            width = len(history.bound_input.positions)
            health_columns.append(
                np.broadcast_to(history.numbers.reshape(-1, width), (count, width))
            )
    if not health_columns:
        return [0]
    health = np.hstack(health_columns)
    has_changed = (health[1:] != health[:-1]).any(axis=1)
    return [0, *(np.flatnonzero(has_changed) + 1).tolist()]
