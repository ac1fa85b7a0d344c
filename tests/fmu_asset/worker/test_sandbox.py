"""FMUs that reach for what is not theirs: nothing is touched, and the sentence says what to do."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuCallError
from fmu_asset.worker.sandbox import landlock_version

pytestmark = pytest.mark.skipif(landlock_version() < 6, reason="the kernel is older than Linux 6.12")

Attempted = Callable[[], bool]
"""Whether what was attempted has happened."""


def binding(**limits: Any) -> Binding:
    return parse_binding(
        {
            "binding": {"name": "hostile", "step_size": 1.0},
            "control": {"u": {"variable": "u", "unit": "m/s"}},
            "observation": {"y": {"variables": "y", "unit": "m"}},
            "limits": limits,
        }
    )


@pytest.fixture
def key(tmp_path: Path) -> Path:
    """Return a private key."""
    path = tmp_path / "id_ed25519"
    path.write_text("the private key")
    path.chmod(0o600)
    return path


class Targets:
    """What is attempted, by name: the target that the FMU is told, and whether it was reached."""

    def __init__(self, folder: Path, key: Path, cleaner: ExitStack) -> None:
        self._folder, self._key, self._cleaner = folder, key, cleaner

    def delete(self) -> tuple[str, Attempted]:
        return str(self._key), lambda: not self._key.exists()

    def overwrite(self) -> tuple[str, Attempted]:
        return str(self._key), lambda: self._key.read_text() == ""

    def read(self) -> tuple[str, Attempted]:
        return str(self._key), lambda: True  # what the FMU returns says it

    def spy(self) -> tuple[str, Attempted]:
        return f"/proc/{os.getpid()}/environ", lambda: True

    def make(self) -> tuple[str, Attempted]:
        path = self._folder / "made"
        return str(path), path.exists

    def permit(self) -> tuple[str, Attempted]:
        return str(self._key), lambda: self._key.stat().st_mode & 0o777 == 0o777

    def call(self) -> tuple[str, Attempted]:
        return self._listening(socket.AF_INET, socket.SOCK_STREAM, ("127.0.0.1", 0))

    def datagram(self) -> tuple[str, Attempted]:
        return self._listening(socket.AF_INET, socket.SOCK_DGRAM, ("127.0.0.1", 0))

    def service(self) -> tuple[str, Attempted]:
        return self._listening(socket.AF_UNIX, socket.SOCK_STREAM, str(self._folder / "service"))

    def kill(self) -> tuple[str, Attempted]:
        process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
        self._cleaner.callback(process.communicate)

        def killed() -> bool:
            try:
                return process.wait(0.0) != 0
            except subprocess.TimeoutExpired:
                return False

        return str(process.pid), killed

    def _listening(self, family: int, kind: int, address: Any) -> tuple[str, Attempted]:
        line = self._cleaner.enter_context(socket.socket(family, kind))
        line.bind(address)
        if kind == socket.SOCK_STREAM:
            line.listen()
        line.setblocking(False)

        def reached() -> bool:
            try:
                line.accept()[0].close() if kind == socket.SOCK_STREAM else line.recv(8)
            except BlockingIOError:
                return False
            return True

        return str(line.getsockname()[1] if family == socket.AF_INET else address), reached


@pytest.fixture
def targets(tmp_path: Path, key: Path) -> Iterator[Targets]:
    with ExitStack() as cleaner:
        yield Targets(tmp_path, key, cleaner)


ATTEMPTS = [
    ("delete", "unlink(TARGET)", "Permission denied"),
    ("overwrite", "overwrite(TARGET)", "Permission denied"),
    ("overwrite", "truncate(TARGET,0)", "Permission denied"),
    ("delete", 'rename(TARGET,"mine")', "Permission denied"),
    ("read", "look_into(TARGET)", "Permission denied"),
    ("read", 'link(TARGET,"mine")', "Invalid cross-device link"),
    ("spy", "look_into(TARGET)", "Permission denied"),
    ("make", "create(TARGET)", "Permission denied"),
    ("make", "mkdir(TARGET,0700)", "Permission denied"),
    ("make", "start_program(TARGET)", "Permission denied"),
    ("call", "call(SOCK_STREAM,0,TARGET)", "Permission denied"),
    ("call", "call(SOCK_STREAM,262,TARGET)", "Permission denied"),  # multipath TCP
    ("datagram", "call(SOCK_DGRAM,0,TARGET)", "Permission denied"),
    ("service", "call_service(TARGET)", "Permission denied"),
    ("kill", "kill(atoi(TARGET),SIGKILL)", "Operation not permitted"),
]


@pytest.mark.parametrize(("what", "attempt", "reason"), ATTEMPTS, ids=[case[1] for case in ATTEMPTS])
def test_what_is_not_its_own_is_out_of_reach(
    foreign_fmu: Any, targets: Targets, monkeypatch: pytest.MonkeyPatch, what: str, attempt: str, reason: str
) -> None:
    """And the same FMU reaches it where the sandbox is off: it is the sandbox that holds."""
    fmu = foreign_fmu("hostile2", f"ATTEMPT={attempt}")
    target, happened = getattr(targets, what)()
    monkeypatch.setenv("HOSTILE_TARGET", target)
    with FmiAsset(fmu, binding()) as asset:
        asset.step(), asset.step()
        with pytest.raises(FmuCallError, match=rf"(?s)step 2 .*it cannot have {target}: {reason}") as caught:
            asset.step()
    assert ("granted by `read`, `write`, `ports`" in str(caught.value)) == (reason == "Permission denied")
    assert what in ("read", "spy") or not happened()
    with FmiAsset(fmu, binding(sandbox=False)) as asset:
        for _ in range(3):
            asset.step()
    assert happened()


def test_an_fmu_that_does_not_say_what_it_was_refused(
    foreign_fmu: Any, key: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOSTILE_TARGET", str(key))
    with FmiAsset(foreign_fmu("hostile2", "ATTEMPT=look_into(TARGET)", "SILENT"), binding()) as asset:
        asset.step(), asset.step()
        with pytest.raises(FmuCallError, match=r"The system refused it something \(Permission denied\)"):
            asset.step()
