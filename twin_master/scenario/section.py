"""The base class of all tables of a scenario file, and the types of their values.

A key may carry its unit in its name (`levels_percent`); the value is converted to SI.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar, TypeAlias

from pydantic import AfterValidator, ConfigDict, Field, GetJsonSchemaHandler, model_validator
from pydantic_core import CoreSchema

from reporting.choices import nearest_word
from reporting.formats import toml_file
from reporting.formats.toml_file import Check, Positive, missing_keys, short_repr
from reporting.json_file import JsonDocument

Table: TypeAlias = toml_file.TomlTable
"""A table of a TOML or JSON file before it is checked: values of any type by key."""

_BOUNDS_OF_SCHEMA = ("minimum", "maximum", "exclusiveMinimum", "exclusiveMaximum", "default")
"""Keys of a JSON Schema whose numbers are in the unit of the value."""

UNIT_DIVISOR = {"percent": 100.0, "microstrain": 1.0e6, "microstrain_per_step": 1.0e6}
"""The divisor that converts a value in a unit to SI."""

LARGEST_COUNT = 1_000_000
"""Largest number of steps, draws or sensors; longer arrays do not fit in memory."""
LARGEST_SEED = 2**63 - 1
"""The largest integer that the files of a run can hold."""


def _limit_validator(limit: int, reason: str) -> AfterValidator:
    """Return a validator that refuses numbers above a limit, and states the reason."""

    def check(value: int) -> int:
        if value > limit:
            raise ValueError(
                f"a number of at most {limit} is expected, {reason}, but {short_repr(value)} was "
                "given"
            )
        return value

    return AfterValidator(check)


PerSensor = Positive | tuple[Positive, ...]
"""One positive number for all sensors, or one for each."""
Probability = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0, le=1.0)]
_AT_MOST_LARGEST_COUNT = _limit_validator(LARGEST_COUNT, "as the twin has arrays of that length")
_LARGEST_COUNT_IN_SCHEMA = {"maximum": LARGEST_COUNT}
Count = Annotated[
    int,
    Field(strict=True, ge=1, json_schema_extra=_LARGEST_COUNT_IN_SCHEMA),
    _AT_MOST_LARGEST_COUNT,
]
Step = Annotated[
    int,
    Field(strict=True, ge=0, json_schema_extra=_LARGEST_COUNT_IN_SCHEMA),
    _AT_MOST_LARGEST_COUNT,
]
Seed = Annotated[
    int,
    Field(strict=True, ge=0),
    _limit_validator(LARGEST_SEED, "as the files of a run hold no larger integer"),
]
Flag = Annotated[bool, Field(strict=True)]
Name = Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9_.\-]+$")]


class Section(toml_file.Section):
    """A table of the file: unknown keys are refused, and a unit in a key's name is converted."""

    model_config = ConfigDict(strict=False)
    units: ClassVar[Mapping[str, str]] = {}
    """The unit that a key may carry in its name, by key."""
    filled_in: ClassVar[tuple[str, ...]] = ()
    """Required keys that a file may leave out, because they then follow from others."""

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> Table:
        """Return the JSON Schema of the table in a file, where keys may carry their units."""
        schema = handler(core_schema)
        table = handler.resolve_ref_schema(schema)
        if "properties" in table:
            _add_keys_with_units(table, cls.units)
            _relax_required_keys(table, {*cls.filled_in})
        return schema

    @model_validator(mode="before")
    @classmethod
    def _convert_units(cls, table: object) -> object:
        """Remove the units from the names of the keys, and convert the values to SI."""
        if not isinstance(table, Mapping):
            return table
        converted: dict[str, object] = {}
        for key, value in table.items():
            field, unit = cls.split_unit(str(key))
            if field not in cls.model_fields:
                known_keys = ", ".join(cls._documented_key(name) for name in cls.model_fields)
                keys_with_units = [f"{name}_{unit}" for name, unit in cls.units.items()]
                nearest_key = nearest_word(str(key), [*cls.model_fields, *keys_with_units])
                advice = "" if nearest_key is None else f"; the nearest is `{nearest_key}`"
                raise ValueError(
                    f"unknown key `{key}`; the keys known there are {known_keys}{advice}"
                )
            if field in converted:
                raise ValueError(f"`{field}` was given with and without its unit: keep one of them")
            if unit == "percent":
                _check_percentage(key, value)
            converted[field] = _convert_to_si(value, UNIT_DIVISOR[unit]) if unit else value
        cls._check_required_keys(converted)
        return converted

    @classmethod
    def _check_required_keys(cls, table: Mapping[str, object]) -> None:
        """Refuse a table that lacks a required key, if a missing key may carry a unit.

        Otherwise Pydantic refuses the table. It does not know the units, which the message here
        names: `levels[_percent]`.
        """
        missing = []
        for key, field in cls.model_fields.items():
            if field.is_required() and key not in table:
                missing.append(key)
        may_carry_unit = any(key in cls.units for key in missing)
        if may_carry_unit:
            documented_keys = [cls._documented_key(key) for key in missing]
            raise missing_keys(documented_keys, f"`{documented_keys[0]}` is missing")

    @classmethod
    def _documented_key(cls, name: str) -> str:
        """Return a key for a message, with the unit that it may carry: `levels[_percent]`."""
        return f"{name}[_{cls.units[name]}]" if name in cls.units else name

    @classmethod
    def split_unit(cls, key: str) -> tuple[str, str]:
        """Return the key without its unit, and the unit; an empty text for a key without one."""
        for field, unit in cls.units.items():
            if key == f"{field}_{unit}":
                return field, unit
        return key, ""


