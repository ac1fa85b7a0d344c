"""What the twin of a run knew before its flight, kept in the run folder: `twin.npz`.

Together with what was observed it gives every belief of the flight again, in any process and while the flight
still goes on: a view of it costs the flight nothing.
"""

import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from reporting.files import atomic_write_bytes, atomic_write_text
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import RunFolderError
from twin_master.mission.preparation import Knowledge, knowledge_of
from twin_master.network.planner import BeliefPolicy
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.schema import Scenario

KNOWLEDGE_NAME, CALIBRATION_NAME = "twin.npz", "calibration.json"


def keep_knowledge(folder: Path, knowledge: Knowledge) -> None:
    """Write what a twin knows before its flight; the bytes depend on nothing else.

    The arrays are `predicted` (E, S, U, G), SI, `draws` (E,) and `policy` (S, U); where it is decided by the
    belief also `belief_vectors` (N, S) and `belief_control` (N,); where what is there at
    the sensors is not what they show also `true` (E, S, U, G), SI.

    Raises
    ------
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    content, true = io.BytesIO(), knowledge.rewards.true_per_draw
    arrays: dict[str, Any] = {
        "predicted": knowledge.sensor_model.value_per_draw,
        "draws": knowledge.draws.values,
        "policy": knowledge.plan.policy,
    }
    if knowledge.plan.on_belief is not None:
        arrays |= {f"belief_{name}": array for name, array in vars(knowledge.plan.on_belief).items()}
    np.savez(content, **arrays | ({} if true is None else {"true": true}))
    atomic_write_bytes(folder / KNOWLEDGE_NAME, content.getvalue())
    if knowledge.draws.record is not None:
        text = json.dumps(knowledge.draws.record, sort_keys=True, allow_nan=False)
        atomic_write_text(folder / CALIBRATION_NAME, text + "\n")


def share_knowledge(folder: Path, other: Path) -> None:
    """Keep what a twin knows in another folder, too, on the same bytes of the disk where it has links."""
    if (other / KNOWLEDGE_NAME).exists():
        return
    try:
        os.link(folder / KNOWLEDGE_NAME, other / KNOWLEDGE_NAME)
    except OSError:
        atomic_write_bytes(other / KNOWLEDGE_NAME, (folder / KNOWLEDGE_NAME).read_bytes())


def kept_knowledge(folder: Path, scenario: Scenario) -> Knowledge:
    """Return what the twin of a run knew before its flight.

    Parameters
    ----------
    folder : Path
        The run folder.
    scenario : Scenario
        Of its `config.json`.

    Raises
    ------
    RunFolderError
        The file is missing or damaged, or belongs to another scenario.
    """
    path = folder / KNOWLEDGE_NAME
    try:
        with np.load(path, allow_pickle=False) as kept:
            predicted, draws, policy = (
                np.asarray(kept[name], dtype=np.float64) for name in ("predicted", "draws", "policy")
            )
            true = np.asarray(kept["true"], dtype=np.float64) if "true" in kept else None
            on_belief = BeliefPolicy.of(kept, "belief_") if "belief_control" in kept else None
        calibration = scenario.calibration
        parameter = ParameterDraws(
            calibration.parameter, draws, float(draws.mean()), float(draws.std()), calibration.source
        )
        model = build_graphical_model(scenario)
        return knowledge_of(scenario, model, parameter, predicted, on_belief or policy, true)
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise RunFolderError(
            f"{path} is missing, damaged or of another scenario ({error}): fly the run again with --replace."
        ) from error
