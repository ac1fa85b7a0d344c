"""The steps of a mission, and its ground truth: damage, noise, sensor faults, the asset."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmu_asset.errors import FmuEndedError
from reporting.arrays import AnyArray, Float, Index
from twin_master.assets.asset_source import Asset, AssetReading
from twin_master.errors import MissionInputError, TwinMasterError
from twin_master.network.estimator import Notice, Suspicion
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.twin import Twin, TwinStep
from twin_master.scenario.schema import Scenario
from twin_master.seeds import generator


class GroundTruth(NamedTuple):
    """What really happened in a step: for store and journal, never for the twin.

    Attributes
    ----------
    state : (F,) array
        The true value of each state factor, SI.
    observation : (G,) array
        The observation without noise, SI.
    monitors : dict of str to float
        The figures that the asset reports of itself, such as an error bound.
    """

    state: Float
    observation: Float
    monitors: Mapping[str, float]


@dataclass(frozen=True)
class Reading:
    """An observation that the twin is to assimilate.

    Attributes
    ----------
    observed : (G + I,) array
        The values of G sensors and I inspections, SI; NaN where nothing was received.
    control : int or None
        The index of the control in force; None is the one that the twin proposed.
    revises : int or None
        The earlier step that the observation belongs to; None is the next step.
    unreadable : dict of int to str
        The content that a sensor sent in the place of a number, by the index of the sensor.
    ground_truth : GroundTruth or None
        The true state and values in the step; None for a real asset.
    """

    observed: Float
    control: int | None = None
    revises: int | None = None
    unreadable: Mapping[int, str] = field(default_factory=dict)
    ground_truth: GroundTruth | None = None


@dataclass(frozen=True)
class MissionStep:
    """A step of a mission or a watch.

    Attributes
    ----------
    reading : Reading
        The observation of the step.
    twin_step : TwinStep
        The estimate and the decision of the twin.
    seconds : tuple of float
        The wall-clock time of the source, of the twin, and of storing the step.
    """

    reading: Reading
    twin_step: TwinStep
    seconds: tuple[float, float, float] = (0.0, 0.0, 0.0)


class _StackedAttribute:
    """An attribute of all steps of a `History`, stacked along the first axis of an array."""

    def __init__(self, path: str) -> None:
        self._attribute_of = attrgetter(path)

    def __get__(self, history: "History", _owner: type) -> AnyArray:
        return np.array([self._attribute_of(step) for step in history.steps])


@dataclass
class History:
    """The steps of one twin in their order.

    T is the number of steps, G that of sensors, I that of values after them in a row.

    Attributes
    ----------
    twin : Twin
        The twin; it must keep all steps if they are to be smoothed.
    sensors : int
        The number of sensors G; after their values, a row holds the I readings of inspections, or
        the covariance of identified modes.
    steps : list of MissionStep
        The steps.
    notices : list of (int, Notice)
        The notices to the operator, each with the number of its step.
    resumed_at : int
        The number of steps that an earlier process flew.
    sentence_of_early_end : str
        How the asset ended the mission before its last step; empty if it did not.
    observation_rows : (T, G + I) array
        All observed values, NaN where nothing was received; `observed` and `readings` are its
        parts.
    control_index, log_evidence, filtered, predicted, decision_probability, unexplained : (T, ...)
    array
        The attributes of `TwinStep`.
    state, observation : (T, ...) array
        The attributes of `GroundTruth`; only for a simulated asset.
    seconds : (T, 3) array
        The times of `MissionStep`.
    """

    twin: Twin
    sensors: int
    steps: list[MissionStep] = field(default_factory=list)
    notices: list[tuple[int, Notice]] = field(default_factory=list)
    resumed_at: int = 0
    sentence_of_early_end: str = ""

    observation_rows = _StackedAttribute("reading.observed")
    control_index = _StackedAttribute("twin_step.control_index")
    filtered = _StackedAttribute("twin_step.filtered")
    log_evidence = _StackedAttribute("twin_step.log_evidence")
    predicted = _StackedAttribute("twin_step.prediction.predicted")
    decision_probability = _StackedAttribute("twin_step.decision_probability")
    unexplained = _StackedAttribute("twin_step.unexplained")
    state = _StackedAttribute("reading.ground_truth.state")
    observation = _StackedAttribute("reading.ground_truth.observation")
    seconds = _StackedAttribute("seconds")

    def add(self, step: MissionStep) -> None:
        """Append a step and its notices.

        The joint prediction of states and controls is dropped: it is large, and it follows from the
        rest of the step.
        """
        prediction = replace(step.twin_step.prediction, joint=np.empty(0))
        twin_step = replace(step.twin_step, prediction=prediction)
        self.steps.append(replace(step, twin_step=twin_step))
        for notice in twin_step.notices:
            self.notices.append((twin_step.step, notice))

    def without_first(self, count: int) -> "History":
        """Return a copy without the first `count` steps; it has the notices of all steps."""
        return replace(self, steps=self.steps[count:])

    @property
    def first_step(self) -> int:
        """The number of the first step."""
        return self.steps[0].twin_step.step if self.steps else 0

    @property
    def observed(self) -> Float:
        """The values of the sensors (T, G), NaN where nothing was received."""
        return self.observation_rows[:, : self.sensors]

    @property
    def readings(self) -> Float:
        """The values after those of the sensors (T, I): of inspections, or a covariance."""
        return self.observation_rows[:, self.sensors :]

    @property
    def simulated(self) -> bool:
        """Whether the ground truth of the steps is known, as for a simulated asset."""
        return bool(self.steps) and self.steps[0].reading.ground_truth is not None

    @property
    def monitors(self) -> dict[str, Float]:
        """The figures that the asset reports of itself, each as an array (T,)."""
        records = []
        for step in self.steps:
            if step.reading.ground_truth is not None:
                records.append(step.reading.ground_truth.monitors)
        if not records:
            return {}
        return {name: np.array([record[name] for record in records]) for name in records[-1]}

    @cached_property
    def smoothed(self) -> Float:
        """The belief p(D_k | all observations) in each step (T, S)."""
        return self.twin.smoothed()[-len(self.steps) :]

    @property
    def suspicion(self) -> tuple[Suspicion, ...]:
        """How well the model explained the sensors in each step; empty if that is not watched."""
        suspicions = (step.twin_step.suspicion for step in self.steps)
        return tuple(suspicion for suspicion in suspicions if suspicion is not None)

    @property
    def learnt_names(self) -> tuple[str, ...]:
        """The names of the quantities that the twin learns."""
        return tuple(self.steps[-1].twin_step.learnt) if self.steps else ()

    @property
    def learnt(self) -> Float:
        """The posterior of N learnt quantities in each step (T, N, 4), see `Learnt.figures`."""
        figures = []
        for step in self.steps:
            figures.append([posterior.figures for posterior in step.twin_step.learnt.values()])
        return np.array(figures).reshape(len(self.steps), len(self.learnt_names), 4)


class SensorStatus(IntEnum):
    """The true condition of a sensor in a step, which the twin does not know."""

    HEALTHY = 0
    LOST = 1
    DRIFTING = 2
    STUCK = 3


_STATUS_OF_FAULT = {
    "drift": SensorStatus.DRIFTING,
    "stuck": SensorStatus.STUCK,
    "dropout": SensorStatus.LOST,
}
"""The status of a sensor with a fault of each kind; a later one hides those before it."""


class Truth:
    """Damage history, sensor noise and sensor faults of one mission.

    All random numbers are drawn at construction, so that a resumed mission meets the same ones.

    Parameters
    ----------
    scenario : Scenario
        The scenario of the mission.
    model : GraphicalModel
        The states, and the transitions that random growth of damage follows.
    seed : int
        The seed of the mission.

    Attributes
    ----------
    noise : (T, G) array
        The noise added to the observation of each step and sensor, SI.
    drift : (T, G) array
        The drift added to it, SI.
    status : (T, G) array
        The `SensorStatus` of each sensor.
    reading_noise : (T, I) array
        The noise added to the readings of inspections, SI.
    uniform : (T,) array
        The uniform random numbers that drive random growth; zeros if damage is scripted.
    growth : DamageGrowth
        How damage grows at random.
    in_asset : bool
        Whether the asset itself carries damage, noise and faults. Then the arrays above are zero,
        and the asset reports what happened.
    """

    def __init__(self, scenario: Scenario, model: GraphicalModel, seed: int) -> None:
        steps = scenario.mission.steps
        sensors = scenario.observation.count
        deviation = np.asarray(scenario.truth.noise.standard_deviation)  # () or (G,)
        self.noise: Float = generator(seed, "noise").standard_normal((steps, sensors)) * deviation
        self.drift: Float = np.zeros((steps, sensors))
        self.status: NDArray[np.int8] = np.zeros((steps, sensors), dtype=np.int8)
        self._apply_faults(scenario)
        self._inspections = scenario.inspection_readings
        standard_noise = generator(seed, "inspection").standard_normal(
            (steps, len(self._inspections))
        )
        deviations = [reading.standard_deviation for reading in self._inspections]
        self.reading_noise: Float = standard_noise * deviations
        self.in_asset = scenario.truth.kind == "asset"
        is_scripted = scenario.truth.kind == "scripted"
        self._scripted_states = scenario.scripted_history() if is_scripted else None
        grows_at_random = scenario.truth.kind == "random_growth"
        damage_generator = generator(seed, "damage")
        self.uniform: Float = damage_generator.random(steps) if grows_at_random else np.zeros(steps)
        self._states = model.states
        self.growth = DamageGrowth(model)

    def _apply_faults(self, scenario: Scenario) -> None:
        """Set `status` and `drift` in the steps and sensors of the scenario's sensor faults."""
        steps = np.arange(scenario.mission.steps)
        hidden_first = [*_STATUS_OF_FAULT]
        faults = scenario.truth.sensor_faults
        for fault in sorted(faults, key=lambda fault: hidden_first.index(fault.kind)):
            last_step = fault.last_step if fault.last_step is not None else scenario.mission.steps
            is_active = (steps >= fault.first_step) & (steps <= last_step)
            sensors = np.array(fault.sensor_indices(scenario.observation.count))
            cells = np.ix_(is_active, sensors)
            if fault.rate is not None:  # the schema asks for it if the sensors drift
                # The drift grows by the rate in each step, from the first step of the fault on.
                steps_of_drift = steps[is_active] - fault.first_step + 1.0
                self.drift[cells] += (fault.rate * steps_of_drift)[:, None]
            self.status[cells] = _STATUS_OF_FAULT[fault.kind]

    def state(self, step: int, previous_state: Float | None, previous_control: int | None) -> Float:
        """Return the true state of a step.

        Parameters
        ----------
        step : int
            The step, from 0.
        previous_state : (F,) array or None
            The state of the step before; None at step 0.
        previous_control : int or None
            The index of the control of the step before; None at step 0.

        Returns
        -------
        (F,) array
            The value of each state factor, SI.
        """
        if self._scripted_states is not None:
            return np.array(self._scripted_states[step])
        previous_indices = controls = None
        if previous_state is not None:
            previous_indices = np.array([self._states.index(tuple(previous_state))])
        if previous_control is not None:
            controls = np.array([previous_control])
        state_index = self.growth.next_states(controls, previous_indices, self.uniform[[step]])
        return np.asarray(self._states.coordinates[state_index][0])

    @classmethod
    def stack(cls, truths: Sequence["Truth"]) -> "Truth":
        """Return one truth for B missions of one scenario.

        Its random numbers have the shape (T, B, ...). Script, drift and losses are those of the
        scenario, the same in all missions.
        """
        stacked = copy(truths[0])  # script, drift and losses are the same in all missions
        for name in ("noise", "uniform", "reading_noise"):
            setattr(stacked, name, np.stack([getattr(truth, name) for truth in truths], axis=1))
        return stacked

    def sense(self, step: int, observation: Float, previous: Float | None) -> Float:
        """Return an observation (..., G) with noise and drift, and the faults of its sensors.

        Parameters
        ----------
        step : int
            The step, from 0.
        observation : (..., G) array
            The observation without noise, SI.
        previous : (..., G) array or None
            What was sensed in the step before, SI; None in the first step.

        Returns
        -------
        (..., G) array
            The sensed values, SI. A lost sensor has NaN, and a stuck one its value of the step
            before, if it had any.
        """
        sensed: Float = observation + self.noise[step] + self.drift[step]
        if previous is not None:
            is_held = (self.status[step] == SensorStatus.STUCK) & ~np.isnan(previous)
            sensed = np.where(is_held, previous, sensed)
        sensed[..., self.status[step] == SensorStatus.LOST] = np.nan
        return sensed

    def noise_free(self, step: int, sensed: Float) -> Float:
        """Return sensed values (G,) without noise and drift, up to rounding; 0 for lost sensors.

        Stuck sensors have any value.
        """
        return np.asarray(np.nan_to_num(sensed - self.drift[step] - self.noise[step]))

    def inspect(self, step: int, state: Float, control: Index | int) -> Float:
        """Return the readings of inspections in a step.

        Parameters
        ----------
        step : int
            The step, from 0.
        state : (..., F) array
            The true states, SI.
        control : int or (...) array of int
            The indices of the controls in force.

        Returns
        -------
        (..., I) array
            The readings with noise, SI; NaN if the control does not ask for the inspection.
        """
        columns = []
        for reading in self._inspections:
            is_asked_for = control == reading.control_index
            columns.append(np.where(is_asked_for, state[..., reading.state_index], np.nan))
        # The shape is given because there may be no inspections.
        by_inspection = np.reshape(columns, (len(columns), *state.shape[:-1]))
        return np.asarray(np.moveaxis(by_inspection, 0, -1) + self.reading_noise[step])


