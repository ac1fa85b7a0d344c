"""What every verdict on a search says alike, and what is too small to be a name.

A gain of half a thousandth is a nuisance of instruments, not a cause.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import floor, isnan, log10, nan
from typing import Any, NamedTuple

import numpy as np

from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.entry import NINETY, Effect, EffectParameter, Setting, ShapeParameter
from discrepancy.errors import said
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.predictive import with_draws
from discrepancy.fits.problem import Problem
from discrepancy.missing_force.explained import Explained
from discrepancy.search.starts import are_related
from discrepancy.search.strategy import Search
from discrepancy.verdict import (
    FREE_SHAPE,
    CalibratedParameter,
    Estimate,
    GapWindow,
    Gate,
    Hypothesis,
    Moment,
    NamedEffect,
    Verdict,
    VerdictKind,
)
from fe.runtime.patch import Clock, LoadGain, ModelPatch, SensorGain
from reporting.words import listing

Hypothetic = CandidateFit | Explained
"""A hypothesis as it is compared: as a whole simulation, or along the missing force."""


class Outcome(NamedTuple):
    """A verdict, the search that it rests on, and the fit that stands for it."""

    verdict: Verdict
    search: Search
    fit: CandidateFit


@dataclass(frozen=True)
class Conclusion:
    """What every verdict on a search says alike: hypotheses with their probabilities, as they are told."""

    found: Search
    log_bayes_factor: float
    rows: Sequence[tuple[Hypothetic, float]]

    @classmethod
    def of(
        cls, found: Search, best: CandidateFit, probabilities: Mapping[tuple[str, ...], float]
    ) -> "Conclusion":
        """Return what is said of the sets of effects of a search, the best of them given."""
        setting = found.problem.setting
        places = sum(np.log(len(term.effect.places(setting))) for term in best.candidate.terms)
        rows = [(found.best_of(names), probability) for names, probability in probabilities.items()]
        return cls(found, float(best.log_evidence - places - found.nothing.log_evidence), rows)

    @cached_property
    def inclusion(self) -> dict[str, float]:
        """The probability that each effect takes part."""
        held = [(set(plain_names(item.candidate.identifiers)), p) for item, p in self.rows]
        names = (effect.identifier for effect in self.found.effects)
        return {name: sum(probability for own, probability in held if name in own) for name in names}

    def outcome(
        self,
        kind: VerdictKind,
        sentence: str,
        probability: float,
        fit: CandidateFit | None = None,
        **more: Any,
    ) -> Outcome:
        """Return a verdict with the fit that stands for it: that without effect if none is given."""
        told = tuple(hypothesis(self.found.problem, item, p) for item, p in self.rows)
        verdict = Verdict(
            kind,
            sentence,
            probability,
            self.log_bayes_factor,
            hypotheses=told,
            inclusion=self.inclusion,
            **more,
        )
        return Outcome(verdict, self.found, self.found.none if fit is None else fit)

    def named(self, fit: CandidateFit, probability: float, gates: tuple[Gate, ...], **more: Any) -> Outcome:
        """Return the verdict that names the effects of a fit; the first gate is that of absolute fit."""
        named = named_effects(self.found.problem, fit)
        limit = "" if gates[0].passed else f" {gates[0].reason}"
        told = {"what": effects_text(named), "certain": probability_text(probability), "limit": limit}
        more |= {"effects": named, "gates": gates}
        return self.outcome(VerdictKind.NAMED, said("verdict.named", **told), probability, fit, **more)

    def family(self, fit: CandidateFit, probability: float, gates: tuple[Gate, ...]) -> Outcome:
        """Return the verdict that names the family of a fit with a free shape."""
        drawn = with_draws(self.found.problem, fit)
        named = named_effects(self.found.problem, drawn)
        family = ", ".join(sorted({effect.family for effect in named if effect.shape}))
        beside = ", ".join(effect.name for effect in named if not effect.shape)
        sentence = said("verdict.family", family=family, beside=f", beside {beside}" if beside else "")
        more = {"effects": named, "family": family, "gates": gates}
        return self.outcome(VerdictKind.FAMILY, sentence, probability, drawn, **more)


def plain_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return identifiers without the mark of a free shape."""
    return tuple(name.removesuffix(FREE_SHAPE) for name in names)


def hypothesis(problem: Problem, item: Hypothetic, probability: float) -> Hypothesis:
    """Return the record of a hypothesis; along the missing force no readings are compared."""
    effects, parameters = named_effects(problem, item), calibrated_parameters(problem, item)
    chi_square, freedom = nan, nan
    if isinstance(item, CandidateFit):
        chi_square, freedom = item.chi_square, float(problem.counts.sum() - item.spent.sum())
    return Hypothesis(effects, item.log_evidence, probability, chi_square, freedom, parameters)


