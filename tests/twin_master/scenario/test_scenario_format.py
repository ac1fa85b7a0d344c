"""What flies and what the twin believes: the kinds, a kind of one's own, and files of format 1."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pytest

from reporting.progress import SilentProgress
from scenarios import scenario_files
from twin_master.assets.asset_source import Asset, AssetReading, AssetSource, FlownAndBelieved, StatelessAsset
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.errors import ScenarioError
from twin_master.mission.preparation import prepare_knowledge
from twin_master.scenario.asset import AssetSection, BeliefSection
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.scenario.schema import Scenario

WING = {"young_modulus_factor": 1.0073}
OLD = {
    "level_turns": {"kind": "fmu", "design": "uav_wing", "binding": "uav_wing", "parameters": WING},
    "model_mismatch": {"kind": "strain_library", "design": "uav_wing", "observation_model": "design"},
    "pump_wear": {"script": "gear_pump", "binding": "gear_pump", "parameters": {"viscosity_factor": 1.02}},
}


def table_of(name: str) -> dict[str, Any]:
    return tomllib.loads(scenario_files()[name].read_text(encoding="utf-8"))


def of_format_1(name: str, asset: dict[str, Any]) -> Scenario:
    table = table_of(name) | {"format": 1, "asset": asset}
    del table["belief"]
    return parse_scenario(table, "old.toml")


@pytest.mark.parametrize("name", sorted(OLD))
def test_a_file_of_format_1_means_what_it_meant(name: str) -> None:
    assert of_format_1(name, OLD[name]) == parse_scenario(table_of(name), name)


def test_all_of_several_fmus_is_read_from_format_1() -> None:
    new = table_of("three_fmus")
    old = new["asset"] | {"design": "uav_wing", "observation_model": None, "patch": None, "isolated": True}
    assert of_format_1("three_fmus", old) == parse_scenario(table_of("three_fmus"), "three_fmus")


@pytest.mark.parametrize(
    ("asset", "flown", "believed"),
    [
        ({"file": "a.fmu", "binding": "b.toml"}, "fmu", "asset"),
        ({"file": "a.fmu", "binding": "b.toml", "design": "uav_wing"}, "fmu", "design"),
        ({"design": "calibration", "binding": "uav_wing", "patch": "p"}, "calibration", "calibration"),
        ({"design": "w.toml", "binding": "uav_wing", "observation_model": "asset"}, "design", "asset"),
        ({"kind": "coupled", "file": "a.ssp", "binding": "b.toml"}, "ssp", "asset"),
        ({"script": "gear_pump", "binding": "b", "observation_model": "library", "library": "l.nc"},
         "script", "library"),
    ],
)  # fmt: skip
def test_every_combination_of_format_1_has_its_kinds(
    asset: dict[str, Any], flown: str, believed: str
) -> None:
    scenario = of_format_1("level_turns", asset)
    assert (scenario.asset.kind, scenario.belief.kind) == (flown, believed)


def test_what_is_wrong_with_format_1_stays_wrong() -> None:
    for asset, words in (
        ({"kind": "glider"}, "`kind` must be one of"),
        ({"design": "uav_wing"}, "asset.binding"),
        ({"kind": "strain_library", "observation_model": "design"}, "belief.design"),
        ("wing", "asset"),
    ):
        with pytest.raises(ScenarioError, match=words):
            of_format_1("level_turns", asset)  # type: ignore[arg-type]


def test_the_kinds() -> None:
    assert {*AssetSection.kinds()} >= {
        "design", "calibration", "fmu", "script", "coupled", "ssp", "strain_library",
    }  # fmt: skip
    assert {*BeliefSection.kinds()} >= {"asset", "design", "calibration", "library", "strain_library"}


class Bellows(AssetSection):
    """A kind of one's own, in one class: a spring whose damage states soften it, its own source."""

    kind: Literal["bellows"] = "bellows"
    stiffness: float
    units: ClassVar = {}

    def source(self, scenario: Scenario) -> BellowsSource:
        return BellowsSource(scenario, self)


class BellowsSource(AssetSource):
    """What is made of it; it is believed as well."""

    label = "bellows"

    def __init__(self, scenario: Scenario, section: Bellows) -> None:
        super().__init__(scenario)
        self.section, self.count = section, scenario.observation.count

    def observation_table(self, draws: Any, model: Any) -> Any:
        loads = np.array([control.values["load_factor"] for control in self._scenario.control])
        left = 1.0 - model.states.coordinates.mean(axis=1)
        table = loads / (self.section.stiffness * draws.values[:, None, None] * left[None, :, None])
        return np.repeat(table[..., None], self.count, axis=-1)

    def open(self) -> Asset:
        return StatelessAsset(lambda control, health: AssetReading(np.zeros(self.count)))


def test_a_kind_of_one_s_own_is_one_class(tmp_path: Path) -> None:
    table = table_of("level_turns") | {
        "asset": {"kind": "bellows", "stiffness": 900.0},
        "belief": {"kind": "asset"},
        "calibration": {"parameter": "k", "source": "fixed", "mean": 1.0},
        "reference": [],
    }
    loaded = LoadedScenario(parse_scenario(table, "mine.toml"), tmp_path / "mine.toml", "")
    scenario = resolve_scenario(loaded, Overrides(seed=3))
    assert parse_scenario(scenario.to_dict(), "config.json") == scenario
    source = asset_source(scenario)
    source.prepare(tmp_path, SilentProgress())
    knowledge = prepare_knowledge(scenario, source, 3)
    assert knowledge.sensor_model.mean[0, 1, 0] == pytest.approx(3.0 / 900.0)
    with pytest.raises(ScenarioError, match=r"unknown key `asset.stifness`.*kind, stiffness"):
        parse_scenario(table | {"asset": {"kind": "bellows", "stifness": 1.0}}, "mine.toml")


def test_a_twin_may_believe_another_wing_than_the_one_that_flies(tmp_path: Path) -> None:
    (tmp_path / "other.toml").write_text("", encoding="utf-8")
    table = table_of("level_turns")
    table["belief"]["design"] = "other.toml"
    loaded = LoadedScenario(parse_scenario(table, "x"), tmp_path / "x.toml", "")
    scenario = resolve_scenario(loaded, Overrides())
    assert scenario.belief.design == str(tmp_path / "other.toml")  # type: ignore[attr-defined]
    files = asset_source(scenario).files()
    assert files["asset/design.toml"] == b""
    assert files["asset/flown_design.toml"] != b""
    there = scenario.portable().moved(Path("/there"))
    assert there.belief.design == "/there/asset/design.toml"  # type: ignore[attr-defined]
    assert there.asset.design == "uav_wing"  # type: ignore[attr-defined]


def test_a_strain_library_may_be_believed_of_an_fmu(library_file: Path, tmp_path: Path) -> None:
    table = table_of("level_turns")
    table["belief"] = {"kind": "strain_library", "file": str(library_file)}
    loaded = LoadedScenario(parse_scenario(table, "x"), tmp_path / "x.toml", "")
    source = asset_source(resolve_scenario(loaded, Overrides()))
    source.check()
    assert source.origin == FlownAndBelieved(
        "FMU of the reduced model of the design UAV wing", "strain library", differ=True
    )
    assert len(source.draws(0).values) == 5
