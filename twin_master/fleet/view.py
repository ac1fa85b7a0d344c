"""The page of a fleet in the browser: while it flies, while it is watched, or afterwards."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from reporting.errors import ReportingError
from twin_master.errors import TwinMasterError
from twin_master.fleet.configuration import KIND, WATCHED_KIND
from twin_master.fleet.lessons import LESSONS_NAME
from twin_master.fleet.report import fleet_page
from twin_master.fleet.watched_asset import STATE_NAME
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.run_folder import find_config
from twin_master.viewer.server import ServedText, package_text, serve_texts

ATTENTION_ROWS = 50
"""Rows of the table of assets that need attention next, in the browser."""


def is_fleet(folder: Path) -> bool:
    """Return whether a folder is that of a fleet, flown or watched."""
    return find_config(folder, KIND, WATCHED_KIND) is not None


def _always() -> bool:
    """Return that a page is wanted for ever."""
    return True


def serve_fleet(
    folder: Path,
    port: int,
    ready: Callable[[str], None],
    wanted: Callable[[], bool] = _always,
) -> None:
    """Show a fleet to browsers of this machine.

    Parameters
    ----------
    folder : Path
        The folder of the fleet.
    port : int
        The port of the server; 0 takes a free one.
    ready : callable
        Called with the address once the page can be seen.
    wanted : callable
        Returns whether the page is still wanted.
    """
    page = _CurrentPage(folder)
    texts = {
        "/": ServedText(page.html, "text/html"),
        "/version": ServedText(page.version, "text/plain"),
        "/view.js": package_text("twin_master.fleet", "view.js", "text/javascript"),
    }
    serve_texts(texts, port, ready, wanted)


class _CurrentPage:
    """The page of a fleet, made again whenever the fleet has changed.

    Parameters
    ----------
    folder : Path
        The folder of the fleet.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stamps = _file_stamps(folder)
        self._html = fleet_page(folder, ATTENTION_ROWS)
        self._version = 0

    def version(self) -> str:
        """Return the number of the page, which grows when the fleet has changed.

        Files that cannot be read are just being written; they are looked at again next time.
        """
        with suppress(TwinMasterError, ReportingError, OSError, ValueError):
            stamps = _file_stamps(self._folder)
            if stamps != self._stamps:
                self._html = fleet_page(self._folder, ATTENTION_ROWS)
                self._stamps = stamps
                self._version += 1
        return str(self._version)

    def html(self) -> str:
        """Return the page, with a script that looks for changes."""
        script = f'<script src="/view.js" data-version="{self.version()}"></script>'
        return self._html.replace("</body>", f"{script}</body>")


def _file_stamps(folder: Path) -> list[tuple[str, int, int]]:
    """Return name, time of modification [ns] and size of the files on which the page rests."""
    stamps = []
    for name in (JOURNAL_NAME, STATE_NAME, LESSONS_NAME):
        path = folder / name
        if path.is_file():
            stat = path.stat()
            stamps.append((name, stat.st_mtime_ns, stat.st_size))
    return stamps
