"""`uav-twin library sample`, `fmu build --script` and a run with a library, as a user calls them."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from scenarios import binding_files, scenario_files
from tests.command_line import refused, said

GRID = [
    "--grid",
    "wear=0,0.3",
    "--grid",
    "clogging=0,0.6",
    "--grid",
    "speed=1000",
    "--grid",
    "pressure=100:140:2",
]


def test_from_a_script_to_a_library(tmp_path: Path) -> None:
    fmu, out = tmp_path / "pump.fmu", tmp_path / "pump.nc"
    said("fmu", "build", "--script", "gear_pump", "--out", str(fmu))
    said("fmu", "check", str(fmu), "--cycles", "5")
    sample = ["library", "sample", "--fmu", str(fmu), "--binding", str(binding_files()["gear_pump"]), *GRID]
    assert re.search(
        r"pump\.nc: 1 x 4 x 2 x 4 \(draws, states, controls, sensors\), 2 proc",
        said(*sample, "--out", str(out), "--workers", "2"),
    )
    content = out.read_bytes()
    for extra, words in (
        ([], "exists: choose another --out or give --replace"),
        (["--replace", "--grid", "wear=0,2"], "wear = 2.0 lies outside the range of 'wear'"),
        (["--replace", "--role", "flow"], "no observation 'flow'; it has operation"),
    ):
        assert words in refused(*sample, "--out", str(out), *extra)
        assert out.read_bytes() == content


def test_a_wrong_command_line_is_said_to_be_so(tmp_path: Path) -> None:
    out = ["--out", str(tmp_path / "x.nc")]
    for arguments, words in (
        (["library", "sample", *out], "give a scenario, or --fmu and --binding"),
        (["library", "sample", "pump_wear", *out, "--resume", "--replace"], "either --resume or --replace"),
        (["library", "sample", "pump_wear", *out, "--role", "flow"], "the scenario says what is observed"),
        (["fmu", "build", "--script", "gear_pump", "--kind", "source"], "are for the wing"),
    ):
        assert words in refused(*arguments, code=2)
    assert "the rest is said by the scenario" in refused(
        "library", "sample", "pump_wear", *out, "--grid", "speed=1000"
    )
    missing = str(tmp_path / "missing.nc")
    assert "there is no observation library" in refused(
        "run", "pump_wear", "--library", missing, "--out", str(tmp_path / "run")
    )
    assert not (tmp_path / "run").exists()


@pytest.mark.long
def test_a_run_of_the_pump_speaks_of_pumps(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    text = scenario_files()["pump_wear"].read_text(encoding="utf-8")
    scenario = tmp_path / "short.toml"
    scenario.write_text(
        re.sub(r"^steps = 60$", "steps = 12", text, flags=re.M).replace("draws = 40", "draws = 6")
    )
    folder = tmp_path / "run"
    said("run", str(scenario), "--out", str(folder), "--in-process")
    shown = capsys.readouterr()
    assert "twin, per shift" in shown.out
    page = (folder / "report.html").read_text(encoding="utf-8")
    words = re.sub(r"<svg.*?</svg>|<style.*?</style>", " ", page, flags=re.S)
    words = (
        re.sub(r"<[^>]+>", " ", words)
        + shown.out
        + "".join(file.read_text(encoding="utf-8") for file in (folder / "csv").iterdir())
    )
    for word in ("wing", "strain", "gauge", "stiffness", "turn", "µε", "flight"):
        assert not re.search(rf"\b{word}s?\b", words, flags=re.I), word
    for word in ("shift 11", "oil temperature", "0.15 bar", "growth of the clearances", "L/min"):
        assert word in words.replace("\u00a0", " ")
    drawings = "".join(path.read_text(encoding="utf-8") for path in (folder / "figures").glob("*.svg"))
    assert "microstrain" not in drawings
    assert "Gauge" not in drawings
