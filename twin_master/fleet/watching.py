"""Real assets, many of them: each is watched as `uav-twin watch` watches one, and leaves the same folder."""

import json
import re
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from reporting.errors import DiskFullError
from reporting.files import atomic_write_text, explained_write_errors
from reporting.former_names import with_present_names
from reporting.json_file import read_json
from reporting.progress import SilentProgress
from twin_master.errors import FleetError, said
from twin_master.fleet.flight import WATCHED_KIND, held_fleet
from twin_master.fleet.plan import Fleet, Group, asset_name, recordings
from twin_master.fleet.reading import attention, severity
from twin_master.mission.side_by_side import FLIGHT_ERRORS
from twin_master.run_folder import CONFIG_NAME
from twin_master.watch.feeds import broker_of, file_feed, is_broker
from twin_master.watch.folder import Watch
from twin_master.watch.intake import Feed
from twin_master.watch.mqtt import Session, Topic
from twin_master.watch.opening import begun_watch, resumed_watch

STEPS_AT_ONCE = 64
"""Steps of one asset before the next one is looked at."""
SEARCH_SECONDS, STATE_SECONDS = 2.0, 2.0
"""Between two searches for new files, and between two writings of the state."""
AGAIN_SECONDS, LONGEST_AGAIN = 30.0, 3600.0
"""After which an asset that was lost is taken up again; twice as long each time that it meets the same."""
IDLE_SECONDS, BUSY_SHARE = 0.05, 0.2
"""Shortest pause where nothing came, and share of a processor that looking in vain may take."""
LARGEST_FLEET = 100_000
"""Assets; a broker could name more of them without end."""
STATE_NAME = "watched.json"
"""In the folder of a fleet that is watched: its assets as they stood a moment ago, for its view."""
_OF_A_DECISION = ("step", "control", "next_control", "probability", "health")
"""What of its last decision is kept of each asset."""
_NAME = re.compile(r"\w[\w.-]{0,63}")


def read_standing(folder: Path) -> dict[str, Any]:
    """Return `assets` and `failures` of a watched fleet, both empty where nothing was watched.

    Of each asset `last` is what its last decision said, None before the first; `alarms` and `refused` are
    numbers; `leaving` is the probability that its control is left within the steps that are predicted, and
    `severity` how badly off it is. Both are None where no state is believed.
    """
    path = folder / STATE_NAME
    if not path.is_file():
        return {"assets": {}, "failures": {}}
    record = dict(read_json(path, FleetError))
    return with_present_names(record, {"assets.*.last.turn": "step"}, str(path), FleetError)


def counts_of(standing: Mapping[str, Any]) -> dict[str, int]:
    """Return what `read_standing` tells in numbers."""
    known = standing["assets"].values()
    return {
        "assets": len(known),
        "steps": sum(asset["last"]["step"] + 1 for asset in known if asset["last"] is not None),
        "alarms": sum(asset["alarms"] for asset in known),
        "messages refused": sum(asset["refused"] for asset in known),
        "not watched": len(standing["failures"]),
    }


