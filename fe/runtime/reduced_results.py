"""Results of a reduced model: its static response and its modes.

NumPy and relative imports only: this file is copied into the FMU.
"""

from dataclasses import dataclass

from .arrays import FloatArray


@dataclass(frozen=True, slots=True)
class ReducedResponse:
    """The static response of a reduced structure.

    Attributes
    ----------
    strain : (G,) array
        Gauge strains [1]; for a wing positive where the upper skin is compressed.
    displacement : (D,) array
        Displacement outputs [m]; for a wing the upward displacement of the tip.
    strain_error_bound, displacement_error_bound : float
        Certified: no gauge, and no displacement output, differs from the full model by more.
    coordinates : (N,) array
        Coefficients of the static basis vectors, from which a field can be reconstructed.
    """

    strain: FloatArray
    displacement: FloatArray
    strain_error_bound: float
    displacement_error_bound: float
    coordinates: FloatArray

    @property
    def outputs_with_bounds(self) -> tuple[tuple[FloatArray, float], tuple[FloatArray, float]]:
        """Strains and displacements, each with its error bound."""
        return (
            (self.strain, self.strain_error_bound),
            (self.displacement, self.displacement_error_bound),
        )


@dataclass(frozen=True, slots=True)
class ReducedModes:
    """The M lowest undamped modes of a reduced structure, Kapteyn et al. 2021, eq. (16).

    Attributes
    ----------
    frequency : (M,) array
        Natural frequencies, ascending [Hz].
    shape : (Nm, M) array
        Coefficients of the modal basis vectors, mass-normalised; the last output of a mode is
        positive.
    output : (O, M) array
        Gauges, displacements and accelerations (as displacements) per unit of modal coordinate.
    participation : (L, M) array
        Modal force of each load [N kg^-1/2].
    mass : (Nm, Nm) array
        The mass in the modal basis [kg].
    followed : tuple of int
        Index of the mode most like each tracked shape; for a wing, the first two flapwise bendings.
    followed_mac : tuple of float
        Modal assurance criterion (mass-weighted) of these modes with the tracked shapes.
    """

    frequency: FloatArray
    shape: FloatArray
    output: FloatArray
    participation: FloatArray
    mass: FloatArray
    followed: tuple[int, ...]
    followed_mac: tuple[float, ...]
