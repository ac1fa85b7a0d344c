"""What is known of a wing before the ring-down, and what it shows: priors, weighed mass, and a table.

A healthy wing's figures are polynomials of its parameters there, so that many states cost little.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.chebyshev import chebval3d, chebvander3d
from numpy.typing import ArrayLike

from calibration.errors import OutsideValidityError, PosteriorError, said
from calibration.result.record import CalibratedFigure, ParameterPrior, Reading
from calibration.static.posterior import PRIOR_DEVIATION, StiffnessCurve, stiffness_curve_of
from fe.runtime.modal_system import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from reporting.arrays import Float

TOTAL_MASS = 0.472
"""Weighed mass of two servos and the pitot tube [kg] (Kapteyn et al. 2021, eqs. (19) and (20))."""

MODEL_ERROR = (0.01, 0.05)
"""How far the model's two frequencies may lie from those of the wing with the very same digital state [1].

The wing's frequency is f_i (1 + delta_i) with the model's f_i and independent delta_i ~ N(0, tau_i^2); these
are tau_1 and tau_2. See `docs/calibration.md` for the choice and for other choices.
"""


def weighed(mass: float = TOTAL_MASS, deviation: float = 1e-3) -> Reading:
    """Return the reading of a weighing of two servos and the pitot tube [kg].

    The paper gives no uncertainty: 1 g is our choice, a scale that shows grams and leads that may or may not
    have been weighed.
    """
    return Reading("weighed_mass", "weighing", mass, deviation)


_PAPER, _OURS = "the paper", "our choice"
_PRIORS = {
    "young_modulus_factor": ("1", 1.0, PRIOR_DEVIATION, _PAPER, "factor on Young's modulus of the skin, e"),
    "servo_mass": ("kg", TOTAL_MASS / 3.0, 0.05, _OURS, "mass of each servo"),
    "pitot_mass": ("kg", TOTAL_MASS / 3.0, 0.10, _OURS, "mass of the pitot tube"),
    "damping_alpha": ("1/s", 0.0, 3.0, _OURS, "mass-proportional Rayleigh damping, alpha"),
    "damping_beta": ("s", 0.0, 1.5e-3, _OURS, "stiffness-proportional Rayleigh damping, beta"),
}
SHIPPED_PRIOR = {
    "young_modulus_factor": (1.0073, 0.0103),
    "servo_mass": (0.1685, 0.0041),
    "pitot_mass": (0.1350, 0.0083),
    "damping_alpha": (1.03, 0.37),
    "damping_beta": (7.56e-4, 1.84e-4),
}
"""Mean and standard deviation of the calibrated state of the shipped wing (docs/calibration.md): e of the
paper, its masses, and the damping of the joint posterior, whose spread holds the measurement too."""
_DAMPING_RANGES = {"damping_alpha": (0.0, 20.0), "damping_beta": (0.0, 1e-2)}


def wing_priors(
    validity: Mapping[str, tuple[float, float]], **stated: tuple[float, float]
) -> tuple[ParameterPrior, ...]:
    """Return the priors of e, masses and damping for a model of this validity, in the order of `STATE`.

    e is the paper's N(1, (0.05 / 1.96)^2). The others are weak: of the masses a third of the weighed total
    each, with standard deviations of 50 and 100 g, which under the weighed total leave 30 g of uncertainty to
    a servo; of the damping half Gaussians from zero, of scales 3 1/s and 1.5e-3 s, which alone would damp
    mode 1 by 4 % and mode 2 by 14 %, twice what was measured. e and the masses are confined to the range of
    the model.

    Parameters
    ----------
    validity : mapping of str to (float, float)
        Range of e and the masses.
    **stated : (float, float)
        Mean and standard deviation by name, in the place of these.
    """
    ranges = {**validity, **_DAMPING_RANGES}
    return tuple(
        ParameterPrior(name, unit, *stated.get(name, (mean, deviation)), *ranges[name], stated_by, title)
        for name, (unit, mean, deviation, stated_by, title) in _PRIORS.items()
    )


QUANTITIES = (
    CalibratedFigure("tip_stiffness", "N/m", "tip stiffness"),
    CalibratedFigure("frequency_1", "Hz", "natural frequency of the first flapwise bending mode"),
    CalibratedFigure("frequency_2", "Hz", "natural frequency of the second flapwise bending mode"),
    CalibratedFigure("damping_ratio_1", "1", "damping ratio of the first flapwise bending mode"),
    CalibratedFigure("damping_ratio_2", "1", "damping ratio of the second flapwise bending mode"),
    CalibratedFigure("weighed_mass", "kg", "mass of two servos and the pitot tube"),
)
"""What is measured of a wing and follows from its parameters."""

TOLERANCE = 1e-5
"""Largest relative error of a tabulated frequency that is accepted; 0.1 % of f1 is 1 g of servo mass."""

_DEGREES = ((5, 7, 7), (8, 11, 11))
_CHECKS = 128
_NAMES = ("young_modulus_factor", "servo_mass", "pitot_mass")


@dataclass(frozen=True, eq=False)
class WingTable:
    """Chebyshev polynomials of ln f1 and ln f2 over the range of a model, and its tip stiffness.

    Attributes
    ----------
    limits : (3, 2) array
        Range of e [1], servo mass and pitot mass [kg].
    coefficient : (I, J, K, 2) array
        Of the products of Chebyshev polynomials in the three scaled parameters.
    stiffness : StiffnessCurve
        k(e) of the tip.
    error : float
        Largest relative error of a frequency, found at points between the nodes [1].
    """

    limits: Float
    coefficient: Float
    stiffness: StiffnessCurve
    error: float = 0.0

    @property
    def validity(self) -> dict[str, tuple[float, float]]:
        """Range of e and the masses in which the table holds."""
        return {name: (low, high) for name, (low, high) in zip(_NAMES, self.limits.tolist(), strict=True)}

    def frequency(self, states: ArrayLike) -> Float:
        """Return f1 and f2 (N, 2) [Hz] at rows (N, 3 or more) of e [1] and the masses [kg].

        Raises
        ------
        OutsideValidityError
            If a state lies outside the range of the model or is not finite.
        """
        points = np.atleast_2d(np.asarray(states, dtype=np.float64))[:, :3]
        inside = (points >= self.limits[:, 0]) & (points <= self.limits[:, 1])
        if not inside.all():
            row, place = np.argwhere(~inside)[0]
            prior = wing_priors(self.validity)[place]
            unit = f" {prior.figure.shown_unit}".rstrip()
            value = points[row, place]
            raise OutsideValidityError(said("joint.outside", prior=prior, value=value, unit=unit))
        scaled = (2.0 * points - self.limits.sum(axis=1)) / np.diff(self.limits, axis=1)[:, 0]
        return _values(scaled, self.coefficient)

    def outputs(self, states: Float) -> Float:
        """Return `QUANTITIES` (N, 6) of states (N, 5 or more), e, masses, alpha and beta first [SI].

        Raises
        ------
        OutsideValidityError
            As `frequency`.
        """
        frequency = self.frequency(states)
        factor, servo, pitot, alpha, beta = states[:, :5].T[:, :, None]
        ratio = rayleigh_damping_ratio(alpha, beta, frequency)
        return np.hstack([self.stiffness.stiffness(factor), frequency, ratio, 2.0 * servo + pitot])


def _values(scaled: Float, coefficient: Float) -> Float:
    first, second, third = scaled.T
    return np.asarray(np.exp(chebval3d(first, second, third, coefficient)).T)


def tabulate_wing(model: ReducedModel, tolerance: float = TOLERANCE) -> WingTable:
    """Tabulate a healthy model, its flapwise modes followed by their shape, and check between the nodes.

    Parameters
    ----------
    model : ReducedModel
        The wing.
    tolerance : float
        Largest relative error of a frequency at 128 points that fill the range evenly [1].

    Raises
    ------
    PosteriorError
        If no polynomial of the degrees tried meets the tolerance.
    PosteriorError
        As `stiffness_curve_of`.
    """
    limits = np.array([model.validity[name] for name in _NAMES])
    centre, half = limits.mean(axis=1), 0.5 * np.diff(limits, axis=1)[:, 0]
    from scipy.stats import qmc  # takes a second to load

    def exact(points: Float) -> Float:
        # a node may leave the range by a rounding error
        states = np.clip(centre + half * points, *limits.T)
        found = (model.modes(**dict(zip(_NAMES, state, strict=True))) for state in states.tolist())
        return np.array([modes.frequency[list(modes.followed)] for modes in found])

    curve = stiffness_curve_of(
        model.tip_stiffness, model.validity[_NAMES[0]], "tip stiffness of the tailored model"
    )
    checks = 2.0 * qmc.Halton(3, scramble=False).random(_CHECKS + 1)[1:] - 1.0
    expected = exact(checks)
    error = np.inf
    for degrees in _DEGREES:
        nodes = [np.cos(np.pi * (np.arange(n + 1) + 0.5) / (n + 1)) for n in degrees]
        grid = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 3)
        first, second, third = grid.T
        coefficient = np.linalg.solve(chebvander3d(first, second, third, degrees), np.log(exact(grid)))
        coefficient = coefficient.reshape(*(degree + 1 for degree in degrees), 2)
        error = float(np.abs(_values(checks, coefficient) / expected - 1.0).max())
        if error <= tolerance:
            return WingTable(limits, coefficient, curve, error)
    raise PosteriorError(said("joint.rough", error=error, tolerance=tolerance))
