"""What each step of the calibration found, in the terms of the paper's graphical model.

In the calibration phase a step's control is an experiment, its observation O is what was measured, the
digital state D is updated, the quantity of interest Q follows from it, and the reward R says what the
experiment was worth: Kapteyn et al. 2021, eqs. (1)-(4), Fig. 4.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.static.experiments import HALF_WIDTH_95
from calibration.static.posterior import ScalarPosterior

_SINGULAR = 1e10  # condition of a correlation matrix beyond which some figure has no freedom of its own


@dataclass(frozen=True)
class Update:
    """One figure before and after a step, and what was measured of it.

    Attributes
    ----------
    name, title, unit : str
        Name for programs and for people, and unit (SI; "1" without).
    prior_mean, prior_standard_deviation : float
        Before the step.
    posterior_mean, posterior_standard_deviation : float
        After it.
    measured, measured_standard_deviation : float or None
        What was measured of a quantity of interest, and how well.
    """

    name: str
    title: str
    unit: str
    prior_mean: float
    prior_standard_deviation: float
    posterior_mean: float
    posterior_standard_deviation: float
    measured: float | None = None
    measured_standard_deviation: float | None = None

    def misses(self, which: str = "posterior") -> float:
        """Return |measured - mean| in half-widths of the measurement's 95 % interval; NaN without one."""
        if self.measured is None or not self.measured_standard_deviation:
            return math.nan
        mean = self.prior_mean if which == "prior" else self.posterior_mean
        return abs(self.measured - mean) / (HALF_WIDTH_95 * self.measured_standard_deviation)


@dataclass(frozen=True)
class StepReward:
    """What the experiment of a step was worth: the evaluation factor p(R | D, Q, U, O), eq. (4).

    Attributes
    ----------
    prior_error, posterior_error : float or None
        Minus the mean of |measured - mean| over the quantities of interest, in half-widths of the
        measurements' 95 % intervals, before and after: the form of the paper's error reward [1].
    uncertainty_reduction : float
        1 - geometric mean of the ratios of posterior to prior standard deviation [1].
    information_gain : float or None
        Kullback-Leibler divergence of the posterior from the prior [nat]; None where some figure follows
        from the others without any freedom, as the paper's masses follow from e.
    """

    prior_error: float | None
    posterior_error: float | None
    uncertainty_reduction: float
    information_gain: float | None


@dataclass(frozen=True)
class CalibrationStep:
    """One step of the calibration.

    Attributes
    ----------
    number : int
        1 geometry, 2 load test, 3 ring-down.
    title, procedure, source : str
        What was done, how, and where the measurements come from.
    state : tuple of Update
        p(D) and p(D | O).
    quantities : tuple of Update
        p(Q) and p(Q | D, O) of the quantities of interest.
    reward : StepReward
        What the experiment was worth.
    """

    number: int
    title: str
    procedure: str
    source: str
    state: tuple[Update, ...]
    quantities: tuple[Update, ...]
    reward: StepReward


def update_of_samples(
    name: str,
    title: str,
    unit: str,
    prior: NDArray[np.float64],
    posterior: NDArray[np.float64],
    measured: tuple[float, float] | None = None,
) -> Update:
    """Return the update that samples before and after a step describe; (N,) arrays."""
    return Update(
        name, title, unit,
        float(np.mean(prior)), deviation(prior),
        float(np.mean(posterior)), deviation(posterior),
        *(measured or (None, None)),
    )  # fmt: skip


def update_of_densities(
    name: str,
    title: str,
    unit: str,
    prior: ScalarPosterior,
    posterior: ScalarPosterior,
    measured: tuple[float, float] | None = None,
) -> Update:
    """Return the update that two densities describe."""
    return Update(
        name, title, unit,
        prior.mean, prior.standard_deviation, posterior.mean, posterior.standard_deviation,
        *(measured or (None, None)),
    )  # fmt: skip


def deviation(values: NDArray[np.float64]) -> float:
    """Return the standard deviation of samples; 0 of a single one."""
    return float(np.std(values, ddof=1)) if values.size > 1 else 0.0


def error_reward(quantities: Sequence[Update], which: str) -> float | None:
    """Return minus the mean of |measured - mean| in half-widths of the measurements' 95 % intervals [1].

    The form of the paper's error reward, with each measurement's own half-width in place of the fixed one.
    """
    misses = [miss for quantity in quantities if math.isfinite(miss := quantity.misses(which))]
    return -float(np.mean(misses)) if misses else None


def gaussian_reward(
    quantities: Sequence[Update], prior: NDArray[np.float64], posterior: NDArray[np.float64]
) -> StepReward:
    """Return the reward of a step whose state is known by samples; (M, K) and (N, K) arrays.

    The share of uncertainty taken away is that of the geometric mean of the standard deviations; the
    information gain is the divergence of the Gaussian of equal moments from that of the prior.
    """
    return moment_reward(
        quantities,
        (prior.mean(axis=0), np.atleast_2d(np.cov(prior, rowvar=False))),
        (posterior.mean(axis=0), np.atleast_2d(np.cov(posterior, rowvar=False))),
    )


def moment_reward(
    quantities: Sequence[Update],
    prior: tuple[NDArray[np.float64], NDArray[np.float64]],
    posterior: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> StepReward:
    """Return the reward of a step of which means (K,) and covariances (K, K) are known, see above."""
    (mean_0, covariance_0), (mean_1, covariance_1) = prior, posterior
    scale = np.sqrt(np.diag(covariance_0))  # the figures differ by orders of magnitude
    shift = (mean_1 - mean_0) / scale
    before = covariance_0 / np.outer(scale, scale)
    after = covariance_1 / np.outer(scale, scale)
    _, log_before = np.linalg.slogdet(before)
    _, log_after = np.linalg.slogdet(after)
    free = np.linalg.cond(after / np.sqrt(np.outer(np.diag(after), np.diag(after)))) < _SINGULAR
    gain = 0.5 * float(
        np.trace(np.linalg.solve(before, after))
        + shift @ np.linalg.solve(before, shift)
        - shift.size
        + log_before
        - log_after
    )
    return StepReward(
        prior_error=error_reward(quantities, "prior"),
        posterior_error=error_reward(quantities, "posterior"),
        uncertainty_reduction=1.0 - float(np.exp(0.5 * np.mean(np.log(np.diag(after))))),
        information_gain=gain if free else None,
    )
