"""Classes of observations: few outcomes that tell of the state what all observations do."""

import numpy as np
from scipy.special import rel_entr

from reporting.arrays import Float
from twin_master.network.sensor_model import GaussianSensorModel

SAMPLES = 1500
"""Observations that are drawn for each control, the same number in each state."""
MOST_CLASSES = 64
"""Classes into which they are joined at most."""
_LOSS = 0.005
"""Information about the state that fewer classes may lose [bit]."""


def observation_classes(
    sensor_model: GaussianSensorModel,
    generator: np.random.Generator,
    classes: int = MOST_CLASSES,
) -> tuple[Float, ...]:
    """Return for each control the probability of each class of observations in each state: (K, S).

    Observations are drawn in each state. Those are joined to a class that tell the same of the
    state: their posterior beliefs, from a uniform prior, are close in the distance of Hellinger.
    The probability of a class is that of its members, weighted by their likelihood in each state.
    The number of classes is doubled until they tell as much of the state as all observations.

    Parameters
    ----------
    sensor_model : GaussianSensorModel
        S states, U controls.
    generator : numpy.random.Generator
        Draws the observations.
    classes : int
        The largest number of classes.
    """
    states = sensor_model.state_count
    samples_per_state = -(-SAMPLES // states)  # rounded up
    sampled_states = np.repeat(np.arange(states), samples_per_state)
    class_probabilities = []
    for control in range(sensor_model.control_count):
        observations = sensor_model.draw_observations(sampled_states, control, generator)
        log_likelihood = sensor_model.log_likelihood_sequence(
            observations, np.full(len(observations), control)
        )
        posterior = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
        posterior /= posterior.sum(axis=1, keepdims=True)
        joined = _join_similar(posterior, generator, classes)
        class_probabilities.append(joined / joined.sum(axis=0))
    return tuple(class_probabilities)


def _join_similar(posterior: Float, generator: np.random.Generator, classes: int) -> Float:
    """Return sums (K, S) of posteriors (N, S) that are similar, in K classes at most."""
    from scipy.cluster.vq import kmeans2  # slow to import, and not needed in flight

    information = _information(posterior)
    count = 1
    joined: Float = posterior.sum(axis=0, keepdims=True)
    most = min(classes, len(posterior))
    while count < most and _information(joined) < information - _LOSS:
        count *= 2
        # The Euclidean distance of square roots is that of Hellinger.
        _, label = kmeans2(np.sqrt(posterior), min(count, classes), minit="++", rng=generator)
        joined = np.array([posterior[label == one].sum(axis=0) for one in np.unique(label)])
    return joined


def _information(joint: Float) -> float:
    """Return the mutual information of observation and state [bit].

    Parameters
    ----------
    joint : (K, S) array
        Proportional to the joint probability of K observations and S states.
    """
    observation = joint.sum(axis=1, keepdims=True)
    state = joint.sum(axis=0)
    total = joint.sum()
    independent = observation * state / total
    return float(rel_entr(joint, independent).sum() / total / np.log(2.0))
