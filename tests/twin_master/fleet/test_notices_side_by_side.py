"""Twins with notices that fly side by side give the notices and beliefs that each gives alone."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from tests.twin_master.runs import of_library
from twin_master.assets.asset_source import AssetReading, StatelessAsset
from twin_master.errors import InvalidModelError, InvalidObservationError
from twin_master.gauges.gauge_watch import gauge_watch_of
from twin_master.mission import flights as flights_of_missions
from twin_master.mission.flights import Flights, fly_one_by_one, fly_side_by_side
from twin_master.mission.parts import TwinParts
from twin_master.mission.plant import Truth
from twin_master.mission.preparation import Knowledge
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.tables import Noticing, SensorFault

SEEDS = 4
SOUND = np.ones(24)
LOUD = np.where(np.arange(24) == 4, 1.3, 1.0)
"""Gauge 5 shows too much."""
OTHER_LAW = np.where(np.arange(24) % 2 == 0, 0.67, 1.0)
"""No state of the model explains these gauges together."""


def with_gains(asset: StatelessAsset, gains: NDArray[np.float64]) -> StatelessAsset:
    return StatelessAsset(lambda control, health: AssetReading(asset.step(control, health).values * gains))


def break_wires(truth: Truth) -> None:
    """Let gauge 4 show absurd values in steps 5 to 11, and gauge 8 nothing in steps 15 to 19."""
    truth.noise[5:12, 3] += 0.02
    truth.noise[15:20, 7] = np.nan


@dataclass
class WatchedFleet:
    """Sound twins, twins with a loud gauge, twins beyond the model and twins with broken wires."""

    knowledge: Knowledge
    truths: list[Truth]
    assets: list[StatelessAsset]

    def fly_alone(self) -> Flights:
        return fly_one_by_one(self.knowledge, self.truths, lambda twin, _ended_well: self.assets[twin])

    def fly_together(self) -> Flights:
        return fly_side_by_side(self.knowledge, self.truths, self.assets)


def watched_fleet(name, library_file) -> WatchedFleet:
    """Return the fleet of a scenario, in which gauge 20 is stuck in steps 8 to 18."""
    stuck = SensorFault(kind="stuck", sensors=(20,), first_step=8, last_step=18)
    truth = load_scenario(name).scenario.truth.model_copy(update={"sensor_faults": (stuck,)})
    knowledge, source = of_library(name, library_file, notice=Noticing(), truth=truth)
    asset = source.open()
    truths = [knowledge.truth(seed) for seed in range(4 * SEEDS)]
    for truth in truths[3 * SEEDS :]:
        break_wires(truth)
    assets = []
    for gains in (SOUND, LOUD, OTHER_LAW, SOUND):
        assets += [with_gains(asset, gains)] * SEEDS
    return WatchedFleet(knowledge, truths, assets)


@dataclass
class BothWays:
    """The flights of a watched fleet, twin by twin and side by side."""

    alone: Flights
    together: Flights

    def kinds(self, group: int) -> set[str]:
        """Return the kinds of notices of the twins of a group, flown side by side."""
        twins = self.together.notices[group * SEEDS : (group + 1) * SEEDS]
        return {notice.kind for notices in twins for _, notice in notices}


@pytest.fixture(scope="module", params=["level_turns", "growing_damage"])
def both_ways(request: pytest.FixtureRequest, library_file) -> BothWays:
    fleet = watched_fleet(request.param, library_file)
    return BothWays(fleet.fly_alone(), fleet.fly_together())


def test_twins_side_by_side_believe_what_each_believes_alone(both_ways):
    """To the last bit: a twin alone is watched by the same loops."""
    for name in ("filtered", "unexplained", "log_evidence"):
        np.testing.assert_array_equal(getattr(both_ways.together, name), getattr(both_ways.alone, name))


def test_twins_side_by_side_decide_and_fail_as_each_does_alone(both_ways):
    np.testing.assert_array_equal(both_ways.together.control_index, both_ways.alone.control_index)
    assert both_ways.together.failure == both_ways.alone.failure


def test_twins_side_by_side_give_the_notices_that_each_gives_alone(both_ways):
    assert both_ways.together.notices == both_ways.alone.notices


def test_the_fleet_has_notices_of_all_kinds_that_faults_cause(both_ways):
    assert "alarm" not in both_ways.kinds(0)
    assert {"alarm", "hypothesis"} <= both_ways.kinds(1)
    assert {"gauge_left_out", "gauge_back"} <= both_ways.kinds(3)


def test_each_twin_of_the_fleet_finds_its_stuck_gauge(both_ways):
    for notices in both_ways.together.notices:
        of_gauge = [(step, notice.kind) for step, notice in notices if notice.sensors == (20,)]
        assert of_gauge[0][1] == "gauge_left_out"
        assert 10 <= of_gauge[0][0] <= 12
        assert (19, "gauge_back") in of_gauge


def test_no_state_is_believed_where_no_state_explains_the_gauges(both_ways):
    unexplained = both_ways.together.unexplained[:, -1].reshape(4, SEEDS)
    assert unexplained[2].min() > 0.99
    assert unexplained[0].max() < 0.05


def test_twins_fly_the_same_in_several_formations(library_file, monkeypatch):
    fleet = watched_fleet("level_turns", library_file)
    whole = fleet.fly_together()
    size = gauge_watch_of(fleet.knowledge.estimator).faults.belief_size
    monkeypatch.setattr(flights_of_missions, "_MOST_NUMBERS_TOGETHER", 3 * size)
    parts = fleet.fly_together()
    np.testing.assert_array_equal(parts.filtered, whole.filtered)
    assert parts.notices == whole.notices


def test_an_infinite_value_is_refused_side_by_side_so_that_its_twin_fails_alone(library_file):
    fleet = watched_fleet("level_turns", library_file)
    fleet.truths[1].noise[3, 2] = np.inf
    with pytest.raises(InvalidObservationError, match="infinite"):
        fleet.fly_together()
    assert [twin for twin, failure in enumerate(fleet.fly_alone().failure) if failure] == [1]


class Sharp(GaussianSensorModel):
    """A likelihood of single observations."""

    def log_likelihood(self, observation: ArrayLike, control_index: int) -> NDArray[np.float64]:
        return 2.0 * super().log_likelihood(observation, control_index)


class SharpTogether(GaussianSensorModel):
    """The same likelihood, of many observations at once."""

    def log_likelihood_sequence(
        self, observations: ArrayLike, control_index: ArrayLike
    ) -> NDArray[np.float64]:
        return 2.0 * super().log_likelihood_sequence(observations, control_index)


class Misshapen(GaussianSensorModel):
    """Likelihoods of fewer states than there are."""

    def log_likelihood_sequence(
        self, observations: ArrayLike, control_index: ArrayLike
    ) -> NDArray[np.float64]:
        return super().log_likelihood_sequence(observations, control_index)[:, 1:]


def with_sensor_model(fleet: WatchedFleet, model: type[GaussianSensorModel]) -> WatchedFleet:
    scenario_model = fleet.knowledge.sensor_model
    given = model(scenario_model.value_per_draw, scenario_model.standard_deviation)
    return replace(fleet, knowledge=replace(fleet.knowledge, parts=TwinParts(sensor_model=given)))


@pytest.mark.parametrize("model", [Sharp, SharpTogether])
def test_twins_with_a_sensor_model_of_ones_own_fly_the_same_side_by_side(library_file, model):
    fleet = watched_fleet("level_turns", library_file)
    together = with_sensor_model(fleet, model).fly_together()

    alone = with_sensor_model(fleet, model).fly_alone()
    by_row = with_sensor_model(fleet, Sharp).fly_alone()
    np.testing.assert_allclose(together.filtered, alone.filtered, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(together.filtered, by_row.filtered, rtol=1e-12, atol=1e-12)
    assert together.notices == alone.notices
    assert [notices[0][1].kind for notices in together.notices] == ["gaussian"] * len(fleet.truths)


def test_a_sensor_model_with_likelihoods_of_fewer_states_is_refused(library_file):
    fleet = with_sensor_model(watched_fleet("level_turns", library_file), Misshapen)
    with pytest.raises(InvalidModelError, match="log-likelihood must have the shape"):
        fleet.fly_together()
