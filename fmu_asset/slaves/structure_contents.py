"""The contents of a structure's FMU, read from its resources; copied into the FMU."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from fe.runtime.reduced import ReducedModel

from .behaviour import StructureBehaviour
from .contents import SlaveContents
from .table import StructureRoles, structure_table
from .variables import FmuVariable


def later_outputs(table: Sequence[FmuVariable], roles: StructureRoles) -> tuple[slice, ...]:
    """Return the rows of the outputs that are computed only when they are read, in three groups.

    They are, in this order: the bound of the strain error; the displacement of the load point or,
    without one, the bound of the displacement error; frequencies and damping ratios of the modes.
    `BOUND`, `POINT_OR_BOUND` and `MODES` of `behaviour` are the indices of the groups.
    """
    reference = {row.name: row.reference for row in table}
    bound_row = reference["strain_error_bound"]
    point_or_bound = reference[roles.load_point or roles.displacement_bound or ""]
    first_mode = reference["frequency[1]"]
    mode_count = sum(name.startswith("frequency[") for name in reference)
    return (
        slice(bound_row, bound_row + 1),
        slice(point_or_bound, point_or_bound + 1),
        slice(first_mode, first_mode + 2 * mode_count),  # frequencies, then damping ratios
    )


def load_contents(resources: Path) -> SlaveContents:
    """Return the structure in the resources that `fmu_asset.packing.structure_fmu` packed."""
    model = ReducedModel.load(resources / "reduced_model.npz")
    start = json.loads((resources / "start.json").read_text(encoding="utf-8"))
    structure_start = {}
    for name, value in start.items():
        if not name.startswith("effect."):
            structure_start[name] = value
    table, roles = structure_table(model, structure_start)
    pending_outputs = later_outputs(table, roles)
    make_behaviour = partial(StructureBehaviour, model, table, roles)
    effects_file = resources / "effects.json"
    if not effects_file.is_file():
        return SlaveContents(table, make_behaviour, pending_outputs)
    # a structure without effects needs none of these modules
    from fe.runtime.patch_arrays import PatchArrays

    from .effects import SwitchableEffects, effect_rows

    effects = json.loads(effects_file.read_text(encoding="utf-8"))
    arrays_file = resources / "patch_arrays.npz"
    arrays = PatchArrays.load(arrays_file) if arrays_file.is_file() else None
    rows = effect_rows(effects, len(table), start)
    gauge_count = len(model.gauges)
    return SlaveContents(
        table + rows,
        lambda: make_behaviour(SwitchableEffects(effects, gauge_count, arrays)),
        pending_outputs,
    )
