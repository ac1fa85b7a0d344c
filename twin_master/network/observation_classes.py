"""Classes of observations: few outcomes with nearly all the information about the state."""

import numpy as np

from reporting.arrays import Float
from twin_master.network.sensor_model import GaussianSensorModel

SAMPLES = 1500
"""Observations that are drawn for each control, the same number in each state."""
MOST_CLASSES = 64
"""Largest number of classes into which the drawn observations are joined."""
_LOSS = 0.005
"""Information about the state that fewer classes may lose [bit]."""


def observation_classes(
    sensor_model: GaussianSensorModel,
    generator: np.random.Generator,
    classes: int = MOST_CLASSES,
) -> tuple[Float, ...]:
    """Return for each control p(class of the observation | state), for K classes: (K, S).

    Observations are drawn in each state. Those with similar posterior beliefs, from a uniform
    prior, are joined to a class: their Hellinger distance is small. The probability of a class in a
    state is the sum of the posteriors of its members, normalised over the classes. The number of
    classes is doubled until they contain as much information about the state as all observations.

    Parameters
    ----------
    sensor_model : GaussianSensorModel
        S states, U controls.
    generator : numpy.random.Generator
        The source of random numbers for the observations.
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
        class_sums = _join_similar(posterior, generator, classes)
        class_probabilities.append(class_sums / class_sums.sum(axis=0))
    return tuple(class_probabilities)


def _join_similar(posterior: Float, generator: np.random.Generator, classes: int) -> Float:
    """Return the sum of the posteriors in each class of similar ones: (N, S) -> (K, S).

    The classes are found by k-means; their number K is at most `classes`.
    """
    from scipy.cluster.vq import kmeans2  # slow to import, and not needed in flight

    information = _information(posterior)
    count = 1
    class_sums: Float = posterior.sum(axis=0, keepdims=True)
    largest_count = min(classes, len(posterior))
    while count < largest_count and _information(class_sums) < information - _LOSS:
        count *= 2
        # The Euclidean distance of square roots of probabilities is the Hellinger distance.
        _, label = kmeans2(np.sqrt(posterior), min(count, classes), minit="++", rng=generator)
        class_sums = np.array(
            [posterior[label == class_index].sum(axis=0) for class_index in np.unique(label)]
        )
    return class_sums


def _information(joint: Float) -> float:
    """Return the mutual information of observation and state [bit].

    Parameters
    ----------
    joint : (K, S) array
        Proportional to the joint probability of K observations and S states.
    """
    from scipy.special import rel_entr  # slow to import, and not needed in flight

    observation_weight = joint.sum(axis=1, keepdims=True)
    state_weight = joint.sum(axis=0)
    joint_sum = joint.sum()
    independent = observation_weight * state_weight / joint_sum
    return float(rel_entr(joint, independent).sum() / joint_sum / np.log(2.0))
