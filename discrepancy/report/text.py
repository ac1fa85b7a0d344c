"""Numbers, sizes in SI units and sentences of the report and of the summary on the terminal."""

import re
from collections.abc import Iterable, Sequence
from math import isfinite, isnan
from typing import Any

from discrepancy.campaign.records import Campaign, Quantity
from discrepancy.campaign.units import UNITS
from discrepancy.document import PRIMITIVE_UNITS
from discrepancy.files.verdict import PrimitiveInterval
from discrepancy.judgement.closed_share import closed_share_text, percent_with_interval
from discrepancy.judgement.conclusion import effects_text, probability_text
from discrepancy.proof_record import Proof, Scores
from discrepancy.system.interface import Model
from discrepancy.system.response import EITHER, MOVES, TURNS
from discrepancy.verdict import (
    Estimate,
    ForceAtPort,
    ForceLeft,
    Hypothesis,
    NamedEffect,
    Verdict,
    VerdictKind,
)
from discrepancy.workflow import Investigation
from fe.runtime.patch import CHANNEL_UNIT, ModelPatch, Primitive
from reporting.page import Words
from reporting.words import between, rounded

BEYOND_DOUBT = 1e6
"""Log evidence [nat] above which only "more than" is shown."""
NAMING = (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART)
"""Verdicts that name what is missing, or part of it."""

LARGEST_PLAIN_NUMBER = 1e6
"""Numbers below this are written without a power of ten."""

SHORT_UNITS = {"1": "", "m/s2": "m/s²"}


def estimate_text(estimate: Estimate) -> tuple[str, str]:
    """Return a value and its 90 % interval as texts, to two digits of the half-width."""
    if not (isfinite(estimate.low) and isfinite(estimate.high)):
        return f"{estimate.value:.4g}", "not known"
    half_width = 0.5 * (estimate.high - estimate.low)
    interval = between(estimate.low, estimate.high, half_width)
    return rounded(estimate.value, half_width), interval


def p_value_text(p_value: float) -> str:
    """Return a p-value as text."""
    if isnan(p_value):
        return "not known"
    return "< 1e-6" if p_value < 1e-6 else f"{p_value:.2g}"


def number(value: float, digits: int = 3) -> str:
    """Return a number with significant digits, or a dash where it is not known."""
    if isnan(value):
        return "\N{EN DASH}"
    text = f"{value:.{digits}g}"
    if "e+0" in text and abs(value) < LARGEST_PLAIN_NUMBER:
        text = f"{float(text):,.0f}"
    return text.replace("-", "\N{MINUS SIGN}")


def unit_text(unit: str) -> str:
    """Return a unit for people; empty for plain numbers."""
    return SHORT_UNITS.get(unit, unit)


def headline(verdict: Verdict) -> str:
    """Return the verdict in one sentence, with its probability.

    Identifiers of effects in the sentence are replaced by their names.
    """
    sentence = verdict.sentence.rstrip(".")
    effects = [*verdict.effects]
    for hypothesis in verdict.hypotheses:
        effects += hypothesis.effects
    for identifier, name in {effect.identifier: effect.name for effect in effects}.items():
        # names first, because a name may contain the identifier
        name_or_identifier = rf"{re.escape(name)}|\b{identifier}\b"
        sentence = re.sub(name_or_identifier, name.replace("\\", r"\\"), sentence)
    role = WORDS.content["probability"].get(verdict.kind)
    if isnan(verdict.probability) or "probability" in sentence or role is None:
        return f"{sentence}."
    return f"{sentence} ({role} {probability_text(verdict.probability)})."


def group_members(verdict: Verdict) -> dict[str, tuple[NamedEffect, ...]]:
    """Return the effects of each member of a group by its name; empty for any other verdict."""
    if verdict.kind is not VerdictKind.GROUP:
        return {}
    effects_of_hypotheses = {}
    for hypothesis in reversed(verdict.hypotheses):  # the first of several counts
        effects_of_hypotheses[" + ".join(hypothesis.identifiers)] = hypothesis.effects
    members = {}
    for member in verdict.group:
        if member in effects_of_hypotheses:
            effects = effects_of_hypotheses[member]
        else:
            effects = tuple(effect for effect in verdict.effects if effect.identifier == member)
        members[effects_text(effects) or member] = effects
    return members


