"""Missing effects of a wing as they act: on its structure, and as sensors on what it shows.

Copied into the FMU, where a plain structure needs nothing of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fe.runtime.patch import HighPass, ModelPatch
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.sensors import FilterMemory, SensorRecord, apply_sensors, needs_structure
from fe.runtime.transient import ModalIntegrator

from .base import UnacceptableValuesError
from .effect_variables import TEMPERATURE, active_primitives, effect_rows

FloatArray = npt.NDArray[np.float64]


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
    channels : tuple of (str, str)
        Outputs that sensors show, with their quantities: strains, tip displacement, load point displacement.
    wing : PatchedWing, optional
        The wing for patches; None where the effects are of sensors alone.
    """

    def __init__(
        self,
        effects: Sequence[Mapping[str, Any]],
        channels: tuple[tuple[str, str], ...],
        wing: PatchedWing | None = None,
    ) -> None:
        self._effects, self._channels, self.wing = effects, channels, wing
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
        (shown,), _ = apply_sensors(acting.patch, row, values[np.newaxis], None, transverse, shear, filters)
        if not math.isfinite(float(shown.sum())):
            raise UnacceptableValuesError("With the effects that are on, an output is not finite.")
        return shown.tolist(), filters.after

    def integrator(self, vector: FloatArray, damping: tuple[float, float], acting: Acting) -> ModalIntegrator:
        """Return the wing for patches in time, the last one where nothing changed."""
        key = (vector[:-2].tobytes(), damping, acting.values)
        if self._last is None or self._last[0] != key:
            made = ModalIntegrator(self.wing, vector, *damping, acting.patch, acting.temperature)
            self._last = key, made
        return self._last[1]
