"""Sentences on a verdict, for the report and for the summary on the terminal."""

import re
from collections.abc import Iterable
from math import isnan

from discrepancy.judgement.closed_share import closed_share_text
from discrepancy.judgement.hypotheses import effects_text, probability_text
from discrepancy.proof_record import ErrorComparison, Proof, Scores
from discrepancy.report.text import (
    NAMING,
    estimate_text,
    nats,
    number,
    parameter_text,
    unit_text,
)
from discrepancy.verdict import ForceAtPort, ForceLeft, NamedEffect, Verdict, VerdictKind
from discrepancy.workflow import Investigation
from reporting.words import counted

ROLE_OF_PROBABILITY = {
    VerdictKind.NOTHING_MISSING: "probability that nothing is missing",
    VerdictKind.FAMILY: "probability",
    VerdictKind.BELOW_LIMIT: "probability that nothing is missing",
}
"""What the probability of a verdict is the probability of; other kinds say it themselves."""

MOTION_OF_FORCE_UNIT = {
    "N": ("force", "m", "m/s"),
    "N m": ("moment", "rad", "rad/s"),
    "N or N m": ("force", "m or rad", "m/s or rad/s"),
}
"""What is missing at a port, and the units of its displacement and speed, by the unit of force."""
ROUNDING_OF_MOTION = 1e-9
"""Displacement or speed over its rms below which it is a rounding error, as at a release."""


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
    role = ROLE_OF_PROBABILITY.get(verdict.kind)
    if isnan(verdict.probability) or "probability" in sentence or role is None:
        return f"{sentence}."
    return f"{sentence} ({role} {probability_text(verdict.probability)})."


def group_members(verdict: Verdict) -> dict[str, tuple[NamedEffect, ...]]:
    """Return the members of a group: explanations that the data cannot tell apart.

    Returns
    -------
    dict of str to tuple of NamedEffect
        The effects of each member, by a text that names them. Empty if the verdict is not a group.
    """
    if verdict.kind is not VerdictKind.GROUP:
        return {}
    # `verdict.group` identifies a member of several effects by "first + second".
    effects_by_identifier: dict[str, tuple[NamedEffect, ...]] = {}
    for hypothesis in verdict.hypotheses:  # the most probable first
        identifier = " + ".join(hypothesis.identifiers)
        effects_by_identifier.setdefault(identifier, hypothesis.effects)
    members = {}
    for identifier in verdict.group:
        if identifier in effects_by_identifier:
            effects = effects_by_identifier[identifier]
        else:
            effects = tuple(effect for effect in verdict.effects if effect.identifier == identifier)
        title = effects_text(effects) or identifier
        members[title] = effects
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
    return MOTION_OF_FORCE_UNIT.get(force.unit, of_state)


def force_sentence(force: ForceAtPort) -> str:
    """Return the sentences on a missing force: where it acts, how large it is, and its law.

    The first sentence also compares the evidence for the port with that for the second best port.
    """
    name, displacement_unit, speed_unit = port_motion_units(force)
    evidence = force.evidence[force.port]
    other_ports = {port: value for port, value in force.evidence.items() if port != force.port}
    size = (
        f"A {name} of {number(force.rms)} {force.unit} (rms) is missing at {force.port}, "
        f"at most {number(abs(force.largest.force))}"
    )
    motion = f"{_motion_text(force.largest.speed, force.speed)} {speed_unit}"
    if displacement_unit:
        displacement = _motion_text(force.largest.displacement, force.displacement)
        motion = f"{displacement} {displacement_unit} and {motion}"
    comparison = f"evidence {nats(evidence)} nat over none"
    if other_ports:
        nearest = max(other_ports, key=lambda port: other_ports[port])
        ahead = evidence - other_ports[nearest]
        more_or_less = "more" if ahead >= 0.0 else "less"
        comparison += f", {nats(abs(ahead))} {more_or_less} than at {nearest}"
    # a force with a law depends on what the law says
    dependence = "" if force.law else f"; {force.dependence}"
    sentence = f"{size} at {motion}{dependence} ({comparison})."
    return f"{sentence} {_sentence_on_law(force)}".rstrip()


def _motion_text(value: float, rms: float) -> str:
    """Return a displacement or speed as text; a rounding error beside the rms is told as zero."""
    return number(value if abs(value) > ROUNDING_OF_MOTION * rms else 0.0)


def _sentence_on_law(force: ForceAtPort) -> str:
    """Return how much of a missing force its law leaves; empty if this was not tested."""
    phrases = []
    for role, remainder in tested_trials(force):
        trials = counted(remainder.trials, f"{role} trial")
        phrases.append(
            f"{number(remainder.left)} of {number(remainder.whole)} {force.unit} (rms) are left "
            f"in {trials}"
        )
    return f"Beside {force.law} {', and '.join(phrases)}." if phrases else ""


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
    if proof is None:
        return ""
    if proof.closed is None:
        return proof.closed_reason
    is_named = investigation.verdict.kind in (*NAMING, VerdictKind.FAMILY)
    # the clause begins with the subject "it", which is replaced
    before, after, _ = proof_scores(proof)
    errors = ErrorComparison(proof.closed, proof.closed_reason, before.rms, after.rms)
    predicate = closed_share_text(investigation.campaign.channels, errors).removeprefix("it ")
    if proof.closed.has_grown:
        subject = "With it" if is_named else "With the best hypothesis, which is not named,"
    else:
        subject = "It" if is_named else "The best hypothesis, which is not named,"
    return f"{subject} {predicate}."


def noise_levels(proof: Proof) -> tuple[str, str]:
    """Return the rms of the residuals over the noise, without and with the effects, as texts."""
    before, after, _ = proof_scores(proof)
    rms_before = number(before.chi_square_per_sample**0.5, 2)
    rms_after = number(after.chi_square_per_sample**0.5, 2)
    return rms_before, rms_after


def remainders_sentence(verdict: Verdict) -> str:
    """Return the sentence on what remains unexplained in each channel; empty if nothing does."""
    phrases = []
    for remainder in verdict.remainders:
        phrase = (
            f"{remainder.channel} {number(remainder.size, 2)} standard deviations of the noise "
            f"over {number(remainder.time, 2)} s"
        )
        if remainder.frequency > 0.0:
            phrase += f", swinging at {number(remainder.frequency)} Hz"
        phrases.append(phrase)
    return f"The remainder beyond the noise: {'; '.join(phrases)}." if phrases else ""


def parameters_sentence(effects: Iterable[NamedEffect]) -> str:
    """Return the parameters of named effects with their 90 % intervals; empty if there is none."""
    phrases = []
    for effect in effects:
        for parameter in effect.parameters:
            value, interval = estimate_text(parameter)
            with_unit = f"{value} {unit_text(parameter.unit)}".rstrip()
            phrases.append(f"{parameter_text(parameter)} {with_unit} ({interval})")
    if not phrases:
        return ""
    return f"Its size: {'; '.join(phrases)}; 90 % intervals in brackets."