class WatchedAsset:
    """An asset under watch.

    Attributes
    ----------
    name : str
        Of its group and its own: GROUP/NAME, which is its folder, too.
    watch : Watch
        Begun.
    feed : Feed
        Of its observations.
    decision : dict or None
        The last one.
    alarms : set of str
        The alarms that the operator was told since it was taken up, each sentence once.
    first_untold : int
        The first step that the operator was not told before.
    close : callable
        Gives its folder free.
    """

    close: Callable[[], None]

    def __init__(self, name: str, watch: Watch, feed: Feed, before: Mapping[str, Any] | None) -> None:
        self.name, self.watch, self.feed = name, watch, feed
        self._knowledge = watch.models[-1].knowledge
        self.decision = watch.last_decision()
        self.first_untold = self._alarms_before = 0
        if before is not None and before["last"] is not None:
            self.first_untold, self._alarms_before = before["last"]["step"] + 1, before["alarms"]
        told = [notice for _, notice in watch.told(self.first_untold)] if self.decision else []
        self.alarms = {notice.sentence for notice in told if notice.kind == "alarm"}
        if self.decision is not None:
            watch.filtered = watch.twin.estimator.smoothed(watch.twin.carried[-1:])[0]

    def record(self) -> dict[str, Any]:
        """Return how it stands, for the view."""
        last = leaving = worst = None
        if self.decision is not None and self.watch.filtered is not None:
            last = {key: self.decision[key] for key in _OF_A_DECISION}
            if self.decision.get("state_believed", True):
                control = self.watch.scenario.control_names.index(last["control"])
                leaving = float(attention(self._knowledge, self.watch.filtered, control))
                mean = np.array([state["mean"] for state in last["health"].values()])
                worst = float(severity(self.watch.scenario, mean))
        alarms, refused = self._alarms_before + len(self.alarms), self.watch.intake.counts.rejected
        return {"last": last, "alarms": alarms, "refused": refused, "leaving": leaving, "severity": worst}


