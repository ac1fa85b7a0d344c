"""`uav-twin discrepancy` as a user calls it: example, check, run, and what goes wrong."""

import itertools
import json
import re
from pathlib import Path

import pytest

from discrepancy.files.verdict import read_patch, read_verdict_file
from tests.command_line import command, refused, said

RIG = ("--model", "single_mass_rig")


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """A static campaign of the single-mass rig with a seating offset."""
    folder = tmp_path / "rig test"
    given = ("static", str(folder), *RIG, "--seed", "3", "--effect", "seating_offset@A:offset_ratio=0.08")
    said("discrepancy", "example", *given)
    return folder


def columns(shown: str, heads: str) -> dict[str, list[str]]:
    """Return the rows of a printed table by their first cells; cells stand two blanks apart, or more."""
    lines = iter(shown.splitlines())
    assert any(re.split(r"  +", line.strip()) == heads.split("|") for line in lines)
    rows = (re.split(r"  +", line.strip()) for line in itertools.takewhile(str.strip, lines))
    return {first: rest for first, *rest in rows if rest}


def test_from_an_example_to_a_verdict(campaign, tmp_path):
    table = (campaign / "campaign.toml").read_text(encoding="utf-8")
    (campaign / "campaign.toml").write_text(table.replace("held_out = true", "held_out = false"), "utf-8")
    shown = said("discrepancy", "check", str(campaign), *RIG)
    seen = columns(shown, "effect|shows best at|parameter|detectable from|prior median")
    assert seen["seating_offset"][:2] == ["A", "offset ratio"]
    assert 0.0 < float(seen["seating_offset"][2]) < float(seen["seating_offset"][3]) == 0.03
    assert "Not testable: washout and inertia_relief. The campaign has no flight trial to fit." in shown
    assert "Hold out a trial" in shown or "held out" in shown
    out = tmp_path / "verdict"
    shown = said("discrepancy", "run", str(campaign), *RIG, "--out", str(out), "--calibrate", "1")
    stored = read_verdict_file(out / "verdict.json")
    assert f"Verdict: {stored.verdict.kind.value}" in shown
    assert "seating_offset" in stored.verdict.inclusion
    (named,) = columns(shown, "effect|place|parameter|value|90 % interval").items()
    low, high = map(float, named[1][3].split(" to "))
    assert (named[0], *named[1][:2]) == ("seating_offset", "A", "offset ratio")
    assert low < float(named[1][2]) < high
    assert stored.origin.command == (
        f"uav-twin discrepancy run '{campaign.resolve()}' --model single_mass_rig --seed 0 --calibrate 1"
    )
    assert stored.origin.short_command == (
        "uav-twin discrepancy run 'rig test' --model single_mass_rig --seed 0 --calibrate 1"
    )
    assert "seating_offset" in {effect.identifier for effect in read_patch(out / "patch.json").effects}
    tried = json.loads((out / "self_calibration.json").read_text(encoding="utf-8"))
    assert len(tried["cases"]) == 1
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "seating offset" in page
    assert str(tmp_path) not in page
    # a second time: only on demand (that it comes to the same conclusion is tested in test_workflow.py)
    assert "--replace" in refused("discrepancy", "run", str(campaign), *RIG, "--out", str(out))
    said("discrepancy", "run", str(campaign), *RIG, "--out", str(out), "--replace")
    assert not (out / "self_calibration.json").exists()


def test_faults_of_the_data_end_with_a_sentence_and_a_report(campaign, tmp_path):
    text = (campaign / "campaign.toml").read_text(encoding="utf-8")
    assert 'unit = "mm"' in text
    (campaign / "campaign.toml").write_text(text.replace('unit = "mm"', 'unit = "m"', 1), encoding="utf-8")
    table = next(path for path in campaign.glob("*.csv") if path.name != "noise.csv")
    first, *rows = table.read_text(encoding="utf-8").splitlines()
    table.write_text("\n".join([f"{first},weather", *(f"{row},1" for row in rows)]), encoding="utf-8")
    shown = command("discrepancy", "check", str(campaign), *RIG)
    assert shown.returncode == 1
    assert "Fault:" in shown.stdout
    assert "no channel has the column 'weather'" in shown.stdout
    error = refused("discrepancy", "run", str(campaign), *RIG, "--out", str(tmp_path / "v"))
    assert "1000" in error or "10^" in error or "unit" in error
    assert sorted(path.name for path in (tmp_path / "v").iterdir()) == ["report.html", "verdict.json"]
    page = (tmp_path / "v" / "report.html").read_text(encoding="utf-8")
    assert "Proof" not in page
