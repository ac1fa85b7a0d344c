"""What is read of a laboratory or published instead; the planform; a virtual wing and its laboratory."""

import math
from dataclasses import replace

import numpy as np
import pytest

from calibration import virtual_wing
from calibration.dynamics.records import read_records
from calibration.dynamics.trials import average, fit_trials
from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.geometry import published_lengths, read_lengths, tailored_design, tailored_geometry
from calibration.joint.wing_table import weighed
from calibration.paper.procedure import read_published_results
from calibration.static.experiments import published_measurements, read_measurements
from calibration.virtual_wing import (
    VirtualWing,
    measure_lengths,
    measure_load_test,
    measure_ring_down,
    weigh,
)
from calibration.wing.lab_data import (
    published_data,
    read_lab_folder,
    read_weighed_mass,
    write_lab_folder,
)
from fe.runtime.errors import InvalidDesignError, OutsideModelError
from fe.runtime.state import TIP_FORCE, DigitalState, Geometry
from fe.wing.design import load_design
from tests.calibration.decays import free_decay
from tests.refusals import Inputs, refused
from tests.wings import wing_integrator

INPUTS = Inputs(__file__)


def test_columns_and_runs_of_a_load_test(tmp_path):
    """A run begins where the load falls; equal readings of two runs, or numbered ones, may be."""

    def read(text):
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
    assert replace(data, source="another name").sha256 == data.sha256
    for other in (
        {"load": data.load + 1e-12},
        {"load_standard_deviation": 2.0 * data.load_standard_deviation},
    ):
        assert replace(data, **other).sha256 != data.sha256
    with pytest.raises(ExperimentDataError, match="load of reading 2 is 0"):
        replace(data, load=np.where(np.arange(8) == 1, 0.0, data.load))


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


BAD = [
    pytest.param(name, *row, id=f"{name}: {row[-1]}")
    for name in READERS
    for row in INPUTS.refused(name)
]


@pytest.mark.parametrize(("name", "old", "new", "kind", "sentence"), BAD)
def test_a_bad_file_is_one_sentence(tmp_path, name, old, new, kind, sentence):
    file = tmp_path / "step3" / "weighed_mass.csv"
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


@pytest.mark.parametrize(
    ("load", "displacement", "sentence"), [*INPUTS.refused("units"), (0.0, 0.0, "")]
)
def test_wrong_units_are_recognised(tmp_path, load, displacement, sentence):
    pairs = np.loadtxt(INPUTS.text("load_test.csv").splitlines(), delimiter=",", skiprows=1)
    pairs = pairs * [load, displacement] if load else pairs[:, ::-1]  # exchanged
    rows = "\n".join(f"{load:.10g},{displacement:.10g}" for load, displacement in pairs)
    (tmp_path / "pairs.csv").write_text(f"load,displacement\n{rows}\n", encoding="utf-8")
    with refused(
        ExperimentDataError, f"{sentence}.*expected before calibration|expected.*{sentence}"
    ):
        read_measurements(tmp_path / "pairs.csv")


# -------------------------------- the measured planform in the design, and what a wing cannot be


def lengths(**measured):
    """The published lengths, some measured otherwise [m]."""
    published = published_lengths()
    changes = {
        name: replace(getattr(published, name), measured=value) for name, value in measured.items()
    }
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
        assert (length.prior.low, length.prior.high) == pytest.approx(
            (0.9 * designed, 1.1 * designed)
        )


@pytest.mark.parametrize(("changes", "measured", "kind", "words"), INPUTS.refused("planform"))
def test_what_no_longer_fits_is_refused_with_its_place(changes, measured, kind, words):
    error = {"Data": ExperimentDataError, "Design": InvalidDesignError}[kind]
    with pytest.raises(error, match=words) as caught:
        tailored_design(load_design().changed(**changes), lengths(**measured))
    assert "the changed design" not in str(caught.value)


# ---------------------------------------------------------------- the virtual wing


TRUTH = DigitalState(young_modulus_factor=1.0073, damping_alpha=1.03, damping_beta=7.66e-4)
MASSES = {"servo_mass": TRUTH.servo_mass, "pitot_mass": TRUTH.pitot_mass}


