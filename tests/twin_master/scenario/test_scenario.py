"""Scenario files: what is read, what is refused, kinds, format 1; what options and files change."""

import json
import re
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.errors import CalibrationRecordError
from calibration.result.file import description, plain_record, result_bytes, run_record, save_calibration
from calibration.result.record import Calibration as Calibrated
from calibration.result.record import ParameterPrior
from fe.runtime.patch import LocalStiffnessLoss
from fe.wing.design import SHIPPED_DESIGN
from reporting.formats.former_names import FormerNameWarning
from tests.refusals import Inputs, refused
from tests.twin_master.runs import merged, patch_record, table_of, text_of, written
from twin_master.assets.asset_source import Asset, AssetReading, AssetSource, StatelessAsset
from twin_master.assets.parameter import draw_parameter
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.errors import MissionInputError, ScenarioError, TwinMasterError
from twin_master.network.graphical_model import worsening_table
from twin_master.run_folder import to_json
from twin_master.scenario.kinds import AssetSection
from twin_master.scenario.mission import Calibration
from twin_master.scenario.reading import LoadedScenario, load_scenario, parse_scenario
from twin_master.scenario.schema import Scenario
from uav_twin import fly, load_calibration, prepare_twin

INPUTS = Inputs(__file__)
EDITED = ("level_turns", "failing_gauges", "level_turns_learning", "inspected_wing", "model_mismatch")


@pytest.mark.parametrize(
    ("name", "old", "new", "sentence"), [(name, *row) for name in EDITED for row in INPUTS.refused(name)]
)
def test_whatever_is_wrong_is_named_in_one_sentence(name, old, new, sentence, tmp_path):
    path = written(tmp_path, text_of(name, (old, new)))
    with refused(ScenarioError, f"^{re.escape(str(path))}: .*{sentence}"):
        load_scenario(path)


def test_files_that_are_none_or_name_what_is_not_there(tmp_path):
    with refused(ScenarioError, "is not valid TOML"):
        load_scenario(written(tmp_path, "format = = 1"))
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


# ---------------------------- keys that had other names

FORMER_KEYS = """
[notice]
memory_turns = 30.0
onset_turns = 40.0

[watch]
seconds_per_turn = 2.0
"""


def test_a_scenario_of_an_earlier_version_is_read_with_one_sentence(tmp_path):
    former, present = tmp_path / "former.toml", tmp_path / "present.toml"
    text = text_of("level_turns")
    former.write_text(text + FORMER_KEYS)
    present.write_text(text + FORMER_KEYS.replace("turn", "step"))
    with pytest.warns(FormerNameWarning, match=r"former\.toml: `memory_turns` is now called `memory_steps`"):
        scenario = load_scenario(former).scenario
    # A second warning about the same file were an error.
    assert load_scenario(former).scenario == scenario == load_scenario(present).scenario
    assert scenario.watch.seconds_per_step == 2.0
    table = scenario.to_dict()
    table["planner"]["inspections_a_turn"] = table["planner"]["inspections_per_step"] = 3
    with pytest.raises(ScenarioError, match=r"`inspections_a_turn` is now called .*, and both are given"):
        parse_scenario(table, "x.toml")


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
    knowledge = prepare_twin(loaded, {"seed": 3})
    assert knowledge.sensor_model.mean[0, 1, 0] == pytest.approx(3.0 / 900.0)
    with pytest.raises(ScenarioError, match=r"asset: unknown key `stifness`.*kind, stiffness"):
        parse_scenario(table | {"asset": {"kind": "bellows", "stifness": 1.0}}, "mine.toml")


