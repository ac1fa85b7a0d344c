"""Reading a campaign: a folder with `campaign.toml` and tables in, a checked `Campaign` in SI units out."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from math import inf
from pathlib import Path, PurePosixPath

import numpy as np

from discrepancy.campaign import schema
from discrepancy.campaign.noise import noise_model, pre_trigger_record, repeat_record
from discrepancy.campaign.protocol import Event
from discrepancy.campaign.records import (
    USUAL_REGIONS,
    BoolArray,
    Campaign,
    Channel,
    FloatArray,
    InTables,
    IntArray,
    NoiseRecord,
    Quantity,
    RecordedInput,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.campaign.sampling import check_sampling, nearly_even, spacing_sentence
from discrepancy.campaign.units import conversion, conversion_of
from discrepancy.errors import CampaignDataError, CampaignFileError, said
from reporting.files import hash_file, hash_record
from reporting.table_file import TableErrors, TextTable, read_table
from reporting.toml_file import read_toml
from reporting.words import counted, is_or_are

CAMPAIGN_FILE = "campaign.toml"
"""Name of the file that describes a campaign, in its folder."""
TABLE_ERRORS = TableErrors(layout=CampaignFileError, value=CampaignDataError)
"""What a table of a campaign raises."""
LATE = 1.5
"""Intervals after a release from rest within which its first sample is."""
_REPEATED = "leave one out, or tell repeated readings apart by a column `time`"


def read_campaign(folder: str | Path) -> Campaign:
    """Read a campaign from its folder (or from its `campaign.toml`).

    Parameters
    ----------
    folder : path
        Holds `campaign.toml` and the tables that it names.

    Returns
    -------
    Campaign
        SI units; readings that are left out are marked so, and remarks say what the reader did.

    Raises
    ------
    CampaignFileError
        A file, key or column is missing or is not of its kind; the sentence names place and remedy.
    CampaignDataError
        NaN or infinite readings, uneven sampling, a gap in time, or a noise record that is none.
    """
    folder = Path(folder)
    if folder.name == CAMPAIGN_FILE:
        folder = folder.parent
    path = folder / CAMPAIGN_FILE
    if not path.exists():
        missing = f"{CAMPAIGN_FILE} in {folder}" if folder.is_dir() else f"folder {folder}"
        raise CampaignFileError(f"There is no {missing}: give the folder of a campaign.")
    section = schema.parse_campaign(read_toml(path, CampaignFileError, what="campaign"), str(path))
    names = {CAMPAIGN_FILE, *(trial.file for trial in section.trial)}
    if section.noise is not None:
        names.add(section.noise.file)
    for name in sorted(names):
        own = PurePosixPath(name)
        if own.is_absolute() or ".." in own.parts or "\\" in name or "\0" in name:
            raise CampaignFileError(said("campaign.outside", name=name))
    tables = {name: _read_table(folder, name) for name in sorted(names - {CAMPAIGN_FILE})}
    data_hash = hash_record({name: hash_file(folder / name) for name in sorted(names)})
    return assemble(section, tables, data_hash)


def assemble(section: schema.CampaignSection, tables: Mapping[str, TextTable], data_hash: str) -> Campaign:
    """Return the campaign that a description and its tables make; errors as `read_campaign`.

    Parameters
    ----------
    section : CampaignSection
        What `campaign.toml` says.
    tables : mapping of str to TextTable
        By the names that the description has for them.
    data_hash : str
        SHA-256 of all that was read.
    """
    remarks = _unused(section, tables)
    trials = tuple(_trial(trial, tables[trial.file], section, remarks) for trial in section.trial)
    measured = {name for trial in trials for name in trial.channels}
    if nowhere := next((item for item in section.channel if item.name not in measured), None):
        first = tables[section.trial[0].file]
        has = ", ".join(first.columns)
        raise CampaignFileError(said("campaign.in_no_trial", channel=nowhere, table=first, has=has))
    channels = _channels(section, tables, trials, remarks)
    remarks += remarks_on(channels, trials)
    return Campaign(
        name=section.name,
        channels=channels,
        trials=trials,
        reference_temperature=section.reference_temperature,
        parameters={name: (item.mean, item.deviation) for name, item in section.parameters.items()},
        data_hash=data_hash,
        loggers=section.loggers,
        accept=section.accept,
        events=tuple(placed_events(section.event, trials, CAMPAIGN_FILE)),
        remarks=(*section.remarks, *(remark for remark in remarks if remark not in section.remarks)),
    )


def _unused(section: schema.CampaignSection, tables: Mapping[str, TextTable]) -> list[str]:
    """Return a remark on each column that no channel and no input has."""
    known = {*schema.INPUT_COLUMNS, *(item.table_column for item in section.columns)}
    files: dict[str, list[str]] = {}
    for name in dict.fromkeys(trial.file for trial in section.trial):
        for column in tables[name].columns:
            if column not in known and not column.startswith(schema.OF_REGION):
                files.setdefault(column, []).append(name)
    more = {column: f" and {len(where) - 1} more" if where[1:] else "" for column, where in files.items()}
    return [
        said("remarks.no_channel", file=where[0], more=more[column], column=column)
        for column, where in files.items()
    ]


def placed_events(events: Iterable[Event], trials: tuple[Trial, ...], source: str) -> list[Event]:
    """Return the events with the trials in which they happened, within their records in time.

    Parameters
    ----------
    events : iterable of Event
        As a file has them: with one trial, several, or none, which means all with samples in time.
    trials : tuple of Trial
        Of the campaign.
    source : str
        The file, for refusals.

    Raises
    ------
    CampaignFileError
        A trial of an event is not there or has no samples in time, two events have moments of one name, or
        an event begins again before it was over.
    CampaignDataError
        A moment lies outside of its trial's record.
    """
    in_time = tuple(trial.name for trial in trials if trial.is_dynamic)
    placed = []
    for event in events:
        names = (event.trial,) if event.trial else event.trials or in_time
        placed.append(replace(event, trial=None, trials=names))
    for event in placed:
        for name in event.trials:
            _check_moments(event, name, trials, source)
    for name in in_time:
        _check_order([event for event in placed if name in event.trials], name, source)
    return placed


def _check_moments(event: Event, name: str, trials: tuple[Trial, ...], source: str) -> None:
    """Refuse an event in a trial that is not there, that has no samples in time, or that ended before."""
    trial = next((item for item in trials if item.name == name), None)
    if trial is None:
        known = ", ".join(item.name for item in trials)
        raise CampaignFileError(
            f"{source}: {said('campaign.no_trial', event=event, trial=name, known=known)}."
        )
    if not trial.is_dynamic:
        words = said("campaign.no_course", event=event, trial=name, kind=trial.kind.value)
        raise CampaignFileError(f"{source}: {words}.")
    first, last = trial.time[[0, -1]].tolist()
    for key, moment in (("time", event.time), ("until", event.until)):
        if moment is not None and not first <= moment <= last:
            raise CampaignDataError(
                f"The event {event.name!r} has {key} = {moment:g} s, but the record of the trial {name!r} "
                f"goes from {first:g} to {last:g} s: times count from the trial's start."
            )


def _check_order(events: list[Event], trial: str, source: str) -> None:
    """Refuse moments of one name of different events, and an event that begins again before it was over."""
    owners: dict[str, str] = {}
    for event in events:
        for word in event.moments:
            if owners.setdefault(word, event.name) != event.name:
                words = said("campaign.two_moments", word=word, trial=trial)
                raise CampaignFileError(f"{source}: {words}.")
    in_order = sorted(events, key=lambda event: (event.name, event.time))
    for event, following in pairwise(in_order):
        if event.name != following.name:
            continue
        if event.until is None:
            raise CampaignFileError(
                f"{source}: the event {event.name!r} happens several times in the trial {trial!r}, and that "
                f"at {event.time:g} s has no end: give it `until`."
            )
        if following.time < event.until:
            raise CampaignFileError(
                f"{source}: the event {event.name!r} begins again at {following.time:g} s in the trial "
                f"{trial!r}, before it is over at {event.until:g} s: its intervals must not overlap."
            )


def _read_table(folder: Path, name: str) -> TextTable:
    """Return a table of a campaign's folder; sentences about its content name it without the folder."""
    if not (folder / name).exists():
        there = ", ".join(sorted(item.name for item in folder.glob("*.csv"))) or "none"
        raise CampaignFileError(said("campaign.no_file", name=name, folder=folder, there=there))
    return read_table(folder / name, TABLE_ERRORS, name=name)


