"""An entry of the catalogue: a named effect, its parameters with priors, and its patch."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import exp, log
from typing import Annotated, ClassVar, Literal

from pydantic import ConfigDict, Field, Strict
from scipy.special import ndtr, ndtri

from discrepancy.campaign.records import Campaign, FloatArray, TrialKind
from discrepancy.system.interface import Model
from discrepancy.system.scales import Scales
from fe.runtime.patch import ModelPatch
from reporting.formats.known_keys import TEXTS_ARE_READ

NINETY_PERCENT_QUANTILE = 1.6448536269514722
"""Standard normal quantile of 0.95."""
Number = Annotated[float, Strict()]
ROW = ConfigDict(
    extra="forbid", allow_inf_nan=False, str_min_length=1, use_attribute_docstrings=TEXTS_ARE_READ
)
"""How a table of a file of effects is checked as one of these records."""
FARTHEST_VALUE, FARTHEST_NORMAL = 8.0, 30.0
"""Largest standard normal variables that are fitted: of log-normal and uniform values, and of
normal ones."""
LEAST_SHRINKAGE = 0.3
"""Least factor by which one step of an iteration may multiply a positive value."""


@dataclass(frozen=True)
class Prior:
    """Prior of one number, as a map from a standard normal variable u."""

    __pydantic_config__ = ROW

    shape: Literal["log_normal", "normal", "uniform"]
    """Distribution: "log_normal" and "normal" have 90 % of their mass between `low` and `high`,
    "uniform" has all of it there."""
    low: Number
    """Lower bound, positive for "log_normal" [unit of the parameter]."""
    high: Number
    """Upper bound, positive for "log_normal" [unit of the parameter]."""

    @property
    def largest_standard_normal(self) -> float:
        """The largest magnitude of the standard normal variable that is fitted.

        What is proportional to a normal value, such as the stiffening of a spring, may be far
        larger than usual, and the evidence counts how improbable it is. In the other shapes a value
        would overflow, or be at an end of its range.
        """
        return FARTHEST_NORMAL if self.shape == "normal" else FARTHEST_VALUE

    def _mean_and_deviation(self) -> tuple[float, float]:
        """Return mean and standard deviation of the value, or of its logarithm if log-normal."""
        low, high = self.low, self.high
        if self.shape == "log_normal":
            low, high = log(low), log(high)
        return 0.5 * (low + high), 0.5 * (high - low) / NINETY_PERCENT_QUANTILE

    def value(self, u: float) -> float:
        """Return the value at the standard normal variable `u`."""
        if self.shape == "uniform":
            return self.low + (self.high - self.low) * float(ndtr(u))
        mean, deviation = self._mean_and_deviation()
        if self.shape == "log_normal":
            return exp(mean + deviation * u)
        return mean + deviation * u

    def standard_normal(self, value: float) -> float:
        """Return the standard normal variable of a value: the inverse of the method `value`."""
        if self.shape == "uniform":
            probability = (value - self.low) / (self.high - self.low)
            return float(ndtri(min(max(probability, 1e-12), 1.0 - 1e-12)))
        mean, deviation = self._mean_and_deviation()
        if self.shape == "log_normal":
            value = log(value)
        return (value - mean) / deviation

    def multiply(self, u: float, factor: float, lowest: float, highest: float) -> float:
        """Return the standard normal variable of a value times a factor.

        A log-normal value cannot change its sign: zero and less become the value at `lowest`.

        Parameters
        ----------
        u : float
            Standard normal variable of the value.
        factor : float
            The factor on the value.
        lowest, highest : float
            The limits of the returned variable.
        """
        product = factor * self.value(u)
        if self.shape == "log_normal":
            product = max(product, self.value(lowest))
        return min(max(self.standard_normal(product), lowest), highest)

    def step_along_tangent(self, u: float, step: float) -> float:
        """Return the standard normal variable after a step of a fit.

        For a log-normal value the step is made along the tangent of x(u) = exp(m + s u), where m
        and s are mean and standard deviation of log x. The reason is that predictions are often
        proportional to x, and so linear in x but not in u. Along the tangent a step d in u changes
        x by the factor 1 + s d, and thus u by log(1 + s d) / s. The factor is at least
        `LEAST_SHRINKAGE`, so that x stays positive. Other values are linear in u or are taken as
        such: the result is u + d.

        Parameters
        ----------
        u : float
            The standard normal variable before the step.
        step : float
            The step d in u that the linear equations of the fit give.
        """
        if self.shape != "log_normal":
            return u + step
        _, deviation_of_log = self._mean_and_deviation()
        factor = max(1.0 + deviation_of_log * step, LEAST_SHRINKAGE)
        return u + log(factor) / deviation_of_log


@dataclass(frozen=True)
class EffectParameter:
    """A parameter of an effect."""

    __pydantic_config__ = ROW

    name: str
    """Full name in snake case."""
    symbol: str
    """Symbol in the equation of the effect."""
    unit: str
    """Unit in SI; "1" if it has none."""
    description: str
    """One line."""
    prior: Prior
    """Prior, in the unit."""
    magnitude: Annotated[bool, Strict()] = False
    """True if the effect vanishes with this parameter."""
    levels: Annotated[int, Strict()] = 0
    """Number of values, evenly over the prior, at which fits may begin; 0 leaves the choice to the
    search. With 1, fits begin at the median, which also holds where no value is given."""


@dataclass(frozen=True)
class ShapeParameter:
    """An exponent or the like that is fixed in the named effect and free in its family.

    The shape gate frees it, to test whether the data determine the name.
    """

    __pydantic_config__ = ROW

    name: str
    """Full name in snake case."""
    symbol: str
    """Symbol in the equation of the effect."""
    description: str
    """One line."""
    canonical: Number
    """Value in the named effect [1]."""
    prior: Prior
    """Prior within the family."""
    unit: ClassVar[str] = "1"
    magnitude: ClassVar[bool] = False
    levels: ClassVar[int] = 0


@dataclass(frozen=True)
class Setting:
    """A campaign and a model in which effects are built.

    Attributes
    ----------
    campaign : Campaign
        The campaign.
    model : Model
        The model that effects are added to.
    scales : Scales
        Natural scales of the model in the campaign, which make parameters dimensionless.
    largest : dict
        Cache of the largest readings at places, because a fit builds patches at every step.
    """

    campaign: Campaign
    model: Model
    scales: Scales
    largest: dict[object, float] = field(
        default_factory=dict, init=False, compare=False, repr=False
    )


Build = Callable[[Setting, Mapping[str, float], str], ModelPatch]


@dataclass(frozen=True, kw_only=True)
class EffectKeys:
    """The entries of an effect that its file states."""

    identifier: Annotated[str, Field(alias="id")]
    """Stable identifier in lower case with underscores, such as "coulomb_friction"; `id` in
    files."""
    name: str
    """The field's standard term."""
    family: str
    """Family of laws that it belongs to, such as "damping |v|^p |x|^a"."""
    equation: str
    """Equation, in one line."""
    signature: str
    """What it changes in the data, in one line."""
    reference: str
    """Source, in one line."""
    acts_on: frozenset[TrialKind]
    """Kinds of trials that it changes."""
    parameters: tuple[EffectParameter, ...] = ()
    """Parameters with priors, dimensionless wherever a scale of the setting can make them so."""
    shape: tuple[ShapeParameter, ...] = ()
    """Numbers that the shape gate frees."""
    confusable: tuple[str, ...] = ()
    """Identifiers of effects that some campaigns cannot distinguish from it."""
    counterpart: str = ""
    """Identifier of the effect that stands for it in other kinds of models, such as that of a mesh
    for an effect of a wing. Empty if there is none."""
    spectral: str = ""
    """Name of a parameter that is a frequency over the first natural frequency; fits of it begin at
    peaks of the residuals' spectrum at the place, a channel. Empty if there is none."""
    at_several_places: Annotated[bool, Strict()] = False
    """Whether it may act at several places at once, with a size at each. A search for errors of
    whole simulations then adds it at a second place, too."""
    relative_frequency: Number | None = None
    """How often it occurs, compared with the other effects that state this [1]. Those that do not
    are equally probable."""


