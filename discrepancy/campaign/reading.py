"""Reading a campaign from a folder with `campaign.toml` and tables."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np

from discrepancy.campaign import schema
from discrepancy.campaign.column_remarks import (
    remarks_on_missing_columns,
    remarks_on_unused_columns,
)
from discrepancy.campaign.noise import noise_model
from discrepancy.campaign.noise_records import pre_trigger_record, repeat_record
from discrepancy.campaign.protocol import Event
from discrepancy.campaign.records import (
    Campaign,
    Channel,
    NoiseRecord,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.campaign.sampling import check_sampling, is_nearly_even, spacing_sentence
from discrepancy.campaign.trial_reading import numbers_in_si, read_trial
from discrepancy.campaign.wild_readings import without_fill_values
from discrepancy.errors import CampaignDataError, CampaignFileError
from reporting.files import hash_file, hash_record
from reporting.formats.table_file import TableErrors, TextTable, is_number, read_table
from reporting.formats.toml_file import read_toml
from reporting.words import comma_list, counted, is_or_are

CAMPAIGN_FILE = "campaign.toml"
"""Name of the file that describes a campaign, in its folder."""
TABLE_ERRORS = TableErrors(layout=CampaignFileError, value=CampaignDataError)
"""What a table of a campaign raises."""


def read_campaign(folder: str | Path) -> Campaign:
    """Read a campaign from its folder (or from its `campaign.toml`).

    Parameters
    ----------
    folder : path
        The folder with `campaign.toml` and the tables that it names.

    Returns
    -------
    Campaign
        The campaign in SI units; readings that are left out are marked so, and remarks say what the
        reader did.

    Raises
    ------
    CampaignFileError
        If a file, key or column is missing or is not of its kind; the sentence names place and
        remedy.
    CampaignDataError
        If there are NaN or infinite readings, uneven sampling, a gap in time, or a useless noise
        record.
    """
    folder = Path(folder)
    if folder.name == CAMPAIGN_FILE:
        folder = folder.parent
    path = folder / CAMPAIGN_FILE
    if folder.is_file():
        raise CampaignFileError(
            f"{folder} is a file: give the folder of a campaign, with its {CAMPAIGN_FILE}."
        )
    if not path.exists():
        missing_path = f"{CAMPAIGN_FILE} in {folder}" if folder.is_dir() else f"folder {folder}"
        raise CampaignFileError(f"There is no {missing_path}: give the folder of a campaign.")
    content = read_toml(path, CampaignFileError, what="campaign")
    section = schema.parse_campaign(content, str(path))
    table_names = {trial.file for trial in section.trial}
    if section.noise is not None:
        table_names.add(section.noise.file)
    table_names.discard(CAMPAIGN_FILE)
    for name in sorted(table_names):
        _check_inside(name)
    tables = {name: _read_table(folder, name) for name in sorted(table_names)}
    names = sorted({CAMPAIGN_FILE, *table_names})
    data_hash = hash_record({name: hash_file(folder / name) for name in names})
    remarks = []
    for name, table in tables.items():
        tables[name], clauses = _without_fill_values(table, section)
        remarks += [f"In {name}, {clause} and left out." for clause in clauses]
    return assemble_campaign(section, tables, data_hash, remarks)


def _check_inside(name: str) -> None:
    """Refuse the name of a file that is not in the folder of the campaign."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name:
        raise CampaignFileError(
            f"The file {name!r} must lie in the campaign's folder: give its path within that "
            "folder, with forward slashes."
        )


