"""A table of a scenario file: what all tables have in common, and the kinds of values that they hold.

Some say what is observed, and how well: sensors, or modes of a record. What flies and what the twin believes
are two unions of tables, each told apart by its `kind`. A kind is one class in one file: a subclass of
`AssetSection` or `BeliefSection` in a file whose name ends in `_source`, beside `asset_source`. Its fields
are what a user writes, and its `source` makes of them what the mission needs. Nothing else has to know of it.
"""

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from pkgutil import iter_modules
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, ModelWrapValidatorHandler, model_validator

from reporting import toml_file
from reporting.arrays import Float, Index
from reporting.toml_file import Fault, NotNegative, Positive, missing_keys, short_repr
from scenarios import asset_scripts, binding_files, recording_files, structure_files
from twin_master.errors import said

UNIT_DIVISOR = {"percent": 100.0, "microstrain": 1.0e6, "microstrain_per_step": 1.0e6}

LARGEST_COUNT = 1_000_000
"""Of steps, draws, sensors: more of them make arrays that no machine has room for."""
LARGEST_SEED = 2**63 - 1
"""What the files of a run can hold."""


def _at_most(limit: int, why: str) -> AfterValidator:
    def check(value: int) -> int:
        if value > limit:
            raise ValueError(f"a number of at most {limit} is expected, {why}, and {short_repr(value)} came")
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
        converted: dict[str, object] = {}
        for key, value in table.items():
            base, unit = cls.split_unit(str(key))
            if base not in known:
                raise ValueError(f"unknown key `{key}`; the keys known there are {', '.join(known.values())}")
            if base in converted:
                raise ValueError(f"`{base}` was given with and without its unit: keep one of them")
            for item in value if isinstance(value, list | tuple) else [value]:
                number = isinstance(item, int | float) and not isinstance(item, bool)
                if unit == "percent" and number and not -100 <= item <= 100:
                    raise ValueError(f"`{key}` is in percent, at most 100, and {short_repr(item)} came")
            converted[base] = _in_si(value, UNIT_DIVISOR[unit]) if unit else value
        required = [name for name, field in cls.model_fields.items() if field.is_required()]
        missing = [known[name] for name in required if name not in converted]
        if {*required} & {*cls.units} - {*converted}:  # only here the units of their names are known
            raise missing_keys(missing, f"`{missing[0]}` is missing")
        return converted

    @classmethod
    def split_unit(cls, key: str) -> tuple[str, str]:
        """Return the key without its unit, and the unit (empty without one)."""
        for base, unit in cls.units.items():
            if key == f"{base}_{unit}":
                return base, unit
        return key, ""


def named_once(what: str, names: Sequence[str]) -> Fault:
    """Return the fault that a name comes twice."""
    told = f"each {what} needs a name of its own, and the names are {short(list(names))}"
    return len({*names}) != len(names), told


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


ROLE = "modes"
"""The role of an observation whose values are features of modes."""
Feature = Literal["frequency", "damping_ratio", "shape"]


def row_width(sensors: int) -> int:
    """Return the length of a row of values and, behind them, the lower triangle of their covariance."""
    return sensors + sensors * (sensors + 1) // 2


