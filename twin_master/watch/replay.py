"""The journal of a watch, read back: the twin as it was, to the last bit, and the turns that are stored."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from twin_master.errors import NotResumableError
from twin_master.mission.journal import array_of, damaged, read_records
from twin_master.mission.loop import Beliefs
from twin_master.mission.preparation import Knowledge
from twin_master.network.twin import Twin

SNAPSHOT_TURNS = 1000
"""Turns between two lines that also hold the state of the twin, so that not all turns are filtered again."""


@dataclass(frozen=True)
class BelievedModel:
    """What the twin believes from a turn on.

    Attributes
    ----------
    from_turn : int
        The first turn that is filtered with it.
    knowledge : Knowledge
        Its predicted observations.
    """

    from_turn: int
    knowledge: Knowledge


@dataclass
class Replayed:
    """A watch, filtered again from a snapshot.

    Attributes
    ----------
    twin : Twin
        After the last turn.
    beliefs : Beliefs
        Of the turns that were filtered again.
    first_turn : int
        Of these.
    last : dict or None
        The last line of the journal; None before the first turn.
    """

    twin: Twin
    beliefs: Beliefs
    first_turn: int = 0
    last: dict[str, Any] | None = None


@dataclass
class _Tail:
    """What lies behind a snapshot in the journal."""

    turn: int = -1
    state: bytes | None = None
    seen: dict[int, tuple[Any, int]] = field(default_factory=dict)


def replay(
    path: Path,
    config_hash: str,
    models: Sequence[BelievedModel],
    lag: int | None,
    *,
    first_turn: int | None,
    end: int | None = None,
) -> Replayed:
    """Filter the end of a watch again, what came late in its place.

    Parameters
    ----------
    path : Path
        The journal.
    config_hash : str
        Of the configuration that it belongs to.
    models : sequence of BelievedModel
        The model of the beginning, and those that were adopted later, by their turns. More than the journal
        knows of are a question: what would be believed with them.
    lag : int or None
        Of the twin.
    first_turn : int or None
        The first turn whose belief is wanted; None for the twin alone, from the last snapshot.
    end : int, optional
        Bytes of the journal that are read; all of it if left out.

    Raises
    ------
    NotResumableError
        The journal was changed or is damaged, or decided otherwise.
    """
    tail, last, adopted = _Tail(), None, 0
    for number, (record, place) in enumerate(read_records(path, config_hash), start=1):
        if end is not None and place > end:
            break
        try:
            if "model" in record:
                adopted += 1
            elif "verdict" not in record and "quiet" not in record:
                seen = array_of(record["observed"]), int(record["control_index"])
                tail.seen[int(record["observation_turn"])] = seen
            if "twin_state" in record:
                # Only one that lies before what is wanted, and before all models that are adopted behind it.
                wanted = [model.from_turn for model in models[adopted + 1 :]]
                wanted += [] if first_turn is None else [first_turn]
                if all(int(record["turn"]) < turn for turn in wanted):
                    tail = _Tail(int(record["turn"]), base64.b64decode(record["twin_state"]))
            last = record
        except (KeyError, TypeError, ValueError) as error:
            raise damaged(path, number, f"it has another layout, {error}") from error
    found = _filtered(tail, models, lag)
    found.last = last
    if (
        last is not None
        and adopted + 1 == len(models)
        and last["next_control"] != found.twin.proposed_control
    ):
        raise NotResumableError(
            f"the journal decided otherwise after turn {last['turn']} than this version does: begin "
            f"another watch, in another folder, with `--observations {path.parent}`."
        )
    return found


def _filtered(tail: _Tail, given: Sequence[BelievedModel], lag: int | None) -> Replayed:
    # A model that was adopted from an earlier turn on than one before it takes its place altogether.
    models = [
        model
        for index, model in enumerate(given)
        if all(later.from_turn > model.from_turn for later in given[index + 1 :])
    ]
    at = max(index for index, model in enumerate(models) if not index or model.from_turn <= max(tail.turn, 0))
    twin = models[at].knowledge.twin(lag=lag)
    if tail.state is not None:
        twin.restore_state(tail.state)
    for turn in sorted(turn for turn in tail.seen if turn < twin.turns):
        twin.revise(turn, *tail.seen[turn])
    sensors = models[at].knowledge.scenario.observation.count
    found = Replayed(twin, Beliefs(sensors), first_turn=twin.turns)
    while twin.turns in tail.seen:
        if at + 1 < len(models) and models[at + 1].from_turn <= twin.turns:
            at += 1
            following = models[at].knowledge.twin(lag=lag)
            following.restore_state(twin.save_state())
            twin = found.twin = following
        observed, control = tail.seen[twin.turns]
        found.beliefs.add(observed, twin.turn(observed, control))
    return found
