"""The weights of the hypotheses about the gauges, whose faults begin, show, hide and end.

    the model is right --> a gauge is off, or free gains --> recovered --> the model is right

The evidence for an alarm never fades, so that false alarms stay bounded. But belief and decision
have to come back when a fault has ended. So a fault ends in each step with a small probability, and
its weight goes, with its belief about the state, to the hypothesis "recovered", under which the
gauges are right again. The weights are the posterior of this switching process, given the
predictive density of each hypothesis. The belief of a fault stays that of its first beginning
(compare Blom and Bar-Shalom 1988).

A fault may show under one control and be hidden under another: a gauge that saturates in sharp
turns reads right in gentle ones. If a fault is hidden, the gauges are right, and it predicts the
same as "recovered". So readings do not change the odds of the two, and a hidden fault neither ends
nor fades. Each fault has for each control a probability that it shows there. It is one under the
control in force when the fault begins and `SHOWS_ELSEWHERE` under the others, and is then learnt
from the readings under that control.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reporting.arrays import Float, Index
from twin_master.gauges.belief_transitions import average_competing_beliefs
from twin_master.gauges.fault_kernels import Beliefs
from twin_master.network.estimator import Hypothesis

MODEL = 0
"""Index of the model among the current log weights."""
RECOVERED = 1
"""Index of the hypothesis that there was a fault and the gauges are right again."""
SOUND_HYPOTHESES = slice(RECOVERED + 1)
"""The hypotheses under which the gauges are right: the model, and "recovered"."""
FREE_GAINS = 2
"""Index of the fault that several gauges have unknown gains."""
FAULTS = slice(2, None)
"""All faults: free gains, then each gauge with each gain error."""
GAUGE_FAULTS = slice(3, None)
"""The faults of single gauges."""
FREE_GAINS_OF_FAULTS = 0
"""Index of free gains in arrays of faults only."""
GAUGES_OF_FAULTS = slice(1, None)
"""The faults of single gauges in arrays of faults only."""

END_PROBABILITY = 0.02
"""Probability in a step that a showing fault ends, and that "recovered" becomes the model again."""
SHOWS_ELSEWHERE = 0.5
"""Prior probability that a fault shows under another control than that in which it began."""
LEAST_SHOWING = 1e-3
"""Least probability that a fault shows under a control; a growing fault is then noticed there."""
_LEAST_PROBABILITY = 1e-300
"""Weights of hypotheses do not fall below this in a step, so that they have a logarithm."""
_LEAST_REPORTED = 0.01
"""Faults of gauges that are less probable are not listed among the hypotheses."""


def log_of_sum(first: Float, second: Float) -> Float:
    """Return log(exp(first) + exp(second)); several times as fast as `np.logaddexp`."""
    return np.asarray(np.maximum(first, second) + np.log(1.0 + np.exp(-np.abs(first - second))))


def log_of_sums(values: Float) -> Float:
    """Return the log of the sum of exponentials over the last axis."""
    largest = values.max(axis=-1)
    is_finite = largest > -np.inf
    reference = np.where(is_finite, largest, 0.0)
    with np.errstate(divide="ignore"):
        return np.asarray(reference + np.log(np.exp(values - reference[..., None]).sum(axis=-1)))


@dataclass
class HypothesisWeights:
    """Log weights of the hypotheses before or after an observation.

    There are G gauges with K gain errors each. So there are 1 + G K faults: free gains of several
    gauges, then each gauge with each gain error. Weights are joint log probabilities.
    All arrays may have a leading axis of twins.

    Attributes
    ----------
    current : (..., 3 + G K) array
        The log weights of the model, of "recovered", and of the faults that show under the control
        in force.
    hidden : (..., 1 + G K) array
        The log weights of the faults that do not show under it: free gains, then single gauges.
    showing : (..., 1 + G K, U) array
        The conditional probability that a fault, if there is one, shows under each of U controls.
        That of the control in force is contained in `current` and `hidden`.
    """

    current: Float
    hidden: Float
    showing: Float

    @classmethod
    def initial(
        cls, fault_probability: float, log_begin: Float, control_index: int, control_count: int
    ) -> "HypothesisWeights":
        """Return the weights before the first observation.

        Parameters
        ----------
        fault_probability : float
            The prior probability that there is a fault from the start.
        log_begin : (3 + G K,) array
            The log probability of each fault, given that one begins.
        control_index : int
            The control in force.
        control_count : int
            The number U of controls.
        """
        current = np.log(fault_probability) + log_begin
        current[MODEL] = np.log1p(-fault_probability)
        fault_count = len(log_begin[FAULTS])
        showing = np.full((fault_count, control_count), SHOWS_ELSEWHERE)
        showing[:, control_index] = 1.0
        return cls(current, np.full(fault_count, -np.inf), showing)

    @classmethod
    def stack(cls, weights: Sequence["HypothesisWeights"]) -> "HypothesisWeights":
        """Return the weights of several twins, with a leading axis."""
        return cls(
            current=np.stack([twin.current for twin in weights]),
            hidden=np.stack([twin.hidden for twin in weights]),
            showing=np.stack([twin.showing for twin in weights]),
        )

    def change_controls(self, previous_control: Index, control: Index) -> Float:
        """Update the weights of B twins in place for their new controls, see `change_control`.

        Parameters
        ----------
        previous_control, control : (B,) array
            The indices of the controls before and after the change. Twins in which they are equal
            do not change.

        Returns
        -------
        (B, 1 + G K) array
            The increase of p(fault, hidden), the probability that a fault exists and does not show,
            for free gains, then for each of K gain errors of each of G gauges. It is 0 where this
            probability decreases.
        """
        newly_hidden = np.zeros_like(self.hidden)
        pairs = np.stack([previous_control, control], axis=1)
        for old_control, new_control in np.unique(pairs, axis=0).tolist():
            if old_control == new_control:
                continue
            twins = np.flatnonzero(np.all(pairs == [old_control, new_control], axis=1))
            weights = HypothesisWeights(
                self.current[twins], self.hidden[twins], self.showing[twins]
            )
            newly_hidden[twins] = weights.change_control(old_control, new_control)
            self.current[twins] = weights.current
            self.hidden[twins] = weights.hidden
            self.showing[twins] = weights.showing
        return newly_hidden

    def change_control(self, previous_control: int, control: int) -> Float:
        """Split the probability of each fault into a visible and a hidden part, in place.

        A fault may be visible in the readings under one control and hidden under another. Its total
        probability does not change with the control:

            p(fault) = p(fault, visible) + p(fault, hidden).

        The logarithms of the two parts are in `current` and `hidden`. `showing` has the conditional
        probability p(visible | fault) under each control. First it is updated for the previous
        control from the two parts. Then the two parts are set by its value for the new control.

        Parameters
        ----------
        previous_control, control : int
            The indices of the controls before and after the change.

        Returns
        -------
        (..., 1 + G K) array
            The increase of p(fault, hidden) for free gains, then for each of K gain errors of each
            of G gauges; 0 where it decreases.
        """
        log_fault_and_visible = self.current[..., FAULTS]
        log_fault = np.logaddexp(log_fault_and_visible, self.hidden)
        previous_hidden = np.exp(self.hidden)
        p_visible_given_fault = np.exp(log_fault_and_visible - log_fault)
        self.showing[..., previous_control] = np.clip(p_visible_given_fault, LEAST_SHOWING, 1.0)
        self.current[..., FAULTS] = log_fault + np.log(self.showing[..., control])
        with np.errstate(divide="ignore"):  # a fault that is certainly visible is not hidden
            self.hidden = log_fault + np.log1p(-self.showing[..., control])
        return np.asarray(np.maximum(np.exp(self.hidden) - previous_hidden, 0.0))

    def advance(self, log_hazard: float | Float, log_begin: Float) -> Float:
        """Let faults begin and end in a step: one transition of the weights, in place.

        Parameters
        ----------
        log_hazard : float or (...) array
            The log probability that a fault begins in the step.
        log_begin : (3 + G K,) array
            The log probability of each fault, given that one begins.

        Returns
        -------
        (..., 1 + G K) array
            The probability of each fault that it has ended in the step.
        """
        probability = np.exp(self.current)
        hidden_probability = np.exp(self.hidden)
        hazard = np.exp(np.asarray(log_hazard))
        ended = END_PROBABILITY * probability[..., FAULTS]

        # A new fault begins from the model. If the gauges are right again after a fault, only free
        # gains may begin: the beliefs of single gauges have not followed what happened since.
        free_gains_begin = hazard * np.exp(log_begin[FREE_GAINS])
        right_after_fault = probability[..., RECOVERED] + hidden_probability.sum(axis=-1)
        begun = (probability[..., MODEL] * hazard)[..., None] * np.exp(log_begin[FAULTS])
        begun[..., FREE_GAINS_OF_FAULTS] += right_after_fault * free_gains_begin

        # Each hypothesis keeps the probability that it does not pass on to others.
        stay = np.full_like(probability, 1.0 - END_PROBABILITY)
        stay[..., MODEL] = 1.0 - hazard
        stay[..., RECOVERED] = 1.0 - END_PROBABILITY - free_gains_begin
        advanced = probability * stay
        advanced[..., MODEL] += END_PROBABILITY * probability[..., RECOVERED]
        advanced[..., RECOVERED] += ended.sum(axis=-1)
        advanced[..., FAULTS] += begun
        self.current = np.log(np.maximum(advanced, _LEAST_PROBABILITY))
        self.hidden = self.hidden + np.log1p(-free_gains_begin)[..., None]

        # Nothing is known about a fault that began in this step under the other controls: it shows
        # there with the prior probability.
        hidden_probability *= (1.0 - free_gains_begin)[..., None]
        fault_probability = np.maximum(
            advanced[..., FAULTS] + hidden_probability, _LEAST_PROBABILITY
        )
        self.showing += (begun / fault_probability)[..., None] * (SHOWS_ELSEWHERE - self.showing)
        return np.asarray(ended)

    def update(self, log_ratio: Float) -> None:
        """Correct the weights by an observation, in place, and normalise them.

        Parameters
        ----------
        log_ratio : (..., 3 + G K) array
            The log evidence of each hypothesis minus that of the model. A hidden fault predicts the
            same as "recovered".
        """
        self.current = self.current + log_ratio
        self.hidden = self.hidden + log_ratio[..., RECOVERED, None]
        largest = np.maximum(self.current.max(axis=-1), self.hidden.max(axis=-1))[..., None]
        total = np.exp(self.current - largest).sum(axis=-1)
        total += np.exp(self.hidden - largest).sum(axis=-1)
        log_total_weight = largest + np.log(total)[..., None]
        self.current -= log_total_weight
        self.hidden -= log_total_weight

    @property
    def right_after_fault(self) -> Float:
        """Probability (...) that a fault has ended or is hidden, so that the gauges are right."""
        return np.asarray(np.exp(self.current)[..., RECOVERED] + np.exp(self.hidden).sum(axis=-1))

    @property
    def free_gains_probability(self) -> Float:
        """Probability (...) that several gauges have unknown gains, whether this shows or not."""
        return np.asarray(self._fault_probability[..., FREE_GAINS_OF_FAULTS])

    @property
    def gauge_fault_probability(self) -> Float:
        """Probability (..., G K) of K gain errors of G gauges, whether it shows or not."""
        return np.asarray(self._fault_probability[..., GAUGES_OF_FAULTS])

    @property
    def _fault_probability(self) -> Float:
        """Probability (..., 1 + G K) of each fault, whether it shows or not.

        Exponentials are taken of whole arrays: NumPy takes those of every n-th number by another
        algorithm, whose last bits differ, so that they would depend on the number of twins.
        """
        return np.asarray(np.exp(self.current)[..., FAULTS] + np.exp(self.hidden))


@dataclass(frozen=True)
class MixedBelief:
    """The beliefs of B twins about the state, averaged over all hypotheses but free gains.

    Attributes
    ----------
    belief : (B, S) array
        The average over the model and its competitors.
    competing : (B, S) array
        The average over the competitors of the model.
    model_weight : (B,) array
        The weight of the model.
    """

    belief: Float
    competing: Float
    model_weight: Float


def mix_beliefs(weights: HypothesisWeights, model_belief: Float, beliefs: Beliefs) -> MixedBelief:
    """Return the beliefs about the state, averaged over all hypotheses but free gains.

    The hypothesis of free gains (all gauges have unknown gains) is left out, because it says
    nothing about the state.

    Parameters
    ----------
    weights : HypothesisWeights
        The log weights of B twins.
    model_belief : (B, S) array
        Their beliefs about the state under the model.
    """
    # Normalise the weights without free gains, under which no state is believed.
    log_hidden = weights.hidden[:, GAUGES_OF_FAULTS]
    largest = np.maximum(
        weights.current[:, SOUND_HYPOTHESES].max(axis=1),
        np.maximum(weights.current[:, GAUGE_FAULTS].max(axis=1), log_hidden.max(axis=1)),
    )[:, None]
    sound_weight = np.exp(weights.current[:, SOUND_HYPOTHESES] - largest)
    gauge_weight = np.exp(weights.current[:, GAUGE_FAULTS] - largest)
    hidden_weight = np.exp(log_hidden - largest).sum(axis=1)
    total = sound_weight.sum(axis=1) + gauge_weight.sum(axis=1) + hidden_weight
    gauge_weight /= total[:, None]

    model_weight = sound_weight[:, MODEL] / total
    right_after_fault = (sound_weight[:, RECOVERED] + hidden_weight) / total
    competing_belief = np.empty_like(model_belief)
    average_competing_beliefs(right_after_fault, gauge_weight, beliefs, competing_belief)
    competing_sum = competing_belief.sum(axis=1)[:, None]
    is_any_competing = competing_sum > 0.0
    competing_belief = np.where(
        is_any_competing,
        competing_belief / np.where(is_any_competing, competing_sum, 1.0),
        model_belief,
    )
    belief = model_weight[:, None] * model_belief + (1.0 - model_weight)[:, None] * competing_belief
    return MixedBelief(belief, competing_belief, model_weight)


def list_hypotheses(
    weights: HypothesisWeights,
    model_belief: Float,
    beliefs: Beliefs,
    gauge_names: tuple[str, ...],
) -> tuple[Hypothesis, ...]:
    """Return the competing hypotheses of one twin, with their probabilities and beliefs.

    These are the model, each gauge whose fault has a probability of at least 1 %, and "none of
    these", which is free gains.

    Parameters
    ----------
    weights : HypothesisWeights
        The log weights, with a leading axis of length one.
    model_belief : (1, S) array
        The belief about the state under the model.
    beliefs : Beliefs
        The beliefs under each other hypothesis, of one twin.
    gauge_names : tuple of str
        The names of the G faults of the gauges, such as "gauge 5 off".
    """
    gauge_count = len(gauge_names)
    (probability,) = np.exp(weights.current)  # (3 + G K,)
    (log_hidden,) = weights.hidden  # (1 + G K,)
    showing_probability = probability[GAUGE_FAULTS].reshape(gauge_count, -1)  # (G, K)
    hidden_probability = np.exp(log_hidden[GAUGES_OF_FAULTS]).reshape(gauge_count, -1)  # (G, K)
    gauge_probability = (showing_probability + hidden_probability).sum(axis=1)  # (G,)
    state_count = model_belief.shape[1]
    recovered_belief = beliefs.recovered.reshape(state_count, -1).sum(axis=1)  # (S,)

    # The gauges are right: the mixture of the model's belief and of that after a fault has ended.
    sound_probability = probability[SOUND_HYPOTHESES].sum()
    sound_belief = model_belief[0]
    if probability[RECOVERED] > 0.0:
        joint = probability[MODEL] * sound_belief + probability[RECOVERED] * recovered_belief
        sound_belief = joint / sound_probability
    hypotheses = [Hypothesis("model", float(sound_probability), sound_belief)]

    # A gauge is off: the mixture of the fault where it shows, with each gain error, and of the
    # fault where it is hidden, which predicts the same as "recovered".
    draw_count = beliefs.recovered.shape[1] // state_count
    # (S, E, G, K)
    belief_of_fault = beliefs.gauge.reshape(state_count, draw_count, gauge_count, -1)
    for g in np.flatnonzero(gauge_probability >= _LEAST_REPORTED).tolist():
        showing_joint = np.einsum("k,sek->s", showing_probability[g], belief_of_fault[:, :, g])
        joint = showing_joint + hidden_probability[g].sum() * recovered_belief
        belief = joint / joint.sum()
        hypotheses.append(Hypothesis(gauge_names[g], float(gauge_probability[g]), belief))
    none_of_these = float(weights.free_gains_probability[0])
    hypotheses.append(Hypothesis("none of these", none_of_these, None))
    return tuple(hypotheses)


def most_probable_hypothesis(weights: HypothesisWeights, gauge_count: int) -> tuple[Index, Float]:
    """Return the most probable hypothesis of each of B twins, and its probability.

    Parameters
    ----------
    weights : HypothesisWeights
        The log weights of B twins.
    gauge_count : int
        The number G of gauges.

    Returns
    -------
    hypothesis : (B,) array
        0 is the model, -1 free gains, and g > 0 is gauge g, counted from 1.
    probability : (B,) array
        Its probability.
    """
    twin_count = len(weights.current)
    # The gauges are right under the model, and also after a fault has ended.
    sound_probability = np.exp(weights.current[:, SOUND_HYPOTHESES]).sum(axis=1)  # (B,)
    fault_probability = weights.gauge_fault_probability.reshape(twin_count, gauge_count, -1)
    gauge_probability = fault_probability.sum(axis=2)  # over the gain errors: (B, G)

    # One column for each hypothesis: the model, gauges 1 to G, free gains.
    probability = np.column_stack(
        [sound_probability, gauge_probability, weights.free_gains_probability]
    )
    column = np.argmax(probability, axis=1)
    largest_probability = np.take_along_axis(probability, column[:, None], axis=1)[:, 0]
    column_of_free_gains = gauge_count + 1
    hypothesis = np.where(column == column_of_free_gains, -1, column)
    return hypothesis, largest_probability
