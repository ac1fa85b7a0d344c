"""How well the published outputs determine each free number, and which they cannot separate.

The analysis linearises the fit at its end, in prior standard deviations. The weights are judgements
of how well the idealised wing can match the outputs (`targets.Weights`). So widths can be compared
with each other and with the prior, but they are no probabilities of the real wing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import IdentificationError
from .least_squares import DesignFit, minimise_local, weighted_residuals
from .local_model import build_local_model
from .parameters import FreeParameter, deviations
from .residuals import fitted_residuals
from .targets import Targets, Weights

FloatArray = NDArray[np.float64]

LARGE_FRACTION = 0.3
"""Components of a direction below this fraction of its largest are left out of its description."""
MOST_COMPONENTS = 5
"""Largest number of components in the description of a direction."""
PROFILE_STEPS = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
"""Points of a profile, in standard deviations after the fit."""
PROFILE_RADIUS = 10.0


@dataclass(frozen=True, eq=False)
class Identifiability:
    """Linear analysis of the fit.

    Attributes
    ----------
    names : tuple of str
        Names of the P parameters.
    singular_values : (P,) array
        Singular values of the weighted derivatives, falling: the misfit that one prior standard
        deviation along a direction makes. Below one, the prior determines the direction.
    directions : (P, P) array
        Directions in the parameters; row i belongs to singular value i.
    width : (P,) array
        Standard deviation after the fit over that before it.
    correlation : (P, P) array
        Correlation of the parameters after the fit.
    fixed : tuple of (str, float)
        Names of numbers that were not free, and the fraction of the effect of each (root of the
        sum of squares) that the free ones can imitate.
    """

    names: tuple[str, ...]
    singular_values: FloatArray
    directions: FloatArray
    width: FloatArray
    correlation: FloatArray
    fixed: tuple[tuple[str, float], ...]

    @property
    def effective_count(self) -> float:
        """Number of parameters that the data determine: the sum of s^2 / (1 + s^2)."""
        square = self.singular_values**2
        return float(np.sum(square / (1.0 + square)))

    def describe(self, direction: int) -> str:
        """Return the largest components of a direction in words.

        An example is '0.8 web modulus - 0.5 flap root spring'. The largest component is positive.
        """
        row = self.directions[direction]
        order = np.argsort(-np.abs(row))
        row = row * np.sign(row[np.argmax(np.abs(row))])
        least = LARGE_FRACTION * abs(row[order[0]])
        components = []
        for number in order[:MOST_COMPONENTS]:
            if abs(row[number]) >= least:
                sign = "-" if row[number] < 0.0 else "+"
                components.append(f"{sign} {abs(row[number]):.2f} {self.names[number]}")
        return " ".join(components).removeprefix("+ ")

    def pairs(self, least: float = 0.8) -> list[tuple[str, str, float]]:
        """Return the pairs of strongly correlated parameters with their correlation, largest first.

        Parameters
        ----------
        least : float
            Least absolute correlation after the fit.
        """
        rows, columns = np.triu_indices(len(self.names), 1)
        pairs = []
        for i, j in zip(rows, columns, strict=True):
            correlation = float(self.correlation[i, j])
            if abs(correlation) >= least:
                pairs.append((self.names[i], self.names[j], correlation))
        return sorted(pairs, key=lambda pair: -abs(pair[2]))


def analyse(
    fit: DesignFit, targets: Targets, weights: Weights, fixed: Sequence[FreeParameter] = ()
) -> Identifiability:
    """Analyse a fit.

    Parameters
    ----------
    fit : DesignFit
        The fit.
    targets : Targets
        Published outputs.
    weights : Weights
        Standard deviations of the residuals.
    fixed : sequence of FreeParameter
        Numbers of the design that were not free but might have been.
    """
    gradient = fitted_residuals(fit.model.wing, targets, weights).gradient
    jacobian = gradient * deviations(fit.parameters)
    _, singular_values, directions = np.linalg.svd(jacobian, full_matrices=False)
    covariance = np.linalg.inv(jacobian.T @ jacobian + np.eye(len(fit.parameters)))
    width = np.sqrt(np.diag(covariance))
    return Identifiability(
        names=tuple(parameter.name for parameter in fit.parameters),
        singular_values=singular_values,
        directions=directions,
        width=width,
        correlation=covariance / np.outer(width, width),
        fixed=tuple(_imitated_fractions(fit, targets, weights, jacobian, fixed)),
    )


def _imitated_fractions(
    fit: DesignFit,
    targets: Targets,
    weights: Weights,
    jacobian: FloatArray,
    fixed: Sequence[FreeParameter],
) -> list[tuple[str, float]]:
    """Return for each fixed parameter its name and the fraction of its effect that can be imitated.

    Parameters
    ----------
    fit : DesignFit
        The fit.
    targets : Targets
        Published outputs.
    weights : Weights
        Standard deviations of the residuals.
    jacobian : (M, P) array
        Derivatives of the residuals, per prior standard deviation of each free parameter.
    fixed : sequence of FreeParameter
        Numbers of the design that were not free.
    """
    if not fixed:
        return []
    model = build_local_model(fit.design, fixed)
    effects = fitted_residuals(model.wing, targets, weights).gradient * deviations(fixed)
    # Their own prior holds the free parameters back, as in the fit.
    free_count = len(fit.parameters)
    matrix = np.vstack([jacobian, np.eye(free_count)])
    fractions = []
    for parameter, effect in zip(fixed, effects.T, strict=True):
        right_side = np.concatenate([effect, np.zeros(free_count)])
        step, *_ = np.linalg.lstsq(matrix, right_side, rcond=None)
        residual = np.linalg.norm(effect - jacobian @ step)
        unexplained = min(float(residual / np.linalg.norm(effect)), 1.0)
        fractions.append((parameter.name, (1.0 - unexplained**2) ** 0.5))
    return fractions


@dataclass(frozen=True, eq=False)
class Profile:
    """Objective along one parameter, with all others fitted again.

    Attributes
    ----------
    name, unit : str
        Name and unit of the parameter.
    value : (n,) array
        Values at which the parameter was held.
    rise : (n,) array
        Objective minus that of the fit, on the local model.
    linear : (n,) array
        Rise by the linear analysis: half the square of the distance in standard deviations.
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

    Parameters
    ----------
    fit : DesignFit
        The fit.
    targets : Targets
        Published outputs.
    weights : Weights
        Standard deviations of the residuals.
    analysis : Identifiability
        Analysis of the fit.
    name : str
        Name of a free parameter.

    Raises
    ------
    IdentificationError
        If no free parameter has this name.
    """
    if name not in analysis.names:
        raise IdentificationError(
            f"there is no free number '{name}'; they are {', '.join(analysis.names)}."
        )
    number = analysis.names.index(name)
    parameter = fit.parameters[number]
    fitted_value = fit.values[number]
    width = float(analysis.width[number]) * parameter.standard_deviation
    steps = np.array(PROFILE_STEPS)
    values = np.clip(fitted_value + width * steps, parameter.lower, parameter.upper)

    def lowest_objective(held: dict[int, float]) -> float:
        lowest = minimise_local(fit.model, fit.parameters, targets, weights, PROFILE_RADIUS, held)
        return weighted_residuals(fit.model, lowest, fit.parameters, targets, weights).objective

    lowest_of_all = lowest_objective({})
    rise = [lowest_objective({number: value}) - lowest_of_all for value in values.tolist()]
    return Profile(
        name=name,
        unit=parameter.unit,
        value=values,
        rise=np.array(rise),
        linear=0.5 * ((values - fitted_value) / width) ** 2,
    )
