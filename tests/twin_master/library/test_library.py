"""Observation libraries: sampled from an FMU, and believed; the mission of a pump against its equations."""

import copy
import json
import math
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.optimize import brentq

from calibration.result.file import result_bytes
from calibration.result.record import Calibration, ParameterPrior
from fmu_asset.errors import FmuCallError, FmuTimeoutError, FmuWorkerError
from fmu_asset.packing.script import build_script_fmu
from reporting.arrays import Float
from reporting.progress import SilentProgress
from scenarios import asset_scripts
from scenarios.assets.gear_pump import Conditions, steady_temperature
from tests.kept import ROOT
from tests.refusals import Inputs, refused
from tests.twin_master.runs import check_same, cut_off_after, loaded_from, merged, table_of, written
from twin_master.assets.library_source import load_observation_library
from twin_master.assets.resolution import Overrides, asset_source
from twin_master.errors import MissionInputError
from twin_master.library.grid import SamplingGrid, grid_of_fmu, grid_of_scenario
from twin_master.library.sampling import blocks_folder, sample_library
from twin_master.network.inference import known_control
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from uav_twin import fly, load_scenario, prepare_twin, resume

FINE, LAG, COUNT, DIE, SLEEP, REFUSE, SLOW = (float(mode) for mode in range(7))
WEAR, GAIN, PUSH = (0.0, 0.25, 0.5), (0.9, 1.0, 1.1), (2.0, 4.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("wayward")
    fmu = build_script_fmu(Path(__file__).with_name("wayward.py"), folder / "wayward.fmu").path
    return fmu, Inputs(__file__).folder / "wayward.toml"


def grid(files: tuple[Path, Path], mode: float = FINE, **changes: object) -> SamplingGrid:
    texts = ["wear=0,0.25,0.5", "gain=0.9,1.0,1.1", "push=2,4", f"mode={mode}"]
    return replace(grid_of_fmu(*files, texts), **changes)  # type: ignore[arg-type]


def finished(out: Path) -> int:
    """Points of a library that is being sampled whose observations are on disk."""
    try:
        return int(np.isfinite(np.load(blocks_folder(out) / "observations.npy", mmap_mode="r")[:, 0]).sum())
    except (OSError, ValueError):
        return 0


def test_the_library_holds_what_the_formula_says_with_names_and_units(files, tmp_path):
    outcome = sample_library(grid(files), tmp_path / "lever.nc", workers=1)
    expected = np.array([[[g * p / (1.0 + w) for p in PUSH] for w in WEAR] for g in GAIN])
    np.testing.assert_allclose(outcome.library.values[..., 0], expected, rtol=1e-15)
    np.testing.assert_allclose(outcome.library.values[..., 1], 2e3 * expected, rtol=1e-15)
    assert not blocks_folder(outcome.path).exists()
    with xr.open_dataset(outcome.path, engine="h5netcdf") as stored:
        assert stored["observation"].dims == ("draw", "wear", "control", "sensor")
        assert stored["wear"].attrs["units"] == "1"
        assert list(stored["sensor"].values) == ["shown", "double"]
        assert list(stored["sensor_unit"].values) == ["m", "mm"]
        assert stored["control_push"].attrs["units"] == "N"
        assert float(stored["observation"].sel(wear=0.25)[1, 1, 0]) == 3.2
    read = load_observation_library(outcome.path)
    np.testing.assert_array_equal(read.values, outcome.library.values)
    assert (read.parameter, read.draws.tolist(), read.controls) == (
        "gain", list(GAIN), ("push = 2, mode = 0", "push = 4, mode = 0"),
    )  # fmt: skip


def test_what_an_interrupted_sampling_finished_is_kept(files, tmp_path, request):
    """Interrupted, resumed, and killed. What a shell starts in the background would ignore SIGINT."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, former))
    slow = grid(files, SLOW, draws=tuple(np.linspace(0.8, 1.2, 20)))
    whole = sample_library(slow, tmp_path / "whole.nc", workers=1)
    fmu, binding = files
    out = tmp_path / "part.nc"
    command = [sys.executable, "-m", "uav_twin", "library", "sample", "--quiet", "--workers", "1"]
    command += ["--fmu", str(fmu), "--binding", str(binding), "--out", str(out), "--grid", "wear=0,0.25,0.5"]
    command += ["--grid", "gain=0.8:1.2:20", "--grid", "push=2,4", "--grid", f"mode={SLOW}"]
    for wanted, end, more in ((5, signal.SIGINT, []), (10, signal.SIGKILL, ["--resume"])):
        process = subprocess.Popen([*command, *more], cwd=ROOT, stderr=subprocess.PIPE)
        while finished(out) < 2 * wanted and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(end)
        words = process.communicate()[1].decode()
        if end == signal.SIGINT:
            assert process.returncode == 130
            assert words.startswith("Interrupted; finished blocks are kept")
            assert "Traceback" not in words
    assert not out.exists()
    with pytest.raises(MissionInputError, match=r"part\.nc\.blocks holds the finished blocks"):
        sample_library(slow, out)
    with pytest.raises(MissionInputError, match=r"another FMU, binding, grid .*\(draws\)"):
        sample_library(grid(files, SLOW), out, resume=True)
    outcome = sample_library(slow, out, workers=1, resume=True)
    assert wanted <= outcome.kept_blocks < outcome.block_count
    assert out.read_bytes() == whole.path.read_bytes()


def test_what_is_damaged_is_sampled_again(files, tmp_path, monkeypatch):
    """To the same bytes, whatever the number of processes."""
    some = grid(files, draws=tuple(np.linspace(0.8, 1.2, 30)))  # in blocks of three points
    whole = sample_library(some, tmp_path / "whole.nc", workers=2)

    def full_disk(*_: object) -> None:
        raise KeyboardInterrupt

    for out in (tmp_path / "block.nc", tmp_path / "file.nc"):
        with monkeypatch.context() as patch:
            patch.setattr("twin_master.library.sampling.write_observation_library", full_disk)
            with pytest.raises(KeyboardInterrupt):
                sample_library(some, out, workers=1)
        kept = blocks_folder(out) / "observations.npy"
        if out.stem == "block":
            np.load(kept, mmap_mode="r+")[3] = np.nan
        else:
            kept.write_bytes(kept.read_bytes()[:-8])
        outcome = sample_library(some, out, workers=1, resume=True)
        again = outcome.block_count - outcome.kept_blocks
        assert again == (1 if out.stem == "block" else outcome.block_count)
        assert out.read_bytes() == whole.path.read_bytes()


def test_an_fmu_that_remembers_is_refused_and_sampled_from_a_fresh_start(files, tmp_path):
    for mode in (LAG, COUNT):
        with pytest.raises(MissionInputError, match=r"remembers earlier steps: at wear = .*--settle"):
            sample_library(grid(files, mode), tmp_path / "lever.nc", workers=1, replace_existing=True)
    early = grid(files, LAG, settling_steps=3)
    with pytest.raises(MissionInputError, match="has not settled after 3 steps"):
        sample_library(early, tmp_path / "lever.nc", workers=1, replace_existing=True)
    lagging = grid(files, LAG, settling_steps=40)
    settled = sample_library(lagging, tmp_path / "lever.nc", workers=1, replace_existing=True)
    exact = sample_library(grid(files), tmp_path / "exact.nc", workers=1)
    np.testing.assert_allclose(settled.library.values, exact.library.values, rtol=1e-11)
    assert settled.library.settling_steps == 40


def test_a_refused_point_a_crash_and_a_hanging_fmu_are_one_sentence_each(files, tmp_path):
    out = tmp_path / "lever.nc"
    with pytest.raises(
        FmuCallError, match=r"at wear = 0\.5, control push = [24], mode = 5, gain = 0\.9: .*Discard"
    ):
        sample_library(grid(files, REFUSE), out, workers=2)
    # What came before is kept, so that the user can mend the FMU's surroundings and go on.
    assert finished(out)
    with pytest.raises(FmuWorkerError, match=r"at or soon after wear = .*ended by signal 6 \(SIGABRT\)"):
        sample_library(grid(files, DIE), out, workers=1, replace_existing=True)
    with pytest.raises(FmuTimeoutError, match=r"longer than 5 s for a step"):
        sample_library(grid(files, SLEEP, step_timeout=5.0), out, workers=1, replace_existing=True)
    assert not out.exists()


def test_what_does_not_fit_is_named_before_anything_is_started(files, tmp_path):
    out = tmp_path / "lever.nc"
    for changes, words in Inputs(__file__).refused("grids"):
        with pytest.raises(MissionInputError, match=words):
            sample_library(grid(files, **changes), out, workers=1)
    with pytest.raises(MissionInputError, match="suffix"):
        sample_library(grid(files), tmp_path / "lever.csv", workers=1)
    with pytest.raises(MissionInputError, match="at least 1"):
        sample_library(grid(files), out, workers=0)
    out.write_bytes(b"a library")
    with pytest.raises(MissionInputError, match="exists"):
        sample_library(grid(files), out, workers=1)
    assert [path.name for path in tmp_path.iterdir()] == ["lever.nc"]


pytestmark = pytest.mark.usefixtures("no_report")
INPUTS = Inputs(__file__)


PUMP = merged(table_of("pump_wear"), INPUTS.table("small_pump.toml"))
SMALL = loaded_from(PUMP, "pump_wear")


def changed(key: str, entry: object) -> LoadedScenario:
    """Return the small mission with another entry at a key such as `state.0.unit`."""
    table = copy.deepcopy(PUMP)
    *path, last = key.split(".")
    node: Any = table
    for part in path:
        node = node[int(part)] if part.isdigit() else node[part]
    node[last] = entry
    return loaded_from(table, "pump_wear")


def sampled(folder: Path, *grid: str) -> Path:
    """Sample the FMU of the small mission."""
    found = grid_of_scenario(SMALL, folder / "made", [*grid])
    return sample_library(found, folder / "pump.nc", workers=1).path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sampled(tmp_path_factory.mktemp("library"), "viscosity_factor=0.9:1.1:21")


def test_a_run_with_a_library_keeps_it_and_can_be_resumed(made, tmp_path):
    path = Path(shutil.copy(made, tmp_path / "pump.nc"))
    library = load_observation_library(path)
    between = library.observations_at("viscosity_factor", np.array([0.955]))[0]
    np.testing.assert_allclose(between, 0.5 * (library.values[5] + library.values[6]), rtol=1e-14)
    whole = fly(SMALL, tmp_path / "whole", Overrides(library=path))
    assert not whole.origin.differ
    assert whole.origin.model == "observation library of it"
    config = json.loads((tmp_path / "whole" / "config.json").read_text())
    assert config["scenario"]["belief"]["file"] == "asset/observation_library.nc"
    assert config["scenario"]["asset"]["kind"] == "fmu"
    assert set(config["inputs"]) == {"binding", "fmu", "observation_library"}
    part = tmp_path / "part"
    with cut_off_after(3):
        fly(SMALL, part, Overrides(library=path))
    path.unlink()
    resume(part)
    check_same(part, whole.folder, "run.nc", "summary.json", "csv/health.csv")


def test_a_library_of_another_fmu_is_flown_with_a_notice(made, tmp_path):
    script = tmp_path / "gear_pump.py"
    text = asset_scripts()["gear_pump"].read_text(encoding="utf-8")
    script.write_text(text.replace("COOLING = 250.0", "COOLING = 200.0"))
    fmu = build_script_fmu(script, tmp_path / "other.fmu").path
    outcome = fly(SMALL, tmp_path / "run", Overrides(library=made, fmu=fmu))
    assert outcome.origin.differ
    assert outcome.origin.model == "observation library of another FMU"
    (misfit,) = (figure.value for figure in outcome.figures if figure.key == "model_misfit_largest")
    assert misfit > 1.0  # percent: it is hotter with less cooling
    assert json.loads((outcome.folder / "summary.json").read_text())["asset_and_model_differ"] is True


@pytest.mark.parametrize(("key", "entry", "words"), INPUTS.refused("library"))
def test_what_a_library_lacks_is_named(made, tmp_path, key, entry, words):
    with pytest.raises(MissionInputError, match=words):
        fly(changed(key, entry), tmp_path / "run", Overrides(library=made))


def test_files_that_are_no_library_are_refused(made, library_file, tmp_path):
    """Also one with a number that is none; and a scenario without an FMU cannot be sampled."""
    (tmp_path / "noise.nc").write_bytes(b"no NetCDF at all")
    xr.Dataset({"x": 1.0}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with xr.open_dataset(made, engine="h5netcdf") as opened, xr.set_options(keep_attrs=True):
        for name in ("observation", "control_speed", "wear"):
            wrong = opened.drop_vars(name).assign({name: opened[name].variable.to_base_variable() * np.nan})
            wrong.to_netcdf(tmp_path / f"{name}.nc", engine="h5netcdf")
    for name, words in (
        ("missing", "there is no observation library"), ("noise", "not a whole NetCDF"),
        ("other", "not an observation library of this version"),
        ("observation", "finite"), ("control_speed", "finite"), ("wear", "finite"),
    ):  # fmt: skip
        with refused(MissionInputError, words):
            load_observation_library(tmp_path / f"{name}.nc")
    given = Overrides(strain_library=library_file)
    with pytest.raises(MissionInputError, match="kind `strain_library`, and one FMU can be"):
        grid_of_scenario(load_scenario("level_turns"), tmp_path, overrides=given)


# ---------------------------------------------------------------- physics and probabilities anew

LEVELS = {"wear": (0.0, 0.3, 0.6), "clogging": (0.0, 0.6)}
CONTROLS = {"eco": (1000.0, 100.0), "normal": (1500.0, 140.0), "boost": (1800.0, 180.0)}
WORSENING = {"eco": (0.02, 0.04), "normal": (0.04, 0.06), "boost": (0.08, 0.08)}
NOISE = np.array([0.4, 0.5, 0.6, 0.15])


def show(control: str, wear: float, clogging: float, viscosity: float) -> Float:
    """Flow, torque, temperature and filter pressure drop, as in docs/how_to/another_asset.md."""
    displacement = 16e-6 / (2 * math.pi)
    speed, load = 2 * math.pi * CONTROLS[control][0] / 60, 1e5 * CONTROLS[control][1]

    def at(temperature: float) -> tuple[float, float, float]:
        mu = viscosity * 870 * 46e-6 * (6.8 / 46) ** ((temperature - 40) / 60)
        conductance = 1.52e-8 * displacement * (1 + wear) ** 3 / mu

        def balance(flow: float) -> float:
            drop = mu * 9e9 * flow / (1 - clogging)
            return displacement * speed - conductance * (load + drop) - flow

        flow = brentq(balance, -1e-1, 1e-1, xtol=1e-18)
        drop = mu * 9e9 * flow / (1 - clogging)
        return flow, drop, displacement * ((load + drop) * 1.05 + 1e5 * mu * speed)

    def surplus(temperature: float) -> float:
        flow, _, torque = at(temperature)
        return torque * speed - load * flow - 250 * (temperature - 40)

    temperature = brentq(surplus, 40, 120, xtol=1e-12)
    flow, drop, torque = at(temperature)
    return np.array([6e4 * flow, torque, temperature, 1e-5 * drop])


def move(control: str, before: dict[str, float], after: dict[str, float]) -> float:
    """Probability that each factor stays or worsens by one level; the last level is kept."""
    result = 1.0
    for (name, levels), worse in zip(LEVELS.items(), WORSENING[control], strict=True):
        a, b = levels.index(before[name]), levels.index(after[name])
        up = worse if a < len(levels) - 1 else 0.0
        result *= {0: 1.0 - up, 1: up}.get(b - a, 0.0)
    return result


@pytest.mark.parametrize("believed", ["asset", "library"])
def test_what_the_twin_knows_is_what_the_equations_say(believed, tmp_path):
    """What all sensors show by draw, state and control; moves; the worth of the sensors that have a limit.

    In a library names and order of states and controls do not matter.
    """
    table, given = copy.deepcopy(PUMP), Overrides()
    if believed == "library":
        given = Overrides(library=sampled(tmp_path))
        table["state"].reverse()
        table["control"].reverse()
    known = prepare_twin(loaded_from(table, "pump_wear"), given)
    controls, draws, names = known.model.controls, known.draws.values, known.model.states.names
    states = [dict(zip(names, row, strict=True)) for row in known.model.states.coordinates.tolist()]
    shown = np.array([[[show(u, **state, viscosity=e) for u in controls] for state in states] for e in draws])
    np.testing.assert_allclose(known.sensor_model.value_per_draw, shown, rtol=1e-7)
    np.testing.assert_array_equal(known.sensor_model.standard_deviation, NOISE)
    matrix = [[[move(u, a, b) for b in states] for a in states] for u in controls]
    np.testing.assert_allclose(known.model.transition.matrix, matrix, atol=1e-15)
    health = 1.0 - np.maximum(shown[..., 2] / 50.0, shown[..., 3] / 5.0)
    np.testing.assert_allclose(known.rewards.health_per_draw, health, rtol=1e-7)
    seen = shown[0, 0, 1] + [np.nan, 0.2, 0.3, -0.1]  # a lost sensor says nothing
    believes = known_control(np.eye(len(states))[4], 1, len(controls))
    error = np.nanmean(-np.abs(seen - shown[:, 4, 1]) / NOISE, axis=1).mean()
    found, _ = known.rewards.expectation(believes, seen)
    assert (found[0], found[2]) == pytest.approx((health[:, 4, 1].mean(), error), rel=1e-7)
    # Where the cooler cannot hold the oil there is no steady operation.
    assert math.isnan(steady_temperature(Conditions(2500.0 * math.pi / 30.0, 210e5, 1.0, 0.0, 1.0)))


@pytest.mark.parametrize("way", ["asset", "library", "swept", "learnt"])
def test_what_was_calibrated_beside_the_parameter_follows_its_draws(heat_exchanger, tmp_path, way):
    """By the formula of the heat exchanger and a regression; in the asset all else is at its mean."""
    folder = Path(shutil.copytree(heat_exchanger, tmp_path / "system"))
    with (folder / "binding.toml").open("a") as binding:
        binding.write('[parameter.specific_heat]\nvariable = "specific_heat"\nunit = "J/(kg.K)"\n')
    one, two = np.random.default_rng(3).standard_normal((2, 400))
    samples = np.column_stack([6000.0 + 80.0 * one, 4186.0 + 120.0 * one + 20.0 * two])
    named = [("conductance", "W/K", 6e3), ("specific_heat", "J/(kg.K)", 4e3)]
    priors = tuple(ParameterPrior(*row, 600.0, 1e3, 9e3, "model.toml") for row in named)
    told = ("exchanger 7", "exchanger", "0" * 64, "Gaussian", priors, samples, samples)
    (tmp_path / "c.nc").write_bytes(result_bytes(Calibration(*told, None, (), (), "test", 1, {})))
    loaded, given = load_scenario(folder / "fouling.toml"), Overrides(calibration=tmp_path / "c.nc")
    if way in ("library", "swept"):
        grid = ["conductance=5600:6400:17"] if way == "swept" else []
        asked = grid_of_scenario(loaded, tmp_path / "made", grid, overrides=given)
        given = replace(given, library=sample_library(asked, tmp_path / "l.nc", workers=1).path)
    elif way == "learnt":
        text = 'format = 1\n[calibration]\nparameter = "conductance"\nmean = 6100\nstandard_deviation = 30\n'
        given = replace(given, learnt=written(tmp_path, text))
    known, (slope, offset) = prepare_twin(loaded, given), np.polyfit(*samples.T, 1)
    assert ("the observation library is interpolated" in known.draws.source) is (way == "swept")
    assert known.draws.mean == pytest.approx(6100.0 if way == "learnt" else samples[:, 0].mean())
    flown = known.scenario.asset.source(known.scenario).parameters()
    assert flown == {"conductance": 6100.0, "specific_heat": pytest.approx(samples[:, 1].mean())}
    for true, of in ((4000.0, "under other parameters"), (samples[:, 1].mean(), "")) * (way == "library"):
        table = merged(known.scenario.to_dict(), {"asset": {"parameters": {"specific_heat": float(true)}}})
        source = asset_source(parse_scenario(table, "exchanger"))
        source.prepare(tmp_path / f"{true:g}", SilentProgress())
        assert source.origin.model == f"observation library of it {of}".strip()
        assert source.origin.differ == bool(of)
    axes = known.draws.values, [0, 1e-4, 2e-4, 3e-4], [0.5, 0.8, 1.2]
    draw, fouling, flow = np.meshgrid(*axes, indexing="ij")
    passed = draw / (1.0 + fouling * draw) / ((slope * draw + offset) * flow)
    shown = 20.0 + 60.0 * (1.0 - np.exp(-np.stack([0.5 * passed, passed], axis=-1)))
    np.testing.assert_allclose(known.predicted, shown, rtol=1e-4 if way == "swept" else 1e-12)
