"""Sentences on a verdict, for the report and for the summary on the terminal."""

from collections.abc import Iterable
from math import isfinite

from discrepancy.judgement.closed_share import closed_share_text
from discrepancy.judgement.hypotheses import effects_text
from discrepancy.judgement.remarks import KINDS_WITH_NAME
from discrepancy.proof_record import ErrorComparison, Proof, Scores
from discrepancy.report.text import (
    estimate_text,
    number,
    parameter_text,
    unit_text,
)
from discrepancy.verdict import ForceAtPort, ForceLeft, NamedEffect, Verdict, VerdictKind
from discrepancy.workflow import Investigation
from reporting.words import counted

MOTION_OF_FORCE_UNIT = {
    "N": ("force", "m", "m/s"),
    "N m": ("moment", "rad", "rad/s"),
    "N or N m": ("force", "m or rad", "m/s or rad/s"),
}
"""What is missing at a port, and the units of its displacement and speed, by the unit of force."""
ROUNDING_OF_MOTION = 1e-9
"""Displacement or speed over its rms below which it is a rounding error, as at a release."""


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
    """Return the sentence on a missing force: its size, and its largest value with the motion."""
    name, displacement_unit, speed_unit = port_motion_units(force)
    motion = f"{_motion_text(force.largest.speed, force.speed)} {speed_unit}"
    if displacement_unit:
        displacement = _motion_text(force.largest.displacement, force.displacement)
        motion = f"{displacement} {displacement_unit} and {motion}"
    return (
        f"A {name} of {number(force.rms)} {force.unit} (rms) is missing at {force.port}, at most "
        f"{number(abs(force.largest.force))} {force.unit} at {motion}."
    )


def _motion_text(value: float, rms: float) -> str:
    """Return a displacement or speed as text; a rounding error beside the rms is told as zero."""
    return number(value if abs(value) > ROUNDING_OF_MOTION * rms else 0.0)


def left_sentence(force: ForceAtPort | None) -> str:
    """Return how much of a missing force its law leaves; empty if this was not tested."""
    if force is None:
        return ""
    phrases = []
    for role, remainder in tested_trials(force):
        trials = counted(remainder.trials, f"{role} trial")
        size = f"{number(remainder.left)} {force.unit} (rms) in {trials}"
        if remainder.whole > 0.0:
            share = 100.0 * remainder.left / remainder.whole
            size = f"{size}, {share:.0f} % of the {force.noun} there"
        phrases.append(size)
    return f"Left beside {force.law}: {'; '.join(phrases)}." if phrases else ""


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

    It ends with the error over the noise, before and after. If the fraction could not be computed,
    it is the sentence with the reason. It is empty if nothing was added to the model.
    """
    proof = investigation.proof
    if proof is None:
        return ""
    if proof.closed is None:
        return proof.closed_reason
    kind = investigation.verdict.kind
    subject = "It"
    if kind not in KINDS_WITH_NAME:
        nearest = "first" if kind is VerdictKind.GROUP else "nearest in the catalogue"
        subject = f"The {nearest}, which is not named,"
    # the clause begins with the subject "it", which is replaced
    before, after, _ = proof_scores(proof)
    errors = ErrorComparison(proof.closed, proof.closed_reason, before.rms, after.rms)
    predicate = closed_share_text(investigation.campaign.channels, errors).removeprefix("it ")
    if not isfinite(before.chi_square_per_sample):
        return f"{subject} {predicate}."
    level_before, level_after = noise_levels(proof)
    return f"{subject} {predicate}: {level_before} times the noise before, {level_after} after."


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
    return f"Left beyond the noise: {'; '.join(phrases)}." if phrases else ""


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
    return f"Size: {'; '.join(phrases)}; 90 % intervals in brackets."
