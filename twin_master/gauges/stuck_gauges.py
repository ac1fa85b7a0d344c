"""Stuck gauges: the hypothesis that a gauge repeats its last reading.

Under known noise a reading seldom repeats the one before. For a gauge with independent Gaussian
noise of standard deviation sigma, the difference of two readings has at zero the density
1 / (2 sqrt(pi) sigma). So it lies within -w and w with a probability of about w / (sqrt(pi) sigma);
a stuck gauge repeats its reading with certainty. The ratio of the two is the evidence of a repeat.

The resolution of a logger may be coarse, and the noise smaller than assumed. So the probability p
of a repeat is learnt for each gauge, with a beta prior. With R repeats among N pairs of successive
readings of the gauge,

    p = (R + n f) / (N + n),    f = w / (sqrt(pi) sigma) + r,

where n is the certainty of the noise as a number of observations, and r the fraction of repeats
among the pairs of all gauges. If no reading has ever moved, r is one: there is no noise to rely
on, and a repeat is no evidence.

A gauge may become stuck in any step. It is right again as soon as its reading moves. Faults of
several gauges are independent, so that a logger which repeats whole rows is found as well.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float
from twin_master.gauges.hypothesis_weights import log_of_sum
from twin_master.scenario.tables import Noticing

FROM_THE_START = 0.5
"""Prior probability that a fault, if there is one, begins in the first step, not a later one."""


class StuckGauges(NamedTuple):
    """The test statistics of the gauges of B twins, each field (B, G).

    Attributes
    ----------
    last_reading : (B, G) array
        The last reading that was received, SI; minus infinity where there was none.
    pair_count, repeat_count : (B, G) array
        The number of pairs of successive readings while the gauge was not stuck, and how many of
        these pairs are equal.
    log_evidence : (B, G) array
        The log evidence that the gauge is stuck over that it is not.
    still_since : (B, G) array
        The step of this model in which the reading was repeated first.
    is_stuck : (B, G) array
        One where the gauge is more probably stuck than not, else zero.
    """

    last_reading: Float
    pair_count: Float
    repeat_count: Float
    log_evidence: Float
    still_since: Float
    is_stuck: Float

    @classmethod
    def initial(cls, twins: int, sensors: int) -> "StuckGauges":
        """Return the state before the first reading."""
        shape = (twins, sensors)
        return cls(
            last_reading=np.full(shape, -np.inf),
            pair_count=np.zeros(shape),
            repeat_count=np.zeros(shape),
            log_evidence=np.full(shape, np.log(FROM_THE_START)),
            still_since=np.zeros(shape),
            is_stuck=np.zeros(shape),
        )


@dataclass(frozen=True)
class StandstillTest:
    """The test whether a gauge is stuck.

    Attributes
    ----------
    largest_move : (G,) array
        A reading that moves by at most this much stands still, SI.
    chance : float
        The probability that two readings of the assumed noise agree to within `largest_move`.
    noise_degrees : float
        The certainty of the noise, as a number of observations.
    least_evidence : float
        The log evidence from which a gauge is more probably stuck than not.
    """

    largest_move: Float
    chance: float
    noise_degrees: float
    least_evidence: float

    @classmethod
    def of(cls, noise: Float, settings: Noticing) -> "StandstillTest":
        """Return the test for gauges whose noise has standard deviations (G,), SI."""
        gauge_prior = settings.prior / len(noise)
        return cls(
            largest_move=settings.still_deviations * noise,
            chance=float(settings.still_deviations / np.sqrt(np.pi)),
            noise_degrees=settings.noise_degrees,
            least_evidence=float(-np.log(gauge_prior)),
        )

    def update(
        self, gauges: StuckGauges, readings: Float, step_count: Float, begins_now: Float
    ) -> StuckGauges:
        """Return the state after the readings of a step.

        A gauge that repeats its last reading gains evidence of being stuck: a sound gauge repeats
        it only with a probability, which is estimated from the readings so far. One reading that
        has moved rules the fault out.

        Parameters
        ----------
        gauges : StuckGauges
            The state before.
        readings : (B, G) array
            The readings as they were received, SI; NaN where there is none.
        step_count : (B,) array
            The number of earlier steps.
        begins_now : (B,) array
            The prior probability that a fault begins in this step.
        """
        is_received = ~np.isnan(readings)
        is_pair = is_received & np.isfinite(gauges.last_reading)
        move = np.abs(readings - gauges.last_reading)
        is_repeat = is_pair & (move <= self.largest_move)
        has_moved = is_pair & ~is_repeat

        log_repeat = np.log(self._repeat_probability(gauges, is_pair, is_repeat))
        log_evidence = log_of_sum(gauges.log_evidence, np.log(begins_now)[:, None])
        log_evidence = np.where(is_repeat, log_evidence - log_repeat, log_evidence)
        log_evidence[has_moved] = -np.inf
        is_stuck = log_evidence > self.least_evidence

        # Repeats of a stuck gauge say nothing of the resolution of its logger.
        is_counted = is_pair & ~is_stuck
        is_first_repeat = is_repeat & np.isinf(gauges.log_evidence)
        return StuckGauges(
            last_reading=np.where(is_received, readings, gauges.last_reading),
            pair_count=gauges.pair_count + is_counted,
            repeat_count=gauges.repeat_count + (is_counted & is_repeat),
            log_evidence=log_evidence,
            still_since=np.where(is_first_repeat, step_count[:, None], gauges.still_since),
            is_stuck=is_stuck.astype(np.float64),
        )

    def _repeat_probability(
        self, gauges: StuckGauges, is_pair: NDArray[np.bool_], is_repeat: NDArray[np.bool_]
    ) -> Float:
        """Return the probability (B, G) that a gauge which is not stuck repeats its reading."""
        # Repeats of all gauges, without that of the gauge itself in this step.
        moves_of_all = gauges.pair_count - gauges.repeat_count + (is_pair & ~is_repeat)
        pairs_of_all = (gauges.pair_count + is_pair).sum(axis=1, keepdims=True) - is_pair
        moving_fraction = moves_of_all.sum(axis=1, keepdims=True) / np.maximum(pairs_of_all, 1.0)
        prior_mean = np.clip(self.chance + 1.0 - moving_fraction, self.chance, 1.0)
        repeats = gauges.repeat_count + self.noise_degrees * prior_mean
        return np.asarray(repeats / (gauges.pair_count + self.noise_degrees))
