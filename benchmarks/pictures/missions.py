"""Pictures of missions, of a fleet and of plans: what their reports and commands draw."""

import io
import json
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import matplotlib.image
import numpy as np

import uav_twin
from benchmarks.browser import open_browser
from benchmarks.pictures.notebooks import folder_until_exit, notebook
from benchmarks.pictures.picture import Drawing
from reporting.pages.figures import to_png
from twin_master.fleet.configuration import fleet_config
from twin_master.fleet.page.page_figures import course_figure, map_figure
from twin_master.fleet.reading import last_steps
from twin_master.fleet.storage.store import FAILED, flown_rows, open_group
from twin_master.fleet.storage.store_layout import stored_values
from twin_master.scenario.schema import Scenario

RESOLUTION = 150.0
VIEWED_STEP = 28


@contextmanager
def served_view(run_folder: Path) -> Iterator[str]:
    """Run `uav-twin view` on a run folder, give the address of its page, and end it."""
    command = [sys.executable, "-m", "uav_twin", "view", str(run_folder)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        try:
            line = process.stdout.readline()
            address = re.search(r"http://\S+", line)
            assert address is not None, f"uav-twin view printed no address but {line!r}"
            yield address.group()
        finally:
            process.terminate()


@cache
def flown(scenario: str) -> Path:
    """Fly a shipped scenario and return its run folder."""
    return Path(uav_twin.fly(scenario, folder_until_exit() / scenario, report=False).folder)


def report_drawing(scenario: str, figure: str, now: int | None = None) -> bytes:
    """Return a figure of the report of a shipped scenario as PNG."""
    for report_figure in uav_twin.report_figures(flown(scenario), now):
        if report_figure.name == figure:
            return to_png(report_figure.figure, RESOLUTION)
    raise ValueError(f"The report of {scenario} has no figure {figure!r}.")


def draw_three_regions() -> Drawing:
    """Draw the mission of the wing with three regions at one step."""
    png = report_drawing("three_regions", "mission_now", now=VIEWED_STEP)
    return Drawing(png, {"step": VIEWED_STEP})


def draw_learnt() -> Drawing:
    """Draw what is learnt in the mission of a wing that was never tested."""
    png = report_drawing("level_turns_learning", "learnt")
    steps = uav_twin.open_run(flown("level_turns_learning"))["filtered"].sizes["step"]
    return Drawing(png, {"steps": steps})


def draw_bracket() -> Drawing:
    """Draw the bracket after its last shift."""
    return Drawing(report_drawing("bracket", "structure"), {})


def draw_stiffened_panel() -> Drawing:
    """Draw the stiffened panel after its last shift."""
    return Drawing(report_drawing("stiffened_panel", "structure"), {})


def draw_fleet() -> Drawing:
    """Draw the fleet of the notebook: its assets by health, and health over time."""
    folder = notebook("a_fleet_that_learns", "learn_from_fleet").folder / "runs" / "winter"
    (record,) = fleet_config(folder)["fleet"]["groups"]
    scenario = Scenario.model_validate(record["scenarios"][0])
    group = open_group(folder, record["name"])
    status = stored_values(group, "status")
    assets = flown_rows(status)
    mean = stored_values(group, "filtered/mean")
    last_mean = mean[assets, last_steps(group)[assets]]
    failed = int(np.sum(status == FAILED))
    pictures = (
        map_figure(scenario, last_mean, failed),
        course_figure(scenario, mean[assets], stored_values(group, "truth/state")[assets]),
    )
    png = stacked([to_png(figure, RESOLUTION) for figure in pictures])
    return Drawing(png, {"assets": len(status)})


def stacked(pictures: Sequence[bytes]) -> bytes:
    """Return PNG pictures of one width below each other."""
    images = [matplotlib.image.imread(io.BytesIO(png), format="png") for png in pictures]
    buffer = io.BytesIO()
    # None leaves the name of the software out, which matplotlib's annotation does not allow for
    metadata: dict[str, Any] = {"Software": None}
    matplotlib.image.imsave(buffer, np.vstack(images), format="png", metadata=metadata)
    return buffer.getvalue()


def command_drawing(*words: str) -> tuple[bytes, dict[str, Any]]:
    """Run a command of `uav-twin` that draws; return its picture as PNG and its answer."""
    with TemporaryDirectory(prefix="uav_twin_pictures_") as folder:
        picture = Path(folder) / "picture.png"
        command = [sys.executable, "-m", "uav_twin", *words, "--picture", str(picture), "--json"]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        answer: dict[str, Any] = json.loads(done.stdout)
        return picture.read_bytes(), answer


def draw_plan() -> Drawing:
    """Draw what is done at which belief of a region."""
    png, answer = command_drawing("plan", "inspected_wing")
    numbers = {"lower": answer["lower"], "upper": answer["upper"], "expected": answer["simulated"]}
    return Drawing(png, numbers)


def draw_design() -> Drawing:
    """Draw what eight gauges tell together, and where they are."""
    png, answer = command_drawing("design", "level_turns", "--sensors", "8")
    return Drawing(png, {"chosen": answer["information"][-1], "of_all": answer["of_all"]})


def draw_view() -> Drawing:
    """Draw the live view of the paper's mission at one step, as Chromium shows it."""
    tens, ones = divmod(VIEWED_STEP, 10)
    keys = ["Home", *["PageDown"] * tens, *["ArrowRight"] * ones]
    strides = [0, *[10] * tens, *[1] * ones]
    steps = np.cumsum(strides).tolist()
    with served_view(flown("level_turns")) as address, open_browser() as browser:
        tab = browser.tab()
        tab.go(address, width=1265, height=1300)
        tab.wait("window.painted.length > 0")
        for key, step in zip(keys, steps, strict=True):
            tab.press(key)
            tab.wait(f"state.shown === {step} && window.painted.at(-1)[0] === {step}")
        with TemporaryDirectory(prefix="uav_twin_pictures_") as folder:
            png = tab.picture(Path(folder) / "view.png")
    return Drawing(png, {"step": VIEWED_STEP})
