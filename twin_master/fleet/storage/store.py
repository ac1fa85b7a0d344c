"""The store of a fleet, arrays with a row for each twin: its variables, and how it is opened."""

from collections.abc import Sequence
from importlib import util
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import AnyArray, Float, Index
from reporting.formats.former_names import warn_of_former_names
from reporting.json_file import JsonObject
from twin_master.errors import FleetError
from twin_master.fleet.configuration import fleet_config
from twin_master.fleet.members import Member, RecordedMembers
from twin_master.fleet.storage.store_address import STORE_NAME, address_of
from twin_master.fleet.storage.store_layout import (
    NO_STEP,
    NOTICE_KINDS,
    TWIN_AXIS,
    former_names_used,
    in_present_layout,
    is_former_layout,
    observed_variables,
    stored_layout,
)
from twin_master.mission.earnings import discounted_return, earnings
from twin_master.mission.flights import Flights
from twin_master.mission.preparation import Knowledge
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.schema import Scenario
from twin_master.store.schema import SCHEMA
from twin_master.store.summary import find_fallback

if TYPE_CHECKING:
    import xarray as xr


CREDIBILITY = 0.9
"""Probability of the credible set of states for which coverage of the true state is counted."""
_TOLERANCE = 1e-9
"""Difference of two probabilities up to which they are taken as equal."""
WITHIN = 2
"""Number of steps within which a fallback should follow the damage that calls for it."""

FLOWN, FAILED, ENDED = 1, 2, 3
"""Values of the variable `status`: mission flown to its end, flight failed, asset ended it early.

The value 0 means that the twin has not flown yet.
"""
_NOT_DEFINED = -1
"""Value of `early` if the policy does not depend on the level of one factor alone."""


def flown_rows(status: AnyArray) -> Index:
    """Return the rows of the twins that have flown to the end of the mission or of the asset."""
    return np.flatnonzero((status == FLOWN) | (status == ENDED))


def stored_variables(
    knowledge: Knowledge, flights: Flights, members: Sequence[Member]
) -> dict[str, AnyArray]:
    """Return the stored variables of B flown twins, with B rows each.

    Parameters
    ----------
    members : sequence of Member
        The B assets with their seeds and true parameters.
    """
    has_failed = np.array([bool(sentence) for sentence in flights.failure])
    has_ended = np.array([bool(sentence) for sentence in flights.ended])
    # Twin by twin, so that the rounding of a row does not depend on the other twins of the shard.
    states = knowledge.model.states
    mean = [states.mean(belief) for belief in flights.filtered]
    standard_deviation = [states.standard_deviation(belief) for belief in flights.filtered]
    delay, early = fallbacks_of(knowledge, flights)
    earned = earnings(knowledge, flights.control_index, flights.filtered, flights.state)
    returns = discounted_return(knowledge.scenario, earned.reward, flights.control_index)
    # The belief after the last flown step, (B, S); of a failed twin the last row, which is NaN.
    step_count = flights.control_index.shape[1]
    last_step = np.where(has_failed, step_count, _steps_flown(flights)) - 1
    last_belief = flights.filtered[np.arange(len(has_failed)), last_step]
    values: dict[str, object] = {
        "status": np.where(has_failed, FAILED, np.where(has_ended, ENDED, FLOWN)),
        "seed": np.array([member.seed for member in members]),
        **observed_variables(knowledge.scenario, flights.observation_rows),
        "observed/control_index": flights.control_index,
        "truth/state": flights.state,
        **{f"earned/{name}": values_of_steps for name, values_of_steps in vars(earned).items()},
        "earned/return": np.where(has_failed, np.nan, returns),
        "filtered/mean": mean,
        "filtered/standard_deviation": standard_deviation,
        "filtered/log_evidence": flights.log_evidence,
        "notice/none_of_these": flights.unexplained,
        "filtered/last_probability": last_belief,
        "delay": np.where(has_failed, np.nan, delay),
        "early": np.where(has_failed, _NOT_DEFINED, early),
        **_notice_variables(flights),
        "credible": np.where(has_failed, np.nan, _credible_fraction(knowledge, flights)),
    }
    parameters = list(members[0].parameters)
    for name in parameters:
        values[f"truth/{name}"] = [member.parameters[name] for member in members]
    return {
        path: np.ascontiguousarray(values[path], variable.values.dtype)
        for path, variable in stored_layout(knowledge.scenario, parameters).items()
    }


