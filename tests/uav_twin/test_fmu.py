"""`uav-twin fmu` and `library sample` as a user calls them."""

import csv
import json
import math
import re
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import load_binding, parse_binding
from fmu_asset.client.experiment import default_experiment
from fmu_asset.client.history_files import read_histories
from fmu_asset.client.session import FmiAsset
from fmu_asset.errors import BindingError, FmuFileError, FmuInputError
from scenarios import binding_files, scenario_files
from tests.command_line import command, refused, said
from tests.fmu_asset.making import DESCRIPTION, archive_of, members
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
ROOM = INPUTS.folder / "room.toml"


POWER = [0.0, 3.0, 1.5, 0.25]
OUTSIDE = [5.0, -3.5, 0.1, 20.0]


class SimulatedRoom:
    """A room under histories of power and outside temperature, called from Python and by the command."""

    def __init__(self, fmu: Path, folder: Path) -> None:
        self.table, self.store = folder / "out.csv", folder / "out.nc"
        inputs = folder / "inputs.csv"
        rows = [
            f"{120.0 + 60.0 * row},{power},{outside}"
            for row, (power, outside) in enumerate(zip(POWER, OUTSIDE, strict=True))
        ]
        header = "time, power, load.outside\n"
        inputs.write_text(header + "\n".join(rows) + "\n\n", encoding="utf-8")
        self.words = ("fmu", "simulate", fmu, "--binding", ROOM, "--inputs", inputs, "--out")
        self.printed = [said(*self.words, self.table), said(*self.words, self.store, "--in-process")]
        with FmiAsset(fmu, ROOM, isolated=False) as asset:
            self.observations = [
                asset.step({"power": power}, load={"outside": outside})
                for power, outside in zip(POWER, OUTSIDE, strict=True)
            ]
        self.slopes = [observation.extra["der(room.T)"] for observation in self.observations]


@pytest.fixture(scope="module")
def simulated_room(foreign_fmu, tmp_path_factory) -> SimulatedRoom:
    return SimulatedRoom(foreign_fmu("room2"), tmp_path_factory.mktemp("room"))


def test_a_simulation_counts_its_steps(simulated_room):
    assert all("4 steps to t = 360 s" in text for text in simulated_room.printed)


