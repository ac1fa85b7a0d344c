"""Hypotheses of the search: sets of effects, the unknowns of their fits, and states of a fit.

A *candidate* is a hypothesis about what the model lacks: a set of effects of the catalogue, each at
a place of the structure or in a channel.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from math import inf

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, TrialKind
from discrepancy.catalogue.effect_in_setting import SIDES
from discrepancy.catalogue.entry import Effect, EffectParameter, Setting, ShapeParameter
from discrepancy.verdict import FREE_SHAPE
from fe.runtime.patch import ModelPatch

CandidateKey = tuple[tuple[str, str], ...]
"""Sorted pairs (label, place) of the effects of a candidate."""


@dataclass(frozen=True)
class EffectTerm:
    """One effect of a candidate, at one of its places.

    Its parameters are fitted as scaled variables, which are standard normal under the prior. The
    prior maps them to physical values.

    Attributes
    ----------
    effect : Effect
        The effect of the catalogue.
    place : str
        The place, one of `effect.places(setting)`.
    free_shape : bool
        Whether the shape parameters of the law are fitted; if not, they have their canonical
        values. Effects that differ only by their shape are a family.
    """

    effect: Effect
    place: str = ""
    free_shape: bool = False

    @property
    def label(self) -> str:
        """The identifier of the effect, with the suffix `FREE_SHAPE` if its shape is free."""
        if self.free_shape:
            return self.effect.identifier + FREE_SHAPE
        return self.effect.identifier

    @property
    def port(self) -> str:
        """The port at which a law of the effect acts: the place, without the side of a crack."""
        port, _, side = self.place.rpartition(", ")
        return port if side in SIDES else self.place

    @property
    def name_in_words(self) -> str:
        """The name of the effect, or of its family if the shape of the law is free."""
        is_family = self.free_shape and self.effect.table is None
        return f"a law of the family {self.effect.family}" if is_family else self.effect.name

    @property
    def parameters(self) -> tuple[EffectParameter | ShapeParameter, ...]:
        """The parameters of the effect that are fitted: its own, then those of a free shape."""
        if self.free_shape:
            return (*self.effect.parameters, *self.effect.shape)
        return self.effect.parameters

    @property
    def may_be_negative(self) -> bool:
        """Whether the magnitude of the effect may be negative."""
        low_ends = [parameter.prior.low for parameter in self.parameters if parameter.magnitude]
        return not low_ends or min(low_ends) < 0.0

    def physical_values(self, scaled_values: Sequence[float] | FloatArray) -> dict[str, float]:
        """Return the parameters of the effect in their units by name, given their scaled values."""
        values = {}
        for parameter, scaled_value in zip(self.parameters, scaled_values, strict=True):
            values[parameter.name] = parameter.prior.value(float(scaled_value))
        return values

    def patch(self, setting: Setting, scaled_values: Sequence[float] | FloatArray) -> ModelPatch:
        """Return the change of the model by the effect, given its scaled parameters (E,)."""
        return self.effect.patch(setting, self.physical_values(scaled_values), self.place)

    def depends_on(self, setting: Setting, scaled_values: FloatArray, number: int) -> bool:
        """Return whether the change of the model depends on one of the scaled parameters (E,).

        At a set of nodes, for example, nothing depends on a distance from the place.
        """
        stepped = with_step(scaled_values, number)
        return self.patch(setting, stepped) != self.patch(setting, scaled_values)

    def start_values(self) -> FloatArray:
        """Return the scaled parameters (E,) at the median of the prior and the canonical shape."""
        scaled_values = []
        for parameter in self.parameters:
            if isinstance(parameter, ShapeParameter):
                scaled_values.append(parameter.prior.standard_normal(parameter.canonical))
            else:
                scaled_values.append(0.0)  # the median of a standard normal variable
        return np.array(scaled_values)

    @property
    def largest_scaled_values(self) -> FloatArray:
        """The largest magnitudes (E,) of the scaled parameters that are fitted."""
        return np.array([parameter.prior.largest_standard_normal for parameter in self.parameters])

    def multiply_magnitudes(
        self, scaled_values: FloatArray, factor: float, lowest: float = -inf, highest: float = inf
    ) -> FloatArray:
        """Return the scaled parameters (E,) after all magnitudes are multiplied by a factor.

        Parameters
        ----------
        scaled_values : (E,) array
            The scaled parameters of the term.
        factor : float
            The factor on the physical value of each magnitude.
        lowest, highest : float
            The limits of the returned scaled magnitudes. Without them the factor is exact, and must
            be positive if a prior is log-normal.
        """
        rescaled = scaled_values.copy()
        for number, parameter in enumerate(self.parameters):
            if parameter.magnitude:
                scaled_value = float(scaled_values[number])
                rescaled[number] = parameter.prior.multiply(scaled_value, factor, lowest, highest)
        return rescaled

    def multiply_magnitudes_within_range(
        self, scaled_values: FloatArray, factor: float
    ) -> FloatArray:
        """Return scaled parameters (E,) with multiplied magnitudes, at which a fit may begin.

        They are those of `multiply_magnitudes`, but no magnitude is beyond `largest_scaled_values`.
        """
        rescaled = scaled_values.copy()
        for number, parameter in enumerate(self.parameters):
            if parameter.magnitude:
                scaled_value = float(scaled_values[number])
                largest = parameter.prior.largest_standard_normal
                rescaled[number] = parameter.prior.multiply(scaled_value, factor, -largest, largest)
        return rescaled


@dataclass(frozen=True)
class Candidate:
    """A hypothesis: a set of effects that act together. The empty set is the unchanged model.

    Attributes
    ----------
    terms : tuple of EffectTerm
        The effects at their places.
    """

    terms: tuple[EffectTerm, ...] = ()

    @property
    def identifiers(self) -> tuple[str, ...]:
        """The sorted labels of the effects: identifiers, with a mark where the shape is free."""
        return tuple(sorted(term.label for term in self.terms))

    @property
    def key(self) -> CandidateKey:
        """The sorted pairs (label, place) of the effects, which identify the candidate."""
        return tuple(sorted((term.label, term.place) for term in self.terms))

    @property
    def description(self) -> str:
        """The effects for a line of progress, such as "mass and stiffness"."""
        return " and ".join(self.identifiers)

    @property
    def has_free_shape(self) -> bool:
        """Whether the shape of one of the effects is free."""
        return any(term.free_shape for term in self.terms)

    @property
    def can_imitate_nearly_anything(self) -> bool:
        """Whether a law of free shape acts together with another effect."""
        return self.has_free_shape and len(self.terms) > 1

    @property
    def parameters(self) -> list[EffectParameter | ShapeParameter]:
        """The fitted parameters of all effects, in order."""
        return [parameter for term in self.terms for parameter in term.parameters]

    @property
    def parameter_count(self) -> int:
        """The number E of fitted parameters."""
        return len(self.parameters)

    def within_range(self, scaled_values: FloatArray) -> FloatArray:
        """Return the scaled effect parameters (E,), clipped to the range that is fitted."""
        if not self.terms:
            return scaled_values
        largest = np.concatenate([term.largest_scaled_values for term in self.terms])
        return np.clip(scaled_values, -largest, largest)

    @property
    def acts_on(self) -> frozenset[TrialKind]:
        """The kinds of trials whose prediction the candidate changes."""
        return frozenset().union(*(term.effect.acts_on for term in self.terms))

    def trial_kinds_of_parameter(self, parameter_index: int) -> frozenset[TrialKind]:
        """Return the kinds of trials whose prediction depends on a parameter, given its index."""
        effects = [term.effect for term in self.terms for _ in term.parameters]
        return effects[parameter_index].acts_on

    def split_by_term(self, scaled_values: FloatArray) -> list[tuple[EffectTerm, FloatArray]]:
        """Return each effect together with its own scaled parameters, given those of all (E,)."""
        if not self.terms:
            return []
        ends = np.cumsum([len(term.parameters) for term in self.terms])
        return list(zip(self.terms, np.split(scaled_values, ends[:-1]), strict=True))

    def add_step(self, scaled_values: FloatArray, step: FloatArray) -> FloatArray:
        """Return the scaled effect parameters (E,) after a step of a fit.

        A magnitude makes its step in the physical value, linearised at the present value, because
        the prediction is nearly linear in it. Other parameters step in their scaled variable.

        Parameters
        ----------
        scaled_values : (E,) array
            The E parameters of the effects, on the scale on which their priors are standard normal.
        step : (E,) array
            The step of these scaled values.
        """
        next_values = []
        for parameter, scaled_value, change in zip(
            self.parameters, scaled_values.tolist(), step.tolist(), strict=True
        ):
            if parameter.magnitude:
                next_values.append(parameter.prior.step_along_tangent(scaled_value, change))
            else:
                next_values.append(scaled_value + change)
        return np.array(next_values)

    def patches(self, setting: Setting, scaled_values: FloatArray) -> list[ModelPatch]:
        """Return the change of the model by each effect, given all scaled parameters (E,)."""
        return [term.patch(setting, values) for term, values in self.split_by_term(scaled_values)]

    def patch(self, setting: Setting, scaled_values: FloatArray) -> ModelPatch:
        """Return the change of the model by all effects, given their scaled parameters (E,)."""
        return sum(self.patches(setting, scaled_values), ModelPatch())

    def start_values(self) -> FloatArray:
        """Return the scaled effect parameters (E,) at which a fit may begin."""
        if not self.terms:
            return np.empty(0)
        return np.concatenate([term.start_values() for term in self.terms])

    def with_term(self, term: EffectTerm) -> "Candidate":
        """Return the candidate that has one more effect than this one."""
        return Candidate((*self.terms, term))

    def subset_of_terms(
        self, term_indices: Iterable[int], scaled_values: FloatArray
    ) -> tuple["Candidate", FloatArray]:
        """Return the candidate of some of the terms, and its scaled parameters.

        Parameters
        ----------
        term_indices : iterable of int
            The indices of the terms to keep, at least one.
        scaled_values : (E,) array
            The scaled parameters of all terms.
        """
        terms_with_values = self.split_by_term(scaled_values)
        terms = []
        values_of_terms = []
        for index in term_indices:
            term, values = terms_with_values[index]
            terms.append(term)
            values_of_terms.append(values)
        return Candidate(tuple(terms)), np.concatenate(values_of_terms)


PARAMETER_STEP = 1e-2
"""Step of finite differences in scaled variables."""
LEAST_EFFECT_STEP = 1e-4
"""Least step in effect parameters: above the rounding of the time integration."""
SHARED_STEP = 1e-3
"""Step in calibrated parameters: what an effect shares with the stiffness must cancel to a
thousandth."""


@dataclass(frozen=True)
class TrialDerivatives:
    """The response of the model in one trial, and its derivatives.

    The response is the prediction of the readings without gains and zeros of the channels.

    Attributes
    ----------
    response : (N, C) array
        The response at N times in C channels [unit of the channel].
    by_parameters : (P, N, C) array
        The derivatives with respect to the scaled calibrated parameters.
    by_local : (I, N, C) array
        The derivatives with respect to the scaled unknowns of the trial except its zeros: initial
        state, constants of inputs, time zero, health.
    by_effect : (E, N, C) array
        The derivatives with respect to the scaled effect parameters.
    jumps : (N, C) array
        The jump of the response where it jumps within a step of an unknown, as an acceleration does
        at a reversal of dry friction; zero elsewhere.
    """

    response: FloatArray
    by_parameters: FloatArray
    by_local: FloatArray
    by_effect: FloatArray
    jumps: FloatArray


@dataclass(frozen=True)
class Point:
    """Values of all scaled unknowns of a fit.

    Attributes
    ----------
    shared : (Q,) array
        The unknowns that all hypotheses and trials share: calibrated parameters and gains.
    local : tuple of (L,) array
        The unknowns of each trial.
    effect : (E,) array
        The effect parameters of the candidate.
    """

    shared: FloatArray
    local: tuple[FloatArray, ...]
    effect: FloatArray


@dataclass(frozen=True, eq=False)
class FitState:
    """A candidate at one point: the result of a fit, or a step on the way to it.

    Attributes
    ----------
    point : Point
        The values of all unknowns.
    objective : float
        The negative log posterior, up to a constant that all candidates share [nat].
    residuals : tuple of (N, C) array
        The standardised residuals of each trial.
    squares_by_channel : (channels,) array
        The sum of squared standardised residuals of each channel.
    trial_derivatives : tuple of TrialDerivatives
        The response of each trial at the point; its derivatives are those at the point, or near it.
    """

    point: Point
    objective: float
    residuals: tuple[FloatArray, ...]
    squares_by_channel: FloatArray
    trial_derivatives: tuple[TrialDerivatives, ...] = field(repr=False)

    @property
    def responses(self) -> tuple[FloatArray, ...]:
        """The response (N, C) of the model in each trial, without gains and zeros of channels."""
        return tuple(derivatives.response for derivatives in self.trial_derivatives)


def with_step(values: FloatArray, index: int, step: float = PARAMETER_STEP) -> FloatArray:
    """Return a copy of the values in which one of them is larger by a step."""
    stepped_values = values.copy()
    stepped_values[index] += step
    return stepped_values


@dataclass(frozen=True, eq=False)
class ResidualProcess:
    """The random process in the residuals of each channel besides white noise.

    Hypotheses that all leave more than noise are compared under a noise that is as large as the
    residuals of the best of them (Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63, 425-464).

    Attributes
    ----------
    amplitude : (channels,) array
        The standard deviation of the process over that of the noise; 0 if the residuals are noise
        alone.
    noise_factor : (channels,) array
        The factor on the recorded noise deviation with which the residuals, taken as independent
        noise, have the right weight; 1 if they are white noise of the recorded level.
    correlation_time : (channels,) array
        The correlation time of the process [s].
    frequency : (channels,) array
        The frequency of the process [Hz]; 0 if it does not oscillate.
    is_recorded_colour : (channels,) array of bool
        Whether the residuals have the same correlation in time as the channel's noise record.
    """

    amplitude: FloatArray
    noise_factor: FloatArray
    correlation_time: FloatArray
    frequency: FloatArray
    is_recorded_colour: BoolArray

    @property
    def is_present(self) -> bool:
        """Whether a channel has residuals other than white noise of the recorded level."""
        return bool(np.any(self.noise_factor != 1.0))

    @property
    def is_all_recorded_colour(self) -> bool:
        """Whether the residuals of all channels are noise, white or correlated as in its record."""
        return bool(np.all(self.is_recorded_colour | (self.noise_factor == 1.0)))
