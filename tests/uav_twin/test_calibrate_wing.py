"""`uav-twin calibrate` of a wing, `simulate` before it, and what follows: files, FMUs, flights."""

import csv
import json
import re
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fmpy import read_model_description

from calibration.geometry import published_lengths, read_lengths
from calibration.joint.wing_table import weighed
from calibration.result.record import STATE
from calibration.static.errors_in_variables import assess_fit
from calibration.static.experiments import read_measurements
from calibration.virtual_wing import VirtualWing, measure_load_test, measure_ring_down
from calibration.wing.lab_data import read_weighed_mass, write_lab_folder
from fe.runtime.state import DigitalState
from fe.wing.design import SHIPPED_DESIGN
from fmu_asset.errors import FmuError
from fmu_asset.packing.structure_fmu import build_fmu
from tests.command_line import refused, said
from tests.twin_master.runs import check_same, written
from twin_master.assets.virtual_experiments import FmuTestBench
from uav_twin import FmiAsset, load_calibration, reduced_model

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("wing")]

COARSE = ("refinement = 1.0", "refinement = 0.25")
SOFT = DigitalState(
    young_modulus_factor=0.97, servo_mass=0.160, pitot_mass=0.150, damping_alpha=0.8, damping_beta=6.0e-4
)


def simulate(out: Path, *words: object) -> tuple[Any, ...]:
    return ("calibrate", "simulate", "--out", out, "--sampling-rate", 250, "--seed", 3, *words)


def test_a_laboratory_is_simulated_with_its_truth_and_its_records_are_fitted(tmp_path):
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
    changes = ("semi_span = 1.828", "semi_span = 1.9"), COARSE
    design = written(tmp_path, SHIPPED_DESIGN.read_text(encoding="utf-8"), *changes)
    said(*simulate(tmp_path / "longer", "--design", design))
    lengths = read_lengths(tmp_path / "longer").semi_span
    assert (lengths.designed, lengths.measured) == (pytest.approx(1.9), pytest.approx(1.9, abs=5e-4))
    words = ("--data", tmp_path / "longer", "--design", design, "--out", tmp_path / "model", "--no-report")
    told = json.loads(said("calibrate", *words, "--json"))
    assert told["laboratory"].startswith("step1/geometry_data.csv read")
    assert [item["name"] for item in told["quantities"]][:2] == ["tip_stiffness", "frequency_1"]
    assert {"weighed_mass", "frequency_1"} <= {reading["name"] for reading in told["readings"]}
    # The model is that of the measured planform, to 0.1 mm, by the beam's k ~ 1 / L^3 from the shipped one.
    result = load_calibration(tmp_path / "model/calibration.nc")
    span, model = result.design.planform.semi_span, reduced_model(result.design)
    assert span == round(result.mean("semi_span"), 4) != 1.9
    assert (model.design_hash, result.mean_state().geometry.semi_span) == (result.design_hash, span)
    expected = (1.828 / span) ** 3 * reduced_model().tip_stiffness(1.0)
    assert model.tip_stiffness(1.0) == pytest.approx(expected, rel=1e-2)
    modes = reduced_model().modes(
        young_modulus_factor=0.99, stiffness_loss=(0.0, 0.0), servo_mass=0.18, pitot_mass=0.11
    )
    ringdown = ("calibrate", "ringdown", "--data", out)
    for options, nearest in (((), (2e-3, 5e-2)), (("--fitted",), (1e-3, 5e-3))):
        said(*ringdown, "--out", tmp_path, *options)
        with (tmp_path / "ringdown.csv").open(encoding="utf-8", newline="") as stream:
            found = {row["figure"]: float(row["found"]) for row in csv.DictReader(stream)}
        assert all(len(str(value)) > 8 for value in found.values())  # the console has five digits
        for mode, (place, near) in enumerate(zip(modes.followed, nearest, strict=True), start=1):
            frequency = found[f"mode {mode}, natural frequency"]
            assert frequency == pytest.approx(modes.frequency[place], rel=near), options
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"ringdown.svg", "ringdown.png"}
    assert "only a record read off a plot has them" in refused(*ringdown, "--extremes")


