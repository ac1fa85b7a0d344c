"""The server of the page: on the loopback only, everything from the package, nothing from outside."""

import asyncio
import os
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from reporting.page import script_source
from twin_master.errors import ViewError, said
from twin_master.viewer.flight import Flight, Request, Teller

ADDRESS = "127.0.0.1"
POLL_SECONDS = 0.015
"""Between two looks at the run folder; a look takes some microseconds."""
LONGEST_REQUEST = 4096
"""Bytes."""

OWN_NAMES = r"(localhost|127\.0\.0\.1)(:\d+)?"
"""A page of another site that lets its name point here would come with that name, and is not answered."""
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; connect-src 'self' ws:; img-src 'self' data: blob:; "
    "style-src 'self' 'unsafe-inline'; script-src 'self' " + script_source() + "; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class _StepsSocket(WebSocketHandler):
    """One open page."""

    def initialize(self, teller: Teller) -> None:
        self._teller = teller

    def on_message(self, message: str | bytes) -> None:
        try:
            self._teller.ask(self.tell, Request.model_validate_json(message))
        except ValueError as error:
            self.close(1003, str(error)[:100])

    def on_close(self) -> None:
        self._teller.leave(self.tell)

    def tell(self, text: str) -> None:
        try:
            self.write_message(text)
        except WebSocketClosedError:
            self._teller.leave(self.tell)


class _Answer(RequestHandler):
    """A text that is asked for."""

    def initialize(self, answer: Callable[..., str], kind: str) -> None:
        self._answer, self._kind = answer, kind

    def set_default_headers(self) -> None:
        for name, value in HEADERS.items():
            self.set_header(name, value)

    def get(self, *found: str) -> None:
        self.set_header("Content-Type", f"{self._kind}; charset=utf-8")
        try:
            self.write(self._answer(*found))
        except (IndexError, OSError) as error:
            raise HTTPError(404) from error


def text_of(package: str, name: str) -> Callable[[], str]:
    """Return what reads a file of a package."""
    return lambda: resources.files(package).joinpath(name).read_text(encoding="utf-8")


def serve_page(
    texts: Mapping[str, tuple[Callable[..., str], str]], port: int, ready: Callable[[str], None],
    wanted: Callable[[], bool], handlers: Sequence[Any] = (), look: Callable[[], None] = lambda: None,
) -> None:  # fmt: skip
    """Serve texts on the loopback as long as they are wanted, see `serve`.

    Parameters
    ----------
    texts : mapping
        What gives the text of a path, told what is in brackets there; and its kind.
    port, ready, wanted
        See `serve`.
    handlers : sequence
        Further handlers of tornado.
    look : callable
        Called every few milliseconds.
    """
    answers = [(path, _Answer, {"answer": text, "kind": kind}) for path, (text, kind) in texts.items()]
    application = Application(websocket_max_message_size=LONGEST_REQUEST, websocket_ping_interval=20)
    application.add_handlers(OWN_NAMES, [*answers, *handlers])

    async def serving() -> None:
        server = HTTPServer(application, max_body_size=LONGEST_REQUEST)
        try:
            sockets = bind_sockets(port, ADDRESS)
        except OSError as error:
            reason = os.strerror(error.errno or 0)
            raise ViewError(said("watch.port", port=port, address=ADDRESS, reason=reason)) from error
        server.add_sockets(sockets)
        ready(f"http://{ADDRESS}:{sockets[0].getsockname()[1]}/")
        try:
            while wanted():
                look()
                await asyncio.sleep(POLL_SECONDS)
        finally:
            server.stop()

    asyncio.run(serving())


def serve(
    folder: Path, port: int, ready: Callable[[str], None], wanted: Callable[[], bool] = lambda: True
) -> None:
    """Show the flight of a run folder to browsers of this machine, until the process is interrupted.

    Parameters
    ----------
    folder : Path
        With a flight that is finished or goes on.
    port : int
        0 for any that is free.
    ready : callable
        Called with the address once it answers.
    wanted : callable
        Asked now and then; once it says no, the server ends.

    Raises
    ------
    NotResumableError, RunFolderError
        There is no such run, or it is damaged.
    ViewError
        The port is taken.
    """
    flight = Flight(folder)
    teller = Teller(flight)
    page = teller.page()

    def picture(number: str) -> str:
        return flight.pictures[int(number)].drawing.read_text(encoding="utf-8")

    texts: dict[str, tuple[Callable[..., str], str]] = {
        "/": (lambda: page, "text/html"),
        "/plots.js": (text_of("twin_master.viewer", "plots.js"), "text/javascript"),
        "/view.js": (text_of("twin_master.viewer", "view.js"), "text/javascript"),
        "/view.css": (text_of("twin_master.viewer", "view.css"), "text/css"),
        r"/missing_force_(\d+)\.svg": (picture, "image/svg+xml"),
    }
    serve_page(texts, port, ready, wanted, [("/steps", _StepsSocket, {"teller": teller})], teller.look)