def assemble_campaign(
    section: schema.CampaignSection,
    tables: Mapping[str, TextTable],
    data_hash: str,
    remarks_on_tables: Sequence[str] = (),
) -> Campaign:
    """Return the campaign that `campaign.toml` and its tables describe.

    The remarks of the campaign are those in the file, then those on how the file was read, except
    for sentences that the file has already.

    Parameters
    ----------
    section : CampaignSection
        The content of `campaign.toml`.
    tables : mapping of str to TextTable
        The tables by the names that `campaign.toml` has for them.
    data_hash : str
        SHA-256 of all that was read.
    remarks_on_tables : sequence of str
        The remarks on how the tables were read.

    Raises
    ------
    CampaignFileError, CampaignDataError
        For the causes of `read_campaign`.
    """
    remarks = [*remarks_on_tables, *remarks_on_unused_columns(section, tables)]
    trials = tuple(
        read_trial(trial, tables[trial.file], section, remarks) for trial in section.trial
    )
    remarks += remarks_on_missing_columns(section, tables)
    measured_channels = {name for trial in trials for name in trial.channels}
    for channel in section.channel:
        if channel.name not in measured_channels:
            table = tables[section.trial[0].file]
            raise CampaignFileError(
                f"The channel {channel.name!r} is in no trial: no table has a column "
                f"{channel.table_column!r}; the columns of {table.name} are "
                f"{', '.join(table.columns)}."
            )
    channels = _read_channels(section, tables, trials, remarks)
    remarks += trial_remarks(channels, trials)
    new_remarks = [remark for remark in remarks if remark not in section.remarks]
    priors = {name: (prior.mean, prior.deviation) for name, prior in section.parameters.items()}
    return Campaign(
        name=section.name,
        channels=channels,
        trials=trials,
        reference_temperature=section.reference_temperature,
        parameters=priors,
        data_hash=data_hash,
        loggers=section.loggers,
        accept=section.accept,
        events=tuple(complete_events(section.event, trials, CAMPAIGN_FILE)),
        remarks=(*section.remarks, *new_remarks),
        provenance=section.provenance,
    )


def complete_events(events: Iterable[Event], trials: tuple[Trial, ...], source: str) -> list[Event]:
    """Check the events of a file, and return them with the names of all their trials.

    Parameters
    ----------
    events : iterable of Event
        The events of a file. An event without trials happened in all trials that are records in
        time.
    trials : tuple of Trial
        The trials of the campaign.
    source : str
        The name of the file, for messages.

    Raises
    ------
    CampaignFileError
        If a trial of an event does not exist or is not a record in time, two events use one name in
        expressions, or an event begins again before it is over.
    CampaignDataError
        If an event begins or ends outside the record of its trial.
    """
    trials_by_name = {trial.name: trial for trial in trials}
    recorded_in_time = tuple(trial.name for trial in trials if trial.is_dynamic)
    completed = []
    for event in events:
        names = (event.trial,) if event.trial else event.trials or recorded_in_time
        completed.append(replace(event, trial=None, trials=names))
    for event in completed:
        for name in event.trials:
            _check_trial_of_event(event, name, trials_by_name, source)
            _check_event_in_record(event, trials_by_name[name])
    for name in recorded_in_time:
        events_of_trial = [event for event in completed if name in event.trials]
        _check_names_of_event_times(events_of_trial, name, source)
        _check_occurrences(events_of_trial, name, source)
    return completed


def _check_trial_of_event(
    event: Event, name: str, trials: Mapping[str, Trial], source: str
) -> None:
    """Raise an error if the trial of an event does not exist, or is not a record in time."""
    if name not in trials:
        raise CampaignFileError(
            f"{source}: the event {event.name!r} names the trial {name!r}, which is not among the "
            f"trials {', '.join(trials)}."
        )
    trial = trials[name]
    if not trial.is_dynamic:
        raise CampaignFileError(
            f"{source}: the event {event.name!r} is in the trial {name!r}, which is "
            f"{trial.kind.value}: its rows have no time."
        )


def _check_event_in_record(event: Event, trial: Trial) -> None:
    """Raise an error if an event begins or ends outside the record of a trial."""
    first_time, last_time = trial.time[[0, -1]].tolist()
    for key, time in (("time", event.time), ("until", event.until)):
        if time is not None and not first_time <= time <= last_time:
            raise CampaignDataError(
                f"The event {event.name!r} has {key} = {time:g} s, but the record of the trial "
                f"{trial.name!r} goes from {first_time:g} to {last_time:g} s: times count from the "
                "trial's start."
            )


def _check_names_of_event_times(events: Sequence[Event], trial: str, source: str) -> None:
    """Raise an error if two events of a trial use one name in expressions.

    `pump_until` is both an event of this name, and the end of the event `pump`.
    """
    event_of_name: dict[str, str] = {}
    for event in events:
        for name in event.times_by_name:
            if event_of_name.setdefault(name, event.name) != event.name:
                raise CampaignFileError(
                    f"{source}: two events have a moment {name!r} in the trial {trial!r}: rename "
                    "one."
                )


