"""Decisions of a watch as points of a time series, for InfluxDB and readers of line protocol."""

import time
from collections.abc import Callable, Iterator, Mapping
from math import isfinite
from pathlib import Path

from reporting.files import explained_write_errors
from reporting.words import in_one_line
from twin_master.feeds.feed import Decision
from twin_master.feeds.line_protocol import write_line
from twin_master.feeds.points import Point

MEASUREMENT = "uav_twin"
"""The measurement of a decision, and how the names of the others begin."""
_PLAIN_FIELDS = ("step", "control", "next_control", "state_believed", "lost_sensors")


def decision_points(decision: Decision, asset: str, timestamp: int) -> Iterator[Point]:
    """Yield the points of a decision; before the first step, those of its notices alone.

    Parameters
    ----------
    decision : mapping
        The decision, as a watch publishes it.
    asset : str
        The name of the asset, which becomes the tag `asset` of each point.
    timestamp : int
        The time of the decision since 1970 [ns].
    """
    if "health" in decision:
        fields = {name: decision[name] for name in _PLAIN_FIELDS}
        fields["next_control_probability"] = decision["probability"]
        fields["log_evidence"] = decision["log_evidence"]
        yield Point(MEASUREMENT, _with_value(fields), {"asset": asset}, timestamp)
        for name, health in decision["health"].items():
            moments = {key: health[key] for key in ("mean", "standard_deviation")}
            tags = {"asset": asset, "state": name, "unit": health["unit"]}
            if _with_value(moments):
                yield Point(f"{MEASUREMENT}_state", _with_value(moments), tags, timestamp)
        for name, probability in decision.get("hypotheses", {}).items():
            tags = {"asset": asset, "hypothesis": name}
            fields = {"probability": float(probability)}
            yield Point(f"{MEASUREMENT}_hypothesis", fields, tags, timestamp)
    # points of one series and one time would replace each other: notices are a nanosecond apart
    for number, notice in enumerate(decision.get("notices", ())):
        tags = {"asset": asset, "kind": notice["kind"]}
        fields = {"sentence": in_one_line(notice["sentence"])}
        if "step" in decision:
            fields["step"] = decision["step"]
        yield Point(f"{MEASUREMENT}_notice", fields, tags, timestamp + number)


def _with_value(fields: Mapping[str, object]) -> dict[str, object]:
    """Return fields that have a value, with numbers of NumPy as those of Python."""
    with_value: dict[str, object] = {}
    for name, value in fields.items():
        if isinstance(value, float):
            if isfinite(value):
                with_value[name] = float(value)
        elif value is not None:
            with_value[name] = value
    return with_value


class DecisionLines:
    """Appends the decisions of a watch to a file, in line protocol.

    Parameters
    ----------
    path : Path
        The file; it is made if it does not exist.
    asset : str
        The name of the asset.
    clock : callable
        Returns the time since 1970 [ns].

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """

    def __init__(self, path: Path, asset: str, clock: Callable[[], int] = time.time_ns) -> None:
        self._path = path
        self._asset = asset
        self._clock = clock
        self._append("")

    def write(self, decision: Decision) -> None:
        """Append the lines of a decision, so that a program that follows the file sees them."""
        points = decision_points(decision, self._asset, self._clock())
        self._append("".join(f"{write_line(point)}\n" for point in points))

    def _append(self, text: str) -> None:
        """Append a text to the file."""
        with explained_write_errors(self._path), self._path.open("a", encoding="utf-8") as file:
            file.write(text)
