"""`uav-twin calibrate campaign`, also of an FMU that is flown then."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.result.file import result_bytes, save_calibration
from fmu_asset.client.binding import load_binding
from fmu_asset.packing.script import build_script_fmu
from scenarios import asset_scripts, binding_files
from tests.command_line import refused, said
from tests.refusals import Inputs
from tests.twin_master.runs import changed_scenario, edited, written
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.errors import MissionInputError
from uav_twin import FmiAsset, fly, load_calibration, open_run

INPUTS = Inputs(__file__)


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A folder with a campaign of a spring of 0.88 times its stiffness, and the model beside."""
    folder = tmp_path / "lab"
    folder.mkdir()
    noise = {10.0: 0.3, 20.0: -0.4, 30.0: 0.1, 40.0: 0.2}
    rows = [f"{force},{force / 0.88 + off}" for force, off in noise.items()]
    (folder / "up.csv").write_text("force,tip\n" + "\n".join(rows))
    (folder / "campaign.toml").write_text(INPUTS.text("spring_campaign.toml"))
    (tmp_path / "model.toml").write_text(INPUTS.text("spring.toml"))
    return folder


def words(lab: Path, *more: object) -> tuple[object, ...]:
    return ("calibrate", "campaign", lab, "--model", lab.parent / "model.toml", *more)


def to(lab: Path, asset: str) -> tuple[object, ...]:
    return words(lab, "--out", lab.parent / "out", "--asset", asset)


def test_without_a_report_files_of_something_else_stay(lab):
    out = lab.parent / "out"
    files = (out / "report.html", out / "figures/posterior.svg")
    (out / "figures").mkdir(parents=True)
    for file in files:
        file.write_text("mine")
    said(*to(lab, "spring 7"), "--no-report")
    assert [file.read_text() for file in files] == ["mine", "mine"]


def test_a_campaign_gives_a_table(lab):
    """The prior has a standard deviation of 0.20, and is cut off at 0.5 and 1.5."""
    text = said(*to(lab, "spring 7"), "--no-report")
    assert "factor" in text
    assert "1.00 ± 0.19" in text


def test_a_campaign_gives_a_file_and_a_report(lab):
    said(*to(lab, "spring 7"))
    out = lab.parent / "out"
    calibration = load_calibration(out / "calibration.nc")
    page = (out / "report.html").read_text()
    assert (calibration.asset, calibration.model, calibration.source) == ("spring 7", "spring", "spring test")
    assert calibration.mean("factor") == pytest.approx(0.88, abs=0.02)
    assert ("Calibration of spring 7" in page, page.count("<figure")) == (True, 2)


def test_a_calibration_without_a_report_has_no_page_of_other_figures_beside_it(lab):
    out = lab.parent / "out"
    said(*to(lab, "spring 7"))
    file_before = (out / "calibration.nc").read_bytes()
    said(*to(lab, "spring 7"), "--no-report")
    assert (out / "calibration.nc").read_bytes() == file_before
    assert [path.name for path in out.iterdir()] == ["calibration.nc"]


def test_the_calibration_of_another_asset_is_not_overwritten(lab):
    said(*to(lab, "spring 7"), "--no-report")
    sentence = refused(*to(lab, "spring 8"), code=None)
    assert "is the calibration of spring 7, not of spring 8" in sentence


def test_a_calibration_is_printed_as_data(lab):
    record = json.loads(said(*words(lab, "--json")))
    (parameter,) = record["parameters"]
    low, high = parameter["interval_90"]
    assert (record["explained"], record["procedure"]) == (True, "quadrature")
    assert (parameter["name"], low < 0.88 < high) == ("factor", True)
    assert parameter["prior_left"] < 0.15


def test_the_calibration_of_a_wing_is_not_overwritten_by_that_of_a_campaign(lab, make_calibration):
    file = save_calibration(make_calibration(), lab.parent / "out" / "calibration.nc")
    wing, content = make_calibration().asset, file.read_bytes()
    sentence = refused(*to(lab, wing))
    kind = f"is the calibration of {wing} from the laboratory of a wing (`uav-twin calibrate`), but"
    assert kind in sentence
    assert "from a campaign (`uav-twin calibrate campaign`) was asked for: choose another --out" in sentence
    assert file.read_bytes() == content


def test_the_calibration_of_a_campaign_is_not_overwritten_by_that_of_a_wing(lab):
    said(*to(lab, "spring 7"), "--no-report")
    file = lab.parent / "out" / "calibration.nc"
    content = file.read_bytes()
    sentence = refused("calibrate", "--out", file.parent, "--asset", "spring 7", "--no-report")
    assert "of spring 7 from a campaign (`uav-twin calibrate campaign`), but one" in sentence
    assert file.read_bytes() == content


def test_a_calibration_that_nobody_can_read_is_replaced(lab, make_calibration):
    file = save_calibration(make_calibration(), lab.parent / "out" / "calibration.nc")
    file.write_bytes(file.read_bytes()[:200])
    said(*to(lab, "spring 7"), "--no-report")
    assert load_calibration(file).asset == "spring 7"


