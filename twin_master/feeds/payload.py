"""A publisher's payload in any form: our JSON, JSON of Telegraf, or line protocol."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from twin_master.feeds.line_protocol import looks_like_line_protocol, parse_line
from twin_master.feeds.message import (
    LARGEST_MESSAGE,
    Message,
    MessageContent,
    MessageReader,
    Refused,
)
from twin_master.feeds.points import (
    FieldValue,
    Point,
    seconds_since_1970,
    values_by_timestamp,
)
from twin_master.scenario.schema import Scenario

_BATCH = "metrics"
_FIELDS = "fields"


class PayloadReader:
    """Reads payloads; their form is recognised by their beginning.

    Attributes
    ----------
    reader : MessageReader
        The reader of a single message.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.reader = MessageReader(scenario)

    def read(self, content: MessageContent) -> list[Message | Refused]:
        """Return the messages in a payload, in their order, or the reasons why there are none.

        A JSON object is one message. Metrics of Telegraf, and lines of line protocol, give a
        message for each of their times. The list is empty if there are only comments.
        """
        try:
            if isinstance(content, bytes):
                text = self._line_protocol_in(content)
                if text is not None:
                    return self._read_lines(text)
                content = self.reader.parse(content)
            if not isinstance(content, Message | Refused) and is_of_telegraf(content):
                return self._read_points(points_of_telegraf(content))
        except Refused as refusal:
            return [refusal]
        return [self.reader.read(content)]

    def _line_protocol_in(self, content: bytes) -> str | None:
        """Return the text of a payload if it looks like line protocol; else None."""
        if len(content) > LARGEST_MESSAGE:
            return None  # the reader of messages refuses it
        try:
            text = content.decode()
        except UnicodeDecodeError:
            return None
        return text if looks_like_line_protocol(text) else None

    def _read_lines(self, text: str) -> list[Message | Refused]:
        """Return the messages in lines of line protocol; an invalid line is refused alone."""
        refusals: list[Message | Refused] = []
        points = []
        for line in text.split("\n"):
            try:
                point = parse_line(line)
            except ValueError as error:
                refusals.append(Refused(f"it is not line protocol: {error}"))
                continue
            if point is not None:
                points.append(point)
        return refusals + self._read_points(points)

    def _read_points(self, points: Sequence[Point]) -> list[Message | Refused]:
        """Return a message for each time of some points."""
        try:
            values_of_time = values_by_timestamp(points)
        except Refused as refusal:
            return [refusal]
        messages: list[Message | Refused] = []
        for timestamp, values in values_of_time.items():
            message = self.reader.read(values)
            # A step or time among the values comes before the timestamp of the points.
            if (
                isinstance(message, Message)
                and message.step is None
                and message.time is None
                and timestamp is not None
            ):
                try:
                    message = replace(message, time=seconds_since_1970(timestamp))
                except Refused as refusal:
                    message = refusal
            messages.append(message)
        return messages


def is_of_telegraf(record: Mapping[str, object]) -> bool:
    """Return whether a JSON object is a metric of Telegraf, or a batch of them."""
    if isinstance(record.get(_BATCH), list):
        return True
    return isinstance(record.get(_FIELDS), dict) and ("name" in record or "timestamp" in record)


def points_of_telegraf(record: Mapping[str, object]) -> list[Point]:
    """Return the points in a metric or a batch of metrics.

    Nested fields are named by the path to them, joined by `_`, as Telegraf itself flattens JSON.

    Raises
    ------
    Refused
        If an entry of a batch is not a metric, or a timestamp is not a number.
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
