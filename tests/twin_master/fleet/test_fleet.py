"""Fleets: plan, shards, store, what goes on after a kill, and what is refused."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.errors import PosteriorError
from twin_master.assets.resolution import Overrides
from twin_master.errors import FleetError, NotResumableError, RunFolderExistsError
from twin_master.fleet.engine import Engine
from twin_master.fleet.flight import fly_fleet, group_folder
from twin_master.fleet.plan import Fleet, ensemble, load_fleet, seed_range
from twin_master.fleet.reading import Estimated, group_figures
from twin_master.fleet.reading import open_fleet as fleet_groups
from twin_master.fleet.store import FleetStore
from twin_master.mission.loop import fly
from twin_master.mission.preparation import kept_knowledge
from twin_master.workflow import fly as new_run
from uav_twin.cli import app


def growing(library_file: Path, count: int = 10, shard: int = 4) -> Fleet:
    return ensemble("growing_damage", range(count), Overrides(strain_library=library_file), shard=shard)


def contents(folder: Path) -> dict[str, bytes]:
    """Return the store and what the twins knew, by path; the journal keeps times and is no result."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for part in ("fleet.zarr", "groups", "fleet.json")
        for path in (folder / part, *sorted((folder / part).rglob("*")))
        if path.is_file()
    }


def test_a_twin_of_an_ensemble_flies_what_a_run_flies(library_file: Path, tmp_path: Path) -> None:
    fleet = ensemble("level_turns", range(2020, 2023), Overrides(strain_library=library_file))
    outcome = fly_fleet(fleet, tmp_path / "many")
    group = fleet_groups(outcome.folder)["level_turns"]
    run = new_run("level_turns", tmp_path / "one", Overrides(strain_library=library_file), report=False)
    from twin_master.store.writing import read_run

    tree = read_run(run.folder)
    seed = int(tree.attrs["seed"])
    row = group["seed"].values.tolist().index(seed)
    for ours, (part, name) in {
        "observed": ("observed", "strain"),
        "control_index": ("observed", "control_index"),
        "mean": ("filtered", "mean"),
        "state": ("truth", "state"),
    }.items():
        single = tree[part].to_dataset()[name].values
        assert np.array_equal(group[ours].values[row], single.astype(group[ours].dtype)), ours


def test_shards_and_workers_change_nothing(library_file: Path, tmp_path: Path) -> None:
    whole = fly_fleet(growing(library_file, shard=10), tmp_path / "whole")
    cut = fly_fleet(growing(library_file, shard=3), tmp_path / "cut", Engine(2))
    assert (whole.shards_flown, cut.shards_flown) == (1, 4)
    first, second = (fleet_groups(outcome.folder)["growing_damage"] for outcome in (whole, cut))
    assert set(first.data_vars) == set(second.data_vars)
    for name in first.data_vars:
        np.testing.assert_array_equal(first[name].values, second[name].values)
    assert (first["status"].values == 1).all()
    assert len(np.unique(first["state"].values[:, -1], axis=0)) > 1


