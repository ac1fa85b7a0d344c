"""Missing effects of a wing's FMU: their variables, their patch of the model, and sensor readings.

For each effect there is a switch, and a tunable parameter for every number of its primitives. They
stand at the end of the table, so that the value references before them do not change. This file is
copied into the FMU; a structure without effects does not need it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias, TypedDict

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.runtime.patch import CHANNEL_UNIT, PER_RELEASE, PRIMITIVES, Filter, ModelPatch
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.sensors import FilterMemory, SensorRecord, apply_sensors, needs_structure
from fe.runtime.transient import ModalIntegrator

from .contents import UnacceptableValuesError
from .variables import FmuVariable, VariableTable

TEMPERATURE = "temperature_difference"
"""Input of FMUs with an effect of temperature: difference from the reference temperature [K]."""

ROTATING_PORT = "root"
"""The port of the wing whose motion is a rotation."""

RANGES: Mapping[str, tuple[float, float]] = {"side": (-1.0, 1.0), "element_count": (1.0, 1000.0)}
"""Ranges of the whole numbers of primitives; the wing itself refuses impossible other numbers."""
_TEMPERATURE_RANGE = (-100.0, 100.0)

PrimitiveRecord: TypeAlias = dict[str, object]
"""A primitive, an elementary change of a model or of a sensor, as plain data: its kind, its channel
or port, and its numbers."""


class EffectRecord(TypedDict):
    """An effect as plain data; `ModelPatch.to_list` gives its primitives."""

    id: str
    primitives: list[PrimitiveRecord]


def output_channels(gauge_count: int) -> tuple[tuple[str, str], ...]:
    """Return name and quantity of the wing's measured outputs, in the order of the FMU."""
    strains = tuple((f"strain[{gauge}]", "strain") for gauge in range(1, gauge_count + 1))
    displacements = (
        ("tip_displacement", "displacement"),
        ("load_point_displacement", "displacement"),
    )
    return strains + displacements


class PrimitiveNumber(NamedTuple):
    """A number of an effect: the position of its primitive, and its key there."""

    primitive: int
    key: str


def numbers_of(effect: EffectRecord) -> dict[str, PrimitiveNumber]:
    """Return the numbers in the primitives of an effect, by the names of their FMU variables.

    The variable of a number is called `effect.<id>.<key>`. If several primitives of the effect have
    a number with this key, it is called `effect.<id>.<key>[n]`, with the number n of the primitive
    from 1.
    """
    numbers = []
    for position, primitive in enumerate(effect["primitives"]):
        for key, value in primitive.items():
            if isinstance(value, int | float):
                numbers.append(PrimitiveNumber(position, key))
    key_counts = Counter(number.key for number in numbers)
    by_name = {}
    for number in numbers:
        name = f"effect.{effect['id']}.{number.key}"
        if key_counts[number.key] > 1:
            name += f"[{number.primitive + 1}]"
        by_name[name] = number
    return by_name


def _unit(primitive: PrimitiveRecord, key: str) -> str:
    """Return the unit of a primitive's number as FMI spells it, such as "N.s" or "1"."""
    unit = PRIMITIVES[str(primitive["kind"])].units.get(key, "1")
    # Two units stand for others. CHANNEL_UNIT is that of the channel, which reads a displacement
    # [m] or a strain [1]. PER_RELEASE is that unit divided by the release amplitude, the
    # displacement [m] from which a ring-down starts.
    if unit in (CHANNEL_UNIT, PER_RELEASE):
        # A channel is known as a displacement by its name; `EVERY_CHANNEL` by its quantity.
        is_displacement = (
            str(primitive["channel"]).endswith("displacement")
            or primitive.get("quantity") == "displacement"
        )
        if unit == CHANNEL_UNIT:
            return "m" if is_displacement else "1"
        return "1" if is_displacement else "1/m"
    # A unit such as "N s / m or N m s / rad" is that of a translating or of a rotating port.
    translation_unit, _, rotation_unit = unit.partition(" or ")
    if rotation_unit and primitive.get("port") == ROTATING_PORT:
        return rotation_unit.replace(" ", ".")
    return translation_unit.replace(" ", ".")


def switch_name(effect: EffectRecord) -> str:
    """Return the name of the variable that switches an effect on."""
    return f"effect.{effect['id']}.active"


