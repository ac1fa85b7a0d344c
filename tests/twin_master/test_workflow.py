"""Runs from scenario to report: what a run folder holds, what is refused, and what survives."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from reporting.errors import DiskFullError
from reporting.progress import SilentProgress
from tests.twin_master.runs import cut_off_after
from twin_master import workflow
from twin_master.assets.resolution import Overrides, resolve_scenario
from twin_master.errors import (
    InvalidStrainLibraryError,
    MissionInputError,
    NotResumableError,
    RunFolderError,
    RunFolderExistsError,
    ScenarioError,
)
from twin_master.network.twin import build_graphical_model
from twin_master.run_folder import lock_run_folder
from twin_master.scenario.reading import load_scenario
from twin_master.store.writing import RunOutcome, read_run
from twin_master.workflow import fly as new_run
from twin_master.workflow import resume as resume_run

pytestmark = pytest.mark.usefixtures("no_report")
ROOT = Path(__file__).parents[2]
SAME = ("run.nc", "config.json", "summary.json", "csv/health.csv", "csv/observed.csv", "csv/decisions.csv")


def fly(folder: Path, library: Path, scenario: str = "level_turns", **options: object) -> RunOutcome:
    return new_run(load_scenario(scenario), folder, Overrides(strain_library=library, **options))  # type: ignore[arg-type]


def contents(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in SAME}


def test_run_folder(tmp_path: Path, library_file: Path) -> None:
    outcome = fly(tmp_path / "a" / "run", library_file, "failing_gauges")
    folder = outcome.folder
    tree = read_run(folder)
    assert set(tree.children) == {
        "observed", "filtered", "smoothed", "predicted", "policy", "calibration", "truth", "notice",
    }  # fmt: skip
    assert tree["predicted"]["quantity_mean"].shape == (50, 10, 24)
    assert tree["filtered"]["reward_mean"].dims == ("step", "reward")
    for group in tree.children.values():
        for name, variable in group.data_vars.items():
            assert variable.attrs["units"], name
            assert variable.attrs["long_name"], name
    np.testing.assert_allclose(tree["filtered"]["probability"].sum("state"), 1.0)
    np.testing.assert_array_equal(tree["policy"]["z2"][:5], [0.0, 0.2, 0.4, 0.6, 0.8])
    lower, upper = tree["filtered"]["quantity_lower"], tree["filtered"]["quantity_upper"]
    assert np.all(lower <= upper)
    assert np.all(np.isnan(tree["observed"]["strain"].values[36]))
    assert tree["filtered"]["sensors_received"].values[36] == 0
    assert int(tree.attrs["seed"]) == 2021
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    figures = {figure["key"]: figure for figure in summary["figures"]}
    assert figures["blind_steps"]["value"] == "36, 37"
    assert "follows the dynamics" in figures["blind_steps"]["title"]
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    assert config["scenario"]["state"][0]["levels"] == [0.0, 0.2, 0.4, 0.6, 0.8]
    header, first = (folder / "csv" / "observed.csv").read_text(encoding="utf-8").splitlines()[:2]
    assert header.startswith("step,strain_1_microstrain,strain_2_microstrain")
    assert 2000 < float(first.split(",")[1]) < 4000
    row = (folder / "csv" / "observed.csv").read_text(encoding="utf-8").splitlines()[37]
    assert row == "36" + 24 * ","
    assert "seconds" not in (folder / "summary.json").read_text(encoding="utf-8")
    assert json.loads((folder / "timing.json").read_text(encoding="utf-8"))["turns"] == 50


def test_the_field_of_a_belief_that_rounds_beyond_the_last_level() -> None:
    """A mean of 0.8000000000000003 lies outside every model that ends at 0.8."""
    scenario = load_scenario("level_turns").scenario
    model = build_graphical_model(scenario)
    last = model.states.coordinates[:, 0] == 0.8
    generator = np.random.default_rng(1)
    beliefs = (np.where(last, generator.random(len(last)), 0.0) for _ in range(1000))
    belief = next(b for b in (b / b.sum() for b in beliefs) if model.states.mean(b)[0] > 0.8)
    seen: dict[str, float] = {}
    source = SimpleNamespace(write_field=lambda path, state, control: seen.update(state))
    turn = SimpleNamespace(concluded=SimpleNamespace(filtered=belief, control_index=0))
    result = SimpleNamespace(
        scenario=scenario, knowledge=SimpleNamespace(model=model), flight=SimpleNamespace(turns=[turn])
    )
    workflow._field_writer(source, result)(Path("wing.vtu"))  # type: ignore[arg-type]
    assert seen["z1"] == 0.8
    assert 0.0 < seen["z2"] < 0.8


def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_mission(
    tmp_path: Path, library_file: Path
) -> None:
    first, second = fly(tmp_path / "a", library_file).folder, fly(tmp_path / "b", library_file).folder
    assert contents(first) == contents(second)
    other = fly(tmp_path / "c", library_file, seed=5).folder
    assert (other / "run.nc").read_bytes() != (first / "run.nc").read_bytes()


@pytest.mark.parametrize(
    ("scenario", "turns"),
    [("level_turns", 1), ("failing_gauges", 50), pytest.param("growing_damage", 30, marks=pytest.mark.long)],
)
def test_a_resumed_run_is_bit_identical(
    tmp_path: Path, library_file: Path, scenario: str, turns: int
) -> None:
    whole = contents(fly(tmp_path / "whole", library_file, scenario).folder)
    with cut_off_after(turns):
        fly(tmp_path / "part", library_file, scenario)
    assert not (tmp_path / "part" / "run.nc").exists()
    (tmp_path / "part" / ".checkpoint.1-2.partial.npz").write_bytes(b"left by a killed process")
    resume_run(tmp_path / "part", load_scenario(scenario))
    assert contents(tmp_path / "part") == whole
    assert not list((tmp_path / "part").glob(".*"))
    resume_run(tmp_path / "part")  # a finished run may be resumed; nothing changes
    assert contents(tmp_path / "part") == whole


def test_a_finished_run_says_so_and_is_made_whole_where_something_is_missing(
    tmp_path: Path, library_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def report(folder: Path) -> Path:
        (folder / "report.html").write_text("report", encoding="utf-8")
        return folder / "report.html"

    class Notes(SilentProgress):
        said: list[str]

        def note(self, message: str) -> None:
            self.said.append(message)

    monkeypatch.setattr(workflow, "_report", report)
    flown = fly(tmp_path / "run", library_file)
    whole = contents(flown.folder)
    monkeypatch.setattr(workflow, "_run", None)  # nothing is done again
    notes = Notes()
    notes.said = []
    again = resume_run(flown.folder, progress=notes)
    assert notes.said == [f"The run in {flown.folder} is finished: nothing is flown again."]
    assert (again.figures, again.report, again.origin) == (flown.figures, flown.report, flown.origin)
    monkeypatch.undo()
    monkeypatch.setattr(workflow, "_report", report)
    (flown.folder / "run.nc").write_bytes((flown.folder / "run.nc").read_bytes()[:5000])
    resume_run(flown.folder)
    assert contents(flown.folder) == whole
    (flown.folder / "report.html").unlink()
    assert resume_run(flown.folder).report.is_file()


def test_a_replacement_that_was_killed_is_put_back_and_said(tmp_path: Path, library_file: Path) -> None:
    folder = fly(tmp_path / "run", library_file).folder
    (tmp_path / ".run.old-x").mkdir()
    folder.rename(tmp_path / ".run.old-x" / "run")
    with pytest.raises(RunFolderExistsError, match="holds a run already"):
        fly(folder, library_file)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_a_seed_that_cannot_be_stored_is_refused_before_the_flight(
    tmp_path: Path, library_file: Path
) -> None:
    with pytest.raises(ScenarioError, match=r"at most 9223372036854775807 .*mission.seed"):
        fly(tmp_path / "run", library_file, seed=10**40)
    text = load_scenario("level_turns").path.read_text(encoding="utf-8")
    (tmp_path / "s.toml").write_text(text.replace("seed = 2021", f"seed = {10**40}"), encoding="utf-8")
    with pytest.raises(ScenarioError, match=r"64 bits|seed"):
        fly(tmp_path / "run", library_file, str(tmp_path / "s.toml"))
    assert not (tmp_path / "run").exists()


def test_a_full_disk_loses_nothing(
    tmp_path: Path, library_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = contents(fly(tmp_path / "whole", library_file).folder)
    flush = os.fsync
    count = 0

    def full(descriptor: int) -> None:
        nonlocal count
        count += 1
        if count > 20:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        flush(descriptor)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(DiskFullError, match="No space is left"):
            fly(tmp_path / "part", library_file)
    assert (tmp_path / "part" / "journal.jsonl").read_bytes().count(b"\n") > 2
    resume_run(tmp_path / "part")
    assert contents(tmp_path / "part") == whole


def test_existing_folders_are_refused(tmp_path: Path, library_file: Path) -> None:
    folder = tmp_path / "run"
    fly(folder, library_file)
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(RunFolderExistsError, match="--resume"):
        fly(folder, library_file)
    loaded = load_scenario("level_turns")
    new_run(loaded, folder, Overrides(strain_library=library_file), replace=True)
    assert not (folder / "notes.txt").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run"]
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("important", encoding="utf-8")
    with pytest.raises(RunFolderExistsError, match="no run folder"):
        new_run(loaded, mine, Overrides(strain_library=library_file), replace=True)
    assert (mine / "thesis.txt").read_text(encoding="utf-8") == "important"
    with pytest.raises(RunFolderExistsError, match="no folder"):
        new_run(loaded, mine / "thesis.txt", Overrides(strain_library=library_file), replace=True)
    (tmp_path / "empty").mkdir()
    fly(tmp_path / "empty", library_file)


def test_what_cannot_be_resumed(tmp_path: Path, library_file: Path) -> None:
    with pytest.raises(NotResumableError, match="there is no run folder"):
        resume_run(tmp_path / "nothing")
    with pytest.raises(NotResumableError, match="is no run folder"):
        resume_run(tmp_path)
    folder = tmp_path / "run"
    with cut_off_after(3):
        fly(folder, library_file)
    with pytest.raises(NotResumableError, match="another scenario"):
        resume_run(folder, load_scenario("growing_damage"))
    config = (folder / "config.json").read_text(encoding="utf-8")
    numpy = json.loads(config)["provenance"]["versions"]["numpy"]
    (folder / "config.json").write_text(config.replace(f'"{numpy}"', '"1.0"'), encoding="utf-8")
    with pytest.raises(NotResumableError, match="another version of numpy"):
        resume_run(folder)
    altered = config.replace('"gamma": 0.6', '"gamma": 0.5')
    assert altered != config
    (folder / "config.json").write_text(altered, encoding="utf-8")
    with pytest.raises(NotResumableError, match="another configuration"):
        resume_run(folder)
    (folder / "config.json").write_text(config, encoding="utf-8")
    os.close(lock_run_folder(folder))
    lock = lock_run_folder(folder)
    try:
        with pytest.raises(RunFolderError, match="another process"):
            resume_run(folder)
    finally:
        os.close(lock)
    resume_run(folder)


def test_a_run_needs_nothing_but_its_folder(tmp_path: Path, library_file: Path) -> None:
    library = tmp_path / "a library" / "é.json"
    library.parent.mkdir()
    library.write_bytes(library_file.read_bytes())
    whole = contents(fly(tmp_path / "whole", library_file).folder)
    with cut_off_after(3):
        fly(tmp_path / "part", library)
    library.unlink()
    moved = (tmp_path / "part").rename(tmp_path / "moved é")
    resume_run(moved)
    assert contents(moved) == whole
    for path in moved.rglob("*"):
        if path.is_file():
            assert str(tmp_path).encode() not in path.read_bytes(), path
    with pytest.raises(InvalidStrainLibraryError):
        fly(tmp_path / "never", library)
    assert not (tmp_path / "never").exists()


def test_a_copy_that_changed_is_refused(tmp_path: Path, library_file: Path) -> None:
    with cut_off_after(3):
        fly(tmp_path / "run", library_file)
    copy = tmp_path / "run" / "asset" / "UAVconfig.json"
    content = copy.read_bytes()
    copy.write_bytes(content + b"\n")
    with pytest.raises(NotResumableError, match="strain library changed"):
        resume_run(tmp_path / "run")
    copy.unlink()
    with pytest.raises(InvalidStrainLibraryError, match="cannot be read"):
        resume_run(tmp_path / "run")


@pytest.mark.parametrize("table", ["scenario", "scenario_file", "provenance", "inputs"])
def test_a_damaged_configuration_is_one_sentence(tmp_path: Path, library_file: Path, table: str) -> None:
    folder = fly(tmp_path / "run", library_file).folder
    config = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    for damage in (3, None, []):
        (folder / "config.json").write_text(json.dumps({**config, table: damage}), encoding="utf-8")
        with pytest.raises(NotResumableError, match=f"damaged.*`{table}`.*--replace"):
            resume_run(folder)


def test_an_error_before_the_first_turn_says_how_to_begin_anew(
    tmp_path: Path, library_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise MissionInputError("the parameter cannot be drawn.")

    monkeypatch.setattr(workflow, "prepare_knowledge", broken)
    with pytest.raises(MissionInputError) as caught:
        fly(tmp_path / "run", library_file)
    assert caught.value.__notes__ == ["Nothing was flown yet: once this is mended, fly again with --replace."]


def test_overrides(tmp_path: Path, library_file: Path) -> None:
    loaded = load_scenario("level_turns")
    with pytest.raises(MissionInputError, match="either"):
        resolve_scenario(loaded, Overrides(strain_library=library_file, fmu=tmp_path / "x.fmu"))
    scenario = resolve_scenario(loaded, Overrides(seed=4, fmu=tmp_path / "x.fmu", in_process=True))
    assert scenario.mission.seed == 4
    assert scenario.asset.file == str(tmp_path / "x.fmu")
    assert scenario.asset.isolated is False
    assert scenario.asset.binding == "uav_wing"
    text = loaded.path.read_text(encoding="utf-8").replace('binding = "uav_wing"', 'binding = "mine.toml"')
    (tmp_path / "s.toml").write_text(text, encoding="utf-8")
    moved = resolve_scenario(load_scenario(tmp_path / "s.toml"), Overrides())
    assert moved.asset.binding == str(tmp_path / "mine.toml")


@pytest.mark.slow
@pytest.mark.long
def test_kill_at_random_moments(library_file: Path) -> None:
    """A few trials; `python -m benchmarks.kill_and_resume --trials 20` makes more."""
    result = subprocess.run(
        [sys.executable, "-m", "benchmarks.kill_and_resume", "--trials", "1", "--seed", "5",
         "--", "--no-report", "--strain-library", str(library_file)],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=600,
    )  # fmt: skip
    assert "1 of 1 trials bit-identical" in result.stdout, result.stdout + result.stderr