def port_motion_units(force: ForceAtPort) -> tuple[str, str, str]:
    """Return the name of a missing force and the units of its port's motion.

    Returns
    -------
    name : str
        "force", "moment" or "flow".
    displacement_unit, speed_unit : str
        Units of the port's displacement and speed; at a port of a state, the first is empty and the
        second that of the state.
    """
    of_state = ("flow", "", force.unit.partition("/s times")[0])
    name, displacement_unit, speed_unit = WORDS.content["motions"].get(force.unit, of_state)
    return name, displacement_unit, speed_unit


def force_sentence(force: ForceAtPort) -> str:
    """Return the sentence on a missing force: its port, its size, and what its law leaves.

    It also compares the evidence for the port with that for the second best port.
    """
    name, displacement_unit, speed_unit = port_motion_units(force)
    evidence = force.evidence[force.port]
    other_ports = {port: value for port, value in force.evidence.items() if port != force.port}
    nearest = max(other_ports, key=lambda port: other_ports[port], default="")
    return WORDS.say(
        "force",
        force=force,
        tested=tested_trials(force),
        own=evidence,
        nearest=nearest,
        ahead=evidence - other_ports.get(nearest, evidence),
        what=name,
        place=displacement_unit,
        rate=speed_unit,
    )


def tested_trials(force: ForceAtPort | None) -> list[tuple[str, ForceLeft]]:
    """Return how much of a missing force its law leaves unexplained.

    There is one entry for the fitted trials and one for the held-out trials, named "fitted" and
    "held-out". An entry is left out if the law could not be tested in these trials.
    """
    if force is None:
        return []
    tested = []
    for role, remainder in (("fitted", force.fitted), ("held-out", force.held_out)):
        if remainder is not None and remainder.tested:
            tested.append((role, remainder))
    return tested


def proof_scores(proof: Proof) -> tuple[Scores, Scores, str]:
    """Return the scores without and with the added effects, and the kind of the scored trials.

    The held-out trials are taken if there are any ("held-out"), else the fitted ones ("fitted").
    """
    if proof.held_out_before is not None and proof.held_out_after is not None:
        return proof.held_out_before, proof.held_out_after, "held-out"
    return proof.fitted_before, proof.fitted_after, "fitted"


def error_sentence(investigation: Investigation) -> str:
    """Return the sentence that says which fraction of the model's error the added effects explain.

    If that fraction could not be computed, it is the sentence with the reason. It is empty if
    nothing was added to the model.
    """
    proof = investigation.proof
    before = investigation.before
    after = investigation.after
    if proof is None or before is None or after is None:
        return ""
    if proof.closed is None:
        return proof.closed_reason
    is_named = investigation.verdict.kind in NAMING
    # the clause begins with the subject "it", which is replaced
    predicate = closed_share_text(before, after, proof.closed).removeprefix("it ")
    if proof.closed.has_grown:
        subject = "With it" if is_named else "With the best hypothesis, which is no name,"
    else:
        subject = "It" if is_named else "The best hypothesis, which is no name,"
    return f"{subject} {predicate}."


def noise_levels(proof: Proof) -> tuple[str, str]:
    """Return the rms of the residuals over the noise, without and with the effects, as texts."""
    before, after, _ = proof_scores(proof)
    rms_before = number(before.chi_square_per_sample**0.5, 2)
    rms_after = number(after.chi_square_per_sample**0.5, 2)
    return rms_before, rms_after


def remainders_sentence(verdict: Verdict) -> str:
    """Return the sentence on what remains unexplained in each channel; empty if nothing does."""
    return WORDS.say("left", remainders=verdict.remainders)


def _effects_label(effects: Iterable[tuple[str, str, bool]]) -> str:
    """Return the label of effects: their names, places and a mark for a free shape, joined by +."""
    labels = []
    for name, place, has_free_shape in effects:
        marks = [place] if place else []
        if has_free_shape:
            marks.append("free shape")
        labels.append(f"{name} ({', '.join(marks)})" if marks else name)
    return " + ".join(labels)


def hypothesis_name(hypothesis: Hypothesis) -> str:
    """Return the effects of a hypothesis in words."""
    effects = [(effect.name, effect.place, bool(effect.shape)) for effect in hypothesis.effects]
    return _effects_label(effects) or "nothing missing"


def added_label(investigation: Investigation) -> str:
    """Return the effects that were added to the model, in words; empty if none was."""
    if investigation.fit is None:
        return ""
    terms = investigation.fit.candidate.terms
    return _effects_label((term.effect.name, term.place, term.free_shape) for term in terms)


