"""A force of free shape over the displacement, where no law of the catalogue has the shape."""

from collections.abc import Sequence

import numpy as np
import pytest

from benchmarks.unlisted_laws.campaigns import Experiment, drawn, write
from benchmarks.unlisted_laws.rig import law_force
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.force_curve import CORRELATION_LENGTHS, curve_functions
from discrepancy.estimation.estimate import Estimate
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.ranking import rank_hypotheses
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.workflow import check_and_prepare, problem_without_wrong_ends
from tests.discrepancy.rigs import chosen

SEED = 5


@pytest.fixture(scope="module")
def magnet() -> Experiment:
    """Return a campaign on a mass beside a magnet."""
    return drawn("magnet", SEED)


@pytest.fixture(scope="module")
def search(magnet: Experiment, tmp_path_factory: pytest.TempPathFactory) -> ForceSearch:
    """Return the search for the missing force of a mass beside a magnet."""
    folder = tmp_path_factory.mktemp("magnet")
    write(folder, magnet, SEED)
    model = LumpedModel.load(folder / "model.toml")
    campaign, _ = check_and_prepare(read_campaign(folder), model)
    return ForceSearch(problem_without_wrong_ends(campaign, model))


@pytest.fixture(scope="module")
def ranked(search: ForceSearch) -> Sequence[Estimate]:
    """Return the hypotheses of one named law, the most probable first."""
    return rank_hypotheses(search, chosen("cubic_stiffness"), largest_set=1)


def test_the_curve_is_more_probable_than_a_law_of_another_shape(ranked):
    best, *others = ranked

    assert [term.effect.identifier for term in best.candidate.terms] == ["force_over_displacement"]
    assert best.log_evidence > max(other.log_evidence for other in others) + 30.0


def test_the_curve_leaves_no_force(ranked):
    assert ranked[0].leaves_no_force
    assert not any(other.leaves_no_force for other in ranked[1:])


def test_the_curve_is_that_of_the_magnet(magnet, search, ranked):
    """But for a line, which a small error of the stiffness adds."""
    (table,) = ranked[0].candidate.patch(search.ported.problem.setting, ranked[0].effect)
    displacements = np.array(table.displacements)
    truth = np.array([law_force(magnet.truth, 0.0, x, 0.0, 0.0) for x in displacements])
    difference = np.array(table.forces) - truth
    line = np.polyval(np.polyfit(displacements, difference, 1), displacements)

    assert np.abs(difference - line).max() < 0.05 * np.abs(truth).max()


@pytest.mark.parametrize("correlation_length", CORRELATION_LENGTHS)
def test_the_functions_of_a_curve_add_up_to_the_process(correlation_length):
    """Mercer's theorem: the products of the functions add up to the covariance."""
    functions = curve_functions(correlation_length)
    fractions = np.linspace(0.0, 1.0, len(functions))
    distances = (fractions[:, np.newaxis] - fractions) / correlation_length

    np.testing.assert_allclose(functions @ functions.T, np.exp(-0.5 * distances**2), atol=0.02)
