"""Lists in sentences."""

import pytest

from reporting.words import rows_of_table


@pytest.mark.parametrize(
    ("indices", "text"),
    [
        ([7], "row 8"),
        ([7, 8, 11], "rows 8, 9 and 12"),
        ([0, 1, 2, 3, 4], "rows 1, 2, 3, 4 and 5"),
        ([0, 1, 2, 3, 4, 5], "rows 1, 2, 3, 4 and 2 more"),
    ],
)
def test_rows_count_from_one_and_a_long_list_is_cut(indices, text):
    assert rows_of_table(indices) == text