# ---------------------------------------------------------------- trials


def _trial(
    section: schema.TrialSection, table: TextTable, campaign: schema.CampaignSection, remarks: list[str]
) -> Trial:
    user = f"the trial {section.name!r}"
    time, start = _times(section, table, campaign, user)
    zeros = np.zeros(len(table))
    chosen = _measured(section, table, campaign)
    columns, used = zip(*(_readings(channel, section, table, remarks) for channel in chosen), strict=True)
    regions, health, health_deviation = _health(section, table, user)
    inputs = _inputs(section, table, campaign, user)
    # at rest under other inputs no force need act
    held = section.kind is TrialKind.STATIC and inputs and "force" not in table.columns
    forced = section.kind in (TrialKind.STATIC, TrialKind.FORCED) and not held
    pushing = (item.values for item in inputs if item.quantity in (Quantity.FORCE, Quantity.TORQUE))
    return Trial(
        **section.said,
        channels=tuple(channel.name for channel in chosen),
        values=np.stack(columns, axis=1),
        used=np.stack(used, axis=1),
        time=time,
        force=_force(table, campaign, user) if forced else next(pushing, zeros),
        load_factor=table.numbers("load_factor", user) if section.kind is TrialKind.FLIGHT else zeros,
        temperature=_temperature(section, table, campaign, user),
        start=start,
        health=health,
        regions=regions,
        health_deviation=health_deviation,
        begins=section.begins or Start.SETTLED,
        begin_assumed=section.begins is None,
        inputs=inputs,
    )


