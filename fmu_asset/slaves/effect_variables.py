"""Missing effects as variables of the wing FMU: which there are, and the patch that their values make.

An effect has a switch and every number of its primitives as tunable parameters; they stand at the end of the
table, so that value references before them stay. This file is copied into the FMU, as `behaviour`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fe.runtime.patch import CHANNEL_UNIT, PER_RELEASE, PRIMITIVES

from .variables import FmuVariable, Table, Unit

TEMPERATURE = "temperature_difference"
"""Input of FMUs with an effect of temperature: the wing's temperature less the reference temperature [K]."""

ROTATING_PORT = "root"
"""The port of the wing whose motion is a rotation."""

RANGES: Mapping[str, tuple[float, float]] = {"side": (-1.0, 1.0), "element_count": (1.0, 1000.0)}
"""Ranges of the whole numbers of primitives; of the others the wing says itself what cannot be."""

UNITS = (
    Unit("K", (("K", 1),)),
    Unit("1/K", (("K", -1),), (("microstrain/K", 1e6),)),
    Unit("rad", (("rad", 1),), (("deg", 57.29577951308232),)),
    Unit("1/m", (("m", -1),)),
    Unit("m/s", (("m", 1), ("s", -1))),
    Unit("rad/s", (("rad", 1), ("s", -1))),
    Unit("N.m", (("kg", 1), ("m", 2), ("s", -2))),
    Unit("N/m", (("kg", 1), ("s", -2))),
    Unit("N.m/rad", (("kg", 1), ("m", 2), ("s", -2), ("rad", -1))),
    Unit("rad/(N.m)", (("rad", 1), ("kg", -1), ("m", -2), ("s", 2))),
)
"""Units of effects beside those of `variables`."""


class Number(NamedTuple):
    """One number of an effect: its variable, and where it stands in the effect's primitives."""

    name: str
    primitive: int
    key: str


def numbers_of(effect: Mapping[str, Any]) -> list[Number]:
    """Return the numbers of an effect in the order of its primitives.

    A number is called `effect.<id>.<key>`; where several primitives of the effect have one of that name,
    `effect.<id>.<key>[n]`, n the number of the primitive from 1.

    Parameters
    ----------
    effect : mapping
        `id`, and `primitives` as `ModelPatch.to_list` gives them.
    """
    found = [
        (number, key)
        for number, primitive in enumerate(effect["primitives"])
        for key, value in primitive.items()
        if isinstance(value, int | float)
    ]
    often = Counter(key for _, key in found)
    return [
        Number(f"effect.{effect['id']}.{key}" + (f"[{number + 1}]" if often[key] > 1 else ""), number, key)
        for number, key in found
    ]


def _unit(primitive: Mapping[str, Any], key: str) -> str:
    """Return the unit of a primitive's number in the spelling of FMI, "1" for none."""
    unit = PRIMITIVES[str(primitive["kind"])].units.get(key, "1")
    if unit in (CHANNEL_UNIT, PER_RELEASE):
        channel = str(primitive["channel"])
        displacement = channel.endswith("displacement") or primitive.get("quantity") == "displacement"
        if unit == CHANNEL_UNIT:
            return "m" if displacement else "1"
        return "1" if displacement else "1/m"
    moving, _, turning = unit.partition(" or ")
    return (turning if turning and primitive.get("port") == ROTATING_PORT else moving).replace(" ", ".")


def switch_of(effect: Mapping[str, Any]) -> str:
    """Return the name of the switch of an effect."""
    return f"effect.{effect['id']}.active"


def effect_rows(
    effects: Sequence[Mapping[str, Any]], first: int, start: Mapping[str, float]
) -> tuple[FmuVariable, ...]:
    """Return the rows that effects append to the table of variables.

    Parameters
    ----------
    effects : sequence of mapping
        `id` and `primitives` of each.
    first : int
        Value reference of the first row.
    start : mapping of str to float
        Start values by variable name; a switch that is not there is off, a number has its value in the patch.
    """
    table = Table({}, first)
    for effect in effects:
        kinds = " and ".join(dict.fromkeys(str(item["kind"]) for item in effect["primitives"]))
        switch = switch_of(effect)
        table.add(
            switch, "parameter",
            f"Whether the effect {effect['id']} ({kinds.replace('_', ' ')}) acts: 0 off, 1 on",
            unit="1", box=(0.0, 1.0), default=start.get(switch, 0.0), tunable=True,
        )  # fmt: skip
        for name, number, key in numbers_of(effect):
            primitive = effect["primitives"][number]
            value, place = primitive[key], primitive.get("port") or primitive.get("channel") or ""
            where = f" at {place}" if place not in ("", "*") else ""
            text = f"{key.replace('_', ' ')} of {str(primitive['kind']).replace('_', ' ')}{where}"
            whole = isinstance(value, int)
            table.add(
                name, "parameter", text[:1].upper() + text[1:],
                kind="Integer" if whole else "Real", unit=None if whole else _unit(primitive, key),
                box=RANGES[key] if whole else (None, None), default=start.get(name, value), tunable=True,
            )  # fmt: skip
    if {"thermal_strain", "modulus_temperature"} & {
        item["kind"] for effect in effects for item in effect["primitives"]
    }:
        table.add(
            TEMPERATURE, "input", "Temperature of the wing less the reference temperature",
            unit="K", box=(-100.0, 100.0), default=start.get(TEMPERATURE, 0.0),
        )  # fmt: skip
    return table.rows()


def units_of(rows: Sequence[FmuVariable]) -> tuple[Unit, ...]:
    """Return the units of effects that rows use beside those of `variables`."""
    used = {row.unit for row in rows}
    return tuple(unit for unit in UNITS if unit.name in used)


def active_primitives(
    effects: Sequence[Mapping[str, Any]], value: Mapping[str, float]
) -> list[dict[str, Any]]:
    """Return the primitives of the effects that are switched on, with the values of their variables.

    Parameters
    ----------
    effects : sequence of mapping
        `id` and `primitives` of each.
    value : mapping of str to float
        Values by variable name; a switch is on above one half.
    """
    rows: list[dict[str, Any]] = []
    for effect in effects:
        if value[switch_of(effect)] <= 0.5:
            continue
        own = [dict(primitive) for primitive in effect["primitives"]]
        for name, number, key in numbers_of(effect):
            own[number][key] = type(own[number][key])(value[name])
        rows += own
    return rows
