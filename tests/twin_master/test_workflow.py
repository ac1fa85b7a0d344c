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
from reporting.formats.former_names import FormerNameWarning
from tests.own_process import ended_by
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


def test_a_run_that_flies_is_not_replaced(tmp_path):
    folder = tmp_path / "run"
    with create_run_folder(folder, {"kind": KIND, "name": "first"}):
        with pytest.raises(RunFolderError, match="another process is flying"):
            make(folder, "second", replace=True)
        with pytest.raises(RunFolderError, match="another process is flying"):
            lock_run_folder(folder)


def test_a_run_is_replaced_only_on_demand(tmp_path):
    folder = tmp_path / "run"
    make(folder, "first")
    with pytest.raises(RunFolderError, match="--resume"):
        make(folder, "second")
    assert "first" in (folder / "config.json").read_text(encoding="utf-8")


def test_a_run_that_is_replaced_leaves_nothing(tmp_path):
    folder = tmp_path / "run"
    make(folder, "first")
    written(folder, "mine", name="notes.txt")
    make(folder, "second", replace=True)
    assert "second" in (folder / "config.json").read_text(encoding="utf-8")
    assert not (folder / "notes.txt").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_an_empty_folder_is_replaced(tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    make(folder, "first", replace=True)
    assert (folder / "config.json").is_file()


@pytest.mark.parametrize(("name", "sentence"), [(".", "left unchanged"), ("thesis.txt", "not a folder")])
def test_what_is_no_run_is_not_replaced(tmp_path, name, sentence):
    thesis = written(tmp_path, "important", name="thesis.txt")
    with pytest.raises(RunFolderError, match=sentence):
        make(tmp_path / name, "second", replace=True)
    assert thesis.read_text(encoding="utf-8") == "important"


class KilledReplacement:
    """A run with a note of the user's, whose replacement was killed behind some of its moves."""

    def __init__(self, parent: Path, moves: int) -> None:
        self.parent = parent
        self.folder = parent / "run[1]"
        self.was_moved_aside = moves == 1  # later moves have put the second run in its place
        make(self.folder, "first")
        written(self.folder, "mine", name="notes.txt")
        self.exit_code = ended_by(lambda: self.replace(moves))

    def replace(self, moves: int) -> None:
        """Replace the run, and kill this process behind so many moves."""
        rename = Path.rename
        moved = list[Path]()

        def killing(path: Path, target: Path) -> Path:
            moved.append(rename(path, target))
            if len(moved) == moves:
                os.kill(os.getpid(), signal.SIGKILL)
            return target

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Path, "rename", killing)
            make(self.folder, "second", replace=True)

    def text(self) -> str:
        return (self.folder / "config.json").read_text(encoding="utf-8")


@pytest.fixture(params=[1, 2, 3], ids=lambda moves: f"{moves} moves")
def killed_replacement(request: pytest.FixtureRequest, tmp_path: Path) -> KilledReplacement:
    killed = KilledReplacement(tmp_path, request.param)
    assert killed.exit_code == -signal.SIGKILL
    return killed


@pytest.mark.parametrize("killed_replacement", [1], indirect=True)
def test_a_run_that_is_being_replaced_is_not_put_back(killed_replacement):
    (aside,) = killed_replacement.parent.glob(".*/run*")
    lock = lock_run_folder(aside)
    assert restore_folder(killed_replacement.folder) is False
    os.close(lock)


def test_a_kill_between_the_moves_of_a_replacement_loses_no_run(killed_replacement, library_file):
    killed = killed_replacement
    with pytest.raises(RunFolderError, match="holds a run already"):
        fly(killed.folder, library_file)
    assert ("first" if killed.was_moved_aside else "second") in killed.text()
    assert (killed.folder / "notes.txt").exists() is killed.was_moved_aside


def test_a_run_that_was_moved_aside_is_told_to_be_back(killed_replacement, library_file, monkeypatch):
    notes = noted(monkeypatch)
    with pytest.raises(RunFolderError):
        fly(killed_replacement.folder, library_file)
    is_back = [note.endswith("the previous run was restored.") for note in notes]
    assert is_back == ([True] if killed_replacement.was_moved_aside else [])


