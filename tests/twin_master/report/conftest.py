"""Runs of the wing of a strain library as their report reads them, with changes; what a figure shows."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from reporting.pages import figures
from reporting.pages.page import PageFigure, ReportFigure, render_page
from tests.twin_master.runs import changed_scenario
from twin_master.report import page as report
from twin_master.report.reading import Run, read_run
from twin_master.scenario.schema import Scenario
from uav_twin import fly


def flown(library: Path, folder: Path, **mission: int) -> Run:
    """Fly the paper's mission, of another length, with the wing of a strain library, and read the run."""
    loaded, given = changed_scenario("paper_level_turns", {"mission": mission}), {"strain_library": library}
    return read_run(fly(loaded, folder, given, report=False).folder)


def altered(run: Run, **values: np.ndarray | None) -> Run:
    """A run with other values of variables, GROUP__VARIABLE; None takes a group or a variable away."""
    groups = {name: run.tree[name].to_dataset().copy() for name in run.tree.children}
    for name, content in values.items():
        group, _, variable = name.partition("__")
        if content is None and not variable:
            del groups[group]
        elif content is None:
            groups[group] = groups[group].drop_vars(variable)
        else:
            groups[group][variable] = (groups[group][variable].dims, content)
    return replace(run, tree=xr.DataTree.from_dict({"/": xr.Dataset(attrs=run.tree.attrs), **groups}))


def rescripted(run: Run, **tables: dict[str, Any]) -> Run:
    """A run whose scenario has other values in its tables."""
    scenario = run.scenario.to_dict()
    for table, changes in tables.items():
        if isinstance(scenario[table], dict):
            scenario[table] |= changes
        else:
            scenario[table] = [entry | changes for entry in scenario[table]]
    config = {**run.config, "scenario": scenario}
    return replace(run, scenario=Scenario.model_validate(scenario), config=config)


def panel(figure: Figure, title: str) -> Axes:
    (found,) = [axes for axes in figure.axes if title in axes.get_title(loc="left")]
    return found


def line(axes: Axes, label: str) -> np.ndarray:
    (found,) = [item for item in axes.get_lines() if item.get_label() == label]
    return np.asarray(found.get_xydata())


@pytest.fixture(scope="session")
def folder(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's mission, with what the FMU of a wing would have monitored."""
    place = tmp_path_factory.mktemp("flown") / "run"
    steps = flown(library_file, place).step_count
    monitored = {
        name: ("step", [value] * steps, {"units": unit})
        for name, value, unit in (("strain_error_bound", 1.2e-6, "1"), ("tip_displacement", 0.18, "m"))
    }
    xr.Dataset(monitored).to_netcdf(place / "run.nc", mode="a", group="truth", engine="h5netcdf")
    return place


@pytest.fixture(scope="session")
def run(folder: Path) -> Run:
    """What a report reads of it."""
    return read_run(folder)


@pytest.fixture
def hold(monkeypatch: pytest.MonkeyPatch) -> Callable[[Run], None]:
    """What lets a report find a run that is not written: NetCDF takes a second each way."""
    return lambda run: monkeypatch.setattr(report, "read_run", lambda _folder: run)


def figures_of_unwritten(run: Run, now: int) -> dict[str, ReportFigure]:
    """Return the figures of the report of a run that is not written, by their names."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "read_run", lambda _folder: run)
        return {figure.name: figure for figure in report.report_figures(Path("unwritten"), now)}


def page_of(run: Run, *figures: str) -> str:
    """Return the page of a run as HTML; the named figures are empty drawings."""
    drawing = b'<svg viewBox="0 0 1 1"></svg>'
    drawn = {name: PageFigure(name, drawing, name, "") for name in figures}
    return render_page(report.run_page(run, drawn))


@pytest.fixture
def no_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make figures and page, but do not render the figures, which takes most of the time."""
    monkeypatch.setattr(figures, "to_svg", lambda figure: b'<svg viewBox="0 0 1 1"></svg>')
    monkeypatch.setattr(figures, "to_png", lambda figure: b"")
