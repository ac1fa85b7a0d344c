"""A column of a laboratory's table as it is understood, and what its cells stand for."""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np

from discrepancy.campaign.heads import load_or_time, times_among
from discrepancy.campaign.records import Quantity, TrialKind
from discrepancy.campaign.sampling import as_meant
from discrepancy.campaign.sheet import Sheet
from discrepancy.campaign.units import UNITS, conversion, conversion_of, quantities_of
from discrepancy.errors import CampaignFileError, said
from reporting.words import counted, is_or_are, listing

NOISE, LEFT_OUT, INPUT = "noise", "-", "input:"
"""Kind of a file of samples at rest, role of a column that is left out, and how that of an input begins."""
EXACT, FREE = "exact", "free"
"""What a zero or a gain is that has no deviation, or any."""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
AMOUNT = re.compile(rf"\s*({_NUMBER})\s*(.*?)\s*", re.ASCII)
"""A number and what stands behind it, such as a unit."""


@dataclass(frozen=True)
class Column:
    """A column as it is understood; None and empty texts where a question is open.

    Attributes
    ----------
    sheet : Sheet
        Where it is from.
    head : str
        Its name, without a unit.
    role : str
        `LEFT_OUT`, a column that every table may have (`time`, `force`), `INPUT` and a name, or an output.
    unit, si : str
        As written or said, and in SI.
    read_in : str
        The unit once `--scale` was applied; `unit` where there is no scale.
    quantity : Quantity or None
        Of a channel or an input.
    to_si : float or None
        What one of the unit is in SI, with the scale.
    """

    sheet: Sheet
    head: str
    role: str
    unit: str
    si: str = ""
    quantity: Quantity | None = None
    to_si: float | None = None
    read_in: str = ""

    @property
    def is_channel(self) -> bool:
        """Whether it is a measured channel, neither an input nor a time, a force or a temperature."""
        return self.quantity is not None and INPUT not in self.role

    @property
    def title(self) -> str:
        """Its name in the campaign."""
        return self.head if self.is_channel else self.role.removeprefix(INPUT)

    def in_si(self, decimal: str) -> tuple[str, ...]:
        """Return its cells in SI, empty where too little is known."""
        if self.to_si is None or not decimal:
            return ("",) * len(self.sheet.lines)
        cells = self.sheet.numbers(self.head, decimal)
        if self.to_si == 1.0:
            return cells
        values = np.array([float(cell or "nan") for cell in cells])
        if self.role == "time" and len(cells) > 1 and np.all(np.diff(values) > 0.0):
            values = as_meant(values, cells)  # minutes of few digits may be even
        # two digits less than a float may need, so that no rounding shows: 4.387 mm is 0.004387 m
        shown = (f"{value * self.to_si:.15g}" for value in values.tolist())
        return tuple(cell and text for cell, text in zip(cells, shown, strict=True))


def role_by_unit(head: str, heads: Sequence[str], units: Sequence[str], kinds: Collection[str]) -> str:
    """Return the role of a column, of `kinds` "time" and "force", where its table leaves no doubt, else "".

    Parameters
    ----------
    head : str
        Name of the column.
    heads, units : sequence of str
        Those of all columns of the table.
    kinds : collection of str
        Roles that a unit may tell.
    """
    if head in times_among(heads, units):
        return "time"
    of_units = [load_or_time(unit) for unit in units]
    kind = of_units[heads.index(head)]
    return kind if kind in kinds and of_units.count(kind) == 1 else ""


def scaled_unit(head: str, unit: str, scale: str) -> tuple[str, str, float]:
    """Return the unit of a column's cells, that of its readings, and one cell's unit in the latter.

    Parameters
    ----------
    head : str
        Name of the column.
    unit : str
        Of its cells; empty where the file does not say it.
    scale : str
        Such as `200 N/V`; `200 N` is for cells that are mere numbers, and `-1` keeps the unit.

    Raises
    ------
    CampaignFileError
        If the scale is none, or is for cells in another unit.
    """
    amount = AMOUNT.fullmatch(scale)
    if amount is None or float(amount[1]) == 0.0 or not isfinite(float(amount[1])):
        raise CampaignFileError(
            f"--scale of {head!r} must be a number and units such as 200 N/V, and {scale!r} came."
        )
    if not amount[2]:
        return unit, unit, float(amount[1])
    read_in, slash, per = amount[2].rpartition("/")
    if not slash:
        read_in, per = amount[2], "1"
    try:
        factor = conversion(unit or per, per)
    except ValueError:
        raise CampaignFileError(
            f"--scale of {head!r} is for cells in {per}, and they are in {unit}: give one for {unit}, "
            f"or say --unit {head}={per}."
        ) from None
    return unit or per, read_in, float(amount[1]) * factor


