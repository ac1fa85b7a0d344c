"""Fitted gains and zeros stand beside each channel; where they hide an error, the verdict says so."""

from dataclasses import replace
from math import hypot, inf, isnan, nan

import numpy as np
import pytest

from calibration.result.sensors import MOST_PRINTED_SENSORS
from discrepancy.catalogue.library import library
from discrepancy.files.verdict import read_verdict_file, write_verdict
from discrepancy.fits.normal_equations import normal_equations
from discrepancy.judgement.moved_unknowns import (
    hiding_sentences,
    moved_sentence,
    unknowns_moved_within_prior,
)
from discrepancy.judgement.sensor_estimates import sensor_estimates
from discrepancy.report.figures import ReportInput
from discrepancy.report.page import verdict_page
from discrepancy.report.printed import verdict_lines
from discrepancy.report.sensor_table import printed_sensor_table
from discrepancy.verdict import MovedUnknown, SensorEstimate, SensorValue, VerdictKind
from discrepancy.workflow import investigate
from reporting.pages.page import render_page
from reporting.pages.table import Table
from tests.discrepancy.core import kit
from tests.discrepancy.rigs import ORIGIN, chosen, simulated

GAIN = 0.03
"""Relative error of the gain that is hidden in the channel g2."""


def with_stated_gains(campaign, deviation, *names):
    """Return a campaign of which these channels, or all, state their gains to a standard deviation."""
    channels = dict(campaign.channels)
    for name in names or channels:
        channels[name] = replace(channels[name], gain_deviation=deviation)
    return replace(campaign, channels=channels)


@pytest.fixture(scope="module")
def wide_gain(beam_model):
    """The beam under static loads, whose gauge g2 reads 3 % too much and is stated to 5 %."""
    campaign = simulated(beam_model, "static", 3)
    trials = [
        replace(trial, values=trial.values * (1.0 + GAIN * (np.array(trial.channels) == "g2")))
        for trial in campaign.trials
    ]
    campaign = with_stated_gains(replace(campaign, trials=tuple(trials)), 0.05, "g2")
    return investigate(campaign, beam_model, chosen("load_cell", "region_stiffness_loss"), seed=3)


@pytest.fixture(scope="module")
def fitted_sensors():
    """A fit with uncertain gains and zeros, of the closed form."""
    problem = kit.closed_problem(seed=1, gain_deviation=0.02)
    return problem, kit.fitted(problem)


def deviations_from_normal_equations(problem, fitted):
    """Return the standard deviations of gains and zeros, by channel and trial, inverted at once."""
    equations = normal_equations(problem, fitted, fitted.candidate, np.ones(len(problem.channel_names)))
    deviations = np.sqrt(np.diag(np.linalg.inv(equations.matrix)))
    by_name = {}
    for index, channel in enumerate(problem.shared.gain_channels, start=problem.shared.parameter_count):
        by_name[channel, ""] = problem.shared.scale[index] * deviations[index]
    first = problem.shared.unknown_count
    for data in problem.trials:
        for index, column in enumerate(data.unknowns.zero_columns):
            name = data.trial.channels[column], data.trial.name
            by_name[name] = data.unknowns.scale[index] * deviations[first + index]
        first += data.unknowns.unknown_count
    return by_name


def test_the_deviations_are_those_of_all_unknowns_together(fitted_sensors):
    """Inverted at once, the normal equations give the same deviations as with the trials eliminated."""
    exact = deviations_from_normal_equations(*fitted_sensors)
    estimates = {(item.channel, item.trial): item for item in sensor_estimates(*fitted_sensors)}
    assert estimates.keys() == exact.keys()
    for name, estimate in estimates.items():
        assert estimate.deviation == pytest.approx(exact[name], rel=1e-6)


def test_an_estimate_tells_its_distance_from_the_stated_value_in_deviations(fitted_sensors):
    for estimate in sensor_estimates(*fitted_sensors):
        assert estimate.deviations == pytest.approx(estimate.value / estimate.stated_deviation)


def test_a_gain_is_of_all_trials_and_a_zero_of_one(fitted_sensors):
    for estimate in sensor_estimates(*fitted_sensors):
        assert (estimate.kind is SensorValue.GAIN) == (estimate.trial == "")


def test_a_zero_that_was_not_stated_has_no_distance():
    problem = kit.closed_problem(seed=1, offset_deviation=inf)
    estimates = sensor_estimates(problem, kit.fitted(problem))
    assert estimates
    assert all(isnan(item.deviations) and item.stated_deviation == inf for item in estimates)
    (row, *_) = printed_sensor_table(estimates, problem.campaign.channels).rows
    assert row[4:] == ["not stated", ""]


def gains_of(verdict):
    """Return the estimates of gains, by channel."""
    return {item.channel: item for item in verdict.sensors if item.kind is SensorValue.GAIN}


def printed_gain(content, channel):
    """Return the row of a gain in the printed table."""
    *_, table = [item for item in verdict_lines(content) if isinstance(item, Table) and item.rows]
    (row,) = [row for row in table.rows if list(row[:2]) == [channel, "gain error"]]
    return row


def test_a_gain_error_is_estimated(wide_gain):
    gains = gains_of(wide_gain.verdict)
    estimate = gains["g2"]
    own_deviation = 0.005  # of the simulated gauge, before the gain is hidden
    assert gains.keys() == set(wide_gain.campaign.channels)
    assert abs(estimate.value - GAIN) < 3.0 * hypot(estimate.deviation, own_deviation)
    assert estimate.deviation < 0.005