def test_a_fleet_goes_on_where_it_was_killed(
    library_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = growing(library_file)
    fly_fleet(fleet, tmp_path / "whole")
    finish = FleetStore.finish

    def dying(self: FleetStore, shard: int, told: Any) -> None:
        if shard == 1:  # its chunk is written, and the journal does not know
            raise KeyboardInterrupt
        finish(self, shard, told)

    with monkeypatch.context() as patch:
        patch.setattr(FleetStore, "finish", dying)
        with pytest.raises(KeyboardInterrupt):
            fly_fleet(fleet, tmp_path / "cut")
    journal = tmp_path / "cut" / "done.jsonl"
    assert fleet_groups(tmp_path / "cut")["growing_damage"]["status"].values.tolist() == [1] * 8 + [0] * 2
    with journal.open("a") as file:
        file.write('{"shard": 2, "fail')  # a line that the kill cut off
    outcome = fly_fleet(fleet, tmp_path / "cut")
    assert (outcome.shards_kept, outcome.shards_flown) == (1, 2)
    assert contents(tmp_path / "cut") == contents(tmp_path / "whole")
    assert fly_fleet(fleet, tmp_path / "cut").shards_flown == 0


def test_a_folder_keeps_what_it_holds(library_file: Path, tmp_path: Path) -> None:
    fleet = growing(library_file, count=2)
    fly_fleet(fleet, tmp_path / "fleet")
    with pytest.raises(RunFolderExistsError, match="another fleet"):
        fly_fleet(growing(library_file, count=3), tmp_path / "fleet")
    config = tmp_path / "fleet" / "config.json"
    record = json.loads(config.read_text())
    record["provenance"]["versions"]["numpy"] = "0.1"
    config.write_text(json.dumps(record))
    with pytest.raises(NotResumableError, match="numpy"):
        fly_fleet(fleet, tmp_path / "fleet")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").touch()
    with pytest.raises(RunFolderExistsError, match="there is no folder"):
        fleet_groups(tmp_path / "nowhere")
    with pytest.raises(RunFolderExistsError, match="not the folder of a fleet"):
        fly_fleet(fleet, tmp_path / "other", replace_old=True)
    assert fly_fleet(growing(library_file, count=3), tmp_path / "fleet", replace_old=True).twins == 3


FLEET = """
format = 1
[fleet]
name = "two"
seed = 5
[[group]]
name = "north"
scenario = "north.toml"
count = 3
[[group]]
name = "south"
scenario = "growing_damage"
count = 2
steps = 9
parameters = { young_modulus_factor = { mean = 1.0, standard_deviation = 0.05 } }
"""


@pytest.fixture
def fleet_file(tmp_path: Path) -> Path:
    from scenarios import scenario_files

    (tmp_path / "north.toml").write_text(scenario_files()["growing_damage"].read_text())
    path = tmp_path / "fleet.toml"
    path.write_text(FLEET)
    return path


def test_a_twin_has_a_seed_of_its_own_whatever_else_flies(fleet_file: Path) -> None:
    fleet = load_fleet(fleet_file)
    seeds = [member.seed for group in fleet.groups for member in group.members]
    assert len(set(seeds)) == 5
    fleet_file.write_text(FLEET.replace("count = 3", "count = 1"))
    fewer = load_fleet(fleet_file)
    assert [m.seed for g in fewer.groups for m in g.members] == [seeds[0], *seeds[3:]]
    assert [m.parameters for m in fewer.groups[1].members] == [m.parameters for m in fleet.groups[1].members]
    assert load_fleet(fleet_file, seed=6).groups[0].members[0].seed != seeds[0]
    assert fleet.groups[1].scenarios[0].mission.steps == 9
    assert fleet.groups[0].scenarios[0].mission.seed == 5


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("count = 3", "", "one of `count`"),
        ("count = 3", 'count = 3\nfmus = "*.fmu"', "one of `count`"),
        ('"north.toml"', '"nowhere.toml"', "group north: There is no scenario `nowhere.toml`"),
        ("count = 3", 'fmus = "*.fmu"', "no file fits"),
        ('name = "south"', 'name = "north"', "name of its own"),
        ("seed = 5", "sead = 5", "sead"),
    ],
)
def test_a_wrong_fleet_file_is_refused(fleet_file: Path, old: str, new: str, sentence: str) -> None:
    fleet_file.write_text(FLEET.replace(old, new))
    with pytest.raises(FleetError, match=sentence):
        load_fleet(fleet_file)


def test_all_assets_that_cannot_fly_are_in_one_list(fleet_file: Path) -> None:
    for name in ("a", "b"):
        (fleet_file.parent / f"{name}.fmu").write_bytes(b"no FMU")
    text = FLEET.replace("count = 3", 'fmus = "*.fmu"').replace("young_modulus_factor", "colour")
    fleet_file.write_text(text)
    with pytest.raises(FleetError) as caught:
        fly_fleet(load_fleet(fleet_file), fleet_file.parent / "out")
    lines = str(caught.value).splitlines()
    assert lines[0].startswith("3 of the assets cannot fly")
    assert [line.split(":")[0] for line in lines[1:]] == ["north a.fmu", "north b.fmu", "south"]
    assert not (fleet_file.parent / "out").exists()


@pytest.mark.parametrize("text", ["7", "3:3", "5:1", "a:b", "-1:4", "1:2:3", "0:1000000000000"])
def test_seeds_are_a_range(text: str) -> None:
    with pytest.raises(FleetError, match=r"FIRST:END|1000000 twins at most"):
        seed_range(text)


def test_a_truth_beyond_the_model_is_refused(fleet_file: Path) -> None:
    fleet_file.write_text(FLEET.replace("mean = 1.0,", "mean = 1.3,"))
    with pytest.raises(FleetError, match=r"south: the true young_modulus_factor of 2 of 2 assets is outside"):
        fly_fleet(load_fleet(fleet_file), fleet_file.parent / "out")
    loss = '[[truth.gains]]\nstate = "z1"\nfirst_step = 0\nlast_step = 49\ngain_percent = 5\n\n[truth.noise]'
    north = fleet_file.parent / "north.toml"
    text = north.read_text().replace('kind = "random_growth"', 'kind = "scripted"')
    north.write_text(text.replace("[truth.noise]", loss))
    fleet_file.write_text(FLEET)
    with pytest.raises(FleetError, match=r"north: the true z1 of 3\d of 50 .* is outside of 0 to 0.8"):
        fly_fleet(load_fleet(fleet_file), fleet_file.parent / "out")
    assert not (fleet_file.parent / "out").exists()


