"""The page of a fleet that follows it in the browser: while it flies, while it is watched, or afterwards.

It is made of what the fleet writes anyway, and reads the same with ten assets and with ten thousand: maps and
bands of all, and the fifty that are worst.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path

from tornado.web import Application

from reporting.errors import ReportingError
from twin_master.errors import TwinMasterError
from twin_master.fleet.flight import fleet_record
from twin_master.fleet.lessons import LESSONS_NAME
from twin_master.fleet.report import fleet_page
from twin_master.fleet.watching import STATE_NAME
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.viewer.server import OWN_NAMES, handlers_of, serve_application, text_of

WORST = 50
"""Assets in the table."""
LOOK_SECONDS = 1.0
"""Between two looks at the fleet."""


def is_fleet(folder: Path) -> bool:
    """Return whether a folder is that of a fleet, flown or watched."""
    return fleet_record(folder) is not None


class _Fleet:
    """The page, made again when the fleet has changed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.version, self._seen, self.html = 0, self._stamp(), fleet_page(folder, WORST)

    def _stamp(self) -> str:
        names = (JOURNAL_NAME, STATE_NAME, LESSONS_NAME)
        paths = [self._folder / name for name in names if (self._folder / name).is_file()]
        return str([(path.name, path.stat().st_mtime_ns, path.stat().st_size) for path in paths])

    async def follow(self) -> None:
        """Look now and then, without end; what cannot be read is looked at again."""
        while True:
            await asyncio.sleep(LOOK_SECONDS)
            try:
                stamp = self._stamp()
                if stamp != self._seen:
                    self.html = await asyncio.to_thread(fleet_page, self._folder, WORST)
                    self.version, self._seen = self.version + 1, stamp
            except (TwinMasterError, ReportingError, OSError, ValueError):
                continue  # it was just being written, or another fleet takes its place


def serve_fleet(
    folder: Path, port: int, ready: Callable[[str], None], wanted: Callable[[], bool] = lambda: True
) -> None:
    """Show a fleet to browsers of this machine, as `viewer.server.serve` shows a flight."""
    fleet = _Fleet(folder)

    def page() -> str:
        tag = f'<script src="/view.js" data-version="{fleet.version}"></script></body>'
        return fleet.html.replace("</body>", tag)

    texts = {
        "/": (page, "text/html"),
        "/version": (lambda: str(fleet.version), "text/plain"),
        "/view.js": (text_of("twin_master.fleet", "view.js"), "text/javascript"),
    }
    application = Application()
    application.add_handlers(OWN_NAMES, handlers_of(texts))

    async def follow_and_serve() -> None:
        following = asyncio.create_task(fleet.follow())
        await serve_application(application, port, ready, wanted)
        following.cancel()

    asyncio.run(follow_and_serve())
