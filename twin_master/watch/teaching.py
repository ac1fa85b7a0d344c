"""Teaching: what a journal says that is to be asked and tried, and a patch beside what a watch believes.

What is asked when is a pure function of the journal, so that a watch that was killed and taken up again asks,
tries and adopts the same. What comes of a patch follows from a journal up to one of its lines, so that it may
be worked out beside the watch, which goes on.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fe.runtime.errors import FiniteElementError
from fmu_asset.errors import FmuError
from reporting.progress import Progress
from twin_master.assets.asset_source import AssetSource
from twin_master.assets.design_source import DesignBelief
from twin_master.errors import MissionInputError, TwinMasterError, said
from twin_master.mission.journal import damaged_line_error, records_backwards
from twin_master.mission.preparation import Knowledge, prepare_without_folder
from twin_master.mission.replay import BelievedModel, replay
from twin_master.mission.residuals import residual_summary
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state

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
        Log evidence of the steps that were compared, with the patch less without [nats].
    record : dict
        For the journal: `before` and `after`, the gap of the steps from that of the patch on (see
        `residual_summary`), and `policy_change`, how the policy changes, in a sentence; empty where it stays.
    """

    patch: bytes
    model: BelievedModel
    gained: float
    record: Mapping[str, Any]


def patched_model(
    scenario: Scenario, file: Path, from_step: int, progress: Progress | None = None
) -> BelievedModel:
    """Return the model of a scenario with a patch.

    Raises
    ------
    TwinMasterError, FmuError, FiniteElementError
        The twin cannot believe it.
    """
    if not isinstance(scenario.belief, DesignBelief):
        raise MissionInputError("only a twin that believes a design can be given a patch of its model.")
    scenario = scenario.with_changes("belief", patch=str(file))
    source: AssetSource = scenario.belief.source(scenario, None)
    return BelievedModel(from_step, prepare_without_folder(scenario, source, progress), file)


