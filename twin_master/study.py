"""The same mission under many seeds, without run folders, to see how reliably the twin steers."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin_master.assets.asset_source import AssetSource
from twin_master.errors import MissionInputError
from twin_master.mission.loop import Flight, fly
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.schema import Scenario
from twin_master.store.summary import find_fallback

Float = NDArray[np.float64]

_TOLERANCE = 1e-9


CREDIBILITY = 0.9
"""Probability of the set of states in which the true one is looked for."""


@dataclass(frozen=True)
class Estimated:
    """A figure with its standard error."""

    value: float
    error: float


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
    error : (N, F)
        Mean error of the filtered mean of each factor over the steps, SI: what the estimate is off for good.
    squared_error : (N, F)
        Mean squared error of the same, SI.
    log_evidence : (N,)
        Mean log evidence of a step.
    credible : (N,)
        Share of the turns in which the true state lies in the smallest set of states that the filtered
        belief holds for `CREDIBILITY` probable.
    """

    seeds: tuple[int, ...]
    delay: Float
    early: NDArray[np.bool_]
    error: Float
    squared_error: Float
    log_evidence: Float
    credible: Float

    @classmethod
    def of(cls, seeds: Sequence[int], outcomes: Sequence["Outcome"]) -> "Study":
        """Return the outcomes of N missions together."""
        return cls(
            seeds=tuple(seeds),
            delay=np.array([outcome.delay for outcome in outcomes]),
            early=np.array([outcome.early for outcome in outcomes]),
            error=np.array([outcome.error.mean(axis=0) for outcome in outcomes]),
            squared_error=np.array([np.mean(outcome.error**2, axis=0) for outcome in outcomes]),
            log_evidence=np.array([outcome.log_evidence for outcome in outcomes]),
            credible=np.array([outcome.credible for outcome in outcomes]),
        )

    def within(self, steps: int) -> Estimated:
        """Return the share of the called-for fallbacks that came within some steps; NaN without any."""
        called = self.delay[~np.isnan(self.delay)]
        return _share(called <= steps)

    def share_within(self, steps: int) -> float:
        """Return the share of the called-for fallbacks that came within some steps; NaN without any."""
        return self.within(steps).value

    @property
    def early_share(self) -> float:
        """Share of missions with a fallback before the damage."""
        return self.early_fallback.value

    @property
    def early_fallback(self) -> Estimated:
        """Share of missions with a fallback before the damage."""
        return _share(self.early)

    @property
    def rms_error(self) -> Float:
        """Root of the mean squared error of each factor over all steps of all missions: (F,), SI."""
        return np.asarray(np.sqrt(self.squared_error.mean(axis=0)))

    def rms(self, factor: int) -> Estimated:
        """Return the root of the mean squared error of one factor, SI."""
        mean = _mean(self.squared_error[:, factor])
        root = float(np.sqrt(mean.value))
        return Estimated(root, mean.error / (2.0 * root) if root > 0.0 else 0.0)

    def bias(self, factor: int) -> Estimated:
        """Return the mean error of the filtered mean of one factor, SI."""
        return _mean(self.error[:, factor])

    @property
    def evidence(self) -> Estimated:
        """Mean log evidence of a step."""
        return _mean(self.log_evidence)

    @property
    def credible_share(self) -> Estimated:
        """Share of the turns in which the true state lies in its credible set."""
        return _mean(self.credible)


def _share(hits: NDArray[np.bool_]) -> Estimated:
    if not len(hits):
        return Estimated(float("nan"), float("nan"))
    share = float(np.mean(hits))
    return Estimated(share, float(np.sqrt(share * (1.0 - share) / len(hits))))


def _mean(values: Float) -> Estimated:
    """Return the mean over missions; the turns of a mission are not independent, the missions are."""
    count = len(values)
    error = float(np.std(values, ddof=1) / np.sqrt(count)) if count > 1 else float("nan")
    return Estimated(float(np.mean(values)), error)


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
    outcomes: list[Outcome] = []
    try:
        start = asset.save_state()
        for index, seed in enumerate(chosen):
            if index:
                asset.restore_state(start)
            flight = fly(scenario, knowledge.twin(), knowledge.plant(knowledge.truth(seed), asset))
            outcomes.append(mission_outcome(knowledge, flight))
            if watch is not None:
                watch(seed, flight)
    finally:
        asset.close()
    return Study.of(chosen, outcomes)


@dataclass(frozen=True)
class Outcome:
    """What is kept of a mission; `error` is that of the filtered means, (T, F)."""

    delay: float
    early: bool
    error: Float
    log_evidence: float
    credible: float


def mission_outcome(knowledge: Knowledge, flight: Flight) -> Outcome:
    """Return what is kept of a mission."""
    scenario, model, truth = knowledge.scenario, knowledge.model, flight.happened.state
    first = scenario.control_names.index(scenario.mission.first_control)
    fallback = find_fallback(model, knowledge.plan.control_index, first, flight.control_index, truth)
    delay = float("nan")
    if fallback.called_for_step is not None:
        delay = float("inf") if fallback.delay is None else float(fallback.delay)
    return Outcome(
        delay=delay,
        early=fallback.early_step is not None,
        error=model.states.mean(flight.filtered) - truth,
        log_evidence=float(flight.log_evidence.mean()),
        credible=float(in_credible_set(model, flight.filtered, truth).mean()),
    )
