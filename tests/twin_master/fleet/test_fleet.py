"""Fleets: plan, shards, store, what goes on after a kill; twins side by side fly what each flies alone."""

import json
import os
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from calibration.errors import PosteriorError
from fmu_asset.errors import FmuEndedError
from reporting.formats.former_names import FormerNameWarning
from tests.command_line import refused, said
from tests.refusals import Inputs
from tests.twin_master.runs import check_same, edited, of_library, text_of, written
from twin_master.assets.asset_source import AssetReading, StatelessAsset
from twin_master.assets.resolution import Overrides
from twin_master.command_options import choose_engine
from twin_master.errors import (
    FleetError,
    ImpossibleObservation,
    MissionInputError,
    NotResumableError,
    RunFolderError,
)
from twin_master.fleet import flight
from twin_master.fleet.comparison import earned_statistics, group_statistics
from twin_master.fleet.engine import Engine
from twin_master.fleet.learning.learn import learn_fleet
from twin_master.fleet.members import Member
from twin_master.fleet.outcomes import Outcomes
from twin_master.fleet.page.report import write_fleet_report
from twin_master.fleet.plan import Fleet, ensemble, load_fleet
from twin_master.fleet.shard import result_of_unflown
from twin_master.fleet.storage.store import ENDED, FLOWN, fallbacks_of, in_credible_set, stored_variables
from twin_master.fleet.storage.store_address import STORE_NAME
from twin_master.fleet.storage.store_layout import FORMER_DIMENSIONS, FORMER_PATHS
from twin_master.mission.flights import Flights, fly, fly_one_by_one, fly_side_by_side
from twin_master.mission.journal import JournalFile
from twin_master.mission.plant import DamageGrowth
from twin_master.mission.preparation import Knowledge
from uav_twin import fly as new_run
from uav_twin import fly_fleet, load_scenario, open_fleet, open_run, prepare_twin


def growing(library_file: Path, count: int = 10, shard: int = 4) -> Fleet:
    return ensemble("growing_damage", range(count), Overrides(strain_library=library_file), shard=shard)