def judged(
    journal: Path, end: int, scenario: Scenario, models: Sequence[BelievedModel], patch: bytes,
    from_step: int, compared: tuple[int, int] = (0, 0), progress: Progress | None = None,
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
    from_step : int
        From which on.
    compared : tuple of int
        The first step whose evidence is compared, behind that one, and how many.
    progress : Progress, optional

    Raises
    ------
    TwinMasterError, FmuError, FiniteElementError
        The twin cannot believe it.
    """
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        file = Path(folder) / "patch.json"
        file.write_bytes(patch)
        model = patched_model(scenario, file, from_step, progress)
    begin, count = compared
    before, after = (
        replay(journal, models, scenario.watch.lag, first_step=from_step, end=end, question=question)[0]
        for question in (None, model)
    )
    evidence = [
        sum(step.twin_step.log_evidence for step in found.steps[begin - found.first_step :][:count])
        for found in (before, after)
    ]
    record = {
        "before": residual_summary(before, from_step, models),
        "after": residual_summary(after, from_step, [*models, model]),
        "policy_change": policy_change(models[-1].knowledge, model.knowledge),
    }
    return Outcome(patch, model, float(evidence[1] - evidence[0]), record)


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
    changed = np.flatnonzero(old != new)
    if not len(changed):
        return ""
    where = []
    for factor, value in zip(scenario.state, states.coordinates[changed[0]], strict=True):
        scale, unit = printed_state(factor.unit)
        where.append(f"{factor.name} {scale * value:.4g} {unit}".rstrip())
    chosen, instead = (scenario.control_names[policy[changed[0]]] for policy in (new, old))
    return (
        f"With it another control is chosen in {len(changed)} of {len(old)} states, first {chosen} in the "
        f"place of {instead} at {', '.join(where)}."
    )


SETTLE_STEPS = 10
"""Steps that an alarm must hold before its cause is looked for; they also show what it is."""
CLEARLY = math.log(10.0)
"""Evidence by which several gauges must be a better explanation than one, as of the alarm itself [nats]."""
CHECKED = 250_000
"""Bytes at the end of a journal that are read at least, so that damage there is found."""


def check_teachable(scenario: Scenario) -> None:
    """Refuse a scenario whose alarms nothing could look into.

    Raises
    ------
    MissionInputError
        It gives no alarms, or is of another asset than a wing with a model that can be patched.
    """
    if scenario.notice is None:
        raise MissionInputError(said("watch.no_alarms"))
    role, states = scenario.observation.role, ", ".join(scenario.state_names)
    if not scenario.searchable:
        raise MissionInputError(said("watch.no_wing", what=f"the role {role} under {states}"))
    if not getattr(scenario.belief, "design", None):
        what = f"the belief `{scenario.belief.kind}` without a design"
        raise MissionInputError(said("watch.no_wing", what=what))


@dataclass
class Teaching:
    """Where the teaching of a watch stands, after the lines of its journal so far.

    Parameters
    ----------
    threshold : float
        Evidence from which on an alarm holds.

    Attributes
    ----------
    step : int
        The last step.
    question : tuple or None
        The first and the last step that hold what the model lacks, if its cause is to be looked for.
    trial : dict or None
        The verdict whose patch is on trial.
    untold : list
        Notices that go with the next step.
    adopted : list of dict
        The models that were adopted, as the journal has them.
    first_alarm : tuple or None
        The step of the first alarm, and its notice.
    of_many : bool
        Whether the gauges together speak for the alarm whose cause is looked for, and no single one does.
    """

    threshold: float
    step: int = -1
    question: tuple[int, int] | None = None
    trial: dict[str, Any] | None = None
    untold: list[dict[str, Any]] = field(default_factory=list)
    adopted: list[dict[str, Any]] = field(default_factory=list)
    first_alarm: tuple[int, Mapping[str, Any]] | None = None
    of_many: bool = False
    _alarm: tuple[int, int] | None = None
    _ask_at: int = 0
    _since: int = 0

    def read(self, path: Path) -> None:
        """Take in a journal, each of whose lines holds where this stood before it.

        Raises
        ------
        NotResumableError
            Its end was changed or is damaged.
        """
        last, length = dict[str, Any](), 0
        for record, begin, end in records_backwards(path):
            length, last = length or end, last or record
            if begin and record["standing"]["begin"] != begin:
                raise damaged_line_error(path, begin, "lines before it are missing, or not its own")
            if length - begin > CHECKED:
                break
        if "standing" in last:
            vars(self).update(last["standing"]["teaching"])
            self.take(last)

    def take(self, record: Mapping[str, Any]) -> None:
        """Take in a line of the journal."""
        if "model" in record:
            self.adopted.append(record["model"])
            self.question = self.trial = self._alarm = None
            self._since = int(record["model"]["from_step"])
            self.untold += [record["model"]["notice"]] if "notice" in record["model"] else []
            # An alarm of the steps that were filtered anew: the patch was not all that the model lacks.
            again = record["model"].get("alarms", [])
            self.untold += again
            self._alarms(again)
        elif "verdict" in record:
            self._verdict(record["verdict"])
        elif "filtered" in record:
            self.step = int(record["step"])
            told = {notice["sentence"] for notice in self.untold}
            notices = [n for n in record.get("notices", []) if n["sentence"] not in told]
            self.untold = []
            self._alarms(notices)
            self._ask(record.get("suspicion", {}))

    def _alarms(self, notices: Sequence[Mapping[str, Any]]) -> None:
        for notice in notices:
            if notice["kind"] == "alarm":
                self._alarm = self.step, int(notice.get("since") or 0)
                self._ask_at = self.step + SETTLE_STEPS
                self.first_alarm = self.first_alarm or (self.step, notice)

    def _ask(self, suspicion: Mapping[str, Any]) -> None:
        if self._alarm is None or self.question or self.trial or self.step < self._ask_at:
            return
        of_many = suspicion.get("log_evidence_none", -math.inf)
        of_one = suspicion.get("log_evidence_any_gauge", -math.inf)
        if max(of_many, of_one) >= math.log(self.threshold):
            self.of_many = of_many >= of_one + CLEARLY
            self.question = max(self._alarm[1], self._since), self.step

    def _verdict(self, verdict: dict[str, Any]) -> None:
        self.untold.append(verdict["notice"])
        if verdict["tried"]:
            self.trial, self.question = verdict, None
            return
        # More steps may tell what these could not: asked again with twice as many behind the alarm.
        asked, self.question, self.trial = int(verdict["to_step"]), None, None
        if self._alarm is not None:
            self._ask_at = asked + max(SETTLE_STEPS, asked - self._alarm[0])
