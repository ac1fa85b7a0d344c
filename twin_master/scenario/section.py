"""A table of a scenario file: what all tables have in common, and the kinds of values that they hold."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from reporting import toml_file
from reporting.toml_file import Fault as Fault
from reporting.toml_file import NotNegative as NotNegative
from reporting.toml_file import Number as Number
from reporting.toml_file import Positive as Positive
from reporting.toml_file import shown
from twin_master.sentences import said

UNIT_DIVISOR = {"percent": 100.0, "microstrain": 1.0e6, "microstrain_per_step": 1.0e6}

LARGEST_COUNT = 1_000_000
"""Of steps, draws, sensors: more of them make arrays that no machine has room for."""
LARGEST_SEED = 2**63 - 1
"""What the files of a run can hold."""


def _at_most(limit: int, why: str) -> AfterValidator:
    def check(value: int) -> int:
        if value > limit:
            raise ValueError(f"a number of at most {limit} is expected, {why}, and {shown(value)} came")
        return value

    return AfterValidator(check)


PerSensor = Positive | tuple[Positive, ...]
"""One positive number for all sensors, or one for each."""
Probability = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=0.0, le=1.0)]
_COUNTED = _at_most(LARGEST_COUNT, "for the twin holds arrays of that length")
Count = Annotated[int, Field(strict=True, ge=1), _COUNTED]
Step = Annotated[int, Field(strict=True, ge=0), _COUNTED]
Seed = Annotated[
    int, Field(strict=True, ge=0), _at_most(LARGEST_SEED, "for the files of a run hold no larger integer")
]
Flag = Annotated[bool, Field(strict=True)]
Name = Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9_.\-]+$")]


def _in_si(value: object, divisor: float) -> object:
    if isinstance(value, bool) or not isinstance(value, int | float | list | tuple):
        return value
    if isinstance(value, list | tuple):
        return [_in_si(item, divisor) for item in value]
    try:
        return value / divisor
    except OverflowError:
        return float("inf")  # which no key takes


def _check_percent(key: object, value: object) -> None:
    for item in value if isinstance(value, list | tuple) else [value]:
        if isinstance(item, int | float) and not isinstance(item, bool) and not -100 <= item <= 100:
            raise ValueError(f"`{key}` is in percent, at most 100, and {shown(item)} came")


def one_or_each(key: str, value: object, count: int) -> Fault:
    """Return the fault that what may be given for each sensor is given neither once nor `count` times."""
    came = len(value) if isinstance(value, tuple) else count
    return came != count, said("scenario.one_or_each", key=key, count=count, came=came)


class Section(toml_file.Section):
    """A table of the file: unknown keys are refused, and a unit in a key's name is honoured."""

    model_config = ConfigDict(strict=False)
    units: ClassVar[Mapping[str, str]] = {}
    """The unit that each key may carry in its name."""

    @model_validator(mode="before")
    @classmethod
    def _convert_units(cls, table: object) -> object:
        if not isinstance(table, Mapping):
            return table
        known = {
            name: f"{name}[_{cls.units[name]}]" if name in cls.units else name for name in cls.model_fields
        }
        given = {str(key): cls.split_unit(str(key)) for key in table}
        bases = {base for base, _ in given.values()}
        for key, (base, _) in given.items():
            if base not in known:
                raise ValueError(f"unknown key `{key}`; the keys known there are {', '.join(known.values())}")
        for name in cls.units:
            if cls.model_fields[name].is_required() and name not in bases:
                raise ValueError(f"`{known[name]}` is missing")
        converted: dict[object, object] = {}
        for (key, (base, unit)), value in zip(given.items(), table.values(), strict=True):
            if base in table and unit:
                raise ValueError(f"`{base}` and `{key}` were both given: keep one of them")
            if unit == "percent":
                _check_percent(key, value)
            converted[base] = _in_si(value, UNIT_DIVISOR[unit]) if unit else value
        return converted

    @classmethod
    def split_unit(cls, key: str) -> tuple[str, str]:
        """Return the key without its unit, and the unit (empty without one)."""
        for base, unit in cls.units.items():
            if key == f"{base}_{unit}":
                return base, unit
        return key, ""


def short(values: object) -> str:
    """Return values for a sentence."""
    if isinstance(values, list | tuple):
        return ", ".join(str(value) for value in values)
    return str(values)


def printed_state(unit: str, percent: str = "%") -> tuple[float, str]:
    """Return the factor from the stored unit of a state factor to the printed one, and its name."""
    return (100.0, percent) if unit == "1" else (1.0, unit)


def unknown(name: str, names: tuple[str, ...], where: str, what: str) -> Fault:
    """Return the fault that a name is none of those there are."""
    return name not in names, f"`{where}` must name a {what} ({short(names)}), and `{name}` came"


def incomplete(table: Mapping[str, object], names: tuple[str, ...], where: str, what: str) -> Fault:
    """Return the fault that a table has not one entry for each name."""
    came = short(list(table)) or "none"
    told = f"`{where}` must have one entry for each {what} ({short(names)}), and has {came}"
    return {*table} != {*names}, told
