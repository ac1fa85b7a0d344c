"""Which hypothesis holds now: a mixture whose faults begin and end, for the belief and the decision.

    the model is right --> a gauge is off, or none of these --> mended --> the model is right

Evidence for an alarm never fades, so that its false alarms stay bounded. What is believed has to come back
when a fault has ended: each turn one ends with a small probability, and its share goes with its own belief
about the state to the hypothesis "mended", under which the sensors are right again. The shares of all are the
posterior of this switching process, given the predictive density of each hypothesis; the belief of a fault
stays that of its first beginning (compare Blom and Bar-Shalom 1988).
"""

import numpy as np

from reporting.arrays import Float, Single
from twin_master.network.estimator import Hypothesis

MODEL, MENDED, NONE, GAUGES = 0, 1, 2, 3
"""Places in the log shares; from the last on the sensors and their gains."""
ENDS = 0.02
"""Probability that a fault ends in a turn, and that what is mended is as if nothing had been."""
_TOLD = 0.01


def at_first(begun: float, begins: Float) -> Float:
    """Return the log shares (3 + G K,) before the first observation.

    Parameters
    ----------
    begun : float
        Prior probability of a fault from the start.
    begins : (3 + G K,)
        Log probability of each fault where one begins.
    """
    share: Float = np.log(begun) + begins
    share[MODEL] = np.log1p(-begun)
    return share


def one_turn_later(share: Float, log_hazard: float, begins: Float) -> tuple[Float, Float]:
    """Return the log shares one turn later, and those that went from each fault to "mended" (1 + G K,).

    Parameters
    ----------
    share : (3 + G K,)
        Log shares.
    log_hazard : float
        Log probability that a fault begins in the turn.
    begins : (3 + G K,)
        Log probability of each fault where one begins.
    """
    ended = np.log(ENDS) + share
    left = np.full_like(share, np.log1p(-ENDS))
    left[MODEL] = np.log1p(-np.exp(log_hazard))
    left[MENDED] = np.log1p(-ENDS - np.exp(log_hazard + begins[NONE]))
    come = share[MODEL] + log_hazard + begins
    come[MODEL], come[MENDED] = ended[MENDED], np.logaddexp.reduce(ended[NONE:])
    # Beliefs of single gauges are stale behind a fault that has ended: what is wrong then is none of these.
    come[NONE] = np.logaddexp(come[NONE], share[MENDED] + log_hazard + begins[NONE])
    return np.logaddexp(share + left, come), ended[NONE:] - come[MENDED]


def beliefs_of(share: Float, filtered: Float, mended: Float, gauge: Single) -> tuple[Float, Float, float]:
    """Return the belief (S,) wherever a state is believed, that of all but the model, and the model's weight.

    Parameters
    ----------
    share : (3 + G K,)
        Log shares.
    filtered : (S,)
        Belief under the model.
    mended : (E, S)
    gauge : (G, K, E, S)
    """
    weight = np.exp(share - np.logaddexp.reduce(np.delete(share, NONE)))
    own = weight[GAUGES:].astype(np.float32) @ gauge.reshape(len(weight) - GAUGES, -1)
    rivals = own.reshape(mended.shape).sum(axis=0) + weight[MENDED] * mended.sum(axis=0)
    total = rivals.sum()
    rivals = filtered if total == 0.0 else rivals / total
    right = float(weight[MODEL])
    return right * filtered + (1.0 - right) * rivals, rivals, right


def hypotheses(
    share: Float, filtered: Float, mended: Float, gauge: Single, names: tuple[str, ...]
) -> tuple[Hypothesis, ...]:
    """Return the model, each gauge that may well be off, and none of these, with what each believes.

    Parameters are those of `beliefs_of`; `names` are those of "gauge g is off".
    """
    probability = np.exp(share - np.logaddexp.reduce(share))
    of_gauge = probability[GAUGES:].reshape(gauge.shape[:2])
    right = probability[: MENDED + 1].sum()
    belief = filtered
    if probability[MENDED] > 0.0:
        belief = (probability[MODEL] * filtered + probability[MENDED] * mended.sum(axis=0)) / right
    found = [Hypothesis("model", float(right), belief)]
    for g in np.flatnonzero(of_gauge.sum(axis=1) >= _TOLD).tolist():
        own = np.einsum("k,kes->s", of_gauge[g], gauge[g])
        found.append(Hypothesis(names[g], float(of_gauge[g].sum()), own / own.sum()))
    return (*found, Hypothesis("none of these", float(probability[NONE]), None))
