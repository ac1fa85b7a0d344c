"""The schema of the stores of runs and fleets: one vocabulary, and the page that lists it."""

import pytest

from benchmarks import store_page
from twin_master.store.schema import SCHEMA

ONLY_IN_FLEETS = {"filtered/last_probability", "notice/count", "notice/first_step", "truth/{parameter}"}
"""Variables of fleets, inside the groups of a run, that a run does not have under this name."""
SHARED = [path for path in SCHEMA["fleet"] if "/" in path and path not in ONLY_IN_FLEETS]


def test_the_page_is_that_of_the_schema():
    """If this fails: python -m benchmarks.store_page."""
    assert store_page.PAGE.read_text(encoding="utf-8") == store_page.page()


@pytest.mark.parametrize("path", SHARED)
def test_a_variable_of_a_fleet_has_the_axes_and_the_unit_of_a_run(path):
    group, _, name = path.partition("/")
    variables = SCHEMA["belief"] | SCHEMA[group] if group == "filtered" else SCHEMA[group]
    axes, unit, _ = variables[name]
    assert SCHEMA["fleet"][path][:2] == [axes.replace("{lead}", "step"), unit]


def test_axes_of_a_fleet_have_labels():
    axes = {axis for row in SCHEMA["fleet"].values() for axis in row[0].split()}
    labelled = {row[0] for row in (SCHEMA["coordinates"] | SCHEMA["fleet_coordinates"]).values()}
    assert axes - labelled == {"pair"}  # the entries of a covariance have no names
