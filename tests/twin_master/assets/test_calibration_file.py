"""A calibration file in a scenario: what the twin draws from it, what the run keeps, what is refused."""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import CalibrationRecordError
from calibration.result.file import description, plain_record, result_bytes, run_record, save_calibration
from calibration.result.record import Calibration as Calibrated
from calibration.result.record import ParameterPrior
from reporting.progress import SilentProgress
from tests.refusals import Inputs
from tests.twin_master.runs import text_of, written
from twin_master.assets.fmu_source import FmuSource
from twin_master.assets.parameter import draw_parameter
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.errors import MissionInputError
from twin_master.run_folder import to_json
from twin_master.scenario.schema import Calibration
from uav_twin import fly, load_calibration, load_scenario

MakeCalibration = Callable[..., Calibrated]
TEXT = text_of("level_turns")


@pytest.fixture
def file(tmp_path: Path, make_calibration: MakeCalibration) -> Path:
    return save_calibration(make_calibration(), tmp_path / "my wing.nc")


def of_campaign(file: Path, **means: float) -> Path:
    """Write the calibration of a model with these parameters from a campaign."""
    values = np.array([*means.values()])
    samples = values * (1.0 + 0.001 * np.random.default_rng(1).standard_normal((50, len(values))))
    priors = tuple(
        ParameterPrior(name, "1", mean, 0.1 * mean, 0.5 * mean, 2.0 * mean, "model.toml")
        for name, mean in means.items()
    )
    heading = ("spring 7", "spring", "0" * 64, "Gaussian")
    found = Calibrated(*heading, priors, samples, samples, None, (), (), "test", 1, {})
    file.write_bytes(result_bytes(found))
    return file


def section(file: Path, **others: object) -> Calibration:
    table = {"parameter": "young_modulus_factor", "source": "file", "file": str(file), "draws": 20}
    return Calibration.model_validate(table | others)


def scenario_with(folder: Path, name: str) -> Path:
    """The shipped scenario with a calibration file."""
    begin, end = TEXT.index("[calibration]"), TEXT.index("[truth]")
    table = f'[calibration]\nparameter = "young_modulus_factor"\nsource = "file"\nfile = "{name}"\n\n'
    return written(folder, TEXT[:begin] + table + TEXT[end:])


def test_draws_come_from_the_samples(file):
    result = load_calibration(file)
    for name in ("young_modulus_factor", "servo_mass"):
        draws = draw_parameter(section(file, parameter=name), 3)
        assert draws.name == name
        assert set(draws.values.tolist()) <= set(result.draws_of(name).tolist())
        assert len(draws.values) == 20
        assert (draws.mean, draws.standard_deviation) == (result.mean(name), result.standard_deviation(name))
        assert "Wing 7 (é)" in draws.source
    again, same, other = (draw_parameter(section(file), seed).values for seed in (3, 3, 4))
    np.testing.assert_array_equal(again, same)
    assert not np.array_equal(again, other)
    everything = draw_parameter(section(file, draws=40), 3).values
    np.testing.assert_array_equal(np.sort(everything), np.sort(result.draws_of("young_modulus_factor")))
    with pytest.raises(CalibrationRecordError, match="no samples of `wall_thickness`"):
        draw_parameter(section(file, parameter="wall_thickness"), 0)


def test_the_records_are_plain_and_the_same_for_the_same_file(file, make_calibration):
    result = load_calibration(file)
    text = to_json(run_record(result, "young_modulus_factor"))
    assert text == to_json(run_record(load_calibration(file), "young_modulus_factor"))
    record = json.loads(text)
    state = record["state"]["servo_mass"]
    assert state["unit"] == "kg"
    assert state["standard_deviation"] == pytest.approx(result.standard_deviation("servo_mass"))
    assert state["interval_95"] == pytest.approx(np.quantile(result.samples[:, 1], [0.025, 0.975]))
    correlation = np.corrcoef(result.samples[:, :5], rowvar=False)
    np.testing.assert_allclose(plain_record(result)["correlation"]["matrix"], correlation, atol=1e-12)
    grid, density = (np.array(record["posterior"][name]) for name in ("grid", "density"))
    assert np.trapezoid(density, grid) == pytest.approx(1.0, abs=0.05)
    assert "'Wing 7 (é)'" in description(result)
    assert f"servo_mass {result.mean('servo_mass'):.6g} +- " in description(result)
    single = run_record(make_calibration(count=1), "young_modulus_factor")  # figures that do not vary
    to_json(single)
    assert single["posterior"] == {}
    assert single["correlation"]["matrix"] == np.eye(5).tolist()


