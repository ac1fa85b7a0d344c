"""A reduced model of the wing near one set of parameters, with derivatives.

One factorisation for each fitted state of health gives the solution of the turn and the adjoint
solutions of all gauges. That of the healthy state also gives the static test, the modes, and the
derivatives of all these in e. On the basis of these vectors, outputs and their first derivatives
are those of the full model.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

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
"""Directions of the static basis below this fraction of the largest energy are dropped."""
DEPENDENT_MODES = 1e-9
"""Directions of the modal basis below this fraction are dropped: the mass must stay definite."""
STEP = 5e-3
"""Step of the central differences in prior standard deviations."""
_SERVO_COUNT = 2


@dataclass(frozen=True, eq=False)
class LocalModel:
    """The wing at one set of parameters and near it.

    Attributes
    ----------
    design : WingDesign
        The design with these parameters.
    values : (P,) array
        Values of the parameters, each in its unit.
    wing : ReducedWing
        Operators at these values, and their derivatives per unit of each parameter.
    unknowns : int
        Number of free unknowns of the full model.
    mode_order : tuple of int
        Numbers of the two flapwise bending modes among all modes, from 0.
    frequency : (m,) array
        Lowest frequencies [Hz] at the reference state.
    """

    design: WingDesign
    values: FloatArray
    wing: ReducedWing
    unknowns: int
    mode_order: tuple[int, int]
    frequency: FloatArray

    def at(self, values: FloatArray) -> ReducedWing:
        """Return the wing at other values (P,) of the parameters."""
        return self.wing.at(values - self.values)


def build_local_model(
    design: WingDesign, parameters: Sequence[FreeParameter], progress: Progress | None = None
) -> LocalModel:
    """Factorise the full model at a design and project it and its derivatives.

    Parameters
    ----------
    design : WingDesign
        The design at which the model is built.
    parameters : sequence of FreeParameter
        Parameters of the derivatives; none for values alone.
    progress : Progress, optional
        Receives the name of each parameter when it is done.

    Raises
    ------
    IdentificationError
        If neither side of a parameter can be reached by a small step.
    """
    operators = assemble(design)
    bases = _bases(operators)
    pieces = wing_pieces(design)
    terms = reduced(pieces, bases.static, bases.modal)
    values = values_of(design, parameters)
    slopes = []
    stages = progress or SilentProgress()
    with stages.stage("Derivatives", total=len(parameters), unit="numbers") as stage:
        for parameter, value in zip(parameters, values.tolist(), strict=True):
            slopes.append(_derivative(pieces, parameter, value, bases))
            stage.advance(detail=parameter.name)
    return LocalModel(
        design=design,
        values=values,
        wing=ReducedWing(terms, terms.stack_of(slopes), bases.bending),
        unknowns=operators.unknowns,
        mode_order=bases.mode_order,
        frequency=bases.frequency,
    )


class _Bases(NamedTuple):
    """Bases of a local model, and the modes of its design.

    Attributes
    ----------
    static, modal : (n, N) and (n, m) arrays
        Static and modal basis on the free unknowns.
    bending : (m, 2) array
        Shapes of the two flapwise bending modes on the modal basis.
    mode_order : tuple of int
        Numbers of the two flapwise bending modes among all modes, from 0.
    frequency : (6,) array
        Lowest frequencies [Hz].
    """

    static: FloatArray
    modal: FloatArray
    bending: FloatArray
    mode_order: tuple[int, int]
    frequency: FloatArray


def _derivative(
    pieces: WingPieces, parameter: FreeParameter, value: float, bases: _Bases
) -> ReducedTerms:
    """Return the derivatives of the projected operators in one parameter.

    They are central differences, or one-sided ones if a wing cannot be built on one side.

    Parameters
    ----------
    pieces : WingPieces
        The wing.
    parameter : FreeParameter
        The parameter.
    value : float
        Value of the parameter in the design of the wing, in its unit.
    bases : _Bases
        Static and modal basis.

    Raises
    ------
    IdentificationError
        If a wing can be built on neither side.
    """
    step = STEP * float(deviations([parameter]).item())
    sides = []
    offsets = []
    refusal = ""
    for offset in (step, -step):
        moved_value = np.array([value + offset])
        try:
            design = with_values(pieces.design, [parameter], moved_value)
            sides.append(wing_pieces(design, pieces))
            offsets.append(offset)
        except (FiniteElementError, IdentificationError) as error:
            refusal = str(error)
    if not sides:
        raise IdentificationError(f"'{parameter.name}' cannot be moved from {value:g}: {refusal}")
    if len(sides) == 1:
        sides.append(pieces)
        offsets.append(0.0)
    first_side, second_side = sides
    first_offset, second_offset = offsets
    difference = reduced_difference(first_side, second_side, bases.static, bases.modal)
    return difference.scaled(1.0 / (first_offset - second_offset))


def _bases(operators: AffineOperators) -> _Bases:
    """Return the bases of the local model of a wing."""
    factor = {"young_modulus_factor": LIBRARY_FACTOR}
    healthy = Factorisation(operators.stiffness(factor))
    static = _static_basis(operators, healthy, factor)

    # Modes at the reference masses
    servo = (MASS_TOTAL - REFERENCE_PITOT) / _SERVO_COUNT
    stiffness = operators.stiffness()
    mass = operators.mass(point_masses(servo, REFERENCE_PITOT))
    eigenvalues, shapes = lowest_eigenpairs(stiffness.tocsc(), mass.tocsc(), MODE_COUNT)
    first, second = most_compliant_modes(operators.load_tip, eigenvalues, shapes)
    mode_order = (int(first), int(second))
    bending = shapes[:, mode_order]

    # Changes of the modes with e or a mass. A change x solves (K - w^2 M) x = image. Two terms of
    # K^-1 (1 + w^2 M K^-1 + ...) are taken: their ratio is small because the lowest modes
    # themselves are in the basis, and derivatives of slopes need the second term.
    skin = operators.stiffness_terms[0].matrix
    mass_images = [term @ bending for term in operators.mass_terms[1:]]
    images = np.hstack([skin @ bending, *mass_images])
    changes = healthy.riesz(images)
    inertial_changes = healthy.riesz(mass @ changes)
    second_changes = healthy.riesz(skin @ changes[:, : len(mode_order)])
    columns = np.hstack([shapes, changes, inertial_changes, second_changes])
    modal = _orthonormal(columns, stiffness, DEPENDENT_MODES)
    return _Bases(
        static=static,
        modal=modal,
        # The basis is orthonormal in the stiffness.
        bending=modal.T @ (stiffness @ bending),
        mode_order=mode_order,
        frequency=np.sqrt(eigenvalues) / (2.0 * np.pi),
    )


def _static_basis(
    operators: AffineOperators, healthy: Factorisation, factor: dict[str, float]
) -> FloatArray:
    """Return the basis (n, N) of solutions and adjoint solutions.

    Parameters
    ----------
    operators : AffineOperators
        The wing.
    healthy : Factorisation
        Factorised stiffness of the healthy wing at the factor.
    factor : dict
        Factor e of the library, as a value of the operators.
    """
    skin = operators.stiffness_terms[0].matrix
    gauges = operators.gauge_output.toarray().T
    columns = []
    for first, second in np.argwhere(fitted_states()):
        loss = (LEVELS[first], LEVELS[second])
        damaged = Factorisation(operators.stiffness(factor, loss))
        columns.append(damaged.riesz(np.column_stack([operators.load_lift, gauges])))
    # The healthy wing, with first derivatives in e, and second ones of both loads
    loads = [operators.load_tip, operators.load_lift]
    solutions = healthy.riesz(np.column_stack([*loads, gauges]))
    first_changes = healthy.riesz(skin @ solutions)
    second_changes = healthy.riesz(skin @ first_changes[:, : len(loads)])
    columns += [solutions, first_changes, second_changes]
    return _orthonormal(np.hstack(columns), operators.stiffness(factor), DEPENDENT)


def _orthonormal(columns: FloatArray, stiffness: sparse.csr_array, dependent: float) -> FloatArray:
    """Return a basis of the same space that is orthonormal in the energy.

    Parameters
    ----------
    columns : (n, c) array
        Vectors that span the space.
    stiffness : csr (n, n)
        Stiffness, whose energy is the scalar product.
    dependent : float
        Directions below this fraction of the largest energy are dropped.
    """
    lengths = np.sqrt(np.einsum("ij,ij->j", columns, stiffness @ columns))
    unit_columns = columns / lengths
    eigenvalues, vectors = np.linalg.eigh(unit_columns.T @ (stiffness @ unit_columns))
    is_independent = eigenvalues > dependent * eigenvalues[-1]
    scaled_vectors = vectors[:, is_independent] / np.sqrt(eigenvalues[is_independent])
    return np.asarray(unit_columns @ scaled_vectors)
