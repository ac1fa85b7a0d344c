"""The report shows what the run holds, copes with what it does not hold, and is reproducible."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose, assert_array_equal

from reporting.figures import to_svg
from tests.twin_master.report import synthetic_run
from tests.twin_master.report.drawn import line, panel
from twin_master.report import data as report_data
from twin_master.report import mission as report_mission
from twin_master.report import page as report
from twin_master.report import reading as report_reading
from twin_master.report.text import (
    mission_caption,
    network_caption,
    number,
    turn_ranges,
)


def test_what_is_read_is_what_was_stored(record: report_data.RunRecord, tree: xr.DataTree) -> None:
    assert record.state_names == ("z1", "z2")
    assert record.controls == ("2g", "3g")
    assert record.rewards == ("health", "control", "error")
    assert (record.step_count, record.horizon) == (50, 10)
    assert_array_equal(record.sensors, np.arange(1, 25))
    assert_array_equal(record.filtered.probability, tree["filtered/probability"].values)
    assert record.predicted is not None
    assert_array_equal(record.predicted.mean, tree["predicted/mean"].values)
    assert_array_equal(record.observation, tree["observed/strain"].values)
    assert_array_equal(record.truth_state, tree["truth/state"].values)
    assert record.state_titles[0] == "stiffness loss of region 1"


def test_axes_stored_in_another_order_are_put_right(tmp_path: Path, tree: xr.DataTree) -> None:
    changed = tree.copy()
    changed["predicted"] = xr.DataTree(
        tree["predicted"].to_dataset().transpose("state", "horizon", "step", ...)
    )
    found = report_reading.read_run(synthetic_run.write_run(tmp_path / "run", changed))
    assert found.predicted is not None
    assert_array_equal(found.predicted.probability, tree["predicted/probability"].values)


@pytest.mark.parametrize("now", [0, 7, 18])
def test_smoothing_up_to_a_turn_equals_a_mission_that_ended_there(
    record: report_data.RunRecord, tmp_path: Path, now: int
) -> None:
    shorter = synthetic_run.build_tree(steps=now + 1)
    assert_array_equal(shorter["filtered/probability"].values, record.filtered.probability[: now + 1])
    found = report_data.smoothed_until(record, now)
    assert found is not None
    assert_allclose(found, shorter["smoothed/probability"].values, atol=1e-12)


def test_smoothing_up_to_the_last_turn_is_the_stored_one(record: report_data.RunRecord) -> None:
    found = report_data.smoothed_until(record, 49)
    assert found is not None
    assert record.smoothed is not None
    assert_allclose(found, record.smoothed.probability, atol=1e-12)


def test_without_a_configuration_the_past_is_the_filtered_one(record: report_data.RunRecord) -> None:
    bare = replace(record, config={})
    assert report_data.smoothed_until(bare, 20) is None
    past = line(panel(report_mission.mission_figure(bare, 20), "region 1"), "past")
    assert_allclose(past[:, 1], 100.0 * record.filtered.mean[:21, 0])


@pytest.mark.usefixtures("no_drawing")
def test_another_model_is_told_before_anything_else(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    assert "model differ" not in report.write_report(place).read_text(encoding="utf-8")
    origin = {"asset": "strain library", "twin_model": "reduced model", "asset_and_model_differ": True}
    (place / "summary.json").write_text(json.dumps(synthetic_run.summary() | origin))
    text = report.write_report(place).read_text(encoding="utf-8")
    assert "differ: flown was the strain library, and the twin believes the reduced model." in text


@pytest.fixture(scope="module")
def page(folder: Path) -> Path:
    return report.write_report(folder)


def test_equal_runs_give_equal_bytes(folder: Path, page: Path, tmp_path: Path, tree: xr.DataTree) -> None:
    other = synthetic_run.write_run(tmp_path / "elsewhere", tree)
    second = report.write_report(other)
    contents = []
    for place in (folder, other):
        drawings = {path.name: path.read_bytes() for path in (place / "figures").iterdir()}
        contents.append((drawings, (place / "report.html").read_bytes()))
    assert contents[0] == contents[1]
    assert set(contents[0][0]) == {
        "mission_now.svg", "mission_now.png", "mission_whole.svg", "belief.svg", "policy.svg", "check.svg",
        "calibration.svg", "network.svg",
    }  # fmt: skip
    assert page.read_bytes() == second.read_bytes()


def test_the_page_needs_nothing_from_outside(folder: Path, page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert "http://" not in text
    assert "https://" not in text
    assert text.count("<script>") == text.count("<script") == 1
    assert not re.search(r'(?:src|href)="(?!#|data:image/png;base64,)', text)
    assert not re.search(r"url\((?!#)", text)
    assert text.count("<figure") == 7
    assert str(folder) not in text
    assert re.search(r"largest tip displacement</td><td>0.18\sm<", text)
    assert re.search(r"largest strain error bound</td><td>1.2\sµε<", text)
    for word in ("Kapteyn", "seed 5", "policy leaves the first control from z1", "timing.json"):
        assert word in text


@pytest.mark.long
@pytest.mark.usefixtures("no_drawing")
def test_wall_clock_times_stay_out_of_the_page(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    before = report.write_report(place).read_bytes()
    (place / "timing.json").write_text('{"total_seconds": 4.321}')
    assert report.write_report(place).read_bytes() == before


@pytest.mark.long
@pytest.mark.usefixtures("no_drawing")
def test_figures_without_references_have_no_column_for_them(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    assert "source of the reference" in report.write_report(place).read_text(encoding="utf-8")
    content = json.loads((place / "summary.json").read_text(encoding="utf-8"))
    for figure in content["figures"]:
        figure["reference"] = None
    (place / "summary.json").write_text(json.dumps(content))
    assert "reference</th>" not in report.write_report(place).read_text(encoding="utf-8")


def test_the_caption_tells_the_decision_and_what_it_rests_on(
    record: report_data.RunRecord, tree: xr.DataTree, tmp_path: Path
) -> None:
    assert "twin decided" not in mission_caption(record, 18)  # not stored in this run
    probability = np.full((50, 2), [0.25, 0.75])
    changed = tree.copy()
    changed["filtered"] = xr.DataTree(
        tree["filtered"].to_dataset().assign(decision_probability=(("step", "control"), probability))
    )
    found = report_reading.read_run(synthetic_run.write_run(tmp_path / "run", changed))
    sentence = "At the end of turn 18 the twin decided on 3g for the next one"
    assert f"{sentence}: the policy asks for it with probability 0.75 in the state as just observed." in (
        mission_caption(found, 18)
    )
    scenario = {**found.scenario, "planner": {"gamma": 0.6, "decide_on": "predicted"}}
    ahead = replace(found, config={**found.config, "scenario": scenario})
    assert "in the state predicted for that turn." in mission_caption(ahead, 18)
    assert network_caption(ahead) != network_caption(found)


def test_words() -> None:
    assert turn_ranges([]) == "no turn"
    assert turn_ranges([4]) == "turn 4"
    assert turn_ranges([4, 5, 6, 9]) == "turns 4–6, 9"
    assert number(None) == "—"
    assert number(-0.123456) == "−0.12346"
    assert number(3) == "3"
    assert number(True) == "yes"


def test_a_title_that_would_be_broken_mathematics(record: report_data.RunRecord, tmp_path: Path) -> None:
    titles = (r"loss of $\frac{1$", "loss $_{$ of region 2")
    sensors = tuple(f"gauge ${number}^" for number in record.sensors)
    for drawn in report.report_figures(replace(record, state_titles=titles, sensor_titles=sensors), 20):
        assert to_svg(drawn.figure)
