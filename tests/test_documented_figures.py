"""Figures that pages state of the mission and of the wing model are those that come out."""

import re
from pathlib import Path

import numpy as np
import pytest

from fe.reduction.model_cache import reduced_model
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.assets.strain_library_source import load_strain_library
from twin_master.mission.loop import fly
from twin_master.mission.preparation import prepare_knowledge
from twin_master.scenario.reading import load_scenario

DOCS = Path(__file__).parents[1] / "docs"

pytestmark = pytest.mark.xdist_group("wing")


@pytest.mark.long
def test_the_error_reward_with_and_without_the_load_factor():
    scenario = load_scenario("paper_level_turns").scenario
    source = ReducedModelSource(scenario, reduced_model())
    known = prepare_knowledge(scenario, source, scenario.mission.seed)
    flight = fly(scenario, known.twin(), known.plant(known.truth(scenario.mission.seed), source.open()))
    predicted = source.observation_table(known.draws, known.model)[:, :, flight.control_index]  # (E, S, T, G)
    load_factor = np.array([control.values["load_factor"] for control in scenario.control])

    def mean(normaliser: np.ndarray) -> float:
        distance = np.nanmean(np.abs(flight.observed - predicted) / scenario.rewards.error_scale, axis=-1)
        rewards = -distance / normaliser
        return float(np.einsum("ts,st->t", flight.filtered, rewards.mean(axis=0)).mean())

    page = (DOCS / "explanation" / "departures.md").read_text(encoding="utf-8")
    row = next(line for line in page.splitlines() if line.startswith("| error reward"))
    printed, divided = (float(figure) for figure in re.findall(r"-0\.\d{3}", row))
    assert mean(np.ones(len(flight.observed))) == pytest.approx(printed, abs=5e-4)
    assert mean(load_factor[flight.control_index]) == pytest.approx(divided, abs=5e-4)


def test_the_largest_strain_error_and_what_it_does_to_the_nearest_state(published_library):
    library = load_strain_library(published_library)
    states = library.states.coordinates
    sharp = library.controls.index("3g")
    wing = reduced_model()
    losses = dict(zip(wing.regions, states.T, strict=True))
    ours = wing.static_outputs(wing.vectors({"young_modulus_factor": 1.0073, "load_factor": 3.0, **losses}))
    ours = ours[:, : len(wing.gauges)]
    theirs = library.strain[:, sharp]
    relative = ours / theirs - 1.0
    state, gauge = np.unravel_index(np.abs(relative).argmax(), relative.shape)
    page = (DOCS / "reference" / "model_card.md").read_text(encoding="utf-8")
    row = re.search(r"gauge (\d+) at z1 = (\d+) %, z2 = (\d+) % \| ([\d.]+) %, (\d+) microstrain", page)
    assert row
    assert int(row[1]) == gauge + 1
    assert (int(row[2]) / 100, int(row[3]) / 100) == pytest.approx(states[state])
    assert float(row[4]) == pytest.approx(100.0 * relative[state, gauge], abs=0.1)
    assert float(row[5]) == pytest.approx(1e6 * (ours - theirs)[state, gauge], abs=1.0)
    nearest = states[((ours[:, None] - theirs) ** 2).sum(axis=-1).argmin(axis=0)]
    assert np.array_equal(nearest[:, 0], states[:, 0])
    below = np.isclose(states[:, 1] - nearest[:, 1], 0.2)
    assert (below.sum(), (states[:, 1] > 0.0).sum()) == (17, 20)
    assert "in 17 of the 20" in page
