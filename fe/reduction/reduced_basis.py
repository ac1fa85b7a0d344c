"""Reduce a structure, such as a wing, and measure the errors of the reduced model."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import ReductionError
from fe.runtime.reduced import ReducedModel
from fe.runtime.reduced_results import ReducedResponse as ReducedResponse
from fe.structure.affine import (
    AffineResponse,
    AffineStructure,
    natural_frequencies,
    static_response,
)
from fe.structure.tables import StructureSettings
from reporting.progress import Progress, reporter

from .certified_basis import StaticReduction
from .modal_basis import modal_reduction
from .terms import ReductionTerms, State


@dataclass(frozen=True)
class Reduction:
    """A reduced model and the bases from which it was made.

    Attributes
    ----------
    model : ReducedModel
        The model that is evaluated online.
    static_basis : (n, N) array
        Static basis vectors on the free unknowns of the full model.
    modal_basis : (n, Nm) array
        Modal basis vectors.
    snapshots : tuple of tuple
        Parameters and losses of the full solutions, in the order of the search.
    bound_history : tuple of float
        The largest relative bound on the training set after each round of full solutions.
    terms : ReductionTerms
        The full model, with its factorised stiffness.
    """

    model: ReducedModel
    static_basis: FloatArray
    modal_basis: FloatArray
    snapshots: tuple[State, ...]
    bound_history: tuple[float, ...]
    terms: ReductionTerms


def reduce_structure(
    structure: AffineStructure,
    settings: StructureSettings | None = None,
    progress: Progress | None = None,
) -> Reduction:
    """Return the reduced model of a structure, with what its making has found.

    The modes are reduced first. The static basis then grows until the bound of its error is below
    the tolerance.

    Parameters
    ----------
    settings : StructureSettings, optional
        The required accuracy; by default that of the structure's design.

    Raises
    ------
    ReductionError
        If the structure lacks regions, loads, outputs or mass, or the accuracy is not reached.
    SolutionError
        If the full model cannot be solved.
    """
    progress = reporter(progress)
    if settings is None:
        limits = structure.design.reduction
        settings = StructureSettings(limits.tolerance, limits.most_solutions, limits.modes)
    terms = ReductionTerms(replace(structure, ranges=structure.ranges | settings.ranges))
    _check_reducible(terms)
    with progress.stage("Factorising the structure"):
        _ = terms.factors
    with progress.stage("Reducing the modes") as stage:
        modal = modal_reduction(terms, settings.mode_count, stage)
    with progress.stage("Reducing the statics") as stage:
        static = StaticReduction(terms, modal, stage)
        history = static.search(settings)
        directions = static.compressed(settings.bound_tolerance)
    return Reduction(
        model=static.model(directions),
        static_basis=static.basis.displacements @ directions,
        modal_basis=modal.basis,
        snapshots=tuple(static.snapshots),
        bound_history=history,
        terms=terms,
    )


def _check_reducible(terms: ReductionTerms) -> None:
    """Raise `ReductionError` if the structure lacks regions, loads, outputs or mass."""
    structure = terms.structure
    name = structure.design.name
    if not structure.regions:
        raise ReductionError(
            f"The structure {name} has no [[damage]]: a twin needs a region that may lose "
            "stiffness."
        )
    if not len(terms.load_factors):
        raise ReductionError(
            f"The structure {name} has no [[load]] that does anything: nothing would strain it."
        )
    if not terms.groups:
        raise ReductionError(
            f"The structure {name} has no [[gauge]] and no [[displacement]]: nothing could be "
            "observed."
        )
    if not structure.mass().diagonal().any():
        raise ReductionError(
            f"The structure {name} has no mass, hence no modes; give its materials a density."
        )


@dataclass(frozen=True)
class MeasuredErrors:
    """Largest errors of a reduced model at random states, compared with the full model.

    Attributes
    ----------
    strain, displacement : float
        Errors of the outputs, relative to the largest output of the same load and state; NaN if
        there are no such outputs.
    bound : float
        The largest certified bound of strains and displacements, relative in the same way.
    frequency : float
        Relative error of the natural frequencies at the first and the last state.
    states : int
        The number of states.
    broken : int
        The number of states at which an error is larger than its bound.
    """

    strain: float
    displacement: float
    bound: float
    frequency: float
    states: int
    broken: int


def measured_errors(
    structure: AffineStructure, model: ReducedModel, states: int, seed: int = 2021
) -> MeasuredErrors:
    """Return the largest errors of a reduced model, measured at random states by the full model.

    Each control has its nominal value, or the value one if that is zero. Frequencies are compared
    at the first and the last state only. A state is "broken" if one of its errors exceeds the bound
    that the reduced model gives for it.

    Parameters
    ----------
    states : int
        The number of states, uniform in the ranges; each costs a factorisation.

    Raises
    ------
    SolutionError
        If the full model cannot be solved.
    """
    vectors = _random_values(model, states, seed)
    errors = []
    bounds = []
    frequency_error = 0.0
    for number, vector in enumerate(vectors):
        values = dict(zip(model.input_names, vector.tolist(), strict=True))
        exact = static_response(structure, values)
        state_errors = _relative_errors(exact, model.static_response(vector))
        errors.append(state_errors.errors)
        bounds.append(state_errors.bounds)
        if number in (0, states - 1):
            exact_frequency, _ = natural_frequencies(structure, model.mode_count, values)
            relative_errors = np.abs(model.modes(vector).frequency / exact_frequency - 1.0)
            frequency_error = max(frequency_error, float(relative_errors.max()))
    strain_error, displacement_error = np.fmax.reduce(errors)
    is_broken = (np.array(errors) > np.array(bounds)).any(axis=1)
    return MeasuredErrors(
        strain=float(strain_error),
        displacement=float(displacement_error),
        bound=float(np.nanmax(bounds)),
        frequency=frequency_error,
        states=states,
        broken=int(is_broken.sum()),
    )


class _RelativeErrors(NamedTuple):
    """Errors of strains and of displacements; NaN if the structure has none.

    Attributes
    ----------
    errors, bounds : (2,) array
        The largest error and its certified bound, relative to the largest output.
    """

    errors: FloatArray
    bounds: FloatArray


def _relative_errors(exact: AffineResponse, reduced: ReducedResponse) -> _RelativeErrors:
    """Return the relative errors and bounds of strains and displacements."""
    errors = np.full(2, np.nan)
    bounds = np.full(2, np.nan)
    for kind, exact_outputs in enumerate((exact.strain, exact.output)):
        if exact_outputs.size:
            reduced_outputs, error_bound = reduced.outputs_with_bounds[kind]
            largest = np.abs(exact_outputs).max()
            errors[kind] = np.abs(reduced_outputs - exact_outputs).max() / largest
            bounds[kind] = error_bound / largest
    return _RelativeErrors(errors, bounds)


def _random_values(model: ReducedModel, count: int, seed: int) -> FloatArray:
    """Return random inputs (count, V) in the validity box, with nominal or unit controls."""
    low, high = model.validity_box.T
    generator = np.random.default_rng(seed)
    fractions = generator.random((count, len(low)))
    vectors: FloatArray = low + (high - low) * fractions
    first_control = len(model.input_names) - len(model.controls)
    unit = np.clip(1.0, low, high)
    control_values = np.where(model.nominal == 0.0, unit, model.nominal)
    vectors[:, first_control:] = control_values[first_control:]
    return vectors
