"""The server of the page of a flight, for browsers of this machine only.

Everything comes from the package, and nothing from other hosts.
"""

import asyncio
import os
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets
from tornado.routing import Rule, URLSpec
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from reporting.pages.page import script_source
from twin_master.errors import ViewError
from twin_master.viewer.flight import Flight
from twin_master.viewer.flight_page import FlightPage, Request

ADDRESS = "127.0.0.1"
POLL_SECONDS = 0.015
"""Seconds between two checks of the run folder for new lines, each of some microseconds."""
LONGEST_REQUEST = 4096
"""Greatest length of a request [bytes]."""
_INVALID_MESSAGE = 1003
"""The code with which a WebSocket is closed after a message that is not a request."""

HOST_NAMES = r"(localhost|127\.0\.0\.1)(:\d+)?"
"""The host names to which the server answers.

The page of another site may let its own name point to this machine (DNS rebinding). Its requests
come with that name, and are refused.
"""
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; connect-src 'self' ws:; img-src 'self' data: blob:; "
        f"style-src 'self' 'unsafe-inline'; script-src 'self' {script_source()}; "
        "frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class ServedText(NamedTuple):
    """A text of a server.

    Attributes
    ----------
    read : callable
        Returns the text. Its arguments are the parts of the requested path that the groups of the
        regular expression match, as strings.
    media_type : str
        The type of the text, such as "text/html".
    """

    read: Callable[..., str]
    media_type: str


class _StepsSocket(WebSocketHandler):
    """The connection of one open page."""

    def initialize(self, page: FlightPage) -> None:
        """Set the page that answers; tornado calls this after the constructor."""
        self._page = page

    def on_message(self, message: str | bytes) -> None:
        """Answer a request; close the connection if the message is not a request."""
        try:
            self._page.add_request(self.send, Request.model_validate_json(message))
        except ValueError as error:
            self.close(_INVALID_MESSAGE, str(error)[:100])

    def on_close(self) -> None:
        """Forget the viewer, whose connection is closed."""
        self._page.remove_viewer(self.send)

    def send(self, text: str) -> None:
        """Send an answer; forget the viewer if its connection is closed."""
        try:
            self.write_message(text)
        except WebSocketClosedError:
            self._page.remove_viewer(self.send)


class _TextHandler(RequestHandler):
    """Answers requests for one text."""

    def initialize(self, text: ServedText) -> None:
        """Set the text to be served; tornado calls this after the constructor."""
        self._text = text

    def set_default_headers(self) -> None:
        """Set the headers that keep a page from loading anything from other hosts."""
        for name, value in HEADERS.items():
            self.set_header(name, value)

    def get(self, *groups: str) -> None:
        """Answer with the text, or with 404 if there is none.

        Parameters
        ----------
        *groups : str
            The parts of the requested path that the groups of its regular expression match.
        """
        self.set_header("Content-Type", f"{self._text.media_type}; charset=utf-8")
        try:
            self.write(self._text.read(*groups))
        except (IndexError, OSError) as error:
            raise HTTPError(404) from error


def package_text(package: str, name: str, media_type: str) -> ServedText:
    """Return a file of a package as a text of a server; it is read when it is asked for.

    Parameters
    ----------
    package : str
        The package, such as "twin_master.viewer".
    name : str
        The name of the file in the folder of the package.
    media_type : str
        The type of the text, such as "text/css".
    """
    file = resources.files(package).joinpath(name)
    return ServedText(lambda: file.read_text(encoding="utf-8"), media_type)


def is_always_wanted() -> bool:
    """Return True; the default for `is_wanted`, with which a server runs until interrupted."""
    return True


def serve_texts(
    texts: Mapping[str, ServedText],
    port: int,
    on_ready: Callable[[str], None],
    is_wanted: Callable[[], bool],
    handlers: Sequence[Rule] = (),
    poll: Callable[[], None] = lambda: None,
) -> None:
    """Serve texts to browsers of this machine until `is_wanted` returns False.

    Parameters
    ----------
    texts : mapping of str to ServedText
        The texts by their paths, which are regular expressions.
    port : int
        The port; 0 for any that is free.
    on_ready : callable
        Called with the address once it answers.
    is_wanted : callable
        Called now and then; once it returns False the server ends.
    handlers : sequence of tornado.routing.Rule
        Further handlers.
    poll : callable
        Called every few milliseconds.

    Raises
    ------
    ViewError
        If the port is taken.
    """
    rules: list[Rule] = [
        URLSpec(path, _TextHandler, {"text": text}) for path, text in texts.items()
    ]
    application = Application(
        websocket_max_message_size=LONGEST_REQUEST, websocket_ping_interval=20
    )
    application.add_handlers(HOST_NAMES, [*rules, *handlers])

    async def serve_until_unwanted() -> None:
        server = HTTPServer(application, max_body_size=LONGEST_REQUEST)
        try:
            sockets = bind_sockets(port, ADDRESS)
        except OSError as error:
            reason = os.strerror(error.errno or 0)
            raise ViewError(
                f"port {port} of {ADDRESS} cannot be taken ({reason}): choose another --port."
            ) from error
        server.add_sockets(sockets)
        _, bound_port = sockets[0].getsockname()
        on_ready(f"http://{ADDRESS}:{bound_port}/")
        try:
            while is_wanted():
                poll()
                await asyncio.sleep(POLL_SECONDS)
        finally:
            server.stop()

    asyncio.run(serve_until_unwanted())


def serve(
    folder: Path,
    port: int,
    on_ready: Callable[[str], None],
    is_wanted: Callable[[], bool] = is_always_wanted,
) -> None:
    """Show the flight of a run folder to browsers of this machine.

    Parameters
    ----------
    folder : Path
        The folder of a flight that has ended or goes on.
    port : int
        The port; 0 for any that is free.
    on_ready : callable
        Called with the address once it answers.
    is_wanted : callable
        Called now and then; once it returns False the server ends. If left out, the server goes on
        until its process is interrupted.

    Raises
    ------
    NotResumableError, RunFolderError
        If there is no such run, or if it is damaged.
    ViewError
        If the port is taken.
    """
    flight = Flight(folder)
    page = FlightPage(flight)
    html = page.render_html()

    def read_drawing(number: str) -> str:
        return flight.drawings[int(number)].path.read_text(encoding="utf-8")

    texts = {
        "/": ServedText(lambda: html, "text/html"),
        "/plots.js": package_text("twin_master.viewer", "plots.js", "text/javascript"),
        "/view.js": package_text("twin_master.viewer", "view.js", "text/javascript"),
        "/view.css": package_text("twin_master.viewer", "view.css", "text/css"),
        r"/missing_force_(\d+)\.svg": ServedText(read_drawing, "image/svg+xml"),
    }
    socket = URLSpec("/steps", _StepsSocket, {"page": page})
    serve_texts(texts, port, on_ready, is_wanted, [socket], page.update)
