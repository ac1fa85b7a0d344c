"""The command line: what it says, and how it ends when something is wrong."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import command_page
from reporting import terminal
from tests.command_line import call, refused, said
from twin_master.errors import ScenarioError
from uav_twin import cli


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twin_master.workflow._report", lambda folder: (folder / "report.html").touch())


def test_commands_are_listed() -> None:
    text = said("--help")
    for command in ("run", "wing", "calibrate", "scenarios", "fmu"):
        assert command in text
    text = said("run", "--help")
    for option in (
        "--out",
        "--seed",
        "--resume",
        "--replace",
        "--fmu",
        "--binding",
        "--strain-library",
        "--in-process",
    ):
        assert option in text


def test_scenarios() -> None:
    text = said("scenarios")
    for name in ("level_turns", "growing_damage", "failing_gauges", "model_mismatch"):
        assert name in text


@pytest.mark.usefixtures("no_report")
def test_run_prints_figures_and_report(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, library_file: Path
) -> None:
    out = tmp_path / "run"
    arguments = ["run", "level_turns", "--out", str(out), "--strain-library", str(library_file)]
    text = said(*arguments, "--seed", "3")
    assert "filtered rms error of z1" in text
    assert "60 % (1)" in text
    assert "(1) Kapteyn et al. 2021\n" in text
    assert f"Report: {out / 'report.html'}" in text
    error = refused(*arguments)
    assert "holds a run already" in error
    assert len(error.strip().splitlines()) == 1
    said(*arguments, "--replace", "--quiet")
    captured = capsys.readouterr()
    assert captured.out == captured.err == ""
    said("run", "--resume", str(out), "--quiet")
    (out / "report.html").unlink(missing_ok=True)
    record = json.loads(said(*arguments, "--replace", "--json", "--no-report"))
    assert record["folder"] == str(out)
    assert record["report"] is None
    assert record["scenario"] == "level_turns"
    assert {figure["key"] for figure in record["figures"]} >= {"fallback_delay", "policy_switch_damage"}
    assert not (out / "report.html").exists()


@pytest.mark.usefixtures("no_report")
def test_a_scenario_without_references_has_no_column_for_them(tmp_path: Path, library_file: Path) -> None:
    arguments = ["--out", str(tmp_path / "run"), "--strain-library", str(library_file)]
    text = said("run", "growing_damage", *arguments)
    assert "filtered rms error of z1" in text
    assert "reference" not in text


def test_usage_errors_end_with_2(tmp_path: Path) -> None:
    for arguments in (
        ["run"],
        ["run", "level_turns", "--nonsense"],
        ["run", "level_turns", "--seed", "-1"],
        ["run", "--resume", str(tmp_path), "--seed", "3"],
        ["run", "--resume", str(tmp_path), "--out", str(tmp_path)],
        ["nonsense"],
    ):
        assert "Traceback" not in refused(*arguments, code=2)


def test_errors_of_the_packages_are_one_sentence_and_1(tmp_path: Path) -> None:
    broken = tmp_path / "broken.toml"
    broken.write_text("format = 3", encoding="utf-8")
    for arguments, word in (
        (["run", "no_such_scenario"], "no_such_scenario"),
        (["run", str(broken)], "format"),
        (["run", "--resume", str(tmp_path / "nothing")], "no run folder"),
        (
            ["run", "level_turns", "--out", str(tmp_path / "x"), "--strain-library", str(tmp_path)],
            "UAVconfig.json",
        ),
        (["fmu", "info", str(tmp_path / "no.fmu")], "no.fmu"),
        (["fmu", "info", str(broken)], "broken.toml"),
        (["fmu", "check", str(tmp_path / "no.fmu")], "no.fmu"),
        (["wing", "--design", str(tmp_path / "no.toml")], "no.toml"),
        (["calibrate", "ringdown", "--data", str(tmp_path / "no.csv")], "no.csv"),
    ):
        error = refused(*arguments)
        assert word in error.replace("\n", " ")
        assert "Traceback" not in error
    assert not (tmp_path / "x").exists()


def test_an_error_that_is_not_ours_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(terminal, "with_common_options", lambda _app: lambda **_: broken())
    monkeypatch.setattr(sys, "argv", ["uav-twin"])
    with pytest.raises(ZeroDivisionError):
        cli.main()
    assert issubclass(ScenarioError, ValueError)


def test_ctrl_c_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, library_file: Path
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("twin_master.workflow._fly", interrupted)
    out = tmp_path / "run"
    code = call(
        monkeypatch, "run", "level_turns", "--out", str(out), "--strain-library", str(library_file), "-q"
    )
    assert code == 130
    assert f"--resume {out}" in capsys.readouterr().err


def test_the_master_script_is_the_same_command(tmp_path: Path, library_file: Path) -> None:
    environment = os.environ | {"COLUMNS": "200"}
    for module, arguments in (("twin_master", []), ("uav_twin", ["run"])):
        result = subprocess.run(
            [sys.executable, "-m", module, *arguments, "--resume", str(tmp_path / "nothing")],
            capture_output=True, text=True, check=False, env=environment,
        )  # fmt: skip
        assert result.returncode == 1
        assert "there is no run folder" in result.stderr


def test_start_up_is_lazy() -> None:
    """`--help` must not import what only a flight needs."""
    code = (
        "import sys, uav_twin.cli\n"
        "heavy = {'numpy', 'scipy', 'skfem', 'pymor', 'fmpy', 'xarray', 'matplotlib', 'numba', 'pydantic'}\n"
        "heavy |= {'pint', 'openpyxl'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_the_page_of_commands_is_that_of_the_commands() -> None:
    """If this fails: python -m benchmarks.command_page."""
    text = command_page.PAGE.read_text(encoding="utf-8")
    assert command_page.page(text) == text
    assert command_page.page(text.replace("uav-twin scenarios\n", "")) == text