@pytest.fixture(scope="module")
def whole(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the flown fleet."""
    return fly_fleet(growing(library_file), tmp_path_factory.mktemp("whole") / "fleet").folder


def write_former_store(whole: Path, folder: Path) -> None:
    """Write the store of a fleet as earlier versions did: one group, other names, no coordinates."""
    group = open_fleet(whole)["growing_damage"]
    variables = {name: group[name] for name in ("status", "seed", "delay", "early", "credible")}
    variables |= {name: group[path] for name, path in FORMER_PATHS.items()}
    variables["observed"] = group["observed/strain"]
    names = {present: former_name for former_name, present in FORMER_DIMENSIONS.items()}
    for name, variable in variables.items():
        bare = variable.drop_vars([*variable.coords])
        variables[name] = bare.rename({axis: names[axis] for axis in bare.dims if axis in names})
    former = xr.Dataset(variables)
    former.attrs |= group.attrs
    shutil.rmtree(folder / STORE_NAME)
    former.to_zarr(folder / STORE_NAME, group="growing_damage", consolidated=False, zarr_format=3)


@pytest.fixture(scope="module")
def present_group(whole: Path) -> xr.DataTree:
    """The group of the flown fleet."""
    return open_fleet(whole)["growing_damage"]


@pytest.fixture(scope="module")
def former_group(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> xr.DataTree:
    """The same group, read from a store of an earlier version; a second warning would be an error."""
    folder = shutil.copytree(whole, tmp_path_factory.mktemp("former") / "fleet")
    write_former_store(whole, folder)
    sentence = r"fleet\.zarr: `turn` is now called `step`, `factor` is now called `region`"
    with pytest.warns(FormerNameWarning, match=sentence):
        group = open_fleet(folder)["growing_damage"]
    assert group.equals(open_fleet(folder)["growing_damage"])
    return group


def test_a_store_of_an_earlier_version_is_read_with_one_sentence(former_group, present_group):
    """It has no rewards."""
    assert former_group.equals(present_group.drop_nodes("earned"))
    present_figures = group_statistics(present_group)
    former_figures = group_statistics(former_group)
    assert former_figures == {key: present_figures[key] for key in former_figures}
    assert set(present_figures) - set(former_figures) == set(earned_statistics(present_group))


def test_variables_of_a_store_of_an_earlier_version_have_their_present_attributes(
    former_group, present_group
):
    known_groups = present_group.drop_nodes("earned")
    for node in known_groups.subtree:
        former = former_group[node.relative_to(known_groups)]
        for name, variable in node.variables.items():
            assert former[name].attrs == variable.attrs, name


@pytest.mark.parametrize("path", ["filtered/mean", "filtered/standard_deviation", "truth/state"])
def test_a_region_of_a_fleet_is_chosen_by_its_label(whole, present_group, path):
    first_region = open_fleet(whole).sel(region="z1")["growing_damage"][path]
    assert first_region.dims == ("twin", "step")
    assert np.array_equal(first_region, present_group[path].values[..., 0])


def test_twins_steps_and_sensors_of_a_fleet_are_chosen_by_their_labels(present_group):
    observed = present_group.sel(twin="seed-3", step=5)["observed"]
    second_region = present_group["filtered"].sel(region="z2")
    assert observed.sel(sensor=12)["strain"].shape == ()
    assert second_region["mean"].equals(present_group["filtered/mean"].sel(region="z2"))


def test_states_of_a_belief_have_the_levels_of_their_regions(present_group):
    levels = present_group["filtered/last_probability"].coords
    assert levels["z1"].dims == levels["z2"].dims == ("state",)


def test_a_run_is_chosen_from_by_the_labels_of_a_fleet(single_run, whole):
    for tree in (single_run, open_fleet(whole)):
        assert tree.sel(region="z1").sizes.get("region") is None
    for name in ("filtered", "smoothed", "predicted", "truth"):
        assert "region" not in single_run[name].sel(region="z1").dims


@pytest.fixture(scope="module")
def single_run(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> xr.DataTree:
    """The store of a run with a seed of the fleet."""
    options = Overrides(strain_library=library_file, seed=7)
    folder = tmp_path_factory.mktemp("single") / "one"
    return open_run(new_run("growing_damage", folder, options, report=False).folder)


PATHS = pytest.mark.parametrize(
    "path", ["observed/strain", "observed/control_index", "filtered/mean", "truth/state"]
)


@PATHS
def test_a_twin_of_an_ensemble_flies_what_a_run_flies(present_group, single_run, path):
    row = present_group["seed"].values.tolist().index(int(single_run.attrs["seed"]))
    of_fleet, of_run = present_group[path], single_run[path]
    assert np.array_equal(of_fleet.values[row], of_run.values.astype(of_fleet.dtype))


@PATHS
def test_a_variable_of_a_fleet_is_described_as_that_of_a_run(present_group, single_run, path):
    of_fleet, of_run = present_group[path], single_run[path]
    assert of_fleet.dims == ("twin", *of_run.dims)
    assert of_fleet.attrs == of_run.attrs
    for name, coordinate in of_run.coords.items():
        assert np.array_equal(of_fleet.coords[name], coordinate), name


def test_figures_of_a_fleet_are_those_of_its_store(present_group):
    figures = group_statistics(present_group)
    outcomes = Outcomes.from_store(present_group)
    assert figures["log evidence of a step"] == outcomes.log_evidence
    assert figures["filtered rms error of z2"] == replace(outcomes.rms[1], unit="1")
    assert figures["bias of z2"] == replace(outcomes.bias[1], unit="1")


def test_shards_and_workers_change_nothing(library_file, whole, tmp_path):
    cut = fly_fleet(growing(library_file, shard=3), tmp_path / "cut", Engine(2))
    assert cut.shards_flown == 4
    first, second = (open_fleet(folder)["growing_damage"] for folder in (whole, cut.folder))
    xr.testing.assert_equal(first, second)
    assert (first["status"].values == 1).all()
    assert len(np.unique(first["truth/state"].values[:, -1], axis=0)) > 1


def kill_after_second_chunk(monkeypatch: pytest.MonkeyPatch, fleet: Fleet, folder: Path) -> None:
    """Fly a fleet that dies when its second chunk is written, and its journal does not know yet."""
    append = JournalFile.append

    def dying(self: JournalFile, record: Any, parts: Any = None) -> None:
        if record.get("rows") == [4, 8]:
            raise KeyboardInterrupt
        append(self, record, parts)

    with monkeypatch.context() as patch:
        patch.setattr(JournalFile, "append", dying)
        with pytest.raises(KeyboardInterrupt):
            fly_fleet(fleet, folder)


def files_of(folder: Path) -> list[Path]:
    """Return the names of all files of a folder, relative to it."""
    return sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())


def test_a_killed_fleet_keeps_what_it_has_flown(library_file, tmp_path, monkeypatch):
    kill_after_second_chunk(monkeypatch, growing(library_file), tmp_path / "cut")
    status = open_fleet(tmp_path / "cut")["growing_damage"]["status"].values
    assert status.tolist() == [1] * 8 + [0] * 2


def test_a_fleet_goes_on_where_it_was_killed(library_file, whole, tmp_path, monkeypatch):
    """The journal has times and is no result."""
    fleet, cut = growing(library_file), tmp_path / "cut"
    kill_after_second_chunk(monkeypatch, fleet, cut)
    with (cut / "journal.jsonl").open("a") as file:
        file.write(64 * "0" + ' {"shard": 2, "fail')  # a line that the kill cut off
    first = fly_fleet(fleet, cut)
    second = fly_fleet(fleet, cut)
    assert (first.shards_kept, first.shards_flown, second.shards_flown) == (1, 2, 0)
    files = files_of(cut)
    results = [str(path) for path in files if path.parts[0] in ("fleet.zarr", "groups", "fleet.json")]
    assert files == files_of(whole)
    assert len(results) > 10
    check_same(cut, whole, *results)


@pytest.fixture(scope="module")
def small_fleet(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Fleet, Path]:
    """A flown fleet of two twins and its folder, which no test changes."""
    fleet = growing(library_file, count=2)
    folder = tmp_path_factory.mktemp("small") / "fleet"
    assert fly_fleet(fleet, folder).shards_flown == 1
    return fleet, folder


@pytest.fixture
def folder_of_another_kind(tmp_path: Path) -> Path:
    """A folder with a file of the user's."""
    folder = tmp_path / "other"
    folder.mkdir()
    (folder / "thesis.txt").touch()
    return folder


def test_a_cluster_that_does_not_answer_is_named(library_file, tmp_path, monkeypatch):
    monkeypatch.setattr("twin_master.fleet.engine.CONNECTING", 0.2)
    engine = Engine(cluster="tcp://127.0.0.1:9")
    with pytest.raises(FleetError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        fly_fleet(growing(library_file, count=2), tmp_path / "fleet", engine)


def test_another_fleet_is_flown_into_a_folder_on_demand_only(small_fleet, library_file, tmp_path):
    folder = shutil.copytree(small_fleet[1], tmp_path / "fleet")
    other = growing(library_file, count=3)
    with pytest.raises(RunFolderError, match="another fleet"):
        fly_fleet(other, folder)
    assert fly_fleet(other, folder, replace_old=True).twins == 3


def test_a_fleet_of_other_versions_does_not_go_on(small_fleet, tmp_path):
    fleet, flown_folder = small_fleet
    folder = shutil.copytree(flown_folder, tmp_path / "fleet")
    record = json.loads((folder / "config.json").read_text())
    record["provenance"]["versions"]["numpy"] = "0.1"
    written(folder, json.dumps(record), name="config.json")
    with pytest.raises(NotResumableError, match="numpy"):
        fly_fleet(fleet, folder)


def test_a_fleet_that_is_not_there_is_named(tmp_path):
    with pytest.raises(RunFolderError, match="there is no folder"):
        open_fleet(tmp_path / "nowhere")


@pytest.mark.parametrize("reader", [open_fleet, learn_fleet, write_fleet_report])
def test_a_folder_of_another_kind_is_refused(folder_of_another_kind, reader):
    with pytest.raises(RunFolderError, match="not the folder of a fleet"):
        reader(folder_of_another_kind)


def test_a_folder_of_another_kind_is_not_replaced(folder_of_another_kind, library_file):
    with pytest.raises(RunFolderError, match="left unchanged"):
        fly_fleet(growing(library_file, count=2), folder_of_another_kind, replace_old=True)


@pytest.mark.parametrize(
    ("package", "workers", "sentence"),
    [
        ("distributed", 2, r"needs distributed: pip install 'uav-twin\[fleet\]'\.$"),
        ("zarr", 0, "needs zarr: pip install"),
    ],
)
def test_a_fleet_without_a_package_that_it_needs_is_not_begun(
    library_file, tmp_path, monkeypatch, package, workers, sentence
):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(FleetError, match=sentence):
        fly_fleet(growing(library_file, count=2), tmp_path / "none", Engine(workers))
    assert not (tmp_path / "none").exists()


INPUTS = Inputs(__file__)
FLEET = INPUTS.text("fleet.toml")


@pytest.fixture
def fleet_file(tmp_path: Path) -> Path:
    written(tmp_path, text_of("growing_damage"), name="north.toml")
    return written(tmp_path, FLEET, name="fleet.toml")


def changed(file: Path, *changes: tuple[str, str], seed: int | None = None) -> Fleet:
    return load_fleet(written(file.parent, FLEET, *changes, name=file.name), seed=seed)


def seeds_of(fleet: Fleet) -> list[int]:
    return [member.seed for group in fleet.groups for member in group.members]


def test_a_twin_has_a_seed_of_its_own_whatever_else_flies(fleet_file):
    fleet = load_fleet(fleet_file)
    fewer = changed(fleet_file, ("count = 3", "count = 1"))
    seeds = seeds_of(fleet)
    assert len(set(seeds)) == 5
    assert seeds_of(fewer) == [seeds[0], *seeds[3:]]
    assert seeds_of(changed(fleet_file, seed=6))[0] != seeds[0]


def test_a_twin_has_its_parameters_whatever_else_flies(fleet_file):
    south = load_fleet(fleet_file).groups[1]
    south_beside_fewer = changed(fleet_file, ("count = 3", "count = 1")).groups[1]
    parameters = [member.parameters for member in south.members]
    assert [member.parameters for member in south_beside_fewer.members] == parameters


def test_a_group_has_the_mission_of_its_table(fleet_file):
    north, south = load_fleet(fleet_file).groups
    assert south.scenarios[0].mission.steps == 9
    assert north.scenarios[0].mission.seed == 5


def test_true_rates_of_a_group_may_differ_from_those_believed(fleet_file):
    sound = ("steps = 9", 'true_probability = { "2g" = 0.0, "3g" = 0.0 }')
    as_believed = load_fleet(fleet_file).groups[1].scenarios[0]
    scenario = changed(fleet_file, sound).groups[1].scenarios[0]
    assert scenario.truth.probability == {"2g": 0.0, "3g": 0.0}
    assert scenario.transition.probability == {"2g": 0.05, "3g": 0.1}
    assert as_believed.truth.probability == {}


@pytest.mark.parametrize(("old", "new", "sentence"), INPUTS.refused("fleet"))
def test_a_wrong_fleet_file_is_refused(fleet_file, old, new, sentence):
    with pytest.raises(FleetError, match=sentence):
        changed(fleet_file, (old, new))


def test_all_assets_that_cannot_fly_are_in_one_list(fleet_file):
    for name in ("a", "b"):
        (fleet_file.parent / f"{name}.fmu").write_bytes(b"no FMU")
    out = fleet_file.parent / "out"
    fleet = changed(fleet_file, ("count = 3", 'fmus = "*.fmu"'), ("young_modulus_factor", "colour"))
    with pytest.raises(FleetError) as caught:
        fly_fleet(fleet, out)
    head, *lines = str(caught.value).splitlines()
    assert head.startswith("3 of the assets cannot fly")
    assert [line.split(":")[0] for line in lines] == ["north a", "north b", "south"]
    assert not out.exists()


def test_a_true_parameter_beyond_the_model_is_refused(fleet_file):
    soft = changed(fleet_file, ("mean = 1.0,", "mean = 1.3,"))
    sentence = r"south: the true young_modulus_factor of 2 of 2 assets lies outside"
    with pytest.raises(FleetError, match=sentence):
        fly_fleet(soft, fleet_file.parent / "out")
    assert not (fleet_file.parent / "out").exists()


def test_a_true_state_beyond_the_model_is_refused(fleet_file):
    gain = '[[truth.gains]]\nstate = "z1"\nfirst_step = 0\nlast_step = 49\ngain_percent = 5\n\n[truth.noise]'
    north = edited(text_of("growing_damage"), ('kind = "random_growth"', 'kind = "scripted"'))
    written(fleet_file.parent, north, ("[truth.noise]", gain), name="north.toml")
    sentence = r"north: the z1 that .* in step \d+ is .* gives z1 the range 0 to 0.8"
    with pytest.raises(FleetError, match=sentence):
        fly_fleet(changed(fleet_file), fleet_file.parent / "out")
    assert not (fleet_file.parent / "out").exists()


def test_one_calibration_that_fails_costs_its_own_asset(fleet_file, monkeypatch):
    for name in ("a", "b"):
        (fleet_file.parent / f"{name}.fmu").write_bytes(b"for its name alone")

    def preparing(scenario: Any, folder: Path, *args: Any, **given: Any) -> bytes:
        if folder.name == "0":
            raise PosteriorError("no posterior.")
        return b"kit"

    monkeypatch.setattr(flight, "prepare_kit", preparing)
    monkeypatch.setattr(flight, "check_fleet", lambda _fleet: None)
    monkeypatch.setattr(
        "twin_master.fleet.engine.fly_shard",
        lambda _kit, members: result_of_unflown(members[0], "it was flown"),
    )
    south = FLEET[FLEET.index('[[group]]\nname = "south"') :]
    fleet = changed(fleet_file, (south, ""), ("count = 3", 'fmus = "*.fmu"'))
    outcome = fly_fleet(fleet, fleet_file.parent / "out", Engine(0))
    failures = {"north/a": "no posterior.", "north/b": "it was flown"}
    assert outcome.failures == failures
    (outcome.folder / "journal.jsonl").unlink()
    assert flight.endings_of(outcome.folder) == (failures, {})


@pytest.fixture(scope="module")
def late_fallbacks() -> tuple[Knowledge, Flights]:
    """Five flights of seven steps, after which the asset ends; damage in late steps calls for a fallback."""
    knowledge = prepare_twin("growing_damage")
    flights = Flights.empty(knowledge, 5)
    flights.state[:] = 0.0
    flights.control_index[:, :7] = 1
    called_and_left = [(1, 9), (4, 9), (5, 9), (5, 6), (9, 9)]
    for twin, (step_of_call, step_of_fallback) in enumerate(called_and_left):
        flights.state[twin, step_of_call:, 0] = 0.8
        flights.control_index[twin, step_of_fallback:7] = 0
    return knowledge, flights


def test_a_fallback_that_was_called_for_in_the_last_steps_is_no_failure(late_fallbacks):
    knowledge, flights = late_fallbacks
    delay, early = fallbacks_of(knowledge, flights)
    np.testing.assert_array_equal(delay, [np.inf, np.inf, np.nan, 1.0, np.nan])
    assert (early == 0).all()


def test_a_policy_by_which_no_state_alone_calls_for_a_fallback_has_no_delays(late_fallbacks):
    knowledge, flights = late_fallbacks
    loss_of_both = knowledge.model.states.coordinates.sum(axis=1)
    policy = np.eye(2)[(loss_of_both < 0.5).astype(int)]
    delay, early = fallbacks_of(replace(knowledge, policy=policy), flights)
    assert np.isnan(delay).all()
    assert (early == -1).all()


@pytest.fixture(scope="module")
def flown_by_command(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Any]:
    """The folders of two fleets that the command flew, and what it said of the first as data."""
    folder = tmp_path_factory.mktemp("command")
    words = ("run", "growing_damage", "--strain-library", library_file, "--workers", 0, "--json")
    record = json.loads(said(*words, "--seeds", "0:3", "--out", folder / "a"))
    said(*words, "--seeds", "3:5", "--out", folder / "b")
    return folder / "a", folder / "b", record


def test_the_command_flies_a_fleet_of_seeds(flown_by_command):
    _, _, record = flown_by_command
    assert (record["twins"], record["failed"]) == (3, 0)


def test_the_command_compares_fleets(flown_by_command):
    first, second, _ = flown_by_command
    compared = json.loads(said("compare", first, second, "--json"))
    assert [group["twins"] for group in compared.values()] == [3, 2]


@pytest.fixture(scope="module")
def compared_policies(flown_by_command, library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """What is said of three seeds under the paper's policy and, a copy apart, under one by risk."""
    first, _, _ = flown_by_command
    folder = tmp_path_factory.mktemp("risk")
    text = text_of("growing_damage", ("[planner]", '[planner]\npolicy = "risk"\nrisk = 0.05\nhold = 2'))
    words = ("run", written(folder, text), "--strain-library", library_file, "--workers", 0, "--seeds", "0:3")
    said(*words, "--out", folder / "risk", "--no-report")
    picture = folder / "returns.svg"
    record = json.loads(said("compare", first, folder / "risk", "--picture", picture, "--json"))
    return first, folder / "risk", record, picture


def test_policies_are_compared_by_name(compared_policies):
    assert [group["policy"] for group in compared_policies[2].values()] == ["mode", "risk 0.05, hold 2"]


def test_returns_are_compared_seed_by_seed(compared_policies):
    first, second, record, _ = compared_policies
    (one,), (other,) = (open_fleet(folder).children.values() for folder in (first, second))
    difference = (other["earned/return"] - one["earned/return"].values).values
    compared = record[str(second)][f"return beyond {first}"]
    assert compared["value"] == pytest.approx(difference.mean())
    assert compared["error"] == pytest.approx(difference.std(ddof=1) / np.sqrt(3))


def test_the_shares_of_all_controls_are_one(compared_policies):
    for figures in compared_policies[2].values():
        assert figures["steps with 2g"]["value"] + figures["steps with 3g"]["value"] == pytest.approx(1.0)


def test_what_was_promised_stands_beside_what_was_flown(compared_policies):
    for figures in compared_policies[2].values():
        keys = list(figures)
        assert keys.index("return promised") - keys.index("return") in (1, 2)


def test_the_returns_are_drawn(compared_policies):
    assert b"<svg" in compared_policies[3].read_bytes()


def test_a_run_and_a_fleet_store_the_same_rewards(flown_by_command, library_file, tmp_path):
    (group,) = open_fleet(flown_by_command[0]).children.values()
    new_run("growing_damage", tmp_path / "run", {"seed": 2, "strain_library": library_file}, report=False)
    earned = open_run(tmp_path / "run")["earned"]
    for name in ("reward", "health", "beyond_limit", "needless"):
        assert group[f"earned/{name}"][2].values == pytest.approx(earned[name].values, rel=1e-6), name
    assert float(group["earned/return"][2]) == pytest.approx(float(earned["return"]), rel=1e-12)


def test_a_store_that_lacks_a_variable_is_refused(flown_by_command, tmp_path):
    first, second, _ = flown_by_command
    damaged = shutil.copytree(second, tmp_path / "b")
    (counts,) = (damaged / "fleet.zarr").glob("*/notice/count")
    shutil.rmtree(counts)
    assert "lacks notice/count: fly the fleet again" in refused("compare", first, damaged)


def test_all_processors_fly_unless_the_user_says_how_many():
    cores = len(os.sched_getaffinity(0))
    assert [choose_engine(workers, None).workers for workers in (None, 0, 3)] == [cores, 0, 3]
    assert choose_engine(None, "tcp://127.0.0.1:9") == Engine(cluster="tcp://127.0.0.1:9")


def known(name: str, library_file: Path, decide_on: str = "filtered") -> tuple[Knowledge, StatelessAsset]:
    scenario = load_scenario(name).scenario
    planner = scenario.planner.model_copy(update={"decide_on": decide_on, "policy": "mode"})
    mission = scenario.mission.model_copy(update={"steps": 35})
    knowledge, source = of_library(name, library_file, planner=planner, mission=mission, notice=None)
    asset = source.open()
    assert isinstance(asset, StatelessAsset)
    return knowledge, asset


def same(first: Flights, second: Flights) -> bool:
    names = ("observation_rows", "control_index", "state", "filtered", "log_evidence")
    has_same_endings = (first.failure, first.ended) == (second.failure, second.ended)
    return has_same_endings and all(
        np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True) for name in names
    )


@dataclass
class Side:
    """Flights of one knowledge and asset side by side, under the truths of some seeds."""

    knowledge: Knowledge
    asset: StatelessAsset
    truths: list[Any]
    together: Flights


def flown_side_by_side(knowledge: Knowledge, asset: StatelessAsset, seeds: int = 5) -> Side:
    truths = [knowledge.truth(seed) for seed in range(seeds)]
    together = fly_side_by_side(knowledge, truths, [asset] * seeds)
    return Side(knowledge, asset, truths, together)


def check_flown_alone(side: Side) -> None:
    """Check flights side by side against flights one by one, and one against a mission."""
    knowledge, asset, truths = side.knowledge, side.asset, side.truths
    mission = fly(knowledge.scenario, knowledge.twin(), knowledge.plant(truths[4], asset))
    assert same(side.together, fly_one_by_one(knowledge, truths, lambda *_: asset))
    assert np.array_equal(mission.control_index, side.together.control_index[4])


@pytest.mark.parametrize(("name", "decide_on"), [("level_turns", "filtered"), ("failing_gauges", "filtered")])
def test_each_twin_flies_what_it_flies_alone(name, decide_on, library_file):
    knowledge, asset = known(name, library_file, decide_on)
    assert knowledge.model.transition.is_product is False
    check_flown_alone(flown_side_by_side(knowledge, asset))


def test_each_twin_with_growing_damage_flies_what_it_flies_alone(library_file):
    knowledge, asset = known("growing_damage", library_file, "predicted")
    side = flown_side_by_side(knowledge, asset)
    assert knowledge.model.transition.is_product is False
    assert len(np.unique(side.together.state[:, -1], axis=0)) > 1
    check_flown_alone(side)


def test_each_twin_with_a_transition_of_each_region_flies_what_it_flies_alone(library_file, monkeypatch):
    monkeypatch.setattr("twin_master.network.transition.MAX_JOINT_NON_ZEROS", 0)
    knowledge, asset = known("growing_damage", library_file)
    side = flown_side_by_side(knowledge, asset)
    assert knowledge.model.transition.is_product is True
    assert len(np.unique(side.together.state[:, -1], axis=0)) > 1
    check_flown_alone(side)


@pytest.fixture(scope="module")
def inspected(library_file: Path) -> Side:
    knowledge, asset = known("inspected_wing", library_file, "predicted")
    return flown_side_by_side(knowledge, asset)


def test_each_inspected_twin_flies_what_it_flies_alone(inspected):
    assert inspected.knowledge.model.transition.is_product is False
    check_flown_alone(inspected)


@pytest.mark.parametrize("keys", [{"hold": 3}, {"policy": "risk", "risk": 0.1, "hold": 2}])
def test_each_twin_with_a_safer_policy_flies_what_it_flies_alone(library_file, keys):
    knowledge, asset = known("growing_damage", library_file)
    safer = replace(knowledge, scenario=knowledge.scenario.with_changes("planner", **keys))
    side = flown_side_by_side(safer, asset)
    check_flown_alone(side)


def test_a_region_is_sound_behind_its_repair(inspected):
    repair = inspected.knowledge.scenario.control_names.index("repair_1")
    is_repaired = inspected.together.control_index[:, :-1] == repair
    is_sound_in_next_step = inspected.together.state[:, 1:, 0] == 0.0
    assert is_repaired.any()
    assert is_sound_in_next_step[is_repaired].all()


class Remembering:
    """An asset that is none of `StatelessAsset`, so that it is driven by a plant of its own."""

    def __init__(self, asset: StatelessAsset) -> None:
        self.step = asset.step
        self.units = dict[str, str]()

    def save_state(self) -> bytes:
        return b""

    def restore_state(self, _state: bytes) -> None:
        pass

    def close(self) -> None:
        pass


def until_soft(asset: StatelessAsset, error: Exception) -> StatelessAsset:
    """An asset that raises an error, or shows what is impossible, once its first region has lost 40 %."""

    def step(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        soft = health["z1"] >= 0.4
        if soft and not isinstance(error, ImpossibleObservation):
            raise error
        return AssetReading(asset.step(control, health).values * (1e200 if soft else 1.0))

    return StatelessAsset(step)


class Softening:
    """Flights of six assets, each of which fails or ends once its first region has lost 40 %."""

    def __init__(self, library: Path, drive: Any, error: Exception) -> None:
        self.knowledge, asset = known("growing_damage", library)
        truths = [self.knowledge.truth(seed) for seed in range(6)]
        soft = until_soft(asset, error)
        self.ends = isinstance(error, FmuEndedError)
        self.whole = fly_side_by_side(self.knowledge, truths, [asset] * 6)
        self.whole_driven = fly_side_by_side(self.knowledge, truths, [drive(asset) for _ in truths])
        with np.errstate(over="ignore"):
            self.flights = fly_side_by_side(self.knowledge, truths, [drive(soft) for _ in truths])
            self.one_by_one = fly_one_by_one(self.knowledge, truths, lambda *_: drive(soft))
        is_soft = self.whole.state[:, :, 0] >= 0.4 - 1e-9
        self.steps = np.where(is_soft.any(axis=1), is_soft.argmax(axis=1), 35)


@pytest.fixture(
    scope="module",
    params=[
        (lambda asset: asset, MissionInputError("too soft")),
        (lambda asset: asset, ImpossibleObservation("growing_damage", 0, {})),
        (Remembering, MissionInputError("too soft")),
        (Remembering, FmuEndedError("It is over.", time=1.0)),
    ],
    ids=["fails", "shows what is impossible", "fails with a state of its own", "ends"],
)
def softening(request: pytest.FixtureRequest, library_file: Path) -> Softening:
    return Softening(library_file, *request.param)


def test_assets_that_fail_or_end_fly_side_by_side_what_they_fly_one_by_one(softening):
    assert same(softening.whole, softening.whole_driven)
    assert same(softening.flights, softening.one_by_one)


def test_an_asset_that_fails_or_ends_says_after_how_many_steps(softening):
    flights, ends = softening.flights, softening.ends
    is_short = softening.steps < 35
    sentences = [
        f"The asset ended the mission after {steps} of 35 steps: It is over." if ends and steps < 35 else ""
        for steps in softening.steps
    ]
    assert 0 < np.sum(is_short) < 6
    assert flights.ended == sentences
    assert [text != "" for text in flights.failure] == [bool(short) and not ends for short in is_short]


def test_an_asset_that_fails_or_ends_keeps_what_it_has_flown_and_does_not_touch_the_others(softening):
    flights, whole = softening.flights, softening.whole
    for twin, steps in enumerate(softening.steps):
        assert np.array_equal(flights.filtered[twin, :steps], whole.filtered[twin, :steps])
        assert np.isnan(flights.filtered[twin, steps:]).all()
        assert (flights.control_index[twin, steps:] == -1).all()


def test_the_store_has_the_standard_deviation_of_a_belief_that_is_almost_certain(library_file):
    knowledge, _ = known("growing_damage", library_file)
    flights = Flights.empty(knowledge, 1)
    flights.control_index[:] = 0
    flights.filtered[:] = 0.0
    flights.filtered[..., -2:] = 1e-14, 1.0 - 1e-14  # the last two states differ in z2 by 0.2

    stored = stored_variables(knowledge, flights, [Member(0, "", 0, {})])

    assert stored["filtered/standard_deviation"][0, :, 1] == pytest.approx(0.2 * np.sqrt(1e-14), rel=1e-6)


def test_the_store_has_the_last_belief_of_an_asset_that_ended(softening):
    knowledge, flights = softening.knowledge, softening.flights
    members = [Member(row, "", row, {}) for row in range(6)]
    stored = stored_variables(knowledge, flights, members)
    for row, steps in enumerate(softening.steps):
        if not softening.ends and steps < 35:
            continue  # it failed, and has no result
        belief, states = flights.filtered[row, :steps], flights.state[row, :steps]
        coverage = in_credible_set(knowledge.model, belief, states).mean()
        last_belief = stored["filtered/last_probability"][row]
        assert stored["status"][row] == (ENDED if flights.ended[row] else FLOWN)
        np.testing.assert_array_equal(last_belief, belief[-1].astype("f4"))
        assert stored["credible"][row] == np.float32(coverage)


def test_damage_grows_as_the_model_says(library_file):
    model = known("growing_damage", library_file)[0].model
    growth, uniform = DamageGrowth(model), (np.arange(2000) + 0.5) / 2000
    for control in (0, 1):
        row = model.transition.row(control, 6)
        found = growth.next_states(np.full(len(uniform), control), np.full(len(uniform), 6), uniform)
        np.testing.assert_allclose(np.bincount(found, minlength=25) / 2000, row, atol=1.5 / 2000)
