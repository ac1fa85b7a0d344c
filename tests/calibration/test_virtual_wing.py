"""A virtual wing and its laboratory: releases, records, reading errors."""

import math

import numpy as np
import pytest

from calibration import virtual_wing
from calibration.dynamics.trials import average, fit_trials
from calibration.errors import ExperimentDataError
from calibration.static.experiments import published_measurements
from calibration.virtual_wing import (
    SENSITIVITY,
    VirtualWing,
    measure_lengths,
    measure_load_test,
    measure_ring_down,
    weigh,
)
from fe.runtime.errors import OutsideModelError
from fe.runtime.state import TIP_FORCE, DigitalState, Geometry
from tests.calibration.bench import BEAM_STIFFNESS, Beam
from tests.refusals import Inputs
from tests.wings import wing_integrator

INPUTS = Inputs(__file__)
MODULUS_FACTOR = 1.0073
TRUTH = DigitalState(young_modulus_factor=MODULUS_FACTOR, damping_alpha=1.03, damping_beta=7.66e-4)
MASSES = {"servo_mass": TRUTH.servo_mass, "pitot_mass": TRUTH.pitot_mass}
NO_LOSS = (0.0, 0.0)
RELEASE = 0.03
"""Displacement of the tip that is let go [m]."""
GAUGE = virtual_wing.RECORDED_GAUGE - 1
"""The index of the gauge that is recorded."""


# ---------------------------------------------------------------- a release


@pytest.fixture(scope="module")
def release(wing):
    """The signal [V] of a release over 0.4 s, 1000 samples a second."""
    _, signal = VirtualWing(wing, TRUTH).ring_down(RELEASE, 0.4, 1000.0)
    return signal


@pytest.mark.slow
def test_a_release_moves_as_the_integrator_has_it(wing, release):
    integrator = wing_integrator(
        wing,
        young_modulus_factor=MODULUS_FACTOR,
        stiffness_loss=NO_LOSS,
        damping_alpha=1.03,
        damping_beta=7.66e-4,
        **MASSES,
    )
    states = [integrator.state_after_release(RELEASE, (0.0, 0.0), TIP_FORCE)]
    for _ in release[1:]:
        states.append(integrator.advance(states[-1], 1e-3, (0.0, 0.0)))

    strain = np.array([integrator.outputs(state)[GAUGE] for state in states])

    np.testing.assert_allclose(release, SENSITIVITY * strain, atol=1e-12)


@pytest.mark.slow
def test_a_release_begins_at_the_static_strain(wing, release):
    unit_force = wing.static_response(
        young_modulus_factor=MODULUS_FACTOR,
        stiffness_loss=NO_LOSS,
        load_factor=0.0,
        tip_force=1.0,
    )
    (displacement,) = unit_force.displacement
    holding_force = RELEASE / displacement

    static_signal = SENSITIVITY * holding_force * unit_force.strain[GAUGE]

    # What six modes leave out of the static strain is small.
    assert release[0] == pytest.approx(static_signal, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("damping", ["overdamped", "critical"])
def test_modes_that_do_not_oscillate_die_away(wing, damping):
    modes = wing.modes(young_modulus_factor=1.0, stiffness_loss=NO_LOSS, **MASSES)
    critical_beta = 1.0 / (math.pi * modes.frequency[3])
    state = DigitalState(
        damping_alpha=0.0, damping_beta=0.03 if damping == "overdamped" else critical_beta
    )

    _, signal = VirtualWing(wing, state).ring_down(RELEASE, 1.0, 500.0)

    assert np.all(np.isfinite(signal))
    assert abs(signal[-1]) < abs(signal[0])


# ---------------------------------------------------------------- the truth in its records


@pytest.fixture(scope="module")
def virtual_bench(wing):
    """A virtual wing whose frequencies are a little off those of the model."""
    return VirtualWing(wing, TRUTH, frequency_error=(-0.01, 0.045))


@pytest.fixture(scope="module")
def recorded_trials(virtual_bench):
    """Fits of the ring-downs of the bench."""
    return fit_trials(
        measure_ring_down(virtual_bench, 3, sampling_rate=250.0), frequencies_fitted=True
    )


@pytest.mark.slow
def test_records_give_back_the_true_frequencies(wing, recorded_trials):
    modes = wing.modes(young_modulus_factor=MODULUS_FACTOR, stiffness_loss=NO_LOSS, **MASSES)
    true_first, true_second = modes.frequency[list(modes.followed)]

    first = average(recorded_trials, "frequency", 0).mean
    second = average(recorded_trials, "frequency", 1).mean

    assert first == pytest.approx(0.99 * true_first, rel=2e-4)
    assert second == pytest.approx(1.045 * true_second, rel=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "ratio", "tolerance"), [(0, 0.0281, 5e-3), (1, 0.0716, 0.04)])