def zero_deviation(column: Column, answer: str, largest: float) -> float | str:
    """Return the standard deviation of a zero in SI, or "free".

    Parameters
    ----------
    column : Column
        Whose unit and quantity are known.
    answer : str
        Such as `0.1mm`, `1%` of the largest reading, `exact` or `free`.
    largest : float
        Largest reading of the column [SI].

    Raises
    ------
    CampaignFileError
        If the answer is none of these.
    """
    if answer in (EXACT, FREE):
        return FREE if answer == FREE else 0.0
    amount = AMOUNT.fullmatch(answer)
    if amount is None or not 0.0 <= float(amount[1]) < np.inf:
        raise CampaignFileError(
            f"--zero of {column.head!r} must be a standard deviation such as 0.1{column.read_in} or 1%, "
            f"{EXACT} or {FREE}, and {answer!r} came."
        )
    assert column.quantity is not None
    if amount[2] == "%":
        in_unit = conversion_of(column.quantity, column.read_in)
        deviation = float(amount[1]) / 100.0 * largest / in_unit
        return float(f"{deviation:.2g}") * in_unit
    try:
        return float(amount[1]) * conversion_of(column.quantity, amount[2] or column.read_in)
    except ValueError as cause:
        raise CampaignFileError(f"--zero of {column.head!r}: {cause}.") from None


def gain_deviation(head: str, answer: str) -> float | str:
    """Return the relative standard deviation of a gain, or "free"; raises CampaignFileError."""
    if answer in (EXACT, FREE):
        return FREE if answer == FREE else 0.0
    amount = AMOUNT.fullmatch(answer)
    if amount is None or amount[2] not in ("", "%") or not 0.0 <= float(amount[1]) < np.inf:
        raise CampaignFileError(
            f"--gain of {head!r} must be a standard deviation such as 2%, {EXACT} or {FREE}, "
            f"and {answer!r} came."
        )
    return float(amount[1]) / 100.0 if amount[2] else float(amount[1])


def degrees_celsius(answer: str) -> float:
    """Return a temperature [degC]; raises CampaignFileError where it is no number."""
    try:
        return float(answer)
    except ValueError:
        raise CampaignFileError(said("sheets.no_temperature", came=answer)) from None


def possible_quantities(unit: str, answer: str | None) -> tuple[Quantity, ...]:
    """Return the quantities that a column with a unit can be; one where that was said.

    Raises
    ------
    ValueError
        If none is measured in that unit, or what was said is no quantity.
    """
    if answer is not None and answer not in list(Quantity):
        raise ValueError(f"a quantity is {listing(Quantity, 'or')}, and {answer!r} came")
    able = quantities_of(unit) if answer is None else (Quantity(answer),)
    if not able:
        raise ValueError(f"{unit!r} is no unit of a quantity that is measured here")
    return able


def sampling_interval(answer: str) -> float:
    """Return a sampling interval [s]; raises CampaignFileError where it is no positive number."""
    amount = AMOUNT.fullmatch(answer)
    if amount is None or amount[2] not in ("", "s") or not 0.0 < float(amount[1]) < np.inf:
        raise CampaignFileError(
            f"--interval must be a positive number of seconds such as 0.01, and {answer!r} came."
        )
    return float(amount[1])


def release_in_si(answer: str) -> dict[str, Any]:
    """Return how far a point was held, as `release` of a trial has it; raises CampaignFileError."""
    amount = re.fullmatch(rf"\s*({_NUMBER})\s*(\S+)\s*", answer, re.ASCII)
    if amount is not None:
        for quantity in (Quantity.DISPLACEMENT, Quantity.SIGNAL):
            if quantity in quantities_of(amount[2]):
                displacement = float(amount[1]) * conversion_of(quantity, amount[2])
                return {"displacement": displacement, "unit": UNITS[quantity].si}
    raise CampaignFileError(said("campaign.release", given=answer))


# ---------------------------------------------------------------- what is told of columns


def units_read(columns: Iterable[Column], kinds: Mapping[str, str]) -> dict[str, str]:
    """Return the unit in which each channel, input and force was read, of several the first.

    Parameters
    ----------
    columns : iterable of Column
        Of all tables.
    kinds : mapping of str to str
        What was done, by the name of the table.
    """
    units: dict[str, str] = {}
    for column in columns:
        if column.quantity is not None:
            is_temperature = column.quantity is Quantity.TEMPERATURE
            units.setdefault(column.title, column.si if is_temperature else column.read_in)
        elif column.role == "force" and kinds[column.sheet.name] in (TrialKind.STATIC, TrialKind.FORCED):
            units.setdefault("force", column.read_in)
    return units


def origin_of(sheet: Sheet, used: Sequence[Column], scales: Mapping[str, str]) -> str:
    """Return the remark on where a table came from and what its columns were taken as."""
    columns = listing(
        f"{item.head!r} [{item.unit}]{f' times {scales[item.head]}' if item.head in scales else ''} "
        f"is {item.role}"
        for item in used
    )
    empty = sum(sheet.columns[sheet.heads.index(item.head)].count("") for item in used)
    left = f"; {counted(empty, 'cell')} {is_or_are(empty)} empty" if empty else ""
    return f"Imported from {sheet.name} (SHA-256 {sheet.digest}), {sheet.remark}: {columns}{left}."


def missing_answers(questions: Mapping[tuple[str, str], Sequence[str]]) -> str:
    """Return which options are missing, by option and what it expects, and about which columns or files."""
    count = sum(map(len, questions.values()))
    options = [
        f"--{option} {f'NAME=... for {listing(map(repr, of))}' if of[0] else '...'} ({expected})"
        for (option, expected), of in questions.items()
    ]
    missing = f"{counted(count, 'answer')} {is_or_are(count)} missing, and nothing was written"
    return f"{missing}: give {'; '.join(options)}."
