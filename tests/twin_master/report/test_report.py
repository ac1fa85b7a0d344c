"""The report shows what the run holds, is reproducible, and refuses a damaged run with one sentence."""

import html
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose, assert_array_equal

from calibration.result.file import run_record
from reporting.page import ReportFigure
from reporting.words import number
from tests.refusals import Inputs, refused
from tests.twin_master.report.conftest import altered, flown, line, panel, rescripted
from twin_master.errors import RunFolderError
from twin_master.report import page as report
from twin_master.report.calibration import true_value
from twin_master.report.check import predictive_check
from twin_master.report.mission import default_now, mission_figure
from twin_master.report.opening import opening_sentences
from twin_master.report.page import lost_ranges
from twin_master.report.reading import Run
from twin_master.run_folder import to_json
from twin_master.scenario.reading import load_scenario
from twin_master.store.mission_result import LearntQuantity

INPUTS = Inputs(__file__)
DRAWING = b'<svg viewBox="0 0 1 1"></svg>'


# ------------------------------------------------------------------------- the sentences at its head


def test_the_page_begins_with_what_was_decided_believed_and_explained(run):
    decided, believed, explained = opening_sentences(run)
    assert decided.startswith("The twin fell back from 3g to 2g at step 31, one step after")
    both = np.where(run.model.states.coordinates.sum(axis=1) > 0.59, 0, 1)
    left = opening_sentences(altered(run, policy__control_index=both))[0]
    assert left == "The twin left 3g for 2g at step 31."  # by a policy of both states
    mean, deviation = (100 * run[f"filtered/{name}"][-1, 0] for name in ("mean", "standard_deviation"))
    low, high = max(mean - 2 * deviation, 0.0), min(mean + 2 * deviation, 80.0)
    interval = f"{mean:.1f} % ({low:.1f} to {high:.1f}, truth 60)"
    assert f"puts the stiffness loss of region 1 at {interval}" in believed
    # 150 µε of noise, 125 assumed
    assert f"{predictive_check(run).standard_deviation:.3g} times as far as it assumes" in explained
    text = html.unescape(report.render_page(run, {}, {})).replace("\N{NO-BREAK SPACE}", " ")
    assert " ".join(opening_sentences(run)) in " ".join(text.split())


def first_sentence(run: Run, *gentle: int, level: float = 0.6, **changes: np.ndarray | None) -> str:
    """The first sentence of a run that flew 2g at these steps, by a policy that leaves 3g from a level on."""
    control = np.ones(50, dtype=np.int64)
    control[list(gentle)] = 0
    policy = np.where(run.model.states.coordinates[:, 0] > level - 0.01, 0, 1)
    given = {"observed__control_index": control, "policy__control_index": policy}
    return opening_sentences(altered(run, **given, **changes))[0]


OTHERWISE: dict[str, dict[str, Any]] = {
    "": {},
    "healthy": {"truth__state": np.zeros((50, 2))},
    "always": {"level": 0.0},
    "no truth": {"truth": None},
}


@pytest.mark.parametrize(("gentle", "otherwise", "said"), INPUTS.table("first_sentences.toml")["rows"])
def test_the_first_sentence_follows_the_record(run, gentle, otherwise, said):
    steps = (step for begin, end in gentle for step in range(begin, end))
    assert first_sentence(run, *steps, **OTHERWISE[otherwise]) == said


def test_of_a_real_asset_nothing_is_said_but_what_was_recorded(run):
    watched = replace(altered(run, truth=None), config={**run.config, "watched": True})
    observed = watched.tree["observed"].to_dataset()
    watched.tree["observed"] = observed.assign_coords(step=observed["step"] + 1000)
    obeyed = np.tile([0.1, 0.9], (50, 1))
    obeyed[30:] = [0.8, 0.2]  # asked for 2g from step 31 on
    left = first_sentence(watched, *range(31, 50), filtered__decision_probability=obeyed)
    assert left == "The asset left 3g for 2g at step 1031."
    kept = first_sentence(watched, filtered__decision_probability=obeyed)
    assert kept == "The asset kept 3g at every step; at 19 steps the twin had asked for another control."
    assert "truth" not in " ".join(opening_sentences(watched))


