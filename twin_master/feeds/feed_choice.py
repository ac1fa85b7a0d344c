"""The feed of the observations that a user names: a file, standard input, a program, a broker."""

import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO

import numpy as np

from twin_master.errors import MissionInputError
from twin_master.feeds.broker_address import Broker, is_broker, parse_broker
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.feeds.feed import Feed, FolderFeed, LinesFeed, RunFeed, beginning_of
from twin_master.feeds.line_protocol import looks_like_line_protocol
from twin_master.feeds.lines import Pipe, first_line
from twin_master.feeds.message import FeedItem, Refused
from twin_master.feeds.payload import PayloadReader
from twin_master.scenario.schema import Scenario

Observations = Iterable[Mapping[str, object]] | str | Path
"""Messages of a program, or a file, an address, or "-" for standard input."""
STANDARD_INPUT = "-"
_SUFFIXES_OF_PAYLOADS = (".json", ".jsonl", ".ndjson", ".lp", ".influx")


def _read_messages(
    scenario: Scenario, contents: Iterable[bytes | Refused | None]
) -> Iterator[FeedItem]:
    """Yield the messages in each payload, with the beginning of its text.

    None means, in the payloads and in the result, that nothing has come yet.
    """
    payloads = PayloadReader(scenario)
    for content in contents:
        if content is None:
            yield None, ""
            continue
        for message in payloads.read(content):
            yield message, beginning_of(content)


def feed_of_lines(scenario: Scenario, stream: IO[bytes]) -> Feed:
    """Return the feed of a stream whose lines are JSON objects, or line protocol.

    If the scenario asks for a notice when no messages come, the stream is polled.
    """
    notices_silence = scenario.watch.quiet_after_seconds is not None
    return Feed(_read_messages(scenario, Pipe(stream, polls=notices_silence)))


def feed_of_mappings(scenario: Scenario, messages: Iterable[Mapping[str, object]]) -> Feed:
    """Return the feed of a program's messages, which may have arrays and scalars of NumPy."""
    contents = (
        json.dumps(message, default=lambda value: np.asarray(value).tolist()).encode()
        for message in messages
    )
    return Feed(_read_messages(scenario, contents))


def file_feed(
    path: Path, scenario: Scenario, *, follow: bool = False
) -> CsvFeed | LinesFeed | RunFeed | FolderFeed:
    """Return the feed of a run folder or a file, recognised by its name or first line.

    A file is NetCDF if its name ends with `.nc`. One that begins with a JSON object or with line
    protocol has a payload on each line. Every other file is CSV.

    Parameters
    ----------
    scenario : Scenario
        The scenario of the asset.
    follow : bool
        Whether to wait at the end of a text file for more.

    Raises
    ------
    MissionInputError
        If the file cannot be read, or if it is recorded and is to be followed.
    """
    if not path.exists():
        raise MissionInputError(f"there is no file {path} to read observations from.")
    is_netcdf = path.suffix.lower() == ".nc"
    if follow and (path.is_dir() or is_netcdf):
        raise MissionInputError(
            f"{path} is recorded: only a file of text can be followed (CSV, JSON lines, line "
            "protocol)."
        )
    if path.is_dir():
        return FolderFeed(path, scenario)
    if is_netcdf:
        return RunFeed(path, scenario)
    if _has_payloads(path):
        return LinesFeed(path, scenario, follow=follow)
    return CsvFeed(path, scenario, follow=follow)


def _has_payloads(path: Path) -> bool:
    """Return whether each line of a file is a payload; a CSV file begins with column names.

    The name of the file decides if it is still empty.
    """
    with MissionInputError.instead_of(OSError, before=f"{path} cannot be read: ", after="."):
        beginning = first_line(path).decode("utf-8", "replace").lstrip()
    if not beginning:
        return path.suffix.lower() in _SUFFIXES_OF_PAYLOADS
    return beginning.startswith("{") or looks_like_line_protocol(beginning)


def choose_feed(
    observations: Observations | None,
    scenario: Scenario,
    *,
    follow: bool,
    authority: Path | None,
    default: str | None,
) -> Feed | Broker:
    """Return the feed of observations, or the broker from which they come.

    Parameters
    ----------
    observations : Observations or None
        The observations that the user names. If None, the recording in the scenario is used, and
        `default` if there is none.
    follow : bool
        Whether to wait at the end of a file of text for more.
    authority : Path or None
        The certificate file of a broker's authority.

    Raises
    ------
    MissionInputError
        If there are no observations, or if they cannot be read.
    """
    for candidate in (observations, scenario.watch.recording, default):
        if candidate is not None:
            if not isinstance(candidate, str | Path):
                return feed_of_mappings(scenario, candidate)
            if is_broker(str(candidate)):
                return parse_broker(str(candidate), authority)
            if str(candidate) != STANDARD_INPUT:
                return file_feed(Path(candidate), scenario, follow=follow)
            if follow:
                raise MissionInputError(
                    "--follow belongs to a file; standard input is read to its end anyway."
                )
            return feed_of_lines(scenario, sys.stdin.buffer)
    raise MissionInputError(
        f"{scenario.mission.name} names no recording: give the observations that are to be watched."
    )
