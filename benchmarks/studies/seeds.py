"""Missions under many seeds in this process, without a store: for studies and tests."""

from collections.abc import Sequence

from twin_master.assets.asset_source import Asset, AssetSource, StatelessAsset
from twin_master.errors import FleetError
from twin_master.fleet.members import Member
from twin_master.fleet.outcomes import Outcomes
from twin_master.fleet.storage.store import stored_variables
from twin_master.mission.flights import Flights, fly_one_by_one, fly_side_by_side
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.scenario.schema import Scenario


def outcomes(knowledge: Knowledge, flights: Flights) -> Outcomes:
    """Return what became of missions that are not stored; the first that failed is raised."""
    for sentence in filter(None, flights.failure):
        raise FleetError(sentence)
    members = [Member(row, str(row), row, {}) for row in range(len(flights.failure))]
    return Outcomes.from_store(stored_variables(knowledge, flights, members))


def fly_seeds(
    scenario: Scenario,
    source: AssetSource,
    seeds: Sequence[int],
    *,
    calibration_seed: int | None = None,
) -> Outcomes:
    """Fly a mission under many seeds in this process, without a store, whatever its source is.

    Parameters
    ----------
    scenario : Scenario
    source : AssetSource
        Already prepared; its asset is opened once, and brought back to its start for each mission.
    seeds : sequence of int
    calibration_seed : int, optional
        Of the calibration, which all missions share; the first of the seeds by default.
    """
    seed = seeds[0] if calibration_seed is None else calibration_seed
    knowledge = prepare_knowledge(scenario, source, seed)
    truths = [knowledge.truth(seed) for seed in seeds]
    asset = source.open()
    start = asset.save_state()

    def again(_twin: int, _sound: bool) -> Asset:
        asset.restore_state(start)
        return asset

    try:
        if isinstance(asset, StatelessAsset) and scenario.learning is None:
            return outcomes(knowledge, fly_side_by_side(knowledge, truths, [asset] * len(truths)))
        return outcomes(knowledge, fly_one_by_one(knowledge, truths, again))
    finally:
        asset.close()