def effect_rows(
    effects: Sequence[EffectRecord], first: int, start: Mapping[str, float]
) -> tuple[FmuVariable, ...]:
    """Return the variables that effects add to the FMU, as rows of its table of variables.

    Parameters
    ----------
    first : int
        The value reference of the first row.
    start : mapping of str to float
        Start values by variable name. By default an effect is off, and a number has its value in
        the patch.
    """
    table = VariableTable({}, first)
    for effect in effects:
        _add_switch(table, effect, start)
        for name, number in numbers_of(effect).items():
            primitive = effect["primitives"][number.primitive]
            _add_number(table, name, primitive, number.key, start)
    # Effects of temperature need the temperature as an input.
    kinds = {primitive["kind"] for effect in effects for primitive in effect["primitives"]}
    if kinds & {"thermal_strain", "modulus_temperature"}:
        table.add(
            TEMPERATURE,
            "input",
            "Temperature of the wing less the reference temperature",
            unit="K",
            limits=_TEMPERATURE_RANGE,
            default=start.get(TEMPERATURE, 0.0),
        )
    return table.rows()


def _add_switch(table: VariableTable, effect: EffectRecord, start: Mapping[str, float]) -> None:
    """Add the variable that switches an effect on."""
    kinds = dict.fromkeys(str(primitive["kind"]) for primitive in effect["primitives"])
    words = " and ".join(kinds).replace("_", " ")
    name = switch_name(effect)
    table.add(
        name,
        "parameter",
        f"Whether the effect {effect['id']} ({words}) acts: 0 off, 1 on",
        unit="1",
        limits=(0.0, 1.0),
        default=start.get(name, 0.0),
        tunable=True,
    )


def _add_number(
    table: VariableTable,
    name: str,
    primitive: PrimitiveRecord,
    key: str,
    start: Mapping[str, float],
) -> None:
    """Add an FMU variable for a number of a primitive; its default is the number itself."""
    value = primitive[key]
    assert isinstance(value, int | float)  # `numbers_of` names no other values
    location = primitive.get("port") or primitive.get("channel") or ""
    location_text = "" if location in ("", "*") else f" at {location}"
    kind = str(primitive["kind"]).replace("_", " ")
    description = f"{key.replace('_', ' ')} of {kind}{location_text}"
    is_whole = isinstance(value, int)
    table.add(
        name,
        "parameter",
        description[:1].upper() + description[1:],
        kind="Integer" if is_whole else "Real",
        unit=None if is_whole else _unit(primitive, key),
        limits=RANGES[key] if is_whole else (None, None),
        default=start.get(name, value),
        tunable=True,
    )


def active_primitives(
    effects: Sequence[EffectRecord], values: Mapping[str, float]
) -> list[PrimitiveRecord]:
    """Return the primitives of the effects that are switched on, with the values of the variables.

    Parameters
    ----------
    values : mapping of str to float
        The values by variable name. An effect is on if its switch is above one half.
    """
    active: list[PrimitiveRecord] = []
    for effect in effects:
        if values[switch_name(effect)] <= 0.5:
            continue
        primitives = [dict(primitive) for primitive in effect["primitives"]]
        for name, number in numbers_of(effect).items():
            primitive = primitives[number.primitive]
            # Variables are floats; a number that is whole in the patch stays whole.
            is_whole = isinstance(primitive[number.key], int)
            value = values[name]
            primitive[number.key] = int(value) if is_whole else float(value)
        active += primitives
    return active


class ActiveEffects(NamedTuple):
    """The active effects with the present values of all variables.

    Attributes
    ----------
    values : tuple of float
        The values of the effects' variables.
    patch : ModelPatch
        The active effects as one patch.
    temperature : float
        The temperature of the wing minus the reference temperature [K].
    changes_structure : bool
        Whether an active effect changes more than the readings of sensors.
    filters : list of (str, str, float)
        Channel, quantity and order of each filter. The memory of the filters is kept while these
        stay the same.
    """

    values: tuple[float, ...]
    patch: ModelPatch
    temperature: float
    changes_structure: bool
    filters: list[tuple[str, str, float]]


class SensorReadings(NamedTuple):
    """The readings of all channels at one time.

    Attributes
    ----------
    values : list of float
        The readings.
    filter_memory : list of float
        The memory of the sensors' filters, which the next readings need.
    """

    values: list[float]
    filter_memory: list[float]


