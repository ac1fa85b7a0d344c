"""Evidence, posterior and leverage of a fit against closed forms."""

from __future__ import annotations

from dataclasses import replace
from math import inf, log, pi

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from discrepancy.campaign.records import NoiseRecord
from discrepancy.fits.candidate import Candidate, Term
from discrepancy.fits.fitting import fit
from discrepancy.fits.problem import Problem


def candidate_of(kit, which):  # type: ignore[no-untyped-def]
    terms = {
        "none": (),
        "offset": (Term(kit.offset_effect(), "y1"),),
        "both": (Term(kit.offset_effect(), "y1"), Term(kit.drift_effect(), "y2")),
    }
    return Candidate(terms[which])


@pytest.mark.parametrize(
    ("which", "zeros"), [("none", 0.05), ("offset", 0.05), ("both", 0.05), ("none", inf)]
)
def test_evidence_mean_and_covariance_are_the_gaussian_ones(kit, which: str, zeros: float) -> None:  # type: ignore[no-untyped-def]
    problem = kit.closed_problem(seed=3, effect=0.1, offset_deviation=zeros)
    candidate = candidate_of(kit, which)
    found = fit(problem, candidate, problem.start(candidate))
    linear = kit.Linear(problem, candidate)
    y, a = linear.dense()
    hessian = a.T @ a + np.diag(linear.precision)
    mean, covariance = np.linalg.solve(hessian, a.T @ y), np.linalg.inv(hessian)
    x = np.concatenate((found.point.shared, found.point.effect, *found.point.local))
    shared = problem.shared.size + candidate.size
    assert found.converged
    # a fit ends where a step promises less than CONVERGED, 0.01 nats
    assert float((x - mean) @ hessian @ (x - mean)) < 0.02
    np.testing.assert_allclose(found.covariance, covariance[:shared, :shared], rtol=1e-6, atol=1e-12)
    if zeros == inf:  # free zeros are least squares; their evidence is beside another hypothesis' only
        assert 0.0 in linear.precision
        return
    exact = multivariate_normal(np.zeros(len(y)), np.eye(len(y)) + a @ a.T).logpdf(y)
    assert found.log_evidence - 0.5 * len(y) * log(2.0 * pi) == pytest.approx(exact, abs=0.01)


def test_local_unknowns_are_eliminated_without_loss(kit) -> None:  # type: ignore[no-untyped-def]
    """Leverage of each channel is the trace of the dense hat matrix; its sum is what the unknowns took."""
    problem = kit.closed_problem(seed=5, left_out={2: ((4, 1), (17, 0))}, at_rest=False)
    candidate = candidate_of(kit, "both")
    found = fit(problem, candidate, problem.start(candidate))
    linear = kit.Linear(problem, candidate)
    _, a = linear.dense()
    hessian = a.T @ a + np.diag(linear.precision)
    leverage = np.einsum("ni,ni->n", a, np.linalg.solve(hessian, a.T).T)
    spent = np.bincount(linear.groups, leverage, minlength=3)
    np.testing.assert_allclose(found.spent, spent, rtol=1e-8)
    prior = float(np.trace(np.linalg.solve(hessian, np.diag(linear.precision))))
    assert found.spent.sum() == pytest.approx(linear.size - prior, rel=1e-8)
    assert problem.counts.sum() == len(leverage)


def test_evidence_with_flat_priors_is_the_limit_of_wide_ones(kit) -> None:  # type: ignore[no-untyped-def]
    """A flat zero adds a constant to every hypothesis: differences are those of wide priors."""
    flat = kit.closed_problem(seed=9, offset_deviation=inf)
    wide = replace(
        flat.campaign,
        channels={
            name: replace(channel, offset_deviation=100.0) for name, channel in flat.campaign.channels.items()
        },
    )
    differences = []
    for problem in (flat, Problem(wide, flat.model, flat.setting)):
        scores = []
        for terms in ((), (Term(kit.drift_effect(exponent=3.0, deviation=0.1), "y2"),)):
            candidate = Candidate(terms)
            scores.append(fit(problem, candidate, problem.start(candidate)).log_evidence)
        differences.append(scores[1] - scores[0])
    assert abs(differences[0]) > 0.1
    assert differences[0] == pytest.approx(differences[1], abs=0.02)


