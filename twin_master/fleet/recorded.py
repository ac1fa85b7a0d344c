"""Twins of real assets: what was recorded is assimilated again, as a watch does it."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from twin_master.mission.loop import operate
from twin_master.mission.preparation import Knowledge
from twin_master.mission.side_by_side import IN_FLIGHT, Flights
from twin_master.mission.turns import History, Reading, Turn
from twin_master.network.estimator import Notice
from twin_master.scenario.schema import Scenario
from twin_master.watch.feeds import Fed, file_feed
from twin_master.watch.growing import Place
from twin_master.watch.intake import Intake, LiveFeed, RejectedFile

__all__ = ["assimilated", "read_recording"]


def read_recording(path: Path, scenario: Scenario) -> tuple[Fed, ...]:
    """Return the messages of a recording.

    Raises
    ------
    MissionInputError
        It cannot be read, or is of another asset.
    """
    return tuple(file_feed(path, scenario).messages(None))


class _Recorded(LiveFeed):
    """Messages as a feed."""

    def __init__(self, messages: Sequence[Fed]) -> None:
        self._messages = messages

    def messages(self, place: Place | None) -> Iterator[Fed]:
        return iter(self._messages)


def assimilated(knowledge: Knowledge, recordings: Sequence[Sequence[Fed]]) -> Flights:
    """Return what B twins conclude of B recordings: beliefs and controls are those of a watch of each."""
    flights, most = Flights.empty(knowledge, len(recordings)), knowledge.scenario.mission.steps
    for number, messages in enumerate(recordings):
        try:
            history = _history(knowledge, messages)
        except IN_FLIGHT as error:
            flights.failure[number] = str(error)
            continue
        turns = len(history.turns)
        if not turns:
            flights.failure[number] = "its recording has no turn yet."
        elif turns > most:
            flights.failure[number] = (
                f"it has {turns} turns, and {most} at most are flown: set `steps` of the group."
            )
        else:
            flights.put(number, history)
    return flights


def _history(knowledge: Knowledge, messages: Sequence[Fed]) -> History:
    scenario = knowledge.scenario
    twin = knowledge.twin(lag=scenario.watch.lag)
    history = History(twin, scenario.observation.count)
    intake, seen, late = Intake(scenario, _Recorded(messages), RejectedFile(None)), {}, False
    lost: list[tuple[int, Notice]] = []
    for turn in operate(twin, intake, history.add):
        at = intake.observation_turn
        seen[at] = turn.reading.observed, twin.control_of(at)
        late |= turn.reading.revises is not None
        lost += [(at, notice) for notice in intake.notices]
    if late:
        twin = knowledge.twin()
        history = History(twin, scenario.observation.count)
        for at in sorted(seen):
            history.add(Turn(Reading(*seen[at]), twin.turn(*seen[at])))
    history.notices += lost
    return history
