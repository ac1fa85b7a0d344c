"""Arrays of a reduced model, laid out for the fewest operations in an evaluation.

NumPy only: this file is copied into the FMU.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DualArrays:
    """Approximate dual solutions at one anchor: `correction` (G + 1, R) and `factor` (T (G + 1), T)."""

    correction: FloatArray
    factor: FloatArray


class OnlineArrays:
    """What `ReducedModel.static_response` multiplies; the parameters are fields of `ReducedModel`.

    Attributes
    ----------
    square : tuple of int
        (N, N).
    stiffness : (T, N N) ndarray
        Stiffness terms, flat.
    residual : (R, 2 + T N) ndarray
        Times the loads, then the stiffness coefficients times the coordinates: the residual.
    limits : tuple of (float, float)
        Validity limits of e, of the losses, of load factor and tip force.
    reference : tuple of float
        `bound_reference`.
    splits : tuple of list of float
        `dual_split` of each region.
    dual : list of DualArrays
        Approximate dual solutions by anchor.
    """

    __slots__ = ("dual", "limits", "reference", "residual", "splits", "square", "stiffness")

    def __init__(
        self,
        *,
        static_stiffness: FloatArray,
        validity_box: FloatArray,
        bound_reference: FloatArray,
        residual_load: FloatArray,
        residual_stiffness: FloatArray,
        dual_counts: npt.NDArray[np.int64],
        dual_split: FloatArray,
        dual_correction: FloatArray,
        dual_residual: FloatArray,
    ) -> None:
        self.square = static_stiffness.shape[1:]
        self.stiffness = np.ascontiguousarray(static_stiffness.reshape(len(static_stiffness), -1))
        self.residual = np.concatenate(
            (residual_load, -residual_stiffness.reshape(len(residual_load), -1)), axis=1
        )
        self.limits = tuple((float(low), float(high)) for low, high in validity_box[:-2])
        self.reference = tuple(float(value) for value in bound_reference)
        ends = np.cumsum(dual_counts - 1)[:-1]
        self.splits = tuple([float(value) for value in split] for split in np.split(dual_split, ends))
        # to be multiplied by (e, 1 - z1, ..., 1), as the stiffness
        factors = np.concatenate((-dual_residual[..., 1:], dual_residual[..., :1]), axis=-1)
        terms = len(static_stiffness)
        self.dual = [
            DualArrays(np.ascontiguousarray(correction), np.ascontiguousarray(factor.reshape(-1, terms)))
            for correction, factor in zip(dual_correction, factors, strict=True)
        ]