def _steps_flown(flights: Flights) -> Index:
    """Return the number of flown steps of each twin, a (B,) array."""
    return np.asarray((flights.control_index >= 0).sum(axis=1))


def _credible_fraction(knowledge: Knowledge, flights: Flights) -> Float:
    """Return for each twin the fraction of steps with the true state in the credible set, (B,).

    It is NaN for real assets, whose true state is not known.
    """
    twin_count, step_count, factor_count = flights.state.shape
    is_inside = in_credible_set(
        knowledge.model,
        flights.filtered.reshape(twin_count * step_count, -1),
        flights.state.reshape(-1, factor_count),
    )
    steps_inside = is_inside.reshape(-1, step_count).sum(axis=1)
    fraction = steps_inside / np.maximum(_steps_flown(flights), 1)
    is_truth_unknown = np.isnan(flights.state[:, 0]).any(axis=1)
    return np.where(is_truth_unknown, np.nan, fraction)


def _notice_variables(flights: Flights) -> dict[str, list[list[int]]]:
    """Return for each twin the number of notices of each of `NOTICE_KINDS`, and their first step.

    The step is -1 if there is no notice of the kind.
    """
    counts = []
    first_steps = []
    for notices_of_twin in flights.notices:
        steps_of_kind: dict[str, list[int]] = {kind: [] for kind in NOTICE_KINDS}
        for step, notice in notices_of_twin:
            if notice.kind in steps_of_kind:
                steps_of_kind[notice.kind].append(step)
        counts.append([len(steps) for steps in steps_of_kind.values()])
        first_steps.append([min(steps, default=NO_STEP) for steps in steps_of_kind.values()])
    return {"notice/count": counts, "notice/first_step": first_steps}


def fallbacks_of(knowledge: Knowledge, flights: Flights) -> tuple[Float, Index]:
    """Return the delays and the early cases of the fallbacks of B twins, from their flights.

    A fallback is a change from the initial to a gentler control because of damage. It is called for
    once the true state reaches a level at which the policy leaves the initial control, that of the
    first step. Real assets have the delay NaN and -1 for `early`, because their true state is not
    known.

    Returns
    -------
    delay : (B,) array
        The number of steps from the call to the fallback. It is infinite if the fallback did not
        come within the mission, and NaN if none was called for or if the mission ended within
        `WITHIN` steps of the call without a fallback.
    early : (B,) array
        1 if a fallback came before it was called for, else 0; -1 if the policy does not depend on
        the level of one factor alone.
    """
    scenario = knowledge.scenario
    first_control = scenario.control_names.index(scenario.mission.first_control)
    twin_count = len(flights.state)
    delay = np.full(twin_count, np.nan)
    early = np.full(twin_count, _NOT_DEFINED)
    for twin, steps_flown in enumerate(_steps_flown(flights).tolist()):
        true_state = flights.state[twin]
        if np.isnan(true_state[0]).any():  # the true state of a real asset is not known
            continue
        fallback = find_fallback(
            knowledge.model.states,
            knowledge.plan.control_index,
            first_control,
            flights.control_index[twin, :steps_flown],
            true_state[:steps_flown],
        )
        if fallback.switch_factor is not None:
            early[twin] = fallback.early_change_step is not None
        if fallback.step_at_switch_level is None:
            continue
        if fallback.delay is not None:
            delay[twin] = fallback.delay
        elif steps_flown - fallback.step_at_switch_level > WITHIN:
            delay[twin] = np.inf
    return delay, early


