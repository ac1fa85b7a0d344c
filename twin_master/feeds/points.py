"""Points of a time series, in line protocol or as metrics of Telegraf."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from twin_master.feeds.message import Refused

FieldValue = object
"""The value of a field: a number, a truth value, a text, or a list of these."""
_VALUE_FIELD = "value"
"""The name of a field that says nothing: such a field is called by the measurement."""
_RANGES_SINCE_1970 = ((1e8, 1.0), (1e11, 1e3), (1e14, 1e6), (1e17, 1e9))
"""The least timestamp in s, ms, us and ns that counts from 1970, and the length of a second in it.

Each range ends where the next one begins. In seconds they are the years from 1973 to 5138.
"""
_LARGEST_TIMESTAMP = 1e20


@dataclass(frozen=True)
class Point:
    """The values of some fields at a time.

    Attributes
    ----------
    measurement : str
        The measured quantity.
    tags : dict of str to str
        The source of the values.
    timestamp : int, float or None
        The time since 1970 in s, ms, us or ns; None without a time.
    """

    measurement: str
    fields: Mapping[str, FieldValue]
    tags: Mapping[str, str] = field(default_factory=dict)
    timestamp: float | None = None


def seconds_since_1970(timestamp: float) -> float:
    """Return a timestamp in seconds; its magnitude shows its unit.

    Raises
    ------
    Refused
        If it lies before the year 1973 in each unit, or after the year 5138.
    """
    seconds = math.nan
    if timestamp < _LARGEST_TIMESTAMP:
        for least, units_per_second in _RANGES_SINCE_1970:
            if timestamp >= least:
                seconds = timestamp / units_per_second
    if math.isnan(seconds):
        raise Refused(
            f"its timestamp is {timestamp!r:.40}, and one that counts from 1970 in s, ms, us or ns "
            "is expected; for another clock send a field `step` or `time`"
        )
    return seconds


def values_by_timestamp(points: Iterable[Point]) -> dict[float | None, dict[str, object]]:
    """Return the values of points at each time, under the keys of a JSON message.

    The key of a field is its own name, or the measurement if the field is called `value`. Of the
    tags, only `control` is read.

    Raises
    ------
    Refused
        If two points at one time have different values under one name.
    """
    values_of_time: dict[float | None, dict[str, object]] = {}
    for point in points:
        values = values_of_time.setdefault(point.timestamp, {})
        if "control" in point.tags:
            _add_value(values, "control", point.tags["control"])
        for name, value in point.fields.items():
            _add_value(values, point.measurement if name == _VALUE_FIELD else name, value)
    return values_of_time


def _add_value(values: dict[str, object], name: str, value: FieldValue) -> None:
    """Add a value to those at a time; refuse it if there is another one under its name."""
    former_value = values.setdefault(name, value)
    if former_value is not value and former_value != value:
        raise Refused(
            f"`{name[:60]}` has two values at one time: each sensor needs a field of its own, such "
            "as `strain_7`, which the processor `pivot` of Telegraf makes of a tag"
        )
