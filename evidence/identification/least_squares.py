"""Gauss-Newton on the full model: each step solves the whole problem on a local reduced model.

The objective is half the sum of squares of the weighted residuals and of the parameters' distances from their
prior means in prior standard deviations: the maximum of the posterior density if the weights were standard
deviations of independent normal errors, which they are not (see `targets.Weights`).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fe.runtime.errors import FiniteElementError
from fe.wing.design import WingDesign
from reporting.progress import Progress, SilentProgress

from .errors import IdentificationError
from .local_model import LocalModel, build_local_model
from .parameters import FreeParameter, deviations, scaled, values_of, with_values
from .residuals import fitted_residuals
from .targets import Targets, Weights

FloatArray = NDArray[np.float64]

CONVERGED = 0.02
"""A fit has converged when its next step changes no parameter by more than this many prior deviations."""
RADIUS = 1.0
"""First and largest step of any parameter, in prior standard deviations."""
_REFUSED = 1e6  # residual of a point at which the local model has no meaning


@dataclass(frozen=True, eq=False)
class Iteration:
    """One full model tried: the best point so far, and the next step from it.

    Attributes
    ----------
    objective, misfit : float
        At the best point; the part of the data alone.
    largest_step : float
        Largest change of a parameter in the next step, in prior deviations.
    limited : bool
        Whether that step was cut at the reach of the derivatives, so that its length says nothing.
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
        What was free.
    values, start : (P,)
        Where they are and where they began, each in its unit.
    model : LocalModel
        The wing there, with derivatives.
    iterations : tuple of Iteration
        Models tried, also those that were refused.
    converged : bool
        Whether the next step is below the tolerance, and not only because it was cut.
    """

    design: WingDesign
    parameters: tuple[FreeParameter, ...]
    values: FloatArray
    start: FloatArray
    model: LocalModel
    iterations: tuple[Iteration, ...]
    converged: bool


def objective(
    model: LocalModel,
    values: FloatArray,
    parameters: Sequence[FreeParameter],
    targets: Targets,
    weights: Weights,
) -> tuple[FloatArray, FloatArray]:
    """Residuals and priors (M + P,) and their derivatives (M + P, P) in prior standard deviations."""
    data = fitted_residuals(model.at(values), targets, weights)
    return (
        np.concatenate([data.value, scaled(parameters, values)]),
        np.vstack([data.gradient * deviations(parameters), np.eye(len(parameters))]),
    )


def minimise_local(
    model: LocalModel,
    parameters: Sequence[FreeParameter],
    targets: Targets,
    weights: Weights,
    radius: float,
    held: dict[int, float] | None = None,
) -> FloatArray:
    """Minimise on a local model within `radius` prior deviations of its point; the values (P,).

    A parameter with a stride below one may move less. `held` fixes parameters, by their number, at values.
    """
    held = held or {}
    width = deviations(parameters)
    mean = np.array([parameter.mean for parameter in parameters])
    lower = (np.array([parameter.lower for parameter in parameters]) - mean) / width
    upper = (np.array([parameter.upper for parameter in parameters]) - mean) / width
    start = np.clip(scaled(parameters, model.values), lower, upper)
    reach = radius * np.array([parameter.stride for parameter in parameters])
    low, high = np.maximum(lower, start - reach), np.minimum(upper, start + reach)
    free = np.array([number not in held for number in range(len(parameters))])
    point = start.copy()
    for number, value in held.items():
        point[number] = (value - mean[number]) / width[number]
    first, _ = objective(model, model.values, parameters, targets, weights)
    cache: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def evaluate(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = x.tobytes()
        if key not in cache:
            cache.clear()
            whole = point.copy()
            whole[free] = x
            try:
                residual, jacobian = objective(model, mean + width * whole, parameters, targets, weights)
            except (IdentificationError, np.linalg.LinAlgError):
                # Too far for the derivatives of the geometry: the solver takes a shorter step.
                return np.full_like(first, _REFUSED), np.zeros((len(first), int(free.sum())))
            cache[key] = residual, jacobian[:, free]
        return cache[key]

    # An interior start: the solver refuses to begin on a bound.
    margin = 1e-9 * (high - low)
    result = least_squares(
        lambda x: evaluate(x)[0],
        np.clip(start, low + margin, high - margin)[free],
        jac=lambda x: evaluate(x)[1],
        bounds=(low[free], high[free]),
        x_scale=1.0,
        xtol=1e-10,
        ftol=1e-12,
        gtol=1e-10,
        max_nfev=100,
    )
    point[free] = result.x
    return np.asarray(mean + width * point)


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
        Where to begin, and everything that is not free.
    parameters : sequence of FreeParameter
        What is free.
    targets : Targets
        Published outputs.
    weights : Weights, optional
        What one unit of misfit is.
    largest_count : int
        Largest number of local models.
    tolerance : float
        Largest next step of a converged fit, in prior standard deviations.
    progress : Progress, optional
        Told of each iteration.

    Raises
    ------
    IdentificationError
        If the start lies outside the bounds or is laid out otherwise.
    """
    weights, progress = weights or Weights(), progress or SilentProgress()
    parameters = tuple(parameters)
    first = values_of(start, parameters)
    for parameter, value in zip(parameters, first, strict=True):
        if not parameter.lower <= value <= parameter.upper:
            raise IdentificationError(
                f"the start has {value:g} {parameter.unit} for '{parameter.name}', outside its bounds of "
                f"{parameter.lower:g} to {parameter.upper:g}; begin with another design."
            )
    model = build_local_model(start, parameters, progress)
    residual, _ = objective(model, first, parameters, targets, weights)
    cost = 0.5 * float(residual @ residual)
    radius, iterations, converged = RADIUS, [], False
    values = first
    for count in range(largest_count):
        proposed = minimise_local(model, parameters, targets, weights, radius)
        step = float(np.abs(scaled(parameters, proposed) - scaled(parameters, values)).max())
        misfit = cost - 0.5 * float(np.sum(scaled(parameters, values) ** 2))
        limited = _is_limited(parameters, values, proposed, radius)
        iterations.append(Iteration(cost, misfit, step, limited))
        progress.note(
            f"model {count + 1}: objective {cost:.3f}, next step {step:.3f} prior deviations"
            + (" (as far as allowed)" if limited else "")
        )
        if step <= tolerance and not limited:
            converged = True
            break
        if count == largest_count - 1:
            break
        try:
            trial = build_local_model(with_values(model.design, parameters, proposed), parameters, progress)
            residual, _ = objective(trial, proposed, parameters, targets, weights)
            trial_cost = 0.5 * float(residual @ residual)
        except FiniteElementError as error:
            progress.note(f"a step was refused: {error}")
            trial, trial_cost = model, np.inf
        if trial_cost < cost:
            model, values, cost = trial, proposed, trial_cost
            radius = min(RADIUS, 2.0 * radius)
        else:
            radius = 0.25 * min(radius, step)
            if radius < tolerance:  # no step that is worth one lowers the objective of the full model
                break
    return DesignFit(model.design, parameters, values, first, model, tuple(iterations), converged)


def _is_limited(
    parameters: Sequence[FreeParameter], values: FloatArray, proposed: FloatArray, radius: float
) -> bool:
    """Whether a step ends at the reach of the derivatives, and not at a bound of its parameter."""
    change = np.abs(scaled(parameters, proposed) - scaled(parameters, values))
    at_reach = change >= 0.99 * radius * np.array([parameter.stride for parameter in parameters])
    width = deviations(parameters)
    at_bound = [
        min(value - p.lower, p.upper - value) <= 1e-6 * w
        for value, p, w in zip(proposed, parameters, width, strict=True)
    ]
    return bool(np.any(at_reach & ~np.array(at_bound)))
