"""The run folder: what killed writers leave is removed, and nothing else is."""

from __future__ import annotations

from pathlib import Path

from twin_master.run_folder import FIELD_NAME, tidy


def test_what_killed_writers_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    half_field = tmp_path / f".{FIELD_NAME}.ab12"
    half_field.mkdir()
    (half_field / "wing.vtu").write_bytes(b"half")
    (tmp_path / f".{FIELD_NAME}.cd34").write_bytes(b"half")
    (tmp_path / FIELD_NAME).write_bytes(b"whole")
    (tmp_path / ".mine").write_bytes(b"mine")
    (tmp_path / "csv").mkdir()
    tidy(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".mine", "csv", FIELD_NAME]
    tidy(tmp_path)
