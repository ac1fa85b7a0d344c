"""The flight of one mission, and of many side by side.

Both give the same results to the last bit: sums run over the states, sensors and draws of one twin,
never over twins.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reporting.arrays import Float, Index
from reporting.progress import Progress, SilentProgress
from reporting.system.log import module_logger
from twin_master.assets.asset_source import Asset, StatelessAsset
from twin_master.gauges.gauge_watch import CheckedReadings, GaugeWatch, gauge_watch_of
from twin_master.gauges.watch_state import WatchState
from twin_master.mission.plant import FLIGHT_ERRORS, Plant, Truth
from twin_master.mission.preparation import Knowledge
from twin_master.mission.steps import (
    History,
    OperatedStep,
    Source,
    StepSink,
    log_notices,
    operate,
)
from twin_master.network.estimator import Notice
from twin_master.network.inference import NO_CONTROL, ExactFilter, Filtered
from twin_master.network.planner import BeliefPolicy, ration_controls
from twin_master.network.twin import LARGEST_CARRIED, Twin, unbelievable_observation
from twin_master.scenario.schema import Scenario

_logger = module_logger(__name__)

_MOST_NUMBERS_TOGETHER = 10_000_000
"""Largest number of entries in the gauge beliefs of the twins that fly side by side."""


def fly(
    scenario: Scenario,
    twin: Twin,
    plant: Plant,
    *sinks: StepSink,
    history: History | None = None,
    progress: Progress | None = None,
) -> History:
    """Fly a mission to its end, from the step that twin and plant have reached.

    If the asset ends its simulation early, the mission ends with a notice to the operator.

    Parameters
    ----------
    scenario : Scenario
        The scenario of the mission.
    twin : Twin
        The twin that assimilates and decides.
    plant : Plant
        The asset and its truth, at the same step as the twin.
    *sinks : callable
        The functions that store each step, see `operate`.
    history : History, optional
        The steps flown so far; the new ones are added to it, also if an error ends the flight.
    progress : Progress, optional
        The display of the progress in steps.

    Returns
    -------
    History
        All steps.

    Raises
    ------
    MissionInputError, ImpossibleObservation, FmuError, FiniteElementError
        If the mission cannot go on.
    """
    history = history or History(twin, scenario.observation.count)
    history.resumed_at = twin.steps
    progress = progress or SilentProgress()
    unit = f"{scenario.mission.step_name}s"
    with progress.stage("Flying", total=scenario.mission.steps, unit=unit) as stage:
        stage.advance(twin.steps)
        for step in operate(twin, plant, *sinks, log_notices):
            history.add(step)
            stage.advance(detail=scenario.control_names[step.twin_step.control_index])
    for sentence in plant.endings.values():
        history.sentence_of_early_end = sentence
        history.notices.append((twin.steps - 1, Notice("ended", sentence)))
        _logger.info("%s", sentence)
    return history


@dataclass
class Flights:
    """The steps of B twins.

    After a twin has failed or ended, its values are NaN and its control is -1.

    Attributes
    ----------
    observation_rows : (B, T, G + I) array
        The observed values, as in `History`, SI; NaN where nothing was received.
    control_index : (B, T) array
        The control in force in each step.
    state : (B, T, F) array
        The true state, SI; NaN for a real asset.
    filtered : (B, T, S) array
        The belief p(D_t | o_0..o_t).
    log_evidence : (B, T) array
        log p(o_t | o_0..o_{t-1}).
    unexplained : (B, T) array
        The probability that no state explains the sensors; 0 for twins that give no notices.
    failure : list of str
        The error that ended the flight of each twin; empty if it flew to its end.
    ended : list of str
        How the asset of each twin ended its simulation early; empty if it did not.
    notices : list of list of (int, Notice)
        The notices of each twin to its operator, with their steps.
    is_flying : (B,) array of bool
        Which twins have neither failed nor ended.
    """

    observation_rows: Float
    control_index: Index
    state: Float
    filtered: Float
    log_evidence: Float
    unexplained: Float
    failure: list[str]
    ended: list[str]
    notices: list[list[tuple[int, Notice]]]
    is_flying: NDArray[np.bool_]

    @classmethod
    def empty(cls, knowledge: Knowledge, count: int) -> "Flights":
        """Return the arrays of B missions before their first step."""
        scenario = knowledge.scenario
        steps = scenario.mission.steps
        states = knowledge.model.states.size
        return cls(
            observation_rows=np.full((count, steps, scenario.row_width), np.nan),
            control_index=np.full((count, steps), -1, dtype=np.int64),
            state=np.full((count, steps, len(scenario.state)), np.nan),
            filtered=np.full((count, steps, states), np.nan),
            log_evidence=np.full((count, steps), np.nan),
            unexplained=np.full((count, steps), np.nan),
            failure=[""] * count,
            ended=[""] * count,
            notices=[[] for _ in range(count)],
            is_flying=np.ones(count, dtype=bool),
        )

    @classmethod
    def concatenate(cls, flights: Sequence["Flights"]) -> "Flights":
        """Return the flights of several groups of twins as one, group after group."""
        if len(flights) == 1:
            return flights[0]  # without a copy of its arrays
        return cls(
            observation_rows=np.concatenate([formation.observation_rows for formation in flights]),
            control_index=np.concatenate([formation.control_index for formation in flights]),
            state=np.concatenate([formation.state for formation in flights]),
            filtered=np.concatenate([formation.filtered for formation in flights]),
            log_evidence=np.concatenate([formation.log_evidence for formation in flights]),
            unexplained=np.concatenate([formation.unexplained for formation in flights]),
            failure=list(chain.from_iterable(formation.failure for formation in flights)),
            ended=list(chain.from_iterable(formation.ended for formation in flights)),
            notices=list(chain.from_iterable(formation.notices for formation in flights)),
            is_flying=np.concatenate([formation.is_flying for formation in flights]),
        )

    def fail(self, twin: int, sentence: str) -> None:
        """Record the error that ends the flight of a twin."""
        self.failure[twin] = sentence
        self.is_flying[twin] = False

    def store_step(self, step: "OperatedStep[StepOfTwins]") -> None:
        """Store a step of the twins that are still flying."""
        beliefs = step.twin_step
        is_flying = self.is_flying
        ground_truth = step.reading.ground_truth
        assert ground_truth is not None  # the assets are simulated
        self.observation_rows[is_flying, beliefs.step] = step.reading.observed[is_flying]
        self.control_index[is_flying, beliefs.step] = beliefs.control_index[is_flying]
        self.state[is_flying, beliefs.step] = ground_truth.state[is_flying]
        self.filtered[is_flying, beliefs.step] = beliefs.filtered[is_flying]
        self.log_evidence[is_flying, beliefs.step] = beliefs.log_evidence[is_flying]
        self.unexplained[is_flying, beliefs.step] = beliefs.unexplained[is_flying]

    def store_history(self, twin: int, history: History) -> None:
        """Copy the steps that one twin has flown into the arrays of all missions."""
        steps_flown = len(history.steps)
        if steps_flown > 0:
            self.observation_rows[twin, :steps_flown] = history.observation_rows
            self.control_index[twin, :steps_flown] = history.control_index
            self.filtered[twin, :steps_flown] = history.filtered
            self.log_evidence[twin, :steps_flown] = history.log_evidence
            self.unexplained[twin, :steps_flown] = history.unexplained
        if history.simulated:
            self.state[twin, :steps_flown] = history.state
        if history.sentence_of_early_end:
            self.ended[twin] = history.sentence_of_early_end
            self.is_flying[twin] = False
        self.notices[twin] = history.notices


def fly_side_by_side(
    knowledge: Knowledge, truths: Sequence[Truth], assets: Sequence[Asset]
) -> Flights:
    """Fly B missions of one scenario: side by side, or one by one if an asset has a memory.

    Missions that fly side by side make each step together, in groups that fit into memory.

    Parameters
    ----------
    knowledge : Knowledge
        The knowledge of all twins; the scenario does not learn.
    assets : sequence of Asset
        The asset of each twin, at its start; twins may share one without memory.

    Raises
    ------
    InvalidObservationError
        If an observation is infinite, or so improbable that no belief can be computed. Flown one by
        one, only its own twin fails.
    """
    if not all(isinstance(asset, StatelessAsset) for asset in assets):
        return fly_one_by_one(knowledge, truths, lambda twin, _previous_ended_well: assets[twin])
    group_size = len(truths)
    watch = gauge_watch_of(knowledge.estimator)
    if watch is not None:
        group_size = max(1, _MOST_NUMBERS_TOGETHER // watch.faults.belief_size)
    formations = []
    for first in range(0, len(truths), group_size):
        truth = Truth.stack(truths[first : first + group_size])
        plant = knowledge.plant(truth, *assets[first : first + group_size])
        formations.append(fly_formation(knowledge, plant, plant))
    return Flights.concatenate(formations)


def fly_formation(knowledge: Knowledge, plant: Plant, source: Source["TwinsSideBySide"]) -> Flights:
    """Fly B missions side by side.

    Parameters
    ----------
    plant : Plant
        The assets, at the start of the missions.
    source : Source
        The source of the observations: the plant, or what changes its readings.
    """
    flights = Flights.empty(knowledge, len(plant.is_flying))
    flights.is_flying = plant.is_flying  # one array: a twin that fails stops its asset as well
    twins = TwinsSideBySide(knowledge.scenario, knowledge.twin(), flights)
    for _ in operate(twins, source, flights.store_step):
        pass
    for mission, sentence in plant.failures.items():
        flights.failure[mission] = sentence
    for mission, sentence in plant.endings.items():
        flights.ended[mission] = sentence
    return flights


@dataclass(frozen=True)
class StepOfTwins:
    """The beliefs of B twins after a step.

    Attributes
    ----------
    step : int
        The number of the step, from 0.
    control_index : (B,) array
        The control in force.
    filtered : (B, S) array
        The belief p(D_t | o_0..o_t), averaged over the hypotheses about gauges.
    log_evidence : (B,) array
        log p(o_t | o_0..o_{t-1}).
    unexplained : (B,) array
        The probability that no state explains the sensors.
    """

    step: int
    control_index: Index
    filtered: Float
    log_evidence: Float
    unexplained: Float


class TwinsSideBySide:
    """B twins of one scenario that assimilate and decide together, as `Twin` does alone.

    Parameters
    ----------
    twin : Twin
        A twin before its first observation: all have its model, sensors and policy.

    Attributes
    ----------
    steps : int
        The number of steps so far.
    previous_control, proposed_control : (B,) array
        The indices of the controls in force in the last step, and of those for the next one.
    """

    def __init__(self, scenario: Scenario, twin: Twin, flights: Flights) -> None:
        self._scenario = scenario
        count = len(flights.is_flying)
        self.steps = 0
        self.previous_control: Index = np.full(count, NO_CONTROL)
        self.proposed_control: Index = np.full(count, twin.proposed_control)
        self._proposals: Index = np.zeros(count, dtype=np.int64)
        self._twin = twin
        self._flights = flights
        self._filter = ExactFilter(twin.model, twin.sensor_model, twin.name)
        self._log_belief: Float = twin.model.log_prior
        self._inspecting_controls = sorted(
            {reading.control_index for reading in self._scenario.inspection_readings}
        )
        self._watch = gauge_watch_of(twin.estimator)
        self._watch_state: WatchState | None = None

    def step(self, observation: ArrayLike, control: ArrayLike | None = None) -> StepOfTwins:
        """Filter the observations of a step, and decide on the next controls.

        Parameters
        ----------
        observation : (B, G + I) array
            The values of G sensors and I inspections, SI; NaN where nothing was received.
        control : (B,) array, optional
            The indices of the controls in force; the proposed ones if left out.

        Raises
        ------
        InvalidObservationError
            If an observation is infinite, or so improbable that no belief can be computed.
        """
        rows = np.asarray(observation)
        controls = self.proposed_control if control is None else np.asarray(control)

        # The beliefs: under the model and, with notices, averaged over the faults of gauges.
        checked = None
        if self._watch is not None:
            checked = self._watch.exclude_useless_readings(self._watch_state, rows, controls)
        used_rows = rows if checked is None else checked.rows
        model_beliefs, errors = self._filter.step_of_twins(
            self._log_belief, self.previous_control, used_rows, controls, self.steps
        )
        for twin, error in errors.items():
            self._flights.fail(twin, str(error))
        beliefs = model_beliefs.filtered
        unexplained = np.zeros(len(beliefs))
        if self._watch is not None and checked is not None:
            watch_state = self._watch_gauges(self._watch, checked, model_beliefs)
            beliefs = watch_state.mixed.belief
            unexplained = watch_state.weights.free_gains_probability

        twin_step = StepOfTwins(
            self.steps, controls, beliefs, model_beliefs.log_evidence, unexplained
        )
        self._log_belief = model_beliefs.log_filtered
        self.steps += 1
        self.previous_control = controls
        self.proposed_control = self._decide(beliefs, unexplained)
        return twin_step

    def _watch_gauges(
        self, watch: GaugeWatch, checked: CheckedReadings, model_beliefs: Filtered
    ) -> WatchState:
        """Update the watch over the gauges, record notices of flying twins, and return its state.

        Raises
        ------
        InvalidObservationError
            If the belief of a twin is not finite.
        """
        state, notices = watch.step(
            self._watch_state,
            checked,
            model_beliefs.forecast,
            model_beliefs.filtered,
            self.previous_control,
            self.steps,
        )
        is_flying = self._flights.is_flying
        if np.any(is_flying & ~state.is_finite(LARGEST_CARRIED)):
            raise unbelievable_observation(self._twin.name, self.steps)
        for twin in np.flatnonzero(is_flying).tolist():
            self._flights.notices[twin] += [(self.steps, notice) for notice in notices[twin]]
        self._watch_state = state
        return state

    def _decide(self, beliefs: Float, unexplained: Float) -> Index:
        """Return the next control (B,) of each twin, within the budget of inspections."""
        rule = self._twin.decision_rule
        probability = rule.probabilities(beliefs, self.previous_control, unexplained)
        _, control, self._proposals = rule.decide(
            probability, self.previous_control, self._proposals
        )
        budget = self._scenario.planner.inspections_per_step
        policy_on_belief = rule.on_belief
        if budget is not None and isinstance(policy_on_belief, BeliefPolicy):
            flying = np.flatnonzero(self._flights.is_flying)
            control[flying] = ration_controls(
                self._twin.model.transition,
                beliefs[flying],
                self.previous_control[flying],
                control[flying],
                policy_on_belief,
                self._inspecting_controls,
                budget,
            )
        return control


def fly_one_by_one(
    knowledge: Knowledge, truths: Sequence[Truth], asset_of: Callable[[int, bool], Asset]
) -> Flights:
    """Fly B missions one after the other, as assets with a memory and twins that learn need it.

    Parameters
    ----------
    asset_of : callable
        Returns the asset of a twin at its start. It takes the number of the twin, and whether the
        flight before it went to its end.
    """
    flights = Flights.empty(knowledge, len(truths))
    previous_ended_well = True
    for number, truth in enumerate(truths):
        twin = knowledge.twin()
        history = History(twin, knowledge.scenario.observation.count)
        try:
            asset = asset_of(number, previous_ended_well)
            fly(knowledge.scenario, twin, knowledge.plant(truth, asset), history=history)
        except FLIGHT_ERRORS as error:
            flights.fail(number, str(error))
        flights.store_history(number, history)
        previous_ended_well = bool(flights.is_flying[number])
    return flights
