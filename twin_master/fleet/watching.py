"""Real assets, many of them: each is watched as `uav-twin watch` watches one, and leaves the same folder."""

import json
import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from reporting.errors import DiskFullError
from reporting.files import atomic_write_text
from reporting.progress import SilentProgress
from twin_master.errors import FleetError
from twin_master.fleet.flight import hold_folder, see_folder
from twin_master.fleet.plan import Fleet, Group, asset_name, recordings
from twin_master.fleet.standing import STATE_NAME, WatchedAsset, read_standing
from twin_master.fleet.store import written
from twin_master.mission.side_by_side import IN_FLIGHT
from twin_master.run_folder import CONFIG_NAME
from twin_master.scenario.schema import Scenario
from twin_master.sentences import said
from twin_master.watch.feeds import broker_of, file_feed, is_broker
from twin_master.watch.folder import Watch
from twin_master.watch.growing import Place
from twin_master.watch.intake import Feed
from twin_master.watch.message import Fed, MessageReader
from twin_master.watch.mqtt import Outbox, Session, placed
from twin_master.watch.opening import begun_watch, resumed_watch

KIND = "uav-twin fleet watch"
TURNS_AT_ONCE = 64
"""Turns of one asset before the next one is looked at."""
SEARCH_SECONDS, STATE_SECONDS = 2.0, 2.0
"""Between two searches for new files, and between two writings of the state."""
AGAIN_SECONDS, LONGEST_AGAIN = 30.0, 3600.0
"""After which an asset that was lost is taken up again; twice as long each time that it meets the same."""
HELD = 200
"""Messages of an asset that is lost, the last ones, that wait for it here."""
IDLE_SECONDS, BUSY_SHARE = 0.05, 0.2
"""Shortest pause where nothing came, and share of a processor that looking in vain may take."""
LARGEST_FLEET = 100_000
"""Assets; a broker could name more of them without end."""
_NAME = re.compile(r"\w[\w.-]{0,63}")


