"""`uav-twin calibrate campaign` as a user calls it."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from calibration.result.file import load_calibration, save_calibration
from calibration.result.record import Calibration
from scenarios import structure_files
from tests.command_line import refused, said

MODEL = """format = 1
name = "spring"
mass = 2.0
stiffness = 1000.0
[damping]
ratios = [0.01]
[[input]]
name = "end"
vector = 1.0
[[output]]
name = "sag"
vector = 1.0
[[parameter]]
name = "factor"
terms = "stiffness"
mean = 1.0
deviation = 0.2
low = 0.5
high = 1.5
"""
CAMPAIGN = """format = 1
name = "spring test"
[[channel]]
name = "tip"
quantity = "displacement"
unit = "mm"
output = "sag"
noise = { standard_deviation = 0.5 }
[[trial]]
name = "up"
kind = "static"
file = "up.csv"
"""


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A folder with a campaign of a spring of 0.88 times its stiffness, and the model beside."""
    folder = tmp_path / "lab"
    folder.mkdir()
    forces = (10.0, 20.0, 30.0, 40.0)
    noise = (0.3, -0.4, 0.1, 0.2)
    rows = [f"{f},{f / 0.88 + n}" for f, n in zip(forces, noise, strict=True)]
    (folder / "up.csv").write_text("force,tip\n" + "\n".join(rows))
    (folder / "campaign.toml").write_text(CAMPAIGN)
    (tmp_path / "model.toml").write_text(MODEL)
    return folder


def test_a_campaign_gives_a_file_a_report_and_a_table(lab: Path) -> None:
    model, out = lab.parent / "model.toml", lab.parent / "out"
    shown = said("calibrate", "campaign", lab, "--model", model, "--out", out, "--asset", "spring 7")
    assert "factor" in shown
    assert "1.00 ± 0.19" in shown  # 0.20, cut off at 0.5 and 1.5
    found = load_calibration(out / "calibration.nc")
    assert (found.asset, found.model, found.source) == ("spring 7", "spring", "spring test")
    assert found.mean("factor") == pytest.approx(0.88, abs=0.02)
    page = (out / "report.html").read_text()
    assert "Calibration of spring 7" in page
    assert page.count("<figure") == 2
    first = (out / "calibration.nc").read_bytes()
    said("calibrate", "campaign", lab, "--model", model, "--out", out, "--asset", "spring 7", "--no-report")
    assert (out / "calibration.nc").read_bytes() == first
    assert [path.name for path in out.iterdir()] == ["calibration.nc"]  # no page of other figures beside it
    assert "is the calibration of spring 7, not of spring 8" in refused(
        "calibrate", "campaign", lab, "--model", model, "--out", out, "--asset", "spring 8", code=None
    )


def test_a_report_of_something_else_stays(lab: Path) -> None:
    out = lab.parent / "out"
    (out / "figures").mkdir(parents=True)
    for name in ("report.html", "figures/posterior.svg"):
        (out / name).write_text("mine")
    said("calibrate", "campaign", lab, "--model", lab.parent / "model.toml", "--out", out, "--no-report")
    assert [(out / n).read_text() for n in ("report.html", "figures/posterior.svg")] == ["mine", "mine"]


def test_a_calibration_of_the_other_kind_is_not_overwritten(
    lab: Path, make_calibration: Callable[..., Calibration]
) -> None:
    """A wing's by a campaign's and a campaign's by a wing's, of the same and of another asset."""
    model, out = lab.parent / "model.toml", lab.parent / "out"
    kept = save_calibration(make_calibration(), out / "calibration.nc")
    before, wing = kept.read_bytes(), make_calibration().asset
    for asset, words in (
        (wing, f"is the calibration of {wing} from the laboratory of a wing (`uav-twin calibrate`), and one "
               "from a campaign (`uav-twin calibrate campaign`) was asked for: choose another --out"),
        ("spring 7", f"is the calibration of {wing}, not of spring 7: choose another --out"),
    ):  # fmt: skip
        assert words in refused(
            "calibrate", "campaign", lab, "--model", model, "--out", out, "--asset", asset
        )
        assert kept.read_bytes() == before
    kept.write_bytes(before[:200])  # what nobody can read is replaced
    said("calibrate", "campaign", lab, "--model", model, "--out", out, "--asset", "spring 7", "--no-report")
    before = kept.read_bytes()
    assert load_calibration(kept).design is None
    for asset, words in (
        (
            "spring 7",
            "is the calibration of spring 7 from a campaign (`uav-twin calibrate campaign`), and one",
        ),
        ("UAV 1", "is the calibration of spring 7, not of UAV 1: choose another --out"),
    ):
        assert words in refused("calibrate", "--out", out, "--asset", asset, "--no-report")
        assert kept.read_bytes() == before


def test_json_has_the_same_figures(lab: Path) -> None:
    record = json.loads(said("calibrate", "campaign", lab, "--model", lab.parent / "model.toml", "--json"))
    (parameter,) = record["parameters"]
    assert parameter["name"] == "factor"
    assert parameter["interval_90"][0] < 0.88 < parameter["interval_90"][1]
    assert parameter["prior_left"] < 0.15
    assert record["explained"] is True
    assert record["procedure"] == "quadrature"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("[[parameter]]", "[[place]]"), "'place[1].high' are not keys of a lumped model"),
        (('unit = "mm"', 'unit = "m"'), "1000"),
        (("mean = 1.0", "mean = 1.6"), "a factor needs 0 < low <= mean <= high"),
        (('unit = "mm"', 'unit = "N"'), "unit"),
        ((".", ","), "line 2: 4 cells came, and the header has 2 columns. A decimal comma makes two cells"),
    ],
)
def test_what_is_wrong_is_one_sentence_and_nothing_is_written(
    lab: Path, change: tuple[str, str], words: str
) -> None:
    changed = (lab / "up.csv",) if change[0] == "." else (lab / "campaign.toml", lab.parent / "model.toml")
    for file in changed:
        file.write_text(file.read_text().replace(*change))
    out = lab.parent / "out"
    said = refused(
        "calibrate", "campaign", lab, "--model", lab.parent / "model.toml", "--out", out, code=None
    ).strip()
    assert words in " ".join(said.split())
    assert "Traceback" not in said
    assert not out.exists()


def test_a_structure_without_its_mesh_is_refused(lab: Path) -> None:
    own = lab.parent / "my_part.toml"
    own.write_text(structure_files()["bracket"].read_text(encoding="utf-8"))
    said = refused("calibrate", "campaign", lab, "--model", own, code=None).strip()
    assert "bracket.inp" in said
    assert len(said.splitlines()) == 1


def test_a_model_without_parameters_is_refused(lab: Path) -> None:
    model = lab.parent / "model.toml"
    model.write_text(MODEL.split("[[parameter]]")[0])
    assert "has no parameter to calibrate: it lists none" in refused(
        "calibrate", "campaign", lab, "--model", model, code=None
    )
