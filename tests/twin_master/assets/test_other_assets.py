"""Missions of assets by FMUs, coupled ones and SSP files, and of structures from a mesh."""

import re
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import xarray as xr

from benchmarks.studies.seeds import fly_seeds
from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime.errors import FiniteElementError, InvalidDesignError
from fe.structure.design import load_structure
from fe.structure.operators import load_and_assemble
from fmu_asset.errors import FmuError, SspError
from fmu_asset.ssp.reader import read_ssp
from fmu_asset.structures import structure_binding_text
from tests.refusals import Inputs, refused
from tests.twin_master.runs import (
    changed_scenario,
    check_same,
    cut_off_after,
    edited,
    loaded_from,
    merged,
    of_wing,
    prepared,
    table_of,
    text_of,
    written,
)
from twin_master.assets.resolution import Overrides, believed_source, resolve_scenario
from twin_master.assets.system_export import export_scenario
from twin_master.errors import FleetError, MissionInputError, TwinMasterError
from twin_master.feeds.message import MessageReader
from twin_master.fleet.plan import ensemble
from twin_master.mission.plant import Plant, Truth
from twin_master.mission.sensor_design import add_candidate_gauges
from twin_master.network.graphical_model import build_graphical_model
from twin_master.network.identified import packed_row
from twin_master.scenario.reading import LoadedScenario
from uav_twin import fly as new_run
from uav_twin import fly_fleet, load_scenario, open_run, report_figures, resume, structure_files, watch

pytestmark = [pytest.mark.usefixtures("no_report"), pytest.mark.xdist_group("wing")]
INPUTS = Inputs(__file__)


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


def rows(run: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((run / "csv").iterdir())}


