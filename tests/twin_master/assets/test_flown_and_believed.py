"""What flies is not what is believed: a strain library, hidden effects; and a twin that knows them."""

import json
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from fe.runtime.patch import (
    BoucWen,
    LoadPlace,
    LocalStiffnessLoss,
    PointMass,
    Primitive,
    SensorDrift,
    SensorGain,
    Washout,
)
from fmu_asset.ssp.reader import read_ssp
from scenarios import binding_files
from tests.refusals import Inputs, refused
from tests.twin_master.runs import figures_of, loaded_from, patch_record, prepared, table_of, text_of, written
from twin_master.assets.asset_source import (
    FLOWN_DESIGN_HASH,
    AssetSource,
    PairedSource,
    calibration_sentence,
)
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.assets.strain_library_source import StrainLibrary, load_strain_library
from twin_master.assets.system_export import export_scenario
from twin_master.errors import MissionInputError, TwinMasterError
from twin_master.fleet.storage.store import in_credible_set
from twin_master.mission.preparation import prepare_knowledge
from twin_master.network.graphical_model import build_graphical_model
from twin_master.scenario.schema import Scenario
from twin_master.workflow import check_scenario
from uav_twin import fly as new_run
from uav_twin import load_scenario, open_run

pytestmark = pytest.mark.xdist_group("wing")
TEXT = text_of("model_mismatch")


@pytest.fixture
def content(library_file: Path) -> dict[str, Any]:
    """A library in the published format, of which the regions have other levels."""
    found: dict[str, Any] = json.loads(library_file.read_text(encoding="utf-8"))
    return found | {"states": [[0, 20, 40], [0, 80]]}


def loaded(folder: Path, content: object) -> StrainLibrary:
    text = content if isinstance(content, str) else json.dumps(content)
    return load_strain_library(written(folder, text, name="UAVconfig.json").parent)


class ConstantPredictions(AssetSource):
    """A model that predicts the same for every draw, state, control and sensor."""

    def observation_table(self, draws: Any, model: Any) -> Any:
        return np.full((1, 1, 1, 1), 3.0)


class DoubledPredictions(PairedSource):
    """A pair whose twin predicts twice of what its model does."""

    def observation_table(self, draws: Any, model: Any) -> Any:
        return 2.0 * super().observation_table(draws, model)


CALIBRATED, OTHER = 64 * "a", 64 * "b"
SAME = "The twin believes the design that was calibrated, aaaaaaaaaaaa."
ANOTHER = "The twin believes the design bbbbbbbbbbbb, which is not the one that was calibrated, aaaaaaaaaaaa."
NOT_KNOWN = "It is not known whether the twin believes the design that was calibrated."


@pytest.mark.parametrize(
    ("calibrated", "believed", "hashes", "comparison"),
    [
        (CALIBRATED, "design", {"design": CALIBRATED, FLOWN_DESIGN_HASH: OTHER}, SAME),
        (CALIBRATED, "design", {"design": OTHER, FLOWN_DESIGN_HASH: CALIBRATED}, ANOTHER),
        (CALIBRATED, "FMU", {FLOWN_DESIGN_HASH: CALIBRATED}, SAME),
        (CALIBRATED, "FMU", {FLOWN_DESIGN_HASH: OTHER}, ANOTHER),
        (CALIBRATED, "library", {FLOWN_DESIGN_HASH: OTHER}, NOT_KNOWN),
        (CALIBRATED, "FMU", {}, NOT_KNOWN),
        ("", "design", {"design": OTHER}, NOT_KNOWN),
    ],
)
def test_a_mission_says_whether_the_believed_design_was_calibrated(calibrated, believed, hashes, comparison):
    record = {"campaign": "ground test", "model": "bracket", "design_hash": calibrated}
    sentence = calibration_sentence(record, "FMU", believed, hashes)
    assert sentence is not None
    assert sentence.endswith(f". {comparison}")


