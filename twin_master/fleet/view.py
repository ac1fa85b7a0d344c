"""The page of a fleet that follows it in the browser: while it flies, while it is watched, or afterwards.

It is made of what the fleet writes anyway, and reads the same with ten assets and with ten thousand: maps and
bands of all, and the fifty that are worst.
"""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from reporting.errors import ReportingError
from twin_master.errors import TwinMasterError
from twin_master.fleet.flight import KIND, WATCHED_KIND
from twin_master.fleet.lessons import LESSONS_NAME
from twin_master.fleet.report import fleet_page
from twin_master.fleet.watching import STATE_NAME
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.run_folder import folder_config
from twin_master.viewer.server import serve_page, text_of

WORST = 50
"""Assets in the table."""


def is_fleet(folder: Path) -> bool:
    """Return whether a folder is that of a fleet, flown or watched."""
    return folder_config(folder, KIND, WATCHED_KIND) is not None


def serve_fleet(
    folder: Path, port: int, ready: Callable[[str], None], wanted: Callable[[], bool] = lambda: True
) -> None:
    """Show a fleet to browsers of this machine, as `viewer.server.serve` shows a flight."""
    seen, version, html = _stamp(folder), 0, fleet_page(folder, WORST)

    def current() -> str:
        """Make the page again where the fleet has changed; what cannot be read is looked at again."""
        nonlocal seen, version, html
        with suppress(TwinMasterError, ReportingError, OSError, ValueError):  # it was just being written
            if (stamp := _stamp(folder)) != seen:
                html = fleet_page(folder, WORST)
                seen, version = stamp, version + 1
        return str(version)

    def page() -> str:
        tag = f'<script src="/view.js" data-version="{current()}"></script></body>'
        return html.replace("</body>", tag)

    texts = {
        "/": (page, "text/html"),
        "/version": (current, "text/plain"),
        "/view.js": (text_of("twin_master.fleet", "view.js"), "text/javascript"),
    }
    serve_page(texts, port, ready, wanted)


def _stamp(folder: Path) -> list[tuple[str, int, int]]:
    paths = [folder / name for name in (JOURNAL_NAME, STATE_NAME, LESSONS_NAME)]
    stats = [(path.name, path.stat()) for path in paths if path.is_file()]
    return [(name, stat.st_mtime_ns, stat.st_size) for name, stat in stats]