def _add_keys_with_units(table: Table, units: Mapping[str, str]) -> None:
    """Add to the JSON Schema of a table the keys that have a unit in their names.

    `units` has the unit of each key that has one; a key `length` in mm gives `length_mm`.
    """
    properties: Table = {}
    alternatives = []
    for key, key_schema in table["properties"].items():
        properties[key] = key_schema
        if key not in units:
            continue
        key_with_unit = f"{key}_{units[key]}"
        unit_text = units[key].replace("_per_", " per ")
        scaled_schema = _schema_in_unit(key_schema, UNIT_DIVISOR[units[key]])
        properties[key_with_unit] = {**scaled_schema, "unit": unit_text, "same_as": key}
        if key in table.get("required", ()):
            alternatives.append({"anyOf": [{"required": [key]}, {"required": [key_with_unit]}]})
    table["properties"] = properties
    if alternatives:
        table["allOf"] = alternatives
        _relax_required_keys(table, {*units})


def _relax_required_keys(table: Table, keys: set[str]) -> None:
    """Remove keys from the required ones of the JSON Schema of a table."""
    if "required" in table:
        table["required"] = [key for key in table["required"] if key not in keys]


def _schema_in_unit(schema: JsonDocument, divisor: float) -> JsonDocument:
    """Convert the limits in the JSON Schema of a value from SI to another unit.

    Parameters
    ----------
    divisor : float
        The divisor that converts a value in the unit to SI.
    """
    if isinstance(schema, list):
        return [_schema_in_unit(entry, divisor) for entry in schema]
    if not isinstance(schema, dict):
        return schema
    schema_in_unit: Table = {}
    for key, value in schema.items():
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if key in _BOUNDS_OF_SCHEMA and is_number:
            schema_in_unit[key] = value * divisor
        else:
            schema_in_unit[key] = _schema_in_unit(value, divisor)
    return schema_in_unit


def _check_percentage(key: object, value: object) -> None:
    """Refuse a number, or a number in a list, that is below -100 or above 100 percent."""
    entries = value if isinstance(value, list | tuple) else [value]
    for entry in entries:
        if isinstance(entry, bool) or not isinstance(entry, int | float):
            continue  # the type of the field refuses it
        if not -100 <= entry <= 100:
            raise ValueError(
                f"`{key}` is in percent, at most 100, but {short_repr(entry)} was given"
            )


def _convert_to_si(value: object, divisor: float) -> object:
    """Divide a number, or each of a list, by the divisor; return anything else as it is."""
    if isinstance(value, list | tuple):
        return [_convert_to_si(entry, divisor) for entry in value]
    if isinstance(value, bool) or not isinstance(value, int | float):
        return value
    try:
        return value / divisor
    except OverflowError:
        return float("inf")  # no key accepts an infinity, so the value is refused later


def value_count_check(key: str, value: object, count: int) -> Check:
    """Return the possible fault that a key has neither one value nor one value for each sensor.

    Parameters
    ----------
    key : str
        The key, for the message.
    value : object
        The value of the key. A tuple must have one entry for each sensor; anything else is one
        value for all.
    count : int
        The number of sensors.
    """
    number = len(value) if isinstance(value, tuple) else count
    message = (
        f"`{key}` must be one value, or one for each of the {count} sensors, but {number} were "
        "given"
    )
    return number != count, message


def repeated_name_check(what: str, names: Sequence[str]) -> Check:
    """Return the possible fault that a name is given more than once.

    Parameters
    ----------
    what : str
        The noun of the named things, in the singular, for the message: "state".
    names : sequence of str
        All names.
    """
    is_repeated = len(set(names)) != len(names)
    message = f"each {what} needs a name of its own, but the names are {', '.join(names)}"
    return is_repeated, message


def unknown_name_check(name: str, known_names: Sequence[str], key: str, what: str) -> Check:
    """Return the possible fault that a name is not among the known ones.

    Parameters
    ----------
    name : str
        The name in the file.
    known_names : sequence of str
        The names that it may be.
    key : str
        The key that holds the name, for the message.
    what : str
        The noun of the named things, in the singular, for the message: "control".
    """
    message = f"`{key}` must name a {what} ({', '.join(known_names)}), but `{name}` was given"
    return name not in known_names, message


def incomplete_table_check(
    table: Mapping[str, object], names: Sequence[str], key: str, what: str
) -> Check:
    """Return the possible fault that a table lacks an entry for a name, or has one too many.

    Parameters
    ----------
    table : mapping
        The table.
    names : sequence of str
        The names that must be the keys of the table.
    key : str
        The location of the table in the file, for the message: "rewards.control".
    what : str
        The noun of the named things, in the singular, for the message: "control".
    """
    present_names = ", ".join(table) or "none"
    message = (
        f"`{key}` must have one entry for each {what} ({', '.join(names)}), and has {present_names}"
    )
    return set(table) != set(names), message


def printed_state(unit: str, percent: str = "%") -> tuple[float, str]:
    """Return the ratio of printed to stored values of a state factor, and the printed unit.

    Parameters
    ----------
    unit : str
        The unit of the stored levels; "1" for a fraction, which is printed in percent.
    percent : str
        The printed unit of percentages.
    """
    if unit == "1":
        return 100.0, percent
    return 1.0, unit
