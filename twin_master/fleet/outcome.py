"""What is kept of a twin's mission: the variables of the store, and their shapes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_master.fleet.plan import Member
from twin_master.mission.preparation import Knowledge
from twin_master.mission.side_by_side import Flights
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.schema import Scenario
from twin_master.store.summary import find_fallback

__all__ = ["ENDED", "FAILED", "FLOWN", "VARIABLES", "Variable", "in_credible_set", "outcomes_of", "sizes_of"]

Float = NDArray[np.float64]

NOTICE_KINDS = ("alarm", "gauge_left_out")
"""Notices that are kept of each twin, by their kinds."""
CREDIBILITY = 0.9
"""Probability of the set of states in which the true one is looked for."""
_TOLERANCE = 1e-9

FLOWN, FAILED, ENDED = 1, 2, 3
"""Values of `status`; 0 has not flown yet."""


def has_flown(status: NDArray[Any]) -> NDArray[np.int64]:
    """Return the rows of the twins that flew, to the end of the mission or to that of their assets."""
    return np.flatnonzero((status == FLOWN) | (status == ENDED))


@dataclass(frozen=True)
class Variable:
    """A variable of the store: its dimensions after `twin`, its type, and what it is."""

    dimensions: tuple[str, ...]
    type: str
    title: str
    unit: str = "1"


VARIABLES: Mapping[str, Variable] = {
    "status": Variable(
        (),
        "i1",
        "0: has not flown, 1: has flown to its end, 2: failed in flight, 3: its asset ended early",
    ),
    "seed": Variable((), "i8", "seed of the mission"),
    "observed": Variable(("turn", "sensor"), "f4", "what the sensors said; NaN where lost", "SI"),
    "control_index": Variable(("turn",), "i1", "control in force; -1 after a failure or an end"),
    "state": Variable(("turn", "factor"), "f4", "true state", "SI"),
    "mean": Variable(("turn", "factor"), "f4", "mean of the filtered belief", "SI"),
    "standard_deviation": Variable(("turn", "factor"), "f4", "standard deviation of the same", "SI"),
    "log_evidence": Variable(("turn",), "f4", "log p(o_t | o_0..o_t-1)"),
    "belief": Variable(("level",), "f4", "filtered belief after the last turn, over all joint states"),
    "delay": Variable(
        (),
        "f4",
        "turns from the damage that calls for a fallback to it; infinite: none came, NaN: not called",
    ),
    "early": Variable((), "i1", "whether another control than the first was flown before that damage"),
    "credible": Variable((), "f4", "share of turns with the true state in the 90 % set of the belief"),
    "notices": Variable(("notice_kind",), "i4", f"notices of the kinds {', '.join(NOTICE_KINDS)}"),
    "first_notice": Variable(("notice_kind",), "i4", "turn of the first of each kind; -1: none"),
}
"""What is stored of each twin, by its name; true parameters that differ from twin to twin stand beside it."""


def sizes_of(scenario: Scenario) -> dict[str, int]:
    """Return the lengths of the dimensions."""
    return {
        "turn": scenario.mission.steps,
        "sensor": scenario.observation.count,
        "factor": len(scenario.state),
        "notice_kind": len(NOTICE_KINDS),
        "level": int(np.prod([len(factor.levels) for factor in scenario.state])),
    }


def outcomes_of(knowledge: Knowledge, flights: Flights, members: Sequence[Member]) -> dict[str, NDArray[Any]]:
    """Return the variables of B twins, as they are stored."""
    model, scenario = knowledge.model, knowledge.scenario
    coordinates = model.states.coordinates
    # A product for each twin: what is stored of it does not depend on its neighbours.
    mean = np.matmul(flights.filtered, coordinates)
    variance = np.matmul(flights.filtered, coordinates**2) - mean**2
    steps = flights.control_index.shape[1]
    rows = (-1, model.states.size), (-1, len(scenario.state))
    inside = in_credible_set(model, flights.filtered.reshape(rows[0]), flights.state.reshape(rows[1]))
    failed = np.array([bool(text) for text in flights.failure])
    delay, early = _fallbacks(knowledge, flights)
    unknown = np.isnan(flights.state[:, 0]).any(axis=1)  # of a real asset
    turns = (flights.control_index >= 0).sum(axis=1)  # a recording or a simulation may end early
    short = np.array([bool(text) for text in flights.ended])
    told = [
        [[turn for turn, notice in own if notice.kind == kind] for kind in NOTICE_KINDS]
        for own in flights.notices
    ]
    found: dict[str, Any] = {
        "status": np.where(failed, FAILED, np.where(short, ENDED, FLOWN)),
        "seed": np.array([member.seed for member in members]),
        "observed": flights.observed,
        "control_index": flights.control_index,
        "state": flights.state,
        "mean": mean,
        "standard_deviation": np.sqrt(np.maximum(variance, 0.0)),
        "log_evidence": flights.log_evidence,
        "belief": flights.filtered[np.arange(len(failed)), np.where(failed, steps, turns) - 1],
        "delay": np.where(failed, np.nan, delay),
        "early": early & ~failed,
        "notices": [[len(turns) for turns in own] for own in told],
        "first_notice": [[min(turns, default=-1) for turns in own] for own in told],
        "credible": np.where(
            failed | unknown, np.nan, inside.reshape(-1, steps).sum(axis=1) / np.maximum(turns, 1)
        ),
    }
    found = {name: np.ascontiguousarray(values, VARIABLES[name].type) for name, values in found.items()}
    for name in members[0].parameters:
        found[name] = np.array([member.parameters[name] for member in members])
    return found


def _fallbacks(knowledge: Knowledge, flights: Flights) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the delay of the fallback and whether it came early, of each twin."""
    scenario, plan = knowledge.scenario, knowledge.plan
    first = scenario.control_names.index(scenario.mission.first_control)
    delay = np.full(len(flights.state), np.nan)
    early = np.zeros(len(delay), dtype=bool)
    for twin, (control, state) in enumerate(zip(flights.control_index, flights.state, strict=True)):
        if np.isnan(state[0]).any():
            continue
        turns = int(np.sum(control >= 0))
        course = control[:turns], state[:turns]
        fallback = find_fallback(knowledge.model.states, plan.control_index, first, *course)
        early[twin] = fallback.early_step is not None
        if fallback.called_for_step is not None:
            delay[twin] = np.inf if fallback.delay is None else fallback.delay
    return delay, early