def test_the_last_sentence_judges_the_scatter_and_what_was_learnt_is_said(run):
    random, expected, noise = np.random.default_rng(3), run["filtered/quantity_mean"], 125e-6
    known = altered(run, filtered__quantity_standard_deviation=np.zeros_like(expected))
    draws = random.standard_normal(expected.shape)

    def sentences(scatter: np.ndarray) -> tuple[str, ...]:
        return tuple(opening_sentences(altered(known, observed__strain=expected + noise * scatter)))

    within = "The twin's model explains the observations within the noise that it assumes: 9"
    assert sentences(draws)[-1].startswith(within)
    assert sentences(0.5 * draws)[-1].endswith("its intervals are wider than they need be.")
    assert sentences(2.0 * draws)[-1].endswith("the noise is larger, or the model is off.")
    draws[:, 6] += 1.4  # one gauge is off, and the others hide it
    assert "intervals, but" in sentences(draws)[-1]
    assert sentences(draws)[-1].endswith("% of those of gauge 7.")
    assert len(sentences(np.full_like(draws, np.nan))) == 2
    course, name = np.tile([1.02, 0.004, 1.01, 1.03], (50, 1)), "Young modulus factor"
    learnt = LearntQuantity("young_modulus_factor", name, "", course, course[0], np.array(1.025))
    changed = replace(run)
    vars(changed)["learnt_quantities"] = (learnt,)
    said = opening_sentences(changed)[1]
    assert said.endswith("; it learnt the Young modulus factor: 1.020 (1.012 to 1.028, truth 1.025).")


# ----------------------------------------------------------------------------------------- the page


@pytest.mark.parametrize("now", [0, 18])
def test_smoothing_up_to_a_step_equals_a_mission_that_ended_there(run, library_file, tmp_path, now):
    shorter = flown(library_file, tmp_path / "run", steps=now + 1)
    assert_array_equal(shorter["filtered/probability"], run["filtered/probability"][: now + 1])
    assert_allclose(run.smoothed_until(now), shorter["smoothed/probability"], atol=1e-12)


def test_origins_and_references_are_told_where_there_are_any(run):
    text = report.render_page(run, {}, {})
    assert "model differ" not in text
    assert "source of the reference" in text
    figures = [figure | {"reference": None} for figure in run.summary["figures"]]
    origin = {"asset": "strain library", "twin_model": "reduced model", "asset_and_model_differ": True}
    summary = {**run.summary, "figures": figures, **origin}
    text = report.render_page(replace(run, summary=summary), {}, {})
    assert "differ: flown was the strain library, and the twin believes the reduced model." in text
    assert "reference</th>" not in text


def test_the_page_needs_nothing_from_outside_and_is_the_same_of_equal_runs(folder, tmp_path):
    page = report.write_report(folder).read_bytes()
    equal = Path(shutil.copytree(folder, tmp_path / "equal"))
    (equal / "timing.json").write_text("{}")
    assert report.write_report(equal).read_bytes() == page
    assert {path.name for path in (folder / "figures").iterdir()} == {
        "mission_now.svg", "mission_now.png", "mission_whole.svg", "belief.svg", "policy.svg", "check.svg",
        "calibration.svg", "network.svg",
    }  # fmt: skip
    text = page.decode("utf-8")
    assert "http://" not in text
    assert "https://" not in text
    assert text.count("<script>") == text.count("<script") == 1
    assert not re.search(r'(?:src|href)="(?!#|data:image/png;base64,)', text)
    assert not re.search(r"url\((?!#)", text)
    assert text.count("<figure") == 7
    assert str(folder) not in text
    assert re.search(r"largest tip displacement</td><td>0.18\sm<", text)
    assert re.search(r"largest strain error bound</td><td>1.2\sµε<", text)
    for word in (
        "Kapteyn",
        "seed 2021",
        "stiffness loss of region 1 from which on the policy changes from 3g to 2g",
        "timing.json",
    ):
        assert word in text


def test_the_present_is_chosen_before_the_first_change_of_control(run):
    assert default_now(run) == 28
    for change, now in ((0, 33), (1, 33), (2, 33), (5, 33), (6, 3)):  # before the first nothing would be seen
        control = np.where(np.arange(50) < change, 1, 0)
        assert default_now(altered(run, observed__control_index=control)) == now


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(("steps", "horizon"), [(1, 10), (2, 3), (3, 1)])
def test_short_missions(run, hold, tmp_path, steps, horizon):
    part = {"step": slice(steps), "horizon": slice(horizon), "sensor": slice(5)}
    tree = run.tree.isel(part, missing_dims="ignore")
    hold(rescripted(replace(run, tree=tree), observation={"count": 5}))
    assert f"{steps} steps" in report.write_report(tmp_path).read_text(encoding="utf-8")


@pytest.mark.usefixtures("no_drawing")
def test_lost_gauges_are_told_and_marked(run, hold, tmp_path):
    """Also one that never reports, and a run without any observation."""
    observed = run.observations.copy()
    observed[12:19, 16:20] = observed[3:5] = np.nan
    lost = altered(run, observed__strain=observed)
    assert lost_ranges(lost) == "gauges 17, 18, 19, 20 at steps 12–18; all gauges at steps 3–4"
    assert "the belief followed the dynamics alone" in report.render_page(lost, {}, {})
    axes = panel(mission_figure(lost, 49, [16]), "Gauge 17")
    assert_array_equal(line(axes, "lost")[:, 0], [3, 4, *range(12, 19)])
    assert predictive_check(lost).count[16] == 50 - 2 - 7
    for sensors in (slice(4, 5), slice(None)):
        observed[:, sensors] = np.nan
        hold(altered(run, observed__strain=observed))
        assert "Observations lost" in report.write_report(tmp_path).read_text(encoding="utf-8")


