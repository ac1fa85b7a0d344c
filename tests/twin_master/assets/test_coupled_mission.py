"""Any FMU with a binding and a scenario flies, and so do coupled ones: in a worker, resumed, from an SSP.

The shipped wing, too: the paper's policy and its reliability.
"""

import shutil
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from benchmarks.seeds import fly_seeds
from fmu_asset.errors import FmuError, SspError
from reporting.progress import SilentProgress
from tests.refusals import Inputs, refused
from tests.twin_master.runs import (
    changed_scenario,
    check_resumed,
    of_wing,
    text_of,
    written,
)
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.assets.system_export import export_scenario
from twin_master.errors import FleetError, MissionInputError, TwinMasterError
from twin_master.fleet.plan import ensemble
from twin_master.mission.turns import Plant, Truth
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.reading import LoadedScenario
from uav_twin import fly as new_run
from uav_twin import fly_fleet, load_scenario, open_run, resume

pytestmark = pytest.mark.usefixtures("no_report")
INPUTS = Inputs(__file__)
WING = pytest.mark.xdist_group("wing")
BOTH = pytest.mark.parametrize("name", ["coupled_fouling", "fouling"])


@pytest.fixture(scope="module")
def folder(heat_exchanger: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The heat exchanger as one FMU, and as a system of one component."""
    place = Path(shutil.copytree(heat_exchanger, tmp_path_factory.mktemp("coupled") / "system"))
    binding = (place / "binding.toml").read_text(encoding="utf-8")
    inner = ("wall_temperature", "conductance", "heat")
    names = [(f'variable = "{name}"', f'variable = "exchanger.{name}"') for name in inner]
    names += [('variable = "mass_flow"', 'variable = "flow"')]
    names += [('["middle", "outlet"]', '["exchanger.middle", "outlet"]')]
    written(place, binding, *names, name="coupled.toml")
    text = (place / "fouling.toml").read_text(encoding="utf-8")
    asset = text[text.index("[asset]") : text.index("[calibration]")]
    written(place, text, (asset, INPUTS.text("coupled.toml")), name="coupled_fouling.toml")
    return place


@pytest.fixture(scope="module")
def direct(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The mission with the one FMU, and with the system of one component."""
    place = tmp_path_factory.mktemp("direct")
    return {
        name: new_run(load_scenario(folder / f"{name}.toml"), place / name).folder
        for name in ("fouling", "coupled_fouling")
    }


def rows(run: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((run / "csv").iterdir())}


@BOTH
def test_a_flight_is_the_same_in_process_resumed_and_from_an_ssp_file(folder, direct, tmp_path, name):
    """Also of a system of that FMU. It cannot save its state: its inputs are replayed.

    What is flown lies in the run folder.
    """
    loaded = load_scenario(folder / f"{name}.toml")
    inside = new_run(loaded, tmp_path / "inside", Overrides(in_process=True)).folder
    assert rows(inside) == rows(direct[name]) == rows(direct["fouling"])
    check_resumed(direct[name], loaded, tmp_path / "part", 11)
    ssp = export_scenario(loaded, tmp_path / "x.ssp", replace_file=False)
    flown = new_run(loaded, tmp_path / "flown", Overrides(ssp=ssp)).folder
    assert rows(flown) == rows(direct[name])
    assert (flown / "asset" / "system.ssp").read_bytes() == ssp.read_bytes()
    ssp.unlink()
    assert rows(resume(flown).folder) == rows(direct[name])


ANY = TwinMasterError, FmuError, SspError


@pytest.mark.parametrize(
    ("name", "old", "new", "sentence"),
    [("coupled_fouling", *row) for row in INPUTS.refused("coupled") + INPUTS.refused("exchanger")]
    + [("fouling", *row) for row in INPUTS.refused("exchanger")],
)
def test_what_does_not_fit_is_said_before_a_folder_is_made(folder, tmp_path, name, old, new, sentence):
    text = (folder / f"{name}.toml").read_text(encoding="utf-8")
    with refused(ANY, sentence):
        new_run(load_scenario(written(folder, text, (old, new), name="wrong.toml")), tmp_path / "run")
    assert not [*tmp_path.iterdir()]


def test_files_that_cannot_be_flown_are_refused_before_a_folder_is_made(folder, tmp_path):
    for file in ("broken.fmu", "broken.ssp"):
        (folder / file).write_bytes(b"PK no archive")
    for name, file, words in (
        ("fouling", "none.fmu", r"none\.fmu cannot be read"),
        ("fouling", "broken.fmu", r"broken\.fmu"),
        ("coupled_fouling", "none.ssp", r"none\.ssp cannot be read"),
        ("coupled_fouling", "broken.ssp", "not a sound SSP archive"),
    ):
        with refused(ANY, words):
            new_run(load_scenario(folder / f"{name}.toml"), tmp_path / "run", {file[-3:]: folder / file})
    text = (folder / "coupled_fouling.toml").read_text(encoding="utf-8")
    own = '[truth]\nkind = "asset"\nstate = { fouling = "heat" }\n'
    path = written(folder, text[: text.index("[truth]")] + own, name="own.toml")
    with pytest.raises(MissionInputError, match="name a model for the twin in the table `belief`"):
        new_run(load_scenario(path), tmp_path / "run")
    assert not [*tmp_path.iterdir()]


# ---------------------------------------------------------------------- with the shipped wing


def shipped(name: str, tmp_path: Path, *changes: tuple[str, str]) -> LoadedScenario:
    """Return a shipped scenario with changes, and with a calibration that costs nothing."""
    text = text_of(name)
    calibration = text[text.index("[calibration]") : text.index("[truth]")]
    fixed = '[calibration]\nparameter = "young_modulus_factor"\nsource = "fixed"\nmean = 1.0073\n\n'
    return load_scenario(written(tmp_path, text, (calibration, fixed), *changes, name=f"{name}.toml"))


def plant_of(loaded: LoadedScenario, folder: Path) -> Plant:
    scenario = resolve_scenario(loaded, Overrides(in_process=True))
    source = asset_source(scenario)
    source.check()
    source.prepare(folder, SilentProgress())
    truth = Truth(scenario, build_graphical_model(scenario), scenario.mission.seed)
    return Plant(scenario, truth, source.open())


@pytest.mark.slow
@WING
def test_three_fmus_live_the_script_of_a_scenario(tmp_path):
    """Damage, drift and lost gauges of failing_gauges, once as its truth and once in the FMUs: to the bit."""
    quiet = ("standard_deviation_microstrain = 150", "standard_deviation_microstrain = 0")
    lived = INPUTS.table("lived_by_fmus.toml")["changes"]
    split = plant_of(shipped("three_fmus", tmp_path, *lived), tmp_path / "split")
    single = plant_of(shipped("failing_gauges", tmp_path, quiet), tmp_path / "single")
    controls = np.random.default_rng(3).integers(2, size=50).tolist()
    for step, control in enumerate(controls):
        previous = controls[step - 1] if step else None
        ours, theirs = (plant.turn(control, previous) for plant in (split, single))
        np.testing.assert_array_equal(ours.observed, theirs.observed, err_msg=str(step))
        np.testing.assert_array_equal(ours.happened.state, theirs.happened.state)
        np.testing.assert_array_equal(ours.happened.observation, theirs.happened.observation)
        assert theirs.happened.monitors.items() <= ours.happened.monitors.items()
    assert theirs.happened.state.max() == 0.6


def test_many_lives_of_an_asset_with_its_own_damage_are_refused(tmp_path):
    fleet = ensemble("three_fmus", range(3))
    (group,) = fleet.groups
    (scenario,) = group.scenarios
    seedless = scenario.model_copy(update={"asset": scenario.asset.model_copy(update={"seeds": ()})})
    with pytest.raises(FleetError, match="every seed would fly the same life"):
        fly_fleet(replace(fleet, groups=(replace(group, scenarios=(seedless,)),)), tmp_path / "fleet")


@pytest.mark.slow
@WING
def test_the_papers_policy_and_its_reliability():
    """Bars of 300 missions, widened for 80; `benchmarks/study_level_turns.py` flies as many as wanted."""
    knowledge, source = of_wing("paper_level_turns", 0)
    z1 = knowledge.model.states.coordinates[:, 0]
    np.testing.assert_array_equal(knowledge.plan.control_index, np.where(z1 < 0.59, 1, 0))
    assert knowledge.draws.mean == pytest.approx(1.0073, abs=0.002)
    assert knowledge.draws.standard_deviation == pytest.approx(0.0103, abs=0.001)
    study = fly_seeds(knowledge.scenario, source, range(80))
    assert study.within.value >= 0.95
    assert study.early.value <= 0.2
    assert np.all([study.rms[0].value <= 0.045, study.rms[1].value <= 0.13])


@pytest.mark.long
@WING
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_mission_is_the_same_with_the_compiled_wing_and_without_a_worker(tmp_path):
    trees = []
    for packed in ("python", "compiled"):
        loaded = changed_scenario("paper_level_turns", {"asset": {"packed": packed}})
        trees.append(open_run(new_run(loaded, tmp_path / packed, {"in_process": packed == "python"}).folder))
    with zipfile.ZipFile(tmp_path / "compiled" / "asset" / "asset.fmu") as archive:
        assert not any(name.endswith(".py") for name in archive.namelist())
    for group in ("observed", "filtered", "smoothed", "predicted", "truth"):
        plain, compiled = (tree[group].to_dataset() for tree in trees)
        xr.testing.assert_allclose(compiled, plain, rtol=1e-9, atol=1e-12)
