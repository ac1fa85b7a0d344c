"""What a publisher sends: one observation, checked, in SI.

A publisher is not trusted. Whatever it sends is an observation or a `Refused` with one sentence.
"""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reporting.json_file import parse_json
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import LARGEST_SEED

Float = NDArray[np.float64]

LARGEST_MESSAGE = 1_000_000
"""Bytes of a message; a larger one is refused unread."""
LARGEST_STRAIN = 0.5
"""A strain beyond this is one whose unit was forgotten."""
LARGEST = float(np.finfo(np.float64).max)
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
        SI; NaN where a sensor is absent or null. Where modes are observed, a row with their covariance.
    turn : int or None
        Its turn, if it says so.
    time : float or None
        Its time [s], if it says so.
    control : int or None
        Index of the control in force, if it says so.
    """

    observed: Float
    turn: int | None = None
    time: float | None = None
    control: int | None = None


class MessageReader:
    """Reads the messages about the asset of a scenario.

    A sensor goes by `ROLE_NUMBER` (`strain_7`) or its title, its unit behind it: `strain_7_microstrain`,
    `strain_7 [microstrain]`; without a unit it is in that of the scenario. All sensors together go by their
    role, as a list, with `unit` beside it.

    Attributes
    ----------
    largest : (G,)
        Largest value of each sensor that is believed, SI.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._observation = scenario.observation
        self._controls = scenario.control_names
        role, count = scenario.observation.role, scenario.observation.count
        self._index = {f"{role}_{number + 1}": number for number in range(count)}
        self._index |= {title: number for number, title in enumerate(scenario.observation.titles)}
        self._columns: dict[str, tuple[int, float]] = {}
        units = scenario.observation.sensor_units
        self.largest: Float = np.array(
            [LARGEST_STRAIN if role == "strain" and unit == "1" else LARGEST for unit in units]
        )
        self._largest = self.largest.tolist()

    def column(self, name: str) -> tuple[int, float]:
        """Return the index of the sensor that a name stands for, and what its values are multiplied by.

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
        if base not in self._index:
            known = next(iter(self._index))
            raise Refused(
                f"`{name[:60]}` is no sensor: a sensor is called such as `{known}`, its unit behind it, and "
                f"there are {self._observation.count}"
            )
        sensor = self._index[base]
        found = sensor, self._factor(sensor, unit)
        if len(self._columns) < len(self._index):  # names that mean the same come without end
            self._columns[name] = found
        return found

    def _factor(self, sensor: int, unit: str) -> float:
        own = self._observation.sensor_units[sensor]
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
            record = parse_json(content, "the message", Refused)
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
        observed = np.full(self._observation.width, np.nan)
        given: set[int] = set()
        unit = record.get("unit", "")
        if not isinstance(unit, str):
            raise Refused("`unit` is the name of a unit")
        for name, value in record.items():
            if name in ("turn", "time", "control", "unit") or name.startswith("_"):
                continue
            if name == "covariance" and self._observation.modes is not None:
                observed[self._observation.count :] = self._covariance(value)
                continue
            if name == self._observation.role and isinstance(value, list):
                pairs: Iterable[tuple[int, float, object]] = self._all(value, unit)
            else:
                sensor, factor = self.column(name)
                pairs = [(sensor, factor, value)]
            for sensor, factor, single in pairs:
                if sensor in given:
                    raise Refused(f"sensor {sensor + 1} is given twice")
                given.add(sensor)
                observed[sensor] = self._value(name, sensor, factor, single)
        turn, time = record.get("turn"), record.get("time")
        if turn is not None and (type(turn) is not int or not 0 <= turn <= LARGEST_SEED):
            raise Refused("`turn` is a whole number from 0")
        if time is not None and (type(time) not in (int, float) or not math.isfinite(_number(time))):
            raise Refused("`time` is a number of seconds")
        return Message(
            observed, turn if type(turn) is int else None, None if time is None else _number(time),
            self._control(record.get("control")),
        )  # fmt: skip

    def _all(self, values: list[object], unit: str) -> list[tuple[int, float, object]]:
        if len(values) != self._observation.count:
            raise Refused(f"{self._observation.count} values are expected, and {len(values)} came")
        return [(sensor, self._factor(sensor, unit), value) for sensor, value in enumerate(values)]

    def _covariance(self, value: object) -> Float:
        """Return the lower triangle of the covariance of all values, SI."""
        count = self._observation.count
        try:
            matrix = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):
            matrix = np.empty(0)
        if matrix.shape != (count, count) or not np.isfinite(matrix).all():
            raise Refused(f"`covariance` is {count} rows of {count} numbers, in SI units; null is none")
        size = np.sqrt(np.abs(np.diag(matrix)))
        size[size == 0.0] = 1.0
        scaled = matrix / np.outer(size, size)
        if np.abs(scaled - scaled.T).max() > 1e-6 or np.linalg.eigvalsh(scaled)[0] < -1e-6:
            raise Refused("`covariance` is not symmetric with eigenvalues of zero or more")
        return matrix[np.tril_indices(count)]

    def _value(self, name: str, sensor: int, factor: float, value: object) -> float:
        if value is None:
            return math.nan
        if type(value) not in (int, float):
            raise Refused(f"`{name[:60]}` is a number, or null where the sensor is lost")
        number = _number(value) * factor
        if not math.isfinite(number):
            raise Refused(f"`{name[:60]}` is not finite; a sensor that is lost is null or absent")
        if abs(number) > self._largest[sensor]:
            raise Refused(
                f"`{name[:60]}` would be a strain of {number:g}: give its unit, such as "
                f"`strain_{sensor + 1}_microstrain`"
            )
        return number

    def _control(self, control: object) -> int | None:
        if control is None:
            return None
        if not isinstance(control, str) or control not in self._controls:
            raise Refused(f"`control` is one of {', '.join(self._controls)}, or absent")
        return self._controls.index(control)


def _number(value: object) -> float:
    try:
        return float(value)  # type: ignore[arg-type]
    except OverflowError:
        return math.inf
