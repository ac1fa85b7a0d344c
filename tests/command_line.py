"""The command line as a user calls it, without a process for each call."""

import io
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout

import pytest

from uav_twin import cli


def call(
    monkeypatch: pytest.MonkeyPatch, *words: object, main: Callable[[], None] = cli.main, columns: str = "200"
) -> int:
    """Run `uav-twin` in this process and return its exit code; it writes lines of so many columns.

    `main` is another command line that is run in its place.
    """
    monkeypatch.setattr(sys, "argv", ["uav-twin", *map(str, words)])
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(SystemExit) as ended:
        main()
    code = ended.value.code or 0
    assert isinstance(code, int), code
    return code


def command(
    *words: object, main: Callable[[], None] = cli.main, columns: str = "200"
) -> subprocess.CompletedProcess[str]:
    """Run `uav-twin`, or another command line, in this process; return its exit code and what it said."""
    said, complained = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said), redirect_stderr(complained):
        code = call(patch, *words, main=main, columns=columns)
    return subprocess.CompletedProcess(words, code, said.getvalue(), complained.getvalue())


class Terminal(io.StringIO):
    """What is typed, or seen, at a terminal."""

    def isatty(self) -> bool:
        return True


def seen(*words: object) -> str:
    """Run `uav-twin` at a terminal, which must end well; return what people see there."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(Terminal()) as screen:
        assert call(patch, *words) == 0
    return screen.getvalue()


def said(*words: object) -> str:
    """Run `uav-twin`, which must end well; return what it said."""
    done = command(*words)
    assert done.returncode == 0, done.stderr
    return done.stdout


def refused(*words: object, code: int | None = 1) -> str:
    """Run `uav-twin`, which must end with an exit code (None: with any but 0) and without a traceback.

    Returns what stands on the error stream, on one line.
    """
    done = command(*words)
    assert done.returncode == code or (code is None and done.returncode != 0), done.stderr
    assert "Traceback" not in done.stderr
    return " ".join(done.stderr.replace("│", " ").split())