def in_credible_set(
    model: GraphicalModel, probability: Float, true_state: Float, credibility: float = CREDIBILITY
) -> NDArray[np.bool_]:
    """Return whether the true state lies in the credible set of each of T beliefs.

    The credible set is the smallest set of states whose probability is at least `credibility`; of
    states with equal probabilities it contains all or none. A true value between two levels of a
    factor is replaced by the nearest level; half-way between them, either level counts.

    Parameters
    ----------
    probability : (T, S) array
        The beliefs.
    true_state : (T, F) array
        The true state, in SI units.
    credibility : float
        The least probability of the set.

    Returns
    -------
    (T,) array
        Whether the set contains the true state.
    """
    # Joint states whose level of every factor is nearest to the true value.
    is_nearest = np.ones((len(true_state), model.states.size), dtype=bool)
    for axis, factor in enumerate(model.states.factors):
        true_value = true_state[:, axis, None]
        least_distance = np.abs(np.asarray(factor.levels) - true_value).min(axis=1, keepdims=True)
        distance = np.abs(model.states.coordinates[:, axis] - true_value)  # (T, S)
        is_nearest &= distance <= least_distance + factor.slack
    # Sum the probabilities in descending order. The set ends with the state at which the sum
    # reaches the credibility; all states at least as probable as that one are in the set.
    descending = -np.sort(-probability, axis=1)
    is_reached = np.cumsum(descending, axis=1) >= credibility - _TOLERANCE
    least_probability = descending[np.arange(len(descending)), np.argmax(is_reached, axis=1)]
    is_in_set = probability >= least_probability[:, None] * (1.0 - _TOLERANCE)
    return np.asarray(np.any(is_nearest & is_in_set, axis=1))


def check_installed(*packages: str) -> None:
    """Check that packages of the extra `fleet` are installed.

    Raises
    ------
    FleetError
        If one of the packages is not installed.
    """
    missing_packages = [name for name in packages if util.find_spec(name) is None]
    if missing_packages:
        raise FleetError(
            f"a fleet needs {' and '.join(missing_packages)}: pip install 'uav-twin[fleet]'."
        )


def open_group(folder: Path, group: str, *, names: bool = True) -> "xr.DataTree":
    """Open a group of assets in the store of a fleet.

    The arrays of the group are read from the disk when they are first used. If an earlier version
    of the program wrote the store, the names and shapes of the arrays are converted to the present
    ones.

    Parameters
    ----------
    group : str
        The name of the group.
    names : bool
        Whether to read the names of the twins, which are in memory as long as the group is open.

    Raises
    ------
    FleetError
        If the store has no such group, if an array is missing in the group, or if zarr is not
        installed.
    """
    check_installed("zarr")
    import xarray as xr

    config = fleet_config(folder)
    record = _group_record(config, folder, group)
    address = address_of(config["fleet"], folder)
    address.check()
    # an error of zarr becomes a `FleetError`, whose message quotes it between two texts
    message_start = f"{address.remote or folder} holds no group {group} of a fleet ("
    with FleetError.instead_of(OSError, KeyError, ValueError, before=message_start, after=")."):
        tree: xr.DataTree = xr.open_datatree(
            address.for_zarr(),
            engine="zarr",
            group=group,
            chunks=None,
            consolidated=False,
            drop_variables=[] if names else [TWIN_AXIS],
        )
    stored_group = tree.to_dataset()
    if is_former_layout(stored_group):
        warn_of_former_names(
            str(address.remote or folder / STORE_NAME), former_names_used(stored_group)
        )
        scenario = Scenario.model_validate(record["scenarios"][0])
        members = RecordedMembers(record)
        all_names = [members.name(row) for row in range(len(members))] if names else None
        tree = in_present_layout(stored_group, scenario, all_names)
    # A path with braces is a template, such as "{input}", whose arrays differ between groups.
    # Stores of earlier versions have no rewards.
    required_paths = {
        path for path in SCHEMA["fleet"] if "{" not in path and not path.startswith("earned/")
    }
    for node in tree.subtree:
        for name in node.data_vars:
            required_paths.discard(f"{node.relative_to(tree)}/{name}".removeprefix("./"))
    if required_paths:
        raise FleetError(
            f"{folder} was flown by another version of this program and lacks "
            f"{', '.join(sorted(required_paths))}: fly the fleet again with --replace, "
            "or read it with that version."
        )
    return tree


def _group_record(config: JsonObject, folder: Path, group: str) -> JsonObject:
    """Return the record of a group in the configuration of a fleet."""
    records: list[JsonObject] = config["fleet"]["groups"]
    for record in records:
        if record["name"] == group:
            return record
    raise FleetError(f"{folder} holds no group {group} of a fleet.")
