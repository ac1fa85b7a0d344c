"""The schema of scenario files: what is read, the sentence for whatever is wrong, kinds, and format 1."""

import itertools
import re
from typing import Any, ClassVar, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from reporting.progress import SilentProgress
from tests.refusals import Inputs, refused
from tests.twin_master.runs import merged, table_of, text_of, written
from twin_master.assets.asset_source import Asset, AssetReading, AssetSource, StatelessAsset
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.errors import ScenarioError, TwinMasterError
from twin_master.mission.preparation import prepare_knowledge
from twin_master.network.graphical_model import worsening_table
from twin_master.scenario.reading import LoadedScenario, load_scenario, parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import AssetSection

INPUTS = Inputs(__file__)
EDITED = ("level_turns", "level_turns_learning", "inspected_wing", "model_mismatch")


@pytest.mark.parametrize(
    ("name", "old", "new", "sentence"), [(name, *row) for name in EDITED for row in INPUTS.refused(name)]
)
def test_whatever_is_wrong_is_named_in_one_sentence(name, old, new, sentence, tmp_path):
    path = written(tmp_path, text_of(name, (old, new)))
    with refused(ScenarioError, f"^{re.escape(str(path))}: .*{sentence}"):
        load_scenario(path)


def test_files_that_are_none_or_name_what_is_not_there(tmp_path):
    faults = text_of("failing_gauges", ("sensors = [12]", "sensors = [25]"))
    for text, sentence in ((faults, "from 1 to 24, and 25 came"), ("format = = 1", "is not valid TOML")):
        with refused(ScenarioError, sentence):
            load_scenario(written(tmp_path, text))
    with refused(ScenarioError, "level_turns"):
        load_scenario("level_turn")


def tables(*changed: list[float]) -> dict[str, Any]:
    """Transitions by tables, one of them with other last rows."""
    good = worsening_table(5, 0.1).tolist()
    each = {"2g": {"z1": [*good[: 5 - len(changed)], *changed], "z2": good}, "3g": {"z1": good, "z2": good}}
    return {"transition": {"kind": "independent_tables", "probability": "", "tables": each}}


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        *[("level_turns", *row) for row in (
            ({"mission": {"seed": 10**40}}, r"mission\.seed.*at most 9223372036854775807.*files"),
            ({"mission": {"seed": 10**5000}}, r"mission\.seed.*thousands of digits"),
            ({"observation": {"standard_deviation_microstrain": 10**400}},
             r"observation\.standard_deviation.*finite"),
            ({"rewards": {"health_weight": 10**5000}}, r"rewards\.health_weight.*thousands of digits"),
            ({"observation": {"standard_deviation": 1e-4}}, "given with and without its unit"),
            (tables([0.0, 0.0, 0.0, 0.1, 0.8]), r"2g\.z1.*sum to 1"),
            (tables([0.0, 1.0]), "5 rows of 5"),
        )],
        *INPUTS.refused("tables"),
    ],
    ids=itertools.count(),
)  # fmt: skip
def test_keys_that_do_not_fit_and_numbers_that_no_file_or_float_holds_are_refused(name, changes, words):
    with refused(ScenarioError, words):
        parse_scenario(merged(table_of(name), changes), "mine.toml")


@settings(max_examples=60, deadline=None)  # the first one loads every source
@given(st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=4) | st.integers(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(
        [*Scenario.model_fields, "levels_percent", "prior", "name", "steps", "kind", "x"]
    ), inner, max_size=4),
    max_leaves=12,
))  # fmt: skip
def test_no_table_whatsoever_raises_anything_but_a_sentence(table):
    base = table_of("level_turns")
    candidates = [table] if isinstance(table, dict) else []
    candidates += [base | {key: table} for key in Scenario.model_fields]
    for candidate in candidates:
        sentence = "x.toml"
        try:
            parse_scenario(candidate, "x.toml")
        except TwinMasterError as error:
            sentence = str(error)
        assert sentence.startswith("x.toml")


# ---------------------------- the kinds, a kind of one's own, and files of format 1

FORMAT_1 = INPUTS.table("format_1.toml")


def of_format_1(name: str, asset: dict[str, Any]) -> Scenario:
    table = table_of(name) | {"format": 1, "asset": asset}
    del table["belief"]
    return parse_scenario(table, "old.toml")


@pytest.mark.parametrize("name", [*FORMAT_1["same"], "three_fmus"])
def test_a_file_of_format_1_means_what_it_meant(name):
    several = {"design": "uav_wing", "observation_model": None, "patch": None, "isolated": True}
    old = FORMAT_1["same"].get(name, table_of(name)["asset"] | several)
    assert of_format_1(name, old) == parse_scenario(table_of(name), name)


@pytest.mark.parametrize(("asset", "flown", "believed"), FORMAT_1["kinds"]["rows"])
def test_every_combination_of_format_1_has_its_kinds(asset, flown, believed):
    scenario = of_format_1("level_turns", asset)
    assert (scenario.asset.kind, scenario.belief.kind) == (flown, believed)


@pytest.mark.parametrize(("asset", "words"), FORMAT_1["wrong"]["rows"])
def test_what_is_wrong_with_format_1_stays_wrong(asset, words):
    with pytest.raises(ScenarioError, match=words):
        of_format_1("level_turns", asset)


class Bellows(AssetSection):
    """A kind of one's own, in one class: a spring whose damage states soften it, its own source."""

    kind: Literal["bellows"] = "bellows"
    stiffness: float
    units: ClassVar = {}

    def source(self, scenario: Scenario) -> Any:
        return BellowsSource(scenario)


class BellowsSource(AssetSource):
    """What is made of it; it is believed as well."""

    label = "bellows"

    def observation_table(self, draws: Any, model: Any) -> Any:
        loads = np.array([control.values["load_factor"] for control in self._scenario.control])
        left = 1.0 - model.states.coordinates.mean(axis=1)
        table = loads / (self._scenario.asset.stiffness * draws.values[:, None, None] * left[None, :, None])
        return np.repeat(table[..., None], 24, axis=-1)

    def open(self) -> Asset:
        return StatelessAsset(lambda control, health: AssetReading(np.zeros(24)))


def test_a_kind_of_one_s_own_is_one_class(tmp_path):
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
    with pytest.raises(ScenarioError, match=r"asset: unknown key `stifness`.*kind, stiffness"):
        parse_scenario(table | {"asset": {"kind": "bellows", "stifness": 1.0}}, "mine.toml")
