"""What the FMU of a structure holds in its resources: its table of variables and its behaviour.

This file is copied into the FMU, as `behaviour`.
"""

import json
from pathlib import Path
from typing import Any

from fe.runtime.reduced import ReducedModel

from .base import Contents
from .behaviour import StructureBehaviour, later_outputs
from .table import structure_table


def load_contents(resources: Path) -> Contents:
    """Return what the files that `fmu_asset.packing.structure_fmu` packed describe."""
    model, start = ReducedModel.load(resources / "reduced_model.npz"), _read(resources / "start.json")
    own = {name: value for name, value in start.items() if not name.startswith("effect.")}
    table, roles = structure_table(model, own)
    later = later_outputs(table, roles)
    if not (resources / "effects.json").is_file():
        return Contents(table, lambda: StructureBehaviour(model, table, roles), later)
    # a plain structure needs nothing of these
    from .effect_variables import effect_rows
    from .effects import Effects

    record, wing = _read(resources / "effects.json"), None
    channels = tuple((name, quantity) for name, quantity in record["channels"])
    arrays = resources / "patch_arrays.npz"
    if arrays.is_file():
        from fe.runtime.patch_arrays import PatchArrays
        from fe.runtime.patched_wing import PatchedWing

        wing = PatchedWing(PatchArrays.load(arrays))
    return Contents(
        table + effect_rows(record["effects"], len(table), start),
        lambda: StructureBehaviour(model, table, roles, Effects(record["effects"], channels, wing)),
        later,
    )


def _read(path: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return record
