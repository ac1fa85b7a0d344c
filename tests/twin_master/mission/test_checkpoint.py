"""The checkpoint: what goes in comes out to the last bit, and one that was changed is refused."""

import resource
import signal
from pathlib import Path

import numpy as np
import pytest

from reporting.errors import DiskFullError
from twin_master.errors import NotResumableError
from twin_master.mission import loop as checkpoint
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.mission.loop import Checkpoint, CheckpointFile
from twin_master.mission.turns import Happened, Reading, Turn
from twin_master.network.estimator import Carried
from twin_master.network.inference import Predicted
from twin_master.network.twin import TwinTurn

STATE = b"state\x00\xff"


def flown(count: int) -> list[tuple[Turn, bytes]]:
    """Return turns, each with the state of the asset behind it."""
    generator = np.random.default_rng(0)
    kept = []
    for number in range(count):
        observed = generator.standard_normal(24)
        observed[number] = np.nan
        monitors = {"a.b": float(generator.random())}
        happened = Happened(generator.random(2), generator.random(24), monitors)
        belief = Predicted(np.empty(0), np.empty(0), np.empty(0))
        concluded = TwinTurn(
            forecast=np.ones(1), filtered=np.ones(1), log_evidence=0.0, carried=Carried(1, {}), turn=number,
            prediction=belief, decision_probability=np.array([0.0, 1.0]), next_control=number % 2,
        )  # fmt: skip
        kept.append((Turn(Reading(observed, 1, happened=happened), concluded), STATE * (number + 1)))
    return kept


def write(folder: Path, turns: list[tuple[Turn, bytes]]) -> bytes:
    with CheckpointFile(folder, "abc") as file:
        for turn in turns:
            file.keep(*turn)
    return (folder / JOURNAL_NAME).read_bytes()


def read(folder: Path, config_hash: str = "abc") -> Checkpoint | None:
    with CheckpointFile(folder, config_hash) as file:
        return file.checkpoint


def test_round_trip_is_exact(tmp_path):
    turns = flown(3)
    assert read(tmp_path) is None
    write(tmp_path, turns)
    found = read(tmp_path)
    assert found.decided == [0, 1, 0]
    for reading, (turn, _) in zip(found.readings, turns, strict=True):
        written = turn.reading
        assert reading.control == 1
        assert reading.observed.tobytes() == written.observed.tobytes()
        assert reading.happened.state.tobytes() == written.happened.state.tobytes()
        assert reading.happened.observation.tobytes() == written.happened.observation.tobytes()
        assert reading.happened.monitors == written.happened.monitors
    assert found.asset_state == 3 * STATE


def test_a_line_cut_off_anywhere_is_flown_again(tmp_path):
    turns = flown(4)
    whole = write(tmp_path, turns)
    ends = [n + 1 for n, byte in enumerate(whole) if byte == ord("\n")]
    for cut in [0, 1, ends[0] - 1, ends[0], ends[0] + 70, ends[1] - 1, ends[1], ends[3] + 1, ends[4] - 1]:
        (tmp_path / JOURNAL_NAME).write_bytes(whole[:cut])
        left = sum(end <= cut for end in ends[1:])
        with CheckpointFile(tmp_path, "abc") as file:
            assert file.turns == left
            for turn in turns[left:]:
                file.keep(*turn)
        assert (tmp_path / JOURNAL_NAME).read_bytes() == whole


def test_a_changed_or_foreign_checkpoint_is_refused(tmp_path):
    whole = write(tmp_path, flown(3))
    with pytest.raises(NotResumableError, match="another configuration"):
        read(tmp_path, "other")
    path = tmp_path / JOURNAL_NAME
    lines = whole.splitlines(keepends=True)
    strain = str(flown(1)[0][0].reading.observed[5]).encode()
    for damaged, line in (
        (whole.replace(strain, b"0.25"), 2),
        (lines[0] + lines[2] + lines[1], 2),
        (lines[0] + lines[1] + lines[3], 3),
        (whole[:-2] + b"\n", 4),
        (lines[0] + lines[1].replace(b"a.b", b"a\rb") + lines[2], 2),
        (b"no checkpoint\n" + whole, 1),
        (b"no checkpoint", 1),
        (b"PK\x03\x04\xff", 1),
    ):
        path.write_bytes(damaged)
        with pytest.raises(NotResumableError, match=rf"line {line} of .*changed or is damaged.*--replace"):
            read(tmp_path)


def test_large_states_are_kept_less_often_and_their_turns_flown_again(tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "STATE_ALLOWANCE", 300)
    monkeypatch.setattr(checkpoint, "STATE_SHARE", 30)
    content = np.random.default_rng(1).bytes(100)  # 144 characters in the file
    turns = [(turn, content) for turn, _ in flown(12)]
    whole = write(tmp_path, turns)
    found = read(tmp_path)
    assert len(found.readings) == 10
    with CheckpointFile(tmp_path, "abc") as file:
        for turn in turns[10:]:
            file.keep(*turn)
    assert (tmp_path / JOURNAL_NAME).read_bytes() == whole


def test_a_full_disk_leaves_the_turns_before(tmp_path):
    turns = flown(3)
    size = len(write(tmp_path, turns[:2]))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        with CheckpointFile(tmp_path, "abc") as file:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size + 50, hard))
            with pytest.raises(DiskFullError, match="No space is left"):
                file.keep(*turns[2])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, ignored)
    assert (tmp_path / JOURNAL_NAME).stat().st_size == size