def test_a_table_of_outputs_has_what_python_gets(simulated_room):
    with simulated_room.table.open(encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    expected = [
        [observation.time, *observation.values.tolist(), slope]
        for observation, slope in zip(simulated_room.observations, simulated_room.slopes, strict=True)
    ]
    assert header == ["time", "room.T", "room.sensor.T", "der(room.T)"]
    assert [[float(cell) for cell in row] for row in rows] == expected


def test_a_store_of_outputs_has_the_observations_with_their_units(simulated_room):
    expected = np.array([observation.values for observation in simulated_room.observations])
    with xr.open_dataset(simulated_room.store, engine="h5netcdf", decode_times=False) as data:
        assert data["time"].values.tolist() == [180.0, 240.0, 300.0, 360.0]
        assert data["observation"].values.tobytes() == expected.tobytes()
        assert data["observation_unit"].values.tolist() == ["degC", "degC"]


def test_a_store_of_outputs_has_further_outputs_with_their_units(simulated_room):
    with xr.open_dataset(simulated_room.store, engine="h5netcdf", decode_times=False) as data:
        assert data["extra"].sel(extra_name="der(room.T)").values.tolist() == simulated_room.slopes
        assert data["extra_unit"].values.tolist() == ["K/s"]


def test_outputs_are_replaced_only_on_demand(simulated_room):
    sentence = refused(*simulated_room.words, simulated_room.store, "--in-process", code=None)
    assert "exists: choose another --out or give --replace" in sentence


GRAVITY = 3.72
RESTITUTION = 0.8
FIRST_IMPACT = math.sqrt(2.0 / GRAVITY)
SECOND_IMPACT = FIRST_IMPACT * (1.0 + 2.0 * RESTITUTION)


class FallingBall:
    """A ball that is let go from one metre; its second bounce ends the simulation."""

    def __init__(self, fmu: Path, folder: Path) -> None:
        table = folder / "ball.csv"
        self.picture = folder / "ball.png"
        parameters = ("--set", f"e={RESTITUTION}", "--set", f"g={GRAVITY}")
        options = ("--stop-time", 3, "--step-size", 0.1, *parameters, "--in-process")
        self.printed = said("fmu", "simulate", fmu, *options, "--out", table, "--plot", self.picture)
        self.rows = np.genfromtxt(table, delimiter=",", names=True)


@pytest.fixture(scope="module")
def falling_ball(foreign_fmu, tmp_path_factory) -> FallingBall:
    return FallingBall(foreign_fmu("ball2", "ENDS"), tmp_path_factory.mktemp("ball"))


def test_an_fmu_that_ends_its_simulation_is_told_to_have_ended(falling_ball):
    assert f"20 steps to t = {SECOND_IMPACT:g} s, every 0.1 s" in falling_ball.printed
    assert f"ended at t = {SECOND_IMPACT:g} s" in falling_ball.printed


def test_an_fmu_alone_follows_its_closed_form(falling_ball):
    rows = falling_ball.rows
    is_falling = rows["time"] < FIRST_IMPACT
    height = 1.0 - 0.5 * GRAVITY * rows["time"][is_falling] ** 2
    np.testing.assert_allclose(rows["h"][is_falling], height, atol=1e-4)
    assert rows[0].tolist()[:3] == (0.0, 1.0, 0.0)
    assert rows["bounces"].tolist() == [0] * 8 + [1] * 12 + [2]


def test_an_fmu_alone_is_drawn(falling_ball):
    assert falling_ball.picture.read_bytes()[:4] == b"\x89PNG"


def test_without_a_step_size_an_fmu_takes_500_steps(foreign_fmu):
    fmu = foreign_fmu("ball2", "ENDS")
    printed = said("fmu", "simulate", fmu, "--in-process", "--stop-time", 0.4)
    assert "500 steps to t = 0.4 s, every 0.0008 s" in printed


def test_an_fmu_alone_is_simulated_as_its_default_experiment_says(foreign_fmu, tmp_path):
    experiment = '<DefaultExperiment startTime="2.0" stopTime="3.0" stepSize="0.25"/><ModelVariables>'
    fmu = foreign_fmu.changed("ball2", "ball_with_experiment", ("<ModelVariables>", experiment))
    printed = said("fmu", "simulate", fmu, "--in-process", "--out", tmp_path / "ball.csv")
    rows = np.genfromtxt(tmp_path / "ball.csv", delimiter=",", names=True)
    assert "4 steps to t = 3 s" in printed
    assert rows["time"].tolist() == [2.0, 2.25, 2.5, 2.75, 3.0]
    assert rows["h"][0] == 1.0


@pytest.mark.parametrize("options", [(), ("--in-process",)], ids=["in a worker", "in process"])
def test_structural_parameters_size_the_arrays(foreign_fmu, tmp_path, options):
    """Each of four elements sums its weight times its input."""
    out = tmp_path / "x.csv"
    sized = ("--set", "n=4", "--set", "u=1,2,0,-1")
    run = ("fmu", "simulate", foreign_fmu("resize3"), "--stop-time", 3, "--step-size", 1, "--out", out)
    said(*run, *options, *sized)
    rows = np.genfromtxt(out, delimiter=",", names=True, deletechars="")
    assert rows.dtype.names == ("time", "y[1]", "y[2]", "y[3]", "y[4]", "total")
    assert rows[-1].tolist() == (3.0, 3.0, 12.0, 0.0, -12.0, 3.0)


def test_arrays_may_have_no_elements(foreign_fmu, tmp_path):
    out = tmp_path / "x.csv"
    experiment = ("--stop-time", 3, "--step-size", 1, "--in-process", "--set", "n=0")
    said("fmu", "simulate", foreign_fmu("resize3"), *experiment, "--out", out)
    assert out.read_text(encoding="utf-8").splitlines()[:3] == ["time,total", "0.0,0.0", "1.0,0.0"]


def test_a_binding_sizes_arrays_whose_columns_stand_in_any_order(foreign_fmu, tmp_path):
    """The weights are 1, 2 and 3."""
    inputs, out = tmp_path / "u.csv", tmp_path / "x.csv"
    inputs.write_text("u[2],time,u[1],u[3]\n2,0,1,3\n0,1,0,1\n", encoding="utf-8-sig")
    options = ("--binding", INPUTS.folder / "sized.toml", "--inputs", inputs, "--out", out)
    said("fmu", "simulate", foreign_fmu("resize3"), *options, "--in-process")
    rows = out.read_text(encoding="utf-8").splitlines()[1:]
    assert rows == ["1.0,1.0,4.0,9.0", "2.0,1.0,4.0,12.0"]


def test_inputs_of_an_array_without_elements_are_refused(foreign_fmu, tmp_path):
    binding, inputs = tmp_path / "b.toml", tmp_path / "u.csv"
    binding.write_text(INPUTS.text("sized.toml", ("n = 3", "n = 0")), encoding="utf-8")
    inputs.write_text("time,u\n0,1\n1,1\n", encoding="utf-8")
    options = ("--binding", binding, "--inputs", inputs, "--out", tmp_path / "x.csv", "--in-process")
    sentence = refused("fmu", "simulate", foreign_fmu("resize3"), *options)
    assert "control.u must be 0 values" in sentence


def test_structural_parameters_of_a_binding(foreign_fmu):
    """They hold after every start, in a state and for an asset beside it; some cannot be taken."""
    content = INPUTS.table("structural.toml")
    with closing(FmiAsset(foreign_fmu("resize3"), parse_binding(content))) as asset:
        for _ in range(2):
            asset.reset({"w": [1.0, 1.0, 4.0]}, control={"u": [1.0, 2.0, 3.0]})
            assert asset.step().values.tolist() == [1.0, 2.0, 12.0]
        asset.restore_state(asset.save_state())
        with asset.fork() as other:
            assert other.step(control={"u": [0.0, 0.0, 1.0]}).values.tolist() == [1.0, 2.0, 16.0]
        with pytest.raises(FmuFileError, match=r"'w' of .* has 3 elements but 2 start values"):
            asset.reset({"one": 5.0}, control={"u": [1.0, 2.0, 3.0]})
    content["binding"]["structural_parameters"] = {"rows": 3}
    wrong = r"structural_parameters\.rows of the binding r names 'rows', which is not a variable"
    with pytest.raises(BindingError, match=wrong):
        FmiAsset(foreign_fmu("resize3"), parse_binding(content))
    huge = foreign_fmu.changed("resize3", "many", ('max="8"', ""))
    content["binding"]["structural_parameters"] = {"n": 1e9}
    with pytest.raises(FmuInputError, match="'y' is an array of 1000000000 elements; 10000000 are the most"):
        FmiAsset(huge, parse_binding(content))
    states = '<UInt64 name="n" valueReference="100" causality="structuralParameter" start="2"/>'
    exchange = foreign_fmu.changed("swing3", "sized", ("</ModelVariables>", f"{states}</ModelVariables>"))
    with pytest.raises(BindingError, match=r"is run by model exchange; .* in co-simulation only"):
        FmiAsset(exchange, default_experiment(read_fmu(exchange), values={"n": 3.0}).binding)


@pytest.mark.parametrize(("content", "sentence"), INPUTS.table("histories.toml")["refused"])
def test_files_that_are_refused(tmp_path, content, sentence):
    given = tmp_path / "inputs.csv"
    given.write_text(content, encoding="utf-8")
    with pytest.raises(FmuInputError, match=sentence):
        read_histories(given, load_binding(ROOM))
    given.write_text("time\n120\n180.00001\n240\n", encoding="utf-8")  # the time alone will do
    assert read_histories(given, load_binding(ROOM)) == (3, {})


@pytest.fixture
def follow(foreign_fmu, tmp_path):
    """The words of a simulation of x' = u - x under the rows of a table, and the tables of in- and output."""
    inputs = tmp_path / "u.csv"
    outputs = tmp_path / "x.csv"
    binding = INPUTS.folder / "follow.toml"
    words = (
        foreign_fmu("follow2"),
        "--binding",
        binding,
        "--inputs",
        inputs,
        "--out",
        outputs,
        "--in-process",
    )
    return ("fmu", "simulate", *words), inputs, outputs


def test_rows_that_are_joined_by_lines(follow):
    """From rest under u = t: x = t - 1 + exp(-t); the first row is where the asset starts."""
    command, inputs, outputs = follow
    inputs.write_text("time,u\n0,0\n0.5,0.5\n1,1\n")
    assert "2 steps to t = 1 s" in said(*command, "--interpolation", "linear")
    rows = np.genfromtxt(outputs, delimiter=",", names=True)
    time = rows["time"]
    np.testing.assert_allclose(rows["x"], time - 1.0 + np.exp(-time), atol=1e-14)
    assert time.tolist() == [0.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("interpolation", "sentence"),
    [
        ("linear", "leads from one row of the inputs to the next: give two or more"),
        ("cubic", "--interpolation must be zero-order or linear, but 'cubic' was given"),
    ],
)
def test_rows_that_cannot_be_joined_are_refused(follow, interpolation, sentence):
    command, inputs, _ = follow
    inputs.write_text("time,u\n0,0\n")
    assert sentence in refused(*command, "--interpolation", interpolation, "--replace", code=None)


def test_the_version_and_interface_are_those_that_were_asked_for(tmp_path):
    for options, expected in (
        (("--fmi", "3"), ('fmiVersion="3.0"', "<CoSimulation")),
        (("--interface", "model-exchange"), ('fmiVersion="2.0"', "<ModelExchange")),
    ):
        path = tmp_path / f"{options[1]}.fmu"
        said("fmu", "build", "--kind", "source", *options, "--out", path)
        assert all(part in members(path)[DESCRIPTION].decode() for part in expected)


@pytest.fixture(scope="module")
def bound_ball(foreign_fmu, tmp_path_factory) -> tuple[Path, Path, str]:
    """An FMU of a ball, the binding that the command drafts, and what the command printed."""
    fmu = foreign_fmu("ball2")
    file = tmp_path_factory.mktemp("bound") / "ball.toml"
    return fmu, file, said("fmu", "bind", fmu, "--out", file, "--step-size", "0.05")


def test_a_drafted_binding_begins_with_its_schema_and_is_printed_without(bound_ball):
    fmu, file, printed = bound_ball
    schema, _, text = file.read_text(encoding="utf-8").partition("\n")
    assert f"uav-twin fmu check {fmu} --binding {file}" in " ".join(printed.split())
    assert schema.startswith("#:schema ")
    assert said("fmu", "bind", fmu, "--step-size", "0.05") == text


def test_a_binding_is_not_written_over_another_file(bound_ball):
    fmu, file, _ = bound_ball
    sentence = refused("fmu", "bind", fmu, "--out", file, code=None)
    assert "exists: choose another --out or give --replace" in sentence


@pytest.fixture(scope="module")
def check_of_ball(bound_ball: tuple[Path, Path, str]) -> dict[str, Any]:
    """What the command says as data of a check of that FMU with its binding."""
    fmu, file, _ = bound_ball
    words = ("fmu", "check", fmu, "--binding", file, "--cycles", "5", "--json")
    record: dict[str, Any] = json.loads(said(*words))
    return record


def test_a_check_of_an_fmu_is_printed_as_data(check_of_ball):
    verdicts = {finding["check"]: finding["verdict"] for finding in check_of_ball["findings"]}
    assert check_of_ball["passed"] is True
    assert verdicts["state"] == "warning"
    assert (verdicts["fmpy validate"], verdicts["instances"]) == ("ok", "ok")


def test_a_check_of_an_fmu_is_printed_as_a_table(bound_ball, check_of_ball):
    """Without cycles of reset there are no instances to check.

    A stage tells on the stream of errors that it has begun, in a pipe too.
    """
    fmu, file, _ = bound_ball
    done = command("fmu", "check", fmu, "--binding", file, "--cycles", "0")
    checks = {finding["check"] for finding in check_of_ball["findings"]} - {"instances"}
    assert "no problem found" in done.stdout
    assert all(check in done.stdout for check in checks)
    assert "..." in done.stderr


@pytest.fixture
def crashing_check(foreign_fmu) -> tuple[object, ...]:
    """The words of a check of an FMU that crashes."""
    return ("fmu", "check", foreign_fmu("hostile2", "SEGFAULT"), "--cycles", "0")


def test_a_problem_is_named_and_the_exit_code_says_so(crashing_check):
    done = command(*crashing_check)
    assert (done.returncode, "SIGSEGV" in done.stdout) == (1, True)
    assert "1 problem." in done.stderr
    assert "Traceback" not in done.stdout + done.stderr


@pytest.mark.parametrize("step", [0, 37])
def test_a_simulation_names_the_step_of_a_crash_and_what_was_refused(foreign_fmu, step):
    fmu = foreign_fmu("hostile2", "SEGFAULT", f"AFTER={step}")
    sentence = refused("fmu", "simulate", fmu, "--step-size", "0.01", "--stop-time", "1")
    assert f"step {step} from t = {0.01 * step:g} s" in sentence
    assert "SIGSEGV" in sentence
    assert "The sandbox refused " in sentence


def test_a_problem_is_a_verdict_of_the_data(crashing_check):
    record = json.loads(command(*crashing_check, "--json").stdout)
    assert record["passed"] is False
    assert any(finding["verdict"] == "problem" for finding in record["findings"])


@pytest.fixture(scope="module")
def fmu_for_windows(foreign_fmu, tmp_path_factory) -> Path:
    """The FMU of a ball with a binary for another platform only."""
    fmu = tmp_path_factory.mktemp("windows") / "elsewhere.fmu"
    contents = {
        name.replace("linux64", "win64").replace(".so", ".dll"): content
        for name, content in members(foreign_fmu("ball2")).items()
    }
    archive_of(fmu, contents)
    return fmu


def info(fmu: Path) -> dict[str, Any]:
    """Return what the command says of an FMU as data."""
    record: dict[str, Any] = json.loads(said("fmu", "info", fmu, "--json"))
    return record


def test_an_fmu_for_this_platform_has_no_obstacle(foreign_fmu):
    fmu = foreign_fmu("ball2")
    record = info(fmu)
    assert (record["file"], record["obstacle"]) == (str(fmu), "")


def test_an_fmu_for_another_platform_is_described_with_its_obstacle(foreign_fmu, fmu_for_windows):
    record = info(fmu_for_windows)
    assert "no binary for this platform" in record["obstacle"]
    assert "win64" in record["obstacle"]
    assert record["variables"] == info(foreign_fmu("ball2"))["variables"]


def test_an_fmu_for_another_platform_is_said_not_to_fly(fmu_for_windows):
    assert "It cannot be flown here: " in said("fmu", "info", fmu_for_windows)
    refused("fmu", "simulate", fmu_for_windows, "--stop-time", "1")


def description(fmu: Path, columns: str) -> list[str]:
    """Return the lines that describe an FMU on a screen of so many columns."""
    return command("fmu", "info", fmu, columns=columns).stdout.splitlines()


PIPE, NARROW = "", "80"


@pytest.mark.parametrize("columns", [PIPE, NARROW], ids=["a pipe", "a narrow terminal"])
def test_an_fmu_is_described_with_all_its_variables(foreign_fmu, columns):
    fmu = foreign_fmu("ball2")
    variables = info(fmu)["variables"]
    lines = description(fmu, columns)
    second_words = "".join(line.split(" ", 2)[1] for line in lines if " " in line)
    assert variables
    assert all(variable["name"] in second_words for variable in variables)


@pytest.mark.parametrize("columns", [PIPE, NARROW], ids=["a pipe", "a narrow terminal"])
def test_an_fmu_is_described_without_cuts_behind_its_whole_path(foreign_fmu, columns):
    fmu = foreign_fmu("ball2")
    first, *others = description(fmu, columns)
    assert str(fmu) in first
    assert "…" not in first + "".join(others)


def test_the_description_of_an_fmu_fits_into_a_narrow_terminal(foreign_fmu):
    _, *lines = description(foreign_fmu("ball2"), NARROW)
    assert max(map(len, lines)) <= 80


def test_the_items_of_an_enumeration_are_shown(foreign_fmu):
    shown = " ".join(said("fmu", "info", foreign_fmu("siren2")).split())
    assert "of the horn; items: quiet = 1, loud = 3" in shown
    record = json.loads(said("fmu", "info", foreign_fmu("siren2"), "--json"))
    items = {variable["name"]: variable["items"] for variable in record["variables"]}
    assert items["loudness"] == {"quiet": 1, "loud": 3}


def test_an_enumeration_a_text_and_the_stop_time_are_given_on_the_command_line(foreign_fmu, tmp_path):
    fmu, out = foreign_fmu("siren2", "WANTS_STOP_TIME=86400.0"), tmp_path / "y.csv"
    wanted = ("--stop-time", 86400, "--step-size", 900, "--set", "loudness=loud", "--set", "label=a=b, 1")
    said("fmu", "simulate", fmu, *wanted, "--out", out)
    assert np.genfromtxt(out, delimiter=",", names=True)["y"][-1] == 10.0 + len("a=b, 1")


def test_the_rows_of_a_file_say_when_the_experiment_ends(foreign_fmu, tmp_path):
    binding, inputs, out = (tmp_path / name for name in ("b.toml", "u.csv", "y.csv"))
    binding.write_text(
        "binding = { name = 'siren', step_size = 1.0 }\ncontrol.u = { variable = 'u', unit = '1' }\n"
        "observation.y = { variables = 'y', unit = '1' }\n"
    )
    inputs.write_text("time,u\n0,1\n1,2\n2,3\n")
    fmu = foreign_fmu("siren2", "WANTS_STOP_TIME=3.0")
    said("fmu", "simulate", fmu, "--binding", binding, "--inputs", inputs, "--out", out)
    assert np.genfromtxt(out, delimiter=",", names=True)["y"].tolist() == [1.0, 2.0, 3.0]


GRID = "--grid health.wear=0,0.3 --grid clogging=0,0.6 --grid speed=1000 --grid pressure=100:140:2"


def test_from_a_script_to_a_library(tmp_path):
    fmu, out = tmp_path / "pump.fmu", tmp_path / "pump.nc"
    said("fmu", "build", "--script", "gear_pump", "--out", fmu)
    said("fmu", "check", fmu, "--cycles", "5")
    given = "--fmu", fmu, "--binding", binding_files()["gear_pump"]
    sample = "library", "sample", *given, *GRID.split(), "--out", out
    size = r"pump\.nc: 1 x 4 x 2 x 4 \(draws, states, controls, sensors\), 2 proc"
    assert re.search(size, said(*sample, "--workers", "2"))
    content = out.read_bytes()
    for extra, words in (
        ([], "exists: choose another --out or give --replace"),
        (["--replace", "--grid", "wear=0,2"], "wear = 2.0 lies outside the range of 'wear'"),
        (["--replace", "--role", "flow"], "no observation 'flow'; it has operation"),
    ):
        assert words in refused(*sample, *extra)
        assert out.read_bytes() == content


def test_an_input_that_nobody_sets_is_warned_about_once(foreign_fmu, tmp_path):
    inputs = tmp_path / "inputs.csv"
    inputs.write_text("time,power\n120,1\n180,2\n", encoding="utf-8")
    words = ("--binding", ROOM, "--inputs", inputs, "--in-process")
    told = said("fmu", "simulate", foreign_fmu("room2"), *words)
    assert told.count("2 inputs stay at their start values, because nobody sets them: ") == 1

    binding = binding_files()["gear_pump"].read_text("utf-8")
    without_pressure = re.sub(r"(?s)\[control\.pressure\].*?\n\n", "", binding)
    (tmp_path / "pump.toml").write_text(without_pressure, encoding="utf-8")
    scenario = re.sub(r", pressure = \d+\.0", "", scenario_files()["pump_wear"].read_text("utf-8"))
    scenario = scenario.replace('binding = "gear_pump"', 'binding = "pump.toml"')
    (tmp_path / "mine.toml").write_text(scenario, encoding="utf-8")
    checked = command("scenario", "check", tmp_path / "mine.toml")
    assert checked.returncode == 0, checked.stderr
    assert checked.stderr.count("nobody sets it: pressure (150 bar)") == 1
