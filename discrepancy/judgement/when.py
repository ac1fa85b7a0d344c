"""What is said beside a verdict: since when and until when, and what a name does not exclude."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import floor, log10

from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.errors import said
from discrepancy.search.starts import are_related
from discrepancy.verdict import GapWindow, Moment, NamedEffect, Verdict, VerdictKind
from reporting.words import listing

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
