"""Rival hypotheses about the gauges beside the model as it is, each with a belief over draws and states.

A pair of a draw and a state is a place, of which there are N. Beliefs are weighed where they are not
negligible. Which hypothesis holds now, for the belief and the decision, is a mixture whose faults begin and
end:

    the model is right --> a gauge is off, or none of these --> mended --> the model is right

Evidence for an alarm never fades, so that its false alarms stay bounded. What is believed has to come back
when a fault has ended: each step one ends with a small probability, and its share goes with its own belief
about the state to the hypothesis "mended", under which the sensors are right again. The shares of all are the
posterior of this switching process, given the predictive density of each hypothesis; the belief of a fault
stays that of its first beginning (compare Blom and Bar-Shalom 1988).

A fault may show under one control and be hidden under another: a gauge that saturates in sharp turns reads
right in gentle ones. Where it is hidden the sensors are right, so that it predicts what "mended" predicts:
readings there speak neither for the one nor for the other, and a hidden fault neither ends nor fades. Each
fault has for each control a probability that it shows there: one under the control in force when it begins,
`SHOWS_ELSEWHERE` under the others, and from then on what the readings under that control say.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled
from reporting.arrays import Float, Single
from twin_master.network.estimator import Hypothesis

NEGLIGIBLE = 1e-30
"""Places of the model below this probability are left out of its evidence."""
NEGLIGIBLE_RIVAL = 1e-7
"""The same of a rival: what is left out makes its evidence smaller, and an alarm later."""


class Shown(NamedTuple):
    """One observation beside what is predicted at each place, in units of the assumed noise.

    Attributes
    ----------
    there : (G,)
        Whether a gauge reports; the others have a residual and a size of zero.
    residual, size : (N, G)
        What a gauge shows beyond its prediction, and the prediction.
    power : (G,)
        Of the predictive densities, which are Student's.
    degrees : float
        How sure the assumed noise is.
    """

    there: NDArray[np.bool_]
    residual: Float
    size: Float
    power: Float
    degrees: float


class OfModel(NamedTuple):
    """What an observation says of the model: its squares (G,) before, and what `weigh_model` returns."""

    squares: Float
    known: Float
    log_likelihood: Float


def mix_onset(
    model: Float, belief: Single, log_weight: Float, log_inflow: float, step: float, onset: Float
) -> Float:
    """Let R rivals begin in this step: those of before and the model's belief are mixed by their weights.

    belief (R, E, S), log_weight and onset, the expected first step, (R,) are brought up to date; returned is
    the share of those that began before (R,).
    """
    total = np.logaddexp(log_weight, log_inflow)
    keep = np.exp(log_weight - total)
    log_weight[:] = total
    onset[:] = keep * onset + (1.0 - keep) * step
    old = keep[:, None, None].astype(np.float32)
    belief[:] = old * belief + (1.0 - old) * model.astype(np.float32)
    return np.asarray(keep)


def weigh_model(shown: Shown, squares: Float, belief: Float, log_likelihood: Float) -> tuple[float, Float]:
    """Assimilate one observation under the model.

    squares (G,), the expected sums of squares of the residuals, belief (N,) and log_likelihood (N,), to which
    the sum over the gauges is added, are brought up to date.

    Returns
    -------
    tuple of float, (N, G)
        The log evidence, up to a constant of the step, and 1 + x² / (degrees + squares).
    """
    known = 1.0 + shown.residual**2 / (shown.degrees + squares)
    log_likelihood -= np.log(known) @ shown.power
    held = belief >= NEGLIGIBLE
    best = log_likelihood[held].max()
    belief *= np.where(held, np.exp(np.minimum(log_likelihood - best, 0.0)), 0.0)
    mass = belief.sum()
    belief /= mass
    squares += belief @ shown.residual**2
    return float(best + np.log(mass)), known


@compiled
def weigh_gauges(
    shown: Shown, model: OfModel, gains: Float, reach: Float, belief: Single, squares: Float, sums: Float
) -> Float:
    """Assimilate one observation under the rivals "gauge g shows 1 + gains[k] times what is there".

    The gain is learnt within gains[k] ± reach[k], its prior standard deviation, by the sums c² and cx of a
    regression, sums (G, K, 2). belief (G K, N), squares (G, K) and sums are brought up to date; returned is
    the log evidence (G, K).
    """
    squares_of_model, known, log_likelihood = model
    there, residual, size, power, degrees = shown
    result, weight = np.empty_like(squares), np.empty(len(log_likelihood))
    for rival in range(len(belief)):
        g, k = divmod(rival, len(gains))
        left, unknown = degrees + squares[g, k], 1.0 / (1.0 + sums[g, k, 0])
        fitted = min(max(unknown * sums[g, k, 1], -1.0), 1.0)
        constant = 0.5 * np.log((degrees + squares_of_model[g]) / left)
        own, best, mass, added, cc, cx = belief[rival], -np.inf, 0.0, 0.0, 0.0, 0.0
        for n in range(len(own)):
            if own[n] < NEGLIGIBLE_RIVAL:
                own[n] = 0.0
                continue
            weight[n] = log_likelihood[n]
            if there[g]:
                c = reach[k] * size[n, g]
                x, wide = residual[n, g] - gains[k] * size[n, g] - c * fitted, 1.0 + c * c * unknown
                weight[n] += constant + power[g] * np.log(known[n, g] / (1.0 + x * x / (left * wide)))
            best = max(best, weight[n])
        for n in range(len(own)):
            if own[n] > 0.0:
                c = reach[k] * size[n, g]
                x, wide = residual[n, g] - gains[k] * size[n, g], 1.0 + c * c * unknown
                weight[n] = own[n] * np.exp(weight[n] - best) / (np.sqrt(wide) if there[g] else 1.0)
                mass += weight[n]
                cc += weight[n] * c * c
                cx += weight[n] * c * x
                added += weight[n] * (x - c * fitted) ** 2 / wide
        result[g, k] = best + np.log(mass) if mass > 0.0 else -np.inf
        for n in range(len(own)):
            if own[n] > 0.0:
                own[n] = weight[n] / mass
        if mass > 0.0:
            squares[g, k] += added / mass
            sums[g, k, 0] += cc / mass
            sums[g, k, 1] += cx / mass
    return result


def weigh_none(shown: Shown, model: OfModel, gain: float, belief: Single, statistics: Float) -> float:
    """Assimilate one observation under the rival that some gauges have gains of their own; return its log.

    Which ones is not known: the predictive density of each gauge is a mixture of that without a gain and that
    with a free one. belief (N,) and statistics (G, 5) are brought up to date: probability that the gain is
    free, sum of squares without, sums c² and cx of the regression, and sum of squares of its innovations over
    their spread (West and Harrison 1997, section 4.6).
    """
    belief[belief < NEGLIGIBLE_RIVAL] = 0.0
    place = np.flatnonzero(belief > 0.0)
    if not place.size:
        return -np.inf
    free, plain, cc, cx, squares = statistics.T.copy()
    x, c, known = shown.residual[place], gain * shown.size[place], model.known[place]
    unknown = 1.0 / (1.0 + cc)
    innovation, wide = x - c * unknown * cx, 1.0 + c**2 * unknown

    def log_ratio(squared: Float, left: Float) -> Float:
        constant = 0.5 * np.log((shown.degrees + model.squares) / left) * shown.there
        return np.asarray(constant + shown.power * np.log(known / (1.0 + squared / left)))

    free = free.clip(0.0, 1.0)  # rounding takes it above one
    with_gain = np.log(free) + log_ratio(innovation**2 / wide, shown.degrees + squares) - 0.5 * np.log(wide)
    both = np.logaddexp(with_gain, np.log1p(-free) + log_ratio(x**2, shown.degrees + plain))
    log_value = model.log_likelihood[place] + both.sum(axis=1)
    best = log_value.max()
    weight = belief[place] * np.exp(log_value - best)
    mass = weight.sum()
    weight /= mass
    belief[place] = weight
    added = (x**2, c**2, c * x, innovation**2 / wide)
    free = np.where(shown.there, weight @ np.exp(with_gain - both), statistics[:, 0])
    statistics[:] = np.column_stack(
        [free, *(old + weight @ new for old, new in zip((plain, cc, cx, squares), added, strict=True))]
    )
    return float(best + np.log(mass))


MODEL, MENDED, NONE, GAUGES = 0, 1, 2, 3
"""Places in the log shares; from the last on the sensors and their gains. Those of faults hold what shows."""
ENDS = 0.02
"""Probability that a fault that shows ends in a step, and that what is mended is as if nothing had been."""
SHOWS_ELSEWHERE = 0.5
"""Prior probability that a fault shows under another control than that in force when it began."""
LEAST_SHOWS = 1e-3
"""It is never less probable that a fault shows under a control: one that grows is seen there in the end."""
_TOLD = 0.01


@dataclass
class Shares:
    """Log shares of the hypotheses before or after an observation.

    Attributes
    ----------
    current : (3 + G K,)
        Of the model, of "mended", and of the faults as far as they show under the control in force.
    hidden : (1 + G K,)
        Of the faults, none of these first, as far as they do not show under it.
    shows : (1 + G K, U)
        Probability that a fault shows under each control; that of the control in force stands in the shares.
    """

    current: Float
    hidden: Float
    shows: Float

    @classmethod
    def at_first(cls, begun: float, begins: Float, control_index: int, controls: int) -> "Shares":
        """Return the shares before the first observation.

        Parameters
        ----------
        begun : float
            Prior probability of a fault from the start.
        begins : (3 + G K,)
            Log probability of each fault where one begins.
        control_index, controls : int
            Control in force, and the number of controls.
        """
        current = np.log(begun) + begins
        current[MODEL] = np.log1p(-begun)
        faults = len(begins) - NONE
        shows = np.full((faults, controls), SHOWS_ELSEWHERE)
        shows[:, control_index] = 1.0
        return cls(current, np.full(faults, -np.inf), shows)

    def change_control(self, before: int, now: int) -> Float:
        """Divide each fault into what shows under the control that comes into force and what is hidden.

        Parameters
        ----------
        before, now : int
            Control of the step before, and of this step.

        Returns
        -------
        (1 + G K,)
            Probability of each fault that was shown before and is hidden now.
        """
        showing, hidden_before = self.current[NONE:], np.exp(self.hidden)
        fault = np.logaddexp(showing, self.hidden)
        self.shows[:, before] = np.clip(np.exp(showing - fault), LEAST_SHOWS, 1.0)
        self.current[NONE:] = fault + np.log(self.shows[:, now])
        self.hidden = fault + np.log1p(-self.shows[:, now])
        return np.asarray(np.maximum(np.exp(self.hidden) - hidden_before, 0.0))

    def advance(self, log_hazard: float, begins: Float) -> Float:
        """Let faults begin and end in a step.

        Parameters
        ----------
        log_hazard : float
            Log probability that a fault begins in the step.
        begins : (3 + G K,)
            Log probability of each fault where one begins.

        Returns
        -------
        (1 + G K,)
            Probability of each fault that it has ended in the step.
        """
        share = self.current
        ended = np.log(ENDS) + share
        # Beliefs of single gauges are stale behind a fault that has ended or is hidden: what is wrong then is
        # none of these.
        log_another = log_hazard + begins[NONE]
        right_now = np.logaddexp(share[MENDED], np.logaddexp.reduce(self.hidden))
        begun = share[MODEL] + log_hazard + begins[NONE:]
        begun[0] = np.logaddexp(begun[0], right_now + log_another)

        stays = np.full_like(share, np.log1p(-ENDS))
        stays[MODEL] = np.log1p(-np.exp(log_hazard))
        stays[MENDED] = np.log1p(-ENDS - np.exp(log_another))
        comes = np.append([ended[MENDED], np.logaddexp.reduce(ended[NONE:])], begun)
        self.current = np.logaddexp(share + stays, comes)
        self.hidden = self.hidden + np.log1p(-np.exp(log_another))

        # A fault that began in this step is not known under the other controls.
        fresh = np.exp(begun - np.logaddexp(self.current[NONE:], self.hidden))
        self.shows += fresh[:, None] * (SHOWS_ELSEWHERE - self.shows)
        return np.asarray(np.exp(ended[NONE:]))

    def weigh(self, log_ratio: Float) -> None:
        """Correct the shares by the log evidence of each hypothesis over that of the model (3 + G K,)."""
        self.current = self.current + log_ratio
        self.hidden = self.hidden + log_ratio[MENDED]
        total = np.logaddexp(np.logaddexp.reduce(self.current), np.logaddexp.reduce(self.hidden))
        self.current -= total
        self.hidden -= total

    @property
    def log_mended_or_hidden(self) -> float:
        """Log probability that there was a fault, and the sensors are right under the control in force."""
        return float(np.logaddexp(self.current[MENDED], np.logaddexp.reduce(self.hidden)))

    @property
    def none_of_these(self) -> float:
        """Probability that some gauges have gains of their own, whether it shows or not."""
        return float(np.exp(np.logaddexp(self.current[NONE], self.hidden[0])))

    @property
    def of_gauges(self) -> Float:
        """Probability of each single gauge and gain (G K,), whether it shows or not."""
        return np.asarray(np.exp(np.logaddexp(self.current[GAUGES:], self.hidden[1:])))


def beliefs_of(shares: Shares, filtered: Float, mended: Float, gauge: Single) -> tuple[Float, Float, float]:
    """Return the belief (S,) wherever a state is believed, that of all but the model, and the model's weight.

    Parameters
    ----------
    shares : Shares
    filtered : (S,)
        Belief under the model.
    mended : (E, S)
        The same of "mended", and of each gauge where its fault is hidden.
    gauge : (G, K, E, S)
        The same of each gauge where its fault shows.
    """
    believing = np.append(np.delete(shares.current, NONE), shares.hidden[1:])
    total = np.logaddexp.reduce(believing)
    weight = np.exp(shares.current - total)
    right = float(weight[MODEL])
    right_now = weight[MENDED] + np.exp(shares.hidden[1:] - total).sum()
    of_gauges = weight[GAUGES:].astype(np.float32) @ gauge.reshape(len(weight) - GAUGES, -1)
    rivals = of_gauges.reshape(mended.shape).sum(axis=0) + right_now * mended.sum(axis=0)
    sum_of_rivals = rivals.sum()
    rivals = filtered if sum_of_rivals == 0.0 else rivals / sum_of_rivals
    return right * filtered + (1.0 - right) * rivals, rivals, right


def hypotheses(
    shares: Shares, filtered: Float, mended: Float, gauge: Single, names: tuple[str, ...]
) -> tuple[Hypothesis, ...]:
    """Return the model, each gauge that may well be off, and none of these, with what each believes.

    Parameters are those of `beliefs_of`; `names` are those of "gauge g is off".
    """
    probability = np.exp(shares.current)
    showing, hidden = (
        of.reshape(gauge.shape[:2]) for of in (probability[GAUGES:], np.exp(shares.hidden[1:]))
    )
    either = (showing + hidden).sum(axis=1)
    right = probability[: MENDED + 1].sum()
    belief = filtered
    if probability[MENDED] > 0.0:
        belief = (probability[MODEL] * filtered + probability[MENDED] * mended.sum(axis=0)) / right
    result = [Hypothesis("model", float(right), belief)]
    for g in np.flatnonzero(either >= _TOLD).tolist():
        own = np.einsum("k,kes->s", showing[g], gauge[g]) + hidden[g].sum() * mended.sum(axis=0)
        result.append(Hypothesis(names[g], float(either[g]), own / own.sum()))
    return (*result, Hypothesis("none of these", shares.none_of_these, None))