@pytest.fixture(scope="module")
def folder(
    library_file: Path, make_calibration: Callable[..., Calibrated], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """What scenarios and options name: a library, another wing, hidden effects, a calibration, half of it."""
    place = tmp_path_factory.mktemp("given")
    shutil.copy(library_file, place / "UAVconfig.json")
    written(place, SHIPPED_DESIGN.read_text(), ("refinement = 1.0", "refinement = 0.25"), name="other.toml")
    written(place, json.dumps(patch_record(LocalStiffnessLoss(0.3, 0.9, 0.3))), name="p.json")
    wing = save_calibration(make_calibration(), place / "wing 7.nc")
    (place / "half.nc").write_bytes(wing.read_bytes()[:9000])
    return place


BOUND, BELIEF = 'binding = "uav_wing"\n', '[belief]\nkind = "design"\ndesign = "uav_wing"\n'
FLOWN_PATCH, OTHER = (BOUND, f'{BOUND}patch = "p.json"\n'), ('design = "uav_wing"', 'design = "other.toml"')
HIDDEN = ("factor = 1.0073 }", 'factor = 1.0073, "effect.hiden.active" = 0 }')
OF_CALIBRATION, DRAWN = ('design = "uav_wing"', 'design = "calibration"'), 'source = "static_test"'
LIBRARY, WING = {"strain_library": "UAVconfig.json"}, {"asset/binding.toml", "asset/flown_design.toml"}
FILE, TAILORED = {"calibration": "wing 7.nc"}, {"asset/binding.toml", "asset/calibration.nc"}


SOURCES = [
    ("level_turns", (), {}, "design design", False, {*WING, "asset/design.toml"}),
    ("level_turns", (), LIBRARY, "strain_library asset", False, {"asset/UAVconfig.json"}),
    ("level_turns", (FLOWN_PATCH, (BELIEF, f'{BELIEF}patch = "p.json"\n')), {}, "design design", True,
     {*WING, "asset/design.toml", "asset/patch.json", "asset/model_patch.json"}),
    ("level_turns", ((BELIEF, BELIEF.replace("uav_wing", "other.toml")),), {}, "design design", False,
     {*WING, "asset/design.toml"}),
    ("level_turns", ((BELIEF, '[belief]\nkind = "strain_library"\nfile = "UAVconfig.json"\n'),), {},
     "design strain_library", True, {*WING, "asset/UAVconfig.json"}),
    ("level_turns", ((DRAWN, 'source = "file"\nfile = "wing 7.nc"'),), {},
     "calibration calibration", False, TAILORED),
    ("level_turns", ((DRAWN, 'source = "file"\nfile = "none.nc"'),), FILE,
     "calibration calibration", False, TAILORED),
    ("model_mismatch", (), {"strain_library": "."}, "strain_library design", True,
     {"asset/UAVconfig.json", "asset/design.toml"}),
    ("model_mismatch", (("# file", "file"),), {}, "strain_library design", True,
     {"asset/UAVconfig.json", "asset/design.toml"}),
    ("model_mismatch", (), LIBRARY | FILE, "strain_library calibration", True,
     {"asset/UAVconfig.json", "asset/calibration.nc"}),
]  # fmt: skip
"""Scenario, its changes, options, kinds of asset and belief, whether they differ, and files of the run."""


def resolved(folder: Path, name: str, changes: Any, options: Mapping[str, str]) -> Any:
    """Return a scenario with changes under options that name files of a folder."""
    loaded = load_scenario(written(folder, text_of(name, *changes)))
    return resolve_scenario(loaded, {key: folder / file for key, file in options.items()})


@pytest.mark.parametrize(("name", "changes", "options", "kinds", "differ", "kept"), SOURCES)
def test_what_flies_what_is_believed_and_what_a_run_keeps(
    folder, name, changes, options, kinds, differ, kept
):
    scenario = resolved(folder, name, changes, options)
    source = asset_source(scenario)
    source.check()
    files = source.files()
    assert f"{scenario.asset.kind} {scenario.belief.kind}" == kinds
    assert (source.origin.differ, {*files}) == (differ, kept)
    if "asset/calibration.nc" in files:
        assert files["asset/calibration.nc"] == (folder / "wing 7.nc").read_bytes()


@pytest.mark.parametrize(("name", "changes", "options", "kinds", "differ", "kept"), SOURCES)
def test_paths_of_a_scenario_start_at_its_file_and_leave_no_trace_of_the_machine(
    folder, name, changes, options, kinds, differ, kept
):
    portable = resolved(folder, name, changes, options).portable()
    elsewhere = json.dumps(portable.with_paths_from(Path("/there")).to_dict())
    assert str(folder) not in json.dumps(portable.to_dict())
    assert {*re.findall('"/there/(.*?)"', elsewhere)} <= kept


def test_options_change_seed_and_fmu_and_not_the_binding(folder):
    fmu = folder / "x.fmu"
    options = Overrides(seed=4, fmu=fmu, in_process=True)
    scenario = resolve_scenario(load_scenario("level_turns"), options)
    assert (scenario.mission.seed, scenario.asset.binding) == (4, "uav_wing")
    assert (scenario.asset.file, scenario.asset.isolated) == (str(fmu), False)


def test_a_binding_stands_where_the_scenario_does(folder):
    bound = load_scenario(written(folder, text_of("level_turns", ('"uav_wing"\n#', '"mine.toml"\n#'))))
    assert resolve_scenario(bound, Overrides()).asset.binding == str(folder / "mine.toml")


def test_a_calibration_changes_what_is_drawn_and_not_the_truth(folder):
    loaded, file = load_scenario("level_turns"), folder / "wing 7.nc"
    scenario = resolve_scenario(loaded, Overrides(calibration=file))
    assert (scenario.calibration.file, scenario.calibration.draws) == (str(file), 100)
    assert scenario.asset.parameters == loaded.scenario.asset.parameters


def test_what_a_fleet_learnt_is_drawn_in_the_place_of_a_calibration(folder):
    text = "format = 1\n[calibration]\n"
    text += 'parameter = "young_modulus_factor"\nmean = 1.0\nstandard_deviation = 0.01\n'
    options = Overrides(calibration=folder / "wing 7.nc", learnt=written(folder, text, name="learnt.toml"))
    scenario = resolve_scenario(load_scenario("level_turns"), options)
    assert (scenario.asset.kind, scenario.calibration.source) == ("calibration", "normal")
    asset_source(scenario).check()


@pytest.mark.parametrize("changes", [(), (OTHER, OTHER)], ids=["shipped", "other component and belief"])
def test_a_calibration_is_that_of_the_wing_of_a_system(folder, changes):
    several = load_scenario(written(folder, text_of("three_fmus", *changes)))
    scenario = resolve_scenario(several, Overrides(calibration=folder / "wing 7.nc"))
    assert [component.design for component in scenario.asset.component] == [None, "calibration", None]
    assert scenario.belief.kind == "calibration"
    asset_source(scenario).check()


def test_an_ssp_file_keeps_the_parameters_of_the_scenario(folder):
    pump = load_scenario("pump_wear")
    asset = resolve_scenario(pump, Overrides(ssp=folder / "pump.ssp")).asset
    assert (asset.kind, asset.parameters) == ("ssp", pump.scenario.asset.parameters)


@pytest.mark.parametrize(
    ("name", "changes", "given", "sentence"),
    [
        ("level_turns", (), LIBRARY | FILE, "a strain library brings its own samples"),
        ("level_turns", (OF_CALIBRATION,), {}, "there is no calibration file of a wing: give --calibration"),
        (
            "three_fmus",
            (OF_CALIBRATION,),
            {},
            "the scenario asks for the design of a calibration, but there is no",
        ),
        ("level_turns", (), {"calibration": "half.nc"}, "damaged"),
        ("level_turns", (), {"calibration": "none.nc"}, "is missing"),
        ("level_turns", ((BOUND, f'{BOUND}patch = "q.json"\n'),), {}, r"q\.json cannot be read"),
        ("level_turns", (FLOWN_PATCH, HIDDEN), {}, r"effect\.hiden\.active"),
        ("level_turns", (FLOWN_PATCH,), {"fmu": "x.fmu"}, r"`asset\.patch` belongs to an FMU"),
        ("model_mismatch", (), {"fmu": "x.fmu"}, "binding"),
        ("three_fmus", (), {"fmu": "x.fmu"}, "the scenario couples several"),
        ("three_fmus", (), {"fmu": "x.fmu", "ssp": "x.ssp"}, "give only one of an SSP file"),
    ],
)
def test_what_does_not_go_together_is_refused(folder, name, changes, given, sentence):
    loaded = load_scenario(written(folder, text_of(name, *changes)))
    with refused((TwinMasterError, CalibrationRecordError), sentence):
        asset_source(resolve_scenario(loaded, {key: folder / file for key, file in given.items()})).check()


def drawn_from(file: Path, parameter: str, draws: int) -> Any:
    """Return draws of a parameter from a calibration file, with a seed."""
    table = {"parameter": parameter, "source": "file", "file": str(file), "draws": draws}
    return draw_parameter(Calibration.model_validate(table), 3)


@pytest.fixture(scope="module")
def wing_7(folder: Path) -> tuple[Path, Any]:
    """A calibration file, and what it holds."""
    file = folder / "wing 7.nc"
    return file, load_calibration(file)


@pytest.mark.parametrize("name", ["young_modulus_factor", "servo_mass"])
def test_draws_are_some_of_the_samples(wing_7, name):
    file, calibration = wing_7
    draws = drawn_from(file, name, 20)
    assert set(draws.values.tolist()) <= set(calibration.draws_of(name).tolist())
    assert (draws.name, len(draws.values)) == (name, 20)
    assert "Wing 7 (é)" in draws.source


@pytest.mark.parametrize("name", ["young_modulus_factor", "servo_mass"])
def test_draws_have_the_moments_of_all_samples(wing_7, name):
    file, calibration = wing_7
    draws = drawn_from(file, name, 20)
    assert draws.mean == calibration.mean(name)
    assert draws.standard_deviation == calibration.standard_deviation(name)


def test_as_many_draws_as_samples_are_all_samples(wing_7):
    file, calibration = wing_7
    draws = drawn_from(file, "servo_mass", 40).values
    np.testing.assert_array_equal(np.sort(draws), np.sort(calibration.draws_of("servo_mass")))


def test_the_record_of_a_calibration_is_that_of_its_file(wing_7):
    file, calibration = wing_7
    record = to_json(run_record(calibration, "young_modulus_factor"))
    assert record == to_json(run_record(load_calibration(file), "young_modulus_factor"))


def test_the_record_of_a_calibration_has_moments_and_intervals(wing_7):
    _, calibration = wing_7
    record = json.loads(to_json(run_record(calibration, "young_modulus_factor")))
    state = record["state"]["servo_mass"]
    interval = np.quantile(calibration.samples[:, 1], [0.025, 0.975])
    assert state["unit"] == "kg"
    assert state["standard_deviation"] == pytest.approx(calibration.standard_deviation("servo_mass"))
    assert state["interval_95"] == pytest.approx(interval)


def test_the_record_of_a_calibration_has_correlations(wing_7):
    _, calibration = wing_7
    expected = np.corrcoef(calibration.samples[:, :5], rowvar=False)
    matrix = plain_record(calibration)["correlation"]["matrix"]
    np.testing.assert_allclose(matrix, expected, atol=1e-12)


def test_the_posterior_of_a_record_is_a_density(wing_7):
    _, calibration = wing_7
    posterior = json.loads(to_json(run_record(calibration, "young_modulus_factor")))["posterior"]
    area = np.trapezoid(np.array(posterior["density"]), np.array(posterior["grid"]))
    assert area == pytest.approx(1.0, abs=0.05)


def test_the_description_of_a_calibration_has_its_means(wing_7):
    _, calibration = wing_7
    assert f"servo_mass {calibration.mean('servo_mass'):.6g} +- " in description(calibration)


def test_the_record_of_a_single_sample_has_no_density(make_calibration):
    """Figures that do not vary are no error."""
    record = run_record(make_calibration(count=1), "young_modulus_factor")
    to_json(record)
    assert record["posterior"] == {}
    assert record["correlation"]["matrix"] == np.eye(5).tolist()


@pytest.mark.parametrize(("scenario", "means", "words"), Inputs(__file__).refused("campaign"))
def test_what_a_calibration_from_a_campaign_has_must_be_known(tmp_path, scenario, means, words):
    values = np.array([*means.values()])
    samples = values * (1.0 + 0.001 * np.random.default_rng(1).standard_normal((50, len(values))))
    priors = tuple(
        ParameterPrior(name, "1", mean, 0.1 * mean, 0.5 * mean, 2.0 * mean, "model.toml")
        for name, mean in means.items()
    )
    heading = ("spring 7", "spring", "0" * 64, "Gaussian")
    found = Calibrated(*heading, priors, samples, samples, None, (), (), "test", 1, {})
    (tmp_path / "calibration.nc").write_bytes(result_bytes(found))
    given = Overrides(calibration=tmp_path / "calibration.nc")
    with pytest.raises(MissionInputError, match=words):
        fly(load_scenario(scenario), tmp_path / "run", given, report=False)
    assert not (tmp_path / "run").exists()


def missing_in(table: dict[str, Any]) -> str:
    """Return why a table is not a scenario."""
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(table, "mine.toml")
    return str(caught.value)


def test_several_missing_keys_are_named_at_once():
    """Also a key with a unit in its name, and the kind of an asset."""
    table = load_scenario("level_turns").scenario.to_dict()
    del table["mission"]["name"], table["state"][0]["levels"], table["state"][0]["prior"], table["planner"]
    table["asset"] = {}
    found = missing_in(table)
    for place in ("mission.name", "state[1].levels[_percent]", "state[1].prior", "planner", "asset.kind"):
        assert f"'{place}'" in found
    assert found.endswith("are missing.")


def test_a_control_that_several_tables_lack_is_told_of_all():
    table = load_scenario("level_turns").scenario.to_dict()
    del table["rewards"]["control"]["2g"], table["transition"]["probability"]["2g"]
    found = missing_in(table)
    assert "`rewards.control` must have one entry for each control (2g, 3g), and has 3g" in found
    assert "`transition.probability` must have one entry for each control (2g, 3g), and has 3g" in found


def test_the_former_method_of_the_static_test_is_read_where_it_is_exact():
    table = load_scenario("level_turns").scenario.to_dict()
    present = parse_scenario(table, "x.toml")
    table["calibration"]["method"] = "exact"
    assert parse_scenario(table, "x.toml") == present
    table["calibration"]["method"] = "particle_filter"
    with pytest.raises(ScenarioError, match="method"):
        parse_scenario(table, "x.toml")
