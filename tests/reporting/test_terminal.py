"""Tables and progress on a terminal, on a pipe, and not at all."""

import time
from io import StringIO

import pytest
from rich.console import Console

from reporting.progress import Progress, RichProgress, SilentProgress
from reporting.terminal import console_table

# ---------------------------------------------------------------- tables


def print_table(headings: tuple[str, ...], rows: list[tuple[str, ...]], width: int) -> list[str]:
    """Return the lines of a table on a terminal of some columns."""
    stream = StringIO()
    console = Console(file=stream, width=width, highlight=False, markup=False)
    console.print(console_table(headings, rows, width))
    return stream.getvalue().splitlines()


ROWS = [
    ("posterior mean of the Young modulus factor of the wing box", "", "1.008", "1.0073 (1)"),
    ("temperature_dependent_modulus", "", "4.1592 points", "3.8 points (2)"),
    ("asset, per step", "", "0.281 ms (largest 3.14 ms)", ""),
]


@pytest.fixture(params=[80, 100, 200])
def width(request):
    return request.param


@pytest.fixture
def lines(width):
    """The lines of `ROWS`, with a column of units that is empty."""
    return print_table(("figure", "unit", "this run", "reference"), ROWS, width)


def test_a_table_fits_its_terminal(lines, width):
    assert max(map(len, lines)) <= width


@pytest.mark.parametrize("number", ["1.008", "1.0073 (1)", "4.1592 points", "3.8 points (2)"])
def test_no_number_breaks_beside_a_long_title(lines, number):
    assert sum(number in line for line in lines) == 1, lines


def test_an_identifier_breaks_at_an_underscore(lines, width):
    is_broken = any(line.split()[:1] == ["dependent_modulus"] for line in lines)

    assert is_broken == (width < 110)


def test_an_empty_column_is_left_out(lines):
    assert "unit" not in "".join(lines)


def test_a_column_with_a_value_stays(width):
    lines = print_table(("parameter", "unit", "value"), [("length", "m", "2")], width)

    assert "unit" in "".join(lines)


@pytest.mark.parametrize("width", [80, 100])
def test_a_table_whose_values_do_not_fit_is_folded(width):
    headings = ("parameter", "unit", "prior", "posterior", "90 % interval", "left of the prior")
    values = ["0.00120 ± 0.00090", "0.00076 ± 0.00019", "0.00044 to 0.00105", "21 %"]
    name = "stiffness-proportional Rayleigh damping of the whole structure, beta"

    lines = print_table(headings, [(name, "s", *values)], width)

    text = "\n".join(lines)
    assert max(map(len, lines)) <= width
    assert "unit: s" in text
    for heading, value in zip(headings[2:], values, strict=True):
        assert f"{heading}: {value}" in text


# ---------------------------------------------------------------- progress


def fly(progress: Progress) -> None:
    """Report three steps of a flight, a stage inside of each, and a note."""
    with progress.stage("Flying [the wing]", total=3, unit="steps") as stage:
        for step in range(3):
            with progress.stage("Inside"):
                pass
            stage.advance(detail=f"step {step}")
        progress.note("half way [there]")


def test_silent_progress_says_nothing(capsys):
    fly(SilentProgress())

    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("variable", ["FORCE_COLOR", "NO_COLOR"])
def test_stages_and_notes_are_shown_and_standard_output_stays_free(variable, monkeypatch, capsys):
    monkeypatch.setenv(variable, "1")

    fly(RichProgress())

    written = capsys.readouterr()
    assert written.out == ""
    for text in ("Flying [the wing]", "steps", "half way [there]", "Inside"):
        assert text in written.err


def test_an_exception_passes_and_the_terminal_is_given_back():
    stream = StringIO()
    progress = RichProgress(Console(file=stream, force_terminal=True, width=120, color_system=None))

    def fail() -> None:
        with progress.stage("Breaking", total=4) as stage:
            stage.advance()
            raise KeyError("x")

    with pytest.raises(KeyError):
        fail()

    show_cursor = "\x1b[?25h"
    assert stream.getvalue().rstrip().endswith(show_cursor)
    assert "1/4" in stream.getvalue()
    fly(progress)  # a next stage begins as if nothing had happened


# ---------------------------------------------------------------- progress on a pipe


def test_on_a_pipe_a_stage_tells_that_it_begins_and_how_far_it_is(monkeypatch):
    seconds = iter([0.0, 1.0, 12.0, 15.0, 23.0, 23.5, 30.0])
    monkeypatch.setattr("reporting.progress.time.perf_counter", lambda: next(seconds))
    stream = StringIO()
    progress = RichProgress(Console(file=stream, width=40))

    with progress.stage("Checking a wing that has a long name", total=4, unit="checks") as stage:
        at_begin = stream.getvalue()
        for number in range(4):
            stage.advance(detail=f"check {number}")

    assert at_begin == "Checking a wing that has a long name, 4 checks ...\n"
    assert stream.getvalue().removeprefix(at_begin).splitlines() == [
        "Checking a wing that has a long name: 2 of 4 checks, check 1, 12 s ...",
        "Checking a wing that has a long name: 4 of 4 checks, check 3, 23 s ...",
        "Checking a wing that has a long name: done, 23.5 s",
    ]


def test_a_stage_that_fails_does_not_look_finished():
    stream = StringIO()
    progress = RichProgress(Console(file=stream), lines=True)

    with pytest.raises(KeyError), progress.stage("Failing"):
        raise KeyError

    assert stream.getvalue() == "Failing ...\n"


def test_a_stage_that_reports_nothing_shows_its_last_detail_again(monkeypatch):
    monkeypatch.setattr("reporting.progress.LONGEST_SILENCE", 0.1)
    stream = StringIO()
    detail = "estimating friction"

    with RichProgress(Console(file=stream, width=80)).stage("Searching") as stage:
        stage.advance(0, detail)
        limit = time.monotonic() + 600.0
        while stream.getvalue().count(detail) < 2 and time.monotonic() < limit:
            time.sleep(0.01)

    first, *repeated, last = stream.getvalue().splitlines()
    with_detail = [line for line in repeated if line.startswith(f"Searching: {detail}, ")]
    assert (first, last[: len("Searching: done")]) == ("Searching ...", "Searching: done")
    assert repeated == with_detail
    assert len(repeated) >= 2


def test_long_names_of_rows_fold_in_two_fifths_of_a_terminal_and_are_not_crushed():
    name = "rms error of the estimated stiffness loss of region 1"
    rows = [(name, "4.16 percentage points", "3.8 percentage points (2)")]
    lines = print_table(("result", "this run", "reference"), rows, 80)
    assert [line[1:33].rstrip() for line in lines if "loss" in line or "rms" in line] == [
        "rms error of the estimated",
        "stiffness loss of region 1",
    ]
    assert max(map(len, lines)) <= 80
