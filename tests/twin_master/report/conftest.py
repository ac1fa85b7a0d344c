"""A run as its report reads it."""

from pathlib import Path

import pytest
import xarray as xr

from tests.twin_master.report.drawn import flown, stored
from twin_master.report import page as report
from twin_master.report.reading import Run


@pytest.fixture(scope="session")
def run(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The paper's mission, with what the FMU of a wing would have monitored."""
    run = flown(library_file, tmp_path_factory.mktemp("flown") / "run")
    monitored = {
        name: ("step", [value] * run.steps, {"units": unit})
        for name, value, unit in (("strain_error_bound", 1.2e-6, "1"), ("tip_displacement", 0.18, "m"))
    }
    run.tree["truth"] = xr.DataTree(run.tree["truth"].to_dataset().assign(monitored))
    return run


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory, run: Run) -> Path:
    return stored(run, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def no_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make figures and page, but do not render the figures, which takes most of the time."""
    monkeypatch.setattr(report, "to_svg", lambda figure: b'<svg viewBox="0 0 1 1"></svg>')
    monkeypatch.setattr(report, "to_png", lambda figure: b"")
