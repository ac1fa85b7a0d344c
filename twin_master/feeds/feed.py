"""Feeds give messages to a watch and take its decisions; those of recordings can be read again."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from reporting.arrays import Float
from reporting.errors import DamagedFileError
from reporting.formats.netcdf import read_groups
from reporting.json_file import JsonObject, JsonRecord
from twin_master.errors import MissionInputError
from twin_master.feeds.lines import GrowingFile, Position, contains, find_file
from twin_master.feeds.message import (
    LARGEST_MESSAGE,
    FeedItem,
    Message,
    MessageContent,
    MessageReader,
    Refused,
)
from twin_master.feeds.payload import PayloadReader
from twin_master.mission.journal import JOURNAL_NAME, record_of_line
from twin_master.mission.journal_packing import array_from_json
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    import xarray as xr

Decision = JsonRecord
"""A decision as it is published; `docs/how_to/watch.md` lists its keys."""
DecisionSink = Callable[[Decision], object]
"""A function that is called with each decision, once its step is in the journal."""
_TEXT_CHARACTERS = 300


class StepStatus(IntEnum):
    """Whether a message of a step has come, and with its control; journals store the numbers."""

    MISSING = 0
    """No message has come."""
    ASSUMED_CONTROL = 1
    """A message without a control has come: the assumed control may be corrected by a later one."""
    WITH_CONTROL = 2
    """A message with its control has come."""


def beginning_of(content: bytes | Refused) -> str:
    """Return the beginning of a message's text, for the list of refused messages."""
    if isinstance(content, Refused):
        return ""
    return content[:_TEXT_CHARACTERS].decode("utf-8", "replace").rstrip("\n")


class Feed:
    """A source of messages.

    The messages of this base class cannot be read twice: a resumed watch takes what comes next.
    """

    replayable = False
    """Whether a resumed watch can read the messages again from the beginning of the feed."""
    has_every_message = True
    """Whether the feed gives all messages of a logger, of which `watch.every` may thin out."""
    position: Position | None = None
    """The position after the message that was given last, if the feed is a file."""

    def __init__(self, items: Iterable[FeedItem] = ()) -> None:
        self._items = items

    @property
    def waiting_messages(self) -> int:
        """The number of messages that have come and are not read yet; 0 if it is not known."""
        return 0

    def contains_position(self, position: Position) -> bool:
        """Return whether a position belongs to this feed; False for a feed without positions."""
        return False

    def messages(self, position: Position | None) -> Iterator[FeedItem]:
        """Yield the messages after a position; all of them if it is None."""
        return iter(self._items)

    def send_decision(self, decision: Decision) -> None:
        """Send a decision to the publisher of the messages, if it accepts them."""

    def release_file(self) -> None:
        """Close the file of the feed, if any, until the next message is requested."""

    def close(self) -> None:
        """Disconnect from the publisher of the messages, or close the file."""


