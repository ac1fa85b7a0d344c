"""What a publisher sends: one observation, checked, in SI.

A publisher is not trusted. Whatever it sends is an observation or a `Refused` with one sentence.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import lru_cache

import numpy as np

from reporting.arrays import Float
from reporting.json_file import parse_json
from reporting.words import listing
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import LARGEST_SEED
from twin_master.sentences import said

LARGEST_MESSAGE = 1_000_000
"""Bytes of a message; a larger one is refused unread."""
LARGEST_STRAIN = 0.5
"""A strain beyond this is one whose unit was forgotten."""
LARGEST = 1e30
"""The same of any other sensor, SI: far beyond what exists, and its powers are still numbers."""
_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9}
_WITHOUT_UNIT = {"1": 1.0, "percent": 1e-2, "microstrain": 1e-6}
_NAMED = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]$")


class Refused(Exception):  # noqa: N818 - what it is, not what went wrong
    """A message that is no observation; the sentence says why."""


@dataclass(frozen=True)
class Message:
    """An observation as it was sent.

    Attributes
    ----------
    observed : (G,)
        SI; NaN where a sensor is absent or unreadable. Where modes are observed, a row with their covariance.
    turn : int or None
        Its turn, if it says so.
    time : float or None
        Its time [s], if it says so.
    control : int or None
        Index of the control in force, if it says so.
    unreadable : dict of int to str
        What came in the place of a reading, of each sensor that has none, from 0.
    """

    observed: Float
    turn: int | None = None
    time: float | None = None
    control: int | None = None
    unreadable: Mapping[int, str] = field(default_factory=dict)


Fed = tuple[Message | Refused | None, str]
"""A message with the begin of its text; None where nothing more has come yet."""


class MessageReader:
    """Reads the messages about the asset of a scenario.

    A sensor goes by `ROLE_NUMBER` (`strain_7`) or its title, its unit behind it: `strain_7_microstrain`,
    `strain_7 [microstrain]`; without a unit it is in that of the scenario. The reading of an inspection goes
    by `ACTION_STATE` (`inspect_z1_percent`). All sensors together go by their role, as a list, with `unit`
    beside it. A sensor of which no number comes, or an absurd one, is lost alone.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._observation, self._allows_unknown = scenario.observation, scenario.watch.allow_unknown
        self._controls = scenario.control_names
        role, count = scenario.observation.role, scenario.observation.count
        self._index = {f"{role}_{number + 1}": number for number in range(count)}
        self._index |= {title: number for number, title in enumerate(scenario.observation.titles)}
        self._columns: dict[str, tuple[int, float]] = {}
        units, self._width = scenario.observation.sensor_units, scenario.row_width
        self._largest = [LARGEST_STRAIN if role == "strain" and unit == "1" else LARGEST for unit in units]
        self._index |= {name: count + place for place, (*_, name, _) in enumerate(scenario.readings)}
        self._units = [*units, *(scenario.state[place].unit for _, place, *_ in scenario.readings)]
        self._largest += [LARGEST] * len(scenario.readings)

    def column(self, name: str) -> tuple[int, float] | None:
        """Return the index of the sensor that a name stands for, and what its values are multiplied by.

        None for a name that is no sensor, where the scenario allows them.

        Raises
        ------
        Refused
            It is no sensor, or not in a unit of this sensor.
        """
        if name in self._columns:
            return self._columns[name]
        base, unit = name, ""
        if name not in self._index:
            named = _NAMED.match(name)
            if named is not None:
                base, unit = named["name"], named["unit"]
            else:
                base, _, unit = name.rpartition("_")
        if base not in self._index and self._allows_unknown:
            return None
        if base not in self._index:
            near = _near(name[:60], *self._index)
            raise Refused(said("watch.no_sensor", name=name[:60], near=near, count=len(self._units)))
        sensor = self._index[base]
        found = sensor, self._factor(sensor, unit)
        if len(self._columns) < len(self._index):  # names that mean the same come without end
            self._columns[name] = found
        return found

    def _factor(self, sensor: int, unit: str) -> float:
        own = self._units[sensor]
        if unit in ("", own):
            return 1.0
        if own == "1" and unit in _WITHOUT_UNIT:
            return _WITHOUT_UNIT[unit]
        if own != "1" and unit[1:] == own and unit[0] in _PREFIXES:
            return _PREFIXES[unit[0]]
        known = (
            "1, percent or microstrain"
            if own == "1"
            else f"{own}, or {own} with n, u, m, k, M or G before it"
        )
        raise Refused(f"`{unit[:30]}` is no unit of sensor {sensor + 1}: it is read in {known}")

    def parse(self, content: bytes | str) -> Message:
        """Return the observation in a JSON object.

        Raises
        ------
        Refused
            It is none.
        """
        if len(content) > LARGEST_MESSAGE:
            raise Refused(f"a message has at most {LARGEST_MESSAGE} bytes, and {len(content)} came")
        try:
            record = parse_json(content, "the message", Refused, any_number=True)
        except RecursionError:
            raise Refused("it is nested too deeply") from None
        if not isinstance(record, dict):
            raise Refused("it is no JSON object")
        return self.read(record)

    def read(self, record: Mapping[str, object]) -> Message:
        """Return the observation in a record.

        Raises
        ------
        Refused
            It is none.
        """
        observed = np.full(self._width, np.nan)
        given: set[int] = set()
        unreadable: dict[int, str] = {}
        for name, value in self._readings(record):
            if name == "covariance" and self._observation.modes is not None:
                observed[self._observation.count :] = self._covariance(value)
                continue
            if (found := self.column(name)) is None:
                continue
            sensor, factor = found
            if sensor in given:
                raise Refused(f"sensor {sensor + 1} is given twice")
            given.add(sensor)
            shown = self._value(sensor, factor, value)
            if isinstance(shown, str):
                unreadable[sensor] = shown
            else:
                observed[sensor] = shown
        turn, time = record.get("turn"), record.get("time")
        if turn is not None and (type(turn) is not int or not 0 <= turn <= LARGEST_SEED):
            raise Refused("`turn` is a whole number from 0")
        time = float(time) if type(time) is int else time
        if time is not None and not (isinstance(time, float) and math.isfinite(time)):
            raise Refused("`time` is a number of seconds")
        control = self._control(record.get("control"))
        return Message(observed, turn if type(turn) is int else None, time, control, unreadable)

    def _readings(self, record: Mapping[str, object]) -> Iterator[tuple[str, object]]:
        """Return names and values of a record; each of a list has the name of its sensor."""
        unit, role = record.get("unit", ""), self._observation.role
        if not isinstance(unit, str):
            raise Refused("`unit` is the name of a unit")
        for name, value in record.items():
            if name == role and isinstance(value, list):
                if len(value) != self._observation.count:
                    raise Refused(f"{self._observation.count} values are expected, and {len(value)} came")
                yield from ((f"{role}_{n}_{unit}".removesuffix("_"), one) for n, one in enumerate(value, 1))
            elif name not in ("turn", "time", "control", "unit") and not name.startswith("_"):
                yield name, value

    def _covariance(self, value: object) -> Float:
        """Return the lower triangle of the covariance of all values, SI."""
        count = self._observation.count
        try:
            matrix = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.empty(0)
        if matrix.shape != (count, count) or not np.all(np.abs(matrix) <= LARGEST):
            raise Refused(f"`covariance` is {count} rows of {count} numbers, in SI units; null is none")
        size = np.sqrt(np.abs(np.diag(matrix)))
        size[size == 0.0] = 1.0
        with np.errstate(over="ignore"):
            scaled = matrix / size / size[:, None]
        wrong = np.abs(scaled).max() > 1.0 + 1e-6 or np.abs(scaled - scaled.T).max() > 1e-6
        if wrong or np.linalg.eigvalsh(scaled)[0] < -1e-6:
            raise Refused("`covariance` is not symmetric with eigenvalues of zero or more")
        return matrix[np.tril_indices(count)]

    def _value(self, sensor: int, factor: float, value: object) -> float | str:
        """Return what a sensor shows, SI, or what came in the place of that; the one reader of readings."""
        try:
            number = math.nan if isinstance(value, bool) else float(value) * factor  # type: ignore[arg-type]
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if abs(number) <= self._largest[sensor]:
            return number
        if not math.isfinite(number):
            return json.dumps(value)[:30]
        forgotten = factor == 1.0 and self._largest[sensor] == LARGEST_STRAIN
        unit = f"; give its unit, such as `strain_{sensor + 1}_microstrain`" if forgotten else ""
        return f"{number:g}{unit}"

    def _control(self, control: object) -> int | None:
        if control is None:
            return None
        if not isinstance(control, str) or control not in self._controls:
            raise Refused(f"`control` is one of {', '.join(self._controls)}, or absent")
        return self._controls.index(control)


@lru_cache(maxsize=1000)
def _near(name: str, *known: str) -> str:
    """Return the names next to one, in words: kept, because finding them takes longer than a message."""
    return listing(f"`{near}`" for near in get_close_matches(name, known, 3) or known[:1])
