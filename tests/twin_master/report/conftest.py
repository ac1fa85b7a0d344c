"""A run as its report reads it."""

from pathlib import Path

import pytest
import xarray as xr

from tests.twin_master.report import synthetic_run
from twin_master.report import page as report
from twin_master.report.reading import Run, read_run


@pytest.fixture(scope="session")
def tree() -> xr.DataTree:
    return synthetic_run.build_tree()


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory, tree: xr.DataTree) -> Path:
    return synthetic_run.write_run(tmp_path_factory.mktemp("runs") / "run", tree)


@pytest.fixture(scope="session")
def run(folder: Path) -> Run:
    return read_run(folder)


@pytest.fixture
def no_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make figures and page, but do not render the figures, which takes most of the time."""
    monkeypatch.setattr(report, "to_svg", lambda figure: b'<svg viewBox="0 0 1 1"></svg>')
    monkeypatch.setattr(report, "to_png", lambda figure: b"")
