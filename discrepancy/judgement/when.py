"""Since when, until when: the windows of a gap in words."""

from collections.abc import Sequence
from math import floor, log10

from discrepancy.verdict import GapWindow, Moment, NamedEffect

TOLD = 3
"""Windows that are told one by one; of more the largest is, and all are in the file."""


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
    if window.begin is None:
        assert window.end is not None
        return f"from the first sample until {moment_text(window.end)}"
    if window.end is None:
        return f"since {moment_text(window.begin)}, to the end of the record"
    return f"since {moment_text(window.begin)} until {moment_text(window.end)}"


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
