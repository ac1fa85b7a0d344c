"""Densities of one unknown: the Gaussian prior, and a posterior given on a grid."""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.special import ndtri

Seed = int | np.random.SeedSequence
"""A seed: a whole number, or a SeedSequence spawned for the purpose."""

PRIOR_DEVIATION = 0.05 / 1.96
"""Half-width of the prior's 95 % interval of e (Kapteyn et al. 2021, calibration step 2)."""


def stratified(generator: np.random.Generator, count: int) -> NDArray[np.float64]:
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

    def log_density(self, value: ArrayLike) -> NDArray[np.float64]:
        """Return the logarithm of the density, elementwise."""
        standard = (np.asarray(value, dtype=float) - self.mean) / self.standard_deviation
        return np.asarray(-0.5 * standard**2 - math.log(self.standard_deviation * math.sqrt(2.0 * math.pi)))

    def density(self, value: ArrayLike) -> NDArray[np.float64]:
        """Return the density, elementwise."""
        return np.exp(self.log_density(value))

    def quantile(self, probability: ArrayLike) -> NDArray[np.float64]:
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

    grid: NDArray[np.float64]
    density: NDArray[np.float64]
    mean: float = math.nan
    standard_deviation: float = math.nan
    _cumulative: NDArray[np.float64] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        grid, density = self.grid, self.density / np.trapezoid(self.density, self.grid)
        cumulative = cumulative_trapezoid(density, grid, initial=0.0)
        mean = float(np.trapezoid(density * grid, grid)) if math.isnan(self.mean) else self.mean
        variance = float(np.trapezoid(density * (grid - mean) ** 2, grid))
        given = self.standard_deviation
        found = {
            "density": density, "_cumulative": cumulative / cumulative[-1], "mean": mean,
            "standard_deviation": math.sqrt(variance) if math.isnan(given) else given,
        }  # fmt: skip
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def cumulative(self, value: ArrayLike) -> NDArray[np.float64]:
        """Return the distribution function, elementwise."""
        return np.asarray(np.interp(np.asarray(value, dtype=float), self.grid, self._cumulative))

    def quantile(self, probability: ArrayLike) -> NDArray[np.float64]:
        """Return quantiles, elementwise: the inverse of `cumulative`."""
        return np.asarray(np.interp(np.asarray(probability, dtype=float), self._cumulative, self.grid))

    def interval(self, probability: float = 0.95) -> tuple[float, float]:
        """Return the central interval that holds `probability`."""
        tail = 0.5 * (1.0 - probability)
        lower, upper = self.quantile([tail, 1.0 - tail])
        return float(lower), float(upper)

    def samples(self, seed: Seed, count: int) -> NDArray[np.float64]:
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
