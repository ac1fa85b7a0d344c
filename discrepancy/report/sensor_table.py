"""The table of the gains and zeros of channels that were fitted beside what the campaign states."""

from collections.abc import Mapping, Sequence

from calibration.result.sensors import SENSOR_COLUMNS, gains_and_farthest_zeros, printed_rows
from discrepancy.campaign.records import Channel
from discrepancy.judgement.sensor_estimates import sensor_fits
from discrepancy.verdict import SensorEstimate
from reporting.pages.table import Table, table_of_records


def sensor_table(estimates: Sequence[SensorEstimate], channels: Mapping[str, Channel]) -> Table:
    """Return the table of fitted gains and zeros, for the report.

    Parameters
    ----------
    estimates : sequence of SensorEstimate
        All fitted gains and zeros.
    channels : mapping of str to Channel
        The channels of the campaign by name.
    """
    rows = gains_and_farthest_zeros(sensor_fits(estimates, channels))
    return table_of_records(
        SENSOR_COLUMNS,
        rows,
        title="Gains and zeros of the channels",
        caption=(
            "Fitted beside the named effects, or without an effect if none is named, with their "
            "standard deviations; of the "
            "zeros of a channel, the one farthest from what is stated. The last column is the "
            "distance in stated standard deviations. verdict.json has the zeros of all trials."
        ),
    )


def printed_sensor_table(
    estimates: Sequence[SensorEstimate], channels: Mapping[str, Channel]
) -> Table:
    """Return the fitted gains and zeros for the terminal, at most `MOST_PRINTED_SENSORS` of them.

    Parameters
    ----------
    estimates : sequence of SensorEstimate
        All fitted gains and zeros.
    channels : mapping of str to Channel
        The channels of the campaign by name.
    """
    return table_of_records(SENSOR_COLUMNS, printed_rows(sensor_fits(estimates, channels)))
