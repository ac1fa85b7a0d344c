"""The journal: short lines that are read back to the same bits, and what a kill or damage leaves of it."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.own_process import ended_by
from tests.twin_master.runs import journal, of_library
from twin_master.assets.strain_library_source import StrainLibrarySource
from twin_master.errors import NotResumableError
from twin_master.mission.flights import fly
from twin_master.mission.journal import JOURNAL_NAME, JournalFile, encode_line, record_of_line, records
from twin_master.mission.journal_packing import full_record, pack_numbers, unpack_numbers
from twin_master.mission.plant import Truth
from twin_master.mission.preparation import Knowledge
from twin_master.mission.recent_parts import BLOCK_STEPS, RECENT_NAMES, RecentPartsFile, is_whole_step
from twin_master.mission.replay import journal_sink, restore_flight
from twin_master.mission.steps import History
from twin_master.scenario.reading import load_scenario
from twin_master.viewer.flight import Flight

Known = tuple[Knowledge, StrainLibrarySource]
PATH = Path(JOURNAL_NAME)


# ---------------------------------------------------------------- the short form


EXTREMES = [0.1, -0.0, 5e-324, 1.7976931348623157e308, 1.0000000000000002, None, -1 / 3]


def test_numbers_are_read_back_to_the_same_bits():
    rng = np.random.default_rng(1)
    values = [*EXTREMES, *rng.standard_normal(1000).tolist()]
    again = unpack_numbers(pack_numbers(values))
    assert [repr(value) for value in again] == [repr(value) for value in values]


LEARNT = {
    name: {"mean": 1 / 3, "standard_deviation": 0.1, "lower": -0.2, "upper": 5e-7, "unit": unit}
    for name, unit in (("noise_scale[10]", "1"), ("e", "Pa"))
}
INTAKE = {
    "counts": {"received": 7, "missing": 1, "late": 0, "duplicates": 0, "rejected": 0},
    "given": "2220112",
    "clock": None,
    "counter": {"stretches": [[0, 5, False]], "latest": 9, "rate": None, "rate_is_reported": False},
    "source": {"beginning": "0123456789abcdef", "read": 9},
}
RECORDS = [
    {"step": 3, "observed": EXTREMES, "observation": [0.25, 1e-9], "learnt": LEARNT},
    {"step": 3, "filtered": [0.0, 0.25, 0.75], "decision_probability": [1.0, 0.0]},
    {"step": 3, "filtered": np.random.default_rng(1).dirichlet(np.ones(125)).tolist()},
    {"step": 3, "observed": [1.0], "observation_step": 3, "intake": INTAKE},
    {"step": 3, "observed": [1.0], "observation_step": 1, "intake": INTAKE | {"given": ""}},
    {"step": 3, "suspicion": {"none_of_these": 0.25, "hypotheses": {"none of these": 0.25}}},
    {"step": 3, "suspicion": {"none_of_these": 0.5, "hypotheses": {"none of these": 0.25}}},
    {"group": 1, "rows": [0, 4], "failures": {}},
]


@pytest.mark.parametrize("record", RECORDS)
def test_a_record_is_read_back_from_its_short_form(record):
    assert record_of_line(encode_line(record), PATH) == record


def test_a_line_of_the_first_format_is_read_as_it_is():
    record = RECORDS[0] | RECORDS[1] | RECORDS[3] | RECORDS[5]
    assert full_record(json.loads(json.dumps(record))) == record


@pytest.mark.parametrize(
    "packed", [{"observed": "no base 64!"}, {"filtered": {"0": 1.0}}, {"intake": {"given": "2*2"}}]
)
def test_an_entry_with_another_layout_is_left_to_who_uses_it(packed):
    assert full_record(packed) == packed


def test_the_journal_of_a_later_version_is_refused():
    line = encode_line({"config_hash": "abc", "format": 3})
    with pytest.raises(NotResumableError, match=r"journal\.jsonl has the format 3, .* reads up to 2"):
        record_of_line(line, PATH)


# ---------------------------------------------------------------- missions of 200 steps

STEPS = 200


def known_of(name: str, library: Path, steps: int) -> Known:
    mission = load_scenario(name).scenario.mission.model_copy(update={"steps": steps})
    return of_library(name, library, mission=mission)


def flown(known: Known, folder: Path) -> History:
    """Fly a mission, or the rest of one."""
    knowledge, source = known
    plant = knowledge.plant(knowledge.truth(3), source.open())
    with JournalFile(folder, "abc") as file:
        before = restore_flight(file, knowledge, plant)
        return fly(knowledge.scenario, before.twin, plant, journal_sink(file, plant), history=before)


class LongMission:
    """A mission of 200 steps and its folder."""

    def __init__(self, name: str, library: Path, folder: Path) -> None:
        self.known = known_of(name, library, STEPS)
        self.folder = folder
        self.history = flown(self.known, folder)
        self.size = (folder / JOURNAL_NAME).stat().st_size


@pytest.fixture(scope="module")
def learning(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> LongMission:
    return LongMission("level_turns_learning", library_file, tmp_path_factory.mktemp("learning"))


@pytest.fixture(scope="module")
def plain(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> LongMission:
    return LongMission("level_turns", library_file, tmp_path_factory.mktemp("plain"))


def test_a_step_takes_at_most_a_kilobyte_of_the_journal(learning, plain):
    assert plain.size < learning.size <= 1000 * STEPS


def test_observed_and_true_values_are_in_the_journal_to_the_bit(learning):
    knowledge, _ = learning.known
    truth: Truth = knowledge.truth(3)
    for record, step in zip(journal(learning.folder), learning.history.steps, strict=True):
        observed = np.array(record["observed"], dtype=float)
        estimate = truth.noise_free(record["step"], observed)
        true_values = (estimate.view(np.int64) + record["observation_difference"]).view(np.float64)
        assert observed.tobytes() == step.reading.observed.tobytes()
        assert true_values.tobytes() == step.reading.ground_truth.observation.tobytes()


def learnt_of(history: History, step: int) -> dict[str, Any]:
    return {name: vars(learnt) for name, learnt in history.steps[step].twin_step.learnt.items()}


def test_lines_of_whole_steps_have_what_was_learnt_and_others_have_not(learning):
    for record, _, _ in records(learning.folder / JOURNAL_NAME):
        assert ("learnt" in record) == is_whole_step(record["step"])
        if "learnt" in record:
            assert record["learnt"] == learnt_of(learning.history, record["step"])


def test_the_last_steps_have_all_that_was_learnt_and_suspected(learning):
    last_records = journal(learning.folder)[-BLOCK_STEPS:]
    for record in last_records:
        assert record["learnt"] == learnt_of(learning.history, record["step"])
        assert len(record["suspicion"]["log_evidence_gauge"]) == 24


def test_a_viewer_carries_on_what_was_learnt(learning, monkeypatch):
    """The last steps have their own; an earlier one has that of the last whole step."""
    knowledge, _ = learning.known
    monkeypatch.setattr("twin_master.viewer.flight.read_scenario", lambda _folder: knowledge.scenario)
    monkeypatch.setattr("twin_master.viewer.flight.load_knowledge", lambda *_arguments: knowledge)
    flight = Flight(learning.folder)
    flight.update()
    shown = [record["learnt"] for record in flight.records_of_steps(0, STEPS)]
    sources = [0, *[1] * 3, *[4] * 12, *[16] * 48, *[64] * 64]
    assert shown[:128] == [learnt_of(learning.history, step) for step in sources]
    assert shown[128:] == [learnt_of(learning.history, step) for step in range(128, STEPS)]


# ---------------------------------------------------------------- kills and damage

FLOWN_STEPS = 70
"""Number of steps of a mission whose last parts are in both files."""


class WholeMission:
    """A mission that was flown in one go."""

    def __init__(self, library: Path, folder: Path) -> None:
        self.known = known_of("level_turns_learning", library, FLOWN_STEPS)
        self.history = flown(self.known, folder)
        self.files = {name: (folder / name).read_bytes() for name in (JOURNAL_NAME, *RECENT_NAMES)}

    def copy(self, folder: Path, **changed: bytes | None) -> None:
        """Write its files into a folder, in part with another content, or without one."""
        contents = self.files | {
            JOURNAL_NAME: changed.get("journal", self.files[JOURNAL_NAME]),
            RECENT_NAMES[0]: changed.get("recent_0", self.files[RECENT_NAMES[0]]),
            RECENT_NAMES[1]: changed.get("recent_1", self.files[RECENT_NAMES[1]]),
        }
        for name, content in contents.items():
            if content is not None:
                (folder / name).write_bytes(content)

    def check_resumed(self, folder: Path) -> History:
        """Fly the rest, and check that the result is that of the whole to the bit."""
        resumed = flown(self.known, folder)
        assert (folder / JOURNAL_NAME).read_bytes() == self.files[JOURNAL_NAME]
        for name in ("observed", "filtered", "log_evidence", "learnt", "observation", "predicted"):
            np.testing.assert_array_equal(getattr(resumed, name), getattr(self.history, name))
        return resumed


@pytest.fixture(scope="module")
def whole(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> WholeMission:
    return WholeMission(library_file, tmp_path_factory.mktemp("whole"))


def lines_up_to(content: bytes, count: int) -> bytes:
    """Return the first lines of a file; a negative number is counted from the end."""
    return b"".join(content.splitlines(keepends=True)[:count])


def killed_where(known: Known, folder: Path, patch: Callable[[pytest.MonkeyPatch], None]) -> None:
    """Fly in a process of its own that kills itself with SIGKILL where a patch says so."""

    def fly_patched() -> None:
        with pytest.MonkeyPatch.context() as monkeypatch:
            patch(monkeypatch)
            flown(known, folder)

    assert ended_by(fly_patched) == -signal.SIGKILL


@pytest.mark.parametrize("step", [0, 5, 63, 64, 66])
def test_a_kill_between_the_parts_of_a_step_and_its_line_loses_no_step(whole, tmp_path, step):
    def patch(monkeypatch: pytest.MonkeyPatch) -> None:
        append = RecentPartsFile.append

        def dying(self: RecentPartsFile, step_of_line: int, *arguments: Any) -> None:
            append(self, step_of_line, *arguments)
            if step_of_line == step:
                os.kill(os.getpid(), signal.SIGKILL)

        monkeypatch.setattr(RecentPartsFile, "append", dying)

    killed_where(whole.known, tmp_path, patch)
    resumed = whole.check_resumed(tmp_path)
    assert resumed.resumed_at == step
    for name in RECENT_NAMES:
        assert (tmp_path / name).read_bytes() == whole.files[name]


@pytest.mark.parametrize("written", [0, 1, 30, 2000])
def test_a_kill_within_the_parts_of_a_step_loses_no_step(whole, tmp_path, written):
    def patch(monkeypatch: pytest.MonkeyPatch) -> None:
        append = RecentPartsFile.append

        def dying(self: RecentPartsFile, step: int, *arguments: Any) -> None:
            size = self.size_before(step)
            append(self, step, *arguments)
            if step == 66:
                os.truncate(self._paths[1], size + written)
                os.kill(os.getpid(), signal.SIGKILL)

        monkeypatch.setattr(RecentPartsFile, "append", dying)

    killed_where(whole.known, tmp_path, patch)
    resumed = whole.check_resumed(tmp_path)
    assert resumed.resumed_at == 66
    assert (tmp_path / RECENT_NAMES[1]).read_bytes() == whole.files[RECENT_NAMES[1]]


@pytest.mark.parametrize("cut", [1, 500])
def test_a_line_that_a_kill_cut_off_is_flown_again(whole, tmp_path, cut):
    whole.copy(tmp_path, journal=whole.files[JOURNAL_NAME][:-cut])
    assert whole.check_resumed(tmp_path).resumed_at == FLOWN_STEPS - 1


@pytest.mark.parametrize("steps", [1, 6, 30, 63, 65])
def test_parts_of_later_steps_than_the_last_line_are_passed_over(whole, tmp_path, steps):
    journal_of_first_steps = lines_up_to(whole.files[JOURNAL_NAME], 1 + steps)
    whole.copy(tmp_path, journal=journal_of_first_steps)
    assert whole.check_resumed(tmp_path).resumed_at == steps


def test_steps_whose_parts_are_lost_are_flown_again(whole, tmp_path):
    """As after a loss of power: the line is on the disk, and its parts are not."""
    whole.copy(tmp_path, recent_1=lines_up_to(whole.files[RECENT_NAMES[1]], -2))
    assert whole.check_resumed(tmp_path).resumed_at == FLOWN_STEPS - 2


@pytest.mark.parametrize("content", [None, b"", b"\x00" * 5000, b"PK\x03\x04\xff\n"])
def test_without_parts_a_mission_is_resumed_from_a_whole_line_of_its_journal(whole, tmp_path, content):
    whole.copy(tmp_path, recent_0=content, recent_1=content)
    assert whole.check_resumed(tmp_path).resumed_at == BLOCK_STEPS + 1


def test_parts_that_were_changed_are_not_used(whole, tmp_path):
    changed = whole.files[RECENT_NAMES[1]].replace(b'"mean":0.', b'"mean":1.')
    assert changed != whole.files[RECENT_NAMES[1]]
    whole.copy(tmp_path, recent_1=changed)
    assert whole.check_resumed(tmp_path).resumed_at == BLOCK_STEPS + 1
