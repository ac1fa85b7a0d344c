"""A patch beside what a watch believes: the patched model, its turns filtered again, and what that gains.

All of it follows from a journal up to one of its lines, so that it may be worked out beside the watch,
which goes on.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fe.runtime.errors import FiniteElementError
from fmu_asset.errors import FmuError
from reporting.progress import Progress
from twin_master.assets.asset_source import AssetSource
from twin_master.assets.design_source import DesignBelief
from twin_master.errors import MissionInputError, TwinMasterError
from twin_master.mission.preparation import Knowledge, prepared_alone
from twin_master.mission.replay import BelievedModel, gap_of, replay
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state
from twin_master.store.summary import policy_switch

CANNOT = (TwinMasterError, FmuError, FiniteElementError)
"""Why a twin cannot believe a patch."""


@dataclass(frozen=True)
class Outcome:
    """What comes of a patch.

    Attributes
    ----------
    patch : bytes
        Content of the patch file, with what was believed already.
    model : BelievedModel
        The patched one.
    gained : float
        Log evidence of the turns that were compared, with the patch less without [nats].
    before, after : mapping
        The gap of the turns from that of the patch on, see `gap_of`.
    policy_change : str
        How the policy changes, in a sentence; empty where it stays.
    """

    patch: bytes
    model: BelievedModel
    gained: float
    before: Mapping[str, Any]
    after: Mapping[str, Any]
    policy_change: str


def patched_model(
    scenario: Scenario, file: Path, from_turn: int, progress: Progress | None = None
) -> BelievedModel:
    """Return the model of a scenario with a patch.

    Raises
    ------
    TwinMasterError, FmuError, FiniteElementError
        The twin cannot believe it.
    """
    belief = scenario.belief
    if not isinstance(belief, DesignBelief):
        raise MissionInputError("only a twin that believes a design can be given a patch of its model.")
    scenario = scenario.model_copy(update={"belief": belief.model_copy(update={"patch": str(file)})})
    source: AssetSource = scenario.belief.source(scenario, None)
    return BelievedModel(from_turn, prepared_alone(scenario, source, progress), file)


def judged(
    journal: Path, end: int, scenario: Scenario, models: Sequence[BelievedModel], patch: bytes,
    from_turn: int, compared: tuple[int, int] = (0, 0), progress: Progress | None = None,
) -> Outcome:  # fmt: skip
    """Return what comes of a patch.

    Parameters
    ----------
    journal : Path
    end : int
        Bytes of it that are read.
    scenario : Scenario
    models : sequence of BelievedModel
        What was believed so far.
    patch : bytes
        Content of the patch file that would be believed, with what is believed already.
    from_turn : int
        From which on.
    compared : tuple of int
        The first turn whose evidence is compared, behind that one, and how many.
    progress : Progress, optional

    Raises
    ------
    TwinMasterError, FmuError, FiniteElementError
        The twin cannot believe it.
    """
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        file = Path(folder) / "patch.json"
        file.write_bytes(patch)
        model = patched_model(scenario, file, from_turn, progress)
    begin, count = compared
    before, after = (
        replay(journal, models, scenario.watch.lag, first_turn=from_turn, end=end, question=question)[0]
        for question in (None, model)
    )
    known = models[-1].knowledge
    evidence = [
        sum(turn.concluded.log_evidence for turn in found.turns[begin - found.first_turn :][:count])
        for found in (before, after)
    ]
    return Outcome(
        patch=patch,
        model=model,
        gained=float(evidence[1] - evidence[0]),
        before=gap_of(before, from_turn - before.first_turn, known.sensor_model),
        after=gap_of(after, from_turn - after.first_turn, model.knowledge.sensor_model),
        policy_change=policy_change(known, model.knowledge),
    )


def both_patches(before: Path | None, found: Path) -> bytes:
    """Return the patch that the model has and the one that was found beside it, as one file."""
    if before is None:
        return found.read_bytes()
    old, new = (json.loads(file.read_text(encoding="utf-8")) for file in (before, found))
    effects, channels = old["effects"] + new["effects"], old.get("channels", {}) | new.get("channels", {})
    text = json.dumps({"schema": new["schema"], "effects": effects, "channels": channels}, indent=1)
    return (text + "\n").encode()


def policy_change(before: Knowledge, after: Knowledge) -> str:
    """Return in a sentence how the policy of a model differs from that of another; empty where it does not.

    Parameters
    ----------
    before, after : Knowledge
        Of the same scenario.
    """
    scenario, states = before.scenario, before.model.states
    old, new = before.plan.control_index, after.plan.control_index
    changed, first = np.flatnonzero(old != new), scenario.mission.first_control
    if not len(changed):
        return ""

    def level(axis: int, value: float) -> str:
        scale, unit = printed_state(scenario.state[axis].unit)
        return f"{scale * value:.4g} {unit}".rstrip()

    control = scenario.control_names.index(first)
    left, leaves = policy_switch(states, old, control), policy_switch(states, new, control)
    if left and leaves and left[0] == leaves[0]:
        axis = left[0]
        where = f"{scenario.state_names[axis]} {level(axis, leaves[1])}"
        return f"With it {first} is left at {where} in the place of {level(axis, left[1])}."
    state = states.coordinates[changed[0]]
    where = ", ".join(f"{name} {level(k, state[k])}" for k, name in enumerate(scenario.state_names))
    chosen, instead = (scenario.control_names[policy[changed[0]]] for policy in (new, old))
    return (
        f"With it another control is chosen in {len(changed)} of {len(old)} states, first {chosen} in the "
        f"place of {instead} at {where}."
    )
