"""The command line on a system without what POSIX alone has: a mission, a watch, a fleet, a structure.

On Windows these tests run as they are, `python -m pytest -m portable`; elsewhere what Windows lacks is hidden
from the processes that they start.
"""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.portable, pytest.mark.slow]
ROOT = Path(__file__).parents[2]
RECORDING = ROOT / "scenarios" / "recordings" / "watched_wing.csv"
HIDDEN, NATIVE = "tests.portable.other_system", "uav_twin"


def ran(
    folder: Path, *words: object, module: str = HIDDEN, given: str = ""
) -> subprocess.CompletedProcess[str]:
    """Run `uav-twin` in a process of its own, in a folder, with a text as its input; it must end well."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200", "PYTHONUTF8": "1"}
    process = subprocess.run(
        [sys.executable, "-m", module, *map(str, words)],
        cwd=folder,
        env=environment,
        input=given,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )
    assert process.returncode == 0, process.stderr[-3000:]
    return process


IMPORT_ALL = """
import importlib, pkgutil, sys
from tests.portable.other_system import hide_posix
hide_posix()
failed = []
for package in sys.argv[2:]:
    for module in pkgutil.walk_packages([f"{sys.argv[1]}/{package}"], f"{package}."):
        if not module.name.endswith("__main__"):
            try:
                importlib.import_module(module.name)
            except (ImportError, AttributeError) as error:
                failed.append(module.name)
print(*failed)
"""
PACKAGES = (
    "reporting",
    "fe",
    "fmu_asset",
    "calibration",
    "scenarios",
    "twin_master",
    "discrepancy",
    "uav_twin",
)
LINUX_ALONE = {"fmu_asset.worker.refusal_tracer", "fmu_asset.worker.supervisor"}
"""Modules of the process that isolates an FMU, which is not started on other systems."""


def test_all_modules_but_those_of_the_isolation_are_imported():
    process = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL, str(ROOT), *PACKAGES],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert set(process.stdout.split()) <= LINUX_ALONE


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("portable")


@pytest.fixture(scope="module")
def mission(folder: Path) -> subprocess.CompletedProcess[str]:
    """The mission of the paper, flown by an FMU, with its report."""
    return ran(folder, "run", "level_turns", "--out", "mission")


def test_a_mission_is_flown_filtered_and_reported(folder, mission):
    assert "The twin left 3g for 2g at step" in mission.stdout
    assert (folder / "mission" / "report.html").stat().st_size > 100_000
    assert (folder / "mission" / "run.nc").is_file()


@pytest.mark.skipif(os.name != "posix", reason="hides nothing on this system")
@pytest.mark.parametrize("sentence", ["cannot isolate FMUs", "no locks on files", "cannot fork a process"])
def test_what_is_weaker_is_said_once(mission, sentence):
    said = " ".join(mission.stderr.split())
    assert len(re.findall(sentence, said)) == 1


@pytest.mark.skipif(os.name != "posix", reason="hides nothing on this system")
def test_a_mission_is_the_same_to_the_bit(folder, mission):
    ran(folder, "run", "level_turns", "--out", "native", "--no-report", module=NATIVE)
    journals = [(folder / name / "journal.jsonl").read_bytes() for name in ("mission", "native")]
    assert journals[0] == journals[1]


def test_a_file_is_watched_and_the_watch_is_resumed(folder):
    ran(folder, "watch", "watched_wing", "--out", "watch", "--steps", "5", "--no-report")
    ran(folder, "watch", "--resume", "--out", "watch", "--steps", "9", "--observations",
        RECORDING, "--no-report")  # fmt: skip
    lines = (folder / "watch" / "journal.jsonl").read_text(encoding="utf-8").splitlines()
    assert sum('"filtered"' in line for line in lines) == 9


def readings(count: int) -> list[dict[str, str]]:
    """Return the first rows of the shipped recording."""
    with RECORDING.open(encoding="utf-8", newline="") as file:
        return [row for row, _ in zip(csv.DictReader(file), range(count), strict=False)]


def test_a_file_is_followed(folder):
    shutil.copyfile(RECORDING, folder / "followed.csv")
    words = ["--observations", "followed.csv", "--follow", "--steps", "4", "--no-report"]
    decisions = ran(folder, "watch", "watched_wing", "--out", "followed", *words).stdout.splitlines()
    assert [json.loads(decision)["step"] for decision in decisions] == [0, 1, 2, 3]


def test_a_pipe_is_watched_that_must_not_fall_silent(folder):
    """It is polled, which Windows cannot do; so a thread reads it."""
    text = (ROOT / "scenarios" / "watched_wing.toml").read_text(encoding="utf-8")
    (folder / "piped.toml").write_text(f"{text}quiet_after_seconds = 600\n", encoding="utf-8")
    lines = "".join(f"{json.dumps({**row, 'step': step})}\n" for step, row in enumerate(readings(4)))
    words = ["--observations", "-", "--out", "piped", "--no-report"]
    decisions = ran(folder, "watch", "piped.toml", *words, given=lines).stdout.splitlines()
    assert [json.loads(decision)["step"] for decision in decisions] == [0, 1, 2, 3]


def test_a_fleet_is_flown(folder):
    pytest.importorskip("distributed")
    ran(folder, "run", "level_turns", "--seeds", "1:3", "--workers", "0", "--out", "fleet")
    assert any((folder / "fleet").glob("*.zarr"))


def test_a_structure_is_built_and_reduced(folder):
    text = ran(folder, "structure", "info", "bracket").stdout
    assert "bracket" in text
    reduced = json.loads(ran(folder, "structure", "reduce", "bracket", "--states", "2", "--json").stdout)
    assert reduced