def test_paths_start_at_the_scenario_and_leave_no_trace_of_the_machine(file):
    scenario = resolve_scenario(load_scenario(scenario_with(file.parent, "my wing.nc")), Overrides())
    assert scenario.calibration.file == str(file)
    assert (scenario.asset.kind, scenario.belief.kind) == ("calibration", "calibration")
    portable = scenario.portable()
    assert portable.calibration.file == "asset/calibration.nc"
    assert str(file.parent) not in json.dumps(portable.to_dict())
    located = portable.moved(Path("/elsewhere"))
    assert located.calibration.file == "/elsewhere/asset/calibration.nc"
    source = asset_source(scenario)
    assert isinstance(scenario.asset.source(scenario), FmuSource)
    source.check()
    assert set(source.files()) == {"asset/binding.toml", "asset/calibration.nc"}
    assert source.files()["asset/calibration.nc"] == file.read_bytes()


def test_the_option_stands_over_the_scenario(file, tmp_path, library_file):
    loaded = load_scenario("level_turns")
    scenario = resolve_scenario(loaded, Overrides(calibration=file))
    assert (scenario.calibration.source, scenario.calibration.file) == ("file", str(file))
    assert scenario.calibration.draws == loaded.scenario.calibration.draws
    assert scenario.asset.parameters == loaded.scenario.asset.parameters  # the truth stays the scenario's
    named = '[calibration]\nparameter = "young_modulus_factor"\nmean = 1.0\nstandard_deviation = 0.01\n'
    learnt = written(tmp_path, f"format = 1\n{named}", name="learnt.toml")
    tailored = resolve_scenario(loaded, Overrides(calibration=file, learnt=learnt))
    assert (tailored.asset.kind, tailored.calibration.source) == ("calibration", "normal")
    asset_source(tailored).check()
    mine = load_scenario(scenario_with(tmp_path, "other.nc"))
    assert resolve_scenario(mine, Overrides(calibration=file)).calibration.file == str(file)
    flown = Overrides(strain_library=library_file, calibration=file)
    believed = asset_source(resolve_scenario(load_scenario("model_mismatch"), flown))
    believed.check()
    assert believed.origin.differ
    assert {*believed.files()} == {"asset/UAVconfig.json", "asset/calibration.nc"}
    pump = load_scenario("pump_wear")
    of_ssp = resolve_scenario(pump, Overrides(ssp=tmp_path / "pump.ssp")).asset
    assert (of_ssp.kind, of_ssp.parameters) == ("ssp", pump.scenario.asset.parameters)


def test_what_is_refused_before_a_folder_is_made(file, tmp_path, library_file):
    loaded, nothing = load_scenario("level_turns"), Overrides()
    with pytest.raises(MissionInputError, match="a strain library brings its own samples"):
        resolve_scenario(loaded, Overrides(calibration=file, strain_library=library_file))
    design = ('design = "uav_wing"', 'design = "calibration"')
    for text, words in (
        (TEXT.replace(*design), "there is no calibration file: give --calibration"),
        (text_of("three_fmus", design), "the design of a calibration is asked for, and there is no"),
    ):
        with pytest.raises(MissionInputError, match=words):
            resolve_scenario(load_scenario(written(tmp_path, text)), nothing)
    damaged = tmp_path / "damaged.nc"
    damaged.write_bytes(file.read_bytes()[:9000])
    for path, words in ((damaged, "damaged"), (tmp_path / "missing.nc", "not there")):
        with pytest.raises(CalibrationRecordError, match=words):
            asset_source(resolve_scenario(loaded, Overrides(calibration=path))).check()


def test_a_design_file_that_asset_and_component_share_is_tailored_in_both(file, tmp_path):
    design = ('design = "uav_wing"', 'design = "my.toml"')
    text = text_of("three_fmus", design, design)
    scenario = resolve_scenario(load_scenario(written(tmp_path, text)), Overrides(calibration=file))
    assert scenario.belief.kind == "calibration"
    assert scenario.asset.component[1].design == "calibration"
    asset_source(scenario).check()


@pytest.mark.parametrize(("scenario", "means", "words"), Inputs(__file__).refused("campaign"))
def test_what_a_calibration_from_a_campaign_has_must_be_known(tmp_path, scenario, means, words):
    given = Overrides(calibration=of_campaign(tmp_path / "calibration.nc", **means))
    with pytest.raises(MissionInputError, match=words):
        fly(load_scenario(scenario), tmp_path / "run", given, report=False)
    assert not (tmp_path / "run").exists()


@pytest.mark.long
def test_the_wing_among_several_fmus_is_tailored_too(file, tmp_path):
    scenario = resolve_scenario(load_scenario("three_fmus"), Overrides(calibration=file))
    assert [component.design for component in scenario.asset.component] == [None, "calibration", None]
    source = asset_source(scenario)
    source.check()
    (tmp_path / "run").mkdir()
    hashes = source.prepare(tmp_path / "run", SilentProgress())
    assert hashes["design"] == load_calibration(file).design_hash
    with zipfile.ZipFile(tmp_path / "run" / "asset" / "components" / "wing.fmu") as archive:
        record = json.loads(archive.read("resources/calibration.json"))
    assert record["asset"] == "Wing 7 (é)"
    moved = scenario.portable().moved(tmp_path / "run")
    assert moved.asset.component[1].design == "calibration"