def _inputs(
    section: schema.TrialSection, table: TextTable, campaign: schema.CampaignSection, user: str
) -> tuple[RecordedInput, ...]:
    """Return the recorded inputs of a driven or static trial: those whose columns are there."""
    if section.kind not in (TrialKind.DRIVEN, TrialKind.STATIC):
        return ()
    there = (item for item in campaign.input if item.table_column in table.columns)
    return tuple(replace(item, values=_numbers(table, item, user)) for item in there)


def _force(table: TextTable, campaign: schema.CampaignSection, user: str) -> FloatArray:
    """Return the column `force` [N]."""
    return table.numbers("force", user) * conversion(campaign.force_unit, schema.FORCE_UNIT)


def _numbers(table: TextTable, item: InTables, user: str, *, empty_allowed: bool = False) -> FloatArray:
    numbers = table.numbers(item.table_column, user, empty_allowed=empty_allowed)
    return numbers * conversion_of(item.quantity, item.unit)


def _times(
    section: schema.TrialSection, table: TextTable, campaign: schema.CampaignSection, user: str
) -> tuple[FloatArray, float]:
    """Return the times of a trial's rows and its start [s]."""
    start = section.start or 0.0
    if section.kind not in (TrialKind.STATIC, TrialKind.FLIGHT):
        cells = table.cells("time", user)
        time = check_sampling(table.numbers("time", user), cells, user, table.name)
        late = (
            section.release is not None and section.release.at_rest and time[0] > LATE * (time[1] - time[0])
        )
        if section.release is not None and (late or time[0] < 0.0):
            which = "late_release" if late else "before_release"
            raise CampaignDataError(said(f"campaign.{which}", file=table.name, user=user, first=time[0]))
        return time, start
    of_inputs = (item.table_column for item in campaign.input)
    loads = [name for name in dict.fromkeys(("force", "load_factor", *of_inputs)) if name in table.columns]
    branches = _load_branches(table, loads, user).tolist()
    table.refuse_repeated([*zip(branches, *table.columns.values(), strict=True)], "row", _REPEATED)
    if "time" not in table.columns:
        return np.full(len(table), start), start
    time = table.numbers("time", user)
    if np.any(np.diff(time) < 0.0):
        raise CampaignDataError(f"{table.name}: the times of {user} run backwards; put its rows in order.")
    return time, float(time[0]) if section.start is None else start


