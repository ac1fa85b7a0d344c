"""The same mission under many seeds, without run folders, to see how reliably the twin steers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin_master.asset_source import AssetSource
from twin_master.crew import Knowledge, prepare_knowledge
from twin_master.errors import MissionInputError
from twin_master.mission import Flight, fly
from twin_master.scenario import Scenario
from twin_master.summary import filtered_rms_error, find_fallback

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Study:
    """Outcomes of N missions.

    Attributes
    ----------
    seeds : tuple of int
        Seeds of the missions.
    delay : (N,)
        Steps from the damage that calls for it to the fallback; infinite where there was none, NaN where
        no damage called for it.
    early : (N,)
        Whether another control than the first was flown before the damage could be seen.
    squared_error : (N, F)
        Mean squared error of the filtered mean of each factor over the steps, SI.
    """

    seeds: tuple[int, ...]
    delay: Float
    early: NDArray[np.bool_]
    squared_error: Float

    def share_within(self, steps: int) -> float:
        """Return the share of the called-for fallbacks that came within some steps; NaN without any."""
        called = self.delay[~np.isnan(self.delay)]
        return float(np.mean(called <= steps)) if len(called) else float("nan")

    @property
    def early_share(self) -> float:
        """Share of missions with a fallback before the damage."""
        return float(np.mean(self.early))

    @property
    def rms_error(self) -> Float:
        """Root of the mean squared error of each factor over all steps of all missions: (F,), SI."""
        return np.asarray(np.sqrt(self.squared_error.mean(axis=0)))


def fly_many(
    scenario: Scenario,
    source: AssetSource,
    seeds: Iterable[int],
    *,
    calibration_seed: int | None = None,
    watch: Callable[[int, Flight], None] | None = None,
) -> Study:
    """Fly a mission under many seeds in this process.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    source : AssetSource
        Already prepared; its asset is opened once and flown by every mission in turn.
    seeds : iterable of int
        One mission each.
    calibration_seed : int, optional
        Seed of the calibration, which all missions share; the first of the seeds by default.
    watch : callable, optional
        Called with the seed and the flight after each mission.

    Raises
    ------
    MissionInputError
        The asset carries its own damage and noise, which the seeds would not change.
    """
    if scenario.truth.kind == "asset":
        raise MissionInputError(
            "the damage and noise of this asset are its own, so that every seed would fly the same life: fly "
            "the scenario with --seed instead."
        )
    chosen = tuple(seeds)
    knowledge = prepare_knowledge(
        scenario, source, chosen[0] if calibration_seed is None else calibration_seed
    )
    asset = source.open()
    delay = np.full(len(chosen), np.nan)
    early = np.zeros(len(chosen), dtype=bool)
    squared = np.empty((len(chosen), len(scenario.state)))
    try:
        start = asset.save_state()
        for index, seed in enumerate(chosen):
            if index:
                asset.restore_state(start)
            flight = fly(scenario, knowledge.twin(), knowledge.plant(knowledge.truth(seed), asset))
            delay[index], early[index], squared[index] = _outcome(knowledge, flight)
            if watch is not None:
                watch(seed, flight)
    finally:
        asset.close()
    return Study(chosen, delay, early, squared)


def _outcome(knowledge: Knowledge, flight: Flight) -> tuple[float, bool, Float]:
    scenario = knowledge.scenario
    first = scenario.control_names.index(scenario.mission.first_control)
    fallback = find_fallback(
        knowledge.model, knowledge.plan.control_index, first, flight.control_index, flight.truth.state
    )
    delay = float("nan")
    if fallback.called_for_step is not None:
        delay = float("inf") if fallback.delay is None else float(fallback.delay)
    errors = filtered_rms_error(knowledge.model, flight.filtered, flight.truth.state)
    return delay, fallback.early_step is not None, errors**2
