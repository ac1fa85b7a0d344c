"""What is read of a laboratory, what is published instead; the planform; what is wrong in one sentence."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from calibration.dynamics.records import read_records
from calibration.dynamics.trials import average
from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.geometry import published_lengths, read_lengths, tailored_design, tailored_geometry
from calibration.paper.procedure import read_published_results
from calibration.static.experiments import (
    LOAD_STANDARD_DEVIATION,
    LoadDisplacementData,
    published_measurements,
    read_measurements,
)
from calibration.wing.lab_data import (
    WEIGHED_MASS_FILE,
    published_data,
    read_lab_folder,
    read_weighed_mass,
)
from fe.runtime.errors import InvalidDesignError
from fe.wing.design import load_design
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)


def test_columns_and_runs_of_a_load_test(tmp_path):
    """A run begins where the load falls; equal readings of two runs, or numbered ones, may be."""

    def read(text: str) -> LoadDisplacementData:
        (tmp_path / "pairs.csv").write_text(text, encoding="utf-8")
        return read_measurements(tmp_path / "pairs.csv")

    text = INPUTS.text("load_test.csv")
    data = read("\ufeff" + text.replace(",", " , ").replace("\n", "\r\n"))
    assert data.load.tolist() == [2.4525, 4.905, 7.3575, 2.4525, 4.905]
    assert data.run.tolist() == [0, 0, 0, 1, 1]
    assert data.displacement[0] == pytest.approx(3.937e-3)
    swapped = (",x,".join(reversed(line.split(","))) for line in text.split())
    assert read("\n".join(swapped)).sha256 == data.sha256
    runs = "load,displacement\n4.905,7.6\n9.81,14.5\n4.905,7.6\n9.81,14.5\n"
    assert read(runs).run.tolist() == [0, 0, 1, 1]
    assert read("reading,load,displacement\n1,9.81,14.5\n2,9.81,14.5\n").count == 2


def test_the_hash_of_a_load_test_sees_figures_and_not_names():
    data = published_measurements()
    assert dataclasses.replace(data, source="another name").sha256 == data.sha256
    for other in ({"load": data.load + 1e-12}, {"load_standard_deviation": 2 * LOAD_STANDARD_DEVIATION}):
        assert dataclasses.replace(data, **other).sha256 != data.sha256
    with pytest.raises(ExperimentDataError, match="load of reading 2 is 0"):
        dataclasses.replace(data, load=np.where(np.arange(8) == 1, 0.0, data.load))


def test_the_published_figures_are_those_of_the_authors_folder(reference):
    read, published = read_lab_folder(reference, "published"), published_data()
    assert read.pairs.sha256 == published.pairs.sha256
    assert read.input_hashes == published.input_hashes
    assert [origin.read for origin in read.origins] == [True, True, False]
    assert "left aside" in read.origins[2].text
    assert read.trials is None
    authors = read.authors.samples
    assert authors.shape == (100, 5)
    mean, deviation = authors.mean(axis=0), authors.std(axis=0, ddof=1)
    assert mean[1:3] == pytest.approx([0.1691, 0.1337], abs=5e-5)
    assert deviation[1:3] == pytest.approx([0.0039, 0.0077], abs=5e-5)
    assert mean[3:] == pytest.approx([1.030, 7.66e-4], rel=7e-4)


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


# -------------------------------- the measured planform in the design, and what a wing cannot be


def lengths(**measured):
    """The published lengths, some measured otherwise [m]."""
    published = published_lengths()
    changes = {name: replace(getattr(published, name), measured=value) for name, value in measured.items()}
    return published._replace(**changes)


def test_the_planform_is_the_posterior_mean_to_a_tenth_of_a_millimetre():
    measured = lengths(semi_span=1.83517, root_chord=0.4401, tip_chord=0.25541)
    found = tailored_geometry(measured)
    # precision-weighted means by hand: tolerances of 2.54 and 0.2 mm, half-widths of 95 % intervals
    precision = 0.2**-2 + 2.54**-2
    for name, designed in (("semi_span", 1.8288), ("root_chord", 0.43561), ("tip_chord", 0.261112)):
        length = getattr(measured, name)
        mean = designed + 0.2**-2 / precision * (length.measured - designed)
        assert length.posterior.mean == pytest.approx(mean, rel=1e-12)
        assert length.posterior.standard_deviation == pytest.approx(1e-3 * precision**-0.5 / 1.96)
        assert getattr(found, name) == round(mean, 4)


@pytest.mark.parametrize(("changes", "measured", "kind", "words"), INPUTS.refused("planform"))
def test_what_no_longer_fits_is_refused_with_its_place(changes, measured, kind, words):
    error = {"Data": ExperimentDataError, "Design": InvalidDesignError}[kind]
    with pytest.raises(error, match=words) as caught:
        tailored_design(load_design().changed(**changes), lengths(**measured))
    assert "the changed design" not in str(caught.value)
