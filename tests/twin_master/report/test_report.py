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
from reporting.pages.page import ReportFigure
from reporting.words import number
from tests.refusals import Inputs, refused
from tests.twin_master.report.conftest import (
    altered,
    figures_of_unwritten,
    flown,
    line,
    page_of,
    panel,
    rescripted,
)
from twin_master.errors import RunFolderError
from twin_master.report import page as report
from twin_master.report.calibration import true_value
from twin_master.report.check import predictive_check
from twin_master.report.mission import default_present_row, mission_figure
from twin_master.report.opening_sentences import opening_sentences
from twin_master.report.page import lost_ranges
from twin_master.report.reading import Run
from twin_master.run_folder import to_json
from twin_master.scenario.reading import load_scenario
from twin_master.store.mission_result import LearntQuantity

INPUTS = Inputs(__file__)


# ------------------------------------------------------------------------- the sentences at its head


def test_the_page_begins_with_what_was_decided_believed_and_explained(run):
    """Believed is the loss of the first region; the noise is 150 µε, and 125 is assumed."""
    decided, believed, explained = opening_sentences(run)
    mean, deviation = (100 * run[f"filtered/{name}"][-1, 0] for name in ("mean", "standard_deviation"))
    low, high = max(mean - 2 * deviation, 0.0), min(mean + 2 * deviation, 80.0)
    interval = f"{mean:.1f} % ({low:.1f} to {high:.1f}, truth 60)"
    ratio = predictive_check(run).standard_deviation
    assert decided.startswith("The twin fell back from 3g to 2g at step 31, one step after")
    assert f"puts the stiffness loss of region 1 at {interval}" in believed
    assert f"{ratio:.3g} times as far as it assumes" in explained


def test_a_policy_of_both_regions_left_a_control(run):
    is_sound = run.model.states.coordinates.sum(axis=1) > 0.59
    policy = np.where(is_sound, 0, 1)
    decided = opening_sentences(altered(run, policy__control_index=policy))[0]
    assert decided == "The twin left 3g for 2g at step 31."


def test_the_page_has_its_opening_sentences(run):
    page = html.unescape(page_of(run)).replace("\N{NO-BREAK SPACE}", " ")
    decided, *others = opening_sentences(run)
    assert f'<div class="card">{decided}</div>' in page
    assert " ".join(others) in " ".join(page.split())


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


class ScatteredRun:
    """The run with observations that scatter as they are told to around what the twin expects."""

    def __init__(self, run: Run) -> None:
        self.expected = run["filtered/quantity_mean"]
        no_deviation = np.zeros_like(self.expected)
        self.run = altered(run, filtered__quantity_standard_deviation=no_deviation)
        self.draws = np.random.default_rng(3).standard_normal(self.expected.shape)

    def sentences(self, scatter: np.ndarray) -> tuple[str, ...]:
        """Return the opening for a scatter in the standard deviations that the twin assumes."""
        observed = self.expected + 125e-6 * scatter
        return tuple(opening_sentences(altered(self.run, observed__strain=observed)))


@pytest.fixture
def scattered(run: Run) -> ScatteredRun:
    return ScatteredRun(run)


def test_the_last_sentence_judges_the_scatter(scattered):
    draws = scattered.draws
    within = "The twin's model explains the observations within the noise that it assumes: 9"
    assert scattered.sentences(draws)[-1].startswith(within)
    assert scattered.sentences(0.5 * draws)[-1].endswith("its intervals are wider than they need be.")
    assert scattered.sentences(2.0 * draws)[-1].endswith("the noise is larger, or the model is off.")


def test_the_last_sentence_names_a_gauge_that_the_others_hide(scattered):
    draws = scattered.draws
    draws[:, 6] += 1.4
    sentence = scattered.sentences(draws)[-1]
    assert "intervals, but" in sentence
    assert sentence.endswith("% of those of gauge 7.")


def test_without_observations_nothing_is_said_of_the_scatter(scattered):
    nothing = np.full_like(scattered.draws, np.nan)
    assert len(scattered.sentences(nothing)) == 2


def test_the_opening_says_what_was_learnt(run):
    course = np.tile([1.02, 0.004, 1.01, 1.03], (50, 1))
    name = "Young modulus factor"
    learnt = LearntQuantity("young_modulus_factor", name, "", course, course[0], np.array(1.025))
    changed = replace(run)
    vars(changed)["learnt_quantities"] = (learnt,)
    sentence = opening_sentences(changed)[1]
    assert sentence.endswith("; it learnt the Young modulus factor: 1.020 (1.012 to 1.028, truth 1.025).")


# ----------------------------------------------------------------------------------------- the page


@pytest.mark.parametrize("now", [0, 18])
def test_smoothing_up_to_a_step_equals_a_mission_that_ended_there(run, library_file, tmp_path, now):
    shorter = flown(library_file, tmp_path / "run", steps=now + 1)
    assert_array_equal(shorter["filtered/probability"], run["filtered/probability"][: now + 1])
    assert_allclose(run.smoothed_until(now), shorter["smoothed/probability"], atol=1e-12)


