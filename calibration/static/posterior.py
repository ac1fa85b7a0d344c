"""Densities of one unknown, and the stiffness as a curve of it: Kapteyn et al. 2021, eq. (14)."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import ArrayLike

from calibration.errors import PosteriorError
from reporting.arrays import Float

Seed = int | np.random.SeedSequence
"""A seed: an integer, or a SeedSequence for one purpose."""

PRIOR_DEVIATION = 0.05 / 1.96
"""Half-width of the prior's 95 % interval of e (Kapteyn et al. 2021, calibration step 2)."""


def stratified(generator: np.random.Generator, count: int) -> Float:
    """Return uniform random numbers (count,), one from each of `count` equal intervals of [0, 1].

    They are shuffled.
    """
    strata = (np.arange(count) + generator.random(count)) / count
    return generator.permutation(strata)


def child_seed(seed: Seed, purpose: int) -> np.random.SeedSequence:
    """Return the seed of one purpose, by its number, derived from a common seed.

    Calls with equal arguments return equal seeds, while the result of `SeedSequence.spawn` depends
    on the number of its calls.
    """
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, purpose))


@dataclass(frozen=True)
class GaussianPrior:
    """A Gaussian prior of e; by default that of the paper, e ~ N(1, (0.05 / 1.96)^2)."""

    mean: float = 1.0
    standard_deviation: float = PRIOR_DEVIATION

    def log_density(self, value: ArrayLike) -> Float:
        """Return the logarithm of the density, elementwise."""
        standardised = (np.asarray(value, dtype=float) - self.mean) / self.standard_deviation
        log_scale = math.log(self.standard_deviation * math.sqrt(2.0 * math.pi))
        return np.asarray(-0.5 * standardised**2 - log_scale)

    def quantile(self, probability: ArrayLike) -> Float:
        """Return quantiles, elementwise."""
        from scipy.special import ndtri  # slow to import, and seldom needed

        standardised = ndtri(np.asarray(probability, dtype=float))
        return np.asarray(self.mean + self.standard_deviation * standardised)


@dataclass(frozen=True, eq=False)
class ScalarPosterior:
    """The density p(value | measurements) on a grid.

    The density is zero outside the grid, and its distribution function is linear in each cell.

    Attributes
    ----------
    grid : (N,) array
        The ascending values of the unknown.
    density : (N,) array
        The density there, not negative; it is scaled to integrate to one.
    mean, standard_deviation : float
        The moments of this density, unless they are given (a particle filter gives those of its
        particles).
    """

    grid: Float
    density: Float
    mean: float = math.nan
    standard_deviation: float = math.nan
    _cumulative: Float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        grid = self.grid
        density = self.density / np.trapezoid(self.density, grid)
        cell_probability = 0.5 * (density[1:] + density[:-1]) * np.diff(grid)
        cumulative = np.r_[0.0, np.cumsum(cell_probability)]
        mean = self.mean
        if math.isnan(mean):
            mean = float(np.trapezoid(density * grid, grid))
        standard_deviation = self.standard_deviation
        if math.isnan(standard_deviation):
            variance = float(np.trapezoid(density * (grid - mean) ** 2, grid))
            standard_deviation = math.sqrt(variance)
        # A frozen dataclass can only be completed in this way.
        object.__setattr__(self, "density", density)
        object.__setattr__(self, "_cumulative", cumulative / cumulative[-1])
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "standard_deviation", standard_deviation)

    def cumulative(self, value: ArrayLike) -> Float:
        """Return the distribution function, elementwise."""
        return np.asarray(np.interp(np.asarray(value, dtype=float), self.grid, self._cumulative))

    def quantile(self, probability: ArrayLike) -> Float:
        """Return quantiles, elementwise: the inverse of `cumulative`."""
        return np.asarray(
            np.interp(np.asarray(probability, dtype=float), self._cumulative, self.grid)
        )

    def interval(self, probability: float = 0.95) -> tuple[float, float]:
        """Return the central interval that contains a given probability."""
        tail = 0.5 * (1.0 - probability)
        lower, upper = self.quantile([tail, 1.0 - tail])
        return float(lower), float(upper)

    def samples(self, seed: Seed, count: int) -> Float:
        """Return samples (count,), one from each of `count` strata of equal probability, shuffled.

        Their mean has far less variance than that of independent draws. Equal seeds give equal
        samples, bit for bit.
        """
        generator = np.random.default_rng(child_seed(seed, 0))
        return self.quantile(stratified(generator, count))


