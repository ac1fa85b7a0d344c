"""Simulation with health that an FMU takes at its start only.

Where damage is a parameter of the FMU, it cannot change during a run. A history in which it changes
is cut into runs of constant health, each with a start of its own.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from reporting.arrays import Float

from .exchange import Exchange
from .slots import InputSlot
from .values import InputsByRole


class ConstantHealthRun(NamedTuple):
    """Successive steps with the same health.

    Attributes
    ----------
    first_inputs : dict of str to dict
        Inputs of the first step by role and name, the health among them.
    histories : dict of str to dict
        Inputs of all steps as `FmiAsset.simulate` takes them, without health set at the start.
    steps : int
        Number of steps.
    """

    first_inputs: dict[str, dict[str, npt.ArrayLike]]
    histories: dict[str, dict[str, npt.ArrayLike]]
    steps: int


class _CheckedHistory(NamedTuple):
    """The history of one input.

    Attributes
    ----------
    role, name : str
        Role and name in the binding.
    values : array_like
        Values as the caller gave them.
    slot : InputSlot
        Where the input goes.
    numbers : (n,) or (N, n) ndarray
        Checked values in the FMU's unit.
    is_at_start : bool
        Whether the FMU takes the input at its start only.
    """

    role: str
    name: str
    values: npt.ArrayLike
    slot: InputSlot
    numbers: Float
    is_at_start: bool

    @property
    def varies(self) -> bool:
        """Whether there is a value for each step."""
        return self.numbers.ndim == 2

    def part(self, begin: int, end: int) -> npt.ArrayLike:
        """Return the values of some steps, as the caller gave them."""
        return np.asarray(self.values)[begin:end] if self.varies else self.values

    def first_value(self, begin: int) -> npt.ArrayLike:
        """Return the value of a step, as the caller gave it."""
        if self.varies:
            first: npt.ArrayLike = np.asarray(self.values)[begin]
            return first
        return self.values


def split_where_health_changes(
    exchange: Exchange, inputs: InputsByRole, steps: int | None
) -> list[ConstantHealthRun]:
    """Return the runs of constant health that histories of inputs consist of.

    Parameters
    ----------
    exchange : Exchange
        The binding, resolved against the FMU.
    inputs : mapping of str to mapping
        Inputs by role and name: one value for all steps, or one for each.
    steps : int, optional
        Number of steps; that of the histories if absent.

    Raises
    ------
    BindingError
        If a name is not in the binding.
    FmuInputError
        If a value is wrong, or the histories have different lengths.
    """
    histories = _checked_histories(exchange, inputs)
    count = exchange.step_count([(entry.slot, entry.numbers) for entry in histories], steps)
    begins = _first_steps(histories, count)
    runs = []
    for begin, end in zip(begins, [*begins[1:], count], strict=True):
        first_inputs: dict[str, dict[str, npt.ArrayLike]] = {}
        sent: dict[str, dict[str, npt.ArrayLike]] = {}
        for history in histories:
            first_inputs.setdefault(history.role, {})[history.name] = history.first_value(begin)
            if not history.is_at_start:
                sent.setdefault(history.role, {})[history.name] = history.part(begin, end)
        runs.append(ConstantHealthRun(first_inputs, sent, end - begin))
    return runs


def _checked_histories(exchange: Exchange, inputs: InputsByRole) -> list[_CheckedHistory]:
    histories = []
    for role, by_name in inputs.items():
        table: Mapping[str, npt.ArrayLike] = by_name or {}
        for name, values in table.items():
            slot = exchange.slot(role, name)
            numbers = slot.numbers(values, history=True)
            is_at_start = role == "health" and name in exchange.health_slots
            histories.append(_CheckedHistory(role, name, values, slot, numbers, is_at_start))
    return histories


def _first_steps(histories: list[_CheckedHistory], count: int) -> list[int]:
    """Return the first step, and every step whose health differs from that of the step before."""
    columns = []
    for history in histories:
        if history.is_at_start:
            width = len(history.slot.positions)
            columns.append(np.broadcast_to(history.numbers.reshape(-1, width), (count, width)))
    if not columns:
        return [0]
    health = np.hstack(columns)
    differs = (health[1:] != health[:-1]).any(axis=1)
    return [0, *(np.flatnonzero(differs) + 1).tolist()]
