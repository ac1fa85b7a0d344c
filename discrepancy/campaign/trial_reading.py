"""A trial from its description in `campaign.toml` and its table."""

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import NamedTuple

import numpy as np

from discrepancy.campaign import schema
from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import (
    USUAL_REGIONS,
    BoolArray,
    Channel,
    FloatArray,
    InTables,
    IntArray,
    Quantity,
    RecordedInput,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.campaign.sampling import check_sampling
from discrepancy.campaign.units import conversion_factor, factor_to_si
from discrepancy.errors import CampaignDataError, CampaignFileError
from reporting.formats.table_file import TextTable
from reporting.words import counted, is_or_are, rows_of_table

LATEST_FIRST_SAMPLE = 1.5
"""Latest time of the first sample after a release from rest, in sampling intervals."""
_REPEATED = "leave one out, or distinguish repeated readings by a column `time`"


def read_trial(
    section: schema.TrialSection,
    table: TextTable,
    campaign: schema.CampaignSection,
    remarks: list[str],
) -> Trial:
    """Read a trial from its section of `campaign.toml` and its table.

    Parameters
    ----------
    section : TrialSection
        What `campaign.toml` states of the trial.
    table : TextTable
        The table of the trial.
    campaign : CampaignSection
        The whole content of `campaign.toml`.
    remarks : list of str
        The remarks of the reader; those on this trial are added.
    """
    user = f"the trial {section.name!r}"
    time, start = _read_times(section, table, campaign, user)
    channels = _channels_of_trial(section, table, campaign)
    values = []
    is_used = []
    for channel in channels:
        channel_values, channel_used = _read_channel(channel, section, table, remarks)
        values.append(channel_values)
        is_used.append(channel_used)
    losses = _stiffness_losses(section, table, user)
    inputs = _read_inputs(section, table, campaign, user)
    load_factor = np.zeros(len(table))
    if section.kind is TrialKind.FLIGHT:
        load_factor = table.numbers("load_factor", user)
    return Trial(
        **section.keys_in_file,
        channels=tuple(channel.name for channel in channels),
        values=np.stack(values, axis=1),  # (rows, channels)
        used=np.stack(is_used, axis=1),
        time=time,
        force=_read_force(section, table, campaign, inputs),
        load_factor=load_factor,
        temperature=_read_temperature(section, table, campaign, user),
        start=start,
        health=losses.means,
        regions=losses.regions,
        health_deviation=losses.deviations,
        begins=section.begins or Start.SETTLED,
        begin_assumed=section.begins is None,
        inputs=inputs,
    )


def _read_inputs(
    section: schema.TrialSection, table: TextTable, campaign: schema.CampaignSection, user: str
) -> tuple[RecordedInput, ...]:
    """Return the recorded inputs of a driven or static trial."""
    if section.kind not in (TrialKind.DRIVEN, TrialKind.STATIC):
        return ()
    return tuple(
        replace(recorded_input, values=numbers_in_si(table, recorded_input, user))
        for recorded_input in campaign.input
        if recorded_input.table_column in table.columns
    )


def _read_force(
    section: schema.TrialSection,
    table: TextTable,
    campaign: schema.CampaignSection,
    inputs: Sequence[RecordedInput],
) -> FloatArray:
    """Return the force [N], or torque [N m], in each row (N,) of a trial's table.

    The force is the column `force` of a static or forced trial, else the first force or torque
    among the inputs, else zero.
    """
    # a static trial may be loaded by its inputs alone, and then needs no column of force
    reads_column = section.kind is TrialKind.FORCED or (
        section.kind is TrialKind.STATIC and ("force" in table.columns or not inputs)
    )
    if reads_column:
        to_newton = conversion_factor(campaign.force_unit, schema.FORCE_UNIT)
        return table.numbers("force", f"the trial {section.name!r}") * to_newton
    for recorded_input in inputs:
        if recorded_input.quantity in (Quantity.FORCE, Quantity.TORQUE):
            return recorded_input.values
    return np.zeros(len(table))


def numbers_in_si(
    table: TextTable, record: InTables, user: str, *, empty_allowed: bool = False
) -> FloatArray:
    """Return the column of a channel or an input (N,) in SI.

    Empty cells are nan where they are allowed.
    """
    numbers = table.numbers(record.table_column, user, empty_allowed=empty_allowed)
    return numbers * factor_to_si(record.quantity, record.unit)


def _read_times(
    section: schema.TrialSection, table: TextTable, campaign: schema.CampaignSection, user: str
) -> tuple[FloatArray, float]:
    """Return the times of a trial's rows (N,) [s], and its start since the campaign's start [s].

    Raises
    ------
    CampaignFileError
        If two rows of a static or flight trial are equal; see `_times_of_rows_at_rest`.
    CampaignDataError
        If times run backwards, or a ring-down does not begin at its release.
    """
    if section.kind in (TrialKind.STATIC, TrialKind.FLIGHT):
        return _times_of_rows_at_rest(section, table, campaign, user)
    cells = table.cells("time", user)
    time = check_sampling(table.numbers("time", user), cells, user, table.name)
    if section.release is not None:
        _check_release_time(section.release, time, table.name, user)
    return time, section.start or 0.0


def _check_release_time(release: Release, time: FloatArray, file: str, user: str) -> None:
    """Refuse a ring-down whose times (N,) [s] do not begin at the release."""
    if release.at_rest and time[0] > LATEST_FIRST_SAMPLE * (time[1] - time[0]):
        raise CampaignDataError(
            f"{file}: the time of {user} begins at {time[0]:g} s, and the first sample of a "
            "release from rest is at the release, at 0: count times from there, or set `at_rest = "
            "false` where the record begins later."
        )
    if time[0] < 0.0:
        raise CampaignDataError(
            f"{file}: the time of {user} begins at {time[0]:g} s, and its release is at 0: leave "
            "out what was recorded before it (samples at rest are a noise record), or count times "
            "from the release."
        )


def _times_of_rows_at_rest(
    section: schema.TrialSection, table: TextTable, campaign: schema.CampaignSection, user: str
) -> tuple[FloatArray, float]:
    """Return the times (N,) of a static or flight trial's rows and its start [s].

    Without a column `time` all rows have the time of the start. With it, the start is the first
    time unless the section states another.

    Raises
    ------
    CampaignFileError
        If two rows are equal and lie on the same branch of the load cycle.
    CampaignDataError
        If the times decrease.
    """
    start = section.start or 0.0
    names_of_loads = dict.fromkeys(
        (
            "force",
            "load_factor",
            *(recorded_input.table_column for recorded_input in campaign.input),
        )
    )
    loads = [name for name in names_of_loads if name in table.columns]
    branches = _load_branches(table, loads, user).tolist()
    rows_with_branch = [*zip(branches, *table.columns.values(), strict=True)]
    table.refuse_repeated(rows_with_branch, "row", _REPEATED)
    if "time" not in table.columns:
        return np.full(len(table), start), start
    time = table.numbers("time", user)
    if np.any(np.diff(time) < 0.0):
        raise CampaignDataError(
            f"{table.name}: the times of {user} run backwards; put its rows in order."
        )
    return time, float(time[0]) if section.start is None else start


def _load_branches(table: TextTable, loads: Sequence[str], user: str) -> IntArray:
    """Return the number (N,) of the branch of a load cycle on which each row lies.

    A branch is a part of the cycle in which the load only rises or only falls. A load cycle passes
    each level upwards and downwards, and a coarse gauge may read the same value both times. Such
    rows are not duplicates, because they lie on different branches.

    Parameters
    ----------
    table : TextTable
        The table of a static or flight trial.
    loads : sequence of str
        The columns of loads in the table; a branch ends if one of them changes direction.
    user : str
        The name of the trial, for messages.
    """
    begins_branch = np.zeros(len(table), dtype=np.int64)
    for column in loads:
        steps = np.diff(table.numbers(column, user))  # (N - 1,)
        changes = np.flatnonzero(steps)  # rows of equal load are skipped
        # the load turns where a change has another sign than the previous change
        is_turn = np.diff(np.sign(steps[changes])) != 0.0
        # step i leads from row i to row i + 1, which is the first row of the new branch
        begins_branch[changes[1:][is_turn] + 1] = 1
    return np.cumsum(begins_branch)


def _channels_of_trial(
    section: schema.TrialSection, table: TextTable, campaign: schema.CampaignSection
) -> tuple[Channel, ...]:
    """Return the channels that a trial names; if it names none, all with a column in its table.

    Raises `CampaignFileError` if there is no channel, or if a named one has no column.
    """
    if section.channels is None:
        channels = tuple(
            channel for channel in campaign.channel if channel.table_column in table.columns
        )
    else:
        by_name = {channel.name: channel for channel in campaign.channel}
        channels = tuple(by_name[name] for name in section.channels)
    # only for its error if a channel has no column
    for channel in channels:
        table.cells(channel.table_column, f"the channel {channel.name!r}")
    if not channels:
        columns = ", ".join(table.columns)
        named_channels = ", ".join(channel.table_column for channel in campaign.channel)
        raise CampaignFileError(
            f"{table.name} of the trial {section.name!r} holds no channel: its columns are "
            f"{columns}, and those of the channels {named_channels}."
        )
    return channels


def _read_channel(
    channel: Channel, section: schema.TrialSection, table: TextTable, remarks: list[str]
) -> tuple[FloatArray, BoolArray]:
    """Read the readings of a channel from the table of a trial.

    An empty cell is replaced by linear interpolation over the rows and marked as not used; the
    sentence that says so is appended to `remarks`. Rows in the key `left_out` of the trial are
    marked as not used, too.

    Returns
    -------
    values : (N,) ndarray
        The readings [SI].
    is_used : (N,) ndarray of bool
        False for readings that are left out.
    """
    values = numbers_in_si(table, channel, f"the channel {channel.name!r}", empty_allowed=True)
    is_used = np.isfinite(values)
    if not is_used.any():
        raise CampaignDataError(
            f"{table.name} has no reading in the column {channel.table_column!r} of the trial "
            f"{section.name!r}."
        )
    if not is_used.all():
        rows = np.arange(len(values))
        values[~is_used] = np.interp(rows[~is_used], rows[is_used], values[is_used])
        empty_rows = np.flatnonzero(~is_used).tolist()
        remarks.append(
            f"{len(empty_rows)} of {len(values)} readings of {channel.name!r} in the trial "
            f"{section.name!r} ({rows_of_table(empty_rows)}) {is_or_are(len(empty_rows))} empty "
            "and left out."
        )
    for row in section.left_out.get(channel.name, ()):
        if row > len(values):
            raise CampaignFileError(
                f"The trial {section.name!r} leaves out row {row} of {channel.name!r}, but "
                f"{table.name} has {counted(len(values), 'row')}."
            )
        is_used[row - 1] = False
    return values, is_used


def _read_temperature(
    section: schema.TrialSection, table: TextTable, campaign: schema.CampaignSection, user: str
) -> FloatArray:
    """Return the temperature of a trial (N,) minus the reference temperature [K]; 0 if unknown.

    Raises `CampaignFileError` if the temperature is given twice, or without a reference.
    """
    has_column = "temperature" in table.columns
    if has_column and section.temperature is not None:
        raise CampaignFileError(
            f"The trial {section.name!r} gives its temperature twice: remove `temperature` or the "
            f"column of {table.name}."
        )
    if not has_column and section.temperature is None:
        return np.zeros(len(table))
    if campaign.reference_temperature is None:
        raise CampaignFileError(no_reference_temperature_message(section.name))
    if has_column:
        return table.numbers("temperature", user) - campaign.reference_temperature
    return np.full(len(table), section.temperature) - campaign.reference_temperature


def no_reference_temperature_message(trial: str) -> str:
    """Return the message that a trial has a temperature, and the campaign no reference for it."""
    return (
        f"The trial {trial!r} has a temperature, but the campaign has no `reference_temperature`: "
        "give it, in degC."
    )


class _StiffnessLosses(NamedTuple):
    """Stiffness losses of a trial's K damage regions in its N rows.

    Attributes
    ----------
    regions : tuple of str
        The names of the damage regions.
    means, deviations : (N, K) ndarray
        Losses [fraction], and their prior standard deviations.
    """

    regions: tuple[str, ...]
    means: FloatArray
    deviations: FloatArray


def _stiffness_losses(
    section: schema.TrialSection, table: TextTable, user: str
) -> _StiffnessLosses:
    """Read the stiffness losses of the damage regions from columns, or from the key `health`.

    A region that neither states has no loss.

    Raises
    ------
    CampaignFileError
        If a region has both a column and a key, or a value is out of its range.
    """
    stated_losses = dict(section.health)
    stated_deviation = stated_losses.pop("deviation", 0.0)
    prefix = schema.OF_REGION
    columns = [name.removeprefix(prefix) for name in table.columns if name.startswith(prefix)]
    regions_of_columns = [name.removesuffix("_deviation") for name in columns]
    regions = tuple(dict.fromkeys((*USUAL_REGIONS, *stated_losses, *regions_of_columns)))
    means = np.zeros((len(table), len(regions)))  # (rows, regions), as the deviations
    deviations = np.zeros((len(table), len(regions)))
    for index, region in enumerate(regions):
        column = region if region in USUAL_REGIONS else f"{prefix}{region}"
        if column in table.columns and region in stated_losses:
            raise CampaignFileError(
                f"The trial {section.name!r} gives {region} twice: remove it from `health` or from "
                f"{table.name}."
            )
        means[:, index] = stated_losses.get(region, 0.0)
        if column in table.columns:
            means[:, index] = table.numbers(column, user)
        _check_range(means[:, index], table, column, "a fraction from 0 to 1", largest=1.0)

        column = f"{column}_deviation"
        deviations[:, index] = stated_deviation
        if column in table.columns:
            deviations[:, index] = table.numbers(column, user)
        _check_range(deviations[:, index], table, column, "a standard deviation", largest=inf)
    return _StiffnessLosses(regions, means, deviations)


def _check_range(
    values: FloatArray, table: TextTable, column: str, expected_range: str, *, largest: float
) -> None:
    """Refuse values (N,) of a column below zero or above the largest that is allowed."""
    rows_outside = np.flatnonzero((values < 0.0) | (values > largest))
    if rows_outside.size:
        row = int(rows_outside[0])
        raise CampaignFileError(
            f"{table.name}, line {table.lines[row]}: {column} is {expected_range}, but "
            f"{values[row]:g} was given."
        )
