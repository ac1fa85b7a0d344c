"""Tables and progress on a terminal, on a pipe, and not at all."""

import time
from io import StringIO

import pytest
from rich.console import Console

from reporting.progress import Progress, RichProgress, SilentProgress
from reporting.terminal import console_table


def printed(headings: tuple[str, ...], rows: list[tuple[str, ...]], width: int) -> list[str]:
    console = Console(file=StringIO(), width=width, highlight=False, markup=False)
    console.print(console_table(headings, rows, width))
    assert isinstance(console.file, StringIO)
    return console.file.getvalue().splitlines()


@pytest.mark.parametrize("width", [80, 100, 200])
def test_a_table_can_be_read_at_any_width(width):
    """No number breaks beside a long title, identifiers do where a reader expects it; empty columns go."""
    rows = [
        ("posterior mean of the Young modulus factor of the wing box", "", "1.008", "1.0073 (1)"),
        ("temperature_dependent_modulus", "", "4.1592 points", "3.8 points (2)"),
        ("asset, per step", "", "0.281 ms (largest 3.14 ms)", ""),
    ]
    lines = printed(("figure", "unit", "this run", "reference"), rows, width)
    assert max(map(len, lines)) <= width
    for number in ("1.008", "1.0073 (1)", "4.1592 points", "3.8 points (2)"):
        assert sum(number in line for line in lines) == 1, lines
    assert any(line.split()[:1] == ["dependent_modulus"] for line in lines) == (width < 110)
    assert "unit" not in "".join(lines)
    assert "unit" in "".join(printed(("parameter", "unit", "value"), [("length", "m", "2")], width))


def fly(progress: Progress) -> None:
    with progress.stage("Flying [the wing]", total=3, unit="steps") as stage:
        for step in range(3):
            with progress.stage("Inside"):
                pass
            stage.advance(detail=f"step {step}")
        progress.note("half way [there]")


@pytest.mark.parametrize("terminal", [True, False])
def test_stages_and_notes_are_shown_and_standard_output_stays_free(terminal, monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR" if terminal else "NO_COLOR", "1")
    fly(SilentProgress())
    assert capsys.readouterr() == ("", "")
    fly(RichProgress())
    told = capsys.readouterr()
    assert told.out == ""
    assert all(words in told.err for words in ("Flying [the wing]", "steps", "half way [there]", "Inside"))


def test_an_exception_passes_and_the_terminal_is_given_back():
    stream = StringIO()
    progress = RichProgress(Console(file=stream, force_terminal=True, width=120, color_system=None))

    def fail() -> None:
        with progress.stage("Breaking", total=4) as stage:
            stage.advance()
            raise KeyError("x")

    with pytest.raises(KeyError):
        fail()
    assert stream.getvalue().rstrip().endswith("\x1b[?25h")  # the cursor is visible again
    assert "1/4" in stream.getvalue()
    fly(progress)


def test_on_a_pipe_a_stage_tells_that_it_begins_and_how_far_it_is(monkeypatch):
    seconds = iter([0.0, 1.0, 12.0, 15.0, 23.0, 23.5, 30.0])
    monkeypatch.setattr("reporting.progress.time.perf_counter", lambda: next(seconds))
    stream = StringIO()
    progress = RichProgress(Console(file=stream, width=40))
    with progress.stage("Checking a wing that has a long name", total=4, unit="checks") as stage:
        assert stream.getvalue() == "Checking a wing that has a long name, 4 checks ...\n"
        for number in range(4):
            stage.advance(detail=f"check {number}")
    assert stream.getvalue().splitlines()[1:] == [
        "Checking a wing that has a long name: 2 of 4 checks, check 1, 12 s ...",
        "Checking a wing that has a long name: 4 of 4 checks, check 3, 23 s ...",
        "Checking a wing that has a long name: done, 23.5 s",
    ]


def test_a_stage_that_fails_does_not_look_finished():
    told = StringIO()
    with pytest.raises(KeyError), RichProgress(Console(file=told), lines=True).stage("Failing"):
        raise KeyError
    assert told.getvalue() == "Failing ...\n"


def test_a_stage_that_reports_nothing_shows_its_last_detail_again(monkeypatch):
    monkeypatch.setattr("reporting.progress.LONGEST_SILENCE", 0.1)
    stream = StringIO()
    with RichProgress(Console(file=stream, width=80)).stage("Searching") as stage:
        stage.advance(0, "estimating friction")
        limit = time.monotonic() + 60.0
        while stream.getvalue().count("estimating friction") < 2 and time.monotonic() < limit:
            time.sleep(0.01)
    first, *silent, last = stream.getvalue().splitlines()
    assert first == "Searching ..."
    assert len(silent) >= 2
    assert all(line.startswith("Searching: estimating friction, ") for line in silent)
    assert last.startswith("Searching: done")
