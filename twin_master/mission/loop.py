"""The one loop: a source gives observations, the twin decides; and a mission, resumable at any turn."""

import base64
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Protocol

from reporting.progress import Progress, SilentProgress
from twin_master.errors import ImpossibleObservation, InvalidObservationError, TwinMasterError
from twin_master.mission.journal import JournalFile, damaged, records_backwards, turn_record
from twin_master.mission.preparation import Knowledge
from twin_master.mission.replay import BelievedModel, replay
from twin_master.mission.truth import Plant
from twin_master.mission.turns import History, Reading, Turn
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


def fly(
    scenario: Scenario,
    twin: Twin,
    plant: Plant,
    *sinks: Callable[[Turn], None],
    history: History | None = None,
    progress: Progress | None = None,
) -> History:
    """Fly a mission, or the rest of one; an asset that ends its simulation ends the mission, and is a notice.

    Parameters
    ----------
    scenario : Scenario
    twin : Twin
    plant : Plant
        The asset and its truth, where the twin is.
    *sinks : callable
        As of `operate`.
    history : History, optional
        Takes in the turns; what it has is there also where an error ends the flight.
    progress : Progress, optional

    Raises
    ------
    MissionError, ImpossibleObservation, FmuError, FiniteElementError
        The mission cannot be flown on.
    """
    history = history or History(twin, scenario.observation.count)
    history.resumed_at = twin.turns
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


STATE_ALLOWANCE = 64_000_000
STATE_SHARE = 4_000
"""Bytes of asset states that a checkpoint may hold, and how many more for each turn.

States that need more are kept less often, so that the file grows with the turns and not with their square
(an asset that is replayed keeps the inputs of all its steps); the turns after the last one are flown again.
"""


def taken_up(journal: JournalFile, knowledge: Knowledge, plant: Plant) -> History:
    """Return what an earlier process flew, with plant and journal where it stopped.

    Turns behind the last saved state of the asset are flown again.

    Raises
    ------
    NotResumableError
        The journal is damaged, or the twin decides otherwise than an earlier process did.
    """
    for record, begin, end in records_backwards(journal.path):
        if not begin or record.get("asset_state") is not None:
            journal.truncate(end)
            state = record.get("asset_state", "")
            break
    history, _ = replay(journal.path, [BelievedModel(0, knowledge)], None)
    if history.turns:
        try:
            plant.restore(history, zlib.decompress(base64.b64decode(state)))
        except (TypeError, ValueError, zlib.error) as error:
            raise damaged(journal.path, begin, f"it has another layout, {error}") from error
    return history


def kept_in(journal: JournalFile, plant: Plant) -> Callable[[Turn], None]:
    """Return a sink that writes turns into a journal, with the state of the asset as often as it may.

    What a kill cuts off, or has no state of the asset behind it, is flown again to the same bits.
    """
    since = 0

    def keep(turn: Turn) -> None:
        nonlocal since
        since += 1
        state: str | None = base64.b64encode(zlib.compress(plant.save_state(), 1)).decode("ascii")
        if journal.size + len(state or "") > STATE_ALLOWANCE and len(state or "") > STATE_SHARE * since:
            state = None
        journal.append(turn_record(turn) | {"asset_state": state})
        since *= state is None

    return keep
