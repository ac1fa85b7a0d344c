"""The page of the figures of watches, which a monitoring system reads over HTTP."""

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import BaseServer

from twin_master.errors import MissionInputError
from twin_master.watch.folder import Watch
from twin_master.watch.metrics import WatchMetrics, exposition

LOOPBACK = "127.0.0.1"
"""The address that is served where the user names none: that of this machine alone."""
PATH = "/metrics"
MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
_ADDRESS = re.compile(r"(?:(\[[\w.:]+\]|[\w.-]+):)?(\d{1,5})")
_LARGEST_PORT = 65_535
_IDLE_SECONDS = 10
"""Seconds after which a connection without a request is closed."""


class MetricsServer:
    """Serves the figures of watches, of each from the moment when it is attached.

    Parameters
    ----------
    host : str
        The address or name of the interface to serve.
    port : int
        The port; 0 for any free one.

    Attributes
    ----------
    address : str
        The address of the page.

    Raises
    ------
    MissionInputError
        If nothing can be served there, for example because the port is taken.
    """

    def __init__(self, host: str, port: int) -> None:
        self._metrics_of_asset: dict[str, WatchMetrics] = {}
        with MissionInputError.instead_of(
            OSError, before=f"the metrics cannot be served at {host}:{port}: ", after="."
        ):
            self._server = _Server((host, port), self)
        self.address = f"http://{host}:{self._server.server_address[1]}{PATH}"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def attach(self, asset: str, watch: Watch) -> WatchMetrics:
        """Serve the figures of a watch from now on, and return them.

        Parameters
        ----------
        asset : str
            The name of the asset, which is in all of its figures.
        watch : Watch
            The watch; one that takes the place of another of the asset begins to count anew.
        """
        metrics = self._metrics_of_asset.get(asset)
        if metrics is None or metrics.watch is not watch:
            metrics = WatchMetrics(watch)
            self._metrics_of_asset[asset] = metrics
        return metrics

    def text(self) -> str:
        """Return the figures in the text format of Prometheus; empty before a watch is attached."""
        # A copy, because the thread of the watches may attach another one meanwhile
        attached = self._metrics_of_asset.copy()
        return exposition({asset: metrics.metrics() for asset, metrics in attached.items()})

    def close(self) -> None:
        """End the page."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Server(ThreadingHTTPServer):
    """An HTTP server that knows whose figures it serves."""

    def __init__(self, address: tuple[str, int], page: MetricsServer) -> None:
        self.page = page
        super().__init__(address, _Handler)


class _Handler(BaseHTTPRequestHandler):
    """Answers a request for the figures; nothing else is served."""

    timeout = _IDLE_SECONDS

    def __init__(self, request: object, client: object, server: BaseServer) -> None:
        assert isinstance(server, _Server)
        self._page = server.page
        super().__init__(request, client, server)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        """Send the figures."""
        if self.path.partition("?")[0] != PATH:
            self.send_error(HTTPStatus.NOT_FOUND, f"The figures are at {PATH}")
            return
        content = self._page.text().encode()
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", MEDIA_TYPE)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *arguments: object) -> None:  # noqa: A002 - as inherited
        """Write nothing: a monitoring system asks every few seconds."""


@contextmanager
def serve_metrics(address: str | int | None) -> Iterator[MetricsServer | None]:
    """Serve the figures of watches within a context; None if no address is given.

    Parameters
    ----------
    address : str, int or None
        A port of this machine, or ``HOST:PORT``, where the host is the interface to serve.

    Raises
    ------
    MissionInputError
        If the address has another form, or cannot be served.
    """
    if address is None:
        yield None
        return
    match = _ADDRESS.fullmatch(str(address))
    if match is None or int(match[2]) > _LARGEST_PORT:
        raise MissionInputError(
            f"metrics are served at a port such as 9100, or at HOST:PORT, but {address} was given."
        )
    server = MetricsServer((match[1] or LOOPBACK).strip("[]"), int(match[2]))
    try:
        yield server
    finally:
        server.close()
