"""Files of a laboratory, what is as published in their place, and the measured planform."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.dynamics.records import read_records
from calibration.dynamics.trials import average
from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.geometry import (
    published_lengths,
    read_lengths,
    tailored_design,
    tailored_geometry,
)
from calibration.joint.wing_table import weighed_mass
from calibration.static.experiments import published_measurements, read_measurements
from calibration.virtual_wing import measure_lengths, measure_load_test, measure_ring_down
from calibration.wing.lab_data import (
    published_data,
    read_lab_folder,
    read_weighed_mass,
    write_lab_folder,
)
from evidence.identification.published_results import read_published_results
from fe.runtime.errors import InvalidDesignError
from fe.runtime.state import Geometry
from fe.wing.design import load_design
from tests.calibration.bench import Beam
from tests.refusals import Inputs, refused

INPUTS = Inputs(__file__)
LOAD_TEST_TEXT = INPUTS.text("load_test.csv")

# ---------------------------------------------------------------- load tests


@pytest.fixture
def read_text(tmp_path):
    """Read a load test from a text."""

    def read(text: str):
        file = tmp_path / "pairs.csv"
        file.write_text(text, encoding="utf-8")
        return read_measurements(file)

    return read


def test_a_load_test_is_read_in_si_units(read_text):
    load_test = read_text(LOAD_TEST_TEXT)

    assert load_test.load.tolist() == [2.4525, 4.905, 7.3575, 2.4525, 4.905]
    assert load_test.displacement[0] == pytest.approx(3.937e-3)


def test_byte_order_mark_spaces_and_line_ends_do_not_matter(read_text):
    decorated = "\ufeff" + LOAD_TEST_TEXT.replace(",", " , ").replace("\n", "\r\n")

    assert read_text(decorated).sha256 == read_text(LOAD_TEST_TEXT).sha256


def test_the_order_of_columns_and_further_columns_do_not_matter(read_text):
    swapped = [",x,".join(reversed(line.split(","))) for line in LOAD_TEST_TEXT.split()]

    assert read_text("\n".join(swapped)).sha256 == read_text(LOAD_TEST_TEXT).sha256


def test_a_run_begins_where_the_load_falls(read_text):
    assert read_text(LOAD_TEST_TEXT).run.tolist() == [0, 0, 0, 1, 1]


def test_two_runs_may_have_equal_readings(read_text):
    load_test = read_text("load,displacement\n4.905,7.6\n9.81,14.5\n4.905,7.6\n9.81,14.5\n")

    assert load_test.run.tolist() == [0, 0, 1, 1]


def test_numbered_readings_may_be_equal(read_text):
    assert read_text("reading,load,displacement\n1,9.81,14.5\n2,9.81,14.5\n").count == 2


def test_the_hash_of_a_load_test_does_not_see_names():
    load_test = published_measurements()

    assert replace(load_test, source="another name").sha256 == load_test.sha256


def test_the_hash_of_a_load_test_sees_readings_and_deviations():
    load_test = published_measurements()
    twice = 2.0 * load_test.load_standard_deviation

    other_load = replace(load_test, load=load_test.load + 1e-12)
    other_deviation = replace(load_test, load_standard_deviation=twice)

    assert other_load.sha256 != load_test.sha256
    assert other_deviation.sha256 != load_test.sha256


def test_a_reading_without_a_load_is_refused():
    load_test = published_measurements()
    is_second = np.arange(8) == 1

    with pytest.raises(ExperimentDataError, match="load of reading 2 is 0"):
        replace(load_test, load=np.where(is_second, 0.0, load_test.load))


def write_pairs(file: Path, pairs) -> None:
    """Write loads and displacements (N, 2) as a load test."""
    rows = "\n".join(f"{load:.10g},{displacement:.10g}" for load, displacement in pairs)
    file.write_text(f"load,displacement\n{rows}\n", encoding="utf-8")


def read_pairs():
    """Return loads and displacements (N, 2) of the good load test, as they stand in the file."""
    return np.loadtxt(LOAD_TEST_TEXT.splitlines(), delimiter=",", skiprows=1)


@pytest.mark.parametrize(
    ("load_factor", "displacement_factor", "sentence"), INPUTS.refused("units")
)
def test_wrong_units_are_recognised(tmp_path, load_factor, displacement_factor, sentence):
    write_pairs(tmp_path / "pairs.csv", read_pairs() * [load_factor, displacement_factor])
    either_order = f"{sentence}.*expected before calibration|expected.*{sentence}"

    with refused(ExperimentDataError, either_order):
        read_measurements(tmp_path / "pairs.csv")


def test_exchanged_columns_are_recognised(tmp_path):
    exchanged = np.fliplr(read_pairs())
    write_pairs(tmp_path / "pairs.csv", exchanged)

    with refused(ExperimentDataError, "expected"):
        read_measurements(tmp_path / "pairs.csv")


# ---------------------------------------------------------------- the folder of the authors


@pytest.fixture(scope="module")
def authors_folder(reference):
    """The folder of the authors, whose ring-downs are as published."""
    return read_lab_folder(reference, "published")


def test_the_published_figures_are_those_of_the_authors_folder(authors_folder):
    published = published_data()

    assert authors_folder.pairs.sha256 == published.pairs.sha256
    assert authors_folder.input_hashes == published.input_hashes


def test_ring_downs_of_the_authors_are_left_aside_if_asked(authors_folder):
    assert [origin.read for origin in authors_folder.origins] == [True, True, False]
    assert "ignored as requested" in authors_folder.origins[2].text
    assert authors_folder.trials is None


@pytest.fixture(scope="module")
def digitised_folder(reference):
    """The folder of the authors with their digitised ring-downs."""
    return read_lab_folder(reference)


def test_digitised_records_are_read(digitised_folder):
    ring_downs = [name for name in digitised_folder.input_hashes if name.startswith("ring_down_")]

    said = "ringdown_trial1_digitised.csv to ringdown_trial5_digitised.csv read"
    assert len(digitised_folder.trials) == 5
    assert len(ring_downs) == 5
    assert digitised_folder.origins[2].text == said


@pytest.mark.parametrize(
    ("name", "values", "tolerance"),
    [("frequency", (5.6547, 29.94), 1e-3), ("damping_ratio", (0.0280, 0.0573), 0.03)],
)
def test_digitised_records_are_fitted_by_their_extremes(digitised_folder, name, values, tolerance):
    means = [average(digitised_folder.trials, name, mode).mean for mode in (0, 1)]

    assert means == pytest.approx(values, rel=tolerance)


# ---------------------------------------------------------------- bad files

READERS = {
    "lengths": read_lengths,
    "load_test": read_measurements,
    "ring_down": read_records,
    "weighed_mass": lambda file: read_weighed_mass(file.parents[1]),
    "authors": read_published_results,
}
ERRORS = {"File": ExperimentFileError, "Data": ExperimentDataError}
BAD_FILES = [
    pytest.param(name, *row, id=f"{name}: {row[-1]}")
    for name in READERS
    for row in INPUTS.refused(name)
]
NAMED_FILES = ["lengths", "load_test", "ring_down", "authors"]


@pytest.mark.parametrize(("name", "old", "new", "kind", "sentence"), BAD_FILES)
def test_a_bad_file_is_one_sentence(tmp_path, name, old, new, kind, sentence):
    file = tmp_path / "step3" / "weighed_mass.csv"
    file.parent.mkdir()
    file.write_text(INPUTS.text(f"{name}.csv", (old, new)), encoding="utf-8")

    with refused(ERRORS[kind], sentence):
        READERS[name](file)


@pytest.mark.parametrize("name", NAMED_FILES)
def test_a_missing_file_is_one_sentence(tmp_path, name):
    with refused(ExperimentFileError, "does not exist"):
        READERS[name](tmp_path / "nowhere")


@pytest.mark.parametrize("name", NAMED_FILES)
def test_an_empty_folder_is_one_sentence(tmp_path, name):
    with refused(ExperimentFileError, "does not hold|holds no ring-down record"):
        READERS[name](tmp_path)


@pytest.mark.parametrize("name", NAMED_FILES)
def test_a_file_that_is_not_text_is_one_sentence(tmp_path, name):
    file = tmp_path / "picture.csv"
    file.write_bytes(bytes(range(128, 256)))

    with refused(ExperimentFileError, "not text in UTF-8"):
        READERS[name](file)


# ---------------------------------------------------------------- a folder is read back


@dataclass(frozen=True)
class WrittenLab:
    """A folder of a laboratory, what was written into it, and what is read of it.

    Attributes
    ----------
    root : Path
        Where reading begins.
    folder : Path
        Where the files lie.
    files : list of Path
        The files; the first one has the lengths.
    lengths, load_test, records
        What was written.
    sampling_rate : float
        Of the records [Hz].
    lab
        What is read.
    """

    root: Path
    folder: Path
    files: list[Path]
    lengths: Any
    load_test: Any
    records: Any
    sampling_rate: float
    lab: Any


@pytest.fixture(
    scope="module", params=[("", 500.0), ("src/datafiles", 100_000.0)], ids=["flat", "nested"]
)
def written_lab(request, tmp_path_factory):
    subfolder, sampling_rate = request.param
    root = tmp_path_factory.mktemp("lab")
    folder = root / subfolder
    lengths = measure_lengths(Geometry(), 2)
    load_test = measure_load_test(Beam(), 2)
    records = measure_ring_down(Beam(), 2, trials=2, duration=1.0, sampling_rate=sampling_rate)
    files = write_lab_folder(
        folder,
        lengths=lengths,
        load_test=load_test,
        records=records,
        total_mass=weighed_mass(0.4711, 2e-3),
    )
    return WrittenLab(
        root=root,
        folder=folder,
        files=files,
        lengths=lengths,
        load_test=load_test,
        records=records,
        sampling_rate=sampling_rate,
        lab=read_lab_folder(root, frequencies_fitted=True),
    )


def test_a_whole_folder_says_what_was_read(written_lab):
    assert [origin.read for origin in written_lab.lab.origins] == [True, True, True]
    assert "weighed_mass.csv read" in written_lab.lab.origins[2].text


def test_each_file_of_a_folder_has_a_hash_of_its_own(written_lab):
    hashes = written_lab.lab.input_hashes

    names = {"lengths", "load_test", "weighed_mass", "ring_down_1", "ring_down_2"}
    assert hashes.keys() == names
    assert not hashes.items() & published_data().input_hashes.items()


def test_a_load_test_is_read_back(written_lab):
    read = written_lab.lab.pairs
    written = written_lab.load_test

    np.testing.assert_allclose(read.load, written.load, rtol=1e-9)
    np.testing.assert_allclose(read.displacement, written.displacement, rtol=1e-9)
    np.testing.assert_array_equal(read.run, written.run)


def test_records_are_read_back(written_lab):
    records = read_records(written_lab.folder / "step3")

    for written, read in zip(written_lab.records, records, strict=True):
        np.testing.assert_allclose(read.time, written.time, atol=1e-6)
        np.testing.assert_allclose(read.signal, written.signal, rtol=1e-8, atol=1e-12)
        assert read.sampling_rate == pytest.approx(written_lab.sampling_rate, rel=1e-6)


def test_each_record_is_a_trial(written_lab):
    assert len(written_lab.lab.trials) == 2


def test_lengths_are_read_back(written_lab):
    root_chord = written_lab.lab.lengths.root_chord
    written = written_lab.lengths.root_chord.measured

    assert root_chord.measured == pytest.approx(written, rel=1e-9)
    assert root_chord.designed == published_data().lengths.root_chord.designed


def test_a_weighed_mass_is_read_back(written_lab):
    mass = written_lab.lab.readings[0]

    assert (mass.value, mass.deviation) == pytest.approx((0.4711, 2e-3))


@pytest.fixture
def lengths_alone(written_lab, tmp_path):
    """A folder of which the lengths alone are left."""
    lengths_file, *_ = written_lab.files
    kept = tmp_path / lengths_file.relative_to(written_lab.root)
    kept.parent.mkdir(parents=True)
    kept.write_bytes(lengths_file.read_bytes())
    (tmp_path / written_lab.folder.relative_to(written_lab.root) / "step3").mkdir()
    return tmp_path


def test_what_is_not_there_is_as_published(written_lab, lengths_alone):
    published = published_data()
    lengths_hash = written_lab.lab.input_hashes["lengths"]

    lab = read_lab_folder(lengths_alone)

    assert [origin.read for origin in lab.origins] == [True, False, False]
    assert lab.input_hashes == published.input_hashes | {"lengths": lengths_hash}
    assert (lab.readings, lab.trials) == (published.readings, None)


def test_measured_ring_downs_need_a_record(lengths_alone):
    sentence = "no ring-down record, and --measured asks for them"

    with pytest.raises(ExperimentFileError, match=sentence):
        read_lab_folder(lengths_alone, "measured")


# ---------------------------------------------------------------- the planform in the design


def change_lengths(**measured):
    """Return the published lengths, some measured otherwise [m]."""
    published = published_lengths()
    changes = {
        name: replace(getattr(published, name), measured=value) for name, value in measured.items()
    }
    return published._replace(**changes)


MEASURED_LENGTHS = change_lengths(semi_span=1.83517, root_chord=0.4401, tip_chord=0.25541)
# Tolerances of 2.54 and 0.2 mm are half-widths of 95 % intervals.
MEASUREMENT_PRECISION = 0.2**-2
PRECISION = MEASUREMENT_PRECISION + 2.54**-2
DESIGNED_LENGTHS = {"semi_span": 1.8288, "root_chord": 0.43561, "tip_chord": 0.261112}


def weighted_mean(name: str) -> float:
    """Return the mean of a designed and a measured length, weighted with their precisions."""
    designed = DESIGNED_LENGTHS[name]
    measured = getattr(MEASURED_LENGTHS, name).measured
    return designed + MEASUREMENT_PRECISION / PRECISION * (measured - designed)


@pytest.mark.parametrize("name", DESIGNED_LENGTHS)
def test_the_posterior_of_a_length_is_the_precision_weighted_mean(name):
    posterior = getattr(MEASURED_LENGTHS, name).posterior

    assert posterior.mean == pytest.approx(weighted_mean(name), rel=1e-12)
    assert posterior.standard_deviation == pytest.approx(1e-3 * PRECISION**-0.5 / 1.96)


@pytest.mark.parametrize("name", DESIGNED_LENGTHS)
def test_the_prior_of_a_length_reaches_ten_per_cent_to_both_sides(name):
    designed = DESIGNED_LENGTHS[name]

    prior = getattr(MEASURED_LENGTHS, name).prior

    assert (prior.low, prior.high) == pytest.approx((0.9 * designed, 1.1 * designed))


@pytest.mark.parametrize("name", DESIGNED_LENGTHS)
def test_the_planform_is_the_posterior_mean_to_a_tenth_of_a_millimetre(name):
    geometry = tailored_geometry(MEASURED_LENGTHS)

    assert getattr(geometry, name) == round(weighted_mean(name), 4)


@pytest.mark.parametrize(("changes", "measured", "kind", "sentence"), INPUTS.refused("planform"))
def test_a_design_that_does_not_fit_the_planform_is_refused_with_its_place(
    changes, measured, kind, sentence
):
    error = {"Data": ExperimentDataError, "Design": InvalidDesignError}[kind]
    design = load_design().changed(**changes)

    with pytest.raises(error, match=sentence) as caught:
        tailored_design(design, change_lengths(**measured))

    assert "the changed design" not in str(caught.value)
