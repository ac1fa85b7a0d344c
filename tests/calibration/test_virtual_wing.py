"""The virtual wing: its physics against the integrator, its experiments, its laboratory folder."""

import math

import numpy as np
import pytest

from calibration import virtual_wing
from calibration.dynamics.records import read_records
from calibration.dynamics.trials import average, fit_trials
from calibration.errors import ExperimentDataError, ExperimentFileError
from calibration.joint.wing_table import weighed
from calibration.static.experiments import published_measurements
from calibration.virtual_wing import (
    RECORDED_GAUGE,
    SENSITIVITY,
    VirtualWing,
    check_recorded,
    measure_lengths,
    measure_load_test,
    measure_ring_down,
    weigh,
)
from calibration.wing.lab_data import published_data, read_lab_folder, write_lab_folder
from fe.runtime.errors import OutsideModelError
from fe.runtime.state import TIP_FORCE, DigitalState, Geometry
from tests.calibration.decays import free_decay
from tests.refusals import Inputs
from tests.wings import wing_integrator

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
    state = integrator.released(0.03, (0.0, 0.0), TIP_FORCE)
    strain = [integrator.outputs(state)[:-1][RECORDED_GAUGE - 1]]
    for _ in time[1:]:
        state = integrator.advance(state, 1e-3, (0.0, 0.0))
        strain.append(integrator.outputs(state)[:-1][RECORDED_GAUGE - 1])
    np.testing.assert_allclose(signal, SENSITIVITY * np.array(strain), atol=1e-12)
    held = wing.static_response(
        young_modulus_factor=1.0073, stiffness_loss=(0.0, 0.0), load_factor=0.0, tip_force=1.0
    )
    holding_force = 0.03 / held.displacement[0]
    # What six modes leave out of the static strain is small.
    assert signal[0] == pytest.approx(SENSITIVITY * holding_force * held.strain[RECORDED_GAUGE - 1], rel=0.02)
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
    assert bench.tip_displacement(9.81) == pytest.approx(9.81 / wing.tip_stiffness(1.0073), rel=1e-12)
    with pytest.raises(ExperimentDataError, match="has 22 gauges, but a release is recorded at gauge 23"):
        check_recorded(22)
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
    one, two, other = (measure_ring_down(Beam(), seed, trials=2, duration=2.0) for seed in (4, 4, 5))
    assert one[1].signal.tobytes() == two[1].signal.tobytes()
    assert len({record.signal.tobytes() for record in (*one, *other)}) == 4
    assert measure_load_test(Beam(), 4).sha256 == measure_load_test(Beam(), 4).sha256
    (record,) = measure_ring_down(Beam(), 1, trials=1, quantisation=5e-5)
    np.testing.assert_allclose(record.signal / 5e-5, np.round(record.signal / 5e-5), atol=1e-9)


@pytest.mark.parametrize(("settings", "words"), Inputs(__file__).refused("ring_down_settings"))
def test_bad_settings(settings, words):
    with pytest.raises(ExperimentDataError, match=words):
        measure_ring_down(Beam(), 1, **settings)


@pytest.mark.parametrize(("above", "rate"), [("", 500.0), ("src/datafiles", 100_000.0)])
def test_a_folder_is_read_back_and_what_is_not_there_is_as_published(tmp_path, above, rate):
    lengths, load_test = measure_lengths(Geometry(), 2), measure_load_test(Beam(), 2)
    records = measure_ring_down(Beam(), 2, trials=2, duration=1.0, sampling_rate=rate)
    folder = tmp_path / above
    files = write_lab_folder(
        folder, lengths=lengths, load_test=load_test, records=records, total_mass=weighed(0.4711, 2e-3)
    )
    lab, published = read_lab_folder(tmp_path, free=True), published_data()
    assert [origin.read for origin in lab.origins] == [True] * 3
    assert "weighed_mass.csv read" in lab.origins[2].text
    assert lab.input_hashes.keys() == {"lengths", "load_test", "weighed_mass", "ring_down_1", "ring_down_2"}
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
    with pytest.raises(ExperimentFileError, match="no ring-down record, and --measured asks for them"):
        read_lab_folder(tmp_path, "measured")
