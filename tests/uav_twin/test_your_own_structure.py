"""The page of ten minutes on a structure of one's own: its files and commands run as they stand."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

from uav_twin import cli

PAGE = Path(__file__).parents[2] / "docs" / "your_own_structure.md"


def test_the_page_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """From the mesh to the report; what the page prints of it is what comes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("COLUMNS", "80")
    text = PAGE.read_text(encoding="utf-8")
    blocks = re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    (script,) = (block for language, block in blocks if language == "python")
    exec(compile(script, str(PAGE), "exec"), {})
    structure, mission = (block for language, block in blocks if language == "toml")
    Path("my_part.toml").write_text(structure, encoding="utf-8")
    Path("my_mission.toml").write_text(mission, encoding="utf-8")
    commands = re.findall(r"^    uav-twin (.*)$", text, re.MULTILINE)
    assert [command.split()[:2] for command in commands[:3]] == [
        ["structure", "info"], ["structure", "reduce"], ["structure", "fmu"]
    ]  # fmt: skip
    printed = ""
    for command in commands:
        monkeypatch.setattr(sys, "argv", ["uav-twin", *command.split()])
        with pytest.raises(SystemExit) as caught:
            cli.main()
        assert not caught.value.code
        printed += capfd.readouterr().out
    came = [" ".join(line.split()) for line in printed.splitlines()]
    for language, block in blocks:
        for line in block.splitlines() if not language else ():
            if line and line != "..." and not re.search(r"e-0\d$", line):  # measured errors differ by machine
                assert " ".join(line.split()) in came
    summary = json.loads(Path("first_run/summary.json").read_text(encoding="utf-8"))
    assert summary["asset"] == "FMU of the structure my_part"
    page = Path("first_run/report.html").read_text(encoding="utf-8")
    assert "stiffness loss of the heel" in page
    assert not re.search(r"\b[Ww]ings?\b", page)
    assert Path("first_run/structure.vtu").is_file()
