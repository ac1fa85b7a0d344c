"""The schema of the stores of runs and fleets: one vocabulary, and the page that lists it."""

from benchmarks import store_page
from twin_master.store.schema import SCHEMA, fleet_rows


def test_the_page_is_that_of_the_schema():
    """If this fails: python -m benchmarks.store_page."""
    assert store_page.PAGE.read_text(encoding="utf-8") == store_page.page()


def test_axes_of_a_fleet_have_labels():
    axes = {axis for row in fleet_rows().values() for axis in row[0].split()}
    labelled = {row[0] for row in (SCHEMA["coordinates"] | SCHEMA["fleet_coordinates"]).values()}
    assert axes - labelled == {"pair"}  # the entries of a covariance have no names
