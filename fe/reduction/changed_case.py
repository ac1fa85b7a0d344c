"""A structure with one change, as full and as reduced model, and the error of the latter."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.runtime.changeable import ChangeableModel
from fe.runtime.changed_structure import ChangedStructure

from .terms import ReductionTerms


class ChangedCase(NamedTuple):
    """A structure with a change, as full and as reduced model.

    Attributes
    ----------
    structure : ChangedStructure
        The reduced structure.
    full_solution : callable
        Returns the displacements (n', k) of the full model under loads (n', k).
    mass : csr (n', n')
        The mass of the full model.
    direction : (n', 1) array
        The unit response to a released motion of a support; empty without one.
    """

    structure: ChangedStructure
    full_solution: Callable[[FloatArray], FloatArray]
    mass: sparse.csr_array
    direction: FloatArray = np.zeros((0, 1))


def case_error(
    case: ChangedCase,
    model: ChangeableModel,
    terms: ReductionTerms,
    held_terms: ReductionTerms,
    shapes: FloatArray,
) -> float:
    """Return the largest relative error of static outputs and natural frequencies in one case.

    Parameters
    ----------
    terms, held_terms : ReductionTerms
        Terms of the structure whose supports yield, and of the one whose supports are held.
    shapes : (n', M) array
        The M reduced mode shapes on all n' unknowns of the full model.
    """
    return max(
        _error_of_statics(case, model, terms, held_terms), _error_of_frequencies(case, shapes)
    )


def _error_of_statics(
    case: ChangedCase, model: ChangeableModel, terms: ReductionTerms, held_terms: ReductionTerms
) -> float:
    """Return the largest error of an output under a load, over the largest output of its group.

    The outputs (O, L) of the full and of the reduced model are compared under L loads.
    """
    structure = case.structure
    # The reduced model has the loads of the structure with held supports. If supports yield, there
    # are more, such as a load on held nodes. A load is identified by its control and free mass.
    factors = terms.load_factors.tolist()
    load_indices = [factors.index(row) for row in held_terms.load_factors.tolist()]
    outputs = terms.outputs.T @ case.full_solution(terms.loads[:, load_indices])
    displacements = structure.basis @ structure.static(structure.basis.T @ model.whole_load.T)
    # the reduced model also has accelerations, after the strains and displacements
    reduced_outputs = model.whole_output[: len(outputs)] @ displacements
    largest_error = 0.0
    for group in terms.groups:
        largest_by_load = np.abs(outputs[group]).max(axis=0)
        difference_by_load = np.abs(reduced_outputs[group] - outputs[group]).max(axis=0)
        has_response = largest_by_load > 0.0
        errors = difference_by_load[has_response] / largest_by_load[has_response]
        largest_error = max(largest_error, float(errors.max(initial=0.0)))
    return largest_error


def _error_of_frequencies(case: ChangedCase, shapes: FloatArray) -> float:
    """Return the largest relative change of a frequency by a step of inverse iteration.

    The step is made with the full model, from the reduced shapes phi (n', M) to improved ones u:
    K u = M phi. The Rayleigh quotient of u is omega^2 = u^T K u / u^T M u = u^T M phi / u^T M u.
    """
    inertia = case.mass @ shapes
    improved_shapes = case.full_solution(inertia)
    stiffness_products = np.sum(improved_shapes * inertia, axis=0)
    mass_products = np.sum(improved_shapes * (case.mass @ improved_shapes), axis=0)
    squared_angular_frequency = stiffness_products / mass_products
    frequency = np.sqrt(squared_angular_frequency) / (2.0 * np.pi)
    return float(np.abs(case.structure.modes.frequency / frequency - 1.0).max())