def test_a_calibration_file_shows_its_wing(run, make_calibration):
    wing = make_calibration(young_modulus_factor=1.05)
    tree = altered(run).tree
    tree["calibration"] = xr.Dataset({"draw_value": ("draw", wing.draws_of("young_modulus_factor"))})
    kept = json.loads(to_json(run_record(wing, "young_modulus_factor")))
    scenario = load_scenario("level_turns").scenario
    plain = replace(run, tree=tree, calibration=kept, scenario=scenario)
    flown = rescripted(plain, asset={"design": "calibration", "parameters": {}})
    mean, wide = wing.mean("young_modulus_factor"), wing.standard_deviation("young_modulus_factor")
    assert true_value(flown) == mean  # the FMU starts at the mean
    figures = {"calibration": ReportFigure("calibration", None, "", "")}
    page = report.render_page(flown, {"calibration": DRAWING}, figures)
    assert "The calibrated wing: Wing 7 (é)" in page
    page = re.sub(' data-of="[^"]*"', "", page)  # headings for narrow screens
    servo = wing.mean("servo_mass"), wing.standard_deviation("servo_mass")
    assert f'{number(servo[0])}</td><td class="number">{number(servo[1])}' in page
    assert "the model of another asset" not in page
    other = rescripted(flown, asset={"parameters": {"young_modulus_factor": 1.0}})
    assert true_value(other) == 1.0
    page = " ".join(report.render_page(other, {}, {}).split())
    off = abs(1.0 - mean) / wide
    sentence = f"The true Young modulus factor of the asset flown is 1, {off:.1f} standard deviations from"
    assert sentence in page
    assert "the model of another asset" in page


# ------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(("file", "content", "sentence"), INPUTS.table("damaged.toml")["rows"])
def test_a_damaged_run_gives_one_sentence(folder, tmp_path, file, content, sentence):
    place = shutil.copytree(folder, tmp_path / "run", ignore=shutil.ignore_patterns("report.html", "figures"))
    (place / file).unlink()
    if content:
        (place / file).write_text(content, encoding="utf-8")
    with refused(RunFolderError, sentence):
        report.write_report(place)
    assert not (place / "report.html").exists()


@pytest.mark.parametrize("missing", ["filtered/probability", "observed"])
def test_another_layout_gives_one_sentence(folder, tmp_path, missing):
    place = shutil.copytree(folder, tmp_path / "run", ignore=shutil.ignore_patterns("report.html", "figures"))
    with h5py.File(place / "run.nc", "a") as file:
        del file[missing]
    with pytest.raises(RunFolderError, match=f"layout of a run .*{missing}"):
        report.write_report(place)
    assert not (place / "figures").exists()


@pytest.mark.usefixtures("no_drawing")
def test_the_last_steps_of_a_watch_have_their_numbers_and_what_nobody_knows_is_left_out(run, hold, tmp_path):
    observed = run.observations.copy()
    observed[7], observed[[8, 9], 2] = np.nan, np.nan
    shifted = altered(run, observed__strain=observed, truth=None).tree.map_over_datasets(
        lambda group: group.assign_coords(step=group["step"] + 1000) if "step" in group.coords else group
    )
    watched = replace(run, tree=shifted, summary={})
    hold(watched)
    figures = {drawn.name: drawn for drawn in report.report_figures(tmp_path, 1020)}
    assert "at step 1020" in figures["mission_now"].title
    drawn = figures["mission_now"].figure
    assert "now: 1020" in {text.get_text() for axes in drawn.axes for text in axes.texts}
    for title, name, first in (
        ("region 1", "past", 1000),
        ("17", "observed", 1000),
        ("17", "prediction", 1021),
    ):
        assert line(panel(drawn, title), name)[0, 0] == first
    assert panel(drawn, "Control: flown").patches[-1].get_center()[0] == 1030
    assert panel(figures["check"].figure, "Standardised").get_xlim() == (999.5, 1049.5)
    assert "step 1049" in [axes.get_title("left") for axes in figures["belief"].figure.axes]
    assert lost_ranges(watched) == "gauge 3 at steps 1008–1009; all gauges at step 1007"
    for now in (49, 999, 1050):
        with pytest.raises(RunFolderError, match=rf"must lie in 1000\.\.1049, but {now} was given"):
            report.write_report(tmp_path, now=now)
    text = report.render_page(watched, dict.fromkeys(figures, DRAWING), figures)
    assert text.count("<figure") == 6
    assert "truth" not in text.replace("the truth, which", "")
