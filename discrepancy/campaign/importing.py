"""A laboratory's files as a campaign: what each column is, and what the user has still to state."""

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from discrepancy.campaign.answers import OF_COLUMNS as OF_COLUMNS
from discrepancy.campaign.answers import OF_FILES as OF_FILES
from discrepancy.campaign.answers import Answers, Questionnaire, check_subjects
from discrepancy.campaign.clock_cells import DAY_FIRST, MONTH_FIRST
from discrepancy.campaign.clock_columns import find_clocks
from discrepancy.campaign.clocks import MergedTable, merge_clocks
from discrepancy.campaign.column_roles import ColumnReader, OutputQuantity
from discrepancy.campaign.columns import (
    INPUT,
    LEFT_OUT,
    NOISE,
    LaboratoryColumn,
    degrees_celsius,
    missing_answers,
    origin_sentence,
    release_in_si,
    sampling_interval,
    units_of_columns,
)
from discrepancy.campaign.force_release import table_of_release_by_force
from discrepancy.campaign.reading import TABLE_ERRORS, assemble_campaign
from discrepancy.campaign.records import Campaign, Hold, Start, TrialKind
from discrepancy.campaign.schema import FORMAT, parse_campaign
from discrepancy.campaign.sensor_deviations import SensorDeviations
from discrepancy.campaign.sheet import Sheet
from discrepancy.errors import CampaignFileError
from reporting.files import hash_record
from reporting.formats.table_file import TextTable
from reporting.words import listing

KINDS = (*TrialKind, NOISE)
"""Kinds of a file: those of trials, and samples at rest."""
_RECORDED_IN_TIME = (TrialKind.RINGDOWN, TrialKind.FORCED, TrialKind.DRIVEN, NOISE)
_WORKBOOK_OR_SUFFIX = re.compile(r".*\.xls[mx]?#|\.[^.]*$")
"""What the name of a trial leaves out of that of its file: the workbook before the name of a sheet,
as in `book.xlsx#sheet`, or else the suffix."""


