"""What each column of a laboratory's table is: its role, unit and quantity."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from discrepancy.campaign.answers import Questionnaire
from discrepancy.campaign.columns import (
    INPUT,
    LEFT_OUT,
    NOISE,
    LaboratoryColumn,
    possible_quantities,
    role_by_unit,
    scaled_unit,
)
from discrepancy.campaign.heads import load_or_time_role
from discrepancy.campaign.records import Quantity, TrialKind
from discrepancy.campaign.schema import INPUT_COLUMNS
from discrepancy.campaign.sheet import Sheet
from discrepancy.campaign.units import (
    DEGREES,
    FAHRENHEIT,
    LETTERS_OF_DEGREES,
    NEVER_CONVERTED,
    UNITS,
    conversion_factor,
    factor_to_si,
    usual_name,
)
from discrepancy.errors import CampaignFileError
from reporting.words import listing

_UNITS_OF_INPUT_COLUMNS = dict(
    zip(INPUT_COLUMNS, ("s", "N", "1", "degC", "1", "1", "1", "1"), strict=True)
)
"""The SI unit of each column that every table may have, by the role of the column."""
_STRAIN = re.compile(r".*(strain|[εϵ]|m/m)")
"""Units that only a strain has, such as microstrain, µε or m/m."""

OutputQuantity = Callable[[str], Quantity | None]
"""Maps the name of a model's output to its quantity, and any other name to None."""


class ColumnReader:
    """Determines role, unit and quantity of columns, and asks the user if they are not clear.

    Parameters
    ----------
    questionnaire : Questionnaire
        The answers of the user; it notes the questions that stay open.
    kinds : mapping of str to str
        The kind of trial of each file, by the name of the file.
    quantity_of : callable or None
        Returns the quantity of a model's output. Without it any name can be that of an output.
    outputs : sequence of str
        The model's outputs with quantity and unit, as a refusal lists them.
    """

    def __init__(
        self,
        questionnaire: Questionnaire,
        kinds: Mapping[str, str],
        quantity_of: OutputQuantity | None,
        outputs: Sequence[str] = (),
    ) -> None:
        self.kinds = kinds
        self._questionnaire = questionnaire
        self._quantity_of = quantity_of
        self._outputs = outputs

    def read_column(self, sheet: Sheet, head: str, unit: str) -> LaboratoryColumn:
        """Return the record of a table's column; what is not clear becomes a question to the user.

        As long as the unit or the quantity is not known, the factor `to_si` of the record is None.

        Parameters
        ----------
        sheet : Sheet
            The table.
        head : str
            The name of the column as printed at its head.
        unit : str
            The unit that the file states, or an empty text; the option `--unit` replaces it.
        """
        cell_unit, reading_unit, factor = self._scaled_unit(head, unit)
        column = self._column_of_readings(sheet, head, reading_unit)
        if column.to_si is None:
            return replace(column, unit=cell_unit, read_in=reading_unit)
        return replace(
            column,
            unit=cell_unit,
            # the letters F and C of a temperature became degF and degC
            read_in=column.unit if column.quantity is Quantity.TEMPERATURE else reading_unit,
            to_si=factor * column.to_si,
            cell_at_zero=column.cell_at_zero / factor,
        )

    def _scaled_unit(self, head: str, unit: str) -> tuple[str, str, float]:
        """Return the unit of a column's cells, that of its readings, and the factor between them.

        The option `--unit` replaces the unit of the file. Units differ, and the factor is not 1,
        only with an option `--scale`.
        """
        stated_unit = self._questionnaire.stated_answer("unit", head)
        unit = unit if stated_unit is None else stated_unit
        scale = self._questionnaire.stated_answer("scale", head)
        if scale is None:
            return unit, unit, 1.0
        return scaled_unit(head, unit, scale)

    def _column_of_readings(self, sheet: Sheet, head: str, unit: str) -> LaboratoryColumn:
        """Return the record of a column, as if its cells were readings without a scale.

        If its role or unit is not known, the user is asked for it. Then, and also if the column is
        left out, the record has no SI unit.
        """
        role = self._determine_role(sheet, head, unit)
        self._check_role(sheet, head, role)
        if not unit and role != LEFT_OUT:
            self._questionnaire.ask("unit", head, "such as mm, kN or ms; 1 for a plain number")
        may_be_a_time = not role and load_or_time_role(unit) == "time"
        if not unit or role == LEFT_OUT or may_be_a_time:
            return LaboratoryColumn(sheet, head, role, unit)
        try:
            is_driven = self.kinds[sheet.name] == TrialKind.DRIVEN
            is_output = is_driven and self._output_quantity(role) is not None
            if role == "force" and is_driven and not is_output:
                raise ValueError(f"a driven trial has {INPUT}NAME in the place of force")
            if role in _UNITS_OF_INPUT_COLUMNS and not (role == "force" and is_output):
                return _column_of_table(sheet, head, role, unit)
            return self._channel_or_input(sheet, head, role, unit)
        except ValueError as cause:
            raise CampaignFileError(
                f"{sheet.name}, column {head!r}: {cause}; choose another."
            ) from None

    def _channel_or_input(self, sheet: Sheet, head: str, role: str, unit: str) -> LaboratoryColumn:
        """Return the record of a table column that is a channel or an input.

        If its quantity cannot be determined yet, the quantity and the SI unit stay empty, and the
        user is asked for the quantity.
        """
        stated_quantity = self._questionnaire.stated_answer("quantity", head)
        if Quantity.TEMPERATURE in (self._output_quantity(role), stated_quantity):
            unit = LETTERS_OF_DEGREES.get(unit, unit)
        quantity = self._determine_quantity(head, role, unit)
        if quantity is None:
            return LaboratoryColumn(sheet, head, role, unit)
        if usual_name(unit) == FAHRENHEIT:
            return replace(_temperature_in_celsius(sheet, head, role, unit), quantity=quantity)
        usual_unit = usual_name(unit)
        return LaboratoryColumn(
            sheet=sheet,
            head=head,
            role=role,
            unit=unit,
            si=usual_unit if usual_unit in NEVER_CONVERTED else UNITS[quantity].si,
            quantity=quantity,
            to_si=factor_to_si(quantity, unit),
        )

    def _check_role(self, sheet: Sheet, head: str, role: str) -> None:
        """Raise an error if the role of a column is neither an input nor an output of the model.

        Without a role yet, or without a model, nothing is checked. A wrong role is refused before
        the user is asked for the unit of the column.
        """
        if not role or self._quantity_of is None:
            return
        names_an_input = role in _UNITS_OF_INPUT_COLUMNS or INPUT in role
        if names_an_input or role == LEFT_OUT:
            return
        if self._output_quantity(role) is None:
            available_outputs = f"; it has {listing(self._outputs)}" if self._outputs else ""
            raise CampaignFileError(
                f"{sheet.name}, column {head!r}: the model has no output "
                f"{role!r}{available_outputs}; choose another."
            )

    def _output_quantity(self, role: str) -> Quantity | None:
        """Return the quantity of a model output; None if it does not exist or there is no model."""
        return None if self._quantity_of is None else self._quantity_of(role)

    def _determine_role(self, sheet: Sheet, head: str, unit: str) -> str:
        """Return the role of a column: time, an input, or the model output that it measures.

        The first of these that is known decides:

        - the answer of the user;
        - the head, if it is the name of an input;
        - the unit, if this is the only column with a unit of time (or of force);
        - the head, if it is the name of an output of the model.

        Otherwise the user is asked, and the result is empty.
        """
        answer = self._questionnaire.stated_answer("column", head)
        if answer is not None:
            return answer
        reads_force = self.kinds[sheet.name] in (
            TrialKind.STATIC,
            TrialKind.FORCED,
            TrialKind.RINGDOWN,
            NOISE,
        )
        name = head.casefold()
        if name in _UNITS_OF_INPUT_COLUMNS and (reads_force or name != "force"):
            return name
        units = []
        for other_head, other_unit in zip(sheet.heads, sheet.units, strict=True):
            _, reading_unit, _ = self._scaled_unit(other_head, other_unit)
            units.append(reading_unit)
        decided_by_unit = ("time", "force") if reads_force else ("time",)
        role = role_by_unit(head, sheet.heads, units, decided_by_unit)
        if role:
            return role
        if self._output_quantity(head) is not None:
            return head
        other_roles = f"{', '.join(INPUT_COLUMNS[:4])}, {INPUT}NAME, or {LEFT_OUT} to leave it out"
        expected_answer = f"the model's output that it measures, {other_roles}"
        return self._questionnaire.ask("column", head, expected_answer)

    def _determine_quantity(self, head: str, role: str, unit: str) -> Quantity | None:
        """Return the quantity that a channel or an input measures.

        The candidates are the quantities with this unit, or the answer of the user. If the quantity
        of the model's output is one of them, it is taken. Otherwise a length is a displacement, and
        what has a unit of strain is a strain. If several candidates remain, the user is asked, and
        the result is None.
        """
        answer = self._questionnaire.stated_answer("quantity", head)
        quantities = possible_quantities(unit, answer)
        if self._quantity_of is not None and role and INPUT not in role:
            modelled = self._quantity_of(role)
            if modelled is not None and modelled in quantities:
                quantities = (modelled,)
        # a displacement rather than a level, and a strain rather than a plain number
        is_usual = quantities[0] is Quantity.DISPLACEMENT or _STRAIN.fullmatch(unit)
        if len(quantities) == 1 or is_usual:
            return quantities[0]
        expected_answer = f"{listing(quantities, 'or')}: {unit} is a unit of each"
        self._questionnaire.ask("quantity", head, expected_answer)
        return None


