"""Many twins of one scenario, flown together; each gives the results of `fly`, to the last bit.

The results of a twin do not depend on the number of twins: sums run over the states, sensors and
draws of one twin, never over twins.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from fe.runtime.errors import FiniteElementError
from fmu_asset.errors import FmuError
from reporting.arrays import Float, Index
from twin_master.assets.asset_source import Asset, StatelessAsset
from twin_master.errors import TwinMasterError
from twin_master.learning.gauge_watch import CheckedReadings, GaugeWatch
from twin_master.learning.monitor import gauge_watch_of
from twin_master.learning.watch_state import WatchState
from twin_master.mission.loop import early_end_sentence, fly
from twin_master.mission.preparation import Knowledge
from twin_master.mission.steps import History, Truth, checked_observation, sentence_of_ending_action
from twin_master.network.estimator import ExactFilter, Notice
from twin_master.network.inference import NO_CONTROL, Filtered
from twin_master.network.planner import decision_probability, ration_controls
from twin_master.network.twin import LARGEST_CARRIED, unbelievable_observation

FLIGHT_ERRORS = (TwinMasterError, FmuError, FiniteElementError, CalibrationError, OSError)
"""Errors that end the flight of one asset, but not the flights of the others."""
_MOST_NUMBERS_TOGETHER = 10_000_000
"""Numbers of four bytes in the beliefs about gauges of the twins that fly together."""


@dataclass
class Flights:
    """The histories of B twins.

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

    @classmethod
    def empty(cls, knowledge: Knowledge, count: int) -> "Flights":
        """Return B missions before their first step."""
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
        )

    @classmethod
    def concatenate(cls, flights: Sequence["Flights"]) -> "Flights":
        """Return the flights of several formations as those of one, formation after formation."""
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
        )

    def store_history(self, twin: int, history: History) -> None:
        """Store the steps of one twin."""
        steps_flown = len(history.steps)
        if steps_flown > 0:
            self.observation_rows[twin, :steps_flown] = history.observation_rows
            self.control_index[twin, :steps_flown] = history.control_index
            self.filtered[twin, :steps_flown] = history.filtered
            self.log_evidence[twin, :steps_flown] = history.log_evidence
            self.unexplained[twin, :steps_flown] = history.unexplained
        if history.simulated:
            self.state[twin, :steps_flown] = history.state
        self.ended[twin] = history.sentence_of_early_end
        self.notices[twin] = history.notices


class _TrueStates(NamedTuple):
    """The true states of B assets.

    Attributes
    ----------
    state_index : (B,) array
        The indices of the states; zeros if the states are scripted.
    state : (B, F) array
        The value of each state factor, SI.
    """

    state_index: Index
    state: Float


