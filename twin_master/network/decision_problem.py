"""The partially observed decision problem that is planned on."""

from dataclasses import dataclass

import numpy as np

from reporting.arrays import Float, Index
from twin_master.network.transition import TransitionModel


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
        control : int
            The control of the step.
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
        control : int
            The control of the step.
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
