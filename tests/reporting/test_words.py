"""Lists in sentences."""

import pytest

from reporting.words import rows_of_table, with_short_hashes


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


def test_a_hash_for_people_has_its_first_12_digits():
    digest = "0123456789abcdef" * 4
    assert with_short_hashes(f"a.toml (SHA-256 {digest})") == "a.toml (SHA-256 0123456789ab)"