def test_records_give_back_the_true_damping(recorded_trials, mode, ratio, tolerance):
    mean = average(recorded_trials, "damping_ratio", mode).mean

    assert mean == pytest.approx(ratio, rel=tolerance)


@pytest.mark.slow
def test_a_load_test_gives_back_the_true_stiffness(wing, virtual_bench):
    displacement = virtual_bench.tip_displacement(9.81)

    expected = 9.81 / wing.tip_stiffness(MODULUS_FACTOR)
    assert displacement == pytest.approx(expected, rel=1e-12)


def test_a_wing_with_fewer_gauges_cannot_be_recorded():
    sentence = "has 22 gauges, but a release is recorded at gauge 23"

    with pytest.raises(ExperimentDataError, match=sentence):
        virtual_wing.check_recorded(22)


@pytest.mark.slow
def test_a_frequency_error_that_leaves_no_frequency_is_refused(wing):
    with pytest.raises(ExperimentDataError, match="frequency error"):
        VirtualWing(wing, TRUTH, frequency_error=(-1.0, 0.0))


@pytest.mark.slow
def test_a_truth_outside_the_model_is_refused(wing):
    with pytest.raises(OutsideModelError, match="servo_mass"):
        VirtualWing(wing, DigitalState(servo_mass=0.9))


# ---------------------------------------------------------------- reading errors


@pytest.fixture(scope="module")
def load_tests():
    """500 load tests of the beam, each with another seed."""
    return [measure_load_test(Beam(), seed) for seed in range(500)]


@pytest.fixture(scope="module")
def load_errors(load_tests):
    return np.array([test.load for test in load_tests]) - published_measurements().load


@pytest.fixture(scope="module")
def displacement_errors(load_tests):
    true_displacement = published_measurements().load / BEAM_STIFFNESS
    return np.array([test.displacement for test in load_tests]) - true_displacement


def test_a_load_test_has_the_runs_of_the_published_one(load_tests):
    np.testing.assert_array_equal(load_tests[0].run, published_measurements().run)


def test_errors_of_loads_are_as_stated(load_errors):
    deviation = published_measurements().load_standard_deviation

    assert np.mean(load_errors) == pytest.approx(0.0, abs=3e-3)
    assert np.std(load_errors) == pytest.approx(deviation, rel=0.05)


def test_errors_of_displacements_are_as_stated(displacement_errors):
    deviation = published_measurements().displacement_standard_deviation

    assert np.mean(displacement_errors) == pytest.approx(0.0, abs=2e-5)
    assert np.std(displacement_errors) == pytest.approx(deviation, rel=0.05)


def test_errors_of_loads_and_displacements_are_independent(load_errors, displacement_errors):
    correlation = np.corrcoef(load_errors.ravel(), displacement_errors.ravel())[0, 1]

    assert abs(correlation) < 0.05


def test_errors_of_weighed_masses_are_as_stated():
    masses = [weigh(TRUTH, seed).value for seed in range(400)]

    true_mass = 2.0 * TRUTH.servo_mass + TRUTH.pitot_mass
    assert np.mean(masses) == pytest.approx(true_mass, abs=2e-4)
    assert np.std(masses) == pytest.approx(1e-3, rel=0.15)


def test_errors_of_lengths_are_as_stated():
    spans = [measure_lengths(Geometry(), seed).semi_span.measured for seed in range(400)]

    assert np.mean(spans) == pytest.approx(1.828, abs=2e-5)
    assert np.std(spans) == pytest.approx(0.2e-3 / 1.96, rel=0.15)


# ---------------------------------------------------------------- seeds and settings


def record_two_trials(seed):
    """Return the bytes of two short records."""
    records = measure_ring_down(Beam(), seed, trials=2, duration=2.0)
    return [record.signal.tobytes() for record in records]


def test_records_of_the_same_seed_have_the_same_bytes():
    assert record_two_trials(4) == record_two_trials(4)


def test_records_and_seeds_have_noise_of_their_own():
    signals = {*record_two_trials(4), *record_two_trials(5)}

    assert len(signals) == 4


def test_load_tests_of_the_same_seed_are_the_same():
    assert measure_load_test(Beam(), 4).sha256 == measure_load_test(Beam(), 4).sha256


def test_a_quantised_record_has_whole_steps():
    step = 5e-5

    (record,) = measure_ring_down(Beam(), 1, trials=1, quantisation=step)

    steps = record.signal / step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)


@pytest.mark.parametrize(("settings", "sentence"), INPUTS.refused("ring_down_settings"))
def test_impossible_settings_of_a_record_are_refused(settings, sentence):
    with pytest.raises(ExperimentDataError, match=sentence):
        measure_ring_down(Beam(), 1, **settings)
