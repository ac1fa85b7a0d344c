"""Missing effects of a wing: their variables, the patch that these make, and how it acts on what is shown.

An effect has a switch and every number of its primitives as tunable parameters; they stand at the end of the
table, so that value references before them stay. Copied into the FMU, where a plain structure needs nothing
of it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.runtime.patch import CHANNEL_UNIT, PER_RELEASE, PRIMITIVES, HighPass, ModelPatch
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.sensors import FilterMemory, SensorRecord, apply_sensors, needs_structure
from fe.runtime.transient import ModalIntegrator

from .base import UnacceptableValuesError
from .variables import FmuVariable, Table

TEMPERATURE = "temperature_difference"
"""Input of FMUs with an effect of temperature: the wing's temperature less the reference temperature [K]."""

ROTATING_PORT = "root"
"""The port of the wing whose motion is a rotation."""

RANGES: Mapping[str, tuple[float, float]] = {"side": (-1.0, 1.0), "element_count": (1.0, 1000.0)}
"""Ranges of the whole numbers of primitives; of the others the wing says itself what cannot be."""


def output_channels(gauge_count: int) -> tuple[tuple[str, str], ...]:
    """Return names and quantities of the outputs that sensors show, in the behaviour's order."""
    strains = tuple((f"strain[{gauge}]", "strain") for gauge in range(1, gauge_count + 1))
    return (*strains, ("tip_displacement", "displacement"), ("load_point_displacement", "displacement"))


def numbers_of(effect: Mapping[str, Any]) -> dict[str, tuple[int, str]]:
    """Return the numbers of an effect by their variables: which primitive has them under which key.

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
    return {
        f"effect.{effect['id']}.{key}" + (f"[{number + 1}]" if often[key] > 1 else ""): (number, key)
        for number, key in found
    }


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
        words = " and ".join(dict.fromkeys(str(item["kind"]) for item in effect["primitives"]))
        switch = switch_of(effect)
        table.add(
            switch, "parameter",
            f"Whether the effect {effect['id']} ({words.replace('_', ' ')}) acts: 0 off, 1 on",
            unit="1", box=(0.0, 1.0), default=start.get(switch, 0.0), tunable=True,
        )  # fmt: skip
        for name, (number, key) in numbers_of(effect).items():
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
    kinds = {item["kind"] for effect in effects for item in effect["primitives"]}
    if kinds & {"thermal_strain", "modulus_temperature"}:
        table.add(
            TEMPERATURE, "input", "Temperature of the wing less the reference temperature",
            unit="K", box=(-100.0, 100.0), default=start.get(TEMPERATURE, 0.0),
        )  # fmt: skip
    return table.rows()


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
        for name, (number, key) in numbers_of(effect).items():
            own[number][key] = type(own[number][key])(value[name])
        rows += own
    return rows


class Acting(NamedTuple):
    """Effects with the values of their variables.

    Attributes
    ----------
    values : tuple of float
        Of the variables.
    patch : ModelPatch
        What is on.
    temperature : float
        Less the reference temperature [K].
    changes_structure : bool
        Whether more is on than what sensors make of the readings.
    filters : list of tuple
        The chain of filters, whose memory stays where it is the same.
    """

    values: tuple[float, ...]
    patch: ModelPatch
    temperature: float
    changes_structure: bool
    filters: list[tuple[str, str, float]]


class Effects:
    """Missing effects that can be switched on and changed between steps.

    Parameters
    ----------
    effects : sequence of mapping
        `id` and `primitives` of each effect.
    gauge_count : int
        Number of gauges of the wing.
    arrays : PatchArrays, optional
        The wing for patches; None where the effects are of sensors alone.
    """

    def __init__(
        self, effects: Sequence[Mapping[str, Any]], gauge_count: int, arrays: PatchArrays | None = None
    ) -> None:
        self._effects, self._channels = effects, output_channels(gauge_count)
        self.wing = None if arrays is None else PatchedWing(arrays)
        self._names = tuple(row.name for row in effect_rows(effects, 0, {}))
        self._last: tuple[object, ModalIntegrator] | None = None  # it never changes

    def values(self, tuned: Mapping[str, float]) -> tuple[float, ...]:
        """Return the values of the variables in their order."""
        return tuple(tuned[name] for name in self._names)

    def acting(self, values: Sequence[float]) -> Acting:
        """Return the effects as values of the variables have them; raises `InvalidPatchError`."""
        named = dict(zip(self._names, values, strict=True))
        patch = ModelPatch.from_list(active_primitives(self._effects, named))
        filters = [(item.channel, item.quantity, item.order) for item in patch if isinstance(item, HighPass)]
        return Acting(tuple(values), patch, named.get(TEMPERATURE, 0.0), needs_structure(patch), filters)

    def shown(
        self, acting: Acting, values: FloatArray, across: FloatArray | None,
        memory: Sequence[float] | None, duration: float, *, time: float, **record: Any,
    ) -> tuple[list[float], list[float]]:  # fmt: skip
        """Return what sensors show of the values (C,) of the channels, and what they remember.

        Parameters
        ----------
        acting : Acting
            The effects.
        values, across : (C,), (2, C) ndarray
            What there is, and strains across and in shear; None: no sensor needs them.
        memory : sequence of float, optional
            From the sample before, `duration` earlier.
        time : float
            Of the sample, as of `SensorRecord` [s].
        **record
            The other values of `SensorRecord`.

        Raises
        ------
        UnacceptableValuesError
            If a reading is not finite.
        """
        row = SensorRecord(
            self._channels, time=np.array([time]), temperature=np.array([acting.temperature]), **record
        )
        transverse, shear = (None, None) if across is None else across[:, np.newaxis]
        filters = FilterMemory(memory, duration)
        (shown,), _ = apply_sensors(
            acting.patch, row, values[np.newaxis], None, transverse, shear, high_pass=filters.filter_row
        )
        if not math.isfinite(float(shown.sum())):
            raise UnacceptableValuesError("With the effects that are on, an output is not finite.")
        return shown.tolist(), filters.states

    def integrator(self, vector: FloatArray, damping: tuple[float, float], acting: Acting) -> ModalIntegrator:
        """Return the wing for patches in time, the last one where nothing changed."""
        assert self.wing is not None
        key = (vector[:-2].tobytes(), damping, acting.values)
        if self._last is None or self._last[0] != key:
            structure = self.wing.structure_at(vector, acting.patch, acting.temperature)
            self._last = key, ModalIntegrator(structure, *damping)
        return self._last[1]