def _load_branches(table: TextTable, loads: Sequence[str], user: str) -> IntArray:
    """Return the branch (N,) of its load cycle that each row stands on: a new one begins where a load turns.

    A cycle comes by each level on the way up and on the way down, where a coarse gauge may read alike.
    """
    turns = np.zeros(len(table), dtype=np.int64)
    for column in loads:
        steps = np.diff(table.numbers(column, user))
        moving = np.flatnonzero(steps)
        turned = np.diff(np.sign(steps[moving])) != 0.0
        turns[moving[1:][turned] + 1] = 1
    return np.cumsum(turns)


def _measured(
    section: schema.TrialSection, table: TextTable, campaign: schema.CampaignSection
) -> tuple[Channel, ...]:
    """Return the channels of a trial: those that it names, or all whose columns are there."""
    channels = {channel.name: channel for channel in campaign.channel}
    there = (name for name, channel in channels.items() if channel.table_column in table.columns)
    chosen = tuple(channels[name] for name in (there if section.channels is None else section.channels))
    for channel in chosen:
        table.cells(channel.table_column, f"the channel {channel.name!r}")
    if not chosen:
        has, wanted = map(", ".join, (table.columns, (item.table_column for item in campaign.channel)))
        raise CampaignFileError(
            said("campaign.no_channel", table=table, trial=section, has=has, wanted=wanted)
        )
    return chosen


def _readings(
    channel: Channel, section: schema.TrialSection, table: TextTable, remarks: list[str]
) -> tuple[FloatArray, BoolArray]:
    """Return a channel's readings and which of them are used; an empty cell is bridged and left out."""
    values = _numbers(table, channel, f"the channel {channel.name!r}", empty_allowed=True)
    used = np.isfinite(values)
    told = {"channel": channel.name, "trial": section.name}
    if not used.any():
        raise CampaignDataError(said("campaign.no_reading", table=table, column=channel.table_column, **told))
    if not used.all():
        rows = np.arange(len(values))
        values[~used] = np.interp(rows[~used], rows[used], values[used])
        count = int((~used).sum())
        are = f"{is_or_are(count)} empty"
        remarks.append(said("remarks.left_out", count=count, total=len(values), are=are, **told))
    for row in section.left_out.get(channel.name, ()):
        if row > len(values):
            has = counted(len(values), "row")
            raise CampaignFileError(said("campaign.no_row", row=row, table=table, has=has, **told))
        used[row - 1] = False
    return values, used


def _temperature(
    section: schema.TrialSection, table: TextTable, campaign: schema.CampaignSection, user: str
) -> FloatArray:
    reference, stated = campaign.reference_temperature, section.temperature
    column = "temperature" in table.columns
    if column and stated is not None:
        raise CampaignFileError(said("campaign.temperature_twice", trial=section, table=table))
    if not column and stated is None:
        return np.zeros(len(table))
    if reference is None:
        raise CampaignFileError(said("campaign.no_reference", trial=section))
    return (table.numbers("temperature", user) if column else np.full(len(table), stated)) - reference


def _health(
    section: schema.TrialSection, table: TextTable, user: str
) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """Return damage regions, and their losses and deviations (N, K), from columns, keys, or healthy."""
    stated = dict(section.health)
    doubt = stated.pop("deviation", 0.0)
    columns = [
        name.removeprefix(schema.OF_REGION) for name in table.columns if name.startswith(schema.OF_REGION)
    ]
    losses = (name.removesuffix("_deviation") for name in columns)
    regions = tuple(dict.fromkeys((*USUAL_REGIONS, *stated, *losses)))
    health, deviation = np.zeros((2, len(table), len(regions)))
    for index, name in enumerate(regions):
        column = name if name in USUAL_REGIONS else f"{schema.OF_REGION}{name}"
        if column in table.columns and name in stated:
            raise CampaignFileError(said("campaign.health_twice", trial=section, region=name, table=table))
        for values, key, most, what, usual in (
            (health, column, 1.0, "a fraction from 0 to 1", stated.get(name, 0.0)),
            (deviation, f"{column}_deviation", inf, "a standard deviation", doubt),
        ):
            values[:, index] = table.numbers(key, user) if key in table.columns else usual
            if (outside := np.flatnonzero((values[:, index] < 0.0) | (values[:, index] > most))).size:
                row = int(outside[0])
                place = f"{table.name}, line {table.lines[row]}"
                raise CampaignFileError(f"{place}: {key} is {what}, and {values[row, index]:g} came.")
    return regions, health, deviation