class SwitchableEffects:
    """Missing effects that can be switched and changed between steps.

    Parameters
    ----------
    arrays : PatchArrays, optional
        The wing for patches; None if all effects are those of sensors.

    Attributes
    ----------
    wing : PatchedWing or None
        The wing for patches.
    """

    def __init__(
        self,
        effects: Sequence[EffectRecord],
        gauge_count: int,
        arrays: PatchArrays | None = None,
    ) -> None:
        self._effects = effects
        self._channels = output_channels(gauge_count)
        self.wing = None if arrays is None else PatchedWing(arrays)
        self._names = tuple(row.name for row in effect_rows(effects, 0, {}))
        # the last integrator, which never changes, and what it was made for
        self._last_integrator: ModalIntegrator | None = None
        self._last_key: object = None

    def values(self, tuned: Mapping[str, float]) -> tuple[float, ...]:
        """Return values by name as a tuple in the order of the effects' variables."""
        return tuple(tuned[name] for name in self._names)

    def active(self, values: Sequence[float]) -> ActiveEffects:
        """Return the active effects, given the variables in the order of the table.

        Raises
        ------
        InvalidPatchError
            If a primitive does not accept the values of its numbers.
        """
        by_name = dict(zip(self._names, values, strict=True))
        patch = ModelPatch.from_list(active_primitives(self._effects, by_name))
        filters = []
        for primitive in patch:
            if isinstance(primitive, Filter):
                filters.append((primitive.channel, primitive.quantity, primitive.order))
        return ActiveEffects(
            values=tuple(values),
            patch=patch,
            temperature=by_name.get(TEMPERATURE, 0.0),
            changes_structure=needs_structure(patch),
            filters=filters,
        )

    def readings(
        self,
        active: ActiveEffects,
        values: FloatArray,
        strains_across: FloatArray | None,
        filter_memory: Sequence[float] | None,
        duration: float,
        *,
        kind: str,
        time: float,
        start: float,
        release: float,
    ) -> SensorReadings:
        """Return the sensor readings at the end of a step, with the active effects.

        Parameters
        ----------
        values : (C,) ndarray
            The true values of the channels.
        strains_across : (2, C) ndarray, optional
            The strains transverse to the gauges and in shear; None if no sensor needs them.
        filter_memory : sequence of float, optional
            The memory of the filters from the last readings; None starts them in steady state.
        duration : float
            The time since the last readings [s].
        kind : {"flight", "forced", "ringdown"}
            The kind of trial, see `SensorRecord`.
        time, start : float
            The time of the readings, and of the start of the simulation [s].
        release : float
            The displacement from which the structure was released [m].

        Raises
        ------
        UnacceptableValuesError
            If a reading is not finite.
        """
        record = SensorRecord(
            self._channels,
            time=np.array([time]),
            temperature=np.array([active.temperature]),
            kind=kind,
            start=start,
            release=release,
        )
        transverse = shear = None
        if strains_across is not None:
            transverse, shear = strains_across[:, np.newaxis]
        filters = FilterMemory(filter_memory, duration)
        (readings,), _ = apply_sensors(
            active.patch,
            record,
            values[np.newaxis],
            None,
            transverse,
            shear,
            high_pass=filters.filter_row,
        )
        if not math.isfinite(float(readings.sum())):
            raise UnacceptableValuesError("With the effects that are on, an output is not finite.")
        return SensorReadings(readings.tolist(), filters.states)

    def integrator(
        self, vector: FloatArray, damping: tuple[float, float], active: ActiveEffects
    ) -> ModalIntegrator:
        """Return the time integrator of the wing with the active effects.

        If nothing has changed since the last call, the last integrator is returned.

        Parameters
        ----------
        vector : (V,) ndarray
            The inputs of the model. The last two are controls, which do not affect the integrator.
        damping : (float, float)
            The coefficients of Rayleigh damping for mass [1/s] and stiffness [s].
        """
        assert self.wing is not None
        key = (vector[:-2].tobytes(), damping, active.values)
        if self._last_integrator is None or self._last_key != key:
            alpha, beta = damping
            structure = self.wing.structure_at(vector, active.patch, active.temperature)
            self._last_integrator = ModalIntegrator(structure, alpha, beta)
            self._last_key = key
        return self._last_integrator
