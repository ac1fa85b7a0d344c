"""Figures that pages state of the mission and of the wing model are those that come out."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fe.reduction.model_cache import reduced_model
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.assets.strain_library_source import load_strain_library
from twin_master.mission.flights import fly
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


class StrainErrors(NamedTuple):
    """Strains of the wing beside those of the published library at 3 g.

    Attributes
    ----------
    states : (S, 2) array
        Losses of stiffness of the two regions.
    ours, theirs : (S, G) array
        Strains of the gauges, in the model and in the library.
    """

    states: np.ndarray
    ours: np.ndarray
    theirs: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """The relative error (S, G)."""
        return self.ours / self.theirs - 1.0

    @property
    def largest(self) -> tuple[int, int]:
        """State and gauge of the largest relative error."""
        error = np.abs(self.relative)
        state, gauge = np.unravel_index(error.argmax(), error.shape)
        return int(state), int(gauge)


@pytest.fixture(scope="module")
def strain_errors(published_library: Path) -> StrainErrors:
    library = load_strain_library(published_library)
    states = library.states.coordinates
    wing = reduced_model()
    losses = dict(zip(wing.regions, states.T, strict=True))
    inputs = wing.vectors({"young_modulus_factor": 1.0073, "load_factor": 3.0, **losses})
    strain = wing.static_outputs(inputs)[:, : len(wing.gauges)]
    return StrainErrors(states, strain, library.strain[:, library.controls.index("3g")])


@pytest.fixture(scope="module")
def model_card() -> str:
    return (DOCS / "reference" / "model_card.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def documented_error(model_card: str) -> tuple[str, ...]:
    """What the model card says: gauge, losses of both regions [%], error [%] and [microstrain]."""
    row = re.search(r"gauge (\d+) at z1 = (\d+) %, z2 = (\d+) % \| ([\d.]+) %, (\d+) microstrain", model_card)
    assert row
    return row.groups()


def test_the_model_card_says_where_the_largest_strain_error_is(strain_errors, documented_error):
    documented_gauge, *documented_losses, _, _ = documented_error
    state, gauge = strain_errors.largest
    assert int(documented_gauge) == gauge + 1
    assert [int(loss) / 100 for loss in documented_losses] == pytest.approx(strain_errors.states[state])


def test_the_model_card_says_how_large_the_largest_strain_error_is(strain_errors, documented_error):
    *_, percent, microstrain = documented_error
    state, gauge = strain_errors.largest
    difference = (strain_errors.ours - strain_errors.theirs)[state, gauge]
    assert float(percent) == pytest.approx(100.0 * strain_errors.relative[state, gauge], abs=0.1)
    assert float(microstrain) == pytest.approx(1e6 * difference, abs=1.0)


def test_the_model_card_says_how_often_strain_errors_change_the_nearest_state(strain_errors, model_card):
    states, ours, theirs = strain_errors
    distance = ((ours[:, None] - theirs) ** 2).sum(axis=-1)  # (states of ours, states of theirs)
    nearest = states[distance.argmin(axis=0)]
    assert np.array_equal(nearest[:, 0], states[:, 0])
    one_level_below = np.isclose(states[:, 1] - nearest[:, 1], 0.2)
    assert (one_level_below.sum(), (states[:, 1] > 0.0).sum()) == (17, 20)
    assert "in 17 of the 20" in model_card
