"""Teaching: from an alarm to a verdict on what the model lacks, to a trial of its patch, to its adoption.

What is asked when is a pure function of the journal, so that a watch that was killed and taken up again asks,
tries and adopts the same.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from twin_master.errors import MissionInputError
from twin_master.mission.journal import damaged, records_backwards
from twin_master.scenario.schema import Scenario
from twin_master.sentences import said

SETTLE_TURNS = 10
"""Turns that an alarm must hold before its cause is looked for; they also show what it is."""
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
    turn : int
        The last turn.
    question : tuple or None
        The first and the last turn that hold what the model lacks, if its cause is to be looked for.
    trial : dict or None
        The verdict whose patch is on trial.
    untold : list
        Notices that go with the next turn.
    adopted : list of dict
        The models that were adopted, as the journal has them.
    """

    threshold: float
    turn: int = -1
    question: tuple[int, int] | None = None
    trial: dict[str, Any] | None = None
    untold: list[dict[str, Any]] = field(default_factory=list)
    adopted: list[dict[str, Any]] = field(default_factory=list)
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
                raise damaged(path, begin, "lines before it are missing, or not its own")
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
            self._since = int(record["model"]["from_turn"])
            self.untold += [record["model"]["notice"]] if "notice" in record["model"] else []
            # An alarm of the turns that were filtered anew: the patch was not all that the model lacks.
            again = record["model"].get("alarms", [])
            self.untold += again
            self._alarms(again)
        elif "verdict" in record:
            self._verdict(record["verdict"])
        elif "quiet" not in record:
            self.turn = int(record["turn"])
            told = {notice["sentence"] for notice in self.untold}
            notices = [n for n in record.get("notices", []) if n["sentence"] not in told]
            self.untold = []
            self._alarms(notices)
            self._ask(record.get("suspicion", {}))

    def _alarms(self, notices: Sequence[Mapping[str, Any]]) -> None:
        for notice in notices:
            if notice["kind"] == "alarm":
                self._alarm = self.turn, int(notice.get("since") or 0)
                self._ask_at = self.turn + SETTLE_TURNS

    def _ask(self, suspicion: Mapping[str, Any]) -> None:
        if self._alarm is None or self.question or self.trial or self.turn < self._ask_at:
            return
        evidence = max(
            suspicion.get("log_evidence_none", -math.inf), suspicion.get("log_evidence_any_gauge", -math.inf)
        )
        if evidence >= math.log(self.threshold):
            self.question = max(self._alarm[1], self._since), self.turn

    def _verdict(self, verdict: dict[str, Any]) -> None:
        self.untold.append(verdict["notice"])
        if verdict["tried"]:
            self.trial, self.question = verdict, None
            return
        # More turns may tell what these could not: asked again with twice as many behind the alarm.
        asked, self.question, self.trial = int(verdict["to_turn"]), None, None
        if self._alarm is not None:
            self._ask_at = asked + max(SETTLE_TURNS, asked - self._alarm[0])