class FleetWatch:
    """A fleet under watch, by this process.

    Parameters
    ----------
    fleet : Fleet
        Its groups have `observations`.
    folder : Path
        With a folder of a watch for each asset; a fleet that was watched there before is gone on with.
    tell : callable
        Told the asset and each decision, once it is written down.
    note : callable
        Told of assets that are lost, and of brokers.
    follow : bool
        Files grow, and new ones come.
    turns : int, optional
        Turns of each asset after which it is left alone.
    authority : Path, optional
        Certificate of the authority of a broker.

    Raises
    ------
    FleetError, MissionInputError
        A group is flown and not watched, or has no recording; an address is wrong.
    RunFolderExistsError, NotResumableError
        The folder holds something else, or was begun with another version.

    Attributes
    ----------
    assets : dict of str to WatchedAsset
    failures : dict of str to str
        What ended the watch of an asset, until it is taken up again; the others go on.
    asked : bool
        Set it to end between two turns.
    """

    def __init__(
        self,
        fleet: Fleet,
        folder: Path,
        tell: Callable[[WatchedAsset, Mapping[str, Any]], None],
        note: Callable[[str], None],
        *,
        follow: bool = False,
        turns: int | None = None,
        authority: Path | None = None,
    ) -> None:
        self.folder, self.assets, self.asked = folder, dict[str, WatchedAsset](), False
        self.failures: dict[str, str] = {}
        self._again: dict[str, float] = {}
        self._met: dict[str, tuple[str, float]] = {}  # why an asset was lost, and how long it was then left
        self.note, self.closing, self.goodbyes = note, ExitStack(), ExitStack()
        self._tell, self._turns = tell, turns
        self._like: dict[str, Watch] = {}
        flown = [group.name for group in fleet.groups if not group.observations]
        if flown:
            raise FleetError(f"a watched group has `observations`, and {', '.join(flown)} has none.")
        self._sources: list[_Files | _Topics] = []
        for group in fleet.groups:
            if is_broker(group.observations):
                self._sources.append(_Topics(self, group, authority))
            else:
                self._sources.append(_Files(self, group, follow))
        self.closing.enter_context(_held(fleet, folder))
        self._told_before = read_standing(folder)["assets"]
        import resource

        limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (limits[1], limits[1]))  # three files for each asset

    def run(self, looked: Callable[[], None] = lambda: None) -> None:
        """Watch until all files are read to their end, or until it is asked to end.

        Parameters
        ----------
        looked : callable
            Called now and then.

        Raises
        ------
        DiskFullError
            The disk is full; what was observed is kept.
        MissionInputError
            A broker does not answer, or refuses the twin.
        """
        state = 0.0
        with self.closing, self.goodbyes:  # what is said last may still write into the folders
            try:
                while not self.asked:
                    begin = time.monotonic()
                    turns = sum(source.look() for source in self._sources)
                    if begin - state > STATE_SECONDS:
                        self._write_state()
                        state = begin
                    looked()
                    if not turns:
                        if all(source.ended for source in self._sources):
                            return
                        looking = time.monotonic() - begin
                        time.sleep(min(max(IDLE_SECONDS, looking / BUSY_SHARE), 1.0))
            finally:
                self._write_state()

    def take_up(
        self, group: Group, name: str, feed: Callable[[Scenario], Feed],
        begun: Callable[[WatchedAsset], None] = lambda _asset: None,
    ) -> WatchedAsset | None:  # fmt: skip
        """Begin the watch of an asset, or go on with it; None where that cannot be."""
        key, folder = f"{group.name}/{name}", self.folder / group.name / name
        with ExitStack() as closing:
            try:
                if not _NAME.fullmatch(name):
                    raise FleetError(f"letters, digits, dots and hyphens name an asset, and {name!r} came.")
                if len(self.assets) == LARGEST_FLEET and key not in self.assets:
                    raise FleetError(f"a process watches {LARGEST_FLEET} assets at most.")
                source, like = feed(group.scenarios[0]), self._like.get(group.name)
                opened = resumed_watch(folder, None, SilentProgress(), like)
                if not (folder / CONFIG_NAME).is_file():
                    with written(folder):
                        folder.parent.mkdir(exist_ok=True)
                    given = group.scenarios[0], group.file, folder, SilentProgress()
                    opened = begun_watch(*given, like=like)
                watch = closing.enter_context(opened)
                closing.enter_context(watch.begun(source))
                asset = WatchedAsset(key, watch, self._told_before.get(key))
                begun(asset)
                asset.close = closing.pop_all().close
            except Exception as error:  # noqa: BLE001 - whatever one asset comes to, the others go on
                self.lost(key, error)
                return None
        self.closing.callback(asset.close)
        self.failures.pop(key, None)
        self._like.setdefault(group.name, watch)
        self.assets[key] = asset
        last = asset.decision
        if last is not None and last["turn"] >= asset.first_untold:  # a kill may have left it untold
            self._decided(asset, last)
        return asset

    def _decided(self, asset: WatchedAsset, decision: dict[str, Any]) -> None:
        if "control" in decision:
            asset.decision = decision
        self._tell(asset, decision)
        asset.tell(decision)
        asset.alarms |= {notice["sentence"] for notice in decision["notices"] if notice["kind"] == "alarm"}

    def advance(self, asset: WatchedAsset, most: int | None = None) -> int:
        """Take in what has come of an asset, in so many turns at most; return the number of turns."""
        count = 0
        if self.done(asset):
            return count
        try:
            for decision in asset.watch.decisions():
                if self._met.pop(asset.name, None) is not None:
                    self.note(f"{asset.name} is watched again.")
                self._decided(asset, decision)
                count += 1
                if count == most or self.done(asset) or self.asked:
                    break
            if not count and not asset.keep.intake.ended:
                asset.watch.quiet(partial(self._decided, asset))
        except Exception as error:  # noqa: BLE001 - likewise
            self.lost(asset.name, error)
        return count

    def ask(self) -> None:
        """Ask for an end between two turns."""
        self.asked = True

    def done(self, asset: WatchedAsset) -> bool:
        """Return whether an asset is left alone: it is lost, or has the turns that were wanted."""
        return self.enough(asset) or asset.name in self.failures

    def enough(self, asset: WatchedAsset) -> bool:
        """Return whether an asset has the turns that were wanted."""
        return self._turns is not None and asset.keep.twin.turns >= self._turns

    def due(self, name: str) -> bool:
        """Return whether an asset that was lost is to be taken up again."""
        return name in self.failures and time.monotonic() >= self._again[name]

    def lost(self, name: str, error: Exception) -> None:
        """Say once why an asset is not watched, and give its folder free; a full disk ends all."""
        if isinstance(error, DiskFullError):
            raise error
        if name not in self.assets and len(self.failures) >= LARGEST_FLEET:
            return
        sentence = str(error) if isinstance(error, IN_FLIGHT) else f"{type(error).__name__}: {error}"
        met, wait = self._met.get(name, ("", 0.0))
        if met != sentence:
            self.note(f"{name} is not watched: {sentence}")
        wait = min(2.0 * wait, LONGEST_AGAIN) if met == sentence else AGAIN_SECONDS
        self.failures[name], self._met[name] = sentence, (sentence, wait)
        self._again[name] = time.monotonic() + wait
        if name in self.assets:
            self._told_before[name] = self.assets[name].record()
            self.assets[name].close()

    def _write_state(self) -> None:
        assets = {name: asset.record() for name, asset in sorted(self.assets.items())}
        record = {"assets": {**self._told_before, **assets}, "failures": self.failures}
        atomic_write_text(self.folder / STATE_NAME, json.dumps(record) + "\n")


