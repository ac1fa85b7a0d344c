"""The watch of many real assets by one process; each has the folder of a `uav-twin watch`."""

import json
import re
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from reporting.errors import DiskFullError
from reporting.files import atomic_write_text, explained_write_errors
from reporting.json_file import JsonObject, JsonRecord
from reporting.progress import SilentProgress
from reporting.system.operating_system import allow_many_files
from twin_master.errors import FleetError
from twin_master.feeds.broker_address import is_broker
from twin_master.feeds.feed import Feed
from twin_master.fleet.configuration import locked_fleet_folder
from twin_master.fleet.plan import Fleet, Group
from twin_master.fleet.watched.watch_sources import (
    LARGEST_FLEET,
    FileSource,
    ObservationSource,
    TopicSource,
)
from twin_master.fleet.watched.watched_asset import STATE_NAME, WatchedAsset, read_watched_state
from twin_master.mission.plant import FLIGHT_ERRORS
from twin_master.run_folder import CONFIG_NAME, WATCHED_FLEET_KIND
from twin_master.watch.folder import Watch
from twin_master.watch.mqtt import Topic
from twin_master.watch.workflow import begin_watch, resume_watch

SEARCH_SECONDS = 2.0
"""Time between two searches for new assets [s]."""
STATE_SECONDS = 2.0
"""Shortest time between two writings of the state [s]."""
FIRST_WAIT_SECONDS = 30.0
"""Time until the watch of an asset is resumed after an error [s].

It doubles each time the same error comes again.
"""
LONGEST_WAIT_SECONDS = 3600.0
"""Largest time until the watch of an asset is resumed after an error [s]."""
IDLE_SECONDS = 0.05
"""Shortest pause if no message has come [s]."""
LONGEST_IDLE = 1.0
"""Longest pause if no message has come [s]."""
BUSY_FRACTION = 0.2
"""Fraction of a processor's time that polling sources without new messages may take."""
FURTHER_FILES = 60
"""Files beside the observations that are followed: what is opened for a moment, and connections.

An asset itself keeps no file open: its journal is opened for each line, and the lock of the fleet's
folder is that of all assets.
"""
STATE_BYTES_PER_STEP = 0.1
"""Fraction of the time that the writing of the state may take."""
_ASSET_NAME = re.compile(r"\w[\w.-]{0,63}")


@dataclass
class _Interruption:
    """An error that has interrupted the watch of an asset.

    Attributes
    ----------
    wait : float
        The time from the error until the watch is resumed [s].
    resume_time : float
        The time on the monotonic clock at which the watch is resumed [s].
    """

    sentence: str
    wait: float
    resume_time: float


