"""A patch beside what a watch believes: the patched model, its turns filtered again, and what that gains.

All of it follows from a journal up to one of its lines, so that it may be worked out beside the watch,
which goes on.
"""

import os
import subprocess
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import Any

import numpy as np

from fe.runtime.errors import FiniteElementError
from fmu_asset.errors import FmuError
from reporting.progress import Progress, SilentProgress
from twin_master.assets.asset_source import AssetSource
from twin_master.assets.design_source import DesignBelief
from twin_master.errors import MissionInputError, TwinMasterError
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.mission.replay import BelievedModel, gap_of, replay
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state
from twin_master.store.summary import policy_switch

COURTESY = 10
"""Niceness of what is worked out beside a watch: the watch comes first."""
CANNOT = (TwinMasterError, FmuError, FiniteElementError)
"""Why a twin cannot believe a patch."""


@dataclass(frozen=True)
class Trial:
    """What is asked.

    Attributes
    ----------
    journal : Path
    end : int
        Bytes of it that are read.
    scenario : Scenario
    models : tuple of BelievedModel
        What was believed so far.
    patch : bytes
        Content of the patch file that would be believed, with what is believed already.
    from_turn : int
        From which on.
    compared : tuple of int
        The first turn whose evidence is compared, and how many.
    """

    journal: Path
    end: int
    scenario: Scenario
    models: tuple[BelievedModel, ...]
    patch: bytes
    from_turn: int
    compared: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Outcome:
    """What came of it.

    Attributes
    ----------
    trial : Trial
    model : BelievedModel
        The patched one.
    gained : float
        Log evidence of the turns that were compared, with the patch less without [nats].
    before, after : mapping
        The gap of the turns from `trial.from_turn` on, see `gap_of`.
    policy_change : str
        How the policy changes, in a sentence; empty where it stays.
    """

    trial: Trial
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
    source.check()
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        source.prepare(Path(folder), progress or SilentProgress())
        return BelievedModel(from_turn, prepare_knowledge(scenario, source, scenario.mission.seed))


def judged(trial: Trial, progress: Progress | None = None) -> Outcome:
    """Return what comes of a patch.

    Raises
    ------
    TwinMasterError, FmuError, FiniteElementError
        The twin cannot believe it.
    """
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        file = Path(folder) / "patch.json"
        file.write_bytes(trial.patch)
        model = patched_model(trial.scenario, file, trial.from_turn, progress)
    first, (begin, count) = trial.from_turn, trial.compared
    wanted = min(first, begin) if count else first
    before, after = (
        replay(
            trial.journal, trial.models, trial.scenario.watch.lag, first_turn=wanted, end=trial.end,
            question=question,
        )[0]
        for question in (None, model)
    )  # fmt: skip
    known = trial.models[-1].knowledge
    compared = [
        sum(turn.concluded.log_evidence for turn in found.turns[begin - found.first_turn :][:count])
        for found in (before, after)
    ]
    return Outcome(
        trial=trial,
        model=model,
        gained=float(compared[1] - compared[0]),
        before=gap_of(before, first - before.first_turn, known.sensor_model),
        after=gap_of(after, first - after.first_turn, model.knowledge.sensor_model),
        policy_change=policy_change(known, model.knowledge),
    )


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


class Errand:
    """A process beside a watch, that no key of its terminal ends, and that leaves a file as its answer."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def answered(self, answer: Path, log: Path, command: Sequence[str], *, waited_for: bool = False) -> bool:
        """Return whether the answer is there; begin the process where it is neither there nor under way.

        Parameters
        ----------
        answer, log
            The file that the process leaves, and where what it says goes.
        command
            Its words.
        waited_for
            Whether it has the priority of the watch.

        Raises
        ------
        TwinMasterError
            It ended without an answer: the last line that it said, or else its exit code.
        """
        if answer.is_file():
            self.end()
            return True
        if self._process is None:
            with log.open("wb") as file:
                self._process = subprocess.Popen(
                    [*command], stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True
                )
            if not waited_for:
                with suppress(ProcessLookupError):
                    os.setpriority(os.PRIO_PROCESS, self._process.pid, COURTESY)
        elif (code := self._process.poll()) is not None and not answer.is_file():
            self._process = None
            lines = log.read_text(encoding="utf-8", errors="replace").split("\n")
            said = (line.strip() for line in reversed(lines) if line.strip())
            raise TwinMasterError(next(said, f"exit code {code}"))
        return False

    def end(self) -> None:
        """End the process, if there is one; a watch that is taken up again begins it anew."""
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._process.wait()
        self._process = None


class Judge:
    """Works out what comes of a patch: at once, or in a thread beside a live watch.

    Parameters
    ----------
    wait : bool
        Whether turns wait for it, as those of a recording do.
    """

    def __init__(self, *, wait: bool) -> None:
        self._wait = wait
        self._found: Future[Outcome] | None = None

    def outcome(self, asked: Callable[[], Trial]) -> Outcome | None:
        """Return what came of the patch; None while it is worked out, of what was asked first.

        Raises
        ------
        TwinMasterError, FmuError, FiniteElementError
            This twin cannot believe it, see `CANNOT`.
        """
        if self._wait:
            return judged(asked())
        if self._found is None:
            self._found = Future()
            Thread(target=_work, args=(asked(), self._found), daemon=True).start()
        if not self._found.done():
            return None
        found, self._found = self._found, None
        return found.result()

    @property
    def answered(self) -> bool:
        """Whether it is worked out."""
        return self._found is not None and self._found.done()


def _work(trial: Trial, found: "Future[Outcome]") -> None:
    try:
        found.set_result(judged(trial))
    except BaseException as error:  # noqa: BLE001 - it is raised where it is asked for
        found.set_exception(error)
