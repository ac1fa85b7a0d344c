"""Histories of health that an FMU takes at its start only, cut into courses of equal health."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from .exchange import Exchange


class ConstantHealthRun(NamedTuple):
    """Steps that are made one after the other in one health.

    Attributes
    ----------
    first_inputs : dict of str to dict
        Inputs of the first step by role and name, the health among them.
    histories : dict of str to dict
        What `FmiAsset.simulate` takes for the steps, without the health that is set at the start.
    steps : int
        Number of steps.
    """

    first_inputs: dict[str, dict[str, Any]]
    histories: dict[str, dict[str, Any]]
    steps: int


def split_where_health_changes(
    exchange: Exchange, roles: Mapping[str, Mapping[str, Any] | None], steps: int | None
) -> list[ConstantHealthRun]:
    """Return the courses that histories consist of.

    Parameters
    ----------
    exchange : Exchange
        What the asset exchanges with its FMU.
    roles : mapping of str to mapping
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
    values: dict[tuple[str, str], Any] = {}
    numbers = []
    for role, table in roles.items():
        for name, history in (table or {}).items():
            slot = exchange.slot(role, name)
            values[role, name] = history
            numbers.append((slot, slot.numbers(history, history=True)))
    count = exchange.step_count(numbers, steps)
    varies = {key: array.ndim == 2 for key, (_, array) in zip(values, numbers, strict=True)}
    health = [
        np.broadcast_to(array.reshape(-1, len(slot.positions)), (count, len(slot.positions)))
        for (role, name), (slot, array) in zip(values, numbers, strict=True)
        if role == "health" and name in exchange.health_slots
    ]
    begins = [0, *_changes(np.hstack(health))] if health else [0]
    courses = []
    for begin, end in zip(begins, [*begins[1:], count], strict=True):
        first: dict[str, dict[str, Any]] = {}
        histories: dict[str, dict[str, Any]] = {}
        for (role, name), history in values.items():
            part = np.asarray(history)[begin:end] if varies[role, name] else history
            first.setdefault(role, {})[name] = part[0] if varies[role, name] else part
            if not (role == "health" and name in exchange.health_slots):
                histories.setdefault(role, {})[name] = part
        courses.append(ConstantHealthRun(first, histories, end - begin))
    return courses


def _changes(rows: Any) -> list[int]:
    """Return the numbers of the rows that differ from the one before."""
    differs = (rows[1:] != rows[:-1]).any(axis=1)
    changes: list[int] = (np.flatnonzero(differs) + 1).tolist()
    return changes
