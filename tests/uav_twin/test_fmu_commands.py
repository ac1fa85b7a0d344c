"""`uav-twin fmu bind` and `uav-twin fmu check` as a user calls them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

from tests.command_line import command

ROOT = Path(__file__).parents[2]


def call(*words: object) -> subprocess.CompletedProcess[str]:
    return command("fmu", *words)


def test_an_fmu_is_bound_and_checked(foreign_fmu: Any, tmp_path: Path) -> None:
    fmu, file = foreign_fmu("ball2"), tmp_path / "ball.toml"
    drafted = call("bind", fmu, "--out", file, "--step-size", "0.05")
    assert drafted.returncode == 0, drafted.stderr
    assert f"uav-twin fmu check {fmu} --binding {file}" in " ".join(drafted.stdout.split())
    assert call("bind", fmu, "--step-size", "0.05").stdout == file.read_text(encoding="utf-8")
    again = call("bind", fmu, "--out", file)
    assert again.returncode != 0
    assert "exists: choose another --out or give --replace" in again.stderr
    checked = call("check", fmu, "--binding", file, "--cycles", "5", "--json")
    assert checked.returncode == 0, checked.stderr
    record = json.loads(checked.stdout)
    assert record["passed"] is True
    found = {finding["check"]: finding["verdict"] for finding in record["findings"]}
    assert found["fmpy validate"] == "ok"
    assert found["state"] == "warning"
    assert found["instances"] == "ok"
    shown = call("check", fmu, "--binding", file, "--cycles", "0")
    assert "no problem found" in shown.stdout
    assert all(finding in shown.stdout for finding in found if finding != "instances")
    assert "..." in shown.stderr  # a stage tells that it has begun, in a pipe too
    assert call("check", fmu, "--binding", file, "--cycles", "0", "-q").stdout == ""


def test_a_problem_is_named_and_the_exit_code_says_so(foreign_fmu: Any, tmp_path: Path) -> None:
    checked = call("check", foreign_fmu("hostile2", "SEGFAULT"), "--cycles", "0")
    assert checked.returncode == 1
    assert "SIGSEGV" in checked.stdout
    told = json.loads(call("check", foreign_fmu("hostile2", "SEGFAULT"), "--cycles", "0", "--json").stdout)
    assert told["passed"] is False
    assert any(finding["verdict"] == "problem" for finding in told["findings"])
    assert "1 problem." in checked.stderr
    assert "Traceback" not in checked.stdout + checked.stderr
    for word in ("bind", "check"):
        missing = call(word, tmp_path / "none.fmu")
        assert missing.returncode != 0
        assert "There is no FMU" in missing.stderr
        assert "Traceback" not in missing.stderr
    (tmp_path / "wrong.toml").write_text("[binding]\nname = 1\n", encoding="utf-8")
    wrong = call("check", foreign_fmu("ball2"), "--binding", tmp_path / "wrong.toml")
    assert wrong.returncode != 0
    assert "wrong.toml" in wrong.stderr


def test_names_of_an_fmu_are_whole_in_a_pipe_and_on_a_narrow_terminal(foreign_fmu: Any) -> None:
    fmu = foreign_fmu("ball2")
    record = json.loads(call("info", fmu, "--json").stdout)
    names = [variable["name"] for variable in record["variables"]]
    assert names
    assert record["file"] == str(fmu)
    environment = {name: value for name, value in os.environ.items() if name != "COLUMNS"}
    for columns in ({}, {"COLUMNS": "80"}):
        shown = subprocess.run(
            [sys.executable, "-m", "uav_twin", "fmu", "info", str(fmu)],
            cwd=ROOT, env=environment | columns, check=True, capture_output=True, text=True,
        ).stdout  # fmt: skip
        assert "…" not in shown
        assert str(fmu) in shown.splitlines()[0]
        for name in names:
            assert name in "".join(line.split(" ", 2)[1] for line in shown.splitlines() if " " in line)
        if columns:
            assert max(map(len, shown.splitlines()[1:])) <= 80


def test_an_fmu_for_another_platform_is_described_and_said_not_to_fly(
    foreign_fmu: Any, tmp_path: Path
) -> None:
    here, elsewhere = foreign_fmu("ball2"), tmp_path / "elsewhere.fmu"
    with zipfile.ZipFile(here) as old, zipfile.ZipFile(elsewhere, "w") as new:
        for name in old.namelist():
            new.writestr(name.replace("linux64", "win64").replace(".so", ".dll"), old.read(name))
    record, other = (json.loads(call("info", fmu, "--json").stdout) for fmu in (here, elsewhere))
    assert record["obstacle"] == ""
    assert "no binary for this platform" in other["obstacle"]
    assert "win64" in other["obstacle"]
    assert other["variables"] == record["variables"]
    shown = call("info", elsewhere)
    assert shown.returncode == 0
    assert "It cannot be flown here: " in shown.stdout
    assert call("simulate", elsewhere, "--stop-time", "1").returncode == 1