def named_effects(problem: Problem, found: Hypothetic) -> tuple[NamedEffect, ...]:
    """Return the effects of a hypothesis with values and 90 % intervals of their parameters.

    Intervals are those of its draws, where it has any, else of its covariance.
    """
    spread = NINETY * np.sqrt(np.diag(found.covariance)[len(found.shared) :])
    low, high = found.effect - spread, found.effect + spread
    draws = getattr(found, "draws", None)
    if draws is not None:
        ends = np.quantile(draws, (0.05, 0.95), axis=0)
        # the most probable value may be one of many optima along a ridge
        low, high = np.minimum(ends[0], found.effect), np.maximum(ends[1], found.effect)
    bounds = iter(zip(low, high, strict=True))
    named = []
    for term, part in found.candidate.parts(found.effect):
        rows = [_estimate(item, u, *next(bounds)) for item, u in zip(term.parameters, part, strict=True)]
        effect, count = term.effect, len(term.effect.parameters)
        patch = term.patch(problem.setting, part)
        whose = (effect.identifier, effect.name, term.place, effect.family)
        named.append(NamedEffect(*whose, tuple(rows[:count]), tuple(rows[count:]), patch))
    return tuple(named)


def _estimate(item: EffectParameter | ShapeParameter, *scaled: float) -> Estimate:
    """Return an estimate at a scaled value and the ends of its interval."""
    value, *ends = (item.prior.value(float(u)) for u in scaled)
    return Estimate(item.name, value, min(ends), max(ends), item.unit, item.description)


def calibrated_parameters(problem: Problem, found: Hypothetic) -> tuple[CalibratedParameter, ...]:
    """Return the calibrated parameters of the model as a hypothesis has them, within the model's range."""
    layout = problem.shared
    values = layout.parameters(found.shared)
    variance = np.diag(found.covariance)[: layout.count]
    spread = layout.scale[: layout.count] * np.sqrt(np.maximum(variance, 0.0))
    return tuple(
        CalibratedParameter(item.name, float(value), float(deviation), item.unit)
        for item, value, deviation in zip(problem.model.parameters, values, spread, strict=True)
    )


# ---------------------------------------------------------------- words


def effects_text(effects: Iterable[NamedEffect]) -> str:
    """Return effects with their places."""
    found = (f"{item.name} at {item.place}" if item.place else item.name for item in effects)
    return listing(dict.fromkeys(found))


def probability_text(probability: float) -> str:
    """Return a probability that is neither rounded to one nor to zero."""
    if isnan(probability):
        return "not known"
    if probability > 0.9995:
        return "> 0.999"
    if probability < 5e-4:
        return f"{probability:.0e}" if probability > 1e-99 else "< 1e-99"
    return f"{probability:.3f}"


def below_limit(names: Sequence[str], coloured: str = "") -> str:
    """Return the sentence on what is too small to tell from noise, and what is nearest to it."""
    nearest = f"; the nearest are {', '.join(names[:4])}" if names else ""
    return said("verdict.below_limit", coloured=coloured, nearest=nearest)


LEAST_SIZE = 1e-3
"""Size of a gain, tare or clock error over what it acts on, below which it is a nuisance and no name."""
UNSTATED_GAIN = 1e-2
"""The same of the gain of a channel of which no deviation is stated, beside a law that explains as much: a
calibration that nobody stated is not exact."""


def is_one_driven_channel(problem: Problem) -> bool:
    """Whether a campaign is of driven trials and one channel: no error of it has a pattern of its own."""
    driven = all(trial.kind in (TrialKind.DRIVEN, TrialKind.FORCED) for trial in problem.campaign.trials)
    return driven and len(problem.channel_names) == 1


def is_small(problem: Problem, patch: ModelPatch, *, unstated: float = LEAST_SIZE) -> bool:
    """Whether a patch is errors of instruments only, too small over what they act on to be a name.

    `unstated`: the least size of a gain of a channel of which no deviation is stated.
    """
    channels, scales = problem.campaign.channels, problem.setting.scales
    sizes = []
    for item in patch:
        least = LEAST_SIZE
        if isinstance(item, LoadGain):
            size = max(abs(item.gain), abs(item.tare) / scales.force if scales.force > 0.0 else 0.0)
        elif isinstance(item, SensorGain):
            size = abs(item.gain)
            if item.channel in channels and channels[item.channel].gain_deviation == 0.0:
                least = unstated
        elif isinstance(item, Clock):
            size = max(abs(item.rate), abs(item.zero) * scales.angular_frequency)
        else:
            return False
        sizes.append(size / least)
    return max(sizes, default=1.0) < 1.0


# ---------------------------------------------------------------- beside a verdict: when, and what else

NO_GAP = (VerdictKind.NOTHING_MISSING, VerdictKind.BELOW_LIMIT)
"""Verdicts by which the model stands as it is."""
TOLD = 3
"""Windows that are told one by one; of more the largest is, and all are in the file. So many effects that
were not tested are called by name."""


def moment_text(moment: Moment) -> str:
    """Return a time with its 90 % interval, by two digits of its width."""
    width = moment.high - moment.low
    places = max(0, 1 - floor(log10(width))) if width > 0.0 else 6
    low, high = f"{moment.low:.{places}f}", f"{moment.high:.{places}f}"
    return f"{moment.value:.{places}f} s ({low} to {high})"