class _StatelessAssets:
    """Assets without memory: each is evaluated once for each control and state, and then reused."""

    def __init__(
        self, knowledge: Knowledge, truths: Sequence[Truth], assets: Sequence[Asset]
    ) -> None:
        self._scenario = knowledge.scenario
        self._states = knowledge.model.states
        distinct_assets = {id(asset): asset for asset in assets}
        self._assets = list(distinct_assets.values())
        numbers = {key: number for number, key in enumerate(distinct_assets)}
        self._asset_of_twin = np.array([numbers[id(asset)] for asset in assets])
        self._truth = Truth.stack(truths)
        self._previous_control: Index | None = None
        self._previous_state_index: Index | None = None
        self._previous_sensed: Float | None = None
        # What an asset shows under a control in a state, or the sentence why it shows nothing.
        self._observations: dict[tuple[int, int, bytes], Float | str] = {}

    def fly_step(
        self, step: int, control: Index, is_flying: NDArray[np.bool_], failure: list[str]
    ) -> tuple[Float, Float]:
        """Fly one step of all twins.

        Parameters
        ----------
        step : int
            The step, from 0.
        control : (B,) array
            The control in force for each twin.
        is_flying : (B,) array of bool
            Whether the twin is still flying.
        failure : list of str
            The error of each twin, empty if there is none; errors of assets are written into it.

        Returns
        -------
        (B, G + I) array
            The observed values, SI.
        (B, F) array
            The true states, SI.
        """
        true_states = self._advance(step, control)
        # Twins with the same asset, control and state share one observation.
        code = self._asset_of_twin * len(self._scenario.control) + control
        code = code * self._states.size + true_states.state_index
        _, first_twins, group_of_twin = np.unique(
            np.where(is_flying, code, -1), return_index=True, return_inverse=True
        )
        observations = np.full((len(first_twins), self._scenario.observation.count), np.nan)
        for group, twin in enumerate(first_twins.tolist()):
            asset = int(self._asset_of_twin[twin])
            observation = self._observe(step, asset, int(control[twin]), true_states.state[twin])
            if isinstance(observation, str):
                for failing_twin in np.flatnonzero((group_of_twin == group) & is_flying):
                    failure[failing_twin] = observation
            else:
                observations[group] = observation
        sensed = self._truth.sense(step, observations[group_of_twin], self._previous_sensed)
        self._previous_sensed = sensed
        inspected = self._truth.inspect(step, true_states.state, control)
        return np.hstack((sensed, inspected)), true_states.state

    def _advance(self, step: int, control: Index) -> _TrueStates:
        """Return the true states in a step: scripted, or drawn given the previous states."""
        if self._scenario.truth.kind == "scripted":
            state = self._truth.state(step, None, None)
            return _TrueStates(
                np.zeros_like(control), np.broadcast_to(state, (len(control), len(state)))
            )
        state_index = self._truth.growth.next_states(
            self._previous_control, self._previous_state_index, self._truth.uniform[step]
        )
        self._previous_control = control
        self._previous_state_index = state_index
        return _TrueStates(state_index, self._states.coordinates[state_index])

    def _observe(self, step: int, asset: int, control_index: int, state: Float) -> Float | str:
        """Return the values of an asset's G sensors without noise, SI, or the text of its error."""
        key = (asset, control_index, state.tobytes())
        if key not in self._observations:
            control = self._scenario.control[control_index]
            health = dict(zip(self._scenario.state_names, state.tolist(), strict=True))
            try:
                reading = self._assets[asset].step(control.values, health)
                observation: Float | str = checked_observation(
                    self._scenario, reading, step, control.name
                )
            except FLIGHT_ERRORS as error:
                observation = str(error)
            self._observations[key] = observation
        return self._observations[key]


