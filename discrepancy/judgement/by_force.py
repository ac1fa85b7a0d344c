"""Verdicts by the missing force, where no simulation leaves noise alone: named in part, a group, unexplained.

A set of effects is named in part that is probable along the missing force and is most of it, in the trials
that were fitted and in those that were not, with what was calibrated within twice its prior deviations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import nan
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from discrepancy.catalogue.entry import NINETY
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.fitting import fit as fit_to
from discrepancy.fits.gates import absolute_gate
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.force import MissingForce, missing_force
from discrepancy.missing_force.hypotheses import key_of, sees_forces
from discrepancy.missing_force.naming import Explained, ForceSearch
from discrepancy.missing_force.shares import ForceShare, orders
from discrepancy.models.port_units import port_unit
from discrepancy.search.strategy import Search
from discrepancy.search_settings import SEARCH
from discrepancy.verdict import ExplainedShare, Hypothesis, NamedEffect, Verdict, VerdictKind

from .conclusion import effects_at, parameters_at, plain_names
from .court import Court, names, of_what, part, percent

FloatArray = NDArray[np.float64]
Outcome = tuple[Verdict, Search, CandidateFit]

LEAST_SHOWN = 0.1
"""Share of the missing force from which a hypothesis is shown as the best one where none is named."""
MOST_TOLD = 12
"""Hypotheses that are listed."""


def judged_by_force(problem: Problem, found: Search, first: Verdict) -> Outcome:
    """Return the verdict where what the best simulation leaves is not the recorded noise.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    found : Search
        With hypotheses along the missing force.
    first : Verdict
        What the simulations led to.

    Returns
    -------
    Verdict, Search, CandidateFit
        As `naming.name` returns them.
    """
    assert found.force is not None
    court = Court(problem, found.force, found.forces, len(found.effects))
    said = _Said(problem, found, first, court)
    if not court.contenders:
        return said.unexplained()
    best = court.slimmed(court.contenders[0])
    members = [best, *court.rivals(best)]
    probability = sum(court.probability(item) for item in members)
    if 1 < len(members) <= SEARCH.largest_group:
        return said.group(members, probability)
    if probability < SEARCH.sure or said.gain(members[0]) < SEARCH.bayes_factor:
        return said.unexplained(members[0], probability)
    return said.in_part(members[0], probability)


def shown_force(problem: Problem, search: Search, fit: CandidateFit) -> MissingForce | None:
    """Return the missing force, with the law of a verdict drawn through it; None where none can be seen."""
    try:
        force = search.force
        terms = fit.candidate.terms
        if terms and not any(term.place in problem.model.ports() for term in terms):
            return None
        if force is None:
            if not sees_forces(problem):
                return None
            force = ForceSearch(problem)
            force.locate()
        key = key_of(fit.candidate)
        found = next((item for item in search.forces if key_of(item.candidate) == key), None)
        if found is None and terms:
            found = force.followed(force.whole, fit.candidate, fit.point.effect)
        return missing_force(force, force.whole if found is None else found)
    except (DiscrepancyError, np.linalg.LinAlgError, ValueError):  # a picture that cannot be is left out
        return None


@dataclass(frozen=True)
class _Said:
    """What is said of hypotheses: the verdicts of each kind, with the fit that stands for each."""

    problem: Problem
    found: Search
    first: Verdict
    court: Court

    def in_part(self, best: Explained, probability: float) -> Outcome:
        """Return the verdict that names a hypothesis in part."""
        effects, share = self.effects(best), self.court.told(best)
        family = ", ".join(sorted({t.effect.family for t in best.candidate.terms if t.free_shape}))
        named = _words([effect for effect in effects if not effect.shape])
        free = f"an effect of the family {family}, with a shape of its own," if family else ""
        what = " and ".join(text for text in (named, free) if text)
        inside = self.court.shares.has_held_out and not share.held_out
        sentence = (
            f"{_capital(what)} is missing (probability {_certain(probability)}): "
            f"{part(share)} {_where(share)}"
            f"{'; in the trials held out it has hardly any force' if inside else ''}; "
            f"{share.left:.3g} of {share.whole:.3g} {self._unit(best)} (rms) are left and unexplained."
            f"{self._shape(best)}"
        )
        return self._verdict(
            VerdictKind.NAMED_IN_PART, sentence, probability, best, [best], effects=effects, family=family,
            gates=(absolute_gate(self.problem, self.found.best()),),
        )  # fmt: skip

    def group(self, members: Sequence[Explained], probability: float) -> Outcome:
        """Return the verdict that one of several hypotheses is what is missing, what they share first."""
        share = self.court.told(members[0])
        words = [f"{_words(self.effects(item))} ({percent(self.court.told(item))})" for item in members]
        sentence = (
            f"Either {', '.join(words[:-1])} or {words[-1]} is this share of {of_what(share)} "
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
            gates=(absolute_gate(self.problem, self.found.best()),),
        )  # fmt: skip

    def unexplained(self, close: Explained | None = None, probability: float = 0.0) -> Outcome:
        """Return the verdict that a force is missing which has no name: how large, and what orders it.

        `close`: what has a probability that is too small for a name.
        """
        court = self.court
        failed = next((gate.reason for gate in self.first.gates if gate.passed is False), "")
        sentence = f"There is a gap that no effect of the catalogue fits. {failed}".strip()
        sentence += f" {self._of_the_force()}"
        effective = [item for item in court.ranked if item.candidate.terms]
        shown = close or max(effective, key=lambda item: court.told(item).value, default=None)
        if shown is not None and court.told(shown).value < LEAST_SHOWN:
            shown = None
        if shown is None:
            sentence += " No hypothesis is a tenth of it."
        else:
            share, why = court.told(shown), court.against(shown)
            if close is not None:
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
        stands: Explained | None,
        first: Sequence[Explained],
        **more: Any,
    ) -> Outcome:
        court = self.court
        scores = np.array([court.score(item) for item in court.ranked])
        weights = np.exp(scores - logsumexp(scores)).tolist()
        rows = sorted(
            zip(weights, court.ranked, strict=True),
            key=lambda row: (not any(row[1] is item for item in first), -row[0]),
        )
        inclusion: dict[str, float] = {}
        for weight, item in rows:
            for name in dict.fromkeys(plain_names(item.candidate.identifiers)):
                inclusion[name] = inclusion.get(name, 0.0) + weight
        verdict = Verdict(
            kind, sentence, probability, self.gain(stands or court.ranked[0]), inclusion=inclusion,
            explained=None if stands is None else explained_share(court.told(stands)),
            hypotheses=tuple(
                Hypothesis(
                    self.effects(item), item.evidence, weight, nan, nan,
                    parameters_at(self.problem, item.shared, item.told_covariance),
                )
                for weight, item in rows[:MOST_TOLD]
            ),
            **more,
        )  # fmt: skip
        return verdict, self.found, self.found.none if stands is None else self._simulated(stands)

    def gain(self, item: Explained) -> float:
        """Return the log evidence of a hypothesis over missing forces alone [nat]."""
        return item.evidence - self.court.search.whole.evidence

    def effects(self, item: Explained) -> tuple[NamedEffect, ...]:
        """Return the effects of a hypothesis with their intervals."""
        ends = NINETY * np.sqrt(np.diag(item.told_covariance)[len(item.shared) :])
        return effects_at(self.problem, item.candidate, item.effect, item.effect - ends, item.effect + ends)

    def _simulated(self, item: Explained) -> CandidateFit:
        """Return the simulation of a hypothesis at its values, with their covariance."""
        point = self.court.search.whole_point(item)
        try:
            shown = fit_to(self.problem, item.candidate, point, local_only=True)
        except (DiscrepancyError, np.linalg.LinAlgError):
            return self.found.none
        return replace(shown, covariance=item.told_covariance)

    def _of_the_force(self) -> str:
        """Return size and port of the missing force, and the variable that orders it."""
        search = self.court.search
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
        return (
            f"A force of {size:.3g} {self._unit(at)} (rms) is missing at {search.ports[port]!r}, {ordered}."
        )

    def _unit(self, item: Explained) -> str:
        """Return the unit of the force at the port of a hypothesis."""
        ports = self.court.search.ports
        places = [t.place for t in item.candidate.terms if t.place in ports]
        return port_unit(places[0] if places else ports[next(iter(item.processes))], self.problem.model.inner)

    def _shape(self, best: Explained) -> str:
        """Return the sentence on the free shape of one law, unless trials not fitted speak against it."""
        (term, *others), told = best.candidate.terms, self.court.told
        freed = replace(term, free_shape=True)
        ranked = self.court.ranked
        free = next((item for item in ranked if item.candidate.terms == (freed,)), None)
        if others or free is None or told(free).value < told(best).value - SEARCH.slim:
            return ""
        spread = np.sqrt(np.diag(free.covariance))[len(term.effect.parameters) :]
        shown = [
            f"{item.description.split(' (')[0]} {item.value:.2g} ({item.low:.2g} to {item.high:.2g})"
            for item, deviation in zip(self.effects(free)[0].shape, spread, strict=True)
            if deviation < SEARCH.told_by_data
        ]
        return f" With a shape of its own: {', '.join(shown)}." if shown else ""


def explained_share(share: ForceShare) -> ExplainedShare:
    """Return the record of a share of the missing force."""
    before, after, noise = (float(column.sum()) for column in (share.before, share.after, share.noise))
    of_noise = min(noise / before, 1.0)
    remainder = min(max(after - noise, 0.0) / before, 1.0 - of_noise)
    return ExplainedShare(
        share.value, *share.interval, float(np.sqrt(max(after - noise, 0.0) / max(noise, 1e-300))),
        1.0 - of_noise - remainder, remainder, of_noise, "held-out" if share.held_out else "fitted",
    )  # fmt: skip


def _where(share: ForceShare) -> str:
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
