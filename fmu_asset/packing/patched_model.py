"""A wing with missing effects in this process: what the FMU of the same patch does, without an FMU."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fe.runtime.damping import rayleigh_damping_ratio
from fe.runtime.errors import FiniteElementError
from fe.runtime.patch import ModelPatch
from fe.runtime.reduced import ReducedModel
from fe.runtime.sensor_stream import Sample, SensorStream, needs_structure
from fe.runtime.transient import ModalIntegrator, TransientState
from fmu_asset.slaves.behaviour import Physics
from fmu_asset.slaves.effect_variables import effect_rows, switch_of
from fmu_asset.slaves.patched_behaviour import PatchedBehaviour, PatchedPhysics

from .patched_runtime import output_channels

MODE_COUNT = 6


def patched_behaviour(
    model: ReducedModel,
    effects: Sequence[Mapping[str, Any]],
    steps: Callable[..., Any] | None = None,
    mode_count: int = MODE_COUNT,
) -> PatchedBehaviour:
    """Return the behaviour of a wing with effects.

    Parameters
    ----------
    model : ReducedModel
        The wing.
    effects : sequence of mapping
        `id` and `primitives` of each, as `patched_runtime.plain_effects` returns them.
    steps : callable, optional
        Makes `fe.runtime.patched_steps.PatchedSteps`; needed for effects of structure and loads.
    mode_count : int
        Number of modes whose data are given.
    """
    physics = Physics(model, ModalIntegrator, TransientState, rayleigh_damping_ratio)
    patched = PatchedPhysics(
        ModelPatch.from_list, needs_structure, SensorStream, Sample, steps, FiniteElementError, np.append
    )
    return PatchedBehaviour(
        physics, min(mode_count, model.mode_count), patched, effects, output_channels(model.gauge_count)
    )


def effect_values(effects: Sequence[Mapping[str, Any]], *, active: bool) -> dict[str, float]:
    """Return the start values of the variables of effects by name, all switched on or all off."""
    start = {switch_of(effect): float(active) for effect in effects}
    return {row.name: float(row.start or 0.0) for row in effect_rows(effects, 0, start)}
