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

from dataclasses import dataclass

import numpy as np

from reporting.arrays import Float, Single
from twin_master.network.estimator import Hypothesis

MODEL = 0
"""Index of the model among the current log weights."""
RECOVERED = 1
"""Index of the hypothesis that there was a fault and the gauges are right again."""
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
"""Least probability that a fault shows under a control: one that grows is seen there in the end."""
_LEAST_REPORTED = 0.01
"""Faults of gauges that are less probable are not listed among the hypotheses."""


@dataclass
class HypothesisWeights:
    """Log weights of the hypotheses before or after an observation, for G gauges and K gain errors.

    Attributes
    ----------
    current : (3 + G K,) array
        The log weights of the model, of "recovered", and of the faults that show under the control
        in force.
    hidden : (1 + G K,) array
        The log weights of the faults that do not show under it: free gains, then single gauges.
    showing : (1 + G K, U) array
        The probability that a fault shows under each control. That of the control in force is
        contained in `current` and `hidden`.
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

    def change_control(self, previous_control: int, control: int) -> Float:
        """Divide each fault into a showing and a hidden part under the next control, in place.

        Parameters
        ----------
        previous_control, control : int
            The controls of the previous step and of the next one.

        Returns
        -------
        (1 + G K,) array
            The probability of each fault that it showed before and is hidden now.
        """
        # Keep what was learnt under the previous control: p(showing | fault).
        log_showing_before = self.current[FAULTS]
        hidden_before = np.exp(self.hidden)
        log_fault = np.logaddexp(log_showing_before, self.hidden)
        showing_probability = np.exp(log_showing_before - log_fault)
        self.showing[:, previous_control] = np.clip(showing_probability, LEAST_SHOWING, 1.0)
        self.current[FAULTS] = log_fault + np.log(self.showing[:, control])
        self.hidden = log_fault + np.log1p(-self.showing[:, control])
        return np.asarray(np.maximum(np.exp(self.hidden) - hidden_before, 0.0))

    def advance(self, log_hazard: float, log_begin: Float) -> Float:
        """Let faults begin and end in a step: one transition of the weights, in place.

        Parameters
        ----------
        log_hazard : float
            The log probability that a fault begins in the step.
        log_begin : (3 + G K,) array
            The log probability of each fault, given that one begins.

        Returns
        -------
        (1 + G K,) array
            The probability of each fault that it has ended in the step.
        """
        before = self.current
        log_ended = np.log(END_PROBABILITY) + before

        # A new fault begins from the model. If the gauges are right again after a fault, only free
        # gains may begin: the beliefs of single gauges have not followed what happened since.
        log_free_gains_begin = log_hazard + log_begin[FREE_GAINS]
        log_right_after_fault = np.logaddexp(before[RECOVERED], np.logaddexp.reduce(self.hidden))
        log_begun = before[MODEL] + log_hazard + log_begin[FAULTS]
        log_begun[FREE_GAINS_OF_FAULTS] = np.logaddexp(
            log_begun[FREE_GAINS_OF_FAULTS], log_right_after_fault + log_free_gains_begin
        )

        # Each hypothesis keeps the probability that it does not pass on to others.
        log_stay = np.full_like(before, np.log1p(-END_PROBABILITY))
        log_stay[MODEL] = np.log1p(-np.exp(log_hazard))
        log_stay[RECOVERED] = np.log1p(-END_PROBABILITY - np.exp(log_free_gains_begin))
        log_to_model = log_ended[RECOVERED]
        log_to_recovered = np.logaddexp.reduce(log_ended[FAULTS])
        log_incoming = np.append([log_to_model, log_to_recovered], log_begun)
        self.current = np.logaddexp(before + log_stay, log_incoming)
        self.hidden = self.hidden + np.log1p(-np.exp(log_free_gains_begin))

        # For a fault that began in this step nothing is known about the other controls: it has the
        # prior probability to show there.
        log_fault = np.logaddexp(self.current[FAULTS], self.hidden)
        begun_fraction = np.exp(log_begun - log_fault)
        self.showing += begun_fraction[:, None] * (SHOWS_ELSEWHERE - self.showing)
        return np.asarray(np.exp(log_ended[FAULTS]))

    def update(self, log_ratio: Float) -> None:
        """Correct the weights by an observation, in place, and normalise them.

        Parameters
        ----------
        log_ratio : (3 + G K,) array
            The log evidence of each hypothesis minus that of the model. A hidden fault predicts the
            same as "recovered".
        """
        self.current = self.current + log_ratio
        self.hidden = self.hidden + log_ratio[RECOVERED]
        total = np.logaddexp(np.logaddexp.reduce(self.current), np.logaddexp.reduce(self.hidden))
        self.current -= total
        self.hidden -= total

    @property
    def log_right_after_fault(self) -> float:
        """Log probability of a fault that ended or is hidden, so that the gauges are right now."""
        return float(np.logaddexp(self.current[RECOVERED], np.logaddexp.reduce(self.hidden)))

    @property
    def free_gains_probability(self) -> float:
        """Probability that several gauges have unknown gains, whether this shows or not."""
        log_hidden = self.hidden[FREE_GAINS_OF_FAULTS]
        return float(np.exp(np.logaddexp(self.current[FREE_GAINS], log_hidden)))

    @property
    def gauge_fault_probability(self) -> Float:
        """Probability of each gain error of each gauge (G K,), whether this shows or not."""
        log_hidden = self.hidden[GAUGES_OF_FAULTS]
        return np.asarray(np.exp(np.logaddexp(self.current[GAUGE_FAULTS], log_hidden)))


@dataclass(frozen=True)
class HypothesisBeliefs:
    """The beliefs about the state under all hypotheses but free gains, which no state explains.

    Attributes
    ----------
    model : (S,) array
        The belief about the state under the model.
    recovered : (E, S) array
        The belief over draws and states under "recovered", and under a gauge fault that is hidden.
    gauge : (G, K, E, S) array
        The same under each fault of a gauge that shows.
    """

    model: Float
    recovered: Float
    gauge: Single


@dataclass(frozen=True)
class MixedBelief:
    """The belief about the state, averaged over all hypotheses but free gains.

    Attributes
    ----------
    belief : (S,) array
        The average over the model and its competitors.
    competing : (S,) array
        The average over the competitors of the model.
    model_weight : float
        The weight of the model.
    """

    belief: Float
    competing: Float
    model_weight: float


def mix_beliefs(weights: HypothesisWeights, beliefs: HypothesisBeliefs) -> MixedBelief:
    """Return the belief about the state, averaged over all hypotheses but free gains.

    Under free gains no state explains the sensors, so that they add nothing to the belief.
    """
    # Normalise the weights without free gains, under which no state is believed.
    log_believing = np.append(
        np.delete(weights.current, FREE_GAINS), weights.hidden[GAUGES_OF_FAULTS]
    )
    log_total = np.logaddexp.reduce(log_believing)
    current_weight = np.exp(weights.current - log_total)
    hidden_weight = np.exp(weights.hidden[GAUGES_OF_FAULTS] - log_total)

    model_weight = float(current_weight[MODEL])
    right_after_fault = current_weight[RECOVERED] + hidden_weight.sum()
    gauge_weight = current_weight[GAUGE_FAULTS].astype(np.float32)
    gauge_competitors = gauge_weight @ beliefs.gauge.reshape(len(gauge_weight), -1)
    competing = gauge_competitors.reshape(beliefs.recovered.shape).sum(axis=0)
    competing = competing + right_after_fault * beliefs.recovered.sum(axis=0)
    competing_sum = competing.sum()
    competing = beliefs.model if competing_sum == 0.0 else competing / competing_sum
    belief = model_weight * beliefs.model + (1.0 - model_weight) * competing
    return MixedBelief(belief, competing, model_weight)


def list_hypotheses(
    weights: HypothesisWeights, beliefs: HypothesisBeliefs, gauge_names: tuple[str, ...]
) -> tuple[Hypothesis, ...]:
    """Return the competing hypotheses, each with its probability and its belief about the state.

    These are the model, each gauge whose fault has a probability of at least 1 %, and "none of
    these" (free gains).

    Parameters
    ----------
    weights : HypothesisWeights
        The log weights.
    beliefs : HypothesisBeliefs
        The belief of each hypothesis about the state.
    gauge_names : tuple of str
        The names of the faults of the gauges, such as "gauge 5 off".
    """
    probability = np.exp(weights.current)
    gauges_and_gains = beliefs.gauge.shape[:2]
    showing_probability = probability[GAUGE_FAULTS].reshape(gauges_and_gains)
    hidden_probability = np.exp(weights.hidden[GAUGES_OF_FAULTS]).reshape(gauges_and_gains)
    gauge_probability = (showing_probability + hidden_probability).sum(axis=1)

    # The gauges are right: under the model, or after a fault has ended.
    sound_probability = probability[: RECOVERED + 1].sum()
    belief = beliefs.model
    if probability[RECOVERED] > 0.0:
        recovered_belief = beliefs.recovered.sum(axis=0)
        belief = (
            probability[MODEL] * beliefs.model + probability[RECOVERED] * recovered_belief
        ) / sound_probability
    hypotheses = [Hypothesis("model", float(sound_probability), belief)]

    for g in np.flatnonzero(gauge_probability >= _LEAST_REPORTED).tolist():
        showing_belief = np.einsum(
            "k,kes->s", showing_probability[g], beliefs.gauge[g]
        )  # over gains, draws
        hidden_belief = hidden_probability[g].sum() * beliefs.recovered.sum(axis=0)
        belief = showing_belief + hidden_belief
        hypotheses.append(
            Hypothesis(gauge_names[g], float(gauge_probability[g]), belief / belief.sum())
        )
    hypotheses.append(Hypothesis("none of these", weights.free_gains_probability, None))
    return tuple(hypotheses)
