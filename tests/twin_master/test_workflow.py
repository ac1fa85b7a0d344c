"""Runs from scenario to report: what a run folder holds, who may take it, what is refused, what survives."""

import errno
import json
import os
import shutil
import signal
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from reporting.errors import DiskFullError
from reporting.folders import restore_folder
from reporting.former_names import FormerNameWarning
from tests.twin_master.runs import check_same, cut_off_after, noted, with_former_names, written
from twin_master import workflow
from twin_master.errors import MissionInputError, NotResumableError, RunFolderError
from twin_master.run_folder import FIELD_NAME, KIND, create_run_folder, lock_run_folder, read_config
from twin_master.store.writing import RunOutcome, finished_run, open_run
from uav_twin import fly as new_run
from uav_twin import load_scenario
from uav_twin import resume as resume_run

pytestmark = pytest.mark.usefixtures("no_report")
SAME = ("run.nc", "config.json", "summary.json", "csv/health.csv", "csv/observed.csv", "csv/decisions.csv")


def fly(folder: Path, library: Path) -> RunOutcome:
    return new_run(load_scenario("failing_gauges"), folder, {"strain_library": library})


@pytest.fixture(scope="module")
def flown(library_file: Path, tmp_path_factory: pytest.TempPathFactory, no_report: None) -> RunOutcome:
    """A mission; tests change copies of its folder."""
    return fly(tmp_path_factory.mktemp("flown") / "run", library_file)


def make(folder: Path, name: str, *, replace: bool = False) -> None:
    with create_run_folder(folder, {"kind": KIND, "name": name}, replace=replace):
        pass


def test_a_run_that_flies_is_not_replaced_nor_anything_that_is_no_run(tmp_path):
    folder = tmp_path / "run"
    with create_run_folder(folder, {"kind": KIND, "name": "first"}):
        with pytest.raises(RunFolderError, match="another process is flying"):
            make(folder, "second", replace=True)
        with pytest.raises(RunFolderError, match="another process is flying"):
            lock_run_folder(folder)
    written(folder, "mine", name="notes.txt")
    with pytest.raises(RunFolderError, match="--resume"):
        make(folder, "second")
    assert "first" in (folder / "config.json").read_text(encoding="utf-8")
    make(folder, "second", replace=True)
    assert "second" in (folder / "config.json").read_text(encoding="utf-8")
    assert not (folder / "notes.txt").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    mine = tmp_path / "mine"
    mine.mkdir()
    make(mine, "first", replace=True)  # an empty folder
    (mine / "config.json").unlink()
    thesis = written(mine, "important", name="thesis.txt")
    for place, sentence in ((mine, "left unchanged"), (thesis, "no folder")):
        with pytest.raises(RunFolderError, match=sentence):
            make(place, "second", replace=True)
    assert thesis.read_text(encoding="utf-8") == "important"


@pytest.mark.parametrize("moves", [1, 2, 3])
def test_a_kill_between_the_moves_of_a_replacement_loses_no_run(tmp_path, library_file, monkeypatch, moves):
    folder, rename, moved = tmp_path / "run[1]", Path.rename, list[Path]()
    make(folder, "first")
    written(folder, "mine", name="notes.txt")

    def killing(path: Path, target: Path) -> Path:
        moved.append(rename(path, target))
        if len(moved) == moves:
            os.kill(os.getpid(), signal.SIGKILL)
        return target

    if not (child := os.fork()):
        try:
            monkeypatch.setattr(Path, "rename", killing)
            make(folder, "second", replace=True)
        finally:
            os._exit(1)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    if moves == 1:
        (aside,) = tmp_path.glob(".*/run*")
        lock = lock_run_folder(aside)  # it is being replaced
        assert restore_folder(folder) is False
        os.close(lock)
    notes = noted(monkeypatch)
    with pytest.raises(RunFolderError, match="holds a run already"):
        fly(folder, library_file)
    assert [note.endswith("the previous run was restored.") for note in notes] == [True] * (moves == 1)
    kept = "first" if moves == 1 else "second"
    assert kept in (folder / "config.json").read_text(encoding="utf-8")
    assert (folder / "notes.txt").exists() is (moves == 1)
    assert not list(tmp_path.glob(".*"))
    assert restore_folder(folder) is False


DEEP = '{"a":' * 5000 + "1" + "}" * 5000