def _check_occurrences(events: Sequence[Event], trial: str, source: str) -> None:
    """Raise an error if an event of a trial begins again before it is over."""
    in_order = sorted(events, key=lambda event: (event.name, event.time))
    for event, following in pairwise(in_order):
        if event.name != following.name:
            continue
        if event.until is None:
            raise CampaignFileError(
                f"{source}: the event {event.name!r} happens several times in the trial {trial!r}, "
                f"and the one at {event.time:g} s has no end: give it `until`."
            )
        if following.time < event.until:
            raise CampaignFileError(
                f"{source}: the event {event.name!r} begins again at {following.time:g} s in the "
                f"trial {trial!r}, before it is over at {event.until:g} s: its intervals must not "
                "overlap."
            )


def _read_table(folder: Path, name: str) -> TextTable:
    """Read a table of a campaign's folder; messages name the table without the folder."""
    if not (folder / name).exists():
        tables = ", ".join(sorted(path.name for path in folder.glob("*.csv"))) or "none"
        raise CampaignFileError(
            f"There is no file {name} in {folder}; the tables there are {tables}."
        )
    return read_table(folder / name, TABLE_ERRORS, name=name)


def _without_fill_values(
    table: TextTable, section: schema.CampaignSection
) -> tuple[TextTable, list[str]]:
    """Replace the fill values of channels, such as -999, by empty cells.

    Returns the table, and a clause for each column with fill values. Columns that are not read stay
    as they are. Raises `CampaignDataError` if a load or another input has a fill value.
    """
    channel_columns = {channel.table_column for channel in section.channel}
    load_columns = {recorded_input.table_column for recorded_input in section.input}
    load_columns |= {*schema.INPUT_COLUMNS}
    columns = dict(table.columns)
    clauses: list[str] = []
    for name, cells in table.columns.items():
        is_read = name in channel_columns or name in load_columns
        if not is_read or not all(is_number(cell) for cell in cells if cell):
            continue  # a text among the numbers is refused where the column is read
        cleaned = without_fill_values(cells, cells, table.lines, name, "line")
        if cleaned.fill_values and name not in channel_columns:
            raise CampaignDataError(
                f"{table.name}: {cleaned.fill_values[0]}, but the trial needs a number in each "
                "row: correct it, or leave the row out."
            )
        columns[name] = cleaned.cells
        clauses += cleaned.fill_values
    return replace(table, columns=columns), clauses


# ---------------------------------------------------------------- channels


def _read_channels(
    section: schema.CampaignSection,
    tables: Mapping[str, TextTable],
    trials: tuple[Trial, ...],
    remarks: list[str],
) -> dict[str, Channel]:
    """Return the channels by name, each with its noise record if there is one.

    The noise of a channel comes from its samples at rest, or else from the key `noise` of the
    channel, or else from repeated trials, which gives a remark.

    Parameters
    ----------
    section : CampaignSection
        The content of `campaign.toml`.
    tables : mapping of str to TextTable
        The tables by their names.
    trials : tuple of Trial
        The trials, among which repeats are searched.
    remarks : list of str
        The remarks of the reader, to which that on noise from repeats is added.
    """
    samples_at_rest = _samples_at_rest(section, tables)
    channels = {}
    for channel in section.channel:
        # repeats come last, because they also contain differences between trials, such as an effect
        noise = samples_at_rest.get(channel.name) or channel.noise
        if noise is None:
            noise = repeat_record(channel, trials)
            if noise is not None:
                remarks.append(
                    f"The noise of the channel {channel.name!r} is taken from repeated trials "
                    f"({noise.degrees_of_freedom:.0f} degrees of freedom): it includes what "
                    "changes from trial to trial."
                )
        channels[channel.name] = replace(channel, column=channel.table_column, noise=noise)
    return channels