def _held(fleet: Fleet, folder: Path) -> AbstractContextManager[None]:
    """Make the folder of a fleet, or see that it holds the same; return what holds it."""
    groups = [
        {"name": group.name, "scenarios": [group.scenarios[0].portable().to_dict()]} for group in fleet.groups
    ]
    heading = {"name": fleet.name, "title": fleet.title, "seed": fleet.seed, "groups": groups}
    config = {"kind": KIND, "format": 1, "fleet": heading}
    see_folder(folder, config, fleet.seed)
    return hold_folder(folder, config, fleet.seed)


class _Files:
    """A file for each asset, whose name is its name."""

    def __init__(self, fleet: FleetWatch, group: Group, follow: bool) -> None:
        self._fleet, self._group, self._follow = fleet, group, follow
        if not follow and not recordings(group.observations):
            raise FleetError(said("fleet.follow", observations=group.observations))
        self._assets: dict[Path, WatchedAsset | None] = {}
        self._owner: dict[str, Path] = {}
        self._searched = -SEARCH_SECONDS

    @property
    def ended(self) -> bool:
        done = self._fleet.done
        here = [asset for asset in self._assets.values() if asset is not None]
        return all(asset.keep.intake.ended or done(asset) for asset in here) and not self._follow

    def look(self) -> int:
        """Take in what is new; return the number of turns."""
        if time.monotonic() - self._searched >= SEARCH_SECONDS:
            self._searched = time.monotonic()
            for path in recordings(self._group.observations):
                name = asset_name(path)
                key = f"{self._group.name}/{name}"
                if self._owner.setdefault(name, path) != path:
                    self._fleet.lost(f"{key} of {path.name}", FleetError("another file has the same name."))
                elif (
                    (path not in self._assets or self._fleet.due(key))
                    and not self._fleet.asked
                    and self._begun(path)
                ):
                    feed = partial(file_feed, path, follow=self._follow)
                    self._assets[path] = self._fleet.take_up(self._group, name, feed)
        turns = 0
        for asset in self._assets.values():
            if self._fleet.asked:
                break
            if asset is not None:
                turns += self._fleet.advance(asset, TURNS_AT_ONCE)
        return turns

    def _begun(self, path: Path) -> bool:
        """Return whether the header of a file that grows is whole."""
        if not self._follow:
            return True
        try:
            with path.open("rb") as file:
                return file.readline(100_000)[-1:] == b"\n"
        except OSError:
            return False


