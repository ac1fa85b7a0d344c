"""Sizes of what a patch changes, in SI units, as they stand in the headline."""

from collections.abc import Sequence
from math import isfinite

from discrepancy.campaign.records import Campaign, Quantity
from discrepancy.campaign.units import UNITS
from discrepancy.document_types import PRIMITIVE_UNITS
from discrepancy.files.patch import PrimitiveInterval
from discrepancy.models.interface import Model
from discrepancy.report.text import NAMING, rounded, unit_text
from discrepancy.verdict import NamedEffect
from discrepancy.workflow import Investigation
from fe.runtime.patch import CHANNEL_UNIT, ModelPatch, Primitive

BESIDE = ("reference_velocity", "reference_displacement", "time", "start", "length", "station")
"""Where or at what a size holds; no sizes themselves."""


def si_sizes(
    patch: ModelPatch, intervals: Sequence[PrimitiveInterval], model: Model, campaign: Campaign
) -> str:
    """Return the sizes of a patch that have a unit, "slip force 0.53 N (0.52 to 0.54)"; empty without.

    Parameters
    ----------
    patch : ModelPatch
        Of one effect.
    intervals : sequence of PrimitiveInterval
        Of its numbers.
    model : Model
        Says whether a port moves or turns.
    campaign : Campaign
        Says what a channel measures.
    """
    found = []
    for item in intervals:
        primitive = patch.primitives[item.primitive]
        unit = definite_unit(item.unit, primitive, model, campaign)
        if not unit or item.parameter in BESIDE or item.value == 0.0:
            continue
        known = isfinite(item.low) and isfinite(item.high) and item.low < item.high
        show = rounded(item.value, 0.5 * (item.high - item.low) if known else 0.0)
        between = f" ({show(item.low)} to {show(item.high)})" if known else ""
        words = _words(item.parameter, primitive, unit)
        text = (
            f"{words} {show(item.value)} {unit}{between}{_where(primitive, item.parameter, model, campaign)}"
        )
        if text not in found:
            found.append(text)
    return ", ".join(found)


def size_sentence(
    investigation: Investigation,
    effects: Sequence[NamedEffect],
    intervals: Sequence[Sequence[PrimitiveInterval]],
) -> str:
    """Return the sizes of the effects of a patch in one sentence; empty where none has a unit."""
    model, campaign = investigation.model, investigation.campaign
    sizes = [si_sizes(e.patch, row, model, campaign) for e, row in zip(effects, intervals, strict=True)]
    named = investigation.verdict.kind in NAMING
    parts = [
        size if named and len(effects) == 1 else f"{effect.name}, {size}"
        for effect, size in zip(effects, sizes, strict=True)
        if size
    ]
    if not parts:
        return ""
    words = "In SI units" if named else "In SI units, were it the most probable member, which is not named"
    brackets = "; 90 % intervals in brackets" if any(" to " in part for part in parts) else ""
    return f"{words}: {'; '.join(parts)}{brackets}."


def _words(parameter: str, primitive: Primitive, unit: str) -> str:
    words = parameter.replace("_", " ")
    if parameter == "coefficient" and unit.endswith("capacity"):
        return "flow"  # into or out of a state
    if parameter == "coefficient" and primitive.kind in ("power_damping", "power_stiffness"):
        words = "force"
    return words.replace("force", "moment") if unit == "N m" else words  # at a port that turns


def _where(primitive: Primitive, parameter: str, model: Model, campaign: Campaign) -> str:
    """Return at which speed or displacement a force has its size, or where a mass sits."""
    if primitive.kind == "point_mass" and parameter == "mass":
        return f" at {getattr(primitive, 'station'):.3g} m"  # noqa: B009
    if parameter != "coefficient":
        return ""
    marks = []
    for exponent, reference in (
        ("velocity_exponent", "reference_velocity"),
        ("displacement_exponent", "reference_displacement"),
        ("exponent", "reference_displacement"),
    ):
        value = getattr(primitive, reference, None)
        if value is not None and getattr(primitive, exponent, 0.0) != 0.0:
            unit = definite_unit(PRIMITIVE_UNITS[primitive.kind][reference], primitive, model, campaign)
            marks.append(f"{value:.3g} {unit}")
    return f" at {' and '.join(marks)}" if marks else ""


def definite_unit(unit: str, primitive: Primitive, model: Model, campaign: Campaign) -> str:
    """Return the unit of a number, made definite as far as port and channel say it."""
    if unit.startswith(CHANNEL_UNIT):
        names = campaign.channels if (name := getattr(primitive, "channel", "*")) == "*" else (name,)
        measured = {campaign.channels[name].quantity for name in names if name in campaign.channels}
        units = {"1" if item is Quantity.SIGNAL else UNITS[item].si for item in measured}
        return unit_text(units.pop()) if len(units) == 1 and unit == CHANNEL_UNIT else ""
    if " or " in unit:
        port = str(getattr(primitive, "port", ""))
        if state := model.unit_of_state(port):
            return state if unit.startswith("m/s") else f"{state}/s times capacity"
        moving, turning = unit.split(" or ")
        return {True: turning, False: moving, None: unit}[model.turns(port)]
    return unit_text(unit)
