"""What each gauge has of its own: offset, gain and noise scale by a conjugate regression.

    o_g = h_g(D_t, k) (1 + gain_g) + offset_g + lambda_g sigma_g noise,
    lambda_g² ~ inverse gamma(degrees / 2, degrees / 2),
    offset_g, gain_g | lambda_g ~ N(0, lambda_g² times their prior variance),

so that the predictive density is Student's (Gelman et al., Bayesian Data Analysis, 3rd ed., section 14.2).
Its sums are exact given the path of the state; over the paths they are expected sums, under the filtered
belief of each step given the hypothesis.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from fe.compilation import compiled
from reporting.arrays import Float, Index

LARGE = 1e100
"""A product is taken to the logarithm above this."""
NEGLIGIBLE = -70.0
"""States this many nats below the best of a hypothesis add nothing that doubles can hold."""


class Compared(NamedTuple):
    """One observation beside what each draw predicts in each state, and what may be learnt of the gauges.

    Attributes
    ----------
    seen : (G,)
        SI; NaN where a sensor is lost.
    draw : (K,)
        Of each hypothesis.
    value : (E, S, G)
        Predictions of each draw, SI.
    inverse : (S, G)
        Of the assumed standard deviation.
    offset, gain : (G,)
        Those of `GaugeRegression`.
    """

    seen: Float
    draw: Index
    value: Float
    inverse: Float
    offset: Float
    gain: Float


@dataclass(frozen=True)
class GaugeRegression:
    """The priors of the regressions of G gauges.

    Their sums over what was observed are `statistics` (K, G, 6) for each of K hypotheses: of a², ac, c², ax,
    cx and x² in units of the assumed noise, where x is what a gauge shows beyond its prediction, and a and c
    what it is changed by when offset and gain are one prior standard deviation.

    Attributes
    ----------
    offset, gain : (G,)
        Prior standard deviations, SI and dimensionless; 0 is not learnt.
    degrees : float
        Degrees of freedom of the noise scale; 0 takes the assumed noise for known.
    """

    offset: Float
    gain: Float
    degrees: float

    @property
    def learns(self) -> bool:
        """Whether anything is learnt of the gauges."""
        return self.degrees > 0.0 or bool(np.any(self.gain > 0.0) or np.any(self.offset > 0.0))

    def fitted(self, statistics: Float) -> Float:
        """Return coefficients (2), their covariance (3) and the squares that they leave: (K, G, 6)."""
        aa, ac, cc, ax, cx, xx = np.moveaxis(statistics, -1, 0)
        first, second = 1.0 + aa, 1.0 + cc
        determinant = first * second - ac**2
        offset, gain = (second * ax - ac * cx) / determinant, (first * cx - ac * ax) / determinant
        left = np.maximum(xx - ax * offset - cx * gain, 0.0)
        return np.stack(
            [offset, gain, second / determinant, -ac / determinant, first / determinant, left], axis=-1
        )

    def scale2(self, fitted: Float, count: Float) -> Float:
        """Return the posterior mean of the squared noise scale of each hypothesis and sensor: (K, G)."""
        if not self.degrees > 0.0:
            return np.ones_like(fitted[..., 5])
        return np.asarray((self.degrees + fitted[..., 5]) / np.maximum(self.degrees + count - 2.0, 1.0))

    def log_density(
        self, seen: Float, draw: Index, value: Float, inverse: Float, statistics: Float, count: Float
    ) -> Float:
        """Return log p(o | state, hypothesis, what was observed before): (K, S).

        Parameters
        ----------
        seen, draw, value, inverse
            As `Compared` has them.
        statistics : (K, G, 6)
        count : (G,)
            Of the observations before.
        """
        there, fitted = ~np.isnan(seen), self.fitted(statistics)
        density: Float = np.full(len(seen), -0.5 * np.log(2.0 * np.pi))
        if self.degrees > 0.0:
            power = 0.5 * (self.degrees + count + 1.0)
            density = gammaln(power) - gammaln(power - 0.5)
            density = density - 0.5 * np.log(np.pi * (self.degrees + fitted[..., 5]))
        result = np.empty((len(draw), value.shape[1]))
        result[:] = np.sum(density, axis=-1, where=there)[..., None]
        result += np.log(inverse[:, there]).sum(axis=1)
        shown = Compared(seen, draw, value, inverse, self.offset, self.gain)
        _add_densities(shown, fitted, self.degrees, count, result)
        return result

    def told(self, seen: Float, draw: Index, value: Float, inverse: Float, log_weight: Float) -> Float:
        """Return what an observation adds to the statistics (K, G, 6), expected over the state.

        Parameters are those of `log_density`; log_weight is (K, S), of a state given the hypothesis but for a
        constant of it.
        """
        result = np.zeros((len(draw), len(seen), 6))
        _expect(Compared(seen, draw, value, inverse, self.offset, self.gain), log_weight, result)
        return result


@compiled
def _add_densities(shown: Compared, fitted: Float, degrees: float, count: Float, result: Float) -> None:
    """Add to result (K, S) what the densities of all gauges have of the state.

    Factors are multiplied, those of Student's densities of the same degrees, before a logarithm is taken,
    which is what costs.
    """
    seen, draw, value, inverse, offset, gain = shown
    for k in range(result.shape[0]):
        for s in range(result.shape[1]):
            total, product, half, wide = 0.0, 1.0, 0.0, 1.0
            for g in range(len(seen)):
                if np.isnan(seen[g]):
                    continue
                scale, predicted = inverse[s, g], value[draw[k], s, g]
                a, c = offset[g] * scale, gain[g] * predicted * scale
                x = (seen[g] - predicted) * scale - a * fitted[k, g, 0] - c * fitted[k, g, 1]
                spread = 1.0 + a * (a * fitted[k, g, 2] + 2.0 * c * fitted[k, g, 3]) + c * c * fitted[k, g, 4]
                power = 0.5 * (degrees + count[g] + 1.0) if degrees > 0.0 else 0.0
                if power != half or product > LARGE or wide > LARGE:
                    total -= half * np.log(product) + 0.5 * np.log(wide)
                    product, half, wide = 1.0, power, 1.0
                wide *= spread
                if degrees > 0.0:
                    product *= 1.0 + x * x / ((degrees + fitted[k, g, 5]) * spread)
                else:
                    total -= 0.5 * x * x / spread
            result[k, s] += total - half * np.log(product) - 0.5 * np.log(wide)


@compiled
def _expect(shown: Compared, log_weight: Float, result: Float) -> None:
    """Add to result (K, G, 6) the products of a, c and x of each gauge, expected over the state."""
    seen, draw, value, inverse, offset, gain = shown
    weight = np.empty(log_weight.shape[1])
    for k in range(len(draw)):
        best = np.max(log_weight[k])
        if best == -np.inf:
            continue
        for s in range(len(weight)):
            weight[s] = np.exp(max(log_weight[k, s] - best, NEGLIGIBLE))
        weight /= weight.sum()
        for s in range(len(weight)):
            if log_weight[k, s] - best <= NEGLIGIBLE:
                continue
            for g in range(len(seen)):
                if not np.isnan(seen[g]):
                    predicted, scale = value[draw[k], s, g], inverse[s, g]
                    a, c, x = offset[g] * scale, gain[g] * predicted * scale, (seen[g] - predicted) * scale
                    result[k, g, 0] += weight[s] * a * a
                    result[k, g, 1] += weight[s] * a * c
                    result[k, g, 2] += weight[s] * c * c
                    result[k, g, 3] += weight[s] * a * x
                    result[k, g, 4] += weight[s] * c * x
                    result[k, g, 5] += weight[s] * x * x
