"""Fitted gains and zeros of channels, and a table that compares them with stated values."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite, nan
from typing import Literal

from reporting.pages.table import RecordColumn, number_cells, text_cells
from reporting.words import plus_minus

MOST_PRINTED_SENSORS = 12
"""Largest number of rows that are printed; a report has all channels."""


@dataclass(frozen=True)
class SensorFit:
    """A fitted gain or zero of a channel, with the factor and unit in which it is shown.

    Attributes
    ----------
    kind : str
        "gain" or "zero". A gain is given by its relative error.
    trial : str
        The trial in which the channel has this zero; empty for a gain, which all trials share.
    value, deviation : float
        The fitted value and its posterior standard deviation [SI]. The stated value is zero.
    stated_deviation : float
        The stated standard deviation of the value; infinite if the value is not stated [SI].
    shown_factor : float
        The factor from SI to the unit that is shown.
    shown_unit : str
        The unit that is shown, such as "%" for a gain and "mm" for the zero of a displacement.
    """

    channel: str
    kind: Literal["gain", "zero"]
    trial: str
    value: float
    deviation: float
    stated_deviation: float
    shown_factor: float
    shown_unit: str

    @property
    def is_free_gain(self) -> bool:
        """Whether the campaign does not state this gain; it is then shown instead of its error."""
        return self.kind == "gain" and self.stated_deviation == inf

    @property
    def deviations(self) -> float:
        """Fitted value in stated standard deviations [1]; NaN if none is stated."""
        return self.value / self.stated_deviation if isfinite(self.stated_deviation) else nan

    @property
    def label(self) -> str:
        """The fitted quantity: the gain, its error, or the zero in a trial."""
        if self.is_free_gain:
            return "gain"
        if self.kind == "gain":
            return "gain error"
        return f"zero in {self.trial}"

    @property
    def value_text(self) -> str:
        """The fitted value with its posterior standard deviation."""
        if self.is_free_gain:
            return plus_minus(1.0 + self.value, self.deviation)
        return plus_minus(self.shown_factor * self.value, self.shown_factor * self.deviation)

    @property
    def unit_text(self) -> str:
        """The unit of the shown value; empty for a gain itself."""
        return "" if self.is_free_gain else self.shown_unit

    @property
    def stated_text(self) -> str:
        """The stated value, which is zero, with its standard deviation."""
        if self.stated_deviation == inf:
            return "not stated"
        stated = self.shown_factor * self.stated_deviation
        text = f"{stated:.2g}"
        if "e+0" in text:  # a deviation of 120 mm, and not of 1.2e+02 mm
            text = f"{float(text):,.0f}"
        return f"0 ± {text}".replace("-", "\N{MINUS SIGN}")

    @property
    def deviations_text(self) -> str:
        """The distance from the stated value in stated standard deviations, or nothing."""
        if not isfinite(self.deviations):
            return ""
        return f"{self.deviations:+.1f}".replace("-", "\N{MINUS SIGN}")


def gains_and_farthest_zeros(fits: Sequence[SensorFit]) -> list[SensorFit]:
    """Return the gain of each channel, and its zero farthest from the stated value.

    Zeros without a stated standard deviation are not ranked; a channel with no others has its first
    one.
    """
    rows = []
    for channel in dict.fromkeys(fit.channel for fit in fits):
        of_channel = [fit for fit in fits if fit.channel == channel]
        rows += [fit for fit in of_channel if fit.kind == "gain"]
        zeros = [fit for fit in of_channel if fit.kind == "zero"]
        if zeros:
            rows.append(max(zeros, key=distance))
    return rows


def printed_rows(fits: Sequence[SensorFit]) -> list[SensorFit]:
    """Return the rows for a terminal: the farthest from the stated value, if there are too many."""
    rows = gains_and_farthest_zeros(fits)
    farthest = sorted(rows, key=lambda row: -distance(row))[:MOST_PRINTED_SENSORS]
    return [row for row in rows if row in farthest]


def distance(fit: SensorFit) -> float:
    """Return the distance from the stated value in standard deviations; -1 if not stated."""
    return abs(fit.deviations) if isfinite(fit.deviations) else -1.0


SENSOR_COLUMNS: list[RecordColumn[SensorFit]] = [
    text_cells("channel", lambda fit: fit.channel),
    text_cells("fitted", lambda fit: fit.label),
    number_cells("value", lambda fit: fit.value_text),
    text_cells("unit", lambda fit: fit.unit_text),
    number_cells("stated", lambda fit: fit.stated_text),
    number_cells("deviations", lambda fit: fit.deviations_text),
]
"""The columns of a table of fitted gains and zeros."""
