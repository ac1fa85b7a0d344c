r"""The density of the joint posterior.

Unknown are e, the servo mass s, the pitot mass p and the Rayleigh coefficients a = (alpha, beta). Known are
the load test, the weighed total T of 2 s + p, and frequencies y and damping ratios z of two modes. With the
model's frequencies f_i(e, s, p) and relative model errors delta_i ~ N(0, tau_i^2),

    T ~ N(2 s + p, s_T^2),   y_i ~ N(f_i (1 + delta_i), s_i^2),   z ~ N(A a, R),

    A = [[1 / (2 omega_1), omega_1 / 2], [1 / (2 omega_2), omega_2 / 2]],   omega_i = 2 pi f_i,

the last by Kapteyn et al. 2021, eq. (18), at the model's own frequencies, as in eq. (25): the coefficients
belong to the model and give *its* modes the measured damping. Two unknowns leave in closed form:

- delta_i: y_i ~ N(f_i, s_i^2 + tau_i^2 f_i^2);
- a, whose prior N(a_0, P) is cut off at zero: without the cut, z ~ N(A a_0, R + A P A') and
  a | z ~ N(a_0 + G (z - A a_0), P - G A P) with the gain G = P A' (R + A P A')^-1. Drawn from it and dropped
  where it is negative, a follows its distribution exactly.

What is left is a density in three quantities, e, s and t = 2 s + p; t takes the place of p (with the same
density), because the weighed total makes s and p nearly one quantity.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.result.record import ParameterPrior
from calibration.static.errors_in_variables import log_likelihood
from calibration.static.experiments import LoadDisplacementData

from .frequency_table import WingTables
from .measurement import ModalMeasurement
from .prior import ModelError, WeighedMass

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class DampingGiven:
    """The Gaussian of (alpha, beta) at given frequencies, before it is cut off at zero.

    `mean` (N, 2) and `covariance` (N, 2, 2) in [1/s], [s]; `log_likelihood` (N,) of the damping ratios.
    """

    mean: FloatArray
    covariance: FloatArray
    log_likelihood: FloatArray


@dataclass(frozen=True, eq=False)
class JointDensity:
    """The posterior density of (e, s, t) up to its normaliser, and of (alpha, beta) given them.

    Attributes
    ----------
    tables : WingTables
        Frequencies and stiffness of the model.
    static, modal, total_mass
        What was measured.
    priors, model_error
        What is assumed.
    """

    tables: WingTables
    static: LoadDisplacementData
    modal: ModalMeasurement
    total_mass: WeighedMass
    priors: tuple[ParameterPrior, ...]
    model_error: ModelError

    def inside(self, reduced: FloatArray) -> NDArray[np.bool_]:
        """Return which rows (e, s, t) of (N, 3) lie within the model's range."""
        limits = self.tables.frequency.limits
        quantities = masses_of(reduced)
        return np.asarray(((quantities >= limits[:, 0]) & (quantities <= limits[:, 1])).all(axis=1))

    def __call__(self, reduced: FloatArray) -> FloatArray:
        """Return the log density of rows (e, s, t) of (N, 3); minus infinity beyond the model's range."""
        inside = self.inside(reduced)
        value = np.full(reduced.shape[0], -np.inf)
        if inside.any():
            value[inside] = self.log_density(reduced[inside])[0]
        return value

    def log_density(self, reduced: FloatArray) -> tuple[FloatArray, DampingGiven]:
        """Return the log of prior times likelihood, and the damping given e and masses.

        The priors enter as whole Gaussians, not normalised for their limits.

        Parameters
        ----------
        reduced : (N, 3) array
            e, s, t, all within the model's range.

        Returns
        -------
        (N,) array, DampingGiven
        """
        quantities = masses_of(reduced)
        frequency = self.tables.frequency.frequency(quantities)
        damping = self.damping(frequency)
        total = log_likelihood(self.tables.stiffness, self.static, quantities[:, 0]) + damping.log_likelihood
        for place, prior in enumerate(self.priors[:3]):
            total += log_normal(quantities[:, place], prior.mean, prior.deviation)
        total += log_normal(reduced[:, 2], *self.total_mass)
        spread = np.hypot(
            self.modal.frequency_standard_deviation, np.array(self.model_error.frequency) * frequency
        )
        total += np.sum(log_normal(frequency, np.array(self.modal.frequency), spread), axis=1)
        return total, damping

    def damping(self, frequency: FloatArray) -> DampingGiven:
        """Return the Gaussian of alpha and beta given frequencies (N, 2) [Hz] and the damping ratios."""
        omega = 2.0 * math.pi * frequency
        design = np.stack([0.5 / omega, 0.5 * omega], axis=2)  # (N, mode, coefficient)
        centre = np.array([prior.mean for prior in self.priors[3:]])
        scale = np.array([prior.deviation for prior in self.priors[3:]])
        # Coefficients in units of their prior: alpha and beta differ by four decades.
        design = design * scale
        ratio = np.array(self.modal.damping_ratio)
        error = np.array(self.modal.damping_ratio_standard_deviation)
        across = np.swapaxes(design, 1, 2)
        variance = design @ across + np.diag(error**2)
        residual = ratio - design @ (centre / scale)
        gain = across @ np.linalg.inv(variance)
        mean = centre / scale + (gain @ residual[..., None])[..., 0]
        # Joseph's form, which stays symmetric and positive.
        left = np.eye(2) - gain @ design
        covariance = left @ np.swapaxes(left, 1, 2)
        covariance = covariance + gain @ np.diag(error**2) @ np.swapaxes(gain, 1, 2)
        solved = np.linalg.solve(variance, residual[..., None])[..., 0]
        misfit = np.sum(residual * solved, axis=1)
        determinant = np.linalg.slogdet(2.0 * math.pi * variance)[1]
        return DampingGiven(mean * scale, covariance * np.outer(scale, scale), -0.5 * (misfit + determinant))


def log_normal(value: FloatArray, mean: FloatArray | float, deviation: FloatArray | float) -> FloatArray:
    """Return the log density of a normal distribution, elementwise."""
    return np.asarray(
        -0.5 * ((value - mean) / deviation) ** 2 - np.log(deviation) - 0.5 * math.log(2.0 * math.pi)
    )


def masses_of(reduced: FloatArray) -> FloatArray:
    """Return (N, 3) rows e, s, p of rows e, s, t."""
    quantities = reduced.copy()
    quantities[:, 2] = reduced[:, 2] - 2.0 * reduced[:, 1]
    return quantities
