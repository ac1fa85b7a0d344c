"""Progress on a terminal, on a pipe, and not at all."""

import io

import pytest
from rich.console import Console

from reporting.progress import Progress, RichProgress, SilentProgress


def fly(progress: Progress) -> None:
    with progress.stage("Flying [the wing]", total=3, unit="turns") as stage:
        for turn in range(3):
            with progress.stage("Inside"):
                pass
            stage.advance(detail=f"turn {turn}")
        progress.note("half way [there]")


@pytest.mark.parametrize("terminal", [True, False])
def test_stages_and_notes_are_shown(terminal):
    stream = io.StringIO()
    fly(RichProgress(Console(file=stream, force_terminal=terminal, width=120, color_system=None)))
    text = stream.getvalue()
    assert "Flying [the wing]" in text
    assert "turns" in text
    assert "half way [there]" in text
    assert "Inside" in text


def test_silence():
    progress = SilentProgress()
    assert isinstance(progress, Progress)
    assert isinstance(RichProgress(Console(file=io.StringIO())), Progress)
    fly(progress)


def test_an_exception_passes_and_the_terminal_is_given_back():
    stream = io.StringIO()
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


def test_standard_output_stays_free(capsys):
    fly(RichProgress())
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Flying" in captured.err


def test_on_a_pipe_a_stage_tells_that_it_begins_and_how_far_it_is(monkeypatch):
    seconds = iter([0.0, 1.0, 12.0, 15.0, 23.0, 23.5, 30.0])
    monkeypatch.setattr("reporting.progress.time.perf_counter", lambda: next(seconds))
    stream = io.StringIO()
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
    told = io.StringIO()
    with (
        pytest.raises(KeyError),
        RichProgress(Console(file=told), lines=True).stage("Failing"),
    ):
        raise KeyError
    assert told.getvalue() == "Failing ...\n"
