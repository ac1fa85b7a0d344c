"""A Gaussian density of parameters truncated at their range: its integral, moments and draws."""

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
class TruncatedGaussian:
    """A Gaussian density of P scaled parameters, truncated at their range.

    Attributes
    ----------
    mean : (P,) ndarray
        The mean of the Gaussian before truncation; it may lie outside the range.
    covariance : (P, P) ndarray
        The covariance of the Gaussian before truncation.
    low, high : (P,) ndarray
        The lower and upper ends of the range of each parameter.
    log_integral : float
        The logarithm of the integral of the density before truncation, up to a constant [nat].
    """

    mean: FloatArray
    covariance: FloatArray
    low: FloatArray
    high: FloatArray
    log_integral: float

    @cached_property
    def factor(self) -> FloatArray:
        """Lower Cholesky factor L (P, P) of the covariance: L @ L.T is the covariance."""
        return np.asarray(np.linalg.cholesky(self.covariance))

    @cached_property
    def tilt(self) -> FloatArray:
        """The shift (P,) that moves standard normal draws towards the mode within the range.

        If the mean is outside the range, draws without a shift are rarely near the mode
        (exponential tilting, Botev 2017, J. R. Statist. Soc. B 79 (1)).
        """
        inverse_factor = np.linalg.inv(self.factor)
        bounds = (self.low, self.high)
        # the mode minimises (u - mean)^T C^-1 (u - mean) = |L^-1 (u - mean)|^2 within the range
        mode = lsq_linear(inverse_factor, inverse_factor @ self.mean, bounds, method="bvls").x
        normal_at_mode = inverse_factor @ (mode - self.mean)
        # At the mode the normal variables are L^T l, with the Lagrange multipliers l of the ends of
        # the range. The part L_ii l_i of variable i comes from its own end, and draws within its
        # own range have it without a shift. The remaining part comes from the ends of parameters
        # that are drawn later: that is the shift.
        multipliers = inverse_factor.T @ normal_at_mode
        part_of_own_end = np.diag(self.factor) * multipliers
        return np.asarray(normal_at_mode - part_of_own_end)

    def weighted_draws(
        self, means: FloatArray, uniform: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return draws within the range, and the logarithms of their weights.

        The parameters are drawn one after another: each within its range, given those before it.
        The weight of a draw is the product of the probabilities of these ranges, so the mean weight
        is the probability of the whole range (Genz 1992, J. Comput. Graph. Stat. 1 (2)). Draws are
        shifted by `tilt`, and the weights contain the ratio of the densities without and with the
        shift.

        Parameters
        ----------
        means : (..., P) ndarray
            The means of the Gaussian for each draw, used instead of `mean`.
        uniform : (..., P) ndarray
            The uniform random numbers between 0 and 1, one for each parameter of each draw.

        Returns
        -------
        draws : (..., P) ndarray
            Draws of the scaled parameters.
        log_weights : (...) ndarray
            The logarithm of the weight of each draw.
        """
        normal = np.zeros_like(uniform)
        log_weight = np.zeros(uniform.shape[:-1])
        for index, shift in enumerate(self.tilt.tolist()):
            # the range of the parameter in standard deviations about its shifted conditional mean
            factor_row = self.factor[index]
            # `normal` is still zero for this parameter and those after it, so the product has only
            # the parameters that are drawn already: it is the mean given these
            conditional_mean = means[..., index] + normal @ factor_row
            conditional_deviation = factor_row[index]
            low = (self.low[index] - conditional_mean) / conditional_deviation - shift
            high = (self.high[index] - conditional_mean) / conditional_deviation - shift
            normal[..., index] = shift + truncnorm.ppf(uniform[..., index], low, high)
            # ln of the probability between the ends; an interval in the upper tail is mirrored, as
            # the difference of two numbers close to one would lose digits
            is_in_upper_tail = low > 0.0
            lower_end = np.where(is_in_upper_tail, -high, low)
            upper_end = np.where(is_in_upper_tail, -low, high)
            log_ratio = log_ndtr(lower_end) - log_ndtr(upper_end)
            log_weight += log_ndtr(upper_end) + np.log1p(-np.exp(log_ratio))
            # ln of N(x; 0, 1) / N(x; shift, 1)
            log_weight += shift * (0.5 * shift - normal[..., index])
        draws = np.clip(means + normal @ self.factor.T, self.low, self.high)
        return draws, log_weight

    def energy(self, u: FloatArray) -> float:
        """Return -ln of the density at scaled parameters u (P,), up to a constant [nat]."""
        shift = u - self.mean
        return 0.5 * float(shift @ np.linalg.solve(self.covariance, shift))

    @cached_property
    def _quasi_random_draws(self) -> tuple[FloatArray, FloatArray]:
        """Quasi-random draws (N, P) by a Sobol sequence, and their log weights (N,)."""
        parameter_count = len(self.mean)
        uniform = Sobol(max(parameter_count, 1), rng=0).random(MOMENT_DRAWS)[:, :parameter_count]
        return self.weighted_draws(self.mean, uniform)

    @cached_property
    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (P,) and covariance (P, P) of the truncated Gaussian."""
        points, log_weight = self._quasi_random_draws
        weight = softmax(log_weight)
        return weight @ points, np.atleast_2d(np.cov(points.T, aweights=weight))

    @property
    def log_evidence(self) -> float:
        """Logarithm of the integral of the density within the range, up to a constant [nat]."""
        _, log_weight = self._quasi_random_draws
        return float(self.log_integral + logsumexp(log_weight) - np.log(MOMENT_DRAWS))

    def draws(self, count: int, generator: np.random.Generator) -> FloatArray:
        """Return equally weighted draws (count, P), resampled from weighted candidates."""
        uniform = generator.random((CANDIDATES_PER_DRAW * count, len(self.mean)))
        candidates, log_weight = self.weighted_draws(self.mean, uniform)
        cumulative_weights = np.cumsum(softmax(log_weight))
        levels = stratified(generator, count)
        chosen_indices = np.searchsorted(cumulative_weights, levels)
        # rounding may leave the last cumulative weight below the last level
        chosen_indices = np.minimum(chosen_indices, len(candidates) - 1)
        return np.asarray(candidates[chosen_indices])

    def draws_with_means(self, means: FloatArray, generator: np.random.Generator) -> FloatArray:
        """Return one draw (N, P) for each of several means, with the covariance of this Gaussian.

        For each mean, one of `CANDIDATES_PER_DRAW` weighted draws is chosen with a probability
        proportional to its weight: the one of largest log weight plus Gumbel noise (the Gumbel-max
        trick).

        Parameters
        ----------
        means : (N, P) ndarray
            The means that are used instead of `mean`.
        """
        shape = (CANDIDATES_PER_DRAW, *means.shape)
        candidates, log_weight = self.weighted_draws(
            np.broadcast_to(means, shape), generator.random(shape)
        )
        chosen_indices = np.argmax(log_weight + generator.gumbel(size=log_weight.shape), axis=0)
        return np.asarray(candidates[chosen_indices, np.arange(len(means))])


MOMENT_DRAWS = 1024
"""Number of draws from which the probability of the range and the moments are computed."""
CANDIDATES_PER_DRAW = 32
"""Number of weighted draws for each draw that is returned."""
