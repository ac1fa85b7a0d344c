"""What a name does not exclude: causes that the catalogue lacks and that act alike."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.search.starting_points import are_related
from discrepancy.sentences import said
from discrepancy.verdict import Verdict, VerdictKind
from reporting.words import listing

TOLD = 3
"""Effects that were not tested and are called by name in the sentence of a verdict."""


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