def test_references_have_a_column_where_there_are_any(run):
    without = [figure | {"reference": None} for figure in run.summary["figures"]]
    page = page_of(run)
    page_without = page_of(replace(run, summary={**run.summary, "figures": without}))
    assert "source of the reference" in page
    assert "reference</th>" not in page_without


def test_an_asset_that_differs_from_the_model_is_told(run):
    origin = {"asset": "strain library", "twin_model": "reduced model", "asset_and_model_differ": True}
    page = page_of(run)
    page_of_other = page_of(replace(run, summary={**run.summary, **origin}))
    sentence = "differ: the asset was the strain library, and the twin believes the reduced model."
    assert "model differ" not in page
    assert sentence in page_of_other


@pytest.fixture(scope="module")
def page(folder: Path) -> bytes:
    """The page of the run with its figures, as it is written."""
    return report.write_report(folder).read_bytes()


@pytest.fixture(scope="module")
def text_of_page(page: bytes) -> str:
    return page.decode("utf-8")


def test_the_page_is_the_same_of_equal_runs(folder, page, tmp_path):
    equal = Path(shutil.copytree(folder, tmp_path / "equal"))
    (equal / "timing.json").write_text("{}")
    assert report.write_report(equal).read_bytes() == page


@pytest.mark.usefixtures("page")
def test_the_report_writes_its_figures(folder):
    names = {"belief", "policy", "check", "calibration", "network", "mission_now", "mission_whole"}
    files = {path.name for path in (folder / "figures").iterdir()}
    assert files == {f"{name}.svg" for name in names} | {"mission_now.png"}


def test_the_page_needs_nothing_from_outside(text_of_page):
    assert not re.search("https?://", text_of_page)
    assert not re.search(r'(?:src|href)="(?!#|data:image/png;base64,)', text_of_page)
    assert not re.search(r"url\((?!#)", text_of_page)


def test_the_page_has_one_script_and_seven_figures(text_of_page):
    assert text_of_page.count("<script>") == text_of_page.count("<script") == 1
    assert text_of_page.count("<figure") == 7


def test_the_page_does_not_say_in_which_folder_it_stands(text_of_page, folder):
    assert str(folder) not in text_of_page


def test_the_page_has_what_the_asset_monitored(text_of_page):
    assert re.search(r"largest tip displacement</td><td>0.18\sm<", text_of_page)
    assert re.search(r"largest strain error bound</td><td>1.2\sµε<", text_of_page)


@pytest.mark.parametrize(
    "words",
    [
        "Kapteyn",
        "seed 2021",
        "stiffness loss of region 1 from which on the policy changes from 3g to 2g",
        "timing.json",
    ],
)
def test_the_page_has_sources_seed_and_figures(text_of_page, words):
    assert words in text_of_page


def test_the_present_is_chosen_before_the_first_change_of_control(run):
    assert default_present_row(run) == 28
    for change, now in ((0, 33), (1, 33), (2, 33), (5, 33), (6, 3)):  # before the first nothing would be seen
        control = np.where(np.arange(50) < change, 1, 0)
        assert default_present_row(altered(run, observed__control_index=control)) == now


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(("steps", "horizon"), [(1, 10), (2, 3), (3, 1)])
def test_short_missions(run, hold, tmp_path, steps, horizon):
    part = {"step": slice(steps), "horizon": slice(horizon), "sensor": slice(5)}
    tree = run.tree.isel(part, missing_dims="ignore")
    hold(rescripted(replace(run, tree=tree), observation={"count": 5}))
    assert f"{steps} steps" in report.write_report(tmp_path).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def run_of_lost_gauges(run: Run) -> Run:
    """The run without four gauges in some steps, and without any gauge in two steps."""
    observed = run.observations.copy()
    observed[12:19, 16:20] = np.nan
    observed[3:5] = np.nan
    return altered(run, observed__strain=observed)


def test_lost_gauges_are_told(run_of_lost_gauges):
    page = page_of(run_of_lost_gauges)
    ranges = "gauges 17, 18, 19, 20 at steps 12–18; all gauges at steps 3–4"
    assert lost_ranges(run_of_lost_gauges) == ranges
    assert "the belief followed the dynamics alone" in page


def test_lost_gauges_are_marked_and_not_counted(run_of_lost_gauges):
    axes = panel(mission_figure(run_of_lost_gauges, 49, [16]), "Gauge 17")
    assert_array_equal(line(axes, "lost")[:, 0], [3, 4, *range(12, 19)])
    assert predictive_check(run_of_lost_gauges).count[16] == 50 - 2 - 7


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize("sensors", [slice(4, 5), slice(None)], ids=["a gauge", "all gauges"])
def test_gauges_that_never_report_are_told(run, hold, tmp_path, sensors):
    observed = run.observations.copy()
    observed[:, sensors] = np.nan
    hold(altered(run, observed__strain=observed))
    assert "Observations lost" in report.write_report(tmp_path).read_text(encoding="utf-8")


