"""`python -m evidence.identification` as a developer calls it."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from evidence.identification.__main__ import main
from evidence.identification.design_file import design_toml
from fe.wing.design import load_design, parse_design
from tests import command_line
from tests.kept import ROOT


def call(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    return command_line.call(monkeypatch, *words, main=main)


def test_files_that_are_missing_or_wrong_end_in_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    published_folder: Path,
    tmp_path: Path,
) -> None:
    out = tmp_path / "out"
    empty = tmp_path / "empty"
    empty.mkdir()
    assert call(monkeypatch, "--data", str(empty), "--out", str(out)) == 1
    assert "holds 0 files UAVconfig.json" in capsys.readouterr().err
    short = load_design().changed(gauges={"positions": load_design().gauges.positions[:8]})
    start = tmp_path / "short.toml"
    start.write_text(design_toml(short, {}))
    assert call(monkeypatch, "--data", str(published_folder), "--design", str(start), "--out", str(out)) == 1
    assert "8 gauges" in capsys.readouterr().err
    assert not out.exists()


def test_the_command_is_that_of_the_module(tmp_path: Path) -> None:
    words = (sys.executable, "-m", "evidence.identification", "--data", str(tmp_path / "none"), "--quiet")
    done = subprocess.run(words, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 1
    assert done.stderr.endswith("is not a folder; give the one that holds the authors' two folders.\n")
    assert done.stderr.count("\n") == 1


@pytest.mark.long
def test_a_run_leaves_a_design_a_record_and_a_report(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    published_folder: Path,
    tmp_path: Path,
) -> None:
    coarse = load_design().changed(mesh={"refinement": 0.25, "span_size": 0.06, "chord_size": 0.2})
    start = tmp_path / "start.toml"
    start.write_text(design_toml(coarse, {}))
    out = tmp_path / "out"
    arguments = ("--data", str(published_folder), "--design", str(start), "--out", str(out), "--steps", "1")
    # One model is not enough for a wing that never was; the result is written and the exit code says so.
    assert call(monkeypatch, *arguments) == 1
    captured = capsys.readouterr()
    assert "has not converged" in captured.err
    assert "limiting gauge" in captured.out
    assert sorted(path.name for path in out.iterdir()) == [
        "identification.json",
        "report.html",
        "uav_wing.toml",
    ]
    record = json.loads((out / "identification.json").read_text())
    assert record["converged"] is False
    assert "evidence.identification" in record["provenance"]["source_hashes"]
    assert len(record["parameters"]) == len(record["singular_values"])
    assert {row["name"] for row in record["comparison"] if not row["fitted"]} >= {"strain ratios at (80, 80)"}
    written = parse_design(tomllib.loads((out / "uav_wing.toml").read_text()))
    assert written.mesh == coarse.mesh
    page = (out / "report.html").read_text()
    assert page.count("<figure") == 3
    assert "http://" not in page.replace("http://www.w3.org", "")
