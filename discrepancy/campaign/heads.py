"""Heads of the columns of a laboratory's table: their names and units, and which are times."""

import re
from collections.abc import Sequence

from discrepancy.campaign.quantity import Quantity
from discrepancy.campaign.units import LETTERS_OF_DEGREES, conversion_factor, quantities_of

_LONGEST_HEAD = 200
_HEAD = re.compile(
    r"(.+?)(?:(?!\S\d+\S$)\s*(?:\[([^][]+)\]|\(([^()]+)\))|\s+/\s+(.+)|,\s+(.+)|\s+in\s+(.+))"
)
"""Name and unit; a number that touches its name, as in `strain[1]`, is part of it."""
_WORD = re.compile(r"[A-Z]?[^\W\d_A-Z]+|[A-Z]+|\d+")
_TIME_NAME = re.compile(r"(?:.*\.)?(?:time|x_value)[ _]?\d*", re.IGNORECASE)
"""Names of times that need no unit to be known as such; `X_Value` is LabVIEW's."""
_TEMPERATURE_NAME = re.compile(r".*temp.*|T(?:[ _]?\d+|_.*)?", re.IGNORECASE | re.DOTALL)
"""Names of temperatures, beside which F and C are degrees."""
_CLOCK_FORMAT = re.compile(
    r"(?=.*(?::|yy|jj|aa))[hmsfdytja0]+(?:[]:./, _-]+[hmsfdytja0]+)*(?: ?am/pm)?", re.IGNORECASE
)
"""How a clock is written, such as `hh:mm:ss.ffffff` and `dd.mm.yyyy`, in the place of a unit."""


def split_head(text: str, unit: str) -> tuple[str, str]:
    """Return the name and the unit of a column's head such as `Weg [mm]`, `F (kN)` or `t / s`.

    What stands in brackets or after a slash is part of the name if it is not a unit. The format of
    a clock is dropped.

    Parameters
    ----------
    text : str
        The text at the head of the column.
    unit : str
        The unit from a row of units below the heads, which replaces that of the head; empty if
        there is none.
    """
    match = _HEAD.fullmatch(text[:_LONGEST_HEAD])
    if match is None:
        return text, unit
    name, *forms_of_unit = match.groups()
    unit_of_head = next(filter(None, forms_of_unit), "").strip()
    name = name.strip()
    if is_clock_format(unit_of_head):
        return name, unit
    known_unit = unit_beside(name, unit_of_head)
    return (name, unit or known_unit) if known_unit else (text, unit)


def plain_unit(text: str) -> str:
    """Return a unit without brackets; a dash stands for a plain number."""
    text = text.strip("[]() ")
    return "1" if text in ("-", "–") else text


def unit_beside(name: str, text: str) -> str:
    """Return the unit that a text beside a column's name means; empty if it is not a unit.

    F and C are degrees beside a temperature.
    """
    unit = plain_unit(text)
    if unit in LETTERS_OF_DEGREES and _TEMPERATURE_NAME.fullmatch(name):
        return LETTERS_OF_DEGREES[unit]
    return unit if is_unit(unit) else ""


def is_clock_format(text: str) -> bool:
    """Return whether a text is the format of a clock, such as `(hh:mm:ss.ffffff)`."""
    return _CLOCK_FORMAT.fullmatch(text.strip("[]() ")) is not None


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
    """Find the columns of times of a table; return their heads.

    There may be one, or several with a common word in their names, such as `time1` and `time2`. If
    several have no word in common, the result is empty, because one of them may be a delay or
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