_WORD = re.compile(r"\b([a-z]+)(?=\b|_)")
_POWERS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def formula(text: str) -> str:
    """Return an equation of the catalogue with Greek letters, powers and arrows."""
    greek = WORDS.content["greek"]
    text = _WORD.sub(lambda match: greek.get(match[1], match[1]), text).replace("->", "→")
    return re.sub(r"\^(\d)(?!\w)", lambda match: match[1].translate(_POWERS), text)


def nats(evidence: float) -> str:
    """Return an evidence [nat] as text; no digits beyond `BEYOND_DOUBT`."""
    return f"{evidence:,.0f}" if abs(evidence) < BEYOND_DOUBT else f"more than {BEYOND_DOUBT:,.0f}"


def parameter_text(estimate: Estimate) -> str:
    """Return the description of a parameter, with its formula as it is printed."""
    return formula(estimate.description or estimate.name.replace("_", " "))


_NUMBERS: tuple[Any, ...] = (
    number,
    nats,
    percent_with_interval,
    formula,
    p_value_text,
    estimate_text,
    unit_text,
    parameter_text,
    probability_text,
    isfinite,
)
WORDS = Words(
    "discrepancy.report", "words.toml", **{function.__name__: function for function in _NUMBERS}
)
"""Words of the report, of figures and of the summary on the terminal."""


BESIDE = ("reference_velocity", "reference_displacement", "time", "start", "length", "station")
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
        if not unit or size.parameter in BESIDE or size.value == 0.0:
            continue
        half_width = 0.0
        interval = ""
        if isfinite(size.low) and isfinite(size.high) and size.low < size.high:
            half_width = 0.5 * (size.high - size.low)
            interval = f" ({between(size.low, size.high, half_width)})"
        name = _size_name(size.parameter, primitive, unit)
        place_text = _location_text(primitive, size, model, campaign)
        sizes[f"{name} {rounded(size.value, half_width)} {unit}{interval}{place_text}"] = None
    return ", ".join(sizes)


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
    is_named = investigation.verdict.kind in (*NAMING, VerdictKind.FAMILY)
    is_only_effect = is_named and len(effects) == 1
    phrases = []
    for effect, intervals_of_effect in zip(effects, intervals, strict=True):
        sizes = si_sizes(
            effect.patch, intervals_of_effect, investigation.model, investigation.campaign
        )
        name = f"a law of the family {effect.family}" if effect.shape else effect.name
        if sizes:
            phrases.append(sizes if is_only_effect else f"{name}, {sizes}")
    if not phrases:
        return ""
    begin = "In SI units"
    if not is_named:
        begin = "In SI units, were it the most probable member, which is not named"
    has_intervals = any(" to " in phrase for phrase in phrases)
    brackets = "; 90 % intervals in brackets" if has_intervals else ""
    return f"{begin}: {'; '.join(phrases)}{brackets}."


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
    primitive: Primitive, size: PrimitiveInterval, model: Model, campaign: Campaign
) -> str:
    """Return the reference speed or displacement of a force, or the station of a mass.

    It is a phrase such as " at 0.3 m/s"; empty for other sizes.
    """
    if primitive.kind == "point_mass" and size.parameter == "mass":
        return f" at {getattr(primitive, 'station'):.3g} m"  # noqa: B009
    if size.parameter != "coefficient":
        return ""
    marks = []
    for exponent in ("velocity_exponent", "displacement_exponent", "exponent"):
        reference = "reference_displacement"
        if exponent.startswith("velocity"):
            reference = "reference_velocity"
        value = getattr(primitive, reference, None)
        if value is not None and getattr(primitive, exponent, 0.0) != 0.0:
            reference_unit = PRIMITIVE_UNITS[primitive.kind][reference]
            unit = definite_unit(reference_unit, primitive, model, campaign)
            marks.append(f"{value:.3g} {unit}")
    return f" at {' and '.join(marks)}" if marks else ""


def definite_unit(unit: str, primitive: Primitive, model: Model, campaign: Campaign) -> str:
    """Return the unit of a primitive's parameter, as its port and its channel determine it.

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
        The unit; empty for a plain number, or if it is not determined.
    """
    if unit.startswith(CHANNEL_UNIT):
        return _channel_unit(primitive, campaign) if unit == CHANNEL_UNIT else ""
    if " or " not in unit:
        return unit_text(unit)
    port = str(getattr(primitive, "port", ""))
    unit_if_moving, unit_if_turning = unit.split(" or ")
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
