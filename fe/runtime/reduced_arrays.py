"""The arrays of a reduced structure: what they are, their shapes, checked, and the file that keeps them.

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import inf
from typing import Annotated, ClassVar

import numpy as np

from .arrays import FloatArray, IntArray
from .errors import ReducedModelFileError
from .kept_arrays import KeptArrays
from .state import MOST_REGIONS, Losses, losses_of

MOST_ANCHORS = 16
"""Largest number of approximate dual solutions of a reduced model."""


@dataclass(frozen=True, repr=False)
class RegionArrays(KeptArrays):
    """Arrays of a structure with K damage regions, 1 to 8.

    Attributes
    ----------
    regions : tuple of str
        Names of the damage regions in the order of their stiffness terms.
    """

    regions: tuple[str, ...]

    def losses(self, stiffness_loss: Mapping[str, float] | Iterable[float]) -> Losses:
        """Return one stiffness loss for each region, in their order; see `fe.runtime.state.losses_of`."""
        return losses_of(stiffness_loss, self.regions)

    def __post_init__(self) -> None:
        if not 1 <= len(self.regions) <= MOST_REGIONS:
            raise ReducedModelFileError(
                f"{self.what.capitalize()} must have 1 to {MOST_REGIONS} damage regions, but names "
                f"{len(self.regions)}; build it anew."
            )
        super().__post_init__()


@dataclass(frozen=True, repr=False)
class ReducedArrays(RegionArrays):
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
        Loads in an orthonormal basis of the residuals (norm dual to the one of `bound_reference`). Its first
        N directions are the norm's own images of the static basis, along which a solution leaves nothing.
    residual_stiffness : (R, T - 1, N) ndarray
        Stiffness terms times static basis vectors, in the same basis: the residual is that of the loads less
        the changes of the coefficients from `bound_reference` times these.
    residual_allowance : float
        Bound of what that basis leaves out of a residual, per unit length of the reduced coordinates.
    rounding_allowance : float
        Part of the norm of the strains, and of displacements, added to the bounds for rounding: a
        multiple of the difference seen where the reduced model holds the full solution itself.
    dual_counts : (K,) ndarray of int64
        Number of approximate dual solutions along each loss; their product is A, at most 16. One along each
        where the M dual functions of an output are combined instead.
    dual_split : (sum of dual_counts less K,) ndarray
        Values of the losses at which the next approximate dual solution takes over, region by region.
    dual_correction : (A or M, O', R) ndarray
        Approximate dual solutions, applied to the basis of the residuals; the last region's change first.
    dual_residual : (A, O', T, T) or (1, O', F, 1 + T M) ndarray
        Factors of the dual residuals: their norm is that of the factor times (1, -theta_1, -theta_2, ...),
        with the coefficients theta of all stiffness terms but the last, which is times one. Of combined
        functions: times (1, -theta_1 c, -theta_2 c, ...), with their coefficients c (M,) in the solution.
    dual_stiffness : (O', T, M, M) ndarray
        Stiffness terms in the dual functions of each output; M is 0 where none are combined.
    dual_output : (O', M) ndarray
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
    layout: ClassVar[Mapping[str, int]] = {"format": 6}

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
    dual_counts: Annotated[IntArray, "regions"]
    dual_split: Annotated[FloatArray, "splits"]
    dual_correction: Annotated[FloatArray, "duals", "outputs", "residual"]
    dual_residual: Annotated[FloatArray, "anchors", "outputs", "dual rows", "dual columns"]
    dual_stiffness: Annotated[FloatArray, "outputs", "terms", "functions", "functions"]
    dual_output: Annotated[FloatArray, "outputs", "functions"]
    modal_stiffness: Annotated[FloatArray, "terms", "modal", "modal"]
    modal_mass: Annotated[FloatArray, "masses", "modal", "modal"]
    modal_load: Annotated[FloatArray, "loads", "modal"]
    modal_output: Annotated[FloatArray, "all outputs", "modal"]
    cross_mass: Annotated[FloatArray, "masses", "modal", "static"]

    def __post_init__(self) -> None:
        counts = self.dual_counts
        if (
            counts.dtype != np.int64
            or counts.ndim != 1
            or not 1 <= counts.min(initial=1) <= counts.prod() <= MOST_ANCHORS
        ):
            raise ReducedModelFileError(
                f"A reduced model must have 1 to {MOST_ANCHORS} approximate dual solutions, at least one "
                f"along each loss, but has {counts.tolist()}; build it anew."
            )
        super().__post_init__()
        if not 1 <= self.mode_count <= self.modal_stiffness.shape[1]:
            raise ReducedModelFileError(
                f"A reduced model with {self.modal_stiffness.shape[1]} modal basis vectors cannot have "
                f"{self.mode_count} modes; build the model anew."
            )
        for name, known in (
            ("stiffness_factors", (len(self.parameters), len(self.regions))),
            ("load_factors", (len(self.controls), len(self.masses))),
        ):
            array = getattr(self, name)
            if array.min(initial=0) < 0 or np.any(array > known):
                raise ReducedModelFileError(
                    f"The array {name} of {self.what} names what is not there; build it anew."
                )
        if self.stiffness_factors[-1].any() or len(self.control_units) != len(self.controls):
            raise ReducedModelFileError(
                f"The terms or units of {self.what} are not those of its names; build it anew."
            )

    @cached_property
    def chosen(self) -> tuple[str, ...]:
        """Names of all that can be chosen: the rows of `validity_box`."""
        return (*self.parameters, *self.regions, *self.masses, *self.controls)

    @cached_property
    def static_count(self) -> int:
        """Number O' of gauges and displacements."""
        return len(self.gauges) + len(self.displacements)

    def _lengths(self) -> dict[str | int, int]:
        terms, masses, regions = len(self.stiffness_factors), len(self.masses), len(self.regions)
        anchors, functions = int(self.dual_counts.prod()), self.dual_output.shape[-1]
        factor = (self.dual_residual.shape[-2], 1 + terms * functions) if functions else (terms, terms)
        return {
            "chosen": len(self.chosen),
            "terms": terms,
            "varied terms": terms - 1,
            "modal": self.modal_stiffness.shape[-1],
            "outputs": self.static_count,
            "all outputs": self.static_count + len(self.accelerations),
            "regions": regions,
            "splits": int(self.dual_counts.sum()) - regions,
            "anchors": anchors,
            "duals": functions or anchors,
            **dict(zip(("dual rows", "dual columns"), factor, strict=True)),
            "masses": 1 + masses,
        }
