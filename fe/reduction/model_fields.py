"""Fields of a reduced model that do not depend on its static basis."""

from typing import NamedTuple, TypedDict

from fe.runtime.arrays import FloatArray, IntArray


class DesignFields(TypedDict):
    """The fields of `fe.runtime.reduced_arrays.ReducedArrays` that follow from the design alone."""

    design_hash: str
    name: str
    regions: tuple[str, ...]
    parameters: tuple[str, ...]
    masses: tuple[str, ...]
    controls: tuple[str, ...]
    control_units: tuple[str, ...]
    gauges: tuple[str, ...]
    displacements: tuple[str, ...]
    accelerations: tuple[str, ...]
    nominal: FloatArray
    damping: FloatArray
    validity_box: FloatArray
    stiffness_factors: IntArray
    load_factors: IntArray
    dual_split: FloatArray


class ModalFields(TypedDict):
    """The fields of `fe.runtime.reduced_arrays.ReducedArrays` that the modal basis gives."""

    mode_count: int
    modal_stiffness: FloatArray
    modal_mass: FloatArray
    modal_load: FloatArray
    modal_output: FloatArray
    followed_shapes: FloatArray


class ModalReduction(NamedTuple):
    """The modal basis of a structure, and the modal fields of its reduced model.

    Attributes
    ----------
    basis : (n, Nm) array
        The basis vectors on the free unknowns of the full model.
    """

    basis: FloatArray
    fields: ModalFields
