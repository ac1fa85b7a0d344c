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
from calibration.joint.wing_table import weighed_mass
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


TRUE_WING = {
    "young_modulus_factor": 0.99,
    "servo_mass": 0.18,
    "pitot_mass": 0.11,
    "damping_alpha": 0.9,
    "damping_beta": 5e-4,
}


@pytest.fixture(scope="module")
def simulated_lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The laboratory of a wing with that truth."""
    out = tmp_path_factory.mktemp("simulated") / "lab"
    options = ("--e", "--servo-mass", "--pitot-mass", "--alpha", "--beta")
    truth = [word for pair in zip(options, TRUE_WING.values(), strict=True) for word in pair]
    said(*simulate(out, *truth))
    return out


def test_a_simulated_laboratory_has_its_truth(simulated_lab):
    truth = json.loads((simulated_lab / "truth.json").read_text(encoding="utf-8"))
    assert {name: truth[name] for name in TRUE_WING} == TRUE_WING
    assert truth["seed"] == 3


def test_a_simulated_laboratory_is_measured_with_errors(simulated_lab):
    assert read_measurements(simulated_lab).count == 8
    assert read_lengths(simulated_lab).semi_span.measured == pytest.approx(1.828, abs=5e-4)
    assert read_weighed_mass(simulated_lab).value == pytest.approx(0.47, abs=4e-3)


class LongerWing:
    """A longer wing on a coarse mesh: its simulated laboratory, and its calibration."""

    def __init__(self, folder: Path) -> None:
        changes = (("semi_span = 1.828", "semi_span = 1.9"), COARSE)
        design = written(folder, SHIPPED_DESIGN.read_text(encoding="utf-8"), *changes)
        lab, out = folder / "longer", folder / "model"
        said(*simulate(lab, "--design", design))
        self.semi_span = read_lengths(lab).semi_span
        words = ("--data", lab, "--design", design, "--out", out, "--no-report", "--json")
        self.record = json.loads(said("calibrate", *words))
        self.calibration = load_calibration(out / "calibration.nc")
        self.model = reduced_model(self.calibration.design)


@pytest.fixture(scope="module")
def longer_wing(tmp_path_factory: pytest.TempPathFactory) -> LongerWing:
    return LongerWing(tmp_path_factory.mktemp("longer"))


def test_a_laboratory_of_another_design_is_simulated(longer_wing):
    assert longer_wing.semi_span.designed == pytest.approx(1.9)
    assert longer_wing.semi_span.measured == pytest.approx(1.9, abs=5e-4)


def test_a_calibration_of_another_design_is_printed_as_data(longer_wing):
    record = longer_wing.record
    readings = {reading["name"] for reading in record["readings"]}
    quantities = [quantity["name"] for quantity in record["quantities"]]
    assert record["laboratory"].startswith("step1/geometry_data.csv read")
    assert quantities[:2] == ["tip_stiffness", "frequency_1"]
    assert {"weighed_mass", "frequency_1"} <= readings


def test_the_model_is_that_of_the_measured_planform(longer_wing):
    """To 0.1 mm."""
    calibration = longer_wing.calibration
    span = calibration.design.planform.semi_span
    assert span == round(calibration.mean("semi_span"), 4) != 1.9
    assert longer_wing.model.design_hash == calibration.design_hash
    assert calibration.mean_state().geometry.semi_span == span


def test_the_model_of_a_longer_wing_is_softer(longer_wing):
    """By the beam's k ~ 1 / L^3 from the shipped one."""
    span = longer_wing.calibration.design.planform.semi_span
    expected = (1.828 / span) ** 3 * reduced_model().tip_stiffness(1.0)
    assert longer_wing.model.tip_stiffness(1.0) == pytest.approx(expected, rel=1e-2)


class RingDownFigures:
    """The figures that the command finds in the ring-down records of a laboratory, and their folder."""

    def __init__(self, lab: Path, out: Path, *options: str) -> None:
        self.out = out
        said("calibrate", "ringdown", "--data", lab, "--out", out, *options)
        with (out / "ringdown.csv").open(encoding="utf-8", newline="") as stream:
            self.value = {row["figure"]: float(row["found"]) for row in csv.DictReader(stream)}


@pytest.fixture(scope="module")
def figures_of_peaks(simulated_lab: Path, tmp_path_factory: pytest.TempPathFactory) -> RingDownFigures:
    return RingDownFigures(simulated_lab, tmp_path_factory.mktemp("peaks"))


@pytest.fixture(scope="module")
def fitted_figures(simulated_lab: Path, tmp_path_factory: pytest.TempPathFactory) -> RingDownFigures:
    return RingDownFigures(simulated_lab, tmp_path_factory.mktemp("fitted"), "--fitted")


def check_frequencies(figures: RingDownFigures, *tolerances: float) -> None:
    """Check the frequencies of the first modes against those of the truth."""
    masses = {name: TRUE_WING[name] for name in ("young_modulus_factor", "servo_mass", "pitot_mass")}
    modes = reduced_model().modes(**masses, stiffness_loss=(0.0, 0.0))
    for number, (mode, tolerance) in enumerate(zip(modes.followed, tolerances, strict=True), start=1):
        frequency = figures.value[f"mode {number}, natural frequency"]
        assert frequency == pytest.approx(modes.frequency[mode], rel=tolerance)


