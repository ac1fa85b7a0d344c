"""Messages of a publisher: from JSON to one observation, checked and in SI units.

A publisher is not trusted. Whatever it sends becomes an observation, or a `Refused` with one
sentence that says why.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from difflib import get_close_matches
from functools import lru_cache
from typing import NamedTuple
from unicodedata import normalize

import numpy as np

from reporting.arrays import Float
from reporting.formats.former_names import with_present_names
from reporting.json_file import parse_json
from reporting.words import listing
from twin_master.mission.steps import Reading
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import LARGEST_SEED

LARGEST_MESSAGE = 1_000_000
"""Largest message [bytes]; a larger one is refused without being parsed."""
LARGEST_STRAIN = 0.5
"""Largest strain; beyond it the publisher has forgotten the unit."""
LARGEST_VALUE = 1e30
"""Largest value of any other sensor, SI; no sensor reaches it, and its powers do not overflow."""
_PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9}
_POWER = re.compile(r"[^\W\d_]+(?:\^|\*\*)?([+-]?\d)")
"""A unit whose first name has a power. The prefix has this power, too: a mm2 is 1e-6 m2."""
_FACTORS_WITHOUT_UNIT = {"1": 1.0, "percent": 1e-2, "microstrain": 1e-6}
OTHER_KEYS = "step", "time", "control"
"""The keys of a message that are not sensors."""
PRESENT_NAMES = {"turn": "step"}
"""The present name of each key of a message, and of each column of a file, by its former name."""
_UNITS_PER_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""The length of a second in each unit of times."""
_LEAST_SIMILARITY = 0.8
"""Least similarity (ratio of `difflib`) at which an unknown name counts as a misspelt known one."""
_SHOWN_CHARACTERS = 60
"""Characters of an unknown name that a refusal shows."""
_SHOWN_NAMES = 3
"""Unknown names that a refusal shows."""
_NAME_WITH_UNIT = re.compile(r"^(.*?)\s*[\[(]([^\])]*)[\])]$")
"""A name with its unit in brackets: `strain_7 [microstrain]`."""


class Refused(Exception):  # noqa: N818 - what it is, not what went wrong
    """A message that is not an observation; the sentence says why."""


@dataclass(frozen=True)
class Message(Reading):
    """An observation as it was sent, in SI units; for modes, a row with their covariance.

    Attributes
    ----------
    step : int or None
        The step that the message names.
    time : float or None
        The time [s] that the message names.
    assumed : bool
        Whether its control was only assumed when it was recorded.
    ignored : dict of str to str
        The names in it that are not sensors, each with the known name that was probably meant, in
        words, or an empty text.
    """

    step: int | None = None
    time: float | None = None
    assumed: bool = False
    ignored: Mapping[str, str] = field(default_factory=dict)


FeedItem = tuple[Message | Refused | None, str]
"""A message with the beginning of its text; None if no further message has come yet."""
MessageContent = bytes | Mapping[str, object] | Message | Refused
"""The content of a message: JSON text, a parsed object, or a message already read or refused."""


class SensorColumn(NamedTuple):
    """What a key of a message, or a column of a file, means.

    Attributes
    ----------
    sensor : int
        The index of the sensor, from 0.
    factor : float
        The factor from the sent values to SI units.
    """

    sensor: int
    factor: float


@dataclass
class _SensorReadings:
    """The readings of all sensors in a message.

    Attributes
    ----------
    observed : array of shape (G + I,)
        The readings of G sensors, then those of I inspections, SI; NaN if none came.
    sensors : set of int
        The indices of the sensors that the message names.
    unreadable : dict of int to str
        The value that was given in the place of a number, by the index of the sensor.
    ignored : dict of str to str
        As in `Message`.
    nested_name : str
        The first ignored name whose value is an object; empty if there is none.
    """

    observed: Float
    sensors: set[int] = field(default_factory=set)
    unreadable: dict[int, str] = field(default_factory=dict)
    ignored: dict[str, str] = field(default_factory=dict)
    nested_name: str = ""