@pytest.mark.parametrize("text", [DEEP, "[1]", "", '{"kind": NaN}', '{"kind": ' + "1" * 5000 + "}"])
def test_a_configuration_that_cannot_be_read_is_that_of_no_run(tmp_path, text):
    written(tmp_path, text, name="config.json")
    with pytest.raises(NotResumableError, match="is not a run folder"):
        read_config(tmp_path)
    with pytest.raises(RunFolderError, match="left unchanged"):
        make(tmp_path, "second", replace=True)
    for name in ("timing.json", "summary.json"):  # of a run that is finished both are whole
        for file in ("timing.json", "summary.json"):
            written(tmp_path, DEEP if file == name else "{}", name=file)
        assert finished_run(tmp_path) is None


def test_the_field_of_a_belief_that_rounds_beyond_the_last_level():
    """A mean of 0.8000000000000003 lies outside every model that ends at 0.8."""
    model = SimpleNamespace(states=SimpleNamespace(mean=lambda _belief: np.array([0.8000000000000003, 0.3])))
    step = SimpleNamespace(twin_step=SimpleNamespace(filtered=None, control_index=0))
    knowledge, flight = SimpleNamespace(model=model), SimpleNamespace(steps=[step])
    scenario, seen = load_scenario("level_turns").scenario, list[dict[str, float]]()
    result = SimpleNamespace(scenario=scenario, knowledge=knowledge, flight=flight)
    source = SimpleNamespace(write_field=lambda _path, state, _control: seen.append(state))
    workflow._field_writer(source, result)(Path("wing.vtu"))  # type: ignore[arg-type]
    assert seen == [{"z1": 0.8, "z2": 0.3}]


@pytest.mark.parametrize("steps", [1, 50])
def test_a_resumed_run_is_bit_identical(flown, tmp_path, library_file, steps):
    """Though its folder was moved and the files that were given are gone."""
    library = written(tmp_path, library_file.read_text(encoding="utf-8"), name="é.json")
    with cut_off_after(steps):
        fly(tmp_path / "part", library)
    assert not (tmp_path / "part" / "run.nc").exists()
    library.unlink()
    moved = (tmp_path / "part").rename(tmp_path / "moved é")
    (moved / f".{FIELD_NAME}.ab12").mkdir()
    for left in (f".{FIELD_NAME}.ab12/wing.vtu", f".{FIELD_NAME}.cd34", "csv/.1-2.partial.csv", ".mine"):
        (moved / left).parent.mkdir(exist_ok=True)
        (moved / left).write_bytes(b"left by a killed process, or the user's")
    resume_run(moved, load_scenario("failing_gauges"))
    check_same(moved, flown.folder, *SAME)
    assert [path.name for path in moved.rglob(".*")] == [".mine"]
    resume_run(moved)  # a finished run may be resumed; nothing changes
    check_same(moved, flown.folder, *SAME)
    for path in moved.rglob("*"):
        assert path.is_dir() or str(tmp_path).encode() not in path.read_bytes(), path
    with pytest.raises(MissionInputError):
        fly(tmp_path / "never", library)
    assert not (tmp_path / "never").exists()


def test_a_run_of_an_earlier_version_is_taken_up_with_a_sentence_for_each_file(flown, tmp_path, library_file):
    with cut_off_after(20):
        fly(tmp_path / "run", library_file)
    with_former_names(tmp_path / "run")
    assert "memory_turns" in (tmp_path / "run" / "config.json").read_text(encoding="utf-8")
    with pytest.warns(FormerNameWarning) as told:
        resume_run(tmp_path / "run")
    assert [str(warning.message).removeprefix(f"{tmp_path / 'run'}/") for warning in told] == [
        "config.json: `memory_turns` is now called `memory_steps` and `onset_turns` is now called "
        "`onset_steps`. The former names are still read.",
        "journal.jsonl: `turn` is now called `step`. The former name is still read.",
    ]
    check_same(tmp_path / "run", flown.folder, "csv/health.csv", "csv/observed.csv", "csv/decisions.csv")


