"""Tip stiffness as a function of the Young's modulus factor: Kapteyn et al. 2021, eq. (14)."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import ArrayLike, NDArray

from calibration.errors import PosteriorError
from calibration.sentences import said

TABLE_TOLERANCE = 1e-7
"""Largest relative error of a curve between the nodes at which a model was asked."""

_INVERSE_TABLE_SIZE = 4001
_DEGREE = 16


@dataclass(frozen=True, eq=False)
class StiffnessCurve:
    """A strictly increasing map k(e) from the Young's modulus factor to the tip stiffness.

    Attributes
    ----------
    polynomial : Chebyshev
        k(e) [N/m] over the range in which the curve may be trusted; straight lines continue it beyond, so
        that tails of a sampled density can be mapped, but no posterior may rest there.
    name : str
        What the curve is, for reports.
    """

    polynomial: Chebyshev
    name: str

    @property
    def lower(self) -> float:
        """Smallest e of the range."""
        return float(self.polynomial.domain[0])

    @property
    def upper(self) -> float:
        """Largest e of the range."""
        return float(self.polynomial.domain[1])

    def stiffness(self, young_modulus_factor: ArrayLike) -> NDArray[np.float64]:
        """Return k(e) [N/m], elementwise."""
        factor = np.asarray(young_modulus_factor, dtype=float)
        inside = np.clip(factor, self.lower, self.upper)
        return np.asarray(self.polynomial(inside) + (factor - inside) * self.slope(inside))

    def slope(self, young_modulus_factor: ArrayLike) -> NDArray[np.float64]:
        """Return dk/de [N/m], elementwise."""
        return np.asarray(self.polynomial.deriv()(np.clip(young_modulus_factor, self.lower, self.upper)))

    def young_modulus_factor(self, stiffness: ArrayLike) -> NDArray[np.float64]:
        """Return the inverse e(k), elementwise; `stiffness` in N/m."""
        value = np.asarray(stiffness, dtype=float)
        factors = np.linspace(self.lower, self.upper, _INVERSE_TABLE_SIZE)
        stiffnesses = self.polynomial(factors)
        inside = np.clip(value, stiffnesses[0], stiffnesses[-1])
        end_slope = np.where(value < inside, *self.slope([self.lower, self.upper]))
        return np.asarray(np.interp(inside, stiffnesses, factors) + (value - inside) / end_slope)


def stiffness_line(
    gradient: float, intercept: float, name: str = "line", lower: float = 0.0, upper: float = 10.0
) -> StiffnessCurve:
    """Return the line k(e) = gradient * e + intercept [N/m] between two factors."""
    ends = np.array([lower, upper])
    return StiffnessCurve(Chebyshev.fit(ends, gradient * ends + intercept, 1, domain=ends), name)


PUBLISHED_LINE = stiffness_line(575.2, 101.8, "published line k(e) = 0.5752 e + 0.1018 N/mm")
"""Kapteyn et al. 2021, eq. (14): the authors' finite element model at the test point, 5 cm from the tip."""


def stiffness_curve_of(
    tip_stiffness: Callable[[float], float], limits: tuple[float, float], name: str = "finite element model"
) -> StiffnessCurve:
    """Return the tip stiffness of a structural model over its range of e.

    A polynomial must meet the model between its nodes within `TABLE_TOLERANCE`.

    Parameters
    ----------
    tip_stiffness : callable
        Of a model: e to load over displacement 5 cm from the tip [N/m].
    limits : (float, float)
        Range of e in which the model holds.
    name : str
        What the curve is, for reports.

    Raises
    ------
    PosteriorError
        If the curve is too rough for a polynomial.
    """
    stiffness = np.vectorize(tip_stiffness, otypes=[float])
    polynomial = Chebyshev.interpolate(stiffness, _DEGREE, domain=limits)
    between = np.linspace(*limits, 2 * _DEGREE)
    error = float(np.max(np.abs(polynomial(between) / stiffness(between) - 1.0)))
    if error > TABLE_TOLERANCE:
        fit = error, _DEGREE
        raise PosteriorError(said("load_test.rough", name=name, limits=limits, fit=fit))
    return StiffnessCurve(polynomial, name)
