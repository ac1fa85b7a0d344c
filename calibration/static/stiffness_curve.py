"""Tip stiffness as a function of the Young's modulus factor: Kapteyn et al. 2021, eq. (14)."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator

from calibration.errors import StiffnessCurveError

TABLE_TOLERANCE = 1e-7
"""Largest relative error of a tabulated curve at the middles between its nodes."""

_INVERSE_TABLE_SIZE = 20_001


class StiffnessCurve(Protocol):
    """A strictly increasing map k(e) from the Young's modulus factor to the tip stiffness.

    Attributes
    ----------
    name : str
        What the curve is, for reports.
    lower, upper : float
        The range of e in which the curve may be trusted; it continues beyond it, so that tails of a
        sampled density can be mapped, but no posterior may rest there.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def lower(self) -> float: ...  # noqa: D102

    @property
    def upper(self) -> float: ...  # noqa: D102

    def stiffness(self, young_modulus_factor: ArrayLike) -> NDArray[np.float64]:
        """Return k(e) [N/m], elementwise."""

    def slope(self, young_modulus_factor: ArrayLike) -> NDArray[np.float64]:
        """Return dk/de [N/m], elementwise."""

    def young_modulus_factor(self, stiffness: ArrayLike) -> NDArray[np.float64]:
        """Return the inverse e(k), elementwise; `stiffness` in N/m."""


@dataclass(frozen=True)
class LinearStiffnessCurve:
    """The line k(e) = gradient * e + intercept.

    Attributes
    ----------
    gradient : float
        dk/de, the part of the stiffness that the skin carries [N/m].
    intercept : float
        The part of the stiffness that does not depend on e [N/m].
    name : str
        What the line is.
    lower, upper : float
        The range of e in which the line may be trusted.

    Raises
    ------
    StiffnessCurveError
        If the line does not rise, or is not positive over its range.
    """

    gradient: float
    intercept: float
    name: str = "line"
    lower: float = 0.0
    upper: float = math.inf

    def __post_init__(self) -> None:
        if not (math.isfinite(self.gradient) and self.gradient > 0.0 and math.isfinite(self.intercept)):
            raise StiffnessCurveError(
                f"a stiffness line must be finite and rise with e, but its gradient is {self.gradient:g} N/m "
                f"and its intercept {self.intercept:g} N/m."
            )
        if not self.lower < self.upper or self.gradient * self.lower + self.intercept < 0.0:
            raise StiffnessCurveError(
                f"a stiffness line needs a range of e in which it is positive, but over [{self.lower:g}, "
                f"{self.upper:g}] it begins at {self.gradient * self.lower + self.intercept:g} N/m."
            )

    def stiffness(self, young_modulus_factor: ArrayLike) -> NDArray[np.float64]:
        """Return k(e) [N/m], elementwise."""
        return np.asarray(self.gradient * np.asarray(young_modulus_factor, dtype=float) + self.intercept)

    def slope(self, young_modulus_factor: ArrayLike) -> NDArray[np.float64]:
        """Return dk/de [N/m], elementwise."""
        return np.full(np.shape(young_modulus_factor), self.gradient)

    def young_modulus_factor(self, stiffness: ArrayLike) -> NDArray[np.float64]:
        """Return the inverse e(k), elementwise; `stiffness` in N/m."""
        return np.asarray((np.asarray(stiffness, dtype=float) - self.intercept) / self.gradient)


PUBLISHED_LINE = LinearStiffnessCurve(
    gradient=575.2, intercept=101.8, name="published line k(e) = 0.5752 e + 0.1018 N/mm"
)
"""Kapteyn et al. 2021, eq. (14): the authors' finite element model at the test point, 5 cm from the tip."""


class TipStiffnessModel(Protocol):
    """What a structural model must offer to be calibrated, as `fe.runtime.reduced.ReducedModel` does."""

    def tip_stiffness(self, young_modulus_factor: float) -> float:
        """Return load over displacement 5 cm from the tip [N/m]."""


