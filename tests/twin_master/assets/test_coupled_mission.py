"""Coupled FMUs as the asset of a mission: as one FMU, in a worker, resumed, and from an SSP file."""

from __future__ import annotations

import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmu_asset.door.binding import load_binding
from fmu_asset.errors import AlgebraicLoopError, BindingError, CouplingError, FmuError, SspError
from reporting.progress import SilentProgress
from scenarios import binding_files, scenario_files
from tests.twin_master.runs import check_same, cut_off_after
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.assets.system_export import export_scenario
from twin_master.errors import FleetError, MissionInputError, ScenarioError
from twin_master.fleet.flight import fly_fleet
from twin_master.fleet.plan import ensemble
from twin_master.mission.truth import Plant, Truth
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.reading import LoadedScenario, load_scenario, parse_scenario
from twin_master.workflow import fly as new_run
from twin_master.workflow import resume as resume_run

pytestmark = pytest.mark.usefixtures("no_report")
COUPLED = """[asset]
kind = "coupled"
binding = "coupled.toml"
parameters = { conductance = 6100.0 }
load = { wall_temperature = 80.0 }

[[asset.component]]
name = "exchanger"
fmu = "HeatExchanger.fmu"
parameters = { conductance = 5000.0 }

[[asset.connection]]
source = "flow"
target = "exchanger.mass_flow"

[[asset.connection]]
source = "fouling"
target = "exchanger.fouling"

[[asset.connection]]
source = "exchanger.outlet"
target = "outlet"

[belief]
kind = "asset"

[calibration]"""