class _Inbox(Feed):
    """What a broker sent of one asset, and what it is told."""

    def __init__(self, topic: str, scenario: Scenario) -> None:
        self.topic, self.name = topic, topic.rpartition("/")[2]
        self._reader = MessageReader(scenario)
        self.came: deque[bytes] = deque(maxlen=HELD)
        self.asset: WatchedAsset | None = None
        self.outbox: Outbox | None = None

    def messages(self, place: Place | None) -> Iterator[Fed]:
        while True:
            yield placed(self._reader, self.came.popleft()) if self.came else (None, "")


class _Topics:
    """A topic for each asset, whose last level is its name."""

    ended = False

    def __init__(self, fleet: FleetWatch, group: Group, authority: Path | None) -> None:
        broker = broker_of(group.observations, authority, many=True)
        self._fleet, self._group, self._topic = fleet, group, broker.topic
        self._session = Session(broker, group.name, fleet.folder, fleet.note, self._pulse)
        fleet.goodbyes.callback(self._session.close)
        self._messages = self._session.messages(0.0)
        self._inboxes: dict[str, _Inbox] = {}
        self._searched = 0.0

    def look(self) -> int:
        """Take in what the broker has sent; return the number of turns."""
        turns, begin = 0, time.monotonic()
        if not self._searched:  # those that were watched before may be quiet, or have decisions to publish
            for path in sorted((self._fleet.folder / self._group.name).glob(f"*/{CONFIG_NAME}")):
                self._inbox(self._topic[:-1] + path.parent.name)
        if begin - self._searched >= SEARCH_SECONDS:
            self._searched = begin
            for inbox in self._inboxes.values():
                if self._fleet.due(f"{self._group.name}/{inbox.name}"):
                    self._take_up(inbox)
                turns += self._advanced(inbox)
        while not self._fleet.asked and (message := next(self._messages)) is not None:
            box = self._inbox(message.topic)
            if box is not None and not (box.asset and self._fleet.enough(box.asset)):
                box.came.append(message.payload)
                turns += self._advanced(box)
            if time.monotonic() - begin > STATE_SECONDS:
                break
        return turns

    def _inbox(self, topic: str) -> _Inbox | None:
        """Return that of a topic, of which an asset is begun; None of one too many."""
        if topic not in self._inboxes and len(self._inboxes) < LARGEST_FLEET:
            self._inboxes[topic] = _Inbox(topic, self._group.scenarios[0])
            self._take_up(self._inboxes[topic])
        return self._inboxes.get(topic)

    def _advanced(self, inbox: _Inbox) -> int:
        return 0 if inbox.asset is None else self._fleet.advance(inbox.asset)

    def _take_up(self, inbox: _Inbox) -> None:
        def begun(asset: WatchedAsset) -> None:
            if inbox.outbox is None:
                failed = partial(self._fleet.lost, asset.name)
                inbox.outbox = Outbox(self._session, inbox.topic, asset.watch, failed)
            else:
                inbox.outbox.take_up(asset.watch)
            inbox.asset, asset.tell = asset, inbox.outbox.tell

        self._fleet.take_up(self._group, inbox.name, lambda _scenario: inbox, begun)

    def _pulse(self) -> dict[str, Any]:
        kept = [inbox.asset.keep for inbox in self._inboxes.values() if inbox.asset is not None]
        return {
            "state": "watching", "assets": len(kept), "turns": sum(keep.twin.turns for keep in kept),
            "quiet": sum(keep.quiet for keep in kept), "lag": len(self._session.came),
            "refused": sum(keep.intake.counts.rejected for keep in kept),
        }  # fmt: skip
