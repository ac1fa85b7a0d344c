"""Watches without a calibration of their own, recordings, and a broker."""

from __future__ import annotations

import copy
import json
import shutil
import socket
import subprocess
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from paho.mqtt import client as paho

from twin_master.mission.journal import JOURNAL_NAME, records
from twin_master.scenario.tables import Noticing
from twin_master.watch.folder import Watch
from twin_master.watch.replay import BelievedModel


def write_csv(path: Path, observed: np.ndarray, controls: np.ndarray, garbage: bool = False) -> Path:
    lines = ["turn,control," + ",".join(f"strain_{number}" for number in range(1, 25))]
    for turn, row in enumerate(observed):
        cells = ",".join("" if np.isnan(value) else repr(value) for value in row.tolist())
        lines.append(f"{turn},{('2g', '3g')[controls[turn]]},{cells}")
        if garbage and turn % 7 == 3:
            lines.append(f"{turn},4g,what")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def begun(base: Watch, folder: Path) -> Watch:
    """Return a watch of the same configuration in a folder of its own, without calibrating again."""
    shutil.copytree(base.folder, folder)
    watch = copy.copy(base)
    watch.folder, watch._path, watch.models = folder, folder / JOURNAL_NAME, list(base.models)
    watch._patches = [None]
    return watch


def watchful(base: Watch, folder: Path) -> Watch:
    watch = begun(base, folder)
    watch.scenario = watch.scenario.model_copy(update={"notice": Noticing()})
    watch.models = [BelievedModel(0, replace(base.models[0].knowledge, scenario=watch.scenario))]
    watch._take_up()
    return watch


def soon_quiet(watch: Watch) -> Watch:
    """Return a watch that notices a silence at once."""
    section = watch.scenario.watch.model_copy(update={"quiet_after_seconds": 0.2})
    watch.scenario = watch.scenario.model_copy(update={"watch": section})
    return watch


def wait_until(found: Callable[[], object]) -> None:
    limit = time.monotonic() + 60.0
    while not found() and time.monotonic() < limit:
        time.sleep(0.02)


def lines(watch: Watch) -> list[dict[str, Any]]:
    return [record for record, *_ in records(watch.folder / JOURNAL_NAME)]


PASSWORD = "a password"


class Mosquitto:
    """A broker on the loopback that wants a user, or TLS, and keeps its sessions when it stops."""

    def __init__(self, folder: Path, *further: str, tls: bool = False) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.folder, self.tls = folder, tls
        self.authority = folder / "certificate.pem"
        self.let_in(PASSWORD)
        self.lines = [
            f"listener {self.port} 127.0.0.1", "allow_anonymous false", f"password_file {folder / 'users'}",
            "persistence true", f"persistence_location {folder}/", "max_queued_messages 10000", "user root",
        ]  # fmt: skip
        if tls:
            command = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2"
            subprocess.run(
                ["openssl", *command.split(), "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1",
                 "-subj", "/CN=localhost",
                 "-keyout", str(folder / "key.pem"), "-out", str(self.authority)],
                check=True, capture_output=True,
            )  # fmt: skip
            self.lines += [f"certfile {self.authority}", f"keyfile {folder / 'key.pem'}"]
        self.further = [*further]
        self.start()

    def let_in(self, password: str) -> None:
        """Let in who knows a password, from the next start on."""
        users = ["mosquitto_passwd", "-b", "-c", str(self.folder / "users"), "wing", password]
        subprocess.run(users, check=True, capture_output=True)

    def start(self) -> None:
        (self.folder / "mosquitto.conf").write_text("\n".join([*self.lines, *self.further, ""]))
        self.process = subprocess.Popen(
            ["mosquitto", "-c", str(self.folder / "mosquitto.conf")], stderr=subprocess.DEVNULL
        )
        for _ in range(400):
            try:
                socket.create_connection(("127.0.0.1", self.port), 1.0).close()
                return
            except OSError:
                time.sleep(0.02)

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(20)

    def client(self, name: str, heard: list[Any] | None = None) -> Any:
        """Return a client whose session lasts, and that hears what its topics say."""
        client = paho.Client(paho.CallbackAPIVersion.VERSION2, client_id=name, clean_session=False)
        client.username_pw_set("wing", PASSWORD)
        if heard is not None:
            client.on_message = lambda _client, _data, told: heard.append(json.loads(told.payload))
        if self.tls:
            client.tls_set(ca_certs=str(self.authority))
        client.connect("localhost" if self.tls else "127.0.0.1", self.port)
        client.loop_start()
        return client
