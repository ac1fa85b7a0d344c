"""What a name does not exclude: causes that the catalogue lacks and that act alike."""

from collections.abc import Iterable

from discrepancy.catalogue.entry import Effect
from discrepancy.verdict import Verdict, VerdictKind


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
        other
        for identifier, effect in effects.items()
        for other in effect.confusable
        if identifier in named and other not in named
    }
    alike |= {
        identifier
        for identifier, effect in effects.items()
        if identifier not in named and not named.keys().isdisjoint(effect.confusable)
    }
    text = (
        f"A cause that the catalogue lacks and that acts on these trials as {' and '.join(named.values())} "
        f"{'does' if len(named) == 1 else 'do together'}, within the noise, would be given the same name."
    )
    tried, untried = sorted(alike & effects.keys()), sorted(alike - effects.keys())
    if tried:
        text += (
            f" Of what is known to look alike, {', '.join(tried)} {_was(tried)} compared, with less evidence"
        )
        text += f"; {', '.join(untried)} {_was(untried)} not compared." if untried else "."
    elif untried:
        text += f" Of what is known to look alike, {', '.join(untried)} {_was(untried)} not compared."
    return text


def _was(items: list[str]) -> str:
    return "was" if len(items) == 1 else "were"
