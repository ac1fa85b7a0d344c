"""Decisions in line protocol: lines written by hand, and all that a watch decides, read back."""

import json
from math import nan
from pathlib import Path

import numpy as np
import pytest

from reporting.errors import FileNotWrittenError
from tests.command_line import command
from tests.refusals import Inputs
from twin_master.feeds.line_protocol import parse_line, write_line
from twin_master.watch.decision_points import DecisionLines, decision_points

TIME = 1_790_000_000_000_000_000
DECISION = {
    "step": 13,
    "control": "3g",
    "state_believed": True,
    "health": {
        "z1": {"mean": np.float64(0.25), "standard_deviation": 0.125, "unit": "1"},
        "crack, heel": {"mean": 2.0, "standard_deviation": nan, "unit": "mm"},
    },
    "next_control": "2g",
    "probability": 0.75,
    "lost_sensors": 1,
    "log_evidence": -4.5,
    "hypotheses": {"model": 0.5, "gauge 4": 0.5},
    "notices": [
        {"kind": "alarm", "sentence": 'Step 13: gauge "4"\nis off.'},
        {"kind": "alarm", "sentence": "Step 13: no state."},
    ],
}
LINES = Inputs(__file__).text("decision.lp").splitlines()
"""Written by hand from the published syntax and the tables of the page on live data."""


def test_the_lines_of_a_decision_are_those_of_the_published_syntax():
    assert [write_line(point) for point in decision_points(DECISION, "my wing", TIME)] == LINES


def test_a_state_that_is_not_believed_has_no_point():
    unbelieved = {"z1": {"mean": None, "standard_deviation": None, "unit": "1"}}
    decision = DECISION | {"health": unbelieved, "state_believed": False}
    points = list(decision_points(decision, "wing", TIME))
    assert not [point for point in points if point.measurement == "uav_twin_state"]
    assert points[0].fields["state_believed"] is False


def test_a_notice_before_the_first_step_is_a_point():
    silent = {"notices": [{"kind": "quiet", "sentence": "Nothing came."}]}
    (point,) = decision_points(silent, "wing", TIME)
    assert point.fields == {"sentence": "Nothing came."}
    assert point.tags == {"asset": "wing", "kind": "quiet"}


def test_no_two_points_of_a_decision_have_one_series_and_one_time():
    points = list(decision_points(DECISION, "wing", TIME))
    series = {(p.measurement, *sorted(p.tags.items()), p.timestamp) for p in points}
    assert len(series) == len(points)


def test_decisions_are_appended(tmp_path):
    path = tmp_path / "decisions.lp"
    path.write_text("# begun before\n", encoding="utf-8")
    DecisionLines(path, "my wing", clock=lambda: TIME).write(DECISION)
    assert path.read_text(encoding="utf-8").splitlines() == ["# begun before", *LINES]


def test_a_file_that_cannot_be_written_is_refused_before_the_first_step(tmp_path):
    with pytest.raises(FileNotWrittenError, match="no_folder"):
        DecisionLines(tmp_path / "no_folder" / "decisions.lp", "wing")


@pytest.fixture(scope="module")
def watched_lines(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[dict], list]:
    """The decisions of the shipped recording as printed, and the points that are read back."""
    folder: Path = tmp_path_factory.mktemp("lines")
    words = ("watch", "watched_wing", "--out", folder / "run", "--line-protocol", folder / "d.lp")
    done = command(*words, "--no-report")
    decisions = [json.loads(line) for line in done.stdout.splitlines()]
    lines = (folder / "d.lp").read_text(encoding="utf-8").splitlines()
    return decisions, [parse_line(line) for line in lines]


def test_a_watch_writes_each_decision_that_it_prints(watched_lines):
    decisions, points = watched_lines
    steps = [point for point in points if point.measurement == "uav_twin"]
    assert [point.fields["step"] for point in steps] == [decision["step"] for decision in decisions]
    assert [point.fields["next_control"] for point in steps] == [d["next_control"] for d in decisions]


def test_a_watch_writes_belief_and_notices(watched_lines):
    decisions, points = watched_lines
    means = [p.fields["mean"] for p in points if p.tags.get("state") == "z1"]
    sentences = [p.fields["sentence"] for p in points if p.measurement == "uav_twin_notice"]
    assert means == [d["health"]["z1"]["mean"] for d in decisions if d["state_believed"]]
    assert sentences == [n["sentence"] for decision in decisions for n in decision["notices"]]
    assert sentences
