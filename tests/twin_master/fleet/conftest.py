"""The fleet of wings with recordings that several files test."""

from pathlib import Path

import pytest

from tests.twin_master.fleet.recordings import write_fleet


@pytest.fixture
def fleet_file(library_file: Path, tmp_path: Path) -> Path:
    """A fleet of three wings with a recording each."""
    return write_fleet(library_file, tmp_path)
