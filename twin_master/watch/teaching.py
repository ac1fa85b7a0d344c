"""Teaching: from an alarm to a verdict on what the model lacks, to a trial of its patch, to its adoption.

What is asked when is a pure function of the journal (`Teaching`), so that a watch that was killed and taken
up again asks, tries and adopts the same. The search for the cause is a process of its own, of low priority
beside a live watch: the very command that the alarm names. Its verdict is a line of the journal behind the
turn in which it came.
"""

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from reporting.errors import DamagedFileError
from reporting.json_file import read_json
from twin_master.errors import MissionInputError, TwinMasterError
from twin_master.mission.journal import damaged, records_backwards
from twin_master.network.estimator import Notice
from twin_master.run_folder import PATCH, TEACHING, VERDICT
from twin_master.scenario.schema import Scenario
from twin_master.sentences import said
from twin_master.watch.trial import Outcome

SETTLE_TURNS = 10
"""Turns that an alarm must hold before its cause is looked for; they also show what it is."""
TRIAL_TURNS = 10
"""Turns behind a verdict, none of which it has seen, in which model and patched model are compared."""
LEAST_GAIN = 3.0
"""Evidence of these turns from which on a patch is adopted [nats]: as much as a name needs in the search."""
GROUP = "group"
TRIED = ("named", "named in part", GROUP)
"""Verdicts whose patch is tried; that of a group is its most probable member. All members explain the gap
alike, so that the state is estimated alike whichever is true; turns that none has seen must bear it out."""
CHECKED = 250_000
"""Bytes at the end of a journal that are read at least, so that damage there is found."""
COURTESY = 10
"""Niceness of a search beside a live watch: the watch comes first."""
_LOOK_AGAIN = 0.05


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


