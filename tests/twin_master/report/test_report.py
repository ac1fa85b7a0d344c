"""The report shows what the run holds, is reproducible, and refuses a damaged run with one sentence."""

import errno
import json
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose, assert_array_equal

from calibration.result.plain import run_record
from calibration.result.record import Calibration
from reporting.errors import DiskFullError
from reporting.figures import to_svg
from reporting.words import number
from tests.twin_master.report import synthetic_run
from tests.twin_master.report.drawn import line, panel
from tests.twin_master.report.synthetic_run import altered, rescripted
from twin_master.errors import RunFolderError
from twin_master.report import page as report
from twin_master.report.calibration import true_value
from twin_master.report.check import predictive_check
from twin_master.report.mission import default_now, mission_figure
from twin_master.report.page import lost_ranges, turn_ranges
from twin_master.report.reading import Run, read_run
from twin_master.run_folder import to_json


def text_of(folder: Path) -> str:
    return report.write_report(folder).read_text(encoding="utf-8")


def without(tree: xr.DataTree, missing: str) -> xr.DataTree:
    """A run without a group, or without a variable: GROUP/VARIABLE."""
    part = xr.DataTree.from_dict({name: tree[name].to_dataset() for name in tree.children})
    group, _, variable = missing.partition("/")
    if variable:
        part[group] = xr.DataTree(part[group].to_dataset().drop_vars(variable))
    else:
        del part[group]
    return part


@pytest.mark.parametrize("now", [0, 7, 18, 49])
def test_smoothing_up_to_a_turn_equals_a_mission_that_ended_there(run: Run, now: int) -> None:
    shorter = synthetic_run.build_tree(steps=now + 1)
    assert_array_equal(shorter["filtered/probability"].values, run["filtered/probability"][: now + 1])
    assert_allclose(run.smoothed_until(now), shorter["smoothed/probability"].values, atol=1e-12)