def test_peaks_of_ring_down_records_have_the_frequencies_of_the_truth(figures_of_peaks):
    check_frequencies(figures_of_peaks, 2e-3, 5e-2)


def test_fitted_ring_down_records_have_the_frequencies_of_the_truth(fitted_figures):
    check_frequencies(fitted_figures, 1e-3, 5e-3)


def test_figures_of_a_ring_down_have_all_digits_and_are_drawn(figures_of_peaks):
    """The console has five digits."""
    drawings = {path.name for path in (figures_of_peaks.out / "figures").iterdir()}
    assert all(len(str(value)) > 8 for value in figures_of_peaks.value.values())
    assert drawings == {"ringdown.svg", "ringdown.png"}


def test_extremes_are_fitted_only_in_records_that_were_read_off_a_plot(simulated_lab):
    sentence = refused("calibrate", "ringdown", "--data", simulated_lab, "--extremes")
    assert "only a record read off a plot has them" in sentence


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
        total_mass=weighed_mass(2.0 * SOFT.servo_mass + SOFT.pitot_mass, 1e-3),
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


@pytest.fixture(scope="module")
def published_calibration() -> list[str]:
    """What the command prints of the published figures."""
    return said("calibrate").splitlines()


def test_a_calibration_says_that_it_is_from_published_figures(published_calibration):
    lengths, _, frequencies, *_ = published_calibration
    assert lengths == "Step 1: published lengths (Kapteyn et al. 2021, Table 1)."
    assert frequencies.startswith("Step 3: published frequencies and damping ratios")


@pytest.mark.parametrize(
    "words", ["geometry_data.csv read", "8 pairs", "initialconditiondata_1.DAT to", "Report:"]
)
def test_a_calibration_says_what_it_reads_and_writes(soft, words):
    assert words in soft.said


def test_a_calibration_leaves_file_fields_and_figures(soft):
    figures = ["load_test", "modes", "posterior", "prior_and_posterior", "readings", "ring_down"]
    names = {path.relative_to(soft.out).as_posix() for path in soft.out.rglob("*") if path.is_file()}
    drawings = {f"figures/{name}.{kind}" for name in figures for kind in ("svg", "png")}
    assert names == {"calibration.nc", "report.html", "wing.vtu", "modes.vtu"} | drawings


@pytest.fixture(scope="module")
def page_of_soft_wing(soft: SimpleNamespace) -> str:
    return str((soft.out / "report.html").read_text(encoding="utf-8"))


def test_the_report_of_a_calibration_has_the_load_test(page_of_soft_wing):
    assert "Calibration of soft" in page_of_soft_wing
    assert "e by the load test alone" in page_of_soft_wing


def test_the_report_of_a_calibration_fetches_nothing_and_names_no_folder(page_of_soft_wing):
    folder = r"""(?<=[\s"'>(=])/(?:[\w.-]+/)+"""
    assert not re.search(r"https?://", page_of_soft_wing.replace("http://www.w3.org", ""))
    assert not re.search(folder, page_of_soft_wing)


def test_a_calibration_has_the_readings_of_all_experiments(soft):
    experiments = [reading.experiment for reading in soft.result.readings]
    assert experiments == [*["planform"] * 3, "load test", "weighing", *["ring-down"] * 4]
    assert soft.result.mean("semi_span") == pytest.approx(1.828005, abs=1e-6)


def test_the_reading_of_a_load_test_is_that_of_least_squares_through_the_origin(soft):
    pairs, bending = read_measurements(soft.words[2]), soft.result.readings[3]
    (stiffness,), *_ = np.linalg.lstsq(pairs.displacement[:, None], pairs.load)
    error = np.hypot(pairs.load_standard_deviation, bending.value * pairs.displacement_standard_deviation)
    deviation = error / np.linalg.norm(pairs.displacement)
    assert bending.value == pytest.approx(stiffness, rel=1e-12)
    assert bending.deviation == pytest.approx(deviation, rel=1e-12)


def test_each_run_of_a_load_test_is_a_channel_with_its_residual(soft):
    pairs = read_measurements(soft.words[2])
    fit = assess_fit(pairs, reduced_model().tip_stiffness(soft.result.mean("young_modulus_factor")))
    residuals = [fit.standardised_residual[pairs.run == run] for run in (0, 1)]
    expected = [np.sqrt(np.mean(residual**2)) for residual in residuals]
    assert [channel.after for channel in soft.result.channels] == pytest.approx(expected, rel=1e-6)


@pytest.mark.long
def test_a_calibration_repeats_to_the_byte(soft, tmp_path):
    said(*soft.words, "--out", tmp_path)
    check_same(tmp_path, soft.out, "calibration.nc", "report.html", "figures/posterior.svg")
    said(*soft.words, "--no-report", "--out", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"calibration.nc"}
    check_same(tmp_path, soft.out, "calibration.nc")


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
