"""The arrays of a reduced structure: what they are, their shapes, checked, and the file that keeps them.

Last the certified static solution online, of arrays laid out for the fewest operations in an evaluation; the
equations are in `docs/reduced_model.md`. NumPy and relative imports only: this file is copied into the FMU.
"""

from dataclasses import dataclass
from functools import cached_property
from math import inf, sqrt
from typing import Annotated

import numpy as np
from numpy import einsum
from numpy.linalg import solve

from .arrays import FloatArray, IntArray, KeptArrays
from .state import Losses


@dataclass(frozen=True, repr=False)
class ReducedArrays(KeptArrays):
    """Affine dense matrices, outputs, modal data, error bound and ranges of a reduced structure, with names.

    What can be chosen are the parameters, the losses of the damage regions, the free masses [kg] and the
    controls, in this order; `chosen` names them. Outputs are the gauges [1], the displacements [m] and, of
    the modes alone, the accelerations [m/s^2].

    T stiffness terms, of which the last is always times one, 1 + P mass terms (the structure, then 1 kg of
    each free mass), L loads and O outputs, of which the first O' are static.

    Attributes
    ----------
    name : str
        Of the structure.
    parameters, masses, controls : tuple of str
        Their names.
    control_units : tuple of str
        Unit of each control.
    gauges, displacements, accelerations : tuple of str
        Names of the outputs.
    nominal : (V,) ndarray
        Nominal value of all that can be chosen; zero for the losses.
    damping : (2,) ndarray
        Rayleigh's alpha [1/s] and beta [s].
    stiffness_factors : (T, 2) ndarray of int64
        Parameter and damage region that each stiffness term is times, counted from one; zero for none.
    load_factors : (L, 2) ndarray of int64
        The control and the free mass that each load is times, counted from one; zero for none.
    mode_count : int
        Number of modes M that `modes` returns.
    followed_shapes : (F, Nm) ndarray
        Shapes in the modal basis by which modes are followed, of a wing its first two flapwise bendings.
    validity_box : (V, 2) ndarray
        Least and largest value of each quantity that can be chosen, SI units.
    static_stiffness : (T, N, N) ndarray
        Stiffness terms in the static basis.
    static_load : (L, N) ndarray
        Loads in the static basis.
    static_output : (O', N) ndarray
        Outputs of the static basis vectors.
    bound_reference : (T - 1,) ndarray
        Coefficients of the stiffness terms whose sum is the norm of the error bound; the last is one.
    residual_load : (R, L) ndarray
        Loads in an orthonormal basis of the residuals (norm dual to the one of `bound_reference`), without
        the norm's own images of the static basis, along which a solution leaves nothing.
    residual_stiffness : (R, T - 1, N) ndarray
        Stiffness terms times static basis vectors, in the same basis: the residual is that of the loads less
        the changes of the coefficients from `bound_reference` times these.
    residual_allowance : float
        Bound of what that basis leaves out of a residual, per unit length of the reduced coordinates.
    rounding_allowance : float
        Part of the norm of the strains, and of displacements, added to the bounds for rounding: a
        multiple of the difference seen where the reduced model holds the full solution itself.
    dual_split : (K,) or (0,) ndarray
        Value of each loss at which the second of two anchors along it takes over; A = 2^K, or one. At each, M
        dual functions of an output are combined to its approximate dual solution.
    dual_correction : (A, M, O', R) ndarray
        Dual functions, applied to the basis of the residuals; the anchors of the last region change first.
    dual_residual : (A, O', F, 1 + T M) ndarray
        Factors of the dual residuals: their norm is that of the factor times (1, -theta_1 c, -theta_2 c,
        ...), with the coefficients theta of the stiffness terms and c (M,) of the functions.
    dual_stiffness : (A, O', T, M, M) ndarray
        Stiffness terms in the dual functions of each output.
    dual_output : (A, O', M) ndarray
        Each output of its dual functions.
    modal_stiffness : (T, Nm, Nm) ndarray
        Stiffness terms in the modal basis.
    modal_mass : (1 + P, Nm, Nm) ndarray
        Mass terms in the modal basis.
    modal_load : (L, Nm) ndarray
        Loads in the modal basis.
    modal_output : (O, Nm) ndarray
        Outputs of the modal basis vectors.
    cross_mass : (1 + P, Nm, N) ndarray
        Mass terms between the modal and the static basis.
    """

    what = "a reduced model"
    version = 7

    name: str
    parameters: tuple[str, ...]
    masses: tuple[str, ...]
    controls: tuple[str, ...]
    control_units: tuple[str, ...]
    gauges: tuple[str, ...]
    displacements: tuple[str, ...]
    accelerations: tuple[str, ...]
    nominal: Annotated[FloatArray, "chosen"]
    damping: Annotated[FloatArray, 2]
    stiffness_factors: Annotated[IntArray, "terms", 2]
    load_factors: Annotated[IntArray, "loads", 2]
    mode_count: int
    followed_shapes: Annotated[FloatArray, "followed", "modal"]
    validity_box: Annotated[FloatArray, "chosen", 2]
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
            self.refuse(f"with {modal} modal basis vectors cannot have {self.mode_count} modes")
        regions, masses = (len(self.parameters), len(self.regions)), (len(self.controls), len(self.masses))
        for name, known in (("stiffness_factors", regions), ("load_factors", masses)):
            array = getattr(self, name)
            if array.min(initial=0) < 0 or np.any(array > known):
                self.refuse(f"names by its array {name} what is not there")
        if self.stiffness_factors[-1].any() or len(self.control_units) != len(self.controls):
            self.refuse("has terms or units that are not those of its names")

    @cached_property
    def chosen(self) -> tuple[str, ...]:
        """Names of all that can be chosen: the rows of `validity_box`."""
        return (*self.parameters, *self.regions, *self.masses, *self.controls)

    @cached_property
    def static_count(self) -> int:
        """Number O' of gauges and displacements."""
        return len(self.gauges) + len(self.displacements)

    def _lengths(self) -> dict[str | int, int]:
        terms, masses = len(self.stiffness_factors), len(self.masses)
        return {
            "chosen": len(self.chosen),
            "terms": terms,
            "varied terms": terms - 1,
            "modal": self.modal_stiffness.shape[-1],
            "outputs": self.static_count,
            "all outputs": self.static_count + len(self.accelerations),
            "splits": len(self.regions) if self.dual_split.size else 0,
            "anchors": 2**self.dual_split.size,
            "dual columns": 1 + terms * self.dual_output.shape[-1],
            "masses": 1 + masses,
        }


