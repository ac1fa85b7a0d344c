"""The arrays of the reduced model of a structure, with the names of all that can be chosen and read.

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from .errors import ReducedModelFileError
from .reduced_arrays import AffineArrays, AffineSizes, FloatArray


@dataclass(frozen=True, repr=False)
class StructureArrays(AffineArrays):
    """Arrays of a reduced structure; those of `AffineArrays` beside its names.

    What can be chosen are the parameters, the losses of the damage regions, the free masses [kg] and the
    controls, in this order; `chosen` names them. Outputs are the gauges [1], the displacements [m] and, of
    the modes alone, the accelerations [m/s^2].

    Attributes
    ----------
    name : str
        Of the structure.
    parameter_names, mass_names, control_names : str
        Parted by spaces; each may be empty.
    control_units : str
        Unit of each control, parted by spaces.
    gauge_names, displacement_names, acceleration_names : str
        Names of the outputs, parted by spaces; each may be empty.
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
    """

    what = "a reduced structure"
    layout = ("structure_format", 2)
    kinds: ClassVar[Mapping[str, type[Any]]] = {
        **AffineArrays.kinds,
        "stiffness_factors": np.int64,
        "load_factors": np.int64,
    }

    name: str
    parameter_names: str
    mass_names: str
    control_names: str
    control_units: str
    gauge_names: str
    displacement_names: str
    acceleration_names: str
    nominal: FloatArray
    damping: FloatArray
    stiffness_factors: npt.NDArray[np.int64]
    load_factors: npt.NDArray[np.int64]
    mode_count: int

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, counts in (
            ("stiffness_factors", (len(self.parameters), len(self.regions))),
            ("load_factors", (len(self.controls), len(self.masses))),
        ):
            array = getattr(self, name)
            if array.min(initial=0) < 0 or np.any(array > counts):
                raise ReducedModelFileError(
                    f"The array {name} of {self.what} names what is not there; build it anew."
                )
        if self.stiffness_factors[-1].any() or self.static_output.shape[0] != self.static_count:
            raise ReducedModelFileError(
                f"The terms or outputs of {self.what} are not those of its names; build it anew."
            )

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.parameter_names.split())

    @property
    def masses(self) -> tuple[str, ...]:
        """Names of the free masses."""
        return tuple(self.mass_names.split())

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the controls."""
        return tuple(self.control_names.split())

    @property
    def gauges(self) -> tuple[str, ...]:
        """Names of the gauges."""
        return tuple(self.gauge_names.split())

    @property
    def displacements(self) -> tuple[str, ...]:
        """Names of the displacement outputs."""
        return tuple(self.displacement_names.split())

    @property
    def accelerations(self) -> tuple[str, ...]:
        """Names of the acceleration outputs."""
        return tuple(self.acceleration_names.split())

    @property
    def chosen(self) -> tuple[str, ...]:
        """Names of all that can be chosen: the rows of `validity_box`."""
        return (*self.parameters, *self.regions, *self.masses, *self.controls)

    @property
    def static_count(self) -> int:
        """Number O' of gauges and displacements."""
        return len(self.gauges) + len(self.displacements)

    @property
    def _modes(self) -> int:
        return self.mode_count

    def _sizes(self) -> AffineSizes:
        return AffineSizes(
            stiffness_terms=len(self.stiffness_factors),
            loads=len(self.load_factors),
            masses=len(self.masses),
            chosen=len(self.chosen),
            dynamic_outputs=len(self.accelerations),
        )

    def _expected_shapes(self) -> dict[str, tuple[int, ...]]:
        return super()._expected_shapes() | {
            "nominal": (len(self.chosen),),
            "damping": (2,),
            "stiffness_factors": (len(self.stiffness_factors), 2),
            "load_factors": (len(self.load_factors), 2),
        }