@pytest.mark.parametrize("freedom", [10.0, 200.0])
def test_misfit_is_the_noise_variance_integrated_out(kit, freedom: float) -> None:  # type: ignore[no-untyped-def]
    """Quadrature over sigma^2 ~ scaled inverse chi-square (n0, s0^2) of the Gaussian likelihood."""
    problem = kit.closed_problem(noise=NoiseRecord(0.02, freedom))
    count = problem.counts[0]

    def integrated(total: float) -> float:
        peak = (freedom + total) / (freedom + count)

        def log_integrand(v: float) -> float:  # v = ln sigma^2
            prior = -0.5 * freedom * v - 0.5 * freedom * np.exp(-v)
            return float(prior - 0.5 * count * v - 0.5 * total * np.exp(-v))

        top = log_integrand(log(peak))
        area, _ = quad(lambda v: np.exp(log_integrand(v) - top), log(peak) - 4.0, log(peak) + 4.0)
        return float(-(top + log(area)))

    sums = [np.array([s, 0.0, 0.0]) for s in (0.5 * count, count, 3.0 * count)]
    values = [problem.misfit(s) - integrated(float(s[0])) for s in sums]
    np.testing.assert_allclose(values, values[0], atol=1e-6)


@pytest.mark.parametrize("freedom", [8.0, 50.0, 0.0])
def test_evidence_with_unknown_variance_against_quadrature(kit, freedom: float) -> None:  # type: ignore[no-untyped-def]
    """One unknown (an offset), everything else exact: the evidence is an integral over one number."""
    tight = {"slope": (1.0, 1e-9), "curvature": (0.5, 1e-9)}
    problem = kit.closed_problem(
        seed=2, effect=0.05, offset_deviation=0.0, kinds=("static",), parameters=tight,
        known_noise=freedom > 0.0, noise=NoiseRecord(0.02, freedom),
    )  # fmt: skip
    candidate = Candidate((Term(kit.offset_effect(deviation=0.1), "y1"),))
    found = fit(problem, candidate, problem.start(candidate))
    linear = kit.Linear(problem, candidate)
    at = problem.shared.size

    def log_joint(u: float) -> float:
        x = np.zeros(linear.size)
        x[at] = u
        residual = linear.residual(x)
        sums = np.bincount(linear.groups, residual**2, minlength=3)
        return -problem.misfit(sums) - 0.5 * u * u - 0.5 * log(2.0 * pi)

    centre, width = found.point.effect[0], float(np.sqrt(found.effect_covariance[0, 0]))
    top = log_joint(centre)
    area, _ = quad(lambda u: np.exp(log_joint(u) - top), centre - 12.0 * width, centre + 12.0 * width)
    exact = top + log(area)
    # parameters that are known exactly leave their unit prior to the evidence: nothing
    assert found.log_evidence == pytest.approx(exact, abs=0.06)


def test_without_a_noise_record_the_scale_does_not_matter(kit) -> None:  # type: ignore[no-untyped-def]
    """-ln L = n/2 ln RSS: the odds of two hypotheses stay when all residuals are counted in another unit."""
    problem = kit.closed_problem(seed=6, effect=0.1, known_noise=False)
    assert np.all(problem.freedom == 0.0)
    sums = np.array([30.0, 40.0, 50.0])
    assert problem.misfit(4.0 * sums) - problem.misfit(sums) == pytest.approx(
        0.5 * problem.counts.sum() * log(4.0)
    )
    np.testing.assert_allclose(problem.precisions(sums), problem.counts / sums)
