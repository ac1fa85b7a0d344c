"""Calibration step 2 as a whole: record, quality of fit, report, files."""

import dataclasses
import html.parser
import json
import math

import numpy as np
import pytest

from calibration.errors import CalibrationRecordError, ExperimentFileError
from calibration.static.experiments import published_measurements
from calibration.static.figures import residual_figure
from calibration.static.quality import assess_fit
from calibration.static.record import StaticCalibration
from calibration.static.report import write_report
from calibration.static.stiffness import PUBLISHED_LINE, calibrate_static, stiffness_curve_of
from calibration.static.stiffness_curve import LinearStiffnessCurve
from calibration.static.summary import summary_rows
from calibration.static.workflow import read_calibration, run_static, write_calibration

COUNT = 40_000


@pytest.fixture(scope="module")
def result() -> StaticCalibration:
    return calibrate_static(seed=3, particle_count=COUNT)


class Model:
    """A structural model near the published line."""

    validity = {"young_modulus_factor": (0.9, 1.1)}  # noqa: RUF012

    def tip_stiffness(self, young_modulus_factor: float) -> float:
        return 1.0 / (1.0 / (640.0 * young_modulus_factor + 100.0) + 1.0 / 8500.0)


def test_tip_stiffness_of_figure_5(result):
    exact, prior = result.tip_stiffness_exact, result.tip_stiffness_prior
    assert prior.mean == pytest.approx(677.0, abs=0.01)
    assert prior.standard_deviation == pytest.approx(575.2 * 0.05 / 1.96, rel=1e-4)
    assert exact.mean == pytest.approx(575.2 * result.exact.mean + 101.8, abs=1e-6)
    assert exact.standard_deviation == pytest.approx(575.2 * result.exact.standard_deviation, rel=1e-6)
    assert exact.interval() == pytest.approx(PUBLISHED_LINE.stiffness(result.exact.interval()), abs=1e-3)
    assert result.tip_stiffness_particle.mean == pytest.approx(681.2, abs=0.6)


def test_what_the_experiment_was_worth(result):
    reward = result.reward
    assert reward.uncertainty_reduction == pytest.approx(1.0 - 0.01031 / 0.02551, abs=1e-3)
    shrink = result.exact.standard_deviation / result.prior.standard_deviation
    shift = (result.exact.mean - 1.0) / result.prior.standard_deviation
    assert reward.information_gain == pytest.approx(
        0.5 * (shrink**2 + shift**2 - 1.0) - math.log(shrink), abs=2e-3
    )


def test_the_offset_between_the_runs_is_noticed(result):
    first, second = result.quality.runs
    assert first.offset - second.offset == pytest.approx(0.47e-3, abs=0.01e-3)
    assert first.line_intercept == pytest.approx(0.508e-3, abs=1e-6)
    assert second.line_intercept == pytest.approx(0.1016e-3, abs=1e-6)
    assert "differ by 0.47 mm" in result.quality.remarks[0]
    assert result.quality.chi_square == pytest.approx(11.76, abs=0.05)
    assert result.quality.degrees_of_freedom == 7
    assert result.quality.tail_probability == pytest.approx(0.109, abs=0.002)


def test_a_perfect_fit_has_no_remarks():
    data = published_measurements()
    data = dataclasses.replace(data, displacement=data.load / 680.0)
    quality = assess_fit(data, 680.0)
    assert quality.remarks == ()
    assert quality.chi_square == pytest.approx(0.0, abs=1e-20)
    assert [run.line_stiffness for run in quality.runs] == pytest.approx([680.0, 680.0])


def test_an_alternative_that_leaves_the_model_is_left_out():
    """Only the assumption of a shared offset is wide enough to reach the end of this curve."""
    line = LinearStiffnessCurve(
        gradient=PUBLISHED_LINE.gradient,
        intercept=PUBLISHED_LINE.intercept,
        name="short",
        lower=0.9,
        upper=1.06,
    )
    found = calibrate_static(line, particle_count=20_000)
    assert [alternative.name.split()[0] for alternative in found.alternatives] == ["prior", "density"]
    assert len(residual_figure(found).axes) == 2
    assert len(calibrate_static(particle_count=20_000).alternatives) == 3


def test_alternatives_stay_near(result):
    means = {alternative.name: alternative.mean for alternative in result.alternatives}
    assert list(means.values()) == pytest.approx([1.00868, 1.00730, 1.01337], abs=1e-4)


