"""A candidate explanation: no effect, one or several effects at given places, shapes fixed or free."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from discrepancy.campaign.records import FloatArray, TrialKind
from discrepancy.catalogue.entry import Effect, EffectParameter, Setting, ShapeParameter
from fe.runtime.patch import ModelPatch

FREE_SHAPE = " (free shape)"
"""What marks the identifier of an effect whose shape is free: its family."""


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
    def parameters(self) -> tuple[EffectParameter | ShapeParameter, ...]:
        """Fitted parameters, in order."""
        return (*self.effect.parameters, *(self.effect.shape if self.free_shape else ()))

    def values(self, normal: Sequence[float] | FloatArray) -> dict[str, float]:
        """Return values by name at standard normal variables, one for each parameter."""
        return {
            item.name: item.prior.value(float(u)) for item, u in zip(self.parameters, normal, strict=True)
        }

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
    def is_family(self) -> bool:
        """Whether a shape is free."""
        return any(term.free_shape for term in self.terms)

    @property
    def size(self) -> int:
        """Number of fitted parameters."""
        return sum(len(term.parameters) for term in self.terms)

    @property
    def acts_on(self) -> frozenset[TrialKind]:
        """Kinds of trials that it changes."""
        return frozenset().union(*(term.effect.acts_on for term in self.terms))

    def acting(self, index: int) -> frozenset[TrialKind]:
        """Kinds of trials that change with the fitted parameter of this index."""
        owners = [term for term in self.terms for _ in term.parameters]
        return owners[index].effect.acts_on

    def parts(self, normal: FloatArray) -> tuple[FloatArray, ...]:
        """Return the standard normal variables of each term."""
        ends = np.cumsum([len(term.parameters) for term in self.terms])
        return tuple(np.split(normal, ends[:-1])) if self.terms else ()

    def patch(self, setting: Setting, normal: FloatArray) -> ModelPatch:
        """Return the patch at standard normal variables (size,)."""
        patch = ModelPatch()
        for term, part in zip(self.terms, self.parts(normal), strict=True):
            patch = patch + term.effect.patch(setting, term.values(part), term.place)
        return patch

    def start(self) -> FloatArray:
        """Return the standard normal variables at which a fit may begin."""
        return np.concatenate([term.start() for term in self.terms]) if self.terms else np.empty(0)

    def plus(self, term: Term) -> "Candidate":
        """Return this set and one more effect."""
        return Candidate((*self.terms, term))

    def without(self, index: int) -> "Candidate":
        """Return this set less one effect."""
        return Candidate(self.terms[:index] + self.terms[index + 1 :])
