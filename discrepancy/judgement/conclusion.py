"""What every verdict on a search says alike: hypotheses, estimates, and the record of each kind."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from discrepancy.catalogue.entry import NINETY
from discrepancy.fits.candidate import FREE_SHAPE, Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.posterior import with_draws
from discrepancy.fits.problem import Problem
from discrepancy.search.strategy import Search
from discrepancy.verdict import (
    CalibratedParameter,
    Estimate,
    Gate,
    Hypothesis,
    NamedEffect,
    Verdict,
    VerdictKind,
)

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Conclusion:
    """What every verdict on a search says alike, and the kinds of it."""

    problem: Problem
    found: Search
    top: tuple[str, ...]
    log_bayes_factor: float
    hypotheses: tuple[Hypothesis, ...]
    inclusion: dict[str, float]

    @classmethod
    def of(
        cls, problem: Problem, found: Search, best: CandidateFit, probabilities: dict[tuple[str, ...], float]
    ) -> "Conclusion":
        """Return what is said of the hypotheses of a search, the best of them given."""
        return cls(
            problem,
            found,
            best.candidate.identifiers,
            log_bayes_factor=single_evidence(found, best) - found.nothing.log_evidence,
            hypotheses=compared(problem, found, probabilities),
            inclusion={
                effect.identifier: sum(
                    p for names, p in probabilities.items() if effect.identifier in plain_names(names)
                )
                for effect in found.effects
            },
        )

    def verdict(self, kind: VerdictKind, sentence: str, probability: float, **more: Any) -> Verdict:
        """Return a verdict."""
        return Verdict(
            kind=kind,
            sentence=sentence,
            probability=probability,
            log_bayes_factor=self.log_bayes_factor,
            hypotheses=self.hypotheses,
            inclusion=self.inclusion,
            **more,
        )

    def family(
        self, fit: CandidateFit, probability: float, gates: tuple[Gate, ...]
    ) -> tuple[Verdict, Search, CandidateFit]:
        """Return the verdict that names the family of a fit with a free shape."""
        drawn = with_draws(self.problem, fit)
        named = named_effects(self.problem, drawn)
        text, sentence = family_words(named)
        more = {"effects": named, "family": text, "gates": gates}
        return self.verdict(VerdictKind.FAMILY, sentence, probability, **more), self.found, drawn

    def unexplained(
        self, sentence: str, probability: float, gates: tuple[Gate, ...]
    ) -> tuple[Verdict, Search, CandidateFit]:
        """Return the verdict that there is a gap without a name."""
        more = {"gates": gates, "resembles": plain_names(self.top)}
        verdict = self.verdict(VerdictKind.UNEXPLAINED, sentence, probability, **more)
        return verdict, self.found, self.found.none


def plain_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return identifiers without the mark of a free shape."""
    return tuple(name.removesuffix(FREE_SHAPE) for name in names)


def best_of(found: Search, identifiers: tuple[str, ...]) -> CandidateFit:
    """Return the most probable fit of a set of effects, fitted exactly."""
    options = [item for item in found.all().values() if item.candidate.identifiers == identifiers]
    best = max(options, key=found.score)
    return found.exactly(best)


def single_evidence(found: Search, best: CandidateFit) -> float:
    """Return the log evidence of the best set, averaged over its places."""
    places = 0.0
    for term in best.candidate.terms:
        places += np.log(len(term.effect.places(found.problem.setting)))
    return best.log_evidence - places


def named_effects(problem: Problem, found: CandidateFit) -> tuple[NamedEffect, ...]:
    """Return the effects of a fit with values and 90 % intervals of their parameters.

    Intervals are those of the fit's draws, else of its covariance.
    """
    deviation = np.sqrt(np.diag(found.effect_covariance))
    low, high = found.point.effect - NINETY * deviation, found.point.effect + NINETY * deviation
    if found.draws is not None:
        low, high = np.quantile(found.draws, (0.05, 0.95), axis=0)
        # the most probable value may be one of many optima along a ridge
        low, high = np.minimum(low, found.point.effect), np.maximum(high, found.point.effect)
    return effects_at(problem, found.candidate, found.point.effect, low, high)


def effects_at(
    problem: Problem, candidate: Candidate, effect: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[NamedEffect, ...]:
    """Return the effects of a candidate at scaled values (E,) with the ends of their intervals (E,)."""
    named = []
    at = 0
    for term, part in zip(candidate.terms, candidate.parts(effect), strict=True):
        estimates = []
        rows = slice(at, at + len(part))
        for item, u, *interval in zip(term.parameters, part, low[rows], high[rows], strict=True):
            ends = [item.prior.value(float(end)) for end in interval]
            estimates.append(
                Estimate(
                    item.name,
                    item.prior.value(float(u)),
                    min(ends),
                    max(ends),
                    getattr(item, "unit", "1"),
                    item.description,
                )
            )
        count = len(term.effect.parameters)
        named.append(
            NamedEffect(
                term.effect.identifier,
                term.effect.name,
                term.place,
                term.effect.family,
                tuple(estimates[:count]),
                tuple(estimates[count:]),
                Candidate((term,)).patch(problem.setting, part),
            )
        )
        at += len(part)
    return tuple(named)


def calibrated_parameters(problem: Problem, found: CandidateFit) -> tuple[CalibratedParameter, ...]:
    """Return the calibrated parameters of the model as a fit has them, within the model's range."""
    return parameters_at(problem, found.point.shared, found.covariance)


def parameters_at(
    problem: Problem, shared: FloatArray, covariance: FloatArray
) -> tuple[CalibratedParameter, ...]:
    """Return the calibrated parameters at scaled shared unknowns (Q,), whose covariance comes first."""
    layout = problem.shared
    values = layout.parameters(shared)
    spread = layout.parameter_scale * np.sqrt(np.maximum(np.diag(covariance)[: len(values)], 0.0))
    return tuple(
        CalibratedParameter(item.name, float(value), float(deviation), item.unit)
        for item, value, deviation in zip(problem.model.parameters, values, spread, strict=True)
    )


def compared(
    problem: Problem, found: Search, probabilities: dict[tuple[str, ...], float]
) -> tuple[Hypothesis, ...]:
    """Return the records of all sets of effects that are compared, most probable first."""
    rows = []
    for identifiers, probability in probabilities.items():
        options = [item for item in found.all().values() if item.candidate.identifiers == identifiers]
        best = max(options, key=found.score)
        rows.append(
            Hypothesis(
                named_effects(problem, best),
                best.log_evidence,
                probability,
                best.chi_square,
                float(problem.counts.sum() - best.spent.sum()),
                calibrated_parameters(problem, best),
            )
        )
    return tuple(rows)


def family_words(named: tuple[NamedEffect, ...]) -> tuple[str, str]:
    """Return the families whose shape is free, and the sentence of the verdict."""
    text = ", ".join(sorted({effect.family for effect in named if effect.shape}))
    beside = ", ".join(effect.name for effect in named if not effect.shape)
    return text, (
        f"An effect of the family {text} is missing, with a shape of its own"
        f"{f', beside {beside}' if beside else ''}."
    )
