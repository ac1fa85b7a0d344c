"""What is read of a lab folder, and what is published instead."""

import pytest

from calibration.dynamics.trials import average
from calibration.errors import ExperimentFileError
from calibration.wing.lab_data import published_data, read_lab_folder


def test_the_published_figures_are_those_of_the_authors_folder(reference):
    read, published = read_lab_folder(reference, "published"), published_data()
    assert read.pairs.sha256 == published.pairs.sha256
    assert read.input_hashes == published.input_hashes
    assert [origin.read for origin in read.origins] == [True, True, False]
    assert "left aside" in read.origins[2].text
    assert read.authors.samples.shape == (100, 5)
    assert read.trials is None


def test_digitised_records_are_fitted_by_their_extremes(reference):
    read = read_lab_folder(reference)
    assert len(read.trials) == 5
    assert [average(read.trials, "frequency", mode).mean for mode in (0, 1)] == pytest.approx(
        (5.6547, 29.94), rel=1e-3
    )
    assert [average(read.trials, "damping_ratio", mode).mean for mode in (0, 1)] == pytest.approx(
        (0.0280, 0.0573), rel=0.03
    )
    assert sum(name.startswith("ring_down_") for name in read.input_hashes) == 5


def folder_with(root, above, *steps):
    for step in steps:
        place = root / above / f"step{step}"
        place.mkdir(parents=True)
        if step == 1:
            rows = "length,1828.8,1829\nchord_{root},435.61,434\nchord_{tip},261.112,260\n"
            text = f"parameter,designed,manufactured\n{rows}"
            (place / "geometry_data.csv").write_text(text, encoding="utf-8")
        if step == 2:
            text = "load,displacement\n2.45,3.6\n4.9,7.2\n"
            (place / "load_displacement_measurements.csv").write_text(text, encoding="utf-8")
    return root


@pytest.mark.parametrize("above", ["", "datafiles", "src/datafiles"])
def test_parts_of_a_folder(tmp_path, above):
    lab = read_lab_folder(folder_with(tmp_path, above, 1, 3))
    assert [origin.read for origin in lab.origins] == [True, False, False]
    assert lab.lengths.semi_span.measured == pytest.approx(1.829)
    assert lab.pairs.sha256 == published_data().pairs.sha256
    assert lab.input_hashes["lengths"] != published_data().input_hashes["lengths"]
    assert lab.readings[0].value == 0.472


def test_a_weighed_mass(tmp_path):
    folder = folder_with(tmp_path, "datafiles", 2, 3)
    file = folder / "datafiles" / "step3" / "weighed_mass.csv"
    file.write_text("mass,standard_deviation\n455,2\n", encoding="utf-8")
    lab = read_lab_folder(folder)
    assert (lab.readings[0].value, lab.readings[0].deviation) == pytest.approx((0.455, 2e-3))
    assert "weighed_mass" in lab.input_hashes
    assert "weighed_mass.csv read" in lab.origins[2].text


def test_records_that_are_asked_for_must_be_there(tmp_path):
    with pytest.raises(ExperimentFileError, match="no ring-down record, and --measured asks for them"):
        read_lab_folder(folder_with(tmp_path, "", 1, 2), "measured")
