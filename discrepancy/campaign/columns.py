"""A column of a laboratory's table: role, unit and quantity, and options that state them."""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from math import isfinite

import numpy as np

from discrepancy.campaign.heads import load_or_time_role, time_heads
from discrepancy.campaign.records import Quantity, TrialKind
from discrepancy.campaign.sampling import undo_rounding
from discrepancy.campaign.sheet import Sheet
from discrepancy.campaign.units import (
    DEGREES,
    LETTERS_OF_DEGREES,
    UNITS,
    amount_in_si,
    conversion_factor,
    factor_to_si,
    quantities_of,
    usual_name,
)
from discrepancy.errors import CampaignFileError
from reporting.words import counted, is_or_are, listing

NOISE = "noise"
"""Kind of a file of samples at rest."""
LEFT_OUT = "-"
"""Role of a column that is left out."""
INPUT = "input:"
"""Prefix of the role of an input of the model, before its name."""
_KINDS_WITH_FORCE = (TrialKind.STATIC, TrialKind.FORCED)
"""Kinds of trials whose force is read from the column `force`."""
EXACT = "exact"
"""Answer for a zero or a gain that has no error."""
FREE = "free"
"""Answer for a zero or a gain of which nothing is known."""
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
AMOUNT = re.compile(rf"\s*({_NUMBER})\s*(.*?)\s*", re.ASCII)
"""A number and the text after it, such as a unit."""


@dataclass(frozen=True)
class LaboratoryColumn:
    """A column of a laboratory's table; None or an empty text for what is not known yet.

    Attributes
    ----------
    sheet : Sheet
        The table that it is from.
    head : str
        Its name, without a unit.
    role : str
        `LEFT_OUT`, a column that every table may have such as "time" or "force", `INPUT` with the
        name of an input, or the name of the model's output that a channel measures.
    unit : str
        The unit of its cells, as the file or the user states it.
    si : str
        The unit of its values in SI.
    quantity : Quantity or None
        The quantity of a channel or an input.
    to_si : float or None
        The factor from its cells to SI, which includes the option `--scale`.
    cell_at_zero : float
        The number in a cell that is 0 in SI; it differs from 0 for K and degF, which become degC.
    read_in : str
        The unit of its readings after `--scale`; equal to `unit` without a scale.
    """

    sheet: Sheet
    head: str
    role: str
    unit: str
    si: str = ""
    quantity: Quantity | None = None
    to_si: float | None = None
    cell_at_zero: float = 0.0
    read_in: str = ""

    @property
    def is_channel(self) -> bool:
        """Whether the column is a measured channel: no input, time, force or temperature."""
        return self.quantity is not None and INPUT not in self.role

    @property
    def title(self) -> str:
        """The name of the column in the campaign."""
        return self.head if self.is_channel else self.role.removeprefix(INPUT)

    def cells_in_si(self, decimal: str) -> tuple[str, ...]:
        """Return the cells in SI; all are empty if the unit or the decimal mark is not known yet.

        Parameters
        ----------
        decimal : str
            The decimal mark of the file, or an empty text.
        """
        if self.to_si is None or not decimal:
            return ("",) * len(self.sheet.lines)
        cells = self.sheet.numbers(self.head, decimal)
        if self.to_si == 1.0 and not self.cell_at_zero:
            return cells
        values = np.array([float(cell or "nan") for cell in cells])  # (rows,)
        if self.cell_at_zero:
            # in decimals, so that 68.1 degF minus 32 is 36.1 and not 36.099999999999994
            zero = Decimal(str(self.cell_at_zero))
            values = np.array([float(Decimal(cell) - zero) if cell else np.nan for cell in cells])
        if self.role == "time" and len(cells) > 1 and np.all(np.diff(values) > 0.0):
            # times in minutes with few digits may be evenly spaced
            values = undo_rounding(values, cells)
        cells_in_si = []
        for cell, value in zip(cells, values.tolist(), strict=True):
            # two digits fewer than a float may need, so that no rounding shows: 4.387 mm is
            # 0.004387 m
            cells_in_si.append(f"{value * self.to_si:.15g}" if cell else "")
        return tuple(cells_in_si)


