"""Sizes of added effects in SI units, as the sentences of a verdict show them."""

from collections.abc import Sequence
from dataclasses import replace
from math import isfinite

import numpy as np

from discrepancy.campaign.records import Campaign, FloatArray, Quantity
from discrepancy.campaign.units import UNITS
from discrepancy.catalogue.effect_in_setting import MOTION_WORDS
from discrepancy.files.verdict import PrimitiveInterval
from discrepancy.report.text import unit_text
from discrepancy.system.interface import Model
from discrepancy.system.response import EITHER, MOVES, TURNS
from discrepancy.verdict import NamedEffect
from discrepancy.workflow import Investigation
from fe.runtime.patch import (
    CHANNEL_UNIT,
    InterfaceCompliance,
    LowPass,
    ModelPatch,
    PlaceMass,
    PowerDamping,
    PowerStiffness,
    Primitive,
    SensorLag,
    SupportCompliance,
    TableDamping,
    TableStiffness,
)
from reporting.words import between, rounded

FLOW_UNIT = "/s times"
"""Part of the unit of a flow at a port of a state."""
BESIDE = (
    "reference_velocity",
    "reference_displacement",
    "time",
    "start",
    "length",
    "station",
    "along",
    "across",
)
"""Parameters of primitives that say where or when an effect acts, and not how large it is."""


def si_sizes(
    patch: ModelPatch, intervals: Sequence[PrimitiveInterval], model: Model, campaign: Campaign
) -> str:
    """Return the sizes of a patch that have a unit, such as "slip force 0.53 N (0.52 to 0.54)".

    Parameters
    ----------
    patch : ModelPatch
        Patch of one effect.
    intervals : sequence of PrimitiveInterval
        Intervals of its numbers.
    model : Model
        The model, which knows whether a port moves or turns.
    campaign : Campaign
        The campaign, which knows what a channel measures.

    Returns
    -------
    str
        Sizes with 90 % intervals; empty if none has a unit.
    """
    sizes: dict[str, None] = {}  # each once, in order
    for size in intervals:
        primitive = patch.primitives[size.primitive]
        unit = definite_unit(size.unit, primitive, model, campaign)
        if isinstance(primitive, TableDamping | TableStiffness):
            continue  # the page has its points
        if not unit or size.parameter in BESIDE or size.value == 0.0:
            continue
        verb = _verb(size, primitive, is_flow=FLOW_UNIT in unit)
        if verb and size.value < 0.0:  # the verb says the sign
            size = replace(size, value=-size.value, low=-size.high, high=-size.low)
        half_width = 0.0
        interval = ""
        if isinstance(primitive, SupportCompliance | InterfaceCompliance):
            size = _as_spring(size, primitive)
            unit = size.unit
        if isfinite(size.low) and isfinite(size.high) and size.low < size.high:
            half_width = 0.5 * (size.high - size.low)
            interval = f" ({between(size.low, size.high, half_width)})"
        name = verb or _size_name(size.parameter, primitive, unit)
        if isinstance(primitive, SupportCompliance):
            motion = _motion_text(primitive.motion)
            name = f"the support {primitive.support} {motion} against a spring of"
        elif isinstance(primitive, InterfaceCompliance):
            motion = _motion_text(primitive.motion)
            name = f"the interface {primitive.interface} {motion} against a spring of"
        if isinstance(primitive, PlaceMass):
            place_text = _text_of_offset_mass(size.primitive, primitive, intervals, model)
        else:
            place_text = _location_text(primitive, size, model, campaign)
        sizes[f"{name} {rounded(size.value, half_width)} {unit}{interval}{place_text}"] = None
    return ", ".join(sizes)


def _verb(interval: PrimitiveInterval, primitive: Primitive, *, is_flow: bool) -> str:
    """Return what a port or channel does by the sign of a number: rubs, softens, stiffens, lags.

    Empty if no verb says it. Of a law that grows faster than the displacement, the force is added
    to that of the spring.
    """
    if isinstance(primitive, SensorLag | LowPass):
        channel = "each channel" if primitive.channel == "*" else primitive.channel
        if isinstance(primitive, LowPass):
            return f"{channel} responds with a time constant of"
        return f"{channel} {'lags' if interval.value > 0.0 else 'leads'} by"
    if interval.parameter != "coefficient":
        return ""
    if isinstance(primitive, PowerDamping):
        is_dry = primitive.velocity_exponent == primitive.displacement_exponent == 0.0
        verb = "lets through" if is_flow else "rubs with"
        return f"{primitive.port} {verb}" if is_dry else ""
    if isinstance(primitive, PowerStiffness) and primitive.exponent > 1.0:
        verb = "stiffens by" if interval.value > 0.0 else "softens by"
        return f"{primitive.port} {verb}"
    return ""


def _as_spring(
    interval: PrimitiveInterval, primitive: SupportCompliance | InterfaceCompliance
) -> PrimitiveInterval:
    """Return the interval of the spring of what yields: the inverse of its compliance."""
    turns = primitive.motion.startswith("r")
    return replace(
        interval,
        value=1.0 / interval.value,
        low=1.0 / interval.high,
        high=1.0 / interval.low,
        unit="N m/rad" if turns else "N/m",
    )


def _motion_text(motion: str) -> str:
    """Return a motion of a support or interface as a predicate: "turns about z"."""
    verb, *words = MOTION_WORDS[motion].split()
    return " ".join((f"{verb}s", *words))


