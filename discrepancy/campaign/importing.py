"""A laboratory's files as a campaign: what each column is, and what has still to be said."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from discrepancy.campaign.reading import TABLE_ERRORS, assemble
from discrepancy.campaign.records import Campaign, Quantity, TrialKind
from discrepancy.campaign.sampling import as_meant
from discrepancy.campaign.schema import FORMAT, INPUT_COLUMNS, parse_campaign
from discrepancy.campaign.sheet import Sheet
from discrepancy.campaign.units import (
    LOGGER_NAMES,
    NEVER_CONVERTED,
    UNITS,
    conversion,
    conversion_of,
    quantities_of,
)
from discrepancy.errors import CampaignFileError, said
from reporting.files import hash_record
from reporting.table_file import TextTable
from reporting.words import be, counted, listing

NOISE, LEFT_OUT, INPUT = "noise", "-", "input:"
"""Kind of a file of samples at rest, role of a column that is left out, and how that of an input begins."""
KINDS = (*TrialKind, NOISE)
OF_COLUMNS, OF_FILES = ("column", "unit", "quantity"), ("kind", "release", "load-place", "decimal")
"""Options that are about columns, and about files or (under an empty name) all of them."""
_SI = dict(zip(INPUT_COLUMNS, ("s", "N", "1", "degC", "1", "1", "1", "1"), strict=True))
_UNTITLED = re.compile(r".*\.xls[mx]#|\.[^.]*$")
_HELD = (Quantity.DISPLACEMENT, Quantity.SIGNAL)
_STRAIN = re.compile(r".*(strain|[εϵ]|m/m)")

Answers = Mapping[str, Mapping[str, str]]
"""What was said, by option and by the column or file that it is about."""


@dataclass(frozen=True)
class Column:
    """A column as it is understood; None and empty texts where a question is open.

    Attributes
    ----------
    sheet : Sheet
        Where it is from.
    head : str
        Its name, without a unit.
    role : str
        `LEFT_OUT`, a column that every table may have (`time`, `force`), `INPUT` and a name, or an output.
    unit, si : str
        As written or said, and in SI.
    quantity : Quantity or None
        Of a channel or an input.
    to_si : float or None
        What one of the unit is in SI.
    """

    sheet: Sheet
    head: str
    role: str
    unit: str
    si: str = ""
    quantity: Quantity | None = None
    to_si: float | None = None

    @property
    def title(self) -> str:
        """Its name in the campaign."""
        return self.head if self.quantity and INPUT not in self.role else self.role.removeprefix(INPUT)

    def in_si(self, decimal: str) -> tuple[str, ...]:
        """Return its cells in SI, empty where too little is known."""
        if self.to_si is None or not decimal:
            return ("",) * len(self.sheet.lines)
        cells = self.sheet.numbers(self.head, decimal)
        if self.to_si == 1.0:
            return cells
        values = np.array([float(cell or "nan") for cell in cells])
        if self.role == "time" and len(cells) > 1 and np.all(np.diff(values) > 0.0):
            values = as_meant(values, cells)  # minutes of few digits may be even
        # two digits less than a float may need, so that no rounding shows: 4.387 mm is 0.004387 m
        shown = (f"{value * self.to_si:.15g}" for value in values.tolist())
        return tuple(cell and text for cell, text in zip(cells, shown, strict=True))


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
        names = [sheet.name for sheet in sheets]
        if len({*names}) < len(names):
            raise CampaignFileError(said("sheets.one_name", names=listing(names)))
        heads = dict.fromkeys(head for sheet in sheets for head in sheet.heads)
        for options, known in ((OF_COLUMNS, [*heads]), (OF_FILES, [*names, ""])):
            for option in options:
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
        self.reference_temperature = None
        if any(column.role == "temperature" for column in self.columns):
            given = self._said("reference-temperature", "", "degC, at which the model's parameters hold")
            try:
                self.reference_temperature = float(given) if given else None
            except ValueError:
                raise CampaignFileError(said("sheets.no_temperature", came=given)) from None

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

    def _release(self, file: str) -> dict[str, Any]:
        question = "how far the point was held that was let go, such as 15.5mm"
        given = self._said("release", file, question) or "1m"
        if found := re.fullmatch(r"\s*([-+]?\d+\.?\d*(?:e[-+]?\d+)?)\s*(\S+)\s*", given, re.ASCII):
            for quantity in (item for item in _HELD if item in quantities_of(found[2])):
                size = float(found[1]) * conversion_of(quantity, found[2])
                return {"displacement": size, "unit": UNITS[quantity].si}
        raise CampaignFileError(said("campaign.release", given=given))

    # ---------------------------------------------------------------- columns

    def _column(self, sheet: Sheet, head: str, unit: str) -> Column:
        unit = self.answers.get("unit", {}).get(head, unit)
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
        units = self.answers.get("unit", {})
        kinds = [_kind(units.get(*pair)) for pair in zip(sheet.heads, sheet.units, strict=True)]
        if kinds.count(_kind(unit)) == 1 and _kind(unit) in (("time",) if driven else ("time", "force")):
            return _kind(unit)
        if self._quantity_of is not None and self._quantity_of(head) is not None:
            return head
        what = f"{', '.join(INPUT_COLUMNS[:4])}, {INPUT}NAME, or {LEFT_OUT} to leave it out"
        return self._said("column", head, f"the model's output that it measures, {what}")

    def _quantity(self, head: str, role: str, unit: str) -> Quantity | None:
        """Return the quantity of a channel or an input, None while that is open."""
        answer = self.answers.get("quantity", {}).get(head)
        if answer is not None and answer not in list(Quantity):
            raise ValueError(f"a quantity is {listing(Quantity, 'or')}, and {answer!r} came")
        able = quantities_of(unit) if answer is None else (Quantity(answer),)
        if not able:
            raise ValueError(f"{unit!r} is no unit of a quantity that is measured here")
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
            count = sum(map(len, self.questions.values()))
            options = [
                f"--{option} {f'NAME=... for {listing(map(repr, of))}' if of[0] else '...'} ({expected})"
                for (option, expected), of in self.questions.items()
            ]
            missing = f"{counted(count, 'answer')} {be(count)} missing, and nothing was written"
            raise CampaignFileError(f"{missing}: give {'; '.join(options)}.")
        channels: dict[str, dict[str, Any]] = {}
        inputs: dict[str, dict[str, Any]] = {}
        for item in self.columns:
            if item.quantity is not None:
                what = {"name": item.title, "quantity": item.quantity.value, "unit": item.si}
                what |= {} if INPUT in item.role else {"output": item.role}
                if (inputs if INPUT in item.role else channels).setdefault(item.title, what) != what:
                    raise CampaignFileError(f"{item.title!r} is something else in {item.sheet.name}.")
        content: dict[str, Any] = {
            "format": FORMAT, "name": name, "channel": [*channels.values()], "input": [*inputs.values()],
            "trial": [self._trial(file) for file, kind in self.kinds.items() if kind != NOISE],
            "remarks": [self._origin(sheet) for sheet in self.sheets],
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

    def _trial(self, file: str) -> dict[str, Any]:
        places = self.answers.get("load-place", {})
        known = {"release": self.releases.get(file), "load_place": places.get(file, places.get(""))}
        given = {key: value for key, value in known.items() if value is not None}
        return {"name": _UNTITLED.sub("", file), "kind": self.kinds[file], "file": file, **given}

    def _table(self, sheet: Sheet) -> TextTable:
        """Return the table of a trial in SI."""
        used = [item for item in self.columns if item.sheet is sheet and item.to_si is not None]
        titles = [item.title for item in used]
        if twice := next((title for title in titles if titles.count(title) > 1), None):
            raise CampaignFileError(said("sheets.twice", file=sheet.name, title=twice))
        columns = {item.title: item.in_si(self.decimals[sheet.name]) for item in used}
        return TextTable(sheet.name, columns, sheet.lines, TABLE_ERRORS)

    def _origin(self, sheet: Sheet) -> str:
        used = [item for item in self.columns if item.sheet is sheet and item.role != LEFT_OUT]
        columns = listing(f"{item.head!r} [{item.unit}] is {item.role}" for item in used)
        empty = sum(sheet.columns[sheet.heads.index(item.head)].count("") for item in used)
        left = f"; {counted(empty, 'cell')} {be(empty)} empty" if empty else ""
        return f"Imported from {sheet.name} (SHA-256 {sheet.digest}), {sheet.remark}: {columns}{left}."


def _kind(unit: str) -> str:
    """Return "time" or "force" where a unit is one of them."""
    try:
        return "time" if conversion(unit, "s") else ""
    except ValueError:
        return "force" if Quantity.FORCE in quantities_of(unit) else ""
