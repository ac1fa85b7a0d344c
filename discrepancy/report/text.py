"""Numbers, sizes in SI units and sentences of the report and of the summary on the terminal.

Also what a campaign can decide, in rows for both.
"""

import re
from collections.abc import Collection, Iterable, Sequence
from math import isfinite, isnan
from typing import Any

import numpy as np

from discrepancy.campaign.records import Campaign, Quantity, TrialKind
from discrepancy.campaign.units import UNITS
from discrepancy.catalogue.entry import Effect
from discrepancy.document import PRIMITIVE_UNITS
from discrepancy.files.verdict import PrimitiveInterval
from discrepancy.judgement.closed_share import closed_text, share_text
from discrepancy.judgement.conclusion import effects_text, probability_text
from discrepancy.judgement.separability import CONFUSED, DETECTED, Detectability, Separability
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
from reporting.words import between, listing, rounded

BEYOND_DOUBT = 1e6
"""Evidence [nat] of which no more is told."""
NAMING = (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART)
"""Verdicts that say what is missing, if not all of it."""

LARGEST_PLAIN = 1e6
"""Numbers from here on have a power of ten."""

SHORT_UNITS = {"1": "", "m/s2": "m/s²"}


def estimate_text(estimate: Estimate) -> tuple[str, str]:
    """Return a value, and its 90 % interval, with two digits of the half-width."""
    if not (isfinite(estimate.low) and isfinite(estimate.high)):
        return f"{estimate.value:.4g}", "not known"
    half = 0.5 * (estimate.high - estimate.low)
    return rounded(estimate.value, half), between(estimate.low, estimate.high, half)


def p_value_text(p: float) -> str:
    """Return a p-value."""
    if isnan(p):
        return "not known"
    return "< 1e-6" if p < 1e-6 else f"{p:.2g}"


def number(value: float, digits: int = 3) -> str:
    """Return a number with significant digits, or a dash where it is not known."""
    if isnan(value):
        return "\N{EN DASH}"
    text = f"{value:.{digits}g}"
    if "e+0" in text and abs(value) < LARGEST_PLAIN:
        text = f"{float(text):,.0f}"
    return text.replace("-", "\N{MINUS SIGN}")


def unit_text(unit: str) -> str:
    """Return a unit for people; empty for plain numbers."""
    return SHORT_UNITS.get(unit, unit)


def headline(verdict: Verdict) -> str:
    """Return the verdict in one sentence that holds its probability."""
    text = verdict.sentence.rstrip(".")
    known = [*verdict.effects, *(effect for item in verdict.hypotheses for effect in item.effects)]
    for identifier, name in {effect.identifier: effect.name for effect in known}.items():
        whole = rf"{re.escape(name)}|\b{identifier}\b"  # a name may hold the identifier
        text = re.sub(whole, lambda _, name=name: name, text)  # type: ignore[misc]
    about = WORDS.content["probability"].get(verdict.kind)
    if isnan(verdict.probability) or "probability" in text or about is None:
        return f"{text}."
    return f"{text} ({about} {probability_text(verdict.probability)})."


def members_of(verdict: Verdict) -> dict[str, tuple[NamedEffect, ...]]:
    """Return the members of a group by name, each with its effects; empty for any other verdict."""
    found = {}
    for group in verdict.group if verdict.kind is VerdictKind.GROUP else ():
        one = next((item for item in verdict.hypotheses if " + ".join(item.identifiers) == group), None)
        effects = tuple(item for item in verdict.effects if item.identifier == group)
        effects = effects if one is None else one.effects
        found[effects_text(effects) or group] = effects
    return found


def motion_of(force: ForceAtPort) -> tuple[str, str, str]:
    """Return what is missing, and the units of displacement and speed of its port."""
    flow = "flow", "", force.unit.partition("/s times")[0]
    what, place, rate = WORDS.content["motions"].get(force.unit, flow)
    return what, place, rate


def force_sentence(force: ForceAtPort) -> str:
    """Return where a force is missing, how large, what orders it, and what its law leaves of it."""
    what, place, rate = motion_of(force)
    own = force.evidence[force.port]
    others = {name: value for name, value in force.evidence.items() if name != force.port}
    nearest = max(others, key=lambda name: others[name], default="")
    evidence = {"own": own, "nearest": nearest, "ahead": own - others.get(nearest, own)}
    port = {"what": what, "place": place, "rate": rate}
    return WORDS.say("force", force=force, tested=tested_trials(force), **evidence, **port)


def tested_trials(force: ForceAtPort | None) -> list[tuple[str, ForceLeft]]:
    """Return which trials, and what a law leaves of a missing force in them; only where it has a force."""
    found = {} if force is None else {"fitted": force.fitted, "held-out": force.held_out}
    return [(kind, left) for kind, left in found.items() if left is not None and left.tested]


