"""The table of the gains and zeros of channels that were fitted beside what the campaign states."""

from collections.abc import Mapping, Sequence
from math import inf, isfinite
from typing import NamedTuple

from discrepancy.campaign.records import Channel
from discrepancy.campaign.units import UNITS
from discrepancy.judgement.closed_share import NOMINAL_UNIT
from discrepancy.report.text import number
from discrepancy.verdict import SensorEstimate, SensorValue
from reporting.page import Table
from reporting.record_table import (
    RecordColumn,
    TitledTable,
    number_cells,
    table_of_records,
    text_cells,
)
from reporting.words import plus_minus

MOST_PRINTED_SENSORS = 12
"""Most rows that are printed; the report has all channels."""
PERCENT = (100.0, "%")
"""Factor and unit in which the relative error of a gain is shown."""


class SensorRow(NamedTuple):
    """A fitted gain or zero of a channel, with the factor and unit in which it is shown."""

    estimate: SensorEstimate
    factor: float
    unit: str

    @property
    def is_free_gain(self) -> bool:
        """Whether the campaign does not state this gain; it is then shown instead of its error."""
        estimate = self.estimate
        return estimate.kind is SensorValue.GAIN and estimate.stated_deviation == inf

    @property
    def value(self) -> str:
        """The fitted value with its posterior standard deviation."""
        if self.is_free_gain:
            return plus_minus(1.0 + self.estimate.value, self.estimate.deviation)
        return plus_minus(self.factor * self.estimate.value, self.factor * self.estimate.deviation)

    @property
    def shown_unit(self) -> str:
        """The unit of the value; empty for a gain itself."""
        return "" if self.is_free_gain else self.unit

    @property
    def stated(self) -> str:
        """The stated value, which is zero, with its standard deviation."""
        if self.estimate.stated_deviation == inf:
            return "not stated"
        return f"0 ± {number(self.factor * self.estimate.stated_deviation, 2)}"

    @property
    def deviations(self) -> str:
        """The distance from the stated value in stated standard deviations."""
        if not isfinite(self.estimate.deviations):
            return ""
        return f"{self.estimate.deviations:+.1f}".replace("-", "\N{MINUS SIGN}")

    @property
    def label(self) -> str:
        """What was fitted: the gain, its error, or the zero in a trial."""
        if self.is_free_gain:
            return "gain"
        if self.estimate.kind is SensorValue.GAIN:
            return "gain error"
        return f"zero in {self.estimate.trial}"


def sensor_rows(
    estimates: Sequence[SensorEstimate], channels: Mapping[str, Channel]
) -> list[SensorRow]:
    """Return the gain of each channel, and the farthest of its zeros that are not free.

    A zero is free if its deviation is not stated: then it says nothing of the sensor. A channel
    with free zeros only has the first of them.

    Parameters
    ----------
    estimates : sequence of SensorEstimate
        All fitted gains and zeros.
    channels : mapping of str to Channel
        The channels of the campaign by name.
    """
    estimates_by_channel: dict[str, list[SensorEstimate]] = {}
    for estimate in estimates:
        estimates_by_channel.setdefault(estimate.channel, []).append(estimate)
    rows = []
    for channel, channel_estimates in estimates_by_channel.items():
        gains = [estimate for estimate in channel_estimates if estimate.kind is SensorValue.GAIN]
        rows += [SensorRow(gain, *PERCENT) for gain in gains]
        zeros = [estimate for estimate in channel_estimates if estimate.kind is SensorValue.ZERO]
        if zeros:
            farthest_zero = max(zeros, key=_distance)
            factor, unit = UNITS[channels[channel].quantity].drawn
            shown_unit = "" if unit == NOMINAL_UNIT else unit
            rows.append(SensorRow(farthest_zero, factor, shown_unit))
    return rows


def _distance(estimate: SensorEstimate) -> float:
    """Return the distance from the stated value in stated deviations; -1 if none is stated."""
    return abs(estimate.deviations) if isfinite(estimate.deviations) else -1.0


def sensor_table(
    estimates: Sequence[SensorEstimate], channels: Mapping[str, Channel]
) -> TitledTable:
    """Return the table of fitted gains and zeros, for the report."""
    return TitledTable(
        table_of_records(_columns(), sensor_rows(estimates, channels)),
        title="Gains and zeros of the channels",
        caption=(
            "Fitted together with the verdict's hypothesis, with their standard deviations; of the "
            "zeros of a channel, the one farthest from what is stated. The last column is the "
            "distance in stated standard deviations. verdict.json has the zeros of all trials."
        ),
    )


def printed_sensor_table(
    estimates: Sequence[SensorEstimate], channels: Mapping[str, Channel]
) -> Table:
    """Return the fitted gains and zeros for the terminal.

    If there are more than `MOST_PRINTED_SENSORS`, only those farthest from what is stated remain.
    """
    rows = sensor_rows(estimates, channels)
    farthest = sorted(rows, key=lambda row: -_distance(row.estimate))[:MOST_PRINTED_SENSORS]
    return table_of_records(_columns(), [row for row in rows if row in farthest])


def _columns() -> list[RecordColumn[SensorRow]]:
    """Return the columns of the table."""
    return [
        text_cells("channel", lambda row: row.estimate.channel),
        text_cells("fitted", lambda row: row.label),
        number_cells("value", lambda row: row.value),
        text_cells("unit", lambda row: row.shown_unit),
        number_cells("stated", lambda row: row.stated),
        number_cells("deviations", lambda row: row.deviations),
    ]
