"""What a learning filter believes of a turn, hypothesis by hypothesis, and what its sensors then show."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from reporting.arrays import Float, Index

_NEGLIGIBLE = 1e-9
"""Share of a belief below which a hypothesis tells nothing."""
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


def shown_by(hypotheses: Hypotheses, value: Float, total_deviation: Float) -> tuple[Float, Float, Float]:
    """Return mean and variance of what the sensors show, normally distributed, and the variance of noise.

    Each is (K, S, U, G): of each hypothesis, state and control; the noise has the model error in it.

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
    mean = own * (1.0 + gain) + offset
    variance = spread[..., 0] + own * (2.0 * spread[..., 1] + own * spread[..., 2])
    return mean, variance, np.broadcast_to(scale2 * total_deviation**2, mean.shape)


def quantiles_of(weight: Float, mean: Float, deviation: Float, levels: Float) -> Float:
    """Return quantiles (P, G) of mixtures of N normal distributions.

    weight is (N,), mean and deviation (N, G). Levels lie between 2.5 and 97.5 %.
    """
    center = weight @ mean
    spread = np.sqrt(weight @ (deviation**2 + (mean - center) ** 2))
    low, high = (np.tile(center + side * REACH * spread, (len(levels), 1)) for side in (-1.0, 1.0))
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        distance = middle[:, None] - mean
        below = ndtr(np.divide(distance, deviation, out=np.copysign(np.inf, distance), where=deviation > 0.0))
        over = np.einsum("n,png->pg", weight, below) >= levels[:, None]
        low, high = np.where(over, low, middle), np.where(over, middle, high)
    return high
