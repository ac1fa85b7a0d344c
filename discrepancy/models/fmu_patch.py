"""What of a patch an FMU carries itself, what acts at its ports, and what changes the loads that it gets."""

from dataclasses import dataclass

from discrepancy.errors import ModelError
from discrepancy.models.fmu_file import FmuModelDescription
from fe.runtime.errors import InvalidPatchError
from fe.runtime.motion import NO_LAWS, Laws, laws_of
from fe.runtime.patch import (
    INTERNAL_FORCES,
    SENSORS,
    LoadGain,
    LoadPlace,
    ModelPatch,
    Primitive,
    StiffnessDrift,
)


@dataclass(frozen=True)
class SortedPatch:
    """A patch by what is done with it.

    Attributes
    ----------
    laws : Laws
        Internal forces at ports.
    settings : tuple of (str, float)
        Parameters that the FMU itself has for primitives, sorted by name.
    gain, tare : float
        The acting force is (1 + gain) times the recorded one, plus the tare [N] where it is not zero.
    along_span, along_chord : float
        How far the acting force is moved [m].
    """

    laws: Laws
    settings: tuple[tuple[str, float], ...]
    gain: float
    tare: float
    along_span: float
    along_chord: float


NO_PATCH = SortedPatch(NO_LAWS, (), 0.0, 0.0, 0.0, 0.0)
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
    settings: dict[str, float] = {}
    gain, tare, along_span, along_chord = 0.0, 0.0, 0.0, 0.0
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
        elif isinstance(item, LoadGain):
            gain, tare = (1.0 + gain) * (1.0 + item.gain) - 1.0, tare * (1.0 + item.gain) + item.tare
        elif isinstance(item, LoadPlace):
            along_span, along_chord = along_span + item.along_span, along_chord + item.along_chord
        else:
            forces.append(item)
    if along_chord and description.inputs.torque is None:
        raise ModelError(
            f"The FMU model {description.name!r} names no torque in [inputs], so a load cannot move along "
            f"the chord."
        )
    try:
        laws = laws_of(ModelPatch(tuple(forces)), ports) if forces else NO_LAWS
    except InvalidPatchError as cause:
        raise ModelError(str(cause)) from cause
    return SortedPatch(laws, tuple(sorted(settings.items())), gain, tare, along_span, along_chord)
