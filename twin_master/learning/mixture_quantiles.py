"""Quantiles of mixtures of normal distributions, by bisection."""

import numpy as np

from reporting.arrays import Float

HALVINGS = 18
"""Bisections: the interval of 13 standard deviations shrinks to 5e-5 of one."""
SEARCH_DEVIATIONS = 6.5
"""Standard deviations from the mean within which the 2.5 and 97.5 % quantiles lie.

By Cantelli's inequality a quantile of probability p lies within sqrt((1 - p) / p) = 6.2 of them.
"""


def mixture_quantiles(weight: Float, mean: Float, deviation: Float, levels: Float) -> Float:
    """Return quantiles (P, G) of G mixtures of N normal distributions.

    Parameters
    ----------
    weight : (N,) array
        The weights of the components, which sum to one; the same for all mixtures.
    mean, deviation : (N, G) array
        Mean and standard deviation of the components; a deviation of zero is a point.
    levels : (P,) array
        Levels of the quantiles, between 2.5 and 97.5 %.
    """
    from scipy.special import ndtr  # slow to import; only a twin that learns needs it

    center = weight @ mean
    total_deviation = np.sqrt(weight @ (deviation**2 + (mean - center) ** 2))
    lower_bound = np.tile(center - SEARCH_DEVIATIONS * total_deviation, (len(levels), 1))
    upper_bound = np.tile(center + SEARCH_DEVIATIONS * total_deviation, (len(levels), 1))
    for _ in range(HALVINGS):
        middle = 0.5 * (lower_bound + upper_bound)
        distance = middle[:, None] - mean  # (P, N, G)
        # A component with a deviation of zero is a point: it lies wholly below or above.
        standardized = np.copysign(np.inf, distance)
        np.divide(distance, deviation, out=standardized, where=deviation > 0.0)
        probability_below = np.einsum("n,png->pg", weight, ndtr(standardized))
        is_above_quantile = probability_below >= levels[:, None]
        lower_bound = np.where(is_above_quantile, lower_bound, middle)
        upper_bound = np.where(is_above_quantile, middle, upper_bound)
    return upper_bound
