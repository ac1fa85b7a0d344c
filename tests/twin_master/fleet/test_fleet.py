"""Fleets: plan, shards, store, what goes on after a kill; twins side by side fly what each flies alone."""

import json
import os
import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from calibration.errors import PosteriorError
from fmu_asset.errors import FmuEndedError
from reporting.former_names import FormerNameWarning
from tests.command_line import refused, said
from tests.refusals import Inputs
from tests.twin_master.runs import check_same, edited, of_library, text_of, written
from twin_master.assets.asset_source import AssetReading, StatelessAsset
from twin_master.assets.resolution import Overrides
from twin_master.errors import (
    FleetError,
    ImpossibleObservation,
    MissionInputError,
    NotResumableError,
    RunFolderError,
)
from twin_master.fleet import flight
from twin_master.fleet.engine import Engine
from twin_master.fleet.learn import learn_fleet
from twin_master.fleet.plan import Fleet, Member, ensemble, load_fleet
from twin_master.fleet.reading import Outcomes, group_figures
from twin_master.fleet.report import write_fleet_report
from twin_master.fleet.shard import result_of_unflown
from twin_master.fleet.store import ENDED, FLOWN, STORE_NAME, fallbacks_of, in_credible_set, stored_variables
from twin_master.fleet.store_layout import FORMER_DIMENSIONS, FORMER_PATHS
from twin_master.fleet_command import choose_engine
from twin_master.mission.journal import JournalFile
from twin_master.mission.loop import fly
from twin_master.mission.preparation import Knowledge
from twin_master.mission.side_by_side import Flights, fly_one_by_one, fly_side_by_side
from twin_master.mission.steps import DamageGrowth
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


def test_a_store_of_an_earlier_version_is_read_with_one_sentence(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "former")
    write_former_store(whole, folder)
    said = r"fleet\.zarr: `turn` is now called `step`, `factor` is now called `region`"
    with pytest.warns(FormerNameWarning, match=said):
        group = open_fleet(folder)["growing_damage"]
    assert group.equals(open_fleet(folder)["growing_damage"])  # a second warning were an error
    present = open_fleet(whole)["growing_damage"]
    assert group.equals(present)
    for node in present.subtree:
        for name, variable in node.variables.items():
            assert group[node.relative_to(present)][name].attrs == variable.attrs, name
    assert group_figures(group) == group_figures(present)


def test_a_fleet_is_chosen_from_by_the_labels_of_a_run(library_file, whole, tmp_path):
    fleet = open_fleet(whole)
    first_region = fleet.sel(region="z1")["growing_damage"]
    group = fleet["growing_damage"]
    for path in ("filtered/mean", "filtered/standard_deviation", "truth/state"):
        assert first_region[path].dims == ("twin", "step")
        assert np.array_equal(first_region[path], group[path].values[..., 0])
    assert group.sel(twin="seed-3", step=5)["observed"].sel(sensor=12)["strain"].shape == ()
    assert group["filtered"].sel(region="z2")["mean"].equals(group["filtered/mean"].sel(region="z2"))
    last_belief = group["filtered/last_probability"]
    assert last_belief.coords["z1"].dims == last_belief.coords["z2"].dims == ("state",)
    run = open_run(new_run("growing_damage", tmp_path / "one", {"strain_library": library_file}).folder)
    for tree in (run, fleet):  # the whole, and each group that has regions
        assert tree.sel(region="z1").sizes.get("region") is None
    for name in ("filtered", "smoothed", "predicted", "truth"):
        assert "region" not in run[name].sel(region="z1").dims


def test_a_twin_of_an_ensemble_flies_what_a_run_flies(library_file, whole, tmp_path):
    given = Overrides(strain_library=library_file, seed=7)
    group = open_fleet(str(whole))["growing_damage"]
    tree = open_run(new_run("growing_damage", tmp_path / "one", given, report=False).folder)
    row = group["seed"].values.tolist().index(int(tree.attrs["seed"]))
    for path in ("observed/strain", "observed/control_index", "filtered/mean", "truth/state"):
        ours, single = group[path], tree[path]
        assert np.array_equal(ours.values[row], single.values.astype(ours.dtype)), path
        assert ours.dims == ("twin", *single.dims)
        assert ours.attrs["units"] == single.attrs["units"]
        for name, coordinate in single.coords.items():
            assert np.array_equal(ours.coords[name], coordinate), name
    figures, study = group_figures(group), Outcomes.from_store(group)
    names = "log evidence of a step", "filtered rms error of z2", "bias of z2"
    assert [figures[name] for name in names] == [study.log_evidence, study.rms[1], study.bias[1]]


