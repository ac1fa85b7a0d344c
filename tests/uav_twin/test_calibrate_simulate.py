"""`uav-twin calibrate simulate` on the command line: folders that the other commands read."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from calibration.dynamics.records import read_records
from calibration.dynamics.ringdown import Frequencies
from calibration.dynamics.trials import fit_trials
from calibration.geometry import read_lengths
from calibration.static.experiments import read_measurements
from calibration.wing.lab_data import read_weighed_mass
from fe.wing.design import SHIPPED_DESIGN
from tests.command_line import call, said

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wing")]


def simulate(monkeypatch: pytest.MonkeyPatch, out: Path, *arguments: object) -> int:
    return call(
        monkeypatch, "calibrate", "simulate", "--out", out, "--sampling-rate", 250, "--seed", 3, *arguments
    )


def test_a_folder_with_its_truth(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    out = tmp_path / "lab"
    given = ("--e", 0.99, "--servo-mass", 0.18, "--pitot-mass", 0.11, "--alpha", 0.9, "--beta", 5e-4)
    assert simulate(monkeypatch, out, *given) == 0
    truth = json.loads((out / "truth.json").read_text(encoding="utf-8"))
    assert truth["young_modulus_factor"] == 0.99
    assert (truth["servo_mass"], truth["pitot_mass"]) == (0.18, 0.11)
    assert (truth["damping_alpha"], truth["damping_beta"], truth["seed"]) == (0.9, 5e-4, 3)
    assert read_measurements(out).count == 8
    assert read_lengths(out).semi_span.measured == pytest.approx(1.828, abs=5e-4)
    assert read_weighed_mass(out).value == pytest.approx(0.47, abs=4e-3)
    records = read_records(out)
    assert len(records) == 5
    trials = fit_trials(records, Frequencies.FITTED)
    from fe.reduction.model_cache import reduced_model

    modes = reduced_model().modes(
        young_modulus_factor=0.99, stiffness_loss=(0.0, 0.0), servo_mass=0.18, pitot_mass=0.11
    )
    first, second = modes.followed
    assert trials.average("frequency", 0).mean == pytest.approx(modes.frequency[first], rel=1e-3)
    assert trials.average("frequency", 1).mean == pytest.approx(modes.frequency[second], rel=5e-3)
    # the same again, bit for bit
    assert simulate(monkeypatch, tmp_path / "again", *given) == 0
    for file in sorted(path for path in out.rglob("*") if path.is_file()):
        assert file.read_bytes() == (tmp_path / "again" / file.relative_to(out)).read_bytes()
    # the command line takes it
    told = json.loads(said("calibrate", "--data", out, "--json"))
    assert told["laboratory"].startswith("step1/geometry_data.csv read")
    assert [item["name"] for item in told["quantities"]][:2] == ["tip_stiffness", "frequency_1"]
    assert {"weighed_mass", "frequency_1"} <= {reading["name"] for reading in told["readings"]}
    said("calibrate", "ringdown", "--data", out, "--fitted")


@pytest.mark.long
def test_the_fmu_gives_the_same_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    fmu = tmp_path / "wing.fmu"
    said("fmu", "build", "--out", fmu)
    assert simulate(monkeypatch, tmp_path / "model") == 0
    assert simulate(monkeypatch, tmp_path / "flown", "--fmu", fmu) == 0
    ours, theirs = read_measurements(tmp_path / "model"), read_measurements(tmp_path / "flown")
    assert theirs.displacement == pytest.approx(ours.displacement, rel=1e-8)
    for expected, seen in zip(
        read_records(tmp_path / "model"), read_records(tmp_path / "flown"), strict=True
    ):
        assert seen.signal == pytest.approx(expected.signal, abs=1e-9)
    truth = json.loads((tmp_path / "flown" / "truth.json").read_text(encoding="utf-8"))
    assert truth["bench"] == "wing.fmu"


def test_refusals(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "lab"
    assert simulate(monkeypatch, out, "--servo-mass", 2) != 0
    assert "servo_mass must lie between" in " ".join(capsys.readouterr().err.split())
    assert not out.exists()
    assert simulate(monkeypatch, out, "--fmu", tmp_path / "none.fmu", "--frequency-error", 0.01, 0.0) != 0
    assert "--frequency-error needs the reduced model" in " ".join(capsys.readouterr().err.split())
    assert simulate(monkeypatch, out, "--fmu", tmp_path / "none.fmu") != 0
    assert not out.exists()
    out.mkdir()
    (out / "mine.txt").write_text("mine", encoding="utf-8")
    assert simulate(monkeypatch, out) != 0
    assert "is not an empty folder" in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in out.iterdir()] == ["mine.txt"]


@pytest.mark.long
def test_another_wing_is_measured_as_it_was_drawn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    text = SHIPPED_DESIGN.read_text(encoding="utf-8")
    for old, new in (("semi_span = 1.828", "semi_span = 1.9"), ("refinement = 1.0", "refinement = 0.25")):
        assert old in text
        text = text.replace(old, new)
    design = tmp_path / "longer.toml"
    design.write_text(text, encoding="utf-8")
    out = tmp_path / "lab"
    assert simulate(monkeypatch, out, "--design", design) == 0
    assert json.loads((out / "truth.json").read_text(encoding="utf-8"))["semi_span"] == 1.9
    lengths = read_lengths(out)
    assert lengths.semi_span.designed == pytest.approx(1.9)
    assert lengths.semi_span.measured == pytest.approx(1.9, abs=5e-4)
