"""A patch sorted by what its primitives change, and what of it all models take alike."""

from collections.abc import Collection, Iterable
from typing import NamedTuple

from discrepancy.errors import ModelError
from discrepancy.models.interface import Model
from fe.runtime.errors import InvalidPatchError
from fe.runtime.motion import NO_LAWS, Laws, laws_of
from fe.runtime.patch import (
    INTERNAL_FORCES,
    SENSORS,
    LoadGain,
    LoadPlace,
    ModelPatch,
    PortForce,
    PortLoad,
    Primitive,
)


class LoadChange(NamedTuple):
    """What of recorded loads changes.

    Attributes
    ----------
    gain, tare : float
        The acting force is (1 + gain) times the recorded one, plus the tare [N] where it is not zero.
    along_span, along_chord : float
        How far the acting force is moved [m].
    """

    gain: float = 0.0
    tare: float = 0.0
    along_span: float = 0.0
    along_chord: float = 0.0

    @classmethod
    def of(cls, patch: Iterable[Primitive]) -> "LoadChange":
        """Return the change by gains and places, one upon the other."""
        gain, tare, span, chord = cls()
        for item in patch:
            if isinstance(item, LoadGain):
                gain, tare = (1.0 + gain) * (1.0 + item.gain) - 1.0, tare * (1.0 + item.gain) + item.tare
            elif isinstance(item, LoadPlace):
                span, chord = span + item.along_span, chord + item.along_chord
        return cls(gain, tare, span, chord)


class SortedPatch(NamedTuple):
    """Structure (or what the model carries itself), internal forces, change of loads, loads at ports."""

    structure: tuple[Primitive, ...]
    forces: ModelPatch
    change: LoadChange
    loads: tuple[PortLoad, ...]


def sorted_patch(patch: ModelPatch, model: Model, what: str, own: Collection[str] = ()) -> SortedPatch:
    """Return the primitives of a patch by what they change; those of sensors are left out.

    Parameters
    ----------
    patch : ModelPatch
        The patch.
    model : Model
        Which shall carry it.
    what : str
        Its name in sentences.
    own : collection of str
        Kinds of primitives that it carries itself, whatever they change elsewhere.

    Raises
    ------
    ModelError
        If the model cannot carry one of them.
    """
    structure, forces, changes = list[Primitive](), list[Primitive](), list[Primitive]()
    loads = list[PortLoad]()
    for item in patch:
        internal = isinstance(item, INTERNAL_FORCES)
        if isinstance(item, SENSORS):
            continue
        if item.kind in own:
            structure.append(item)
        elif not (model.supports(type(item)) or (isinstance(item, PortForce) and item.port in model.ports())):
            port = " (it has no port)" if internal and not model.ports() else ""
            raise ModelError(f"{what} cannot carry the primitive {item.kind!r}{port}.")
        elif internal:
            forces.append(item)
        elif isinstance(item, PortLoad):
            loads.append(item)
        else:
            (changes if isinstance(item, LoadGain | LoadPlace) else structure).append(item)
    return SortedPatch(tuple(structure), ModelPatch(tuple(forces)), LoadChange.of(changes), tuple(loads))


def laws_at(forces: ModelPatch, ports: Collection[str], *, in_windows: bool = True) -> Laws:
    """Return the laws of internal forces at ports; raises `ModelError` where one cannot be."""
    if not len(forces):
        return NO_LAWS
    try:
        return laws_of(forces, ports, in_windows=in_windows)
    except InvalidPatchError as cause:
        raise ModelError(str(cause)) from cause