class ModesSection(Section):
    """Which modes are observed, and what of each.

    A value is observed for each mode and each feature that has a standard deviation: frequency, damping
    ratio, and the shape at each accelerometer behind the first, divided by that at the first.
    """

    accelerometers: Annotated[tuple[Name, ...], Field(min_length=1)]
    """Acceleration outputs of the model, the first is the one that shapes are relative to."""
    bands: Annotated[tuple[tuple[Positive, Positive], ...], Field(min_length=1)]
    """Least and largest frequency of each mode [Hz]: what a record shows most of in it is the mode."""
    numbers: tuple[Count, ...] = ()
    """Number of each mode in the model, in rising order; 1, 2, ... without them."""
    standard_deviation: dict[Feature, Positive]
    """Of each feature [Hz, 1, 1], beside that with which it was identified: what changes between records,
    and what the model is wrong by."""

    def faults(self) -> Iterator[Fault]:
        """Yield what bands, numbers and features may have wrong."""
        ordered, numbers = pairwise(sorted(self.bands)), len(self.numbers or self.bands)
        yield any(high <= low for low, high in self.bands), said("scenario.band")
        yield any(after[0] < before[1] for before, after in ordered), said("scenario.bands")
        told = said("scenario.mode_numbers", numbers=numbers, bands=len(self.bands))
        yield numbers != len(self.bands), told
        yield not self.columns, said("scenario.mode_features")

    @property
    def places(self) -> Index:
        """Places of the modes in the model (M,), from 0."""
        return np.array(self.numbers or range(1, len(self.bands) + 1)) - 1

    @property
    def columns(self) -> list[int]:
        """Which of the features are observed."""
        return [place for place, (_, kind) in enumerate(self.features) if kind in self.standard_deviation]

    @property
    def features(self) -> list[tuple[str, Feature]]:
        """Name and kind of frequency, damping ratio and relative shape at each further accelerometer."""
        shapes: list[tuple[str, Feature]] = [(name, "shape") for name in self.accelerometers[1:]]
        return [("frequency", "frequency"), ("damping_ratio", "damping_ratio"), *shapes]

    def filled(self) -> dict[str, Any]:
        """Return the keys of `[observation]` that follow: count, titles, unit, standard_deviation."""
        observed = [self.features[column] for column in self.columns]
        each = [(f"{name}_{number + 1}", kind) for number in self.places for name, kind in observed]
        return {
            "count": len(each),
            "titles": tuple(title for title, _ in each),
            "unit": tuple("Hz" if kind == "frequency" else "1" for _, kind in each),
            "standard_deviation": tuple(self.standard_deviation[kind] for _, kind in each),
        }

    def observed(self, values: Float) -> Float:
        """Return what is observed (..., G) of all values (..., M, 1 + A) of the modes."""
        return values[..., self.columns].reshape(*values.shape[:-2], -1)

    def covariance(self, of_modes: Float) -> Float:
        """Return the covariance of what is observed (G, G), of those of the modes (M, 1 + A, 1 + A)."""
        size = len(self.columns)
        found = np.zeros((len(of_modes) * size,) * 2)
        for mode, block in enumerate(of_modes):
            rows = slice(mode * size, (mode + 1) * size)
            found[rows, rows] = block[np.ix_(self.columns, self.columns)]
        return found


class RecordSection(Section):
    """How the record of each step comes about, for a simulated asset."""

    kind: Literal["ambient", "decay"]
    """`ambient`: the input is shaken by white noise; `decay`: it is let go."""
    input: Name
    """Control input that is shaken or let go."""
    amplitude: Positive
    """Root mean square of the shaking, or what is let go, in the unit of the input."""
    duration: Positive
    """[s]"""
    sampling_rate: Positive
    """[Hz]"""
    noise: NotNegative = 0.0
    """Standard deviation of the noise of the accelerometers [m/s^2]."""


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
            raise ValueError(said("scenario.role_of_modes", role=ROLE))
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
        """Length of the row that comes of a step: values, and their covariance where it comes with them."""
        return self.count if self.modes is None else row_width(self.count)

    @property
    def sensor_units(self) -> tuple[str, ...]:
        """Unit of each sensor."""
        return (self.unit,) * self.count if isinstance(self.unit, str) else self.unit

    @property
    def word(self) -> str:
        """What one sensor is called."""
        return "gauge" if self.role == "strain" else "sensor"

    @property
    def printed(self) -> tuple[float, tuple[str, ...]]:
        """Factor from the stored values to the printed ones, and the printed unit of each sensor."""
        if self.role == "strain" and {*self.sensor_units} <= {"1", ""}:
            return 1e6, ("microstrain",) * self.count
        return 1.0, self.sensor_units

    def faults(self) -> Iterator[Fault]:
        """Yield keys that are given neither once nor for each sensor."""
        for key in ("unit", "standard_deviation", "titles"):
            yield one_or_each(f"observation.{key}", getattr(self, key) or None, self.count)
        yield one_or_each("observation.model_error_percent", self.model_error, self.count)


KIND_FOLDER = Path(__file__).parents[1] / "assets"
KIND_PACKAGE = f"{__package__.rpartition('.')[0]}.{KIND_FOLDER.name}"
"""Where the kinds are found by the names of their files: the tables know none of them."""
CALIBRATED_DESIGN_NAME = "calibration"
"""The tailored design inside the calibration file: with a file it takes the place of the scenario's."""


def _shipped_designs() -> dict[str, Path]:
    from fe.wing.design import SHIPPED_DESIGN

    return {path.stem: path for path in sorted(SHIPPED_DESIGN.parent.glob("*.toml"))}


