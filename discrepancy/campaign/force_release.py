"""A ring-down that begins when a force is cut off, such as a weight: it is a forced trial.

At rest under the force, the structure has its static deflection; from the release on, the force is
zero.
"""

from collections.abc import Collection
from dataclasses import replace

from discrepancy.campaign.trial_reading import LATEST_FIRST_SAMPLE
from discrepancy.errors import CampaignDataError
from reporting.formats.table_file import TextTable


def table_of_release_by_force(
    table: TextTable, channels: Collection[str], force: float
) -> TextTable:
    """Return the table of a forced trial for the record of a ring-down.

    The table has a new column `force`, which holds the force at negative times, and 0 from time 0
    on. If the record has no negative times, a row is put before all others, one interval earlier,
    in which the force acts and the channels have no readings.

    Parameters
    ----------
    table : TextTable
        The record in SI.
    channels : collection of str
        The names of the columns with readings.
    force : float
        The force that held the structure until the release [N].

    Raises
    ------
    CampaignFileError, CampaignDataError
        If a time is not a number, or the first one is too late for a release at 0.
    """
    times = table.numbers("time", "a ring-down").tolist()
    forces = [repr(force) if time < 0.0 else "0" for time in times]
    if times[0] < 0.0 or len(times) == 1:
        return replace(table, columns={**table.columns, "force": tuple(forces)})
    interval = times[1] - times[0]
    if times[0] > LATEST_FIRST_SAMPLE * interval:
        raise CampaignDataError(
            f"{table.name}: the time begins at {times[0]:g} s, and a release by a force is at 0: "
            "count times from there."
        )
    columns = {}
    for name, cells in table.columns.items():
        columns[name] = ("" if name in channels else cells[0], *cells)
    columns["time"] = (f"{times[0] - interval:.15g}", *table.columns["time"])
    columns["force"] = (repr(force), *forces)
    return replace(table, columns=columns, lines=(table.lines[0], *table.lines))
