"""A laboratory's files as a campaign: what each column is, and what has still to be said."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from math import isfinite
from typing import Any

from discrepancy.campaign.clocks import OneClock, on_one_clock, own_clocks
from discrepancy.campaign.columns import (
    EXACT,
    FREE,
    INPUT,
    LEFT_OUT,
    NOISE,
    Column,
    degrees_celsius,
    gain_deviation,
    missing_answers,
    origin_of,
    possible_quantities,
    release_in_si,
    role_by_unit,
    sampling_interval,
    scaled_unit,
    units_read,
    zero_deviation,
)
from discrepancy.campaign.reading import TABLE_ERRORS, assemble
from discrepancy.campaign.records import Campaign, Hold, Quantity, Start, TrialKind
from discrepancy.campaign.schema import FORMAT, INPUT_COLUMNS, parse_campaign
from discrepancy.campaign.sheet import Sheet
from discrepancy.campaign.units import (
    LOGGER_NAMES,
    NEVER_CONVERTED,
    UNITS,
    conversion,
    conversion_of,
)
from discrepancy.errors import CampaignFileError, said
from reporting.files import hash_record
from reporting.table_file import TextTable
from reporting.words import listing

KINDS = (*TrialKind, NOISE)
OF_COLUMNS = ("column", "unit", "quantity", "scale", "zero", "gain", "hold")
"""Options that are about columns."""
OF_FILES = ("kind", "release", "load-place", "decimal", "interval", "begins", "held-out")
"""Options that are about files or, under an empty name, all of them."""
OF_ALL_COLUMNS = ("zero", "gain", "hold")
"""Options about columns that may, under an empty name, be about all of them."""
ASSUMED_ZERO, ASSUMED_GAIN = "1%", "2%"
"""How well a zero (of the largest reading) and a gain are taken to be known where nobody says it."""
_TIMED = (TrialKind.RINGDOWN, TrialKind.FORCED, TrialKind.DRIVEN, NOISE)
_SI = dict(zip(INPUT_COLUMNS, ("s", "N", "1", "degC", "1", "1", "1", "1"), strict=True))
_UNTITLED = re.compile(r".*\.xls[mx]#|\.[^.]*$")
_STRAIN = re.compile(r".*(strain|[εϵ]|m/m)")

Answers = Mapping[str, Mapping[str, str]]
"""What was said, by option and by the column or file that it is about."""


class Understanding:
    """What is known of files, and the questions that are left.

    Parameters
    ----------
    sheets : sequence of Sheet
        The files.
    answers : mapping
        By the options of `OF_COLUMNS` and `OF_FILES`, and "reference-temperature".
    quantity_of : callable, optional
        What an output of the model is, None for what is no output; left out, any name is one.

    Raises
    ------
    CampaignFileError
        An answer is about no column or file, or does not fit.
    """

    def __init__(
        self,
        sheets: Sequence[Sheet],
        answers: Answers,
        quantity_of: Callable[[str], Quantity | None] | None = None,
    ) -> None:
        self.sheets, self.answers, self._quantity_of = sheets, answers, quantity_of
        self.questions: dict[tuple[str, str], list[str]] = {}
        self.assumptions: dict[tuple[str, str], dict[str, str]] = {}
        self._clocks: dict[str, OneClock] = {}
        names = [sheet.name for sheet in sheets]
        if len({*names}) < len(names):
            raise CampaignFileError(said("sheets.one_name", names=listing(names)))
        heads = dict.fromkeys(head for sheet in sheets for head in sheet.heads)
        for options, about in ((OF_COLUMNS, [*heads]), (OF_FILES, [*names, ""])):
            for option in options:
                known = [*about, ""] if option in OF_ALL_COLUMNS else about
                for name in answers.get(option, {}).keys() - {*known}:
                    of = listing(map(repr, filter(None, known)), "or")
                    raise CampaignFileError(said("sheets.about", option=option, of=of, name=name))
        self.kinds = {name: self._said("kind", name, listing(KINDS, "or"), KINDS) for name in names}
        if len(resting := [name for name, kind in self.kinds.items() if kind == NOISE]) > 1:
            raise CampaignFileError(said("sheets.noise", files=listing(resting)))
        self.decimals = {
            sheet.name: sheet.decimal
            or self._said("decimal", sheet.name, f". or ,: {sheet.unclear} can be read as both", (".", ","))
            for sheet in sheets
        }
        self.columns = [
            self._column(sheet, head, unit)
            for sheet in sheets
            for head, unit in zip(sheet.heads, sheet.units, strict=True)
        ]
        ringing = [name for name, kind in self.kinds.items() if kind == TrialKind.RINGDOWN]
        self.releases = {name: self._release(name) for name in ringing}
        self.intervals = {sheet.name: self._interval(sheet) for sheet in sheets}
        self.zeros = {column.head: self._zero(column) for column in self._with_zero()}
        self.gains = {column.head: self._gain(column.head) for column in self.columns if column.is_channel}
        self.holds = {column.head: self._hold(column) for column in self.columns if self._is_held(column)}
        self.begins = {name: self._begins(name) for name in names}
        self.held_out = {name: self._held_out(name) for name in names}
        self.reference_temperature = None
        if any(column.role == "temperature" for column in self.columns):
            given = self._said("reference-temperature", "", "degC, at which the model's parameters hold")
            self.reference_temperature = degrees_celsius(given) if given else None

    def with_answer(self, option: str, about: str, said: str) -> "Understanding":
        """Return what is understood once a question is answered."""
        given = {**self.answers.get(option, {}), about: said}
        return Understanding(self.sheets, {**self.answers, option: given}, self._quantity_of)

    def _said(self, option: str, about: str, expected: str, choices: Collection[str] = ()) -> str:
        """Return an answer; an empty one, and a question, where there is none."""
        given = self.answers.get(option, {})
        answer = given.get(about, given.get(""))
        if answer is None:
            asked = self.questions.setdefault((option, expected), [])
            asked += [] if about in asked else [about]
        elif choices and answer not in choices:
            raise CampaignFileError(f"--{option} must be {listing(choices, 'or')}, and {answer!r} came.")
        return answer or ""

    def _said_or(
        self, default: str, option: str, about: str, expected: str, choices: Collection[str] = ()
    ) -> str:
        """Return an answer; the default, and an assumption, where there is none."""
        given = self.answers.get(option, {})
        if about not in given and "" not in given:
            self.assumptions.setdefault((option, expected), {})[about] = default
            return default
        return self._said(option, about, expected, choices)

    def _is_assumed(self, option: str, about: str) -> bool:
        return any(key[0] == option and about in names for key, names in self.assumptions.items())

    # ---------------------------------------------------------------- zeros and gains

    def _with_zero(self) -> list[Column]:
        """Return the first column of each channel or input whose unit and quantity are known."""
        first: dict[str, Column] = {}
        for column in self.columns:
            if column.quantity is not None:
                first.setdefault(column.head, column)
        return [*first.values()]

    def _zero(self, column: Column) -> float | str:
        """Return the standard deviation of a zero in SI, or "free"."""
        default = ASSUMED_ZERO if column.is_channel else EXACT
        expected = (
            f"how well its zero is known in each trial: a standard deviation such as 0.1{column.read_in} "
            f"or 1% of the largest reading, {EXACT} or {FREE}"
        )
        answer = self._said_or(default, "zero", column.head, expected)
        return zero_deviation(column, answer, self._largest(column.head))

    def _largest(self, head: str) -> float:
        """Return the largest reading of a column in all trials, in SI; zero while it cannot be read."""
        largest = 0.0
        for column in self.columns:
            if column.head == head and self.kinds[column.sheet.name] != NOISE:
                readings = (float(cell) for cell in column.in_si(self.decimals[column.sheet.name]) if cell)
                largest = max(largest, *map(abs, filter(isfinite, readings)), 0.0)
        return largest

    def _gain(self, head: str) -> float | str:
        """Return the relative standard deviation of a gain, or "free"."""
        expected = (
            f"how well its gain is known: a standard deviation such as 2%, {EXACT}, or {FREE} for a signal"
        )
        answer = self._said_or(ASSUMED_GAIN, "gain", head, expected)
        return gain_deviation(head, answer)

    @property
    def assumed(self) -> str:
        """Which zeros and gains nobody stated, and as what they are taken; empty where all are stated."""
        parts = []
        for column in self._with_zero():
            zero = self.zeros[column.head]
            if column.is_channel and self._is_assumed("zero", column.head) and not isinstance(zero, str):
                assert column.quantity is not None
                deviation = zero / conversion_of(column.quantity, column.read_in)
                parts.append(f"the zero of {column.head!r} to {deviation:.2g} {column.read_in}")
        gains = [repr(head) for head in self.gains if self._is_assumed("gain", head)]
        if gains:
            several = "gains" if gains[1:] else "gain"
            parts.append(f"the {several} of {listing(gains)} to {ASSUMED_GAIN.replace('%', ' %')}")
        if not parts:
            return ""
        return f"Zeros and gains that nobody stated are assumed to be known: {listing(parts)}."

    # ---------------------------------------------------------------- trials

    def _interval(self, sheet: Sheet) -> float | None:
        """Return the sampling interval of a table without a time [s]; None where it has one or needs none."""
        columns = [column for column in self.columns if column.sheet is sheet]
        given = self.answers.get("interval", {})
        if any(column.role == "time" for column in columns):
            if sheet.name in given:
                raise CampaignFileError(
                    f"{sheet.name} has a column of times, and --interval came for it: leave one of them out."
                )
            return None
        understood = all(column.role for column in columns)  # else one of them may be the time
        if not understood or self.kinds[sheet.name] not in _TIMED:
            return None
        answer = self._said("interval", sheet.name, "seconds between its rows, as no column is a time")
        return sampling_interval(answer) if answer else None

    def _is_held(self, column: Column) -> bool:
        """Whether it is a load that is known at samples only; motions are smooth."""
        if self.kinds[column.sheet.name] == TrialKind.FORCED:
            return column.role == "force"
        moving = column.quantity is not None and bool(column.quantity.moving)
        return INPUT in column.role and column.quantity is not None and not moving

    def _hold(self, column: Column) -> str | None:
        """Return what a load does between its samples; None where nobody said it."""
        kinds = [*map(str, Hold)]
        expected = f"what it does between its samples, {listing(kinds, 'or')}"
        answer = self._said_or(Hold.LINEAR.value, "hold", column.head, expected, kinds)
        return None if self._is_assumed("hold", column.head) else answer

    def _begins(self, file: str) -> str | None:
        """Return how a forced or driven trial begins; None where nobody said it."""
        if self.kinds[file] not in (TrialKind.FORCED, TrialKind.DRIVEN):
            if file in self.answers.get("begins", {}) and self.kinds[file]:
                raise CampaignFileError(
                    f"--begins is for forced and driven trials, and {file} is {self.kinds[file]}."
                )
            return None
        kinds = [*map(str, Start)]
        expected = (
            f"how it begins, {listing(kinds, 'or')}: at rest under what acts at first, under nothing, or not"
        )
        answer = self._said_or(Start.SETTLED.value, "begins", file, expected, kinds)
        return None if self._is_assumed("begins", file) else answer

    def _held_out(self, file: str) -> bool:
        """Return whether a trial is kept for proof."""
        trials = [name for name, kind in self.kinds.items() if kind != NOISE]
        given = self.answers.get("held-out", {})
        if self.kinds[file] == NOISE or not (trials[1:] or given):
            if file in given:
                raise CampaignFileError(f"--held-out is for trials, and {file} holds samples at rest.")
            return False
        expected = "whether it is kept for proof and not fitted, yes or no"
        return self._said_or("no", "held-out", file, expected, ("yes", "no")) == "yes"

    def _release(self, file: str) -> dict[str, Any]:
        question = "how far the point was held that was let go, such as 15.5mm"
        given = self._said("release", file, question) or "1m"
        return release_in_si(given)

    # ---------------------------------------------------------------- columns

    def _scaled(self, head: str, unit: str) -> tuple[str, str, float]:
        """Return the unit of a column's cells, that of its readings, and one cell's unit in the latter."""
        unit = self.answers.get("unit", {}).get(head, unit)
        scale = self.answers.get("scale", {}).get(head)
        return (unit, unit, 1.0) if scale is None else scaled_unit(head, unit, scale)

    def _column(self, sheet: Sheet, head: str, unit: str) -> Column:
        cell_unit, unit, factor = self._scaled(head, unit)
        column = self._column_read_in(sheet, head, unit)
        to_si = None if column.to_si is None else factor * column.to_si
        return replace(column, unit=cell_unit, read_in=unit, to_si=to_si)

    def _column_read_in(self, sheet: Sheet, head: str, unit: str) -> Column:
        """Return a column whose readings are in a unit."""
        role = self._role(sheet, head, unit)
        if not unit and role != LEFT_OUT:
            self._said("unit", head, "such as mm, kN or ms; 1 for a mere number")
        if not unit or role == LEFT_OUT:
            return Column(sheet, head, role, unit)
        try:
            if role == "temperature" and unit == "K":
                raise ValueError("a temperature must be in degC, and 'K' came")
            driven = self.kinds[sheet.name] == TrialKind.DRIVEN
            is_output = driven and self._quantity_of is not None and self._quantity_of(role) is not None
            if role == "force" and driven and not is_output:
                raise ValueError(f"a driven trial has {INPUT}NAME in the place of force")
            if role in _SI and not (role == "force" and is_output):
                kind = {"force": Quantity.FORCE, "temperature": Quantity.TEMPERATURE}.get(role)
                number = "1" if (role, unit) == ("load_factor", "g") else unit
                to_si = conversion(number, _SI[role]) if kind is None else conversion_of(kind, unit)
                return Column(sheet, head, role, unit, _SI[role], None, to_si)
            if (quantity := self._quantity(head, role, unit)) is None:
                return Column(sheet, head, role, unit)
            to_si = conversion_of(quantity, unit)
            known = LOGGER_NAMES.get(unit, unit)
            si = known if known in NEVER_CONVERTED else UNITS[quantity].si
            return Column(sheet, head, role, unit, si, quantity, to_si)
        except ValueError as cause:
            raise CampaignFileError(f"{sheet.name}, column {head!r}: {cause}; say another.") from None

    def _role(self, sheet: Sheet, head: str, unit: str) -> str:
        """Return what a column is: as said, by its name, or as the only one of a time or a force."""
        answer, called = self.answers.get("column", {}).get(head), head.casefold()
        driven = self.kinds[sheet.name] not in (TrialKind.STATIC, TrialKind.FORCED, TrialKind.RINGDOWN, NOISE)
        if answer is not None or (called in _SI and not (driven and called == "force")):
            return called if answer is None else answer
        units = [self._scaled(*pair)[1] for pair in zip(sheet.heads, sheet.units, strict=True)]
        if role := role_by_unit(head, sheet.heads, units, ("time",) if driven else ("time", "force")):
            return role
        if self._quantity_of is not None and self._quantity_of(head) is not None:
            return head
        what = f"{', '.join(INPUT_COLUMNS[:4])}, {INPUT}NAME, or {LEFT_OUT} to leave it out"
        return self._said("column", head, f"the model's output that it measures, {what}")

    def _quantity(self, head: str, role: str, unit: str) -> Quantity | None:
        """Return the quantity of a channel or an input, None while that is open."""
        able = possible_quantities(unit, self.answers.get("quantity", {}).get(head))
        if self._quantity_of is not None and role and INPUT not in role:
            modelled = self._quantity_of(role)
            if modelled is None:
                raise ValueError(f"the model has no output {role!r}")
            able = (modelled,) if modelled in able else able
        if len(able) == 1 or able[0] is Quantity.DISPLACEMENT or _STRAIN.fullmatch(unit):
            return able[0]
        self._said("quantity", head, f"{listing(able, 'or')}: {unit} is a unit of each")
        return None

    # ---------------------------------------------------------------- the campaign

    def campaign(self, name: str) -> Campaign:
        """Return the campaign, in SI; a remark says where each trial came from.

        Raises
        ------
        CampaignFileError, CampaignDataError
            A question is open, or as `read_campaign`; lines are those of the files that were given.
        """
        if self.questions:
            raise CampaignFileError(missing_answers(self.questions))
        channels: dict[str, dict[str, Any]] = {}
        inputs: dict[str, dict[str, Any]] = {}
        for item in self.columns:
            if item.quantity is not None:
                what = {"name": item.title, "quantity": item.quantity.value, "unit": item.si}
                what |= self._stated(item)
                if (inputs if INPUT in item.role else channels).setdefault(item.title, what) != what:
                    raise CampaignFileError(f"{item.title!r} is something else in {item.sheet.name}.")
        content: dict[str, Any] = {
            "format": FORMAT, "name": name, "channel": [*channels.values()], "input": [*inputs.values()],
            "trial": [self._trial(file) for file, kind in self.kinds.items() if kind != NOISE],
            "remarks": [*(self._origin(sheet) for sheet in self.sheets), *filter(None, [self.assumed])],
        }  # fmt: skip
        if resting := [file for file, kind in self.kinds.items() if kind == NOISE]:
            content["noise"] = {"file": resting[0]}
        if self.reference_temperature is not None:
            content["reference_temperature"] = self.reference_temperature
        tables = {sheet.name: self._table(sheet) for sheet in self.sheets}
        origin = hash_record([sheet.digest for sheet in self.sheets])
        section = parse_campaign(content, listing(tables))
        # whoever reads what is written remarks on it as it is by then
        return replace(assemble(section, tables, origin), remarks=section.remarks)

    def _stated(self, column: Column) -> dict[str, Any]:
        """Return what `[[channel]]` or `[[input]]` says of a column beside its name, quantity and unit."""
        stated: dict[str, Any] = {"hold": self.holds.get(column.head)}
        if column.is_channel:
            stated = {"output": column.role, "gain_deviation": self.gains[column.head]}
        stated["offset_deviation"] = self.zeros[column.head]
        return {key: value for key, value in stated.items() if value is not None}

    def units(self) -> dict[str, str]:
        """Return the unit in which each channel, input and force was read, of several the first."""
        return units_read(self.columns, self.kinds)

    def _trial(self, file: str) -> dict[str, Any]:
        places = self.answers.get("load-place", {})
        holds = [
            self.holds[column.head]
            for column in self.columns
            if column.sheet.name == file and column.role == "force" and self._is_held(column)
        ]
        known = {
            "release": self.releases.get(file),
            "load_place": places.get(file, places.get("")),
            "hold": holds[0] if holds else None,
            "begins": self.begins[file],
            "held_out": self.held_out[file] or None,
        }
        given = {key: value for key, value in known.items() if value is not None}
        return {"name": _UNTITLED.sub("", file), "kind": self.kinds[file], "file": file, **given}

    def clock_of(self, sheet: Sheet) -> OneClock | None:
        """Return a table with several columns of times on one clock; None with one column, or with questions.

        Raises
        ------
        CampaignFileError, CampaignDataError
            As `own_clocks` and `on_one_clock`.
        """
        columns = [column for column in self.columns if column.sheet is sheet]
        if self.questions or [column.role for column in columns].count("time") < 2:
            return None
        if sheet.name not in self._clocks:
            kind, decimal = self.kinds[sheet.name], self.decimals[sheet.name]
            self._clocks[sheet.name] = on_one_clock(own_clocks(columns), kind, decimal, self.holds)
        return self._clocks[sheet.name]

    @property
    def clock_sentences(self) -> list[str]:
        """How tables with several columns of times come to one."""
        clocks = {sheet.name: self.clock_of(sheet) for sheet in self.sheets}
        return [f"{name}: {clock.sentence}." for name, clock in clocks.items() if clock is not None]

    def _table(self, sheet: Sheet) -> TextTable:
        """Return the table of a trial in SI."""
        used = [item for item in self.columns if item.sheet is sheet and item.to_si is not None]
        clock = self.clock_of(sheet)
        titles = [item.title for item in used if clock is None or item.role != "time"]
        if twice := next((title for title in titles if titles.count(title) > 1), None):
            raise CampaignFileError(said("sheets.twice", file=sheet.name, title=twice))
        if clock is not None:
            return TextTable(sheet.name, clock.cells, clock.lines, TABLE_ERRORS)
        columns = {item.title: item.in_si(self.decimals[sheet.name]) for item in used}
        interval = self.intervals[sheet.name]
        if interval is not None:
            stamps = tuple(f"{row * interval:.15g}" for row in range(len(sheet.lines)))
            columns = {"time": stamps, **columns}
        return TextTable(sheet.name, columns, sheet.lines, TABLE_ERRORS)

    def _origin(self, sheet: Sheet) -> str:
        used = [item for item in self.columns if item.sheet is sheet and item.role != LEFT_OUT]
        clock = self.clock_of(sheet)
        on_one_clock = f" {clock.sentence}." if clock is not None else ""
        return origin_of(sheet, used, self.answers.get("scale", {})) + on_one_clock