def _column_of_table(sheet: Sheet, head: str, role: str, unit: str) -> LaboratoryColumn:
    """Return the record of a column that every table may have, such as a time or a force.

    Raises `ValueError` if the column cannot have this unit, such as a time in newtons.
    """
    if role == "temperature":
        return _temperature_in_celsius(sheet, head, role, LETTERS_OF_DEGREES.get(unit, unit))
    si = _UNITS_OF_INPUT_COLUMNS[role]
    if role == "force":
        to_si = factor_to_si(Quantity.FORCE, unit)
    elif role == "load_factor" and unit == "g":
        to_si = 1.0
    else:
        to_si = conversion_factor(unit, si)
    return LaboratoryColumn(sheet, head, role, unit, si, to_si=to_si)


def _temperature_in_celsius(sheet: Sheet, head: str, role: str, unit: str) -> LaboratoryColumn:
    """Return the record of a column of temperatures in any unit; its SI unit is degC.

    Raises `ValueError` if the unit is not one of temperature.
    """
    to_celsius = factor_to_si(Quantity.TEMPERATURE, unit)
    _, reading_at_zero = DEGREES[usual_name(unit)]
    return LaboratoryColumn(
        sheet=sheet,
        head=head,
        role=role,
        unit=unit,
        si=UNITS[Quantity.TEMPERATURE].si,
        to_si=to_celsius,
        cell_at_zero=reading_at_zero,
    )
