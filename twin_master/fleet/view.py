"""The page of a fleet that follows it in the browser: while it flies, while it is watched, or afterwards.

It is made of what the fleet writes anyway, and reads the same with ten assets and with ten thousand: maps and
bands of all, and the fifty that are worst.
"""

import asyncio
import json
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from tornado.web import Application, RequestHandler

from reporting.errors import ReportingError
from reporting.json_file import read_json
from reporting.page import Page, script_source
from reporting.words import counted
from twin_master.errors import FleetError, TwinMasterError
from twin_master.fleet.flight import KIND as FLOWN_KIND
from twin_master.fleet.lessons import LESSONS_NAME
from twin_master.fleet.report import LOST, Standing, add_failures, add_flown_group, add_group, add_lessons
from twin_master.fleet.standing import STATE_NAME, FleetRecord
from twin_master.fleet.store import DONE_NAME, FAILED, has_flown, open_group
from twin_master.fleet.watching import KIND as WATCHED_KIND
from twin_master.run_folder import CONFIG_NAME
from twin_master.scenario.schema import Scenario
from twin_master.viewer.server import HEADERS, OWN_NAMES, serve_application

__all__ = ["fleet_view", "is_fleet", "serve_fleet"]

WORST = 50
"""Assets in the table."""
LOOK_SECONDS = 1.0
"""Between two looks at the fleet."""


def _config(folder: Path) -> dict[str, Any]:
    path = folder / CONFIG_NAME
    found = read_json(path, FleetError) if path.is_file() else None
    return found if isinstance(found, dict) else {}


def is_fleet(folder: Path) -> bool:
    """Return whether a folder is that of a fleet, flown or watched."""
    return _config(folder).get("kind") in (FLOWN_KIND, WATCHED_KIND)


def fleet_view(folder: Path) -> str:
    """Return the page of a fleet as it stands.

    Raises
    ------
    FleetError
        The folder holds none, or nothing was begun there.
    """
    config = _config(folder)
    if config.get("kind") not in (FLOWN_KIND, WATCHED_KIND):
        raise FleetError(f"{folder} holds no fleet.")
    watched, fleet = config["kind"] == WATCHED_KIND, config["fleet"]
    page = Page(fleet["title"] or fleet["name"], f"seed {fleet['seed']}, {'watched' if watched else 'flown'}")
    if watched:
        _add_watched(page, folder, fleet)
    else:
        _add_flown(page, folder, fleet)
    lessons = folder / LESSONS_NAME
    if lessons.is_file():
        page.add_section("Learnt across the fleet")
        add_lessons(page, json.loads(lessons.read_text()))
    return page.render()


def _add_watched(page: Page, folder: Path, fleet: dict[str, Any]) -> None:
    record = FleetRecord.read(folder)
    known, failures = record.assets, record.failures
    silent = sorted(name for name, told in known.items() if told.last is None and name not in failures)
    turns = sum(told.last.turn + 1 for told in known.values() if told.last is not None)
    alarms, refused = (sum(getattr(told, name) for told in known.values()) for name in ("alarms", "refused"))
    counts = [len(known), turns, alarms, refused, len(failures)]
    titles = ("assets", "turns", "alarms", "messages refused", "not watched")
    page.add_highlights([(str(count), title) for count, title in zip(counts, titles, strict=True)])
    if failures:
        notice = f"{len(failures)} of {counted(len(known | failures), 'asset')} are not watched."
        add_failures(page, failures, notice, f"They stand in {STATE_NAME}.")
    if silent:
        named = ", ".join(silent[:WORST]) + ", ..." * (len(silent) > WORST)
        page.add_notice(f"Without a turn yet: {counted(len(silent), 'asset')} ({named}).")
    for group in fleet["groups"]:
        scenario = Scenario.model_validate(group["scenarios"][0])
        own = {
            name.partition("/")[2]: (told.last, told.alarms, told.leaving)
            for name, told in known.items()
            if name.startswith(f"{group['name']}/") and told.last is not None
        }
        last = [told for told, _, _ in own.values()]
        if any(set(scenario.state_names) - told.health.keys() for told in last):
            raise FleetError(
                f"{folder / STATE_NAME}: the health of an asset of {group['name']} is that of "
                f"{', '.join(scenario.state_names)}, and one of them is missing."
            )
        mean, deviation = (
            np.array([[getattr(told.health[n], m) for n in scenario.state_names] for told in last])
            for m in ("mean", "standard_deviation")
        )
        standing = Standing(
            scenario, list(own), np.array([told.turn for told in last], dtype=np.int64), mean, deviation,
            [told.control for told in last],
            np.array([alarms for _, alarms, _ in own.values()], dtype=np.int64),
            np.array([chance for _, _, chance in own.values()], dtype=np.float64),
        )  # fmt: skip
        add_group(page, group["name"], standing, WORST)


