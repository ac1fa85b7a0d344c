"""The journal of a mission: what is missing is flown again, what was changed refused."""

from pathlib import Path

import numpy as np
import pytest

from tests.twin_master.runs import journal, of_library
from twin_master.assets.strain_library_source import StrainLibrarySource
from twin_master.errors import NotResumableError
from twin_master.mission import loop
from twin_master.mission.journal import (
    JOURNAL_NAME,
    JournalFile,
    line_of,
)
from twin_master.mission.preparation import Knowledge
from twin_master.mission.truth import Plant
from twin_master.mission.turns import History


class Heavy(Plant):
    """A plant whose asset has a state of a hundred bytes: 144 characters in the file."""

    def save_state(self) -> bytes:
        return np.random.default_rng(self.step).bytes(100)

    def restore(self, flown: History, asset_state: bytes) -> None:
        self.step, self._state = len(flown.turns), flown.state[-1]
        assert asset_state == self.save_state()


Known = tuple[Knowledge, StrainLibrarySource]


@pytest.fixture(scope="module")
def known(library_file: Path) -> Known:
    return of_library("level_turns", library_file)


def fly(known: Known, folder: Path, turns: int, config_hash: str = "abc") -> History:
    """Fly a mission, or the rest of one, up to a turn."""
    knowledge, source = known
    plant = Heavy(knowledge.scenario, knowledge.truth(3), source.open())
    with JournalFile(folder, config_hash) as file:
        history = loop.taken_up(file, knowledge, plant)
        history.resumed_at = history.twin.turns
        keep = loop.kept_in(file, plant)
        flight = loop.operate(history.twin, plant, keep, history.add)
        while history.twin.turns < turns:
            next(flight)
    return history


def test_a_line_cut_off_anywhere_is_flown_again(known, tmp_path):
    fly(known, tmp_path, 4)
    whole = (tmp_path / JOURNAL_NAME).read_bytes()
    ends = [n + 1 for n, byte in enumerate(whole) if byte == ord("\n")]
    for cut in [0, 1, ends[0] - 1, ends[0], ends[0] + 70, ends[1] - 1, ends[1], ends[3] + 1, ends[4] - 1]:
        (tmp_path / JOURNAL_NAME).write_bytes(whole[:cut])
        assert fly(known, tmp_path, 4).resumed_at == sum(end <= cut for end in ends[1:])
        assert (tmp_path / JOURNAL_NAME).read_bytes() == whole


def test_a_changed_or_foreign_journal_is_refused(known, tmp_path):
    fly(known, tmp_path, 3)
    path = tmp_path / JOURNAL_NAME
    whole = path.read_bytes()
    with pytest.raises(NotResumableError, match="another configuration"):
        fly(known, tmp_path, 3, "other")
    lines = whole.splitlines(keepends=True)
    strain = str(journal(tmp_path)[0]["observed"][5]).encode()
    for damaged, line in (
        (whole.replace(strain, b"0.25"), 2),
        (lines[0] + lines[2] + lines[1], 2),
        (lines[0] + lines[1] + lines[3], 3),
        (lines[0] + lines[2] + lines[3], 2),
        (whole[:-2] + b"\n", 4),
        (lines[0] + lines[1].replace(b"monitors", b"monit\rrs") + lines[2], 2),
        (b"no checkpoint\n" + whole, 1),
        (b"no checkpoint", 1),
        (b"PK\x03\x04\xff", 1),
    ):
        path.write_bytes(damaged)
        with pytest.raises(NotResumableError, match=rf"line {line} of .*changed or is damaged.*--replace"):
            fly(known, tmp_path, 3)


def test_a_journal_that_decided_otherwise_in_any_turn_is_refused(known, tmp_path):
    fly(known, tmp_path, 4)
    lines = (tmp_path / JOURNAL_NAME).read_bytes().splitlines(keepends=True)
    for turn, record in enumerate(journal(tmp_path)):
        other = line_of(record | {"next_control": 1 - record["next_control"]})
        (tmp_path / JOURNAL_NAME).write_bytes(b"".join([*lines[: turn + 1], other, *lines[turn + 2 :]]))
        with pytest.raises(NotResumableError, match=f"decided otherwise after turn {turn} .*--replace"):
            fly(known, tmp_path, 4)


def test_large_states_are_kept_less_often_and_their_turns_flown_again(known, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "STATE_ALLOWANCE", 5000)
    monkeypatch.setattr(loop, "STATE_SHARE", 50)
    fly(known, tmp_path, 12)
    whole, kept = (tmp_path / JOURNAL_NAME).read_bytes(), [n["asset_state"] for n in journal(tmp_path)]
    last = max(number for number, state in enumerate(kept) if state is not None)
    assert [state is None for state in kept[-6:]].count(True) == 4
    assert last < 11
    assert fly(known, tmp_path, 12).resumed_at == last + 1
    assert (tmp_path / JOURNAL_NAME).read_bytes() == whole
