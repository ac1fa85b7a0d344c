"""What the heads of a table's columns say: names, units, and which columns are times."""

import re
from collections.abc import Sequence

from discrepancy.campaign.quantity import Quantity
from discrepancy.campaign.units import conversion, quantities_of

_LONGEST_HEAD = 200
_HEAD = re.compile(r"(.+?)(?:(?!\S\d+\S$)\s*(?:\[([^][]+)\]|\(([^()]+)\))|\s+/\s+(.+)|,\s+(.+)|\s+in\s+(.+))")
"""Name and unit; a number that touches its name, as in `strain[1]`, is part of it."""
_WORD = re.compile(r"[A-Z]?[^\W\d_A-Z]+|[A-Z]+|\d+")
_TIME_NAME = re.compile(r"(?:.*\.)?(?:time|x_value)[ _]?\d*", re.IGNORECASE)
"""Names of times that need no unit to be known as such; `X_Value` is LabVIEW's."""


def named(text: str, unit: str) -> tuple[str, str]:
    """Return name and unit of a head such as `Weg [mm]`, `F (kN)` or `t / s`; a row of units goes first."""
    found = _HEAD.fullmatch(text[:_LONGEST_HEAD])
    said = "" if found is None else next(filter(None, found.groups()[1:]), "").strip()
    if found is not None and is_unit(said):
        return found[1].strip(), unit or plain_unit(said)
    return text, unit


def plain_unit(text: str) -> str:
    """Return a unit without brackets; a dash is that of a plain number."""
    text = text.strip("[]() ")
    return "1" if text in ("-", "–") else text


def is_unit(text: str) -> bool:
    """Whether a text is a unit of a quantity that is measured here, or of time."""
    unit = plain_unit(text)
    try:
        return bool(quantities_of(unit)) or bool(conversion(unit, "s"))
    except ValueError:
        return False


def load_or_time(unit: str) -> str:
    """Return "time" or "force" where a unit is one of them."""
    try:
        return "time" if conversion(unit, "s") else ""
    except ValueError:
        return "force" if Quantity.FORCE in quantities_of(unit) else ""


def times_among(heads: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """Return the columns of times of a table: one, or several of names of one kind as `time1` and `time2`.

    None where several have nothing in common: one may be a delay, or another clock of the same rows.
    """
    times = [
        head
        for head, unit in zip(heads, units, strict=True)
        if load_or_time(unit) == "time" or (not unit and _TIME_NAME.fullmatch(head))
    ]
    return tuple(times) if times and shared_words(times) else ()


def words(head: str) -> frozenset[str]:
    """Return the words and numbers that a head is made of, as `acc` and `1` of `acc1`."""
    return frozenset(word.casefold() for word in _WORD.findall(head))


def shared_words(heads: Sequence[str]) -> frozenset[str]:
    """Return the words that all of some heads have, without numbers."""
    common = frozenset.intersection(*map(words, heads))
    return frozenset(word for word in common if not word.isdigit())