def _samples_at_rest(
    section: schema.CampaignSection, tables: Mapping[str, TextTable]
) -> dict[str, NoiseRecord]:
    """Return the noise records from the table of samples at rest, by the name of the channel.

    The result is empty without such a table. If its times are too uneven for a filter, the records
    have no sampling interval.

    Raises
    ------
    CampaignFileError
        If the table has no column of any channel.
    CampaignDataError
        If a record has a gap. Empty cells are allowed only at its end, where it is shorter.
    """
    if section.noise is None:
        return {}
    table = tables[section.noise.file]
    user = "the noise record"
    interval = section.noise.interval
    if interval is None:
        cells = table.cells("time", user)
        time = check_sampling(table.numbers("time", user), cells, user, table.name)
        if is_nearly_even(time):
            interval = float(time[-1] - time[0]) / (len(time) - 1)
    # the samples of each channel, without the empty cells at the end of its column
    records = {}
    for channel in section.channel:
        if channel.table_column not in table.columns:
            continue
        values = numbers_in_si(table, channel, user, empty_allowed=True)
        is_reading = np.isfinite(values)
        count = int(is_reading.sum())
        if not is_reading[:count].all():
            raise CampaignDataError(
                f"{table.name}: the column {channel.table_column!r} has an empty cell between "
                "readings; a noise record must be without gaps."
            )
        records[channel.name] = pre_trigger_record(
            values[:count], interval, channel.name, table.name
        )
    if not records:
        raise CampaignFileError(
            f"{table.name} holds the noise of no channel: its columns are "
            f"{comma_list(table.columns)}."
        )
    return records


# ---------------------------------------------------------------- remarks on records in time


def trial_remarks(channels: Mapping[str, Channel], trials: tuple[Trial, ...]) -> list[str]:
    """Return the remarks on sampling, begins and coloured noise of a campaign's trials."""
    times = {trial.name: trial.time for trial in trials if trial.is_dynamic}
    remarks = []
    uneven_sampling = spacing_sentence(times)
    if uneven_sampling is not None:
        remarks.append(uneven_sampling)
    remarks += _remarks_on_begins(trials)
    remarks += _remarks_on_coloured_noise(channels, trials)
    return remarks


_BEGINS = {
    Start.SETTLED: "taken to begin at rest under the loads of the first sample",
    Start.STILL: "taken to begin at rest without loads",
    Start.UNKNOWN: "taken to begin in a state that is fitted",
}
_ASSUMED = ' (assumed; set `begins` to "settled", "still" or "unknown")'


def _remarks_on_begins(trials: tuple[Trial, ...]) -> list[str]:
    """Return remarks that say which trials begin in which state, stated by the file or assumed.

    A forced trial without a force at its first sample begins in the same way in any assumed state,
    and is not mentioned.
    """
    groups: dict[tuple[Start, bool], list[str]] = {}
    for trial in trials:
        is_loaded_at_first = trial.kind is TrialKind.FORCED and trial.force[0] != 0.0
        begin_matters = trial.kind is TrialKind.DRIVEN or is_loaded_at_first
        if begin_matters or not trial.begin_assumed:
            group = groups.setdefault((trial.begins, trial.begin_assumed), [])
            group.append(repr(trial.name))
    remarks = []
    for (begin, is_assumed), names in groups.items():
        how = _BEGINS[begin] + (_ASSUMED if is_assumed else "")
        subject = "The trial" if len(names) == 1 else "The trials"
        remarks.append(f"{subject} {', '.join(names)} {is_or_are(len(names))} {how}.")
    return remarks


def _remarks_on_coloured_noise(
    channels: Mapping[str, Channel], trials: tuple[Trial, ...]
) -> list[str]:
    """Return a remark on each channel whose coloured noise cannot be whitened in some trial."""
    remarks = []
    for name, channel in channels.items():
        noise = noise_model(channel, 1.0)
        coloured = [
            trial.name for trial in trials if name in trial.channels and noise.stays_coloured(trial)
        ]
        if coloured:
            names = f"{counted(len(coloured), 'trial')} {', '.join(map(repr, coloured))}"
            remarks.append(
                f"The noise of the channel {name!r} is coloured, and its record is not sampled "
                f"like the {names}: there its samples count as independent, so that probabilities "
                "are too sharp; record the noise at the trials' sampling."
            )
    return remarks
