"""What results show in a notebook: tables as HTML, and pictures that hold the stored numbers."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

import uav_twin
from reporting.pages.notebook import MOST_ROWS, html_table, new_panels
from tests.conftest import synthetic_calibration
from tests.reporting.test_page import parse
from tests.twin_master.runs import changed_scenario

mpl.use("Agg")


@pytest.fixture(scope="module")
def outcome(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    short = changed_scenario("paper_level_turns", {"mission": {"steps": 8}})
    folder = tmp_path_factory.mktemp("notebook") / "run"
    return uav_twin.fly(short, folder, {"strain_library": library_file}, report=False)


def test_a_table_is_well_formed_and_escaped():
    text = html_table("<run>", ("a", "b"), [("<x>", 1)], ["it's & so on"])
    parse(text)
    assert "<td>&lt;x&gt;</td>" in text
    assert "&lt;run&gt;" in text


def test_a_long_table_is_cut_with_a_line_that_says_so():
    text = html_table("run", ("a", "b"), [("x", 1)] * (MOST_ROWS + 2))
    parse(text)
    assert text.count("<td>x</td>") == MOST_ROWS
    assert "and 2 more" in text


def test_a_table_without_headings_has_no_row_for_them():
    assert "<th>" not in html_table("", (), [("x",)])


def test_a_run_shows_its_figures_and_its_belief_with_the_truth(outcome):
    text = outcome._repr_html_()
    parse(text)
    assert "rms error of the estimated stiffness loss of region 1" in text
    first, second = outcome.plot()
    assert (first.get_ylabel(), second.get_ylabel()) == ("z1 (%)", "z2 (%)")
    lines = {line.get_label(): line.get_ydata() for line in second.get_lines()}
    tree = outcome.tree
    np.testing.assert_allclose(lines["truth"], 100.0 * tree["truth"]["state"].sel(region="z2"))
    believed = lines["believed, with two standard deviations"]
    np.testing.assert_allclose(believed, 100.0 * tree["filtered"]["mean"].sel(region="z2"))


def test_functions_take_the_tree_and_panels_of_the_user(outcome):
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(2)
    assert uav_twin.plot_belief(outcome.tree, panels) == list(panels)
    with pytest.raises(ValueError, match="The picture has 2 panels, but 1 were given"):
        uav_twin.plot_belief(outcome.tree, panels[0])
    with pytest.raises(TypeError, match=r"a str was given: open a folder with `uav_twin.open_run`"):
        uav_twin.plot_belief("runs/mine")  # type: ignore[arg-type]
    panel = uav_twin.plot_residuals(outcome)
    (mesh,) = panel.collections
    residual = outcome.tree["filtered"]["residual"].transpose("sensor", "step").values
    np.testing.assert_allclose(np.asarray(mesh.get_array()), residual)
    pyplot.close("all")
    assert figure.number not in pyplot.get_fignums()


def test_a_fleet_shows_how_its_twins_fared_and_their_courses(library_file, tmp_path):
    fleet = uav_twin.ensemble("growing_damage", range(2), {"strain_library": library_file})
    flown = uav_twin.fly_fleet(fleet, tmp_path / "fleet")
    text = flown._repr_html_()
    parse(text)
    assert "rms error of the estimated z1" in text
    panels = flown.plot()
    assert [panel.get_ylabel() for panel in panels] == ["z1, %", "z2, %"]
    believed = uav_twin.open_fleet(flown.folder)["growing_damage/filtered/mean"].values[..., 0]
    np.testing.assert_allclose(panels[0].get_lines()[0].get_ydata(), 100.0 * np.median(believed, axis=0))


def test_a_calibration_shows_prior_and_posterior_of_each_parameter():
    calibration = synthetic_calibration()
    text = calibration._repr_html_()
    parse(text)
    assert "<th>posterior</th>" in text
    panels = calibration.plot()
    assert len(panels) == len(calibration.priors)
    assert panels[0].get_xlabel() == calibration.priors[0].quantity.axis_title


def test_panels_are_below_one_another():
    assert len(new_panels(3)) == 3
