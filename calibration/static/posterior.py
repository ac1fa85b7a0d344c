"""Densities of one unknown; the stiffness as a curve of it: Kapteyn et al. 2021, eq. (14)."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import ArrayLike
from scipy.special import ndtri

from calibration.errors import PosteriorError, said
from reporting.arrays import Float

Seed = int | np.random.SeedSequence
"""A seed: a whole number, or a SeedSequence spawned for the purpose."""

PRIOR_DEVIATION = 0.05 / 1.96
"""Half-width of the prior's 95 % interval of e (Kapteyn et al. 2021, calibration step 2)."""


def stratified(generator: np.random.Generator, count: int) -> Float:
    """Return a number from each of `count` equal parts of 0 to 1, in shuffled order (count,)."""
    return generator.permutation((np.arange(count) + generator.random(count)) / count)


def child_seed(seed: Seed, purpose: int) -> np.random.SeedSequence:
    """Return the seed of one purpose, always the same for the same `seed` (spawning would count calls)."""
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, purpose))


@dataclass(frozen=True)
class GaussianPrior:
    """A Gaussian prior; by default that of the paper, e ~ N(1, (0.05 / 1.96)^2).

    Attributes
    ----------
    mean, standard_deviation : float
        Of the Young's modulus factor [1].
    """

    mean: float = 1.0
    standard_deviation: float = PRIOR_DEVIATION

    def log_density(self, value: ArrayLike) -> Float:
        """Return the logarithm of the density, elementwise."""
        standard = (np.asarray(value, dtype=float) - self.mean) / self.standard_deviation
        return np.asarray(-0.5 * standard**2 - math.log(self.standard_deviation * math.sqrt(2.0 * math.pi)))

    def quantile(self, probability: ArrayLike) -> Float:
        """Return quantiles, elementwise."""
        return np.asarray(self.mean + self.standard_deviation * ndtri(np.asarray(probability, dtype=float)))


@dataclass(frozen=True, eq=False)
class ScalarPosterior:
    """p(value | measurements) on a grid; the density is zero outside, and within a cell its mean.

    Attributes
    ----------
    grid : (N,) array
        Ascending values of the unknown.
    density : (N,) array
        Density there, not negative; it is scaled to integrate to one.
    mean, standard_deviation : float
        Of this density, unless given (a particle filter gives those of its particles).
    """

    grid: Float
    density: Float
    mean: float = math.nan
    standard_deviation: float = math.nan
    _cumulative: Float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        grid, density = self.grid, self.density / np.trapezoid(self.density, self.grid)
        cumulative = np.r_[0.0, np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(grid))]
        mean = float(np.trapezoid(density * grid, grid)) if math.isnan(self.mean) else self.mean
        variance = float(np.trapezoid(density * (grid - mean) ** 2, grid))
        given = self.standard_deviation
        found = {
            "density": density, "_cumulative": cumulative / cumulative[-1], "mean": mean,
            "standard_deviation": math.sqrt(variance) if math.isnan(given) else given,
        }  # fmt: skip
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def cumulative(self, value: ArrayLike) -> Float:
        """Return the distribution function, elementwise."""
        return np.asarray(np.interp(np.asarray(value, dtype=float), self.grid, self._cumulative))

    def quantile(self, probability: ArrayLike) -> Float:
        """Return quantiles, elementwise: the inverse of `cumulative`."""
        return np.asarray(np.interp(np.asarray(probability, dtype=float), self._cumulative, self.grid))

    def interval(self, probability: float = 0.95) -> tuple[float, float]:
        """Return the central interval that holds `probability`."""
        tail = 0.5 * (1.0 - probability)
        lower, upper = self.quantile([tail, 1.0 - tail])
        return float(lower), float(upper)

    def samples(self, seed: Seed, count: int) -> Float:
        """Draw one sample from each of `count` strata of equal probability, in shuffled order.

        Sample means have far less variance than those of independent draws.

        Parameters
        ----------
        seed : int or SeedSequence
            The same seed gives the same samples, bit for bit.
        count : int
            Number of samples.

        Returns
        -------
        (count,) array, unit as `grid`
        """
        generator = np.random.default_rng(child_seed(seed, 0))
        return self.quantile(stratified(generator, count))


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

    def stiffness(self, young_modulus_factor: ArrayLike) -> Float:
        """Return k(e) [N/m], elementwise."""
        factor = np.asarray(young_modulus_factor, dtype=float)
        inside = np.clip(factor, self.lower, self.upper)
        return np.asarray(self.polynomial(inside) + (factor - inside) * self.slope(inside))

    def slope(self, young_modulus_factor: ArrayLike) -> Float:
        """Return dk/de [N/m], elementwise."""
        return np.asarray(self.polynomial.deriv()(np.clip(young_modulus_factor, self.lower, self.upper)))

    def young_modulus_factor(self, stiffness: ArrayLike) -> Float:
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