def test_a_subclass_of_a_pair_changes_what_the_twin_predicts():
    """As the study of level turns does, which scales the predictions of each gauge."""
    model = ConstantPredictions(load_scenario("level_turns").scenario)
    assert PairedSource(model, model).observation_table(None, None).item() == 3.0
    assert DoubledPredictions(model, model).observation_table(None, None).item() == 6.0


@pytest.fixture
def library(content, tmp_path):
    return loaded(tmp_path, content)


@pytest.fixture
def strain_of_3g(content):
    """The mean strains by both levels and gauge."""
    first_levels, second_levels = content["states"]
    microstrain = [
        [content["observations"][str(z1)][str(z2)]["3g"]["mean"] for z2 in second_levels]
        for z1 in first_levels
    ]
    return 1e-6 * np.array(microstrain)


def test_a_library_in_the_published_format_has_controls_states_gauges_and_draws(library):
    assert library.controls == ("2g", "3g")
    assert (library.states.shape, library.gauge_count) == ((3, 2), 24)
    np.testing.assert_array_equal(library.young_modulus_factor, [0.994, 1.0, 1.004, 1.008, 1.014])


def test_a_library_in_the_published_format_has_the_strains_of_its_states_and_draws(
    library, content, strain_of_3g
):
    state = library.states.index((0.4, 0.8))
    first_draw = content["observations"]["40"]["80"]["3g"]["0.994"]
    np.testing.assert_allclose(library.strain[state, 1], strain_of_3g[2, 1])
    np.testing.assert_allclose(library.strain_per_draw[0, state, 1], 1e-6 * np.array(first_draw))


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.4, 0.8), (0.2, 0.0), (0.07, 0.21), (0.39, 0.8)])
def test_a_library_in_the_published_format_is_multilinear_between_its_levels(
    place, library, content, strain_of_3g
):
    (expected,) = RegularGridInterpolator(content["states"], strain_of_3g)(100.0 * np.array(place))
    np.testing.assert_allclose(library.strain_at(place, 1), expected, rtol=1e-13)


@pytest.fixture
def library_of_one_region(content, tmp_path):
    """A library whose second region has one level."""
    first_levels, _ = content["states"]
    return loaded(tmp_path, content | {"states": [first_levels, [0]]})


def test_a_library_of_one_region_is_linear_between_its_levels(library_of_one_region, strain_of_3g):
    expected = 0.65 * strain_of_3g[0, 0] + 0.35 * strain_of_3g[1, 0]
    np.testing.assert_allclose(library_of_one_region.strain_at((0.07, 0.0), 1), expected, rtol=1e-13)


def test_another_level_than_the_only_one_is_refused(library_of_one_region):
    with pytest.raises(MissionInputError, match=r"covers z2 from 0 to 0, but the state has 0\.1"):
        library_of_one_region.strain_at((0.07, 0.1), 1)


@pytest.mark.parametrize("outside", [0.41, -0.01, np.nan])
def test_a_state_outside_the_levels_of_a_library_is_refused(outside, library):
    with pytest.raises(MissionInputError, match=r"covers z1 from 0 to 0\.4"):
        library.strain_at((outside, 0.0), 0)


def cell(content: dict[str, Any], draw: str) -> list[float]:
    return content["observations"]["20"]["0"]["3g"][draw]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda content: content.pop("observations"), "lacks the entry 'observations'"),
        (lambda content: content["observations"].pop("40"), "lacks the entry '40'"),
        (lambda content: cell(content, "0.994").pop(), r"\[20\]\[0\]\[3g\]\[0.994\] must hold 24 finite"),
        (lambda content: cell(content, "mean").__setitem__(1, float("nan")), "NaN is not a number in JSON"),
        (lambda content: content.update(states=[[0, 20]]), "levels of 2 regions"),
        (lambda _: '{"states": [[0', "not valid JSON"),
        (lambda _: "[1, 2]", "not in the published format"),
    ],
)
def test_an_incomplete_or_damaged_library_is_refused(content, tmp_path, change, sentence):
    damaged = change(content)
    with pytest.raises(MissionInputError, match=sentence):
        loaded(tmp_path, damaged if isinstance(damaged, str) else content)


