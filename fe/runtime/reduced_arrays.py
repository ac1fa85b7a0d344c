"""The stored arrays of a reduced structure, and its certified static solution.

The equations are in `docs/explanation/reduced_model.md`. NumPy and relative imports only: this
file is copied into the FMU.
"""

from dataclasses import dataclass
from functools import cached_property
from math import inf, sqrt
from typing import Annotated, NamedTuple

import numpy as np
from numpy import einsum
from numpy.linalg import solve

from .arrays import FloatArray, IntArray, StoredArrays
from .state import Losses


@dataclass(frozen=True, repr=False)
class ReducedArrays(StoredArrays):
    """The stored arrays of a reduced structure.

    They are its affine matrices, outputs, modal data, error bound and ranges.

    The inputs of the model are the V values that a caller may choose: the parameters, the losses of
    the damage regions, the free masses [kg] and the controls, in this order. Outputs are the gauges
    [1], the displacements [m] and, of the modes alone, the accelerations [m/s^2].

    There are T stiffness terms, of which the last always has the coefficient one; 1 + P mass terms
    (the structure, then 1 kg of each free mass); L loads; and O outputs, of which the first O' are
    static.

    Attributes
    ----------
    parameters, masses, controls : tuple of str
        Names of these inputs.
    control_units : tuple of str
        Unit of each control.
    gauges, displacements, accelerations : tuple of str
        Names of the outputs.
    nominal : (V,) array
        Nominal value of each input; zero for the losses.
    damping : (2,) array
        Rayleigh's alpha [1/s] and beta [s].
    stiffness_factors : (T, 2) array of int64
        Parameter and damage region whose values multiply each stiffness term, counted from one;
        zero for none.
    load_factors : (L, 2) array of int64
        Control and free mass whose values multiply each load, counted from one; zero for none.
    mode_count : int
        Number of modes M that `ReducedModel.modes` returns.
    followed_shapes : (F, Nm) array
        Shapes in the modal basis that modes are compared with; of a wing its first two flapwise
        bendings.
    validity_box : (V, 2) array
        Least and largest value of each input, SI units.
    static_stiffness : (T, N, N) array
        Stiffness terms in the static basis.
    static_load : (L, N) array
        Loads in the static basis.
    static_output : (O', N) array
        Outputs of the static basis vectors.
    bound_reference : (T - 1,) array
        Coefficients of the stiffness terms whose sum is the norm of the error bound; the last is
        one.
    residual_load : (R, L) array
        Loads in an orthonormal basis of the residuals (in the norm dual to that of
        `bound_reference`), without the norm's own images of the static basis, along which no
        residual remains.
    residual_stiffness : (R, T - 1, N) array
        Stiffness terms times static basis vectors, in the same basis. The residual is that of the
        loads minus the changes of the coefficients from `bound_reference` times these.
    residual_allowance : float
        Bound of the part of the residual outside of that basis, per unit length of the reduced
        coordinates.
    rounding_allowance : float
        Fraction of the norm of the strains, and of displacements, that is added to the bounds for
        rounding: a multiple of the difference measured at states whose full solutions are in the
        basis.
    dual_split : (K,) or (0,) array
        Value of each loss at which the second of two anchors along it takes over; A = 2^K anchors,
        or one. At each, M dual functions of an output are combined to its approximate dual
        solution.
    dual_correction : (A, M, O', R) array
        Dual functions, applied to the basis of the residuals; the anchors of the last region change
        first.
    dual_residual : (A, O', F, 1 + T M) array
        Factors of the dual residuals. Their norm is that of the factor times (1, -theta_1 c,
        -theta_2 c, ...), with the coefficients theta of the stiffness terms and c (M,) of the
        functions.
    dual_stiffness : (A, O', T, M, M) array
        Stiffness terms in the dual functions of each output.
    dual_output : (A, O', M) array
        Each output of its dual functions.
    modal_stiffness : (T, Nm, Nm) array
        Stiffness terms in the modal basis.
    modal_mass : (1 + P, Nm, Nm) array
        Mass terms in the modal basis.
    modal_load : (L, Nm) array
        Loads in the modal basis.
    modal_output : (O, Nm) array
        Outputs of the modal basis vectors.
    cross_mass : (1 + P, Nm, N) array
        Mass terms between the modal and the static basis.
    """

    record_name = "a reduced model"
    version = 7

    name: str
    parameters: tuple[str, ...]
    masses: tuple[str, ...]
    controls: tuple[str, ...]
    control_units: tuple[str, ...]
    gauges: tuple[str, ...]
    displacements: tuple[str, ...]
    accelerations: tuple[str, ...]
    nominal: Annotated[FloatArray, "inputs"]
    damping: Annotated[FloatArray, 2]
    stiffness_factors: Annotated[IntArray, "terms", 2]
    load_factors: Annotated[IntArray, "loads", 2]
    mode_count: int
    followed_shapes: Annotated[FloatArray, "followed", "modal"]
    validity_box: Annotated[FloatArray, "inputs", 2]
    static_stiffness: Annotated[FloatArray, "terms", "static", "static"]
    static_load: Annotated[FloatArray, "loads", "static"]
    static_output: Annotated[FloatArray, "outputs", "static"]
    bound_reference: Annotated[FloatArray, "varied terms"]
    residual_load: Annotated[FloatArray, "residual", "loads"]
    residual_stiffness: Annotated[FloatArray, "residual", "varied terms", "static"]
    residual_allowance: Annotated[float, 0.0, inf]
    rounding_allowance: Annotated[float, 0.0, inf]
    dual_split: Annotated[FloatArray, "splits"]
    dual_correction: Annotated[FloatArray, "anchors", "functions", "outputs", "residual"]
    dual_residual: Annotated[FloatArray, "anchors", "outputs", "dual rows", "dual columns"]
    dual_stiffness: Annotated[FloatArray, "anchors", "outputs", "terms", "functions", "functions"]
    dual_output: Annotated[FloatArray, "anchors", "outputs", "functions"]
    modal_stiffness: Annotated[FloatArray, "terms", "modal", "modal"]
    modal_mass: Annotated[FloatArray, "masses", "modal", "modal"]
    modal_load: Annotated[FloatArray, "loads", "modal"]
    modal_output: Annotated[FloatArray, "all outputs", "modal"]
    cross_mass: Annotated[FloatArray, "masses", "modal", "static"]

    def __post_init__(self) -> None:
        super().__post_init__()
        modal = self.modal_stiffness.shape[1]
        if not 1 <= self.mode_count <= modal:
            raise self._error(
                f"with {modal} modal basis vectors cannot have {self.mode_count} modes"
            )
        stiffness_names = (len(self.parameters), len(self.regions))
        load_names = (len(self.controls), len(self.masses))
        self._check_factors("stiffness_factors", self.stiffness_factors, stiffness_names)
        self._check_factors("load_factors", self.load_factors, load_names)
        has_factor_of_last_term = bool(self.stiffness_factors[-1].any())
        if has_factor_of_last_term or len(self.control_units) != len(self.controls):
            raise self._error("has terms or units that do not fit its names")

    def _check_factors(self, name: str, factors: IntArray, counts: tuple[int, int]) -> None:
        """Raise `ReducedModelFileError` if factors (k, 2) exceed the counts of their names."""
        if factors.min(initial=0) < 0 or np.any(factors > counts):
            raise self._error(f"has an array {name} that names something that does not exist")

    @cached_property
    def input_names(self) -> tuple[str, ...]:
        """Names of all inputs: the rows of `validity_box`."""
        return (*self.parameters, *self.regions, *self.masses, *self.controls)

    @cached_property
    def static_output_count(self) -> int:
        """Number O' of gauges and displacements."""
        return len(self.gauges) + len(self.displacements)

    def _axis_lengths(self) -> dict[str, int]:
        terms = len(self.stiffness_factors)
        return {
            "inputs": len(self.input_names),
            "terms": terms,
            "varied terms": terms - 1,
            "modal": self.modal_stiffness.shape[-1],
            "outputs": self.static_output_count,
            "all outputs": self.static_output_count + len(self.accelerations),
            "splits": len(self.regions) if self.dual_split.size else 0,
            "anchors": 2**self.dual_split.size,
            "dual columns": 1 + terms * self.dual_output.shape[-1],
            "masses": 1 + len(self.masses),
        }