def in_credible_set(
    model: GraphicalModel, probability: Float, true_state: Float, credibility: float = CREDIBILITY
) -> NDArray[np.bool_]:
    """Return whether the smallest set of states with a probability holds the true state: (T,).

    Between the levels the true state counts as the nearest level of each factor, half-way between two as
    either. Of equally probable states all are in the set, or none.

    Parameters
    ----------
    model : GraphicalModel
        S states of F factors.
    probability : (T, S)
        Beliefs.
    true_state : (T, F)
        True state, SI.
    credibility : float
        Probability of the set.
    """
    nearest = np.ones((len(true_state), model.states.size), dtype=bool)
    for axis, factor in enumerate(model.states.factors):
        distance = np.abs(np.asarray(factor.levels) - true_state[:, axis, None])  # (T, levels)
        level_distance = np.abs(model.states.coordinates[:, axis] - true_state[:, axis, None])
        nearest &= level_distance <= distance.min(axis=1, keepdims=True) + _TOLERANCE
    descending = -np.sort(-probability, axis=1)
    reached = np.cumsum(descending, axis=1) >= credibility - _TOLERANCE
    least = descending[np.arange(len(descending)), np.argmax(reached, axis=1)]
    return np.asarray(np.any(nearest & (probability >= least[:, None] * (1.0 - _TOLERANCE)), axis=1))