@pytest.mark.usefixtures("no_drawing")
def test_another_model_is_told_before_anything_else(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    assert "model differ" not in text_of(place)
    origin = {"asset": "strain library", "twin_model": "reduced model", "asset_and_model_differ": True}
    (place / "summary.json").write_text(json.dumps(synthetic_run.summary() | origin))
    text = text_of(place)
    assert "differ: flown was the strain library, and the twin believes the reduced model." in text


@pytest.fixture(scope="module")
def page(folder: Path) -> Path:
    return report.write_report(folder)


def test_equal_runs_give_equal_bytes(folder: Path, page: Path, tmp_path: Path, tree: xr.DataTree) -> None:
    other = synthetic_run.write_run(tmp_path / "elsewhere", tree)
    (other / "timing.json").write_text('{"total_seconds": 4.321}')
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


@pytest.mark.usefixtures("no_drawing")
def test_figures_without_references_have_no_column_for_them(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    assert "source of the reference" in text_of(place)
    content = json.loads((place / "summary.json").read_text(encoding="utf-8"))
    for figure in content["figures"]:
        figure["reference"] = None
    (place / "summary.json").write_text(json.dumps(content))
    assert "reference</th>" not in text_of(place)


def test_captions_tell_the_decision_and_what_it_rests_on(
    folder: Path, tmp_path: Path, tree: xr.DataTree
) -> None:
    asked = 100 * tree["filtered/decision_probability"].values[18, 1]
    sentence = "At the end of turn 18 the twin decided on 3g for the next one: the policy asks for it with "
    captions = {figure.name: figure.caption for figure in report.report_figures(folder, 18)}
    assert (
        f"{sentence}probability {asked / 100:.2f} in the state as just observed." in captions["mission_now"]
    )
    place = synthetic_run.write_run(tmp_path / "run", tree)
    config = json.loads((place / "config.json").read_text())
    config["scenario"]["planner"]["decide_on"] = "predicted"
    (place / "config.json").write_text(json.dumps(config))
    caption = next(report.report_figures(place, 18)).caption
    assert "in the state predicted for that turn." in caption


def test_words() -> None:
    assert turn_ranges([4]) == "turn 4"
    assert turn_ranges([4, 5, 6, 9]) == "turns 4–6, 9"
    assert number(None) == "—"
    assert number(-0.123456) == "−0.12346"
    assert number(3) == "3"
    assert number(True) == "yes"


def test_the_present_is_chosen_before_the_first_change_of_control(run: Run) -> None:
    def now(control: np.ndarray) -> int:
        return default_now(altered(run, observed__control_index=control))

    turns = np.arange(50)
    assert default_now(run) == 18
    assert now(np.zeros(50)) == 33
    for change in (1, 2, 5):  # of which nothing would be seen before it
        assert now(np.where(turns < change, 1, 0)) == 33
    assert now(np.where(turns < 6, 1, 0)) == 3


def test_a_fallback_that_came_before_the_damage_has_no_delay() -> None:
    from twin_master.scenario.reading import load_scenario
    from twin_master.store.summary import Fallback, _fallback_figures

    scenario = load_scenario("level_turns").scenario

    def values(*steps: int | None) -> list[object]:
        fallback = Fallback("z1", 0.6, *steps)
        return [figure.value for figure in _fallback_figures(fallback, scenario, "turn")]

    assert values(30, 30, 12) == [60.0, 30, None, None, 12]
    assert values(30, 31, None) == [60.0, 30, 31, 1, None]
    assert values(30, 30, None) == [60.0, 30, 30, 0, None]


@pytest.mark.usefixtures("no_drawing")
def test_what_nobody_knows_is_left_out(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", without(tree, "truth"))
    (place / "summary.json").unlink()
    text = text_of(place)
    assert text.count("<figure") == 7
    assert "truth" not in text.replace("the truth, which", "")


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(("steps", "horizon"), [(1, 10), (12, 10), (2, 3), (3, 1)])
def test_short_missions(tmp_path: Path, steps: int, horizon: int) -> None:
    short = synthetic_run.build_tree(steps=steps, horizon=horizon, sensors=5)
    assert f"{steps} turns" in text_of(synthetic_run.write_run(tmp_path / "run", short))


@pytest.mark.usefixtures("no_drawing")
def test_lost_gauges_are_told_and_marked(tmp_path: Path) -> None:
    place = synthetic_run.write_run(tmp_path / "run", synthetic_run.build_tree(lost=True))
    run = read_run(place)
    assert lost_ranges(run) == "gauges 17, 18, 19, 20 at turns 12–18; all gauges at turns 3–4"
    assert "the belief followed the dynamics alone" in text_of(place)
    axes = panel(mission_figure(run, 49, [16]), "Gauge 17")
    assert_array_equal(line(axes, "lost")[:, 0], [3, 4, *range(12, 19)])
    assert predictive_check(run).count[16] == 50 - 2 - 7


@pytest.mark.usefixtures("no_drawing")
def test_a_gauge_that_never_reports_and_a_run_without_any_observation(
    tmp_path: Path, tree: xr.DataTree
) -> None:
    for name, sensors in (("one", slice(4, 5)), ("all", slice(None))):
        changed = tree.copy(deep=True)
        changed["observed/strain"].values[:, sensors] = np.nan
        assert "Observations lost" in text_of(synthetic_run.write_run(tmp_path / name, changed))


def test_a_calibration_file_shows_its_wing(
    run: Run, make_calibration: Callable[..., Calibration], tree: xr.DataTree
) -> None:
    wing = make_calibration(young_modulus_factor=1.05)
    draws = wing.draws_of("young_modulus_factor")
    tree = altered(run).tree
    tree["calibration"] = xr.Dataset({"draw_value": ("draw", draws)})
    asset = run.config["scenario"]["asset"] | {"design": "calibration", "parameters": {}}
    kept = json.loads(to_json(run_record(wing, "young_modulus_factor")))
    flown = rescripted(replace(run, tree=tree, calibration=kept), asset=asset)
    mean, wide = wing.mean("young_modulus_factor"), wing.standard_deviation("young_modulus_factor")
    assert true_value(flown) == mean  # the FMU starts at the mean
    drawing = {"calibration": b'<svg viewBox="0 0 1 1"></svg>'}
    page = report.render_page(flown, drawing, {"calibration": ("", "")})
    assert "The calibrated wing: Wing 7 (é)" in page
    servo = wing.mean("servo_mass"), wing.standard_deviation("servo_mass")
    assert f'{number(servo[0])}</td><td class="number">{number(servo[1])}' in page
    assert "the model of another asset" not in page
    other = rescripted(flown, asset=asset | {"parameters": {"young_modulus_factor": 1.0}})
    assert true_value(other) == 1.0
    page = " ".join(report.render_page(other, {}, {}).split())
    off = abs(1.0 - mean) / wide
    assert (
        f"The true Young modulus factor of the asset flown is 1, {off:.1f} standard deviations from" in page
    )
    assert "the model of another asset" in page


BROKEN = {
    "no run": (lambda folder: (folder / "run.nc").unlink(), r"holds no run\.nc"),
    "empty": (lambda folder: (folder / "run.nc").write_bytes(b""), "damaged"),
    "text": (lambda folder: (folder / "run.nc").write_bytes(b"not a run"), "damaged"),
    "half a configuration": (
        lambda folder: (folder / "config.json").write_text('{"half": '),
        r"config\.json",
    ),
    "a list": (lambda folder: (folder / "config.json").write_text("[1]"), r"config\.json"),
    "no configuration": (lambda folder: (folder / "config.json").unlink(), r"config\.json.*fly it again"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_damaged_run_gives_one_sentence(tmp_path: Path, tree: xr.DataTree, name: str) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    change, sentence = BROKEN[name]
    change(place)
    with pytest.raises(RunFolderError, match=sentence) as caught:
        report.write_report(place)
    assert "\n" not in str(caught.value)
    assert not (place / "report.html").exists()


@pytest.mark.parametrize("missing", ["filtered", "filtered/probability", "observed", "policy/action_value"])
def test_another_layout_gives_one_sentence(tmp_path: Path, tree: xr.DataTree, missing: str) -> None:
    with pytest.raises(RunFolderError, match="layout of a run"):
        read_run(synthetic_run.write_run(tmp_path / "run", without(tree, missing)))


def test_other_axes_give_one_sentence(tmp_path: Path, tree: xr.DataTree) -> None:
    changed = tree.copy()
    renamed = tree["filtered"].to_dataset().rename({"step": "time"})
    del changed["filtered"]
    changed["filtered"] = xr.DataTree(renamed)
    with pytest.raises(RunFolderError, match="has the axes"):
        read_run(synthetic_run.write_run(tmp_path / "run", changed))


def test_a_run_that_was_cut_off_anywhere_is_one_sentence(folder: Path, tmp_path: Path) -> None:
    whole = (folder / "run.nc").read_bytes()
    (tmp_path / "config.json").write_bytes((folder / "config.json").read_bytes())
    for length in (1, 100, 2_000, len(whole) // 3, len(whole) - 10):
        (tmp_path / "run.nc").write_bytes(whole[:length])
        with pytest.raises(RunFolderError, match=r"damaged.* resume the run or fly it again\.$"):
            read_run(tmp_path)


@pytest.mark.parametrize("now", [-1, 50])
def test_the_present_must_be_a_turn_of_the_run(folder: Path, now: int) -> None:
    with pytest.raises(RunFolderError, match=r"must lie in 0\.\.49"):
        report.write_report(folder, now=now)


@pytest.mark.usefixtures("no_drawing")
def test_a_full_disk_keeps_the_old_report(
    tmp_path: Path, tree: xr.DataTree, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    (place / "report.html").write_text("old")

    def fail(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(DiskFullError):
        report.write_report(place)
    assert (place / "report.html").read_text() == "old"
    assert list((place / "figures").iterdir()) == []


def test_a_title_that_would_be_broken_mathematics(run: Run) -> None:
    titles = [f"gauge ${number}^" for number in range(1, 25)]
    odd = rescripted(run, state={"title": r"loss of $\frac{1$"}, observation={"titles": titles})
    assert to_svg(mission_figure(odd, 20))
