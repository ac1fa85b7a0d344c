"""A patched model that a watch believes, and the comparison of its evidence with the old model.

The outcome depends on the journal up to one of its lines. So it can be computed beside the watch,
which continues meanwhile.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from fe.runtime.errors import FiniteElementError
from fmu_asset.errors import FmuError
from reporting.json_file import JsonObject
from reporting.progress import Progress
from twin_master.assets.asset_source import AssetSource
from twin_master.assets.design_source import DesignBelief
from twin_master.errors import MissionInputError, TwinMasterError
from twin_master.mission.preparation import Knowledge, prepare_without_folder
from twin_master.mission.replay import BelievedModel, replay
from twin_master.mission.residuals import residual_summary
from twin_master.mission.steps import History
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state

PATCH_ERRORS = (TwinMasterError, FmuError, FiniteElementError)
"""The errors that say that a twin cannot believe a patch."""


@dataclass(frozen=True)
class ComparedSteps:
    """The steps in which the evidence with and without a patch is compared.

    Attributes
    ----------
    first : int
        The first of these steps.
    """

    first: int
    count: int


NO_STEPS = ComparedSteps(0, 0)
"""No step is compared, because the user wants the patch to be believed in any case."""


@dataclass(frozen=True)
class PatchOutcome:
    """The outcome of the trial of a patch.

    Attributes
    ----------
    patch : bytes
        The content of the patch file, combined with the patch that was believed before.
    model : BelievedModel
        The patched model.
    gained_evidence : float
        The log evidence of the compared steps with the patch minus that without it [nats].
    record : dict
        The keys `before` and `after`, with the residual and the log evidence of the steps from the
        patch on (`residual_summary`), and `policy_change`, a sentence, for the journal.
    """

    patch: bytes
    model: BelievedModel
    gained_evidence: float
    record: JsonObject


def patched_model(
    scenario: Scenario, patch: Path, from_step: int, progress: Progress | None = None
) -> BelievedModel:
    """Return the model that a twin believes if the design of its scenario is patched.

    Parameters
    ----------
    scenario : Scenario
        The scenario, whose belief is a design.
    from_step : int
        The first step that is filtered with the patched model.

    Raises
    ------
    TwinMasterError, FmuError, FiniteElementError
        If the twin cannot believe the patch.
    """
    if not isinstance(scenario.belief, DesignBelief):
        raise MissionInputError(
            "only a twin that believes a design can be given a patch of its model."
        )
    scenario = scenario.with_changes("belief", patch=str(patch))
    source: AssetSource = scenario.belief.source(scenario, None)
    return BelievedModel(from_step, prepare_without_folder(scenario, source, progress), patch)


def outcome_of_patch(
    journal: Path,
    end: int,
    scenario: Scenario,
    models: Sequence[BelievedModel],
    patch: bytes,
    from_step: int,
    compared: ComparedSteps = NO_STEPS,
    progress: Progress | None = None,
) -> PatchOutcome:
    """Find out what a patch of the model would change in a watch.

    The steps from `from_step` on are filtered twice, without and with the patch.

    Parameters
    ----------
    end : int
        The number of bytes of the journal to read.
    models : sequence of BelievedModel
        The models that were believed so far.
    patch : bytes
        The content of the patch file, combined with the patch that is believed already.
    from_step : int
        The first step that is filtered with the patched model.

    Raises
    ------
    TwinMasterError, FmuError, FiniteElementError
        If the twin cannot believe the patch.
    """
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        file = Path(folder) / "patch.json"
        file.write_bytes(patch)
        model = patched_model(scenario, file, from_step, progress)
    # Filter the steps without and with the patch
    lag = scenario.watch.lag
    history_before, _ = replay(journal, models, lag, first_step=from_step, end=end, question=None)
    history_after, _ = replay(journal, models, lag, first_step=from_step, end=end, question=model)
    evidence_before = _log_evidence(history_before, compared)
    evidence_after = _log_evidence(history_after, compared)
    record = {
        "before": residual_summary(history_before, from_step, models),
        "after": residual_summary(history_after, from_step, [*models, model]),
        "policy_change": describe_policy_change(models[-1].knowledge, model.knowledge),
    }
    return PatchOutcome(patch, model, float(evidence_after - evidence_before), record)


def _log_evidence(history: History, compared: ComparedSteps) -> float:
    """Return the log evidence of the compared steps in a history [nats]."""
    begin = compared.first - history.first_step
    steps = history.steps[begin:][: compared.count]
    return sum(step.twin_step.log_evidence for step in steps)


def merge_patches(believed: Path | None, new_patch: Path) -> bytes:
    """Return the content of a patch file with the effects of two patches.

    Parameters
    ----------
    believed : Path or None
        The file of the patch that is believed already, if any.
    new_patch : Path
        The file of the patch that is added.
    """
    if believed is None:
        return new_patch.read_bytes()
    believed_record = json.loads(believed.read_text(encoding="utf-8"))
    new_record = json.loads(new_patch.read_text(encoding="utf-8"))
    merged_record = {
        "schema": new_record["schema"],
        "effects": believed_record["effects"] + new_record["effects"],
        "channels": believed_record.get("channels", {}) | new_record.get("channels", {}),
    }
    return (json.dumps(merged_record, indent=1) + "\n").encode()


def describe_policy_change(before: Knowledge, after: Knowledge) -> str:
    """Return a sentence on the difference between the policies of two models.

    Parameters
    ----------
    before, after : Knowledge
        The knowledge of the twin with the old and with the new model of the same scenario.

    Returns
    -------
    str
        The number of states in which another control is chosen, and the first of these states;
        empty if the policies are the same.
    """
    scenario = before.scenario
    old_policy = before.plan.control_index
    new_policy = after.plan.control_index
    changed_states = np.flatnonzero(old_policy != new_policy)
    if not len(changed_states):
        return ""
    state = changed_states[0]
    coordinates = before.model.states.coordinates[state]
    values = []
    for factor, value in zip(scenario.state, coordinates, strict=True):
        scale, unit = printed_state(factor.unit)
        values.append(f"{factor.name} {scale * value:.4g} {unit}".rstrip())
    new_control = scenario.control_names[new_policy[state]]
    old_control = scenario.control_names[old_policy[state]]
    return (
        f"With it another control is chosen in {len(changed_states)} of {len(old_policy)} states, "
        f"first {new_control} in the place of {old_control} at {', '.join(values)}."
    )
