"""Compliance and elasticity of materials in their axes and in global axes.

Strains are in Voigt order 11, 22, 33, 23, 13, 12 with engineering shear strains.
"""

import numpy as np
from numpy.typing import ArrayLike

from fe.runtime.arrays import FloatArray

VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
"""Indices ij of the strains in Voigt order."""
_PAIRS_OF_AXES = ((0, 1), (0, 2), (1, 2))
"""Axes ij of Poisson's ratios and shear moduli."""
_VOIGT_NUMBER = np.array(
    [
        [0, 5, 4],
        [5, 1, 3],
        [4, 3, 2],
    ]
)
"""Number in Voigt order of the strain ij."""


def orthotropic_compliance(
    moduli: ArrayLike, ratios: ArrayLike, shear_moduli: ArrayLike
) -> FloatArray:
    """Return the compliance (6, 6) [1/Pa] of an orthotropic material in its axes.

    Parameters
    ----------
    moduli : (3,) array or float
        Young's moduli along the axes [Pa].
    ratios : (3,) array or float
        Poisson's ratios 12, 13, 23; ratio ij is the contraction along j under tension along i.
    shear_moduli : (3,) array or float
        Shear moduli 12, 13, 23 [Pa].
    """
    young = np.broadcast_to(moduli, 3)
    # The shear moduli are 12, 13, 23, and Voigt order is 23, 13, 12.
    shear = np.broadcast_to(shear_moduli, 3)[::-1]
    stiffness_moduli = np.concatenate((young, shear))
    compliance = np.diag(1.0 / stiffness_moduli)
    poisson_ratios = np.broadcast_to(ratios, 3)
    for (i, j), ratio in zip(_PAIRS_OF_AXES, poisson_ratios, strict=True):
        coupling = -ratio / young[i]
        compliance[i, j] = coupling
        compliance[j, i] = coupling
    return compliance


def isotropic_compliance(young_modulus: float, poisson_ratio: float) -> FloatArray:
    """Return the compliance (6, 6) [1/Pa] of an isotropic material."""
    shear_modulus = young_modulus / (2.0 * (1.0 + poisson_ratio))
    return orthotropic_compliance(young_modulus, poisson_ratio, shear_modulus)


def unit_vector(vectors: ArrayLike) -> FloatArray:
    """Scale vectors (..., 3) to length one."""
    values = np.asarray(vectors, dtype=np.float64)
    return np.asarray(values / np.linalg.norm(values, axis=-1, keepdims=True))


def axes_of(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """Return orthonormal axes (3, 3) from two vectors (3,) that span a plane.

    The rows are: along the first vector, at right angles to it in the plane, normal to the plane.
    """
    along = np.asarray(first, dtype=np.float64)
    in_plane = np.asarray(second, dtype=np.float64)
    normal = np.cross(along, in_plane)
    across = np.cross(normal, along)
    return unit_vector([along, across, normal])


def rotate_elasticity(elasticity: FloatArray, axes: FloatArray) -> FloatArray:
    """Rotate elasticities (n, 6, 6) [Pa] from local to global axes.

    The local axes (n, 3, 3) are given as rows.
    """
    first_pair = _VOIGT_NUMBER[:, :, np.newaxis, np.newaxis]
    tensor = elasticity[:, first_pair, _VOIGT_NUMBER]
    rotated = np.einsum(
        "nabcd,nai,nbj,nck,ndl->nijkl", tensor, axes, axes, axes, axes, optimize=True
    )
    i, j = np.transpose(VOIGT)
    rows = rotated[:, i, j]
    return np.asarray(rows[:, :, i, j])
