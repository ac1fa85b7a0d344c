"""A force that follows the past motion: no law of the present motion alone is its name."""

import pytest

from benchmarks.unlisted_laws.campaigns import drawn, write
from discrepancy.campaign.reading import read_campaign
from discrepancy.estimation.estimate import Estimate
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.screen import screen_effects
from discrepancy.fits.candidate import Candidate
from discrepancy.fits.fitting import fit
from discrepancy.judgement.force_comparison import ForceComparison
from discrepancy.search.strategy import Search
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.workflow import check_and_prepare, problem_without_wrong_ends
from tests.discrepancy.rigs import chosen

SEED = 6


@pytest.fixture(scope="module")
def comparison(tmp_path_factory: pytest.TempPathFactory) -> ForceComparison:
    """Return the comparison on a mass with a spring in series with a damper (Maxwell)."""
    folder = tmp_path_factory.mktemp("maxwell")
    write(folder, drawn("Maxwell branch", SEED), SEED)
    model = LumpedModel.load(folder / "model.toml")
    campaign, _ = check_and_prepare(read_campaign(folder), model)
    problem = problem_without_wrong_ends(campaign, model)
    no_effect = fit(problem, Candidate(), problem.prior_mean_point(Candidate()))
    return ForceComparison(Search(problem, (), no_effect), ForceSearch(problem))


def rough_estimate(comparison: ForceComparison, identifier: str) -> Estimate:
    """Return a rough estimate of one effect."""
    search = comparison.force_search
    base = search.estimate_without_effects
    best, *_ = screen_effects(search, base, chosen(identifier))
    start = best.starts[0]
    estimate = search.estimate_roughly(base, Candidate((best.term,)), start.effect, start.processes)
    assert estimate is not None
    return estimate


def test_damping_is_no_name(comparison):
    reason = comparison.failed_check_reason(rough_estimate(comparison, "quadratic_damping"))
    assert reason.startswith("the force follows the displacement relaxed within 0.0")
    assert reason.endswith("it depends on the past motion, and its law on the present one alone")


def test_a_law_with_memory_may_be_its_name(comparison):
    estimate = rough_estimate(comparison, "bouc_wen_hysteresis")
    assert not estimate.leaves_no_force
    assert comparison.failed_check_reason(estimate) == ""
