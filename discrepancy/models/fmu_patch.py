"""What of a patch an FMU carries itself, what acts at its ports, and what changes the loads that it gets."""

from typing import NamedTuple

from discrepancy.errors import ModelError
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.patch_parts import LoadChange, laws_at
from fe.runtime.motion import NO_LAWS, Laws
from fe.runtime.patch import (
    INTERNAL_FORCES,
    SENSORS,
    LoadGain,
    LoadPlace,
    ModelPatch,
    Primitive,
    StiffnessDrift,
)


class SortedPatch(NamedTuple):
    """A patch by what is done with it.

    Attributes
    ----------
    laws : Laws
        Internal forces at ports.
    settings : tuple of (str, float)
        Parameters that the FMU itself has for primitives, sorted by name.
    load : LoadChange
        Of the recorded force.
    """

    laws: Laws
    settings: tuple[tuple[str, float], ...]
    load: LoadChange


NOTHING = SortedPatch(NO_LAWS, (), LoadChange())
"""The empty patch, sorted."""


def carries(description: FmuModelDescription, primitive: type[Primitive]) -> bool:
    """Whether the model of a description can carry a primitive."""
    if primitive in SENSORS or primitive.kind in description.effects:
        return True
    forces = bool(description.inputs.forces)
    if primitive is LoadGain:
        return forces
    if primitive is LoadPlace:
        return forces and description.inputs.bending_moment is not None
    return primitive in INTERNAL_FORCES and primitive is not StiffnessDrift and bool(description.port)


def sorted_patch(patch: ModelPatch, description: FmuModelDescription) -> SortedPatch:
    """Return a patch by what is done with it; sensors are passed over.

    Raises
    ------
    ModelError
        If the model cannot carry a primitive.
    """
    ports = tuple(port.name for port in description.port)
    forces: list[Primitive] = []
    loads: list[Primitive] = []
    settings: dict[str, float] = {}
    effects = description.effects
    for item in patch:
        if isinstance(item, SENSORS):
            continue
        if item.kind in effects:
            identifier = effects[item.kind]
            if f"effect.{identifier}.active" in settings:
                raise ModelError(
                    f"The patch has two primitives {item.kind!r}, but the FMU model {description.name!r} "
                    f"carries one (effect.{identifier})."
                )
            settings[f"effect.{identifier}.active"] = 1.0
            for key, value in item.to_mapping().items():
                if key != "kind":
                    settings[f"effect.{identifier}.{key}"] = float(value)
        elif not carries(description, type(item)):
            port = " (it has no port)" if isinstance(item, INTERNAL_FORCES) and not ports else ""
            raise ModelError(
                f"The FMU model {description.name!r} cannot carry the primitive {item.kind!r}{port}."
            )
        else:
            (loads if isinstance(item, LoadGain | LoadPlace) else forces).append(item)
    load = LoadChange.of(loads)
    if load.along_chord and description.inputs.torque is None:
        raise ModelError(
            f"The FMU model {description.name!r} names no torque in [inputs], so a load cannot move along "
            f"the chord."
        )
    laws = laws_at(ModelPatch(tuple(forces)), ports, in_windows=False)
    return SortedPatch(laws, tuple(sorted(settings.items())), load)
