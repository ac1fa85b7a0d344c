"""Twins of real assets: what was recorded is assimilated again, as a watch does it."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from twin_master.mission.loop import Beliefs, operate
from twin_master.mission.preparation import Knowledge
from twin_master.mission.side_by_side import IN_FLIGHT, Flights
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
    """Return what B twins conclude of B recordings: beliefs and controls are those of a watch of each.

    True states are NaN, and so is everything behind the end of a recording. What came late is in its place,
    as if it had come in time.
    """
    scenario = knowledge.scenario
    flights, failure = Flights.empty(knowledge, len(recordings)), [""] * len(recordings)
    notices = [*flights.notices]
    for number, messages in enumerate(recordings):
        try:
            beliefs = _beliefs(knowledge, messages)
        except IN_FLIGHT as error:
            failure[number] = str(error)
            continue
        turns = len(beliefs.observed)
        most = scenario.mission.steps
        if not 0 < turns <= most:
            failure[number] = (
                f"it has {turns} turns, and {most} at most are flown: set `steps` of the group."
                if turns
                else "its recording has no turn yet."
            )
            continue
        flights.observed[number, :turns] = beliefs.observed
        flights.control_index[number, :turns] = beliefs.control_index
        flights.filtered[number, :turns] = beliefs.filtered
        flights.log_evidence[number, :turns] = beliefs.log_evidence
        notices[number] = tuple(beliefs.notices)
    return replace(flights, failure=tuple(failure), notices=tuple(notices))


def _beliefs(knowledge: Knowledge, messages: Sequence[Fed]) -> Beliefs:
    scenario = knowledge.scenario
    twin, beliefs = knowledge.twin(lag=scenario.watch.lag), Beliefs(scenario.observation.count)
    intake, seen, late = Intake(scenario, _Recorded(messages), RejectedFile(None)), {}, False
    lost: list[tuple[int, Notice]] = []
    for reading, turn, _ in operate(twin, intake):
        at = intake.observation_turn
        seen[at] = reading.observed, twin.control_of(at)
        late |= reading.revises is not None
        lost += [(at, notice) for notice in intake.notices]
        beliefs.add(reading.observed, turn)
    if late:
        twin, beliefs = knowledge.twin(), Beliefs(scenario.observation.count)
        for at in sorted(seen):
            beliefs.add(seen[at][0], twin.turn(*seen[at]))
    beliefs.notices += lost
    return beliefs