class Beam:
    """A test bench of closed formulas: k = 680 N/m, two modes."""

    def tip_displacement(self, load):
        return load / 680.0

    def ring_down(self, initial_tip_displacement, duration, rate):
        time = virtual_wing.sampling_times(duration, rate)
        signal = free_decay(time, 5.65, 0.028, 0.8) + free_decay(time, 29.0, 0.05, 0.5)
        return time, 0.4 * initial_tip_displacement * signal


@pytest.mark.slow
def test_the_release_is_the_integrators(wing):
    time, signal = VirtualWing(wing, TRUTH).ring_down(0.03, 0.4, 1000.0)
    integrator = wing_integrator(
        wing, young_modulus_factor=1.0073, stiffness_loss=(0.0, 0.0), damping_alpha=1.03,
        damping_beta=7.66e-4, **MASSES,
    )  # fmt: skip
    gauge, states = (
        virtual_wing.RECORDED_GAUGE - 1,
        [integrator.state_after_release(0.03, (0.0, 0.0), TIP_FORCE)],
    )
    for _ in time[1:]:
        states.append(integrator.advance(states[-1], 1e-3, (0.0, 0.0)))
    strain = np.array([integrator.outputs(state)[gauge] for state in states])
    np.testing.assert_allclose(signal, virtual_wing.SENSITIVITY * strain, atol=1e-12)
    held = wing.static_response(
        young_modulus_factor=1.0073, stiffness_loss=(0.0, 0.0), load_factor=0.0, tip_force=1.0
    )
    holding_force = 0.03 / held.displacement[0]
    # What six modes leave out of the static strain is small.
    static = virtual_wing.SENSITIVITY * holding_force * held.strain[gauge]
    assert signal[0] == pytest.approx(static, rel=0.02)
    # overdamped and critical modes
    modes = wing.modes(young_modulus_factor=1.0, stiffness_loss=(0.0, 0.0), **MASSES)
    for beta in (0.03, 1.0 / (math.pi * modes.frequency[3])):
        damped = DigitalState(damping_alpha=0.0, damping_beta=beta)
        _, signal = VirtualWing(wing, damped).ring_down(0.03, 1.0, 500.0)
        assert np.all(np.isfinite(signal))
        assert abs(signal[-1]) < abs(signal[0])


@pytest.mark.slow
def test_records_give_back_the_truth(wing):
    bench = VirtualWing(wing, TRUTH, frequency_error=(-0.01, 0.045))
    modes = wing.modes(young_modulus_factor=1.0073, stiffness_loss=(0.0, 0.0), **MASSES)
    first, second = modes.frequency[list(modes.followed)]
    trials = fit_trials(measure_ring_down(bench, 3, sampling_rate=250.0), free=True)
    for name, mode, value, error in (
        ("frequency", 0, 0.99 * first, 2e-4), ("frequency", 1, 1.045 * second, 5e-3),
        ("damping_ratio", 0, 0.0281, 5e-3), ("damping_ratio", 1, 0.0716, 0.04),
    ):  # fmt: skip
        assert average(trials, name, mode).mean == pytest.approx(value, rel=error)
    assert bench.tip_displacement(9.81) == pytest.approx(
        9.81 / wing.tip_stiffness(1.0073), rel=1e-12
    )
    with pytest.raises(
        ExperimentDataError, match="has 22 gauges, but a release is recorded at gauge 23"
    ):
        virtual_wing.check_recorded(22)
    with pytest.raises(ExperimentDataError, match="frequency error"):
        VirtualWing(wing, TRUTH, frequency_error=(-1.0, 0.0))
    with pytest.raises(OutsideModelError, match="servo_mass"):
        VirtualWing(wing, DigitalState(servo_mass=0.9))


