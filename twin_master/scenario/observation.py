"""The table of a scenario that says what is observed, and how well."""

from collections.abc import Mapping
from typing import ClassVar, Literal, Self

from pydantic import model_validator

from twin_master.scenario.modes import ROLE, ModesSection, row_width
from twin_master.scenario.section import (
    Count,
    Name,
    NotNegative,
    PerSensor,
    Section,
    check_one_or_each,
)


class ObservationSection(Section):
    """What is observed (a role of the binding) and the sensor noise that the twin assumes."""

    units: ClassVar[Mapping[str, str]] = {"standard_deviation": "microstrain", "model_error": "percent"}
    role: Name = "strain"
    count: Count
    titles: tuple[str, ...] = ()
    """What each sensor is called in the report; without them they have numbers."""
    unit: str | tuple[str, ...] = "1"
    """Unit of the observed values, one for all sensors or one for each; a strain without unit is printed in
    microstrain."""
    standard_deviation: PerSensor
    """Of the noise that the twin assumes, one for all sensors or one for each."""
    model_error: NotNegative | tuple[NotNegative, ...] = 0.0
    """Standard deviation of the predicted value as a share of it, one for all sensors or one for each; added
    to the noise in quadrature."""
    between_levels: bool = True
    """Whether the truth may lie between the levels of the states, which then stand for intervals."""
    average_over_draws: Literal["outside", "inside"] = "outside"
    """Where the average over the draws of the parameter stands: outside the product over the sensors as in
    the integral (30), or inside it as eq. (32) is printed."""
    modes: ModesSection | None = None
    """With the role `modes`: what is observed; count, titles, unit and standard deviation follow from it."""

    @model_validator(mode="before")
    @classmethod
    def _of_modes(cls, table: object) -> object:
        """Fill in what follows from the modes that are observed."""
        if not isinstance(table, Mapping):
            return table
        if (table.get("role") == ROLE) != (table.get("modes") is not None):
            raise ValueError(
                f"the role `{ROLE}` needs the table `observation.modes`, and that needs the role"
            )
        if table.get("modes") is None:
            return table
        modes = ModesSection.model_validate(table["modes"])
        filled = modes.filled()
        for key in table:
            base, _ = cls.split_unit(key)
            given = tuple(table[key]) if isinstance(table[key], list) else table[key]
            if base in filled and given != filled[base]:
                raise ValueError(f"`{key}` follows from `observation.modes`: leave it out")
        return {**table, **filled, "modes": modes}

    @property
    def width(self) -> int:
        """Length of the row that comes of a turn: values, and their covariance where it comes with them."""
        return self.count if self.modes is None else row_width(self.count)

    @property
    def sensor_units(self) -> tuple[str, ...]:
        """Unit of each sensor."""
        return (self.unit,) * self.count if isinstance(self.unit, str) else self.unit

    @model_validator(mode="after")
    def _check(self) -> Self:
        for key, value in (("unit", self.unit), ("standard_deviation", self.standard_deviation)):
            check_one_or_each(f"observation.{key}", value, self.count)
        if self.titles:
            check_one_or_each("observation.titles", self.titles, self.count)
        return self
