"""A structure with one change, as full and as reduced model, and the error of the latter."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.runtime.arrays import FloatArray
from fe.runtime.changeable import ChangeableModel, ChangedStructure

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

    The error of a frequency is its change by one step of inverse iteration with the full model.

    Parameters
    ----------
    terms, held_terms : ReductionTerms
        Terms of the structure whose supports yield, and of the one whose supports are held.
    shapes : (n', M) array
        The reduced mode shapes on all unknowns.
    """
    structure = case.structure
    # statics: outputs (O, L) of the full and of the reduced model under each load
    factors = terms.load_factors.tolist()
    load_numbers = [factors.index(row) for row in held_terms.load_factors.tolist()]
    outputs = terms.outputs.T @ case.full_solution(terms.loads[:, load_numbers])
    displacements = structure.basis @ structure.static(structure.basis.T @ model.whole_load.T)
    reduced_outputs = model.whole_output[: len(outputs)] @ displacements
    largest_error = 0.0
    for group in terms.groups:
        largest = np.abs(outputs[group]).max(axis=0)
        difference = np.abs(reduced_outputs[group] - outputs[group]).max(axis=0)
        responds = largest > 0.0
        largest_error = max(
            largest_error, float((difference[responds] / largest[responds]).max(initial=0.0))
        )
    # Frequencies: with the shapes improved by inverse iteration, K u = M phi, the Rayleigh quotient
    # is omega^2 = u^T K u / u^T M u = u^T M phi / u^T M u.
    inertia = case.mass @ shapes
    improved_shapes = case.full_solution(inertia)
    stiffness_products = np.sum(improved_shapes * inertia, axis=0)
    mass_products = np.sum(improved_shapes * (case.mass @ improved_shapes), axis=0)
    squares = stiffness_products / mass_products
    frequency = np.sqrt(squares) / (2.0 * np.pi)
    frequency_errors = np.abs(structure.modes.frequency / frequency - 1.0)
    return max(largest_error, float(frequency_errors.max()))