def scored(proof: Proof) -> tuple[Scores, Scores, str]:
    """Return the scores before and after, and on which trials: those held out, where there are any."""
    if proof.held_out_before is not None and proof.held_out_after is not None:
        return proof.held_out_before, proof.held_out_after, "held-out"
    return proof.fitted_before, proof.fitted_after, "fitted"


def error_sentence(investigation: Investigation) -> str:
    """Return what share of the error the effects take away, in which channels from what to what; or why none.

    Empty where nothing was added.
    """
    proof, before, after = investigation.proof, investigation.before, investigation.after
    if proof is None or before is None or after is None:
        return ""
    if proof.closed is None:
        return proof.closed_reason
    named = investigation.verdict.kind in NAMING
    what = "With it" if named else "With the best hypothesis, which is no name,"
    text = closed_text(before, after, proof.closed)
    return f"{what} {text.removeprefix('it ')}." if proof.closed.grew else f"{_subject(named)}{text[2:]}."


def _subject(named: bool) -> str:
    """Return what explains a share of the error."""
    return "It" if named else "The best hypothesis, which is no name,"


def noise_levels(proof: Proof) -> tuple[str, str]:
    """Return the rms of the residuals before and after over the noise, for people."""
    before, after, _ = scored(proof)
    levels = (score.chi_square_per_sample**0.5 for score in (before, after))
    first, second = (number(level, 2) for level in levels)
    return first, second


def remainders_sentence(verdict: Verdict) -> str:
    """Return what is left in which channel, over what time; empty without a remainder."""
    return WORDS.say("left", remainders=verdict.remainders)


def _labels(effects: Iterable[tuple[str, str, bool]]) -> str:
    """Return effects joined, each of a name and a place, and whether its shape is free."""
    found = []
    for name, place, free_shape in effects:
        marks = ", ".join(filter(None, (place, "free shape" if free_shape else "")))
        found.append(f"{name} ({marks})" if marks else name)
    return " + ".join(found)


def hypothesis_name(hypothesis: Hypothesis) -> str:
    """Return the effects of a hypothesis in words."""
    return (
        _labels((item.name, item.place, bool(item.shape)) for item in hypothesis.effects) or "nothing missing"
    )


def added_label(investigation: Investigation) -> str:
    """Return what the model "after" has more than the model "before"; empty if nothing."""
    terms = () if investigation.fit is None else investigation.fit.candidate.terms
    return _labels((term.effect.name, term.place, term.free_shape) for term in terms)


_WORD = re.compile(r"\b([a-z]+)(?=\b|_)")
_POWERS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def formula(text: str) -> str:
    """Return an equation of the catalogue with Greek letters, powers and arrows as they are printed."""
    greek = WORDS.content["greek"]
    text = _WORD.sub(lambda match: greek.get(match[1], match[1]), text).replace("->", "→")
    return re.sub(r"\^(\d)(?!\w)", lambda match: match[1].translate(_POWERS), text)


def nats(evidence: float) -> str:
    """Return an evidence; beyond all doubt its digits tell nothing."""
    return f"{evidence:,.0f}" if abs(evidence) < BEYOND_DOUBT else f"more than {BEYOND_DOUBT:,.0f}"


def parameter_text(item: Estimate) -> str:
    """Return what a parameter is."""
    return formula(item.description or item.name.replace("_", " "))


_NUMBERS: tuple[Any, ...] = (
    number, nats, share_text, formula, p_value_text, estimate_text, unit_text, parameter_text,
    probability_text, isfinite,
)  # fmt: skip
WORDS = Words("discrepancy.report", "words.toml", **{function.__name__: function for function in _NUMBERS})
"""Words of the report, of figures and of the summary on the terminal."""


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
    found: dict[str, None] = {}
    for item in intervals:
        primitive = patch.primitives[item.primitive]
        unit = definite_unit(item.unit, primitive, model, campaign)
        if not unit or item.parameter in BESIDE or item.value == 0.0:
            continue
        known = isfinite(item.low) and isfinite(item.high) and item.low < item.high
        half = 0.5 * (item.high - item.low) if known else 0.0
        interval = f" ({between(item.low, item.high, half)})" if known else ""
        words, where = _words(item.parameter, primitive, unit), _where(primitive, item, model, campaign)
        found[f"{words} {rounded(item.value, half)} {unit}{interval}{where}"] = None
    return ", ".join(found)