@pytest.mark.parametrize(("old", "new", "sentence"), INPUTS.table("changed.toml")["spring"])
def test_what_is_wrong_is_one_sentence_and_nothing_is_written(lab, old, new, sentence):
    for file in (lab / "up.csv",) if old == "." else (lab / "campaign.toml", lab.parent / "model.toml"):
        file.write_text(file.read_text().replace(old, new))
    assert sentence in refused(*words(lab, "--out", lab.parent / "out"), code=None)
    assert not (lab.parent / "out").exists()


TRUTH = 1.04
NOISE = np.array([0.04, 0.05, 0.06, 0.015])


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the FMU, its model file and `lab`: nine operating points of a pump with thicker oil."""
    folder = tmp_path_factory.mktemp("pump")
    (folder / "lab").mkdir()
    build_script_fmu(asset_scripts()["gear_pump"], folder / "gear_pump.fmu")
    binding, random = load_binding(binding_files()["gear_pump"]), np.random.default_rng(7)
    rows = ["speed,load,flow_seen,torque_seen,temperature_seen,filter_pressure_seen"]
    with FmiAsset(folder / "gear_pump.fmu", binding, isolated=False) as pump:
        for speed in (1000.0, 1400.0, 1800.0):
            for pressure in (60.0, 120.0, 180.0):
                pump.reset({"viscosity_factor": TRUTH})
                shown = pump.step({"speed": speed, "pressure": pressure}).values
                noisy = shown + NOISE * random.standard_normal(4)
                rows.append(",".join(map(repr, [speed, pressure, *noisy.tolist()])))
    (folder / "lab/points.csv").write_text("\n".join(rows))
    (folder / "model.toml").write_text(INPUTS.text("pump.toml"))
    (folder / "lab/campaign.toml").write_text(INPUTS.text("pump_campaign.toml"))
    return folder


def test_an_fmu_is_calibrated_at_operating_points_and_flown(bench, tmp_path):
    arguments = (bench / "lab", "--model", bench / "model.toml", "--out", tmp_path / "out", "--no-report")
    said("calibrate", "campaign", *arguments)
    file = tmp_path / "out/calibration.nc"
    found = load_calibration(file)
    assert found.explained is True
    deviation = found.standard_deviation("viscosity_factor")
    assert abs(found.mean("viscosity_factor") - TRUTH) < 3.0 * deviation < 0.012

    scenario = changed_scenario("pump_wear", INPUTS.table("pump_mission.toml"))
    folder = fly(scenario, tmp_path / "run", Overrides(calibration=file), report=False).folder
    tree = open_run(folder)
    assert set(tree["calibration"]["draw_value"].values) <= set(found.draws_of("viscosity_factor"))
    binding = load_binding(binding_files()["gear_pump"])
    with FmiAsset(bench / "gear_pump.fmu", binding, isolated=False) as pump:
        pump.reset({"viscosity_factor": found.mean("viscosity_factor")})
        wanted = pump.step({"speed": 1800.0, "pressure": 180.0}).values
    np.testing.assert_allclose(tree["truth"]["operation"].values[0], wanted, rtol=1e-6)

    (prior,), binding = found.priors, (binding_files()["gear_pump"]).read_text()
    shares = written(tmp_path, binding, ('variable = "wear"\nunit = "1"', 'variable = "wear"\nunit = "%"'))
    for changes, own, wrong in (  # of a pump that takes thicker oil, and one that was told otherwise
        ({"high": 9.0}, {}, r"range of 'viscosity_factor', 0\.8 to 1\.2.* calibration has"),
        ({"unit": "%"}, {}, r"the parameter viscosity_factor in 1, and `calibration.file` .* says %"),
        ({}, {"binding": shares}, "the state wear in %, and `state.unit` of the scenario says 1"),
    ):
        samples = found.samples + 0.25 * ("high" in changes)
        other = replace(found, priors=(replace(prior, **changes),), samples=samples)
        (tmp_path / "other.nc").write_bytes(result_bytes(other))
        resolved = resolve_scenario(scenario, Overrides(calibration=tmp_path / "other.nc", **own))
        with pytest.raises(MissionInputError, match=wrong):
            asset_source(resolved).check()


def test_what_an_fmu_does_not_have_is_one_sentence(bench):
    for old, new, sentence in INPUTS.table("changed.toml")["pump"]:
        model = bench / "wrong.toml"
        model.write_text(edited((bench / "model.toml").read_text(), (old, new)))
        assert sentence in refused("calibrate", "campaign", bench / "lab", "--model", model, code=None)
    shutil.copytree(bench / "lab", bench / "far")
    points = (bench / "lab/points.csv").read_text()
    (bench / "far/points.csv").write_text(points.replace("1400.0,", "9400.0,", 1))
    for lab, model, sentence in (
        ("far", bench / "model.toml", "The trial 'points', row 4 of its table"),
        ("far", bench / "model.toml", "lies outside the range of 'speed', 500 to 2500"),
        ("lab", bench / "gear_pump.fmu", "is an FMU: give a TOML file"),
        ("lab", "single_mass_rig", "does not have"),
    ):
        assert sentence in refused("calibrate", "campaign", bench / lab, "--model", model, code=None)
