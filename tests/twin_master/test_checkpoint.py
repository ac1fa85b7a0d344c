"""The checkpoint: what goes in comes out to the last bit, and a damaged one is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from twin_master.checkpoint import CHECKPOINT_NAME, Checkpoint, read_checkpoint, write_checkpoint
from twin_master.errors import NotResumableError
from twin_master.plant import PlantRecord


def checkpoint() -> Checkpoint:
    generator = np.random.default_rng(0)
    observed = generator.standard_normal((3, 24))
    observed[1, 2] = np.nan
    record = PlantRecord(generator.random((3, 2)), generator.random((3, 24)), {"a.b": generator.random(3)})
    return Checkpoint("abc", observed, np.array([1, 1, 0, 1]), record, b"state\x00\xff")


def test_round_trip_is_exact(tmp_path: Path) -> None:
    written = checkpoint()
    write_checkpoint(tmp_path, written)
    read = read_checkpoint(tmp_path, "abc")
    assert read is not None
    assert read.turns == 3
    np.testing.assert_array_equal(read.observed, written.observed)
    np.testing.assert_array_equal(read.control_index, written.control_index)
    np.testing.assert_array_equal(read.plant.state, written.plant.state)
    np.testing.assert_array_equal(read.plant.observation, written.plant.observation)
    np.testing.assert_array_equal(read.plant.monitors["a.b"], written.plant.monitors["a.b"])
    assert read.asset_state == b"state\x00\xff"


def test_none_before_the_first_turn(tmp_path: Path) -> None:
    assert read_checkpoint(tmp_path, "abc") is None


def test_a_damaged_or_foreign_checkpoint_is_refused(tmp_path: Path) -> None:
    write_checkpoint(tmp_path, checkpoint())
    with pytest.raises(NotResumableError, match="another configuration"):
        read_checkpoint(tmp_path, "other")
    path = tmp_path / CHECKPOINT_NAME
    content = path.read_bytes()
    for damaged in (content[: len(content) // 2], b"", b"no archive"):
        path.write_bytes(damaged)
        with pytest.raises(NotResumableError, match="cannot be read"):
            read_checkpoint(tmp_path, "abc")