def test_a_wing_that_is_an_fmu_is_measured_as_the_model_is(wing, tmp_path):
    """With damage, too."""
    fmu = build_fmu(wing, tmp_path / "wing.fmu").path
    truth = replace(SOFT, stiffness_loss=(0.1, 0.0))
    model = VirtualWing(wing, truth)
    with FmuTestBench(fmu, truth) as bench:
        ours, theirs = measure_load_test(model, 7), measure_load_test(bench, 7)
        np.testing.assert_allclose(theirs.displacement, ours.displacement, rtol=1e-12)
        settings = {"trials": 2, "duration": 0.5, "sampling_rate": 500.0, "noise": 0.0}
        records = (measure_ring_down(made, 7, **settings) for made in (model, bench))
        for expected, seen in zip(*records, strict=True):
            np.testing.assert_array_equal(seen.time, expected.time)
            scale = np.abs(expected.signal).max()
            np.testing.assert_allclose(seen.signal, expected.signal, atol=1e-10 * scale)
    heavy = replace(SOFT, servo_mass=2.0)
    with pytest.raises(FmuError, match="servo_mass"), FmuTestBench(fmu, heavy) as bench:
        bench.tip_displacement(1.0)


@pytest.fixture(scope="module")
def soft(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """The soft wing, calibrated: the words without --out, the folder, what was said, the result.

    Its laboratory has the published planform, and is measured with errors.
    """
    lab = tmp_path_factory.mktemp("soft") / "lab"
    bench = VirtualWing(reduced_model(), SOFT)
    write_lab_folder(
        lab,
        lengths=published_lengths(),
        load_test=measure_load_test(bench, 0),
        records=measure_ring_down(bench, 0, trials=3, noise=2e-5),
        total_mass=weighed(2.0 * SOFT.servo_mass + SOFT.pitot_mass, 1e-3),
    )
    words, out = ("calibrate", "--data", lab, "--asset", "soft", "--fitted"), lab.with_name("calibrated")
    told = said(*words, "--out", out)
    return SimpleNamespace(words=words, out=out, said=told, result=load_calibration(out / "calibration.nc"))


def test_the_truth_lies_in_the_posterior(soft):
    result, truth = soft.result, SOFT
    assert result.asset == "soft"
    assert result.design_hash == reduced_model().design_hash  # published lengths: nothing was built anew
    for entry in STATE:
        off = result.mean(entry) - getattr(truth, entry)
        assert abs(off) < 4.0 * result.standard_deviation(entry), entry
    mass = 2.0 * result.samples[:, 1] + result.samples[:, 2]
    np.testing.assert_allclose(mass, 2.0 * truth.servo_mass + truth.pitot_mass, atol=6e-3)


def test_the_published_figures_give_table_1():
    lines = said("calibrate").splitlines()
    assert lines[0] == "Step 1: published lengths (Kapteyn et al. 2021, Table 1)."
    assert lines[2].startswith("Step 3: published frequencies and damping ratios")
    rows = {line.split("  ")[0].strip(): line for line in lines if "±" in line}
    table = {name: re.findall(r"[−+]?[\d.]+", line.replace(name, "", 1)) for name, line in rows.items()}
    assert table["modulus factor e"][4:8] == ["1.0073", "0.0103", "1.0073", "0.0103"]  # procedure and paper
    near = {"servo mass, g": 1.0, "pitot mass, g": 2.0, "alpha, 1/s": 0.01, "beta, ms": 0.01}
    for name, off in near.items():
        assert float(table[name][4]) == pytest.approx(float(table[name][6]), abs=off)
    lengths = {"semi-span, mm": "1828.00", "root chord, mm": "433.00", "tip chord, mm": "260.00"}
    assert {name: table[name][6] for name in lengths} == lengths


def test_what_a_calibration_leaves_and_says(soft):
    for word in ("geometry_data.csv read", "8 pairs", "initialconditiondata_1.DAT to", "Report:"):
        assert word in soft.said
    names = {path.relative_to(soft.out).as_posix() for path in soft.out.rglob("*") if path.is_file()}
    figures = ["load_test", "modes", "posterior", "prior_and_posterior", "procedure", "readings", "ring_down"]
    assert names == {
        "calibration.nc", "report.html", "table_1.csv", "wing.vtu", "modes.vtu",
        *(f"figures/{name}.{kind}" for name in figures for kind in ("svg", "png")),
    }  # fmt: skip
    page = (soft.out / "report.html").read_text(encoding="utf-8")
    assert "Calibration of soft" in page
    assert "This calibration and Table 1 of the paper" in page
    assert not re.search(r"https?://", page.replace("http://www.w3.org", ""))  # nothing is fetched
    assert not re.search(r"""(?<=[\s"'>(=])/(?:[\w.-]+/)+""", page)  # no folder of this machine
    result = soft.result
    assert [reading.experiment for reading in result.readings] == [
        *["planform"] * 3, "load test", "weighing", *["ring-down"] * 4,
    ]  # fmt: skip
    assert result.mean("semi_span") == pytest.approx(1.828005, abs=1e-6)
    pairs, bending = read_measurements(soft.words[2]), result.readings[3]  # least squares through the origin
    error = np.hypot(pairs.load_standard_deviation, bending.value * pairs.displacement_standard_deviation)
    (expected,), *_ = np.linalg.lstsq(pairs.displacement[:, None], pairs.load)
    assert bending.value == pytest.approx(expected, rel=1e-12)
    assert bending.deviation == pytest.approx(error / np.linalg.norm(pairs.displacement), rel=1e-12)
    apart = assess_fit(pairs, reduced_model().tip_stiffness(result.mean("young_modulus_factor")))
    runs = [apart.standardised_residual[pairs.run == run] for run in (0, 1)]
    wanted = [np.sqrt(np.mean(run**2)) for run in runs]
    assert [channel.after for channel in result.channels] == pytest.approx(wanted, rel=1e-6)


@pytest.mark.long
def test_a_calibration_repeats_to_the_byte(soft, tmp_path):
    said(*soft.words, "--out", tmp_path)
    check_same(tmp_path, soft.out, "calibration.nc", "report.html", "table_1.csv", "figures/posterior.svg")
    said(*soft.words, "--no-report", "--out", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"calibration.nc", "table_1.csv"}
    check_same(tmp_path, soft.out, "calibration.nc", "table_1.csv")


def test_a_calibrated_wing_is_an_fmu_of_its_own(soft, tmp_path):
    fmu = tmp_path / "soft.fmu"
    said("fmu", "build", "--calibration", soft.out / "calibration.nc", "--out", fmu)
    said("fmu", "check", fmu, "--cycles", "5")
    described = read_model_description(str(fmu))
    assert "Calibrated for the wing 'soft'" in described.description
    start = {variable.name: variable.start for variable in described.modelVariables}
    variables = ("young_modulus_factor", "mass.servo", "mass.pitot", "damping.alpha", "damping.beta")
    assert [float(start[variable]) for variable in variables] == [soft.result.mean(e) for e in STATE]
    with zipfile.ZipFile(fmu) as archive:
        assert json.loads(archive.read("resources/calibration.json"))["asset"] == "soft"
    with FmiAsset(fmu, "scenarios/bindings/uav_wing.toml", isolated=False) as asset:
        seen = asset.step({"load_factor": 3.0}, {"z1": 0.0, "z2": 0.0}).values
    masses = {name: soft.result.mean(name) for name in ("young_modulus_factor", "servo_mass", "pitot_mass")}
    static = reduced_model().static_response(load_factor=3.0, stiffness_loss=(0.0, 0.0), **masses)
    np.testing.assert_allclose(seen, static.strain, rtol=1e-9)