def test_shards_and_workers_change_nothing(library_file, whole, tmp_path):
    cut = fly_fleet(growing(library_file, shard=3), tmp_path / "cut", Engine(2))
    assert cut.shards_flown == 4
    first, second = (open_fleet(folder)["growing_damage"] for folder in (whole, cut.folder))
    xr.testing.assert_equal(first, second)
    assert (first["status"].values == 1).all()
    assert len(np.unique(first["truth/state"].values[:, -1], axis=0)) > 1


def test_a_fleet_goes_on_where_it_was_killed(library_file, whole, tmp_path, monkeypatch):
    fleet, cut, append = growing(library_file), tmp_path / "cut", JournalFile.append

    def dying(self: JournalFile, record: Any) -> None:
        if record.get("rows") == [4, 8]:  # its chunk is written, and the journal does not know
            raise KeyboardInterrupt
        append(self, record)

    with monkeypatch.context() as patch:
        patch.setattr(JournalFile, "append", dying)
        with pytest.raises(KeyboardInterrupt):
            fly_fleet(fleet, cut)
    assert open_fleet(cut)["growing_damage"]["status"].values.tolist() == [1] * 8 + [0] * 2
    with (cut / "journal.jsonl").open("a") as file:
        file.write(64 * "0" + ' {"shard": 2, "fail')  # a line that the kill cut off
    outcome = fly_fleet(fleet, cut)
    assert (outcome.shards_kept, outcome.shards_flown) == (1, 2)
    kept = [  # the journal keeps times and is not a result
        sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
        for folder in (cut, whole)
    ]
    assert kept[0] == kept[1]
    results = [str(path) for path in kept[0] if path.parts[0] in ("fleet.zarr", "groups", "fleet.json")]
    assert len(results) > 10
    check_same(cut, whole, *results)
    assert fly_fleet(fleet, cut).shards_flown == 0


