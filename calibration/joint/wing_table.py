"""Priors of a wing's parameters, its weighed mass, and a table of its outputs.

The table consists of polynomials of the parameters of a healthy wing, so that many states can be
evaluated at little cost.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial.chebyshev import chebval3d, chebvander3d
from numpy.typing import ArrayLike

from calibration.errors import OutsideValidityError, PosteriorError
from calibration.result.record import CalibratedQuantity, ParameterPrior, QuantityReading
from calibration.static.posterior import PRIOR_DEVIATION, StiffnessCurve, stiffness_curve_of
from fe.runtime.modal_system import rayleigh_damping_ratio
from fe.runtime.reduced import ReducedModel
from reporting.arrays import Float

TOTAL_MASS = 0.472
"""Weighed mass of two servos and the pitot tube [kg] (Kapteyn et al. 2021, eqs. (19) and (20))."""

MODEL_ERROR = (0.01, 0.05)
"""Relative standard deviations of the model's two frequencies about those of the wing [1].

The frequency of a wing is f_i (1 + delta_i) with the frequency f_i of the model with the same
state, and independent delta_i ~ N(0, tau_i^2); these are tau_1 and tau_2. See
`docs/explanation/calibration.md` for the choice and for other choices.
"""


def weighed_mass(mass: float = TOTAL_MASS, deviation: float = 1e-3) -> QuantityReading:
    """Return the reading of a weighing of two servos and the pitot tube.

    The paper gives no uncertainty. Our choice is 1 g: a scale that shows grams, and leads that may
    or may not have been weighed.

    Parameters
    ----------
    mass, deviation : float
        The mass and its standard deviation [kg].
    """
    return QuantityReading("weighed_mass", "weighing", mass, deviation)


class _Prior(NamedTuple):
    """A Gaussian prior before its truncation, see `ParameterPrior`."""

    unit: str
    mean: float
    deviation: float
    stated_by: str
    title: str


_PAPER = "the paper"
_OURS = "our choice"
_PRIORS = {
    "young_modulus_factor": _Prior(
        "1", 1.0, PRIOR_DEVIATION, _PAPER, "factor on Young's modulus of the skin, e"
    ),
    "servo_mass": _Prior("kg", TOTAL_MASS / 3.0, 0.05, _OURS, "mass of each servo"),
    "pitot_mass": _Prior("kg", TOTAL_MASS / 3.0, 0.10, _OURS, "mass of the pitot tube"),
    "damping_alpha": _Prior("1/s", 0.0, 3.0, _OURS, "mass-proportional Rayleigh damping, alpha"),
    "damping_beta": _Prior(
        "s", 0.0, 1.5e-3, _OURS, "stiffness-proportional Rayleigh damping, beta"
    ),
}
SHIPPED_PRIOR = {
    "young_modulus_factor": (1.0073, 0.0103),
    "servo_mass": (0.1685, 0.0041),
    "pitot_mass": (0.1350, 0.0083),
    "damping_alpha": (1.03, 0.37),
    "damping_beta": (7.56e-4, 1.84e-4),
}
"""Mean and standard deviation of the calibrated state of the shipped wing
(docs/explanation/calibration.md): e of the paper, its masses, and the damping of the joint
posterior, whose standard deviation includes that of the measurement."""
_DAMPING_RANGES = {"damping_alpha": (0.0, 20.0), "damping_beta": (0.0, 1e-2)}


def wing_priors(
    validity: Mapping[str, tuple[float, float]], **stated: tuple[float, float]
) -> tuple[ParameterPrior, ...]:
    """Return the priors of a wing's stiffness, two masses and two damping coefficients.

    The stiffness is given by e, a factor on Young's modulus of the skin. Its prior is that of the
    paper, N(1, (0.05 / 1.96)^2). The other priors are weak:

    - Two servos and a pitot tube were weighed together. The mean of each of the three masses is a
      third of the total. The standard deviation is 50 g for a servo and 100 g for the pitot tube;
      given the total, that of a servo is 30 g.
    - The Rayleigh damping coefficients alpha and beta are not negative. Their priors are the
      halves above zero of Gaussians with mean zero and standard deviations 3 1/s and 1.5e-3 s. A
      coefficient of one standard deviation alone gives a damping ratio of 4 % (alpha, mode 1) or
      14 % (beta, mode 2), which is twice the measured ratio.

    Parameters
    ----------
    validity : mapping of str to (float, float)
        The least and the largest value of e and of each mass for which the model is valid. They
        limit the priors.
    **stated : (float, float)
        Means and standard deviations that replace the ones above, by the name of the parameter.
    """
    ranges = {**validity, **_DAMPING_RANGES}
    priors = []
    for name, prior in _PRIORS.items():
        mean, deviation = stated.get(name, (prior.mean, prior.deviation))
        low, high = ranges[name]
        priors.append(
            ParameterPrior(
                name=name,
                unit=prior.unit,
                mean=mean,
                deviation=deviation,
                low=low,
                high=high,
                stated_by=prior.stated_by,
                title=prior.title,
            )
        )
    return tuple(priors)


QUANTITIES = (
    CalibratedQuantity("tip_stiffness", "N/m", "tip stiffness"),
    CalibratedQuantity("frequency_1", "Hz", "natural frequency of the first flapwise bending mode"),
    CalibratedQuantity(
        "frequency_2", "Hz", "natural frequency of the second flapwise bending mode"
    ),
    CalibratedQuantity("damping_ratio_1", "1", "damping ratio of the first flapwise bending mode"),
    CalibratedQuantity("damping_ratio_2", "1", "damping ratio of the second flapwise bending mode"),
    CalibratedQuantity("weighed_mass", "kg", "mass of two servos and the pitot tube"),
)
"""The measured quantities that follow from the parameters of a wing."""

TOLERANCE = 1e-5
"""Largest relative error of a tabulated frequency; 1 g of servo mass changes f1 by 0.1 %."""

_DEGREES = (
    (5, 7, 7),
    (8, 11, 11),
)  # of the polynomials in the three parameters, which are tried in turn
_CHECK_COUNT = 128
_PARAMETERS = ("young_modulus_factor", "servo_mass", "pitot_mass")


@dataclass(frozen=True, eq=False)
class WingTable:
    """Chebyshev polynomials of ln f1 and ln f2 over the range of a model, and its tip stiffness.

    Attributes
    ----------
    limits : (3, 2) array
        The ranges of e [1], servo mass and pitot mass [kg].
    coefficients : (I, J, K, 2) array
        The coefficients of products of Chebyshev polynomials in e, servo mass and pitot mass, each
        scaled to [-1, 1]; I, J and K are the numbers of polynomials in each of them.
    error : float
        The largest relative error of a frequency at points between the nodes [1].
    """

    limits: Float
    coefficients: Float
    stiffness: StiffnessCurve
    error: float = 0.0

    @property
    def validity(self) -> dict[str, tuple[float, float]]:
        """The ranges of e and the masses for which the table is valid."""
        lower, upper = self.limits.T.tolist()
        ranges = zip(lower, upper, strict=True)
        return dict(zip(_PARAMETERS, ranges, strict=True))

    def frequency(self, states: ArrayLike) -> Float:
        """Return the natural frequencies (N, 2) [Hz] of both flapwise modes in N states.

        Parameters
        ----------
        states : (N, 3 or more) array
            States, whose first values are e [1] and the masses [kg].

        Raises
        ------
        OutsideValidityError
            If a state lies outside the range of the model or is not finite.
        """
        points = np.atleast_2d(np.asarray(states, dtype=np.float64))[:, :3]
        lower, upper = self.limits.T
        is_inside = (points >= lower) & (points <= upper)
        if not is_inside.all():
            state, parameter = np.argwhere(~is_inside)[0]
            prior = wing_priors(self.validity)[parameter]
            unit = f" {prior.quantity.printed_unit}".rstrip()
            raise OutsideValidityError(
                f"the {prior.title} is {points[state, parameter]:.4g}{unit}, but the model holds "
                f"for {prior.low:g} to {prior.high:g}{unit}; check the measurements, or build a "
                "model with a wider range."
            )
        unit_points = (2.0 * points - (lower + upper)) / (upper - lower)
        return _evaluate(unit_points, self.coefficients)

    def outputs(self, states: Float) -> Float:
        """Return the `QUANTITIES` (N, 6) [SI] of the wing in N states.

        Parameters
        ----------
        states : (N, 5 or more) array
            States, whose first values are e, masses, alpha and beta [SI].

        Raises
        ------
        OutsideValidityError
            If a state lies outside the range of the model or is not finite.
        """
        frequencies = self.frequency(states)
        # Each array is (N, 1), so that it is combined with the two columns of frequencies.
        factor, servo, pitot, alpha, beta = states[:, :5].T[:, :, None]
        damping_ratios = rayleigh_damping_ratio(alpha, beta, frequencies)
        total_masses = 2.0 * servo + pitot
        return np.hstack(
            [self.stiffness.stiffness(factor), frequencies, damping_ratios, total_masses]
        )


def _evaluate(unit_points: Float, coefficients: Float) -> Float:
    """Evaluate the frequencies (N, 2) [Hz] from the polynomials of their logarithms.

    The points (N, 3) are values of e, servo mass and pitot mass, each scaled to [-1, 1].
    """
    x, y, z = unit_points.T
    return np.asarray(np.exp(chebval3d(x, y, z, coefficients)).T)


def _interpolating_coefficients(
    nodes: Float, frequencies: Float, degrees: tuple[int, int, int]
) -> Float:
    """Return the Chebyshev coefficients that interpolate ln f1 and ln f2 at the nodes.

    Parameters
    ----------
    nodes : (N, 3) array
        The values of e, servo mass and pitot mass at the nodes, each scaled to [-1, 1].
    frequencies : (N, 2) array
        The frequencies f1 and f2 at the nodes [Hz].
    degrees : (int, int, int)
        The degrees I - 1, J - 1, K - 1 of the polynomials in the three parameters, with N = I J K.

    Returns
    -------
    (I, J, K, 2) array
        The coefficients of ln f1 and ln f2.
    """
    x, y, z = nodes.T
    # each row of the matrix holds the products of the polynomials at one node
    polynomials_at_nodes = chebvander3d(x, y, z, degrees)
    coefficients = np.linalg.solve(polynomials_at_nodes, np.log(frequencies))
    counts = [degree + 1 for degree in degrees]
    return np.asarray(coefficients.reshape(*counts, 2))


def _chebyshev_grid(degrees: tuple[int, int, int]) -> Float:
    """Return the grid (N, 3) of Chebyshev nodes for polynomials of some degrees."""
    nodes = []
    for degree in degrees:
        angles = np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1)
        nodes.append(np.cos(angles))
    return np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 3)


def tabulate_wing(model: ReducedModel, tolerance: float = TOLERANCE) -> WingTable:
    """Approximate a wing's frequencies and stiffness by polynomials, checked between their nodes.

    The flapwise modes are identified by their shapes, so that a crossing of frequencies does not
    exchange them.

    Parameters
    ----------
    model : ReducedModel
        The wing without damage.
    tolerance : float
        The largest relative error of a frequency at 128 points that fill the range evenly [1].

    Raises
    ------
    PosteriorError
        If no polynomial of the degrees tried meets the tolerance, or the tip stiffness is too rough
        for a polynomial.
    """
    from scipy.stats import qmc  # takes a second to import

    limits = np.array([model.validity[name] for name in _PARAMETERS])
    curve = stiffness_curve_of(
        model.tip_stiffness, model.validity[_PARAMETERS[0]], "tip stiffness of the tailored model"
    )
    # The first point of the sequence is a corner of the range.
    halton = qmc.Halton(3, scramble=False).random(_CHECK_COUNT + 1)[1:]
    check_points = 2.0 * halton - 1.0
    model_frequencies = _model_frequencies(model, limits, check_points)
    error = np.inf
    for degrees in _DEGREES:
        grid = _chebyshev_grid(degrees)
        grid_frequencies = _model_frequencies(model, limits, grid)
        coefficients = _interpolating_coefficients(grid, grid_frequencies, degrees)
        relative_errors = _evaluate(check_points, coefficients) / model_frequencies - 1.0
        error = float(np.abs(relative_errors).max())
        if error <= tolerance:
            return WingTable(limits, coefficients, curve, error)
    raise PosteriorError(
        "the flapwise frequencies of the model are not smooth over its range: a polynomial errs by "
        f"{error:.2g} where {tolerance:.2g} are allowed; build a model with a narrower range of "
        "masses."
    )


def _model_frequencies(model: ReducedModel, limits: Float, unit_points: Float) -> Float:
    """Compute the frequencies (N, 2) [Hz] of a model's flapwise modes in N states.

    `unit_points` (N, 3) are values of e, servo mass and pitot mass, each scaled from its range in
    `limits` (3, 2) to [-1, 1].
    """
    centre = limits.mean(axis=1)
    lower, upper = limits.T
    half_width = 0.5 * (upper - lower)
    # A node at an end may leave the range by a rounding error.
    states = np.clip(centre + half_width * unit_points, lower, upper)
    frequencies = []
    for state in states.tolist():
        modes = model.modes(**dict(zip(_PARAMETERS, state, strict=True)))
        frequencies.append(modes.frequency[list(modes.followed)])
    return np.array(frequencies)
