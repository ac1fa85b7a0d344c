"""The two flapwise frequencies as a polynomial of e and the masses, so that many states cost little."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.chebyshev import chebval3d, chebvander3d
from numpy.typing import ArrayLike, NDArray

from calibration.errors import OutsideValidityError, PosteriorError
from calibration.static.stiffness_curve import StiffnessCurve, stiffness_curve_of
from fe.runtime.reduced import ReducedModel

TOLERANCE = 1e-5
"""Largest relative error of a tabulated frequency that is accepted; 0.1 % of f1 is 1 g of servo mass."""

_DEGREES = ((5, 7, 7), (8, 11, 11))
_CHECKS = 128
_NAMES = ("young_modulus_factor", "servo_mass", "pitot_mass")


@dataclass(frozen=True, eq=False)
class FrequencyTable:
    """Chebyshev polynomials of ln f1 and ln f2 over the range of a model.

    Attributes
    ----------
    limits : (3, 2) array
        Range of e [1], servo mass and pitot mass [kg].
    coefficient : (I, J, K, 2) array
        Of the products of Chebyshev polynomials in the three scaled quantities.
    error : float
        Largest relative error of a frequency, found at points between the nodes [1].
    """

    limits: NDArray[np.float64]
    coefficient: NDArray[np.float64]
    error: float

    def frequency(self, quantities: ArrayLike) -> NDArray[np.float64]:
        """Return f1 and f2 of many states.

        Parameters
        ----------
        quantities : (N, 3) array_like
            e [1], servo mass and pitot mass [kg] of each state.

        Returns
        -------
        (N, 2) array [Hz]

        Raises
        ------
        OutsideValidityError
            If a state lies outside the range of the model or is not finite.
        """
        points = np.atleast_2d(np.asarray(quantities, dtype=np.float64))
        inside = (points >= self.limits[:, 0]) & (points <= self.limits[:, 1])
        if not inside.all():
            row, place = np.argwhere(~inside)[0]
            lower, upper = self.limits[place]
            raise OutsideValidityError(
                f"{_NAMES[place]} is {points[row, place]:g}, but the model holds for {lower:g} to {upper:g}; "
                "build one with a wider range."
            )
        scaled = (2.0 * points - self.limits.sum(axis=1)) / np.diff(self.limits, axis=1)[:, 0]
        first, second, third = scaled.T
        return np.asarray(np.exp(chebval3d(first, second, third, self.coefficient)).T)


@dataclass(frozen=True, eq=False)
class WingTables:
    """A reduced model as the posterior needs it: tables that many posteriors can share.

    Attributes
    ----------
    frequency : FrequencyTable
        f1 and f2.
    stiffness : StiffnessCurve
        k(e) of the tip.
    """

    frequency: FrequencyTable
    stiffness: StiffnessCurve

    @property
    def validity(self) -> dict[str, tuple[float, float]]:
        """Range of e and the masses in which the tables hold."""
        return {
            name: (low, high)
            for name, (low, high) in zip(_NAMES, self.frequency.limits.tolist(), strict=True)
        }


def tabulate_wing(model: ReducedModel) -> WingTables:
    """Tabulate a healthy model; see `tabulate_frequencies` and `stiffness_curve_of`."""
    return WingTables(tabulate_frequencies(model), stiffness_curve_of(model))


def tabulate_frequencies(model: ReducedModel, tolerance: float = TOLERANCE) -> FrequencyTable:
    """Tabulate the flapwise frequencies of a healthy model, and check the table between its nodes.

    Parameters
    ----------
    model : ReducedModel
        The wing; its flapwise modes are followed by their shape.
    tolerance : float
        Largest relative error at 128 points that fill the range evenly [1].

    Raises
    ------
    PosteriorError
        If no polynomial of the degrees tried meets the tolerance.
    """
    limits = np.array([model.validity[name] for name in _NAMES])
    centre, half = limits.mean(axis=1), 0.5 * np.diff(limits, axis=1)[:, 0]
    from scipy.stats import qmc  # takes a second to load

    checks = 2.0 * qmc.Halton(3, scramble=False).random(_CHECKS + 1)[1:] - 1.0
    exact = np.array([_frequencies(model, centre + half * point) for point in checks])
    error = np.inf
    for degrees in _DEGREES:
        nodes = [np.cos(np.pi * (np.arange(n + 1) + 0.5) / (n + 1)) for n in degrees]
        grid = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 3)
        values = np.array([_frequencies(model, centre + half * point) for point in grid])
        first, second, third = grid.T
        vandermonde = chebvander3d(first, second, third, degrees)
        coefficient = np.linalg.solve(vandermonde, np.log(values))
        coefficient = coefficient.reshape(*(degree + 1 for degree in degrees), 2)
        table = FrequencyTable(limits, coefficient, 0.0)
        error = float(np.abs(table.frequency(centre + half * checks) / exact - 1.0).max())
        if error <= tolerance:
            return FrequencyTable(limits, coefficient, error)
    raise PosteriorError(
        f"the flapwise frequencies of the model are not smooth over its range: a polynomial errs by "
        f"{error:.2g} where {tolerance:.2g} are allowed; build a model with a narrower range of masses."
    )


def _frequencies(model: ReducedModel, point: NDArray[np.float64]) -> NDArray[np.float64]:
    factor, servo, pitot = (
        min(max(value, low), high)  # a node may leave the range by a rounding error
        for value, (low, high) in zip(point.tolist(), (model.validity[name] for name in _NAMES), strict=True)
    )
    modes = model.modes(young_modulus_factor=factor, servo_mass=servo, pitot_mass=pitot)
    return modes.frequency[list(modes.followed)]
