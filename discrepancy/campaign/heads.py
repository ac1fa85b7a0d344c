"""Heads of the columns of a laboratory's table: their names and units, and which are times."""

import re
from collections.abc import Sequence

from discrepancy.campaign.quantity import Quantity
from discrepancy.campaign.units import conversion_factor, quantities_of

_LONGEST_HEAD = 200
_HEAD = re.compile(
    r"(.+?)(?:(?!\S\d+\S$)\s*(?:\[([^][]+)\]|\(([^()]+)\))|\s+/\s+(.+)|,\s+(.+)|\s+in\s+(.+))"
)
"""Name and unit; a number that touches its name, as in `strain[1]`, is part of it."""
_WORD = re.compile(r"[A-Z]?[^\W\d_A-Z]+|[A-Z]+|\d+")
_TIME_NAME = re.compile(r"(?:.*\.)?(?:time|x_value)[ _]?\d*", re.IGNORECASE)
"""Names of times that need no unit to be known as such; `X_Value` is LabVIEW's."""


def split_head(text: str, unit: str) -> tuple[str, str]:
    """Return the name and the unit of a column's head such as `Weg [mm]`, `F (kN)` or `t / s`.

    Parameters
    ----------
    text : str
        The text at the head of the column.
    unit : str
        The unit from a row of units below the heads, which comes first; empty if there is none.
    """
    match = _HEAD.fullmatch(text[:_LONGEST_HEAD])
    if match is None:
        return text, unit
    name, *forms_of_unit = match.groups()
    unit_of_head = next(filter(None, forms_of_unit), "").strip()
    if not is_unit(unit_of_head):
        return text, unit
    return name.strip(), unit or plain_unit(unit_of_head)


def plain_unit(text: str) -> str:
    """Return a unit without brackets; a dash stands for a plain number."""
    text = text.strip("[]() ")
    return "1" if text in ("-", "–") else text


def is_unit(text: str) -> bool:
    """Return whether a text is a unit of time, or of a quantity that channels measure."""
    unit = plain_unit(text)
    try:
        return bool(quantities_of(unit)) or bool(conversion_factor(unit, "s"))
    except ValueError:
        return False


def is_same_unit(first: str, second: str) -> bool:
    """Return whether two texts mean one unit, as um and µm do."""
    try:
        return first == second or conversion_factor(first, second) == 1.0
    except ValueError:
        return False


def load_or_time_role(unit: str) -> str:
    """Return "time" or "force" for a unit of one of them, else an empty text."""
    try:
        return "time" if conversion_factor(unit, "s") else ""
    except ValueError:
        return "force" if Quantity.FORCE in quantities_of(unit) else ""


def time_heads(heads: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """Return the heads of the columns of times of a table.

    There may be one, or several with a common word in their names, such as `time1` and `time2`. If
    several have no word in common the result is empty, because one of them may be a delay, or
    another clock of the same rows.

    Parameters
    ----------
    heads : sequence of str
        The names of the columns as printed at their heads.
    units : sequence of str
        Their units; empty where a unit is not known.
    """
    times = []
    for head, unit in zip(heads, units, strict=True):
        is_named_so = not unit and _TIME_NAME.fullmatch(head)
        if is_named_so or load_or_time_role(unit) == "time":
            times.append(head)
    return tuple(times) if times and shared_words(times) else ()


def words_of_head(head: str) -> frozenset[str]:
    """Return the words and numbers in a head, in lower case: `acc` and `1` for `acc1`."""
    return frozenset(word.casefold() for word in _WORD.findall(head))


def shared_words(heads: Sequence[str]) -> frozenset[str]:
    """Return the words, without numbers, that all of several heads have in common."""
    common_words = frozenset.intersection(*map(words_of_head, heads))
    return frozenset(word for word in common_words if not word.isdigit())