class CertifiedSolution(NamedTuple):
    """A static solution in N basis vectors, with certified error bounds.

    Attributes
    ----------
    coordinates : (N,) array
        Coefficients of the basis vectors.
    outputs : (O,) array
        Gauges [1] and displacements [m].
    bounds : (O,) array
        Error bounds of the outputs, without rounding.
    """

    coordinates: FloatArray
    outputs: FloatArray
    bounds: FloatArray


class _Anchor(NamedTuple):
    """The dual functions of the O outputs that were made for one combination of losses.

    Attributes
    ----------
    stiffness : (T, O M M) array
        Stiffness terms in the functions of each output.
    output : (O, M, 1) array
        Each output of its functions.
    correction : (O, M, R) array
        Functions applied to the basis of the residuals.
    output_residual : (O, F) array
        Factor of the dual residual for the output itself, see `ReducedArrays.dual_residual`.
    term_residual : (O, F, T M) array
        Factors of the dual residual for the stiffness terms times the functions.
    """

    stiffness: FloatArray
    output: FloatArray
    correction: FloatArray
    output_residual: FloatArray
    term_residual: FloatArray


class _DualSolution(NamedTuple):
    """Approximate dual solutions of the outputs.

    Attributes
    ----------
    correction : (O, R) array
        The solutions, applied to the basis of the residuals.
    residual_norm : (O,) array
        Norms of their own residuals.
    """

    correction: FloatArray
    residual_norm: FloatArray


