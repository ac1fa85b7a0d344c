"""Runs that are cut off, and run folders that are compared."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from twin_master.mission.loop import CheckpointFile


@contextmanager
def cut_off_after(turns: int) -> Iterator[None]:
    """Let the run within die, as it must, once so many turns are on the disk."""
    keep = CheckpointFile.keep

    def dying(self: CheckpointFile, *turn: Any) -> None:
        keep(self, *turn)
        if self.turns == turns:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CheckpointFile, "keep", dying)
        with pytest.raises(KeyboardInterrupt):
            yield


def check_same(first: Path, second: Path, *names: str) -> None:
    """Compare files of two folders to the last bit."""
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name