TABLE_TOLERANCE = 1e-7
"""Largest relative error of a curve between the interpolation nodes."""

_INVERSE_TABLE_SIZE = 4001
_DEGREE = 16


@dataclass(frozen=True, eq=False)
class StiffnessCurve:
    """A strictly increasing map k(e) from the Young's modulus factor to the tip stiffness.

    Attributes
    ----------
    polynomial : Chebyshev
        The stiffness k(e) [N/m] over the range in which the curve is valid. It is continued by its
        tangents, so that tails of a sampled density can be mapped; no posterior may lie there.
    name : str
        The name of the curve, for reports.
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
        # Beyond the range the curve goes on along its tangent.
        inside = np.clip(factor, self.lower, self.upper)
        return np.asarray(self.polynomial(inside) + (factor - inside) * self.slope(inside))

    def slope(self, young_modulus_factor: ArrayLike) -> Float:
        """Return dk/de [N/m], elementwise."""
        return np.asarray(
            self.polynomial.deriv()(np.clip(young_modulus_factor, self.lower, self.upper))
        )

    def young_modulus_factor(self, stiffness: ArrayLike) -> Float:
        """Return the inverse e(k) [1], elementwise, of a stiffness [N/m]."""
        value = np.asarray(stiffness, dtype=float)
        # Inverse by a table within the range, and along the tangents beyond it
        factors = np.linspace(self.lower, self.upper, _INVERSE_TABLE_SIZE)
        stiffnesses = self.polynomial(factors)
        inside = np.clip(value, stiffnesses[0], stiffnesses[-1])
        end_slope = np.where(value < inside, *self.slope([self.lower, self.upper]))
        return np.asarray(np.interp(inside, stiffnesses, factors) + (value - inside) / end_slope)


def stiffness_line(
    gradient: float, intercept: float, name: str = "line", lower: float = 0.0, upper: float = 10.0
) -> StiffnessCurve:
    """Return the line k(e) = gradient * e + intercept.

    Parameters
    ----------
    gradient, intercept : float
        The coefficients of the line [N/m].
    lower, upper : float
        The range of e [1].
    """
    ends = np.array([lower, upper])
    return StiffnessCurve(Chebyshev.fit(ends, gradient * ends + intercept, 1, domain=ends), name)


PUBLISHED_LINE = stiffness_line(575.2, 101.8, "published line k(e) = 0.5752 e + 0.1018 N/mm")
"""Kapteyn et al. 2021, eq. (14): the authors' model at the test point, 5 cm from the tip."""


def stiffness_curve_of(
    tip_stiffness: Callable[[float], float],
    limits: tuple[float, float],
    name: str = "finite element model",
) -> StiffnessCurve:
    """Approximate the tip stiffness of a structural model by a Chebyshev polynomial of e.

    Between the interpolation nodes the polynomial must agree with the model within
    `TABLE_TOLERANCE`.

    Parameters
    ----------
    tip_stiffness : callable
        Returns load over displacement 5 cm from the tip [N/m] for a value of e.
    limits : (float, float)
        The range of e in which the model is valid.

    Raises
    ------
    PosteriorError
        If the curve is too rough for a polynomial.
    """
    stiffness = np.vectorize(tip_stiffness, otypes=[float])
    polynomial = Chebyshev.interpolate(stiffness, _DEGREE, domain=limits)
    points_between_nodes = np.linspace(*limits, 2 * _DEGREE)
    error = float(
        np.max(np.abs(polynomial(points_between_nodes) / stiffness(points_between_nodes) - 1.0))
    )
    if error > TABLE_TOLERANCE:
        raise PosteriorError(
            f"the tip stiffness of {name} over e in [{limits[0]:g}, {limits[1]:g}] is too rough "
            f"for a polynomial: the relative error is {error:.1g} at degree {_DEGREE}."
        )
    return StiffnessCurve(polynomial, name)


def push_forward(posterior: ScalarPosterior, curve: StiffnessCurve) -> ScalarPosterior:
    """Return the density of the stiffness k(e), given that of e: p(k) = p(e) / (dk/de).

    Values of e for which the stiffness is not positive are left out.
    """
    stiffness = curve.stiffness(posterior.grid)
    is_positive = stiffness > 0.0
    density = posterior.density[is_positive] / curve.slope(posterior.grid[is_positive])
    return ScalarPosterior(stiffness[is_positive], density)
