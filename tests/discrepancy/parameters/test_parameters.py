"""The posterior of a model's parameters beside closed forms, dense integration and known truths."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from calibration.errors import CalibrationRecordError
from calibration.result.file import FILE_NAME, load_calibration, result_bytes
from calibration.result.record import ParameterPrior
from calibration.static.errors_in_variables import exact_posterior
from calibration.static.experiments import published_measurements
from calibration.static.stiffness_curve import stiffness_curve_of
from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Quantity
from discrepancy.errors import CampaignDataError, ModelError
from discrepancy.model_choice import ModelChoice, ModelKind, choose_model
from discrepancy.models.interface import Model, Response
from discrepancy.models.scales import Scales
from discrepancy.parameters.calibration import calibrate_parameters
from fe.reduction.model_cache import reduced_model

Float = NDArray[np.float64]

FORCE = np.array([10.0, 20.0, 30.0, 40.0, 50.0, 60.0])
NOISE = 0.02


@dataclass(frozen=True)
class Curve(Model):
    """A model at rest whose only output is any function of force and parameters."""

    law: Callable[[Float, Float], Float]
    parameters: tuple[ParameterPrior, ...]
    name: str = "curve"

    def output_quantity(self, output):
        return Quantity.DISPLACEMENT if output == "y" else None

    def supports(self, primitive):
        return False

    def scales(self, campaign):
        ports = {}
        return Scales(1.0, 1.0, 1.0, 1.0, 60.0, 0.0, 1.0, 1.0, ports)

    def _respond(self, trial, outputs, patch, conditions):
        values = self.law(trial.force, conditions.parameters)
        return Response(np.tile(values[:, np.newaxis], (1, len(outputs))))


def choice_of(law, *priors):
    """Return a curve whose parameters p1, p2, ... have mean, deviation, low, high."""
    parameters = tuple(
        ParameterPrior(f"p{number}", "1", mean, deviation, low, high)
        for number, (mean, deviation, low, high) in enumerate(priors, start=1)
    )
    return ModelChoice(Curve(law, parameters), ModelKind.LUMPED, "curve.toml", "0" * 64)


def campaign_of(folder, values, *, freedom=None, more=""):
    """Return static readings in metres at `FORCE`, one row of values for each trial."""
    folder.mkdir(parents=True, exist_ok=True)
    known = "" if freedom is None else f", degrees_of_freedom = {freedom}"
    text = (
        'format = 1\nname = "bench"\n[[channel]]\nname = "y"\nquantity = "displacement"\nunit = "m"\n'
        f"noise = {{ standard_deviation = {NOISE}{known} }}\n{more}\n"
    )
    for number, row in enumerate(np.atleast_2d(values)):
        rows = zip(FORCE.tolist(), row.tolist(), strict=True)
        (folder / f"t{number}.csv").write_text(
            "force,y\n" + "".join(f"{force!r},{value!r}\n" for force, value in rows)
        )
        text += f'[[trial]]\nname = "t{number}"\nkind = "static"\nfile = "t{number}.csv"\n'
    (folder / "campaign.toml").write_text(text.replace('unit = "m"\n', 'unit = "m"\noutput = "y"\n'))
    return read_campaign(folder)


def line(force, parameters):
    return np.asarray(parameters[0] * force / 10.0 + parameters[1] * (force / 40.0) ** 2)


def spring(force, parameters):
    return np.asarray(force / 10.0 / parameters[0])


PRIORS = ((1.0, 0.2, -3.0, 5.0), (0.5, 0.3, -3.0, 4.0))


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """A calibration whose posterior is Gaussian, and the readings."""
    noise = NOISE * np.random.default_rng(3).standard_normal(len(FORCE))
    values = line(FORCE, np.array([1.1, 0.7])) + noise
    campaign = campaign_of(tmp_path_factory.mktemp("line"), values)
    return calibrate_parameters(campaign, choice_of(line, *PRIORS), samples=20_000, seed=4), values


def test_a_linear_model_has_the_posterior_of_the_closed_form(told):
    found, values = told
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


def test_the_file_holds_all_of_it_and_refuses_damage(told, tmp_path):
    found, _ = told
    content = result_bytes(found)
    assert content == result_bytes(found)
    path = tmp_path / FILE_NAME
    path.write_bytes(content)
    again = load_calibration(path)
    np.testing.assert_array_equal(again.samples, found.samples)
    assert result_bytes(again) == content
    assert again.priors == found.priors
    assert again.channels == found.channels
    damaged = bytearray(content)
    at = content.index(found.samples[:, 0].tobytes()[:8])
    damaged[at] ^= 1
    path.write_bytes(bytes(damaged))
    with pytest.raises(CalibrationRecordError, match=r"damaged .*hash"):
        load_calibration(path)


def test_what_is_drawn_together_stays_together(told):
    found, _ = told
    given = found.given("p1", found.mean("p1") + np.array([-0.01, 0.0, 0.01]))["p2"]
    slope = np.cov(found.samples, rowvar=False)[0, 1] / found.samples[:, 0].var()
    np.testing.assert_allclose(np.diff(given), 0.01 * slope, rtol=1e-3)


def test_one_parameter_is_integrated_as_densely_as_one_likes(tmp_path):
    """Two readings with much noise, a prior that is cut off, noise known from few degrees of freedom."""
    values = spring(FORCE, np.array([0.7])) + 60.0 * NOISE * np.sin(FORCE)
    more = "[parameters.p1]\nmean = 1.0\ndeviation = 0.6"
    campaign = campaign_of(tmp_path, values, freedom=4, more=more)
    found = calibrate_parameters(campaign, choice_of(spring, (1.0, 0.1, 0.72, 3.0)), samples=20_000)
    assert found.procedure == "quadrature"
    grid = np.linspace(0.72, 3.0, 200_001)
    residual = np.zeros_like(grid)
    for force, value in zip(FORCE, values, strict=True):
        residual += ((value - force / 10.0 / grid) / NOISE) ** 2
    log = -0.5 * (4 + len(FORCE)) * np.log1p(residual / 4) - 0.5 * ((grid - 1.0) / 0.6) ** 2
    mass = np.cumsum(np.exp(log - log.max()))
    for share in (0.05, 0.25, 0.5, 0.75, 0.95):
        expected = grid[np.searchsorted(mass, share * mass[-1])]
        assert np.quantile(found.samples, share) == pytest.approx(expected, abs=2e-4)
    assert found.priors[0].stated_by == "the campaign"
    assert any("end of its range" in sentence for sentence in found.findings)
    assert found.explained is False
    assert any("not explained by these parameters" in sentence for sentence in found.findings)


@pytest.mark.long
def test_intervals_cover_what_is_true(tmp_path):
    """Truths from the prior; the zero is free, and the noise known from twelve degrees of freedom."""
    generator = np.random.default_rng(12)
    choice = choice_of(line, *PRIORS)
    template = campaign_of(tmp_path, np.stack([line(FORCE, np.array([1.0, 0.5]))] * 2), freedom=12)
    channels = {"y": replace(template.channels["y"], offset_deviation=np.inf)}
    inside = np.zeros(2)
    total = 20
    for seed in range(total):
        truth = np.array([1.0, 0.5]) + generator.standard_normal(2) * [0.2, 0.3]
        deviation = NOISE * np.sqrt(12 / generator.chisquare(12))
        trials = tuple(
            replace(
                trial,
                values=(line(FORCE, truth) + generator.normal(0.0, 3.0))[:, np.newaxis]
                + deviation * generator.standard_normal((len(FORCE), 1)),
            )
            for trial in template.trials
        )
        campaign = replace(template, channels=channels, trials=trials)
        found = calibrate_parameters(campaign, choice, samples=400, seed=seed)
        ends = [found.interval(name) for name in ("p1", "p2")]
        inside += [low < value < high for (low, high), value in zip(ends, truth, strict=True)]
    assert 0.8 * 2 * total <= inside.sum() <= 0.98 * 2 * total


def test_what_is_not_told_is_said(tmp_path):
    def tied(force, parameters):
        return np.asarray(force / 10.0 * (parameters[0] + parameters[1]) + 0.0 * parameters[2])

    noise = NOISE * np.random.default_rng(5).standard_normal(len(FORCE))
    campaign = campaign_of(tmp_path, 2.0 * FORCE / 10.0 + noise)
    prior = (1.0, 0.1, 0.2, 2.0)
    found = calibrate_parameters(campaign, choice_of(tied, prior, prior, prior), samples=2000)
    assert found.kept_share("p3") == pytest.approx(1.0, abs=0.05)
    assert any("does not tell p3: " in sentence for sentence in found.findings)
    assert not any(
        "does not tell p1" in sentence for sentence in found.findings
    )  # half of its variance is gone
    assert any("p1 and p2 are told together and hardly apart" in sentence for sentence in found.findings)


def test_a_truth_beyond_the_range_ends_at_its_end(tmp_path):
    """The model refuses what lies outside, as an FMU does."""

    def bounded(force, parameters):
        if not 0.9 <= parameters[0] <= 1.1:
            raise ModelError(f"p1 = {float(parameters[0])!r} lies outside the range of the model.")
        return spring(force, parameters)

    noise = NOISE * np.random.default_rng(8).standard_normal(len(FORCE))
    campaign = campaign_of(tmp_path, FORCE / 10.0 / 0.85 + noise)
    found = calibrate_parameters(campaign, choice_of(bounded, (1.0, 0.05, 0.9, 1.1)), samples=500)
    assert found.samples.min() >= 0.9
    assert found.mean("p1") < 0.91
    assert any("p1 reaches the end of its range, 0.9 to 1.1" in sentence for sentence in found.findings)


def test_where_the_model_cannot_be_had_is_said(tmp_path):
    """Within its range a model refuses what the posterior holds: it ends there, and says so."""

    def refusing(force, parameters):
        if parameters[0] > 1.1:
            raise ModelError("a stiffness above 1.1 is not known.")
        return spring(force, parameters)

    words = "(a stiffness above 1.1 is not known): the posterior has nothing there"
    for truth, said in ((1.096, True), (0.9, False)):
        campaign = campaign_of(tmp_path, spring(FORCE, np.array([truth])))
        found = calibrate_parameters(campaign, choice_of(refusing, (1.0, 0.2, 0.5, 1.5)))
        assert np.max(found.draws_of("p1")) < 1.105
        assert (words in " ".join(found.findings)) == said


def test_a_parameter_that_is_not_told_keeps_its_prior_as_it_is_cut_off(tmp_path):
    """Range of two prior deviations, beside a parameter that is told: moments of a dense grid."""

    def weak(force, parameters):
        return np.asarray(force / 10.0 * parameters[0] + 0.02 * (force / 60.0) * parameters[1])

    noise = NOISE * np.random.default_rng(2).standard_normal(len(FORCE))
    values = weak(FORCE, np.array([1.02, 2.6])) + noise
    priors = ((1.0, 0.05, 0.9, 1.1), (2.5, 0.625, 1.25, 3.75))
    campaign = campaign_of(tmp_path, values)
    found = calibrate_parameters(campaign, choice_of(weak, *priors), samples=4000)
    first, second = np.meshgrid(np.linspace(0.9, 1.1, 801), np.linspace(1.25, 3.75, 801), indexing="ij")
    misfit = values - FORCE / 10.0 * first[..., None] - 0.02 * (FORCE / 60.0) * second[..., None]
    log = -0.5 * np.sum((misfit / NOISE) ** 2, axis=-1)
    log += -0.5 * ((first - 1.0) / 0.05) ** 2 - 0.5 * ((second - 2.5) / 0.625) ** 2
    weight = np.exp(log - log.max())
    for name, grid in (("p1", first), ("p2", second)):
        mean = float(np.average(grid, weights=weight))
        deviation = float(np.sqrt(np.average((grid - mean) ** 2, weights=weight)))
        assert found.mean(name) == pytest.approx(mean, abs=0.05 * deviation)
        assert found.standard_deviation(name) == pytest.approx(deviation, rel=0.03)
    assert np.sum((found.samples[:, 1] == 1.25) | (found.samples[:, 1] == 3.75)) == 0
    assert found.kept_share("p2") == pytest.approx(1.0, abs=0.05)
    assert any("does not tell p2: " in sentence for sentence in found.findings)
    assert not any("reaches the end" in sentence for sentence in found.findings)


def test_a_bent_ridge_is_followed(tmp_path):
    def product(force, parameters):
        return np.asarray(force / 10.0 * parameters[0] * parameters[1])

    campaign = campaign_of(tmp_path, FORCE / 10.0)
    prior = (1.0, 0.3, 0.2, 3.0)
    found = calibrate_parameters(campaign, choice_of(product, prior, prior), samples=2000)
    assert found.procedure == "quadrature"
    np.testing.assert_allclose((found.samples[:, 0] * found.samples[:, 1]), 1.0, atol=0.02)
    # along the ridge p2 = 1 / p1 the prior density and the width 1 / hypot(p1, p2) of the ridge count
    grid = np.linspace(0.34, 2.9, 20_001)
    log = -0.5 * ((grid - 1.0) / 0.3) ** 2 - 0.5 * ((1.0 / grid - 1.0) / 0.3) ** 2 - np.log(grid)
    mass = np.cumsum(np.exp(log))
    for share in (0.1, 0.5, 0.9):
        expected = grid[np.searchsorted(mass, share * mass[-1])]
        assert np.quantile(found.samples[:, 0], share) == pytest.approx(expected, abs=0.01)


def test_several_maxima_are_told(tmp_path):
    def even(force, parameters):
        return np.asarray(force / 10.0 * parameters[0] ** 2 + 0.5 * parameters[1])

    noise = NOISE * np.random.default_rng(6).standard_normal(len(FORCE))
    campaign = campaign_of(tmp_path, even(FORCE, np.array([0.8, 0.0])) + noise)
    priors = ((0.05, 1.0, -5.0, 5.0), (0.0, 0.1, -1.0, 1.0))
    found = calibrate_parameters(campaign, choice_of(even, *priors), samples=4000)
    assert found.procedure == "several optima"
    assert any("has 2 maxima" in sentence for sentence in found.findings)
    share = float(np.mean(found.samples[:, 0] > 0.0))  # equal likelihoods: the prior weighs them
    ratio = np.exp(-0.5 * (0.75**2 - 0.85**2))
    assert share == pytest.approx(ratio / (1.0 + ratio), abs=0.03)
    np.testing.assert_allclose(np.abs(found.samples[:, 0]).mean(), 0.8, atol=0.01)


def test_a_parameter_far_from_its_prior_is_said(tmp_path):
    campaign = campaign_of(tmp_path, spring(FORCE, np.array([0.8])))
    found = calibrate_parameters(campaign, choice_of(spring, (1.0, 0.02, 0.5, 1.5)), samples=500)
    assert found.mean("p1") == pytest.approx(0.8, abs=0.01)
    assert any("prior deviations below what curve.toml states" in sentence for sentence in found.findings)


@pytest.mark.parametrize(
    ("more", "priors", "cause", "words"),
    [
        (
            "[parameters.q]\nmean = 1\ndeviation = 0.1",
            (1.0, 0.1, 0.5, 1.5),
            CampaignDataError,
            "does not have",
        ),
        ("", (1.0, 0.0, 0.5, 1.5), ModelError, r"curve.toml has no parameter to calibrate"),
    ],
)
def test_what_cannot_be_calibrated_is_one_sentence(tmp_path, more, priors, cause, words):
    campaign = campaign_of(tmp_path, spring(FORCE, np.array([1.0])), more=more)
    with pytest.raises(cause, match=words):
        calibrate_parameters(campaign, choice_of(spring, priors))


def test_a_mean_outside_the_range_is_said_before_the_model_is_asked(tmp_path):
    def law(force, parameters):
        if parameters[0] > 1.5:
            raise ModelError("The FMU refuses it.")
        return spring(force, parameters)

    more = "[parameters.p1]\nmean = 2.0\ndeviation = 0.1"
    campaign = campaign_of(tmp_path, spring(FORCE, np.array([1.0])), more=more)
    with pytest.raises(CampaignDataError, match=r"range 0.5 to 1.5 .* correct \[parameters.p1\]"):
        calibrate_parameters(campaign, choice_of(law, (1.0, 0.1, 0.5, 1.5)))


def test_held_out_trials_take_no_part(tmp_path):
    values = spring(FORCE, np.array([1.1]))
    whole = campaign_of(tmp_path, np.stack([values, 1.2 * values]))
    marked = replace(whole, trials=(whole.trials[0], replace(whole.trials[1], held_out=True)))
    found = calibrate_parameters(marked, choice_of(spring, (1.0, 0.1, 0.5, 1.5)), samples=500)
    assert found.mean("p1") == pytest.approx(1.1, abs=0.005)
    assert [(item.trials, item.after > 10.0) for item in found.channels] == [
        ("fitted", False),
        ("held out", True),
    ]


@pytest.mark.slow
@pytest.mark.xdist_group("wing")
def test_the_published_load_test_gives_the_posterior_of_the_wings_own_calibration(tmp_path):
    """Errors of load and displacement as one: with f = k(e) x, their variances add as S(e) / k^2.

    That S grows with e is left out, which is worth 0.03 deviations.
    """
    pairs, model = published_measurements(), reduced_model()
    exact = exact_posterior(
        pairs, curve=stiffness_curve_of(model.tip_stiffness, model.validity["young_modulus_factor"])
    )
    stiffness = float(model.tip_stiffness(exact.mean))
    noise = np.hypot(pairs.displacement_standard_deviation, pairs.load_standard_deviation / stiffness)
    rows = zip(pairs.load.tolist(), pairs.displacement.tolist(), strict=True)
    (tmp_path / "pairs.csv").write_text("force,tip\n" + "".join(f"{f!r},{x!r}\n" for f, x in rows))
    (tmp_path / "campaign.toml").write_text(
        'format = 1\nname = "published"\n[parameters.young_modulus_factor]\nmean = 1.0\n'
        f"deviation = {0.05 / 1.96!r}\n"
        '[[channel]]\nname = "tip"\nquantity = "displacement"\nunit = "m"\n'
        f'output = "load_point_displacement"\nnoise = {{ standard_deviation = {float(noise)!r} }}\n'
        '[[trial]]\nname = "pairs"\nkind = "static"\nfile = "pairs.csv"\n'
    )
    found = calibrate_parameters(read_campaign(tmp_path), choose_model(None), samples=20_000)
    assert found.mean("young_modulus_factor") == pytest.approx(exact.mean, abs=6e-4)
    deviation = found.standard_deviation("young_modulus_factor")
    assert deviation == pytest.approx(exact.standard_deviation, rel=0.03)
    assert found.kept_share("servo_mass") > 0.95
