"""Decisions in a journal, as records and in words for the operator."""

import shlex
from pathlib import Path

from reporting.json_file import JsonObject, JsonRecord
from twin_master.mission.journal import KEPT_OF_SUSPICION
from twin_master.mission.journal_packing import array_from_json
from twin_master.network.estimator import is_state_believed
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state


def decision_from_line(line: JsonRecord, scenario: Scenario, model: GraphicalModel) -> JsonObject:
    """Return the decision in a line of a journal; empty if the line contains none.

    A decision always states the probability of its control. If most probably no state explains the
    sensors, mean and standard deviation of the state are None.

    Parameters
    ----------
    line : mapping of str to object
        The record of the line.
    model : GraphicalModel
        The states to which the belief in the line refers.
    """
    for reason in ("quiet", "refused"):  # such a line contains a copy of the last decision
        if reason in line:
            return dict(line[reason])
    if "filtered" not in line:
        return {}
    controls = scenario.control_names
    next_control = line["next_control"]
    is_a_state_believed = is_state_believed(unexplained_probability(line))
    filtered_belief = array_from_json(line["filtered"])
    mean = model.states.mean(filtered_belief)
    deviation = model.states.standard_deviation(filtered_belief)
    health: JsonObject = {}
    for index, factor in enumerate(scenario.state):
        health[factor.name] = {
            "mean": mean[index] if is_a_state_believed else None,
            "standard_deviation": deviation[index] if is_a_state_believed else None,
            "unit": factor.unit,
        }
    decision: JsonObject = {
        "step": line["step"],
        "control": controls[line.get("control_in_force", line["control_index"])],
        "state_believed": is_a_state_believed,
        "health": health,
        "next_control": controls[next_control],
        "probability": min(float(line["decision_probability"][next_control]), 1.0),
        "lost_sensors": line["observed"][: scenario.observation.count].count(None),
        "log_evidence": line["log_evidence"],
        "notices": line.get("notices", []),
    }
    if "suspicion" in line:
        decision |= {key: line["suspicion"][key] for key in KEPT_OF_SUSPICION}
    if "control_in_force" in line:
        decision["revised_by_step"] = line["observation_step"]
    if "learnt" in line:
        decision["learnt"] = line["learnt"]
    message_step = _step_by_messages(line, scenario.watch.every)
    if message_step not in (None, line["step"]):
        decision["message_step"] = message_step
    return decision


def unexplained_probability(line: JsonRecord) -> float:
    """Return the probability that no state of the model explains the sensors; 0 without notices.

    Parameters
    ----------
    line : mapping of str to object
        The full record of a step in the journal.
    """
    return float(line.get("suspicion", {}).get("none_of_these", 0.0))


def _step_by_messages(line: JsonRecord, numbers_per_step: int) -> int | None:
    """Return the number of a line's step in the messages; None if they do not count steps."""
    counter = line.get("intake", {}).get("counter")
    if counter is None:
        return None
    for first_step, first_number, _ in reversed(counter["stretches"]):
        steps = line["step"] - first_step
        if steps >= 0:
            return int(first_number + steps * numbers_per_step)
    return None


def with_folder(sentence: str, folder: Path) -> str:
    """Return the sentence of a notice whose command names the folder of its run.

    The sentence itself has DIR in the place of the folder, because the folder may be moved.
    """
    return sentence.replace(" DIR", f" {shlex.quote(str(folder))}")


def health_in_words(decision: JsonRecord) -> dict[str, str]:
    """Return mean and standard deviation of each state factor as text, such as "20 ± 3 %".

    For a state that is not believed the text is "not believed".
    """
    texts = {}
    for name, moments in decision["health"].items():
        if moments["mean"] is None:
            texts[name] = "not believed"
            continue
        scale, unit = printed_state(moments["unit"])
        digits = ".0f" if unit == "%" else ".3g"
        mean = scale * moments["mean"]
        deviation = scale * moments["standard_deviation"]
        texts[name] = f"{mean:{digits}} ± {deviation:{digits}} {unit}"
    return texts


def decision_line(scenario: Scenario, decision: JsonRecord) -> str:
    """Return a decision as a line of text for the operator."""
    health_text = "no state is believed"
    if decision.get("state_believed", True):
        texts = health_in_words(decision)
        health_text = ", ".join(f"{name} {text}" for name, text in texts.items())
    line = (
        f"{scenario.mission.step_name} {decision['step']}: {decision['control']}, {health_text}; "
        f"next {decision['next_control']} with probability {decision['probability']:.3f}"
    )
    hypothesis = decision.get("decided_by", "model")
    if hypothesis == "model":
        return line
    return f"{line}; by {hypothesis} ({decision['hypotheses'][hypothesis]:.2f})"
