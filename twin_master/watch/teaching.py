"""The state of teaching in a watch: when to search for a cause, and which patch is on trial.

This state depends on the journal only. So a watch that was killed and resumed searches, tests and
adopts in the same way.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from reporting.json_file import JsonObject, JsonRecord
from twin_master.errors import MissionInputError
from twin_master.mission.journal import damaged_line_error, records_backwards
from twin_master.scenario.schema import Scenario
from twin_master.watch.records import ModelRecord, VerdictRecord

SETTLE_STEPS = 10
"""Number of steps after an alarm before its cause is searched; the search uses them as data."""
CLEARLY = math.log(10.0)
"""Log evidence [nats] by which several gauges must explain an alarm better than one gauge.

The alarm itself asks for the same.
"""
CHECKED_BYTES = 250_000
"""Number of bytes at the end of a journal that are checked for damage when it is read."""

_KEYS = {
    "threshold": "threshold",
    "step": "step",
    "steps_to_search": "question",
    "verdict_on_trial": "trial",
    "pending_notices": "untold",
    "adopted_models": "adopted",
    "first_alarm": "first_alarm",
    "is_alarm_of_many": "of_many",
    "_current_alarm": "_alarm",
    "_next_search_step": "_ask_at",
    "_model_from_step": "_since",
}
"""The key in a journal of each attribute of `Teaching`."""


def check_teachable(scenario: Scenario) -> None:
    """Raise an error if no search could find the cause of a scenario's alarms.

    Raises
    ------
    MissionInputError
        If the scenario gives no alarms, or if its asset is not a wing whose model can be patched.
    """
    if scenario.notice is None:
        raise MissionInputError(
            "--teach begins with an alarm, but this scenario raises none: `notice` is off."
        )
    if not scenario.searchable:
        states = ", ".join(scenario.state_names)
        raise _no_wing_error(f"the role {scenario.observation.role} under {states}")
    if not getattr(scenario.belief, "design", None):
        raise _no_wing_error(f"the belief `{scenario.belief.kind}` without a design")


def _no_wing_error(reason: str) -> MissionInputError:
    """Return the error for a scenario whose asset is not a wing that can be taught."""
    return MissionInputError(
        "--teach looks for what the model of a wing lacks. It needs strains under the damage "
        "states z1 and z2 that a design or a calibration predicts, but this scenario has "
        f"{reason}: leave --teach out; alarms are raised without it, too."
    )


@dataclass
class Teaching:
    """The state of teaching after some lines of a watch's journal.

    Parameters
    ----------
    threshold : float
        The evidence above which an alarm holds.

    Attributes
    ----------
    step : int
        The last step; -1 before the first one.
    steps_to_search : (int, int) or None
        The first and the last step of the data for a search for the cause of an alarm.
    verdict_on_trial : VerdictRecord or None
        The verdict whose patch is tested beside the model.
    pending_notices : list of dict
        The notices that are given with the next step.
    adopted_models : list of ModelRecord
        The patched models that were adopted.
    first_alarm : (int, dict) or None
        The step of the first alarm, and its notice.
    is_alarm_of_many : bool
        Whether several gauges explain the alarm clearly better than any single one.
    """

    threshold: float
    step: int = -1
    steps_to_search: tuple[int, int] | None = None
    verdict_on_trial: VerdictRecord | None = None
    pending_notices: list[JsonObject] = field(default_factory=list)
    adopted_models: list[ModelRecord] = field(default_factory=list)
    first_alarm: tuple[int, JsonObject] | None = None
    is_alarm_of_many: bool = False
    _current_alarm: tuple[int, int] | None = None  # its step, and the first step of the fault
    _next_search_step: int = 0  # no search begins before it
    _model_from_step: int = 0  # the first step of the model that is believed

    @property
    def has_alarm(self) -> bool:
        """Whether there is an alarm whose cause may be searched after later steps."""
        return self._current_alarm is not None

    def as_record(self) -> JsonObject:
        """Return the state with the keys of a journal."""
        return {key: getattr(self, attribute) for attribute, key in _KEYS.items()}

    def read_journal(self, path: Path) -> None:
        """Restore the state after the last line of a journal.

        Some lines contain the state before them, under `standing`. So the state is restored from
        the last of these lines, and then updated with this line and those after it. The lines in
        the last `CHECKED_BYTES` bytes are always read, to check that each begins at the byte at
        which it was written.

        Raises
        ------
        NotResumableError
            If the end of the journal was changed or is damaged.
        """
        lines_since_state: list[JsonObject] = []  # the last line first
        state_before: JsonObject | None = None
        journal_size = 0
        for line, begin, end in records_backwards(path):
            # The journal is read backwards: the first line that comes is the last one
            journal_size = journal_size or end
            is_header = begin == 0
            if not is_header and line["standing"]["begin"] != begin:
                raise damaged_line_error(
                    path, begin, "lines before it are missing, or belong to another journal"
                )
            if state_before is None:
                lines_since_state.append(line)
                state_before = line.get("standing", {}).get("teaching")
            if state_before is not None and journal_size - begin > CHECKED_BYTES:
                break
        # The state as `as_record` returned it; earlier versions have not recorded all of it.
        for attribute, key in _KEYS.items():
            if state_before is not None and key in state_before:
                setattr(self, attribute, state_before[key])
        for line in reversed(lines_since_state):
            self.take_line(line)

    def take_line(self, line: JsonRecord) -> None:
        """Update the state with the next line of the journal."""
        if "model" in line:
            self._take_model(line["model"])
        elif "verdict" in line:
            self._take_verdict(line["verdict"])
        elif "filtered" in line:
            self._take_step(line)

    def _take_model(self, model: ModelRecord) -> None:
        """Update the state with a patched model that was adopted."""
        self.adopted_models.append(model)
        self.steps_to_search = None
        self.verdict_on_trial = None
        self._current_alarm = None
        self._model_from_step = int(model["from_step"])
        if "notice" in model:
            self.pending_notices.append(model["notice"])
        # An alarm of the steps that were filtered again: the model lacks more than the patch.
        alarms = model.get("alarms", [])
        self.pending_notices += alarms
        self._note_alarms(alarms)

    def _take_step(self, line: JsonRecord) -> None:
        """Update the state with a step.

        Pending notices were given with this step; only further alarms count as new.
        """
        self.step = int(line["step"])
        pending_sentences = {notice["sentence"] for notice in self.pending_notices}
        new_notices = []
        for notice in line.get("notices", []):
            if notice["sentence"] not in pending_sentences:
                new_notices.append(notice)
        self.pending_notices = []
        self._note_alarms(new_notices)
        self._request_search_if_due(line.get("suspicion", {}))

    def _note_alarms(self, notices: Sequence[JsonObject]) -> None:
        """Record the alarms among notices; each delays the search by `SETTLE_STEPS` steps."""
        for notice in notices:
            if notice["kind"] == "alarm":
                self._current_alarm = (self.step, int(notice.get("since") or 0))
                self._next_search_step = self.step + SETTLE_STEPS
                self.first_alarm = self.first_alarm or (self.step, notice)

    def _request_search_if_due(self, suspicion: Mapping[str, float]) -> None:
        """Request a search for the cause of the alarm, if one is due.

        It is due if the alarm came at least `SETTLE_STEPS` steps ago, its evidence still exceeds
        the threshold, and neither another search nor the trial of a patch is running. `suspicion`
        has the log evidence [nats] of two hypotheses: that no state of the model explains the
        readings, and that one gauge alone is wrong.
        """
        is_busy = self.steps_to_search is not None or self.verdict_on_trial is not None
        if self._current_alarm is None or is_busy or self.step < self._next_search_step:
            return
        evidence_of_many = suspicion.get("log_evidence_none", -math.inf)
        evidence_of_one = suspicion.get("log_evidence_any_gauge", -math.inf)
        if max(evidence_of_many, evidence_of_one) >= math.log(self.threshold):
            self.is_alarm_of_many = evidence_of_many >= evidence_of_one + CLEARLY
            _, fault_step = self._current_alarm
            self.steps_to_search = (max(fault_step, self._model_from_step), self.step)

    def _take_verdict(self, verdict: VerdictRecord) -> None:
        """Update the state with a verdict, or with the end of the trial of its patch."""
        self.pending_notices.append(verdict["notice"])
        self.steps_to_search = None
        if verdict["tried"]:
            self.verdict_on_trial = verdict
            return
        self.verdict_on_trial = None
        # No patch is tried: search again once there are twice as many steps since the alarm
        if self._current_alarm is not None:
            alarm_step, _ = self._current_alarm
            last_searched = int(verdict["to_step"])
            more_steps = max(SETTLE_STEPS, last_searched - alarm_step)
            self._next_search_step = last_searched + more_steps
