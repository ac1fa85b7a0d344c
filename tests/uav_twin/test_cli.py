"""The command line: `run`, `scenario check` and `wing verify`, and how it ends when something is wrong."""

import json
import os
import re
import subprocess
import sys
from importlib.metadata import version

import pytest

from benchmarks import command_page
from fe.verification import wing_checks
from fe.verification.wing_checks import Check
from reporting import terminal
from scenarios import scenario_files
from tests.command_line import command, refused, said
from tests.refusals import Inputs
from tests.twin_master.runs import text_of, written
from twin_master.errors import MissionInputError, ScenarioError
from twin_master.workflow import check_scenario
from uav_twin import assemble, cli, load_design, load_scenario


def leaves(command: object, *words: str) -> list[tuple[tuple[str, ...], object]]:
    """Return every command with the words that call it."""
    found = [(words, command)]
    for name, inner in getattr(command, "commands", {}).items():
        found += leaves(inner, *words, name)
    return found


def test_every_command_has_help_and_the_common_options():
    assert said("--version") == f"uav-twin {version('uav-twin')}\n"
    everything = leaves(terminal.with_common_options(cli.app))
    assert len(everything) > 25
    for words, leaf in everything:
        given = [option for parameter in leaf.params for option in parameter.opts]  # type: ignore[attr-defined]
        for option in ("--quiet", "-q", "--verbose", "-v"):
            assert given.count(option) == 1, (words, option)
        assert leaf.help, words  # type: ignore[attr-defined]


