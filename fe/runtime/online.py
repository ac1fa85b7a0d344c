"""Arrays of a reduced model, laid out for the fewest operations in an evaluation.

NumPy only: this file is copied into the FMU.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DualArrays:
    """Approximate dual solutions at one anchor: `correction` (G + 1, R) and `factor` (4 (G + 1), 4)."""

    correction: FloatArray
    factor: FloatArray


class OnlineArrays:
    """What `ReducedModel.static_response` multiplies; the parameters are fields of `ReducedModel`.

    Attributes
    ----------
    square : tuple of int
        (N, N).
    stiffness : (4, N N) ndarray
        Stiffness terms, flat.
    residual : (R, 2 + 4 N) ndarray
        Times the loads, then the stiffness coefficients times the coordinates: the residual.
    limits : tuple of float
        Validity limits of e, z1, z2, load factor and tip force, least and largest in turn.
    reference : tuple of float
        `bound_reference`.
    split_1, split_2 : list of float
        `dual_split_1`, `dual_split_2`.
    dual : list of list of DualArrays
        Approximate dual solutions by anchor.
    """

    __slots__ = ("dual", "limits", "reference", "residual", "split_1", "split_2", "square", "stiffness")

    def __init__(
        self,
        *,
        static_stiffness: FloatArray,
        validity_box: FloatArray,
        bound_reference: FloatArray,
        residual_load: FloatArray,
        residual_stiffness: FloatArray,
        splits: tuple[FloatArray, FloatArray],
        dual_correction: FloatArray,
        dual_residual: FloatArray,
    ) -> None:
        self.square = static_stiffness.shape[1:]
        self.stiffness = np.ascontiguousarray(static_stiffness.reshape(4, -1))
        self.residual = np.concatenate(
            (residual_load, -residual_stiffness.reshape(len(residual_load), -1)), axis=1
        )
        self.limits = tuple(float(value) for value in validity_box[:5].ravel())
        self.reference = tuple(float(value) for value in bound_reference)
        self.split_1, self.split_2 = ([float(value) for value in split] for split in splits)
        # to be multiplied by (e, 1 - z1, 1 - z2, 1), as the stiffness
        factors = np.concatenate((-dual_residual[..., 1:], dual_residual[..., :1]), axis=-1)
        self.dual = [
            [
                DualArrays(np.ascontiguousarray(correction), np.ascontiguousarray(factor.reshape(-1, 4)))
                for correction, factor in zip(correction_row, factor_row, strict=True)
            ]
            for correction_row, factor_row in zip(dual_correction, factors, strict=True)
        ]