class _NextStates(NamedTuple):
    """The states that may follow a state under a control, and their cumulative probability."""

    cumulative_probability: Float
    state_indices: Index


class DamageGrowth:
    """Damage that follows the prior and the transitions of a model."""

    def __init__(self, model: GraphicalModel) -> None:
        self._model = model
        self._initial = _possible_states(model.prior)
        self._next_states: dict[tuple[int, int], _NextStates] = {}

    def next_states(self, control: Index | None, state: Index | None, uniform: Float) -> Index:
        """Return the indices (B,) of the states that follow states under controls.

        Parameters
        ----------
        control : (B,) array or None
            The indices of the controls; None at the first step, which is drawn from the prior.
        state : (B,) array or None
            The indices of the states; None at the first step.
        uniform : (B,) array
            The random numbers, uniform in [0, 1).
        """
        if control is None or state is None:
            return _draw(self._initial, uniform)
        next_states = np.empty_like(state)
        # Missions with the same control in the same state are drawn together.
        code = control * self._model.states.size + state
        for pair_code in np.unique(code).tolist():
            has_code = code == pair_code
            next_states[has_code] = _draw(self._states_after(pair_code), uniform[has_code])
        return next_states

    def _states_after(self, code: int) -> _NextStates:
        """Return the possible next states of a pair, coded as control * S + state."""
        control, state = divmod(code, self._model.states.size)
        if (control, state) not in self._next_states:
            probability = self._model.transition.row(control, state)
            self._next_states[control, state] = _possible_states(probability)
        return self._next_states[control, state]


