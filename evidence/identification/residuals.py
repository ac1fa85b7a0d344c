"""Residuals of the fitted outputs, divided by their weights, with derivatives."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .responses import ReducedWing, Value
from .targets import (
    HEALTHY,
    LEVELS,
    LIBRARY_FACTOR,
    LIMITING_GAUGE,
    Targets,
    Weights,
    fitted_states,
)

FloatArray = NDArray[np.float64]


class Residuals(NamedTuple):
    """Residuals of outputs, in standard deviations.

    Attributes
    ----------
    value : (M,) array
        Model minus target, over the standard deviation.
    gradient : (M, P) array
        Derivatives of the residuals, per unit of each parameter.
    """

    value: FloatArray
    gradient: FloatArray


def fitted_residuals(wing: ReducedWing, targets: Targets, weights: Weights) -> Residuals:
    """Return the residuals of all fitted outputs.

    Parameters
    ----------
    wing : ReducedWing
        The model.
    targets : Targets
        Published outputs.
    weights : Weights
        Standard deviations of the residuals.
    """
    groups = (
        *_strains(wing, targets, weights),
        *_stiffness(wing, targets, weights),
        *_frequencies(wing, targets, weights),
    )
    return Residuals(
        np.concatenate([group.value for group in groups]),
        np.concatenate([group.gradient for group in groups]),
    )


def _weighted(output: Value, target: FloatArray, deviation: FloatArray | float) -> Residuals:
    """Return the residuals of an output (M,) with a target (M,) and standard deviations (M,)."""
    deviations = np.broadcast_to(deviation, target.shape)
    return Residuals(
        (output.value - target) / deviations, output.gradient / deviations[..., np.newaxis]
    )


def _strains(wing: ReducedWing, targets: Targets, weights: Weights) -> Iterator[Residuals]:
    """Yield the residuals of healthy strains, strain ratios of fitted states and slopes."""
    gauge_count = targets.strain.shape[2]
    is_limiting = np.arange(gauge_count) == LIMITING_GAUGE
    healthy = wing.strain(LIBRARY_FACTOR, (LEVELS[0], LEVELS[0]))
    yield _weighted(
        healthy.log(),
        np.log(targets.strain[HEALTHY]),
        np.where(is_limiting, weights.limiting_strain, weights.strain),
    )
    for first, second in np.argwhere(fitted_states()):
        loss = (LEVELS[first], LEVELS[second])
        first_is_damaged = LEVELS[first] > 0.0
        yield _weighted(
            wing.strain(LIBRARY_FACTOR, loss).over(healthy),
            targets.ratio[first, second],
            np.where(is_limiting & first_is_damaged, weights.limiting_ratio, weights.ratio),
        )
    yield _weighted(wing.strain_slope(LIBRARY_FACTOR), targets.strain_slope, weights.slope)


def _stiffness(wing: ReducedWing, targets: Targets, weights: Weights) -> Iterator[Residuals]:
    """Yield the residuals of tip stiffness, relative, and of its slope."""
    stiffness_and_slope = wing.tip_stiffness()
    scale = np.array([targets.tip_stiffness, 1.0])
    relative = Value(
        stiffness_and_slope.value / scale, stiffness_and_slope.gradient / scale[:, np.newaxis]
    )
    yield _weighted(
        relative,
        np.array([1.0, targets.tip_stiffness_slope]),
        np.array([weights.stiffness, weights.stiffness_slope]),
    )


def _frequencies(wing: ReducedWing, targets: Targets, weights: Weights) -> Iterator[Residuals]:
    """Yield the residuals of the frequencies in the fitted rows, and of their slopes."""
    rows = np.flatnonzero(targets.fitted_row)
    log_frequency = wing.log_frequency(
        targets.young_modulus_factor[rows], targets.servo_mass[rows], targets.pitot_mass[rows]
    )
    log_targets = np.log(targets.frequency[rows]).ravel()
    flat = Value(log_frequency.value.ravel(), log_frequency.gradient.reshape(len(log_targets), -1))
    yield _weighted(flat, log_targets, weights.frequency)
    regression = wing.frequency_slopes()
    yield _weighted(regression.factor_slope, targets.frequency_slope, weights.frequency_slope)
    yield _weighted(regression.mass_slope, targets.mass_slope, weights.mass_slope)