def fly_side_by_side(
    knowledge: Knowledge, truths: Sequence[Truth], assets: Sequence[Asset]
) -> Flights:
    """Fly B missions of one scenario, step by step together, or one by one if assets have a memory.

    Parameters
    ----------
    knowledge : Knowledge
        The knowledge of all twins; the scenario does not learn.
    truths : sequence of Truth
        The truth of each twin.
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
    size = len(truths)
    watch = gauge_watch_of(knowledge.estimator)
    if watch is not None:
        size = max(1, _MOST_NUMBERS_TOGETHER // watch.faults.belief_size)
    flights = []
    for first in range(0, len(truths), size):
        formation = _Formation(
            knowledge, truths[first : first + size], assets[first : first + size]
        )
        for step in range(knowledge.scenario.mission.steps):
            formation.fly_step(step)
        flights.append(formation.flights)
    return Flights.concatenate(flights)


class _Formation:
    """B twins that fly the same step at the same time.

    Attributes
    ----------
    flights : Flights
        The histories of the twins so far.
    """

    def __init__(
        self, knowledge: Knowledge, truths: Sequence[Truth], assets: Sequence[Asset]
    ) -> None:
        scenario = knowledge.scenario
        count = len(truths)
        self.flights = Flights.empty(knowledge, count)
        self._knowledge = knowledge
        self._assets = _StatelessAssets(knowledge, truths, assets)
        first_control = scenario.control_names.index(scenario.mission.first_control)
        self._control = np.full(count, first_control)
        self._previous_control: Index = np.full(count, NO_CONTROL)
        self._filter = ExactFilter(knowledge.model, knowledge.sensor_model, scenario.mission.name)
        self._log_belief: Float = knowledge.model.log_prior
        self._is_flying = np.ones(count, dtype=bool)
        self._ends_mission = np.array(
            [scenario.ends(index) for index in range(len(scenario.control))]
        )
        self._inspecting_controls = sorted(
            {reading.control_index for reading in scenario.inspection_readings}
        )
        self._watch = gauge_watch_of(knowledge.estimator)
        self._watch_state: WatchState | None = None

    def fly_step(self, step: int) -> None:
        """Fly one step of all twins, filter its observations, and decide on the next control.

        What was flown is stored in `flights`.
        """
        if step > 0:
            self._end_missions(step)
        observed_rows, state = self._assets.fly_step(
            step, self._control, self._is_flying, self.flights.failure
        )
        self._is_flying &= np.array(self.flights.failure) == ""
        observed_rows[~self._is_flying] = np.nan

        # The beliefs: under the model and, with notices, averaged over the faults of gauges.
        checked = None
        if self._watch is not None:
            checked = self._watch.leave_out_useless_readings(
                self._watch_state, observed_rows, self._control
            )
        used_rows = observed_rows if checked is None else checked.rows
        model_beliefs, errors = self._filter.step_of_twins(
            self._log_belief, self._previous_control, used_rows, self._control, step
        )
        for twin, error in errors.items():
            self.flights.failure[twin] = self.flights.failure[twin] or str(error)
            self._is_flying[twin] = False
        beliefs = model_beliefs.filtered
        unexplained = np.zeros(len(beliefs))
        if self._watch is not None and checked is not None:
            watch_state = self._watch_gauges(self._watch, step, checked, model_beliefs)
            beliefs = watch_state.mixed.belief
            unexplained = watch_state.weights.free_gains_probability

        # Store the step of the twins that are still flying.
        is_flying = self._is_flying
        flights = self.flights
        flights.observation_rows[is_flying, step] = observed_rows[is_flying]
        flights.control_index[is_flying, step] = self._control[is_flying]
        flights.state[is_flying, step] = state[is_flying]
        flights.filtered[is_flying, step] = beliefs[is_flying]
        flights.log_evidence[is_flying, step] = model_beliefs.log_evidence[is_flying]
        flights.unexplained[is_flying, step] = unexplained[is_flying]

        self._log_belief = model_beliefs.log_filtered
        self._previous_control = self._control
        self._control = self._decide(beliefs, unexplained)

    def _end_missions(self, step: int) -> None:
        """End the missions whose last control was an action that ends them."""
        ends_now = self._is_flying & self._ends_mission[self._previous_control]
        for twin in np.flatnonzero(ends_now).tolist():
            scenario = self._knowledge.scenario
            reason = sentence_of_ending_action(scenario, self._previous_control[twin])
            self.flights.ended[twin] = early_end_sentence(scenario, step, reason)
            self._is_flying[twin] = False

    def _watch_gauges(
        self, watch: GaugeWatch, step: int, checked: CheckedReadings, model_beliefs: Filtered
    ) -> WatchState:
        """Return the state of the watch after a step, and store its notices in `flights.notices`.

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
            self._previous_control,
            step,
        )
        if np.any(self._is_flying & ~state.is_finite(LARGEST_CARRIED)):
            raise unbelievable_observation(self._knowledge.scenario.mission.name, step)
        for twin in np.flatnonzero(self._is_flying).tolist():
            self.flights.notices[twin] += [(step, notice) for notice in notices[twin]]
        self._watch_state = state
        return state

    def _decide(self, filtered_belief: Float, unexplained: Float) -> Index:
        """Return the next control of each of B twins, within the budget of inspections.

        With the probability (B,) that no state explains the sensors, the safest control is taken.
        """
        knowledge = self._knowledge
        planner = knowledge.scenario.planner
        policy_on_belief = knowledge.plan.on_belief
        safest = None
        if self._watch is not None:
            safest = np.eye(len(knowledge.model.controls))[knowledge.safest_control]
        probability = decision_probability(
            knowledge.model.transition,
            filtered_belief,
            self._previous_control,
            knowledge.plan.policy,
            policy_on_belief,
            ahead=planner.decide_on == "predicted",
            unexplained=unexplained,
            safest=safest,
        )
        control = np.argmax(probability, axis=1)
        if planner.inspections_per_step is not None and policy_on_belief is not None:
            flying = np.flatnonzero(self._is_flying)
            control[flying] = ration_controls(
                knowledge.model.transition,
                filtered_belief[flying],
                self._previous_control[flying],
                control[flying],
                policy_on_belief,
                self._inspecting_controls,
                planner.inspections_per_step,
            )
        return np.asarray(control)


def fly_one_by_one(
    knowledge: Knowledge, truths: Sequence[Truth], asset_of: Callable[[int, bool], Asset]
) -> Flights:
    """Fly B missions one after the other with `fly`.

    This is needed for assets with a memory, and for twins that learn.

    Parameters
    ----------
    knowledge : Knowledge
        The knowledge of all twins.
    truths : sequence of Truth
        The truth of each twin.
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
            flights.failure[number] = str(error)
        flights.store_history(number, history)
        previous_ended_well = not flights.failure[number] and not history.sentence_of_early_end
    return flights
