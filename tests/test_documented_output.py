"""What a page prints as the answer of its commands is what they answer, to the digits that it prints."""

import contextlib
import re
from pathlib import Path

import pytest

from benchmarks.pictures.picture import PRINTED_NUMBER, agrees
from tests import command_line
from tests.conftest import REFERENCE
from twin_master.fleet.comparison import COUNTS_OF_FLEETS, PRINTED_STATISTICS_OF_FLEETS
from twin_master.scenario.schema import SUMMARY_TITLES

DOCS = Path(__file__).parents[1] / "docs"


def block(page: str, language: str) -> list[str]:
    """Return the lines of the first fenced block of a page in a language."""
    text = (DOCS / page).read_text(encoding="utf-8")
    match = re.search(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert match is not None
    return match[1].splitlines()


def same_line(printed: str, answered: str) -> bool:
    """Return whether two lines have the same words, and numbers that agree."""
    if re.split(PRINTED_NUMBER, printed) != re.split(PRINTED_NUMBER, answered):
        return False
    pairs = zip(re.findall(PRINTED_NUMBER, printed), re.findall(PRINTED_NUMBER, answered), strict=True)
    return all(agrees(text, float(number.replace(",", "").replace("−", "-"))) for text, number in pairs)


@pytest.mark.long
@pytest.mark.parametrize(
    ("page", "folder", "published"),
    [
        ("explanation/real_wing.md", "UAV-Experimental-Calibration", "uav_experimental_calibration"),
        ("explanation/measured_rigs.md", "FOLDER", "measured/two_tanks"),
        ("how_to/discrepancy.md", "", ""),
    ],
)
def test_the_commands_of_a_page_print_what_it_says(page, folder, published, tmp_path):
    """`folder` is how the commands call the folder of the published records, where they need one."""
    if folder:
        records = REFERENCE / published
        if not records.is_dir():
            pytest.skip(f"the published records are not at {records}")
        (tmp_path / folder).symlink_to(records)
    commands = [line.split()[1:] for line in block(page, "") if line.startswith("uav-twin ")]
    with contextlib.chdir(tmp_path):
        answers = [command_line.said(*words) for words in commands]
    answered = [line.rstrip() for answer in answers for line in answer.splitlines()]
    missing = [line for line in block(page, "text") if not any(same_line(line, other) for other in answered)]
    assert missing == []


BLOCK = re.compile(r"^```(.*?)\n(.*?)^```", re.MULTILINE | re.DOTALL)
ROW = re.compile(r" ?(\S(?:.*?\S)?)  +\S")
"""The first cell of a row of a printed table: two blanks end it."""


def named_rows() -> re.Pattern[str]:
    """Return what the rows of the tables of `run` and `fleet run` are called, with any names in fields."""
    titles = [title for group in SUMMARY_TITLES.values() for title, _unit in group.values()]
    titles += [statistic.title for statistic in PRINTED_STATISTICS_OF_FLEETS.values()]
    titles += COUNTS_OF_FLEETS
    pieces = [re.split(r"\{\w+\}", title) for title in titles]
    return re.compile("|".join(".+".join(map(re.escape, piece)) for piece in pieces))


def quoted_tables() -> dict[str, list[str]]:
    """Return the names of the rows of each table of figures that a page quotes, by page."""
    tables: dict[str, list[str]] = {}
    for path in (DOCS.parent / "README.md", *DOCS.rglob("*.md")):
        for language, text in BLOCK.findall(path.read_text("utf-8")):
            if language not in ("", "text"):
                continue
            rows = [row[1] for row in map(ROW.match, text.splitlines()) if row]
            if any("rms error" in row for row in rows):
                tables.setdefault(path.name, []).extend(row for row in rows if row != "result")
    return tables


def test_the_rows_of_quoted_tables_are_called_as_they_are_printed():
    """Figures may be older than the code; the names of the rows must not be."""
    tables, names = quoted_tables(), named_rows()
    assert tables.keys() >= {"README.md", "another_asset.md", "coupling.md", "fleets.md", "scenarios.md"}
    former = {page: [row for row in rows if not names.fullmatch(row)] for page, rows in tables.items()}
    assert {page: rows for page, rows in former.items() if rows} == {}


def test_a_line_with_another_number_is_not_the_same():
    assert same_line("frequency 5.776 Hz", "frequency 5.776 Hz")
    assert not same_line("frequency 5.776 Hz", "frequency 5.786 Hz")
