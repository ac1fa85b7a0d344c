"""What teaches a watch between two of its steps: it has the cause looked for, tries a patch, and adopts it.

The search for the cause is a process of its own, of low priority beside a live watch: the very command that
the alarm names. Its verdict is a line of the journal behind the step in which it came.
"""

import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from fe.runtime.patch import SensorSaturation
from reporting.errors import DamagedFileError
from reporting.json_file import read_json
from twin_master.network.estimator import Notice
from twin_master.run_folder import PATCH, TEACHING, VERDICT
from twin_master.watch.folder import Watch
from twin_master.watch.teaching import CANNOT, Outcome

TRIAL_STEPS = 10
"""Steps behind a verdict, none of which it has seen, in which model and patched model are compared."""
LEAST_GAIN = 3.0
"""Evidence of these steps from which on a patch is adopted [nats]: as much as a name needs in the search."""
GROUP = "group"
TRIED = ("named", "named in part", GROUP)
"""Verdicts whose patch is tried; that of a group is its most probable member. All members explain the gap
alike, so that the state is estimated alike whichever is true; steps that none has seen must bear it out. A
group of which some members saturate is not tried: they agree at the loads of the search, and at no other."""
ABSOLUTE_FIT = "absolute fit"
"""Gate of a verdict that says whether what is named leaves noise alone."""
SEARCH = (sys.executable, "-m", "uav_twin", "discrepancy", "run")
"""The command that looks for the cause of an alarm."""
COURTESY = 10
"""Niceness of a search beside a live watch: the watch comes first."""
_LOOK_AGAIN = 0.05


class Tutor:
    """Asks, tries and adopts between two steps of a watch.

    Parameters
    ----------
    watch : Watch
    wait : bool
        Whether the next step waits for an answer, as those of a recording do. Those of a live watch go on
        beside a process that searches and a thread that tries a patch.
    command : sequence of str
        What begins with a search.

    Attributes
    ----------
    outcome : Future or None
        What comes of the patch that is tried.
    """

    def __init__(self, watch: Watch, *, wait: bool, command: Sequence[str] = SEARCH) -> None:
        self._watch, self._wait, self._command = watch, wait, command
        self._search: subprocess.Popen[bytes] | None = None
        self.outcome: Future[Outcome] | None = None

    def act(self) -> None:
        """Do what is due behind the last step of the watch, which has begun."""
        watch, teaching, step = self._watch, self._watch.teaching, self._watch.scenario.mission.step_name
        if teaching.question is not None:
            first, last = teaching.question
            folder = watch.folder / TEACHING / f"steps_{first}_to_{last}"
            log = folder.with_name(folder.name + ".log")
            if self._searched(folder, log, ["--from-step", str(first), "--to-step", str(last)]):
                found = verdict_of(folder, log, first, last, step)
                watch.write(verdict={"step": teaching.step, "of_many": teaching.of_many, **found})
        if teaching.trial is not None and teaching.step >= teaching.trial["step"] + TRIAL_STEPS:
            self._judge(teaching.trial, step)

    def _searched(self, folder: Path, log: Path, steps: Sequence[str]) -> bool:
        """Return whether the search that fills a folder with a verdict has ended; begin it if there is none.

        No key of the terminal ends the process; where steps do not wait for it, it has a low priority.
        """
        log.parent.mkdir(exist_ok=True)
        while not (folder / VERDICT).is_file():
            if self._search is None:
                run, seed = str(self._watch.folder), str(self._watch.scenario.mission.seed)
                words = ["--from-run", run, *steps, "--out", str(folder), "--seed", seed]
                with log.open("wb") as file:
                    self._search = subprocess.Popen(
                        [*self._command, *words],
                        stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True,
                    )  # fmt: skip
                if not self._wait:
                    with suppress(ProcessLookupError):
                        os.setpriority(os.PRIO_PROCESS, self._search.pid, COURTESY)
            elif self._search.poll() is not None:
                break
            if not self._wait or self._watch.intake.asked:
                return False
            time.sleep(_LOOK_AGAIN)
        self.close()
        return True

    def _judge(self, trial: dict[str, Any], step: str) -> None:
        """Adopt the patch of a trial that has all of its steps, or say why not, once that is known."""
        watch = self._watch
        if self.outcome is None:
            file, compared = watch.folder / trial["folder"] / PATCH, (trial["step"] + 1, TRIAL_STEPS)
            worker = ThreadPoolExecutor(1)
            self.outcome = worker.submit(watch.trial(file, trial["from_step"], compared))
            worker.shutdown(wait=self._wait)
        if not self.outcome.done():
            return
        asked, self.outcome, outcome = self.outcome, None, None
        try:
            outcome = asked.result()
            sentence = trial_sentence(trial, outcome, step)
        except CANNOT as error:
            sentence = f"The patch cannot be believed by this twin: {error}"
        notice = Notice("trial", sentence).as_record()
        if outcome is not None and is_adopted(trial, outcome):
            watch.adopt(outcome, notice)
        else:
            watch.write(verdict={**trial, "tried": False, "notice": notice})

    def close(self) -> None:
        """End the search, if there is one; a watch that is taken up again begins it anew."""
        if self._search is not None and self._search.poll() is None:
            self._search.terminate()
            self._search.wait()
        self._search = None


