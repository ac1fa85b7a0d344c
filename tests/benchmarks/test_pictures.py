"""Each picture of README and docs is drawn by one command, and pages quote the numbers that are in it."""

import re
import sys
from pathlib import Path

import pytest

from benchmarks.pictures import __main__ as command
from benchmarks.pictures import whole
from benchmarks.pictures.catalogue import PICTURES
from benchmarks.pictures.picture import (
    IMAGES,
    ROOT,
    Picture,
    Statement,
    agrees,
    numbers_of,
    share_of_changed_pixels,
    with_numbers,
)
from reporting.pages.figures import new_figure, to_png
from tests.conftest import REFERENCE

LARGEST = 300_000
"""Bytes of a picture in the documentation."""
CHANGED = 0.002
"""Share of pixels that may change visibly from one machine to another."""

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))


def quoted(name: str) -> str:
    """Return the first number of a picture that a page quotes."""
    (number, *_) = re.findall(r"\{(\w+)\}", PICTURES[name].statements[0].text)
    return number


def test_the_command_draws_every_picture_of_the_folder():
    committed = {path.name for path in IMAGES.iterdir()}
    assert committed == {f"{whole.NAME}.svg", *(picture.committed.name for picture in PICTURES.values())}


def test_every_picture_stands_on_a_page():
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert [path.name for path in IMAGES.iterdir() if f"images/{path.name}" not in text] == []


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_is_small(name):
    assert PICTURES[name].committed.stat().st_size < LARGEST


@pytest.mark.parametrize("name", PICTURES)
def test_pages_quote_the_numbers_of_the_committed_picture(name):
    """If this fails: python -m benchmarks.pictures NAME draws the picture anew and says what pages state."""
    picture = PICTURES[name]
    assert picture.disagreements(numbers_of(picture.committed.read_bytes())) == []


def cases():
    """Return each picture as a case: those of one source are drawn by one worker, once."""
    parameters = []
    for name, picture in PICTURES.items():
        marks = [pytest.mark.slow, pytest.mark.xdist_group(f"picture of {picture.source or name}")]
        if picture.minutes:
            marks.append(pytest.mark.long)
        parameters.append(pytest.param(picture, id=name, marks=marks))
    return parameters


@pytest.mark.parametrize("picture", cases())
def test_a_picture_drawn_anew_is_the_committed_one(picture: Picture, tmp_path: Path):
    reason = command.reason_to_pass_over(picture, REFERENCE)
    if reason:
        pytest.skip(reason)
    drawing = picture.drawn(REFERENCE)
    (tmp_path / "new.png").write_bytes(drawing.png)
    assert picture.disagreements(drawing.numbers) == []
    if not picture.browser:
        assert share_of_changed_pixels(drawing.png, picture.committed.read_bytes()) < CHANGED


@pytest.mark.parametrize(
    ("printed", "value", "agree"),
    [
        ("13", 13, True),
        ("13", 14, False),
        ("0.1597", 0.15973, True),
        ("0.1597", 0.1599, False),
        ("1,580", 1580.3, True),
        ("−0.25", -0.25, True),
        ("4e-5", 4.2e-5, True),
    ],
)
def test_a_printed_number_agrees_where_it_is_the_value_rounded(printed, value, agree):
    assert agrees(printed, value) is agree


def test_a_number_that_a_page_states_otherwise_is_told():
    statement = Statement("README.md", "alarm at step {alarm},")
    (sentence,) = statement.disagreements({"alarm": 14})
    assert sentence == "README.md says 13 where 14 is drawn: 'alarm at step {alarm},'."


def test_a_sentence_that_no_page_holds_is_told():
    (sentence,) = Statement("README.md", "alarm at century {alarm}").disagreements({"alarm": 14})
    assert "0 times, expected once" in sentence


def test_a_picture_keeps_its_numbers():
    png = to_png(new_figure(1.0, 1.0), 50.0)
    kept = with_numbers(png, {"alarm": 13})
    assert numbers_of(kept) == {"alarm": 13}
    assert share_of_changed_pixels(png, kept) == 0.0


def test_a_stale_picture_makes_the_command_fail(tmp_path, monkeypatch, capsys):
    name = "front_watch"
    committed = PICTURES[name].committed.read_bytes()
    stale = with_numbers(committed, {quoted(name): 14})  # stands before the right one
    (tmp_path / f"{name}.png").write_bytes(stale)
    monkeypatch.setattr(sys, "argv", ["pictures", name, "--check", "--out", str(tmp_path)])
    assert command.main() == 1
    assert "README.md says 13 where 14 is drawn" in capsys.readouterr().out


def test_an_unknown_picture_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["pictures", "front_wach"])
    with pytest.raises(SystemExit):
        command.main()
    assert "There is no picture 'front_wach'" in capsys.readouterr().err
