"""What is known before the ring-down: priors of the five quantities, weighed masses, error of the model."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from calibration.dynamics.masses_and_damping import TOTAL_MASS
from calibration.errors import PosteriorError
from calibration.static.posterior import GaussianPrior

NAMES = ("young_modulus_factor", "servo_mass", "pitot_mass", "damping_alpha", "damping_beta")
"""The quantities of the joint posterior: e [1], each servo [kg], the pitot tube [kg], [1/s], [s]."""

DEFAULT_MODEL_ERROR = (0.01, 0.05)
"""Relative standard deviations of the model's first two flapwise frequencies about the wing's [1]."""


class WeighedMass(NamedTuple):
    """Weighed mass of two servos and the pitot tube, and the standard deviation of the weighing [kg].

    The mass is that of Kapteyn et al. 2021, eqs. (19) and (20). The paper gives no uncertainty: 1 g is our
    choice, a scale that shows grams and leads that may or may not have been weighed.
    """

    mass: float = TOTAL_MASS
    standard_deviation: float = 1e-3


class ModelError(NamedTuple):
    """How far the model's frequencies may lie from those of the wing with the very same digital state.

    The wing's frequency is f_i (1 + delta_i) with the model's f_i and delta_i ~ N(0, tau_i^2), independent;
    `frequency` holds tau_1, tau_2 [1]. See `docs/calibration.md` for the choice and for other choices.
    """

    frequency: tuple[float, float] = DEFAULT_MODEL_ERROR


@dataclass(frozen=True)
class JointPrior:
    """Independent Gaussian priors of the five quantities, cut off where the wing or its model ends.

    e and the masses are confined to the range of the model, the Rayleigh coefficients to positive values.

    Attributes
    ----------
    young_modulus_factor : GaussianPrior
        e; the paper's N(1, (0.05 / 1.96)^2).
    servo_mass, pitot_mass : GaussianPrior
        Weak: a third of the weighed total each, with standard deviations of 50 and 100 g. Under the weighed
        total they leave 30 g of uncertainty to a servo.
    damping_alpha, damping_beta : GaussianPrior
        Weak: half Gaussians from zero, of scales 3 1/s and 1.5e-3 s; these alone would damp mode 1 by 4 %
        and mode 2 by 14 %, twice what was measured.
    """

    young_modulus_factor: GaussianPrior = field(default_factory=GaussianPrior)
    servo_mass: GaussianPrior = field(default_factory=lambda: GaussianPrior(TOTAL_MASS / 3.0, 0.05))
    pitot_mass: GaussianPrior = field(default_factory=lambda: GaussianPrior(TOTAL_MASS / 3.0, 0.10))
    damping_alpha: GaussianPrior = field(default_factory=lambda: GaussianPrior(0.0, 3.0))
    damping_beta: GaussianPrior = field(default_factory=lambda: GaussianPrior(0.0, 1.5e-3))

    @property
    def marginals(self) -> tuple[GaussianPrior, ...]:
        """The five Gaussians in the order of `NAMES`."""
        return tuple(getattr(self, name) for name in NAMES)

    def limits(self, validity: Mapping[str, tuple[float, float]]) -> NDArray[np.float64]:
        """Return the (5, 2) limits of the quantities for a model of this validity."""
        confined = [validity[name] for name in NAMES[:3]]
        return np.array([*confined, (0.0, math.inf), (0.0, math.inf)])

    def log_mass_inside(self, limits: NDArray[np.float64]) -> float:
        """Return the log probability that the Gaussians give to the region within the limits.

        Raises
        ------
        PosteriorError
            If less than 1e-6 of a Gaussian lies there.
        """
        total = 0.0
        for name, prior, (lower, upper) in zip(NAMES, self.marginals, limits.tolist(), strict=True):
            inside = float(np.diff(_cumulative(prior, np.array([lower, upper])))[0])
            if not inside > 1e-6:
                raise PosteriorError(
                    f"the prior of {name}, {prior.mean:g} ± {prior.standard_deviation:g}, lies outside "
                    f"{lower:g} to {upper:g}, where the model holds; choose another prior or a wider model."
                )
            total += math.log(inside)
        return total

    def samples(
        self, validity: Mapping[str, tuple[float, float]], generator: np.random.Generator, count: int
    ) -> NDArray[np.float64]:
        """Draw (count, 5) independent samples of `NAMES` in SI units, within the limits."""
        limits = self.limits(validity)
        self.log_mass_inside(limits)
        probability = generator.random((count, len(NAMES)))
        drawn = np.empty_like(probability)
        for place, prior in enumerate(self.marginals):
            lower, upper = _cumulative(prior, limits[place])
            standard = ndtri(lower + (upper - lower) * probability[:, place])
            drawn[:, place] = np.clip(prior.mean + prior.standard_deviation * standard, *limits[place])
        return drawn


def _cumulative(prior: GaussianPrior, value: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(ndtr((value - prior.mean) / prior.standard_deviation))
