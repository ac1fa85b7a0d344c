"""How well zeros and gains of channels are known, as a user states it or by default."""

from collections.abc import Mapping, Sequence

import numpy as np

from discrepancy.campaign.answers import Questionnaire
from discrepancy.campaign.columns import (
    EXACT,
    FREE,
    NOISE,
    LaboratoryColumn,
    gain_deviation,
    zero_deviation,
)
from discrepancy.campaign.units import factor_to_si
from discrepancy.campaign.wild_readings import numbers_or_nan, wild_readings
from reporting.words import listing

ASSUMED_ZERO = "1%"
"""Standard deviation of a zero if the user does not state it, relative to the largest reading."""
ASSUMED_GAIN = "2%"
"""Relative standard deviation of a gain if the user does not state it."""


class SensorDeviations:
    """Standard deviations of the zeros and gains of a laboratory's columns.

    All are determined when the object is made. Where the user states none, the zero of a channel is
    taken as known to 1 % of its largest reading, that of an input as exact, and gains to 2 %.

    Parameters
    ----------
    questionnaire : Questionnaire
        The answers of the user; it notes the defaults that are used.
    columns : sequence of LaboratoryColumn
        The columns of all tables.
    kinds : mapping of str to str
        The kind of trial of each file, by the name of the file.
    decimals : mapping of str to str
        The decimal mark of each file.

    Attributes
    ----------
    zeros : dict of str to (float or str)
        The standard deviation of the zero of each channel and input [SI], or "free", by head.
    gains : dict of str to (float or str)
        The relative standard deviation of the gain of each channel, or "free", by head.
    """

    def __init__(
        self,
        questionnaire: Questionnaire,
        columns: Sequence[LaboratoryColumn],
        kinds: Mapping[str, str],
        decimals: Mapping[str, str],
    ) -> None:
        self.columns = columns
        self.kinds = kinds
        self.decimals = decimals
        self._questionnaire = questionnaire
        self.zeros = {
            column.head: self._ask_zero_deviation(column) for column in self._columns_with_zero()
        }
        self.gains = {
            column.head: self._ask_gain_deviation(column.head)
            for column in columns
            if column.is_channel
        }

    def _columns_with_zero(self) -> list[LaboratoryColumn]:
        """Return the first column of each channel or input whose unit and quantity are known."""
        first_columns: dict[str, LaboratoryColumn] = {}
        for column in self.columns:
            if column.quantity is not None:
                first_columns.setdefault(column.head, column)
        return [*first_columns.values()]

    def _ask_zero_deviation(self, column: LaboratoryColumn) -> float | str:
        """Return the standard deviation of a channel's or input's zero [SI], or "free"."""
        default = ASSUMED_ZERO if column.is_channel else EXACT
        expected_answer = (
            "how well its zero is known in each trial: a standard deviation such as "
            f"0.1{column.read_in} or 1% of the largest reading, {EXACT} or {FREE}"
        )
        answer = self._questionnaire.ask_or_assume(default, "zero", column.head, expected_answer)
        return zero_deviation(column, answer, self._largest_reading(column.head))

    def _largest_reading(self, head: str) -> float:
        """Return the largest absolute reading [SI] under a head in all trials.

        Wild readings and records at rest do not count. The result is 0 while the unit or decimal
        mark is not known.
        """
        largest = 0.0
        for column in self.columns:
            if column.head != head or self.kinds[column.sheet.name] == NOISE:
                continue
            readings = numbers_or_nan(column.cells_in_si(self.decimals[column.sheet.name]))
            is_counted = np.isfinite(readings) & ~wild_readings(readings)
            largest = max(largest, float(np.max(np.abs(readings[is_counted]), initial=0.0)))
        return largest

    def _ask_gain_deviation(self, head: str) -> float | str:
        """Return the relative standard deviation of a channel's gain, or "free"."""
        expected_answer = (
            f"how well its gain is known: a standard deviation such as 2%, {EXACT}, or {FREE} for "
            "a signal"
        )
        answer = self._questionnaire.ask_or_assume(ASSUMED_GAIN, "gain", head, expected_answer)
        return gain_deviation(head, answer)

    @property
    def assumed(self) -> str:
        """The remark on the assumed deviations of zeros and gains; empty if all were stated."""
        phrases = []
        for column in self._columns_with_zero():
            zero = self.zeros[column.head]
            is_assumed = self._questionnaire.is_assumed("zero", column.head)
            if column.is_channel and is_assumed and not isinstance(zero, str):
                assert column.quantity is not None
                deviation = zero / factor_to_si(column.quantity, column.read_in)
                phrases.append(f"the zero of {column.head!r} to {deviation:.2g} {column.read_in}")
        gains = [repr(head) for head in self.gains if self._questionnaire.is_assumed("gain", head)]
        if gains:
            noun = "gain" if len(gains) == 1 else "gains"
            phrases.append(f"the {noun} of {listing(gains)} to {ASSUMED_GAIN.replace('%', ' %')}")
        if not phrases:
            return ""
        return (
            "At the import, zeros and gains without a stated standard deviation were assumed to be "
            "known: "
            f"{listing(phrases)}."
        )
