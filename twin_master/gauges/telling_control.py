"""Which control tells two hypotheses about the gauges apart, as advice where an alarm is ambiguous.

Two hypotheses are told apart by the readings that they predict. The separation of a control is the
distance of their mean readings in one step, in standard deviations of the noise: half its square is
the log evidence that a step is expected to bring (Lindley 1956, for Gaussian noise).
"""

from typing import NamedTuple

import numpy as np

from reporting.arrays import Float
from twin_master.gauges.watch_state import WatchState
from twin_master.network.sensor_model import GaussianSensorModel

_LEAST_PROBABILITY = 0.1
"""Two hypotheses that are both at least as probable make an alarm ambiguous."""


class PredictedReadings(NamedTuple):
    """A hypothesis, and the readings that it predicts.

    Attributes
    ----------
    name : str
        Its name.
    probability : float
        Its probability.
    readings : (U, G) array
        The mean readings of G gauges under each of U controls, SI.
    """

    name: str
    probability: float
    readings: Float


class Separation(NamedTuple):
    """How well the controls tell the two most probable hypotheses apart.

    Attributes
    ----------
    names : tuple of str
        The hypotheses, the more probable one first.
    probabilities : tuple of float
        Their probabilities.
    by_control : (U,) array
        The separation under each control, in standard deviations.
    """

    names: tuple[str, str]
    probabilities: tuple[float, float]
    by_control: Float


def separation_of_hypotheses(
    hypotheses: list[PredictedReadings], noise: Float
) -> Separation | None:
    """Return how well controls tell the two most probable hypotheses apart.

    The result is None if only one hypothesis is probable.

    Parameters
    ----------
    hypotheses : list of PredictedReadings
        The hypotheses.
    noise : (G,) array
        The standard deviation of the noise of each gauge, SI.
    """
    first, second = sorted(hypotheses, key=lambda hypothesis: -hypothesis.probability)[:2]
    if second.probability < _LEAST_PROBABILITY:
        return None
    distance = (first.readings - second.readings) / noise
    return Separation(
        (first.name, second.name),
        (first.probability, second.probability),
        np.sqrt(np.sum(distance**2, axis=-1)),
    )


def predicted_by_hypotheses(
    state: WatchState,
    twin: int,
    model_belief: Float,
    sensor_model: GaussianSensorModel,
    gains: Float,
    gain_deviation: float,
    gauge_names: tuple[str, ...],
) -> list[PredictedReadings]:
    """Return the readings that the hypotheses of a twin predict for a next step.

    Parameters
    ----------
    state : WatchState
        The state of the watch of B twins.
    twin : int
        The twin.
    model_belief : (S,) array
        Its belief about the state under the model.
    sensor_model : GaussianSensorModel
        The readings in each state.
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
    mean_readings = sensor_model.mean  # (S, U, G)
    by_model = np.einsum("s,sug->ug", model_belief, mean_readings)
    is_sound = 1.0 - none_of_these - float(probability.sum())
    hypotheses = [PredictedReadings("model", is_sound, by_model)]

    gauge = int(np.argmax(probability.sum(axis=1)))
    gauge_probability = float(probability[gauge].sum())
    belief_of_faults = state.beliefs.gauge[twin].reshape(states, -1, gauge_count, len(gains))
    joint = belief_of_faults[:, :, gauge].sum(axis=1) @ probability[gauge]  # (S,)
    if gauge_probability > 0.0 and joint.sum() > 0.0:
        readings = np.einsum("s,sug->ug", joint / joint.sum(), mean_readings)
        readings[:, gauge] *= 1.0 + float(probability[gauge] @ gains) / gauge_probability
        hypotheses.append(PredictedReadings(gauge_names[gauge], gauge_probability, readings))

    belief = state.beliefs.free_gains[twin].reshape(states, -1).sum(axis=1)
    statistics = state.free_gain_statistics
    regression = statistics.sum_cx[twin] / (1.0 + statistics.sum_cc[twin])
    gain = gain_deviation * statistics.free_probability[twin] * regression
    readings = (1.0 + gain) * np.einsum("s,sug->ug", belief / belief.sum(), mean_readings)
    hypotheses.append(PredictedReadings("none of these", none_of_these, readings))
    return hypotheses
