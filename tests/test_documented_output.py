"""What a page prints as the answer of its commands is what they answer, to the digits that it prints."""

import contextlib
import re
from pathlib import Path

import pytest

from benchmarks.pictures.picture import PRINTED_NUMBER, agrees
from tests import command_line
from tests.conftest import REFERENCE

PAGE = Path(__file__).parents[1] / "docs" / "real_wing.md"


def block(language: str) -> list[str]:
    """Return the lines of the first fenced block of the page in a language."""
    match = re.search(
        rf"^```{language}\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    assert match is not None
    return match[1].splitlines()


def same_line(printed: str, answered: str) -> bool:
    """Return whether two lines have the same words, and numbers that agree."""
    if re.split(PRINTED_NUMBER, printed) != re.split(PRINTED_NUMBER, answered):
        return False
    pairs = zip(re.findall(PRINTED_NUMBER, printed), re.findall(PRINTED_NUMBER, answered), strict=True)
    return all(agrees(text, float(number.replace(",", "").replace("−", "-"))) for text, number in pairs)


@pytest.mark.long
def test_the_commands_for_the_real_wing_print_what_the_page_says(tmp_path):
    published = REFERENCE / "uav_experimental_calibration"
    if not published.is_dir():
        pytest.skip(f"the authors' published data are not at {published}")
    (tmp_path / "UAV-Experimental-Calibration").symlink_to(published)
    commands = [line.split()[1:] for line in block("") if line.startswith("uav-twin ")]
    with contextlib.chdir(tmp_path):
        answers = [command_line.said(*words) for words in commands]
    answered = [line.rstrip() for line in answers[-1].splitlines()]
    missing = [line for line in block("text") if not any(same_line(line, other) for other in answered)]
    assert missing == []


def test_a_line_with_another_number_is_not_the_same():
    assert same_line("frequency 5.776 Hz", "frequency 5.776 Hz")
    assert not same_line("frequency 5.776 Hz", "frequency 5.786 Hz")
