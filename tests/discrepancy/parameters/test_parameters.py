"""The posterior of a model's parameters beside closed forms and dense integration.

`python -m benchmarks.studies.rig_coverage` asks how often intervals hold the truth.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from calibration.result.file import load_calibration, result_bytes, save_calibration
from calibration.result.record import ParameterPrior
from calibration.result.text import printed_calibration
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.errors import CampaignDataError, ModelError
from discrepancy.files.verdict import StoredPatch
from discrepancy.model_choice import ModelChoice, ModelKind
from discrepancy.parameters.calibration import calibrate_parameters
from discrepancy.system.interface import Model
from discrepancy.system.response import Response
from discrepancy.system.scales import Scales
from discrepancy.verdict import VerdictKind
from reporting.pages.table import Table
from tests.discrepancy.core import kit
from tests.discrepancy.rigs import ORIGIN

FORCE = np.array([10.0, 20.0, 30.0, 40.0, 50.0, 60.0])
NOISE = 0.02


@dataclass(frozen=True)
class Curve(Model):
    """A model at rest whose only output is any function of force and parameters."""

    law: Callable[[np.ndarray, np.ndarray], np.ndarray]
    parameters: tuple[ParameterPrior, ...]
    name: str = "curve"

    def output_quantity(self, output):
        return Quantity.DISPLACEMENT if output == "y" else None

    def supports(self, primitive):
        return False

    def scales(self, campaign):
        return Scales(1.0, 1.0, 1.0, 1.0, 60.0, 0.0, 1.0, 1.0, {})

    def _respond(self, trial, outputs, patch, conditions):
        values = self.law(trial.force, conditions.parameters)
        return Response(np.tile(values[:, np.newaxis], (1, len(outputs))))


def choice_of(law, *priors):
    """Return a curve whose parameters p1, p2, ... have mean, deviation, low, high."""
    parameters = tuple(ParameterPrior(f"p{k}", "1", *prior) for k, prior in enumerate(priors, start=1))
    return ModelChoice(Curve(law, parameters), ModelKind.LUMPED, "curve.toml", "0" * 64)


def campaign_of(*rows, force=FORCE, noise=NOISE, freedom=np.inf, output="y", **parameters):
    """Return static readings in metres under forces, one row of values for each trial."""
    channel = Channel("y", Quantity.DISPLACEMENT, output, NoiseRecord(noise, freedom))
    usual = TrialKind.STATIC, ("y",), np.arange(len(force))
    trials = tuple(
        Trial.plain(f"t{k}", *usual, force=force, values=row[:, None]) for k, row in enumerate(rows)
    )
    return Campaign("bench", {"y": channel}, trials, None, parameters, "0" * 64)


def noisy(law, *truth, seed):
    return law(FORCE, np.array(truth)) + NOISE * np.random.default_rng(seed).standard_normal(len(FORCE))


def line(force, p):
    return p[0] * force / 10.0 + p[1] * (force / 40.0) ** 2


def spring(force, p):
    return force / 10.0 / p[0]


PRIORS = ((1.0, 0.2, -3.0, 5.0), (0.5, 0.3, -3.0, 4.0))


class LinearPosterior:
    """The posterior of a linear model by its calibration, and in closed form."""

    def __init__(self):
        values = noisy(line, 1.1, 0.7, seed=3)
        choice = choice_of(line, *PRIORS)
        self.calibration = calibrate_parameters(campaign_of(values), choice, samples=20_000, seed=4)
        design = np.column_stack([FORCE / 10.0, (FORCE / 40.0) ** 2])
        self.prior_mean = np.array([1.0, 0.5])
        self.prior_precision = np.diag([0.2**-2, 0.3**-2])
        self.covariance = np.linalg.inv(self.prior_precision + design.T @ design / NOISE**2)
        weighted_readings = self.prior_precision @ self.prior_mean + design.T @ values / NOISE**2
        self.mean = self.covariance @ weighted_readings

    def information(self):
        """Return the divergence of the posterior from the prior."""
        ratio = self.prior_precision @ self.covariance
        shift = self.mean - self.prior_mean
        by_spread = 0.5 * (np.trace(ratio) - 2.0 - np.linalg.slogdet(ratio)[1])
        return by_spread + 0.5 * shift @ self.prior_precision @ shift


@pytest.fixture(scope="module")
def linear_posterior():
    return LinearPosterior()


def test_a_linear_model_has_the_posterior_of_the_closed_form(linear_posterior):
    calibration, covariance = linear_posterior.calibration, linear_posterior.covariance
    tolerance = 0.03 * np.sqrt(np.diag(covariance)).min()
    assert calibration.procedure == "Gaussian"
    np.testing.assert_allclose(calibration.samples.mean(axis=0), linear_posterior.mean, atol=tolerance)
    np.testing.assert_allclose(np.cov(calibration.samples, rowvar=False), covariance, rtol=0.04)


def test_the_information_of_a_calibration_is_the_divergence_from_its_prior(linear_posterior):
    expected = linear_posterior.information()
    assert linear_posterior.calibration.information == pytest.approx(expected, rel=0.02)


def test_a_right_model_is_explained_by_its_parameters(linear_posterior):
    (channel,) = linear_posterior.calibration.channels
    assert linear_posterior.calibration.explained is True
    assert channel.before > 5.0 > 1.5 > channel.after


def test_parameters_that_are_drawn_together_stay_together(linear_posterior):
    calibration = linear_posterior.calibration
    values = calibration.mean("p1") + np.array([-0.01, 0.0, 0.01])
    slope = np.cov(calibration.samples, rowvar=False)[0, 1] / calibration.samples[:, 0].var()
    np.testing.assert_allclose(
        np.diff(calibration.conditional_means("p1", values)["p2"]), 0.01 * slope, rtol=1e-3
    )


def test_the_file_of_a_calibration_holds_all_of_it(linear_posterior, tmp_path):
    calibration = linear_posterior.calibration
    again = load_calibration(save_calibration(calibration, tmp_path / "c.nc"))
    np.testing.assert_array_equal(again.samples, calibration.samples)
    assert (again.priors, again.channels) == (calibration.priors, calibration.channels)
    assert result_bytes(again) == result_bytes(calibration)


def on_grid(law, values, priors):
    """Yield mean and deviation of each parameter on a grid that ends where less than a billionth is left."""
    mean, deviation, *ends = np.array(priors).T
    low, high = np.maximum(ends[0], mean - 6.0 * deviation), np.minimum(ends[1], mean + 6.0 * deviation)
    size = 1_000_000 ** (1.0 / len(priors))
    for _ in range(3):
        share = (np.arange(int(size)) + 0.5) / int(size)
        axes = [a + share * (b - a) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"))
        log = -0.5 * sum(((v - law(f, grid)) / NOISE) ** 2 for f, v in zip(FORCE, values, strict=True))
        log -= 0.5 * sum(((u - m) / d) ** 2 for u, m, d in zip(grid, mean, deviation, strict=True))
        mass = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
        for at, axis in enumerate(axes):
            left = axis[mass.sum(axis=tuple(np.delete(np.arange(len(axes)), at))) > 1e-9]
            step = 0.5 * (axis[1] - axis[0])
            low[at], high[at] = left[0] - step, left[-1] + step
    for axis in grid:
        middle = float(np.sum(mass * axis))
        yield middle, float(np.sqrt(np.sum(mass * (axis - middle) ** 2)))


WEAK = ((1.0, 0.05, 0.9, 1.1), (2.5, 0.625, 1.25, 3.75))
"""Ranges of two prior deviations, of a parameter that is told and of one that is not."""


def weak(force, p):
    return force / 10.0 * p[0] + 0.02 * (force / 60.0) * p[1]


def valley(force, p):
    return force / 10.0 * p[0] * p[1]


def ridge(force, p):
    return force / 10.0 * p[0] * p[1] + 0.5 * (force / 40.0) ** 2 * p[2]


CUT_OFF = pytest.mark.parametrize(
    ("procedure", "law", "truth", "priors"),
    [
        ("Gaussian", line, (1.1, 0.7), ((1.0, 0.2, -3.0, 1.098), PRIORS[1])),
        # both are cut off, the readings being up to ten deviations beyond either end
        ("Gaussian", line, (1.1, 0.7), ((1.0, 0.2, -3.0, 1.06), (0.5, 0.3, -3.0, 0.6))),
        ("Gaussian", line, (1.1, 0.7), ((1.2, 0.2, 1.12, 2.0), (0.9, 0.3, 0.72, 2.0))),
        ("Gaussian", weak, (1.02, 2.6), WEAK),
        # a narrow valley at a corner
        ("Gaussian", valley, (0.94, 0.97), ((1.0, 0.05, 0.914, 1.03), (1.0, 0.05, 0.988, 1.09))),
        # a bent one, and one beside a bent valley of two, which ends, too
        ("quadrature", valley, (1.0, 1.0), ((1.0, 0.3, 0.2, 3.0), (1.0, 0.3, 0.2, 3.0))),
        (
            "quadrature",
            ridge,
            (1.0, 1.0, 0.9),
            ((1.0, 0.3, 0.6, 1.2), (1.0, 0.3, 0.9, 2.0), (0.5, 0.3, -3.0, 0.8)),
        ),
    ],
)


@CUT_OFF
def test_ranges_cut_off_the_posterior(procedure, law, truth, priors):
    values = noisy(law, *truth, seed=3)
    calibration = calibrate_parameters(campaign_of(values), choice_of(law, *priors), samples=20_000)
    is_settled = not any("settled" in sentence for sentence in calibration.findings)
    assert (calibration.procedure, is_settled) == (procedure, True)
    for number, (mean, deviation) in enumerate(on_grid(law, values, priors), start=1):
        assert calibration.mean(f"p{number}") == pytest.approx(mean, abs=0.03 * deviation)
        assert calibration.standard_deviation(f"p{number}") == pytest.approx(deviation, rel=0.03)


@pytest.fixture(scope="module")
def noisy_spring():
    """Readings of a spring with much noise, and their calibration.

    The prior is cut off, and the noise is known from few degrees of freedom.
    """
    values = spring(FORCE, [0.7]) + 60.0 * NOISE * np.sin(FORCE)
    campaign = campaign_of(values, freedom=4, p1=(1.0, 0.6))
    choice = choice_of(spring, (1.0, 0.1, 0.72, 3.0))
    return values, calibrate_parameters(campaign, choice, samples=20_000)


def test_one_parameter_is_integrated_as_densely_as_one_likes(noisy_spring):
    values, calibration = noisy_spring
    grid = np.linspace(0.72, 3.0, 200_001)
    squares = sum(((v - f / 10.0 / grid) / NOISE) ** 2 for f, v in zip(FORCE, values, strict=True))
    log_likelihood = -0.5 * (4 + len(FORCE)) * np.log1p(squares / 4)
    log_posterior = log_likelihood - 0.5 * ((grid - 1.0) / 0.6) ** 2
    mass = np.cumsum(np.exp(log_posterior - log_posterior.max()))
    assert calibration.procedure == "quadrature"
    for probability in (0.05, 0.25, 0.5, 0.75, 0.95):
        expected = grid[np.searchsorted(mass, probability * mass[-1])]
        assert np.quantile(calibration.samples, probability) == pytest.approx(expected, abs=2e-4)


def test_a_prior_of_the_campaign_is_stated_by_it(noisy_spring):
    _, calibration = noisy_spring
    assert calibration.priors[0].stated_by == "the campaign"


def test_readings_that_the_parameters_do_not_explain_are_found(noisy_spring):
    _, calibration = noisy_spring
    findings = " ".join(calibration.findings)
    assert calibration.explained is False
    assert "end of its range" in findings
    assert "not explained by these parameters" in findings


@pytest.mark.parametrize("recorded", [True, False])
def test_the_colour_of_the_noise_is_no_gap_where_its_record_has_it(monkeypatch, recorded):
    """A record of 400 samples tells the colour only roughly, and 1500 residuals are not white."""
    monkeypatch.setattr(
        "discrepancy.parameters.calibration.check_and_prepare", lambda campaign, *_, **__: (campaign, ())
    )
    generator = np.random.default_rng(101)

    def coloured(rows):
        return 0.02 * kit.coloured(generator, (1.2, -0.5), len(rows), before=300)

    white = 0.02 * generator.standard_normal(400)
    samples = coloured(white) + white if recorded else white
    problem = kit.closed_problem(seed=0, kinds=("ringdown",), samples=1500, extra=coloured)
    record = NoiseRecord(float(samples.std()), 399.0, samples - samples.mean(), 0.01, "pre-trigger")
    campaign = kit.with_noise(problem, y1=record).campaign
    campaign = replace(campaign, trials=campaign.trials[:1])
    choice = ModelChoice(problem.model, ModelKind.LUMPED, "chain.toml", "0" * 64)
    assert calibrate_parameters(campaign, choice, samples=20).explained is recorded


def gain_campaign(gain_deviation):
    """Return readings of a spring of known stiffness by a sensor that shows 3 % too much."""
    values = 1.03 * noisy(spring, 1.0, seed=6)
    campaign = campaign_of(values)
    channel = replace(campaign.channels["y"], gain_deviation=gain_deviation, offset_deviation=0.1)
    return replace(campaign, channels={"y": channel})


@pytest.fixture(scope="module")
def known_spring():
    """The calibration of a spring that is known to 0.1 %, with a gain that is stated to 0.5 %."""
    choice = choice_of(spring, (1.0, 0.001, 0.5, 2.0))
    return calibrate_parameters(gain_campaign(0.005), choice, samples=200)


def test_the_gain_of_a_sensor_has_the_posterior_of_the_closed_form(known_spring):
    (gain, zero) = known_spring.sensors
    reading = gain_campaign(0.005).trials[0].values[:, 0]
    # linear in gain error, zero and stiffness error: y = f (1 + gain - stiffness) + zero
    force = FORCE / 10.0
    design = np.column_stack([force, np.ones(len(force)), -force])
    precision = np.diag([0.005**-2, 0.1**-2, 0.001**-2]) + design.T @ design / NOISE**2
    expected = np.linalg.solve(precision, design.T @ (reading - force) / NOISE**2)
    assert (gain.kind, zero.kind) == ("gain", "zero")
    assert gain.value == pytest.approx(expected[0], rel=0.02)
    assert gain.deviation == pytest.approx(np.sqrt(np.linalg.inv(precision)[0, 0]), rel=0.02)


def test_a_gain_that_is_far_from_what_is_stated_is_named(known_spring):
    (sentence,) = [finding for finding in known_spring.findings if "moves" in finding]
    assert "the gain of y to 1." in sentence
    assert " % too much (stated to 0.5 %;" in sentence


def test_the_file_of_a_calibration_holds_gains_and_zeros(known_spring, tmp_path):
    again = load_calibration(save_calibration(known_spring, tmp_path / "c.nc"))
    assert again.sensors == known_spring.sensors


def test_fitted_gains_and_zeros_are_printed(known_spring):
    (table,) = [
        entry
        for entry in printed_calibration(known_spring)
        if isinstance(entry, Table) and entry.columns[1].name == "fitted"
    ]
    gain, zero = table.rows
    assert [gain[1], gain[3], gain[4]] == ["gain error", "%", "0 ± 0.5"]
    assert [zero[1], zero[3], zero[4]] == ["zero in t0", "mm", "0 ± 100"]


def test_a_patch_found_on_the_same_campaign_is_reported(known_spring):
    choice = choice_of(spring, (1.0, 0.001, 0.5, 2.0))
    campaign = gain_campaign(0.005)
    reasons = []
    for data_hash in (campaign.data_hash, "1" * 64):
        origin = replace(ORIGIN, data_hash=data_hash)
        patch = StoredPatch(VerdictKind.NAMED, "A gain.", (), {}, (), origin)
        result = calibrate_parameters(campaign, replace(choice, built_in=patch), samples=200)
        reasons.append([finding for finding in result.findings if "count twice" in finding])
    same, other = reasons
    assert len(same) == 1
    assert other == []


@pytest.fixture(scope="module")
def tied():
    """A calibration of two parameters of which the sum is told, and of one that does nothing."""

    def tied_law(force, p):
        return force / 10.0 * (p[0] + p[1]) + 0.0 * p[2]

    prior = (1.0, 0.1, 0.2, 2.0)
    campaign = campaign_of(noisy(tied_law, 1.0, 1.0, 1.0, seed=5))
    return calibrate_parameters(campaign, choice_of(tied_law, prior, prior, prior), samples=2000)


def test_a_parameter_that_is_not_told_is_said(tied):
    """Of the first one half of the variance is gone."""
    findings = " ".join(tied.findings)
    assert tied.posterior_over_prior("p3") == pytest.approx(1.0, abs=0.05)
    assert "does not determine p3: " in findings
    assert "does not determine p1" not in findings


def test_parameters_that_are_told_together_are_said(tied):
    assert "p1 and p2 are determined in combination" in " ".join(tied.findings)


@pytest.fixture(scope="module")
def weakly_told():
    """A calibration of a parameter that is told, and of one that is not, with ranges that cut them off."""
    return calibrate_parameters(campaign_of(noisy(weak, 1.02, 2.6, seed=2)), choice_of(weak, *WEAK))


def test_a_parameter_that_is_not_told_keeps_its_prior_as_it_is_cut_off(weakly_told):
    samples = weakly_told.samples[:, 1]
    assert np.sum((samples == 1.25) | (samples == 3.75)) == 0
    assert weakly_told.posterior_over_prior("p2") == pytest.approx(1.0, abs=0.05)


def test_a_parameter_that_is_not_told_does_not_reach_the_end_of_its_range(weakly_told):
    findings = " ".join(weakly_told.findings)
    assert "does not determine p2: " in findings
    assert "reaches the end" not in findings


@pytest.mark.parametrize(
    ("truth", "prior", "refused_beyond", "words", "said"),
    [
        # the model refuses what lies outside, as an FMU does
        (0.85, (1.0, 0.05, 0.9, 1.1), (0.9, 1.1), "p1 reaches the end of its range, 0.9 to 1.1", True),
        # within its range it refuses what the posterior holds: it ends there, and says so
        (1.096, (1.0, 0.2, 0.5, 1.5), (0.0, 1.1), "(it is not known): the posterior leaves", True),
        (0.9, (1.0, 0.2, 0.5, 1.5), (0.0, 1.1), "(it is not known): the posterior leaves", False),
        (0.8, (1.0, 0.02, 0.5, 1.5), (0.0, 9.0), "prior deviations below what curve.toml states", True),
    ],
)  # fmt: skip
def test_where_a_truth_lies_beyond(truth, prior, refused_beyond, words, said):
    low, high = refused_beyond

    def bounded(force, p):
        if not low <= p[0] <= high:
            raise ModelError("it is not known.")
        return spring(force, p)

    found = calibrate_parameters(campaign_of(spring(FORCE, [truth])), choice_of(bounded, prior))
    assert low <= found.samples.min() <= found.samples.max() < high + 0.005
    assert found.mean("p1") == pytest.approx(max(truth, prior[2]), abs=0.01)
    assert (words in " ".join(found.findings)) is said


def even(force, p):
    """Return a law in which the sign of the first parameter cannot be told."""
    return force / 10.0 * p[0] ** 2 + 0.5 * p[1]


EVEN_READINGS = noisy(even, 0.8, 0.0, seed=6)
SMALL_OFFSET = (0.0, 0.1, -1.0, 1.0)


@pytest.fixture(scope="module")
def two_maxima():
    choice = choice_of(even, (0.05, 1.0, -5.0, 5.0), SMALL_OFFSET)
    return calibrate_parameters(campaign_of(EVEN_READINGS), choice, samples=4000)


def test_several_maxima_are_told(two_maxima):
    assert two_maxima.procedure == "several optima"
    assert any("has 2 maxima" in sentence for sentence in two_maxima.findings)


def test_the_prior_weighs_maxima_of_equal_likelihood(two_maxima):
    first = two_maxima.samples[:, 0]
    ratio = np.exp(-0.5 * (0.75**2 - 0.85**2))
    assert np.mean(first > 0.0) == pytest.approx(ratio / (1.0 + ratio), abs=0.03)
    np.testing.assert_allclose(np.abs(first).mean(), 0.8, atol=0.01)


def test_samples_at_the_end_of_the_range_are_told_where_the_best_maximum_is_within():
    """Both signs explain the readings, and the range ends at the middle of the lesser maximum."""
    choice = choice_of(even, (0.05, 1.0, -0.8, 5.0), SMALL_OFFSET)
    cut_off = calibrate_parameters(campaign_of(EVEN_READINGS), choice, samples=4000)
    assert np.mean(cut_off.samples[:, 0] < -0.79) > 0.1
    assert any("p1 reaches the end of its range, -0.8 to 5" in text for text in cut_off.findings)


def test_two_maxima_within_the_range_do_not_reach_its_end(two_maxima):
    assert not any("reaches the end" in sentence for sentence in two_maxima.findings)


@pytest.mark.parametrize(
    ("margin", "is_told"), [(-30.0, True), (-3.0, True), (0.0, True), (1.5, True), (3.0, False)]
)
def test_a_posterior_is_told_to_reach_the_end_by_its_distance_in_deviations(margin, is_told):
    deviation = NOISE / np.sqrt(np.sum((FORCE / 10.0) ** 2))
    low = 1.0 - margin * deviation
    choice = choice_of(lambda force, p: p[0] * force / 10.0, (low + 0.2, 1.0, low, 3.0))
    found = calibrate_parameters(campaign_of(FORCE / 10.0), choice)
    assert any("reaches the end" in sentence for sentence in found.findings) is is_told


def test_of_few_samples_the_lesser_maximum_may_have_none():
    choice = choice_of(even, (0.3, 0.7, -5.0, 5.0), SMALL_OFFSET)
    few = calibrate_parameters(campaign_of(EVEN_READINGS), choice, samples=4)
    assert few.procedure == "several optima"
    np.testing.assert_allclose(few.samples[:, 0], 0.8, atol=0.02)


def test_a_mean_outside_the_range_is_said_before_the_model_is_asked():
    def refusing(force, p):
        raise ModelError("The FMU refuses it.")

    campaign = campaign_of(spring(FORCE, [1.0]), p1=(2.0, 0.1))
    with pytest.raises(CampaignDataError, match=r"range 0.5 to 1.5 .* correct \[parameters.p1\]"):
        calibrate_parameters(campaign, choice_of(refusing, (1.0, 0.1, 0.5, 1.5)))


def test_held_out_trials_take_no_part():
    values = spring(FORCE, [1.1])
    whole = campaign_of(values, 1.2 * values)
    marked = replace(whole, trials=(whole.trials[0], replace(whole.trials[1], held_out=True)))
    found = calibrate_parameters(marked, choice_of(spring, (1.0, 0.1, 0.5, 1.5)), samples=500)
    assert found.mean("p1") == pytest.approx(1.1, abs=0.005)
    told = [(item.trials, item.after > 10.0) for item in found.channels]
    assert told == [("fitted", False), ("held out", True)]
