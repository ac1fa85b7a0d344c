"""Number formats of Excel: the units that they show, and numbers as they show them."""

import re
from collections.abc import Sequence
from decimal import Decimal
from functools import cache

from discrepancy.campaign.cells import ExactNumber
from discrepancy.campaign.heads import is_same_unit, is_unit
from discrepancy.errors import CampaignFileError
from reporting.words import listing

_NUMBER_FORMAT = re.compile(
    r"""(?:\[[^\]]*\])*[^"\\%]*[0#?](,*)((?:"[^"]*"|\\.|_.|[ %])*)(?:\[[^\]]*\])*"""
)
"""A number format of Excel: the commas that divide by 1000, and the text behind the digits."""


def unit_beside_number_formats(name: str, head: str, unit: str, filled: Sequence[str]) -> str:
    """Return the unit of a column, given its head and the number formats of its filled cells.

    The unit that Excel shows beside the numbers replaces a missing unit, and a plain number by
    per cent.

    Raises
    ------
    CampaignFileError
        If cells are shown in several units, or in another one than the head states.
    """
    shown_units = {cell.shown_unit if isinstance(cell, ExactNumber) else "" for cell in filled}
    if shown_units == {""}:
        return unit
    if unit not in ("", "1"):
        shown_units.discard("")  # the head is the unit of cells that show none
    if len(shown_units) > 1:
        listed_units = listing(sorted(shown or "no unit" for shown in shown_units))
        raise CampaignFileError(
            f"{name}: the cells of the column {head!r} are shown in {listed_units}: give all of "
            "them one number format."
        )
    (shown_unit,) = shown_units
    is_ratio = shown_unit == "%" and unit == "1"
    if not unit or is_ratio or is_same_unit(unit, shown_unit):
        return shown_unit
    raise CampaignFileError(
        f"{name}: the column {head!r} has the unit {unit}, but its cells are shown in "
        f"{shown_unit}: correct the head or the number format."
    )


def shown_number(value: float, number_format: str) -> ExactNumber:
    """Return a number of a workbook as its cell shows it if it shows a unit, else as it is stored.

    A number in per cent is shown times 100, and each comma behind the digits divides it by 1000.
    """
    unit, power_of_ten = _unit_of_number_format(number_format)
    text = f"{Decimal(repr(value)).scaleb(power_of_ten):f}" if power_of_ten else repr(value)
    number = ExactNumber(text)
    number.shown_unit = unit
    return number


@cache
def _unit_of_number_format(number_format: str) -> tuple[str, int]:
    """Return the unit that a number format shows, and the power of ten by which it multiplies.

    If the text behind the digits is not a unit, the result is an empty text and 0.
    """
    match = _NUMBER_FORMAT.fullmatch(number_format.partition(";")[0])
    if match is None:
        return "", 0
    commas, literals = match.groups()
    unit = re.sub(r'"([^"]*)"|\\(.)|_.', r"\1\2", literals).strip()
    if not is_unit(unit):
        return "", 0
    is_per_cent = "%" in re.sub(r'"[^"]*"|\\.', "", literals)
    return unit, 2 * is_per_cent - 3 * len(commas)
