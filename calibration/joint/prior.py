"""What is known of a wing before the ring-down: priors, weighed mass, error of the model."""

from collections.abc import Mapping

from calibration.result.record import ParameterPrior, Reading
from calibration.static.experiments import HALF_WIDTH_95
from calibration.static.posterior import PRIOR_HALF_WIDTH

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


_OURS = "our choice"
_PRIORS = {
    "young_modulus_factor": (
        "1",
        1.0,
        PRIOR_HALF_WIDTH / HALF_WIDTH_95,
        "the paper",
        "factor on Young's modulus of the skin, e",
    ),
    "servo_mass": ("kg", TOTAL_MASS / 3.0, 0.05, _OURS, "mass of each servo"),
    "pitot_mass": ("kg", TOTAL_MASS / 3.0, 0.10, _OURS, "mass of the pitot tube"),
    "damping_alpha": ("1/s", 0.0, 3.0, _OURS, "mass-proportional Rayleigh damping, alpha"),
    "damping_beta": ("s", 0.0, 1.5e-3, _OURS, "stiffness-proportional Rayleigh damping, beta"),
}
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
