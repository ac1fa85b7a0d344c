"""The one loop: a source gives observations, the twin decides; and a mission, resumable at any turn."""

import base64
import binascii
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from reporting.progress import Progress, SilentProgress
from twin_master.errors import (
    ImpossibleObservation,
    InvalidObservationError,
    NotResumableError,
    TwinMasterError,
)
from twin_master.mission.journal import (
    JOURNAL_NAME,
    JournalFile,
    array_of,
    belief_record,
    damaged,
    line_of,
    plain,
    records,
)
from twin_master.mission.truth import Plant
from twin_master.mission.turns import Happened, History, Reading, Turn
from twin_master.network.estimator import Notice
from twin_master.network.twin import Twin, TwinTurn
from twin_master.scenario.schema import Scenario


class Source(Protocol):
    """Where observations come from: a simulated asset, a file, a broker."""

    def read(self, twin: Twin) -> Reading | None:
        """Return the next observation of what the twin watches; None where there are no more."""

    def impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        """Return what is assimilated in the place of one that no state allows, or that has no weight."""


def operate(twin: Twin, source: Source, *sinks: Callable[[Turn], None]) -> Iterator[Turn]:
    """Let a twin assimilate and decide until its source ends; each turn is kept before it is given.

    Parameters
    ----------
    twin : Twin
    source : Source
        Asked for the next observation when the turn before it was taken in.
    *sinks : callable
        Told each turn, one after the other: a journal, a history.
    """
    while True:
        begin = time.perf_counter()
        reading = source.read(twin)
        if reading is None:
            return
        received = time.perf_counter()
        try:
            concluded = _assimilated(twin, reading)
        except (ImpossibleObservation, InvalidObservationError) as error:
            reading = source.impossible(reading, error)
            concluded = _assimilated(twin, reading)
        decided = time.perf_counter()
        turn = Turn(reading, concluded)
        for sink in sinks:
            sink(turn)
        kept = time.perf_counter()
        yield replace(turn, seconds=(received - begin, decided - received, kept - decided))


def _assimilated(twin: Twin, reading: Reading) -> TwinTurn:
    if reading.revises is not None:
        return twin.revise(reading.revises, reading.observed, reading.control)
    return twin.turn(reading.observed, reading.control)


class Checkpoint(NamedTuple):
    """Where an earlier process stopped: what came and what was decided in each turn, and the asset."""

    readings: Sequence[Reading]
    decided: Sequence[int]
    asset_state: bytes


def fly(
    scenario: Scenario,
    twin: Twin,
    plant: Plant,
    *,
    checkpoint: Checkpoint | None = None,
    keep: Callable[[Turn, bytes], None] | None = None,
    progress: Progress | None = None,
    history: History | None = None,
) -> History:
    """Fly a mission, or the rest of one; an asset that ends its simulation ends the mission, and is a notice.

    Parameters
    ----------
    scenario : Scenario
    twin : Twin
        Which has seen nothing yet.
    plant : Plant
        The asset and its truth, at their start.
    checkpoint : Checkpoint, optional
        Where an earlier process stopped.
    keep : callable, optional
        Told each turn, and the state of the asset behind it.
    progress : Progress, optional
    history : History, optional
        Takes in the turns; what it has is there also where an error ends the flight.

    Raises
    ------
    NotResumableError
        The twin decides otherwise than an earlier process did.
    MissionError, ImpossibleObservation, FmuError, FiniteElementError
        The mission cannot be flown on.
    """
    history = history or History(twin, scenario.observation.count)
    if checkpoint is not None:
        _replay(history, checkpoint)
        plant.restore(checkpoint.readings, checkpoint.asset_state)
    history.resumed_at = twin.turns
    sinks = [] if keep is None else [lambda turn: keep(turn, plant.save_state())]
    unit = f"{scenario.mission.step_name}s"
    with (progress or SilentProgress()).stage("Flying", total=scenario.mission.steps, unit=unit) as stage:
        stage.advance(twin.turns)
        for turn in operate(twin, plant, *sinks):
            history.add(turn)
            stage.advance(detail=scenario.control_names[turn.concluded.control_index])
    if plant.ended:
        history.ended = ended_sentence(scenario, twin.turns, plant.ended)
        history.notices.append((twin.turns - 1, Notice("ended", history.ended)))
    return history


