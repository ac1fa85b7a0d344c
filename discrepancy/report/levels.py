"""The four questions that a verdict answers, and how sure each answer is.

Is something missing (detect), where (locate), what does it depend on (characterise), and which law
is it (name)? The order is that of Kerschen, Worden, Vakakis and Golinval 2006 (Mech. Syst. Signal
Process. 20, 505-592) and of Noel and Kerschen 2017 (ibid. 83, 2-35).
"""

from math import isfinite
from typing import NamedTuple

import numpy as np
from scipy.special import expit, logsumexp

from discrepancy.judgement.curve_words import curve_of
from discrepancy.judgement.hypotheses import effects_text, probability_text
from discrepancy.judgement.remarks import KINDS_WITHOUT_GAP
from discrepancy.report.force_figure import shape_in_words
from discrepancy.report.text import number, p_value_text
from discrepancy.report.verdict_sentences import group_members
from discrepancy.verdict import ForceAtPort, Gate, Verdict, VerdictKind, as_noun
from discrepancy.workflow import Investigation
from reporting.pages.table import RecordColumn, Table, table_of_records, text_cells
from reporting.words import listing


class Answer(NamedTuple):
    """The answer to one of the four questions.

    Attributes
    ----------
    question, text : str
        The question, and its answer in a few words.
    certainty : str
        How sure the answer is; empty if the question has none.
    """

    question: str
    text: str
    certainty: str


def levels_table(investigation: Investigation, *, next_step: str = "") -> Table:
    """Return the table of the four questions; without rows if the data are at fault.

    `next_step` is the answer of a last row on what to do next; without it there is no such row.
    """
    verdict = investigation.verdict
    shape = ""
    if verdict.kind is VerdictKind.UNEXPLAINED:
        shape = shape_in_words(investigation.missing)
    columns: list[RecordColumn[Answer]] = [
        text_cells("question", lambda answer: answer.question),
        text_cells("answer", lambda answer: answer.text),
        text_cells("how sure", lambda answer: answer.certainty),
    ]
    rows = answers(verdict, shape)
    if rows and next_step:
        rows.append(Answer("What next?", next_step, ""))
    return table_of_records(
        columns,
        rows,
        title="What is known",
        caption=(
            "Probabilities are among what was compared: a missing force against none, its port "
            "against the others, a law against the others and a force without a law."
        ),
    )


def answers(verdict: Verdict, shape: str = "") -> list[Answer]:
    """Return the answers of a verdict to the four questions, as far as the data reach.

    Nothing follows the first answer if nothing is missing, and the list is empty if the data are at
    fault or the model was not fitted. `shape` describes the force over what it depends on.
    """
    if verdict.kind is VerdictKind.DATA_ERROR or verdict.unfitted:
        return []
    if verdict.kind in KINDS_WITHOUT_GAP:
        is_missing = "no" if verdict.kind is VerdictKind.NOTHING_MISSING else "not seen"
        certainty = f"probability that nothing is missing {probability_text(verdict.probability)}"
        return [Answer("Is something missing?", is_missing, certainty)]
    rows = [_detection(verdict), _location(verdict), _dependence(verdict, shape), _name(verdict)]
    return [row for row in rows if row.text]


def _detection(verdict: Verdict) -> Answer:
    """Return whether something is missing, and its size if it is a force."""
    text = "yes"
    certainty = ""
    force = verdict.force
    if force is not None:
        largest = number(abs(force.largest.force))
        size = f"{number(force.rms)} {force.unit} (rms), at most {largest} {force.unit}"
        text = f"yes: a {force.noun} of {size}"
        certainty = f"probability {probability_text(probability_of_force(force))}"
    elif verdict.kind is not VerdictKind.UNEXPLAINED:
        certainty = f"probability {probability_text(float(expit(verdict.log_bayes_factor)))}"
    gates = deciding_gates(verdict)
    if not certainty and gates:
        certainty = f"p = {p_value_text(gates[0].statistic)} that it is noise".replace("= <", "<")
    return Answer("Is something missing?", text, certainty)


def probability_of_force(force: ForceAtPort) -> float:
    """Return the probability that a force is missing at some port, even odds before the data."""
    log_evidence = np.array(list(force.evidence.values()))
    return float(expit(logsumexp(log_evidence) - np.log(len(log_evidence))))


def probability_of_port(force: ForceAtPort) -> float:
    """Return the probability of the port of a missing force, all ports even before the data."""
    log_evidence = np.array(list(force.evidence.values()))
    return float(np.exp(force.evidence[force.port] - logsumexp(log_evidence)))


def _location(verdict: Verdict) -> Answer:
    """Return where something is missing: at a port, or at the place of an effect."""
    question = "Where?"
    force = verdict.force
    if force is not None:
        if len(force.evidence) == 1:
            return Answer(question, f"at {force.port}", "the only port of the model")
        nearest = max(force.evidence, key=lambda port: force.evidence[port])
        if nearest != force.port:
            certainty = f"by its law; a force without a law shows more at {nearest}"
            return Answer(question, f"at {force.port}", certainty)
        certainty = f"probability {probability_text(probability_of_port(force))} among the ports"
        return Answer(question, f"at {force.port}", certainty)
    if group_members(verdict):
        return Answer(question, "", "")
    places = {effect.place: effect.place_in_words for effect in verdict.effects if effect.place}
    if not places:
        return Answer(question, "", "")
    probability = sum(
        hypothesis.probability
        for hypothesis in verdict.hypotheses
        if places.keys() <= {effect.place for effect in hypothesis.effects}
    )
    certainty = f"probability {probability_text(min(probability, 1.0))}"
    return Answer(question, f"at {listing(places.values())}", certainty)


def _dependence(verdict: Verdict, shape: str) -> Answer:
    """Return what a missing force depends on, and how."""
    question = "What does it depend on?"
    force = verdict.force
    if force is None:
        return Answer(question, "", "")
    if not force.ordered_by:
        return Answer(question, f"none of {listing(map(as_noun, force.orders))}", "")
    text = listing(map(as_noun, force.ordered_by), "or")
    if shape:
        text = f"{text}: {shape}"
    return Answer(question, text, f"{force.followed_percent} % of its variance")


def _name(verdict: Verdict) -> Answer:
    """Return the law or the error of a sensor that has the name, or which are nearest."""
    question = "Which law is it?"
    certainty = f"probability {probability_text(verdict.probability)}"
    members = group_members(verdict)
    if members:
        return Answer(question, listing(members, "or"), f"{certainty} that it is one of them")
    if verdict.kind is VerdictKind.UNEXPLAINED:
        return Answer(question, "none of the catalogue", "")
    if curve_of(verdict.effects) is not None:
        return Answer(question, "none of the catalogue", certainty)
    if verdict.kind is VerdictKind.FAMILY:
        return Answer(question, effects_text(verdict.effects), certainty)
    passed = "it leaves only noise"
    if verdict.kind is VerdictKind.NAMED_IN_PART:
        passed = "it leaves more than noise"
    elif not any(gate.name == "absolute fit" and gate.passed for gate in verdict.gates):
        passed = ""
    return Answer(
        question, effects_text(verdict.effects), "; ".join(filter(None, (certainty, passed)))
    )


def deciding_gates(verdict: Verdict) -> list[Gate]:
    """Return the gates that compared a p-value; those that did not pass come first."""
    compared = [
        gate
        for gate in verdict.gates
        if isfinite(gate.statistic) and gate.name not in ("shape", "held-out trials")
    ]
    return sorted(compared, key=lambda gate: not gate.has_failed)
