"""What each gauge has of its own: offset, gain and noise scale by a conjugate regression.

    o_g = h_g(D_t, k) (1 + gain_g) + offset_g + lambda_g sigma_g noise,
    lambda_g² ~ inverse gamma(degrees / 2, degrees / 2),
    offset_g, gain_g | lambda_g ~ N(0, lambda_g² times their prior variance),

so that the predictive density is Student's (Gelman et al., Bayesian Data Analysis, 3rd ed., section 14.2).
Its sums are exact given the path of the state; over the paths they are expected sums, under the filtered
belief of each turn given the hypothesis.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

__all__ = ["GaugeRegression"]

Float = NDArray[np.float64]


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
        self, seen: Float, value: Float, inverse: Float, statistics: Float, count: Float
    ) -> Float:
        """Return log p(o | state, hypothesis, what was observed before): (K, S).

        Parameters
        ----------
        seen : (G,)
            SI; NaN where a sensor is lost.
        value : (K, S, G)
            Predictions, SI.
        inverse : (S, G)
            Of the assumed standard deviation.
        statistics : (K, G, 6)
        count : (G,)
            Of the observations before.
        """
        there = ~np.isnan(seen)
        inverse = inverse[:, there]
        residual = (seen[there] - value[..., there]) * inverse
        fitted = np.moveaxis(self.fitted(statistics)[:, None, there], -1, 0)
        spread = np.ones(1)
        if np.any(self.gain > 0.0) or np.any(self.offset > 0.0):
            a, c = self.offset[there] * inverse, self.gain[there] * value[..., there] * inverse
            residual -= a * fitted[0] + c * fitted[1]
            spread = 1.0 + a * (a * fitted[2] + 2.0 * c * fitted[3]) + c**2 * fitted[4]
        if self.degrees > 0.0:
            power, left = 0.5 * (self.degrees + count[there] + 1.0), self.degrees + fitted[5]
            density = gammaln(power) - gammaln(power - 0.5) - 0.5 * np.log(np.pi * left)
            density = density - power * np.log(1.0 + residual**2 / (left * spread))
        else:
            density = -0.5 * np.log(2.0 * np.pi) - 0.5 * residual**2 / spread
        return np.asarray((density + np.log(inverse) - 0.5 * np.log(spread)).sum(axis=-1))

    def told(self, seen: Float, value: Float, inverse: Float, weight: Float) -> Float:
        """Return what an observation adds to the statistics (K, G, 6), expected over the state.

        Parameters are those of `log_density`; weight is (K, S), p(state | hypothesis).
        """
        there = ~np.isnan(seen)
        x = np.where(there, seen - value, 0.0) * inverse
        a, c, share = self.offset * inverse, self.gain * value * inverse, weight[:, :, None]
        pairs = ((a, a), (a, c), (c, c), (a, x), (c, x), (x, x))
        sums = [(share * (one * other)).sum(axis=1) for one, other in pairs]
        return np.where(there[:, None], np.stack(sums, axis=-1), 0.0)