def test_a_fitted_gain_is_printed(wide_gain):
    estimate = gains_of(wide_gain.verdict)["g2"]
    _, _, fitted, unit, stated, deviations = printed_gain(ReportInput(wide_gain, ORIGIN), "g2")
    assert [unit, stated] == ["%", "0 ± 5"]
    assert float(fitted.split(" ± ")[0]) == pytest.approx(100.0 * estimate.value, abs=0.1)
    assert float(deviations) == pytest.approx(estimate.deviations, abs=0.06)


def test_fitted_gains_are_in_the_file(wide_gain, tmp_path):
    path = write_verdict(tmp_path / "verdict.json", wide_gain.verdict, None, ORIGIN)
    assert read_verdict_file(path).verdict.sensors == wide_gain.verdict.sensors


def test_a_fitted_gain_is_on_the_page(wide_gain):
    content = ReportInput(wide_gain, ORIGIN)
    page = render_page(verdict_page(content, {}))
    assert "Gains and zeros of the channels" in page
    assert printed_gain(content, "g2")[2] in page


def test_a_gain_that_was_not_stated_is_shown_itself():
    problem = kit.closed_problem(seed=1, gain_deviation=0.02)
    (stated, *_) = sensor_estimates(problem, kit.fitted(problem))
    free = replace(stated, value=0.25, deviation=0.01, stated_deviation=inf, deviations=nan)
    (row,) = printed_sensor_table([free], problem.campaign.channels).rows
    assert row[1:] == ["gain", "1.250 ± 0.010", "", "not stated", ""]


def test_of_many_channels_the_farthest_are_printed():
    problem = kit.closed_problem(seed=1, gain_deviation=0.02)
    (some, *_) = sensor_estimates(problem, kit.fitted(problem))
    channel = problem.campaign.channels[some.channel]
    names = [f"g{number}" for number in range(30)]
    many = [
        replace(some, channel=name, value=0.1 * number * some.stated_deviation)
        for number, name in enumerate(names)
    ]
    printed = printed_sensor_table(many, dict.fromkeys(names, channel))
    assert [row[0] for row in printed.rows] == names[-MOST_PRINTED_SENSORS:]


@pytest.fixture(scope="module")
def hidden_in_gains(beam_model):
    """The verdict on a stiffness loss of 20 % that hides in gains that are stated to 12 %."""
    loss = ("region_stiffness_loss", {"loss": 0.2}, "z2")
    campaign = with_stated_gains(simulated(beam_model, "static", 3, loss), 0.12)
    return investigate(campaign, beam_model, library(), seed=3, thorough=False).verdict


def test_gains_that_moved_within_their_priors_are_told(hidden_in_gains):
    moved = {unknown.name: unknown for unknown in hidden_in_gains.moved_within_prior}
    assert hidden_in_gains.kind is VerdictKind.NOTHING_MISSING, hidden_in_gains.sentence
    assert "gain of g3" in moved
    assert all(1.0 <= abs(unknown.deviations) <= 2.0 for unknown in moved.values())


def test_nothing_missing_says_which_gain_an_error_may_hide_in(hidden_in_gains):
    moved = {unknown.name: unknown for unknown in hidden_in_gains.moved_within_prior}
    percent = 100.0 * moved["gain of g3"].value
    assert f"the gain of g3 to {percent:.3g} % too much (stated to 12 %;" in hidden_in_gains.text
    assert "an error of the model of this size would not show" in hidden_in_gains.text


@pytest.fixture(scope="module")
def gain_far_from_stated(beam_model):
    """The verdict on a campaign without an effect, one of whose drawn gains is far from what is stated."""
    campaign = simulated(beam_model, "static", 3)
    return investigate(campaign, beam_model, chosen("load_cell"), seed=3, thorough=False).verdict


def test_a_gain_far_from_what_is_stated_is_no_effect(gain_far_from_stated):
    assert gain_far_from_stated.kind is VerdictKind.NOTHING_MISSING, gain_far_from_stated.sentence
    assert abs(gain_far_from_stated.moved[0].deviations) > 2.0


def test_nothing_missing_says_which_gain_is_far_from_what_is_stated(gain_far_from_stated):
    farthest = gain_far_from_stated.moved[0]
    assert f"{abs(farthest.deviations):.1f} deviations)" in gain_far_from_stated.text
    assert "an error of the model may hide there" in gain_far_from_stated.text
    assert farthest.name.removeprefix("gain of ") in gain_far_from_stated.reasons


@pytest.mark.parametrize(("value", "side"), [(0.04, "much"), (-0.04, "little")])
def test_a_gain_far_from_what_is_stated_is_told_with_its_deviation(value, side):
    moved = MovedUnknown("gain of y", 0.0, 0.01, value, 100.0 * value, "1")
    gain = SensorEstimate("y", SensorValue.GAIN, "", value, 0.0004, 0.01, 100.0 * value, "1")

    sentence = hiding_sentences([moved], [], [gain])

    assert f"y shows 4.000 ± 0.040 % too {side} (stated to 1 %; 4.0 deviations)" in sentence


def test_a_moved_zero_has_the_unit_of_the_report():
    moved = MovedUnknown("zero of g2 in 'unloading'", 0.0, 8e-7, -1.8e-6, -2.25, "1")
    told = "the zero of g2 in 'unloading' to −1.8 µε (stated to 0.8 µε; 2.2 deviations)"
    assert told in moved_sentence([moved])


def test_a_prior_that_is_narrow_hides_nothing():
    """Gains within a fifth of a per cent move by up to two deviations, which is no error of a model."""
    problem = kit.closed_problem(seed=1, gain_deviation=0.002)
    fitted = kit.fitted(problem)
    far = replace(fitted.point, shared=np.full_like(fitted.point.shared, 1.5))
    names = {item.name for item in unknowns_moved_within_prior(problem, replace(fitted, point=far))}
    assert not any(name.startswith("gain of ") for name in names)
