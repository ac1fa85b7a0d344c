"""The one loop of missions and watches: a source gives observations, the twin assimilates and decides."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

from reporting.progress import Progress, SilentProgress
from twin_master.errors import (
    ImpossibleObservation,
    InvalidObservationError,
    NotResumableError,
    TwinMasterError,
)
from twin_master.mission.plant import Plant
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
