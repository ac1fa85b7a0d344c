"""What is read of a laboratory, what is published instead, and what is wrong told in one sentence."""

import dataclasses

import numpy as np
import pytest

from calibration.dynamics.records import read_records
from calibration.dynamics.trials import average
from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.geometry import read_lengths
from calibration.paper.procedure import read_published_results
from calibration.static.experiments import LOAD_STANDARD_DEVIATION, published_measurements, read_measurements
from calibration.wing.lab_data import WEIGHED_MASS_FILE, published_data, read_lab_folder, read_weighed_mass
from tests.refusals import Inputs, refused

PAIRS = np.array([[2.4525, 3.937], [4.905, 7.6962], [7.3575, 10.8712], [2.4525, 3.3528], [4.905, 7.2898]])


def write(folder, text):
    file = folder / "step2" / "load_displacement_measurements.csv"
    file.parent.mkdir(exist_ok=True, parents=True)
    file.write_text(text, encoding="utf-8")
    return folder


def table(pairs, header="load,displacement"):
    return "\n".join([header, *(f"{load:.10g},{displacement:.10g}" for load, displacement in pairs)]) + "\n"


def test_published_pairs():
    data = published_measurements()
    assert data.run.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert data.load / 9.81 == pytest.approx(np.tile([0.25, 0.5, 0.75, 1.0], 2))
    assert data.load_standard_deviation == pytest.approx(0.0981 / 1.96)
    assert data.displacement_standard_deviation == pytest.approx(0.5e-3 / 1.96)
    with pytest.raises(ExperimentDataError, match="load of reading 2 is 0"):
        dataclasses.replace(data, load=np.where(np.arange(8) == 1, 0.0, data.load))


@pytest.mark.parametrize("above", ["", "datafiles", "src/datafiles"])
def test_folders_files_columns_and_runs(tmp_path, above):
    write(tmp_path / above, "\ufeff" + table(PAIRS, "load , displacement").replace("\n", "\r\n"))
    data = read_measurements(tmp_path)
    assert data.load.tolist() == PAIRS[:, 0].tolist()
    assert data.displacement == pytest.approx(PAIRS[:, 1] * 1e-3)
    assert data.run.tolist() == [0, 0, 0, 1, 1]
    file = tmp_path / above / "step2" / "load_displacement_measurements.csv"
    assert read_measurements(file).sha256 == data.sha256
    rows = "\n".join(f"{displacement},x,{load}" for load, displacement in PAIRS)
    other = read_measurements(write(tmp_path / above, f"displacement,remark,load\n{rows}\n"))
    assert other.load.tolist() == data.load.tolist()
    # equal readings of two runs, or two numbered ones, are no repetition
    runs = "load,displacement\n4.905,7.6\n9.81,14.5\n4.905,7.6\n9.81,14.5\n"
    assert read_measurements(write(tmp_path / above, runs)).run.tolist() == [0, 0, 1, 1]
    numbered = "reading,load,displacement\n1,9.81,14.5\n2,9.81,14.5\n"
    assert read_measurements(write(tmp_path / above, numbered)).count == 2


def test_the_hash_sees_figures_and_not_names():
    data = published_measurements()
    assert dataclasses.replace(data, source="another name").sha256 == data.sha256
    assert dataclasses.replace(data, load=data.load + 1e-12).sha256 != data.sha256
    assert (
        dataclasses.replace(data, load_standard_deviation=2 * LOAD_STANDARD_DEVIATION).sha256 != data.sha256
    )


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
    said = "ringdown_trial1_digitised.csv to ringdown_trial5_digitised.csv read"
    assert read.origins[2].text == said


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


INPUTS = Inputs(__file__)
READERS = {
    "lengths": read_lengths,
    "load_test": read_measurements,
    "ring_down": read_records,
    "weighed_mass": lambda file: read_weighed_mass(file.parents[1]),
    "authors": read_published_results,
}
ERRORS = {"File": ExperimentFileError, "Data": ExperimentDataError}


BAD = [pytest.param(name, *row, id=f"{name}: {row[-1]}") for name in READERS for row in INPUTS.refused(name)]


@pytest.mark.parametrize(("name", "old", "new", "kind", "sentence"), BAD)
def test_a_bad_file_is_one_sentence(tmp_path, name, old, new, kind, sentence):
    file = tmp_path / WEIGHED_MASS_FILE
    file.parent.mkdir()
    file.write_text(INPUTS.text(f"{name}.csv", (old, new)), encoding="utf-8")
    with refused(ERRORS[kind], sentence):
        READERS[name](file)


@pytest.mark.parametrize("name", ["lengths", "load_test", "ring_down", "authors"])
def test_a_file_that_is_not_there(tmp_path, name):
    with refused(ExperimentFileError, "does not exist"):
        READERS[name](tmp_path / "nowhere")
    with refused(ExperimentFileError, "does not hold|holds no ring-down record"):
        READERS[name](tmp_path)
    (tmp_path / "picture.csv").write_bytes(bytes(range(128, 256)))
    with refused(ExperimentFileError, "not text in UTF-8"):
        READERS[name](tmp_path / "picture.csv")


@pytest.mark.parametrize(("load", "displacement", "sentence"), [*INPUTS.refused("units"), (0.0, 0.0, "")])
def test_wrong_units_are_recognised(tmp_path, load, displacement, sentence):
    pairs = np.loadtxt(INPUTS.text("load_test.csv").splitlines(), delimiter=",", skiprows=1)
    pairs = pairs * [load, displacement] if load else pairs[:, ::-1]  # exchanged
    rows = "\n".join(f"{load:.10g},{displacement:.10g}" for load, displacement in pairs)
    (tmp_path / "pairs.csv").write_text(f"load,displacement\n{rows}\n", encoding="utf-8")
    with refused(ExperimentDataError, f"{sentence}.*expected before calibration|expected.*{sentence}"):
        read_measurements(tmp_path / "pairs.csv")