@dataclass(frozen=True, eq=False)
class ForceTable:
    """A force over the displacement or velocity of a port: functions with free amplitudes.

    At a port of a state it is a flow over the value of the state, such as a level.

    Attributes
    ----------
    variable : {"displacement", "velocity", "state"}
        What the force follows.
    points : (P,) ndarray
        The displacements or velocities, rising [m or rad, or per s]; or the values of the state.
    functions : (P, K) ndarray
        The force at each point for a unit of each of the K amplitudes [N or N m], or the flow.
    """

    variable: Literal["displacement", "velocity", "state"]
    points: FloatArray
    functions: FloatArray


@dataclass(frozen=True, kw_only=True)
class Effect(EffectKeys):
    """A named effect: the patch that adds it to a model, and where it may act.

    Attributes
    ----------
    build : callable
        Returns the patch by setting, values of parameters and shape by name, and place. A shape
        value that is missing is the canonical one.
    places : callable
        Returns the places where it may act in a setting (names of channels, ports, runs or mains
        lines); ("",) if there is no choice.
    unavailable : callable
        Returns why it cannot be tested in a setting, or None.
    variant_of : str
        Identifier of the effect of which this is a variant that acts only in an event; empty if it
        is none.
    prior_weight : float
        Prior probability over that of an effect without a stated frequency.
    table : ForceTable or None
        The table of a force of free shape, whose amplitudes are the parameters; None for a law.
    """

    build: Build
    places: Callable[[Setting], tuple[str, ...]] = field(default=lambda setting: ("",))
    unavailable: Callable[[Setting], str | None] = field(default=lambda setting: None)
    variant_of: str = ""
    prior_weight: float = 1.0
    table: ForceTable | None = None

    @property
    def kind(self) -> str:
        """The identifier of the effect of which this is a variant, or else its own."""
        return self.variant_of or self.identifier

    def canonical_shape(self) -> dict[str, float]:
        """Return the shape parameters of the named effect by name, such as the exponent 2."""
        return {parameter.name: parameter.canonical for parameter in self.shape}

    def patch(self, setting: Setting, values: Mapping[str, float], place: str = "") -> ModelPatch:
        """Return the patch that adds the effect to a model.

        Parameters
        ----------
        setting : Setting
            Campaign and model.
        values : mapping of str to float
            Values of the parameters, and of shape parameters that are not canonical, by name. A
            parameter with one level may be left out.
        place : str
            Name of the place where the effect acts; empty if there is no choice.
        """
        medians = {
            parameter.name: parameter.prior.value(0.0)
            for parameter in self.parameters
            if parameter.levels == 1
        }
        return self.build(setting, {**medians, **self.canonical_shape(), **values}, place)