def _possible_states(probability: Float) -> _NextStates:
    """Return the states that have a positive probability, with their cumulative probability."""
    possible_states = np.flatnonzero(probability > 0.0)
    return _NextStates(np.cumsum(probability[possible_states]), possible_states)


def _draw(states: _NextStates, uniform: Float) -> Index:
    """Return a state for each uniform random number, by inverse transform sampling."""
    # Rounding may leave the last cumulative probability a little below one.
    last_position = len(states.state_indices) - 1
    position = np.searchsorted(states.cumulative_probability, uniform, side="right").clip(
        max=last_position
    )
    return np.asarray(states.state_indices[position])


def checked_observation(
    scenario: Scenario, reading: AssetReading, step: int, control: str
) -> Float:
    """Return the observation (G,) that an asset gave in a step, SI.

    Raises
    ------
    MissionInputError
        If the number of values is wrong, or a value is not finite.
    """
    values = np.asarray(reading.values, dtype=np.float64)
    section = scenario.observation
    if values.shape != (section.count,):
        raise MissionInputError(
            f"step {step}: the scenario expects {section.count} values of `{section.role}` and "
            f"the asset returned {values.shape}"
        )
    if not np.all(np.isfinite(values)):
        numbers = ", ".join(str(index + 1) for index in np.flatnonzero(~np.isfinite(values)))
        raise MissionInputError(
            f"step {step}: the asset returned NaN or an infinity for `{section.role}` {numbers} "
            f"under the control `{control}`; the run stops here and can be resumed"
        )
    return values


