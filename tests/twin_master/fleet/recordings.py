"""A fleet of three wings with a recording each, for tests that watch it or fly it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tests.command_line import said
from tests.twin_master.runs import text_of, written
from tests.twin_master.watch.conftest import write_csv
from twin_master.fleet.plan import load_fleet
from twin_master.fleet.watched.watched_asset import WatchedAsset
from twin_master.fleet.watched.watching import FleetWatch
from twin_master.mission.journal import JOURNAL_NAME

STEPS = 6
FLOWN = [1, 1, 1, 1, 1, 0]
"""Control of each step: what the last one does to the wing nobody sees."""
LOGS = 'observations = "logs/*.csv"'
Decision = Mapping[str, Any]


def write_fleet(library: Path, folder: Path) -> Path:
    """Write a fleet of three wings with a recording each into a folder.

    Of one a line is garbage and a gauge unreadable for a step, of another a step is late.
    """
    text = text_of("growing_damage")
    flown = text[text.index("[asset]") : text.index("[calibration]")]
    asset = f'[asset]\nkind = "strain_library"\nfile = "{library}"\n\n[belief]\nkind = "asset"\n\n'
    written(folder, text, (flown, asset), name="wing.toml")
    (folder / "logs").mkdir()
    noise = np.random.default_rng(3).normal(1e-3, 1e-4, (3, STEPS, 24))
    for number, rows in enumerate(noise):
        write_csv(log_of(folder, number), rows, np.array(FLOWN), number == 1)
    unread, late = (log_of(folder, number).read_text().splitlines() for number in (1, 2))
    unread[3] = ",".join([*unread[3].split(",")[:-1], "OL"])
    late[3], late[4] = late[4], late[3]
    for number, lines in ((1, unread), (2, late)):
        log_of(folder, number).write_text("\n".join(lines) + "\n")
    return fleet_of(folder, LOGS)


def log_of(folder: Path, number: int) -> Path:
    return folder / "logs" / f"wing-{number}.csv"


def fleet_of(folder: Path, *lines: str) -> Path:
    head = (
        'format = 1\nfleet = { name = "real", seed = 7 }\n[[group]]\nname = "north"\nscenario = "wing.toml"'
    )
    return written(folder, "\n".join([head, *lines, ""]), name="fleet.toml")


def watch_alone(folder: Path) -> list[bytes]:
    """Watch each asset of a folder alone, and return the journals."""
    for number in range(3):
        out = folder / "alone" / f"wing-{number}"
        options = ("--observations", log_of(folder, number), "--out", out, "--seed", 7)
        said("watch", folder / "wing.toml", *options, "--no-report")
    return [path.read_bytes() for path in sorted((folder / "alone").glob(f"*/{JOURNAL_NAME}"))]


def watched(fleet_file: Path, out: Path, stop_after: int | None = None) -> FleetWatch:
    """Return a fleet that was watched; where it is to stop, in the middle of it."""
    told: list[str] = []

    def tell(asset: WatchedAsset, _decision: Decision) -> None:
        told.append(asset.name)
        fleet.is_end_requested = len(told) == stop_after

    fleet = FleetWatch(load_fleet(fleet_file), out, tell, told.append)
    fleet.run()
    return fleet