def test_our_own_model_as_curve():
    curve = stiffness_curve_of(Model())
    calibrated = calibrate_static(curve, seed=1, particle_count=COUNT)
    # The same stiffness from another curve: e differs, what was measured does not.
    assert calibrated.tip_stiffness_exact.mean == pytest.approx(681.6, abs=2.0)
    assert json.dumps(StaticCalibration.from_dict(calibrated.to_dict()).to_dict()) == json.dumps(
        calibrated.to_dict()
    )


def test_a_single_pair_will_do(tmp_path):
    data = published_measurements()
    one = dataclasses.replace(data, load=data.load[:1], displacement=data.displacement[:1], run=data.run[:1])
    calibrated = calibrate_static(data=one, particle_count=COUNT)
    assert calibrated.quality.degrees_of_freedom == 0
    assert calibrated.quality.runs[0].line_stiffness is None
    assert 0.02 < calibrated.exact.standard_deviation < 0.0256
    assert write_report(calibrated, tmp_path).is_file()
    assert (
        json.loads(json.dumps(calibrated.to_dict(), allow_nan=False))["quality"]["tail_probability"] is None
    )


def test_samples_for_the_mission(result):
    samples = result.samples(11, 30)
    assert np.array_equal(samples, result.samples(11, 30))
    assert samples.shape == (30,)
    assert samples.mean() == pytest.approx(result.exact.mean, abs=1e-3)
    assert samples.std() == pytest.approx(result.exact.standard_deviation, rel=0.1)


def test_summary_stands_beside_the_paper():
    rows = {row.name: row for row in summary_rows(calibrate_static(seed=0))}
    mean, deviation = rows["e, particle filter, mean"], rows["e, particle filter, standard deviation"]
    assert (mean.paper, deviation.paper) == (1.0073, 0.0103)
    assert abs(mean.ours - mean.paper) < 0.002
    assert abs(deviation.ours - deviation.paper) < 0.001
    assert rows["tip stiffness, particle filter, mean"].ours == pytest.approx(0.6812, abs=0.0012)


def test_record_goes_to_json_and_back_bit_for_bit(result, tmp_path):
    file = tmp_path / "calibration.json"
    write_calibration(result, file)
    again = read_calibration(file)
    assert again.to_dict() == result.to_dict()
    assert np.array_equal(again.samples(1, 50), result.samples(1, 50))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda record: record.update(schema="other"), "schema"),
        (lambda record: record.pop("exact"), "damaged"),
        (lambda record: record["exact"].update(density=[1.0]), "damaged"),
        (lambda record: record["data"]["load_N"].__setitem__(0, 2.5), "hash"),
        (lambda record: record["data"].update(load_N="many"), "damaged"),
    ],
)
def test_damaged_records_are_refused(result, tmp_path, change, sentence):
    record = json.loads(json.dumps(result.to_dict()))
    change(record)
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps(record))
    with pytest.raises(CalibrationRecordError, match=sentence):
        read_calibration(file)


@pytest.mark.parametrize("text", ["", "{", "[]"])
def test_files_that_are_no_record_are_refused(tmp_path, text):
    file = tmp_path / "calibration.json"
    file.write_text(text)
    with pytest.raises(CalibrationRecordError):
        read_calibration(file)
    with pytest.raises(CalibrationRecordError, match="cannot be read"):
        read_calibration(tmp_path / "none.json")


class _Outside(html.parser.HTMLParser):
    """Collects what a page would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []

    def handle_starttag(self, tag, attrs):
        named = dict(attrs)
        if tag in ("link", "img", "iframe"):
            self.fetched.append(tag)
        self.fetched += [v for k, v in named.items() if k in ("src", "href") and v and not v.startswith("#")]


def test_workflow_leaves_a_self_contained_report_that_repeats(tmp_path):
    for name in ("first", "second"):
        run_static(None, tmp_path / name, seed=5, particle_count=COUNT)
    names = {path.relative_to(tmp_path / "first").as_posix() for path in (tmp_path / "first").rglob("*.*")}
    assert names == {
        "calibration.json", "report.html", "figures/calibration.svg", "figures/calibration.png",
        "figures/residuals.svg", "figures/residuals.png",
    }  # fmt: skip
    for name in names:
        assert (tmp_path / "first" / name).read_bytes() == (tmp_path / "second" / name).read_bytes(), name
    page = (tmp_path / "first" / "report.html").read_text(encoding="utf-8")
    parser = _Outside()
    parser.feed(page)
    assert parser.fetched == []
    words = " ".join(page.split())  # the page may put no-break spaces before units
    assert "Loading runs 1 and 2 differ by 0.47 mm" in words


def test_workflow_without_a_folder_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_static(seed=1, particle_count=COUNT)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ExperimentFileError, match="does not exist"):
        run_static(tmp_path / "missing", tmp_path / "out")
    assert not (tmp_path / "out").exists()