class CertifiedSolver:
    """The static solver of a reduced model, on arrays that are laid out for few operations.

    There are T stiffness terms, L loads and O outputs in N basis vectors.

    Attributes
    ----------
    square : tuple of int
        The shape (N, N).
    stiffness : (T, N N) array
        Stiffness terms, flat.
    """

    def __init__(self, arrays: ReducedArrays) -> None:
        stiffness = arrays.static_stiffness
        term_count = len(stiffness)
        self.square = stiffness.shape[1:]
        self.stiffness = np.ascontiguousarray(stiffness.reshape(term_count, -1))
        self._load = arrays.static_load
        self._output = arrays.static_output
        # this matrix gives the residual from the loads, followed by the products of changes of
        # coefficients and coordinates
        residual_terms = arrays.residual_stiffness.reshape(len(arrays.residual_load), -1)
        self._residual = np.concatenate((arrays.residual_load, -residual_terms), axis=1)
        self._allowance = arrays.residual_allowance
        self._reference = np.append(arrays.bound_reference, 1.0)
        # the dual functions, one anchor after the other
        self._splits = arrays.dual_split.tolist()
        anchor_count = len(arrays.dual_output)
        term_first = arrays.dual_stiffness.swapaxes(1, 2)
        flat_stiffness = term_first.reshape(anchor_count, term_count, -1)
        output_first = np.ascontiguousarray(arrays.dual_correction.swapaxes(1, 2))
        output = arrays.dual_output[..., np.newaxis]
        output_residual = np.ascontiguousarray(arrays.dual_residual[..., 0])
        term_residual = np.ascontiguousarray(arrays.dual_residual[..., 1:])
        self._anchors = [
            _Anchor(
                stiffness=flat_stiffness[number],
                output=output[number],
                correction=output_first[number],
                output_residual=output_residual[number],
                term_residual=term_residual[number],
            )
            for number in range(anchor_count)
        ]
        self._latest_dual: tuple[tuple[bytes, Losses], _DualSolution] | None = None

    def _dual_solution(self, theta: FloatArray, losses: Losses) -> _DualSolution:
        """Return the approximate dual solutions of the outputs in one state of the structure.

        They are Galerkin solutions in the basis of one of the anchors, the states for which such
        bases are stored: for each loss, the anchor on the same side of `dual_split`. The last
        solution is kept, since successive loads often act on a structure in the same state.
        """
        key = (theta.tobytes(), losses)
        if self._latest_dual is not None and self._latest_dual[0] == key:
            return self._latest_dual[1]
        number = 0
        for split, loss in zip(self._splits, losses, strict=False):
            number = 2 * number + int(loss >= split)
        anchor = self._anchors[number]
        one_function = anchor.output.shape[1] == 1
        solution = _one_dual_function(anchor, theta) if one_function else _combined(anchor, theta)
        self._latest_dual = (key, solution)
        return solution

    def solve(self, theta: FloatArray, load: FloatArray, losses: Losses) -> CertifiedSolution:
        """Return the static solution with certified error bounds.

        The bounds are derived in `docs/explanation/reduced_model.md`:

        |l(u) - l(u_N)| = |psi(r)| <= |psi_N(r)| + |r| |l - K psi_N| / alpha, with the residual r,
        the dual solution psi of the output l, and norms dual to that of the reference.

        Parameters
        ----------
        theta : (T,) array
            Coefficients of the stiffness terms.
        load : (L,) array
            Coefficients of the loads.
        losses : tuple of float
            Stiffness losses of the damage regions, which select the anchor of the dual functions.
        """
        stiffness = (theta @ self.stiffness).reshape(self.square)
        right_hand_side = load @ self._load
        coordinates = np.asarray(solve(stiffness, right_hand_side), dtype=np.float64)
        # residual of the solution
        change = (theta - self._reference)[:-1]
        changes = np.multiply.outer(change, coordinates).ravel()
        residual = self._residual @ np.concatenate((load, changes))
        neglected_residual = self._allowance * sqrt(coordinates @ coordinates)
        # Bounds of the outputs. For affine positive semi-definite terms the coercivity alpha in the
        # reference norm is at least the smallest ratio of coefficients (min-theta approach).
        dual = self._dual_solution(theta, losses)
        coercivity = min((theta / self._reference).tolist())
        error_norm = (sqrt(residual @ residual) + neglected_residual) / coercivity
        correction = np.abs(dual.correction @ residual)
        bounds = error_norm * dual.residual_norm + correction
        outputs = self._output @ coordinates
        return CertifiedSolution(coordinates, outputs, bounds)