def test_reading_errors_are_as_stated_and_follow_the_seed():
    published = published_measurements()
    tests = [measure_load_test(Beam(), seed) for seed in range(500)]
    load = np.array([test.load for test in tests]) - published.load
    displacement = np.array([test.displacement for test in tests]) - published.load / 680.0
    assert abs(np.corrcoef(load.ravel(), displacement.ravel())[0, 1]) < 0.05
    np.testing.assert_array_equal(tests[0].run, published.run)
    total = [weigh(TRUTH, seed).value for seed in range(400)]
    lengths = [measure_lengths(Geometry(), seed).semi_span.measured for seed in range(400)]
    for readings, mean, bias, deviation, error in (
        (load, 0.0, 3e-3, published.load_standard_deviation, 0.05),
        (displacement, 0.0, 2e-5, published.displacement_standard_deviation, 0.05),
        (total, 2.0 * TRUTH.servo_mass + TRUTH.pitot_mass, 2e-4, 1e-3, 0.15),
        (lengths, 1.828, 2e-5, 0.2e-3 / 1.96, 0.15),
    ):
        assert np.mean(readings) == pytest.approx(mean, abs=bias)
        assert np.std(readings) == pytest.approx(deviation, rel=error)
    one, two, other = (
        measure_ring_down(Beam(), seed, trials=2, duration=2.0) for seed in (4, 4, 5)
    )
    assert one[1].signal.tobytes() == two[1].signal.tobytes()
    assert len({record.signal.tobytes() for record in (*one, *other)}) == 4
    assert measure_load_test(Beam(), 4).sha256 == measure_load_test(Beam(), 4).sha256
    (record,) = measure_ring_down(Beam(), 1, trials=1, quantisation=5e-5)
    np.testing.assert_allclose(record.signal / 5e-5, np.round(record.signal / 5e-5), atol=1e-9)


@pytest.mark.parametrize(("settings", "words"), INPUTS.refused("ring_down_settings"))
def test_bad_settings(settings, words):
    with pytest.raises(ExperimentDataError, match=words):
        measure_ring_down(Beam(), 1, **settings)


@pytest.mark.parametrize(("above", "rate"), [("", 500.0), ("src/datafiles", 100_000.0)])
def test_a_folder_is_read_back_and_what_is_not_there_is_as_published(tmp_path, above, rate):
    lengths, load_test = measure_lengths(Geometry(), 2), measure_load_test(Beam(), 2)
    records = measure_ring_down(Beam(), 2, trials=2, duration=1.0, sampling_rate=rate)
    folder = tmp_path / above
    files = write_lab_folder(
        folder,
        lengths=lengths,
        load_test=load_test,
        records=records,
        total_mass=weighed(0.4711, 2e-3),
    )
    lab, published = read_lab_folder(tmp_path, free=True), published_data()
    assert [origin.read for origin in lab.origins] == [True] * 3
    assert "weighed_mass.csv read" in lab.origins[2].text
    assert lab.input_hashes.keys() == {
        "lengths",
        "load_test",
        "weighed_mass",
        "ring_down_1",
        "ring_down_2",
    }
    assert not lab.input_hashes.items() & published.input_hashes.items()
    np.testing.assert_allclose(lab.pairs.load, load_test.load, rtol=1e-9)
    np.testing.assert_allclose(lab.pairs.displacement, load_test.displacement, rtol=1e-9)
    np.testing.assert_array_equal(lab.pairs.run, load_test.run)
    for written, read in zip(records, read_records(folder / "step3"), strict=True):
        np.testing.assert_allclose(read.time, written.time, atol=1e-6)
        np.testing.assert_allclose(read.signal, written.signal, rtol=1e-8, atol=1e-12)
        assert read.sampling_rate == pytest.approx(rate, rel=1e-6)
    assert len(lab.trials) == 2
    assert lab.lengths.root_chord.measured == pytest.approx(lengths.root_chord.measured, rel=1e-9)
    assert lab.lengths.root_chord.designed == published.lengths.root_chord.designed
    assert (lab.readings[0].value, lab.readings[0].deviation) == pytest.approx((0.4711, 2e-3))
    for file in files[1:]:
        file.unlink()
    (folder / "step2").rmdir()
    rest = read_lab_folder(tmp_path)
    assert [origin.read for origin in rest.origins] == [True, False, False]
    assert rest.input_hashes == published.input_hashes | {"lengths": lab.input_hashes["lengths"]}
    assert (rest.readings, rest.trials) == (published.readings, None)
    with pytest.raises(
        ExperimentFileError, match="no ring-down record, and --measured asks for them"
    ):
        read_lab_folder(tmp_path, "measured")
