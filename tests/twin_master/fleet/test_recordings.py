"""Recordings of real assets that are flown as a fleet have what watches of them have."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.twin_master.fleet.recordings import (
    FLOWN,
    LOGS,
    STEPS,
    fleet_of,
    log_of,
    watch_alone,
    watched,
    write_fleet,
)
from tests.twin_master.runs import journal
from twin_master.fleet.comparison import group_statistics
from twin_master.fleet.engine import Engine
from twin_master.fleet.page.report import write_fleet_report
from twin_master.fleet.plan import load_fleet
from uav_twin import fly_fleet, learn_from_fleet, open_fleet

NOTICES = ("alarm", "gauge_left_out")


class FlownRecordings:
    """Recordings of 3, 6 and 6 steps that are flown as a fleet, and watches of each of them alone."""

    def __init__(self, fleet_file: Path, folder: Path) -> None:
        self.folder = folder
        short = log_of(folder, 0)
        short.write_text("".join(short.read_text().splitlines(keepends=True)[:4]))
        fleet_of(folder, LOGS, f"steps = {STEPS}")
        self.outcome = fly_fleet(load_fleet(fleet_file), folder / "flown", Engine(0))
        self.group = open_fleet(self.outcome.folder)["north"]
        self.lines = [journal(folder / "alone" / f"wing-{row}") for row in range(3)]
        self.steps = (3, STEPS, STEPS)

    def last_records(self, row: int) -> dict[int, dict[str, Any]]:
        """Return the last record of each step in the journal of a watch alone."""
        return {record["step"]: record for record in self.lines[row]}

    def steps_with_notice(self, row: int, kind: str) -> list[int]:
        """Return the steps of a recording in which a watch alone gave a notice of a kind."""
        told = [
            (line["step"], notice["kind"]) for line in self.lines[row] for notice in line.get("notices", ())
        ]
        return [step for step, kind_told in told if kind_told == kind and step < self.steps[row]]

    @property
    def alarmed(self) -> int:
        """Return how many assets raised an alarm."""
        return int(np.count_nonzero(self.group["notice/count"].values[:, NOTICES.index("alarm")]))


@pytest.fixture(scope="module")
def flown_recordings(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> FlownRecordings:
    folder = tmp_path_factory.mktemp("recordings")
    fleet = write_fleet(library_file, folder)
    watch_alone(folder)
    return FlownRecordings(fleet, folder)


def check_observations(flown: FlownRecordings, row: int) -> None:
    """Check controls, readings and evidences of a recording against those of its watch."""
    group, steps = flown.group, flown.steps[row]
    records = flown.last_records(row)
    controls = group["observed/control_index"].values[row].tolist()
    evidence = group["filtered/log_evidence"].values[row]
    assert controls == FLOWN[:steps] + [-1] * (STEPS - steps)
    assert np.isnan(evidence[steps:]).all()
    for step in range(steps):
        if row == 2 and step in (2, 3):
            continue  # the watch wrote these down before the late message came
        reading = np.array(records[step]["observed"], np.float32)
        stored = group["observed/strain"].values[row, step]
        np.testing.assert_allclose(evidence[step], records[step]["log_evidence"], rtol=1e-6)
        assert np.array_equal(stored, reading, equal_nan=True)


def check_belief_and_notices(flown: FlownRecordings, row: int) -> None:
    """Check the last belief and the notices of a recording against those of its watch."""
    group, steps = flown.group, flown.steps[row]
    belief = flown.last_records(row)[steps - 1]["filtered"]
    np.testing.assert_allclose(group["filtered/last_probability"].values[row], belief, rtol=0, atol=1e-7)
    if row == 2:
        return  # a late message tells of steps before it
    for number, kind in enumerate(NOTICES):
        noticed = flown.steps_with_notice(row, kind)
        assert group["notice/count"].values[row, number] == len(noticed)
        assert group["notice/first_step"].values[row, number] == min(noticed, default=-1)


def test_recordings_are_flown_as_a_fleet(flown_recordings):
    """The store has what watches have."""
    for row in range(3):
        check_observations(flown_recordings, row)
        check_belief_and_notices(flown_recordings, row)


def test_figures_of_flown_recordings_count_alarms(flown_recordings):
    flown = flown_recordings
    figures = group_statistics(flown.group)
    assert flown.group["notice/count"].values[1, NOTICES.index("gauge_left_out")] >= 1
    assert (figures["flown"], figures["raised an alarm"]) == (3, flown.alarmed)
    assert "early fallback" not in figures


def test_the_report_of_flown_recordings_has_their_alarms(flown_recordings):
    page = write_fleet_report(flown_recordings.outcome.folder).read_text()
    assert flown_recordings.alarmed >= 1
    assert "raised an alarm, first in" in page


def test_a_fleet_of_recordings_teaches_its_transitions(flown_recordings, tmp_path):
    """What 2g does nobody saw, as each recording ends with it."""
    file = tmp_path / "learnt.toml"
    learnt = learn_from_fleet(flown_recordings.outcome.folder, file)["groups"]["north"]
    probability = tomllib.loads(file.read_text())["transition"]["probability"]
    assert learnt["probability"]["2g"]["flown"] is False
    assert learnt["alarmed"] == flown_recordings.alarmed
    assert (probability["2g"], probability["3g"] != 0.10) == (0.05, True)


def test_a_watched_fleet_raises_the_alarms_of_one_that_is_flown(flown_recordings, tmp_path):
    assets = watched(flown_recordings.folder / "fleet.toml", tmp_path / "out").assets
    records = [asset.record() for asset in assets.values()]
    assert sum(record["alarms"] > 0 for record in records) == flown_recordings.alarmed


def test_recordings_without_steps_or_with_too_many_are_not_flown(fleet_file, tmp_path):
    short = log_of(tmp_path, 0)
    short.write_text("".join(short.read_text().splitlines(keepends=True)[:4]))
    (tmp_path / "logs" / "wing-9.csv").write_text("step,control\n")
    fleet = load_fleet(fleet_of(tmp_path, LOGS, "steps = 5"))
    failures = fly_fleet(fleet, tmp_path / "few", Engine(0)).failures
    too_long = "it has 6 steps, and 5 at most are flown: set `steps` of the group."
    assert failures == {
        "north/wing-1": too_long,
        "north/wing-2": too_long,
        "north/wing-9": "its recording has no step yet.",
    }
