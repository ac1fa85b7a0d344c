"""What an FMU that carries missing effects holds beside the plain wing: runtime, arrays, effects."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from fe.reduced import ReducedModel

from .patch_file import Effect

OWN_FILES = ("effect_variables.py", "patched_behaviour.py")
SENSOR_FILES = ("patch.py", "sensors.py", "sensor_stream.py")

ENTRY = '''"""Joins the slave, the reduced model, missing effects and pythonfmu's base class."""
import ctypes
import json

import numpy as np

from .behaviour import Physics
from .effect_variables import effect_rows
from .fe.damping import rayleigh_damping_ratio
from .fe.errors import FiniteElementError
from .fe.patch import ModelPatch
from .fe.reduced import ReducedModel
from .fe.sensor_stream import Sample, SensorStream, needs_structure
from .fe.transient import ModalIntegrator, TransientState
from .patched_behaviour import PatchedBehaviour, PatchedPhysics
from .pythonfmu.fmi2slave import Fmi2Slave
from .slave import Contents
from .slave import WingSlave as _WingSlave
from .variables import variable_table

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
        _contents.append(
            Contents(
                table,
                lambda: PatchedBehaviour(physics, setting["mode_count"], patched, record["effects"], channels),
            )
        )
    return _contents[0]


def load_steps(resources, model):
    """Return what makes the wing of a patch, if there are arrays for it."""
    return None


class WingSlave(_WingSlave):
    """The slave with its resources."""

    load_contents = staticmethod(load_contents)
'''
"""Takes the place of `entry.py` of the plain wing."""


def output_channels(gauge_count: int) -> tuple[tuple[str, str], ...]:
    """Return names and quantities of the outputs that sensors show, in the order of the behaviour's values."""
    strains = tuple((f"strain[{gauge}]", "strain") for gauge in range(1, gauge_count + 1))
    return (*strains, ("tip_displacement", "displacement"), ("load_point_displacement", "displacement"))


def plain_effects(effects: Sequence[Effect]) -> list[dict[str, Any]]:
    """Return effects as plain data, as `effect_variables` takes them."""
    return [{"id": effect.id, "primitives": effect.patch.to_list()} for effect in effects]


def patched_members(
    runtime: str, model: ReducedModel, effects: Sequence[dict[str, Any]]
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
    """
    own, wing = files("fmu_asset"), files("fe")
    record = {"channels": output_channels(model.gauge_count), "effects": effects}
    # The order of keys is that of the variables.
    text = json.dumps(record, indent=1, allow_nan=False)
    return {
        "resources/effects.json": f"{text}\n".encode(),
        f"{runtime}/entry.py": ENTRY.encode(),
        **{f"{runtime}/{name}": (own / name).read_bytes() for name in OWN_FILES},
        **{f"{runtime}/fe/{name}": (wing / name).read_bytes() for name in SENSOR_FILES},
    }