class LaboratoryImport:
    """The import of a laboratory's files: what the files and the user's answers say about them.

    To make a campaign from such files, create this object, answer its open `questions` by
    `with_answer`, which returns a new object, and then call `campaign`.

    Parameters
    ----------
    sheets : sequence of Sheet
        The tables of all files.
    answers : mapping
        The answers of the user, by option (`OF_COLUMNS`, `OF_FILES`, "reference-temperature") and
        by the column or file that they are about.
    quantity_of : callable, optional
        Returns the quantity of a model's output. Without it any name can be that of an output.
    outputs : sequence of str
        The model's outputs with quantity and unit, as questions and refusals list them.

    Raises
    ------
    CampaignFileError
        If an answer is about no column or file, or does not fit.
    """

    def __init__(
        self,
        sheets: Sequence[Sheet],
        answers: Answers,
        quantity_of: OutputQuantity | None = None,
        outputs: Sequence[str] = (),
    ) -> None:
        self._sheets_as_read = sheets
        self.answers = answers
        self._quantity_of = quantity_of
        self._outputs = outputs
        self._questionnaire = Questionnaire(answers)
        self._clocks: dict[str, MergedTable] = {}
        names = [sheet.name for sheet in sheets]
        if len({*names}) < len(names):
            raise CampaignFileError(
                f"Two files have the same name among {listing(names)}: rename one, because trials "
                "are named after their files."
            )
        heads = dict.fromkeys(head for sheet in sheets for head in sheet.heads)
        check_subjects(answers, [*heads], names)

        self.kinds = {name: self._kind_of_file(name) for name in names}
        self._noise_file = self._only_noise_file()
        sheets = self.sheets = [self._sheet_with_clear_dates(sheet) for sheet in sheets]
        self.decimals = {sheet.name: self._decimal_mark(sheet) for sheet in sheets}
        reader = ColumnReader(self._questionnaire, self.kinds, quantity_of, outputs)
        self.columns: list[LaboratoryColumn] = []
        for sheet in sheets:
            for head, unit in zip(sheet.heads, sheet.units, strict=True):
                self.columns.append(reader.read_column(sheet, head, unit))
        self.releases = {
            name: self._release_table(name)
            for name, kind in self.kinds.items()
            if kind == TrialKind.RINGDOWN
        }
        self.intervals = {sheet.name: self._sampling_interval(sheet) for sheet in sheets}
        self._deviations = SensorDeviations(
            self._questionnaire, self.columns, self.kinds, self.decimals
        )
        self.holds = {
            column.head: self._hold_of_load(column)
            for column in self.columns
            if self._is_sampled_load(column)
        }
        self.begins = {name: self._begin_of_trial(name) for name in names}
        self.held_out = {name: self._is_held_out(name) for name in names}
        self.reference_temperature = self._reference_temperature()

    @property
    def questions(self) -> dict[tuple[str, str], list[str]]:
        """Columns and files of open questions, by option and what it expects."""
        return self._questionnaire.questions

    @property
    def assumptions(self) -> dict[tuple[str, str], dict[str, str]]:
        """Default answers that were used, by column or file, by option and what it expects."""
        return self._questionnaire.assumptions

    @property
    def assumed(self) -> str:
        """The remark on zeros and gains that nobody stated; empty if all are stated."""
        return self._deviations.assumed

    @property
    def outputs_sentence(self) -> str:
        """The outputs that a column can measure; empty if the role of every column is known."""
        if not any(option == "column" for option, _ in self.questions):
            return ""
        if self._outputs:
            return f"The model has the outputs {listing(self._outputs)}."
        return "To have the outputs of your model listed, give --model."

    def with_answer(self, option: str, subject: str, answer: str) -> "LaboratoryImport":
        """Return the import with one more answer of the user.

        Parameters
        ----------
        option : str
            The option that is answered, without dashes.
        subject : str
            The column or file that the answer is about.
        answer : str
            The answer that the user gave.
        """
        answers_to_option = {**self.answers.get(option, {}), subject: answer}
        answers = {**self.answers, option: answers_to_option}
        return LaboratoryImport(self._sheets_as_read, answers, self._quantity_of, self._outputs)

    # ---------------------------------------------------------------- files

    def _kind_of_file(self, file: str) -> str:
        """Return the kind of the trial in a file, or `NOISE` if the file is a record of noise."""
        return self._questionnaire.ask("kind", file, listing(KINDS, "or"), KINDS)

    def _only_noise_file(self) -> str | None:
        """Return the file of samples at rest, or None if there is none; refuse a second one."""
        files = [name for name, kind in self.kinds.items() if kind == NOISE]
        if len(files) > 1:
            raise CampaignFileError(
                f"Noise is read from one file, but {listing(files)} were given: give one of them."
            )
        return files[0] if files else None

    def _sheet_with_clear_dates(self, sheet: Sheet) -> Sheet:
        """Return a table with the day or the month first; ask if its dates can be read as both.

        Until the user answers, the day comes first.
        """
        if sheet.month_first is None:
            return sheet
        expected_answer = f"day or month, whichever comes first in {sheet.unclear_date}"
        answer = self._questionnaire.ask(
            "date-order", sheet.name, expected_answer, (DAY_FIRST, MONTH_FIRST)
        )
        return sheet.month_first if answer == MONTH_FIRST else sheet

    def _decimal_mark(self, sheet: Sheet) -> str:
        """Return the decimal mark of a file; ask if its numbers can be read in two ways."""
        if sheet.decimal:
            return sheet.decimal
        expected_answer = f". or ,: {sheet.unclear} can be read as both"
        return self._questionnaire.ask("decimal", sheet.name, expected_answer, (".", ","))

    def _sampling_interval(self, sheet: Sheet) -> float | None:
        """Return the sampling interval of a table [s], given the answer of the user.

        The result is None if the table has a column of times, is not recorded in time, or if the
        user has not answered yet.

        Raises
        ------
        CampaignFileError
            If the user states an interval for a table with a column of times.
        """
        columns = [column for column in self.columns if column.sheet is sheet]
        if any(column.role == "time" for column in columns):
            if self._questionnaire.stated_answer("interval", sheet.name) is not None:
                raise CampaignFileError(
                    f"{sheet.name} has a column of times, but --interval was given for it, too: "
                    "leave one of them out."
                )
            return None
        # while the role of a column is not known, it may be the time
        roles_are_known = all(column.role for column in columns)
        if not roles_are_known or self.kinds[sheet.name] not in _RECORDED_IN_TIME:
            return None
        expected_answer = "seconds between its rows, because no column is a time"
        answer = self._questionnaire.ask("interval", sheet.name, expected_answer)
        return sampling_interval(answer) if answer else None

    def _begin_of_trial(self, file: str) -> str | None:
        """Return how a forced or driven trial begins, as the user stated it, or None.

        If the user did not state it, the default is noted as an assumption. Raises
        `CampaignFileError` if the user states it for another kind of trial.
        """
        kind = self.kinds[file]
        if kind not in (TrialKind.FORCED, TrialKind.DRIVEN):
            if self._questionnaire.stated_answer("begins", file) is not None and kind:
                raise CampaignFileError(
                    f"--begins is for forced and driven trials, but {file} is {kind}."
                )
            return None
        choices = [*map(str, Start)]
        expected_answer = (
            f"how it begins, {listing(choices, 'or')}: at rest under the first loads, at rest "
            "without loads, or in an unknown state"
        )
        answer = self._questionnaire.ask_or_assume(
            Start.SETTLED.value, "begins", file, expected_answer, choices
        )
        return None if self._questionnaire.is_assumed("begins", file) else answer

    def _is_held_out(self, file: str) -> bool:
        """Return whether a trial is held out for the proof and not fitted; no by default.

        The user is not asked if there is only one trial. Raises `CampaignFileError` if the user
        answers for a noise record or, without being asked, for a single trial.
        """
        trials = [name for name, kind in self.kinds.items() if kind != NOISE]
        is_noise = self.kinds[file] == NOISE
        is_a_choice = len(trials) > 1 or bool(self.answers.get("held-out", {}))
        if is_noise or not is_a_choice:
            if self._questionnaire.stated_answer("held-out", file) is not None:
                raise CampaignFileError(
                    f"--held-out is for trials, but {file} holds samples at rest."
                )
            return False
        expected_answer = "whether it is held out for the proof and not fitted, yes or no"
        answer = self._questionnaire.ask_or_assume(
            "no", "held-out", file, expected_answer, ("yes", "no")
        )
        return answer == "yes"

    def _release_table(self, file: str) -> dict[str, Any]:
        """Return the table `release` of a ring-down; 1 m stands in until the user answers."""
        expected_answer = (
            "displacement at which the release point was held, such as 15.5mm, or the force that "
            "held it, such as 600N"
        )
        answer = self._questionnaire.ask("release", file, expected_answer)
        return release_in_si(answer or "1m")

    def _reference_temperature(self) -> float | None:
        """Return the reference temperature [degC] that the user states.

        The result is None if no column is a temperature, or if the user has not answered yet.
        """
        if not any(column.role == "temperature" for column in self.columns):
            return None
        expected_answer = "degC, at which the model's parameters hold"
        answer = self._questionnaire.ask("reference-temperature", "", expected_answer)
        return degrees_celsius(answer) if answer else None

    # ---------------------------------------------------------------- loads

    def _is_sampled_load(self, column: LaboratoryColumn) -> bool:
        """Return whether a column is a load whose course between its samples is asked for.

        Such a load is the force of a forced trial, or an input other than a motion: motions are
        smooth.
        """
        if self.kinds[column.sheet.name] == TrialKind.FORCED:
            return column.role == "force"
        is_input = INPUT in column.role and column.quantity is not None
        return is_input and not (column.quantity is not None and column.quantity.motion_chain)

    def _hold_of_load(self, column: LaboratoryColumn) -> str | None:
        """Return the course of a load between its samples; None if the user did not state it.

        The default is then noted as assumed.
        """
        choices = [*map(str, Hold)]
        expected_answer = f"what it does between its samples, {listing(choices, 'or')}"
        answer = self._questionnaire.ask_or_assume(
            Hold.LINEAR.value, "hold", column.head, expected_answer, choices
        )
        return None if self._questionnaire.is_assumed("hold", column.head) else answer

    # ---------------------------------------------------------------- the campaign

    def campaign(self, name: str) -> Campaign:
        """Return the campaign in SI, with a sentence on the origin of each trial.

        Raises
        ------
        CampaignFileError, CampaignDataError
            If a question is open, or for the causes of `read_campaign`; lines in a message are
            those of the laboratory's files.
        """
        if self.questions:
            message = f"{missing_answers(self.questions)} {self.outputs_sentence}"
            raise CampaignFileError(message.rstrip())
        trial_files = [file for file in self.kinds if file != self._noise_file]
        content: dict[str, Any] = {
            "format": FORMAT,
            "name": name,
            "channel": self._column_tables(are_inputs=False),
            "input": self._column_tables(are_inputs=True),
            "trial": [self._trial_table(file) for file in trial_files],
            "remarks": [self.assumed] if self.assumed else [],
            "provenance": [self._origin_sentence(sheet) for sheet in self.sheets],
        }
        if self._noise_file is not None:
            content["noise"] = {"file": self._noise_file}
        if self.reference_temperature is not None:
            content["reference_temperature"] = self.reference_temperature
        tables = {sheet.name: self._text_table(sheet) for sheet in self.sheets}
        origin = hash_record([sheet.digest for sheet in self.sheets])
        section = parse_campaign(content, listing(tables))
        # remarks of the reader are left out, because reading the written campaign makes them again
        return replace(assemble_campaign(section, tables, origin), remarks=section.remarks)

    def _column_tables(self, *, are_inputs: bool) -> list[dict[str, Any]]:
        """Return the tables `[[channel]]`, or `[[input]]`, of the campaign's file.

        Raises
        ------
        CampaignFileError
            If columns of one name differ from file to file.
        """
        tables: dict[str, dict[str, Any]] = {}
        for column in self.columns:
            if column.quantity is None or (INPUT in column.role) is not are_inputs:
                continue
            table = {
                "name": column.title,
                "quantity": column.quantity.value,
                "unit": column.si,
                **self._further_keys(column),
            }
            if tables.setdefault(column.title, table) != table:
                raise CampaignFileError(
                    f"{column.title!r} has another quantity or unit in {column.sheet.name} than in "
                    "another file: rename one."
                )
        return [*tables.values()]

    def _further_keys(self, column: LaboratoryColumn) -> dict[str, Any]:
        """Return the keys of a channel's or input's table other than name, quantity and unit."""
        keys: dict[str, Any] = {}
        if column.is_channel:
            keys["output"] = column.role
            keys["gain_deviation"] = self._deviations.gains[column.head]
        else:
            keys["hold"] = self.holds.get(column.head)
        keys["offset_deviation"] = self._deviations.zeros[column.head]
        return {key: value for key, value in keys.items() if value is not None}

    def units(self) -> dict[str, str]:
        """Return the unit in which each channel, input and force was read.

        If files have several units for one, it is that of the first file.
        """
        return units_of_columns(self.columns, self.kinds)

    def _trial_table(self, file: str) -> dict[str, Any]:
        """Return the table `[[trial]]` that `campaign.toml` needs for the trial in a file.

        A ring-down from a force becomes a forced trial: it begins at rest under the force, which
        `_text_table` adds to its table, and which drops to zero at the release in one step.
        """
        # the course of the force between its samples
        course_of_force = None
        for column in self.columns:
            is_force = column.sheet.name == file and column.role == "force"
            if is_force and self._is_sampled_load(column):
                course_of_force = self.holds[column.head]
                break
        load_places = self.answers.get("load-place", {})
        place_in_all_files = load_places.get("")  # an answer without a file is about all of them
        optional_keys = {
            "kind": self.kinds[file],
            "release": self.releases.get(file),
            "load_place": load_places.get(file, place_in_all_files),
            "hold": course_of_force,
            "begins": self.begins[file],
            "held_out": self.held_out[file] or None,
        }
        if self._released_force(file) is not None:
            # of zero order, so that the force is not a ramp between the last sample before the
            # release and the first one after it; settled is at rest under the force
            optional_keys |= {
                "kind": TrialKind.FORCED.value,
                "release": None,
                "hold": Hold.ZERO_ORDER.value,
                "begins": Start.SETTLED.value,
            }
        stated_keys = {key: value for key, value in optional_keys.items() if value is not None}
        return {"name": _WORKBOOK_OR_SUFFIX.sub("", file, count=1), "file": file, **stated_keys}

    def _released_force(self, file: str) -> float | None:
        """Return the force [N] from which a ring-down was released; None if there was none."""
        return self.releases.get(file, {}).get("force")

    def merge_clocks_of(self, sheet: Sheet) -> MergedTable | None:
        """Merge a table with several columns of times into one with a single clock.

        The result is None if the table has fewer than two columns of times, or if questions to the
        user are open. It is computed once.

        Raises
        ------
        CampaignFileError, CampaignDataError
            For the causes of `find_clocks` and `merge_clocks`.
        """
        columns = [column for column in self.columns if column.sheet is sheet]
        time_column_count = [column.role for column in columns].count("time")
        if self.questions or time_column_count < 2:
            return None
        if sheet.name not in self._clocks:
            self._clocks[sheet.name] = merge_clocks(
                find_clocks(columns),
                self.kinds[sheet.name],
                self.decimals[sheet.name],
                self.holds,
            )
        return self._clocks[sheet.name]

    @property
    def clock_sentences(self) -> list[str]:
        """Sentences on the tables whose columns of times were merged."""
        sentences = []
        for sheet in self.sheets:
            clock = self.merge_clocks_of(sheet)
            if clock is not None:
                sentences.append(f"{sheet.name}: {clock.sentence}.")
        return sentences

    def _text_table(self, sheet: Sheet) -> TextTable:
        """Return the table of a file in SI, with one column of times if it is recorded in time.

        The table of a ring-down from a force also has a column `force`.

        Raises
        ------
        CampaignFileError
            If two of its columns have one name in the campaign.
        """
        used_columns = [
            column for column in self.columns if column.sheet is sheet and column.to_si is not None
        ]
        clock = self.merge_clocks_of(sheet)
        titles = [column.title for column in used_columns if clock is None or column.role != "time"]
        for title in titles:
            if titles.count(title) > 1:
                raise CampaignFileError(
                    f"{sheet.name} has more than one column that is {title!r}: leave one out."
                )
        columns: dict[str, tuple[str, ...]] = {}
        lines = sheet.lines
        interval = self.intervals[sheet.name]
        if clock is not None:
            columns, lines = dict(clock.cells), clock.lines
        elif interval is not None:
            columns["time"] = tuple(f"{row * interval:.15g}" for row in range(len(sheet.lines)))
        if clock is None:
            for column in used_columns:
                columns[column.title] = column.cells_in_si(self.decimals[sheet.name])
        table = TextTable(sheet.name, columns, lines, TABLE_ERRORS)
        released_force = self._released_force(sheet.name)
        if released_force is None:
            return table
        channels = [column.title for column in used_columns if column.is_channel]
        return table_of_release_by_force(table, channels, released_force)

    def _origin_sentence(self, sheet: Sheet) -> str:
        """Return the sentence on the file of a table, its columns, and its clocks."""
        used_columns = [
            column for column in self.columns if column.sheet is sheet and column.role != LEFT_OUT
        ]
        origin = origin_sentence(sheet, used_columns, self.answers.get("scale", {}))
        clock = self.merge_clocks_of(sheet)
        return origin if clock is None else f"{origin} {clock.sentence}."
