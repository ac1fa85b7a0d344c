"""What the published outputs tell of each free number, and what they cannot tell apart.

All is said of the fit linearised where it ended, in prior standard deviations. The weights are judgements of
the idealisation's misfit (`targets.Weights`), so that widths are to be compared with each other and with the
prior, and are no probabilities of the real wing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import IdentificationError
from .least_squares import DesignFit, minimise_local, objective
from .local_model import build_local_model
from .parameters import FreeParameter, deviations
from .residuals import fitted_residuals
from .targets import Targets, Weights

FloatArray = NDArray[np.float64]

LARGE_SHARE = 0.3
"""Components of a direction below this share of its largest are left out of its description."""
PROFILE_STEPS = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
"""Places of a profile in standard deviations after the fit."""
PROFILE_RADIUS = 10.0


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Linear analysis of the fit.

    Attributes
    ----------
    names : tuple of str
        The P parameters.
    singular_values : (P,)
        Of the weighted derivatives, falling: how many units of misfit one prior deviation along a direction
        makes. Below one the prior decides.
    directions : (P, P)
        Row i belongs to singular value i.
    width : (P,)
        Standard deviation after the fit over that before.
    correlation : (P, P)
        After the fit.
    fixed : tuple of (str, float)
        Numbers that were not free, and which share of the effect of each (root of the sum of squares) the
        free ones can imitate.
    """

    names: tuple[str, ...]
    singular_values: FloatArray
    directions: FloatArray
    width: FloatArray
    correlation: FloatArray
    fixed: tuple[tuple[str, float], ...]

    @property
    def effective_count(self) -> float:
        """How many parameters the data determine: sum of s^2 / (1 + s^2)."""
        square = self.singular_values**2
        return float(np.sum(square / (1.0 + square)))

    def describe(self, direction: int) -> str:
        """Largest components of a direction, such as '0.8 web modulus - 0.5 flap root spring'."""
        row = self.directions[direction]
        row = row * np.sign(row[np.argmax(np.abs(row))])
        order = np.argsort(-np.abs(row))
        large = [int(n) for n in order if abs(row[n]) >= LARGE_SHARE * abs(row[order[0]])][:5]
        text = " ".join(f"{'-' if row[n] < 0.0 else '+'} {abs(row[n]):.2f} {self.names[n]}" for n in large)
        return text.removeprefix("+ ")

    def pairs(self, least: float = 0.8) -> list[tuple[str, str, float]]:
        """Pairs of parameters whose correlation after the fit is at least `least` in size, largest first."""
        rows, columns = np.triu_indices(len(self.names), 1)
        found = [
            (self.names[i], self.names[j], float(self.correlation[i, j]))
            for i, j in zip(rows, columns, strict=True)
            if abs(self.correlation[i, j]) >= least
        ]
        return sorted(found, key=lambda pair: -abs(pair[2]))


def analyse(
    fit: DesignFit, targets: Targets, weights: Weights, fixed: Sequence[FreeParameter] = ()
) -> Identifiability:
    """Analyse a fit; `fixed` are numbers of the design that were not free but might have been."""
    own = fitted_residuals(fit.model.wing, targets, weights).gradient * deviations(fit.parameters)
    _, values, directions = np.linalg.svd(own, full_matrices=False)
    covariance = np.linalg.inv(own.T @ own + np.eye(own.shape[1]))
    width = np.sqrt(np.diag(covariance))
    return Identifiability(
        names=tuple(parameter.name for parameter in fit.parameters),
        singular_values=values,
        directions=directions,
        width=width,
        correlation=covariance / np.outer(width, width),
        fixed=tuple(_imitated(fit, targets, weights, own, fixed)),
    )


def _imitated(
    fit: DesignFit, targets: Targets, weights: Weights, own: FloatArray, fixed: Sequence[FreeParameter]
) -> list[tuple[str, float]]:
    if not fixed:
        return []
    model = build_local_model(fit.design, fixed)
    effect = fitted_residuals(model.wing, targets, weights).gradient * deviations(fixed)
    # Their own prior holds the free ones back, as in the fit.
    matrix = np.vstack([own, np.eye(own.shape[1])])
    found = []
    for parameter, column in zip(fixed, effect.T, strict=True):
        right = np.concatenate([column, np.zeros(own.shape[1])])
        moved, *_ = np.linalg.lstsq(matrix, right, rcond=None)
        left = float(np.linalg.norm(column - own @ moved) / np.linalg.norm(column))
        found.append((parameter.name, (1.0 - min(left, 1.0) ** 2) ** 0.5))
    return found


@dataclass(frozen=True, eq=False)
class Profile:
    """Objective along one parameter, all others fitted again.

    Attributes
    ----------
    name, unit : str
    value : (n,)
        Where it was held.
    rise : (n,)
        Objective above that of the fit, on the local model.
    linear : (n,)
        The same by the linear analysis: half the square of the distance in standard deviations.
    """

    name: str
    unit: str
    value: FloatArray
    rise: FloatArray
    linear: FloatArray


def profile(
    fit: DesignFit, targets: Targets, weights: Weights, analysis: Identifiability, name: str
) -> Profile:
    """Profile the objective along a named parameter, on the local model of the fit.

    Raises
    ------
    IdentificationError
        If no free parameter has this name.
    """
    if name not in analysis.names:
        raise IdentificationError(f"there is no free number '{name}'; they are {', '.join(analysis.names)}.")
    number = analysis.names.index(name)
    parameter = fit.parameters[number]
    width = float(analysis.width[number]) * parameter.standard_deviation
    steps = np.array(PROFILE_STEPS)
    places = np.clip(fit.values[number] + width * steps, parameter.lower, parameter.upper)
    lowest = minimise_local(fit.model, fit.parameters, targets, weights, PROFILE_RADIUS)
    base = _objective(fit, lowest, targets, weights)
    rise = [
        _objective(
            fit,
            minimise_local(
                fit.model, fit.parameters, targets, weights, PROFILE_RADIUS, {number: float(place)}
            ),
            targets,
            weights,
        )
        - base
        for place in places
    ]
    return Profile(
        name, parameter.unit, places, np.array(rise), 0.5 * ((places - fit.values[number]) / width) ** 2
    )


def _objective(fit: DesignFit, values: FloatArray, targets: Targets, weights: Weights) -> float:
    residual, _ = objective(fit.model, values, fit.parameters, targets, weights)
    return 0.5 * float(residual @ residual)
