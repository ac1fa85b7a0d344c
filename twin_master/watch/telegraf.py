"""Metrics as Telegraf writes them in JSON, alone or as a batch."""

from collections.abc import Iterator, Mapping

from twin_master.watch.message import Refused
from twin_master.watch.points import FieldValue, Point

_BATCH = "metrics"
_FIELDS = "fields"


def is_of_telegraf(record: Mapping[str, object]) -> bool:
    """Return whether a JSON object is a metric of Telegraf, or a batch of them."""
    if isinstance(record.get(_BATCH), list):
        return True
    return isinstance(record.get(_FIELDS), dict) and ("name" in record or "timestamp" in record)


def points_of_telegraf(record: Mapping[str, object]) -> list[Point]:
    """Return the points in a metric or a batch of metrics.

    Nested fields are called by the names on the way to them, with `_` between, as Telegraf itself
    flattens JSON.

    Raises
    ------
    Refused
        If an entry of a batch is not a metric, or if a timestamp is not a number.
    """
    metrics = record.get(_BATCH)
    if not isinstance(metrics, list):
        return [_point_of_metric(record)]
    return [_point_of_metric(metric) for metric in metrics]


def _point_of_metric(metric: object) -> Point:
    """Return the point in a metric; see `points_of_telegraf`."""
    if not isinstance(metric, Mapping):
        raise Refused(f"a metric of Telegraf is an object, but {metric!r:.40} was given")
    fields = metric.get(_FIELDS)
    tags = metric.get("tags") or {}
    if not isinstance(fields, Mapping) or not isinstance(tags, Mapping):
        raise Refused("a metric of Telegraf has the objects `fields` and `tags`")
    return Point(
        str(metric.get("name", "")),
        dict(_flattened(fields)),
        {str(name): str(tag) for name, tag in tags.items()},
        _timestamp_of_metric(metric.get("timestamp")),
    )


def _timestamp_of_metric(timestamp: object) -> float | None:
    """Return the timestamp of a metric; None if it has none."""
    if timestamp is None:
        return None
    if isinstance(timestamp, bool) or not isinstance(timestamp, int | float):
        raise Refused(
            f"its timestamp is {timestamp!r:.40}, and a number is expected: leave out "
            "`json_timestamp_format` in Telegraf's configuration"
        )
    return timestamp


def _flattened(fields: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, FieldValue]]:
    """Yield the name and the value of each field; nested ones with the names on the way."""
    for name, value in fields.items():
        if isinstance(value, Mapping):
            yield from _flattened(value, f"{prefix}{name}_")
        else:
            yield f"{prefix}{name}", value
