"""Where a hypothesis stands, and the derivatives of its predictions there."""

from dataclasses import dataclass

from discrepancy.campaign.records import FloatArray

PARAMETER_STEP = 1e-2
"""Step of the differences in scaled variables."""
LEAST_STEP = 1e-4
"""Least step by effect parameters, above the rounding of the integration."""
SHARED_STEP = 1e-3
"""The same for calibrated parameters: what effects share with the stiffness must cancel to a thousandth."""


@dataclass(frozen=True)
class Linearisation:
    """Prediction of one trial and its derivatives, before gain and zero.

    Attributes
    ----------
    response : (N, C) ndarray
        Prediction without gain and zero.
    parameters : (P, N, C) ndarray
        Its derivatives by the scaled calibrated parameters.
    local : (I, N, C) ndarray
        By the scaled initial state, time zero and health.
    effect : (E, N, C) ndarray
        By the scaled effect parameters; empty without effect.
    """

    response: FloatArray
    parameters: FloatArray
    local: FloatArray
    effect: FloatArray


@dataclass(frozen=True)
class Point:
    """Values of all scaled variables.

    Attributes
    ----------
    shared : (Q,) ndarray
        Global unknowns.
    local : tuple of (L_t,) ndarray
        Of each trial.
    effect : (E,) ndarray
        Of the candidate.
    """

    shared: FloatArray
    local: tuple[FloatArray, ...]
    effect: FloatArray


@dataclass(frozen=True)
class Base:
    """Where the derivatives by shared and local unknowns were taken, for chord steps."""

    point: Point
    parts: tuple[Linearisation, ...]


def moved(values: FloatArray, index: int, step: float = PARAMETER_STEP) -> FloatArray:
    """Return the values with one of them a step further."""
    changed = values.copy()
    changed[index] += step
    return changed
