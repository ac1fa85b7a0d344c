"""Observation libraries: sampled from an FMU, and believed; the mission of a pump against its equations."""

import copy
import json
import math
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
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
from tests.fmu_asset.making import limit_call_without_answer
from tests.kept import ROOT
from tests.refusals import Inputs, refused
from tests.twin_master.runs import check_same, cut_off_after, loaded_from, merged, table_of, written
from twin_master.assets.library_source import load_observation_library
from twin_master.assets.resolution import Overrides, asset_source
from twin_master.errors import MissionInputError
from twin_master.library.grid import SamplingGrid, grid_of_fmu, grid_of_scenario
from twin_master.library.sampling import blocks_folder, sample_library
from twin_master.mission.preparation import Knowledge
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


@pytest.fixture(scope="module")
def lever(files: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A library that was sampled from the FMU of a lever."""
    return sample_library(grid(files), tmp_path_factory.mktemp("lever") / "lever.nc", workers=1)


def test_the_library_holds_what_the_formula_says(lever):
    expected = np.array([[[g * p / (1.0 + w) for p in PUSH] for w in WEAR] for g in GAIN])
    np.testing.assert_allclose(lever.library.values[..., 0], expected, rtol=1e-15)
    np.testing.assert_allclose(lever.library.values[..., 1], 2e3 * expected, rtol=1e-15)
    assert not blocks_folder(lever.path).exists()


def test_the_file_of_a_library_has_names_of_axes_and_sensors(lever):
    with xr.open_dataset(lever.path, engine="h5netcdf") as stored:
        assert stored["observation"].dims == ("draw", "wear", "control", "sensor")
        assert list(stored["sensor"].values) == ["shown", "double"]
        assert float(stored["observation"].sel(wear=0.25)[1, 1, 0]) == 3.2


def test_the_file_of_a_library_has_units(lever):
    with xr.open_dataset(lever.path, engine="h5netcdf") as stored:
        assert stored["wear"].attrs["units"] == "1"
        assert list(stored["sensor_unit"].values) == ["m", "mm"]
        assert stored["control_push"].attrs["units"] == "N"


def test_the_file_of_a_library_reads_back(lever):
    library = load_observation_library(lever.path)
    np.testing.assert_array_equal(library.values, lever.library.values)
    assert (library.parameter, library.draws.tolist()) == ("gain", list(GAIN))
    assert library.controls == ("push = 2, mode = 0", "push = 4, mode = 0")


class InterruptedSampling:
    """A library whose sampling was interrupted after five points, resumed, and killed after ten."""

    FINISHED_AT_KILL = 10

    def __init__(self, files: tuple[Path, Path], folder: Path) -> None:
        fmu, binding = files
        self.out = folder / "part.nc"
        self.grid = grid(files, SLOW, draws=tuple(np.linspace(0.8, 1.2, 20)))
        self.words = [sys.executable, "-m", "uav_twin", "library", "sample", "--quiet", "--workers", "1"]
        self.words += ["--fmu", str(fmu), "--binding", str(binding), "--out", str(self.out)]
        for axis in ("wear=0,0.25,0.5", "gain=0.8:1.2:20", "push=2,4", f"mode={SLOW}"):
            self.words += ["--grid", axis]
        self.code, self.sentence = self.stop_at(5, signal.SIGINT)
        self.stop_at(self.FINISHED_AT_KILL, signal.SIGKILL, "--resume")

    def stop_at(self, points: int, end: signal.Signals, *options: str) -> tuple[int, str]:
        """Sample until so many points are finished; return exit code and what was said."""
        with subprocess.Popen([*self.words, *options], cwd=ROOT, stderr=subprocess.PIPE) as process:
            try:
                while finished(self.out) < 2 * points and process.poll() is None:
                    time.sleep(0.01)
                process.send_signal(end)
                complaint = process.communicate()[1].decode()
            finally:
                process.kill()
        return process.returncode, complaint


@pytest.fixture(scope="module")
def interrupted_sampling(
    files: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> InterruptedSampling:
    """What a shell starts in the background would ignore SIGINT."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return InterruptedSampling(files, tmp_path_factory.mktemp("interrupted"))
    finally:
        signal.signal(signal.SIGINT, former)


def test_an_interrupted_sampling_ends_with_a_sentence(interrupted_sampling):
    assert interrupted_sampling.code == 130
    assert interrupted_sampling.sentence.startswith("Interrupted; finished blocks are kept")
    assert "Traceback" not in interrupted_sampling.sentence


def test_finished_blocks_are_resumed_only_on_demand_and_for_the_same_grid(interrupted_sampling, files):
    out = interrupted_sampling.out
    with pytest.raises(MissionInputError, match=r"part\.nc\.blocks holds the finished blocks"):
        sample_library(interrupted_sampling.grid, out)
    with pytest.raises(MissionInputError, match=r"another FMU, binding, grid .*\(draws\)"):
        sample_library(grid(files, SLOW), out, resume=True)
    assert not out.exists()


def test_what_an_interrupted_sampling_finished_is_kept(interrupted_sampling, tmp_path):
    sampling = interrupted_sampling
    whole = sample_library(sampling.grid, tmp_path / "whole.nc", workers=1)
    outcome = sample_library(sampling.grid, sampling.out, workers=1, resume=True)
    assert sampling.FINISHED_AT_KILL <= outcome.kept_blocks < outcome.block_count
    assert sampling.out.read_bytes() == whole.path.read_bytes()


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


def test_a_refused_point_a_crash_and_a_hanging_fmu_are_one_sentence_each(files, tmp_path, monkeypatch):
    out = tmp_path / "lever.nc"
    with pytest.raises(
        FmuCallError, match=r"at wear = 0\.5, control push = [24], mode = 5, gain = 0\.9: .*Discard"
    ):
        sample_library(grid(files, REFUSE), out, workers=2)
    # What came before is kept, so that the user can mend the FMU's surroundings and go on.
    assert finished(out)
    with pytest.raises(FmuWorkerError, match=r"at or soon after wear = .*ended by signal 6 \(SIGABRT\)"):
        sample_library(grid(files, DIE), out, workers=1, replace_existing=True)
    limit_call_without_answer(monkeypatch, "run")
    with pytest.raises(FmuTimeoutError, match=r"longer than 2 s for a step"):
        sample_library(grid(files, SLEEP), out, workers=1, replace_existing=True)
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


def test_between_its_draws_a_library_is_interpolated(made):
    library = load_observation_library(made)
    between = library.observations_at("viscosity_factor", np.array([0.955]))[0]
    np.testing.assert_allclose(between, 0.5 * (library.values[5] + library.values[6]), rtol=1e-14)


@pytest.fixture(scope="module")
def run_with_library(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A run that believes the library."""
    return fly(SMALL, tmp_path_factory.mktemp("with_library") / "whole", Overrides(library=made))


def test_a_run_with_a_library_says_what_is_believed(run_with_library):
    assert not run_with_library.origin.differ
    assert run_with_library.origin.model == "observation library of it"


def test_a_run_with_a_library_keeps_it(run_with_library):
    config = json.loads((run_with_library.folder / "config.json").read_text())
    assert config["scenario"]["belief"]["file"] == "asset/observation_library.nc"
    assert config["scenario"]["asset"]["kind"] == "fmu"
    assert set(config["inputs"]) == {"binding", "fmu", "observation_library"}


def test_a_run_whose_library_is_gone_is_resumed(run_with_library, made, tmp_path):
    library = Path(shutil.copy(made, tmp_path / "pump.nc"))
    part = tmp_path / "part"
    with cut_off_after(3):
        fly(SMALL, part, Overrides(library=library))
    library.unlink()
    resume(part)
    check_same(part, run_with_library.folder, "run.nc", "summary.json", "csv/health.csv")


@pytest.fixture(scope="module")
def run_of_hotter_pump(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A run of a pump with less cooling than that whose library is believed."""
    folder = tmp_path_factory.mktemp("hotter")
    script = folder / "gear_pump.py"
    text = asset_scripts()["gear_pump"].read_text(encoding="utf-8")
    script.write_text(text.replace("COOLING = 250.0", "COOLING = 200.0"))
    fmu = build_script_fmu(script, folder / "other.fmu").path
    return fly(SMALL, folder / "run", Overrides(library=made, fmu=fmu))


def test_a_library_of_another_fmu_is_flown_with_a_notice(run_of_hotter_pump):
    summary = json.loads((run_of_hotter_pump.folder / "summary.json").read_text())
    assert run_of_hotter_pump.origin.differ
    assert run_of_hotter_pump.origin.model == "observation library of another FMU"
    assert summary["asset_and_model_differ"] is True


def test_the_misfit_of_a_library_of_another_fmu_is_a_figure(run_of_hotter_pump):
    """In percent of the reading."""
    figures = {figure.key: figure.value for figure in run_of_hotter_pump.figures}
    assert figures["model_misfit_largest"] > 1.0


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


@dataclass(frozen=True)
class PumpKnowledge:
    """What a twin of the pump knows, beside the equations of its sensors by draw, state and control."""

    twin: Knowledge
    states: list[dict[str, float]]
    observations: Float

    @property
    def health(self) -> Float:
        """Return the health by draw, state and control: temperature and filter have limits."""
        _, _, temperature, filter_drop = np.moveaxis(self.observations, -1, 0)
        return 1.0 - np.maximum(temperature / 50.0, filter_drop / 5.0)


@pytest.fixture(scope="module", params=["asset", "library"])
def pump(request, tmp_path_factory) -> PumpKnowledge:
    """The knowledge from the asset, or from a library.

    In a library names and order of states and controls do not matter.
    """
    table = copy.deepcopy(PUMP)
    overrides = Overrides()
    if request.param == "library":
        overrides = Overrides(library=sampled(tmp_path_factory.mktemp("pump")))
        table["state"].reverse()
        table["control"].reverse()
    twin = prepare_twin(loaded_from(table, "pump_wear"), overrides)
    names = twin.model.states.names
    states = [dict(zip(names, row, strict=True)) for row in twin.model.states.coordinates.tolist()]
    observations = [
        [[show(control, **state, viscosity=draw) for control in twin.model.controls] for state in states]
        for draw in twin.draws.values
    ]
    return PumpKnowledge(twin, states, np.array(observations))


def test_what_sensors_show_is_what_the_equations_say(pump):
    sensors = pump.twin.sensor_model
    np.testing.assert_allclose(sensors.value_per_draw, pump.observations, rtol=1e-7)
    np.testing.assert_array_equal(sensors.standard_deviation, NOISE)


def test_transitions_are_what_the_equations_say(pump):
    expected = [
        [[move(control, before, after) for after in pump.states] for before in pump.states]
        for control in pump.twin.model.controls
    ]
    np.testing.assert_allclose(pump.twin.model.transition.matrix, expected, atol=1e-15)


def test_health_is_what_the_equations_say_of_the_sensors_that_have_a_limit(pump):
    np.testing.assert_allclose(pump.twin.rewards.health_per_draw, pump.health, rtol=1e-7)


def test_rewards_are_those_of_health_and_of_the_error_of_what_is_seen(pump):
    """A lost sensor says nothing."""
    state, control = 4, 1
    observation = pump.observations[0, 0, control] + [np.nan, 0.2, 0.3, -0.1]
    belief = known_control(np.eye(len(pump.states))[state], control, len(pump.twin.model.controls))
    rewards, _ = pump.twin.rewards.expectation(belief, observation)
    standardised = np.abs(observation - pump.observations[:, state, control]) / NOISE
    error = -np.nanmean(standardised, axis=1).mean()
    health = pump.health[:, state, control].mean()
    assert (rewards[0], rewards[2]) == pytest.approx((health, error), rel=1e-7)


def test_where_the_cooler_cannot_hold_the_oil_there_is_no_steady_operation():
    speed = 2500.0 * math.pi / 30.0
    assert math.isnan(steady_temperature(Conditions(speed, 210e5, 1.0, 0.0, 1.0)))


class CalibratedExchanger:
    """A heat exchanger whose conductance and specific heat were calibrated, and a mission that believes it.

    What is believed is the asset itself, a library at the samples, a library over a sweep of the
    conductance, or the asset with a conductance that a fleet learnt.
    """

    def __init__(self, exchanger: Path, folder: Path, way: str) -> None:
        system = Path(shutil.copytree(exchanger, folder / "system"))
        with (system / "binding.toml").open("a") as binding:
            binding.write('[parameter.specific_heat]\nvariable = "specific_heat"\nunit = "J/(kg.K)"\n')
        self.way = way
        self.samples = self.draw_samples()
        self.overrides = Overrides(calibration=self.write_calibration(folder))
        loaded = load_scenario(system / "fouling.toml")
        if way in ("library", "swept"):
            axes = ["conductance=5600:6400:17"] if way == "swept" else []
            asked = grid_of_scenario(loaded, folder / "made", axes, overrides=self.overrides)
            library = sample_library(asked, folder / "l.nc", workers=1).path
            self.overrides = replace(self.overrides, library=library)
        elif way == "learnt":
            text = "format = 1\n[calibration]\n"
            text += 'parameter = "conductance"\nmean = 6100\nstandard_deviation = 30\n'
            self.overrides = replace(self.overrides, learnt=written(folder, text))
        self.known = prepare_twin(loaded, self.overrides)

    def draw_samples(self) -> Float:
        """Return samples of conductance and specific heat, which depend on each other."""
        one, two = np.random.default_rng(3).standard_normal((2, 400))
        return np.column_stack([6000.0 + 80.0 * one, 4186.0 + 120.0 * one + 20.0 * two])

    def write_calibration(self, folder: Path) -> Path:
        rows = [("conductance", "W/K", 6e3), ("specific_heat", "J/(kg.K)", 4e3)]
        priors = tuple(ParameterPrior(*row, 600.0, 1e3, 9e3, "model.toml") for row in rows)
        about = ("exchanger 7", "exchanger", "0" * 64, "Gaussian", priors, self.samples, self.samples)
        file = folder / "c.nc"
        file.write_bytes(result_bytes(Calibration(*about, None, (), (), "test", 1, {})))
        return file


@pytest.fixture(scope="module", params=["asset", "library", "swept", "learnt"])
def calibrated_exchanger(
    request: pytest.FixtureRequest, heat_exchanger: Path, tmp_path_factory: pytest.TempPathFactory
) -> CalibratedExchanger:
    return CalibratedExchanger(heat_exchanger, tmp_path_factory.mktemp(request.param), request.param)


def test_draws_of_the_parameter_say_where_they_come_from(calibrated_exchanger):
    draws, way = calibrated_exchanger.known.draws, calibrated_exchanger.way
    mean = 6100.0 if way == "learnt" else calibrated_exchanger.samples[:, 0].mean()
    is_interpolated = "the observation library is interpolated" in draws.source
    assert is_interpolated is (way == "swept")
    assert draws.mean == pytest.approx(mean)


def test_in_the_asset_all_but_the_parameter_is_at_its_mean(calibrated_exchanger):
    scenario = calibrated_exchanger.known.scenario
    specific_heat = pytest.approx(calibrated_exchanger.samples[:, 1].mean())
    parameters = scenario.asset.source(scenario).parameters()
    assert parameters == {"conductance": 6100.0, "specific_heat": specific_heat}


def test_what_was_calibrated_beside_the_parameter_follows_its_draws(calibrated_exchanger):
    """By the formula of the heat exchanger and a regression."""
    known = calibrated_exchanger.known
    slope, offset = np.polyfit(*calibrated_exchanger.samples.T, 1)
    fouling_levels, mass_flows = [0, 1e-4, 2e-4, 3e-4], [0.5, 0.8, 1.2]
    draw, fouling, flow = np.meshgrid(known.draws.values, fouling_levels, mass_flows, indexing="ij")
    specific_heat = slope * draw + offset
    transfer_units = draw / (1.0 + fouling * draw) / (specific_heat * flow)
    half_and_whole = np.stack([0.5 * transfer_units, transfer_units], axis=-1)
    expected = 20.0 + 60.0 * (1.0 - np.exp(-half_and_whole))
    tolerance = 1e-4 if calibrated_exchanger.way == "swept" else 1e-12
    np.testing.assert_allclose(known.predicted, expected, rtol=tolerance)


@pytest.mark.parametrize("calibrated_exchanger", ["library"], indirect=True)
@pytest.mark.parametrize("is_at_mean", [True, False])
def test_a_library_says_that_it_was_sampled_under_other_parameters(
    calibrated_exchanger, tmp_path, is_at_mean
):
    true_value = float(calibrated_exchanger.samples[:, 1].mean()) if is_at_mean else 4000.0
    changes = {"asset": {"parameters": {"specific_heat": true_value}}}
    table = merged(calibrated_exchanger.known.scenario.to_dict(), changes)
    source = asset_source(parse_scenario(table, "exchanger"))
    source.prepare(tmp_path / "source", SilentProgress())
    expected = "observation library of it" + ("" if is_at_mean else " under other parameters")
    assert source.origin.model == expected
    assert source.origin.differ is not is_at_mean