def verdict_of(folder: Path, log: Path, first: int, last: int, step: str) -> dict[str, Any]:
    """Return what the journal keeps of a verdict, and what the operator is told.

    Parameters
    ----------
    folder : Path
        Where the verdict is; in the folder of verdicts of the watch.
    log : Path
        What the search said, where there is none.
    first, last : int
        The steps that were searched.
    step : str
        What a step is called.
    """
    try:
        verdict = read_json(folder / VERDICT, DamagedFileError)["verdict"]
        kind, told = str(verdict["kind"]), f": {verdict['kind']}. {verdict['sentence']}"
        caveats = caveats_of(verdict)
    except (DamagedFileError, KeyError, TypeError) as error:
        lines = [str(error), *log.read_text(encoding="utf-8", errors="replace").split("\n")]
        *_, said = (line.strip() for line in lines if line.strip())
        kind, told = "none", f", and the search ended without a verdict: {said}"
        caveats = []
    patch, place = folder / PATCH, f"{TEACHING}/{folder.name}"
    tried = kind in TRIED and patch.is_file() and not caveats
    sentence = f"{step.capitalize()}s {first} to {last} were searched for the cause{told}"
    if kind in TRIED:
        sentence = " ".join([sentence, *(caveat for caveat in caveats if caveat not in sentence)])
    if tried:
        which = "patch of the most probable of these" if kind == GROUP else "patch"
        sentence += f" The {which} is tried beside the model for {TRIAL_STEPS} {step}s."
    elif patch.is_file():
        sentence += f" To believe it none the less: {command_to_believe(place, first)}"
    return {
        "from_step": first, "to_step": last, "tried": tried, "kind": kind, "folder": place,
        "notice": Notice("verdict", sentence).as_record(),
    }  # fmt: skip


def caveats_of(verdict: Mapping[str, Any]) -> list[str]:
    """Return why the patch of a verdict is not to be tried: a name needs an absolute fit.

    Parameters
    ----------
    verdict : dict
        As `verdict.json` has it.

    Returns
    -------
    list of str
        The reasons of the gates that failed, of an absolute fit that was not tested, and of a group whose
        members differ at other loads; empty where none.
    """
    gates = verdict["gates"]
    caveats = [str(gate["reason"]) for gate in gates if gate["passed"] is False]
    tested = [gate for gate in gates if gate["name"] == ABSOLUTE_FIT and gate["passed"] is not None]
    if not tested:
        caveats.append("Whether it leaves noise alone was not tested.")
    if verdict["kind"] == GROUP and has_some_saturating_members(verdict):
        caveats.append(
            "A sensor that saturates and the other effects of the group differ at other loads, and these "
            "steps do not tell them apart; more steps at more than one load may."
        )
    return caveats


def has_some_saturating_members(verdict: Mapping[str, Any]) -> bool:
    """Return whether some effects of a group are sensors that saturate, and others are not."""
    kinds_of_effects = [{item["kind"] for item in effect["patch"]} for effect in verdict["effects"]]
    saturating = [SensorSaturation.kind in kinds for kinds in kinds_of_effects]
    return any(saturating) and not all(saturating)


def command_to_believe(place: str, first: int) -> str:
    """Return the command that believes the patch in a folder of a watch from a step on."""
    return f"uav-twin watch --resume --out DIR --model-patch DIR/{place}/{PATCH} --from-step {first}"


def is_adopted(trial: Mapping[str, Any], outcome: Outcome) -> bool:
    """Return whether a patch is believed after its trial.

    After an alarm of many gauges none is: what is named then is the effect of the catalogue that comes
    closest, and any that moves all gauges gains evidence over a model that explains none.
    """
    return outcome.gained >= LEAST_GAIN and not trial.get("of_many", False)


def trial_sentence(trial: Mapping[str, Any], outcome: Outcome, step: str) -> str:
    """Return what the operator is told at the end of a trial."""
    first = trial["from_step"]
    compared = (
        f"Beside the model for {TRIAL_STEPS} {step}s the patch gained {outcome.gained:.3g} nats of evidence"
    )
    if outcome.gained < LEAST_GAIN:
        return f"{compared}, {LEAST_GAIN:g} are needed, and is not adopted."
    if not is_adopted(trial, outcome):
        return (
            f"{compared}, and is not adopted from its name alone, because many gauges raised the alarm: any "
            "effect that moves all of them explains more than the model does. Look at the asset first. To "
            f"believe it: {command_to_believe(trial['folder'], first)}"
        )
    said = f"{compared}: it is believed from {step} {first} on, and these {step}s were filtered anew."
    if trial["kind"] == GROUP:
        said += " It is one of a group: which of them is true these data cannot tell."
    return f"{said} {outcome.record['policy_change']}".rstrip()