def resolved(library: Path, path: Path | str = "model_mismatch") -> Scenario:
    return resolve_scenario(load_scenario(path), Overrides(strain_library=library))


@pytest.mark.parametrize(("old", "new", "sentence"), Inputs(__file__).refused("disagreeing"))
def test_what_asset_and_model_cannot_agree_on_is_refused(library_file, tmp_path, old, new, sentence):
    scenario = resolved(library_file, written(tmp_path, TEXT, (old, new)))
    with refused(TwinMasterError, sentence):
        asset_source(scenario).check()


def smallest_credible_set(weights):
    """Return the states at least as probable as p, for the largest p at which they hold 90 %."""
    for least in (5, 4, 3, 2, 1):
        states = [state for state, weight in enumerate(weights) if weight >= least]
        if 10 * sum(weights[state] for state in states) >= 9 * sum(weights):
            return states
    raise AssertionError("the set of all states holds everything")


@given(
    weights=st.lists(st.integers(0, 5), min_size=25, max_size=25).filter(any),
    truth=st.tuples(st.integers(0, 80), st.integers(0, 80)),
)
def test_the_credible_set_by_enumeration(weights, truth):
    """Of a truth half way between two levels, both count."""
    model = build_graphical_model(load_scenario("level_turns").scenario)
    probability = np.array(weights) / sum(weights)
    distance = np.abs(np.rint(100.0 * model.states.coordinates) - truth)
    is_nearest = (distance == distance.min(axis=0)).all(axis=1)
    expected = bool(is_nearest[smallest_credible_set(weights)].any())
    is_inside = in_credible_set(model, probability[None], np.array([truth]) / 100.0)
    assert is_inside.tolist() == [expected]


def test_a_model_error_reaches_the_twin(library_file, tmp_path):
    """A twin that doubts its model trusts each sensor less, by a share of what it predicts."""
    percent = [float(value) for value in range(24)]
    listed = ("# model_error_percent = 3", f"model_error_percent = {percent}\nbetween_levels = false")
    asset = ('kind = "design"\ndesign = "uav_wing"\n', 'kind = "asset"\n')
    scenario = resolved(library_file, written(tmp_path, TEXT, asset, listed))
    sensors = prepare_knowledge(scenario, asset_source(scenario), 1).sensor_model
    expected = np.hypot(125e-6, np.arange(24) / 100.0 * sensors.mean)
    np.testing.assert_allclose(sensors.total_standard_deviation, expected, rtol=1e-12)


