"""The stored run as the report sees it: plain arrays with checked shapes, missing parts as None."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_master.network.transition import TransitionModel
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.schema import Scenario

Float = NDArray[np.floating[Any]]
Index = NDArray[np.int64]

NORMAL_95 = 1.959963984540054
"""Half-width of a 95 % interval of the normal distribution, in standard deviations."""


@dataclass(frozen=True)
class Uncertain:
    """Mean and 95 % interval of quantities that the twin is not certain of.

    Attributes
    ----------
    mean, lower, upper : (..., n)
    """

    mean: Float
    lower: Float
    upper: Float


@dataclass(frozen=True)
class Estimate:
    """What the twin believes at each step, or at each step about each coming step.

    The leading axes are (T,) for estimates and (T, H) for predictions. A part that was not stored is None.

    Attributes
    ----------
    probability : (..., S)
        Belief over the joint states.
    mean, standard_deviation : (..., K)
        Of each factor of the state, SI.
    quantity : (..., G) or None
        Noise-free observation of each sensor, SI.
    quantity_standard_deviation : (..., G) or None
        Of the same.
    reward : (..., R) or None
        Each reward, dimensionless.
    """

    probability: Float
    mean: Float
    standard_deviation: Float
    quantity: Uncertain | None
    quantity_standard_deviation: Float | None
    reward: Uncertain | None


@dataclass(frozen=True)
class PolicyTable:
    """The policy that was flown.

    Attributes
    ----------
    control_index : (S,)
        Control chosen in each state.
    action_value : (S, U) or None
        Q of eq. (36).
    """

    control_index: Index
    action_value: Float | None


@dataclass(frozen=True)
class LearntCourse:
    """A quantity that was learnt, of the whole asset or of each sensor.

    Attributes
    ----------
    name, unit : str
        As stored.
    course : (T, 4) or (T, G, 4)
        Mean, standard deviation and bounds of the 90 % interval after each step.
    prior : (4,) or (G, 4)
        Before the first step.
    truth : () or (G,), or None
    """

    name: str
    unit: str
    course: Float
    prior: Float
    truth: Float | None


@dataclass(frozen=True)
class RunRecord:
    """One run: T steps, S joint states of K factors, G sensors, U controls, R rewards, H predicted steps.

    Attributes
    ----------
    state_names, state_titles : tuple of str
        The K factors.
    levels : tuple of (L_k,)
        Levels of each factor, SI.
    coordinates : (S, K)
        Levels of each joint state.
    sensors : (G,)
        Numbers of the sensors as printed, from 1.
    controls, rewards : tuple of str
    observation : (T, G) or None
        As measured, SI; NaN where a sensor was lost.
    observation_name, observation_unit : str
        What is observed and its stored unit; strain is dimensionless and shown in microstrain.
    control_index : (T,)
    filtered, smoothed, predicted : Estimate or None
        p(D_t | o_0..o_t), p(D_t | o_0..o_{T-1}), p(D_{t+h} | o_0..o_t).
    control_probability : (T, H, U) or None
        p(U_{t+h} | o_0..o_t).
    decision_probability : (T, U) or None
        The policy averaged over the belief that the twin decided on; its mode is the control of t + 1.
    log_evidence : (T,) or None
        log p(o_t | o_0..o_{t-1}).
    policy : PolicyTable or None
    truth_state : (T, K) or None
    truth_observation : (T, G) or None
        Noise-free.
    monitors : mapping of ((T,), unit)
        What the asset reported of itself, such as a certified error bound.
    parameter_name : str
        The uncertain parameter of the model; empty if it was not stored.
    parameter_draws : (E,) or None
        Its draws, over which the twin averages.
    calibration : mapping
        Content of ``calibration.json``; empty if there is none.
    attributes : mapping
        Root attributes of ``run.nc``.
    config, summary : mapping
        The JSON files of the run folder; empty if there is none.
    state_units : tuple of str
        Stored unit of each factor; empty stands for dimensionless.
    sensor_units, sensor_titles : tuple of str
        Unit and name of each sensor; empty where all have the unit of the observation, and no names.
    parameter_unit : str
        Unit of the draws.
    learnt : tuple of LearntCourse
        What was learnt; empty where nothing is.
    first_step : int
        Number of the first step.
    learnt_noise : (T, G) or None
        Standard deviation of noise and model error as learnt; None where it is the assumed one.
    """

    state_names: tuple[str, ...]
    state_titles: tuple[str, ...]
    levels: tuple[Float, ...]
    coordinates: Float
    sensors: Index
    controls: tuple[str, ...]
    rewards: tuple[str, ...]
    observation: Float | None
    observation_name: str
    observation_unit: str
    control_index: Index
    filtered: Estimate
    smoothed: Estimate | None
    predicted: Estimate | None
    control_probability: Float | None
    decision_probability: Float | None
    log_evidence: Float | None
    policy: PolicyTable | None
    truth_state: Float | None
    truth_observation: Float | None
    monitors: Mapping[str, tuple[Float, str]]
    parameter_name: str
    parameter_draws: Float | None
    calibration: Mapping[str, Any]
    attributes: Mapping[str, Any]
    config: Mapping[str, Any]
    summary: Mapping[str, Any]
    state_units: tuple[str, ...] = ()
    sensor_units: tuple[str, ...] = ()
    sensor_titles: tuple[str, ...] = ()
    parameter_unit: str = "1"
    learnt: tuple[LearntCourse, ...] = ()
    first_step: int = 0
    learnt_noise: Float | None = None

    @property
    def step_word(self) -> str:
        """What a step is called."""
        mission = self.scenario.get("mission")
        word = mission.get("step_name") if isinstance(mission, Mapping) else None
        return str(word or "turn")

    @property
    def step_count(self) -> int:
        """Number T of steps."""
        return len(self.control_index)

    @property
    def horizon(self) -> int:
        """Number H of predicted steps; 0 without predictions."""
        return 0 if self.predicted is None else int(self.predicted.mean.shape[1])

    @cached_property
    def transition(self) -> TransitionModel | None:
        """p(D_{t+1} | D_t, u) of the scenario; None if the folder does not hold it."""
        if not self.scenario:
            return None
        try:
            model = build_graphical_model(Scenario.model_validate(self.scenario))
        except ValueError:
            return None
        fits = model.states.names == self.state_names and model.controls == self.controls
        return model.transition if fits else None

    @property
    def decides_on_prediction(self) -> bool:
        """Whether the policy acted on the state predicted for the next turn, not on that just observed."""
        planner = self.scenario.get("planner")
        return isinstance(planner, Mapping) and planner.get("decide_on") == "predicted"

    @property
    def scenario(self) -> Mapping[str, Any]:
        """The resolved scenario, SI; empty if the folder does not hold it."""
        scenario = self.config.get("scenario", {})
        return scenario if isinstance(scenario, Mapping) else {}


def smoothed_until(record: RunRecord, now: int) -> Float | None:
    """Return p(D_t | o_0..o_now) for t = 0..now, (now + 1, S), from the filtered beliefs and the transitions.

    The backward recursion of the smoother needs nothing else: with f the filtered belief and T the
    transition under u_t, s_t = f_t * T (s_{t+1} / (f_t T)). None without transitions.
    """
    transition = record.transition
    if transition is None:
        return None
    filtered = record.filtered.probability
    smoothed = filtered[: now + 1].copy()
    for step in range(now - 1, -1, -1):
        control = int(record.control_index[step])
        forecast = transition.forward(control, filtered[step])
        ratio = np.divide(smoothed[step + 1], forecast, out=np.zeros_like(forecast), where=forecast > 0.0)
        smoothed[step] = filtered[step] * transition.expected(control, ratio)
        smoothed[step] /= smoothed[step].sum()
    return smoothed


def moments(probability: Float, coordinates: Float) -> tuple[Float, Float]:
    """Return mean and standard deviation of each factor under beliefs: (..., S) -> two of (..., K)."""
    mean = probability @ coordinates
    variance = np.einsum("...s,...sk->...k", probability, (coordinates - mean[..., None, :]) ** 2)
    return mean, np.sqrt(variance)
