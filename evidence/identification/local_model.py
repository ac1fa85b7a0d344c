"""The wing near one set of parameters: bases of solutions, adjoints and modes, and derivatives on them.

One factorisation for each fitted state of health gives the solution of the turn and the adjoint solutions of
all gauges; the healthy one also gives the static test, the modes, and the derivatives of all these in e. On
the basis that they span, the model answers as the full model does, with the same first derivatives.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.full.factorisation import Factorisation, lowest_eigenpairs, most_compliant_modes
from fe.runtime.errors import FiniteElementError
from fe.wing.design import WingDesign
from fe.wing.operators import AffineOperators, assemble, point_masses
from reporting.progress import Progress, SilentProgress

from .errors import IdentificationError
from .parameters import FreeParameter, deviations, values_of, with_values
from .pieces import ReducedTerms, WingPieces, reduced, reduced_difference, wing_pieces
from .responses import ReducedWing
from .targets import LEVELS, LIBRARY_FACTOR, MASS_TOTAL, REFERENCE_PITOT, fitted_states

FloatArray = NDArray[np.float64]

MODE_COUNT = 6
DEPENDENT = 1e-11
"""Directions of the static basis whose share of the largest energy is below this are dropped."""
DEPENDENT_MODES = 1e-9
"""The same of the modal basis; the mass must stay definite on it."""
STEP = 5e-3
"""Step of the central differences in prior standard deviations."""


@dataclass(frozen=True, eq=False)
class LocalModel:
    """The wing at one set of parameters and near it.

    Attributes
    ----------
    design : WingDesign
        The design with these parameters.
    values : (P,)
        Their values, each in its unit.
    wing : ReducedWing
        Operators there and their derivatives per unit of each parameter.
    unknowns : int
        Free unknowns of the full model.
    mode_order : tuple of int
        Places of the two flapwise bending modes among all modes.
    frequency : (m,) Hz
        Lowest frequencies at the reference state.
    """

    design: WingDesign
    values: FloatArray
    wing: ReducedWing
    unknowns: int
    mode_order: tuple[int, int]
    frequency: FloatArray

    def at(self, values: FloatArray) -> ReducedWing:
        """Return the wing at other values (P,)."""
        return self.wing.at(values - self.values)


def build_local_model(
    design: WingDesign, parameters: Sequence[FreeParameter], progress: Progress | None = None
) -> LocalModel:
    """Factorise the full model at a design and project it and its derivatives.

    Parameters
    ----------
    design : WingDesign
        Where.
    parameters : sequence of FreeParameter
        In what to differentiate; none for values alone.
    progress : Progress, optional
        Told of each parameter.

    Raises
    ------
    IdentificationError
        If neither side of a parameter can be reached by a small step.
    """
    operators = assemble(design)
    static, modal, bending, order, frequency = _bases(operators)
    pieces = wing_pieces(design)
    terms = reduced(pieces, static, modal)
    values = values_of(design, parameters)
    slopes = []
    with (progress or SilentProgress()).stage("Derivatives", total=len(parameters), unit="numbers") as stage:
        for number in range(len(parameters)):
            slopes.append(_derivative(pieces, parameters, values, number, static, modal))
            stage.advance(detail=parameters[number].name)
    stacked = (np.stack(parts) for parts in zip(*slopes, strict=True))
    derivatives = (
        ReducedTerms(*stacked) if slopes else ReducedTerms(*(np.empty((0, *part.shape)) for part in terms))
    )
    return LocalModel(
        design=design,
        values=values,
        wing=ReducedWing(terms, derivatives, bending),
        unknowns=operators.unknowns,
        mode_order=order,
        frequency=frequency,
    )


def _derivative(
    pieces: WingPieces,
    parameters: Sequence[FreeParameter],
    values: FloatArray,
    number: int,
    static: FloatArray,
    modal: FloatArray,
) -> ReducedTerms:
    """Central difference of the projected operators; one-sided where one side cannot be built."""
    step = STEP * float(deviations(parameters)[number])
    sides, places, failed = [], [], ""
    for sign in (1.0, -1.0):
        moved = values[number : number + 1] + sign * step
        try:
            design = with_values(pieces.design, parameters[number : number + 1], moved)
            sides.append(wing_pieces(design, pieces))
            places.append(sign * step)
        except (FiniteElementError, IdentificationError) as error:
            failed = str(error)
    if not sides:
        raise IdentificationError(
            f"'{parameters[number].name}' cannot be moved from {values[number]:g}: {failed}"
        )
    if len(sides) == 1:
        sides.append(pieces)
        places.append(0.0)
    return reduced_difference(sides[0], sides[1], static, modal).scaled(1.0 / (places[0] - places[1]))


def _bases(
    operators: AffineOperators,
) -> tuple[FloatArray, FloatArray, FloatArray, tuple[int, int], FloatArray]:
    """Return static (n, N) and modal (n, m) basis, bending shapes (m, 2), their places, frequencies."""
    skin, factor = operators.stiffness_terms[0].matrix, {"young_modulus_factor": LIBRARY_FACTOR}
    columns = []
    outputs = operators.gauge_output.toarray().T
    for i, j in np.argwhere(fitted_states()):
        factors = Factorisation(operators.stiffness(factor, (LEVELS[i], LEVELS[j])))
        columns.append(factors.riesz(np.column_stack([operators.load_lift, outputs])))
    healthy = Factorisation(operators.stiffness(factor))
    first = healthy.riesz(np.column_stack([operators.load_tip, operators.load_lift, outputs]))
    second = healthy.riesz(skin @ first)
    third = healthy.riesz(skin @ second[:, :2])
    static = _orthonormal(np.hstack([*columns, first, second, third]), operators.stiffness(factor), DEPENDENT)

    servo = 0.5 * (MASS_TOTAL - REFERENCE_PITOT)
    stiffness, mass = operators.stiffness(), operators.mass(point_masses(servo, REFERENCE_PITOT))
    eigenvalues, shapes = lowest_eigenpairs(stiffness.tocsc(), mass.tocsc(), MODE_COUNT)
    places = most_compliant_modes(operators.load_tip, eigenvalues, shapes)
    order = int(places[0]), int(places[1])
    bending = shapes[:, list(order)]
    # What the modes become when e or a mass changes a little.
    images = np.hstack([skin @ bending, *(term @ bending for term in operators.mass_terms[1:])])
    # A change of a mode solves (K - w^2 M) x = image: two terms of K^-1 (1 + w^2 M K^-1 + ...), whose ratio
    # is
    # small because the lowest modes themselves are in the basis. Derivatives of slopes need the second one.
    changed = healthy.riesz(images)
    inertial = healthy.riesz(mass @ changed)
    again = healthy.riesz(skin @ changed[:, :2])
    modal = _orthonormal(np.hstack([shapes, changed, inertial, again]), stiffness, DEPENDENT_MODES)
    on_basis = modal.T @ (stiffness @ bending)  # the basis is orthonormal in the stiffness
    return static, modal, on_basis, order, np.sqrt(eigenvalues) / (2.0 * np.pi)


def _orthonormal(columns: FloatArray, stiffness: sparse.csr_array, dependent: float) -> FloatArray:
    """Basis of the same space, orthonormal in the energy, without dependent directions."""
    energy = np.sqrt(np.einsum("ij,ij->j", columns, stiffness @ columns))
    columns = columns / energy
    values, vectors = np.linalg.eigh(columns.T @ (stiffness @ columns))
    kept = values > dependent * values[-1]
    return np.asarray(columns @ (vectors[:, kept] / np.sqrt(values[kept])))
