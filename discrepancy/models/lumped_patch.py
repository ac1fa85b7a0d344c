"""A patch for a lumped model, sorted by what its primitives change."""

from collections.abc import Collection
from typing import NamedTuple

from discrepancy.errors import ModelError
from discrepancy.models.interface import Model
from fe.runtime.errors import InvalidPatchError
from fe.runtime.motion import NO_LAWS, Laws, laws_of
from fe.runtime.patch import INTERNAL_FORCES, SENSORS, LoadGain, LoadPlace, ModelPatch, PortLoad, Primitive


class SortedLumped(NamedTuple):
    """Structure, internal forces, gain [1] and tare [N] of loads, how far they move [m], loads at ports."""

    structure: tuple[Primitive, ...]
    forces: ModelPatch
    gain: float
    tare: float
    along_span: float
    along_chord: float
    loads: tuple[PortLoad, ...]


def sorted_lumped(patch: ModelPatch, model: Model) -> SortedLumped:
    """Return the primitives of a patch by what they change; those of sensors are left out.

    Raises
    ------
    ModelError
        If the model cannot carry one of them.
    """
    structure, forces, loads = [], [], []
    gain, tare, along_span, along_chord = 0.0, 0.0, 0.0, 0.0
    for item in patch:
        if isinstance(item, SENSORS):
            continue
        if isinstance(item, INTERNAL_FORCES):
            forces.append(item)
        elif not model.supports(type(item)):
            raise ModelError(f"The lumped model {model.name!r} cannot carry the primitive {item.kind!r}.")
        elif isinstance(item, PortLoad):
            loads.append(item)
        elif isinstance(item, LoadGain):
            gain, tare = (1.0 + gain) * (1.0 + item.gain) - 1.0, tare + item.tare
        elif isinstance(item, LoadPlace):
            along_span, along_chord = along_span + item.along_span, along_chord + item.along_chord
        else:
            structure.append(item)
    return SortedLumped(
        tuple(structure), ModelPatch(tuple(forces)), gain, tare, along_span, along_chord, tuple(loads)
    )


def laws_at(forces: ModelPatch, ports: Collection[str]) -> Laws:
    """Return the laws of internal forces at ports; raises `ModelError` where one cannot be."""
    if not len(forces):
        return NO_LAWS
    try:
        return laws_of(forces, ports, in_windows=True)
    except InvalidPatchError as cause:
        raise ModelError(str(cause)) from cause
