"""The partially observed decision problem that is planned on, with finitely many observations."""

from dataclasses import dataclass

import numpy as np

from reporting.arrays import Float, Index
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.network.transition import TransitionModel

SAMPLES = 1500
"""Observations that are drawn for each control, the same number in each state."""
MOST_CLASSES = 64
"""Largest number of classes into which the drawn observations are joined."""
_LOSS = 0.005
"""Information about the state that fewer classes may lose [bit]."""


@dataclass(frozen=True)
class DecisionProblem:
    """A partially observed Markov decision problem of finite size.

    In a step the state is first observed under the control and then moves. If `moves_first`, the
    state first moves and is then observed.

    Attributes
    ----------
    transition : TransitionModel
        The transitions between S states under U controls.
    reward : (S, U) array
        The reward of one step.
    discount : (U,) array
        The discount factor of the return after a step, in [0, 1); zero if nothing follows.
    likelihood : tuple of (K, S) array
        For each control p(observation | state), for K observations: columns sum to one. K may
        differ from control to control.
    prior : (S,) array
        The belief before the first step.
    moves_first : bool
        Whether the observation in a step is that of the state to which the step leads.
    """

    transition: TransitionModel
    reward: Float
    discount: Float
    likelihood: tuple[Float, ...]
    prior: Float
    moves_first: bool = False

    def next_beliefs(self, belief: Float, control: int, observation: Index | None = None) -> Float:
        """Return the next beliefs, each multiplied by the probability of its observation.

        Parameters
        ----------
        belief : (S,) or (B, S) array
            One belief; or B beliefs with an observation for each.
        observation : (B,) array, optional
            The observation that follows each belief; if left out, all K observations of one belief.

        Returns
        -------
        (K, S) or (B, S) array
            The next belief after each observation. A row sums to the observation's probability.
        """
        likelihood = self.likelihood[control]
        if observation is not None:
            likelihood = likelihood[observation]
        if self.moves_first:
            return np.asarray(likelihood * self.transition.forward(control, belief))
        return self.transition.forward(control, likelihood * belief)

    def expected_vector(self, control: int, plan_of_class: Index, vectors: Float) -> Float:
        """Return the expected return after a step, by the state before the step.

        The observation of the step decides which plan is followed after it. The reward of the step
        itself is not included.

        Parameters
        ----------
        plan_of_class : (K,) array
            For each of K observations, the index of the plan that is followed after it.
        vectors : (N, S) array
            The expected return of each of N plans, if it starts from each of S states.

        Returns
        -------
        (S,) array
            The expected return after the step, for each state before it.
        """
        likelihood = self.likelihood[control]  # (K, S), p(observation | state)
        if self.moves_first:
            # The observation depends on the state after the transition: take the expectation over
            # the observation in each such state, then over the transition.
            after_transition = np.einsum("ks,ks->s", likelihood, vectors[plan_of_class])
            return self.transition.expected_value(control, after_transition)
        # The observation depends on the state before the transition: sum over the plans of the
        # probability that the plan is chosen times its expected return.
        result: Float = np.zeros(len(self.prior))
        for plan in np.unique(plan_of_class).tolist():
            probability = likelihood[plan_of_class == plan].sum(axis=0)
            result += probability * self.transition.expected_value(control, vectors[plan])
        return result


def observation_classes(
    sensor_model: GaussianSensorModel,
    generator: np.random.Generator,
    classes: int = MOST_CLASSES,
) -> tuple[Float, ...]:
    """Divide observations into K classes; return p(class | state) (K, S) for each control.

    Observations are drawn in each state. Observations with similar posteriors (from a uniform
    prior, by the Hellinger distance) form a class. The probability of a class in a state is the sum
    of the posteriors of its members, normalised over the classes. K is doubled until the classes
    contain nearly as much information about the state as all observations.

    Parameters
    ----------
    sensor_model : GaussianSensorModel
        S states, U controls.
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
    """Divide N posteriors (N, S) into K classes of similar ones; return their sums (K, S).

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