@pytest.fixture(scope="module")
def rows_alone(folder: Path, no_report: None, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The tables of a flight of the exchanger as one FMU."""
    loaded = load_scenario(folder / "fouling.toml")
    return rows(new_run(loaded, tmp_path_factory.mktemp("alone") / "run").folder)


class ExchangerFlight:
    """A flight of the exchanger as one FMU, or as a system of that FMU."""

    def __init__(self, loaded: LoadedScenario, folder: Path) -> None:
        self.loaded = loaded
        self.whole = new_run(loaded, folder / "whole").folder
        self.ssp = export_scenario(loaded, folder / "x.ssp", replace_file=False)


@pytest.fixture(scope="module", params=["fouling", "coupled_fouling"])
def exchanger_flight(
    request: pytest.FixtureRequest, folder: Path, no_report: None, tmp_path_factory: pytest.TempPathFactory
) -> ExchangerFlight:
    loaded = load_scenario(folder / f"{request.param}.toml")
    return ExchangerFlight(loaded, tmp_path_factory.mktemp(request.param))


def test_a_flight_is_the_same_in_process(exchanger_flight, rows_alone, tmp_path):
    options = Overrides(in_process=True)
    inside = new_run(exchanger_flight.loaded, tmp_path / "inside", options).folder
    assert rows(inside) == rows(exchanger_flight.whole) == rows_alone


def test_a_flight_is_the_same_resumed(exchanger_flight, tmp_path):
    """The FMU cannot save its state: its inputs are replayed."""
    with cut_off_after(11):
        new_run(exchanger_flight.loaded, tmp_path / "part")
    resume(tmp_path / "part")
    names = ("run.nc", "config.json", "summary.json", "journal.jsonl")
    check_same(tmp_path / "part", exchanger_flight.whole, *names)


def test_a_flight_is_the_same_from_an_ssp_file(exchanger_flight, rows_alone, tmp_path):
    """What is flown lies in the run folder, so that the run is resumed when the file is gone."""
    ssp = Path(shutil.copy(exchanger_flight.ssp, tmp_path / "x.ssp"))
    flown = new_run(exchanger_flight.loaded, tmp_path / "flown", Overrides(ssp=ssp)).folder
    assert rows(flown) == rows_alone
    assert (flown / "asset" / "system.ssp").read_bytes() == ssp.read_bytes()
    ssp.unlink()
    assert rows(resume(flown).folder) == rows_alone


def test_an_ssp_file_has_the_span_of_the_mission(folder, tmp_path):
    later_and_finer = ("step_size = 60.0", "step_size = 15.0\ndecimation = 4\nstart_time = 1000.0")
    binding = written(tmp_path, (folder / "binding.toml").read_text(encoding="utf-8"), later_and_finer)
    loaded = load_scenario(folder / "fouling.toml")
    asset = loaded.scenario.asset.model_copy(update={"binding": str(binding)})
    later = replace(loaded, scenario=loaded.scenario.model_copy(update={"asset": asset}))
    ssp = export_scenario(later, tmp_path / "later.ssp", replace_file=False)
    assert read_ssp(ssp, tmp_path).span == (1000.0, 1000.0 + 60.0 * later.scenario.mission.steps)


@pytest.mark.parametrize(
    ("name", "old", "new", "sentence"),
    [("coupled_fouling", *row) for row in INPUTS.refused("coupled") + INPUTS.refused("exchanger")]
    + [("fouling", *row) for row in INPUTS.refused("exchanger")],
)
def test_what_does_not_fit_is_said_before_a_folder_is_made(folder, tmp_path, name, old, new, sentence):
    text = (folder / f"{name}.toml").read_text(encoding="utf-8")
    with refused((TwinMasterError, FmuError, SspError), sentence):
        new_run(load_scenario(written(folder, text, (old, new), name="wrong.toml")), tmp_path / "run")
    assert not [*tmp_path.iterdir()]


# ---------------------------------------------------------------------- with the shipped wing


def plant_of(name: str, folder: Path, *changes: tuple[str, str]) -> Plant:
    """Return what flies in a shipped scenario with changes, and with a calibration that costs nothing."""
    text = text_of(name)
    calibration = text[text.index("[calibration]") : text.index("[truth]")]
    fixed = '[calibration]\nparameter = "young_modulus_factor"\nsource = "fixed"\nmean = 1.0073\n\n'
    loaded = load_scenario(written(folder, text, (calibration, fixed), *changes, name=f"{name}.toml"))
    scenario, source = loaded.scenario, prepared(loaded, folder / name, {"in_process": True})
    truth = Truth(scenario, build_graphical_model(scenario), scenario.mission.seed)
    return Plant(scenario, truth, source.open())


@pytest.mark.slow
def test_three_fmus_live_the_script_of_a_scenario(tmp_path):
    """Damage, drift and lost gauges of failing_gauges, once as its truth and once in the FMUs: to the bit."""
    quiet = ("standard_deviation_microstrain = 150", "standard_deviation_microstrain = 0")
    lived = INPUTS.table("lived_by_fmus.toml")["changes"]
    split, single = plant_of("three_fmus", tmp_path, *lived), plant_of("failing_gauges", tmp_path, quiet)
    controls = np.random.default_rng(3).integers(2, size=50).tolist()
    for step, control in enumerate(controls):
        previous = controls[step - 1] if step else None
        ours, theirs = (plant.fly_step(control, previous) for plant in (split, single))
        np.testing.assert_array_equal(ours.observed, theirs.observed, err_msg=str(step))
        np.testing.assert_array_equal(ours.ground_truth.state, theirs.ground_truth.state)
        np.testing.assert_array_equal(ours.ground_truth.observation, theirs.ground_truth.observation)
        assert theirs.ground_truth.monitors.items() <= ours.ground_truth.monitors.items()
    assert theirs.ground_truth.state.max() == 0.6


def test_many_lives_of_an_asset_with_its_own_damage_are_refused(tmp_path):
    fleet = ensemble("three_fmus", range(3))
    (group,) = fleet.groups
    (scenario,) = group.scenarios
    seedless = scenario.model_copy(update={"asset": scenario.asset.model_copy(update={"seeds": ()})})
    with pytest.raises(FleetError, match="every seed would fly the same mission"):
        fly_fleet(replace(fleet, groups=(replace(group, scenarios=(seedless,)),)), tmp_path / "fleet")


@pytest.fixture(scope="module")
def papers_wing() -> tuple[Any, Any]:
    """What a twin of the paper's wing knows, and that wing."""
    return of_wing("paper_level_turns", 0)


@pytest.mark.slow
def test_the_papers_policy_leaves_a_control_at_60_percent(papers_wing):
    knowledge, _ = papers_wing
    loss = knowledge.model.states.coordinates[:, 0]
    np.testing.assert_array_equal(knowledge.plan.control_index, np.where(loss < 0.59, 1, 0))


@pytest.mark.slow
def test_the_papers_calibration_has_its_moments(papers_wing):
    draws = papers_wing[0].draws
    assert draws.mean == pytest.approx(1.0073, abs=0.002)
    assert draws.standard_deviation == pytest.approx(0.0103, abs=0.001)


@pytest.mark.slow
def test_the_papers_policy_is_reliable(papers_wing):
    """Bars of 300 missions, widened for 80; `benchmarks/studies/level_turns.py` flies as many as wanted."""
    knowledge, source = papers_wing
    study = fly_seeds(knowledge.scenario, source, range(80))
    assert study.prompt_fallbacks.value >= 0.95
    assert study.early_fallbacks.value <= 0.2
    assert np.all([study.rms[0].value <= 0.045, study.rms[1].value <= 0.13])


@pytest.mark.long
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


FILE = structure_files()["bracket"]
TEXT = FILE.read_text(encoding="utf-8")
STATES, INPUTS = table_of("bracket")["state"], Inputs(__file__)


def short(**changes: Any) -> LoadedScenario:
    """The shipped mission of the bracket in ten shifts."""
    gains = [{"state": "z_heel", "first_step": 2, "last_step": 3, "gain_percent": 20}]
    mission = {"steps": 10, "prediction_steps": 3}
    own = {"mission": mission, "asset": {"isolated": False}, "truth": {"gains": gains}}
    return loaded_from(merged(merged(table_of("bracket"), own), changes), "bracket")


def fly(loaded: LoadedScenario, folder: Path) -> Any:
    """Return the tree of the run."""
    return open_run(new_run(loaded, folder, report=False).folder)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its run folder."""
    return new_run(short(), tmp_path_factory.mktemp("bracket") / "run", report=False).folder


@pytest.fixture(scope="module")
def bracket() -> Any:
    """The full model of the bracket."""
    return load_and_assemble(FILE)


@pytest.mark.parametrize("step", [0, 9])
def test_the_strains_flown_are_those_of_the_full_model_within_their_bound(flown, bracket, step):
    tree = open_run(flown)
    truth = tree["truth"]
    losses = dict(zip(bracket.regions, truth["state"].values[step].tolist(), strict=True))
    solution = Factorisation(bracket.stiffness({"e": 1.02}, losses)).solve(bracket.load("weight", 1.0))
    expected = float(tree["observed"]["load_factor"][step]) * (bracket.gauge_output @ solution)
    bound = float(truth["strain_error_bound"][step])
    error = np.abs(truth["strain"].values[step] - expected).max()
    assert error <= bound < 1e-3 * np.abs(expected).max()


def test_the_twin_accuses_the_heel_and_not_the_arm(flown):
    tree = open_run(flown)
    np.testing.assert_allclose(tree["truth"]["state"].values[-1], [0.4, 0.0], atol=1e-12)
    np.testing.assert_allclose(tree["filtered"]["mean"].values[-1], [0.4, 0.0], atol=0.1)


def test_the_field_of_a_structure_has_its_mesh_and_displacement(flown):
    field = meshio.read(flown / "structure.vtu")
    assert field.cells[0].type == "hexahedron20"
    assert 1e-4 < np.abs(field.point_data["displacement"]).max() < 5e-3
    assert not (flown / "wing.vtu").exists()


def test_the_field_of_a_structure_has_regions_and_losses(flown):
    data = meshio.read(flown / "structure.vtu").cell_data
    loss, region = data["stiffness_loss"][0], data["region"][0]
    assert set(np.unique(region)) == {0, 1, 2}
    assert np.all(loss[region == 0] == 0.0)
    assert 0.2 < loss[region == 1].max() < 0.6


def test_the_report_draws_a_structure_with_losses_and_gauges(flown, bracket):
    loss = meshio.read(flown / "structure.vtu").cell_data["stiffness_loss"][0]
    (drawn,) = (figure.figure for figure in report_figures(flown) if figure.name == "structure")
    surface, gauges, *_ = drawn.axes[0].collections
    np.testing.assert_allclose(np.unique(surface.get_array()), 100.0 * np.unique(loss))
    assert len(gauges.get_offsets()) == len(bracket.gauges)


@pytest.mark.long
def test_damage_is_found_from_frequencies_alone(tmp_path):
    """Three natural frequencies in the place of gauges; those flown are the full model's."""
    rewards: dict[str, Any] = {"health_limit": 100.0, "error_scale": 1.0}
    rewards |= dict.fromkeys(("health_limit_microstrain", "error_scale_microstrain"), "")
    noise: dict[str, Any] = {"standard_deviation": [0.2, 0.4, 1.2], "standard_deviation_microstrain": ""}
    observation = {"role": "frequency", "count": 3, "titles": ["f1", "f2", "f3"], "unit": "Hz"}
    loaded = short(observation=observation | noise, rewards=rewards, truth={"noise": noise})
    tree, structure = fly(loaded, tmp_path / "run"), load_and_assemble(FILE)
    assert tree["truth"]["frequency"].attrs["units"] == "Hz"
    squares, _ = lowest_eigenpairs(structure.stiffness({"e": 1.02}, {"z_heel": 0.4}), structure.mass(), 3)
    found = tree["truth"]["frequency"].values[-1]
    np.testing.assert_allclose(found, np.sqrt(squares) / (2.0 * np.pi), rtol=2e-5)
    np.testing.assert_allclose(tree["filtered"]["mean"].values[-1], [0.4, 0.0], atol=0.12)


def test_a_resumed_flight_is_bit_identical_after_the_files_are_gone(flown, tmp_path):
    files = [Path(shutil.copy(FILE.with_name(name), tmp_path)) for name in ("bracket.toml", "bracket.inp")]
    own = {"structure": str(files[0])}
    with cut_off_after(4):
        new_run(short(asset=own, belief=own), tmp_path / "part", report=False)
    for file in files:
        file.unlink()
    moved = (tmp_path / "part").rename(tmp_path / "moved")
    resume(moved, report=False)
    check_same(moved, flown, "csv/observed.csv", "csv/estimated.csv", "csv/decisions.csv")


def test_a_mesh_without_a_set_and_one_that_lies_elsewhere_are_refused(tmp_path):
    """The sentence names the user's mesh, not a copy of it."""
    mesh = Path(shutil.copy(FILE.with_name("bracket.inp"), tmp_path))
    (tmp_path / "sub").mkdir()
    misspelt = written(tmp_path, TEXT.replace('set = "HEEL"', 'set = "HEAL"'))
    below = written(tmp_path / "sub", TEXT.replace('"bracket.inp"', '"../bracket.inp"'), name="bracket.toml")
    named = re.escape(f"{mesh} holds no set")
    for table, file, sentence in (
        ("asset", misspelt, named), ("belief", misspelt, named), ("asset", below, "does not lie beside it")
    ):  # fmt: skip
        with pytest.raises((TwinMasterError, FiniteElementError), match=sentence):
            new_run(short(**{table: {"structure": str(file)}}), tmp_path / "run", report=False)
        assert not (tmp_path / "run").exists()


def test_a_belief_in_another_unit_than_that_of_the_model_is_refused():
    """Also where nothing flies whose binding would tell: millimetres would be taken for metres."""
    given = {"role": "displacement", "count": 1, "titles": "", "unit": "mm"}
    changes: dict[str, Any] = {"asset": "", "truth": "", "observation": given}
    watched = loaded_from(merged(table_of("bracket"), changes), "bracket")
    with pytest.raises(MissionInputError, match=r"`displacement` in m, but `observation\.unit` is mm"):
        believed_source(resolve_scenario(watched)).check()


# ------------------------------- modes identified of a record of accelerations, as the observation of a step

TWO = {
    "acceleration = [{": 'acceleration = [{ name = "mid", point = [60, 10, 5], direction = [0, 0, 1] }, {',
    "beta = 2e-5": "beta = 2e-6",
}
BEAM = INPUTS.table("beam_mission.toml")
MODES = BEAM["observation"]["modes"]
TITLES = ["frequency_1", "damping_ratio_1", "mid_1", "frequency_3", "damping_ratio_3", "mid_3"]


def mission(file: Path, **changes: Any) -> LoadedScenario:
    """A beam whose inner region loses 30 % of its stiffness, watched by two accelerometers."""
    own = {"asset": {"structure": str(file)}, "belief": {"structure": str(file)}}
    return loaded_from(merged(merged(BEAM, own), changes), "bracket")


@pytest.fixture(scope="module")
def file(write_beam: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_beam(tmp_path_factory.mktemp("beam"), TWO)


def features(tree: Any, titles: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True and seen features, and the standard errors of the record."""
    truth = tree["truth"]
    errors = np.stack([truth[f"standard_error_{title}"].values for title in titles], axis=1)
    return truth["modes"].values, tree["observed"]["modes"].values, errors


def test_the_twin_finds_the_loss_from_records_of_accelerations(file, tmp_path):
    """Features lie within their errors of those of the model that flies; the inner region is accused.

    A watch of what is stored believes the same, and residuals count the errors of the record.
    """
    loaded = mission(file, observation={"between_levels": False})
    tree = fly(loaded, tmp_path / "run")
    again = open_run(watch(loaded, tmp_path / "run" / "run.nc", tmp_path / "again", report=False))
    np.testing.assert_allclose(again["filtered"]["log_evidence"], tree["filtered"]["log_evidence"], rtol=1e-9)
    true, seen, errors = features(tree, TITLES)
    assert list(tree["observed"]["sensor_unit"].values) == ["Hz", "1", "1"] * 2
    # mode 5, at 8 kHz and strongly damped, is in the record and told by none of the bands: a small bias
    assert np.abs((seen - true) / np.hypot(errors, 5e-3 * np.abs(true))).max() < 5.0
    assert np.all(errors[:, 0] < 1e-3 * true[:, 0])
    # a record has its own rate, however many communication steps of the binding make a step of the mission
    several = ("step_size = 1.0", "step_size = 1.0\ndecimation = 4")
    binding = written(tmp_path, structure_binding_text(load_structure(file)), several)
    once = {"mission": {"steps": 1}, "truth": {"gains": []}, "asset": {"binding": str(binding)}}
    rate = fly(mission(file, **once), tmp_path / "rate")
    np.testing.assert_array_equal(rate["observed"]["modes"].values, seen[:1])
    noise = np.hypot(errors, loaded.scenario.observation.standard_deviation)
    np.testing.assert_allclose(tree["filtered"]["noise_standard_deviation"], noise, rtol=1e-9)
    np.testing.assert_allclose(tree["filtered"]["mean"].values, tree["truth"]["state"].values, atol=0.02)


@pytest.mark.long
def test_ambient_records_tell_the_same_mode_also_when_the_flight_is_resumed(file, tmp_path):
    """White noise on the push: its three features within four standard errors of the record."""
    modes = {"bands": MODES["bands"][:1], "numbers": [1]}
    record = {"kind": "ambient", "duration": 2.0, "sampling_rate": 3000.0}
    truth = {"gains": [], "record": record}
    loaded = mission(file, mission={"steps": 2}, truth=truth, observation={"modes": modes})
    whole = new_run(loaded, tmp_path / "whole", report=False).folder
    true, seen, errors = features(open_run(whole), TITLES[:3])
    assert np.all(np.abs(seen - true) < 4.0 * errors)
    assert errors[0, 0] < 0.01 * true[0, 0]
    with cut_off_after(1):
        new_run(loaded, tmp_path / "part", report=False)
    resume(tmp_path / "part", report=False)
    check_same(tmp_path / "part", whole, "csv/observed.csv", "csv/estimated.csv")


@pytest.mark.parametrize(
    ("of", "changes", "sentence"),
    [(of, *row) for of in ("bracket", "modes") for row in INPUTS.refused(of)],
)
def test_what_does_not_fit_is_refused_before_a_folder_is_made(file, of, changes, sentence, tmp_path):
    with pytest.raises((TwinMasterError, FiniteElementError), match=sentence):
        new_run(short(**changes) if of == "bracket" else mission(file, **changes), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_watch_takes_features_with_their_covariance(file):
    """Messages of features give the belief of the mission; a covariance that is none is refused."""
    scenario = mission(file).scenario
    reader, count = MessageReader(scenario), scenario.observation.count
    covariance = np.diag([1e-2, 1e-8, 1e-6, 1.0, 1e-6, 1e-6])
    told = {"frequency_1_Hz": 461.7, "mid_1": None, "modes_4": 4590.0, "covariance": covariance.tolist()}
    message = reader.read(told)
    np.testing.assert_array_equal(message.observed[:count], [461.7, np.nan, np.nan, 4590.0, np.nan, np.nan])
    np.testing.assert_array_equal(message.observed, packed_row(message.observed[:count], covariance))
    for wrong, sentence in (([1.0], "6 rows of 6"), ((-covariance).tolist(), "eigenvalues of zero or more")):
        assert sentence in str(reader.read({"covariance": wrong}))


# ------------------------------------------------------------------ gauges beside those of a structure file


def test_gauges_that_cannot_stand_beside_those_of_the_file(tmp_path):
    """What is wrong names the option."""
    panel = resolve_scenario(load_scenario("stiffened_panel"), Overrides())
    whole = panel.model_copy(update={"rewards": panel.rewards.model_copy(update={"health_sensors": "all"})})
    found, folder = add_candidate_gauges(whole, "2", tmp_path / "2"), tmp_path / "0"
    limited = [found.observation.titles[number - 1] for number in found.rewards.health_sensors]
    assert limited == [*panel.observation.titles]  # health stays that of the gauges of the file
    with pytest.raises(MissionInputError, match="--candidates needs at least one place"):
        add_candidate_gauges(panel, "0", folder)
    for name, point, words in (
        ("end_1", "[150, 100, 2]", "end_1"), ("far", "[150, 100, 90]", r"gauge\[1\] \(far\): the point")
    ):  # fmt: skip
        one = f'[[gauge]]\nname = "{name}"\npoint = {point}\ndirection = [1, 0, 0]\n'
        listed, folder = written(tmp_path, one, name="more.toml"), tmp_path / name
        with pytest.raises(InvalidDesignError, match=f"^--candidates .*more.toml: .*{words}") as caught:
            add_candidate_gauges(panel, str(listed), folder)
        assert str(folder) not in str(caught.value)
    source = structure_files()["stiffened_panel"]
    shutil.copy(source.with_suffix(".msh"), tmp_path)
    text = source.read_text()
    gauges = text[text.index("[[gauge]]") : text.index("[[displacement]]")]
    rows = 'gauge = [{ name = "end_1", point = [40, 50, -20], direction = [1, 0, 0] }]\n'
    inline = written(tmp_path, rows + edited(text, (gauges, "")), name="panel.toml")
    believed = panel.belief.model_copy(update={"structure": str(inline)})
    with pytest.raises(MissionInputError, match=r"as tables \[\[gauge\]\], not in a list"):
        add_candidate_gauges(panel.model_copy(update={"belief": believed}), "3", tmp_path / "3")
