"""The live report of a fleet in the browser: while it flies, while it is watched, or afterwards."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from reporting.errors import ReportingError
from reporting.pages.page import render_page
from twin_master.errors import TwinMasterError
from twin_master.fleet.learning.lessons import LESSONS_NAME
from twin_master.fleet.page.report import fleet_page
from twin_master.fleet.watched.watched_asset import STATE_NAME
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.run_folder import FLEET_KIND, WATCHED_FLEET_KIND, find_config
from twin_master.viewer.server import (
    ServedText,
    is_always_wanted,
    package_text,
    serve_texts,
)

ATTENTION_ROWS = 50
"""Rows of the table of assets that need attention next, in the browser."""


def is_fleet(folder: Path) -> bool:
    """Return whether a folder is that of a fleet, flown or watched."""
    return find_config(folder, FLEET_KIND, WATCHED_FLEET_KIND) is not None


def serve_fleet(
    folder: Path,
    port: int,
    ready: Callable[[str], None],
    is_wanted: Callable[[], bool] = is_always_wanted,
) -> None:
    """Serve the report of a fleet to browsers on this machine; update it when files change.

    Parameters
    ----------
    port : int
        The port of the server; 0 takes a free one.
    ready : callable
        Called with the address once the server answers.
    is_wanted : callable
        Returns whether to continue serving; by default always.
    """
    page = _CurrentPage(folder)
    texts = {
        "/": ServedText(page.html, "text/html"),
        "/version": ServedText(page.version, "text/plain"),
        "/view.js": package_text("twin_master.fleet.page", "view.js", "text/javascript"),
    }
    serve_texts(texts, port, ready, is_wanted)


class _CurrentPage:
    """The report of a fleet as HTML, which is rendered again when its files have changed.

    Parameters
    ----------
    folder : Path
        The folder of the fleet.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._stamps = _file_stamps(folder)
        self._version = 0
        self._html = self._render(self._version)

    def _render(self, version: int) -> str:
        """Render the page with a script that asks the server for newer versions."""
        page = fleet_page(self._folder, ATTENTION_ROWS)
        return render_page(replace(page, scripts=[f"/view.js?version={version}"]))

    def version(self) -> str:
        """Render the page again if the fleet's files have changed, and return its version number.

        If a file cannot be read, because it is being written, the former page and version stay.
        """
        with suppress(TwinMasterError, ReportingError, OSError, ValueError):
            stamps = _file_stamps(self._folder)
            if stamps != self._stamps:
                self._html = self._render(self._version + 1)
                self._stamps = stamps
                self._version += 1
        return str(self._version)

    def html(self) -> str:
        """Return the current page."""
        self.version()
        return self._html


def _file_stamps(folder: Path) -> list[tuple[str, int, int]]:
    """Return name, time of modification [ns] and size of the files from which the page is made."""
    stamps = []
    for name in (JOURNAL_NAME, STATE_NAME, LESSONS_NAME):
        path = folder / name
        if path.is_file():
            stat = path.stat()
            stamps.append((name, stat.st_mtime_ns, stat.st_size))
    return stamps