class FleetWatch:
    """The watch of a fleet of real assets by this process.

    Parameters
    ----------
    folder : Path
        The folder of the fleet, with the folder of a watch for each asset; a fleet that was watched
        there before is resumed.
    receive_decision : callable
        Called with the asset and each of its decisions, once the decision is in the journal.
    note : callable
        Called with sentences for the operator: about brokers, and errors that interrupt the watch
        of an asset.
    follow : bool
        Whether to wait for new lines in the files and for new files.
    steps : int, optional
        The number of steps after which no more observations of an asset are processed.
    authority : Path, optional
        The certificate of the authority that has signed the broker's.

    Raises
    ------
    FleetError, MissionInputError
        If a group is of simulated assets, if it has no recording, or if an address is wrong.
    RunFolderError, NotResumableError
        If the folder holds something else, or was begun with another version.

    Attributes
    ----------
    assets : dict of str to WatchedAsset
        The watched assets by GROUP/NAME, without those that an error has interrupted.
    state : dict
        The records of all assets as last written to the file; see `read_watched_state`.
    is_end_requested : bool
        Whether the watch is to end after the present step.
    """

    def __init__(
        self,
        fleet: Fleet,
        folder: Path,
        receive_decision: Callable[[WatchedAsset, JsonRecord], None],
        note: Callable[[str], None],
        *,
        follow: bool = False,
        steps: int | None = None,
        authority: Path | None = None,
    ) -> None:
        self.folder = folder
        self.assets: dict[str, WatchedAsset] = {}
        self.is_end_requested = False
        self.folder_locks = ExitStack()
        self.final_actions = ExitStack()
        self._receive_decision = receive_decision
        self._note = note
        self._wanted_steps = steps
        self._interruptions: dict[str, _Interruption] = {}
        # The first watch of each group: the other watches share the knowledge of its twin.
        self._sibling: dict[str, Watch] = {}
        _check_observed(fleet)
        self._sources: list[ObservationSource] = []
        for group in fleet.groups:
            if is_broker(group.observations):
                self._sources.append(TopicSource(self, group, authority))
            else:
                self._sources.append(FileSource(self, group, follow=follow))
        self.folder_locks.enter_context(
            locked_fleet_folder(folder, WATCHED_FLEET_KIND, _record(fleet))
        )
        self.state = read_watched_state(folder)
        self._records_of_interrupted = dict(self.state["assets"])
        self._most_followed_files = allow_many_files() - FURTHER_FILES

    def note(self, sentence: str) -> None:
        """Notify the operator by a sentence."""
        self._note(sentence)

    @property
    def failures(self) -> dict[str, str]:
        """The errors of the assets whose watch is interrupted, by GROUP/NAME."""
        return {
            key: interruption.sentence
            for key, interruption in self._interruptions.items()
            if key not in self.assets
        }

    @property
    def complaints(self) -> dict[str, str]:
        """Why messages of watched assets were of no use, by asset; see `Intake.complaint`."""
        complaints = {}
        for key, asset in sorted(self.assets.items()):
            complaint = asset.watch.intake.complaint()
            if complaint:
                complaints[key] = complaint
        return complaints

    def run(self, after_poll: Callable[[], None] | None = None) -> None:
        """Watch until all files are read to their end, or until the end is requested.

        Parameters
        ----------
        after_poll : callable, optional
            Called after each poll of all sources.

        Raises
        ------
        DiskFullError
            If the disk is full; the journals keep all steps before that.
        MissionInputError
            If a broker does not answer, or refuses the twin.
        """
        # Negative, so that the first poll searches for assets.
        last_search = -SEARCH_SECONDS
        next_state = 0.0
        # The final actions run before the folders are released, into which they may still write.
        with self.folder_locks, self.final_actions:
            try:
                while not self.is_end_requested:
                    begin = time.monotonic()
                    is_search_due = begin - last_search >= SEARCH_SECONDS
                    if is_search_due:
                        last_search = begin
                    steps = sum(source.poll(searches=is_search_due) for source in self._sources)
                    if begin >= next_state:
                        self._write_state()
                        seconds = time.monotonic() - begin
                        next_state = begin + max(STATE_SECONDS, seconds / STATE_BYTES_PER_STEP)
                    if after_poll is not None:
                        after_poll()
                    if steps == 0:
                        if all(source.has_ended for source in self._sources):
                            return
                        # In proportion to the duration of the poll without new messages
                        idle_seconds = (time.monotonic() - begin) / BUSY_FRACTION
                        time.sleep(min(max(IDLE_SECONDS, idle_seconds), LONGEST_IDLE))
            finally:
                self._write_state()

    def advance(
        self,
        group: Group,
        name: str,
        open_feed: Callable[[], Feed],
        most_steps: int | None = None,
    ) -> int:
        """Process the new observations of an asset, and return the number of steps.

        If the asset is not watched, its watch is begun or resumed first, unless an error has
        interrupted it and the waiting time is not over.

        Parameters
        ----------
        open_feed : callable
            Returns the feed of its observations.
        most_steps : int, optional
            The largest number of steps to process; by default all that have come.
        """
        key = f"{group.name}/{name}"
        is_waiting = (
            key in self._interruptions and time.monotonic() < self._interruptions[key].resume_time
        )
        if self.is_end_requested or (key not in self.assets and is_waiting):
            return 0
        steps = 0
        try:
            if key not in self.assets:
                self._begin_or_resume(group, name, open_feed())
            asset = self.assets[key]
            if self.has_all_steps(asset):
                return 0
            for decision in asset.watch.decisions():
                if key in self._interruptions:
                    del self._interruptions[key]
                    self.note(f"{key} is watched again.")
                self._pass_on(asset, decision)
                steps += 1
                if steps == most_steps or self.has_all_steps(asset) or self.is_end_requested:
                    break
            if steps == 0 and not asset.watch.intake.has_ended:
                asset.watch.report_silence(partial(self._pass_on, asset))
            if not asset.keeps_file_open:
                asset.feed.release_file()
        except Exception as error:  # noqa: BLE001 - whatever happens to one asset, the others go on
            self.interrupt(key, error)
        return steps

    def _begin_or_resume(self, group: Group, name: str, feed: Feed) -> None:
        """Begin or resume the watch of an asset, and hand on its last decision if that is due.

        An error is raised if the name cannot be that of a folder, or if there are too many assets.
        """
        if not _ASSET_NAME.fullmatch(name):
            raise FleetError(
                "the name of an asset must consist of letters, digits, dots and hyphens, but "
                f"{name!r} was given."
            )
        if len(self.assets) >= LARGEST_FLEET:
            raise FleetError(
                f"a process watches {LARGEST_FLEET:,} assets at most: watch the others in another "
                "process."
            )
        key = f"{group.name}/{name}"
        asset = self._open_asset(group, name, feed)
        self.folder_locks.callback(asset.close)
        self._sibling.setdefault(group.name, asset.watch)
        self.assets[key] = asset
        last_decision = asset.decision
        if last_decision is not None and last_decision["step"] >= asset.first_new_step:
            # The former process may have been killed after it wrote the decision to the journal
            # and before it handed the decision on.
            self._pass_on(asset, last_decision)

    def _open_asset(self, group: Group, name: str, feed: Feed) -> WatchedAsset:
        """Begin or resume the watch of an asset in its locked folder."""
        key = f"{group.name}/{name}"
        folder = self.folder / group.name / name
        sibling = self._sibling.get(group.name)
        if (folder / CONFIG_NAME).is_file():
            watch_context = resume_watch(
                folder, None, SilentProgress(), sibling, fleet_is_locked=True
            )
        else:
            with explained_write_errors(folder):
                folder.parent.mkdir(exist_ok=True)
            watch_context = begin_watch(
                group.scenarios[0],
                group.scenario_file,
                folder,
                SilentProgress(),
                sibling=sibling,
                fleet_is_locked=True,
            )
        with ExitStack() as closing:
            closing.callback(feed.close)
            watch = closing.enter_context(watch_context)
            closing.enter_context(watch.begin(feed))
            if isinstance(feed, Topic):
                feed.attach(watch)
            asset = WatchedAsset(
                key,
                watch,
                feed,
                self._records_of_interrupted.get(key),
                keeps_file_open=len(self.assets) < self._most_followed_files,
            )
            asset.close = closing.pop_all().close
        return asset

    def _pass_on(self, asset: WatchedAsset, decision: JsonObject) -> None:
        """Pass a decision to the operator and to the feed of the asset, and record its alarms.

        A notice before the first step has no control, and does not become the last decision.
        """
        if "control" in decision:
            asset.decision = decision
        self._receive_decision(asset, decision)
        asset.feed.send_decision(decision)
        for notice in decision["notices"]:
            if notice["kind"] == "alarm":
                asset.alarms.add(notice["sentence"])

    def request_end(self) -> None:
        """Request the end of the watch after the present step."""
        self.is_end_requested = True

    def has_all_steps(self, asset: WatchedAsset) -> bool:
        """Return whether an asset has reached the requested number of steps."""
        return self._wanted_steps is not None and asset.watch.twin.steps >= self._wanted_steps

    def interrupt(self, key: str, error: Exception) -> None:
        """Interrupt the watch of an asset because of an error, and release its folder.

        The watch is resumed after a time. If the same error comes again, this time doubles and the
        operator gets no second message.

        Raises
        ------
        DiskFullError
            If the error is this one, because it concerns all assets.
        """
        if isinstance(error, DiskFullError):
            raise error
        if isinstance(error, FLIGHT_ERRORS):
            sentence = str(error)
        else:
            sentence = f"{type(error).__name__}: {error}"
        wait = FIRST_WAIT_SECONDS
        previous = self._interruptions.get(key)
        if previous is not None and previous.sentence == sentence:
            wait = min(2.0 * previous.wait, LONGEST_WAIT_SECONDS)
        else:
            self.note(f"{key} is not watched: {sentence}")
        self._interruptions[key] = _Interruption(sentence, wait, time.monotonic() + wait)
        asset = self.assets.pop(key, None)
        if asset is not None:
            self._records_of_interrupted[key] = asset.record()
            asset.close()

    def _write_state(self) -> None:
        """Write the records of all assets to the file that `read_watched_state` reads."""
        records = {name: asset.record() for name, asset in sorted(self.assets.items())}
        self.state = {
            "assets": {**self._records_of_interrupted, **records},
            "failures": self.failures,
        }
        atomic_write_text(self.folder / STATE_NAME, json.dumps(self.state) + "\n")


def _check_observed(fleet: Fleet) -> None:
    """Raise an error if a group of a fleet has no `observations`, and so no real assets."""
    unobserved = [group.name for group in fleet.groups if not group.observations]
    if unobserved:
        raise FleetError(
            f"a watched group has `observations`, and {', '.join(unobserved)} has none."
        )


def _record(fleet: Fleet) -> JsonObject:
    """Return the record of a watched fleet for `config.json`.

    It has no members, because assets are added and lost during the watch.
    """
    groups = []
    for group in fleet.groups:
        scenario = group.scenarios[0].portable().to_dict()
        groups.append({"name": group.name, "scenarios": [scenario]})
    return fleet.head.model_dump(exclude={"shard"}) | {"groups": groups}