def role_by_unit(
    head: str, heads: Sequence[str], units: Sequence[str], roles: Collection[str]
) -> str:
    """Return the role of a column, "time" or "force", if its unit alone determines it, or "".

    A column is a time if `time_heads` counts it among the times of the table, of which there may be
    several. Otherwise its unit determines its role if this role is among `roles`, and if no other
    column of the table has a unit of the same role.

    Parameters
    ----------
    head : str
        The name of the column as printed at its head.
    heads, units : sequence of str
        The names and units of all columns of the table; a unit is empty if it is not known.
    roles : collection of str
        The roles that a unit may determine. "force" is not among them for trials that do not read a
        column `force`, in which a column in newtons may be a channel.
    """
    if head in time_heads(heads, units):
        return "time"
    roles_of_units = [load_or_time_role(unit) for unit in units]
    role_of_unit = roles_of_units[heads.index(head)]
    is_only_column = roles_of_units.count(role_of_unit) == 1
    return role_of_unit if role_of_unit in roles and is_only_column else ""


def scaled_unit(head: str, unit: str, scale: str) -> tuple[str, str, float]:
    """Interpret the option `--scale` of a column: a factor from its cells to its readings.

    Parameters
    ----------
    head : str
        The name of the column as printed at its head.
    unit : str
        The unit of its cells; empty if the file does not state it.
    scale : str
        The option, such as `200 N/V`; `200 N` is for cells without a unit, and `-1` keeps the unit.

    Returns
    -------
    cell_unit, reading_unit : str
        The units of the cells and of the readings. Without a unit of the file, the cells have the
        one after the slash.
    factor : float
        The factor from cells to readings, which includes a conversion of the unit of the cells to
        the one after the slash.

    Raises
    ------
    CampaignFileError
        If the option is not a scale, or is for cells in another unit.
    """
    amount = AMOUNT.fullmatch(scale)
    if amount is None or float(amount[1]) == 0.0 or not isfinite(float(amount[1])):
        raise CampaignFileError(
            f"--scale of {head!r} must be a number and units such as 200 N/V, but {scale!r} was "
            "given."
        )
    amount_text, ratio_of_units = amount.groups()
    if not ratio_of_units:
        return unit, unit, float(amount_text)
    reading_unit, slash, unit_of_scale = ratio_of_units.rpartition("/")
    if not slash:
        reading_unit, unit_of_scale = ratio_of_units, "1"
    cell_unit = unit or unit_of_scale
    try:
        factor = conversion_factor(cell_unit, unit_of_scale)
    except ValueError:
        raise CampaignFileError(
            f"--scale of {head!r} is for cells in {unit_of_scale}, but they are in {unit}: give "
            f"one for {unit}, or give --unit {head}={unit_of_scale}."
        ) from None
    return cell_unit, reading_unit, float(amount_text) * factor