class FileSection(Section):
    """A table that names files: its own, by their paths, or shipped ones, by their names."""

    shipped: ClassVar = {
        "binding": binding_files,
        "design": _shipped_designs,
        "observations": recording_files,
        "script": asset_scripts,
        "structure": structure_files,
    }

    kept: ClassVar[Mapping[str, str]] = {}
    """For each key that names a file the place of its copy in a run folder."""

    def copies(self) -> Mapping[str, str]:
        """Return for each key that names a file where its copy stands in a run folder."""
        return self.kept

    def own_files(self) -> dict[str, str]:
        """Return the paths of the files that are not shipped, by their keys."""
        given = {key: getattr(self, key) for key in self.copies()}
        return {key: path for key, path in given.items() if path and not self._is_shipped(key, path)}

    def all_files(self) -> dict[str, Path]:
        """Return all files, the shipped ones too, by the places of their copies in a run folder."""
        found = {}
        for key, copy in self.copies().items():
            name = getattr(self, key)
            if name and name != CALIBRATED_DESIGN_NAME:
                shipped = self.shipped[key]() if key in self.shipped else {}
                found[copy] = shipped.get(name, Path(name))
        return found

    def moved(self, folder: Path) -> Self:
        """Return the table with its relative paths from a folder."""
        return self.model_copy(update={key: str(folder / path) for key, path in self.own_files().items()})

    def portable(self) -> "FileSection":
        """Return the table with the paths of the copies inside a run folder."""
        return self.model_copy(update={key: self.copies()[key] for key in self.own_files()})

    def _is_shipped(self, key: str, name: str) -> bool:
        return name == CALIBRATED_DESIGN_NAME or (key in self.shipped and name in self.shipped[key]())


class KindSection(FileSection):
    """A table whose `kind` says which class it is of."""

    kind: str
    own_figures: ClassVar[bool] = False
    """Whether its observations are of no model that anything else flies or believes."""

    @property
    def departs(self) -> bool:
        """Whether this is known to be another model than all else, by its own figures or a patch."""
        return self.own_figures or getattr(self, "patch", None) is not None

    @classmethod
    def kinds(cls) -> dict[str, type[Self]]:
        """Return the kinds of this union and their classes."""
        for module in iter_modules([str(KIND_FOLDER)]):
            if module.name.endswith("_source"):
                import_module(f"{KIND_PACKAGE}.{module.name}")
        return {kind: found for found in _subclasses(cls) if (kind := found.own_kind()) is not None}

    @classmethod
    def own_kind(cls) -> str | None:
        """Return the kind of this class; None for the union itself."""
        kind = cls.model_fields["kind"].default
        return kind if isinstance(kind, str) else None

    @model_validator(mode="wrap")
    @classmethod
    def _of_its_kind(cls, table: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if cls.own_kind() is not None or not isinstance(table, Mapping):
            return handler(table)
        kinds, kind = cls.kinds(), table.get("kind")
        if not isinstance(kind, str) or kind not in kinds:
            expected = f"`kind` must be one of {short(sorted(kinds))}"
            if "kind" not in table:
                raise missing_keys(["kind"], f"{expected}, and it is missing")
            raise ValueError(f"{expected}, and {short_repr(kind)} came")
        return kinds[kind].model_validate(table)


class BeliefSection(KindSection):
    """What the twin believes: where its predicted observations come from."""

    @abstractmethod
    def source(self, scenario: Any, flown: Any) -> Any:
        """Return what the twin of a `Scenario` believes of what is flown, both `asset_source.AssetSource`."""


class AssetSection(KindSection):
    """What flies."""

    is_fmu: ClassVar[bool] = False
    """Whether it is an FMU, or several, and so may carry damage and sensors of its own."""

    @property
    def true_parameters(self) -> Mapping[str, float]:
        """Parameters of the true asset, SI, as far as they are given."""
        return dict(getattr(self, "parameters", {}))

    @property
    def constant_load(self) -> Mapping[str, float]:
        """Load inputs, the same in every step, SI."""
        return dict(getattr(self, "load", {}))

    @abstractmethod
    def source(self, scenario: Any) -> Any:
        """Return what is flown in a `Scenario`, an `asset_source.AssetSource`."""


def _subclasses(cls: type[KindSection]) -> Iterator[type[Any]]:
    for found in cls.__subclasses__():
        yield found
        yield from _subclasses(found)
