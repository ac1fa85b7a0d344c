"""Gauss-Newton on the full model: each step solves the whole problem on a local reduced model.

The objective is half the sum of squares of the weighted residuals and of the distances of the
parameters from their prior means, in prior standard deviations. If the weights were standard
deviations of independent normal errors, its minimum would be the maximum of the posterior density.
They are not (see `targets.Weights`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fe.runtime.errors import FiniteElementError
from fe.wing.design import WingDesign
from reporting.progress import Progress, SilentProgress

from .errors import IdentificationError
from .local_model import LocalModel, build_local_model
from .parameters import (
    FreeParameter,
    deviations,
    prior_means,
    scaled,
    values_of,
    with_values,
)
from .residuals import fitted_residuals
from .targets import Targets, Weights

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

CONVERGED = 0.02
"""Largest next step of a converged fit, in prior standard deviations."""
RADIUS = 1.0
"""First and largest step of any parameter, in prior standard deviations."""
_REFUSED = 1e6  # residual of a point at which the local model has no meaning


@dataclass(frozen=True, eq=False)
class Iteration:
    """One iteration: the best point until then, and the next step from it.

    Attributes
    ----------
    objective, misfit : float
        Objective at the best point, and the contribution of the data to it.
    largest_step : float
        Largest change of a parameter in the next step, in prior standard deviations.
    limited : bool
        Whether the next step was cut where the derivatives stop being valid. Its length then says
        nothing about convergence.
    """

    objective: float
    misfit: float
    largest_step: float
    limited: bool


@dataclass(frozen=True, eq=False)
class DesignFit:
    """Result of the identification.

    Attributes
    ----------
    design : WingDesign
        The identified wing.
    parameters : tuple of FreeParameter
        The P free parameters.
    values, start : (P,) arrays
        Values of the parameters at the end and at the start, each in its unit.
    model : LocalModel
        The identified wing with derivatives.
    iterations : tuple of Iteration
        All iterations, with those whose step was refused.
    converged : bool
        Whether the next step is below the tolerance and was not cut.
    """

    design: WingDesign
    parameters: tuple[FreeParameter, ...]
    values: FloatArray
    start: FloatArray
    model: LocalModel
    iterations: tuple[Iteration, ...]
    converged: bool


class WeightedResiduals(NamedTuple):
    """Residuals of outputs and parameters, in standard deviations.

    Attributes
    ----------
    residual : (M + P,) array
        Residuals of the outputs, then distances of the parameters from their prior means.
    jacobian : (M + P, P) array
        Derivatives of the residuals, per prior standard deviation of each parameter.
    """

    residual: FloatArray
    jacobian: FloatArray

    @property
    def objective(self) -> float:
        """Half the sum of squares of the residuals."""
        return 0.5 * float(self.residual @ self.residual)


def weighted_residuals(
    model: LocalModel,
    values: FloatArray,
    parameters: Sequence[FreeParameter],
    targets: Targets,
    weights: Weights,
) -> WeightedResiduals:
    """Return the residuals of outputs and parameters.

    Parameters
    ----------
    model : LocalModel
        The wing.
    values : (P,) array
        Values of the parameters, each in its unit.
    parameters : sequence of FreeParameter
        The free parameters.
    targets : Targets
        Published outputs.
    weights : Weights
        Standard deviations of the residuals.
    """
    outputs = fitted_residuals(model.at(values), targets, weights)
    output_jacobian = outputs.gradient * deviations(parameters)
    prior_jacobian = np.eye(len(parameters))
    return WeightedResiduals(
        np.concatenate([outputs.value, scaled(parameters, values)]),
        np.vstack([output_jacobian, prior_jacobian]),
    )


@dataclass(eq=False)
class _LocalProblem:
    """Least-squares problem on a local model, in the parameters that are not held.

    All points are in prior standard deviations from the prior mean.

    Attributes
    ----------
    model : LocalModel
        The wing.
    parameters : sequence of FreeParameter
        The P free parameters of the fit.
    targets : Targets
        Published outputs.
    weights : Weights
        Standard deviations of the residuals.
    is_varied : (P,) array of bool
        Whether a parameter is varied; the others are held.
    point : (P,) array
        Point of all parameters, of which the problem reads those that are held.
    """

    model: LocalModel
    parameters: Sequence[FreeParameter]
    targets: Targets
    weights: Weights
    is_varied: BoolArray
    point: FloatArray
    _last: tuple[bytes, WeightedResiduals] | None = field(default=None, init=False)

    def residual(self, varied: FloatArray) -> FloatArray:
        """Return the residuals at a point of the varied parameters."""
        return self._evaluate(varied).residual

    def jacobian(self, varied: FloatArray) -> FloatArray:
        """Return the derivatives of the residuals in the varied parameters."""
        return self._evaluate(varied).jacobian

    def values_at(self, varied: FloatArray) -> FloatArray:
        """Return the values (P,) of all parameters, each in its unit."""
        point = self.point.copy()
        point[self.is_varied] = varied
        return np.asarray(prior_means(self.parameters) + deviations(self.parameters) * point)

    def _evaluate(self, varied: FloatArray) -> WeightedResiduals:
        """Return residuals and derivatives; the last ones are kept, as the solver asks twice."""
        key = varied.tobytes()
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        try:
            residuals = self._residuals(self.values_at(varied))
        except (IdentificationError, np.linalg.LinAlgError):
            # Too far for the derivatives of the geometry: the solver takes a shorter step.
            return self._refused()
        reduced = WeightedResiduals(residuals.residual, residuals.jacobian[:, self.is_varied])
        self._last = (key, reduced)
        return reduced

    def _residuals(self, values: FloatArray) -> WeightedResiduals:
        return weighted_residuals(self.model, values, self.parameters, self.targets, self.weights)

    def _refused(self) -> WeightedResiduals:
        """Return residuals so large that the solver leaves the point."""
        count = len(self._residuals(self.model.values).residual)
        return WeightedResiduals(
            np.full(count, _REFUSED), np.zeros((count, int(self.is_varied.sum())))
        )


def minimise_local(
    model: LocalModel,
    parameters: Sequence[FreeParameter],
    targets: Targets,
    weights: Weights,
    radius: float,
    held: Mapping[int, float] | None = None,
) -> FloatArray:
    """Return the values (P,) of the parameters that minimise the objective on a local model.

    Parameters
    ----------
    model : LocalModel
        The wing.
    parameters : sequence of FreeParameter
        The P free parameters.
    targets : Targets
        Published outputs.
    weights : Weights
        Standard deviations of the residuals.
    radius : float
        Largest step of a parameter from the point of the model, in prior standard deviations. A
        parameter with a stride below one may move less.
    held : mapping of int to float, optional
        Parameters that are held at a value, by their number.
    """
    width = deviations(parameters)
    mean = prior_means(parameters)
    lower = (np.array([parameter.lower for parameter in parameters]) - mean) / width
    upper = (np.array([parameter.upper for parameter in parameters]) - mean) / width
    start = np.clip(scaled(parameters, model.values), lower, upper)
    reach = radius * np.array([parameter.stride for parameter in parameters])
    low = np.maximum(lower, start - reach)
    high = np.minimum(upper, start + reach)

    is_varied = np.ones(len(parameters), dtype=bool)
    point = start.copy()
    for number, value in (held or {}).items():
        is_varied[number] = False
        point[number] = (value - mean[number]) / width[number]
    problem = _LocalProblem(model, parameters, targets, weights, is_varied, point)

    # An interior start: the solver refuses to begin on a bound.
    margin = 1e-9 * (high - low)
    interior_start = np.clip(start, low + margin, high - margin)
    result = least_squares(
        problem.residual,
        interior_start[is_varied],
        jac=problem.jacobian,
        bounds=(low[is_varied], high[is_varied]),
        x_scale=1.0,
        xtol=1e-10,
        ftol=1e-12,
        gtol=1e-10,
        max_nfev=100,
    )
    return problem.values_at(result.x)


def identify(
    start: WingDesign,
    parameters: Sequence[FreeParameter],
    targets: Targets,
    weights: Weights | None = None,
    *,
    largest_count: int = 15,
    tolerance: float = CONVERGED,
    progress: Progress | None = None,
) -> DesignFit:
    """Fit the free parameters of a wing design.

    Parameters
    ----------
    start : WingDesign
        Design at which the fit begins; everything that is not free stays as in this design.
    parameters : sequence of FreeParameter
        The free parameters.
    targets : Targets
        Published outputs.
    weights : Weights, optional
        Standard deviations of the residuals.
    largest_count : int
        Largest number of local models.
    tolerance : float
        Largest next step of a converged fit, in prior standard deviations.
    progress : Progress, optional
        Receives a note on each iteration.

    Raises
    ------
    IdentificationError
        If the start lies outside the bounds of a parameter, or lacks a number that is free.
    """
    weights = weights or Weights()
    progress = progress or SilentProgress()
    parameters = tuple(parameters)
    first_values = values_of(start, parameters)
    _check_start(parameters, first_values)
    values = first_values
    model = build_local_model(start, parameters, progress)
    cost = weighted_residuals(model, values, parameters, targets, weights).objective
    radius = RADIUS
    iterations = []
    converged = False
    for count in range(1, largest_count + 1):
        proposed = minimise_local(model, parameters, targets, weights, radius)
        distance = scaled(parameters, proposed) - scaled(parameters, values)
        step = float(np.abs(distance).max())
        misfit = cost - 0.5 * float(np.sum(scaled(parameters, values) ** 2))
        limited = _is_limited(parameters, values, proposed, radius)
        iterations.append(Iteration(cost, misfit, step, limited))
        remark = " (as far as allowed)" if limited else ""
        progress.note(
            f"model {count}: objective {cost:.3f}, next step {step:.3f} prior deviations{remark}"
        )
        if step <= tolerance and not limited:
            converged = True
            break
        if count == largest_count:
            break
        # The full model at the proposed point decides whether the step is taken.
        try:
            design = with_values(model.design, parameters, proposed)
            trial = build_local_model(design, parameters, progress)
            residuals = weighted_residuals(trial, proposed, parameters, targets, weights)
            trial_cost = residuals.objective
        except FiniteElementError as error:
            progress.note(f"a step was refused: {error}")
            trial = model
            trial_cost = np.inf
        if trial_cost < cost:
            model = trial
            values = proposed
            cost = trial_cost
            radius = min(RADIUS, 2.0 * radius)
        else:
            radius = 0.25 * min(radius, step)
            # No step above the tolerance lowers the objective of the full model.
            if radius < tolerance:
                break
    return DesignFit(
        design=model.design,
        parameters=parameters,
        values=values,
        start=first_values,
        model=model,
        iterations=tuple(iterations),
        converged=converged,
    )


def _check_start(parameters: Sequence[FreeParameter], values: FloatArray) -> None:
    """Raise `IdentificationError` if a value (P,) lies outside the bounds of its parameter."""
    for parameter, value in zip(parameters, values, strict=True):
        if not parameter.lower <= value <= parameter.upper:
            raise IdentificationError(
                f"the start has {value:g} {parameter.unit} for '{parameter.name}', outside its "
                "bounds of "
                f"{parameter.lower:g} to {parameter.upper:g}; begin with another design."
            )


def _is_limited(
    parameters: Sequence[FreeParameter], values: FloatArray, proposed: FloatArray, radius: float
) -> bool:
    """Return whether a step was cut by the radius, and not only by the bounds of parameters.

    Parameters
    ----------
    parameters : sequence of FreeParameter
        The P free parameters.
    values, proposed : (P,) arrays
        Values before and after the step, each in its unit.
    radius : float
        Largest step of a parameter, in prior standard deviations.
    """
    change = np.abs(scaled(parameters, proposed) - scaled(parameters, values))
    stride = np.array([parameter.stride for parameter in parameters])
    at_reach = change >= 0.99 * radius * stride
    lower = np.array([parameter.lower for parameter in parameters])
    upper = np.array([parameter.upper for parameter in parameters])
    distance_to_bound = np.minimum(proposed - lower, upper - proposed)
    at_bound = distance_to_bound <= 1e-6 * deviations(parameters)
    return bool(np.any(at_reach & ~at_bound))
