"""What a wing that carries missing effects needs beside the plain one: effects, arrays, behaviour."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from fe.runtime.errors import FiniteElementError
from fe.runtime.patch import LocalStiffnessLoss, ModelPatch
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.reduced import ReducedModel
from fe.runtime.sensors import needs_structure
from fe.runtime.transient import ModalIntegrator
from fmu_asset.errors import PatchFileError
from fmu_asset.slaves.behaviour import StructureBehaviour
from fmu_asset.slaves.effects import Effects, effect_rows, switch_of
from fmu_asset.slaves.table import structure_table

from .patch_file import Effect

ARRAYS_FILE = "resources/patch_arrays.npz"


def output_channels(gauge_count: int) -> tuple[tuple[str, str], ...]:
    """Return names and quantities of the outputs that sensors show, in the behaviour's order."""
    strains = tuple((f"strain[{gauge}]", "strain") for gauge in range(1, gauge_count + 1))
    return (*strains, ("tip_displacement", "displacement"), ("load_point_displacement", "displacement"))


def plain_effects(effects: Sequence[Effect]) -> list[dict[str, Any]]:
    """Return effects as plain data, as `fmu_asset.slaves.effects` takes them."""
    return [{"id": effect.id, "primitives": effect.patch.to_list()} for effect in effects]


def patched_members(
    model: ReducedModel,
    effects: Sequence[dict[str, Any]],
    arrays: PatchArrays | None,
) -> dict[str, bytes]:
    """Return the further files of an FMU that carries effects, by their names in the archive.

    Parameters
    ----------
    model : ReducedModel
        The wing.
    effects : sequence of dict
        As `plain_effects` returns them.
    arrays : PatchArrays or None
        The same wing in the basis for patches; needed where an effect is of more than sensors.

    Raises
    ------
    PatchFileError
        If the arrays are missing or are those of another wing, or the wing cannot carry an effect.
    """
    record = {"channels": output_channels(model.gauge_count), "effects": effects}
    # The order of keys is that of the variables.
    text = json.dumps(record, indent=1, allow_nan=False)
    members = {"resources/effects.json": f"{text}\n".encode()}
    patch = ModelPatch.from_list([primitive for effect in effects for primitive in effect["primitives"]])
    if not needs_structure(patch):
        return members
    if arrays is None:
        raise PatchFileError(
            "The patch changes structure or loads, for which the FMU needs the wing in the basis for "
            "patches: give `arrays`, as `fe.reduction.model_cache.patch_arrays` returns them."
        )
    if arrays.design_hash != model.design_hash:
        raise PatchFileError(
            f"The wing for patches is of the design {arrays.design_hash[:12]}, and the reduced model of "
            f"{model.design_hash[:12]}; make both of one design."
        )
    try:
        ModalIntegrator(PatchedWing(arrays), model.nominal, *model.damping.tolist(), patch).modes  # noqa: B018
    except FiniteElementError as cause:
        raise PatchFileError(f"The wing cannot carry the patch: {cause}") from cause
    if not len(patch.of(LocalStiffnessLoss)):  # strips, which only that needs, are most of the bytes
        strips = ("strip_stiffness", "strip_of", "term_of")
        arrays = replace(arrays, **{name: getattr(arrays, name)[:0] for name in strips})
    return {**members, ARRAYS_FILE: arrays.to_bytes()}


def patched_behaviour(
    model: ReducedModel, effects: Sequence[Mapping[str, Any]], arrays: PatchArrays | None
) -> StructureBehaviour:
    """Return the behaviour of a wing with effects in this process, without an FMU.

    Parameters
    ----------
    model : ReducedModel
        The wing.
    effects : sequence of mapping
        As `plain_effects` returns them.
    arrays : PatchArrays or None
        The wing for patches; needed for effects of structure and loads.
    """
    wing = None if arrays is None else PatchedWing(arrays)
    return StructureBehaviour(
        model, *structure_table(model, {}), Effects(effects, output_channels(model.gauge_count), wing)
    )


def effect_values(effects: Sequence[Mapping[str, Any]], *, active: bool) -> dict[str, float]:
    """Return the start values of the variables of effects by name, all switched on or all off."""
    start = {switch_of(effect): float(active) for effect in effects}
    return {row.name: float(row.start or 0.0) for row in effect_rows(effects, 0, start)}
