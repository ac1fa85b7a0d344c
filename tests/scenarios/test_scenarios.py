"""The shipped scenarios and bindings."""

import tomllib

import pytest

from fe.wing.design import SHIPPED_DESIGN
from scenarios import recording_files, scenario_files
from twin_master.mission.turns import Truth
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.reading import load_scenario

SHAPES = {
    "bracket": (81, 40, 4),
    "stiffened_panel": (64, 40, 6),
    "three_regions": (125, 50, 24),
    "pump_wear": (25, 60, 4),
    "inspected_wing": (25, 120, 24),
}
"""States, steps and sensors, where they are not those of the paper's mission."""


@pytest.mark.parametrize("name", sorted({*scenario_files()} - {"watched_wing"}))
def test_each_scenario_can_be_flown(name: str) -> None:
    """That what it names is there `uav-twin scenario check` says."""
    scenario = load_scenario(name).scenario
    model = build_graphical_model(scenario)
    assert (model.states.size, *Truth(scenario, model, 0).noise.shape) == SHAPES.get(name, (25, 50, 24))


def test_the_shipped_watch_reads_the_shipped_recording() -> None:
    assert load_scenario("watched_wing").scenario.watch.recording == recording_files()["watched_wing"]


def test_the_wing_with_a_third_region_is_the_shipped_one_with_a_third_region() -> None:
    shipped = tomllib.loads(SHIPPED_DESIGN.read_text(encoding="utf-8"))
    three = tomllib.loads(SHIPPED_DESIGN.with_name("uav_wing_three_regions.toml").read_text(encoding="utf-8"))
    third = three["defects"].pop()
    assert set(third) == {"span_start", "span_end", "chord_start", "chord_end"}
    assert (three.pop("name"), shipped.pop("name")) == ("UAV wing, three regions", "UAV wing")
    assert three == shipped
    scenario = load_scenario("three_regions").scenario
    assert scenario.state_names == ("z1", "z2", "z3")
    build_source = scenario.belief.source(scenario, scenario.asset.source(scenario))
    build_source.check()