def test_a_folder_keeps_what_it_holds_and_nothing_is_begun_that_cannot_be_flown(
    library_file, tmp_path, monkeypatch
):
    fleet, other, folder = growing(library_file, count=2), growing(library_file, count=3), tmp_path / "fleet"
    monkeypatch.setattr("twin_master.fleet.engine.CONNECTING", 0.2)
    with pytest.raises(FleetError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        fly_fleet(fleet, folder, Engine(cluster="tcp://127.0.0.1:9"))
    assert fly_fleet(fleet, folder).shards_flown == 1
    with pytest.raises(RunFolderError, match="another fleet"):
        fly_fleet(other, folder)
    record = json.loads((folder / "config.json").read_text())
    record["provenance"]["versions"]["numpy"] = "0.1"
    written(folder, json.dumps(record), name="config.json")
    with pytest.raises(NotResumableError, match="numpy"):
        fly_fleet(fleet, folder)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").touch()
    with pytest.raises(RunFolderError, match="there is no folder"):
        open_fleet(tmp_path / "nowhere")
    for opened in (open_fleet, learn_fleet, write_fleet_report):
        with pytest.raises(RunFolderError, match="not the folder of a fleet"):
            opened(tmp_path / "other")
    with pytest.raises(RunFolderError, match="left unchanged"):
        fly_fleet(fleet, tmp_path / "other", replace_old=True)
    assert fly_fleet(other, folder, replace_old=True).twins == 3
    for lacking, sentence in (
        ("distributed", r"needs distributed: pip install 'uav-twin\[fleet\]'\.$"),
        ("zarr", "needs zarr: pip install"),
    ):
        monkeypatch.setitem(sys.modules, lacking, None)
        with pytest.raises(FleetError, match=sentence):
            fly_fleet(fleet, tmp_path / "none", Engine(2 if lacking == "distributed" else 0))
    assert not (tmp_path / "none").exists()


INPUTS = Inputs(__file__)
FLEET = INPUTS.text("fleet.toml")


@pytest.fixture
def fleet_file(tmp_path: Path) -> Path:
    written(tmp_path, text_of("growing_damage"), name="north.toml")
    return written(tmp_path, FLEET, name="fleet.toml")


def changed(file: Path, *changes: tuple[str, str], seed: int | None = None) -> Fleet:
    return load_fleet(written(file.parent, FLEET, *changes, name=file.name), seed=seed)


def test_a_twin_has_a_seed_of_its_own_whatever_else_flies(fleet_file):
    fleet, fewer = load_fleet(fleet_file), changed(fleet_file, ("count = 3", "count = 1"))
    seeds, left = (
        [member.seed for group in one.groups for member in group.members] for one in (fleet, fewer)
    )
    assert len(set(seeds)) == 5
    assert left == [seeds[0], *seeds[3:]]
    assert [m.parameters for m in fewer.groups[1].members] == [m.parameters for m in fleet.groups[1].members]
    assert changed(fleet_file, seed=6).groups[0].members[0].seed != seeds[0]
    assert fleet.groups[1].scenarios[0].mission.steps == 9
    assert fleet.groups[0].scenarios[0].mission.seed == 5
    slow = ("steps = 9", 'true_probability = { "2g" = 0.0, "3g" = 0.0 }')
    scenario = changed(fleet_file, slow).groups[1].scenarios[0]  # true rates may differ from those believed
    assert scenario.truth.probability == {"2g": 0.0, "3g": 0.0}
    assert scenario.transition.probability == {"2g": 0.05, "3g": 0.1}
    assert fleet.groups[1].scenarios[0].truth.probability == {}


@pytest.mark.parametrize(("old", "new", "sentence"), INPUTS.refused("fleet"))
def test_a_wrong_fleet_file_is_refused(fleet_file, old, new, sentence):
    with pytest.raises(FleetError, match=sentence):
        changed(fleet_file, (old, new))


def test_all_assets_that_cannot_fly_are_in_one_list_and_a_truth_beyond_the_model_is_refused(fleet_file):
    for name in ("a", "b"):
        (fleet_file.parent / f"{name}.fmu").write_bytes(b"no FMU")
    fleet = changed(fleet_file, ("count = 3", 'fmus = "*.fmu"'), ("young_modulus_factor", "colour"))
    with pytest.raises(FleetError) as caught:
        fly_fleet(fleet, fleet_file.parent / "out")
    lines = str(caught.value).splitlines()
    assert lines[0].startswith("3 of the assets cannot fly")
    assert [line.split(":")[0] for line in lines[1:]] == ["north a", "north b", "south"]
    soft = r"south: the true young_modulus_factor of 2 of 2 assets is outside"
    with pytest.raises(FleetError, match=soft):
        fly_fleet(changed(fleet_file, ("mean = 1.0,", "mean = 1.3,")), fleet_file.parent / "out")
    loss = '[[truth.gains]]\nstate = "z1"\nfirst_step = 0\nlast_step = 49\ngain_percent = 5\n\n[truth.noise]'
    north = edited(text_of("growing_damage"), ('kind = "random_growth"', 'kind = "scripted"'))
    written(fleet_file.parent, north, ("[truth.noise]", loss), name="north.toml")
    with pytest.raises(
        FleetError, match=r"north: the z1 that .* in step \d+ is .* gives z1 the range 0 to 0.8"
    ):
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


def test_a_fallback_that_was_called_for_in_the_last_steps_is_no_failure():
    knowledge = prepare_twin("growing_damage")
    flights = Flights.empty(knowledge, 5)
    flights.state[:], flights.control_index[:, :7] = 0.0, 1  # seven steps, then the asset ends
    for twin, (called, left) in enumerate([(1, 9), (4, 9), (5, 9), (5, 6), (9, 9)]):
        flights.state[twin, called:, 0] = 0.8
        flights.control_index[twin, left:7] = 0
    delay, early = fallbacks_of(knowledge, flights)
    np.testing.assert_array_equal(delay, [np.inf, np.inf, np.nan, 1.0, np.nan])
    assert (early == 0).all()
    lost = knowledge.model.states.coordinates.sum(axis=1)
    both = replace(knowledge, policy=np.eye(2)[(lost < 0.5).astype(int)])
    delay, early = fallbacks_of(both, flights)  # by which no state alone calls for a fallback
    assert (np.isnan(delay) & (early == -1)).all()


def test_the_command_line(library_file, tmp_path):
    words = ("run", "growing_damage", "--strain-library", library_file, "--workers", 0, "--json", "--seeds")
    told = json.loads(said(*words, "0:3", "--out", tmp_path / "a"))
    assert (told["twins"], told["failed"]) == (3, 0)
    said(*words, "3:5", "--out", tmp_path / "b")
    compared = json.loads(said("compare", tmp_path / "a", tmp_path / "b", "--json"))
    assert [group["twins"] for group in compared.values()] == [3, 2]
    (counts,) = (tmp_path / "b" / "fleet.zarr").glob("*/notice/count")
    shutil.rmtree(counts)
    assert "lacks notice/count: fly the fleet again" in refused("compare", tmp_path / "a", tmp_path / "b")


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
    pairs = ((getattr(first, name), getattr(second, name)) for name in names)
    told = (first.failure, first.ended) == (second.failure, second.ended)
    return told and all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


@pytest.mark.parametrize(
    ("name", "decide_on", "product"),
    [
        ("level_turns", "filtered", False),
        ("growing_damage", "predicted", False),
        ("growing_damage", "filtered", True),  # of tables, one for each region
        ("failing_gauges", "filtered", False),
        ("inspected_wing", "predicted", False),
    ],
)
def test_each_twin_flies_what_it_flies_alone(name, decide_on, product, library_file, monkeypatch):
    if product:
        monkeypatch.setattr("twin_master.network.transition.JOINT_NON_ZEROS", 0)
    knowledge, asset = known(name, library_file, decide_on)
    assert knowledge.model.transition.is_product is product
    truths = [knowledge.truth(seed) for seed in range(5)]
    together = fly_side_by_side(knowledge, truths, [asset] * 5)
    assert same(together, fly_one_by_one(knowledge, truths, lambda *_: asset))
    alone = fly(knowledge.scenario, knowledge.twin(), knowledge.plant(truths[4], asset))
    assert np.array_equal(alone.control_index, together.control_index[4])
    assert len(np.unique(together.state[:, -1], axis=0)) > 1 or name != "growing_damage"
    if name == "inspected_wing":  # a region is sound behind its repair
        places = knowledge.scenario.control_names.index("repair_1"), together.control_index[:, :-1]
        assert (together.state[:, 1:, 0] == 0.0)[places[1] == places[0]].all()
        assert (places[1] == places[0]).any()


class Remembering:
    """An asset that is none of `StatelessAsset`, so that it is driven by a plant of its own."""

    def __init__(self, asset: StatelessAsset) -> None:
        self.step, self.units = asset.step, dict[str, str]()
        self.restore_state, self.close = (lambda _state: None), (lambda: None)

    def save_state(self) -> bytes:
        return b""


def until_soft(asset: StatelessAsset, error: Exception) -> StatelessAsset:
    """An asset that raises an error, or shows what is impossible, once its first region has lost 40 %."""

    def step(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        soft = health["z1"] >= 0.4
        if soft and not isinstance(error, ImpossibleObservation):
            raise error
        return AssetReading(asset.step(control, health).values * (1e200 if soft else 1.0))

    return StatelessAsset(step)


@pytest.mark.parametrize(
    ("driven", "error"),
    [
        (lambda asset: asset, MissionInputError("too soft")),
        (lambda asset: asset, ImpossibleObservation("growing_damage", 0, {})),
        (Remembering, MissionInputError("too soft")),
        (Remembering, FmuEndedError("It is over.", time=1.0)),
    ],
)
def test_an_asset_that_fails_or_ends_keeps_what_it_has_flown_and_does_not_touch_the_others(
    driven, error, library_file
):
    knowledge, asset = known("growing_damage", library_file)
    truths, soft = [knowledge.truth(seed) for seed in range(6)], until_soft(asset, error)
    whole = fly_side_by_side(knowledge, truths, [asset] * 6)
    assert same(whole, fly_side_by_side(knowledge, truths, [driven(asset) for _ in truths]))
    with np.errstate(over="ignore"):
        found = fly_side_by_side(knowledge, truths, [driven(soft) for _ in truths])
        assert same(found, fly_one_by_one(knowledge, truths, lambda *_: driven(soft)))
    softened = whole.state[:, :, 0] >= 0.4 - 1e-9
    flown = np.where(softened.any(axis=1), softened.argmax(axis=1), 35)
    assert 0 < np.sum(flown < 35) < 6
    ends, over = isinstance(error, FmuEndedError), "The asset ended the mission after"
    said = [f"{over} {n} of 35 steps: It is over." if ends and n < 35 else "" for n in flown]
    assert found.ended == said
    assert [text != "" for text in found.failure] == [not ends and n < 35 for n in flown]
    for twin, end in enumerate(flown):
        assert np.array_equal(found.filtered[twin, :end], whole.filtered[twin, :end])
        assert np.isnan(found.filtered[twin, end:]).all()
        assert (found.control_index[twin, end:] == -1).all()
    kept = stored_variables(knowledge, found, [Member(row, "", row, {}) for row in range(6)])
    for row, steps in enumerate(flown):
        if ends or steps == 35:
            assert kept["status"][row] == (ENDED if found.ended[row] else FLOWN)
            np.testing.assert_array_equal(
                kept["filtered/last_probability"][row], found.filtered[row, steps - 1].astype("f4")
            )
            inside = in_credible_set(knowledge.model, found.filtered[row, :steps], found.state[row, :steps])
            assert kept["credible"][row] == np.float32(inside.mean())


def test_damage_grows_as_the_model_says(library_file):
    model = known("growing_damage", library_file)[0].model
    growth, uniform = DamageGrowth(model), (np.arange(2000) + 0.5) / 2000
    for control in (0, 1):
        row = model.transition.row(control, 6)
        found = growth.next_states(np.full(len(uniform), control), np.full(len(uniform), 6), uniform)
        np.testing.assert_allclose(np.bincount(found, minlength=25) / 2000, row, atol=1.5 / 2000)