@pytest.fixture
def wing(make_calibration):
    return make_calibration(young_modulus_factor=1.05)


@pytest.fixture
def run_of_calibrated_wing(run, wing) -> Run:
    """The run with the draws of a calibrated wing, whose FMU starts at their mean."""
    tree = altered(run).tree
    draws = wing.draws_of("young_modulus_factor")
    tree["calibration"] = xr.Dataset({"draw_value": ("draw", draws)})
    record = json.loads(to_json(run_record(wing, "young_modulus_factor")))
    scenario = load_scenario("level_turns").scenario
    calibrated = replace(run, tree=tree, calibration=record, scenario=scenario)
    return rescripted(calibrated, asset={"design": "calibration", "parameters": {}})


def test_a_calibrated_wing_flies_at_the_mean(run_of_calibrated_wing, wing):
    assert true_value(run_of_calibrated_wing) == wing.mean("young_modulus_factor")


def test_a_calibration_file_shows_its_wing(run_of_calibrated_wing, wing):
    page = page_of(run_of_calibrated_wing, "calibration")
    without_headings = re.sub(' data-of="[^"]*"', "", page)  # those for narrow screens
    mean, deviation = wing.mean("servo_mass"), wing.standard_deviation("servo_mass")
    assert "The calibrated wing: Wing 7 (é)" in page
    assert f'{number(mean)}</td><td class="number">{number(deviation)}' in without_headings
    assert "the model of another asset" not in page


def test_a_wing_that_flies_beside_its_calibration_is_told(run_of_calibrated_wing, wing):
    other = rescripted(run_of_calibrated_wing, asset={"parameters": {"young_modulus_factor": 1.0}})
    page = " ".join(page_of(other).split())
    mean, deviation = (
        wing.mean("young_modulus_factor"),
        wing.standard_deviation("young_modulus_factor"),
    )
    distance = abs(1.0 - mean) / deviation
    sentence = (
        f"The true Young modulus factor of the asset flown is 1, {distance:.1f} standard deviations from"
    )
    assert true_value(other) == 1.0
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


@pytest.fixture(scope="module")
def last_steps(run: Run) -> Run:
    """The run as the last 50 of 1050 steps of a watch, without a truth, and with lost gauges."""
    observed = run.observations.copy()
    observed[7] = np.nan
    observed[[8, 9], 2] = np.nan
    tree = altered(run, observed__strain=observed, truth=None).tree.map_over_datasets(
        lambda group: group.assign_coords(step=group["step"] + 1000) if "step" in group.coords else group
    )
    return replace(run, tree=tree, summary={})


@pytest.fixture(scope="module")
def figures_of_last_steps(last_steps: Run) -> dict[str, ReportFigure]:
    return figures_of_unwritten(last_steps, 1020)


@pytest.mark.usefixtures("no_drawing")
def test_the_present_of_a_watch_has_its_number(figures_of_last_steps):
    now = figures_of_last_steps["mission_now"]
    assert "at step 1020" in now.title
    assert "now: 1020" in {text.get_text() for axes in now.figure.axes for text in axes.texts}


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(
    ("title", "name", "first"),
    [("region 1", "past", 1000), ("17", "observed", 1000), ("17", "prediction", 1021)],
)
def test_curves_of_the_last_steps_begin_at_their_numbers(figures_of_last_steps, title, name, first):
    figure = figures_of_last_steps["mission_now"].figure
    assert line(panel(figure, title), name)[0, 0] == first


@pytest.mark.usefixtures("no_drawing")
def test_panels_of_the_last_steps_have_their_numbers(figures_of_last_steps):
    controls = panel(figures_of_last_steps["mission_now"].figure, "Control: flown")
    residuals = panel(figures_of_last_steps["check"].figure, "Standardised")
    titles = [axes.get_title("left") for axes in figures_of_last_steps["belief"].figure.axes]
    assert controls.patches[-1].get_center()[0] == 1030
    assert residuals.get_xlim() == (999.5, 1049.5)
    assert "step 1049" in titles


def test_lost_gauges_of_the_last_steps_have_their_numbers(last_steps):
    assert lost_ranges(last_steps) == "gauge 3 at steps 1008–1009; all gauges at step 1007"


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize("now", [49, 999, 1050])
def test_a_present_outside_the_last_steps_is_refused(last_steps, hold, tmp_path, now):
    hold(last_steps)
    with pytest.raises(RunFolderError, match=rf"must lie in 1000\.\.1049, but {now} was given"):
        report.write_report(tmp_path, now=now)


@pytest.mark.usefixtures("no_drawing")
def test_the_page_of_a_watch_leaves_out_what_nobody_knows(last_steps, figures_of_last_steps):
    page = page_of(last_steps, *figures_of_last_steps)
    assert page.count("<figure") == 6
    assert "truth" not in page.replace("the truth, which", "")