def window_text(window: GapWindow) -> str:
    """Return since when and until when, in words."""
    if window.begin is None and window.end is None:
        return "throughout the record"
    since = f"since {moment_text(window.begin)}" if window.begin else "from the first sample"
    return since + (f" until {moment_text(window.end)}" if window.end else ", to the end of the record")


def when_sentence(windows: Sequence[GapWindow]) -> str:
    """Return when the gap of the model as it was is there, in one sentence; empty without a gap in time."""
    found = [window for window in windows if not window.with_effect]
    if not found:
        return ""
    if all(window.begin is None and window.end is None for window in found):
        return "The gap is there throughout the records."
    told = sorted(found, key=lambda window: (window.begin is None, -window.size))
    if len(told) > TOLD:
        most = max(found, key=lambda window: window.size)
        return f"The gap comes and goes, {len(found)} times; the largest is {_where(most)}."
    return f"The gap is there {'; '.join(_where(window) for window in told)}."


def _where(window: GapWindow) -> str:
    return f"in {window.trial!r} {window_text(window)}, {_times(window.size)} the noise"


def _times(size: float) -> str:
    two = f"{size:.2g}"
    return f"{float(two):,.0f} times" if "e+0" in two else f"{two} times"


def dated(verdict: Verdict, windows: Sequence[GapWindow]) -> str:
    """Return the sentence of a verdict, with when the gap is there where that tells something."""
    when = acting_sentence(verdict.effects)
    telling = begins_inside(windows) or verdict.kind is VerdictKind.UNEXPLAINED
    if not when and verdict.kind not in NO_GAP and telling:
        when = when_sentence(windows)
    return f"{verdict.sentence} {when}".strip()


def begins_inside(windows: Sequence[GapWindow]) -> bool:
    """Whether the gap of the model as it was has a begin in a record: something happened there."""
    return any(window.begin is not None for window in windows if not window.with_effect)


def acting_sentence(effects: Sequence[NamedEffect]) -> str:
    """Return when effects in windows act, in one sentence each; empty for those that always act."""
    sentences = []
    for effect in effects:
        windows = effect.patch.primitives[0].windows if len(effect.patch) else ()
        parts = []
        for trial, begin, end in windows:
            since = "from the first sample" if begin is None else f"from {begin:.6g} s"
            until = "on" if end is None else f"until {end:.6g} s"
            parts.append(f"{since} {until} in {trial!r}")
        more = f"; and in {len(parts) - TOLD} more" if len(parts) > TOLD else ""
        if parts:
            sentences.append(f"{effect.name} acts {'; '.join(parts[:TOLD])}{more}.")
    return " ".join(sentences)


def with_untested(verdict: Verdict, setting: Setting, effects: Sequence[Effect]) -> Verdict:
    """Return a verdict on a group or on several effects that says what could not be tested.

    A cause that needs another trial or a port is no member of a group, however like one it acts: those that
    are easily taken for a member are named.
    """
    several = verdict.kind in (VerdictKind.NAMED, VerdictKind.NAMED_IN_PART) and len(verdict.effects) > 1
    if verdict.kind is not VerdictKind.GROUP and not several:
        return verdict
    untested = [effect for effect in effects if effect.unavailable(setting) is not None]
    if not untested:
        return verdict
    known = {effect.identifier: effect for effect in effects}
    members = [known[item.identifier] for item in verdict.effects if item.identifier in known]
    untested.sort(key=lambda effect: not any(are_related(effect, member) for member in members))
    rest = len(untested) - TOLD
    names = [effect.name for effect in untested[:TOLD]] + ([f"{rest} more"] if rest > 0 else [])
    sentence = said("remarks.untested", sentence=verdict.sentence, names=listing(names))
    return replace(verdict, sentence=sentence)


def look_alike_remark(verdict: Verdict, compared: Iterable[Effect]) -> str | None:
    """Return what else a named effect could be, from the likenesses that the catalogue declares.

    Parameters
    ----------
    verdict : Verdict
        With its effects.
    compared : iterable of Effect
        Effects that could act and were compared with the named ones.

    Returns
    -------
    str or None
        One sentence or two; None where nothing is named.
    """
    if verdict.kind is not VerdictKind.NAMED:
        return None
    effects = {effect.identifier: effect for effect in compared}
    named = {effect.identifier: effect.name for effect in verdict.effects}
    alike = {
        identifier for identifier, effect in effects.items() if not set(effect.confusable).isdisjoint(named)
    }
    alike |= {other for name in named.keys() & effects.keys() for other in effects[name].confusable}
    alike -= named.keys()
    does = "does" if len(named) == 1 else "do together"
    text = said("remarks.look_alike", names=" and ".join(named.values()), does=does)
    tried, untried = sorted(alike & effects.keys()), sorted(alike - effects.keys())
    missed = said("remarks.not_compared", names=", ".join(untried), was=_was(untried)) if untried else ""
    if tried:
        words = said("remarks.compared", names=", ".join(tried), was=_was(tried))
        return f"{text}{words}{f'; {missed}' if missed else '.'}"
    return f"{text} Of what is known to look alike, {missed}" if missed else text


def _was(items: list[str]) -> str:
    return "was" if len(items) == 1 else "were"