# ---------------------------------------------------------------- channels


def _channels(
    section: schema.CampaignSection,
    tables: Mapping[str, TextTable],
    trials: tuple[Trial, ...],
    remarks: list[str],
) -> dict[str, Channel]:
    recorded = _recorded_noise(section, tables)
    channels = {}
    for item in section.channel:
        # repeats come last: they hold what differs from trial to trial, which may be what is looked for
        noise = recorded.get(item.name) or item.noise or repeat_record(item, trials)
        if noise is not None and noise.source == "repeats" and item.noise is None:
            remarks.append(said("remarks.repeats", channel=item, found=noise))
        channels[item.name] = replace(item, column=item.table_column, noise=noise)
    return channels


def _recorded_noise(
    section: schema.CampaignSection, tables: Mapping[str, TextTable]
) -> dict[str, NoiseRecord]:
    """Return the records of the samples at rest; a shorter record has empty cells at its end."""
    if section.noise is None:
        return {}
    table = tables[section.noise.file]
    user = "the noise record"
    interval = section.noise.interval
    if interval is None:
        time = check_sampling(table.numbers("time", user), table.cells("time", user), user, table.name)
        interval = float(time[-1] - time[0]) / (len(time) - 1) if nearly_even(time) else None
    records = {}
    for item in section.channel:
        if item.table_column not in table.columns:
            continue
        values = _numbers(table, item, user, empty_allowed=True)
        there = np.isfinite(values)
        count = int(there.sum())
        if not there[:count].all():
            raise CampaignDataError(said("campaign.noise_gap", table=table, item=item))
        records[item.name] = pre_trigger_record(values[:count], interval, item.name, table.name)
    if not records:
        raise CampaignFileError(said("campaign.noise_of_none", table=table))
    return records


# ---------------------------------------------------------------- remarks on records in time
def remarks_on(channels: Mapping[str, Channel], trials: tuple[Trial, ...]) -> list[str]:
    """Return the sentences on the trials of a campaign, in one order."""
    uneven = spacing_sentence({trial.name: trial.time for trial in trials if trial.is_dynamic})
    found = [] if uneven is None else [uneven]
    return [*found, *_begins(trials), *_not_whitened(channels, trials)]


_BEGINS = {
    Start.SETTLED: "taken to begin at rest under what acts at the first sample",
    Start.STILL: "taken to begin at rest under nothing",
    Start.UNKNOWN: "begun in a state that is fitted",
}
_ASSUMED = ' (assumed: say `begins`, "settled", "still" or "unknown")'


def _begins(trials: tuple[Trial, ...]) -> list[str]:
    """Return what is said or assumed of how trials begin, one sentence for each kind of begin."""
    groups: dict[tuple[Start, bool], list[str]] = {}
    for trial in trials:
        matters = trial.kind is TrialKind.DRIVEN or (trial.kind is TrialKind.FORCED and trial.force[0] != 0.0)
        if matters or not trial.begin_assumed:
            groups.setdefault((trial.begins, trial.begin_assumed), []).append(repr(trial.name))
    found = []
    for (begins, assumed), names in groups.items():
        several, are = ("", "is") if len(names) == 1 else ("s", "are")
        how = _BEGINS[begins] + (_ASSUMED if assumed else "")
        found.append(f"The trial{several} {', '.join(names)} {are} {how}.")
    return found


def _not_whitened(channels: Mapping[str, Channel], trials: tuple[Trial, ...]) -> list[str]:
    """Return a sentence for each channel whose coloured noise cannot be whitened in some trial."""
    found = []
    for name, channel in channels.items():
        noise = noise_model(channel, 1.0)
        there = (trial for trial in trials if name in trial.channels)
        where = [trial.name for trial in there if noise.stays_coloured(trial)]
        if where:
            trials_there = f"{counted(len(where), 'trial')} {', '.join(map(repr, where))}"
            found.append(said("remarks.not_whitened", channel=name, trials=trials_there))
    return found
