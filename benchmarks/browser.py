"""A headless Chromium, driven by its DevTools protocol over Tornado's websocket."""

import asyncio
import base64
import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tornado.httpclient import AsyncHTTPClient
from tornado.websocket import WebSocketClientConnection, websocket_connect

CHROMIUM = (
    shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
)
_MOST = 256 * 2**20
_PATIENCE = 600.0
"""After so long [s] a browser hangs."""


class Tab:
    """A page that is open."""

    def __init__(self, loop: asyncio.AbstractEventLoop, socket: WebSocketClientConnection) -> None:
        self._loop, self._socket = loop, socket
        self._numbers = itertools.count(1)
        self.errors: list[str] = []
        self.requests: list[str] = []
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        answer = asyncio.wait_for(self._send(method, parameters), _PATIENCE)
        try:
            return self._loop.run_until_complete(answer)
        except TimeoutError:
            raise AssertionError(
                f"no answer to {method} {parameters}; errors: {self.errors}"
            ) from None

    async def _send(self, method: str, parameters: dict[str, Any]) -> dict[str, Any]:
        number = next(self._numbers)
        await self._socket.write_message(
            json.dumps({"id": number, "method": method, "params": parameters})
        )
        while True:
            text = await self._socket.read_message()
            assert text is not None, "the browser went away"
            message = json.loads(text)
            if message.get("id") == number:
                assert "error" not in message, (method, message)
                result: dict[str, Any] = message["result"]
                return result
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        parameters = message.get("params", {})
        if message["method"] == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(parameters["exceptionDetails"])[:2000])
        elif message["method"] == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            self.errors.append(parameters["entry"]["text"])
        elif message["method"] == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])

    def go(self, address: str, width: int = 1300, height: int = 1500) -> None:
        """Open an address in a window of a size."""
        self.resize(width, height)
        self.send("Page.navigate", url=address)

    def resize(self, width: int, height: int) -> None:
        """Give the window a size."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def value(self, expression: str) -> Any:
        """Return the value of a JavaScript expression; promises are awaited."""
        answer = self.send(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, condition: str) -> None:
        """Wait until a JavaScript expression is true."""
        self.value(
            "new Promise((resolve) => { const look = () => { let there = false;"
            f" try {{ there = ({condition}); }} catch (error) {{ }}"
            " if (there) resolve(true); else setTimeout(look, 20); }; look(); })"
        )

    def press(self, key: str) -> None:
        """Press a key."""
        text = {"text": key} if len(key) == 1 else {}
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key)

    def picture(self, path: Path, *, whole: bool = True) -> bytes:
        """Write a picture of the page and return it as PNG."""
        content = base64.b64decode(
            self.send("Page.captureScreenshot", captureBeyondViewport=whole)["data"]
        )
        path.write_bytes(content)
        return content


class Browser:
    """A browser with any number of tabs."""

    def __init__(self, loop: asyncio.AbstractEventLoop, port: int) -> None:
        self._loop, self._port = loop, port

    def tab(self) -> Tab:
        """Open an empty page."""
        return Tab(self._loop, self._loop.run_until_complete(self._connect()))

    async def _connect(self) -> WebSocketClientConnection:
        root = f"127.0.0.1:{self._port}"
        version = json.loads((await AsyncHTTPClient().fetch(f"http://{root}/json/version")).body)
        whole = await websocket_connect(version["webSocketDebuggerUrl"])
        # In a window of its own: what lies behind another tab is not painted.
        wanted = {"url": "about:blank", "newWindow": True}
        await whole.write_message(
            json.dumps({"id": 1, "method": "Target.createTarget", "params": wanted})
        )
        target = json.loads(str(await whole.read_message()))["result"]["targetId"]
        whole.close()
        return await websocket_connect(
            f"ws://{root}/devtools/page/{target}", max_message_size=_MOST
        )


@contextmanager
def open_browser() -> Iterator[Browser]:
    """Start a browser of its own, and end it."""
    assert CHROMIUM is not None, "these tests need Chromium: apt-get install chromium"
    loop = asyncio.new_event_loop()
    with tempfile.TemporaryDirectory(
        prefix="uav_twin_browser_", ignore_cleanup_errors=True
    ) as profile:
        options = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--no-first-run",
        ]
        process = subprocess.Popen(
            [
                CHROMIUM,
                *options,
                "--remote-debugging-port=0",
                f"--user-data-dir={profile}",
                "about:blank",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            yield Browser(loop, _port(Path(profile) / "DevToolsActivePort", process))
        finally:
            os.killpg(process.pid, 9)
            process.wait()
            loop.close()


def _port(path: Path, process: subprocess.Popen[bytes]) -> int:
    deadline = time.monotonic() + _PATIENCE
    while time.monotonic() < deadline:
        assert process.poll() is None, "the browser did not start"
        if path.is_file() and (text := path.read_text(encoding="ascii")).count("\n"):
            return int(text.splitlines()[0])
        time.sleep(0.1)
    raise AssertionError("the browser has not said its port")