@dataclass(frozen=True, eq=False)
class TabulatedStiffnessCurve:
    """A curve through nodes: monotone cubic (PCHIP) between them, straight lines beyond them.

    Attributes
    ----------
    factors : (N,) array
        Ascending values of e [1].
    stiffnesses : (N,) array
        k at the nodes, positive and ascending [N/m].
    name : str
        What the curve is.
    table_error : float
        Largest relative error of k between the nodes, as found when the table was made; NaN if unknown.

    Raises
    ------
    StiffnessCurveError
        If there are fewer than four nodes, or they are not finite, ascending and positive.
    """

    factors: NDArray[np.float64]
    stiffnesses: NDArray[np.float64]
    name: str = "table"
    table_error: float = math.nan
    _spline: PchipInterpolator = field(init=False, repr=False)
    _derivative: PchipInterpolator = field(init=False, repr=False)
    _inverse: tuple[NDArray[np.float64], NDArray[np.float64]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        factors = np.array(self.factors, dtype=float)
        stiffnesses = np.array(self.stiffnesses, dtype=float)
        if factors.ndim != 1 or factors.shape != stiffnesses.shape or factors.size < 4:
            raise StiffnessCurveError(
                "a tabulated stiffness curve needs two vectors of one length with at least four nodes, but "
                f"their shapes are {factors.shape} and {stiffnesses.shape}."
            )
        finite = bool(np.all(np.isfinite(factors)) and np.all(np.isfinite(stiffnesses)))
        if not finite or np.any(np.diff(factors) <= 0.0):
            raise StiffnessCurveError("the nodes of a stiffness curve must be finite and ascend in e.")
        if stiffnesses[0] <= 0.0 or np.any(np.diff(stiffnesses) <= 0.0):
            worst = int(np.argmin(np.diff(stiffnesses)))
            raise StiffnessCurveError(
                f"the tip stiffness must be positive and rise with e, but {self.name} goes from "
                f"{stiffnesses[worst]:g} to {stiffnesses[worst + 1]:g} N/m between e = {factors[worst]:g} "
                f"and {factors[worst + 1]:g}."
            )
        spline = PchipInterpolator(factors, stiffnesses, extrapolate=False)
        fine = np.linspace(factors[0], factors[-1], _INVERSE_TABLE_SIZE)
        object.__setattr__(self, "factors", factors)
        object.__setattr__(self, "stiffnesses", stiffnesses)
        object.__setattr__(self, "_spline", spline)
        object.__setattr__(self, "_derivative", spline.derivative())
        object.__setattr__(self, "_inverse", (spline(fine), fine))

    @property
    def lower(self) -> float:
        """Smallest e of the table."""
        return float(self.factors[0])

    @property
    def upper(self) -> float:
        """Largest e of the table."""
        return float(self.factors[-1])

    def stiffness(self, young_modulus_factor: ArrayLike) -> NDArray[np.float64]:
        """Return k(e) [N/m], elementwise."""
        factor = np.asarray(young_modulus_factor, dtype=float)
        inside = np.clip(factor, self.lower, self.upper)
        return np.asarray(self._spline(inside) + (factor - inside) * self._derivative(inside))

    def slope(self, young_modulus_factor: ArrayLike) -> NDArray[np.float64]:
        """Return dk/de [N/m], elementwise."""
        factor = np.asarray(young_modulus_factor, dtype=float)
        return np.asarray(self._derivative(np.clip(factor, self.lower, self.upper)))

    def young_modulus_factor(self, stiffness: ArrayLike) -> NDArray[np.float64]:
        """Return the inverse e(k), elementwise; `stiffness` in N/m."""
        value = np.asarray(stiffness, dtype=float)
        inside = np.clip(value, self.stiffnesses[0], self.stiffnesses[-1])
        end_slope = np.where(value < inside, self._derivative(self.lower), self._derivative(self.upper))
        return np.asarray(np.interp(inside, *self._inverse) + (value - inside) / end_slope)


def stiffness_curve_of(
    model: TipStiffnessModel,
    *,
    lower: float | None = None,
    upper: float | None = None,
    name: str = "finite element model",
) -> TabulatedStiffnessCurve:
    """Tabulate the tip stiffness of a structural model over its range of e.

    The table is refined until the monotone cubic meets the model at the middles between the nodes
    within `TABLE_TOLERANCE`.

    Parameters
    ----------
    model : TipStiffnessModel
        Offers `tip_stiffness(young_modulus_factor)` [N/m].
    lower, upper : float, optional
        Range of e; by default the model's `validity["young_modulus_factor"]` where it has one, else
        [0.9, 1.1].
    name : str
        What the curve is, for reports.

    Raises
    ------
    StiffnessCurveError
        If the curve is not positive and rising, or too rough for a table of 2049 nodes.
    """
    validity = getattr(model, "validity", {}).get("young_modulus_factor", (0.9, 1.1))
    lower = float(validity[0]) if lower is None else lower
    upper = float(validity[1]) if upper is None else upper
    if not (math.isfinite(lower) and math.isfinite(upper) and 0.0 < lower < upper):
        raise StiffnessCurveError(
            f"the range of e must ascend and be positive, but it is [{lower:g}, {upper:g}]."
        )
    evaluate: Callable[[float], float] = model.tip_stiffness
    factors = np.linspace(lower, upper, 17)
    stiffnesses = np.array([evaluate(float(factor)) for factor in factors])
    while True:
        curve = TabulatedStiffnessCurve(factors, stiffnesses, name=name)
        middles = 0.5 * (factors[1:] + factors[:-1])
        exact = np.array([evaluate(float(factor)) for factor in middles])
        error = float(np.max(np.abs(curve.stiffness(middles) / exact - 1.0)))
        if error <= TABLE_TOLERANCE:
            return TabulatedStiffnessCurve(factors, stiffnesses, name=name, table_error=error)
        if factors.size > 2048:
            raise StiffnessCurveError(
                f"the tip stiffness of {name} over e in [{lower:g}, {upper:g}] is too rough to tabulate: the "
                f"relative error is {error:.1g} with {factors.size} nodes."
            )
        order = np.argsort(np.concatenate([factors, middles]))
        factors = np.concatenate([factors, middles])[order]
        stiffnesses = np.concatenate([stiffnesses, exact])[order]