@pytest.mark.slow
def test_a_belief_of_some_regions_and_of_each_role_is_the_wing_itself(wing, tmp_path):
    """A region that is not named is healthy, for the twin, the FMU that flies and the field."""
    strains = '[observation.strain]\nvariables = "strain[{1..24}]"\nunit = "1"'
    for role, variables, changes in (
        ("strain", "", {}),
        ("displacement", '["tip_displacement"]', {"count": 1, "unit": "m", "standard_deviation": 0.1}),
        ("frequency", '"frequency[{1..3}]"', {"count": 3, "unit": "Hz", "standard_deviation": 0.1}),
    ):
        table = table_of("level_turns") | {"reference": []}
        table["state"], table["calibration"]["draws"] = table["state"][:1], 3
        table["truth"]["gains"] = table["truth"]["gains"][:3]
        if changes:
            table["observation"] = {"role": role, **changes}
            table["rewards"] |= {"health_limit": 100.0, "error_scale": 1.0}
            del table["rewards"]["health_limit_microstrain"], table["rewards"]["error_scale_microstrain"]
            table["truth"]["noise"] = {"standard_deviation": 0.1}
            own = f'[observation.{role}]\nvariables = {variables}\nunit = "{changes["unit"]}"'
            bound = binding_files()["uav_wing"].read_text()
            table["asset"] |= {"binding": str(written(tmp_path, bound, (strains, own), name=f"{role}.toml"))}
        table["asset"]["isolated"] = False
        observed = loaded_from(table, "level_turns")
        source, model = prepared(observed, tmp_path / role, {}), build_graphical_model(observed.scenario)
        draws = source.draws(0)
        found = source.observation_table(draws, model)
        flown, health, control = source.open(), {"z1": 0.4}, {"load_factor": 3.0}
        shown, state = flown.step(control, health).values, model.states.index((0.4,))
        flown.close()
        for e, row in zip((*draws.values, 1.0073), (*found[:, state, 1], shown), strict=True):
            losses = {"young_modulus_factor": e, "stiffness_loss": (0.4, 0.0)}
            static, modes = wing.static_response(load_factor=3.0, **losses), wing.modes(**losses)
            full = {"strain": static.strain, "displacement": static.displacement}
            np.testing.assert_allclose(row, full.get(role, modes.frequency[:3]), rtol=1e-9)
        assert source.write_field(tmp_path / "wing.vtu", health, control)
    table["belief"]["patch"] = str(write_patch(tmp_path, SensorGain("g5", 0.1)))
    patched = resolve_scenario(loaded_from(table, "level_turns"), Overrides())
    with pytest.raises(MissionInputError, match="predicts strains, but `frequency`"):
        asset_source(patched).check()


# ------------------------------------------------- effects: hidden in the asset, known to the twin

SHORT = text_of("level_turns", ("steps = 50", "steps = 7"), ("draws = 100", "draws = 6"))
DRIFT: tuple[Primitive, ...] = (SensorDrift("g5", 3e-5, 1.0), SensorGain("strain[9]", 0.1))
FILE = 'patch = "p.json"\n'


def write_patch(folder: Path, *primitives: Primitive) -> Path:
    return written(folder, json.dumps(patch_record(*primitives)), name="p.json")


def scenario_of(folder: Path, lines: str = "", parameters: str = "", belief: str = "") -> Path:
    """The mission with lines in the tables of asset and belief and with further parameters."""
    more = f", {parameters}" if parameters else ""
    return written(
        folder,
        SHORT,
        ('binding = "uav_wing"\n', f'binding = "uav_wing"\n{lines}'),
        ("[belief]\n", f"[belief]\n{belief}"),
        ("factor = 1.0073 }", f"factor = 1.0073{more} }}"),
    )


@pytest.mark.parametrize(
    ("primitive", "words"),
    [(LocalStiffnessLoss(0.3, end, 0.3), "m from the root, and the wing is 1.828 m long") for end in (5, -1)]
    + [(PointMass(1, 2.2), "a point_mass at 2.2 m"), (LoadPlace(-2, 0), "a load_place at -0.222 m")]
    + [(SensorDrift("strain[1]", 1e-5, 1.0), "on time"), (BoucWen("tip", 1.0, 1e-3, 1.0), "loads before")]
    + [(SensorDrift("strain[1]", 1e-5, 1.0, 0.0), "")],
)
def test_places_beside_the_wing_are_refused_and_what_changes_in_a_mission_is_no_model(
    primitive, words, tmp_path
):
    write_patch(tmp_path, primitive)
    for lines, belief in (("", FILE), *[(FILE, "")] * ("m" in words.split())):
        loaded = load_scenario(scenario_of(tmp_path, lines, belief=belief))
        with refused(MissionInputError, words) if words else nullcontext():
            check_scenario(loaded)


@pytest.fixture
def mission(tmp_path: Path, no_report: None) -> Callable[..., Path]:
    def fly(name: str, lines: str = "", parameters: str = "", belief: str = "") -> Path:
        loaded = load_scenario(scenario_of(tmp_path, lines, parameters, belief))
        return new_run(loaded, tmp_path / name, Overrides(in_process=True)).folder

    return fly


