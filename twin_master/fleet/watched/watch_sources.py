"""Sources of watched assets' observations: files, or topics of a broker."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Protocol

from twin_master.errors import FleetError
from twin_master.feeds.broker_address import parse_broker
from twin_master.feeds.feed import Feed
from twin_master.feeds.feed_choice import file_feed
from twin_master.feeds.mqtt_session import Session
from twin_master.fleet.plan import Group, asset_name, recording_files
from twin_master.fleet.watched.watched_asset import WatchedAsset
from twin_master.run_folder import CONFIG_NAME
from twin_master.watch.mqtt import Topic

STEPS_AT_ONCE = 64
"""Largest number of steps of one asset that are processed before the next asset has its turn."""
BUSY_SECONDS = 2.0
"""Longest time for which one source reads messages before the next source has its turn [s]."""
LARGEST_FLEET = 100_000
"""Largest number of assets, because a broker can send messages on any number of topics."""
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
    """The part of a fleet's watch that sources use; `FleetWatch` implements it.

    Attributes
    ----------
    is_end_requested : bool
        Whether the operator has requested the end of the watch.
    final_actions : ExitStack
        The actions at the end of the watch, before the folders are released.
    """

    folder: Path
    assets: dict[str, WatchedAsset]
    is_end_requested: bool
    final_actions: ExitStack

    def note(self, sentence: str) -> None:
        """Notify the operator by a sentence."""

    def advance(
        self,
        group: Group,
        name: str,
        open_feed: Callable[[], Feed],
        most_steps: int | None = None,
    ) -> int:
        """Process the new observations of an asset; return the number of steps."""

    def has_all_steps(self, asset: WatchedAsset) -> bool:
        """Return whether an asset has reached the requested number of steps."""

    def interrupt(self, key: str, error: Exception) -> None:
        """Interrupt the watch of an asset because of an error."""


class ObservationSource(Protocol):
    """The observations of a group of real assets."""

    @property
    def has_ended(self) -> bool:
        """Whether all observations are read and no more can come."""

    def poll(self, *, searches: bool) -> int:
        """Process the new observations of all assets, and return the number of new steps.

        Parameters
        ----------
        searches : bool
            Whether a search for new assets is due, which is not made at every poll.
        """


class FileSource:
    """A file for each asset of a group; the asset is named after its file.

    Parameters
    ----------
    follow : bool
        Whether to wait for new lines in the files and for new files.

    Raises
    ------
    FleetError
        If there is no file and `follow` is false.
    """

    def __init__(self, watcher: Watcher, group: Group, *, follow: bool) -> None:
        if not follow and not recording_files(group.observations):
            raise FleetError(
                f"no recording matches {group.observations}; give --follow to wait for recordings "
                "that are still to come."
            )
        self._watcher = watcher
        self._group = group
        self._follow = follow
        self._files: dict[str, Path] = {}

    @property
    def has_ended(self) -> bool:
        """Whether all files are read to their end, or to the requested number of steps."""
        if self._follow:
            return False
        for name in self._files:
            asset = self._watcher.assets.get(f"{self._group.name}/{name}")
            if asset is None:
                continue
            if not asset.watch.intake.has_ended and not self._watcher.has_all_steps(asset):
                return False
        return True

    def poll(self, *, searches: bool) -> int:
        """Process the new lines of all assets' files, and return the number of new steps.

        Parameters
        ----------
        searches : bool
            Whether a search is due: for files of new assets.
        """
        if searches:
            for path in recording_files(self._group.observations):
                name = asset_name(path)
                if self._files.get(name, path) != path:
                    error = FleetError("another file has the same name.")
                    self._watcher.interrupt(f"{self._group.name}/{name} of {path.name}", error)
                elif not self._follow or _has_whole_header(path):
                    self._files[name] = path
        scenario = self._group.scenarios[0]  # real assets of a group share one scenario
        steps = 0
        for name, path in self._files.items():
            open_feed = partial(file_feed, path, scenario, follow=self._follow)
            steps += self._watcher.advance(self._group, name, open_feed, STEPS_AT_ONCE)
        return steps


def _has_whole_header(path: Path) -> bool:
    """Return whether the first line of a file is complete; False if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.readline(_LONGEST_HEADER).endswith(b"\n")
    except OSError:
        return False


