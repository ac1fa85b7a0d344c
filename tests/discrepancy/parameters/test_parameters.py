"""The posterior of a model's parameters beside closed forms and dense integration.

`python -m benchmarks.studies.rig_coverage` asks how often intervals hold the truth.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from calibration.result.file import load_calibration, result_bytes, save_calibration
from calibration.result.record import ParameterPrior
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.errors import CampaignDataError, ModelError
from discrepancy.model_choice import ModelChoice, ModelKind
from discrepancy.parameters.calibration import calibrate_parameters
from discrepancy.system.interface import Model
from discrepancy.system.response import Response
from discrepancy.system.scales import Scales
from tests.discrepancy.core import kit

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


def test_a_linear_model_has_the_posterior_of_the_closed_form(tmp_path):
    values = noisy(line, 1.1, 0.7, seed=3)
    found = calibrate_parameters(campaign_of(values), choice_of(line, *PRIORS), samples=20_000, seed=4)
    design = np.column_stack([FORCE / 10.0, (FORCE / 40.0) ** 2])
    mean, precision = np.array([1.0, 0.5]), np.diag([0.2**-2, 0.3**-2])
    covariance = np.linalg.inv(precision + design.T @ design / NOISE**2)
    expected = covariance @ (precision @ mean + design.T @ values / NOISE**2)
    deviation = np.sqrt(np.diag(covariance))
    assert found.procedure == "Gaussian"
    np.testing.assert_allclose(found.samples.mean(axis=0), expected, atol=0.03 * deviation.min())
    np.testing.assert_allclose(np.cov(found.samples, rowvar=False), covariance, rtol=0.04)
    prior = 0.5 * (np.trace(precision @ covariance) - 2.0 - np.linalg.slogdet(precision @ covariance)[1])
    shift = expected - mean
    assert found.information == pytest.approx(prior + 0.5 * shift @ precision @ shift, rel=0.02)
    assert found.explained is True
    assert found.channels[0].before > 5.0 > 1.5 > found.channels[0].after
    # what is drawn together stays together
    given = found.given("p1", found.mean("p1") + np.array([-0.01, 0.0, 0.01]))["p2"]
    slope = np.cov(found.samples, rowvar=False)[0, 1] / found.samples[:, 0].var()
    np.testing.assert_allclose(np.diff(given), 0.01 * slope, rtol=1e-3)
    # the file holds all of it
    again = load_calibration(save_calibration(found, tmp_path / "c.nc"))
    np.testing.assert_array_equal(again.samples, found.samples)
    assert (again.priors, again.channels) == (found.priors, found.channels)
    assert result_bytes(again) == result_bytes(found)


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


@pytest.mark.parametrize(
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
def test_ranges_cut_off_the_posterior(procedure, law, truth, priors):
    values = noisy(law, *truth, seed=3)
    found = calibrate_parameters(campaign_of(values), choice_of(law, *priors), samples=20_000)
    assert found.procedure == procedure
    assert not any("settled" in sentence for sentence in found.findings)
    for place, (middle, spread) in enumerate(on_grid(law, values, priors), start=1):
        assert found.mean(f"p{place}") == pytest.approx(middle, abs=0.03 * spread)
        assert found.standard_deviation(f"p{place}") == pytest.approx(spread, rel=0.03)


def test_one_parameter_is_integrated_as_densely_as_one_likes():
    """Two readings with much noise, a prior that is cut off, noise known from few degrees of freedom."""
    values = spring(FORCE, [0.7]) + 60.0 * NOISE * np.sin(FORCE)
    campaign = campaign_of(values, freedom=4, p1=(1.0, 0.6))
    found = calibrate_parameters(campaign, choice_of(spring, (1.0, 0.1, 0.72, 3.0)), samples=20_000)
    assert found.procedure == "quadrature"
    grid = np.linspace(0.72, 3.0, 200_001)
    residual = sum(((v - f / 10.0 / grid) / NOISE) ** 2 for f, v in zip(FORCE, values, strict=True))
    log = -0.5 * (4 + len(FORCE)) * np.log1p(residual / 4) - 0.5 * ((grid - 1.0) / 0.6) ** 2
    mass = np.cumsum(np.exp(log - log.max()))
    for share in (0.05, 0.25, 0.5, 0.75, 0.95):
        expected = grid[np.searchsorted(mass, share * mass[-1])]
        assert np.quantile(found.samples, share) == pytest.approx(expected, abs=2e-4)
    assert found.priors[0].stated_by == "the campaign"
    assert found.explained is False
    said = " ".join(found.findings)
    assert "end of its range" in said
    assert "not explained by these parameters" in said


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


def test_what_is_not_told_is_said():
    def tied(force, p):
        return force / 10.0 * (p[0] + p[1]) + 0.0 * p[2]

    prior = (1.0, 0.1, 0.2, 2.0)
    campaign = campaign_of(noisy(tied, 1.0, 1.0, 1.0, seed=5))
    found = calibrate_parameters(campaign, choice_of(tied, prior, prior, prior), samples=2000)
    assert found.kept_share("p3") == pytest.approx(1.0, abs=0.05)
    said = " ".join(found.findings)
    assert "does not tell p3: " in said
    assert "does not determine p1" not in said  # half of its variance is gone
    assert "p1 and p2 are determined in combination" in said
    # one that is not told keeps its prior as it is cut off
    found = calibrate_parameters(campaign_of(noisy(weak, 1.02, 2.6, seed=2)), choice_of(weak, *WEAK))
    assert np.sum((found.samples[:, 1] == 1.25) | (found.samples[:, 1] == 3.75)) == 0
    assert found.kept_share("p2") == pytest.approx(1.0, abs=0.05)
    said = " ".join(found.findings)
    assert "does not tell p2: " in said
    assert "reaches the end" not in said


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


def test_several_maxima_are_told():
    def even(force, p):
        return force / 10.0 * p[0] ** 2 + 0.5 * p[1]

    priors = ((0.05, 1.0, -5.0, 5.0), (0.0, 0.1, -1.0, 1.0))
    campaign = campaign_of(noisy(even, 0.8, 0.0, seed=6))
    found = calibrate_parameters(campaign, choice_of(even, *priors), samples=4000)
    assert found.procedure == "several optima"
    assert any("has 2 maxima" in sentence for sentence in found.findings)
    ratio = np.exp(-0.5 * (0.75**2 - 0.85**2))  # equal likelihoods: the prior weighs them
    assert np.mean(found.samples[:, 0] > 0.0) == pytest.approx(ratio / (1.0 + ratio), abs=0.03)
    np.testing.assert_allclose(np.abs(found.samples[:, 0]).mean(), 0.8, atol=0.01)
    few = calibrate_parameters(campaign, choice_of(even, (0.3, 0.7, -5.0, 5.0), priors[1]), samples=4)
    assert few.procedure == "several optima"  # of which the lesser has no draw
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
