"""`uav-twin fmu`, `library sample`, `ssp` and `run x.ssp` as a user calls them."""

import csv
import io
import json
import math
import re
import zipfile
from contextlib import closing
from pathlib import Path

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
from tests.fmu_asset.making import DESCRIPTION, archive_of, edited, members
from tests.refusals import Inputs

INPUTS = Inputs(__file__)
ROOM = INPUTS.folder / "room.toml"


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


def test_histories_in_outputs_out(foreign_fmu, tmp_path):
    fmu, given = foreign_fmu("room2"), tmp_path / "inputs.csv"
    power, outside = [0.0, 3.0, 1.5, 0.25], [5.0, -3.5, 0.1, 20.0]
    lines = [f"{120.0 + 60.0 * i},{p},{o}" for i, (p, o) in enumerate(zip(power, outside, strict=True))]
    given.write_text("time, power, load.outside\n" + "\n".join(lines) + "\n\n", encoding="utf-8")
    with FmiAsset(fmu, ROOM, isolated=False) as asset:
        seen = [asset.step({"power": p}, load={"outside": o}) for p, o in zip(power, outside, strict=True)]
    for out, more in ((tmp_path / "out.csv", ()), (tmp_path / "out.nc", ("--in-process",))):
        words = ("fmu", "simulate", fmu, "--binding", ROOM, "--inputs", given, "--out", out)
        assert "4 steps to t = 360 s" in said(*words, *more)
    with (tmp_path / "out.csv").open(encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    assert header == ["time", "room.T", "room.sensor.T", "der(room.T)"]
    expected = [[item.time, *item.values.tolist(), item.extra["der(room.T)"]] for item in seen]
    assert [[float(cell) for cell in row] for row in rows] == expected
    with xr.open_dataset(tmp_path / "out.nc", engine="h5netcdf", decode_times=False) as data:
        assert data["time"].values.tolist() == [180.0, 240.0, 300.0, 360.0]
        assert data["observation"].values.tobytes() == np.array([item.values for item in seen]).tobytes()
        assert data["observation_unit"].values.tolist() == ["degC", "degC"]
        assert data["extra"].sel(extra_name="der(room.T)").values.tolist() == [row[-1] for row in expected]
        assert data["extra_unit"].values.tolist() == ["K/s"]
    assert "exists: choose another --out or give --replace" in refused(*words, code=None)


def test_an_fmu_alone(foreign_fmu, tmp_path):
    """A ball that is let go, against its closed form; its second bounce ends the simulation."""
    out, plot, fmu = tmp_path / "ball.csv", tmp_path / "ball.png", foreign_fmu("ball2", "ENDS")
    wanted = ("--stop-time", 3, "--step-size", 0.1, "--set", "e=0.8", "--set", "g=3.72", "--in-process")
    told = said("fmu", "simulate", fmu, *wanted, "--out", out, "--plot", plot)
    end = math.sqrt(2.0 / 3.72) * (1.0 + 2.0 * 0.8)
    assert f"20 steps to t = {end:g} s, every 0.1 s" in told
    assert f"ended at t = {end:g} s" in told
    rows = np.genfromtxt(out, delimiter=",", names=True)
    falling = rows["time"] < math.sqrt(2.0 / 3.72)
    np.testing.assert_allclose(rows["h"][falling], 1.0 - 1.86 * rows["time"][falling] ** 2, atol=1e-4)
    assert rows[0].tolist()[:3] == (0.0, 1.0, 0.0)
    assert rows["bounces"].tolist() == [0] * 8 + [1] * 12 + [2]
    assert plot.read_bytes()[:4] == b"\x89PNG"
    told = said("fmu", "simulate", fmu, "--in-process", "--stop-time", 0.4)
    assert "500 steps to t = 0.4 s, every 0.0008 s" in told
    text = '<DefaultExperiment startTime="2.0" stopTime="3.0" stepSize="0.25"/><ModelVariables>'
    fmu = foreign_fmu.changed("ball2", "ball_with_experiment", ("<ModelVariables>", text))
    assert "4 steps to t = 3 s" in said("fmu", "simulate", fmu, "--in-process", "--out", out, "--replace")
    rows = np.genfromtxt(out, delimiter=",", names=True)
    assert rows["time"].tolist() == [2.0, 2.25, 2.5, 2.75, 3.0]
    assert rows["h"][0] == 1.0


def test_structural_parameters_size_the_arrays(foreign_fmu, tmp_path):
    """Each element sums its weight times its input: n of them, set in configuration mode; it may be none."""
    fmu, out = foreign_fmu("resize3"), tmp_path / "x.csv"
    wanted = ("fmu", "simulate", fmu, "--stop-time", 3, "--step-size", 1, "--replace", "--out", out)
    for where in ((), ("--in-process",)):
        said(*wanted, *where, "--set", "n=4", "--set", "u=1,2,0,-1")
        rows = np.genfromtxt(out, delimiter=",", names=True, deletechars="")
        assert rows.dtype.names == ("time", "y[1]", "y[2]", "y[3]", "y[4]", "total")
        assert rows[-1].tolist() == (3.0, 3.0, 12.0, 0.0, -12.0, 3.0)
    said(*wanted, "--in-process", "--set", "n=0")
    assert out.read_text(encoding="utf-8").splitlines()[:3] == ["time,total", "0.0,0.0", "1.0,0.0"]
    # By a binding, with weights 1, 2, 3 and histories whose columns stand in any order.
    bound, given = tmp_path / "b.toml", tmp_path / "u.csv"
    words = ("fmu", "simulate", fmu, "--binding", bound, "--inputs", given, "--out", out, "--in-process")
    bound.write_text(INPUTS.text("sized.toml"), encoding="utf-8")
    given.write_text("u[2],time,u[1],u[3]\n2,0,1,3\n0,1,0,1\n", encoding="utf-8-sig")
    said(*words, "--replace")
    assert out.read_text(encoding="utf-8").splitlines()[1:] == ["1.0,1.0,4.0,9.0", "2.0,1.0,4.0,12.0"]
    bound.write_text(INPUTS.text("sized.toml", ("n = 3", "n = 0")), encoding="utf-8")
    given.write_text("time,u\n0,1\n1,1\n", encoding="utf-8")
    assert "control.u must be 0 values" in refused(*words, "--replace")


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


def test_rows_that_are_joined_by_lines(foreign_fmu, tmp_path):
    """x' = u - x from rest under u = t: x = t - 1 + exp(-t); the first row is where the asset starts."""
    given, bound, out = tmp_path / "u.csv", INPUTS.folder / "follow.toml", tmp_path / "x.csv"
    given.write_text("time,u\n0,0\n0.5,0.5\n1,1\n")
    wanted = (foreign_fmu("follow2"), "--binding", bound, "--inputs", given, "--out", out, "--in-process")
    assert "2 steps to t = 1 s" in said("fmu", "simulate", *wanted, "--interpolation", "linear")
    rows = np.genfromtxt(out, delimiter=",", names=True)
    np.testing.assert_allclose(rows["x"], rows["time"] - 1.0 + np.exp(-rows["time"]), atol=1e-14)
    assert rows["time"].tolist() == [0.0, 0.5, 1.0]
    given.write_text("time,u\n0,0\n")
    for more, sentence in (
        (("--interpolation", "linear"), "leads from one row of the inputs to the next: give two or more"),
        (("--interpolation", "cubic"), "--interpolation must be zero-order or linear, but 'cubic' was given"),
    ):
        assert sentence in refused("fmu", "simulate", *wanted, *more, "--replace", code=None)


def test_the_version_and_interface_are_those_that_were_asked_for(tmp_path):
    for options, expected in (
        (("--fmi", "3"), ('fmiVersion="3.0"', "<CoSimulation")),
        (("--interface", "model-exchange"), ('fmiVersion="2.0"', "<ModelExchange")),
    ):
        path = tmp_path / f"{options[1]}.fmu"
        said("fmu", "build", "--kind", "source", *options, "--out", path)
        assert all(part in members(path)[DESCRIPTION].decode() for part in expected)


def test_an_fmu_is_bound_and_checked(foreign_fmu, tmp_path):
    fmu, file = foreign_fmu("ball2"), tmp_path / "ball.toml"
    drafted = said("fmu", "bind", fmu, "--out", file, "--step-size", "0.05")
    assert f"uav-twin fmu check {fmu} --binding {file}" in " ".join(drafted.split())
    schema, _, text = file.read_text(encoding="utf-8").partition("\n")
    assert schema.startswith("#:schema ")
    assert said("fmu", "bind", fmu, "--step-size", "0.05") == text
    again = refused("fmu", "bind", fmu, "--out", file, code=None)
    assert "exists: choose another --out or give --replace" in again
    record = json.loads(said("fmu", "check", fmu, "--binding", file, "--cycles", "5", "--json"))
    assert record["passed"] is True
    found = {finding["check"]: finding["verdict"] for finding in record["findings"]}
    assert (found["fmpy validate"], found["state"], found["instances"]) == ("ok", "warning", "ok")
    shown = command("fmu", "check", fmu, "--binding", file, "--cycles", "0")
    assert "no problem found" in shown.stdout
    assert all(finding in shown.stdout for finding in found if finding != "instances")
    assert "..." in shown.stderr  # a stage tells that it has begun, in a pipe too


def test_a_problem_is_named_and_the_exit_code_says_so(foreign_fmu, tmp_path):
    words = ("fmu", "check", foreign_fmu("hostile2", "SEGFAULT"), "--cycles", "0")
    checked = command(*words)
    assert checked.returncode == 1
    assert "SIGSEGV" in checked.stdout
    assert "1 problem." in checked.stderr
    assert "Traceback" not in checked.stdout + checked.stderr
    told = json.loads(command(*words, "--json").stdout)
    assert told["passed"] is False
    assert any(finding["verdict"] == "problem" for finding in told["findings"])


def test_an_fmu_is_described_whole_and_one_for_another_platform_said_not_to_fly(
    foreign_fmu, tmp_path, monkeypatch
):
    fmu, elsewhere = foreign_fmu("ball2"), tmp_path / "elsewhere.fmu"
    for_windows = {n.replace("linux64", "win64").replace(".so", ".dll"): c for n, c in members(fmu).items()}
    archive_of(elsewhere, for_windows)
    record, other = (json.loads(said("fmu", "info", file, "--json")) for file in (fmu, elsewhere))
    assert (record["file"], record["obstacle"]) == (str(fmu), "")
    assert "no binary for this platform" in other["obstacle"]
    assert "win64" in other["obstacle"]
    assert other["variables"] == record["variables"]
    assert "It cannot be flown here: " in said("fmu", "info", elsewhere)
    refused("fmu", "simulate", elsewhere, "--stop-time", "1")
    for columns in ("", "80"):  # a pipe, and a narrow terminal
        first, *rest = command("fmu", "info", fmu, columns=columns).stdout.splitlines()
        assert "…" not in first + "".join(rest)
        assert str(fmu) in first
        second_words = "".join(line.split(" ", 2)[1] for line in [first, *rest] if " " in line)
        assert record["variables"]
        assert all(variable["name"] in second_words for variable in record["variables"])
        assert not columns or max(map(len, rest)) <= 80


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


END = "</ssm:ParameterMapping>"


@pytest.fixture(scope="module")
def system(heat_exchanger: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The heat exchanger as an SSP file."""
    place = tmp_path_factory.mktemp("system") / "x.ssp"
    assert "x.ssp: " in said("ssp", "export", heat_exchanger / "fouling.toml", "--out", place)
    return place


def mapped(*entries: tuple[str, str]) -> tuple[str, str]:
    """What adds entries, sources and targets, to the mapping of parameters."""
    texts = (f'<ssm:MappingEntry source="{one}" target="heat_exchanger.{other}" />' for one, other in entries)
    return END, "".join(texts) + END


def test_a_system_is_checked_simulated_as_it_lies_there_and_flown(heat_exchanger, system, tmp_path):
    """Against the closed form of the heat exchanger: what the file says, and what is set instead."""
    text = said("ssp", "check", system)
    assert "no problem found; 7 connections, 2 parameters" in text
    assert "evaluated in the order heat_exchanger (HeatExchanger)" in text
    table, picture = tmp_path / "x.csv", tmp_path / "x.svg"
    simulate = ("ssp", "simulate", system, "--stop-time", "3", "--step-size", "1", "--in-process")
    assert "3 steps to t = 3 s, every 1 s." in said(*simulate, "--out", table, "--plot", picture)
    assert picture.read_text(encoding="utf-8").startswith("<?xml")
    rows = np.genfromtxt(table, delimiter=",", names=True)
    np.testing.assert_allclose(rows["time"], [0.0, 1.0, 2.0, 3.0])
    assert rows["outlet"][-1] == pytest.approx(20.0 + 60.0 * -np.expm1(-6100.0 / 4186.0), rel=1e-14)
    for number, name in enumerate(("conductance", "heat_exchanger.conductance")):
        again = tmp_path / f"{number}.nc"
        said(*simulate, "--set", "mass_flow=0.5", "--set", f"{name}=5000", "--out", again)
        with xr.open_dataset(again, engine="h5netcdf") as data:
            outlet = float(data["observation"].sel(observation_name="outlet")[-1])
            assert data.attrs["fmu"] == "x.ssp"
        assert outlet == pytest.approx(20.0 + 60.0 * -np.expm1(-5000.0 / (4186.0 * 0.5)), rel=1e-14)
    assert "no parameter or input" in refused(*simulate, "--set", "heat_exchanger.outlet=1")
    asked = "asks for linear interpolation of inputs, but no component"
    assert asked in refused(*simulate, "--interpolation", "linear")
    out = tmp_path / "run"
    options = "--out", out, "--in-process", "--no-report", "-q"
    said("run", system, "--scenario", heat_exchanger / "fouling.toml", *options)
    assert (out / "asset" / "system.ssp").read_bytes() == system.read_bytes()
    assert (out / "csv" / "observed.csv").is_file()


def test_what_nothing_takes_is_a_warning_and_not_flown(heat_exchanger, system, tmp_path):
    """The nearest name is said; what another entry gives is not missed."""
    file = edited(system, tmp_path / "more.ssp", mapped(("conductance", "baffle")))
    named = f"{file} sets parameters that nothing takes: heat_exchanger.baffle; correct"
    for words in (("check", file), ("simulate", file, "--stop-time", "1", "--in-process")):
        assert f"warning: {named}" in " ".join(said("ssp", *words).split())
    assert json.loads(said("ssp", "check", file, "--json"))["unused"] == ["heat_exchanger.baffle"]
    more = mapped(("conductance", "conductanse"), ("cold", "wall_temperature"))
    file = edited(system, tmp_path / "misspelt.ssp", more)
    meant = "heat_exchanger.conductanse (did you mean 'heat_exchanger.conductance'?)"
    named = f"{file} sets parameters that nothing takes: {meant}"
    assert f"warning: {named}" in " ".join(said("ssp", "check", file).split())
    out = tmp_path / "run"
    assert named in refused("run", file, "--scenario", heat_exchanger / "fouling.toml", "--out", out, "-q")
    assert not out.exists()


def test_the_words_of_ssp_2_are_read(system, tmp_path):
    """The numbers of FMI 3, metadata and the version; what 1.0 has no word for is refused."""
    meta = '<ssc:MetaData kind="general" type="text/plain" source="note.txt" />'
    words = ('version="1.0" name=', 'version="2.0" name='), ("</ssd:SystemS", f"{meta}</ssd:SystemS")
    numbers = ("ssc:Real", "ssc:Float64"), ("ssv:Real", "ssv:Float64")
    newer = edited(system, tmp_path / "newer.ssp", *words, *numbers)
    tables = [tmp_path / "0.csv", tmp_path / "1.csv"]
    for file, table in zip((system, newer), tables, strict=True):
        said("ssp", "simulate", file, "--out", table, "--step-size", "0.25", "--in-process")
    assert tables[0].read_bytes() == tables[1].read_bytes()
    for what, by, sentence in (
        ("<ssc:Float64 />", '<ssc:Float64 /><ssd:Dimension size="2" />', "has an array"),
        ("<ssc:Float64 />", "<ssc:Clock />", "has a clock"),
        ('kind="parameter"', 'kind="structuralParameter"', "a connector of the kind structuralParameter"),
        (' source="resources/heat_exchanger.fmu"', "", "'heat_exchanger' without a source"),
    ):
        bad = edited(newer, tmp_path / "bad.ssp", (what, by))
        assert sentence in refused("ssp", "simulate", bad)


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_the_wing_of_a_design(tmp_path):
    said("ssp", "export", "uav_wing", "--out", tmp_path / "wing.ssp")
    assert "evaluated in the order uav_wing (uav_wing)" in said("ssp", "check", tmp_path / "wing.ssp")


def members_of_component(system: Path, component: str) -> set[str]:
    """Return the first folders and files inside the FMU of a component of an SSP file."""
    with zipfile.ZipFile(system) as archive:
        content = archive.read(f"resources/{component}.fmu")
    with zipfile.ZipFile(io.BytesIO(content)) as fmu:
        return {name.partition("/")[0] for name in fmu.namelist()} | {*fmu.namelist()}


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_fmus_of_a_design_are_exported_as_the_user_says(tmp_path):
    """A compiled FMU has no Python inside, and other components stay as they are."""
    said("ssp", "export", "uav_wing", "--kind", "compiled", "--out", tmp_path / "wing.ssp")
    said("ssp", "export", "three_fmus", "--kind", "compiled", "--out", tmp_path / "three.ssp")
    said("ssp", "export", "three_fmus", "--out", tmp_path / "as_said.ssp")
    python = {
        (system, component): any(
            name.endswith(".py") for name in members_of_component(tmp_path / f"{system}.ssp", component)
        )
        for system, component in (
            ("wing", "uav_wing"),
            ("three", "wing"),
            ("three", "gauges"),
            ("as_said", "wing"),
        )
    }
    assert [*python.values()] == [False, False, True, True]
    assert "no problem found" in said("ssp", "check", tmp_path / "three.ssp")