def size_sentence(
    investigation: Investigation,
    effects: Sequence[NamedEffect],
    intervals: Sequence[Sequence[PrimitiveInterval]],
) -> str:
    """Return the sizes of the effects of a patch in one sentence; empty where none has a unit."""
    model, campaign = investigation.model, investigation.campaign
    sizes = [si_sizes(e.patch, row, model, campaign) for e, row in zip(effects, intervals, strict=True)]
    named = investigation.verdict.kind in (*NAMING, VerdictKind.FAMILY)
    alone = named and len(effects) == 1
    parts = []
    for effect, size in zip(effects, sizes, strict=True):
        name = f"a law of the family {effect.family}" if effect.shape else effect.name
        if size:
            parts.append(size if alone else f"{name}, {size}")
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


def _where(primitive: Primitive, item: PrimitiveInterval, model: Model, campaign: Campaign) -> str:
    """Return at which speed or displacement a force has its size, or where a mass sits."""
    if primitive.kind == "point_mass" and item.parameter == "mass":
        return f" at {getattr(primitive, 'station'):.3g} m"  # noqa: B009
    if item.parameter != "coefficient":
        return ""
    marks = []
    for exponent in ("velocity_exponent", "displacement_exponent", "exponent"):
        reference = "reference_velocity" if exponent.startswith("velocity") else "reference_displacement"
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
        (moving, turning), (force, state) = unit.split(" or "), model.port_units(port)
        of_state = state if unit.startswith("m/s") else force
        return {MOVES[0]: moving, TURNS[0]: turning, EITHER[0]: unit}.get(force, of_state)
    return unit_text(unit)


def seen_of(item: Detectability) -> tuple[str, str, str]:
    """Return whether an effect can be seen, from which size on, and its prior median."""
    seen = item.distance >= DETECTED
    visible = "yes" if seen else "larger than usual only"
    if not item.parameter:
        return visible, "at once" if seen else "not at its prior median", ""
    size, typical = (
        f"{number(value, 2)} {unit_text(item.unit)}".rstrip() for value in (item.detectable, item.typical)
    )
    return (visible, size, typical) if isfinite(item.detectable) else ("not visible", "never", typical)


def neighbours(found: Separability, name: str) -> list[str]:
    """Return the effects that these data cannot tell from one, in either direction."""
    if name not in found.identifiers:
        return []
    at = found.identifiers.index(name)
    near = np.minimum(found.distance[at], found.distance[:, at]) < CONFUSED
    return [other for place, other in enumerate(found.identifiers) if near[place] and place != at]


def group_lines(found: Separability, told: str = "the table says to which") -> list[str]:
    """Return one sentence for each confusion group, or one that there is none; `told`: where to look."""
    seen = [item for item in found.detectability if not item.reason and isfinite(item.detectable)]
    if not found.identifiers or not any(item.parameter and item.distance > 0.0 for item in seen):
        return [WORDS.say("nothing_shown")]
    if not found.groups:
        return [WORDS.say("all_apart")]
    lines = []
    for group in found.groups:
        names = [name.replace("_", " ") for name in group]
        if len(names) == 2:
            lines.append(f"These data cannot tell {names[0]} from {names[1]}.")
        else:
            lines.append(f"Confusion group, each close to at least one other ({told}): {listing(names)}.")
    return lines


def needs(
    found: Separability, campaign: Campaign, effects: Sequence[Effect], possible: Collection[TrialKind]
) -> list[str]:
    """Return sentences on what the campaign would need to decide more; `possible`: what the model follows."""
    known = {effect.identifier: effect for effect in effects}
    there = {trial.kind for trial in campaign.trials}
    lines = []
    for group in found.groups:
        acts = [known[name].acts_on for name in group if name in known]
        union: frozenset[TrialKind] = frozenset().union(*acts)
        common = frozenset(TrialKind).intersection(*acts)
        apart = [
            kind for kind in TrialKind if kind in union - common and kind in possible and kind not in there
        ]
        names = listing(name.replace("_", " ") for name in group)
        kinds = " or ".join(WORDS.content["kinds"][kind.value] for kind in apart)
        lines.append(WORDS.say("add_kinds" if apart else "vary", names=names, kinds=kinds))
    hidden = [
        item
        for item in found.detectability
        if not item.reason and item.parameter and isfinite(item.detectable) and item.distance < DETECTED
    ]
    if hidden:
        first = max(hidden, key=lambda item: item.distance)
        factor = (DETECTED / first.distance) ** 0.5 if first.distance > 0.0 else float("inf")
        unseen = [item.effect.identifier.replace("_", " ") for item in hidden]
        values = {"first": first.effect.identifier.replace("_", " "), "factor": factor, "trials": factor**2}
        lines.append(WORDS.say("unseen" if unseen[1:] else "unseen_one", unseen=listing(unseen), **values))
    unknown = [name for name, channel in campaign.channels.items() if channel.noise is None]
    lines += [WORDS.say("give_noise", names=", ".join(unknown))] if unknown else []
    return lines if campaign.held_out else [*lines, WORDS.say("hold_out")]