def zero_deviation(column: LaboratoryColumn, answer: str, largest: float) -> float | str:
    """Return the standard deviation of the zero offset of a sensor, given the option `--zero`.

    Parameters
    ----------
    column : LaboratoryColumn
        The column with the readings of the sensor, whose unit and quantity are known.
    answer : str
        The value of the option: a standard deviation such as `0.1mm`, a percentage of the largest
        reading such as `1%`, `exact` (there is no offset) or `free` (nothing is known of it).
    largest : float
        The largest reading of the column [SI].

    Returns
    -------
    float or str
        The standard deviation in SI, 0 for `exact`; or the text "free".

    Raises
    ------
    CampaignFileError
        If the value of the option has none of these forms, or is a number without its unit.
    """
    if answer == FREE:
        return FREE
    if answer == EXACT:
        return 0.0
    amount = AMOUNT.fullmatch(answer)
    if amount is None or not 0.0 <= float(amount[1]) < np.inf:
        raise CampaignFileError(
            f"--zero of {column.head!r} must be a standard deviation such as 0.1{column.read_in} "
            f"or 1%, {EXACT} or {FREE}, but {answer!r} was given."
        )
    assert column.quantity is not None
    amount_text, unit = amount.groups()
    if unit == "%":
        to_si = factor_to_si(column.quantity, column.read_in)
        deviation = float(amount_text) / 100.0 * largest / to_si
        # rounded to two digits in the unit of the readings, as the user sees it in that unit
        rounded_deviation = float(f"{deviation:.2g}")
        return amount_in_si(rounded_deviation, to_si)
    if not unit and column.read_in != "1" and float(amount_text) > 0.0:
        # one number for channels in microstrain and in mm would be right for one of them at most
        raise CampaignFileError(
            f"--zero of {column.head!r} needs a unit, such as {amount_text}{column.read_in} in the "
            f"unit of its readings, but {answer!r} was given."
        )
    try:
        return amount_in_si(amount_text, factor_to_si(column.quantity, unit or column.read_in))
    except ValueError as cause:
        raise CampaignFileError(f"--zero of {column.head!r}: {cause}.") from None


def gain_deviation(head: str, answer: str) -> float | str:
    """Return the relative standard deviation of a gain, or "free", from the option `--gain`.

    Raises
    ------
    CampaignFileError
        If the option is not a number, a percentage, `exact` or `free`.
    """
    if answer == FREE:
        return FREE
    if answer == EXACT:
        return 0.0
    amount = AMOUNT.fullmatch(answer)
    if amount is None or amount[2] not in ("", "%") or not 0.0 <= float(amount[1]) < np.inf:
        raise CampaignFileError(
            f"--gain of {head!r} must be a standard deviation such as 2%, {EXACT} or {FREE}, but "
            f"{answer!r} was given."
        )
    amount_text, percent = amount.groups()
    return float(amount_text) / 100.0 if percent else float(amount_text)


def degrees_celsius(answer: str) -> float:
    """Read the option `--reference-temperature`, such as 20 or 293.15K; return it in [degC].

    Raises
    ------
    CampaignFileError
        If the option is not a number, which may have a unit of temperature.
    """
    amount = AMOUNT.fullmatch(answer)
    unit = amount[2] or "degC" if amount else ""
    unit = usual_name(LETTERS_OF_DEGREES.get(unit, unit))
    if amount is None or unit not in DEGREES:
        raise CampaignFileError(
            "--reference-temperature must be a temperature such as 20, 293.15K or 68degF, but "
            f"{answer!r} was given."
        )
    degree, reading_at_zero = DEGREES[unit]
    difference = Decimal(amount[1]) - Decimal(str(reading_at_zero))
    return float(f"{float(difference) * degree:.15g}")


def possible_quantities(unit: str, answer: str | None) -> tuple[Quantity, ...]:
    """Return the quantities that a column with a unit can have.

    Parameters
    ----------
    unit : str
        The unit of the readings.
    answer : str or None
        The option `--quantity`, which decides.

    Raises
    ------
    ValueError
        If no quantity is measured in that unit, or the option is not a quantity.
    """
    if answer is not None:
        if answer not in list(Quantity):
            raise ValueError(f"a quantity is {listing(Quantity, 'or')}, but {answer!r} was given")
        return (Quantity(answer),)
    quantities = quantities_of(unit)
    if not quantities:
        raise ValueError(f"{unit!r} is not a unit of a measured quantity")
    return quantities


def sampling_interval(answer: str) -> float:
    """Return the sampling interval [s] of the option `--interval`.

    Raises
    ------
    CampaignFileError
        If the option is not a positive number of seconds.
    """
    amount = AMOUNT.fullmatch(answer)
    if amount is None or amount[2] not in ("", "s") or not 0.0 < float(amount[1]) < np.inf:
        raise CampaignFileError(
            f"--interval must be a positive number of seconds such as 0.01, but {answer!r} was "
            "given."
        )
    return float(amount[1])


