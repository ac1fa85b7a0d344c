"""What the operator is told of a turn, and how well the twin's model has explained turns."""

from typing import Any

import numpy as np

from twin_master.mission.loop import Beliefs, Reading
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.inference import known_control
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.network.twin import Twin, TwinTurn
from twin_master.scenario.schema import Scenario


def decision_of(
    scenario: Scenario, model: GraphicalModel, twin: Twin, reading: Reading, turn: TwinTurn
) -> dict[str, Any]:
    """Return what the operator is told of a turn: never a control without its certainty."""
    controls = scenario.control_names
    mean, deviation = model.states.mean(turn.filtered), model.states.standard_deviation(turn.filtered)
    record: dict[str, Any] = {
        "turn": turn.turn,
        "control": controls[turn.control_index],
        "health": {
            factor.name: {"mean": mean[index], "standard_deviation": deviation[index], "unit": factor.unit}
            for index, factor in enumerate(scenario.state)
        },
        "next_control": controls[turn.next_control],
        "probability": min(float(turn.decision_probability[turn.next_control]), 1.0),
        "lost_sensors": int(np.isnan(reading.observed).sum()),
        "log_evidence": turn.log_evidence,
        "alarms": [vars(notice) for notice in turn.notices],
    }
    if turn.suspicion is not None:
        record["none_of_these"] = turn.suspicion.none_of_these
    if reading.revises is not None:
        record["revised_by_turn"] = reading.revises
    if turn.learnt:
        record["learnt"] = {name: vars(learnt) for name, learnt in turn.learnt.items()}
    return record


def gap_of(beliefs: Beliefs, skipped: int, sensors: GaussianSensorModel) -> dict[str, Any]:
    """Return root mean square residual and log evidence of the turns behind `skipped`; None without any.

    The residuals are in standard deviations of the noise that is assumed, or learnt where the twin learns.
    """
    observed = np.array(beliefs.observed[skipped:])
    if not len(observed) or np.isnan(observed).all():
        return {"rms_residual": None, "log_evidence": None}
    if beliefs.residual:
        residual = np.array(beliefs.residual[skipped:])
    else:
        filtered, control = np.array(beliefs.filtered[skipped:]), np.array(beliefs.control_index[skipped:])
        joint = known_control(filtered, control, sensors.control_count)
        residual = (observed - sensors.moments(joint)[0]) / sensors.noise(joint)
    return {
        "rms_residual": float(np.sqrt(np.nanmean(residual**2))),
        "log_evidence": float(np.sum(beliefs.log_evidence[skipped:])),
    }