def test_a_finished_run_says_so_and_is_made_whole_where_something_is_missing(flown, tmp_path, monkeypatch):
    whole = Path(shutil.copytree(flown.folder, tmp_path / "whole"))
    groups = {"observed", "filtered", "smoothed", "predicted", "policy", "calibration", "truth", "notice"}
    assert {*open_run(whole).children} == groups
    assert json.loads((whole / "timing.json").read_text(encoding="utf-8"))["steps"] == 50

    def report(folder: Path) -> Path:
        (folder / "report.html").write_text("report", encoding="utf-8")
        return folder / "report.html"

    monkeypatch.setattr(workflow, "_write_report", report)
    with monkeypatch.context() as patch:
        patch.setattr(workflow, "_run", None)  # nothing is done again
        notes = noted(patch)
        again = resume_run(whole)
    assert notes == [f"The run in {whole} is finished: nothing is flown again."]
    assert (again.figures, again.report.name, again.origin) == (flown.figures, "report.html", flown.origin)
    (whole / "run.nc").write_bytes((whole / "run.nc").read_bytes()[:5000])
    resume_run(whole)
    check_same(whole, flown.folder, *SAME)
    (whole / "report.html").unlink()
    assert resume_run(whole).report.is_file()


def test_a_full_disk_loses_nothing(flown, tmp_path, library_file, monkeypatch):
    """Nor does it leave half a line, though it takes one in pieces."""
    write, journal = os.write, tmp_path / "part" / "journal.jsonl"

    def full(descriptor: int, content: bytes) -> int:
        if journal.stat().st_size > 10_000:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(descriptor, content[:700])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", full)
        with pytest.raises(DiskFullError, match="No space is left"):
            fly(tmp_path / "part", library_file)
    kept = journal.read_bytes()
    assert kept.count(b"\n") > 2
    assert kept.endswith(b"\n")
    assert (flown.folder / "journal.jsonl").read_bytes().startswith(kept)
    resume_run(tmp_path / "part")
    check_same(tmp_path / "part", flown.folder, *SAME)


def test_what_cannot_be_resumed(tmp_path, library_file):
    for place, sentence in (
        (tmp_path / "nothing", "there is no run folder"),
        (tmp_path, "is not a run folder"),
    ):
        with pytest.raises(NotResumableError, match=sentence):
            resume_run(place)
    folder = tmp_path / "run"
    with cut_off_after(3):
        fly(folder, library_file)
    with pytest.raises(NotResumableError, match="another scenario"):
        resume_run(folder, load_scenario("growing_damage"))
    config, copy = folder / "config.json", folder / "asset" / "UAVconfig.json"
    text, content = config.read_text(encoding="utf-8"), copy.read_bytes()
    numpy = json.loads(text)["provenance"]["versions"]["numpy"]
    for old, new, sentence in (
        (f'"{numpy}"', '"1.0"', "another version of numpy"),
        ('"gamma": 0.6', '"gamma": 0.5', "another configuration"),
    ):
        written(folder, text, (old, new), name="config.json")
        with pytest.raises(NotResumableError, match=sentence):
            resume_run(folder)
    config.write_text(text, encoding="utf-8")
    copy.write_bytes(content + b"\n")
    with pytest.raises(NotResumableError, match="strain library changed"):
        resume_run(folder)
    copy.unlink()
    with pytest.raises(MissionInputError, match="cannot be read"):
        resume_run(folder)
    copy.write_bytes(content)
    lock = lock_run_folder(folder)
    with pytest.raises(RunFolderError, match="another process"):
        resume_run(folder)
    os.close(lock)
    resume_run(folder)


def test_a_damaged_configuration_is_one_sentence(tmp_path):
    tables = "scenario", "scenario_file", "provenance", "inputs"
    for damaged, damage in product(tables, (3, None, [])):
        config = {"kind": KIND, **{table: {} for table in tables}, damaged: damage}
        written(tmp_path, json.dumps(config), name="config.json")
        with pytest.raises(NotResumableError, match=f"damaged.*`{damaged}`.*--replace"):
            resume_run(tmp_path)


def test_an_error_before_the_first_step_says_how_to_begin_anew(tmp_path, library_file, monkeypatch):
    def broken(*_: object) -> None:
        raise MissionInputError("the parameter cannot be drawn.")

    monkeypatch.setattr(workflow, "prepare_knowledge", broken)
    with pytest.raises(MissionInputError) as caught:
        fly(tmp_path / "run", library_file)
    assert caught.value.__notes__ == [
        "Nothing was flown yet: correct the cause, and fly again with --replace."
    ]
