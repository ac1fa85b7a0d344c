"""`python -m evidence.identification` as a developer calls it."""

import json
import tomllib

import pytest

from evidence.identification.__main__ import main
from evidence.identification.design_file import design_toml
from fe.wing.design import load_design, parse_design
from tests import command_line


def test_a_folder_that_is_not_there_is_one_line(monkeypatch, capsys, tmp_path):
    out = tmp_path / "out"
    words = "--data", tmp_path / "none", "--out", out, "--quiet"
    assert command_line.call(monkeypatch, *words, main=main) == 1
    said = capsys.readouterr().err
    assert said.endswith("is not a folder; give the one that holds the authors' two folders.\n")
    assert said.count("\n") == 1
    assert not out.exists()


@pytest.mark.long
def test_a_run_leaves_a_design_a_record_and_a_report(monkeypatch, capsys, published_folder, tmp_path):
    coarse = load_design().changed(mesh={"refinement": 0.25, "span_size": 0.06, "chord_size": 0.2})
    start = tmp_path / "start.toml"
    start.write_text(design_toml(coarse, {}))
    out = tmp_path / "out"
    arguments = ("--data", str(published_folder), "--design", str(start), "--out", str(out), "--steps", "1")
    # One model is not enough for a wing that never was; the result is written and the exit code says so.
    assert command_line.call(monkeypatch, *arguments, main=main) == 1
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