@dataclass
class DriftingMissions:
    """Missions with a hidden drift of gauge 5: without its patch, with it, and with it turned off."""

    patch: Path
    plain: Path
    hidden: Path
    off: Path

    def strain(self, name: str) -> np.ndarray:
        """Return the strains that a mission observed."""
        return np.asarray(open_run(getattr(self, name))["observed"]["strain"].values)


@pytest.fixture(scope="module")
def drifting_missions(no_report: None, tmp_path_factory: pytest.TempPathFactory) -> DriftingMissions:
    folder = tmp_path_factory.mktemp("drifting")
    write_patch(folder, *DRIFT)

    def fly(name: str, *options: str) -> Path:
        loaded = load_scenario(scenario_of(folder, *options))
        return new_run(loaded, folder / name, Overrides(in_process=True)).folder

    turned_off = '"effect.hidden.active" = 0'
    return DriftingMissions(
        folder / "p.json", fly("plain"), fly("hidden", FILE), fly("off", FILE, turned_off)
    )


@pytest.mark.slow
def test_a_drift_that_is_turned_off_changes_nothing(drifting_missions):
    np.testing.assert_array_equal(drifting_missions.strain("off"), drifting_missions.strain("plain"))


@pytest.mark.slow
def test_a_hidden_drift_shows_in_its_gauge_alone(drifting_missions):
    """The control of later steps may differ, since the twin is misled; that of the first ones does not."""
    hidden, plain = drifting_missions.strain("hidden"), drifting_missions.strain("plain")
    np.testing.assert_allclose(hidden[:2, 4] - plain[:2, 4], [3e-5, 6e-5], rtol=1e-6)
    assert np.all(hidden[0, [0, 1, 20]] == plain[0, [0, 1, 20]])


@pytest.mark.slow
def test_the_summary_says_that_asset_and_model_differ_by_a_hidden_drift(drifting_missions):
    """The misfit is in percent."""
    folder = drifting_missions.hidden
    summary = json.loads((folder / "summary.json").read_text())
    assert figures_of(folder)["model_misfit_rms"] > 1.0
    assert summary["asset_and_model_differ"] is True


@pytest.mark.slow
def test_a_run_keeps_the_patch_of_its_asset(drifting_missions):
    folder = drifting_missions.hidden
    config = json.loads((folder / "config.json").read_text())
    assert (folder / "asset" / "patch.json").read_bytes() == drifting_missions.patch.read_bytes()
    assert config["scenario"]["asset"]["patch"] == "asset/patch.json"
    assert "patch" in config["inputs"]


@pytest.mark.long
def test_a_twin_that_knows_the_effect_has_no_misfit(mission, tmp_path):
    loss, washout = LocalStiffnessLoss(0.3, 0.9, 0.3), Washout(0.05, 2.0)
    write_patch(tmp_path, loss, washout, SensorGain("g5", -0.05))
    ways = {"ignorant": (FILE, ""), "knowing": (FILE, FILE), "mistaken": ("", FILE)}
    misfit = {
        name: figures_of(mission(name, lines, belief=belief))["model_misfit_rms"]
        for name, (lines, belief) in ways.items()
    }
    # percent; what is left where the twin knows the effect is the mean of the draws of e against the true e
    assert misfit["knowing"] < 0.1
    assert min(misfit["ignorant"], misfit["mistaken"]) > 20.0 * misfit["knowing"]


@pytest.mark.slow
def test_the_asset_with_its_effects_can_be_exported(tmp_path):
    write_patch(tmp_path, *DRIFT)
    loaded = load_scenario(scenario_of(tmp_path, FILE, '"effect.hidden.gain" = 0.2'))
    system = read_ssp(export_scenario(loaded, tmp_path / "wing.ssp", seed=1, replace_file=False), tmp_path)
    given = [component.settings.get("effect.hidden.gain") for component in system.components]
    assert [setting.value for setting in given if setting] == [0.2]
