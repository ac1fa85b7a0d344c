"""A flow of free shape over a level, where no law of the catalogue has the shape."""

from collections.abc import Sequence

import numpy as np
import pytest

from discrepancy.campaign.records import (
    Campaign,
    Channel,
    Hold,
    NoiseRecord,
    Quantity,
    RecordedInput,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.estimation.estimate import Estimate
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.ranking import rank_hypotheses
from discrepancy.judgement.hypotheses import curve_sentence, named_effects
from discrepancy.workflow import check_and_prepare, problem_without_wrong_ends
from tests.discrepancy.rigs import chosen, integrated, model_of

TANK = """
format = 1
name = "Tank with a linear outlet"
capacity = 1.0
conductance = 0.02
input = [{ name = "pump", vector = 1.0, quantity = "flow" }]
output = [{ name = "level", vector = 1.0, quantity = "level" }]
port = [{ name = "wall", vector = 1.0 }]
"""
NOISE = 2e-4
"""Standard deviation of the noise of the level [m]."""


def leak(level):
    """Return the flow through a weed in the wall, which lets most through in the middle [m3/s]."""
    return 0.008 * np.exp(-(((level - 0.7) / 0.15) ** 2))


@pytest.fixture(scope="module")
def search() -> ForceSearch:
    """Return the search for the missing flow of a tank that is filled and emptied twice."""
    generator = np.random.default_rng(3)
    time = 5.0 * np.arange(240.0)

    def pump(t: float) -> float:
        return 0.016 + 0.012 * np.sin(2.0 * np.pi * t / 600.0)

    level = integrated(lambda t, x: [pump(t) - 0.02 * x[0] - leak(x[0])], time, [0.3], max_step=1.0)[:, 0]
    readings = level + NOISE * generator.standard_normal(len(time))
    pumped = RecordedInput("pump", Quantity.FLOW, np.array([pump(t) for t in time]), Hold.SMOOTH)
    trial = Trial.plain(
        "filling",
        TrialKind.DRIVEN,
        ("level",),
        time,
        values=readings[:, None],
        inputs=(pumped,),
        begins=Start.UNKNOWN,
    )
    channel = Channel("level", Quantity.LEVEL, "level", NoiseRecord(NOISE, 500.0))
    campaign = Campaign("tank", {"level": channel}, (trial,), None, {}, "0" * 64)
    model = model_of(TANK)
    prepared, _ = check_and_prepare(campaign, model)
    return ForceSearch(problem_without_wrong_ends(prepared, model))


@pytest.fixture(scope="module")
def ranked(search: ForceSearch) -> Sequence[Estimate]:
    """Return the hypotheses of one named law, the most probable first."""
    return rank_hypotheses(search, chosen("outflow", "overflow"), largest_set=1)


def test_the_flow_of_free_shape_is_more_probable_than_an_overflow(ranked):
    best, *others = ranked
    assert [term.effect.identifier for term in best.candidate.terms] == ["flow_over_state"]
    assert best.log_evidence > max(other.log_evidence for other in others) + 30.0


def test_the_flow_is_that_through_the_wall(search, ranked):
    (table,) = ranked[0].candidate.patch(search.ported.problem.setting, ranked[0].effect)
    levels = np.array(table.speeds)
    assert np.abs(np.array(table.forces) - leak(levels)).max() < 0.05 * 0.008


def test_the_sentence_tells_the_flow_over_the_state(search, ranked):
    problem = search.ported.problem
    sentence = curve_sentence(problem, named_effects(problem, ranked[0]), 0.99)
    assert sentence.startswith("A flow that follows the state is missing at wall (probability 0.990)")
    assert sentence.endswith("(in m/s times capacity).")