class OnlineArrays:
    """T stiffness terms, L loads and O outputs in N basis vectors, with the arrays of the error bound.

    Parameters
    ----------
    arrays : ReducedArrays
        Arrays of the reduced model.

    Attributes
    ----------
    square : tuple of int
        (N, N).
    stiffness : (T, N N) ndarray
        Stiffness terms, flat.
    """

    def __init__(self, arrays: ReducedArrays) -> None:
        stiffness, residual = arrays.static_stiffness, arrays.residual_load
        self.square = stiffness.shape[1:]
        self.stiffness = np.ascontiguousarray(stiffness.reshape(len(stiffness), -1))
        self._load, self._output = arrays.static_load, arrays.static_output
        # times the loads, then the changes of the coefficients times the coordinates: the residual
        terms = arrays.residual_stiffness.reshape(len(residual), -1)
        self._residual = np.concatenate((residual, -terms), axis=1)
        self._allowance = arrays.residual_allowance
        self._reference = np.append(arrays.bound_reference, 1.0)
        self._splits = arrays.dual_split.tolist()
        of_terms = arrays.dual_stiffness.swapaxes(1, 2).reshape(len(arrays.dual_output), len(stiffness), -1)
        by_output = np.ascontiguousarray(arrays.dual_correction.swapaxes(1, 2))
        output = arrays.dual_output[..., np.newaxis]
        self._anchors = list(zip(of_terms, output, by_output, arrays.dual_residual, strict=True))
        self._last: tuple[object, tuple[FloatArray, FloatArray]] | None = None

    def _dual(self, theta: FloatArray, loss: Losses) -> tuple[FloatArray, FloatArray]:
        """Return dual solutions applied to the basis of residuals (O, R), and norms (O,) of what they leave.

        They are the Galerkin solutions of the outputs in their functions of the anchor at the losses.
        """
        last, key = self._last, (theta.tobytes(), loss)  # a course of loads meets the same health again
        if last is not None and last[0] == key:
            return last[1]
        number = 0
        for split, value in zip(self._splits, loss, strict=False):
            number = 2 * number + (value >= split)
        stiffness, output, corrections, factor = self._anchors[number]
        outputs, functions, _ = output.shape
        if functions == 1:  # stacks of single numbers are dear
            weights = output[:, 0] / (theta @ stiffness)[:, np.newaxis]
            left = factor[:, :, 0] - weights * (factor[:, :, 1:] @ theta)
            correction = weights * corrections[:, 0]
        else:
            weights = solve((theta @ stiffness).reshape(outputs, functions, functions), output)
            across = weights.transpose(0, 2, 1)
            coefficients = (-theta[:, np.newaxis] * across).reshape(outputs, -1, 1)
            left = factor[:, :, 0] + (factor[:, :, 1:] @ coefficients)[:, :, 0]
            correction = (across @ corrections)[:, 0]
        found = correction, np.sqrt(einsum("ij,ij->i", left, left))
        self._last = key, found
        return found

    def solution(
        self, theta: FloatArray, load: FloatArray, loss: Losses
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return coordinates (N,), outputs (O,) and certified bounds (O,) of their errors, rounding left out.

        Parameters
        ----------
        theta : (T,) ndarray
            Coefficients of the stiffness terms.
        load : (L,) ndarray
            Coefficients of the loads.
        loss : tuple of float
            Stiffness losses of the damage regions, by which the anchor is chosen.
        """
        stiffness = (theta @ self.stiffness).reshape(self.square)
        coordinates = np.asarray(solve(stiffness, load @ self._load), dtype=np.float64)

        # |l(u) - l(u_N)| = |psi(r)| <= |psi_N(r)| + |r| |l - K psi_N| / alpha, norms dual to the reference
        change = (theta - self._reference)[:-1]
        residual = self._residual @ np.concatenate((load, np.multiply.outer(change, coordinates).ravel()))
        correction, dual = self._dual(theta, loss)
        coercivity = min((theta / self._reference).tolist())
        outside = self._allowance * sqrt(coordinates @ coordinates)
        remainder = (sqrt(residual @ residual) + outside) / coercivity
        return coordinates, self._output @ coordinates, remainder * dual + np.abs(correction @ residual)
