"""`uav-twin calibrate` of a wing, `simulate` before it, and what follows: files, FMUs, flights."""

import errno
import json
import os
import re
import shutil
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from fmpy import read_model_description

from calibration.dynamics.records import read_records
from calibration.dynamics.trials import average, fit_trials
from calibration.geometry import published_lengths, read_lengths
from calibration.joint.wing_table import weighed
from calibration.result.record import STATE, Calibration
from calibration.static.experiments import read_measurements
from calibration.virtual_wing import VirtualWing, measure_load_test, measure_ring_down
from calibration.wing.lab_data import read_weighed_mass, write_lab_folder
from fe.runtime.state import DigitalState
from fe.wing.design import SHIPPED_DESIGN
from tests.command_line import command, refused, said
from tests.kept import FE, ROOT, kept_folder
from tests.refusals import Inputs
from tests.twin_master.runs import check_same, edited, written
from tests.wings import tip_stiffness
from uav_twin import FmiAsset, assemble, load_calibration, load_design, reduced_model

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wing")]

COARSE = ("refinement = 1.0", "refinement = 0.25")
TRUTHS = {name: DigitalState(**own) for name, own in Inputs(__file__).table("wings.toml").items()}


def simulate(out: Path, *words: object) -> tuple[Any, ...]:
    return ("calibrate", "simulate", "--out", out, "--sampling-rate", 250, "--seed", 3, *words)


def test_a_laboratory_is_simulated_with_its_truth(tmp_path):
    out = tmp_path / "lab"
    given = ("--e", 0.99, "--servo-mass", 0.18, "--pitot-mass", 0.11, "--alpha", 0.9, "--beta", 5e-4)
    said(*simulate(out, *given))
    truth = json.loads((out / "truth.json").read_text(encoding="utf-8"))
    assert truth["young_modulus_factor"] == 0.99
    assert (truth["servo_mass"], truth["pitot_mass"]) == (0.18, 0.11)
    assert (truth["damping_alpha"], truth["damping_beta"], truth["seed"]) == (0.9, 5e-4, 3)
    assert read_measurements(out).count == 8
    assert read_lengths(out).semi_span.measured == pytest.approx(1.828, abs=5e-4)
    assert read_weighed_mass(out).value == pytest.approx(0.47, abs=4e-3)
    records = read_records(out)
    assert len(records) == 5
    trials = fit_trials(records, free=True)
    modes = reduced_model().modes(
        young_modulus_factor=0.99, stiffness_loss=(0.0, 0.0), servo_mass=0.18, pitot_mass=0.11
    )
    for mode, (place, near) in enumerate(zip(modes.followed, (1e-3, 5e-3), strict=True)):
        found = average(trials, "frequency", mode).mean
        assert found == pytest.approx(modes.frequency[place], rel=near)
    said(*simulate(tmp_path / "again", *given))  # bit for bit
    for file in sorted(path for path in out.rglob("*") if path.is_file()):
        assert file.read_bytes() == (tmp_path / "again" / file.relative_to(out)).read_bytes()
    coarse = written(tmp_path, SHIPPED_DESIGN.read_text(encoding="utf-8"), COARSE)
    told = json.loads(said("calibrate", "--data", out, "--design", coarse, "--json"))
    assert told["laboratory"].startswith("step1/geometry_data.csv read")
    assert [item["name"] for item in told["quantities"]][:2] == ["tip_stiffness", "frequency_1"]
    assert {"weighed_mass", "frequency_1"} <= {reading["name"] for reading in told["readings"]}
    said("calibrate", "ringdown", "--data", out, "--fitted")


