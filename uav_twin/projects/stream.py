"""`uav-twin init stream`: a real asset that is watched, and readings to begin with."""

import csv
import io
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from fe.structure.design import load_structure
from twin_master.store.writing import open_run
from twin_master.workflow import fly
from uav_twin.projects.mesh import (
    SECONDS_PER_STEP,
    STREAM_NAME,
    STRUCTURE_NAME,
    drafted_part,
    mission_text,
)
from uav_twin.projects.project import Project

_STUCK_FROM = 10
"""First step in which a gauge is stuck."""
_PAUSE_AFTER = 20
"""Last step before the logger pauses."""
_PAUSE = 8 * 3600.0
"""Length of the pause [s]."""


def stream_project(name: str, structure_file: Path | None) -> Project:
    """Return a project to watch a real part by the readings of its gauges.

    The part is that of `structure_file`, or the shipped bracket. The project comes with simulated
    readings, in which a gauge is stuck and the logger pauses; see `_simulated_stream`.
    """
    # Structure and mission are read from files to simulate the readings: here they are temporary.
    with TemporaryDirectory(prefix="uav_twin_") as temporary_folder:
        folder = Path(temporary_folder)
        if structure_file is None:
            part = drafted_part(name, None)
            structure_copy = folder / STRUCTURE_NAME
            structure_copy.write_text(part.structure, encoding="utf-8")
            shutil.copy(part.mesh_file, folder)
            part_files = [part.mesh_file.name]
        else:
            structure_copy = folder / structure_file.name
            shutil.copy(structure_file, structure_copy)
            part_files = list(load_structure(structure_file).files)
            for part_file in part_files:
                shutil.copy(structure_file.parent / part_file, folder)
        flown_file = folder / "flown.toml"
        flown_file.write_text(mission_text(name, structure_copy), encoding="utf-8")
        stream = _simulated_stream(flown_file, folder / "run")
        watched = mission_text(name, structure_copy, watched=True)
        texts = {"watch.toml": watched, STREAM_NAME: stream}
        texts[structure_copy.name] = structure_copy.read_text(encoding="utf-8")
        contents = {part_file: (folder / part_file).read_bytes() for part_file in part_files}
    files = dict.fromkeys(part_files, "the mesh or the matrices")
    return Project(
        title="A part that is watched, from the readings of its gauges.",
        texts=texts,
        contents=contents,
        files={
            **files,
            structure_copy.name: "the part: material, support, loads, regions, gauges",
            "watch.toml": "what the twin sees, believes and may propose",
            STREAM_NAME: "readings to begin with: simulated, with a stuck gauge and a pause",
        },
        commands=(
            (
                "uav-twin scenario check watch.toml",
                "Check what is watched, and what the twin knows.",
            ),
            (
                "uav-twin watch watch.toml --out runs/first",
                "Watch the readings: a decision for each step, notices of a stuck gauge and of a "
                "pause; the report is runs/first/report.html.",
            ),
            (
                "uav-twin view runs/first",
                "Look at what the twin believed, step by step in the browser; Ctrl-C ends it.",
            ),
            (
                f"uav-twin watch watch.toml --observations {STREAM_NAME} --follow --out runs/live",
                "Watch a file that your logger goes on writing; Ctrl-C ends it.",
            ),
            (
                "uav-twin watch --resume --out runs/live",
                "Go on after a stop or a kill, where the watch was.",
            ),
        ),
    )


def _simulated_stream(scenario_file: Path, folder: Path) -> str:
    """Simulate a mission and return its strains as CSV text, with two faults to be noticed.

    From step `_STUCK_FROM` on, the gauge with the largest strain at the start repeats its last
    reading. After step `_PAUSE_AFTER`, all times are `_PAUSE` later, as if the logger had stopped.
    """
    fly(scenario_file, folder, {"in_process": True}, report=False)
    run = open_run(folder)
    readings = 1e6 * np.asarray(run["observed/strain"].values)
    control_index = np.asarray(run["observed/control_index"].values, dtype=int)
    controls = run["policy"].to_dataset()["control"].values
    stuck_gauge = int(np.argmax(np.abs(readings[0])))
    readings[_STUCK_FROM:, stuck_gauge] = readings[_STUCK_FROM - 1, stuck_gauge]
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    gauges = [f"strain_{number}_microstrain" for number in range(1, readings.shape[1] + 1)]
    writer.writerow(["time", "control", *gauges])
    for step, row in enumerate(readings):
        time = step * SECONDS_PER_STEP + (_PAUSE if step > _PAUSE_AFTER else 0.0)
        cells = [f"{reading:.2f}" for reading in row]
        writer.writerow([f"{time:g}", controls[control_index[step]], *cells])
    return table.getvalue()
