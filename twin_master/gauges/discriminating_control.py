"""The control that discriminates best between two hypotheses about the gauges.

It is advised when an alarm is ambiguous. The next step is simulated under each control and both
hypotheses: the readings of the gauges and those of inspections that the control asks for. If one
step seldom suffices, ten steps are simulated. The hypotheses are discriminated if the true one
is then almost certain. A control is rated by the probability of that, as an experiment is rated by
its expected information (Lindley 1956).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from reporting.arrays import Float
from twin_master.gauges.watch_state import WatchState
from twin_master.network.sensor_model import GaussianSensorModel

_LEAST_PROBABILITY = 0.1
"""An alarm is ambiguous if two hypotheses have at least this probability."""
_ALMOST_CERTAIN = 0.95
"""The probability that the true hypothesis must reach."""
_LOG_ODDS_OF_ALMOST_CERTAIN = float(np.log(_ALMOST_CERTAIN / (1.0 - _ALMOST_CERTAIN)))
_SIMULATIONS = 500
"""Simulations for each control and hypothesis."""
_STEPS = (1, 10)
"""Successive steps under one control that are simulated."""
_PROBABLE = 0.5
"""If a control discriminates with this probability, more steps need not be simulated."""


class GaugeHypothesis(NamedTuple):
    """A hypothesis about the gauges.

    Attributes
    ----------
    belief : (S,) array
        The belief about the state, given the hypothesis.
    factor : (G,) array
        The reading of each gauge over the value that the model predicts.
    """

    name: str
    probability: float
    belief: Float
    factor: Float


class DiscriminatingControls(NamedTuple):
    """The probability with which each control discriminates between two hypotheses.

    Attributes
    ----------
    names, probabilities : tuple
        The two hypotheses, the more probable one first.
    steps : int
        The number of successive steps under a control.
    by_control : (U,) array
        The probability that these steps make the true hypothesis almost certain.
    """

    names: tuple[str, str]
    probabilities: tuple[float, float]
    steps: int
    by_control: Float


def discriminating_controls(
    hypotheses: Sequence[GaugeHypothesis], sensor_model: GaussianSensorModel
) -> DiscriminatingControls | None:
    """Return how probably each control discriminates between the two most probable hypotheses.

    The result is None if only one hypothesis is probable. Equal arguments give equal results.
    """
    first, second = sorted(hypotheses, key=lambda hypothesis: -hypothesis.probability)[:2]
    if second.probability < _LEAST_PROBABILITY:
        return None
    names = (first.name, second.name)
    probabilities = (first.probability, second.probability)
    controls = range(sensor_model.control_count)
    for steps in _STEPS:
        by_control = np.array(
            [_probability_to_discriminate(first, second, sensor_model, u, steps) for u in controls]
        )
        if by_control.max() >= _PROBABLE:
            break
    return DiscriminatingControls(names, probabilities, steps, by_control)


def _probability_to_discriminate(
    first: GaugeHypothesis,
    second: GaugeHypothesis,
    sensor_model: GaussianSensorModel,
    control: int,
    steps: int,
) -> float:
    """Return the probability that steps under a control make the true hypothesis almost certain.

    Readings are simulated under each of the two hypotheses; the state stays the same in these
    steps. The true hypothesis is almost certain if the log odds in its favour, after the readings,
    are at least `_LOG_ODDS_OF_ALMOST_CERTAIN`.
    """
    log_odds = np.log(first.probability / second.probability)
    generator = np.random.default_rng(0)
    probability = 0.0
    for true_hypothesis, sign in ((first, 1.0), (second, -1.0)):
        probability_of_state = true_hypothesis.belief / true_hypothesis.belief.sum()
        states = generator.choice(sensor_model.state_count, _SIMULATIONS, p=probability_of_state)
        error = (true_hypothesis.factor - 1.0) * sensor_model.mean[states, control]
        log_density_of_first = np.zeros((_SIMULATIONS, sensor_model.state_count))
        log_density_of_second = np.zeros_like(log_density_of_first)
        for _ in range(steps):
            rows = sensor_model.draw_observations(states, control, generator)
            rows[:, : sensor_model.sensor_count] += error  # the wrong gain of the gauge
            log_density_of_first += _log_density(first, sensor_model, control, rows)
            log_density_of_second += _log_density(second, sensor_model, control, rows)
        log_ratio = _log_mean(log_density_of_first, first) - _log_mean(
            log_density_of_second, second
        )
        is_certain = sign * (log_odds + log_ratio) >= _LOG_ODDS_OF_ALMOST_CERTAIN
        probability += true_hypothesis.probability * float(np.mean(is_certain))
    return probability / (first.probability + second.probability)


def _log_density(
    hypothesis: GaugeHypothesis, sensor_model: GaussianSensorModel, control: int, rows: Float
) -> Float:
    """Return the log density of observations (N, G + I) in each state under a hypothesis: (N, S).

    Constants that do not depend on the hypothesis are left out.
    """
    values, log_density = sensor_model.split_observation(rows)
    deviation = sensor_model.total_standard_deviation[:, control]  # (S, G)
    expected = hypothesis.factor * sensor_model.mean[:, control]
    squares = np.empty((len(rows), len(deviation)))
    for state in range(len(deviation)):
        standardized = (values - expected[state]) / deviation[state]
        squares[:, state] = np.einsum("ng,ng->n", standardized, standardized)
    return np.asarray(log_density - np.log(deviation).sum(axis=1) - 0.5 * squares)


def _log_mean(log_density: Float, hypothesis: GaugeHypothesis) -> Float:
    """Return the log of densities (N, S), averaged over the belief under a hypothesis: (N,)."""
    with np.errstate(divide="ignore"):
        log_belief = np.log(hypothesis.belief / hypothesis.belief.sum())
    return np.asarray(np.logaddexp.reduce(log_density + log_belief, axis=1))


def gauge_hypotheses(
    state: WatchState,
    twin: int,
    model_belief: Float,
    gains: Float,
    gain_deviation: float,
    gauge_names: tuple[str, ...],
) -> list[GaugeHypothesis]:
    """Return the hypotheses of a twin: the model, its most probably faulty gauge, and free gains.

    Parameters
    ----------
    model_belief : (S,) array
        Its belief about the state under the model.
    gains : (K,) array
        The gain errors of a single gauge that are compared.
    gain_deviation : float
        The prior standard deviation of gains, where no state explains the gauges.
    gauge_names : tuple of str
        The name of the hypothesis that a gauge is off, for each of G gauges.
    """
    states = len(model_belief)
    gauge_count = len(gauge_names)
    probability = state.weights.gauge_fault_probability[twin].reshape(gauge_count, -1)  # (G, K)
    none_of_these = float(state.weights.free_gains_probability[twin])
    is_sound = 1.0 - none_of_these - float(probability.sum())
    hypotheses = [GaugeHypothesis("model", is_sound, model_belief, np.ones(gauge_count))]

    gauge = int(np.argmax(probability.sum(axis=1)))
    gauge_probability = float(probability[gauge].sum())
    belief_of_faults = state.beliefs.gauge[twin].reshape(states, -1, gauge_count, len(gains))
    joint = belief_of_faults[:, :, gauge].sum(axis=1) @ probability[gauge]  # (S,)
    if gauge_probability > 0.0 and joint.sum() > 0.0:
        factor = np.ones(gauge_count)
        factor[gauge] += float(probability[gauge] @ gains) / gauge_probability
        hypotheses.append(GaugeHypothesis(gauge_names[gauge], gauge_probability, joint, factor))

    belief = state.beliefs.free_gains[twin].reshape(states, -1).sum(axis=1)
    statistics = state.free_gain_statistics
    regression = statistics.sum_cx[twin] / (1.0 + statistics.sum_cc[twin])
    gain = gain_deviation * statistics.free_probability[twin] * regression
    hypotheses.append(GaugeHypothesis("none of these", none_of_these, belief, 1.0 + gain))
    return hypotheses