@dataclass
class _Lost:
    """Why an asset was lost, how long it is left alone, and until when on the clock [s]."""

    sentence: str
    wait: float
    again: float


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
    steps : int, optional
        Steps of each asset after which it is left alone.
    authority : Path, optional
        Certificate of the authority of a broker.

    Raises
    ------
    FleetError, MissionInputError
        A group is flown and not watched, or has no recording; an address is wrong.
    RunFolderError, NotResumableError
        The folder holds something else, or was begun with another version.

    Attributes
    ----------
    assets : dict of str to WatchedAsset
        Those that are not lost.
    standing : dict
        How all stood a moment ago, as `read_standing` has it.
    asked : bool
        Set it to end between two steps.
    """

    def __init__(
        self,
        fleet: Fleet,
        folder: Path,
        tell: Callable[[WatchedAsset, Mapping[str, Any]], None],
        note: Callable[[str], None],
        *,
        follow: bool = False,
        steps: int | None = None,
        authority: Path | None = None,
    ) -> None:
        self.folder, self.assets, self.asked = folder, dict[str, WatchedAsset](), False
        self._lost: dict[str, _Lost] = {}
        self.note, self.closing, self.goodbyes = note, ExitStack(), ExitStack()
        self._tell, self._steps = tell, steps
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
        named = [(group.name, group.scenarios[0].portable().to_dict()) for group in fleet.groups]
        groups = [{"name": name, "scenarios": [scenario]} for name, scenario in named]
        record = fleet.head.model_dump(exclude={"shard"}) | {"groups": groups}
        self.closing.enter_context(held_fleet(folder, WATCHED_KIND, record))
        self.standing = read_standing(folder)
        self._told_before = dict(self.standing["assets"])
        import resource

        limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (limits[1], limits[1]))  # three files for each asset

    @property
    def failures(self) -> dict[str, str]:
        """What ended the watch of an asset, until it is taken up again; the others go on."""
        return {name: lost.sentence for name, lost in self._lost.items() if name not in self.assets}

    @property
    def complaints(self) -> dict[str, str]:
        """Why the messages of an asset that is watched were of no use, see `Intake.complaint`."""
        complaints = {name: asset.watch.intake.complaint() for name, asset in sorted(self.assets.items())}
        return {name: complaint for name, complaint in complaints.items() if complaint}

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
        state = searched = -SEARCH_SECONDS
        with self.closing, self.goodbyes:  # what is said last may still write into the folders
            try:
                while not self.asked:
                    begin = time.monotonic()
                    searching = begin - searched >= SEARCH_SECONDS
                    searched = begin if searching else searched
                    steps = sum(source.look(searching) for source in self._sources)
                    if begin - state > STATE_SECONDS:
                        self._write_state()
                        state = begin
                    looked()
                    if not steps:
                        if all(source.ended for source in self._sources):
                            return
                        looking = time.monotonic() - begin
                        time.sleep(min(max(IDLE_SECONDS, looking / BUSY_SHARE), 1.0))
            finally:
                self._write_state()

    def advance(self, group: Group, name: str, feed: Callable[[], Feed], most: int | None = None) -> int:
        """Take in what has come of an asset, in so many steps at most; return the number of steps.

        It is begun, or taken up again, where it is not watched and it is time.
        """
        key, count = f"{group.name}/{name}", 0
        waiting = key in self._lost and time.monotonic() < self._lost[key].again
        if self.asked or (key not in self.assets and waiting):
            return count
        try:
            if key not in self.assets:
                self._take_up(group, name, feed())
            asset = self.assets[key]
            if self.enough(asset):
                return count
            for decision in asset.watch.decisions():
                if self._lost.pop(key, None) is not None:
                    self.note(f"{key} is watched again.")
                self._decided(asset, decision)
                count += 1
                if count == most or self.enough(asset) or self.asked:
                    break
            if not count and not asset.watch.intake.ended:
                asset.watch.quiet(partial(self._decided, asset))
        except Exception as error:  # noqa: BLE001 - whatever one asset comes to, the others go on
            self.lost(key, error)
        return count

    def _take_up(self, group: Group, name: str, feed: Feed) -> None:
        """Begin the watch of an asset, or go on with it."""
        key, folder = f"{group.name}/{name}", self.folder / group.name / name
        if not _NAME.fullmatch(name):
            raise FleetError(f"letters, digits, dots and hyphens name an asset, and {name!r} came.")
        if len(self.assets) == LARGEST_FLEET:
            raise FleetError(f"a process watches {LARGEST_FLEET} assets at most.")
        like = self._like.get(group.name)
        opened = resumed_watch(folder, None, SilentProgress(), like)
        if not (folder / CONFIG_NAME).is_file():
            with explained_write_errors(folder):
                folder.parent.mkdir(exist_ok=True)
            opened = begun_watch(group.scenarios[0], group.file, folder, SilentProgress(), like=like)
        with ExitStack() as closing:
            watch = closing.enter_context(opened)
            closing.enter_context(watch.begun(feed))
            if isinstance(feed, Topic):
                feed.begun(watch)
            asset = WatchedAsset(key, watch, feed, self._told_before.get(key))
            asset.close = closing.pop_all().close
        self.closing.callback(asset.close)
        self._like.setdefault(group.name, watch)
        self.assets[key] = asset
        last = asset.decision
        if last is not None and last["step"] >= asset.first_untold:  # a kill may have left it untold
            self._decided(asset, last)

    def _decided(self, asset: WatchedAsset, decision: dict[str, Any]) -> None:
        if "control" in decision:
            asset.decision = decision
        self._tell(asset, decision)
        asset.feed.decide(decision)
        asset.alarms |= {notice["sentence"] for notice in decision["notices"] if notice["kind"] == "alarm"}

    def ask(self) -> None:
        """Ask for an end between two steps."""
        self.asked = True

    def enough(self, asset: WatchedAsset) -> bool:
        """Return whether an asset has the steps that were wanted."""
        return self._steps is not None and asset.watch.twin.steps >= self._steps

    def lost(self, key: str, error: Exception) -> None:
        """Say once why an asset is not watched, and give its folder free; a full disk ends all."""
        if isinstance(error, DiskFullError):
            raise error
        sentence = str(error) if isinstance(error, FLIGHT_ERRORS) else f"{type(error).__name__}: {error}"
        before, wait = self._lost.get(key), AGAIN_SECONDS
        if before is not None and before.sentence == sentence:
            wait = min(2.0 * before.wait, LONGEST_AGAIN)
        else:
            self.note(f"{key} is not watched: {sentence}")
        self._lost[key] = _Lost(sentence, wait, time.monotonic() + wait)
        if (asset := self.assets.pop(key, None)) is not None:
            self._told_before[key] = asset.record()
            asset.close()

    def _write_state(self) -> None:
        assets = {name: asset.record() for name, asset in sorted(self.assets.items())}
        self.standing = {"assets": {**self._told_before, **assets}, "failures": self.failures}
        atomic_write_text(self.folder / STATE_NAME, json.dumps(self.standing) + "\n")


class _Files:
    """A file for each asset, whose name is its name."""

    def __init__(self, fleet: FleetWatch, group: Group, follow: bool) -> None:
        self._fleet, self._group, self._follow = fleet, group, follow
        if not follow and not recordings(group.observations):
            raise FleetError(said("fleet.follow", observations=group.observations))
        self._files: dict[str, Path] = {}

    @property
    def ended(self) -> bool:
        """Whether nothing more is to be read."""
        found = (self._fleet.assets.get(f"{self._group.name}/{name}") for name in self._files)
        return not self._follow and all(
            asset is None or asset.watch.intake.ended or self._fleet.enough(asset) for asset in found
        )

    def look(self, searching: bool) -> int:
        """Take in what is new, and look for new files; return the number of steps."""
        for path in recordings(self._group.observations) if searching else ():
            name = asset_name(path)
            if self._files.get(name, path) != path:
                error = FleetError("another file has the same name.")
                self._fleet.lost(f"{self._group.name}/{name} of {path.name}", error)
            elif not self._follow or _has_header(path):
                self._files[name] = path
        scenario = self._group.scenarios[0]
        return sum(
            self._fleet.advance(
                self._group, name, partial(file_feed, path, scenario, follow=self._follow), STEPS_AT_ONCE
            )
            for name, path in self._files.items()
        )


def _has_header(path: Path) -> bool:
    """Return whether the header of a file that grows is whole."""
    try:
        with path.open("rb") as file:
            return file.readline(100_000)[-1:] == b"\n"
    except OSError:
        return False


class _Topics:
    """A topic for each asset, whose last level is its name."""

    ended = False

    def __init__(self, fleet: FleetWatch, group: Group, authority: Path | None) -> None:
        broker = broker_of(group.observations, authority, many=True)
        self._fleet, self._group, self._topic = fleet, group, broker.topic
        self._session = Session(broker, group.name, fleet.folder, fleet.note, self._pulse)
        fleet.goodbyes.callback(self._session.close)
        self._messages = self._session.messages(0.0)
        self._topics: dict[str, Topic] = {}

    def look(self, searching: bool) -> int:
        """Take in what the broker has sent; return the number of steps."""
        steps, begin = 0, time.monotonic()
        if not self._topics:  # those that were watched before may be quiet, or have decisions to publish
            for path in sorted((self._fleet.folder / self._group.name).glob(f"*/{CONFIG_NAME}")):
                self._found(path.parent.name)
        for name in [*self._topics] if searching else ():
            steps += self._advanced(name)
        while not self._fleet.asked and (message := next(self._messages)) is not None:
            name = message.topic.rpartition("/")[2]
            asset = self._fleet.assets.get(f"{self._group.name}/{name}")
            topic = self._found(name)
            if topic is not None and not (asset and self._fleet.enough(asset)):
                topic.came.append(message.payload)
                steps += self._advanced(name)
            if time.monotonic() - begin > STATE_SECONDS:
                break
        return steps

    def _found(self, name: str) -> Topic | None:
        """Return the topic of an asset; None of one too many."""
        if name not in self._topics and len(self._topics) < LARGEST_FLEET:
            failed = partial(self._fleet.lost, f"{self._group.name}/{name}")
            topic = self._topic[:-1] + name
            self._topics[name] = Topic(self._session, topic, self._group.scenarios[0], failed)
        return self._topics.get(name)

    def _advanced(self, name: str) -> int:
        return self._fleet.advance(self._group, name, lambda: self._topics[name])

    def _pulse(self) -> dict[str, Any]:
        kept = [topic.watch for topic in self._topics.values() if topic.watch is not None]
        return {
            "state": "watching", "assets": len(kept), "steps": sum(watch.twin.steps for watch in kept),
            "quiet": sum(watch.is_quiet for watch in kept), "lag": len(self._session.came),
            "refused": sum(watch.intake.counts.rejected for watch in kept),
        }  # fmt: skip