class TopicSource:
    """A topic of a broker for each asset of a group; its last level names the asset.

    Parameters
    ----------
    group : Group
        The group, whose observations are the address of a broker.
    authority : Path or None
        The certificate of the broker's authority.
    """

    has_ended = False  # a broker may send more at any time

    def __init__(self, watcher: Watcher, group: Group, authority: Path | None) -> None:
        broker = parse_broker(group.observations, authority, has_many_assets=True)
        self._watcher = watcher
        self._group = group
        self._topic_prefix = broker.topic.removesuffix("+")
        self._session = Session(broker, group.name, watcher.folder, watcher.note, self._heartbeat)
        watcher.final_actions.callback(self._session.close)
        self._messages: Iterator[BrokerMessage | None] = self._session.receive(0.0)
        self._topics: dict[str, Topic] = {}

    def poll(self, *, searches: bool) -> int:
        """Process the messages that the broker has sent; return the number of steps.

        A message on a new topic begins the watch of a new asset.

        Parameters
        ----------
        searches : bool
            Whether a search is due: the queues of all known topics are processed first, because
            messages came while the watch of their asset was interrupted by an error.
        """
        begin = time.monotonic()
        steps = 0
        if not self._topics:
            # Assets that were watched before may send nothing for a long time, or have decisions
            # that are not published yet.
            group_folder = self._watcher.folder / self._group.name
            for path in sorted(group_folder.glob(f"*/{CONFIG_NAME}")):
                self._find_topic(path.parent.name)
        if searches:
            for name in list(self._topics):
                steps += self._advance(name)
        while not self._watcher.is_end_requested:
            message = next(self._messages)
            if message is None:  # none has come; the iterator itself never ends
                break
            steps += self._take_in(message)
            if time.monotonic() - begin > BUSY_SECONDS:
                break
        return steps

    def _take_in(self, message: BrokerMessage) -> int:
        """Queue a message at its topic and process the topic; return the number of new steps.

        It is ignored if its asset has all requested steps, or if there are too many assets.
        """
        name = message.topic.rpartition("/")[2]
        asset = self._watcher.assets.get(f"{self._group.name}/{name}")
        topic = self._find_topic(name)
        if topic is None or (asset is not None and self._watcher.has_all_steps(asset)):
            return 0
        topic.payloads.append(bytes(message.payload))
        return self._advance(name)

    def _find_topic(self, name: str) -> Topic | None:
        """Return the topic of an asset, created if it is new; None if there are too many."""
        if name not in self._topics and len(self._topics) < LARGEST_FLEET:
            interrupt = partial(self._watcher.interrupt, f"{self._group.name}/{name}")
            self._topics[name] = Topic(
                self._session, self._topic_prefix + name, self._group.scenarios[0], interrupt
            )
        return self._topics.get(name)

    def _advance(self, name: str) -> int:
        """Process all messages in the queue of an asset's topic; return the number of steps."""
        return self._watcher.advance(self._group, name, lambda: self._topics[name])

    def _heartbeat(self) -> dict[str, object]:
        """Return the state of the watch, which the session publishes at regular intervals."""
        # A topic has no watch until one is attached to it.
        watches = [topic.watch for topic in self._topics.values() if topic.watch is not None]
        quiet_watches = [watch for watch in watches if watch.is_quiet]
        return {
            "state": "watching",
            "assets": len(watches),
            "steps": sum(watch.twin.steps for watch in watches),
            "quiet": len(quiet_watches),
            "lag": len(self._session.unread),
            "refused": sum(watch.intake.counts.rejected for watch in watches),
        }
