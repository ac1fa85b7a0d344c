"""A candidate explanation: effects at given places, shapes fixed or free; where it stands, what it leaves."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from math import inf

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, TrialKind
from discrepancy.catalogue.entry import Effect, EffectParameter, Setting, ShapeParameter
from discrepancy.verdict import FREE_SHAPE
from fe.runtime.patch import ModelPatch

Key = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Term:
    """One effect of a candidate.

    Attributes
    ----------
    effect : Effect
        Which.
    place : str
        One of its discrete places.
    free_shape : bool
        Whether its shape parameters are fitted (the effect's family) or canonical (the effect itself).
    """

    effect: Effect
    place: str = ""
    free_shape: bool = False

    @property
    def label(self) -> str:
        """The effect's identifier, marked where its shape is free."""
        return self.effect.identifier + (FREE_SHAPE if self.free_shape else "")

    @property
    def name_in_words(self) -> str:
        """The effect's name; of a free shape that of its family, of which the effect is one member."""
        return f"a law of the family {self.effect.family}" if self.free_shape else self.effect.name

    @property
    def parameters(self) -> tuple[EffectParameter | ShapeParameter, ...]:
        """Fitted parameters, in order."""
        return (*self.effect.parameters, *(self.effect.shape if self.free_shape else ()))

    def values(self, normal: Sequence[float] | FloatArray) -> dict[str, float]:
        """Return values by name at standard normal variables, one for each parameter."""
        return {
            item.name: item.prior.value(float(u)) for item, u in zip(self.parameters, normal, strict=True)
        }

    def patch(self, setting: Setting, normal: Sequence[float] | FloatArray) -> ModelPatch:
        """Return the patch at standard normal variables, one for each parameter."""
        return self.effect.patch(setting, self.values(normal), self.place)

    def sized(
        self, normal: FloatArray, factor: float, lowest: float = -inf, highest: float = inf
    ) -> FloatArray:
        """Return standard normal variables with the magnitudes so many times as large, between ends."""
        found = normal.copy()
        for number, item in enumerate(self.parameters):
            if item.magnitude:
                value = factor * item.prior.value(float(normal[number]))
                if item.prior.shape == "log_normal":  # it cannot change its sign
                    value = max(value, item.prior.value(lowest))
                found[number] = np.clip(item.prior.normal(value), lowest, highest)
        return found

    @property
    def may_turn(self) -> bool:
        """Whether its size may be negative."""
        ends = [item.prior.low for item in self.parameters if item.magnitude]
        return not ends or min(ends) < 0.0

    def start(self) -> FloatArray:
        """Return the standard normal variables at prior medians and canonical shapes."""
        return np.array(
            [
                item.prior.normal(item.canonical) if isinstance(item, ShapeParameter) else 0.0
                for item in self.parameters
            ]
        )


@dataclass(frozen=True)
class Candidate:
    """A set of effects that act together; the empty one is the model as it is."""

    terms: tuple[Term, ...] = ()

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Identifiers of the effects, sorted; those of free shape are marked by `FREE_SHAPE`."""
        return tuple(sorted(term.label for term in self.terms))

    @property
    def key(self) -> Key:
        """What tells candidates apart: sorted (identifier, place)."""
        return tuple(sorted((term.label, term.place) for term in self.terms))

    @property
    def words(self) -> str:
        """The effects for a line of progress."""
        return " and ".join(self.identifiers)

    @property
    def is_family(self) -> bool:
        """Whether a shape is free."""
        return any(term.free_shape for term in self.terms)

    @property
    def parameters(self) -> list[EffectParameter | ShapeParameter]:
        """Fitted parameters, in order."""
        return [item for term in self.terms for item in term.parameters]

    @property
    def size(self) -> int:
        """Number of fitted parameters."""
        return len(self.parameters)

    @property
    def acts_on(self) -> frozenset[TrialKind]:
        """Kinds of trials that it changes."""
        return frozenset().union(*(term.effect.acts_on for term in self.terms))

    def acting(self, index: int) -> frozenset[TrialKind]:
        """Kinds of trials that change with the fitted parameter of this index."""
        owners = [term for term in self.terms for _ in term.parameters]
        return owners[index].effect.acts_on

    def parts(self, normal: FloatArray) -> list[tuple[Term, FloatArray]]:
        """Return each term with its own of the standard normal variables (size,)."""
        ends = np.cumsum([len(term.parameters) for term in self.terms])
        return list(zip(self.terms, np.split(normal, ends[:-1]), strict=True)) if self.terms else []

    def stepped(self, normal: FloatArray, step: FloatArray) -> FloatArray:
        """Return standard normal variables after a step, of magnitudes along the tangents of values."""
        moves = zip(self.parameters, normal.tolist(), step.tolist(), strict=True)
        return np.array([item.prior.stepped(u, du) if item.magnitude else u + du for item, u, du in moves])

    def patches(self, setting: Setting, normal: FloatArray) -> list[ModelPatch]:
        """Return the patch of each term at standard normal variables (size,)."""
        return [term.patch(setting, part) for term, part in self.parts(normal)]

    def patch(self, setting: Setting, normal: FloatArray) -> ModelPatch:
        """Return the patch at standard normal variables (size,)."""
        return sum(self.patches(setting, normal), ModelPatch())

    def start(self) -> FloatArray:
        """Return the standard normal variables at which a fit may begin."""
        return np.concatenate([term.start() for term in self.terms]) if self.terms else np.empty(0)

    def plus(self, term: Term) -> "Candidate":
        """Return this set and one more effect."""
        return Candidate((*self.terms, term))

    def some(self, kept: Iterable[int], normal: FloatArray) -> tuple["Candidate", FloatArray]:
        """Return some of the effects with their standard normal variables, of those of all (size,)."""
        parts = self.parts(normal)
        terms, values = zip(*(parts[number] for number in kept), strict=True)
        return Candidate(terms), np.concatenate(values)


PARAMETER_STEP = 1e-2
"""Step of the differences in scaled variables."""
LEAST_STEP = 1e-4
"""Least step by effect parameters, above the rounding of the integration."""
SHARED_STEP = 1e-3
"""The same for calibrated parameters: what effects share with the stiffness must cancel to a thousandth."""


@dataclass(frozen=True)
class Linearisation:
    """Prediction of one trial and its derivatives, before gain and zero.

    Attributes
    ----------
    response : (N, C) ndarray
        Prediction without gain and zero.
    parameters : (P, N, C) ndarray
        Its derivatives by the scaled calibrated parameters.
    local : (I, N, C) ndarray
        By the scaled initial state, time zero and health.
    effect : (E, N, C) ndarray
        By the scaled effect parameters; empty without effect.
    """

    response: FloatArray
    parameters: FloatArray
    local: FloatArray
    effect: FloatArray


@dataclass(frozen=True)
class Point:
    """Values of all scaled variables.

    Attributes
    ----------
    shared : (Q,) ndarray
        Global unknowns.
    local : tuple of (L_t,) ndarray
        Of each trial.
    effect : (E,) ndarray
        Of the candidate.
    """

    shared: FloatArray
    local: tuple[FloatArray, ...]
    effect: FloatArray


@dataclass(frozen=True, eq=False)
class State:
    """Where a candidate stands: a fit, or on the way to one.

    Attributes
    ----------
    point : Point
        Values of all unknowns.
    objective : float
        -ln posterior there, up to a constant shared by all candidates [nat].
    residuals : tuple of (N, C) ndarray
        Standardised, of each trial.
    sums : (channels,) ndarray
        Sum of squared residuals by channel.
    linearisations : tuple of Linearisation
        At the point.
    """

    point: Point
    objective: float
    residuals: tuple[FloatArray, ...]
    sums: FloatArray
    linearisations: tuple[Linearisation, ...] = field(repr=False)

    @property
    def responses(self) -> tuple[FloatArray, ...]:
        """Of each trial, (N, C), without gain and zero."""
        return tuple(part.response for part in self.linearisations)


def moved(values: FloatArray, index: int, step: float = PARAMETER_STEP) -> FloatArray:
    """Return the values with one of them a step further."""
    changed = values.copy()
    changed[index] += step
    return changed


@dataclass(frozen=True, eq=False)
class Remainder:
    """What is left in each channel of trials in motion.

    Attributes
    ----------
    size : (channels,) ndarray
        Standard deviation beside the noise, over that of the noise; nought where noise alone is left.
    factor : (channels,) ndarray
        Deviation of the noise that counts as many samples as are independent, over the recorded one.
    time : (channels,) ndarray
        Over which it forgets [s].
    frequency : (channels,) ndarray
        At which it swings [Hz]; nought if it does not.
    of_noise : (channels,) ndarray of bool
        Where it is the colour of the noise itself, as its record admits.
    """

    size: FloatArray
    factor: FloatArray
    time: FloatArray
    frequency: FloatArray
    of_noise: BoolArray

    @property
    def acts(self) -> bool:
        """Whether anything but white noise is left."""
        return bool(np.any(self.factor != 1.0))

    @property
    def is_noise(self) -> bool:
        """Whether all that is left is the colour of the noise, as its records have it."""
        return bool(np.all(self.of_noise | (self.factor == 1.0)))
