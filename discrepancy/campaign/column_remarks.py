"""Remarks on columns: those that nothing reads, and those that the tables of some trials lack."""

from collections.abc import Iterable, Mapping, Sequence

from discrepancy.campaign import schema
from discrepancy.campaign.records import InTables, TrialKind
from reporting.formats.table_file import TextTable
from reporting.words import comma_list


def remarks_on_unused_columns(
    section: schema.CampaignSection, tables: Mapping[str, TextTable]
) -> list[str]:
    """Return a remark on each column that no channel and no input reads."""
    used_columns = {
        *schema.INPUT_COLUMNS,
        *(channel_or_input.table_column for channel_or_input in section.columns),
    }
    files_of_columns: dict[str, list[str]] = {}
    for file in dict.fromkeys(trial.file for trial in section.trial):
        for column in tables[file].columns:
            if column not in used_columns and not column.startswith(schema.OF_REGION):
                files_of_columns.setdefault(column, []).append(file)
    remarks = []
    for column, files in files_of_columns.items():
        further_files = f" and {len(files) - 1} more" if len(files) > 1 else ""
        remarks.append(
            f"{files[0]}{further_files}: no channel reads the column {column!r}, so it is left "
            "out; if you mean to use it, check its spelling."
        )
    return remarks


def remarks_on_missing_columns(
    section: schema.CampaignSection, tables: Mapping[str, TextTable]
) -> list[str]:
    """Return a remark on each channel and input that the tables of some trials, not all, lack.

    - Channels: a trial that states its `channels` lacks others on purpose and is not mentioned. It
      counts among all trials nevertheless: if all others lack a channel, that is remarked.
    - Inputs: only driven trials are compared with one another, because others need no input: a
      static trial may have a column `force` instead.

    The remarks name no files, so that they stay the same when a campaign is written again.
    """
    trials_without_list = [trial for trial in section.trial if trial.channels is None]
    driven_trials = [trial for trial in section.trial if trial.kind is TrialKind.DRIVEN]
    remarks = []
    for channel in section.channel:
        lacking_trials = _trials_without(channel, trials_without_list, tables)
        if lacking_trials and len(lacking_trials) < len(section.trial):
            remarks.append(
                f"{_trials_have(lacking_trials)} no column of the channel {channel.name!r}, which "
                "is not compared there; if that is not meant, correct the table, or else state the "
                "`channels` of the trial."
            )
    for recorded_input in section.input:
        lacking_trials = _trials_without(recorded_input, driven_trials, tables)
        if lacking_trials and len(lacking_trials) < len(driven_trials):
            remarks.append(
                f"{_trials_have(lacking_trials)} no column of the input {recorded_input.name!r}, "
                "which is taken not to act there; if that is not meant, correct the table."
            )
    return remarks


def _trials_without(
    channel_or_input: InTables,
    trials: Iterable[schema.TrialSection],
    tables: Mapping[str, TextTable],
) -> list[schema.TrialSection]:
    """Return the trials whose table has no column of a channel or an input."""
    column = channel_or_input.table_column
    return [trial for trial in trials if column not in tables[trial.file].columns]


def _trials_have(trials: Sequence[schema.TrialSection]) -> str:
    """Return the beginning of a sentence on what trials have; a long list is cut."""
    names = comma_list(repr(trial.name) for trial in trials)
    return f"The trial {names} has" if len(trials) == 1 else f"The trials {names} have"