@pytest.mark.long
def test_an_fmu_and_another_design_are_measured_alike(tmp_path):
    fmu, model, flown = tmp_path / "wing.fmu", tmp_path / "model", tmp_path / "flown"
    said("fmu", "build", "--out", fmu)
    said(*simulate(model))
    said(*simulate(flown, "--fmu", fmu))
    ours, theirs = read_measurements(model), read_measurements(flown)
    assert theirs.displacement == pytest.approx(ours.displacement, rel=1e-8)
    for expected, seen in zip(read_records(model), read_records(flown), strict=True):
        assert seen.signal == pytest.approx(expected.signal, abs=1e-9)
    assert json.loads((flown / "truth.json").read_text(encoding="utf-8"))["bench"] == "wing.fmu"
    changes = ("semi_span = 1.828", "semi_span = 1.9"), COARSE
    design = written(tmp_path, SHIPPED_DESIGN.read_text(encoding="utf-8"), *changes)
    said(*simulate(tmp_path / "longer", "--design", design))
    truth = json.loads((tmp_path / "longer" / "truth.json").read_text(encoding="utf-8"))
    lengths = read_lengths(tmp_path / "longer").semi_span
    assert (truth["semi_span"], lengths.designed) == (1.9, pytest.approx(1.9))
    assert lengths.measured == pytest.approx(1.9, abs=5e-4)


