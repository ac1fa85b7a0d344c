import numpy as np

from evidence.identification.comparison import _row
from evidence.identification.design_file import _NOTES


def test_the_first_gauge_is_gauge_1() -> None:
    difference = np.zeros((3, 24))
    difference[2, 0] = 1.0
    assert _row("strain", "%", difference, (None, None), True).where == "gauge 1"
    difference[1, 23] = -2.0
    assert _row("strain", "%", difference, (None, None), True).where == "gauge 24"


def test_a_written_design_counts_its_gauges_from_1() -> None:
    assert "row A is gauges 1-16, row B gauges 17-24" in _NOTES["gauges"]
