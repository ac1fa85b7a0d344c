"""Verdicts where no simulation leaves noise alone: named in part, a group, unexplained.

A set of effects is named in part that is probable and is most of what is missing, in the trials that were
fitted and in those that were not, with what was calibrated within twice its prior deviations. Hypotheses are
compared along the missing force where one can be seen, else by whole simulations under what they leave.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from discrepancy.catalogue.entry import NINETY
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.gates import absolute_gate
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.hypotheses import key_of
from discrepancy.missing_force.shares import Share, orders
from discrepancy.search.honest_evidence import weigh_with_remainders
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import (
    ExplainedShare,
    Gate,
    Hypothesis,
    NamedEffect,
    RemainderEstimate,
    Verdict,
    VerdictKind,
)

from .comparison import ByForce, ByReadings, Comparison, H
from .conclusion import Conclusion, effects_at, named_effects, parameters_at, plain_names
from .consistency_gate import consistency_gate
from .court import Court, names, part, percent
from .practical_size import UNSTATED_GAIN, is_one_driven_channel, small_terms
from .proof import held_out_gate

FloatArray = NDArray[np.float64]
Outcome = tuple[Verdict, Search, CandidateFit]

LEAST_SHOWN = 0.1
"""Share of what is missing from which a hypothesis is shown as the best one where none is named."""
MOST_TOLD = 12
"""Hypotheses that are listed."""


def judged_in_part(problem: Problem, found: Search, first: Verdict) -> Outcome:
    """Return the verdict where what the best simulation leaves is not the recorded noise.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    found : Search
        All candidates as fitted to recorded noise, and hypotheses along the missing force if it is seen.
    first : Verdict
        What the simulations led to.

    Returns
    -------
    Verdict, Search, CandidateFit
        As `naming.name` returns them; the fit is that of the best hypothesis for an unexplained gap too.
    """
    if found.force is not None:
        return _Said(problem, found, first, ByForce(problem, found)).verdict()
    weigh_with_remainders(found)
    way = ByReadings(problem, found)
    coloured = _beside_coloured_noise(problem, found, way)
    if coloured is not None:
        return coloured
    way.add_families()
    return _Said(problem, found, first, way).verdict()


def without_sliver(problem: Problem, found: Search, first: Verdict, fit: CandidateFit) -> Outcome:
    """Return the verdict on a set that was named, one of whose effects may explain next to nothing.

    Where what is left is nearly noise, such an effect stands for what is left as well as wider noise does. It
    stays if the evidence of the whole set is above that of the set without it by far.

    Parameters
    ----------
    problem, found, first
        As of `judged_in_part`.
    fit : CandidateFit
        Of the set that was named.
    """
    way = ByReadings(problem, found)
    court = Court(problem, way)
    small = small_terms(problem, fit, unstated=UNSTATED_GAIN)
    terms, one_channel = fit.candidate.terms, is_one_driven_channel(problem)
    kept = {
        (term.label, term.place) for term, size in zip(terms, small, strict=True)
        if size is None and (court.acts(term) or not one_channel)
    }  # fmt: skip
    whole_key, share = set(key_of(fit.candidate)), court.told(fit).value
    less = [
        item
        for item in found.exact.values()
        if item.candidate.terms and set(key_of(item.candidate)) < whole_key
    ]
    if kept == whole_key and not any(court.told(item).value > share - SEARCH.sliver for item in less):
        return first, found, fit
    weigh_with_remainders(found)
    whole = found.judged.get(key_of(fit.candidate), fit)
    for item in sorted(found.judged.values(), key=lambda one: len(one.candidate.terms)):
        own = set(key_of(item.candidate))
        if not own or not own < whole_key or court.told(item).value < share - SEARCH.sliver:
            continue
        if own == kept or found.score(item) > found.score(whole) - SEARCH.sliver_gain:
            said = _Said(problem, found, first, way)
            probability = said.court.probability(item)
            if said.court.against(item) or probability < SEARCH.sure:
                return said.unexplained(item, probability)
            return said.in_part(item, probability)
    found.judge({})
    return first, found, fit


def _beside_coloured_noise(problem: Problem, found: Search, way: ByReadings) -> Outcome | None:
    """Return the verdict where all that is left is the colour of the noise, as its records have it."""
    nothing, best = found.nothing, found.best()
    probabilities = found.set_probabilities()
    told = Conclusion.of(problem, found, best, probabilities)
    gate, p_none = absolute_gate(problem, nothing), probabilities.get((), 0.0)
    if p_none > 1.0 - SEARCH.sure and gate.passed is not False and _is_coloured(nothing):
        hints = sorted(name for name, p in told.inclusion.items() if p > 1.0 - SEARCH.sure)
        more: dict[str, Any] = {"gates": (gate,), "remainders": remainder_estimates(problem, nothing)}
        if p_none >= SEARCH.unsure:
            sentence = (
                "The model explains the data within their noise, which is coloured as its records admit."
            )
            return told.verdict(VerdictKind.NOTHING_MISSING, sentence, p_none, **more), found, nothing
        sentence = (
            "Something may be missing, but too small for these data to tell from noise that is coloured"
        )
        sentence += f"; the nearest are {', '.join(hints[:4])}." if hints else "."
        total = min(p_none + sum(told.inclusion[name] for name in hints), 1.0)
        return (
            told.verdict(VerdictKind.BELOW_LIMIT, sentence, total, group=tuple(hints), **more),
            found,
            nothing,
        )
    court = Court(problem, way)
    if not best.candidate.terms or best.candidate.is_family or not _is_coloured(best):
        return None
    probability = court.probability(best)
    gates: tuple[Gate, ...] = (
        absolute_gate(problem, best), consistency_gate(problem, best),
        held_out_gate(way.residuals(replace(best, remainder=None))),
    )  # fmt: skip
    if probability < SEARCH.sure or any(gate.passed is False for gate in gates):
        return None
    named = named_effects(problem, best)
    sentence = f"The model lacks {_words(named)} (probability {_certain(probability)})."
    more = {"effects": named, "gates": gates, "remainders": remainder_estimates(problem, best)}
    return told.verdict(VerdictKind.NAMED, sentence, probability, **more), found, best


def _is_coloured(item: CandidateFit) -> bool:
    return item.remainder is not None and item.remainder.is_noise


@dataclass(frozen=True)
class _Said(Generic[H]):
    """What is said of hypotheses: the verdicts of each kind, with the fit that stands for each."""

    problem: Problem
    found: Search
    first: Verdict
    way: Comparison[H]

    @cached_property
    def court(self) -> Court[H]:
        """Which of them may be named."""
        return Court(self.problem, self.way)

    def verdict(self) -> Outcome:
        """Return the verdict."""
        court = self.court
        if not court.contenders:
            return self.unexplained()
        best = court.slimmed(court.contenders[0])
        members = [best, *court.rivals(best)]
        probability = sum(court.probability(item) for item in members)
        if 1 < len(members) <= SEARCH.largest_group:
            return self.group(members, probability)
        if len(members) > SEARCH.largest_group:
            return self.unexplained(best, court.probability(best), len(members) - 1)
        if probability < SEARCH.sure or self.way.gain(members[0]) < SEARCH.bayes_factor:
            return self.unexplained(members[0], probability)
        return self.in_part(members[0], probability)

    def in_part(self, best: H, probability: float) -> Outcome:
        """Return the verdict that names a hypothesis in part."""
        effects, share = self.effects(best), self.court.told(best)
        family = ", ".join(sorted({t.effect.family for t in best.candidate.terms if t.free_shape}))
        named = _words([effect for effect in effects if not effect.shape])
        free = f"an effect of the family {family}, with a shape of its own," if family else ""
        what = " and ".join(text for text in (named, free) if text)
        inside = self.way.has_held_out and not share.held_out
        sentence = (
            f"{_capital(what)} is missing (probability {_certain(probability)}): "
            f"{part(share)} {_where(share)}"
            f"{'; in the trials held out it has hardly any force' if inside else ''}; "
            f"{self.way.left(best, share)}."
            f"{self._shape(best)}"
        )
        return self._verdict(
            VerdictKind.NAMED_IN_PART, sentence, probability, best, [best], effects=effects, family=family,
            gates=(self.way.gate(best),),
        )  # fmt: skip

    def group(self, members: Sequence[H], probability: float) -> Outcome:
        """Return the verdict that one of several hypotheses is what is missing, what they share first."""
        share = self.court.told(members[0])
        words = [f"{_words(self.effects(item))} ({percent(self.court.told(item))})" for item in members]
        sentence = (
            f"Either {', '.join(words[:-1])} or {words[-1]} is this share of {share.of} "
            f"{_where(share)}; these data cannot tell which."
        )
        common = set.intersection(*(names(item) for item in members))
        both = [e for e in self.effects(members[0]) if (e.identifier, e.place) in common]
        if both:
            sentence = f"{_capital(_words(both))} is missing. {sentence}"
        return self._verdict(
            VerdictKind.GROUP, sentence, min(probability, 1.0), members[0], members,
            effects=tuple(effect for item in members for effect in self.effects(item)),
            group=tuple(" + ".join(sorted(plain_names(item.candidate.identifiers))) for item in members),
            gates=(self.way.gate(members[0]),),
        )  # fmt: skip

    def unexplained(self, close: H | None = None, probability: float = 0.0, rivals: int = 0) -> Outcome:
        """Return the verdict that a force is missing which has no name: how large, and what orders it.

        `close`: what has a probability that is too small for a name, or more rivals than tell anything.
        """
        court = self.court
        failed = next((gate.reason for gate in self.first.gates if gate.passed is False), "")
        sentence = f"There is a gap that no effect of the catalogue fits. {failed}".strip()
        sentence = f"{sentence} {self._of_the_force()}".strip()
        effective = [item for item in court.ranked if item.candidate.terms]
        shown = close or max(effective, key=lambda item: court.told(item).value, default=None)
        if shown is not None and court.told(shown).value < LEAST_SHOWN:
            shown = None
        if shown is None:
            sentence += " No hypothesis is a tenth of it."
        else:
            share, why = court.told(shown), court.against(shown)
            if rivals:
                why = f"{rivals} others are as much of it: that tells nothing"
            elif close is not None and not why:
                why = f"its probability is {probability:.2g}: a name needs {SEARCH.sure:g}"
            sentence += (
                f" The best hypothesis, {_words(self.effects(shown))}, is {part(share)} {_where(share)}"
                f"{f'; it is no name, as {why}' if why else ''}."
            )
        resembles = () if shown is None else plain_names(shown.candidate.identifiers)
        return self._verdict(
            VerdictKind.UNEXPLAINED, sentence, self.first.probability, shown, [], resembles=resembles,
            gates=self.first.gates,
        )  # fmt: skip

    def _verdict(
        self,
        kind: VerdictKind,
        sentence: str,
        probability: float,
        stands: H | None,
        first: Sequence[H],
        **more: Any,
    ) -> Outcome:
        court = self.court
        ranked = [*court.ranked, *(item for item in first if not any(item is one for one in court.ranked))]
        scores = np.array([self.way.score(item) for item in ranked])
        weights = np.exp(scores - logsumexp(scores)).tolist()
        rows = sorted(
            zip(weights, ranked, strict=True),
            key=lambda row: (not any(row[1] is item for item in first), -row[0]),
        )
        inclusion: dict[str, float] = {}
        for weight, item in rows:
            for name in dict.fromkeys(plain_names(item.candidate.identifiers)):
                inclusion[name] = inclusion.get(name, 0.0) + weight
        fit = self.found.none if stands is None else self.way.fitted(stands)
        verdict = Verdict(
            kind, sentence, probability, self.way.gain(stands or court.ranked[0]), inclusion=inclusion,
            explained=None if stands is None else explained_share(court.told(stands)),
            hypotheses=tuple(
                Hypothesis(
                    self.effects(item), evidence, weight, chi_square, freedom,
                    parameters_at(self.problem, item.shared, self.way.covariance(item)),
                )
                for weight, item in rows[:MOST_TOLD]
                for evidence, chi_square, freedom in (self.way.sizes(item),)
            ),
            remainders=remainder_estimates(self.problem, fit),
            **more,
        )  # fmt: skip
        return verdict, self.found, fit

    def effects(self, item: H) -> tuple[NamedEffect, ...]:
        """Return the effects of a hypothesis with their intervals."""
        ends = NINETY * np.sqrt(np.diag(self.way.covariance(item))[len(item.shared) :])
        return effects_at(self.problem, item.candidate, item.effect, item.effect - ends, item.effect + ends)

    def _of_the_force(self) -> str:
        """Return size and port of the missing force, and the variable that orders it; empty: none is seen."""
        if not isinstance(self.way, ByForce):
            return ""
        search = self.way.search
        at = search.best()
        (port,) = at.processes
        rows = []
        for trial, motion in zip(at.view.trials, at.motions, strict=True):
            samples = slice(None, None, trial.parts)
            moving = motion.positions[:, port], motion.speeds[:, port]
            columns = (motion.forces[port], *moving, trial.fine_time)
            rows.append(np.array([column[samples] for column in columns]))
        force, position, speed, time = np.concatenate(rows, axis=1)
        shares, names_of = orders(force, position, speed, time)
        ordered = "ordered by none of displacement, velocity, amplitude and time"
        if names_of:
            most = 100.0 * max(shares.values())
            ordered = f"ordered by {' and '.join(names_of)} ({most:.0f} % of its variance)"
        size = float(np.sqrt(np.mean(force**2)))
        unit = self.way.unit(at)
        return f"A force of {size:.3g} {unit} (rms) is missing at {search.ports[port]!r}, {ordered}."

    def _shape(self, best: H) -> str:
        """Return the sentence on the free shape of one law, unless trials not fitted speak against it."""
        (term, *others), told = best.candidate.terms, self.court.told
        free = None if others else self.way.freed(best)
        if free is None or told(free).value < told(best).value - SEARCH.slim:
            return ""
        spread = np.sqrt(np.diag(self.way.covariance(free)))[len(free.shared) + len(term.effect.parameters) :]
        shown = [
            f"{item.description.split(' (')[0]} {item.value:.2g} ({item.low:.2g} to {item.high:.2g})"
            for item, deviation in zip(self.effects(free)[0].shape, spread, strict=True)
            if deviation < SEARCH.told_by_data
        ]
        return f" With a shape of its own: {', '.join(shown)}." if shown else ""


def explained_share(share: Share) -> ExplainedShare:
    """Return the record of a share of the missing force."""
    before, after, noise = (float(column.sum()) for column in (share.before, share.after, share.noise))
    of_noise = min(noise / before, 1.0)
    remainder = min(max(after - noise, 0.0) / before, 1.0 - of_noise)
    return ExplainedShare(
        share.value, *share.interval, float(np.sqrt(max(after - noise, 0.0) / max(noise, 1e-300))),
        1.0 - of_noise - remainder, remainder, of_noise, "held-out" if share.held_out else "fitted",
    )  # fmt: skip


def _where(share: Share) -> str:
    kind = "not fitted" if share.held_out else "fitted"
    return (
        f"in {share.trials} trials that were {kind}" if share.trials > 1 else f"in one trial that was {kind}"
    )


def _words(effects: Sequence[NamedEffect]) -> str:
    return " and ".join(f"{effect.name}{f' at {effect.place}' if effect.place else ''}" for effect in effects)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _certain(probability: float) -> str:
    return "> 0.999" if probability > 0.9995 else f"{probability:.3f}"


def remainder_estimates(problem: Problem, found: CandidateFit) -> tuple[RemainderEstimate, ...]:
    """Return the remainders of a fit for the verdict."""
    remainder = found.remainder
    if remainder is None:
        return ()
    rows = (
        (name, remainder.size[channel], remainder.time[channel], remainder.frequency[channel])
        for channel, name in enumerate(problem.channel_names)
        if remainder.size[channel] > 0.0
    )
    return tuple(
        RemainderEstimate(name, float(size), float(time), float(frequency))
        for name, size, time, frequency in rows
    )