class MessageReader:
    """Reads the messages about the asset of a scenario.

    The key of a sensor is `ROLE_NUMBER` (`strain_7`) or its title, followed by its unit:
    `strain_7_microstrain`, `strain_7 [microstrain]`. Without a unit the value is in that of the
    scenario. The key of the reading of an inspection is `ACTION_STATE` (`inspect_z1_percent`). All
    sensors together have the key of their role, with a list as value and `unit` beside it. A sensor
    whose value is not a number, or is too large, is lost; the others of the message count.

    Parameters
    ----------
    scenario : Scenario
        The scenario with the sensors, the controls and the unit of times.

    Attributes
    ----------
    allows_unknown : bool
        Whether keys that are not sensors are ignored, and not refused.
    """

    def __init__(self, scenario: Scenario) -> None:
        observation = scenario.observation
        self._observation = observation
        self.allows_unknown = scenario.watch.allow_unknown
        self._units_per_second = _UNITS_PER_SECOND[scenario.watch.time_unit]
        self._controls = scenario.control_names
        self._width = scenario.row_width

        # Sensors
        role = observation.role
        count = observation.count
        self._sensor_of_name = {f"{role}_{number + 1}": number for number in range(count)}
        self._sensor_of_name |= {title: number for number, title in enumerate(observation.titles)}
        self._units = list(observation.sensor_units)
        self._largest_values = []
        for unit in observation.sensor_units:
            is_strain = role == "strain" and unit == "1"
            self._largest_values.append(LARGEST_STRAIN if is_strain else LARGEST_VALUE)

        # Readings of inspections, which follow the sensors in a row
        for index, reading in enumerate(scenario.inspection_readings):
            self._sensor_of_name[reading.name] = count + index
            self._units.append(scenario.state[reading.state_index].unit)
            self._largest_values.append(LARGEST_VALUE)

        # A stream repeats the same names in each message
        cache_size = 2 * len(self._sensor_of_name)
        self.find_column = lru_cache(maxsize=cache_size)(self._find_column)
        self.likely_name = lru_cache(maxsize=1000)(self._find_likely_name)

    def _find_column(self, name: str) -> SensorColumn | None:
        """Return the sensor that a name in a message means, with the factor to SI.

        The name is that of a sensor, alone or followed by a unit, in brackets or after `_`. Any
        other name gives None.

        Raises
        ------
        Refused
            If the unit is not one of this sensor.
        """
        base = name
        unit = ""
        if name not in self._sensor_of_name:
            match = _NAME_WITH_UNIT.match(name)
            if match:
                base, unit = match.groups()
            else:
                base, _, unit = name.rpartition("_")
        if base not in self._sensor_of_name:
            return None
        sensor = self._sensor_of_name[base]
        factors = self._unit_factors(sensor)
        if unit and unit not in factors:
            raise Refused(
                f"`{unit[:30]}` is not a unit of sensor {sensor + 1}: it is read in "
                f"{listing(factors, 'or')}"
            )
        return SensorColumn(sensor, factors[unit or self._units[sensor]])

    def _unit_factors(self, sensor: int) -> dict[str, float]:
        """Return the units in which a sensor may be sent, each with its factor to SI.

        They are the unit of the sensor with each SI prefix. In a unit with a power, such as m2, the
        prefix has that power, too.
        """
        unit = self._units[sensor]
        if unit == "1":
            return _FACTORS_WITHOUT_UNIT
        power_match = _POWER.match(normalize("NFKC", unit))
        power = int(power_match[1]) if power_match else 1
        return {prefix + unit: factor**power for prefix, factor in _PREFIXES.items()}

    def _find_likely_name(self, name: str) -> str:
        """Return the known name that an unknown one probably misspells; empty if there is none."""
        known_names = (*OTHER_KEYS, *self._sensor_of_name)
        matches = get_close_matches(name, known_names, 1, cutoff=_LEAST_SIMILARITY)
        return matches[0] if matches else ""

    def describe_unknown(self, names: Sequence[str], *, has_sensors: bool) -> str:
        """Return a sentence that says which names are not sensors, and how sensors are named.

        Parameters
        ----------
        names : sequence of str
            At least one unknown name.
        has_sensors : bool
            Whether the message also names sensors. Only then does the sentence advise to ignore the
            unknown names.
        """
        shown_names = [name[:_SHOWN_CHARACTERS] for name in names[:_SHOWN_NAMES]]
        quoted_names = listing(f"`{name}`" for name in shown_names)
        verb = "is not a sensor"
        if len(names) > 1:
            hidden_count = len(names) - len(shown_names)
            verb = "are not sensors" + (f" (and {hidden_count} more)" if hidden_count else "")
        examples = _similar_names(shown_names[0], *self._sensor_of_name)
        sentence = (
            f"{quoted_names} {verb}: sensors have names such as {examples}, with a unit at the end "
            f"where it is not SI, and there are {len(self._units)}"
        )
        if has_sensors and not any(map(self.likely_name, shown_names)):
            sentence += (
                "; a name that shall be ignored must begin with `_`, or be allowed by "
                "--allow-unknown"
            )
        return sentence

    def read(self, content: MessageContent) -> Message | Refused:
        """Return the observation of a message, or the reason why there is none."""
        try:
            if isinstance(content, bytes):
                content = self.parse(content)
            if isinstance(content, Message | Refused):
                return content
            return self._read_record(content)
        except Refused as refusal:
            return refusal

    def parse(self, content: bytes) -> Mapping[str, object]:
        """Return the JSON object in the text of a message.

        Raises
        ------
        Refused
            If the text is too long, or not a JSON object.
        """
        if len(content) > LARGEST_MESSAGE:
            raise Refused(
                f"a message has at most {LARGEST_MESSAGE} bytes, but {len(content)} were given"
            )
        try:
            record = parse_json(content, "the message", Refused, any_number=True)
        except RecursionError:
            raise Refused("it is nested too deeply") from None
        if not isinstance(record, dict):
            raise Refused("it is not a JSON object")
        return record

    def _read_record(self, record: Mapping[str, object]) -> Message:
        """Return the observation in a parsed message; refuse invalid values and unknown names."""
        record = with_present_names(record, PRESENT_NAMES, "A message", Refused)
        readings = self._read_sensors(record)
        self._check_ignored_names(readings)
        step = self._read_step(record.get("step"))
        time = self._read_time(record.get("time"))
        control_name = record.get("control")
        if control_name is not None and control_name not in self._controls:
            raise Refused(f"`control` is one of {', '.join(self._controls)}, or absent")
        control = None if control_name is None else self._controls.index(str(control_name))
        return Message(
            readings.observed,
            control,
            unreadable=readings.unreadable,
            step=step,
            time=time,
            ignored=readings.ignored,
        )

    def _read_sensors(self, record: Mapping[str, object]) -> _SensorReadings:
        """Return the readings of all sensors in a parsed message.

        A value that is not a number, or too large, leaves the sensor without a reading
        (`unreadable`). Unknown names are collected in `ignored`, and refused later if they are not
        allowed.
        """
        readings = _SensorReadings(np.full(self._width, np.nan))
        for name, value in self._named_values(record):
            if name == "covariance" and self._observation.modes is not None:
                readings.observed[self._observation.count :] = self._read_covariance(value)
                continue
            column = self.find_column(name)
            if column is None:
                likely_name = self.likely_name(name[:_SHOWN_CHARACTERS])
                readings.ignored[name] = f"probably `{likely_name}`" if likely_name else ""
                if isinstance(value, dict):
                    readings.nested_name = readings.nested_name or name
                continue
            sensor = column.sensor
            if sensor in readings.sensors:
                raise Refused(f"sensor {sensor + 1} is given twice")
            readings.sensors.add(sensor)
            number = math.nan
            if not isinstance(value, bool):
                with suppress(TypeError, ValueError, OverflowError):
                    number = float(value) * column.factor  # type: ignore[arg-type]
            if abs(number) <= self._largest_values[sensor]:
                readings.observed[sensor] = number
            else:
                readings.unreadable[sensor] = self._describe_unreadable(value, number, column)
        return readings

    def _check_ignored_names(self, readings: _SensorReadings) -> None:
        """Refuse a message with unknown names that must not be ignored."""
        if not readings.ignored:
            return
        if readings.nested_name and not readings.sensors:
            example = next(iter(self._sensor_of_name))
            raise Refused(
                f"`{readings.nested_name[:_SHOWN_CHARACTERS]}` holds an object, and the message "
                "has no other sensor: sensors must be at the top level of a message, as in "
                f'{{"step": 0, "{example}": 0.0}}'
            )
        if not self.allows_unknown:
            has_sensors = bool(readings.sensors)
            raise Refused(self.describe_unknown(list(readings.ignored), has_sensors=has_sensors))

    def _read_step(self, value: object) -> int | None:
        """Return the step of a message, a whole number in any form; None without one."""
        if value is None:
            return None
        step = value
        if isinstance(value, str):
            with suppress(ValueError):
                step = int(value) if value.isdecimal() else float(value)
        if isinstance(step, float) and step.is_integer():
            step = int(step)
        if type(step) is not int or not 0 <= step <= LARGEST_SEED:
            raise Refused(f"`step` is a whole number from 0, but {value!r:.40} was given")
        return step

    def _read_time(self, value: object) -> float | None:
        """Return the time of a message [s]; None without one.

        It is a number in the unit of the scenario, which may be in quotes, or a date and time by
        ISO 8601, which is counted from 1970, and is in UTC if it has no offset.
        """
        if value is None:
            return None
        time = math.nan
        with suppress(ValueError, OverflowError):
            if isinstance(value, int | float | str) and not isinstance(value, bool):
                time = float(value) / self._units_per_second
        if isinstance(value, str) and math.isnan(time):
            with suppress(ValueError):
                date = datetime.fromisoformat(value.strip().removesuffix("UTC").rstrip())
                time = (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()
        if not math.isfinite(time):
            raise Refused(
                "`time` is a number, or a date and time such as 2026-03-31T10:00:00Z, but "
                f"{value!r:.40} was given"
            )
        return time

    def _named_values(self, record: Mapping[str, object]) -> Iterator[tuple[str, object]]:
        """Yield the name and the value of each sensor in a parsed message.

        A list under the key of the role is split into sensors with the names `ROLE_NUMBER_UNIT`.
        Keys that begin with `_` are skipped.
        """
        role = self._observation.role
        unit = record.get("unit", "")
        if not isinstance(unit, str):
            raise Refused("`unit` is the name of a unit")
        for name, value in record.items():
            if name == role and isinstance(value, list):
                count = self._observation.count
                if len(value) != count:
                    raise Refused(f"{count} values are expected, but {len(value)} were given")
                for number, element in enumerate(value, start=1):
                    yield f"{role}_{number}_{unit}".removesuffix("_"), element
            elif name not in (*OTHER_KEYS, "unit") and not name.startswith("_"):
                yield name, value

    def _read_covariance(self, value: object) -> Float:
        """Return the lower triangle, row by row, of the sensors' covariance matrix in SI units.

        It must be symmetric and positive semidefinite.
        """
        count = self._observation.count
        try:
            matrix = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.empty(0)
        if matrix.shape != (count, count) or not np.all(np.abs(matrix) <= LARGEST_VALUE):
            raise Refused(
                f"`covariance` is {count} rows of {count} numbers, in SI units; null is none"
            )
        # Check correlations and not covariances, so that the tolerances hold for any unit. No
        # correlation exceeds 1. A sensor with zero variance is left unscaled: divided by one.
        standard_deviation = np.sqrt(np.abs(np.diag(matrix)))
        standard_deviation[standard_deviation == 0.0] = 1.0
        with np.errstate(over="ignore"):
            correlation = matrix / standard_deviation / standard_deviation[:, None]
        is_too_large = np.abs(correlation).max() > 1.0 + 1e-6
        is_asymmetric = np.abs(correlation - correlation.T).max() > 1e-6
        if is_too_large or is_asymmetric or np.linalg.eigvalsh(correlation)[0] < -1e-6:
            raise Refused("`covariance` is not symmetric with eigenvalues of zero or more")
        return matrix[np.tril_indices(count)]

    def _describe_unreadable(self, value: object, number: float, column: SensorColumn) -> str:
        """Return, in words, the value that is no reading, given also in SI units.

        A strain that is too large and has no unit was probably sent in microstrain: then the text
        says how to give the unit.
        """
        if not math.isfinite(number):
            return json.dumps(value)[:30]
        is_strain = self._largest_values[column.sensor] == LARGEST_STRAIN
        advice = ""
        if is_strain and column.factor == 1.0:
            advice = f"; give its unit, such as `strain_{column.sensor + 1}_microstrain`"
        return f"{number:g}{advice}"


@lru_cache(maxsize=1000)
def _similar_names(name: str, *known_names: str) -> str:
    """Return the known names that are most similar to one, in words.

    The result is cached, because the comparison takes longer than reading a message.
    """
    similar_names = get_close_matches(name, known_names, 3) or known_names[:1]
    return listing(f"`{similar_name}`" for similar_name in similar_names)