@pytest.fixture(scope="module")
def labs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Laboratories of two wings of the published planform, measured with errors."""
    made = {}
    for number, (name, truth) in enumerate(TRUTHS.items()):
        made[name] = tmp_path_factory.mktemp(name) / "lab"
        bench = VirtualWing(reduced_model(), truth)
        write_lab_folder(
            made[name],
            lengths=published_lengths(),
            load_test=measure_load_test(bench, number),
            records=measure_ring_down(bench, number, trials=3, noise=2e-5),
            total_mass=weighed(2.0 * truth.servo_mass + truth.pitot_mass, 1e-3),
        )
    return made


class Calibrated(NamedTuple):
    """The soft wing, calibrated: the words without --out, the folder, what was said, the result."""

    words: tuple[object, ...]
    out: Path
    said: str
    result: Calibration


@pytest.fixture(scope="module")
def soft(labs: dict[str, Path]) -> Calibrated:
    lab = labs["soft"]
    words, out = ("calibrate", "--data", lab, "--asset", "soft", "--fitted"), lab.with_name("calibrated")
    measured = [path.read_bytes() for path in sorted(lab.rglob("*")) if path.is_file()]
    places = (*FE, ROOT / "calibration", ROOT / "uav_twin")
    told = kept_folder(out, lambda: said(*words, "--out", out), places, measured)
    return Calibrated(words, out, told, load_calibration(out / "calibration.nc"))


def test_the_truth_lies_in_the_posterior(soft):
    result, truth = soft.result, TRUTHS["soft"]
    assert result.asset == "soft"
    assert result.design_hash == reduced_model().design_hash  # published lengths: nothing was built anew
    for entry in STATE:
        off = result.mean(entry) - getattr(truth, entry)
        assert abs(off) < 4.0 * result.standard_deviation(entry), entry
    mass = 2.0 * result.samples[:, 1] + result.samples[:, 2]
    np.testing.assert_allclose(mass, 2.0 * truth.servo_mass + truth.pitot_mass, atol=6e-3)


def test_the_published_figures_give_table_1():
    rows = {line.split("  ")[0].strip(): line for line in said("calibrate").splitlines() if "±" in line}
    table = {name: re.findall(r"[−+]?[\d.]+", line.replace(name, "", 1)) for name, line in rows.items()}
    assert table["modulus factor e"][4:8] == ["1.0073", "0.0103", "1.0073", "0.0103"]  # procedure and paper
    near = {"servo mass, g": 1.0, "pitot mass, g": 2.0, "alpha, 1/s": 0.01, "beta, ms": 0.01}
    for name, off in near.items():
        assert float(table[name][4]) == pytest.approx(float(table[name][6]), abs=off)
    lengths = {"semi-span, mm": "1828.00", "root chord, mm": "433.00", "tip chord, mm": "260.00"}
    assert {name: table[name][6] for name in lengths} == lengths


def test_what_a_calibration_leaves_and_says(soft):
    for word in (
        "Step 1: step1/geometry_data.csv read",
        "8 pairs",
        "initialconditiondata_1.DAT to",
        "Report:",
    ):
        assert word in soft.said
    names = {path.relative_to(soft.out).as_posix() for path in soft.out.rglob("*") if path.is_file()}
    figures = ["load_test", "modes", "posterior", "prior_and_posterior", "procedure", "readings", "ring_down"]
    assert names == {
        "calibration.nc", "report.html", "table_1.csv", "wing.vtu", "modes.vtu",
        *(f"figures/{name}.{kind}" for name in figures for kind in ("svg", "png")),
    }  # fmt: skip
    page = (soft.out / "report.html").read_text(encoding="utf-8")
    assert "Calibration of soft" in page
    assert "This calibration beside Table 1 of the paper" in page
    assert not re.search(r"https?://", page.replace("http://www.w3.org", ""))  # nothing is fetched
    assert not re.search(r"""(?<=[\s"'>(=])/(?:[\w.-]+/)+""", page)  # no folder of this machine
    result = soft.result
    assert [reading.experiment for reading in result.readings] == [
        *["planform"] * 3, "load test", "weighing", *["ring-down"] * 4,
    ]  # fmt: skip
    for experiment in ("load test", "ring-down"):
        assert result.error(experiment, prior=True) < result.error(experiment) <= 0.0
    assert -0.5 < result.error("weighing") <= 0.0
    assert all(0.0 < result.kept_share(prior.name) < 1.0 for prior in result.priors)
    assert result.information > 5.0
    assert result.mean("semi_span") == pytest.approx(1.828005, abs=1e-6)


@pytest.mark.long
def test_a_calibration_repeats_to_the_byte(soft, tmp_path):
    said(*soft.words, "--out", tmp_path)
    check_same(tmp_path, soft.out, "calibration.nc", "report.html", "table_1.csv", "figures/posterior.svg")
    said(*soft.words, "--no-report", "--out", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"calibration.nc", "table_1.csv"}
    check_same(tmp_path, soft.out, "calibration.nc", "table_1.csv")


@pytest.mark.long
def test_a_calibrated_wing_is_an_fmu_of_its_own(soft, tmp_path):
    described, seen = {}, {}
    for name, given in (("drawn", ()), ("soft", ("--calibration", soft.out / "calibration.nc"))):
        fmu = tmp_path / f"{name}.fmu"
        said("fmu", "build", *given, "--out", fmu)
        described[name] = read_model_description(str(fmu))
        with FmiAsset(fmu, "scenarios/bindings/uav_wing.toml", isolated=False) as asset:
            seen[name] = asset.step({"load_factor": 3.0}, {"z1": 0.0, "z2": 0.0})
    said("fmu", "check", fmu, "--cycles", "5")
    assert described["soft"].guid != described["drawn"].guid
    assert "Calibrated for the wing 'soft'" in described["soft"].description
    start = {variable.name: variable.start for variable in described["soft"].modelVariables}
    variables = ("young_modulus_factor", "mass.servo", "mass.pitot", "damping.alpha", "damping.beta")
    assert [float(start[variable]) for variable in variables] == [soft.result.mean(e) for e in STATE]
    with zipfile.ZipFile(fmu) as archive:
        assert json.loads(archive.read("resources/calibration.json"))["asset"] == "soft"
    ratio = seen["soft"].values / seen["drawn"].values
    assert np.all(ratio > 1.0)
    assert seen["soft"].extra["tip_displacement"] > seen["drawn"].extra["tip_displacement"]
    (drawn,) = (v.start for v in described["drawn"].modelVariables if v.name == variables[0])
    assert 1.0 < np.median(ratio) < float(drawn) / soft.result.mean("young_modulus_factor") * 1.01


def test_missing_steps_are_told_and_a_full_disk_leaves_nothing(labs, tmp_path, monkeypatch):
    # The published frequencies ask the softer wing for masses beyond the model.
    lab = tmp_path / "lab"
    shutil.copytree(labs["stiff"] / "step2", lab / "step2")
    replace, count = Path.replace, 0

    def full(self: Path, target: Path) -> Path:
        nonlocal count
        count += 1
        if count > 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", full)
    out = tmp_path / "out"
    done = command("calibrate", "--data", lab, "--procedure", "paper", "--out", out, "--no-report")
    lines = done.stdout.splitlines()
    assert lines[0] == "Step 1: published lengths (Kapteyn et al. 2021, Table 1)."
    assert lines[1] == "Step 2: step2/load_displacement_measurements.csv read, 8 pairs."
    assert lines[2].startswith("Step 3: published frequencies and damping ratios")
    assert "modulus factor e" in done.stdout
    assert done.returncode == 1
    assert "No space is left on the disk" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["lab"]


@pytest.mark.long
def test_records_may_be_left_aside(labs):
    out = said("calibrate", "--data", labs["stiff"], "--published", "--procedure", "paper")
    assert "Nothing was written" in out.splitlines()[-1]
    assert "Step 3: records left aside as asked; published" in out
    assert re.search(r"frequency_1 +Hz +5\.649 ±", out)


def measured_planform(folder: Path, semi_span: float) -> Path:
    """A laboratory folder with nothing but lengths, semi-span in mm."""
    file = folder / "lab" / "step1" / "geometry_data.csv"
    file.parent.mkdir(parents=True)
    rows = f"length,1828.8,{semi_span}\nchord_{{root}},435.61,433\nchord_{{tip}},261.112,260\n"
    file.write_text("parameter,designed,manufactured\n" + rows, encoding="utf-8")
    return folder / "lab"


@pytest.mark.long
def test_the_model_follows_the_measured_planform(tmp_path):
    """The tailored wing is shorter and stiffer than the one on the drawing (a coarse mesh, for speed)."""
    text = SHIPPED_DESIGN.read_text(encoding="utf-8")
    coarse = written(tmp_path, text, COARSE)
    words = ("--data", measured_planform(tmp_path, 1818.0), "--design", coarse, "--out", tmp_path / "out")
    said("calibrate", *words, "--asset", "short wing", "--no-report")
    result = load_calibration(tmp_path / "out" / "calibration.nc")
    assert result.design.planform.semi_span == 1.8181  # prior and measurement together, to 0.1 mm
    assert result.mean_state().geometry.semi_span == 1.8181
    model = reduced_model(result.design)
    assert model.design_hash == result.design_hash
    assert result.prior_moments("tip_stiffness")[0] == pytest.approx(model.tip_stiffness(1.0), rel=1e-3)
    # against the full model of the wing as drawn, by the beam's k ~ 1 / L^3
    expected = (1.828 / 1.8181) ** 3 * tip_stiffness(assemble(load_design(coarse)))
    assert model.tip_stiffness(1.0) == pytest.approx(expected, rel=5e-3)


def test_a_design_that_the_measured_planform_spoils_is_refused(tmp_path):
    text = SHIPPED_DESIGN.read_text(encoding="utf-8")
    last = text.rindex("span_end = ")
    design = written(tmp_path, text[:last] + re.sub(r"^span_end = .*", "span_end = 1.825", text[last:]))
    lab = measured_planform(tmp_path, 1815.0)
    assert "defects[1] ends 1.825 m from the root, off the wing of 1.8151 m" in refused(
        "calibrate", "--data", lab, "--design", design, "--out", tmp_path / "out"
    )
    assert not (tmp_path / "out").exists()


LENGTHS, PAIRS, RECORD = (
    "step1/geometry_data.csv", "step2/load_displacement_measurements.csv", "step3/initialconditiondata_1.DAT",
)  # fmt: skip


def one_mode(text: str) -> str:
    """Write a record of one mode over the times of another record."""
    time = np.loadtxt(text.splitlines())[:, 0]
    signal = 0.01 * np.exp(-0.9 * time) * np.cos(2.0 * np.pi * 5.65 * time)
    return "\n".join(f"{t:.9e} {s:.9e} 0" for t, s in zip(time, signal, strict=True))


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [  # one of each step; tests/calibration has the others
        (LENGTHS, lambda text: edited(text, ("1828.8,1828", "1.8288,1.828")), "looks like m: give it in mm"),
        (PAIRS, lambda text: edited(text, ("load,", "force,")), "no column 'load', which a load test needs"),
        (RECORD, one_mode, "two spectral peaks are needed"),
    ],
    ids=["lengths", "pairs", "record"],
)
def test_a_wrong_file_is_one_sentence_and_leaves_nothing(labs, tmp_path, name, change, sentence):
    lab, out = tmp_path / "lab", tmp_path / "out"
    shutil.copytree(labs["soft"], lab)
    (lab / name).write_text(change((lab / name).read_text(encoding="utf-8")), encoding="utf-8")
    assert sentence in refused("calibrate", "--data", lab, "--out", out)
    assert not out.exists()