def _add_flown(page: Page, folder: Path, fleet: dict[str, Any]) -> None:
    groups = {record["name"]: open_group(folder, record["name"]) for record in fleet["groups"]}
    status = np.concatenate([group["status"].values for group in groups.values()])
    flown, failed = len(has_flown(status)), int(np.sum(status == FAILED))
    page.add_highlights(
        [(str(len(status)), "assets"), (str(flown), "flown"), (str(failed), "failed in flight")]
    )
    failures = _failures(folder)
    if failures:
        notice = LOST.format(len(failures), len(status))
        add_failures(page, failures, notice, "They stand in fleet.json once the fleet has flown.")
    for record in fleet["groups"]:
        add_flown_group(page, folder, record, groups[record["name"]], WORST)


def _failures(folder: Path) -> dict[str, str]:
    """Return the failures of the shards that are done; the last line may still be written."""
    found: dict[str, str] = {}
    path = folder / DONE_NAME
    for line in path.read_bytes().splitlines(keepends=True) if path.is_file() else []:
        if line.endswith(b"\n"):
            found |= json.loads(line)["failures"]
    return found


class _Fleet:
    """The page, made again when the fleet has changed."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._seen = folder, ""
        self.version, self.html = 0, fleet_view(folder)
        self._seen = self._stamp()

    def _stamp(self) -> str:
        names = (DONE_NAME, STATE_NAME, LESSONS_NAME)
        paths = [self._folder / name for name in names if (self._folder / name).is_file()]
        return str([(path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in paths])

    async def follow(self) -> None:
        """Look now and then, without end; what cannot be read is looked at again."""
        while True:
            await asyncio.sleep(LOOK_SECONDS)
            try:
                stamp = self._stamp()
                if stamp != self._seen:
                    self.html = await asyncio.to_thread(fleet_view, self._folder)
                    self.version, self._seen = self.version + 1, stamp
            except (TwinMasterError, ReportingError, OSError, ValueError):
                continue  # it was just being written, or another fleet takes its place


class _Answer(RequestHandler):
    """What the page asks for."""

    def initialize(self, answer: Callable[[], str], kind: str) -> None:
        self._answer, self._kind = answer, kind

    def set_default_headers(self) -> None:
        for name, value in HEADERS.items():
            self.set_header(name, value.replace("script-src 'self'", f"script-src 'self' {script_source()}"))

    def get(self) -> None:
        self.set_header("Content-Type", f"{self._kind}; charset=utf-8")
        self.write(self._answer())


def serve_fleet(
    folder: Path, port: int, ready: Callable[[str], None], wanted: Callable[[], bool] = lambda: True
) -> None:
    """Show a fleet to browsers of this machine, as `viewer.server.serve` shows a flight."""
    fleet = _Fleet(folder)
    script = resources.files(__package__).joinpath("view.js").read_text(encoding="utf-8")

    def page() -> str:
        tag = f'<script src="/view.js" data-version="{fleet.version}"></script></body>'
        return fleet.html.replace("</body>", tag)

    handlers = [
        (path, _Answer, {"answer": answer, "kind": kind})
        for path, answer, kind in (
            ("/", page, "text/html"),
            ("/version", lambda: str(fleet.version), "text/plain"),
            ("/view.js", lambda: script, "text/javascript"),
        )
    ]
    application = Application()
    application.add_handlers(OWN_NAMES, handlers)

    async def follow_and_serve() -> None:
        following = asyncio.create_task(fleet.follow())
        await serve_application(application, port, ready, wanted)
        following.cancel()

    asyncio.run(follow_and_serve())
