"""A catalogue entry: a named effect, its parameters with priors, and the patch that it stands for."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import exp, log
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field, Strict
from scipy.special import ndtr, ndtri

from discrepancy.campaign.records import Campaign, TrialKind
from discrepancy.system.interface import Model
from discrepancy.system.scales import Scales
from fe.runtime.patch import ModelPatch

NINETY = 1.6448536269514722
"""Standard normal quantile of 0.95."""
Number = Annotated[float, Strict()]
ROW = ConfigDict(extra="forbid", allow_inf_nan=False, str_min_length=1)
"""How a table of an entry is read as one of these records."""
LEAST_SHRINKAGE = 0.3
"""A step takes no positive value below this share of itself."""


@dataclass(frozen=True)
class Prior:
    """Prior of one number, as a map of a standard normal variable u.

    Attributes
    ----------
    shape : {"log_normal", "normal", "uniform"}
        "log_normal": 90 % of the mass between `low` and `high`, both positive; "normal": the same; "uniform":
        between them.
    low, high : float
        See there.
    """

    __pydantic_config__ = ROW

    shape: Literal["log_normal", "normal", "uniform"]
    low: Number
    high: Number

    def _line(self) -> tuple[float, float]:
        """Return mean and deviation of the value, or of its logarithm."""
        low, high = self.low, self.high
        if self.shape == "log_normal":
            low, high = log(low), log(high)
        return 0.5 * (low + high), 0.5 * (high - low) / NINETY

    def value(self, u: float) -> float:
        """Return the value at the standard normal variable `u`."""
        if self.shape == "uniform":
            return self.low + (self.high - self.low) * float(ndtr(u))
        mean, deviation = self._line()
        return exp(mean + deviation * u) if self.shape == "log_normal" else mean + deviation * u

    def normal(self, value: float) -> float:
        """Return the standard normal variable of a value; the inverse of `value`."""
        if self.shape == "uniform":
            return float(ndtri(min(max((value - self.low) / (self.high - self.low), 1e-12), 1.0 - 1e-12)))
        mean, deviation = self._line()
        return ((log(value) if self.shape == "log_normal" else value) - mean) / deviation

    def stepped(self, u: float, step: float) -> float:
        """Return the standard normal variable after a step, taken along the value's tangent.

        What follows a value in proportion is far from following its logarithm.
        """
        if self.shape != "log_normal":
            return u + step
        slope = self._line()[1]
        return u + log(max(1.0 + slope * step, LEAST_SHRINKAGE)) / slope


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect.

    Attributes
    ----------
    name, symbol, unit, description : str
        Full name in snake case, the symbol of the equation, SI unit ("1" without), one line.
    prior : Prior
        In the unit.
    magnitude : bool
        Whether the effect vanishes with this parameter.
    levels : int
        Number of values, evenly over the prior, at which fits may begin; 0 leaves the choice to the search.
    """

    __pydantic_config__ = ROW

    name: str
    symbol: str
    unit: str
    description: str
    prior: Prior
    magnitude: Annotated[bool, Strict()] = False
    levels: Annotated[int, Strict()] = 0


@dataclass(frozen=True)
class ShapeParameter:
    """A number that is fixed in the named effect and free in its family (the shape gate frees it).

    Attributes
    ----------
    name, symbol, description : str
        As of `EffectParameter`.
    canonical : float
        Value in the named effect.
    prior : Prior
        Within the family.
    """

    __pydantic_config__ = ROW

    name: str
    symbol: str
    description: str
    canonical: Number
    prior: Prior
    unit: ClassVar[str] = "1"
    magnitude: ClassVar[bool] = False
    levels: ClassVar[int] = 0


@dataclass(frozen=True)
class Setting:
    """Where an effect is to be built: campaign, model, natural scales.

    `largest` keeps the largest readings that were found, as patches are built at every step of a fit.
    """

    campaign: Campaign
    model: Model
    scales: Scales
    largest: dict[object, float] = field(default_factory=dict, init=False, compare=False, repr=False)


Build = Callable[[Setting, Mapping[str, float], str], ModelPatch]


@dataclass(frozen=True, kw_only=True)
class EffectKeys:
    """What an effect has as its file says it.

    Attributes
    ----------
    identifier : str
        Lower case with underscores, such as "coulomb_friction"; stable. `id` in files.
    name : str
        The field's standard term.
    family : str
        Name of the free-shape family that it belongs to, such as "damping |v|^p |x|^a".
    equation, signature, reference : str
        One line each.
    acts_on : frozenset of TrialKind
        Trials that it changes.
    parameters : tuple of EffectParameter
        With priors, dimensionless wherever a scale of the setting can make them so.
    shape : tuple of ShapeParameter
        Freed by the shape gate.
    confusable : tuple of str
        Identifiers of effects that some campaigns cannot tell from it.
    spectral : str
        Name of a parameter that is a frequency over the first natural frequency; fits of it begin at peaks of
        the residuals' spectrum at the place, a channel. Empty if there is none.
    """

    identifier: Annotated[str, Field(alias="id")]
    name: str
    family: str
    equation: str
    signature: str
    reference: str
    acts_on: frozenset[TrialKind]
    parameters: tuple[EffectParameter, ...] = ()
    shape: tuple[ShapeParameter, ...] = ()
    confusable: tuple[str, ...] = ()
    spectral: str = ""


@dataclass(frozen=True, kw_only=True)
class Effect(EffectKeys):
    """A named effect.

    Attributes
    ----------
    build : callable
        (setting, values by name of parameters and shape, place) -> patch. A missing shape value is canonical.
    places : callable
        setting -> the discrete places where it may act (channel names, ports, runs, mains frequencies); ("",)
        if there is no choice.
    unavailable : callable
        setting -> why it cannot be tested here, or None.
    """

    build: Build
    places: Callable[[Setting], tuple[str, ...]] = field(default=lambda setting: ("",))
    unavailable: Callable[[Setting], str | None] = field(default=lambda setting: None)

    def canonical_shape(self) -> dict[str, float]:
        """Return the shape values of the named effect."""
        return {item.name: item.canonical for item in self.shape}

    def patch(self, setting: Setting, values: Mapping[str, float], place: str = "") -> ModelPatch:
        """Return the patch at given values; shape values that are not given are canonical."""
        return self.build(setting, {**self.canonical_shape(), **values}, place)
