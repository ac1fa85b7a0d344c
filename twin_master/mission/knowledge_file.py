"""Files of a run folder with the model, draws and policy of a twin before its flight."""

import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from reporting.arrays import Float
from reporting.files import atomic_write_bytes, atomic_write_text
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import RunFolderError
from twin_master.mission.parts import NO_PARTS, TwinParts
from twin_master.mission.preparation import Knowledge
from twin_master.network.graphical_model import build_graphical_model
from twin_master.network.planner import BeliefPolicy, RiskPolicy
from twin_master.scenario.schema import Scenario

KNOWLEDGE_NAME = "twin.npz"
"""The file of a run folder with the knowledge of the twin before its flight."""
EARLIER_KNOWLEDGE = "twin_{}.npz"
"""The same for the models that a watch believed earlier, by their numbers from 0."""
CALIBRATION_NAME = "calibration.json"
"""The file of a run folder with the record of the calibration."""


def save_knowledge(folder: Path, knowledge: Knowledge, number: int | None = None) -> None:
    """Write the knowledge of a twin before its flight to a file; equal knowledge gives equal bytes.

    If the calibration has a record, it is written to a second file.

    For E draws of the parameter, S states, U controls and G sensors, the arrays are:

    - `predicted` (E, S, U, G), SI, `draws` (E,) and `policy` (S, U);
    - `belief_vectors` (N, S) and `belief_control` (N,), with a policy that was planned on the
      belief;
    - `risk_beyond_limit` (S, U), `risk_hardest_first` (U,) and `risk_level`, with a policy by risk;
    - `true` (E, S, U, G), SI, if the sensors do not show the values of the structure itself.

    Parameters
    ----------
    number : int, optional
        The number of an earlier model of a watch, from 0; left out for the last or only one.

    Raises
    ------
    FileNotWrittenError
        If the disk is full or the folder cannot be written.
    """
    arrays: dict[str, Any] = {
        "predicted": knowledge.predicted,
        "draws": knowledge.draws.values,
        "policy": knowledge.plan.policy,
    }
    policy_on_belief = knowledge.plan.on_belief
    if policy_on_belief is not None:
        prefix = "risk_" if isinstance(policy_on_belief, RiskPolicy) else "belief_"
        for name, array in vars(policy_on_belief).items():
            arrays[prefix + name] = array
    if knowledge.true_values is not None:
        arrays["true"] = knowledge.true_values
    content = io.BytesIO()
    np.savez(content, **arrays)
    name = KNOWLEDGE_NAME if number is None else EARLIER_KNOWLEDGE.format(number)
    atomic_write_bytes(folder / name, content.getvalue())
    if knowledge.draws.record is not None:
        text = json.dumps(knowledge.draws.record, sort_keys=True, allow_nan=False)
        atomic_write_text(folder / CALIBRATION_NAME, text + "\n")


def link_knowledge(folder: Path, other_folder: Path) -> None:
    """Put the knowledge file of `folder` into `other_folder`, if it has none.

    The file is a hard link if the file system allows it, and a copy otherwise.
    """
    if (other_folder / KNOWLEDGE_NAME).exists():
        return
    try:
        os.link(folder / KNOWLEDGE_NAME, other_folder / KNOWLEDGE_NAME)
    except OSError:
        content = (folder / KNOWLEDGE_NAME).read_bytes()
        atomic_write_bytes(other_folder / KNOWLEDGE_NAME, content)


def load_knowledge(
    folder: Path, scenario: Scenario, number: int | None = None, parts: TwinParts = NO_PARTS
) -> Knowledge:
    """Return the knowledge of a run's twin before its flight, from the files of the run folder.

    Parameters
    ----------
    scenario : Scenario
        The scenario in its `config.json`.
    number : int, optional
        The number of an earlier model of a watch, from 0; the last model if there is no such file.
    parts : TwinParts
        The sensor model and the estimator that a user gives in the place of the scenario's.

    Raises
    ------
    RunFolderError
        If the file is missing or damaged, or belongs to another scenario.
    """
    path = folder / EARLIER_KNOWLEDGE.format(number)
    if not path.is_file():
        path = folder / KNOWLEDGE_NAME
    try:
        with np.load(path, allow_pickle=False) as stored_arrays:
            predicted_readings = np.asarray(stored_arrays["predicted"], dtype=np.float64)
            draws = np.asarray(stored_arrays["draws"], dtype=np.float64)
            policy: Float | BeliefPolicy | RiskPolicy = np.asarray(
                stored_arrays["policy"], dtype=np.float64
            )
            true_values = None
            if "true" in stored_arrays:
                true_values = np.asarray(stored_arrays["true"], dtype=np.float64)
            if "belief_control" in stored_arrays:
                policy = BeliefPolicy.from_arrays(stored_arrays, "belief_")
            elif "risk_level" in stored_arrays:
                policy = RiskPolicy.from_arrays(stored_arrays, "risk_")
        calibration = scenario.calibration
        parameter = ParameterDraws(
            calibration.parameter,
            draws,
            float(draws.mean()),
            float(draws.std()),
            calibration.source,
        )
        model = build_graphical_model(scenario)
        knowledge = Knowledge(
            scenario, model, parameter, predicted_readings, policy, true_values, parts
        )
        _ = knowledge.plan  # planned now, so that arrays of another shape are refused here
        return knowledge
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise RunFolderError(
            f"{path} is missing, damaged or of another scenario ({error}): "
            "fly the run again with --replace."
        ) from error
