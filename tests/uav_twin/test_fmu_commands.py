"""`uav-twin fmu build`, `bind`, `check` and `info`, and `uav-twin library sample`, as a user calls them."""

import json
import re
import zipfile

import pytest

from scenarios import binding_files
from tests.command_line import command, refused, said
from tests.twin_master.runs import text_of, written


def test_the_version_and_interface_are_those_that_were_asked_for(tmp_path):
    for options, expected in (
        (("--fmi", "3"), ('fmiVersion="3.0"', "<CoSimulation")),
        (("--interface", "model-exchange"), ('fmiVersion="2.0"', "<ModelExchange")),
    ):
        path = tmp_path / f"{options[1]}.fmu"
        said("fmu", "build", "--kind", "source", *options, "--out", path)
        with zipfile.ZipFile(path) as archive:
            text = archive.read("modelDescription.xml").decode()
        assert all(part in text for part in expected)


def test_an_fmu_is_bound_and_checked(foreign_fmu, tmp_path):
    fmu, file = foreign_fmu("ball2"), tmp_path / "ball.toml"
    drafted = said("fmu", "bind", fmu, "--out", file, "--step-size", "0.05")
    assert f"uav-twin fmu check {fmu} --binding {file}" in " ".join(drafted.split())
    assert said("fmu", "bind", fmu, "--step-size", "0.05") == file.read_text(encoding="utf-8")
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
    assert said("fmu", "check", fmu, "--binding", file, "--cycles", "0", "-q") == ""


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
    with zipfile.ZipFile(fmu) as old, zipfile.ZipFile(elsewhere, "w") as new:
        for name in old.namelist():
            new.writestr(name.replace("linux64", "win64").replace(".so", ".dll"), old.read(name))
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


GRID = (
    "--grid",
    "wear=0,0.3",
    "--grid",
    "clogging=0,0.6",
    "--grid",
    "speed=1000",
    "--grid",
    "pressure=100:140:2",
)


def test_from_a_script_to_a_library(tmp_path):
    fmu, out = tmp_path / "pump.fmu", tmp_path / "pump.nc"
    said("fmu", "build", "--script", "gear_pump", "--out", fmu)
    said("fmu", "check", fmu, "--cycles", "5")
    sample = (
        "library",
        "sample",
        "--fmu",
        fmu,
        "--binding",
        binding_files()["gear_pump"],
        *GRID,
        "--out",
        out,
    )
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


@pytest.mark.long
def test_a_run_of_the_pump_speaks_of_pumps(tmp_path):
    scenario = written(
        tmp_path, text_of("pump_wear", ("steps = 60", "steps = 12"), ("draws = 40", "draws = 6"))
    )
    folder = tmp_path / "run"
    shown = said("run", scenario, "--out", folder, "--in-process")
    assert "twin, per shift" in shown
    page = (folder / "report.html").read_text(encoding="utf-8")
    words = re.sub(r"<svg.*?</svg>|<style.*?</style>", " ", page, flags=re.S)
    words = re.sub(r"<[^>]+>", " ", words) + shown
    words += "".join(file.read_text(encoding="utf-8") for file in (folder / "csv").iterdir())
    for word in ("wing", "strain", "gauge", "stiffness", "turn", "µε", "flight"):
        assert not re.search(rf"\b{word}s?\b", words, flags=re.I), word
    for word in ("shift 11", "oil temperature", "0.15 bar", "growth of the clearances", "L/min"):
        assert word in words.replace("\u00a0", " ")
    drawings = "".join(path.read_text(encoding="utf-8") for path in (folder / "figures").glob("*.svg"))
    assert "microstrain" not in drawings
    assert "Gauge" not in drawings