class RecordedFeed(Feed):
    """A file of lines that can be read again.

    Parameters
    ----------
    follow : bool
        Whether to wait at the end of the file for more, also in a file that replaces it.

    Attributes
    ----------
    longest_line : float
        The greatest length of a line [bytes].
    """

    replayable = True
    longest_line: float = LARGEST_MESSAGE

    def __init__(self, path: Path, scenario: Scenario, *, follow: bool = False) -> None:
        super().__init__()
        self.path = path
        self.follow = follow
        self.scenario = scenario
        self.reader = MessageReader(scenario)
        self._lines_of_file: GrowingFile | None = None

    def contains_position(self, position: Position) -> bool:
        """Return whether a position is in this file or, if it is followed, in a rotated one."""
        with self.open_file(position) as file:
            return contains(file, position)

    def open_file(self, position: Position | None) -> BinaryIO:
        """Open the file that contains a position, or else the file at the path."""
        file = find_file(self.path, position, follow=self.follow) or self.path
        return file.open("rb", buffering=0)

    def messages(self, position: Position | None) -> Iterator[FeedItem]:
        """Yield each message after a position of the file, with the beginning of its text.

        As long as the file has no further line, (None, "") is yielded. `self.position` becomes the
        end of a line before the last of its messages is yielded, or at once if it has no message.

        Parameters
        ----------
        position : Position or None
            Where reading begins; None for the beginning of the file.
        """
        followed_path = self.path if self.follow else None
        lines = GrowingFile(self.open_file(position), position, followed_path)
        lines.longest = self.longest_line
        self._lines_of_file = lines
        for line in lines:
            content: MessageContent | None = line
            if isinstance(line, bytes):
                content = self.content_of(line, lines.begin)
            if line is None or content is None:
                self.position = lines.position
                if line is None:
                    yield None, ""
                continue
            messages = self.read_content(content)
            # A watch that ends between the messages of a line reads the whole line again
            for message in messages[:-1]:
                yield message, beginning_of(line)
            self.position = lines.position
            for message in messages[-1:]:  # none if the line has no message
                yield message, beginning_of(line)

    def release_file(self) -> None:
        """Close the file until the next message is requested; see `GrowingFile.release`."""
        if self.follow and self._lines_of_file is not None:
            self._lines_of_file.release()

    def close(self) -> None:
        """Close the file; no further message is read."""
        if self._lines_of_file is not None:
            self._lines_of_file.close()

    def read_content(self, content: MessageContent) -> Sequence[Message | Refused]:
        """Return the messages in a line, or the reasons why there are none."""
        return [self.reader.read(content)]

    def content_of(self, line: bytes, begin: int) -> MessageContent | None:
        """Return the message in a line; None if the line is not a message.

        Parameters
        ----------
        line : bytes
            The line, with its line feed.
        begin : int
            Where the line begins in the file [bytes].
        """
        return line


class LinesFeed(RecordedFeed):
    """A file with a payload in each line: JSON, JSON of Telegraf, or line protocol."""

    def __init__(self, path: Path, scenario: Scenario, *, follow: bool = False) -> None:
        super().__init__(path, scenario, follow=follow)
        self._payloads = PayloadReader(scenario)

    def read_content(self, content: MessageContent) -> Sequence[Message | Refused]:
        """Return the messages in a payload, or the reasons why there are none."""
        return self._payloads.read(content)


class RunFeed(RecordedFeed):
    """A NetCDF file with the group `observed` of a run: observations, and controls in force.

    Raises
    ------
    MissionInputError
        If the file cannot be read, or has other sensors or controls than the scenario.
    """

    has_every_message = False

    def __init__(self, path: Path, scenario: Scenario) -> None:
        super().__init__(path, scenario)
        role = scenario.observation.role
        try:
            group: xr.Dataset = read_groups(path)["observed"].to_dataset()
            records = self._records_of(group)
        except (DamagedFileError, KeyError, ValueError, TypeError, OSError) as error:
            reason = str(error).rstrip(".")
            raise MissionInputError(
                f"{path} is not a NetCDF file with `observed/{role}` (step, sensor): {reason}."
            ) from None
        self._lines = "".join(f"{json.dumps(record)}\n" for record in records).encode()

    def _records_of(self, group: xr.Dataset) -> list[JsonObject]:
        """Return a message for each step of the group `observed`, with the keys of JSON messages.

        A message contains the sensors, the step, and, if the group has them, the readings of
        inspections, the covariance of identified modes, and the control in force.
        """
        role = self.scenario.observation.role
        rows = group[role].values.tolist()
        controls = []
        if "control_index" in group:
            controls = group["control_index"].values.tolist()
        self._check_shape(group, rows, controls)
        records: list[JsonObject] = []
        for row, step in zip(rows, group["step"].values.tolist(), strict=True):
            records.append({role: row, "step": int(step)})
        for reading in self.scenario.inspection_readings:
            if reading.name in group:
                values = group[reading.name].values.tolist()
                for record, value in zip(records, values, strict=True):
                    if math.isfinite(value):
                        record[reading.name] = value
        covariance = group.get(f"{role}_covariance")  # of modes
        if covariance is not None:
            for record, triangle in zip(records, covariance.values, strict=False):
                record["covariance"] = self._symmetric_matrix(triangle).tolist()
        for record, control in zip(records, controls, strict=False):
            record["control"] = self.scenario.control_names[int(control)]
        return records

    def _check_shape(
        self, group: xr.Dataset, rows: Sequence[Sequence[float]], controls: Sequence[int]
    ) -> None:
        """Raise an error for another number of sensors, or unknown controls."""
        count = self.scenario.observation.count
        lengths = {len(row) for row in rows}
        known_controls = range(len(self.scenario.control_names))
        has_unknown_control = any(control not in known_controls for control in controls)
        if not lengths <= {count} or has_unknown_control:
            shape = group[self.scenario.observation.role].shape
            raise ValueError(
                f"{count} sensors and the controls of the scenario are expected, but the shape "
                f"{shape} was given"
            )

    def _symmetric_matrix(self, triangle: Float) -> Float:
        """Return the symmetric covariance (G, G) with this lower triangle, row by row.

        A missing covariance (NaN) becomes zero.
        """
        count = self.scenario.observation.count
        matrix = np.zeros((count, count))
        matrix[np.tril_indices(count)] = np.nan_to_num(triangle)
        symmetric: Float = matrix + np.tril(matrix, -1).T
        return symmetric

    def open_file(self, position: Position | None) -> BinaryIO:
        """Return the messages as a file with a line of JSON for each step."""
        return io.BytesIO(self._lines)


