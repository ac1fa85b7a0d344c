"""The arrays of a reduced model: what they are, their shapes, checked, and the file that keeps them.

NumPy and relative imports only: this file is copied into the FMU.
"""

from dataclasses import dataclass
from math import isfinite

import numpy as np
import numpy.typing as npt

from .errors import ReducedModelFileError
from .kept_arrays import KeptArrays

FloatArray = npt.NDArray[np.float64]

PARAMETER_NAMES = ("young_modulus_factor", "z1", "z2", "load_factor", "tip_force", "servo_mass", "pitot_mass")
"""The rows of `ReducedModel.validity_box`, in this order."""


@dataclass(frozen=True, repr=False)
class ReducedArrays(KeptArrays):
    """Affine dense matrices, outputs, modal data, error bound and validity of a reduced wing.

    Terms of the stiffness, in this order: skin (times e), first defect region (times 1 - z1), second defect
    region (times 1 - z2), everything else (times 1). Terms of the mass: structure, servos (times servo
    mass), pitot (times pitot mass). Loads: lift at load factor 1, tip force of 1 N. Output rows: the G
    gauges [1], then the tip displacement [m].

    Attributes
    ----------
    validity_box : (7, 2) ndarray
        Least and largest value of each of `PARAMETER_NAMES`, SI units.
    static_stiffness : (4, N, N) ndarray
        Stiffness terms in the static basis.
    static_load : (2, N) ndarray
        Loads in the static basis.
    static_output : (G + 1, N) ndarray
        Outputs of the static basis vectors.
    bound_reference : (3,) ndarray
        The values of (e, 1 - z1, 1 - z2) whose stiffness is the norm of the error bound.
    residual_load : (R, 2) ndarray
        Loads in an orthonormal basis of the residuals (norm dual to the one of `bound_reference`).
    residual_stiffness : (R, 4, N) ndarray
        Stiffness terms times static basis vectors, in the same basis.
    residual_allowance : float
        Bound of what that basis leaves out of a residual, per unit length of the reduced coordinates.
    rounding_allowance : float
        Part of the norm of the strains, and of the tip displacement, added to the bounds for rounding: a
        multiple of the difference seen where the reduced model holds the full solution itself.
    dual_split_1, dual_split_2 : (A1 - 1,), (A2 - 1,) ndarray
        Values of z1 and z2 at which the next approximate dual solution takes over.
    dual_correction : (A1, A2, G + 1, R) ndarray
        Approximate dual solutions, applied to the basis of the residuals.
    dual_residual : (A1, A2, G + 1, 4, 4) ndarray
        Factors of the dual residuals: their norm is that of the factor times (1, -e, z1 - 1, z2 - 1).
    modal_stiffness : (4, Nm, Nm) ndarray
        Stiffness terms in the modal basis.
    modal_mass : (3, Nm, Nm) ndarray
        Mass terms in the modal basis.
    modal_load : (2, Nm) ndarray
        Loads in the modal basis.
    modal_output : (G + 1, Nm) ndarray
        Outputs of the modal basis vectors.
    cross_mass : (3, Nm, N) ndarray
        Mass terms between the modal and the static basis.
    flapwise_reference : (2, Nm) ndarray
        Shapes that define the first and second flapwise bending, in the modal basis.
    mode_count : int
        Number of modes M that `modes` returns.
    """

    what = "a reduced model"
    layout = ("format", 1)

    validity_box: FloatArray
    static_stiffness: FloatArray
    static_load: FloatArray
    static_output: FloatArray
    bound_reference: FloatArray
    residual_load: FloatArray
    residual_stiffness: FloatArray
    residual_allowance: float
    rounding_allowance: float
    dual_split_1: FloatArray
    dual_split_2: FloatArray
    dual_correction: FloatArray
    dual_residual: FloatArray
    modal_stiffness: FloatArray
    modal_mass: FloatArray
    modal_load: FloatArray
    modal_output: FloatArray
    cross_mass: FloatArray
    flapwise_reference: FloatArray
    mode_count: int

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.mode_count <= self.modal_stiffness.shape[1]:
            raise ReducedModelFileError(
                f"A reduced model with {self.modal_stiffness.shape[1]} modal basis vectors cannot have "
                f"{self.mode_count} modes; build the model anew."
            )
        for name in ("residual_allowance", "rounding_allowance"):
            value = getattr(self, name)
            if not (isfinite(value) and value >= 0.0):
                raise ReducedModelFileError(
                    f"The {name} of a reduced model must not be negative, but is {value!r}; build it anew."
                )

    def _expected_shapes(self) -> dict[str, tuple[int, ...]]:
        n, outputs, r = (
            self.static_stiffness.shape[-1],
            self.static_output.shape[0],
            self.residual_load.shape[0],
        )
        a1, a2, m = self.dual_split_1.size + 1, self.dual_split_2.size + 1, self.modal_stiffness.shape[-1]
        return {
            "validity_box": (len(PARAMETER_NAMES), 2),
            "static_stiffness": (4, n, n),
            "static_load": (2, n),
            "static_output": (outputs, n),
            "bound_reference": (3,),
            "residual_load": (r, 2),
            "residual_stiffness": (r, 4, n),
            "dual_split_1": (a1 - 1,),
            "dual_split_2": (a2 - 1,),
            "dual_correction": (a1, a2, outputs, r),
            "dual_residual": (a1, a2, outputs, 4, 4),
            "modal_stiffness": (4, m, m),
            "modal_mass": (3, m, m),
            "modal_load": (2, m),
            "modal_output": (outputs, m),
            "cross_mass": (3, m, n),
            "flapwise_reference": (2, m),
        }
