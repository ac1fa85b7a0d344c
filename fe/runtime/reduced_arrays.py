"""The arrays of a reduced model: what they are, their shapes, checked, and the file that keeps them.

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from .errors import ReducedModelFileError
from .kept_arrays import KeptArrays
from .state import MOST_REGIONS, Losses, losses_of

FloatArray = npt.NDArray[np.float64]

MOST_ANCHORS = 16
"""Largest number of approximate dual solutions of a reduced model."""


def parameter_names(regions: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the rows of `ReducedModel.validity_box`, in their order."""
    return ("young_modulus_factor", *regions, "load_factor", "tip_force", "servo_mass", "pitot_mass")


@dataclass(frozen=True, repr=False)
class RegionArrays(KeptArrays):
    """Arrays of a structure with K damage regions, 1 to 8.

    Attributes
    ----------
    region_names : str
        Names of the damage regions in the order of their stiffness terms, parted by spaces.
    """

    region_names: str

    @property
    def regions(self) -> tuple[str, ...]:
        """Names of the K damage regions."""
        return tuple(self.region_names.split())

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


class AffineSizes(NamedTuple):
    """Numbers of stiffness terms, loads, free masses, chosen quantities, outputs of the modes alone."""

    stiffness_terms: int
    loads: int
    masses: int
    chosen: int
    dynamic_outputs: int = 0


@dataclass(frozen=True, repr=False)
class AffineArrays(RegionArrays):
    """Affine dense matrices, outputs, modal data and error bound of a reduced structure.

    T stiffness terms, of which the last is always times one, 1 + P mass terms (the structure, then 1 kg of
    each mass that can be chosen), L loads and O outputs, of which the first O' are static; what multiplies
    them is told by the subclasses.

    Attributes
    ----------
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
        Loads in an orthonormal basis of the residuals (norm dual to the one of `bound_reference`).
    residual_stiffness : (R, T, N) ndarray
        Stiffness terms times static basis vectors, in the same basis.
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

    kinds: ClassVar[Mapping[str, type[Any]]] = {"dual_counts": np.int64}

    validity_box: FloatArray
    static_stiffness: FloatArray
    static_load: FloatArray
    static_output: FloatArray
    bound_reference: FloatArray
    residual_load: FloatArray
    residual_stiffness: FloatArray
    residual_allowance: float
    rounding_allowance: float
    dual_counts: npt.NDArray[np.int64]
    dual_split: FloatArray
    dual_correction: FloatArray
    dual_residual: FloatArray
    dual_stiffness: FloatArray
    dual_output: FloatArray
    modal_stiffness: FloatArray
    modal_mass: FloatArray
    modal_load: FloatArray
    modal_output: FloatArray
    cross_mass: FloatArray

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
        if not 1 <= self._modes <= self.modal_stiffness.shape[1]:
            raise ReducedModelFileError(
                f"A reduced model with {self.modal_stiffness.shape[1]} modal basis vectors cannot have "
                f"{self._modes} modes; build the model anew."
            )
        for name in ("residual_allowance", "rounding_allowance"):
            value = getattr(self, name)
            if not (isfinite(value) and value >= 0.0):
                raise ReducedModelFileError(
                    f"The {name} of a reduced model must not be negative, but is {value!r}; build it anew."
                )

    @property
    def _modes(self) -> int:
        """Number of modes."""
        raise NotImplementedError

    def _sizes(self) -> AffineSizes:
        """Return how many there are of what the arrays do not tell."""
        raise NotImplementedError

    def _expected_shapes(self) -> dict[str, tuple[int, ...]]:
        n, outputs, r = (
            self.static_stiffness.shape[-1],
            self.static_output.shape[0],
            self.residual_load.shape[0],
        )
        k, m = len(self.regions), self.modal_stiffness.shape[-1]
        sizes, anchors = self._sizes(), int(self.dual_counts.prod())
        terms, loads, masses = sizes.stiffness_terms, sizes.loads, sizes.masses
        functions, factor = self.dual_output.shape[-1], (terms, terms)
        if functions:
            factor = (self.dual_residual.shape[-2], 1 + terms * functions)
        return {
            "validity_box": (sizes.chosen, 2),
            "static_stiffness": (terms, n, n),
            "static_load": (loads, n),
            "static_output": (outputs, n),
            "bound_reference": (terms - 1,),
            "residual_load": (r, loads),
            "residual_stiffness": (r, terms, n),
            "dual_counts": (k,),
            "dual_split": (int(self.dual_counts.sum()) - k,),
            "dual_correction": (functions or anchors, outputs, r),
            "dual_residual": (anchors, outputs, *factor),
            "dual_stiffness": (outputs, terms, functions, functions),
            "dual_output": (outputs, functions),
            "modal_stiffness": (terms, m, m),
            "modal_mass": (1 + masses, m, m),
            "modal_load": (loads, m),
            "modal_output": (outputs + sizes.dynamic_outputs, m),
            "cross_mass": (1 + masses, m, n),
        }


@dataclass(frozen=True, repr=False)
class ReducedArrays(AffineArrays):
    """Affine dense matrices, outputs, modal data, error bound and validity of a reduced wing.

    Terms of the stiffness, T = K + 2 for K damage regions, in this order: skin (times e), the damage regions
    (each times 1 - z of its own), everything else (times 1). Terms of the mass: structure, servos (times
    servo mass), pitot (times pitot mass). Loads: lift at load factor 1, tip force of 1 N. Output rows: the G
    gauges [1], then the tip displacement [m]. Other attributes: those of `AffineArrays`.

    Attributes
    ----------
    validity_box : (K + 5, 2) ndarray
        Least and largest value of each of `parameter_names`, SI units.
    bound_reference : (K + 1,) ndarray
        The values of (e, 1 - z1, ...) whose stiffness is the norm of the error bound.
    flapwise_reference : (2, Nm) ndarray
        Shapes that define the first and second flapwise bending, in the modal basis.
    mode_count : int
        Number of modes M that `modes` returns.
    """

    what = "a reduced model"
    layout = ("format", 3)

    flapwise_reference: FloatArray
    mode_count: int

    @property
    def _modes(self) -> int:
        return self.mode_count

    def _sizes(self) -> AffineSizes:
        k = len(self.regions)
        return AffineSizes(k + 2, loads=2, masses=2, chosen=len(parameter_names(self.regions)))

    def _expected_shapes(self) -> dict[str, tuple[int, ...]]:
        return super()._expected_shapes() | {"flapwise_reference": (2, self.modal_stiffness.shape[-1])}
