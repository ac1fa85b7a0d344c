"""A Gaussian of parameters that is cut off at their range: its integral, moments and draws."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import lsq_linear
from scipy.special import log_ndtr, logsumexp, softmax
from scipy.stats import truncnorm
from scipy.stats.qmc import Sobol

from calibration.static.posterior import stratified
from discrepancy.campaign.records import FloatArray


@dataclass(frozen=True)
class CutGaussian:
    """A Gaussian of P scaled parameters, cut off at their range.

    Attributes
    ----------
    mean : (P,) ndarray
        Mean of the Gaussian without the range; it may lie beyond the range.
    covariance : (P, P) ndarray
        Its covariance.
    low, high : (P,) ndarray
        Ends of the range.
    log_integral : float
        Logarithm of its integral without the range, up to a constant [nat].
    """

    mean: FloatArray
    covariance: FloatArray
    low: FloatArray
    high: FloatArray
    log_integral: float

    @cached_property
    def factor(self) -> FloatArray:
        """Lower Cholesky factor (P, P) of the covariance."""
        return np.asarray(np.linalg.cholesky(self.covariance))

    @cached_property
    def tilt(self) -> FloatArray:
        """Shift (P,) of each standard normal variable towards where the density is largest.

        It is the exponential tilting of Botev 2017, J. R. Statist. Soc. B 79 (1).
        """
        inverse = np.linalg.inv(self.factor)
        bounds = (self.low, self.high)
        mode = lsq_linear(inverse, inverse @ self.mean, bounds, method="bvls").x
        normal = inverse @ (mode - self.mean)
        return np.asarray(normal - np.diag(self.factor) * (inverse.T @ normal))

    def weighted_draws(
        self, means: FloatArray, uniform: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return draws within the range, and the logarithms of their weights.

        Each parameter is drawn within its range given the parameters before it, and its weight is
        the probability of that range: the mean weight is the probability of the whole range (Genz
        1992, J. Comput. Graph. Stat. 1 (2)). Draws are shifted by `tilt`, which their weights
        correct.

        Parameters
        ----------
        means : (..., P) ndarray
            Means in place of `mean`.
        uniform : (..., P) ndarray
            Numbers between 0 and 1.

        Returns
        -------
        draws : (..., P) ndarray
        log_weights : (...) ndarray
        """
        normal = np.zeros_like(uniform)
        log_weight = np.zeros(uniform.shape[:-1])
        for index, shift in enumerate(self.tilt.tolist()):
            row = self.factor[index]
            conditional_mean = means[..., index] + normal @ row
            low = (self.low[index] - conditional_mean) / row[index] - shift
            high = (self.high[index] - conditional_mean) / row[index] - shift
            normal[..., index] = shift + truncnorm.ppf(uniform[..., index], low, high)
            # probability between the ends, in the lower tail, where no digits are lost
            is_upper = low > 0.0
            lower_end = np.where(is_upper, -high, low)
            upper_end = np.where(is_upper, -low, high)
            log_ratio = log_ndtr(lower_end) - log_ndtr(upper_end)
            log_weight += log_ndtr(upper_end) + np.log1p(-np.exp(log_ratio))
            log_weight += shift * (0.5 * shift - normal[..., index])
        draws = np.clip(means + normal @ self.factor.T, self.low, self.high)
        return draws, log_weight

    def energy(self, u: FloatArray) -> float:
        """Return -ln of the density at scaled parameters (P,), up to a constant [nat]."""
        shift = u - self.mean
        return 0.5 * float(shift @ np.linalg.solve(self.covariance, shift))

    @cached_property
    def _even_draws(self) -> tuple[FloatArray, FloatArray]:
        """Evenly spread draws (N, P) by a Sobol sequence, and their log weights (N,)."""
        count = len(self.mean)
        uniform = Sobol(max(count, 1), rng=0).random(EVEN)[:, :count]
        return self.weighted_draws(self.mean, uniform)

    @cached_property
    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (P,) and covariance (P, P) within the range."""
        points, log_weight = self._even_draws
        weight = softmax(log_weight)
        return weight @ points, np.atleast_2d(np.cov(points.T, aweights=weight))

    @property
    def log_evidence(self) -> float:
        """Logarithm of its integral within the range, up to a constant [nat]."""
        _, log_weight = self._even_draws
        return float(self.log_integral + logsumexp(log_weight) - np.log(EVEN))

    def draws(self, count: int, generator: np.random.Generator) -> FloatArray:
        """Return draws (count, P) of equal weight, resampled from weighted ones."""
        uniform = generator.random((TRIED * count, len(self.mean)))
        points, log_weight = self.weighted_draws(self.mean, uniform)
        cumulative = np.cumsum(softmax(log_weight))
        chosen = np.searchsorted(cumulative, stratified(generator, count))
        return np.asarray(points[np.minimum(chosen, len(points) - 1)])

    def draws_about(self, means: FloatArray, generator: np.random.Generator) -> FloatArray:
        """Return a draw about each of several means (N, P), which replace the Gaussian's own.

        One of several weighted draws is chosen by the Gumbel-max trick.
        """
        shape = (TRIED, *means.shape)
        points, log_weight = self.weighted_draws(
            np.broadcast_to(means, shape), generator.random(shape)
        )
        chosen = np.argmax(log_weight + generator.gumbel(size=log_weight.shape), axis=0)
        return np.asarray(points[chosen, np.arange(len(means))])


EVEN = 1024
"""Draws of a Gaussian from which its probability within the range is computed."""
TRIED = 32
"""Weighted draws of a Gaussian of which one is taken."""
