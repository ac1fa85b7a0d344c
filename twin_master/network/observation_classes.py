"""What sensors may show, as classes of finite number with their probabilities in each state."""

import numpy as np
from scipy.special import rel_entr

from reporting.arrays import Float
from twin_master.network.sensor_model import GaussianSensorModel

SAMPLES = 1500
"""Observations that are drawn for each control, the same number in each state."""
CLASSES = 64
"""Classes that they are joined to at most."""
_LOST = 0.005
"""Bits that may be lost where fewer classes do."""


def observation_classes(
    sensor_model: GaussianSensorModel, generator: np.random.Generator, classes: int = CLASSES
) -> tuple[Float, ...]:
    """Return for each control the probability of each class of observations in each state: (K, S).

    Observations are drawn in each state, and those are joined that tell the same of the state: whose
    posterior beliefs, from all states alike, are close in the distance of Hellinger. The probability of a
    class is that of its members, weighed by their likelihood in each state. There are as few as tell of the
    state what all observations do, by doubling their number.
    """
    from scipy.cluster.vq import kmeans2  # reads a second of modules that a flight does not need

    states = sensor_model.state_count
    drawn = np.repeat(np.arange(states), -(-SAMPLES // states))
    result = []
    for control in range(sensor_model.control_count):
        rows = sensor_model.sampled(drawn, control, generator)
        log_likelihood = sensor_model.log_likelihood_sequence(rows, np.full(len(rows), control))
        told = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
        told /= told.sum(axis=1, keepdims=True)
        number, every, joined = 1, _information(told), told.sum(axis=0, keepdims=True)
        while number < min(classes, len(rows)) and _information(joined) < every - _LOST:
            number *= 2
            _, label = kmeans2(np.sqrt(told), min(number, classes), minit="++", rng=generator)
            joined = np.array([told[label == place].sum(axis=0) for place in np.unique(label)])
        result.append(joined / joined.sum(axis=0))
    return tuple(result)


def _information(joint: Float) -> float:
    """Return what observations (K, S) tell of the state, in proportion to their joint probability [bit]."""
    seen, state = joint.sum(axis=1, keepdims=True), joint.sum(axis=0)
    return float(rel_entr(joint, seen * state / joint.sum()).sum() / joint.sum() / np.log(2.0))
