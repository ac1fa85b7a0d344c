"""The conjugate regression of each gauge: its offset, its gain error and its noise scale.

    o_g = h_g(D_t, k) (1 + gain_g) + offset_g + lambda_g sigma_g noise,
    lambda_g² ~ inverse gamma(nu / 2, nu / 2), with nu degrees of freedom,
    offset_g, gain_g | lambda_g ~ N(0, lambda_g² times their prior variance),

so that the predictive density is Student's (Gelman et al., Bayesian Data Analysis, 3rd ed., section
14.2). The sums of the regression are exact if the path of the state is known. It is not, so each
step adds expected products, under the filtered belief of that step given the hypothesis.

In all formulas of this module a gauge is measured in units of its assumed noise sigma_g:

    x = (observation - prediction) / sigma,
    a = prior standard deviation of the offset / sigma,
    c = prior standard deviation of the gain error times the prediction / sigma,

so that x = a u + c v + lambda noise, and the coefficients u and v have the prior N(0, lambda²).

The axes of arrays are K hypotheses, E draws of the calibrated parameter, S states and G gauges.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fe.compilation import compiled
from reporting.arrays import Float, Index

LARGEST_PRODUCT = 1e100
"""A larger product of factors is replaced by its logarithm, so that it cannot overflow."""
NEGLIGIBLE_LOG_WEIGHT = -70.0
"""A state whose log weight is this far below the largest adds less than a rounding error."""
SUM_COUNT = 6
"""Number of sums that a regression of two coefficients keeps."""


class GaugeReadings(NamedTuple):
    """One observation of G gauges, with the predictions of E draws in S states.

    Attributes
    ----------
    observation : (G,) array
        Sensor values, SI; NaN where a sensor is lost.
    draw : (K,) array
        The index of the draw of each hypothesis.
    prediction : (E, S, G) array
        Predicted values of each draw in each state, SI.
    inverse_deviation : (S, G) array
        One over the assumed standard deviation of the noise, 1/SI.
    """

    observation: Float
    draw: Index
    prediction: Float
    inverse_deviation: Float


class RegressionSums(NamedTuple):
    """Sums of products over all observations, each (K, G).

    For a gauge, x is the standardised residual, and a and c are the changes of its standardised
    value by one prior standard deviation of offset and gain. The field `cx` is the sum of c x.

    An array (K, G, 6) holds them in this order along its last axis.
    """

    aa: Float
    ac: Float
    cc: Float
    ax: Float
    cx: Float
    xx: Float

    @classmethod
    def view(cls, array: Float) -> "RegressionSums":
        """Return the sums in an array (K, G, 6) for K hypotheses and G gauges, without a copy."""
        return cls._make(np.moveaxis(array, -1, 0))


class GaugeFit(NamedTuple):
    """Posterior of the two coefficients of each gauge, each field (K, G).

    Offset and gain are the coefficients u and v of the module: they are in prior standard
    deviations, and their variances are those for a noise scale of one.

    Attributes
    ----------
    offset, gain : (K, G) array
        Posterior means.
    offset_variance, covariance, gain_variance : (K, G) array
        Posterior covariance of the two.
    sum_of_squares : (K, G) array
        The sum of the squared residuals of the fit over all observations, plus the squared
        coefficients, which the prior adds as in a ridge regression.
    """

    offset: Float
    gain: Float
    offset_variance: Float
    covariance: Float
    gain_variance: Float
    sum_of_squares: Float


@dataclass(frozen=True)
class GaugeRegression:
    """The priors of the regressions of G gauges.

    Attributes
    ----------
    offset_deviation : (G,) array
        Prior standard deviation of the offset, SI; a gauge with 0 learns no offset.
    gain_deviation : (G,) array
        Prior standard deviation of the gain error, dimensionless; a gauge with 0 learns no gain.
    degrees_of_freedom : float
        Degrees of freedom of the prior of the noise scale; with 0 the noise is as assumed.
    """

    offset_deviation: Float
    gain_deviation: Float
    degrees_of_freedom: float

    @property
    def learns(self) -> bool:
        """Whether anything about the gauges is learnt."""
        learns_coefficients = np.any(self.gain_deviation > 0.0) or np.any(
            self.offset_deviation > 0.0
        )
        return self.learns_noise or bool(learns_coefficients)

    @property
    def learns_noise(self) -> bool:
        """Whether the noise scales are learnt; if not, each of them is one."""
        return self.degrees_of_freedom > 0.0

    def fit(self, regression_sums: Float) -> GaugeFit:
        """Return the posterior of offset and gain, given the sums (K, G, 6) of a regression."""
        sums = RegressionSums.view(regression_sums)
        # Invert the precision matrix [[1 + aa, ac], [ac, 1 + cc]].
        offset_precision = 1.0 + sums.aa
        gain_precision = 1.0 + sums.cc
        determinant = offset_precision * gain_precision - sums.ac**2

        offset = (gain_precision * sums.ax - sums.ac * sums.cx) / determinant
        gain = (offset_precision * sums.cx - sums.ac * sums.ax) / determinant
        sum_of_squares = np.maximum(sums.xx - sums.ax * offset - sums.cx * gain, 0.0)
        fields = [
            offset,
            gain,
            gain_precision / determinant,
            -sums.ac / determinant,
            offset_precision / determinant,
            sum_of_squares,
        ]
        # The fields are views of one array, as the sums are. A mean over hypotheses of such a view
        # is summed by NumPy, not by a library of linear algebra whose last bits may differ.
        return GaugeFit._make(np.moveaxis(np.stack(fields, axis=-1), -1, 0))

    def squared_noise_scale(self, fit: GaugeFit, count: Float) -> Float:
        """Return the posterior mean of each squared noise scale lambda², (K, G).

        Parameters
        ----------
        count : (G,) array
            The number of observations of each gauge.
        """
        if not self.learns_noise:
            return np.ones_like(fit.sum_of_squares)
        # The mean of an inverse gamma distribution exists above two degrees of freedom; with fewer
        # the divisor is kept at one.
        degrees_above_two = np.maximum(self.degrees_of_freedom + count - 2.0, 1.0)
        return np.asarray((self.degrees_of_freedom + fit.sum_of_squares) / degrees_above_two)

    def log_density(self, readings: GaugeReadings, regression_sums: Float, count: Float) -> Float:
        """Return the log predictive density of an observation in each state.

        The density is the product of those of the gauges that are present. That of a gauge is
        Student's, or normal if the noise scale is not learnt.

        Parameters
        ----------
        readings : GaugeReadings
            The observation of G gauges, and its predictions in S states.
        regression_sums : (K, G, 6) array
            The sums of the regressions over earlier observations, given each of K hypotheses, in
            the order of the fields of `RegressionSums`.
        count : (G,) array
            The number of earlier observations of each gauge.

        Returns
        -------
        (K, S) array
            The log density of values in SI.
        """
        is_present = ~np.isnan(readings.observation)  # (G,)
        fit = self.fit(regression_sums)  # each field (K, G)
        hypothesis_count = len(readings.draw)
        state_count = readings.prediction.shape[1]
        log_density = np.empty((hypothesis_count, state_count))

        # Terms that do not depend on the state: the constant of each gauge's density.
        log_constant: Float
        if self.learns_noise:
            from scipy.special import gammaln  # slow to import; only a twin that learns needs it

            power = 0.5 * (self.degrees_of_freedom + count + 1.0)  # (G,)
            scale_squares = self.degrees_of_freedom + fit.sum_of_squares  # (K, G)
            log_constant = gammaln(power) - gammaln(power - 0.5)
            log_constant = log_constant - 0.5 * np.log(np.pi * scale_squares)  # (K, G)
            log_density[:] = np.sum(log_constant, axis=1, where=is_present)[:, None]
        else:
            log_constant = np.full(len(is_present), -0.5 * np.log(2.0 * np.pi))  # (G,)
            log_density[:] = np.sum(log_constant, where=is_present)

        # Terms that depend on the state: the conversion from units of noise to SI, and the kernels.
        log_density += np.log(readings.inverse_deviation[:, is_present]).sum(axis=1)
        contiguous_fit = GaugeFit._make(map(np.ascontiguousarray, fit))  # faster in the loop
        _add_log_densities(
            readings,
            self.offset_deviation,
            self.gain_deviation,
            contiguous_fit,
            self.degrees_of_freedom,
            count,
            log_density,
        )
        return log_density

    def expected_products(self, readings: GaugeReadings, log_weight: Float) -> Float:
        """Return the terms that an observation adds to the six sums of each gauge's regression.

        These are the products aa, ac, cc, ax, cx and xx: a and c are the changes of the gauge's
        reading by one prior standard deviation of offset and of gain, and x is its residual, all
        divided by the standard deviation of the noise. As the state is unknown, each product is
        averaged over the S states.

        Parameters
        ----------
        readings : GaugeReadings
            The observation of G gauges, and its predictions in each state.
        log_weight : (K, S) array
            The log probability of each state under each of K hypotheses. A constant may be added
            to each row.

        Returns
        -------
        (K, G, 6) array
            The expected products, in the order of the fields of `RegressionSums`.
        """
        hypothesis_count = len(readings.draw)
        gauge_count = len(readings.observation)
        products = np.zeros((SUM_COUNT, hypothesis_count, gauge_count))
        # The compiled function fills `products` in place, through a view of each of its six parts.
        _add_expected_products(
            readings,
            self.offset_deviation,
            self.gain_deviation,
            log_weight,
            RegressionSums._make(products),
        )
        return np.ascontiguousarray(np.moveaxis(products, 0, -1))


@compiled
def _add_log_densities(
    readings: GaugeReadings,
    offset_deviation: Float,
    gain_deviation: Float,
    fit: GaugeFit,
    degrees_of_freedom: float,
    count: Float,
    result: Float,
) -> None:
    """Add the part of the log predictive density that depends on the state to `result` (K, S).

    For a gauge, x is the standardised residual after the fitted offset and gain are subtracted, and
    a and c are the changes of its standardised value by one prior standard deviation of offset and
    gain.

    Logarithms take most of the time. So the factors of gauges whose densities have the same power
    are multiplied first, and one logarithm is taken of the product.
    """
    observation, draw, prediction, inverse_deviation = readings
    for k in range(result.shape[0]):
        for s in range(result.shape[1]):
            log_density = 0.0
            # Products over gauges of the same power: Student's kernels, and predictive variances.
            kernel_product = 1.0
            variance_product = 1.0
            product_power = 0.0
            for g in range(len(observation)):
                if np.isnan(observation[g]):
                    continue
                scale = inverse_deviation[s, g]
                predicted_value = prediction[draw[k], s, g]
                a = offset_deviation[g] * scale
                c = gain_deviation[g] * predicted_value * scale
                x = (
                    (observation[g] - predicted_value) * scale
                    - a * fit.offset[k, g]
                    - c * fit.gain[k, g]
                )
                variance = (
                    1.0
                    + a * (a * fit.offset_variance[k, g] + 2.0 * c * fit.covariance[k, g])
                    + c * c * fit.gain_variance[k, g]
                )
                power = 0.0  # of a normal density, which has no kernel to multiply
                if degrees_of_freedom > 0.0:
                    power = 0.5 * (degrees_of_freedom + count[g] + 1.0)
                too_large = kernel_product > LARGEST_PRODUCT or variance_product > LARGEST_PRODUCT
                if power != product_power or too_large:
                    log_density -= product_power * np.log(kernel_product) + 0.5 * np.log(
                        variance_product
                    )
                    kernel_product = 1.0
                    variance_product = 1.0
                    product_power = power
                variance_product *= variance
                if degrees_of_freedom > 0.0:
                    scale_squares = degrees_of_freedom + fit.sum_of_squares[k, g]
                    kernel_product *= 1.0 + x * x / (scale_squares * variance)
                else:
                    log_density -= 0.5 * x * x / variance
            log_kernels = product_power * np.log(kernel_product)
            result[k, s] += log_density - log_kernels - 0.5 * np.log(variance_product)


@compiled
def _add_expected_products(
    readings: GaugeReadings,
    offset_deviation: Float,
    gain_deviation: Float,
    log_weight: Float,
    sums: RegressionSums,
) -> None:
    """Add the expected products of a, c and x of each gauge to `sums` (K, G), in place.

    The expectation is over the state, given each of K hypotheses. For a gauge, x is the
    standardised residual, and a and c are the changes of its standardised value by one prior
    standard deviation of offset and gain.
    """
    observation, draw, prediction, inverse_deviation = readings
    weight = np.empty(log_weight.shape[1])
    for k in range(len(draw)):
        largest = np.max(log_weight[k])
        if largest == -np.inf:  # the hypothesis is ruled out
            continue
        # Probability of each state given the hypothesis.
        for s in range(len(weight)):
            weight[s] = np.exp(max(log_weight[k, s] - largest, NEGLIGIBLE_LOG_WEIGHT))
        weight /= weight.sum()
        # Sum of the products over states.
        for s in range(len(weight)):
            if log_weight[k, s] - largest <= NEGLIGIBLE_LOG_WEIGHT:
                continue
            for g in range(len(observation)):
                if np.isnan(observation[g]):
                    continue
                predicted_value = prediction[draw[k], s, g]
                scale = inverse_deviation[s, g]
                a = offset_deviation[g] * scale
                c = gain_deviation[g] * predicted_value * scale
                x = (observation[g] - predicted_value) * scale
                sums.aa[k, g] += weight[s] * a * a
                sums.ac[k, g] += weight[s] * a * c
                sums.cc[k, g] += weight[s] * c * c
                sums.ax[k, g] += weight[s] * a * x
                sums.cx[k, g] += weight[s] * c * x
                sums.xx[k, g] += weight[s] * x * x