def _one_dual_function(anchor: _Anchor, theta: FloatArray) -> _DualSolution:
    """Return the dual solutions if each output has one function, without stacked matrices."""
    stiffness = (theta @ anchor.stiffness)[:, np.newaxis]
    weights = anchor.output[:, 0] / stiffness
    residual = anchor.output_residual - weights * (anchor.term_residual @ theta)
    squared_norm = einsum("ij,ij->i", residual, residual)
    correction = weights * anchor.correction[:, 0]
    return _DualSolution(correction, np.sqrt(squared_norm))


def _combined(anchor: _Anchor, theta: FloatArray) -> _DualSolution:
    """Return the dual solutions as Galerkin combinations of each output's functions."""
    outputs, functions, _ = anchor.output.shape
    # Galerkin's equations of each output
    stiffness = (theta @ anchor.stiffness).reshape(outputs, functions, functions)
    weights = solve(stiffness, anchor.output).transpose(0, 2, 1)
    # norms of the residuals of the dual equations
    term_weights = -theta[:, np.newaxis] * weights
    coefficients = term_weights.reshape(outputs, -1, 1)
    term_residual = np.squeeze(anchor.term_residual @ coefficients, axis=-1)
    residual = anchor.output_residual + term_residual
    squared_norm = einsum("ij,ij->i", residual, residual)
    correction = np.squeeze(weights @ anchor.correction, axis=1)
    return _DualSolution(correction, np.sqrt(squared_norm))
