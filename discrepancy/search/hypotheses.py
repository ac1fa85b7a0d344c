"""The hypotheses of a search: sets of effects with their fits, prior shares and probabilities."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import exp

from scipy.special import logsumexp

from discrepancy.catalogue.entry import Effect
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.hypotheses import Key, key_of, log_prior

Tell = Callable[[str], None]


def in_silence(what: str) -> None:
    """Tell nobody."""


@dataclass
class Hypotheses:
    """All candidates fitted so far.

    Attributes
    ----------
    problem : Problem
        Campaign and model.
    effects : tuple of Effect
        Those that can act here.
    none : CandidateFit
        Without effect.
    exact : dict of Key to CandidateFit
        Fitted to convergence.
    rough : dict of Key to CandidateFit
        Fitted by few steps only; their evidence is approximate.
    judged : dict of Key to CandidateFit
        Fitted with their remainders; where there are any, they alone are compared.
    promised : dict of str to float
        The most that a screen at the fit without effect promised of each effect [nat].
    tell : callable
        Takes a few words on what is fitted, and how much is left.
    wide : Problem or None
        That under what the best hypothesis leaves, by which the judged ones were fitted.
    """

    problem: Problem
    effects: tuple[Effect, ...]
    none: CandidateFit
    exact: dict[Key, CandidateFit] = field(default_factory=dict)
    rough: dict[Key, CandidateFit] = field(default_factory=dict)
    judged: dict[Key, CandidateFit] = field(default_factory=dict)
    promised: dict[str, float] = field(default_factory=dict)
    tell: Tell = in_silence
    wide: Problem | None = None

    def __post_init__(self) -> None:
        self.exact[()] = self.none

    def log_prior(self, candidate: Candidate) -> float:
        """Return ln of the prior probability of a candidate at its places."""
        return log_prior(candidate, len(self.effects), self.problem.setting)

    def score(self, found: CandidateFit) -> float:
        """Return ln (evidence times prior), up to a constant."""
        return found.log_evidence + self.log_prior(found.candidate)

    def all(self) -> dict[Key, CandidateFit]:
        """Return every candidate that is compared, the exact fit where there is one."""
        return self.judged or {**self.rough, **self.exact}

    def best(self) -> CandidateFit:
        """Return the most probable candidate."""
        return max((self.judged or self.exact).values(), key=self.score)

    def best_of(self, identifiers: tuple[str, ...]) -> CandidateFit:
        """Return the most probable fit of a set of effects."""
        options = [item for item in self.all().values() if item.candidate.identifiers == identifiers]
        return max(options, key=self.score)

    def fitted(self) -> frozenset[str]:
        """Return the identifiers of all effects that were fitted, alone or with others."""
        kept = (*self.rough.values(), *self.exact.values(), *self.judged.values())
        return frozenset(term.effect.identifier for item in kept for term in item.candidate.terms)

    @property
    def nothing(self) -> CandidateFit:
        """The fit without effect as it is compared, with its remainder where others have theirs."""
        return self.judged.get((), self.none)

    def judge(self, fits: dict[Key, CandidateFit]) -> None:
        """Compare these from now on."""
        self.judged = fits

    def set_probabilities(self) -> dict[tuple[str, ...], float]:
        """Return the probability of each set of identifiers, places summed, most probable first."""
        scores: dict[tuple[str, ...], list[float]] = {}
        for found in self.all().values():
            scores.setdefault(found.candidate.identifiers, []).append(self.score(found))
        sums = {identifiers: float(logsumexp(values)) for identifiers, values in scores.items()}
        total = float(logsumexp(list(sums.values())))
        ordered = sorted(sums.items(), key=lambda item: -item[1])
        return {identifiers: min(exp(value - total), 1.0) for identifiers, value in ordered}

    def keep(self, found: CandidateFit, *, exact: bool) -> None:
        """Keep a fit if it is better than what is known of the same candidate."""
        kept = self.exact if exact else self.rough
        key = key_of(found.candidate)
        if key not in kept or kept[key].log_evidence < found.log_evidence:
            kept[key] = found
