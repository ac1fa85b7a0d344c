"""The store of a fleet: what is kept of each twin, chunk by chunk, and which shards are there."""

from collections.abc import Sequence
from importlib import util
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float
from reporting.files import explained_write_errors
from reporting.former_names import warn_of_former_names
from twin_master.errors import FleetError, said
from twin_master.fleet.plan import Fleet, Group, Member
from twin_master.mission.preparation import Knowledge
from twin_master.mission.side_by_side import Flights
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.schema import Scenario
from twin_master.store.mission_result import SCHEMA
from twin_master.store.summary import find_fallback

if TYPE_CHECKING:
    import xarray as xr
    import zarr


NOTICE_KINDS = ("alarm", "gauge_left_out")
"""Notices that are kept of each twin, by their kinds."""
CREDIBILITY = 0.9
"""Probability of the set of states in which the true one is looked for."""
_TOLERANCE = 1e-9
WITHIN = 2
"""Steps within which the fallback is to come."""

FLOWN, FAILED, ENDED = 1, 2, 3
"""Values of `status`; 0 has not flown yet."""


def has_flown(status: NDArray[Any]) -> NDArray[np.int64]:
    """Return the rows of the twins that flew, to the end of the mission or to that of their assets."""
    return np.flatnonzero((status == FLOWN) | (status == ENDED))


def sizes_of(scenario: Scenario) -> dict[str, int]:
    """Return the lengths of the dimensions."""
    return {
        "step": scenario.mission.steps,
        "sensor": scenario.row_width,
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
    steps_flown = (flights.control_index >= 0).sum(axis=1)  # a recording or a simulation may end early
    short = np.array([bool(text) for text in flights.ended])
    told = [
        [[step for step, notice in own if notice.kind == kind] for kind in NOTICE_KINDS]
        for own in flights.notices
    ]
    found: dict[str, Any] = {
        "status": np.where(failed, FAILED, np.where(short, ENDED, FLOWN)),
        "seed": np.array([member.seed for member in members]),
        "observed": flights.observation_rows,
        "control_index": flights.control_index,
        "state": flights.state,
        "mean": mean,
        "standard_deviation": np.sqrt(np.maximum(variance, 0.0)),
        "log_evidence": flights.log_evidence,
        "unexplained": flights.unexplained,
        "belief": flights.filtered[np.arange(len(failed)), np.where(failed, steps, steps_flown) - 1],
        "delay": np.where(failed, np.nan, delay),
        "early": np.where(failed, -1, early),
        "notices": [[len(numbers) for numbers in own] for own in told],
        "first_notice": [[min(numbers, default=-1) for numbers in own] for own in told],
        "credible": np.where(
            failed | unknown, np.nan, inside.reshape(-1, steps).sum(axis=1) / np.maximum(steps_flown, 1)
        ),
    }
    found = {name: np.ascontiguousarray(values, SCHEMA["fleet"][name][3]) for name, values in found.items()}
    for name in members[0].parameters:
        found[name] = np.array([member.parameters[name] for member in members])
    return found


def _fallbacks(knowledge: Knowledge, flights: Flights) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the delay of the fallback, and whether it came early (-1: none is defined), of each twin."""
    scenario, plan = knowledge.scenario, knowledge.plan
    first = scenario.control_names.index(scenario.mission.first_control)
    delay = np.full(len(flights.state), np.nan)
    early = np.full(len(delay), -1)
    for twin, (control, state) in enumerate(zip(flights.control_index, flights.state, strict=True)):
        if np.isnan(state[0]).any():
            continue
        steps_flown = int(np.sum(control >= 0))
        course = control[:steps_flown], state[:steps_flown]
        fallback = find_fallback(knowledge.model.states, plan.control_index, first, *course)
        if fallback.switch_state is not None:
            early[twin] = fallback.early_step is not None
        if fallback.called_for_step is not None:
            # Where the mission ends so soon behind it, nobody knows whether the fallback would come.
            late = steps_flown - fallback.called_for_step <= WITHIN
            never = np.nan if late else np.inf
            delay[twin] = never if fallback.delay is None else fallback.delay
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
        nearest &= level_distance <= distance.min(axis=1, keepdims=True) + factor.slack
    descending = -np.sort(-probability, axis=1)
    reached = np.cumsum(descending, axis=1) >= credibility - _TOLERANCE
    least = descending[np.arange(len(descending)), np.argmax(reached, axis=1)]
    return np.asarray(np.any(nearest & (probability >= least[:, None] * (1.0 - _TOLERANCE)), axis=1))


STORE_NAME = "fleet.zarr"
FORMER_DIMENSION = "turn"
"""What the dimension `step` was called in the stores of earlier versions."""


def check_installed(*packages: str) -> None:
    """Refuse to begin without what the extra `fleet` brings.

    Raises
    ------
    FleetError
        One of the packages is not installed.
    """
    missing = [name for name in packages if util.find_spec(name) is None]
    if missing:
        raise FleetError(f"a fleet needs {' and '.join(missing)}: pip install 'uav-twin[fleet]'.")


def open_group(folder: Path, group: str) -> "xr.Dataset":
    """Return a group of the store, whose arrays are read as they are asked for.

    Raises
    ------
    FleetError
        There is none, or zarr is not installed.
    """
    check_installed("zarr")
    import xarray as xr

    before = f"{folder} holds no group {group} of a fleet ("
    with FleetError.instead_of(OSError, KeyError, ValueError, before=before, after=")."):
        found: xr.Dataset = xr.open_zarr(folder / STORE_NAME, group=group, chunks=None, consolidated=False)
    if FORMER_DIMENSION in found.dims:
        warn_of_former_names(f"{folder / STORE_NAME}", {FORMER_DIMENSION: "step"})
        found = found.rename({FORMER_DIMENSION: "step"})
    if missing := SCHEMA["fleet"].keys() - found.keys():
        raise FleetError(said("fleet.other_layout", folder=folder, missing=", ".join(sorted(missing))))
    return found


def create_store(folder: Path, fleet: Fleet) -> None:
    """Make the arrays of a fleet, in which nothing has flown."""
    import zarr

    with explained_write_errors(folder / STORE_NAME):
        root = zarr.open_group(folder / STORE_NAME, mode="a", zarr_format=3)
        for group in fleet.groups:
            _create_group(root.require_group(group.name), group, fleet)


def _create_group(made: "zarr.Group", group: Group, fleet: Fleet) -> None:
    scenario, count = group.scenarios[0], len(group.members)
    sizes = sizes_of(scenario)
    true = {name: ["", "SI", "true parameter", "f8"] for name in group.spreads}
    for name, (axes, unit, title, kind) in (SCHEMA["fleet"] | true).items():
        shape = (count, *(sizes[axis] for axis in axes.split()))
        made.create_array(
            name,
            shape=shape,
            chunks=(min(fleet.head.shard, count), *shape[1:]),
            dtype=kind,
            fill_value=np.nan if kind[0] == "f" else -int(name in ("control_index", "first_notice")),
            dimension_names=("twin", *axes.split()),
            attributes={"title": title, "units": unit},
            overwrite=True,
        )
    made.attrs.update(
        {
            "scenario": scenario.mission.name,
            "fleet": fleet.head.name,
            "fleet_seed": fleet.head.seed,
            "factors": list(scenario.state_names),
            "controls": list(scenario.control_names),
            "step_name": scenario.mission.step_name,
            "gives_notice": scenario.notice is not None,
        }
    )