class Question(NamedTuple):
    """What is asked: which effect the turns `from_turn` to `to_turn` hold that the model lacks."""

    from_turn: int
    to_turn: int

    def folder(self, watch: Path) -> Path:
        """Return where the verdict is put."""
        return watch / TEACHING / f"turns_{self.from_turn}_to_{self.to_turn}"


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
    question : Question or None
        What is to be answered.
    trial : dict or None
        The verdict whose patch is on trial.
    untold : list
        Notices that go with the next turn.
    adopted : list of dict
        The models that were adopted, as the journal has them.
    """

    threshold: float
    turn: int = -1
    question: Question | None = None
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
            before = last["standing"]["teaching"]
            vars(self).update(before, question=before["question"] and Question(*before["question"]))
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
            self.question = Question(max(self._alarm[1], self._since), self.turn)

    def _verdict(self, verdict: dict[str, Any]) -> None:
        self.untold.append(verdict["notice"])
        if verdict["tried"]:
            self.trial, self.question = verdict, None
            return
        # More turns may tell what these could not: asked again with twice as many behind the alarm.
        asked, self.question, self.trial = int(verdict["to_turn"]), None, None
        if self._alarm is not None:
            self._ask_at = asked + max(SETTLE_TURNS, asked - self._alarm[0])


@dataclass
class Search:
    """The search for a cause, as a process.

    Parameters
    ----------
    watch : Path
        Folder of the watch.
    seed : int
        Of its draws.
    command : sequence of str
        What begins with a search; by default this package's `discrepancy run`.
    """

    watch: Path
    seed: int
    command: Sequence[str] = (sys.executable, "-m", "uav_twin", "discrepancy", "run")
    _process: "subprocess.Popen[bytes] | None" = field(default=None, init=False)

    def words(self, question: Question) -> list[str]:
        """Return the options of the command that answers a question."""
        turns = ["--from-turn", str(question.from_turn), "--to-turn", str(question.to_turn)]
        out = ["--out", str(question.folder(self.watch)), "--seed", str(self.seed)]
        return ["--from-run", str(self.watch), *turns, *out]

    def answer(
        self, question: Question, wait: bool, asked_to_end: Callable[[], bool]
    ) -> Path | TwinMasterError | None:
        """Return the folder of the verdict, or the last that a search without one said; None before.

        No key of the terminal ends the process; where turns do not wait for it, it has a low priority.
        """
        folder = question.folder(self.watch)
        log = folder.with_name(folder.name + ".log")
        log.parent.mkdir(exist_ok=True)
        while not (folder / VERDICT).is_file():
            if self._process is None:
                words = [*self.command, *self.words(question)]
                with log.open("wb") as file:
                    self._process = subprocess.Popen(
                        words, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True
                    )
                if not wait:
                    with suppress(ProcessLookupError):
                        os.setpriority(os.PRIO_PROCESS, self._process.pid, COURTESY)
            elif (code := self._process.poll()) is not None and not (folder / VERDICT).is_file():
                self._process = None
                lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
                said = (line.strip() for line in reversed(lines) if line.strip())
                return TwinMasterError(next(said, f"exit code {code}"))
            if not wait or asked_to_end():
                return None
            time.sleep(_LOOK_AGAIN)
        self.end()
        return folder

    def end(self) -> None:
        """End the process, if there is one; a watch that is taken up again begins it anew."""
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._process.wait()
        self._process = None


def verdict_of(
    watch: Path, question: Question, folder: Path | TwinMasterError, turn: int, step: str
) -> dict[str, Any]:
    """Return what the journal keeps of a verdict, and what the operator is told.

    Parameters
    ----------
    watch : Path
        Folder of the watch.
    question : Question
    folder : Path or TwinMasterError
        Where the verdict is, or why there is none.
    turn : int
        The last turn before it came.
    step : str
        What a turn is called.
    """
    asked = {"from_turn": question.from_turn, "to_turn": question.to_turn, "turn": turn}
    where = f"{step.capitalize()}s {question.from_turn} to {question.to_turn} were searched for the cause"
    if isinstance(folder, TwinMasterError):
        sentence = f"{where}, and the search ended without a verdict: {folder}"
        return {**asked, "tried": False, "kind": "none", "notice": Notice("verdict", sentence).as_record()}
    try:
        verdict = read_json(folder / VERDICT, DamagedFileError)["verdict"]
        kind, said = str(verdict["kind"]), str(verdict["sentence"])
    except (DamagedFileError, KeyError, TypeError) as error:
        return verdict_of(watch, question, TwinMasterError(f"{folder.name}: {error}"), turn, step)
    tried, patch = kind in TRIED and (folder / PATCH).is_file(), folder / PATCH
    sentence = f"{where}: {kind}. {said}"
    if tried:
        which = "patch of the most probable of these" if kind == GROUP else "patch"
        sentence += f" The {which} is tried beside the model for {TRIAL_TURNS} {step}s."
    elif patch.is_file():
        options = f"--model-patch DIR/{patch.relative_to(watch)} --from-turn {question.from_turn}"
        sentence += f" To believe it none the less: uav-twin watch --resume --out DIR {options}"
    return {
        **asked, "tried": tried, "kind": kind, "folder": folder.relative_to(watch).as_posix(),
        "notice": Notice("verdict", sentence).as_record(),
    }  # fmt: skip


def trial_sentence(trial: Mapping[str, Any], outcome: Outcome, step: str) -> str:
    """Return what the operator is told at the end of a trial."""
    first = trial["from_turn"]
    compared = (
        f"Beside the model for {TRIAL_TURNS} {step}s the patch gained {outcome.gained:.3g} nats of evidence"
    )
    if outcome.gained < LEAST_GAIN:
        return f"{compared}, {LEAST_GAIN:g} are needed, and is not adopted."
    said = f"{compared}: it is believed from {step} {first} on, and these {step}s were filtered anew."
    if trial["kind"] == GROUP:
        said += " It is one of a group: which of them is true these data cannot tell."
    return f"{said} {outcome.policy_change}".rstrip()


def both_patches(before: Path | None, found: Path) -> bytes:
    """Return the patch that the model has and the one that was found beside it, as one file."""
    if before is None:
        return found.read_bytes()
    old, new = (json.loads(file.read_text(encoding="utf-8")) for file in (before, found))
    effects, channels = old["effects"] + new["effects"], old.get("channels", {}) | new.get("channels", {})
    text = json.dumps({"schema": new["schema"], "effects": effects, "channels": channels}, indent=1)
    return (text + "\n").encode()