def release_in_si(answer: str) -> dict[str, str | float]:
    """Return the table `release` of a trial from the option `--release`.

    For a length or a voltage its keys are `displacement` and `unit`, m or V. For a force its only
    key is `force` [N].

    Raises
    ------
    CampaignFileError
        If the option is not a length, a voltage or a force.
    """
    amount = re.fullmatch(rf"\s*({_NUMBER})\s*(\S+)\s*", answer, re.ASCII)
    if amount is not None:
        amount_text, unit = amount.groups()
        for quantity in (Quantity.DISPLACEMENT, Quantity.SIGNAL):
            if quantity in quantities_of(unit):
                displacement = amount_in_si(amount_text, factor_to_si(quantity, unit))
                return {"displacement": displacement, "unit": UNITS[quantity].si}
        if Quantity.FORCE in quantities_of(unit):
            return {"force": amount_in_si(amount_text, factor_to_si(Quantity.FORCE, unit))}
    raise CampaignFileError(
        "--release must be a length, a voltage or a force such as 15.5mm or 600N, but "
        f"{answer!r} was given."
    )


# ---------------------------------------------------------------- messages about columns


def units_of_columns(
    columns: Iterable[LaboratoryColumn], kinds: Mapping[str, str]
) -> dict[str, str]:
    """Return the unit in which the readings of each channel, input and force are printed.

    If tables have several units for one name, the first table decides. A temperature has its SI
    unit.

    Parameters
    ----------
    columns : iterable of LaboratoryColumn
        The columns of all tables.
    kinds : mapping of str to str
        The kind of each table's trial, by the name of the table.

    Returns
    -------
    dict of str to str
        Unit by the name of the channel or input, or by "force".
    """
    units: dict[str, str] = {}
    for column in columns:
        if column.quantity is Quantity.TEMPERATURE:
            units.setdefault(column.title, column.si)
        elif column.quantity is not None:
            units.setdefault(column.title, column.read_in)
        elif column.role == "force" and kinds[column.sheet.name] in _KINDS_WITH_FORCE:
            units.setdefault("force", column.read_in)
    return units


def origin_sentence(
    sheet: Sheet, columns: Sequence[LaboratoryColumn], scales: Mapping[str, str]
) -> str:
    """Return the sentence on the source file of a table and on the role of each of its columns.

    Parameters
    ----------
    sheet : Sheet
        The table.
    columns : sequence of LaboratoryColumn
        The columns of the table that are not left out.
    scales : mapping of str to str
        Values of the option `--scale` of the import, by the head of the column they apply to.
    """
    phrases = []
    empty_cell_count = 0
    for column in columns:
        scale = f" times {scales[column.head]}" if column.head in scales else ""
        phrases.append(f"{column.head!r} [{column.unit}]{scale} is {column.role}")
        empty_cell_count += sheet.columns[sheet.heads.index(column.head)].count("")
    empty_cells = (
        f"; {counted(empty_cell_count, 'cell')} {is_or_are(empty_cell_count)} empty"
        if empty_cell_count
        else ""
    )
    return (
        f"Imported from {sheet.name} (SHA-256 {sheet.digest}), {sheet.remark}: "
        f"{listing(phrases)}{empty_cells}."
    )


def missing_answers(questions: Mapping[tuple[str, str], Sequence[str]]) -> str:
    """Return the message that lists the options which an import still needs.

    Parameters
    ----------
    questions : mapping of (str, str) to sequence of str
        For each missing option and the phrase on what it expects: the heads of the columns, or the
        names of the files, that need a value. A single empty name means one value for all.
    """
    option_phrases = []
    for (option, expected_answer), subjects in questions.items():
        placeholder = "..."
        if subjects[0]:
            placeholder = f"NAME=... for {listing(map(repr, subjects))}"
        option_phrases.append(f"--{option} {placeholder} ({expected_answer})")
    answer_count = sum(map(len, questions.values()))
    answers_text = f"{counted(answer_count, 'answer')} {is_or_are(answer_count)} missing"
    return f"{answers_text}, and nothing was written: give {'; '.join(option_phrases)}."
