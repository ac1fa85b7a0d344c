"""Private folders of FMUs: which paths they may have, and how they are removed on any system."""

from pathlib import Path

import pytest

from fmu_asset import folders
from fmu_asset.folders import plain_folder, remove_folder


@pytest.mark.parametrize(
    "path", ["/tmp/a-b_c.d", "C:/Users/RUNNER~1/AppData/Local/Temp", "d:/temp"]
)
def test_a_plain_path_is_taken_on_each_system(path):
    assert folders._PLAIN_PATH.fullmatch(path)


@pytest.mark.parametrize(
    "path", ["/tmp/a b", "/tmp/größe", "/tmp/a~b", "C:/Program Files", "C:", "/tmp/a:b"]
)
def test_a_path_that_some_fmus_do_not_survive_is_not_taken(path):
    assert folders._PLAIN_PATH.fullmatch(path) is None


@pytest.mark.parametrize("has_opened_paths", [True, False])
def test_a_folder_is_removed_with_the_folder_that_is_its_alone(monkeypatch, has_opened_paths):
    monkeypatch.setattr(folders, "_HAS_OPENED_PATHS", has_opened_paths)
    folder = plain_folder()
    (folder / "a" / "b").mkdir(parents=True)
    (folder / "a" / "file").write_text("x", encoding="utf-8")
    remove_folder(folder)
    assert not folder.parent.exists()


@pytest.mark.parametrize("has_opened_paths", [True, False])
def test_what_a_link_leads_to_is_not_removed(monkeypatch, tmp_path, has_opened_paths):
    monkeypatch.setattr(folders, "_HAS_OPENED_PATHS", has_opened_paths)
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "file").write_text("x", encoding="utf-8")
    folder = plain_folder()
    Path(folder, "link").symlink_to(tmp_path / "kept")
    remove_folder(folder)
    assert (tmp_path / "kept" / "file").is_file()
    assert not folder.exists()