def sentence_of_ending_action(scenario: Scenario, control_index: int) -> str:
    """Return the sentence that an action of the twin is the reason of an early end."""
    return f"the twin decided on `{scenario.control_names[control_index]}`."


class Plant:
    """A simulated asset, driven by its truth and flown under the controls that the twin proposes.

    Parameters
    ----------
    scenario : Scenario
        The scenario of the mission.
    truth : Truth
        Damage, noise and faults.
    asset : Asset
        The asset at its start.

    Attributes
    ----------
    step : int
        The number of steps flown.
    reason_of_end : str
        Why the mission ended before its last step, as a sentence; empty if it did not.
    """

    def __init__(self, scenario: Scenario, truth: Truth, asset: Asset) -> None:
        self._scenario = scenario
        self._truth = truth
        self._asset = asset
        self._state: Float | None = None
        self._sensed: Float | None = None
        self.step = 0
        self.reason_of_end = ""

    def read(self, twin: Twin) -> Reading | None:
        """Fly the next step and return its observation; None at the end of the mission.

        This is `Source.read` of a simulated asset. The mission ends in three cases:

        - All its steps are flown.
        - The twin has decided on an action that ends it.
        - The FMU has ended its simulation.

        In the last two cases `reason_of_end` becomes a sentence.

        Raises
        ------
        FmuEndedError
            If the FMU ends its simulation in the first step.
        MissionInputError
            As `fly_step`.
        """
        steps_done = twin.steps
        if steps_done == self._scenario.mission.steps:
            return None
        previous_control = twin.control_of(steps_done - 1) if steps_done > 0 else None
        if previous_control is not None and self._scenario.ends(previous_control):
            self.reason_of_end = sentence_of_ending_action(self._scenario, previous_control)
            return None
        try:
            return self.fly_step(twin.proposed_control, previous_control)
        except FmuEndedError as error:
            if steps_done == 0:
                raise  # a mission without a single step is an error, and no early end
            self.reason_of_end = error.sentence
            return None

    def replace_impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        """Raise the error: a simulated asset showed the reading, whatever the twin believes."""
        raise error

    def fly_step(self, control_index: int, previous_control_index: int | None) -> Reading:
        """Fly one step and return its observation.

        Parameters
        ----------
        control_index : int
            The index of the control in force.
        previous_control_index : int or None
            That of the step before; None in the first step.

        Raises
        ------
        MissionInputError
            If the asset returns something that is not an observation.
        """
        control = self._scenario.control[control_index]
        if self._truth.in_asset:
            reading = self._asset.step(control.values, {})
            state = self._state_in_asset(reading)
        else:
            state = self._truth.state(self.step, self._state, previous_control_index)
            health = dict(zip(self._scenario.state_names, state.tolist(), strict=True))
            reading = self._asset.step(control.values, health)
        observation = checked_observation(self._scenario, reading, self.step, control.name)
        sensed = reading.sensed
        if sensed is None:
            sensed = self._truth.sense(self.step, observation, self._sensed)
        inspected = self._truth.inspect(self.step, state, control_index)
        self._state = state
        self._sensed = sensed
        self.step += 1
        monitors = {name: float(value) for name, value in reading.monitors.items()}
        return Reading(
            np.concatenate((sensed, inspected)),
            control_index,
            ground_truth=GroundTruth(state, observation, monitors),
        )

    def _state_in_asset(self, reading: AssetReading) -> Float:
        """Return the F true state factors that an asset with damage of its own reports."""
        if reading.state is None:
            raise MissionInputError(
                f"step {self.step}: the asset does not report its damage, which the table `truth` "
                "requires"
            )
        return np.array([reading.state[name] for name in self._scenario.state_names])

    def noise_free(self, step: int, sensed: Float) -> Float:
        """Return sensed values (G,) without noise and drift, see `Truth.noise_free`."""
        return self._truth.noise_free(step, sensed)

    def save_state(self) -> bytes:
        """Return the state of the asset as bytes."""
        return self._asset.save_state()

    def restore(self, flown_history: History, asset_state: bytes) -> None:
        """Continue after the steps of a history, from the state that the asset had then."""
        self.step = len(flown_history.steps)
        self._state = flown_history.state[-1]
        self._sensed = flown_history.observed[-1]
        self._asset.restore_state(asset_state)