class FolderFeed(RecordedFeed):
    """The journal of another run or watch, of any version, with its observations as they came.

    A damaged line is refused, and reading continues after it.

    Raises
    ------
    MissionInputError
        If the folder has no journal.
    """

    has_every_message = False
    longest_line = math.inf

    def __init__(self, folder: Path, scenario: Scenario) -> None:
        super().__init__(folder / JOURNAL_NAME, scenario)
        if not self.path.is_file():
            raise MissionInputError(
                f"{folder} holds no journal of a run or a watch ({JOURNAL_NAME})."
            )

    def content_of(self, line: bytes, begin: int) -> MessageContent | None:
        """Return the observation in a line of the journal, or the reason why it is refused.

        The result is None if the line has no observation, or if it is the incomplete last line of a
        process that was killed.

        Parameters
        ----------
        line : bytes
            The line, with its line feed if it is complete.
        begin : int
            Where the line begins in the journal [bytes].
        """
        record = record_of_line(line, self.path)  # None if the checksum or the JSON is wrong
        if record is None and line.endswith(b"\n"):
            number = self.path.read_bytes()[:begin].count(b"\n") + 1
            return Refused(f"line {number} of {self.path.name} was changed or is damaged")
        if record is None or "observed" not in record:
            return None
        try:
            return self._message_of(record)
        except (KeyError, TypeError, ValueError, IndexError):
            return Refused("the line has another layout")

    def _message_of(self, line: JsonRecord) -> Message | Refused | None:
        """Return the observation in a line of the journal; None if its step had no message.

        A journal of an asset with other sensors or controls is refused.
        """
        observed_values = array_from_json(line["observed"])
        control = int(line["control_index"])
        line_step = int(line["step"])
        step = int(line.get("observation_step", line_step))
        status = StepStatus.WITH_CONTROL  # a line of a simulated mission has no intake
        if "intake" in line:
            # `given` has a character for the status of each step that may still be revised. The
            # last one belongs to `line_step`, so that `step` has the negative index below.
            character = line["intake"]["given"][step - line_step - 1]
            status = StepStatus(int(character))
        if status is StepStatus.MISSING:
            return None
        count = self.scenario.observation.count
        width = self.scenario.row_width
        if len(observed_values) not in (count, width) or control >= len(self.scenario.control):
            return Refused("it is of an asset with other sensors or controls")
        row = np.full(width, np.nan)
        row[: len(observed_values)] = (
            observed_values  # a journal without covariances has only the sensors
        )
        has_assumed_control = status is not StepStatus.WITH_CONTROL
        return Message(row, control, step=step, assumed=has_assumed_control)
