"""What an FMU that carries missing effects holds beside the plain wing: runtime, arrays, effects."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from fe.runtime.errors import FiniteElementError
from fe.runtime.patch import LocalStiffnessLoss, ModelPatch
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_steps import PatchedSteps
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.reduced import ReducedModel
from fe.runtime.sensor_stream import needs_structure
from fe.runtime.state import DigitalState
from fmu_asset.errors import PatchFileError

from .patch_file import Effect

_STATE = DigitalState()
PLAIN_STATE: dict[str, Any] = {
    "young_modulus_factor": _STATE.young_modulus_factor,
    "stiffness_loss": _STATE.stiffness_loss,
    "servo_mass": _STATE.servo_mass,
    "pitot_mass": _STATE.pitot_mass,
    "damping_alpha": _STATE.damping_alpha,
    "damping_beta": _STATE.damping_beta,
}
"""The healthy wing, on which a patch is tried when it is packed."""

ARRAYS_FILE = "resources/patch_arrays.npz"

ENTRY = '''"""Joins the slave, the reduced model, missing effects and pythonfmu's base class."""
import ctypes
import functools
import json

import numpy as np

from .fe.damping import rayleigh_damping_ratio
from .fe.errors import FiniteElementError
from .fe.patch import ModelPatch
from .fe.reduced import ReducedModel
from .fe.sensor_stream import Sample, SensorStream, needs_structure
from .fe.transient import ModalIntegrator, TransientState
from .pythonfmu.fmi2slave import Fmi2Slave
from .slaves.base import Contents
from .slaves.behaviour import Physics
from .slaves.effect_variables import effect_rows
from .slaves.patched_behaviour import PatchedBehaviour, PatchedPhysics
from .slaves.variables import variable_table
from .slaves.wing_slave import WingSlave as _WingSlave

__all__ = ["Fmi2Slave", "WingSlave", "keep_alive"]

_contents = []


def keep_alive(thing):
    """Hold one more reference for ever, also while the interpreter shuts down and clears this module."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))


def load_contents(resources):
    """Read the model once in a process: this package's name is a hash of its content."""
    if not _contents:
        model = ReducedModel.load(resources / "reduced_model.npz")
        setting = json.loads((resources / "start.json").read_text(encoding="utf-8"))
        record = json.loads((resources / "effects.json").read_text(encoding="utf-8"))
        table = variable_table(
            gauge_count=model.gauge_count,
            mode_count=setting["mode_count"],
            validity=model.validity,
            start=setting["start"],
        )
        table += effect_rows(record["effects"], len(table), setting["start"])
        physics = Physics(model, ModalIntegrator, TransientState, rayleigh_damping_ratio)
        patched = PatchedPhysics(
            ModelPatch.from_list,
            needs_structure,
            SensorStream,
            Sample,
            load_steps(resources, model),
            FiniteElementError,
            np.append,
        )
        channels = tuple((name, quantity) for name, quantity in record["channels"])
        given = (physics, setting["mode_count"], patched, record["effects"], channels)
        _contents.append(Contents(table, lambda: PatchedBehaviour(*given)))
    return _contents[0]


def load_steps(resources, model):
    """Return what makes the wing of a patch, if there are arrays for it."""
    path = resources / "patch_arrays.npz"
    if not path.is_file():
        return None
    from .fe.patch_arrays import PatchArrays
    from .fe.patched_steps import PatchedSteps
    from .fe.patched_wing import PatchedWing

    return functools.partial(PatchedSteps, model, PatchedWing(PatchArrays.load(path)))


class WingSlave(_WingSlave):
    """The slave with its resources."""

    load_contents = staticmethod(load_contents)
'''
"""Takes the place of `entry.py` of the plain wing."""


def output_channels(gauge_count: int) -> tuple[tuple[str, str], ...]:
    """Return names and quantities of the outputs that sensors show, in the behaviour's order."""
    strains = tuple((f"strain[{gauge}]", "strain") for gauge in range(1, gauge_count + 1))
    return (*strains, ("tip_displacement", "displacement"), ("load_point_displacement", "displacement"))


def plain_effects(effects: Sequence[Effect]) -> list[dict[str, Any]]:
    """Return effects as plain data, as `effect_variables` takes them."""
    return [{"id": effect.id, "primitives": effect.patch.to_list()} for effect in effects]


def patched_members(
    runtime: str,
    model: ReducedModel,
    effects: Sequence[dict[str, Any]],
    arrays: PatchArrays | None,
) -> dict[str, bytes]:
    """Return the further files of an FMU that carries effects, by their names in the archive.

    Parameters
    ----------
    runtime : str
        Folder of the runtime package.
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
    members = {
        "resources/effects.json": f"{text}\n".encode(),
        f"{runtime}/entry.py": ENTRY.encode(),
    }
    patch = whole_patch(effects)
    if needs_structure(patch):
        if arrays is None:
            raise PatchFileError(
                "The patch changes structure or loads, for which the FMU needs the wing in the basis for "
                "patches: give `arrays`, as `fe.reduction.patch_cache.patch_arrays` returns them."
            )
        _check_arrays(model, arrays, patch)
        if not len(patch.of(LocalStiffnessLoss)):
            arrays = without_strips(arrays)
        members[ARRAYS_FILE] = arrays.to_bytes()
    return members


def whole_patch(effects: Sequence[Mapping[str, Any]]) -> ModelPatch:
    """Return all effects together."""
    return ModelPatch.from_list([primitive for effect in effects for primitive in effect["primitives"]])


def _check_arrays(model: ReducedModel, arrays: PatchArrays, patch: ModelPatch) -> None:
    if arrays.design_hash != model.design_hash:
        raise PatchFileError(
            f"The wing for patches is of the design {arrays.design_hash[:12]}, and the reduced model of "
            f"{model.design_hash[:12]}; make both of one design."
        )
    try:
        steps = PatchedSteps(model, PatchedWing(arrays), **PLAIN_STATE, patch=patch)
        steps.modal_data()
    except FiniteElementError as cause:
        raise PatchFileError(f"The wing cannot carry the patch: {cause}") from cause


def without_strips(arrays: PatchArrays) -> PatchArrays:
    """Return the arrays without the parts that only a local stiffness loss needs, most of the bytes."""
    return replace(
        arrays,
        strip_stiffness=arrays.strip_stiffness[:0],
        strip_of=arrays.strip_of[:0],
        term_of=arrays.term_of[:0],
    )
