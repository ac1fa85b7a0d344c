"""Tables on the terminal."""

from io import StringIO

import pytest
from rich.console import Console

from discrepancy.catalogue.library import load_catalogue
from reporting.console_table import broken, console_table


def printed(headings: tuple[str, ...], rows: list[tuple[str, ...]], width: int) -> list[str]:
    console = Console(file=StringIO(), width=width, highlight=False, markup=False)
    console.print(console_table(headings, rows, width))
    assert isinstance(console.file, StringIO)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("coulomb_friction", ["coulomb_friction"]),
        ("temperature_dependent_modulus", ["temperature_", "dependent_modulus"]),
        ("temperature-dependent modulus", ["temperature-", "dependent modulus"]),
        ("a_verylongwordwithoutanybreak", ["a_", "verylongwordwithoutanybreak"]),
        ("", [""]),
    ],
)
def test_long_words_break_where_a_reader_expects_it(text, lines):
    assert broken(text, 20).split("\n") == lines


@pytest.mark.parametrize("width", [80, 200])
def test_every_identifier_can_be_read_in_the_first_column(width):
    catalogue = load_catalogue()
    rows = [(item.identifier, item.name, "0.0000123 K", "a place, upper skin") for item in catalogue]
    lines = printed(("effect", "name", "detectable from", "shows best at"), rows, width)
    assert max(map(len, lines)) <= width
    first = "\n".join(line.split(" ", 2)[1] for line in lines if len(line) > 2)
    for item in catalogue:
        assert (item.identifier if width > 80 else broken(item.identifier, 20)) in first


def test_columns_without_any_entry_are_left_out():
    rows = [("mass ratio", "", "1"), ("length", "", "2")]
    assert "unit" not in "".join(printed(("parameter", "unit", "value"), rows, 80))
    assert "unit" in "".join(printed(("parameter", "unit", "value"), [("length", "m", "2")], 80))


@pytest.mark.parametrize("width", [80, 100])
def test_a_long_title_does_not_break_the_numbers_beside_it(width):
    rows = [
        ("posterior mean of the Young modulus factor of the wing box", "1.008", "1.0073 (1)"),
        ("filtered rms error of z1", "4.1592 points", "3.8 points (2)"),
        ("asset, per turn", "0.281 ms (largest 3.14 ms)", ""),
    ]
    lines = printed(("figure", "this run", "reference"), rows, width)
    for number in ("1.008", "1.0073 (1)", "4.1592 points", "3.8 points (2)"):
        assert sum(number in line for line in lines) == 1, lines
