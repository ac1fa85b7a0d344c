"""Dry friction in one direction: a force that hardly changes is the law's, not a random force's."""

import numpy as np
import pytest

from discrepancy.campaign.reading import read_campaign
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.ranking import rank_by_missing_force
from discrepancy.model_choice import load_model
from discrepancy.workflow import check_and_prepare, problem_without_wrong_ends
from tests.discrepancy.rigs import chosen

MASS = 20.0
"""Mass of the slide and of its model [kg]."""
FRICTION = 30.0
"""Dry friction of the guide, which the model lacks [N]."""
NOISE = 1.0
"""Standard deviation of the load cell [N]."""

MODEL = """format = 1
name = "slide"
mass = 20.0
free = true
[[input]]
name = "screw"
vector = 1.0
quantity = "velocity"
[[output]]
name = "cell"
reaction = "screw"
quantity = "force"
[[port]]
name = "guide"
vector = 1.0
[[parameter]]
name = "mass_factor"
terms = "mass"
deviation = 0.03
low = 0.7
high = 1.3
"""
CAMPAIGN = """format = 1
name = "A slide that is driven one way"
[[channel]]
name = "load cell"
quantity = "force"
unit = "N"
output = "cell"
noise = { standard_deviation = 1.0 }
offset_deviation = 1.0
[[input]]
name = "screw"
quantity = "velocity"
unit = "m/s"
hold = "smooth"
[[trial]]
name = "speeding up"
kind = "driven"
file = "drive.csv"
begins = "still"
"""


@pytest.fixture(scope="module")
def search(tmp_path_factory: pytest.TempPathFactory) -> ForceSearch:
    """Return the estimates of a slide that begins to move at a thousandth of its final speed."""
    folder = tmp_path_factory.mktemp("slide")
    time = 0.7e-3 * np.arange(400)
    logistic = 1.0 / (1.0 + np.exp(-(time - 0.14) / 0.02))
    speed = 0.3 * logistic
    acceleration = 0.3 * logistic * (1.0 - logistic) / 0.02
    noise = NOISE * np.random.default_rng(7).standard_normal(len(time))
    table = np.column_stack((time, speed, MASS * acceleration + FRICTION + noise))
    header = "time,screw,load cell"
    np.savetxt(folder / "drive.csv", table, "%.9g", ",", header=header, comments="")
    (folder / "campaign.toml").write_text(CAMPAIGN, encoding="utf-8")
    (folder / "model.toml").write_text(MODEL, encoding="utf-8")
    model = load_model(folder / "model.toml")
    campaign, _ = check_and_prepare(read_campaign(folder), model)
    return ForceSearch(problem_without_wrong_ends(campaign, model))


def test_a_recorded_speed_moves_the_port_from_the_first_sample_on(search: ForceSearch) -> None:
    """Dry friction acts at any speed, so that a first speed of zero would leave it out there."""
    trial = search.estimate_without_effects.trials[0].trial

    assert trial.port_speeds[0, 0] == pytest.approx(0.3 / (1.0 + np.exp(7.0)), rel=1e-6)


def test_friction_in_one_direction_is_estimated_in_its_size(search: ForceSearch) -> None:
    effects = chosen("coulomb_friction", "quadratic_damping", "gauge_zero_drift")

    best, *_ = rank_by_missing_force(search, effects)

    assert best.candidate.identifiers == ("coulomb_friction",)
    (law,) = best.candidate.patch(search.ported.problem.setting, best.effect)
    assert law.coefficient == pytest.approx(FRICTION, abs=2.0)
    assert best.processes[0].standard_deviation < 0.05 * FRICTION


def test_a_missing_force_varies_within_the_record(search: ForceSearch) -> None:
    """One with a longer correlation time would be a constant, which trades places with the law."""
    effects = chosen("coulomb_friction", "quadratic_damping")
    duration = float(np.ptp(search.estimate_without_effects.trials[0].trial.time))

    estimates = rank_by_missing_force(search, effects)

    times = [estimate.processes[0].correlation_time for estimate in estimates]
    assert max(times) <= duration * (1.0 + 1e-9)
