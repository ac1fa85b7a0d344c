"""What a publisher sends: one observation, checked, in SI.

A publisher is not trusted. Whatever it sends is an observation or a `Refused` with one sentence.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import lru_cache
from unicodedata import normalize

import numpy as np

from reporting.arrays import Float
from reporting.former_names import with_present_names
from reporting.json_file import parse_json
from reporting.words import listing
from twin_master.mission.steps import Reading
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import LARGEST_SEED

LARGEST_MESSAGE = 1_000_000
"""Bytes of a message; a larger one is refused unread."""
LARGEST_STRAIN = 0.5
"""A strain beyond this is one whose unit was forgotten."""
LARGEST = 1e30
"""The same of any other sensor, SI: far beyond what exists, and its powers are still numbers."""
_PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6, "G": 1e9}
_POWER = re.compile(r"[^\W\d_]+(?:\^|\*\*)?([+-]?\d)")
"""A unit whose first name has a power, which its prefix has, too: a mm2 is 1e-6 m2."""
_WITHOUT_UNIT = {"1": 1.0, "percent": 1e-2, "microstrain": 1e-6}
OTHER_KEYS = "step", "time", "control"
"""What stands in a message beside its sensors."""
PRESENT_NAMES = {"turn": "step"}
"""The present name of each key of a message, and of each column of a file, by its former name."""
_SECOND = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
"""A second in each unit of times."""
_LIKELY = 0.8
"""Ratio of `difflib` from which on a name is probably a slip of the pen of a known one."""
_NAME_SHOWN, _NAMES_SHOWN = 60, 3
"""Characters of a name, and names, that a refusal shows."""
_NAMED = re.compile(r"^(.*?)\s*[\[(]([^\])]*)[\])]$")


class Refused(Exception):  # noqa: N818 - what it is, not what went wrong
    """A message that is no observation; the sentence says why."""


@dataclass(frozen=True)
class Message(Reading):
    """An observation as it was sent, SI; where modes are observed, a row with their covariance.

    Attributes
    ----------
    step : int or None
        Its step, if it says so.
    time : float or None
        Its time [s], if it says so.
    assumed : bool
        Whether its control was not told where it was recorded.
    passed_over : dict of str to str
        Names in it that are no sensor; with each what it probably is, in words, where it looks like a slip.
    """

    step: int | None = None
    time: float | None = None
    assumed: bool = False
    passed_over: Mapping[str, str] = field(default_factory=dict)


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
        self._observation, self.allows_unknown = scenario.observation, scenario.watch.allow_unknown
        self._second = _SECOND[scenario.watch.time_unit]
        self._controls = scenario.control_names
        role, count = scenario.observation.role, scenario.observation.count
        self._index = {f"{role}_{number + 1}": number for number in range(count)}
        self._index |= {title: number for number, title in enumerate(scenario.observation.titles)}
        units, self._width = scenario.observation.sensor_units, scenario.row_width
        self._largest = [LARGEST_STRAIN if role == "strain" and unit == "1" else LARGEST for unit in units]
        self._index |= {name: count + place for place, (*_, name, _) in enumerate(scenario.readings)}
        self._units = [*units, *(scenario.state[place].unit for _, place, *_ in scenario.readings)]
        self._largest += [LARGEST] * len(scenario.readings)
        # Names that mean the same come without end.
        self.column = lru_cache(maxsize=2 * len(self._index))(self._column)
        self.likely_slip = lru_cache(maxsize=1000)(self._likely_slip)

    def _column(self, name: str) -> tuple[int, float] | None:
        """Return the index of the sensor that a name stands for, and what its values are multiplied by.

        None for a name that is no sensor.

        Raises
        ------
        Refused
            It is not in a unit of this sensor.
        """
        base, unit = name, ""
        if name not in self._index:
            named = _NAMED.match(name)
            base, unit = named.groups() if named else name.rpartition("_")[::2]
        if base not in self._index:
            return None
        sensor = self._index[base]
        own = self._units[sensor]
        squared = _POWER.match(normalize("NFKC", own))
        power = int(squared[1]) if squared else 1
        known = {prefix + own: factor**power for prefix, factor in _PREFIXES.items()}
        known = _WITHOUT_UNIT if own == "1" else known
        if unit and unit not in known:
            what = f"`{unit[:30]}` is no unit of sensor {sensor + 1}"
            raise Refused(f"{what}: it is read in {listing(known, 'or')}")
        return sensor, known[unit or own]

    def _likely_slip(self, name: str) -> str:
        """Return the known name of which an unknown one is probably a slip of the pen; empty without any."""
        likely = get_close_matches(name, (*OTHER_KEYS, *self._index), 1, cutoff=_LIKELY)
        return likely[0] if likely else ""

    def unknown(self, names: Sequence[str], *, is_any_known: bool) -> str:
        """Return what is wrong with names that are no sensor, and what to do, in words.

        Parameters
        ----------
        names : sequence of str
            At least one.
        is_any_known : bool
            Whether there are sensors beside them; if not, to pass over the names leaves nothing.
        """
        shown = [name[:_NAME_SHOWN] for name in names[:_NAMES_SHOWN]]
        further = f" (and {len(names) - len(shown)} more)" if names[_NAMES_SHOWN:] else ""
        are = "is no sensor" if len(names) == 1 else f"are no sensors{further}"
        near = _near(shown[0], *self._index)
        sentence = (
            f"{listing(f'`{name}`' for name in shown)} {are}: a sensor is called such as {near}, its unit "
            f"behind it, and there are {len(self._units)}"
        )
        if is_any_known and not any(map(self.likely_slip, shown)):
            sentence += "; what is meant to be passed over begins with `_`, or is allowed by --allow-unknown"
        return sentence

    def message(self, content: bytes | Mapping[str, object] | Message | Refused) -> Message | Refused:
        """Return the observation in a JSON object, or in a record of one, or why there is none."""
        try:
            content = self._parsed(content) if isinstance(content, bytes) else content
            return content if isinstance(content, Message | Refused) else self._read(content)
        except Refused as refusal:
            return refusal

    def _parsed(self, content: bytes) -> dict[str, object]:
        if len(content) > LARGEST_MESSAGE:
            raise Refused(f"a message has at most {LARGEST_MESSAGE} bytes, and {len(content)} came")
        try:
            record = parse_json(content, "the message", Refused, any_number=True)
        except RecursionError:
            raise Refused("it is nested too deeply") from None
        if not isinstance(record, dict):
            raise Refused("it is no JSON object")
        return record

    def _read(self, record: Mapping[str, object]) -> Message:
        record = with_present_names(record, PRESENT_NAMES, "A message", Refused)
        observed = np.full(self._width, np.nan)
        given: set[int] = set()
        unreadable: dict[int, str] = {}
        passed_over: dict[str, str] = {}
        nested = ""
        for name, value in self._readings(record):
            if name == "covariance" and self._observation.modes is not None:
                observed[self._observation.count :] = self._covariance(value)
                continue
            column = self.column(name)
            if column is None:
                likely = self.likely_slip(name[:_NAME_SHOWN])
                passed_over[name] = f"probably `{likely}`" if likely else ""
                nested = nested or (name if isinstance(value, dict) else "")
                continue
            sensor, factor = column
            if sensor in given:
                raise Refused(f"sensor {sensor + 1} is given twice")
            given.add(sensor)
            shown = self._value(sensor, factor, value)
            if isinstance(shown, str):
                unreadable[sensor] = shown
            else:
                observed[sensor] = shown
        if passed_over and nested and not given:
            example = next(iter(self._index))
            raise Refused(
                f"`{nested[:_NAME_SHOWN]}` holds an object, and no sensor stands beside it: sensors stand at "
                f'the top level of a message, as in {{"step": 0, "{example}": 0.0}}'
            )
        if passed_over and not self.allows_unknown:
            raise Refused(self.unknown([*passed_over], is_any_known=bool(given)))
        step, time, control = (record.get(name) for name in OTHER_KEYS)
        if step is not None and (type(step) is not int or not 0 <= step <= LARGEST_SEED):
            raise Refused(f"`step` is a whole number from 0, and {step!r:.40} came")
        time = float(time) if type(time) is int else time
        if time is not None and not (isinstance(time, float) and math.isfinite(time)):
            raise Refused("`time` is a number")
        if control not in (None, *self._controls):
            raise Refused(f"`control` is one of {', '.join(self._controls)}, or absent")
        number = None if control is None else self._controls.index(str(control))
        return Message(
            observed,
            number,
            unreadable=unreadable,
            step=step,
            time=None if time is None else time / self._second,
            passed_over=passed_over,
        )

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
            elif name not in (*OTHER_KEYS, "unit") and not name.startswith("_"):
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


@lru_cache(maxsize=1000)
def _near(name: str, *known: str) -> str:
    """Return the names next to one, in words: kept, because finding them takes longer than a message."""
    return listing(f"`{near}`" for near in get_close_matches(name, known, 3) or known[:1])
