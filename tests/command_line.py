"""The command line as a user calls it, without a process for each call."""

from __future__ import annotations

import io
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout

import pytest

from uav_twin import cli


def call(monkeypatch: pytest.MonkeyPatch, *words: object, main: Callable[[], None] = cli.main) -> int:
    """Run `uav-twin` in this process and return its exit code; it writes lines of 200 columns.

    `main` is another command line that is run in its place.
    """
    monkeypatch.setattr(sys, "argv", ["uav-twin", *map(str, words)])
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as ended:
        main()
    code = ended.value.code or 0
    assert isinstance(code, int), code
    return code


def command(*words: object) -> subprocess.CompletedProcess[str]:
    """Run `uav-twin` in this process; return its exit code and what it said."""
    said, complained = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(said), redirect_stderr(complained):
        code = call(patch, *words)
    return subprocess.CompletedProcess(words, code, said.getvalue(), complained.getvalue())