def test_a_killed_replacement_leaves_nothing_hidden(killed_replacement, library_file):
    with pytest.raises(RunFolderError):
        fly(killed_replacement.folder, library_file)
    assert not list(killed_replacement.parent.glob(".*"))
    assert restore_folder(killed_replacement.folder) is False


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


def fly_until(steps: int, folder: Path, library: Path) -> None:
    """Fly a mission that dies after some steps, and remove the library that it was given."""
    with cut_off_after(steps):
        fly(folder, library)
    assert not (folder / "run.nc").exists()
    library.unlink()


@pytest.fixture
def copied_library(tmp_path: Path, library_file: Path) -> Path:
    return written(tmp_path, library_file.read_text(encoding="utf-8"), name="é.json")


@pytest.mark.parametrize("steps", [1, 50])
def test_a_resumed_run_is_bit_identical(flown, tmp_path, copied_library, steps):
    """Though its folder was moved and the files that were given are gone; also if it is resumed once more."""
    fly_until(steps, tmp_path / "part", copied_library)
    moved = (tmp_path / "part").rename(tmp_path / "moved é")
    for _ in range(2):
        resume_run(moved, load_scenario("failing_gauges"))
        check_same(moved, flown.folder, *SAME)


def test_a_resumed_run_does_not_say_in_which_folder_it_stands(tmp_path, copied_library):
    fly_until(50, tmp_path / "part", copied_library)
    resume_run(tmp_path / "part")
    for path in (tmp_path / "part").rglob("*"):
        assert path.is_dir() or str(tmp_path).encode() not in path.read_bytes(), path


def test_a_resumed_run_removes_what_a_killed_process_left_and_nothing_of_the_users(tmp_path, copied_library):
    folder = tmp_path / "part"
    fly_until(50, folder, copied_library)
    (folder / f".{FIELD_NAME}.ab12").mkdir()
    (folder / "csv").mkdir(exist_ok=True)
    for name in (f".{FIELD_NAME}.ab12/wing.vtu", f".{FIELD_NAME}.cd34", "csv/.1-2.partial.csv", ".mine"):
        (folder / name).write_bytes(b"left by a killed process, or the user's")
    resume_run(folder)
    assert [path.name for path in folder.rglob(".*")] == [".mine"]


def test_a_mission_without_its_library_is_not_begun(tmp_path):
    with pytest.raises(MissionInputError):
        fly(tmp_path / "never", tmp_path / "é.json")
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


@pytest.fixture
def finished(flown: RunOutcome, tmp_path: Path) -> Path:
    """A copy of the folder of the run."""
    return Path(shutil.copytree(flown.folder, tmp_path / "whole"))


def write_short_report(folder: Path) -> Path:
    """Stand for the report, which has tests of its own and takes seconds."""
    (folder / "report.html").write_text("report", encoding="utf-8")
    return folder / "report.html"


def test_a_run_has_all_groups_and_the_time_of_its_steps(finished):
    beliefs = {"filtered", "smoothed", "predicted"}
    groups = beliefs | {"observed", "policy", "calibration", "truth", "notice", "earned"}
    timing = json.loads((finished / "timing.json").read_text(encoding="utf-8"))
    assert {*open_run(finished).children} == groups
    assert timing["steps"] == 50


def test_a_finished_run_says_so_and_is_not_flown_again(flown, finished, monkeypatch):
    monkeypatch.setattr(workflow, "_write_report", write_short_report)
    monkeypatch.setattr(workflow, "_run", None)
    notes = noted(monkeypatch)
    again = resume_run(finished)
    assert notes == [f"The run in {finished} is finished: nothing is flown again."]
    assert (again.figures, again.report.name, again.origin) == (flown.figures, "report.html", flown.origin)


def test_a_finished_run_is_made_whole_where_something_is_missing(flown, finished, monkeypatch):
    monkeypatch.setattr(workflow, "_write_report", write_short_report)
    store = finished / "run.nc"
    store.write_bytes(store.read_bytes()[:5000])
    resume_run(finished)
    check_same(finished, flown.folder, *SAME)
    (finished / "report.html").unlink()
    assert resume_run(finished).report.is_file()


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