def ended_sentence(scenario: Scenario, turns: int, how: str) -> str:
    """Return that an asset has ended its simulation after some turns of a mission."""
    steps, unit = scenario.mission.steps, scenario.mission.step_name
    return f"The asset ended the mission after {turns} of {steps} {unit}s: {how}"


def _replay(history: History, checkpoint: Checkpoint) -> None:
    """Let the twin see again what was observed, and check that it decides as it did."""
    for step, (reading, decided) in enumerate(zip(checkpoint.readings, checkpoint.decided, strict=True)):
        turn = Turn(reading, _assimilated(history.twin, reading))
        if turn.concluded.next_control != decided:
            raise NotResumableError(
                f"the journal decided otherwise after turn {step} than this version does: "
                "fly the mission again with --replace."
            )
        history.add(turn)


STATE_ALLOWANCE = 64_000_000
STATE_SHARE = 4_000
"""Bytes of asset states that a checkpoint may hold, and how many more for each turn.

States that need more are kept less often, so that the file grows with the turns and not with their square
(an asset that is replayed keeps the inputs of all its steps); the turns after the last one are flown again.
"""


class CheckpointFile(JournalFile):
    """The checkpoint of a run folder, open to be continued.

    Attributes
    ----------
    checkpoint : Checkpoint or None
        Where an earlier process stopped; None if no turn was finished.
    turns : int
        Turns in the file.
    """

    def __init__(self, folder: Path, config_hash: str) -> None:
        path = folder / JOURNAL_NAME
        readings: list[Reading] = []
        decided: list[int] = []
        whole, state, size, place, end = 0, "", 0, 0, len(line_of({"config_hash": config_hash}))
        self._state_bytes = 0
        for record, begin, behind in records(path, config_hash=config_hash):
            if record.get("turn") != len(readings):
                raise damaged(path, begin, f"turn {len(readings)} was expected")
            try:
                readings.append(_reading(record))
                decided.append(int(record["next_control"]))
                size += len(record["asset_state"] or "")
            except (KeyError, TypeError, ValueError, AttributeError) as error:
                raise damaged(path, begin, f"it has another layout, {error}") from error
            if record["asset_state"] is not None:
                whole, state, self._state_bytes = len(readings), record["asset_state"], size
                place, end = begin, behind
        try:
            content = zlib.decompress(base64.b64decode(state)) if whole else b""
        except (TypeError, ValueError, zlib.error, binascii.Error) as error:
            raise damaged(path, place, f"it has another layout, {error}") from error
        self.turns = whole
        self.checkpoint = Checkpoint(readings[:whole], decided[:whole], content) if whole else None
        super().__init__(folder, config_hash)
        if whole < len(readings):  # without the state of the asset they are flown again
            self.truncate(end)

    def keep(self, turn: Turn, asset_state: bytes) -> None:
        """Add a turn; it is on the disk when this returns.

        Raises
        ------
        FileNotWrittenError
            The disk is full or the folder cannot be written; the turns before are still there.
        """
        happened = turn.reading.happened
        assert happened is not None  # of a simulated asset
        self.turns += 1
        state: str | None = base64.b64encode(zlib.compress(asset_state, 1)).decode("ascii")
        if self._state_bytes + len(state or "") > STATE_ALLOWANCE + STATE_SHARE * self.turns:
            state = None
        self._state_bytes += len(state or "")
        self.append(
            {
                "turn": self.turns - 1,
                "control_index": turn.concluded.control_index,
                "next_control": turn.concluded.next_control,
                "observed": plain(turn.reading.observed),
                "state": plain(happened.state),
                "observation": plain(happened.observation),
                "monitors": dict(zip(happened.monitors, plain([*happened.monitors.values()]), strict=True)),
                "asset_state": state,
                **belief_record(turn.concluded),
            }
        )


def _reading(record: dict[str, Any]) -> Reading:
    monitors = record["monitors"]
    told = dict(zip(monitors, array_of(list(monitors.values())).tolist(), strict=True))
    happened = Happened(array_of(record["state"]), array_of(record["observation"]), told)
    return Reading(array_of(record["observed"]), int(record["control_index"]), happened=happened)
