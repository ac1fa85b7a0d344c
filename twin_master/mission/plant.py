"""The simulated asset of a mission, and its ground truth: damage, noise and sensor faults."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.errors import CalibrationError
from fe.runtime.errors import FiniteElementError
from fmu_asset.errors import FmuEndedError, FmuError
from reporting.arrays import Float, Index
from twin_master.assets.asset_source import Asset, AssetReading
from twin_master.errors import MissionInputError, TwinMasterError
from twin_master.mission.steps import GroundTruth, History, Reading, Source
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.schema import Scenario
from twin_master.seeds import generator

FLIGHT_ERRORS = (TwinMasterError, FmuError, FiniteElementError, CalibrationError, OSError)
"""Errors that end the flight of one asset, but not the flights of the others."""


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
"""The status of a sensor with a fault of each kind; a later kind hides the earlier ones."""


class TrueState(NamedTuple):
    """The true state of one mission, or of B missions: (...) is () or (B,).

    Attributes
    ----------
    state_index : (...) array
        The index of the state; zero if damage does not grow at random.
    values : (..., F) array
        The value of each state factor, SI.
    """

    state_index: Index
    values: Float


class Truth:
    """Damage history, sensor noise and sensor faults of one mission.

    All random numbers are drawn at construction, so that a resumed mission meets the same ones.

    Parameters
    ----------
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
        # Where several faults meet, the one whose kind comes last in this list sets the status.
        kinds_in_order = [*_STATUS_OF_FAULT]
        faults = scenario.truth.sensor_faults
        for fault in sorted(faults, key=lambda fault: kinds_in_order.index(fault.kind)):
            last_step = fault.last_step if fault.last_step is not None else scenario.mission.steps
            is_active = (steps >= fault.first_step) & (steps <= last_step)
            sensors = np.array(fault.sensor_indices(scenario.observation.count))
            cells = np.ix_(is_active, sensors)
            if fault.rate is not None:  # the schema asks for it if the sensors drift
                # The drift grows by the rate in each step, from the first step of the fault on.
                steps_of_drift = steps[is_active] - fault.first_step + 1.0
                self.drift[cells] += (fault.rate * steps_of_drift)[:, None]
            self.status[cells] = _STATUS_OF_FAULT[fault.kind]

    @property
    def shape(self) -> tuple[int, ...]:
        """The leading axes of all arrays but time: () for one mission, (B,) for B of them."""
        return self.uniform.shape[1:]

    def next_state(
        self, step: int, previous: TrueState | None, previous_control: ArrayLike | None
    ) -> TrueState:
        """Return the true state of a step; NaN if the asset itself carries the damage.

        Parameters
        ----------
        step : int
            The step, from 0.
        previous : TrueState or None
            The state of the step before; None at step 0.
        previous_control : int or (B,) array of int, or None
            The index of the control of the step before; None at step 0.
        """
        if self.in_asset:
            return self.state_of_values(np.full(len(self._states.factors), np.nan))
        if self._scripted_states is not None:
            return self.state_of_values(self._scripted_states[step])
        index = self.growth.next_states(
            None if previous_control is None else np.asarray(previous_control),
            None if previous is None else previous.state_index,
            self.uniform[step],
        )
        return TrueState(index, self._states.coordinates[index])

    def state_of_values(self, values: Float) -> TrueState:
        """Return the true state of all missions from values (F,) of the state factors, SI."""
        values = np.asarray(values)
        grows_at_random = self._scripted_states is None and not self.in_asset
        index = self._states.index(tuple(values)) if grows_at_random else 0
        return TrueState(
            np.full(self.shape, index), np.broadcast_to(values, (*self.shape, len(values)))
        )

    @classmethod
    def stack(cls, truths: Sequence["Truth"]) -> "Truth":
        """Return one ground truth for B missions of one scenario.

        Its random numbers have the shape (T, B, ...). Script, drift and losses are the same in all
        missions.
        """
        stacked = copy(truths[0])
        for name in ("noise", "uniform", "reading_noise"):
            setattr(stacked, name, np.stack([getattr(truth, name) for truth in truths], axis=1))
        return stacked

    def sense(self, step: int, observation: Float, previous: Float | None) -> Float:
        """Return an observation (..., G) with noise, drift and the faults of its sensors.

        Parameters
        ----------
        step : int
            The step, from 0.
        observation : (..., G) array
            The observation without noise, SI.
        previous : (..., G) array or None
            The sensed values of the step before, SI; None in the first step.

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

        The values of stuck sensors mean nothing.
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
        # (I, ...); the shape is stated because there may be no inspections
        by_inspection = np.reshape(columns, (len(columns), *state.shape[:-1]))
        return np.asarray(np.moveaxis(by_inspection, 0, -1) + self.reading_noise[step])


class _NextStates(NamedTuple):
    """The possible next states of a state under a control, and their cumulative probability."""

    cumulative_probability: Float
    state_indices: Index


class DamageGrowth:
    """Random growth of damage that follows the prior and the transitions of a model."""

    def __init__(self, model: GraphicalModel) -> None:
        self._model = model
        self._initial = _possible_states(model.prior)
        self._next_states: dict[int, _NextStates] = {}  # by the codes of `next_states`

    def next_states(self, control: Index | None, state: Index | None, uniform: Float) -> Index:
        """Draw the indices (...) of the states that follow states under controls.

        Parameters
        ----------
        control : (...) array or None
            The indices of the controls; None at the first step, which is drawn from the prior.
        state : (...) array or None
            The indices of the states; None at the first step.
        uniform : (...) array
            The random numbers, uniform in [0, 1).
        """
        if control is None or state is None:
            return _draw(self._initial, uniform)
        next_states = np.empty_like(state)
        # Missions with the same control in the same state are drawn together. A pair of control and
        # state is coded as one number.
        pair_codes = control * self._model.states.size + state
        for pair_code in np.unique(pair_codes).tolist():
            has_code = pair_codes == pair_code
            if pair_code not in self._next_states:
                row = self._model.transition.row(*divmod(pair_code, self._model.states.size))
                self._next_states[pair_code] = _possible_states(row)
            next_states[has_code] = _draw(self._next_states[pair_code], uniform[has_code])
        return next_states


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


class DecidingTwins(Protocol):
    """A twin, or several side by side, under whose decisions a plant flies."""

    @property
    def steps(self) -> int:
        """Number of steps so far."""

    @property
    def proposed_control(self) -> int | Index:
        """Index of the control for the next step, of each twin."""

    @property
    def previous_control(self) -> int | Index:
        """Index of the control in force in the last step, of each twin."""


def sentence_of_ending_action(scenario: Scenario, control_index: int) -> str:
    """Return the sentence that an action of the twin ended the mission."""
    return f"the twin decided on `{scenario.control_names[control_index]}`."


class Plant(Source[DecidingTwins]):
    """The simulated assets of one mission or of B missions, with damage, noise and sensor faults.

    The assets of B missions fly side by side if they have no memory. Then the arrays of controls,
    states and readings have a leading axis B; (...) stands for it, and is empty for one mission.

    Parameters
    ----------
    truth : Truth
        Damage, noise and faults of one mission, or of B missions (`Truth.stack`).
    *assets : Asset
        The asset of each mission at its start; missions may share one without memory.

    Attributes
    ----------
    step : int
        The number of steps flown.
    is_flying : (...) array of bool
        Which missions have not ended; clearing an entry stops the asset of a twin that failed.
    endings : dict of int to str
        How missions ended before their last step, by the number of the mission.
    failures : dict of int to str
        The errors of assets that flew side by side, by the number of the mission.
    """

    def __init__(self, scenario: Scenario, truth: Truth, *assets: Asset) -> None:
        self._scenario = scenario
        self._truth = truth
        distinct_assets = {id(asset): asset for asset in assets}
        numbers = {key: number for number, key in enumerate(distinct_assets)}
        self._assets = list(distinct_assets.values())
        asset_of_mission = np.array([numbers[id(asset)] for asset in assets])
        self._asset_of_mission = asset_of_mission.reshape(truth.shape)
        self._state: TrueState | None = None
        self._sensed: Float | None = None
        # The readings of memoryless assets by asset, control and state.
        self._known_readings: dict[tuple[int, int, bytes], AssetReading] = {}
        self._ends_mission = np.array(
            [scenario.ends(index) for index in range(len(scenario.control))]
        )
        self.step = 0
        self.is_flying: NDArray[np.bool_] = np.ones(truth.shape, dtype=bool)
        self.endings: dict[int, str] = {}
        self.failures: dict[int, str] = {}

    def read(self, twin: DecidingTwins) -> Reading | None:
        """Fly the next step of all missions and return the observation; None when all have ended.

        A mission ends in three cases:

        - All its steps are flown.
        - The twin has decided on an action that ends it.
        - The FMU of a single mission has ended its simulation.

        In the last two cases a sentence is added to `endings`.

        Raises
        ------
        FmuEndedError
            If the FMU ends its simulation in the first step.
        MissionInputError
            As `fly_step`.
        """
        if twin.steps == self._scenario.mission.steps:
            return None
        previous_control = None
        if twin.steps > 0:
            previous_control = np.asarray(twin.previous_control)
            ends_now = self.is_flying & self._ends_mission[previous_control]
            for mission in np.flatnonzero(ends_now).tolist():
                control = int(previous_control.flat[mission])
                self._end(mission, sentence_of_ending_action(self._scenario, control))
        if not self.is_flying.any():
            return None
        try:
            return self.fly_step(twin.proposed_control, previous_control)
        except FmuEndedError as error:
            if twin.steps == 0:
                raise  # a mission without a single step is an error, and no early end
            self._end(0, error.sentence)
            return None

    def _end(self, mission: int, reason: str) -> None:
        """End a mission before its last step, for a reason in words."""
        section = self._scenario.mission
        steps = f"{self.step} of {section.steps} {section.step_name}s"
        self.endings[mission] = f"The asset ended the mission after {steps}: {reason}"
        self.is_flying.flat[mission] = False

    def fly_step(
        self, control_index: ArrayLike, previous_control_index: ArrayLike | None
    ) -> Reading:
        """Fly one step and return its observation; NaN for missions that have ended.

        Parameters
        ----------
        control_index : int or (B,) array of int
            The index of the control in force.
        previous_control_index : int or (B,) array of int, or None
            That of the step before; None in the first step.

        Raises
        ------
        MissionInputError
            If the asset of a single mission returns something that is not an observation. Side by
            side, the error of an asset is kept in `failures`, and its observation is NaN.
        """
        control = np.asarray(control_index)
        state = self._truth.next_state(self.step, self._state, previous_control_index)

        # Missions with the same asset, control and state share one reading of the asset.
        code = self._asset_of_mission * len(self._scenario.control) + control
        code = code * (1 + state.state_index.max()) + state.state_index
        _, first_missions, group = np.unique(
            np.where(self.is_flying, code, -1), return_index=True, return_inverse=True
        )
        group = group.reshape(self._truth.shape)
        readings = []
        for number, mission in enumerate(first_missions.tolist()):
            missions = np.flatnonzero((group == number) & self.is_flying)
            readings.append(self._read_asset(mission, missions, control, state))
        observation = np.stack([reading.values for reading in readings])[group]

        # The sensor values; the asset of a single mission may have sensors of its own.
        sensed = None
        monitors: Mapping[str, float] = {}
        if group.ndim == 0:
            sensed = readings[0].sensed
            monitors = {name: float(value) for name, value in readings[0].monitors.items()}
        if sensed is None:
            sensed = self._truth.sense(self.step, observation, self._sensed)
        if self._truth.in_asset:
            rows = []
            for reading in readings:
                if reading.state is None:
                    raise MissionInputError(
                        f"step {self.step}: the asset does not report its damage, which the table "
                        "`truth` requires"
                    )
                rows.append([reading.state[name] for name in self._scenario.state_names])
            state = TrueState(state.state_index, np.array(rows)[group])
        inspected = self._truth.inspect(self.step, state.values, control)
        self._state = state
        self._sensed = sensed
        self.step += 1
        observed = np.concatenate((sensed, inspected), axis=-1)
        observed[~self.is_flying] = np.nan
        return Reading(
            observed,
            ground_truth=GroundTruth(state.values, observation, monitors),
        )

    def _read_asset(
        self, mission: int, missions: Index, control: Index, state: TrueState
    ) -> AssetReading:
        """Return the reading of the asset of one mission, which the `missions` share.

        If the asset fails, all of these missions end, with the error in `failures`. If `missions`
        is empty, the asset is not read, and the values are NaN.
        """
        no_reading = AssetReading(np.full(self._scenario.observation.count, np.nan))
        if len(missions) == 0:
            return no_reading
        asset_number = int(self._asset_of_mission.flat[mission])
        control_number = int(control.flat[mission])
        values = state.values.reshape(-1, state.values.shape[-1])[mission]
        key = asset_number, control_number, values.tobytes()
        if key in self._known_readings:
            return self._known_readings[key]
        asset = self._assets[asset_number]
        health = {}
        if not self._truth.in_asset:
            health = dict(zip(self._scenario.state_names, values.tolist(), strict=True))
        try:
            reading = asset.step(self._scenario.control[control_number].values, health)
            reading = replace(reading, values=self._checked_values(reading, control_number))
        except FLIGHT_ERRORS as error:
            if self._truth.shape == ():
                raise
            self.failures |= dict.fromkeys(missions.tolist(), str(error))
            self.is_flying[missions] = False
            return no_reading
        if self._truth.shape:  # these assets have no memory
            self._known_readings[key] = reading
        return reading

    def _checked_values(self, reading: AssetReading, control_index: int) -> Float:
        """Return the observed values (G,) in a reading of an asset, SI, after a check.

        Raises
        ------
        MissionInputError
            If the number of values is wrong, or a value is not finite.
        """
        values = np.asarray(reading.values, dtype=np.float64)
        section = self._scenario.observation
        if values.shape != (section.count,):
            raise MissionInputError(
                f"step {self.step}: the scenario expects {section.count} values of "
                f"`{section.role}` and the asset returned {values.shape}"
            )
        if not np.all(np.isfinite(values)):
            numbers = ", ".join(str(index + 1) for index in np.flatnonzero(~np.isfinite(values)))
            control = self._scenario.control_names[control_index]
            raise MissionInputError(
                f"step {self.step}: the asset returned NaN or an infinity for `{section.role}` "
                f"{numbers} under the control `{control}`; the run stops here and can be resumed"
            )
        return values

    def noise_free(self, step: int, sensed: Float) -> Float:
        """Return sensed values (G,) without noise and drift, see `Truth.noise_free`."""
        return self._truth.noise_free(step, sensed)

    def save_state(self) -> bytes:
        """Return the state of the asset of a single mission as bytes."""
        return self._assets[0].save_state()

    def restore(self, flown_history: History, asset_state: bytes) -> None:
        """Continue a single mission after the steps of a history.

        Parameters
        ----------
        flown_history : History
            The steps that were flown.
        asset_state : bytes
            The state that the asset had after them.
        """
        self.step = len(flown_history.steps)
        self._state = self._truth.state_of_values(flown_history.state[-1])
        self._sensed = flown_history.observed[-1]
        self._assets[0].restore_state(asset_state)