@pytest.fixture(scope="module")
def folder(heat_exchanger: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The heat exchanger as one FMU, and as a system of one component."""
    place = tmp_path_factory.mktemp("coupled") / "system"
    shutil.copytree(heat_exchanger, place)
    binding = (place / "binding.toml").read_text(encoding="utf-8")
    for old, new in (
        ('variable = "mass_flow"', 'variable = "flow"'),
        ('variable = "wall_temperature"', 'variable = "exchanger.wall_temperature"'),
        ('variable = "misbehaviour"', 'variable = "exchanger.misbehaviour"'),
        ('variable = "conductance"', 'variable = "exchanger.conductance"'),
        ('["middle", "outlet"]', '["exchanger.middle", "outlet"]'),
        ('variable = "heat"', 'variable = "exchanger.heat"'),
    ):
        assert old in binding
        binding = binding.replace(old, new)
    (place / "coupled.toml").write_text(binding, encoding="utf-8")
    text = (place / "fouling.toml").read_text(encoding="utf-8")
    before, rest = text.split("[asset]\n")
    _, after = rest.split("[calibration]")
    (place / "coupled_fouling.toml").write_text(before + COUPLED + after, encoding="utf-8")
    return place


@pytest.fixture(scope="module")
def direct(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The mission with the one FMU, and with the system of one component."""
    place = tmp_path_factory.mktemp("direct")
    return {
        name: new_run(load_scenario(folder / f"{name}.toml"), place / name).folder
        for name in ("fouling", "coupled_fouling")
    }


def changed(folder: Path, name: str, *changes: tuple[str, str]) -> Path:
    text = (folder / "coupled_fouling.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / f"{name}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def rows(run: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((run / "csv").iterdir())}


def test_a_system_of_one_fmu_flies_as_the_fmu_alone(
    folder: Path, direct: dict[str, Path], tmp_path: Path
) -> None:
    """In a worker and in this process."""
    assert rows(direct["coupled_fouling"]) == rows(direct["fouling"])
    loaded = load_scenario(folder / "coupled_fouling.toml")
    inside = new_run(loaded, tmp_path / "run", Overrides(in_process=True)).folder
    assert rows(inside) == rows(direct["fouling"])


@pytest.mark.parametrize("name", ["coupled_fouling", "fouling"])
def test_a_resumed_flight_is_bit_identical(
    folder: Path, direct: dict[str, Path], tmp_path: Path, name: str
) -> None:
    """The FMU cannot save its state: its inputs are replayed. What is flown lies in the run folder."""
    with cut_off_after(11):
        new_run(load_scenario(folder / f"{name}.toml"), tmp_path / "part")
    resume_run(tmp_path / "part")
    check_same(tmp_path / "part", direct[name], "run.nc", "config.json", "summary.json", "journal.jsonl")


@pytest.mark.parametrize("name", ["coupled_fouling", "fouling"])
def test_an_exported_system_flies_the_same_mission(
    folder: Path, direct: dict[str, Path], tmp_path: Path, name: str
) -> None:
    """From the coupled scenario and from that of one FMU; the run folder holds the SSP file."""
    loaded = load_scenario(folder / f"{name}.toml")
    ssp = export_scenario(loaded, tmp_path / "x.ssp", replace_file=False, progress=SilentProgress())
    flown = new_run(loaded, tmp_path / "flown", Overrides(ssp=ssp)).folder
    assert rows(flown) == rows(direct[name])
    assert (flown / "asset" / "system.ssp").read_bytes() == ssp.read_bytes()
    ssp.unlink()
    assert rows(resume_run(flown).folder) == rows(direct[name])


def test_what_does_not_fit_is_said_before_a_folder_is_made(folder: Path, tmp_path: Path) -> None:
    for name, change, kind, words in (
        ("component", ('source = "exchanger.outlet"', 'source = "boiler.outlet"'), CouplingError,
         r"'boiler\.outlet' begins with no component; the components are exchanger"),
        ("variable", ('target = "exchanger.mass_flow"', 'target = "exchanger.flow"'), CouplingError,
         "has no variable 'flow'"),
        ("missing", ("HeatExchanger.fmu", "Missing.fmu"), MissionInputError, r"Missing\.fmu cannot be read"),
        ("setting", ("conductance = 5000.0", "conduction = 5000.0"), CouplingError,
         "no variable 'conduction'"),
        ("twice", ('parameters = { conductance = 5000.0 }',
                   'parameters = { conductance = 5000.0, "conductance[{1..1}]" = 1.0 }'), CouplingError,
         "no variable 'conductance"),
        ("loop", ('source = "flow"', 'source = "exchanger.heat"'), AlgebraicLoopError,
         "close an algebraic loop"),
        ("binding", ('target = "outlet"', 'target = "exit"'), BindingError,
         "names 'outlet', which is not a variable of the system fouling"),
        ("truth", ('kind = "scripted"', 'kind = "asset"\nstate = { fouling = "heat" }'), ScenarioError,
         "leaves damage, noise and faults to the asset"),
        ("both", ('binding = "coupled.toml"', 'binding = "coupled.toml"\nfile = "x.ssp"'), ScenarioError,
         "unknown key `asset.file`"),
        ("neither", ('fmu = "HeatExchanger.fmu"\n', ""), ScenarioError, "needs one of `fmu` and `design`"),
        ("kind", ('kind = "coupled"', 'kind = "fmu"\nfile = "HeatExchanger.fmu"'), ScenarioError,
         "unknown key `asset.component`"),
        ("key", ("target = ", "to = "), ScenarioError, r"unknown key `asset\.connection\[1\]\.to`"),
        ("seeds", ("load = {", 'seeds = ["seed"]\nload = {'), MissionInputError, "parameter seed, which"),
    ):  # fmt: skip
        path = changed(folder, name, change)
        with pytest.raises(kind, match=words) as caught:
            new_run(load_scenario(path), tmp_path / name)
        assert "\n" not in str(caught.value)
    loaded = load_scenario(folder / "coupled_fouling.toml")
    (tmp_path / "bad.ssp").write_bytes(b"nothing")
    for overrides, words in (
        (Overrides(fmu=folder / "HeatExchanger.fmu"), "the scenario couples several"),
        (Overrides(ssp=tmp_path / "bad.ssp", fmu=folder / "HeatExchanger.fmu"), "give neither --fmu"),
        (Overrides(ssp=tmp_path / "none.ssp"), "none.ssp cannot be read"),
        (Overrides(ssp=tmp_path / "bad.ssp"), "not a sound SSP archive"),
    ):
        with pytest.raises((MissionInputError, SspError, FmuError), match=words):
            new_run(loaded, tmp_path / "run", overrides)
    assert [path.name for path in tmp_path.iterdir()] == ["bad.ssp"]


def test_an_asset_with_its_own_damage_needs_a_model_for_the_twin(folder: Path, tmp_path: Path) -> None:
    text = (folder / "coupled_fouling.toml").read_text(encoding="utf-8")
    text = text[: text.index("[truth]")] + '[truth]\nkind = "asset"\nstate = { fouling = "heat" }\n'
    path = folder / "own.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MissionInputError, match="name a model for the twin in the table `belief`"):
        new_run(load_scenario(path), tmp_path / "run")


def test_the_schema_of_the_truth() -> None:
    path = scenario_files()["three_fmus"]
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    for change, words in (
        ({"state": {"z1": "z1"}}, "`truth.state` must have one entry for each state"),
        ({"kind": "random_growth"}, "belong to the kind `asset`"),
        ({"kind": "random_growth", "state": {}, "observation": None, "received": None},
         "`truth.noise` is missing"),
        ({"noise": {"standard_deviation": 1e-4}}, "leaves damage, noise and faults to the asset"),
    ):  # fmt: skip
        truth = {key: value for key, value in (table["truth"] | change).items() if value is not None}
        with pytest.raises(ScenarioError, match=words):
            parse_scenario(table | {"truth": truth}, "x")


# ---------------------------------------------------------------------- with the shipped wing


def shipped(name: str, tmp_path: Path, *changes: tuple[str, str]) -> LoadedScenario:
    """Return a shipped scenario with changes, and with a calibration that costs nothing."""
    text = scenario_files()[name].read_text(encoding="utf-8")
    calibration = text[text.index("[calibration]") : text.index("[truth]")]
    text = text.replace(
        calibration, '[calibration]\nparameter = "young_modulus_factor"\nsource = "fixed"\nmean = 1.0073\n\n'
    )
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    path = tmp_path / f"{name}.toml"
    path.write_text(text, encoding="utf-8")
    return load_scenario(path)


def plant_of(loaded: LoadedScenario, folder: Path) -> Plant:
    scenario = resolve_scenario(loaded, Overrides(in_process=True))
    source = asset_source(scenario)
    source.check()
    source.prepare(folder, SilentProgress())
    truth = Truth(scenario, build_graphical_model(scenario), scenario.mission.seed)
    return Plant(scenario, truth, source.open())


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_three_fmus_live_the_script_of_a_scenario(tmp_path: Path) -> None:
    """Damage, drift and lost gauges of failing_gauges, once as its truth and once in the FMUs: to the bit."""
    script = {
        1: (10, 19, "z1", 0.02), 2: (20, 20, "z1", 0.2), 3: (30, 30, "z1", 0.2),
        4: (5, 14, "z2", 0.02), 5: (5, 5, "z2", 0.2), 6: (25, 25, "z2", 0.2),
    }  # fmt: skip
    entries = ", ".join(
        f'"script[{i}].first" = {first}.0, "script[{i}].last" = {last}.0, "script[{i}].{region}" = {gain}'
        for i, (first, last, region, gain) in script.items()
    )
    faults = (
        '"dropout_start[1]" = 28.0, "dropout_end[1]" = 1000.0, "dropout_start[{17..20}]" = 12.0, '
        '"dropout_end[{17..20}]" = 19.0, "blackout.start" = 36.0, "blackout.end" = 38.0, '
        '"drift_rate[12]" = 6e-6, "drift_start[12]" = 8.0'
    )
    split = plant_of(
        shipped(
            "three_fmus",
            tmp_path,
            ('"probability.z1" = 0.10, "probability.z2" = 0.10', entries),
            ('noise = 150e-6, "dropout_start[6]" = 20.0, "dropout_end[6]" = 30.0', faults),
        ),
        tmp_path / "split",
    )
    single = plant_of(
        shipped(
            "failing_gauges",
            tmp_path,
            ("standard_deviation_microstrain = 150", "standard_deviation_microstrain = 0"),
        ),
        tmp_path / "single",
    )
    controls = np.random.default_rng(3).integers(2, size=50)
    for step, control in enumerate(controls):
        previous = int(controls[step - 1]) if step else None
        ours, theirs = (plant.turn(int(control), previous) for plant in (split, single))
        assert ours.happened is not None
        assert theirs.happened is not None
        np.testing.assert_array_equal(ours.observed, theirs.observed, err_msg=str(step))
        np.testing.assert_array_equal(ours.happened.state, theirs.happened.state)
        np.testing.assert_array_equal(ours.happened.observation, theirs.happened.observation)
        assert theirs.happened.monitors.items() <= ours.happened.monitors.items()
    assert theirs.happened.state.max() == 0.6


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_the_shipped_scenario_in_process_in_workers_and_resumed(tmp_path: Path) -> None:
    loaded = shipped("three_fmus", tmp_path, ("steps = 50", "steps = 24"))
    whole = new_run(loaded, tmp_path / "whole").folder
    inside = new_run(loaded, tmp_path / "inside", Overrides(in_process=True)).folder
    assert rows(inside) == rows(whole)
    with cut_off_after(9):
        new_run(loaded, tmp_path / "part")
    resume_run(tmp_path / "part")
    check_same(tmp_path / "part", whole, "run.nc", "config.json", "summary.json", "journal.jsonl")
    scenarios = [resolve_scenario(loaded, Overrides(seed=seed)) for seed in (7, 8)]
    drawn = [scenario.asset.source(scenario).parameters() for scenario in scenarios]
    assert all(drawn[0][name] != drawn[1][name] for name in ("damage_seed", "gauge_seed"))
    received = np.genfromtxt(whole / "csv" / "observed.csv", delimiter=",", skip_header=1)[:, 6]
    assert np.flatnonzero(np.isnan(received)).tolist() == [20, 21, 22, 23]  # the sixth gauge is lost
    ssp = export_scenario(loaded, tmp_path / "x.ssp", replace_file=False, progress=SilentProgress())
    assert rows(new_run(loaded, tmp_path / "ssp", Overrides(ssp=ssp)).folder) == rows(whole)


def test_many_lives_of_an_asset_with_its_own_damage_are_refused(tmp_path: Path) -> None:
    fleet = ensemble("three_fmus", range(3))
    (group,) = fleet.groups
    (scenario,) = group.scenarios
    seedless = scenario.model_copy(update={"asset": scenario.asset.model_copy(update={"seeds": ()})})
    with pytest.raises(FleetError, match="every seed would fly the same life"):
        fly_fleet(replace(fleet, groups=(replace(group, scenarios=(seedless,)),)), tmp_path / "fleet")


def test_the_law_of_the_shipped_damage_is_what_the_twin_believes() -> None:
    scenario = load_scenario("three_fmus").scenario
    (damage, *_) = scenario.asset.component
    values = damage.parameters
    for control in scenario.control:
        severity = (control.values["load_factor"] / values["reference_load_factor"]) ** values["exponent"]
        for region in ("z1", "z2"):
            assert values[f"probability.{region}"] * severity == pytest.approx(
                scenario.transition.probability[control.name], rel=1e-12
            )
    assert {factor.levels[1] - factor.levels[0] for factor in scenario.state} == {values["level"]}
    binding = load_binding(binding_files()["three_fmus"])
    assert binding.step_size == 1.0
