"""Residuals of the fitted outputs in units of their weights, with derivatives and a label each."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .responses import ReducedWing, Value
from .targets import (
    LEVELS,
    LIBRARY_FACTOR,
    LIMITING_GAUGE,
    Targets,
    Weights,
    fitted_states,
)

FloatArray = NDArray[np.float64]


class Residuals(NamedTuple):
    """Residuals in standard deviations.

    Attributes
    ----------
    value : (M,)
    gradient : (M, P)
        Per unit of each parameter.
    """

    value: FloatArray
    gradient: FloatArray


def fitted_residuals(wing: ReducedWing, targets: Targets, weights: Weights) -> Residuals:
    """Residuals of everything that is fitted, model less target, over its standard deviation."""
    parts = [part for group in (_strains, _stiffness, _frequencies) for part in group(wing, targets, weights)]
    return Residuals(
        np.concatenate([part.value for part in parts]), np.concatenate([part.gradient for part in parts])
    )


def _part(found: Value, target: FloatArray, deviation: FloatArray | float) -> Residuals:
    width = np.broadcast_to(deviation, target.shape)
    return Residuals((found.value - target) / width, found.gradient / width[..., None])


def _strains(wing: ReducedWing, targets: Targets, weights: Weights) -> Iterator[Residuals]:
    gauges = targets.strain.shape[2]
    limiting = np.arange(gauges) == LIMITING_GAUGE
    healthy = wing.strain(LIBRARY_FACTOR, (0.0, 0.0))
    yield _part(
        healthy.log(),
        np.log(targets.strain[0, 0]),
        np.where(limiting, weights.limiting_strain, weights.strain),
    )
    for i, j in np.argwhere(fitted_states()):
        one, two = LEVELS[i], LEVELS[j]
        yield _part(
            wing.strain(LIBRARY_FACTOR, (one, two)).over(healthy),
            targets.ratio[i, j],
            np.where(limiting & (one > 0.0), weights.limiting_ratio, weights.ratio),
        )
    yield _part(wing.strain_slope(LIBRARY_FACTOR), targets.strain_slope, weights.slope)


def _stiffness(wing: ReducedWing, targets: Targets, weights: Weights) -> Iterator[Residuals]:
    found = wing.tip_stiffness()
    scale = np.array([targets.tip_stiffness, 1.0])
    relative = Value(found.value / scale, found.gradient / scale[:, None])
    yield _part(
        relative,
        np.array([1.0, targets.tip_stiffness_slope]),
        np.array([weights.stiffness, weights.stiffness_slope]),
    )


def _frequencies(wing: ReducedWing, targets: Targets, weights: Weights) -> Iterator[Residuals]:
    rows = np.flatnonzero(targets.fitted_row)
    found = wing.log_frequency(
        targets.young_modulus_factor[rows], targets.servo_mass[rows], targets.pitot_mass[rows]
    )
    flat = Value(found.value.ravel(), found.gradient.reshape(2 * len(rows), -1))
    yield _part(flat, np.log(targets.frequency[rows]).ravel(), weights.frequency)
    _, factor_slope, mass_slope = wing.frequency_slopes()
    yield _part(factor_slope, targets.frequency_slope, weights.frequency_slope)
    yield _part(mass_slope, targets.mass_slope, weights.mass_slope)
