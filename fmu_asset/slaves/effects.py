"""Missing effects of a wing as they act: on its structure, and as sensors on what it shows.

Copied into the FMU, where a plain structure needs nothing of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from fe.runtime.patch import ModelPatch
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.sensors import FilterMemory, SensorRecord, apply_sensors, needs_structure
from fe.runtime.transient import ModalIntegrator

from .base import UnacceptableValuesError
from .effect_variables import TEMPERATURE, active_primitives, effect_rows

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Acting:
    """Effects with the values of their variables.

    Attributes
    ----------
    values : tuple of float
        Of the variables.
    patch : ModelPatch
        What is on.
    temperature : float
        Less the reference temperature [K].
    channels : tuple of (str, str)
        As of `Effects`.
    """

    values: tuple[float, ...]
    patch: ModelPatch
    temperature: float
    channels: tuple[tuple[str, str], ...]

    @cached_property
    def changes_structure(self) -> bool:
        """Whether more is on than what sensors make of the readings."""
        return needs_structure(self.patch)

    @cached_property
    def filters(self) -> list[tuple[object, ...]]:
        """The chain of filters, whose memory stays where it is the same."""
        return [
            (item["channel"], item["quantity"], item["order"])
            for item in self.patch.to_list()
            if item["kind"] == "high_pass"
        ]

    def shown(
        self, values: FloatArray, across: FloatArray | None, memory: Sequence[float] | None, duration: float,
        end: float, *, begun: float, release: float, dynamic: bool,
    ) -> tuple[list[float], list[float]]:  # fmt: skip
        """Return what sensors show of the values (C,) of the channels at a time, and what they remember.

        Parameters
        ----------
        values, across : (C,), (2, C) ndarray
            What there is, and strains across and in shear; None: no sensor needs them.
        memory : sequence of float, optional
            From the sample before, `duration` earlier.
        end, begun : float
            Time of the sample, and of the start [s].
        release : float
            Amplitude of the release at the start [m]; zero: none, and decaying lines do nothing.
        dynamic : bool
            Whether this is a motion; else high-pass and lines do nothing.

        Raises
        ------
        UnacceptableValuesError
            If a reading is not finite.
        """
        record = SensorRecord(
            channels=self.channels,
            kind="flight" if not dynamic else "ringdown" if release else "forced",
            time=np.array([end - begun if dynamic else end]),
            start=begun,
            temperature=np.array([self.temperature]),
            release=release,
        )
        transverse, shear = (None, None) if across is None else across[:, np.newaxis]
        filters = FilterMemory(memory, duration)
        (shown,), _ = apply_sensors(self.patch, record, values[np.newaxis], None, transverse, shear, filters)
        if not math.isfinite(float(shown.sum())):
            raise UnacceptableValuesError("With the effects that are on, an output is not finite.")
        return shown.tolist(), filters.after


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
        return Acting(tuple(values), patch, named.get(TEMPERATURE, 0.0), self._channels)

    def integrator(self, vector: FloatArray, damping: tuple[float, float], acting: Acting) -> ModalIntegrator:
        """Return the wing for patches in time, the last one where nothing changed."""
        key = (vector[:-2].tobytes(), damping, acting.values)
        if self._last is None or self._last[0] != key:
            made = ModalIntegrator(self.wing, vector, *damping, acting.patch, acting.temperature)
            self._last = key, made
        return self._last[1]
