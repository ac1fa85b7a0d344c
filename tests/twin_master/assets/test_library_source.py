"""A twin that believes an observation library: what it is given, what is refused, what is said."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from fmu_asset.packing.script import build_script_fmu
from reporting.progress import SilentProgress
from scenarios import asset_scripts, binding_files
from tests.twin_master.runs import check_same, cut_off_after
from twin_master.assets.library_source import ObservationLibrary, load_observation_library
from twin_master.assets.resolution import Overrides
from twin_master.errors import InvalidObservationLibraryError, ScenarioError, TwinMasterError
from twin_master.library.grid import SamplingGrid
from twin_master.library.request import grid_of_scenario
from twin_master.library.sampling import sample_library
from twin_master.scenario.reading import LoadedScenario, load_scenario, parse_scenario
from twin_master.workflow import fly as new_run
from twin_master.workflow import resume as resume_run

sys.path.insert(0, str(Path(__file__).parent))
from pump_mission import PATH, pump_table, small_pump

pytestmark = pytest.mark.usefixtures("no_report")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SamplingGrid]:
    folder = tmp_path_factory.mktemp("library")
    grid = grid_of_scenario(
        small_pump(), folder / "made", ["viscosity_factor=0.9:1.1:21"], progress=SilentProgress()
    )
    return sample_library(grid, folder / "pump.nc", workers=1).path, grid


@pytest.fixture
def library(made: tuple[Path, SamplingGrid]) -> ObservationLibrary:
    return load_observation_library(made[0])


def changed(key: str, entry: object) -> LoadedScenario:
    table = pump_table()
    *path, last = key.split(".")
    node = table
    for part in path:
        node = node[int(part)] if part.isdigit() else node[part]  # type: ignore[call-overload]
    node[last] = entry
    return LoadedScenario(parse_scenario(table, "small_pump"), PATH, "0" * 64)


def test_a_table_over_another_parameter_grid_is_interpolated(library: ObservationLibrary) -> None:
    nodes = library.at_draws("viscosity_factor", library.draws[[3, 7]])
    np.testing.assert_array_equal(nodes, library.values[[3, 7]])
    between = library.at_draws("viscosity_factor", np.array([0.955]))
    np.testing.assert_allclose(between[0], 0.5 * (library.values[5] + library.values[6]), rtol=1e-14)
    assert library.holds_draws(library.draws)
    assert not library.holds_draws(np.array([0.955]))


def test_a_run_with_a_library_keeps_it_and_can_be_resumed(
    made: tuple[Path, SamplingGrid], tmp_path: Path
) -> None:
    path = tmp_path / "pump.nc"
    shutil.copy(made[0], path)
    whole = new_run(small_pump(), tmp_path / "whole", Overrides(library=path))
    assert not whole.origin.differ
    assert whole.origin.model == "observation library of it"
    config = json.loads((tmp_path / "whole" / "config.json").read_text())
    assert config["scenario"]["belief"]["file"] == "asset/observation_library.nc"
    assert config["scenario"]["asset"]["kind"] == "fmu"
    assert set(config["inputs"]) == {"binding", "fmu", "observation_library"}
    with cut_off_after(3):
        new_run(small_pump(), tmp_path / "part", Overrides(library=path))
    path.unlink()
    resume_run(tmp_path / "part")
    check_same(tmp_path / "part", tmp_path / "whole", "run.nc", "summary.json", "csv/health.csv")
    stored = tmp_path / "part" / "asset" / "observation_library.nc"
    stored.write_bytes(stored.read_bytes()[:-200])
    (tmp_path / "part" / "run.nc").unlink()  # of a finished run nothing is read again
    with pytest.raises(TwinMasterError, match=r"not a whole NetCDF"):
        resume_run(tmp_path / "part")


@pytest.mark.long
def test_a_library_of_the_same_draws_gives_the_same_run(tmp_path: Path) -> None:
    grid = grid_of_scenario(small_pump(), tmp_path / "made", progress=SilentProgress())
    path = sample_library(grid, tmp_path / "pump.nc", workers=1).path
    new_run(small_pump(), tmp_path / "asked")
    new_run(small_pump(), tmp_path / "sampled", Overrides(library=path))
    for file in (tmp_path / "asked" / "csv").iterdir():
        assert (tmp_path / "sampled" / "csv" / file.name).read_bytes() == file.read_bytes()
    # With another seed the draws are others, inside the sampled range only for some.
    with pytest.raises(InvalidObservationLibraryError, match="scenario and seed"):
        new_run(small_pump(), tmp_path / "other", Overrides(library=path, seed=3))


def test_a_library_of_another_fmu_is_flown_with_a_notice(
    made: tuple[Path, SamplingGrid], tmp_path: Path
) -> None:
    script = tmp_path / "gear_pump.py"
    text = asset_scripts()["gear_pump"].read_text(encoding="utf-8")
    script.write_text(text.replace("COOLING = 250.0", "COOLING = 200.0"))
    fmu = build_script_fmu(script, tmp_path / "other.fmu").path
    outcome = new_run(small_pump(), tmp_path / "run", Overrides(library=made[0], fmu=fmu))
    assert outcome.origin.differ
    assert outcome.origin.model == "observation library of another FMU"
    figures = {figure.key: figure.value for figure in outcome.figures}
    assert figures["model_misfit_largest"] > 1.0  # percent: the oil is hotter with less cooling
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["asset_and_model_differ"] is True


@pytest.mark.parametrize(
    ("key", "entry", "words"),
    [
        ("state.0.levels_percent", [0, 25, 60], "has the levels 0, 0.3, 0.6 of wear.*asks for 0.25"),
        (
            "control.2.values",
            {"speed": 1900.0, "pressure": 180.0},
            "not sampled at speed = 1900.*control boost",
        ),
        (
            "observation.unit",
            ["L/min", "N.m", "1", "bar"],
            r"has them in L/min, N\.m, degC, bar.* L/min, N\.m, 1, bar",
        ),
        ("calibration.mean", 1.5, "reach from .* and the observation library from 0.9 to 1.1"),
        ("state.0.unit", "percent", "has the states in clogging: 1, wear: 1"),
    ],
)
def test_what_a_library_lacks_is_named(
    made: tuple[Path, SamplingGrid], tmp_path: Path, key: str, entry: object, words: str
) -> None:
    with pytest.raises(InvalidObservationLibraryError, match=words):
        new_run(changed(key, entry), tmp_path / "run", Overrides(library=made[0]))


def test_names_and_order_of_controls_and_states_do_not_matter(
    made: tuple[Path, SamplingGrid], tmp_path: Path
) -> None:
    table = pump_table()
    table["state"].reverse()
    table["control"].reverse()
    turned = LoadedScenario(parse_scenario(table, "small_pump"), PATH, "0" * 64)
    for name, loaded in (("a", small_pump()), ("b", turned)):
        new_run(loaded, tmp_path / name, Overrides(library=made[0]))
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in "ab"]
    figures = [{f["key"]: f["value"] for f in summary["figures"]} for summary in summaries]
    assert figures[0]["log_evidence"] == pytest.approx(figures[1]["log_evidence"], rel=1e-12)
    assert figures[0]["filtered_rms_error_wear"] == pytest.approx(figures[1]["filtered_rms_error_wear"])


def test_files_that_are_no_library_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidObservationLibraryError, match="there is no observation library"):
        load_observation_library(tmp_path / "missing.nc")
    (tmp_path / "noise.nc").write_bytes(b"no NetCDF at all")
    with pytest.raises(InvalidObservationLibraryError, match="not a whole NetCDF"):
        load_observation_library(tmp_path / "noise.nc")
    import xarray as xr

    xr.Dataset({"x": 1.0}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(InvalidObservationLibraryError, match="no observation library of this version"):
        load_observation_library(tmp_path / "other.nc")


@pytest.mark.parametrize("name", ["observation", "control_speed", "wear"])
def test_a_library_with_a_number_that_is_none_is_refused(
    made: tuple[Path, SamplingGrid], tmp_path: Path, name: str
) -> None:
    import xarray as xr

    with xr.open_dataset(made[0], engine="h5netcdf") as opened:
        dataset = opened.load()
    values = dataset[name].values.copy()
    values[(0,) * values.ndim] = np.nan
    changed = dataset.drop_vars(name).assign({name: (dataset[name].dims, values, dataset[name].attrs)})
    changed.to_netcdf(tmp_path / "pump.nc", engine="h5netcdf")
    with pytest.raises(InvalidObservationLibraryError, match="finite") as caught:
        load_observation_library(tmp_path / "pump.nc")
    assert "\n" not in str(caught.value)


def test_a_library_is_named_by_the_belief_and_an_fmu_by_the_asset() -> None:
    for asset, words in (
        ({"library": "pump.nc"}, "unknown key `asset.library`"),
        ({"file": "pump.fmu"}, "unknown key `asset.file`"),
        ({"kind": "fmu", "file": "pump.fmu"}, "unknown key `asset.script`"),
    ):
        with pytest.raises(ScenarioError, match=words):
            small_pump(**asset)


def test_a_scenario_without_an_fmu_cannot_be_sampled(tmp_path: Path, library_file: Path) -> None:
    with pytest.raises(
        InvalidObservationLibraryError, match="kind `strain_library`, and one FMU can be sampled"
    ):
        grid_of_scenario(
            load_scenario("level_turns"),
            tmp_path,
            overrides=Overrides(strain_library=library_file),
            progress=SilentProgress(),
        )
    assert binding_files()["gear_pump"].is_file()


@pytest.mark.parametrize(
    ("key", "entry", "words"),
    [
        ("observation.unit", ["bar"], r"`observation\.unit` must be one value, or one for each of the 4"),
        ("observation.standard_deviation", [1.0, 1.0], r"`observation\.standard_deviation` must be one"),
        ("observation.titles", ["flow"], r"`observation\.titles`"),
        ("rewards.health_limit", [1.0, 2.0, 3.0], r"`rewards\.health_limit` .* 2 sensors, and 3 came"),
        (
            "rewards.health_sensors",
            [1, 5],
            r"`rewards\.health_sensors` must name different sensors from 1 to 4",
        ),
        ("rewards.error_scale", [1.0], r"`rewards\.error_scale`"),
        ("truth.noise", {"standard_deviation": [1.0]}, r"`truth\.noise\.standard_deviation`"),
    ],
)
def test_lists_of_another_length_are_refused(key: str, entry: object, words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        changed(key, entry)