def size_sentence(
    investigation: Investigation,
    effects: Sequence[NamedEffect],
    intervals: Sequence[Sequence[PrimitiveInterval]],
) -> str:
    """Return the sizes of the effects of a patch in one sentence; empty if none has a unit.

    Parameters
    ----------
    investigation : Investigation
        The investigation.
    effects : sequence of NamedEffect
        Effects of the patch.
    intervals : sequence of sequence of PrimitiveInterval
        Intervals of the numbers of each effect.
    """
    phrases = []
    for effect, intervals_of_effect in zip(effects, intervals, strict=True):
        sizes = si_sizes(
            effect.patch, intervals_of_effect, investigation.model, investigation.campaign
        )
        name = f"a law of the family {effect.family}" if effect.shape else effect.name
        if sizes:
            phrases.append(sizes if len(effects) == 1 else f"{name}, {sizes}")
    if not phrases:
        return ""
    has_intervals = any(" to " in phrase for phrase in phrases)
    brackets = "; 90 % intervals in brackets" if has_intervals else ""
    return f"Size: {'; '.join(phrases)}{brackets}."


def _size_name(parameter: str, primitive: Primitive, unit: str) -> str:
    """Return the name of a primitive's parameter in words: a force, a moment, a flow, ..."""
    if parameter == "coefficient" and unit.endswith("capacity"):
        return "flow"  # into or out of a state
    name = parameter.replace("_", " ")
    if parameter == "coefficient" and primitive.kind in ("power_damping", "power_stiffness"):
        name = "force"
    is_at_turning_port = unit == "N m"
    return name.replace("force", "moment") if is_at_turning_port else name


def _location_text(
    primitive: Primitive, interval: PrimitiveInterval, model: Model, campaign: Campaign
) -> str:
    """Return where a size holds: a force's reference speed or displacement, or a mass's station.

    It is a phrase such as " at 0.3 m/s"; empty for other sizes.
    """
    if primitive.kind == "point_mass" and interval.parameter == "mass":
        return f" at {getattr(primitive, 'station'):.3g} m"  # noqa: B009
    if interval.parameter != "coefficient":
        return ""
    marks = []
    for exponent in ("velocity_exponent", "displacement_exponent", "exponent"):
        reference = "reference_displacement"
        if exponent.startswith("velocity"):
            reference = "reference_velocity"
        value = getattr(primitive, reference, None)
        if value is not None and getattr(primitive, exponent, 0.0) != 0.0:
            reference_unit = primitive.units[reference]
            unit = definite_unit(reference_unit, primitive, model, campaign)
            marks.append(f"{value:.3g} {unit}")
    return f" at {' and '.join(marks)}" if marks else ""


def _text_of_offset_mass(
    primitive_index: int,
    primitive: PlaceMass,
    intervals: Sequence[PrimitiveInterval],
    model: Model,
) -> str:
    """Return the position of a mass that is offset from its named place, with its uncertainty.

    The text is empty if the mass is at the place itself. `primitive_index` is the index of the mass
    in its patch.
    """
    location = model.point_of_mass(primitive)
    if location is None:
        return ""
    precisions = []
    for parameter, axis in zip(("along", "across"), location.axes, strict=True):
        for interval in intervals:
            is_of_mass = interval.primitive == primitive_index and interval.parameter == parameter
            if is_of_mass and isfinite(interval.low) and isfinite(interval.high):
                half_width = 0.5 * (interval.high - interval.low)
                precisions.append(f"to {half_width:.2g} m along {_vector_text(axis, 2)}")
    uncertainty = f", known {' and '.join(precisions)}" if precisions else ""
    return f" at {_vector_text(location.point, 4)} m{uncertainty}"


def _vector_text(vector: FloatArray, digits: int) -> str:
    """Return the components of a vector (3,) in brackets, without negative zeros."""
    components = [f"{value + 0.0:g}" for value in np.round(vector, digits)]
    return f"({', '.join(components)})"


def definite_unit(unit: str, primitive: Primitive, model: Model, campaign: Campaign) -> str:
    """Return the unit of a primitive's parameter, which its port or its channel may determine.

    Parameters
    ----------
    unit : str
        Unit of the kind of primitive, which may be that of a channel, or one "or" another.
    primitive : Primitive
        The primitive, with a port or a channel.
    model, campaign
        Model and campaign.

    Returns
    -------
    str
        The unit:

        - for "channel's unit", that of the channel; empty for a unit relative to it
        - for a unit without "or", this unit; empty for a plain number
        - for a unit such as "N/m or N m/rad", the first if the port or support moves, the second if
          it turns, and both if it may do either
        - otherwise the unit of the port's own force or state
    """
    if unit.startswith(CHANNEL_UNIT):
        return _channel_unit(primitive, campaign) if unit == CHANNEL_UNIT else ""
    if " or " not in unit:
        return unit_text(unit)
    unit_if_moving, unit_if_turning = unit.split(" or ")
    if isinstance(primitive, SupportCompliance | InterfaceCompliance):
        is_turn = primitive.motion.startswith("r")  # such as "rx"; "x" is a displacement
        return unit_if_turning if is_turn else unit_if_moving
    port = str(getattr(primitive, "port", ""))
    force_unit, state_unit = model.port_units(port)
    if force_unit == MOVES[0]:
        return unit_if_moving
    if force_unit == TURNS[0]:
        return unit_if_turning
    if force_unit == EITHER[0]:
        return unit
    return state_unit if unit.startswith("m/s") else force_unit


def _channel_unit(primitive: Primitive, campaign: Campaign) -> str:
    """Return the unit of a primitive's channels; empty if they have several."""
    name = getattr(primitive, "channel", "*")
    names = campaign.channels if name == "*" else (name,)
    units = set()
    for channel_name in names:
        if channel_name in campaign.channels:
            quantity = campaign.channels[channel_name].quantity
            units.add("1" if quantity is Quantity.SIGNAL else UNITS[quantity].si)
    return unit_text(units.pop()) if len(units) == 1 else ""
