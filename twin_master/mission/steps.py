"""A step, from its observation to its decision; and what really happens: damage, noise, faults, the asset."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmu_asset.errors import FmuEndedError
from reporting.arrays import Float, Index
from twin_master.assets.asset_source import Asset, AssetReading
from twin_master.errors import MissionInputError, TwinMasterError, said
from twin_master.network.estimator import Notice, Suspicion
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.twin import Twin, TwinStep
from twin_master.scenario.schema import Scenario
from twin_master.seeds import generator


class Happened(NamedTuple):
    """What really happened in a step, for store and journal; never for the twin.

    Attributes
    ----------
    state : (F,)
        True state, SI.
    observation : (G,)
        Noise-free observation, SI.
    monitors : dict of str to float
        Figures that the asset reported of itself.
    """

    state: Float
    observation: Float
    monitors: Mapping[str, float]


@dataclass(frozen=True)
class Reading:
    """An observation that is to be assimilated.

    Attributes
    ----------
    observed : (G + I,)
        What the sensors said and inspections read, SI; NaN where nothing was received.
    control : int or None
        Index of the control in force; None is the one that was proposed.
    revises : int or None
        The earlier step that it belongs to; None is the next step.
    unreadable : dict of int to str
        What came in the place of a reading, by the index of the sensor.
    happened : Happened or None
        Of a simulated asset.
    """

    observed: Float
    control: int | None = None
    revises: int | None = None
    unreadable: Mapping[int, str] = field(default_factory=dict)
    happened: Happened | None = None


@dataclass(frozen=True)
class MissionStep:
    """A step.

    Attributes
    ----------
    reading : Reading
        What came.
    concluded : TwinStep
        What the twin made of it.
    seconds : tuple of float
        On the clock: of the source, of the twin, and of those that kept it.
    """

    reading: Reading
    concluded: TwinStep
    seconds: tuple[float, float, float] = (0.0, 0.0, 0.0)


class _Column:
    """What the steps say under a name, as an array with a leading axis of the steps."""

    def __init__(self, name: str) -> None:
        self._of = attrgetter(name)

    def __get__(self, history: "History", _owner: type) -> NDArray[Any]:
        return np.array([self._of(step) for step in history.steps])


@dataclass
class History:
    """The steps of one twin, T of them, in their order.

    Attributes
    ----------
    twin : Twin
        It has kept all of them where they are to be smoothed.
    sensors : int
        Values of a row that are observed; behind them stand readings of inspections, or a covariance.
    steps : list of MissionStep
    notices : list of (int, Notice)
        What the operator was told, and in which step.
    resumed_at : int
        Steps that an earlier process flew.
    ended : str
        How the asset ended the mission before its last step; empty where it did not.
    row : (T, G + I)
        All that came; `observed` and `readings` are its two parts, NaN where nothing was received.
    control_index, log_evidence, filtered, predicted, decision_probability, unexplained : (T, ...)
        As in `TwinStep`.
    state, observation : (T, ...)
        As in `Happened`; of a simulated asset only.
    seconds : (T, 3)
        As in `MissionStep`.
    """

    twin: Twin
    sensors: int
    steps: list[MissionStep] = field(default_factory=list)
    notices: list[tuple[int, Notice]] = field(default_factory=list)
    resumed_at: int = 0
    ended: str = ""

    row = _Column("reading.observed")
    control_index = _Column("concluded.control_index")
    filtered = _Column("concluded.filtered")
    log_evidence = _Column("concluded.log_evidence")
    predicted = _Column("concluded.prediction.predicted")
    decision_probability = _Column("concluded.decision_probability")
    unexplained = _Column("concluded.unexplained")
    state = _Column("reading.happened.state")
    observation = _Column("reading.happened.observation")
    seconds = _Column("seconds")

    def add(self, step: MissionStep) -> None:
        """Take in a step, without what follows from the rest of it."""
        prediction = replace(step.concluded.prediction, joint=np.empty(0))
        self.steps.append(replace(step, concluded=replace(step.concluded, prediction=prediction)))
        self.notices += [(step.concluded.step, notice) for notice in step.concluded.notices]

    def behind(self, skipped: int) -> "History":
        """Return the steps behind the first `skipped`; the notices stay those of all."""
        return replace(self, steps=self.steps[skipped:])

    @property
    def first_step(self) -> int:
        """Number of the first step."""
        return self.steps[0].concluded.step if self.steps else 0

    @property
    def observed(self) -> Float:
        """What the sensors said (T, G)."""
        return self.row[:, : self.sensors]

    @property
    def readings(self) -> Float:
        """What came behind it (T, I)."""
        return self.row[:, self.sensors :]

    @property
    def simulated(self) -> bool:
        """Whether it is known what really happened."""
        return bool(self.steps) and self.steps[0].reading.happened is not None

    @property
    def monitors(self) -> dict[str, Float]:
        """Figures that the asset reported of itself (T,)."""
        told = [step.reading.happened.monitors for step in self.steps if step.reading.happened is not None]
        return {name: np.array([monitors[name] for monitors in told]) for name in (told[-1] if told else ())}

    @cached_property
    def smoothed(self) -> Float:
        """p(D_k | all observations) (T, S)."""
        return self.twin.smoothed()[-len(self.steps) :]

    @property
    def suspicion(self) -> tuple[Suspicion, ...]:
        """How well the model explained the sensors, where that is watched."""
        found = (step.concluded.suspicion for step in self.steps)
        return tuple(suspicion for suspicion in found if suspicion is not None)

    @property
    def learnt_names(self) -> tuple[str, ...]:
        """What is learnt."""
        return tuple(self.steps[-1].concluded.learnt) if self.steps else ()

    @property
    def learnt(self) -> Float:
        """The figures of each posterior (T, N, 4)."""
        figures = [[one.figures for one in step.concluded.learnt.values()] for step in self.steps]
        return np.array(figures).reshape(len(self.steps), len(self.learnt_names), 4)


class SensorStatus(IntEnum):
    """What a sensor really does at a step."""

    HEALTHY = 0
    LOST = 1
    DRIFTING = 2


class Truth:
    """Damage history, sensor noise and sensor faults of one mission.

    All random numbers are drawn when it is made, so that a resumed mission meets the same ones.

    Parameters
    ----------
    scenario : Scenario
        What happens.
    model : GraphicalModel
        States and transitions; random growth follows them, as the twin believes.
    seed : int
        Seed of the run.

    Attributes
    ----------
    noise : (T, G)
        Noise added to the raw observation, in its SI unit.
    drift : (T, G)
        Drift added to the raw observation, in its SI unit.
    status : (T, G)
        `SensorStatus` of each sensor.
    reading_noise : (T, I)
        Noise added to the readings of inspections, SI.
    uniform : (T,)
        What drives random growth; zeros where damage is scripted.
    growth : DamageGrowth
        How damage grows that does so at random.
    in_asset : bool
        Whether the asset carries damage, noise and faults; then all of the above is zero, and the asset
        tells what happened.
    """

    def __init__(self, scenario: Scenario, model: GraphicalModel, seed: int) -> None:
        steps, sensors = scenario.mission.steps, scenario.observation.count
        deviation = np.asarray(scenario.truth.noise.standard_deviation)  # one, or one for each sensor
        self.noise: Float = generator(seed, "noise").standard_normal((steps, sensors)) * deviation
        self.drift: Float = np.zeros((steps, sensors))
        self.status: NDArray[np.int8] = np.zeros((steps, sensors), dtype=np.int8)
        self._apply_faults(scenario)
        self._readings = scenario.readings
        drawn = generator(seed, "inspection").standard_normal((steps, len(self._readings)))
        self.reading_noise: Float = drawn * [deviation for *_, deviation in self._readings]
        self.in_asset = scenario.truth.kind == "asset"
        self._scripted = scenario.scripted_history() if scenario.truth.kind == "scripted" else None
        grows = scenario.truth.kind == "random_growth"
        self.uniform: Float = generator(seed, "damage").random(steps) if grows else np.zeros(steps)
        self._states, self.growth = model.states, DamageGrowth(model)

    def _apply_faults(self, scenario: Scenario) -> None:
        steps = np.arange(scenario.mission.steps)
        for fault in scenario.truth.sensor_faults:
            last = fault.last_step if fault.last_step is not None else scenario.mission.steps
            active = (steps >= fault.first_step) & (steps <= last)
            cells = np.ix_(active, np.array(fault.sensor_indices(scenario.observation.count)))
            if fault.kind == "dropout":
                self.status[cells] = SensorStatus.LOST
            else:
                assert fault.rate is not None  # the schema asks for it
                self.drift[cells] += (fault.rate * (steps[active] - fault.first_step + 1.0))[:, None]
                lost = self.status[cells] == SensorStatus.LOST
                self.status[cells] = np.where(lost, SensorStatus.LOST, SensorStatus.DRIFTING)

    def state(self, step: int, previous_state: Float | None, previous_control: int | None) -> Float:
        """Return the true state of a step: (F,), a value of each state factor in SI.

        Parameters
        ----------
        step
            The step, from 0.
        previous_state, previous_control
            State and control index of the step before; None at step 0.
        """
        if self._scripted is not None:
            return np.array(self._scripted[step])
        before = None if previous_state is None else np.array([self._states.index(tuple(previous_state))])
        control = None if previous_control is None else np.array([previous_control])
        place = self.growth.following(control, before, self.uniform[[step]])
        return np.asarray(self._states.coordinates[place][0])

    @classmethod
    def together(cls, truths: Sequence["Truth"]) -> "Truth":
        """Return the truths of B missions of one scenario as one, which senses and inspects for all."""
        joint = copy(truths[0])  # script, drift and losses are the scenario's, the same for all
        for name in ("noise", "uniform", "reading_noise"):
            setattr(joint, name, np.stack([getattr(truth, name) for truth in truths], axis=1))
        return joint

    def sense(self, step: int, observation: Float) -> Float:
        """Return what sensors say about an observation (..., G): noise and drift added, lost ones NaN."""
        sensed: Float = observation + self.noise[step] + self.drift[step]
        sensed[..., self.status[step] == SensorStatus.LOST] = np.nan
        return sensed

    def inspected(self, step: int, state: Float, control: Index | int) -> Float:
        """Return the readings of inspections (..., I), SI, NaN where the control asks for none."""
        read = [np.where(control == at, state[..., place], np.nan) for at, place, *_ in self._readings]
        shape = len(read), *state.shape[:-1]
        return np.asarray(np.moveaxis(np.reshape(read, shape), 0, -1) + self.reading_noise[step])


class DamageGrowth:
    """Damage that follows the prior and the transitions of a model, driven by uniform numbers."""

    def __init__(self, model: GraphicalModel) -> None:
        self._model = model
        self._rows: dict[tuple[int, int] | None, tuple[Float, Index]] = {}

    def following(self, control: Index | None, index: Index | None, uniform: Float) -> Index:
        """Return the indices (B,) of the states that follow states (B,) under controls (B,).

        Both are None at the first step.
        """
        if control is None or index is None:
            return self._reached(None, uniform)
        result, code = np.empty_like(index), control * self._model.states.size + index
        for number in np.unique(code).tolist():
            chosen = code == number
            result[chosen] = self._reached(divmod(number, self._model.states.size), uniform[chosen])
        return result

    def _reached(self, key: tuple[int, int] | None, uniform: Float) -> Index:
        if key not in self._rows:
            row = self._model.prior if key is None else self._model.transition.row(*key)
            possible = np.flatnonzero(row > 0.0)
            self._rows[key] = np.cumsum(row[possible]), possible
        reached, possible = self._rows[key]
        place = np.searchsorted(reached, uniform, side="right").clip(max=len(possible) - 1)
        return np.asarray(possible[place])


def checked_values(scenario: Scenario, reading: AssetReading, step: int, control: str) -> Float:
    """Return the observation (G,) of a reading.

    Raises
    ------
    MissionInputError
        It has another number of values, or one that is not finite.
    """
    values = np.asarray(reading.values, dtype=np.float64)
    if values.shape != (scenario.observation.count,):
        came, wanted = str(values.shape), scenario.observation
        raise MissionInputError(said("mission.width", step=step, wanted=wanted, came=came))
    if not np.all(np.isfinite(values)):
        bad = ", ".join(str(index + 1) for index in np.flatnonzero(~np.isfinite(values)))
        what = f"`{scenario.observation.role}` {bad} under the control `{control}`"
        raise MissionInputError(said("mission.no_number", step=step, what=what))
    return values


def decided_to_end(scenario: Scenario, control_index: int) -> str:
    """Return that an action has ended a mission."""
    return f"the twin decided on `{scenario.control_names[control_index]}`."


class Plant:
    """An asset, driven by its truth, and flown under the controls that a twin proposes.

    Parameters
    ----------
    scenario : Scenario
    truth : Truth
    asset : Asset
        At its start.

    Attributes
    ----------
    step : int
        Steps flown.
    ended : str
        How the asset ended the mission before its last step; empty where it did not.
    """

    def __init__(self, scenario: Scenario, truth: Truth, asset: Asset) -> None:
        self._scenario, self._truth, self._asset = scenario, truth, asset
        self._state: Float | None = None
        self.step, self.ended = 0, ""

    def read(self, twin: Twin) -> Reading | None:
        """Return what comes of the next step, see `Source`; None at the end of the mission."""
        if twin.steps == self._scenario.mission.steps:
            return None
        before = twin.control_of(twin.steps - 1) if twin.steps else None
        if before is not None and self._scenario.ends(before):
            self.ended = decided_to_end(self._scenario, before)
            return None
        try:
            return self.fly_step(twin.proposed_control, before)
        except FmuEndedError as error:
            if not twin.steps:
                raise
            self.ended = error.sentence
            return None

    def impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        """Refuse to go on: what is simulated was observed, whatever the twin believes."""
        raise error

    def fly_step(self, control_index: int, previous_control_index: int | None) -> Reading:
        """Fly one step.

        Parameters
        ----------
        control_index
            Control in force.
        previous_control_index
            Control of the step before; None in the first one.

        Raises
        ------
        MissionInputError
            The asset returned something that is no observation.
        """
        control = self._scenario.control[control_index]
        if self._truth.in_asset:
            reading = self._asset.step(control.values, {})
            if reading.state is None:
                raise MissionInputError(said("mission.no_damage", step=self.step))
            state = np.array([reading.state[name] for name in self._scenario.state_names])
        else:
            state = self._truth.state(self.step, self._state, previous_control_index)
            health = dict(zip(self._scenario.state_names, state.tolist(), strict=True))
            reading = self._asset.step(control.values, health)
        values = checked_values(self._scenario, reading, self.step, control.name)
        sensed = self._truth.sense(self.step, values) if reading.sensed is None else reading.sensed
        inspected = self._truth.inspected(self.step, state, control_index)
        self._state, self.step = state, self.step + 1
        monitors = {name: float(value) for name, value in reading.monitors.items()}
        happened = Happened(state, values, monitors)
        return Reading(np.concatenate((sensed, inspected)), control_index, happened=happened)

    def save_state(self) -> bytes:
        """Return the state of the asset as bytes."""
        return self._asset.save_state()

    def restore(self, flown: History, asset_state: bytes) -> None:
        """Continue behind steps that were flown, and from a saved state of the asset."""
        self.step, self._state = len(flown.steps), flown.state[-1]
        self._asset.restore_state(asset_state)
