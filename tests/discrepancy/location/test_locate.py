"""Locating: calibration under the null, discoveries, words of disagreements; backbones of known laws."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from discrepancy.campaign.records import NoiseRecord
from discrepancy.errors import FitError
from discrepancy.location.backbones import backbones
from discrepancy.location.dependence import modal_motion, predicted_frequencies
from discrepancy.location.locate import locate, outlier_remarks
from discrepancy.location.map import dependence_functions, residual_map
from discrepancy.location.patterns import group_by_kind, singular_patterns
from discrepancy.location.residuals import ResidualSet, sum_of_squares_moments
from tests.discrepancy.bench import SHAPES, Bench, with_noise

# ---------------------------------------------------------------- calibration of the whole


def test_the_map_is_silent_under_the_null_and_honest_beside_a_bad_channel():
    bench = Bench(count=120)
    generator = np.random.default_rng(23)
    silent, proportion = [], []
    for _ in range(20):
        fitted = bench.fit(generator)
        silent.append(
            not any(cell.significant for cell in residual_map(fitted, fitted.whitened_residuals(generator)))
        )
        fitted = bench.fit(generator, extra={0: np.array([0.0, 0.0, 4.0, 0.0])})
        cells = residual_map(fitted, fitted.whitened_residuals(generator))
        found = [(cell.channel, cell.trial) for cell in cells if cell.significant]
        assert ("g3", "release 1") in found
        proportion.append(np.mean([place != ("g3", "release 1") for place in found]))
    assert np.mean(silent) >= 0.95 - 3.0 * np.sqrt(0.05 * 0.95 / 20)
    assert np.mean(proportion) <= 0.05


def test_a_short_noise_record_makes_no_pattern_over_the_channels():
    """Noise of a channel that its record takes for smaller is no finding of a sensor."""
    bench, generator = Bench(count=120, noise_freedom=20.0), np.random.default_rng(5)
    told = 0
    for _ in range(40):
        fitted = bench.fit(generator)
        told += sum(
            bool(singular_patterns(fitted, kind))
            for kind in group_by_kind(fitted, fitted.whitened_residuals(generator))
        )
    assert told <= binom.isf(1e-3, 80, 0.01)


def located(seed, extra, **given):
    """Locate what is added to a bench; return all, the first told apart from its channels, and patterns."""
    bench = Bench(**given)
    found = locate(bench.fit(np.random.default_rng(seed), extra=extra(bench)))
    patterns = [item for item in found.disagreements if item.dependence == "channels"]
    return found, next(item for item in found.disagreements if item not in patterns), patterns


def in_releases(shape, wave):
    """Return a wave in time with a size in each channel, added to every release."""

    def extra(bench):
        return {n: np.outer(wave(trial, n), shape) for n, trial in enumerate(bench.trials[:-1])}

    return extra


def quadratic(trial, _):
    """An error that grows with the square of the amplitude of mode 1, in phase with its velocity."""
    w = 2.0 * np.pi * 5.0
    amplitude = trial.release.displacement * np.exp(-0.02 * w * trial.time)
    return 60.0 * (amplitude / 200.0) ** 2 * np.sin(w * trial.time)


def hum(trial, _):
    return np.cos(2 * np.pi * 17.0 * trial.time)


MODE = SHAPES[0]


@pytest.fixture(scope="module")
def amplitude_dependence():
    """What is located of an error of mode 1 that grows with its amplitude, in three releases."""
    return located(2, in_releases(MODE, quadratic), amplitudes=(200.0, 100.0, 50.0))


def test_an_amplitude_dependence_is_told_where_releases_differ(amplitude_dependence):
    location, first, _ = amplitude_dependence
    assert location.disagrees
    assert (first.subject, first.dependence, first.trials) == ("mode 1", "amplitude", "ring-down")
    assert first.share > 0.8


def test_an_amplitude_dependence_is_told_in_a_sentence(amplitude_dependence):
    _, first, _ = amplitude_dependence
    assert first.sentence.startswith("Mode 1, by amplitude, in ring-down trials; explains ")


def test_the_pattern_of_a_mode_is_dynamics_or_load(amplitude_dependence):
    _, _, patterns = amplitude_dependence
    pattern = next(item for item in patterns if item.trials == "ring-down")
    assert pattern.subject == "dynamics or load"
    assert pattern.share > 0.8


def test_releases_of_one_amplitude_do_not_tell_amplitude_from_time():
    _, first, _ = located(2, in_releases(MODE, quadratic))
    assert first.subject == "mode 1"
    assert "do not tell the two apart" in first.sentence


@pytest.fixture(scope="module")
def bad_gauge():
    """What is located of a gauge that drifts in static trials."""
    drift = np.zeros((16, 4))
    drift[:, 1] = np.linspace(0.0, 25.0, 16)
    location, _, patterns = located(3, lambda bench: {2: drift})
    return location, patterns


def test_a_bad_gauge_is_a_sensor(bad_gauge):
    location, patterns = bad_gauge
    assert location.disagrees
    assert patterns[0].subject == "sensor"
    assert "g2" in patterns[0].sentence


def test_a_bad_gauge_is_the_subject_of_static_trials(bad_gauge):
    location, _ = bad_gauge
    static = next(item for item in location.disagreements if item.trials == "static")
    assert static.subject in ("channel g2", "sensor")


def test_most_significant_cells_are_those_of_a_bad_gauge(bad_gauge):
    """The fit puts part of the drift into the stiffness that all gauges share: others may follow faintly."""
    location, _ = bad_gauge
    significant = [cell.channel == "g2" for cell in location.cells if cell.significant]
    assert min(location.cells, key=lambda cell: cell.p_value).channel == "g2"
    assert np.mean(significant) > 0.6


def test_few_static_readings_do_not_drown_in_many_samples():
    wave = np.outer(3.0 * np.array([1.0, -1.0] * 8), [1.0, 0.5, 1.0, 0.5])
    variance = locate(Bench(count=1500).fit(np.random.default_rng(3), extra={2: wave})).tests[0]
    assert variance.rejected
    assert variance.where.startswith("steps, ")
    assert variance.statistic < 1.1


def test_modes_are_those_of_records_at_one_rate():
    """Of a record at half the rate the peaks would be at twice their frequencies."""
    fast, long = (Bench(count=count).fit(np.random.default_rng(7)).trials[0] for count in (300, 600))
    wave = {"trial": replace(fast.trial, time=2.0 * fast.trial.time), "prediction": long.prediction[::2]}
    slow = replace(fast, **wave)
    assert predicted_frequencies((fast, slow)) == predicted_frequencies((fast,))


@pytest.fixture(scope="module")
def located_hum():
    """What is located of a hum that is common to all channels."""
    return located(4, in_releases(np.full(4, 2.0), hum))


def test_a_line_is_found_by_its_test(located_hum):
    location, _, _ = located_hum
    line = next(test for test in location.tests if test.name == "Fisher g")
    assert line.rejected
    assert line.where.endswith("17 Hz")


def test_a_hum_is_a_line_that_is_common_to_all_channels(located_hum):
    _, first, patterns = located_hum
    assert patterns[0].subject == "common"
    assert first.dependence == "a line at 17 Hz"
    assert first.share > 0.9


def test_a_mode_that_the_model_lacks_is_a_decaying_line():
    def lacking_mode(trial, n):
        return np.cos(2 * np.pi * 9.0 * trial.time + n) * np.exp(-2.0 * trial.time)

    shape = 40.0 * np.array([0.2, 0.5, -0.3, 0.1])
    _, first, _ = located(4, in_releases(shape, lacking_mode))
    assert first.dependence in ("a decaying line at 9 Hz", "a decaying line at 9.08 Hz")
    assert first.share > 0.8
    assert first.sentence.startswith("All channels, a decaying line at 9")


def test_what_follows_the_temperature_of_static_trials_is_told():
    def warming(bench):
        return {2: np.outer(bench.trials[-1].temperature, np.full(4, 3.0))}

    location, first, _ = located(5, warming)
    assert (first.trials, first.dependence) == ("static", "temperature")
    assert any(cell.statistic == "temperature" and cell.significant for cell in location.cells)


@pytest.fixture(scope="module")
def spiky():
    """Residuals with three spikes in a trial."""
    spikes = np.zeros((300, 4))
    spikes[[20, 150, 280], [0, 2, 2]] = 30.0
    return Bench().fit(np.random.default_rng(4), extra={1: spikes})


def test_outliers_are_remarked_as_errors_of_the_data(spiky):
    (remark,) = outlier_remarks(spiky)
    assert "row 21 of 'g1' in the trial" in remark
    assert "rows 151 and 281 of 'g3' in the trial" in remark
    assert not outlier_remarks(Bench().fit(np.random.default_rng(4)))


def test_a_sample_without_neighbours_is_no_outlier(spiky):
    """As it is beside a gap."""
    residuals = spiky.trials[1]
    used = residuals.used.copy()
    used[[19, 21, 149, 151, 279, 281]] = False
    gaps = replace(residuals, trial=replace(residuals.trial, used=used))
    assert not outlier_remarks(replace(spiky, trials=(gaps,)))


def test_where_the_model_is_off_many_samples_are_far_out_and_none_is_an_outlier(spiky):
    residuals = spiky.trials[1]
    off = replace(residuals, residual=residuals.residual + 20.0 * residuals.noise_deviation)
    assert not outlier_remarks(replace(spiky, trials=(off,)))


def test_where_the_model_is_far_off_no_cell_is_judged():
    """What was fitted is uncertain by the size of the residual."""
    fitted = Bench(count=120).fit(np.random.default_rng(5))
    generator = np.random.default_rng(6)
    uncertain_trials = []
    for item in fitted.trials:
        sensitivity = 200.0 * generator.standard_normal((*item.residual.shape, 1))
        leverage = np.ones_like(item.leverage)
        uncertain_trials.append(replace(item, leverage=leverage, sensitivity=sensitivity))
    location = locate(replace(fitted, trials=tuple(uncertain_trials)))
    assert not any(cell.axis != "frequency" for cell in location.cells)
    assert any("no single cell of the map can be judged" in remark for remark in location.remarks)


def test_without_a_noise_record_nothing_absolute_is_said():
    location = locate(with_noise(Bench().fit(np.random.default_rng(1)), None))
    assert np.isnan(location.tests[0].p_value)
    assert "No noise record for g1" in location.remarks[0]
    assert not any(cell.statistic == "variance" for cell in location.cells)


def test_without_a_noise_record_there_is_no_gap():
    location = locate(with_noise(Bench().fit(np.random.default_rng(1)), None))
    assert not location.disagrees


def test_residuals_below_the_noise_record_are_remarked_on_and_no_gap():
    fitted = Bench().fit(np.random.default_rng(1))
    quiet = tuple(replace(item, noise_deviation=3.0 * item.noise_deviation) for item in fitted.trials)
    location = locate(replace(fitted, trials=quiet))
    assert any("smaller than their noise record allows" in remark for remark in location.remarks)
    assert not location.disagrees


def test_a_line_that_the_noise_record_holds_too_is_no_gap():
    bench, generator = Bench(), np.random.default_rng(9)
    line = 1.5 * np.cos(2 * np.pi * 17.0 * 0.01 * np.arange(400))
    samples = 2.0 * generator.standard_normal(400) + line
    record = NoiseRecord(float(samples.std()), 399.0, samples, 0.01, "pre-trigger")
    fitted = bench.fit(generator, extra=in_releases(np.full(4, 1.5), hum)(bench))
    deviation = np.full(4, samples.std())
    trials = tuple(replace(item, noise_deviation=deviation) for item in fitted.trials)
    location = locate(with_noise(replace(fitted, trials=trials), record))
    assert any("holds a line at 17 Hz" in remark for remark in location.remarks)
    assert not location.disagrees


@pytest.fixture(scope="module")
def error_in_held_out():
    """Residuals with an error in the trial that is held out."""
    bench = Bench(amplitudes=(200.0, 150.0), held_out=(False, True))
    return bench.fit(np.random.default_rng(2), extra={1: np.full(4, 50.0)})


def test_the_same_seed_gives_the_same_bits(error_in_held_out):
    first, second = locate(error_in_held_out, seed=5), locate(error_in_held_out, seed=5)
    assert first.tests == second.tests
    assert [cell.p_value for cell in first.cells] == [cell.p_value for cell in second.cells]


def test_held_out_trials_do_not_count(error_in_held_out):
    location = locate(error_in_held_out, seed=5)
    assert not location.disagrees
    assert "release 2" not in {cell.trial for cell in location.cells}


def test_a_campaign_in_which_every_trial_is_held_out_is_refused(error_in_held_out):
    held_out = replace(error_in_held_out, trials=error_in_held_out.trials[1:2])
    with pytest.raises(FitError, match="every trial is held out"):
        locate(held_out)


def test_one_channel_of_few_static_points_is_located():
    fitted = Bench().fit(np.random.default_rng(2))
    residuals = fitted.trials[-1]
    rows = residuals.trial.rows(np.arange(len(residuals.trial.time)) < 3)
    trial = replace(rows, channels=("g1",), values=rows.values[:, :1], used=rows.used[:, :1])
    names = ("prediction", "residual", "predictive_deviation", "leverage", "sensitivity")
    small = {name: getattr(residuals, name)[:3, :1] for name in names}
    item = replace(residuals, trial=trial, noise_deviation=residuals.noise_deviation[:1], **small)
    location = locate(replace(fitted, trials=(item,)))
    assert not location.disagrees
    assert not location.disagreements
    assert all(np.isfinite(cell.p_value) for cell in location.cells)


def test_a_bin_of_time_without_a_sample_is_no_cell():
    """A quarter of the record does not count."""
    fitted = Bench().fit(np.random.default_rng(2))
    residuals = fitted.trials[0]
    is_late = np.arange(len(residuals.used)) >= len(residuals.used) // 4
    trial = replace(residuals.trial, used=residuals.used & is_late[:, None])
    location = locate(replace(fitted, trials=(replace(residuals, trial=trial),)))
    assert min(cell.count for cell in location.cells if cell.axis == "time") > 0


def test_harmonics_of_a_motion_are_those_of_its_phase():
    item = Bench(count=400).fit(np.random.default_rng(2)).trials[0]
    angle = 2.0 * np.pi * 5.0 * item.trial.time
    moved = {"prediction": np.cos(angle), "rates": -np.sin(angle)}
    found = dependence_functions(
        replace(item, **{name: np.tile(row[:, None], 4) for name, row in moved.items()}), 0
    )
    for order, name in ((2, "2nd harmonic"), (3, "3rd harmonic")):
        wave = np.cos(order * angle + 0.3)
        left = wave - found[name] @ np.linalg.lstsq(found[name], wave, rcond=None)[0]
        assert np.linalg.norm(left) < 0.02 * np.linalg.norm(wave)


# -------------------------------- the hand-over record, and the split of a motion into its modes


def test_moments_of_a_sum_of_squares_are_those_of_the_projection():
    generator = np.random.default_rng(5)
    S = np.linalg.qr(generator.standard_normal((12, 3)))[0] * np.array([1.0, 0.9, 0.4])
    A = np.eye(12) - S @ S.T
    expected = 1.0 - np.sum(S**2, axis=1)
    mean, freedom = sum_of_squares_moments([(expected[:5], S[:5]), (expected[5:], S[5:])])
    assert mean == pytest.approx(np.trace(A))
    assert freedom == pytest.approx(np.trace(A) ** 2 / np.trace(A @ A))
    assert sum_of_squares_moments([(expected, None)]) == pytest.approx((np.trace(A), np.trace(A)))


@pytest.mark.parametrize("held_out", [False, True])
def test_restored_residuals_are_white_with_unit_variance(held_out):
    bench = Bench(count=40, noise_freedom=np.inf, held_out=(False, held_out))
    generator = np.random.default_rng(11)
    draws = np.array([
        np.concatenate([part.ravel() for part in bench.fit(generator).whitened_residuals(generator)])
        for _ in range(500)
    ])  # fmt: skip
    covariance = draws.T @ draws / len(draws)
    plain = np.abs(covariance - np.eye(len(covariance)))
    # Standard deviations of the entries are sqrt(2 / 500) on and sqrt(1 / 500) off the diagonal.
    assert np.max(np.diag(plain)) < 5.0 * np.sqrt(2.0 / 500)
    assert np.max(plain - np.diag(np.diag(plain))) < 6.0 * np.sqrt(1.0 / 500)


def test_what_no_fit_leaves_is_refused():
    good = Bench(count=40).fit(np.random.default_rng(1))
    item = good.trials[0]
    for change in (
        {"residual": np.full_like(item.residual, np.nan)},
        {"noise_deviation": np.zeros(4)},
        {"predictive_deviation": -item.predictive_deviation},
        {"leverage": np.full_like(item.leverage, 1.5)},
    ):
        with pytest.raises(
            FitError, match="not finite, deviations that are not positive, or a leverage above"
        ):
            replace(item, **change)
    for channels, trials in ((good.channels, ()), ({}, good.trials)):
        with pytest.raises(FitError, match="at least one trial, and the channels"):
            ResidualSet(channels, trials)


# ---------------------------------------------------------------- splitting a motion into its modes


def test_two_damped_modes_are_split_up_to_the_ends():
    time = 0.005 * np.arange(800)
    waves = []
    for f, zeta, size in ((5.3, 0.02, 1.0), (28.0, 0.01, 0.4)):
        w = 2.0 * np.pi * f
        waves.append(size * np.exp((-zeta + 1j) * w * time))
    values = (waves[0] + waves[1]).real[:, np.newaxis] + 0.3
    found = modal_motion(values, 0.005, (5.2, 28.3))[:, :, 0]
    for part, wave in zip(found, waves, strict=True):
        error = np.abs(part - wave) / np.abs(wave[0])
        # The mirror image of a decay has a kink in its phase.
        assert error.max() < 0.08
        assert error[80:-80].max() < 0.03


# ---------------------------------------------------------------- backbones of known laws


TIME = 0.005 * np.arange(2000)
OMEGA = 2.0 * np.pi * 5.0


def _viscous(zeta=0.01, f=5.0, size=1.0):
    w = 2.0 * np.pi * f
    return size * np.exp(-zeta * w * TIME) * np.cos(w * np.sqrt(1.0 - zeta**2) * TIME + 0.4)


def test_two_modes_are_separated():
    drift = 0.2 - 0.01 * TIME
    first, second = backbones(TIME, _viscous() + _viscous(0.006, 7.3, 0.5) + drift, (4.9, 7.5))
    np.testing.assert_allclose(first.frequency, 5.0, rtol=1e-5)
    np.testing.assert_allclose(first.damping_ratio, 0.01, rtol=1e-3)
    np.testing.assert_allclose(first.amplitude, np.exp(-0.01 * OMEGA * first.time), rtol=1e-3)
    np.testing.assert_allclose(second.frequency, 7.3, rtol=1e-5)
    np.testing.assert_allclose(second.damping_ratio, 0.006, rtol=1e-3)


@pytest.fixture(scope="module", params=[None, 0.01], ids=["unknown noise", "known noise"])
def mode_that_dies_away(request):
    """The backbones of a mode that goes on, and of one that dies away in noise."""
    noise = np.random.default_rng(3).standard_normal(TIME.size)
    signal = _viscous() + _viscous(0.03, 30.0) + 0.01 * noise
    return backbones(TIME, signal, (5.0, 30.0), noise_deviation=request.param)


def test_a_mode_that_dies_away_is_dropped_and_the_other_goes_on(mode_that_dies_away):
    first, second = mode_that_dies_away
    assert second.time[-1] < 3.0 < 8.0 < first.time[-1]
    assert np.all(second.amplitude > 4.0 * second.amplitude_error)
    np.testing.assert_allclose(second.frequency[:2], 30.0, rtol=2e-3)


def test_noise_alone_has_no_backbone():
    noise = np.random.default_rng(3).standard_normal(TIME.size)
    (curve,) = backbones(TIME[:600], noise[:600], (5.0,), noise_deviation=1.0)
    assert curve.time.size == 0


@pytest.mark.parametrize(("periods", "sentence"), [(0.1, "at least 12"), (500.0, "the record's length")])
def test_a_window_that_is_too_short_or_too_long_is_refused(periods, sentence):
    with pytest.raises(FitError, match=sentence):
        backbones(TIME, _viscous(), (5.0,), periods=periods)


@pytest.mark.parametrize(("mode", "frequency", "ratio"), [(0, 5.0, 0.01), (1, 30.0, 0.03)])
def test_errors_of_a_backbone_are_those_that_are_made(mode_that_dies_away, mode, frequency, ratio):
    curve = mode_that_dies_away[mode]
    amplitude = np.exp(-2.0 * np.pi * frequency * ratio * curve.time)
    truth = {"frequency": frequency, "damping_ratio": ratio, "amplitude": amplitude}
    for name, true_value in truth.items():
        error = (getattr(curve, name) - true_value) / getattr(curve, f"{name}_error")
        assert 0.2 < np.mean(error**2) < 3.0


def test_coulomb_friction_has_a_ratio_that_falls_with_amplitude():
    # Exact motion: half cycles of cosines about +-delta, delta = Fc / k; peaks fall by 2 delta each.
    delta = 0.004
    half = np.floor(TIME * OMEGA / np.pi).astype(int)
    peak = 1.0 - 2.0 * delta * half
    sign = np.where(half % 2 == 0, 1.0, -1.0)
    signal = sign * ((peak - delta) * np.cos(OMEGA * TIME - half * np.pi) + delta)
    keep = int(0.9 / (2.0 * delta) * np.pi / OMEGA / 0.005)
    curve = backbones(TIME[:keep], signal[:keep], (5.1,))[0]
    exact = 2.0 * delta / (np.pi * curve.amplitude)  # zeta_eq = 2 Fc / (pi k A)
    assert curve.damping_ratio[-1] > 3.0 * curve.damping_ratio[0]
    np.testing.assert_allclose(curve.damping_ratio[:-2], exact[:-2], rtol=0.04)
    np.testing.assert_allclose(curve.frequency[:-2], 5.0, rtol=1e-3)
