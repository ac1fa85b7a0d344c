"""Statics and modes of a structure, by the solver of `fe.full`."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fe.full.modes import lowest_eigenpairs
from fe.full.statics import Factorisation
from fe.runtime.errors import SolutionError

from .affine import AffineStructure
from .operators import Structure

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class StaticResponse:
    """Static response of a structure to one load.

    Attributes
    ----------
    displacement : (n,) m
        Free unknowns.
    largest : float
        Largest displacement of a node [m].
    strain : (gauges,)
        Strain at the gauges, positive in tension.
    output : (displacements,) m
        Displacement outputs.
    """

    displacement: FloatArray
    largest: float
    strain: FloatArray
    output: FloatArray


def static_responses(structure: AffineStructure) -> dict[str, StaticResponse]:
    """Solve for each load alone, its control at the nominal value, the structure undamaged.

    Raises
    ------
    SolutionError
        If the stiffness cannot be factorised, or a solution is not accurate.
    """
    if not structure.loads:
        return {}
    factors = Factorisation(structure.stiffness())
    fields = factors.solve(np.column_stack([structure.load(name) for name in structure.loads]))
    return {name: response(structure, fields[:, number]) for number, name in enumerate(structure.loads)}


def response(structure: AffineStructure, displacement: FloatArray) -> StaticResponse:
    """Evaluate the outputs of free unknowns (n,)."""
    return StaticResponse(
        displacement=displacement,
        largest=float(np.linalg.norm(structure.full_displacement(displacement), axis=1).max()),
        strain=np.asarray(structure.gauge_output @ displacement),
        output=np.asarray(structure.displacement_output @ displacement),
    )


def natural_frequencies(structure: AffineStructure, count: int) -> tuple[FloatArray, FloatArray]:
    """Lowest frequencies (m,) [Hz], rising, and mass-normalised shapes (n, m), undamaged and undamped.

    Raises
    ------
    SolutionError
        If there is no mass, there are not so many modes, or the iteration did not converge.
    """
    if count >= structure.unknowns:
        raise SolutionError(
            f"{count} modes were asked for, but a structure of {structure.unknowns} free unknowns gives at "
            f"most {structure.unknowns - 1}."
        )
    if not structure.mass().diagonal().any():
        raise SolutionError("The structure has no mass, hence no modes; give its materials a density.")
    values, shapes = lowest_eigenpairs(structure.stiffness(), structure.mass(), count)
    shapes = shapes / np.sqrt(np.einsum("im,im->m", shapes, structure.mass() @ shapes))
    return np.sqrt(values) / (2.0 * np.pi), shapes


def weighed(structure: Structure) -> tuple[float, FloatArray]:
    """Mass [kg] with the nominal point masses, and the centre of gravity (3,) [m]."""
    mesh, shares = structure.mesh, structure.nodal_mass
    for name, value in structure.masses.items():
        shares = shares + value * structure.point_weights[name]
    mass = float(shares.sum())
    return mass, shares @ mesh.points / mass if mass > 0.0 else mesh.points.mean(axis=0)