def test_one_calibration_that_fails_costs_its_own_asset(
    fleet_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from twin_master.fleet import flight

    for name in ("a", "b"):
        (fleet_file.parent / f"{name}.fmu").write_bytes(b"for its name alone")
    north = FLEET.split('[[group]]\nname = "south"')[0]
    fleet_file.write_text(north.replace("count = 3", 'fmus = "*.fmu"'))
    flown = []

    def preparing(scenario: Any, folder: Path, *args: Any, **given: Any) -> bytes:
        flown.append(folder.name)
        if folder.name == "0":
            raise PosteriorError("no posterior.")
        return b"kit"

    monkeypatch.setattr(flight, "prepared", preparing)
    monkeypatch.setattr(flight, "_check", lambda _fleet: None)
    monkeypatch.setattr("twin_master.fleet.engine.fly_shard", lambda _kit, members: "it was flown")
    outcome = fly_fleet(load_fleet(fleet_file), fleet_file.parent / "out", Engine(0))
    assert outcome.failures == {"north/a": "no posterior.", "north/b": "it was flown"}


def test_nobody_answers(library_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("twin_master.fleet.engine.CONNECTING", 0.2)
    with pytest.raises(FleetError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        fly_fleet(growing(library_file), tmp_path / "fleet", Engine(cluster="tcp://127.0.0.1:9"))
    assert fly_fleet(growing(library_file), tmp_path / "fleet").shards_flown == 3


def test_figures_are_those_of_the_flights(library_file: Path, tmp_path: Path) -> None:
    fleet = growing(library_file, count=4)
    folder = fly_fleet(fleet, tmp_path / "fleet").folder
    own = group_folder(folder, fleet.groups[0], 0)
    knowledge = kept_knowledge(own, fleet.groups[0].scenarios[0])
    source = fleet.groups[0].scenarios[0].asset.source(fleet.groups[0].scenarios[0])
    asset = source.open()
    flights = [
        fly(knowledge.scenario, knowledge.twin(), knowledge.plant(knowledge.truth(seed), asset))
        for seed in range(4)
    ]
    figures = group_figures(fleet_groups(folder)["growing_damage"])
    evidence = figures["log evidence of a step"]
    assert isinstance(evidence, Estimated)
    assert evidence.value == pytest.approx(np.mean([f.log_evidence.mean() for f in flights]), rel=1e-6)
    error = [knowledge.model.states.mean(f.filtered) - f.state for f in flights]
    rms = figures["filtered rms error of z2"]
    assert isinstance(rms, Estimated)
    assert rms.value == pytest.approx(float(np.sqrt(np.mean(np.square(error)[:, :, 1]))), rel=1e-5)


def test_the_command_line(library_file: Path, tmp_path: Path) -> None:
    def command(*words: str) -> dict[str, Any]:
        result = CliRunner().invoke(app, [*words, "--json"])
        assert result.exit_code == 0, result.output
        found: dict[str, Any] = json.loads(result.stdout)
        return found

    common = ("--strain-library", str(library_file), "--workers", "0")
    told = command("run", "growing_damage", "--seeds", "0:3", *common, "--out", str(tmp_path / "a"))
    assert (told["twins"], told["failed"]) == (3, 0)
    command("run", "growing_damage", "--seeds", "3:5", *common, "--out", str(tmp_path / "b"))
    compared = command("compare", str(tmp_path / "a"), str(tmp_path / "b"))
    assert [group["twins"] for group in compared.values()] == [3, 2]
    for words in (["--seeds", "0:3", "--seed", "1"], ["--workers", "2"]):
        assert CliRunner().invoke(app, ["run", "growing_damage", *words]).exit_code == 2


def test_without_the_extra_nothing_is_begun(
    library_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(FleetError, match=r"needs distributed: pip install 'uav-twin\[fleet\]'\.$"):
        fly_fleet(growing(library_file), tmp_path / "fleet", Engine(2))
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(FleetError, match=r"needs zarr: pip install"):
        fly_fleet(growing(library_file), tmp_path / "fleet")
    assert not (tmp_path / "fleet").exists()
