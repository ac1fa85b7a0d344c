"""Where the observations of watched assets come from: files, or topics of a broker."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from twin_master.errors import FleetError
from twin_master.fleet.plan import Group, asset_name, recording_files
from twin_master.fleet.watched_asset import WatchedAsset
from twin_master.run_folder import CONFIG_NAME
from twin_master.watch.broker_address import parse_broker
from twin_master.watch.feed import Feed
from twin_master.watch.feeds import file_feed
from twin_master.watch.mqtt import Topic
from twin_master.watch.mqtt_session import Session

STEPS_AT_ONCE = 64
"""Steps of one asset before the next asset is looked at."""
BUSY_SECONDS = 2.0
"""Time after which a broker with many messages lets the other sources have a turn [s]."""
LARGEST_FLEET = 100_000
"""Largest number of assets; a broker could name more of them without end."""
_LONGEST_HEADER = 100_000
"""Largest number of bytes of the header of a file."""


class BrokerMessage(Protocol):
    """A message of a broker."""

    @property
    def topic(self) -> str:
        """The topic of the message."""

    @property
    def payload(self) -> bytes | bytearray:
        """The content of the message."""


class Watcher(Protocol):
    """What sources need of the watch of a fleet; `FleetWatch` has it.

    Attributes
    ----------
    folder : Path
        The folder of the fleet.
    assets : dict of str to WatchedAsset
        The assets under watch.
    is_end_requested : bool
        Whether the watch is to end.
    final_actions : ExitStack
        The actions at the end of the watch, before the folders are released.
    """

    folder: Path
    assets: dict[str, WatchedAsset]
    is_end_requested: bool
    final_actions: ExitStack

    def note(self, sentence: str) -> None:
        """Tell the operator a sentence."""

    def advance(
        self,
        group: Group,
        name: str,
        open_feed: Callable[[], Feed],
        most_steps: int | None = None,
    ) -> int:
        """Take in what has come of an asset; return the number of steps."""

    def has_all_steps(self, asset: WatchedAsset) -> bool:
        """Return whether an asset has the steps that were wanted."""

    def lose(self, key: str, error: Exception) -> None:
        """Stop watching an asset because of an error."""


class Source(Protocol):
    """The observations of a group of real assets."""

    @property
    def has_ended(self) -> bool:
        """Whether nothing more is to be read."""

    def look(self, *, for_new_assets: bool) -> int:
        """Take in what is new; return the number of steps."""


class FileSource:
    """A file for each asset of a group, which is named after its file.

    Parameters
    ----------
    watcher : Watcher
        The watch of the fleet.
    group : Group
        The group.
    follow : bool
        Whether files grow and new ones come.

    Raises
    ------
    FleetError
        If there is no file, and none can come.
    """

    def __init__(self, watcher: Watcher, group: Group, *, follow: bool) -> None:
        if not follow and not recording_files(group.observations):
            raise FleetError(
                f"no recording fits {group.observations}; "
                "what is still to come is waited for with --follow."
            )
        self._watcher = watcher
        self._group = group
        self._follow = follow
        self._files: dict[str, Path] = {}

    @property
    def has_ended(self) -> bool:
        """Whether all files are read to their end, or as far as was wanted."""
        if self._follow:
            return False
        for name in self._files:
            asset = self._watcher.assets.get(f"{self._group.name}/{name}")
            if asset is not None and not self._is_read(asset):
                return False
        return True

    def _is_read(self, asset: WatchedAsset) -> bool:
        """Return whether the file of an asset is read to its end, or as far as was wanted."""
        return asset.watch.intake.has_ended or self._watcher.has_all_steps(asset)

    def look(self, *, for_new_assets: bool) -> int:
        """Take in what is new in the files; return the number of steps.

        Parameters
        ----------
        for_new_assets : bool
            Whether new files are searched for, too.
        """
        if for_new_assets:
            for path in recording_files(self._group.observations):
                self._add_file(path)
        scenario = self._group.scenarios[0]
        steps = 0
        for name, path in self._files.items():
            open_feed = partial(file_feed, path, scenario, follow=self._follow)
            steps += self._watcher.advance(self._group, name, open_feed, STEPS_AT_ONCE)
        return steps

    def _add_file(self, path: Path) -> None:
        """Add the file of an asset, unless its header is still being written."""
        name = asset_name(path)
        if self._files.get(name, path) != path:
            error = FleetError("another file has the same name.")
            self._watcher.lose(f"{self._group.name}/{name} of {path.name}", error)
        elif not self._follow or _has_whole_header(path):
            self._files[name] = path


def _has_whole_header(path: Path) -> bool:
    """Return whether the first line of a file that grows is whole."""
    try:
        with path.open("rb") as file:
            return file.readline(_LONGEST_HEADER).endswith(b"\n")
    except OSError:
        return False


class TopicSource:
    """A topic of a broker for each asset of a group, which is named after its last level.

    Parameters
    ----------
    watcher : Watcher
        The watch of the fleet.
    group : Group
        The group, whose observations are the address of a broker.
    authority : Path or None
        The certificate of the broker's authority.
    """

    has_ended = False  # a broker may send more at any time

    def __init__(self, watcher: Watcher, group: Group, authority: Path | None) -> None:
        broker = parse_broker(group.observations, authority, many=True)
        self._watcher = watcher
        self._group = group
        self._topic_prefix = broker.topic.removesuffix("+")
        self._session = Session(broker, group.name, watcher.folder, watcher.note, self._heartbeat)
        watcher.final_actions.callback(self._session.close)
        self._messages: Iterator[BrokerMessage | None] = self._session.receive(0.0)
        self._topics: dict[str, Topic] = {}

    def look(self, *, for_new_assets: bool) -> int:
        """Take in what the broker has sent; return the number of steps.

        Parameters
        ----------
        for_new_assets : bool
            Whether all known topics are looked at, too: what came while an asset was lost waits
            there.
        """
        begin = time.monotonic()
        steps = 0
        if not self._topics:
            self._add_topics_of_folder()
        if for_new_assets:
            for name in list(self._topics):
                steps += self._advance(name)
        while not self._watcher.is_end_requested:
            message = next(self._messages)
            if message is None:
                break
            steps += self._take_in(message)
            if time.monotonic() - begin > BUSY_SECONDS:
                break
        return steps

    def _add_topics_of_folder(self) -> None:
        """Add the topics of assets that were watched before.

        These may be silent, or have decisions that are still to be published.
        """
        group_folder = self._watcher.folder / self._group.name
        for path in sorted(group_folder.glob(f"*/{CONFIG_NAME}")):
            self._find_topic(path.parent.name)

    def _take_in(self, message: BrokerMessage) -> int:
        """Take in a message of the broker; return the number of steps."""
        name = message.topic.rpartition("/")[2]
        asset = self._watcher.assets.get(f"{self._group.name}/{name}")
        topic = self._find_topic(name)
        if topic is None or (asset is not None and self._watcher.has_all_steps(asset)):
            return 0
        topic.payloads.append(bytes(message.payload))
        return self._advance(name)

    def _find_topic(self, name: str) -> Topic | None:
        """Return the topic of an asset, a new one if need be; None if there are too many."""
        if name not in self._topics and len(self._topics) < LARGEST_FLEET:
            lose = partial(self._watcher.lose, f"{self._group.name}/{name}")
            self._topics[name] = Topic(
                self._session, self._topic_prefix + name, self._group.scenarios[0], lose
            )
        return self._topics.get(name)

    def _advance(self, name: str) -> int:
        """Take in all that has come on the topic of an asset; return the number of steps."""
        return self._watcher.advance(self._group, name, lambda: self._topics[name])

    def _heartbeat(self) -> dict[str, Any]:
        """Return what the watch tells the broker regularly."""
        watches = [topic.watch for topic in self._topics.values() if topic.watch is not None]
        return {
            "state": "watching",
            "assets": len(watches),
            "steps": sum(watch.twin.steps for watch in watches),
            "quiet": sum(watch.is_quiet for watch in watches),
            "lag": len(self._session.unread),
            "refused": sum(watch.intake.counts.rejected for watch in watches),
        }
