"""`uav-twin discrepancy` as a user calls it: example, check and run."""

import itertools
import json
import re
import shutil
from pathlib import Path

import pytest

from discrepancy.files.verdict import read_patch, read_verdict_file
from tests.command_line import command, refused, said

MODEL = "single_mass_rig"
RIG = ("--model", MODEL)


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def shared_campaign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A static campaign of the single-mass rig with a seating offset, which no test changes."""
    folder = tmp_path_factory.mktemp("example") / "rig test"
    effect = "seating_offset@A:offset_ratio=0.08"
    said("discrepancy", "example", "static", folder, *RIG, "--seed", "3", "--effect", effect)
    return folder


@pytest.fixture
def campaign(shared_campaign: Path, tmp_path: Path) -> Path:
    """A copy of that campaign."""
    return shutil.copytree(shared_campaign, tmp_path / "rig test")


def columns(shown: str, heads: str) -> dict[str, list[str]]:
    """Return the rows of a printed table by their first cells; cells stand two blanks apart, or more."""
    lines = iter(shown.splitlines())
    assert any(re.split(r"  +", line.strip()) == heads.split("|") for line in lines)
    rows = (re.split(r"  +", line.strip()) for line in itertools.takewhile(str.strip, lines))
    return {first: rest for first, *rest in rows if rest}


class ExampleSearch:
    """The check of a campaign and the search of its verdict, with one trial of self-calibration."""

    def __init__(self, example: Path, folder: Path) -> None:
        self.campaign = shutil.copytree(example, folder / "rig test")
        self.out = folder / "verdict"
        file = self.campaign / "campaign.toml"
        nothing_held_out = file.read_text("utf-8").replace("held_out = true", "held_out = false")
        file.write_text(nothing_held_out, "utf-8")
        self.checked = said("discrepancy", "check", self.campaign, *RIG)
        self.run = ("discrepancy", "run", self.campaign, *RIG, "--out", self.out)
        self.printed = said(*self.run, "--calibrate", "1")
        self.verdict_file = read_verdict_file(self.out / "verdict.json")


@pytest.fixture(scope="module")
def example_search(shared_campaign: Path, tmp_path_factory: pytest.TempPathFactory) -> ExampleSearch:
    return ExampleSearch(shared_campaign, tmp_path_factory.mktemp("search"))


def test_a_check_says_from_which_size_an_effect_is_detectable(example_search):
    heads = "effect|shows best at|parameter|detectable from|prior median"
    row = columns(example_search.checked, heads)["seating_offset"]
    place, parameter, detectable_from, prior_median = row[:4]
    assert (place, parameter) == ("A", "offset ratio")
    assert 0.0 < float(detectable_from) < float(prior_median) == 0.03


def test_a_check_says_what_is_not_testable_and_what_is_held_out(example_search):
    not_testable = "Not testable: washout and inertia_relief. The campaign has no flight trial to fit."
    held_out = "Note: Held out for proof by the rule of the workflow: unloading."
    assert not_testable in example_search.checked
    assert held_out in example_search.checked


def test_a_search_prints_its_verdict(example_search):
    verdict = example_search.verdict_file.verdict
    assert f"Verdict: {verdict.kind.value}" in example_search.printed
    assert "seating_offset" in verdict.inclusion


def test_a_search_prints_the_named_effect_with_its_interval(example_search):
    heads = "effect|place|parameter|value|90 % interval"
    ((effect, row),) = columns(example_search.printed, heads).items()
    place, parameter, value, interval = row[:4]
    low, high = map(float, interval.split(" to "))
    assert (effect, place, parameter) == ("seating_offset", "A", "offset ratio")
    assert low < float(value) < high


def test_a_verdict_has_the_command_that_found_it(example_search):
    origin = example_search.verdict_file.origin
    options = "--model single_mass_rig --seed 0 --calibrate 1"
    path = example_search.campaign.resolve()
    assert origin.command == f"uav-twin discrepancy run '{path}' {options}"
    assert origin.short_command == f"uav-twin discrepancy run 'rig test' {options}"


def test_a_search_writes_patch_and_self_calibration(example_search):
    patch = read_patch(example_search.out / "patch.json")
    calibration = json.loads((example_search.out / "self_calibration.json").read_text("utf-8"))
    assert "seating_offset" in {effect.identifier for effect in patch.effects}
    assert len(calibration["cases"]) == 1


def test_a_search_writes_a_report_that_names_no_folder(example_search):
    page = (example_search.out / "report.html").read_text("utf-8")
    assert "seating offset" in page
    assert str(example_search.out.parent) not in page


def test_a_verdict_is_replaced_only_on_demand(example_search):
    """That another search comes to the same conclusion is tested in test_workflow.py."""
    assert "--replace" in refused(*example_search.run)


class InterruptedSearch:
    """A search to which Ctrl-C comes when single effects are compared."""

    def __init__(self, campaign: Path, out: Path) -> None:
        self.out = out
        self.kept = out / "verdict_so_far.json"
        self.run = ("discrepancy", "run", campaign, *RIG, "--out", out, "--no-report")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("discrepancy.estimation.ranking._Ranking.estimate_simpler_forms", interrupt)
            self.sentence = refused(*self.run, code=130)


@pytest.fixture(scope="module")
def interrupted_search(shared_campaign: Path, tmp_path_factory: pytest.TempPathFactory) -> InterruptedSearch:
    return InterruptedSearch(shared_campaign, tmp_path_factory.mktemp("interrupted") / "verdict")


def test_an_interrupted_search_says_where_it_keeps_what_it_has_found(interrupted_search):
    search = interrupted_search
    assert f"Interrupted; the hypotheses fitted until then are in {search.kept}." in search.sentence


def test_an_interrupted_search_keeps_what_it_has_found(interrupted_search):
    record = json.loads(interrupted_search.kept.read_text("utf-8"))
    hypotheses = record["hypotheses"]
    assert record["schema"] == "uav-twin verdict so far 1"
    assert hypotheses[0]["effects"][0]["identifier"] == "seating_offset"
    assert sum(row["probability"] for row in hypotheses) == pytest.approx(1.0, abs=1e-3)


def test_another_search_takes_the_place_of_what_an_interrupted_one_kept(interrupted_search):
    said(*interrupted_search.run)
    assert not interrupted_search.kept.exists()
    assert (interrupted_search.out / "verdict.json").is_file()


def test_a_search_that_is_interrupted_before_it_has_found_anything_leaves_no_folder(campaign, tmp_path):
    out = tmp_path / "verdict"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("discrepancy.workflow.check_data", interrupt)
        words = refused("discrepancy", "run", str(campaign), *RIG, "--out", str(out), code=130)
    assert "Interrupted." in words
    assert not out.exists()


def interrupt(*_: object) -> None:
    """Do what Ctrl-C does."""
    raise KeyboardInterrupt


@pytest.fixture
def faulty_campaign(campaign: Path) -> Path:
    """The campaign with a channel in a wrong unit, and a column in a trial that is no channel."""
    file = campaign / "campaign.toml"
    text = file.read_text("utf-8")
    assert 'unit = "mm"' in text
    file.write_text(text.replace('unit = "mm"', 'unit = "m"', 1), "utf-8")
    table = next(path for path in campaign.glob("*.csv") if path.name != "noise.csv")
    header, *rows = table.read_text("utf-8").splitlines()
    with_column = [f"{header},weather", *(f"{row},1" for row in rows)]
    table.write_text("\n".join(with_column), "utf-8")
    return campaign


def test_a_check_lists_the_faults_of_data(faulty_campaign):
    done = command("discrepancy", "check", faulty_campaign, *RIG)
    assert done.returncode == 1
    assert "Fault:" in done.stdout
    assert "no channel reads the column 'weather'" in done.stdout


def test_a_search_of_faulty_data_ends_with_a_sentence_and_a_report(faulty_campaign, tmp_path):
    out = tmp_path / "v"
    sentence = refused("discrepancy", "run", faulty_campaign, *RIG, "--out", out)
    page = (out / "report.html").read_text("utf-8")
    assert "shows about 1000 times what the model predicts (mm given as m?)" in sentence
    assert sorted(path.name for path in out.iterdir()) == ["report.html", "verdict.json"]
    assert "Proof" not in page