@pytest.mark.usefixtures("no_report")
def test_run_prints_figures_and_report(tmp_path, library_file):
    out = tmp_path / "run"
    words = ("run", "level_turns", "--out", out, "--strain-library", library_file)
    text = said(*words, "--seed", "3")
    assert re.search(r"first control from z1 +60 % +60 % \(1\)", text)
    assert all(part in text for part in ("(1) Kapteyn et al. 2021\n", f"Report: {out / 'report.html'}"))
    assert "holds a run already" in refused(*words)
    done = command(*words, "--replace", "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    said("run", "--resume", out, "--quiet")
    (out / "report.html").unlink(missing_ok=True)
    record = json.loads(said(*words, "--replace", "--json", "--no-report"))
    assert (record["folder"], record["report"], record["scenario"]) == (str(out), None, "level_turns")
    assert {figure["key"] for figure in record["figures"]} >= {"fallback_delay", "policy_switch_damage"}
    assert not (out / "report.html").exists()
    text = said("run", "growing_damage", "--out", tmp_path / "other", "--strain-library", library_file)
    assert "filtered rms error of z1" in text
    assert "reference" not in text  # the scenario has none, and no column for them


def test_the_traceback_is_told_where_it_is_asked_for():
    sentence = refused("scenario", "check", "nowhere")
    told = command("scenario", "check", "nowhere", "-v").stderr
    assert "Traceback" in told
    assert told.strip().endswith(sentence)


def test_an_error_that_is_not_ours_is_not_hidden(monkeypatch):
    def broken() -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(terminal, "with_common_options", lambda _app: lambda **_: broken())
    monkeypatch.setattr(sys, "argv", ["uav-twin"])
    with pytest.raises(ZeroDivisionError):
        cli.main()
    assert issubclass(ScenarioError, ValueError)


def test_ctrl_c_ends_every_command_alike_and_says_how_to_go_on(monkeypatch, tmp_path, library_file):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("twin_master.workflow._fly", interrupted)
    monkeypatch.setattr("fe.wing.design.load_design", interrupted)
    words = ("run", "level_turns", "--out", tmp_path / "run", "--strain-library", library_file, "-q")
    assert f"--resume {tmp_path / 'run'}" in refused(*words, code=130)
    assert refused("wing", code=130) == "Interrupted."


def test_the_master_script_is_the_same_command(tmp_path):
    line = [sys.executable, "-m", "twin_master", "--resume", str(tmp_path / "nothing")]
    environment = os.environ | {"COLUMNS": "200"}
    done = subprocess.run(line, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 1
    assert "there is no run folder" in done.stderr


def test_start_up_is_lazy():
    """`--help` must not import what only a flight needs, nor a name from Python any package."""
    heavy = "numpy scipy skfem pymor fmpy xarray matplotlib numba pydantic pint openpyxl"
    code = f"""import sys, uav_twin
print('numpy' in sys.modules or 'fe' in sys.modules)
import uav_twin.cli
print(sorted(set('{heavy}'.split()) & set(sys.modules)))"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False", "[]"]


def test_the_page_of_commands_is_that_of_the_commands():
    """If this fails: python -m benchmarks.command_page."""
    text = command_page.PAGE.read_text(encoding="utf-8")
    assert command_page.page(text) == text
    assert command_page.page(text.replace("uav-twin scenarios\n", "")) == text


def test_a_scenario_is_described_as_data():
    record = json.loads(said("scenario", "check", "level_turns", "--json", "-q"))
    assert (record["states"], record["turns"], record["sensors"]) == (25, 50, 24)
    # at least predictions (E, S, U, G), transitions (U, S, S) and beliefs of 60 steps
    assert record["memory"] > 8 * (100 * 25 * 2 * 24 + 2 * 25**2 + 25 * 60)
    assert said("scenario", "check", "level_turns", "-q") == ""


@pytest.mark.parametrize("name", sorted(scenario_files()))
def test_every_shipped_scenario_is_sound_or_says_what_it_needs(name):
    if name == "model_mismatch":  # it names no strain library of its own
        with pytest.raises(MissionInputError, match="--strain-library FILE"):
            check_scenario(load_scenario(name))
        return
    found = check_scenario(load_scenario(name))
    assert found["name"] == name
    assert found["memory"] > 0


@pytest.mark.parametrize(("old", "new", "sentence"), Inputs(__file__).table("changed.toml")["scenario"])
def test_a_fault_is_one_sentence(old, new, sentence, tmp_path):
    path = written(tmp_path, text_of("level_turns", (old, new)))
    done = command("scenario", "check", path)
    assert (done.returncode, done.stdout) == (1, "")
    assert sentence in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_checks_of_a_wing_are_listed_and_kept(monkeypatch, tmp_path):
    nan, out = float("nan"), tmp_path / "out"
    checks = [Check("patch test", "strain", 1e-15, 1e-12), Check("mesh", "order", nan)]
    monkeypatch.setattr(wing_checks, "all_checks", lambda *_, **__: checks)
    text = said("wing", "verify", "--out", out)
    assert "patch test" in text
    assert "kept" in text
    record = json.loads((out / "verification.json").read_text())
    assert [check["passed"] for check in record["checks"]] == [True, True]
    assert record["checks"][1]["value"] is None
    assert record["design_hash"] == load_design().hash
    assert "not an empty folder" in refused("wing", "verify", "--out", out)
    checks[:] = [Check("wing", "mass", 1e-3, 1e-10), Check("wing", "energy", nan, 1e-5)]
    done = command("wing", "verify")
    assert (done.returncode, done.stdout.count("BROKEN")) == (1, 2)
    assert "2 of 2 checks broke their limit: wing, mass; wing, energy." in done.stderr


def test_every_check_of_a_coarse_wing_is_kept_and_convergence_names_every_gauge():
    design = load_design().changed(mesh={"refinement": 0.25})
    checks = list(wing_checks.balance_checks(assemble(design)))
    assert [check.name for check in checks[1:]] == ["mass", "reaction", "root moment", "energy and work"]
    assert all(check.limit is not None for check in checks)
    assert [check.name for check in checks if not check.passed] == []
    # Three coarse meshes: the names and the kind of figures, not their size.
    checks = list(wing_checks.convergence_checks(design, (0.25, 0.3, 0.36), limited=False))
    names = [check.name for check in checks]
    assert names[:3] == ["tip stiffness", "first bending", "second bending"]
    assert [name for name in names if name.startswith("gauge ")] == [f"gauge {n}" for n in range(1, 25)]
    assert all("order" in check.note or "monotone" in check.note for check in checks[:3])
