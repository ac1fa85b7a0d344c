"""What a learning filter believes of a turn, hypothesis by hypothesis, and what its sensors then show."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled

__all__ = ["Hypotheses", "Shown", "quantiles_of", "shown_by"]

Float = NDArray[np.float64]
Index = NDArray[np.int64]

_NEGLIGIBLE = 1e-9
"""Share of a belief below which a hypothesis tells nothing."""
ROOT_TWO = math.sqrt(2.0)
HALVINGS = 18
REACH = 6.5
"""Standard deviations from the mean within which a quantile between 2.5 and 97.5 % lies, by Cantelli."""


@dataclass(frozen=True)
class Hypotheses:
    """Belief over state and static hypotheses, and what each hypothesis says of the G sensors.

    Attributes
    ----------
    weight : (K, S)
        p(D, k | observations).
    draw : (K,)
        Draw of the parameter of each hypothesis.
    offset, gain : (K, G)
        Posterior mean of offset [SI] and gain error [1] given the hypothesis.
    covariance : (K, G, 3)
        Variance of the offset, covariance, and variance of the gain error, the noise scale averaged.
    scale2 : (K, G)
        Posterior mean of the squared noise scale.
    """

    weight: Float
    draw: Index
    offset: Float
    gain: Float
    covariance: Float
    scale2: Float

    def counting(self, weight: Float) -> "Hypotheses":
        """Return those whose weight (K, S) tells something, with it."""
        share = weight.sum(axis=1)
        kept = np.flatnonzero(share > _NEGLIGIBLE * share.sum())
        return Hypotheses(
            weight[kept], self.draw[kept], self.offset[kept], self.gain[kept], self.covariance[kept],
            self.scale2[kept],
        )  # fmt: skip


@dataclass(frozen=True)
class Shown:
    """What the G sensors show without noise, and the noise, for each hypothesis, state and control.

    Attributes
    ----------
    mean, variance : (K, S, U, G)
        Of what is shown, normally distributed.
    noise2 : (K, S, U, G)
        Variance of noise and model error.
    """

    mean: Float
    variance: Float
    noise2: Float


def shown_by(hypotheses: Hypotheses, value: Float, total_deviation: Float) -> Shown:
    """Return what the sensors show.

    Parameters
    ----------
    hypotheses : Hypotheses
    value : (E, S, U, G)
        Predictions for each draw, SI.
    total_deviation : (S, U, G)
        Standard deviation of assumed noise and model error, SI.
    """
    own = value[hypotheses.draw]
    gain, offset, spread, scale2 = (
        part[:, None, None]
        for part in (hypotheses.gain, hypotheses.offset, hypotheses.covariance, hypotheses.scale2)
    )
    return Shown(
        mean=own * (1.0 + gain) + offset,
        variance=spread[..., 0] + own * (2.0 * spread[..., 1] + own * spread[..., 2]),
        noise2=scale2 * total_deviation**2,
    )


@compiled
def quantiles_of(
    weight: Float, mean: Float, deviation: Float, center: Float, spread: Float, levels: Float, result: Float
) -> None:
    """Fill result (P, G) with quantiles of mixtures of N normal distributions.

    weight is (N,), mean and deviation (G, N); center and spread (G,) are those of the mixtures. Levels lie
    between 2.5 and 97.5 %.
    """
    for g in range(mean.shape[0]):
        for level in range(len(levels)):
            low, high = center[g] - REACH * spread[g], center[g] + REACH * spread[g]
            for _ in range(HALVINGS):
                middle = 0.5 * (low + high)
                reached = 0.0
                for n in range(len(weight)):
                    z = middle - mean[g, n]
                    if deviation[g, n] > 0.0:
                        reached += weight[n] * 0.5 * math.erfc(-z / (deviation[g, n] * ROOT_TWO))
                    elif z >= 0.0:
                        reached += weight[n]
                if reached >= levels[level]:
                    high = middle
                else:
                    low = middle
            result[level, g] = high
