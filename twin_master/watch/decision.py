"""What the operator is told of a turn, and how well the twin's model has explained turns."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_master.mission.journal import array_of
from twin_master.mission.turns import History
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.inference import known_control
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.schema import Scenario

Float = NDArray[np.float64]

_SUSPECTED = ("none_of_these", "hypotheses", "decided_by")
"""What is told of a suspicion."""


def journalled_decision(line: Mapping[str, Any], scenario: Scenario, model: GraphicalModel) -> dict[str, Any]:
    """Return what the operator is told with a line of a journal: never a control without its certainty.

    Nothing where it tells no decision.
    """
    if "quiet" in line:
        return dict(line["quiet"])
    if "filtered" not in line:
        return {}
    filtered = array_of(line["filtered"])
    mean, deviation = model.states.mean(filtered), model.states.standard_deviation(filtered)
    controls, coming = scenario.control_names, line["next_control"]
    record = {
        "turn": line["turn"],
        "control": controls[line.get("control_in_force", line["control_index"])],
        "health": {
            factor.name: {"mean": mean[index], "standard_deviation": deviation[index], "unit": factor.unit}
            for index, factor in enumerate(scenario.state)
        },
        "next_control": controls[coming],
        "probability": min(float(line["decision_probability"][coming]), 1.0),
        "lost_sensors": line["observed"][: scenario.observation.count].count(None),
        "log_evidence": line["log_evidence"],
        "notices": line.get("notices", []),
    }
    if "suspicion" in line:
        record |= {name: line["suspicion"][name] for name in _SUSPECTED}
    if "control_in_force" in line:
        record["revised_by_turn"] = line["observation_turn"]
    if "learnt" in line:
        record["learnt"] = line["learnt"]
    return record


def gap_of(history: History, skipped: int, sensors: GaussianSensorModel) -> dict[str, Any]:
    """Return root mean square residual and log evidence of the turns behind `skipped`; None without any.

    The residuals are in standard deviations of the noise that is assumed, or learnt where the twin learns.
    """
    left = history.behind(skipped)
    if not left.turns or np.isnan(left.observed).all():
        return {"rms_residual": None, "log_evidence": None}
    residual = left.residual()
    if not len(residual):
        joint = known_control(left.filtered, left.control_index, sensors.control_count)
        residual = (left.observed - sensors.moments(joint)[0]) / sensors.noise(joint)
    return {
        "rms_residual": float(np.sqrt(np.nanmean(residual**2))),
        "log_evidence": float(np.sum(left.log_evidence)),
    }
